"""Users' own systems on the engine of the two vehicles: event times, trajectories, tables and fits, with their derivatives.

A hybrid system is a `Hybrid` of modes, each an `AbstractMode`; a mechanical system is an `AbstractSystem`, from whose metric,
potential, constraints and forces the equations of motion follow.
"""

from .event_time import event_time as event_time
from .identify import Recording as Recording
from .identify import identify as identify
from .mode import AbstractMode as AbstractMode
from .mode import Hybrid as Hybrid
from .simulate import simulate as simulate
from .sweep import sweep as sweep
from .trajectory import Trajectory as Trajectory
