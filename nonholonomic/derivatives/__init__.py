"""Forward and adjoint derivatives of the end of a run, and the rate at which neighbouring runs diverge.

With few tangents the variations are integrated along with the run; with more, each run is differentiated by one
backward pass. Both hold step lengths fixed. `sampled_run` returns a run at given times, with derivatives. Hybrid runs
are in `nonholonomic.hybrid`.

**Example:** a decay, whose half-life can be differentiated.

>>> import jax
>>> import jax.numpy as jnp
>>> from nonholonomic.derivatives import AbstractDifferentiableSolve, differentiable_solve, tangents_by
>>> from nonholonomic.derivatives import solve_ensemble_with_tangents
>>> from nonholonomic.integration import AbstractProblem, Settings, solve_ensemble
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
>>> def build(leaves, cells):
...     return Decays(jnp.broadcast_to(leaves[0], () if cells is None else (cells,)))
>>> class HalfLife(AbstractDifferentiableSolve):
...     movable: int = 1
...     def absent(self, value):
...         return jnp.isinf(value)
...     def solve(self, cells, rate):
...         options = (t1, jnp.asarray(cells), settings)
...         return solve_ensemble(build((rate,), cells), *options, traced=True)[0].crossing_time
...     def value_and_tangents(self, active, nested, cells, rate):
...         problem, tangents, gather = tangents_by(build, active, (rate,), cells)
...         options = (t1, jnp.asarray(cells), settings)
...         outcome, slopes = solve_ensemble_with_tangents(problem, tangents, *options, traced=True)
...         return outcome.crossing_time, gather(slopes)
>>> t1, settings = jnp.asarray(5.0), Settings(1e-9)
>>> half_life = lambda rate: differentiable_solve(HalfLife(), rate)
>>> print(jax.vmap(jax.grad(half_life))(jnp.array([1.0, 2.0])).round(6))  # -ln(2) / rate^2
[-0.693147 -0.173287]
"""

from .adjoint import solve_ensemble_with_tangents as solve_ensemble_with_tangents
from .differentiable import AbstractDifferentiableSolve as AbstractDifferentiableSolve
from .differentiable import differentiable_solve as differentiable_solve
from .sampled_runs import SampledRun as SampledRun
from .sampled_runs import sampled_run as sampled_run
from .variation import VariationalProblem as VariationalProblem
from .variation import exponent_of as exponent_of
from .variation import growth as growth
from .variation import in_groups as in_groups
from .variation import tangent_scale as tangent_scale
from .variation import tangents_by as tangents_by
from .variation import tangents_of as tangents_of
