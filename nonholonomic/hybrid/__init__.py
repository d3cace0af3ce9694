"""Hybrid systems: smooth motion in modes with resets between them, for ensembles and single runs, with their
derivatives.

`solve_hybrid` integrates an ensemble of runs, each through the modes of a system; `solve_hybrid_dense` integrates a single
run with its path, and `hybrid_resets` returns the resets of one. `solve_hybrid_with_tangents` carries tangents through every
reset by the saltation matrix. With `traced=True`, `solve_hybrid` and `solve_hybrid_with_tangents` work inside other
transformed functions. `solve_hybrid_with_samples` returns the states of an ensemble at times, and `hybrid_samples` those of
a run inside a transformation, both with their derivatives. A run that is not over after `MOST_ROUNDS` modes is `UNRESOLVED`;
`BETWEEN` is the number of the segment of a `HybridPath` between two modes.

**Example:** two bouncing balls. The event is the highest point: the velocity falls through zero.

>>> import jax
>>> import jax.numpy as jnp
>>> import numpy as np
>>> from nonholonomic.hybrid import AbstractBatchedMode, Transition, solve_hybrid
>>> from nonholonomic.integration import AbstractProblem, Settings
>>> from nonholonomic.integration.problem import RUNNING
>>> class Fall(AbstractProblem):
...     state: jax.Array  # height and velocity, (2, cells), or (2,) for a single run
...     direction_decides = True  # a ball that starts on the ground and rises has not left the mode
...     def start(self):
...         return self.state, jnp.ones_like(self.state)
...     def field(self, time, state):
...         return jnp.stack([state[1], jnp.full_like(state[1], -9.81)])
...     def event_function(self, state):
...         return state[1]
...     def domain_margin(self, time, state):
...         return state[0]
>>> class Bounce(AbstractBatchedMode):
...     restitution: jax.Array
...     def problem(self, state):
...         return Fall(state)
...     def reset_map(self, state, left):
...         none, never = jnp.zeros(left.shape, int), jnp.full(left.shape, jnp.inf)
...         after = jnp.stack([0.0 * state[0], -self.restitution * state[1]])
...         return Transition(none, after, 0.0 * left, none + RUNNING, never, none[None] + 1)
>>> modes, settings = (Bounce(jnp.array([0.6, 0.8])),), Settings(1e-9)
>>> first, start = np.zeros(2, int), np.array([[1.0, 1.0], [0.0, 0.0]])
>>> outcome = solve_hybrid(modes, first, start, 5.0, 2, settings, counters=1)
>>> print(outcome.crossing_time.round(6), outcome.counts)
[0.722438 0.812743] [[1 1]]
"""

from .ensemble import BETWEEN as BETWEEN
from .ensemble import MOST_ROUNDS as MOST_ROUNDS
from .ensemble import AbstractBatchedMode as AbstractBatchedMode
from .ensemble import AbstractHoppingMode as AbstractHoppingMode
from .ensemble import HybridOutcome as HybridOutcome
from .ensemble import HybridPath as HybridPath
from .ensemble import Segment as Segment
from .ensemble import Transition as Transition
from .ensemble import TransitionPath as TransitionPath
from .ensemble import hybrid_resets as hybrid_resets
from .ensemble import solve_hybrid as solve_hybrid
from .ensemble import solve_hybrid_dense as solve_hybrid_dense
from .saltation import solve_hybrid_with_tangents as solve_hybrid_with_tangents
from .samples import hybrid_samples as hybrid_samples
from .samples import solve_hybrid_with_samples as solve_hybrid_with_samples
