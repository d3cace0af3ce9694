"""Integrate runs from an initial state to an event, to the end of the model's validity, or to a horizon.

`solve_ensemble` runs many cells of a problem in lanes that step together; `follow` and `sample` integrate single runs
with any solver of Diffrax. `solve_by_diffrax` is an independent reference. Hybrid runs are in `nonholonomic.hybrid`.
`Settings` holds the options. The status codes of a run are `RUNNING`, `REACHED_END` (at the horizon), `CROSSED` (on the
event), `LEFT_DOMAIN`, `FAILED` and `UNRESOLVED`. The limits are `DEFAULT_MAX_STEPS`, `MOST_STEPS` for runs that should
be short, and `TIGHTEST`, the smallest tolerance.

A `nonholonomic.AbstractMode` has functions of one state, and the package maps them over cells. An `AbstractProblem` has
functions of all cells at once: components along the first axis, cells along the last. `Lanes` is the type of one number
per cell, and `States` the type of the states of all cells.

**Example:** a decay, first as a mode, then as a problem with three cells.

>>> import jax
>>> import jax.numpy as jnp
>>> import nonholonomic
>>> from nonholonomic.integration import AbstractProblem, Settings, solve_ensemble
>>> class Decay(nonholonomic.AbstractMode):
...     rate: float
...     def field(self, t, y):
...         return -self.rate * y
>>> class Decays(AbstractProblem):
...     rate: jax.Array  # (cells,), or () for a single run
...     def start(self):
...         return jnp.ones((1, *self.rate.shape)), jnp.ones((1, *self.rate.shape))
...     def field(self, time, state):
...         return jnp.stack([-self.rate * state[0]])
...     def event_function(self, state):
...         return state[0] - 0.5
...     def domain_margin(self, time, state):
...         return None
>>> problem, settings = Decays(jnp.array([1.0, 2.0, 4.0])), Settings(1e-9)
>>> outcome, iterations = solve_ensemble(problem, jnp.asarray(5.0), jnp.asarray(3), settings)
>>> decay = nonholonomic.Hybrid([Decay(2.0)], event=lambda t, y: y[0] - 0.5)
>>> print(outcome.crossing_time.round(6), nonholonomic.event_time(decay, [1.0], t1=5.0).round(6))
[0.693147 0.346574 0.173287] 0.346574
"""

from .dense import DenseSolution as DenseSolution
from .dense import follow as follow
from .dense import padded as padded
from .dense import sample as sample
from .ensemble import solve_ensemble as solve_ensemble
from .ensemble import traced_solve_ensemble as traced_solve_ensemble
from .extended import AbstractPassive as AbstractPassive
from .extended import ExtendedProblem as ExtendedProblem
from .midpoint import ImplicitMidpoint as ImplicitMidpoint
from .oscillatory import Oscillatory8 as Oscillatory8
from .problem import AbstractProblem as AbstractProblem
from .problem import CoreProblem as CoreProblem
from .problem import crossing_time as crossing_time
from .reference import solve_by_diffrax as solve_by_diffrax
from .runge_kutta import Lanes as Lanes
from .runge_kutta import States as States
from .runge_kutta import explicit_tableau as explicit_tableau
from .samples import solve_with_samples as solve_with_samples
from .scheduler import Outcome as Outcome
from .settings import DEFAULT_MAX_STEPS as DEFAULT_MAX_STEPS
from .settings import MOST_STEPS as MOST_STEPS
from .settings import TIGHTEST as TIGHTEST
from .settings import Settings as Settings
from .settings import legal_run as legal_run
from .settings import require_adaptive as require_adaptive
from .settings import require_adjoint as require_adjoint
from .settings import require_run as require_run
from .settings import require_times as require_times
from .settings import run_bounds as run_bounds
from .settings import tolerance_bound as tolerance_bound
from .status import CROSSED as CROSSED
from .status import FAILED as FAILED
from .status import LEFT_DOMAIN as LEFT_DOMAIN
from .status import REACHED_END as REACHED_END
from .status import RUNNING as RUNNING
from .status import UNRESOLVED as UNRESOLVED
from .status import Status as Status
from .step import LaneState as LaneState
from .zeros import few_trials as few_trials
from .zeros import halved as halved
from .zeros import sign_changes as sign_changes
