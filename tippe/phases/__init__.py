"""What a top does between two events: slipping and rolling, flying, striking the ground, leaning on its stem.

A `Scene` is built from what is handed out here, so the files that need a `Scene` themselves, the phases of runs through
flights (`sliding`) and through sticking (`stick_slip_runs`) and the path of a flight (`flight_trajectory`), are imported by
their own names.
"""

from .rolling import RollingDynamics as RollingDynamics
from .stick_slip import Kind as Kind
from .stick_slip import StickSlip as StickSlip
