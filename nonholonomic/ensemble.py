"""Many lanes at once: the driver for event times and end states of a whole grid.

A block of lanes advances in lockstep, every lane with its own step length. A lane whose run has ended takes the next
cell of the grid from the queue, so lanes of different cost share a block without waiting for one another. The state is
one array (components, lanes); the numbers of the problem are scalars or one per cell.

Derivatives (forward mode) flow through the states alone; step lengths are held fixed.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental.xla_metadata import set_xla_metadata
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from .lockstep import (
    CROSSED,
    GUARD_LOST,
    REACHED_END,
    RUNNING,
    AbstractProblem,
    Block,
    Control,
    Search,
    attempt,
    crossing_time,
    least_margin,
)
from .runge_kutta import explicit_tableau, first_length


class Outcome(NamedTuple):
    """How every cell ended.

    `status` is one of the codes of `lockstep.py`; `crossing_time` [s] is the time of the event (of the last one, where
    runs pass through it), infinite if there was none; `end_time` [s] and `state` are those at which the run ended;
    `steps` counts accepted and rejected steps, `rejected` the latter.
    """

    status: Int[Array, " cells"]
    crossing_time: Float[Array, " cells"]
    end_time: Float[Array, " cells"]
    state: Float[Array, "components cells"]
    steps: Int[Array, " cells"]
    rejected: Int[Array, " cells"]


def march(
    problem: AbstractProblem,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    rtol: Float[Array, ""],
    atol: Float[Array, ""],
    *,
    solver: diffrax.AbstractERK,
    lanes: int,
    passes: bool = False,
    max_steps: int = 2_000_000,
    one_kernel: bool = False,
) -> tuple[Outcome, Int[Array, ""]]:
    """Run every cell of a problem from t = 0 to its event, to the end of the model's validity, or to `t1`.

    **Arguments:**

    - `problem`: the number of cells is the last axis of its `start()`.
    - `t1`: horizon [s], one for all or one per cell.
    - `cells`: how many of the problem's cells to run; the rest is padding, so that one compiled program serves grids of
      different sizes.
    - `rtol`, `atol`: relative tolerance, and absolute tolerance in units of the problem's magnitudes.
    - `solver`: an explicit Runge-Kutta solver of Diffrax.
    - `lanes`: how many cells advance together.
    - `passes`: whether a run goes on through the event, in either direction, rather than ending there.
    - `max_steps`: a cell that needs more has failed.
    - `one_kernel`: whether to have the loop compiled into a single kernel on a CPU, which halves its cost
      but is not for every problem: see `single_kernel_march`.

    **Returns:** the `Outcome`, and the number of lockstep iterations, each of which advanced `lanes` lanes.
    """
    control = Control(explicit_tableau(solver), solver.order(None), rtol, t1, max_steps, passes)
    starts, scales = problem.start()
    capacity = starts.shape[1]
    zero = jnp.zeros_like(starts[0])
    start_rates = problem.field(zero, starts)
    atols = atol * scales
    lengths = stop_gradient(first_length(problem.field, zero, starts, start_rates, control.order, rtol, atols))
    fresh = _fresh_block(problem, control, starts, start_rates, jnp.minimum(lengths, t1))

    def pick(tree: Any, cell: Int[Array, " lanes"]) -> Any:
        inside = jnp.minimum(cell, capacity - 1)
        return jax.tree.map(lambda leaf: leaf if jnp.ndim(leaf) == 0 else leaf[..., inside], tree)

    def load(cell: Int[Array, " lanes"]) -> Block:
        block = pick(fresh, cell)
        # A lane whose cell does not exist has nothing to do.
        return block._replace(cell=cell, status=jnp.where(cell < cells, block.status, REACHED_END))

    def store(outcome: Outcome, block: Block) -> Outcome:
        ended = (block.status != RUNNING) & (block.cell < cells)
        to = jnp.where(ended, block.cell, capacity)
        found = Outcome(block.status, block.crossing_time, block.time, block.state, block.steps, block.rejected)
        return jax.tree.map(lambda all, some: all.at[..., to].set(some, mode="drop"), outcome, found)

    def run_and_refill(carry):
        block, queued, outcome, iterations = carry
        here, atol_here = pick(problem, block.cell), pick(atols, block.cell)
        control_here = control._replace(t1=pick(t1, block.cell))
        # While cells wait, stop to refill once a sixteenth of the lanes is idle; then run to the last lane.
        least_active = jnp.where(queued < cells, lanes - max(1, lanes // 16), 0)

        def enough_active(inner):
            return jnp.sum(inner[0].status == RUNNING) > least_active

        def step(inner):
            return attempt(here, control_here, atol_here, inner[0]), inner[1] + 1

        def run(inner):
            return jax.lax.while_loop(enough_active, step, inner)

        block, iterations = (_in_one_kernel(run) if one_kernel else run)((block, iterations))
        outcome = store(outcome, block)
        idle = block.status != RUNNING
        next_cell = jnp.minimum(queued + jnp.cumsum(idle) - 1, capacity)
        loaded = load(jnp.where(idle, next_cell, block.cell))
        block = jax.tree.map(lambda new, old: jnp.where(idle, new, old), loaded, block)
        return block, jnp.minimum(queued + jnp.sum(idle), cells), outcome, iterations

    def unfinished(carry):
        block, queued, *_ = carry
        return jnp.any(block.status == RUNNING) | (queued < cells)

    empty = Outcome(fresh.status, fresh.crossing_time, fresh.time, fresh.state, fresh.steps, fresh.rejected)
    carry = (load(jnp.arange(lanes)), jnp.minimum(lanes, cells), empty, jnp.zeros((), int))
    block, _, outcome, iterations = jax.lax.while_loop(unfinished, run_and_refill, carry)
    outcome = store(outcome, block)
    if not passes and problem.crossing(outcome.state) is not None:
        time = crossing_time(problem, outcome.end_time, outcome.state)
        # A cell that starts beyond the event is there at once.
        time = jnp.where(outcome.end_time > 0.0, time, 0.0)
        outcome = outcome._replace(crossing_time=jnp.where(outcome.status == CROSSED, time, jnp.inf))
    return outcome, iterations


def _in_one_kernel(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function that XLA compiles, on a CPU, into a single kernel.

    Otherwise every fused operation of a loop's body is a call of its own, and for blocks that fit the first caches calling
    costs as much as computing. XLA does so by itself for loops over very small arrays only.
    """
    if jax.default_backend() != "cpu":
        return function

    def called(argument: Any) -> Any:
        with set_xla_metadata(xla_cpu_small_call="true", inlineable="false"):
            return jax.jit(function)(argument)

    return called


#: JAX takes compiler options only for the outermost compiled function. Wide vectors pay here, although compilers shy away
#: from them: the sums over stages are streams of multiply-adds.
_alone = eqx.filter_jit(compiler_options={"xla_cpu_prefer_vector_width": 512})

#: `march`, compiled on its own.
compiled_march = _alone(march)

#: The same with the loop in one kernel, twice as fast on a CPU. XLA aborts the process on some programs (jaxlib 0.10.2: where
#: components of the field vanish identically, and on second derivatives), so this is for problems that a test has gone
#: through, and with other versions of jaxlib it is `compiled_march`.
single_kernel_march = (
    _alone(functools.partial(march, one_kernel=True)) if jaxlib.__version__.startswith("0.10.") else compiled_march
)

#: `march`, for use inside other transformed functions.
traced_march = eqx.filter_jit(march)


def lanes_for(cells: int) -> int:
    """How many cells should advance together.

    On a CPU a block and its stages should fit the first caches; an accelerator is idle below tens of thousands.
    """
    most = 64 if jax.default_backend() == "cpu" else 32768
    return min(most, 1 << (cells - 1).bit_length())


def _fresh_block(
    problem: AbstractProblem,
    control: Control,
    states: Float[Array, "components cells"],
    rates: Float[Array, "components cells"],
    lengths: Float[Array, " cells"],
) -> Block:
    """Every cell at its start; one that starts beyond the event or beyond the guard has ended."""
    zero, none = jnp.zeros_like(lengths), jnp.zeros(lengths.shape, int)
    no = jnp.zeros(lengths.shape, bool)
    crossing, guard = problem.crossing(states), problem.guard(zero, states)
    beyond = no
    if crossing is not None:
        # On the event exactly, it is the way onwards that counts.
        falls = jax.jvp(problem.crossing, (states,), (rates,))[1] <= 0.0
        beyond = (crossing < 0.0) | ((crossing == 0.0) & (falls | (not control.passes)))
    side = jnp.where(beyond & control.passes, -1.0, 1.0).astype(lengths.dtype)
    status = jnp.where(beyond & (not control.passes), CROSSED, RUNNING)
    if guard is not None:
        status = jnp.where(guard <= 0.0, GUARD_LOST, status)
    return Block(
        cell=jnp.arange(lengths.shape[0]),
        status=status,
        time=zero,
        state=states,
        rate=rates,
        length=lengths,
        side=side,
        margin=stop_gradient(least_margin(problem, side, zero, states)),
        crossing_time=jnp.where(beyond, zero, jnp.inf),
        searching=no,
        search=Search(zero, zero, zero, zero, zero, none),
        steps=none,
        rejected=none,
    )
