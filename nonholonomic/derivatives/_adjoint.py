"""First derivatives of event times by any number of numbers at once: the discrete adjoint of the march.

A run is cut into periods, each with its steps recorded. Once the last one is done, the periods are taken back from the last
to the first, the derivatives of the events' times by the states carried along; a period whose record is gone is repeated from
the latest progress that was kept before it. The cost does not depend on how many numbers move, and the memory not on how
long the runs are. Step lengths are held fixed, as they are by the variations (`variation.py`).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..integration import (
    RUNNING,
    AbstractProblem,
    Block,
    Lanes,
    Outcome,
    Progress,
    Queue,
    States,
    attempt,
    length_to_try,
    moved_state,
)
from ._shared_values import sharing_values
from .variation import VariationalProblem

#: Iterations of a period: as many as have a record that fits the caches.
PERIOD = 128

#: Periods at whose start the progress is kept; beyond that some are forgotten, and repeated from further back. With the 64
#: lanes of a CPU that takes 5 MB, with the 32768 of an accelerator 2 GB.
KEPT = 256

#: What is measured of a run at its end: (problem, block) -> a number per lane, with its derivative by the problem's numbers
#: and the block's state.
Measured = Callable[[Any, Block], Lanes]


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
    problem: VariationalProblem,
    moving: Any,
    probe: Any,
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

    **Arguments:** as for `march`, but `passes` and `max_steps`, and

    - `problem`: without directions.
    - `moving`: a tree like the problem of booleans: which of its numbers to differentiate by, scalars or (cells,).
    - `probe`: a direction of the inner problem. Its variation runs along and takes part in step control, so that the steps
      bear tangents also where the state is at rest.
    - `measured`: what is measured.

    **Returns:** the `Outcome`, with crossing times left out; the derivatives of every cell by its state at the start; and
    those by the numbers, one per cell, in a tree like the problem with `None` for what does not move.

    **Raises:** `ValueError` for a number that moves and has several components.
    """
    states = problem.start()[0]
    components, size = states.shape
    numbers, rest = eqx.partition(problem, moving)
    for leaf in jax.tree.leaves(numbers):
        if jnp.shape(leaf) not in ((), (size,)):
            raise ValueError(f"moving: a number must be a scalar or ({size},), not of shape {jnp.shape(leaf)}")
    numbers = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size,)), numbers)
    problem = eqx.combine(numbers, rest)
    # Numbers that move have one value for each cell by now, and so have their rates.
    probe = jax.tree.map(
        lambda rate, number: None if rate is None else jnp.broadcast_to(rate, jnp.shape(number)),
        probe,
        problem.problem,
        is_leaf=lambda rate: rate is None,
    )
    probed = dataclasses.replace(problem, directions=(probe,))
    queue = Queue.of(probed, t1, cells, rtol, atol, solver=solver, lanes=lanes, one_kernel=one_kernel, parts=2)
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
        needed=jnp.asarray(jnp.iinfo(jnp.arange(0).dtype).max),
        outcome=queue.empty(),
        adjoint=jnp.zeros((rows, lanes), states.dtype),
        gradient=jnp.zeros((rows, size), states.dtype),
    )
    run = jax.lax.while_loop(lambda run: run.needed > 0, period, run)
    by_number = jax.tree.unflatten(jax.tree.structure(numbers), list(run.gradient[components:]))
    return run.outcome._replace(state=run.outcome.state[:components]), run.gradient[:components], by_number


def _recorded(queue: Queue, progress: Progress) -> tuple[Progress, Record, Int[Array, ""]]:
    """Let the block go on for a period, with its steps recorded; and how many iterations that were."""
    here = queue.here(progress.block)

    def going(carry: Any) -> Bool[Array, ""]:
        block, _, count = carry
        return queue.enough_active(block, progress.queued) & (count < PERIOD)

    def step(carry: Any) -> Any:
        block, record, count = carry
        after = attempt(*here, block)
        length = jnp.where(after.time > block.time, length_to_try(here[1], block), 0.0)
        made = Record(block.time, _without_probe(block).state, length)
        record = jax.tree.map(functools.partial(_written, at=count), record, made)
        return after, record, count + 1

    def loop(start: Block) -> Any:
        empty = Record(
            *(
                jnp.zeros((PERIOD, *leaf.shape), leaf.dtype)
                for leaf in (start.time, _without_probe(start).state, start.length)
            )
        )
        return jax.lax.while_loop(going, step, (start, empty, jnp.zeros((), int)))

    block, record, count = queue.in_kernel(loop)(progress.block)
    return Progress(block, progress.queued, progress.iterations + count), record, count


def _without_probe(block: Block) -> Block:
    """A block with the states alone, of the states and the variations that run along with them."""
    return block._replace(state=block.state[: block.state.shape[0] // 2])


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
    weights = Weights.of(queue.control.tableau)
    # Picked out here: XLA 0.10.2 aborts on a kernel that is handed all the cells' starts where these are known constants.
    problem = dataclasses.replace(queue.here(block)[0], directions=())
    block = _without_probe(block)

    def loop(carry: Any) -> Any:
        block, record, count, adjoint = carry
        ended = block.status != RUNNING
        adjoint = jnp.where(ended, _at_the_end(problem, moving, measured, block), adjoint)

        def step(carry: Any) -> Any:
            index, *along = carry
            made = jax.tree.map(functools.partial(_read, at=index - 1), record)
            return index - 1, *step_taken_back(weights, problem, moving, *made, *along)

        room = jnp.zeros((len(weights.fractions), *block.state.shape), adjoint.dtype)
        return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (count, adjoint, room))[1]

    return queue.in_kernel(loop)((block, record, count, adjoint))


def _at_the_end(problem: AbstractProblem, moving: Any, measured: Measured, block: Block) -> Float[Array, "rows lanes"]:
    """The derivatives of what is measured, by the state at the end and by the numbers."""
    numbers, rest = eqx.partition(problem, moving)

    def value(numbers: Any, state: States) -> Lanes:
        return measured(eqx.combine(numbers, rest), block._replace(state=state))

    by_number, by_state = jax.vjp(value, numbers, block.state)[1](jnp.ones_like(block.time))
    return jnp.concatenate([by_state, *(one[None] for one in jax.tree.leaves(by_number))])


class Weights(NamedTuple):
    """A Runge-Kutta method as its adjoint sees it.

    `fractions` of the step at which the stages lie, `rows` that lead to every stage but the first, and for every stage the
    `shares` of its rate in the end of the step and in the later stages.
    """

    fractions: Float[np.ndarray, " stages"]
    rows: tuple[Float[np.ndarray, " before"], ...]
    shares: Float[np.ndarray, "stages 1+stages"]

    @classmethod
    def of(cls, tableau: diffrax.ButcherTableau) -> "Weights":
        """The weights of a method; the last stage of one that ends on it serves the next step, and is left out."""
        weights, fractions, rows = tableau.b_sol, np.array([0.0, *tableau.c]), tableau.a_lower
        if tableau.fsal:
            weights, fractions, rows = rows[-1], fractions[:-1], rows[:-1]
        stages = len(fractions)
        shares = np.zeros((stages, 1 + stages))
        shares[:, 0] = weights
        for after, row in enumerate(rows, start=1):
            shares[: len(row), 1 + after] = row
        return cls(fractions, tuple(rows), shares)


def step_taken_back(
    weights: Weights,
    problem: AbstractProblem,
    moving: Any,
    time: Lanes,
    state: States,
    length: Lanes,
    adjoint: Float[Array, "rows lanes"],
    room: Float[Array, "stages components lanes"],
) -> tuple[Float[Array, "rows lanes"], Float[Array, "stages components lanes"]]:
    """Carry derivatives from the end of a Runge-Kutta step to its start (Hager, Numer. Math. 87 (2000) 247).

    The stages are taken back in a loop: written out one by one they take a quarter less time, but thrice as long to compile.

    **Arguments:**

    - `weights`: the method.
    - `problem`, `moving`: its leaves scalars or one number per lane; which of them to differentiate by.
    - `time`, `state`, `length`: where the step starts, and its length; 0 where none was made.
    - `adjoint`: derivatives at the end of the step, by the state and by the numbers.
    - `room`: for the derivatives by the stages, of finite numbers.

    **Returns:** those at the start; and the room, to be used again.
    """
    numbers, rest = eqx.partition(problem, moving)
    components, stages = state.shape[0], len(weights.fractions)
    states, rates = [state], []
    for row, fraction in zip(weights.rows, weights.fractions, strict=False):
        rates.append(jax.lax.optimization_barrier(problem.field(time + float(fraction) * length, states[-1])))
        states.append(moved_state(state, length, row, rates))
    along = jnp.stack(states)
    fractions, shares = jnp.asarray(weights.fractions), jnp.asarray(weights.shares)

    def pull(at: Lanes, numbers: Any, parts: tuple[Lanes, ...], by_rate: tuple[Lanes, ...]) -> tuple[Lanes, ...]:
        def field(numbers: Any, parts: tuple[Lanes, ...]) -> States:
            return eqx.combine(numbers, rest).field(at, parts)

        by_number, by_part = jax.vjp(field, numbers, parts)[1](jnp.stack(by_rate))
        return (*by_part, *jax.tree.leaves(by_number))

    def stage_taken_back(carry: Any) -> Any:
        stage, by_stage, total = carry
        share = _read(shares, at=stage)
        half = components // 2
        parts = [
            length * sum(share[i] * one for i, one in enumerate([adjoint[rows], *by_stage[:, rows]]))
            for rows in (slice(half), slice(half, components))
        ]
        by_rate = jax.lax.optimization_barrier(jnp.concatenate(parts))
        at = time + fractions[stage] * length
        pulled = sharing_values(pull)(
            at, numbers, tuple(jnp.unstack(_read(along, at=stage))), tuple(jnp.unstack(by_rate))
        )
        # Where no step was made nothing is known to be finite.
        pulled = jax.lax.optimization_barrier(jnp.where(length > 0.0, jnp.stack(pulled), 0.0))
        return stage - 1, _written(by_stage, pulled[:components], at=stage), total + pulled

    carry = (jnp.asarray(stages - 1), room, jnp.zeros_like(adjoint))
    _, room, total = jax.lax.while_loop(lambda carry: carry[0] >= 0, stage_taken_back, carry)
    return adjoint + total, room


def _read(whole: Array, at: Int[Array, ""]) -> Array:
    """One of the arrays that are stacked in another."""
    return jax.lax.dynamic_index_in_dim(whole, at, 0, keepdims=False)


def _written(whole: Array, one: Array, at: Int[Array, ""]) -> Array:
    """A stack of arrays with one of them replaced; without the look at bounds that `at[].set` has, it is done in place."""
    return jax.lax.dynamic_update_index_in_dim(whole, one, at, 0)
