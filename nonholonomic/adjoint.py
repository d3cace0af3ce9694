"""First derivatives of event times by any number of numbers at once: the discrete adjoint of the march.

A run is cut into periods, each with its steps recorded. Once the last one is done, the periods are taken back from the last
to the first, the derivatives of the events' times by the states carried along; a period whose record is gone is repeated from
the latest progress that was kept before it. The cost does not depend on how many numbers move, and the memory not on how
long the runs are. Step lengths are held fixed, as they are by the variations (`variation.py`).
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .lockstep import RUNNING, AbstractProblem, Block, attempt
from .queue import Outcome, Progress, Queue, in_one_kernel
from .runge_kutta import Lanes, States, moved_state, weighted_sum
from .shared_values import sharing_values

#: Iterations of a period: as many as have a record that fits the caches.
PERIOD = 128

#: Periods at whose start the progress is kept; beyond that some are forgotten, and repeated from further back.
KEPT = 256

#: What is measured of a run at its end: (problem, block) -> a number per lane, with its derivative by the problem's numbers
#: and the block's state.
Measured = Callable[[AbstractProblem, Block], Lanes]


class Record(NamedTuple):
    """The steps of a period: where each began, and its length, 0 for a lane that did not move."""

    time: Float[Array, "iterations lanes"]
    state: Float[Array, "iterations components lanes"]
    length: Float[Array, "iterations lanes"]


class Kept(NamedTuple):
    """Progress that was kept, the earliest first.

    `depth` of them; `index` says of which period each is the start, `slot` where in `progress` it stands.
    """

    depth: Int[Array, ""]
    index: Int[Array, " slots"]
    slot: Int[Array, " slots"]
    progress: Progress

    @classmethod
    def of(cls, progress: Progress) -> "Kept":
        """The start of the first period."""
        room = jax.tree.map(lambda leaf: jnp.zeros((KEPT, *leaf.shape), leaf.dtype).at[0].set(leaf), progress)
        return cls(jnp.ones((), int), jnp.zeros(KEPT, int), jnp.arange(KEPT), room)

    def latest(self) -> tuple[Int[Array, ""], Progress]:
        """The latest, and of which period it is the start."""
        last = self.depth - 1
        return self.index[last], jax.tree.map(functools.partial(_read, at=self.slot[last]), self.progress)

    def dropped(self, drop: Bool[Array, ""]) -> "Kept":
        """Without the latest, if it is to be dropped."""
        return self._replace(depth=self.depth - drop)

    def added(self, index: Int[Array, ""], progress: Progress, add: Bool[Array, ""]) -> "Kept":
        """With another one, if it is to be added; where there is no room, the one whose neighbours are closest is forgotten."""
        position = jnp.arange(KEPT)
        full = self.depth == KEPT
        following = jnp.where(position == KEPT - 1, index, jnp.roll(self.index, -1))
        gap = jnp.where(position == 0, jnp.iinfo(self.index.dtype).max, following - jnp.roll(self.index, 1))
        forgotten = jnp.where(full, jnp.argmin(gap), self.depth)
        free = self.slot[forgotten]
        moves = full & (position >= forgotten)
        to = jnp.minimum(self.depth, KEPT - 1)
        indices = jnp.where(moves, jnp.roll(self.index, -1), self.index).at[to].set(index)
        slots = jnp.where(moves, jnp.roll(self.slot, -1), self.slot).at[to].set(free)
        # Written in any case: where none is added, the room is free.
        room = jax.tree.map(functools.partial(_written, at=free), self.progress, progress)
        return Kept(jnp.minimum(self.depth + add, KEPT), indices, slots, room)


class Backward(NamedTuple):
    """A run on its way back: `needed` is the period behind the one to be taken back next.

    `adjoint` has, for the cell in each lane, the derivatives of what is measured by the state, in its first rows, and by the
    numbers that move; `gradient` those of every cell by its start.
    """

    kept: Kept
    needed: Int[Array, ""]
    outcome: Outcome
    adjoint: Float[Array, "rows lanes"]
    gradient: Float[Array, "rows cells"]


def march_with_gradient(
    problem: AbstractProblem,
    moving: Any,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    rtol: Float[Array, ""],
    atol: Float[Array, ""],
    *,
    measured: Measured,
    solver: diffrax.AbstractERK,
    lanes: int,
    one_kernel: bool = False,
) -> tuple[Outcome, Float[Array, "components cells"], Any]:
    """Run every cell to its end, and differentiate what is measured there by the numbers of the problem.

    **Arguments:** as for `ensemble.march`, and

    - `moving`: a tree like the problem of booleans: which of its numbers to differentiate by.
    - `measured`: what is measured.

    **Returns:** the `Outcome`, with crossing times left out; the derivatives of every cell by its state at the start; and
    those by the numbers, one per cell, in a tree like the problem with `None` for what does not move.
    """
    states = problem.start()[0]
    components, size = states.shape
    numbers, rest = eqx.partition(problem, moving)
    numbers = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size,)), numbers)
    problem = eqx.combine(numbers, rest)
    queue = Queue.of(problem, t1, cells, rtol, atol, solver=solver, lanes=lanes, one_kernel=one_kernel)
    rows = components + len(jax.tree.leaves(numbers))

    def period(run: Backward) -> Backward:
        index, before = run.kept.latest()
        after, record, count = _recorded(queue, before)
        outcome = queue.store(run.outcome, after.block)
        onward = queue.refill(after)
        back = ~queue.unfinished(onward) | (index + 1 == run.needed)
        adjoint = _taken_back(queue, moving, measured, after.block, record, jnp.where(back, count, 0), run.adjoint)
        # A cell that had made no step was at its start.
        began = back & (before.block.steps == 0) & (before.block.cell < cells)
        to = jnp.where(began, before.block.cell, size)
        return Backward(
            kept=run.kept.dropped(back).added(index + 1, onward, ~back),
            needed=jnp.where(back, index, run.needed),
            outcome=outcome,
            adjoint=jnp.where(back, adjoint, run.adjoint),
            gradient=run.gradient.at[:, to].set(adjoint, mode="drop"),
        )

    run = Backward(
        kept=Kept.of(queue.start()),
        needed=jnp.asarray(jnp.iinfo(int).max),
        outcome=queue.empty(),
        adjoint=jnp.zeros((rows, lanes), states.dtype),
        gradient=jnp.zeros((rows, size), states.dtype),
    )
    run = jax.lax.while_loop(lambda run: run.needed > 0, period, run)
    by_number = jax.tree.unflatten(jax.tree.structure(numbers), list(run.gradient[components:]))
    return run.outcome, run.gradient[:components], by_number


def _recorded(queue: Queue, progress: Progress) -> tuple[Progress, Record, Int[Array, ""]]:
    """Let the block go on for a period, with its steps recorded; and how many iterations that were."""
    here = queue.here(progress.block)

    def going(carry: Any) -> Bool[Array, ""]:
        block, _, count = carry
        return queue.enough_active(block, progress.queued) & (count < PERIOD)

    def step(carry: Any) -> Any:
        block, record, count = carry
        after = attempt(*here, block)
        made = Record(block.time, block.state, jnp.where(after.time > block.time, block.length, 0.0))
        record = jax.tree.map(functools.partial(_written, at=count), record, made)
        return after, record, count + 1

    def loop(start: Block) -> Any:
        empty = Record(
            *(jnp.zeros((PERIOD, *leaf.shape), leaf.dtype) for leaf in (start.time, start.state, start.length))
        )
        return jax.lax.while_loop(going, step, (start, empty, jnp.zeros((), int)))

    block, record, count = (in_one_kernel(loop) if queue.one_kernel else loop)(progress.block)
    return Progress(block, progress.queued, progress.iterations + count), record, count


def _taken_back(
    queue: Queue,
    moving: Any,
    measured: Measured,
    block: Block,
    record: Record,
    count: Int[Array, ""],
    adjoint: Float[Array, "rows lanes"],
) -> Float[Array, "rows lanes"]:
    """Carry the derivatives from the end of a period to its start; those of the lanes that have ended begin there."""

    def loop(carry: Any) -> Any:
        block, record, count, adjoint = carry
        problem = queue.here(block)[0]
        ended = block.status != RUNNING
        adjoint = jnp.where(ended, _at_the_end(problem, moving, measured, block), adjoint)

        def step(carry: Any) -> Any:
            index, adjoint = carry
            made = jax.tree.map(functools.partial(_read, at=index - 1), record)
            return index - 1, step_taken_back(queue.control.tableau, problem, moving, *made, adjoint)

        return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (count, adjoint))[1]

    return (in_one_kernel(loop) if queue.one_kernel else loop)((block, record, count, adjoint))


def _at_the_end(problem: AbstractProblem, moving: Any, measured: Measured, block: Block) -> Float[Array, "rows lanes"]:
    """The derivatives of what is measured, by the state at the end and by the numbers."""
    numbers, rest = eqx.partition(problem, moving)

    def value(numbers: Any, state: States) -> Lanes:
        return measured(eqx.combine(numbers, rest), block._replace(state=state))

    by_number, by_state = jax.vjp(value, numbers, block.state)[1](jnp.ones_like(block.time))
    return jnp.concatenate([by_state, *(one[None] for one in jax.tree.leaves(by_number))])


def step_taken_back(
    tableau: diffrax.ButcherTableau,
    problem: AbstractProblem,
    moving: Any,
    time: Lanes,
    state: States,
    length: Lanes,
    adjoint: Float[Array, "rows lanes"],
) -> Float[Array, "rows lanes"]:
    """Carry derivatives from the end of a Runge-Kutta step to its start (Hager, Numer. Math. 87 (2000) 247).

    **Arguments:**

    - `tableau`: the method.
    - `problem`, `moving`: its leaves scalars or one number per lane; which of them to differentiate by.
    - `time`, `state`, `length`: where the step starts, and its length; 0 where none was made.
    - `adjoint`: derivatives at the end of the step, by the state and by the numbers.

    **Returns:** those at the start.
    """
    numbers, rest = eqx.partition(problem, moving)
    components = state.shape[0]

    def pull(at: Lanes, numbers: Any, parts: tuple[Lanes, ...], by_rate: tuple[Lanes, ...]) -> tuple[Lanes, ...]:
        def field(numbers: Any, parts: tuple[Lanes, ...]) -> States:
            return eqx.combine(numbers, rest).field(at, parts)

        by_number, by_part = jax.vjp(field, numbers, parts)[1](jnp.stack(by_rate))
        return (*by_part, *jax.tree.leaves(by_number))

    weights, fractions = tableau.b_sol, [0.0, *tableau.c]
    if tableau.fsal:
        weights, fractions = tableau.a_lower[-1], fractions[:-1]
    times = [time + float(fraction) * length for fraction in fractions]
    states, rates = [state], []
    for row, at in zip(tableau.a_lower[: len(times) - 1], times, strict=False):
        rates.append(jax.lax.optimization_barrier(problem.field(at, states[-1])))
        states.append(moved_state(state, length, row, rates))
    by_state, by_stage = adjoint[:components], [adjoint] * len(times)
    for stage in reversed(range(len(times))):
        later = range(stage + 1, len(times))
        shares = [weights[stage], *(tableau.a_lower[after - 1][stage] for after in later)]
        behind = [by_state, *(by_stage[after][:components] for after in later)]
        by_rate = moved_state(jnp.zeros_like(by_state), length, shares, behind)
        parts = tuple(jnp.unstack(states[stage])), tuple(jnp.unstack(by_rate))
        by_stage[stage] = jax.lax.optimization_barrier(jnp.stack(sharing_values(pull)(times[stage], numbers, *parts)))
    return jnp.where(length > 0.0, adjoint + sum(by_stage), adjoint)


def _read(all: Array, at: Int[Array, ""]) -> Array:
    """One of the arrays that are stacked in another."""
    return jax.lax.dynamic_index_in_dim(all, at, 0, keepdims=False)


def _written(all: Array, one: Array, at: Int[Array, ""]) -> Array:
    """A stack of arrays with one of them replaced; without the look at bounds that `at[].set` has, it is done in place."""
    return jax.lax.dynamic_update_index_in_dim(all, one, at, 0)
