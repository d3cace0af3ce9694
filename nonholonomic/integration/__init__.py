"""Runs in time: from a start along a field to an event, to the end of the model's validity, or to a horizon.

`compiled_march` runs many cells of a problem in lanes that keep step with one another; `follow` and `sample` are single runs
with any solver of Diffrax. `march_by_diffrax` is the independent second road. Runs of several modes are in
`nonholonomic.hybrid`. `Settings` says how, and the codes of a run's status are `RUNNING`, `REACHED_END`, `CROSSED`,
`GUARD_LOST`, `FAILED` and `UNRESOLVED`.
"""

from .attempt import Block as Block
from .attempt import attempt as attempt
from .attempt import length_to_try as length_to_try
from .diffrax_march import march_by_diffrax as march_by_diffrax
from .march import compiled_march as compiled_march
from .march import traced_march as traced_march
from .march import with_crossing_times as with_crossing_times
from .midpoint import ImplicitMidpoint as ImplicitMidpoint
from .oscillatory import Oscillatory8 as Oscillatory8
from .problem import AbstractProblem as AbstractProblem
from .problem import LeadingProblem as LeadingProblem
from .problem import crossing_time as crossing_time
from .problem import event_time as event_time
from .queue import Outcome as Outcome
from .queue import Progress as Progress
from .queue import Queue as Queue
from .runge_kutta import Lanes as Lanes
from .runge_kutta import Stages as Stages
from .runge_kutta import States as States
from .runge_kutta import explicit_tableau as explicit_tableau
from .runge_kutta import moved_state as moved_state
from .runge_kutta import over_stages as over_stages
from .samples import march_with_samples as march_with_samples
from .settings import ABSOLUTE as ABSOLUTE
from .settings import LOOSEST as LOOSEST
from .settings import MOST_STEPS as MOST_STEPS
from .settings import Settings as Settings
from .settings import lanes_for as lanes_for
from .settings import require_adaptive as require_adaptive
from .settings import require_adjoint as require_adjoint
from .settings import run_bounds as run_bounds
from .settings import times_bounds as times_bounds
from .settings import tolerance_bound as tolerance_bound
from .single_run import Followed as Followed
from .single_run import Sampled as Sampled
from .single_run import follow as follow
from .single_run import padded as padded
from .single_run import sample as sample
from .status import CROSSED as CROSSED
from .status import FAILED as FAILED
from .status import FORMER_WORDS as FORMER_WORDS
from .status import GUARD_LOST as GUARD_LOST
from .status import REACHED_END as REACHED_END
from .status import RUNNING as RUNNING
from .status import UNRESOLVED as UNRESOLVED
from .status import Status as Status
from .zeros import few_trials as few_trials
from .zeros import halved as halved
from .zeros import sign_changes as sign_changes
