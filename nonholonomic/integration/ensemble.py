"""Many lanes at once: the driver for event times and end states of a whole grid.

A block of lanes advances in lockstep, every lane with its own step length; cells wait in a queue for a lane (`scheduler.py`).
The state is one array (components, lanes); the parameters of the problem are scalars or one per cell.

Derivatives (forward mode) flow through the states alone; step lengths are held fixed. `derivatives/slopes.py` has the
fast ways to first derivatives.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..xla_cpu import compiled_alone
from .problem import AbstractProblem, crossing_time
from .scheduler import LaneScheduler, Outcome
from .settings import Settings
from .status import CROSSED


def ensemble_solve(
    problem: AbstractProblem,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    passes: bool = False,
    one_kernel: bool = False,
    parts: int = 1,
) -> tuple[Outcome, Int[Array, ""]]:
    """Run every cell of a problem from t = 0 to its event, to the end of the model's validity, or to `t1`.

    **Arguments:**

    - `problem`: the number of cells is the last axis of its `start()`.
    - `t1`: horizon [s], one for all or one per cell.
    - `cells`: how many of the problem's cells to run; the rest is padding, so that one compiled program serves grids of
      different sizes.
    - `settings`: with an explicit Runge-Kutta solver of Diffrax.
    - `passes`: whether a run goes on through the event, in either direction, rather than ending there.
    - `one_kernel`: whether to have the loop compiled into a single kernel on a CPU, which halves its cost; not for
      programs that are differentiated again.
    - `parts`: of how many equal parts the state is made, as for `LaneScheduler.of`.

    **Returns:** the `Outcome`, and the number of lockstep iterations, each of which advanced a block of lanes.
    """
    options = {"passes": passes, "one_kernel": one_kernel, "parts": parts}
    outcome, iterations = LaneScheduler.of(problem, t1, cells, settings, **options).outcome()
    return (outcome if passes else with_crossing_times(problem, outcome)), iterations


def with_crossing_times(problem: AbstractProblem, outcome: Outcome) -> Outcome:
    """The outcome with the time of the event in the cells that ended on it, infinite in the others."""
    if problem.event_function(outcome.state) is None:
        return outcome
    time = crossing_time(problem, outcome.end_time, outcome.state)
    # A cell that starts beyond the event is there at once.
    time = jnp.where(outcome.end_time > 0.0, time, 0.0)
    time = jnp.where(outcome.status == CROSSED, time, jnp.inf)
    return outcome._replace(first_crossing=time, crossing_time=time)


#: `ensemble_solve`, compiled on its own, for use outside of other transformed functions.
solve_ensemble = compiled_alone(functools.partial(ensemble_solve, one_kernel=True))

#: `ensemble_solve`, for use inside other transformed functions.
traced_solve_ensemble = eqx.filter_jit(ensemble_solve)
