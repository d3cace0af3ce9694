"""Runs in time: from a start along a field to an event, to the end of the model's validity, or to a horizon.

`compiled_march` runs many cells of a problem in lanes that advance together; `travel` runs cells
through phases; `follow` and `sample` are single runs with any solver of Diffrax, and `march_by_diffrax` is the
independent check. The codes of a run's status are `RUNNING`, `CROSSED`, `GUARD_LOST`, `REACHED_END` and
`FAILED`.
"""

from .diffrax_march import march_by_diffrax as march_by_diffrax
from .lockstep import CROSSED as CROSSED
from .lockstep import FAILED as FAILED
from .lockstep import GUARD_LOST as GUARD_LOST
from .lockstep import REACHED_END as REACHED_END
from .lockstep import RUNNING as RUNNING
from .lockstep import AbstractProblem as AbstractProblem
from .lockstep import Block as Block
from .lockstep import attempt as attempt
from .lockstep import crossing_time as crossing_time
from .lockstep import event_time as event_time
from .lockstep import length_to_try as length_to_try
from .march import alone as alone
from .march import compiled_march as compiled_march
from .march import lanes_for as lanes_for
from .march import traced_march as traced_march
from .march import with_crossing_times as with_crossing_times
from .midpoint import ImplicitMidpoint as ImplicitMidpoint
from .phases import UNRESOLVED as UNRESOLVED
from .phases import AbstractPhase as AbstractPhase
from .phases import Journey as Journey
from .phases import Passage as Passage
from .phases import travel as travel
from .queue import Outcome as Outcome
from .queue import Progress as Progress
from .queue import Queue as Queue
from .runge_kutta import Lanes as Lanes
from .runge_kutta import States as States
from .runge_kutta import explicit_tableau as explicit_tableau
from .runge_kutta import moved_state as moved_state
from .samples import march_with_samples as march_with_samples
from .single_run import MOST_STEPS as MOST_STEPS
from .single_run import Followed as Followed
from .single_run import follow as follow
from .single_run import sample as sample
from .zeros import few_trials as few_trials
from .zeros import halved as halved
from .zeros import sign_changes as sign_changes
