"""Solve an ensemble in lanes: event times and end states of a whole grid.

All lanes step together, every lane with its own step length; cells wait in a queue for a lane (`scheduler.py`). The
state is one array (components, lanes); the parameters of the problem are scalars or one per cell.

Forward-mode derivatives flow through the states alone; step lengths are held fixed. `derivatives/slopes.py` computes
first derivatives faster.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..compilation.xla_cpu import compiled_alone
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
    nonterminal: bool = False,
    one_kernel: bool = False,
    n_blocks: int = 1,
) -> tuple[Outcome, Int[Array, ""]]:
    """Run every cell of a problem from t = 0 to its event, to the end of the model's validity, or to `t1`.

    `solve_ensemble` is compiled on its own, for use outside of other transformed functions; `traced_solve_ensemble` is for
    use inside them.

    **Arguments:**

    - `problem`: the problem; the last axis of its `start()` counts the cells.
    - `t1`: horizon [s], one number for all cells or one per cell.
    - `cells`: number of cells to run; the other cells of the problem are padding, so that one compiled program serves
      grids of different sizes.
    - `settings`: settings with an explicit Runge-Kutta solver of Diffrax.
    - `nonterminal`: whether the event is nonterminal: a run continues through it, in either direction.
    - `one_kernel`: whether to compile the loop into a single kernel on a CPU, which halves its cost; not for programs
      that are differentiated again.
    - `n_blocks`: number of equal blocks of the state, as for `LaneScheduler.of`.

    **Returns:** the `Outcome`, and the number of iterations, each of which advanced all lanes.

    **Example:** inside `jit`, with `traced_solve_ensemble`. With `nonterminal`, the runs continue to `t1`.

    >>> from nonholonomic.integration import traced_solve_ensemble
    >>> def solve(problem, t1):
    ...     return traced_solve_ensemble(problem, t1, jnp.asarray(3), settings, nonterminal=True)[0]
    >>> continued = jax.jit(solve)(problem, jnp.asarray(2.0))
    >>> print(continued.crossing_time.round(6), continued.end_time)
    [0.693147 0.346574 0.173287] [2. 2. 2.]
    """
    options = {"nonterminal": nonterminal, "one_kernel": one_kernel, "n_blocks": n_blocks}
    outcome, iterations = LaneScheduler.of(problem, t1, cells, settings, **options).outcome()
    return (outcome if nonterminal else with_crossing_times(problem, outcome)), iterations


def with_crossing_times(problem: AbstractProblem, outcome: Outcome) -> Outcome:
    """The outcome with the event time of the cells that ended on the event, and infinite times for the others."""
    if problem.event_function(outcome.state) is None:
        return outcome
    time = crossing_time(problem, outcome.end_time, outcome.state)
    # A cell that starts beyond the event has its event at 0.
    time = jnp.where(outcome.end_time > 0.0, time, 0.0)
    time = jnp.where(outcome.status == CROSSED, time, jnp.inf)
    return outcome._replace(first_crossing=time, crossing_time=time)


# With its docstring.
solve_ensemble = compiled_alone(
    functools.update_wrapper(functools.partial(ensemble_solve, one_kernel=True), ensemble_solve)
)

traced_solve_ensemble = eqx.filter_jit(ensemble_solve)
