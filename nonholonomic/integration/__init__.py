"""Integrate runs from an initial state to an event, to the end of the model's validity, or to a horizon.

`solve_ensemble` runs many cells of a problem in lanes that step together; `follow` and `sample` integrate single runs
with any solver of Diffrax. `solve_by_diffrax` is an independent reference. Hybrid runs are in `nonholonomic.hybrid`.
`Settings` holds the options. Import more from two modules of this subpackage: the codes of how a run ended, and checks of
arguments, from `problem`; zeros of functions from `dense`.

A `nonholonomic.AbstractMode` has functions of one state, and the package maps them over cells. An `AbstractProblem` has
functions of all cells at once: components along the first axis, cells along the last. `Lanes` is the type of one number
per cell, and `States` the type of the states of all cells; `Components` are states that may also come as a tuple.

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
from .dense import ImplicitMidpoint as ImplicitMidpoint
from .dense import follow as follow
from .dense import sample as sample
from .dense import solve_by_diffrax as solve_by_diffrax
from .problem import AbstractPassive as AbstractPassive
from .problem import AbstractProblem as AbstractProblem
from .problem import CoreProblem as CoreProblem
from .problem import ExtendedProblem as ExtendedProblem
from .problem import Jumps as Jumps
from .problem import Settings as Settings
from .problem import crossing_time as crossing_time
from .runge_kutta import Components as Components
from .runge_kutta import Lanes as Lanes
from .runge_kutta import Oscillatory8 as Oscillatory8
from .runge_kutta import Stabilized8 as Stabilized8
from .runge_kutta import States as States
from .runge_kutta import explicit_tableau as explicit_tableau
from .samples import solve_with_samples as solve_with_samples
from .scheduler import Outcome as Outcome
from .scheduler import solve_ensemble as solve_ensemble
from .step import LaneState as LaneState
