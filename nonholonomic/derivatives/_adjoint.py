"""First derivatives of event times with respect to any number of parameters: the discrete adjoint of an ensemble solve.

A run is cut into periods, and the steps of each period are recorded. After the last period, a backward pass carries the
derivatives of the event times with respect to the states from the last period to the first. A period whose record is
gone is computed again from the latest checkpoint before it. The cost does not depend on the number of parameters, and
the memory does not depend on the length of the runs. Step lengths are held fixed, as in `variation.py`.
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

from ..integration import RUNNING, AbstractProblem, Lanes, LaneState, Outcome, Settings, States
from ..integration.runge_kutta import Stages, moved_state, over_stages
from ..integration.scheduler import AbstractRecorder, InLanes, LaneScheduler, Progress
from ..integration.step import length_to_try, try_step
from ..xla_cpu import uncounted, written_by_component, written_in_place
from .variation import VariationalProblem

#: Number of checkpoints. With more periods, some checkpoints are dropped and computed again from an earlier one. With
#: the 64 lanes of a CPU the checkpoints take 5 MB, with the 32768 of an accelerator 2 GB.
KEPT = 256

#: The quantity measured at the end of a run: (problem, lane state) -> a number per lane, differentiable with respect to
#: the problem's parameters and the lanes' states.
Measured = Callable[[Any, LaneState], Lanes]


class StepRecord(NamedTuple):
    """The steps of a period: where each step began, and its length, 0 for a lane that did not move."""

    time: Float[Array, "iterations lanes"]
    state: Float[Array, "iterations components lanes"]
    length: Float[Array, "iterations lanes"]


class StepRecorder(AbstractRecorder):
    """Records where each step began, and its length."""

    # As many iterations as fit in the caches with their record; a period ends with a refill.
    period = 128
    refill_cost = 2.0

    def begin(self, lane_state: LaneState, collected: None) -> StepRecord:
        leaves = (lane_state.time, _without_probe(lane_state).state, lane_state.length)
        return StepRecord(*(jnp.zeros((self.period, *leaf.shape), leaf.dtype) for leaf in leaves))

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: StepRecord, iteration: Int[Array, ""]
    ) -> tuple[LaneState, StepRecord]:
        after = try_step(*in_lanes, lane_state)
        length = jnp.where(after.time > lane_state.time, length_to_try(in_lanes[1], lane_state), 0.0)
        entry = StepRecord(lane_state.time, _without_probe(lane_state).state, length)
        return after, jax.tree.map(functools.partial(written_in_place, at=iteration), record, entry)


class Checkpoints(NamedTuple):
    """The stored starts of periods, the earliest first.

    There are `depth` of them; `index` holds the period that each one starts, `slot` its place in `progress`.
    """

    depth: Int[Array, ""]
    index: Int[Array, " slots"]
    slot: Int[Array, " slots"]
    progress: Progress

    @classmethod
    def of(cls, progress: Progress) -> "Checkpoints":
        """The start of the first period."""
        room = jax.tree.map(lambda leaf: jnp.zeros((KEPT, *leaf.shape), leaf.dtype).at[0].set(leaf), progress)
        return cls(jnp.ones((), int), jnp.zeros(KEPT, int), jnp.arange(KEPT), room)

    def latest(self) -> tuple[Int[Array, ""], Progress]:
        """The period of the latest checkpoint, and the checkpoint itself."""
        last = self.depth - 1
        return self.index[last], jax.tree.map(functools.partial(_read, at=self.slot[last]), self.progress)

    def dropped(self, drop: Bool[Array, ""]) -> "Checkpoints":
        """Drop the latest checkpoint if `drop` is true."""
        return self._replace(depth=self.depth - drop)

    def added(self, index: Int[Array, ""], progress: Progress, add: Bool[Array, ""]) -> "Checkpoints":
        """Add a checkpoint if `add` is true; if all slots are full, drop the checkpoint whose neighbours are closest."""
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
        # Always written: if no checkpoint is added, the slot stays free.
        room = jax.tree.map(functools.partial(written_in_place, at=free), self.progress, progress)
        return Checkpoints(jnp.minimum(self.depth + add, KEPT), indices, slots, room)


class Backward(NamedTuple):
    """State of a backward pass. The pass takes the period before `needed` next.

    `adjoint` holds, for the cell in each lane, the derivatives of the measured quantity: the first rows are those with
    respect to the state, the others those with respect to the parameters. `gradient` holds the derivatives of every
    cell with respect to its initial state.
    """

    kept: Checkpoints
    needed: Int[Array, ""]
    outcome: Outcome
    adjoint: Float[Array, "rows lanes"]
    gradient: Float[Array, "rows cells"]


def solve_with_adjoint(
    problem: VariationalProblem,
    moving: Any,
    probe: Any,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    measured: Measured,
    one_kernel: bool = False,
) -> tuple[Outcome, Float[Array, "components cells"], Any]:
    """Run every cell to its end, and differentiate a quantity at the end with respect to the problem's parameters.

    **Arguments:** as for `ensemble_solve`, except `nonterminal`, and

    - `problem`: without tangents.
    - `moving`: a tree of booleans like the problem: the leaves, scalars or (cells,), with respect to which to
      differentiate.
    - `probe`: a tangent of the inner problem. Its variation is also integrated and takes part in step-size control, so
      that the steps suit tangents even where the state is at rest.
    - `measured`: the quantity to differentiate.

    **Returns:** the `Outcome`, without crossing times; the derivatives of every cell with respect to its initial state;
    and those with respect to the parameters, one per cell, in a tree like the problem with `None` for the other leaves.

    **Raises:** `ValueError` for a chosen leaf that has several components.
    """
    states = problem.start()[0]
    components, size = states.shape
    numbers, rest = eqx.partition(problem, moving)
    for leaf in jax.tree.leaves(numbers):
        if jnp.shape(leaf) not in ((), (size,)):
            raise ValueError(f"moving: a number must be a scalar or ({size},), not of shape {jnp.shape(leaf)}")
    numbers = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (size,)), numbers)
    problem = eqx.combine(numbers, rest)
    # The chosen parameters now have one value per cell, so their rates must, too.
    probe = jax.tree.map(
        lambda rate, number: None if rate is None else jnp.broadcast_to(rate, jnp.shape(number)),
        probe,
        problem.problem,
        is_leaf=lambda rate: rate is None,
    )
    probed = dataclasses.replace(problem, tangents=(probe,))
    # As many lanes as without the probe: the backward pass, which is the most expensive part, does not use the probe.
    settings = dataclasses.replace(settings, lanes=settings.lanes_of(size))
    scheduler = LaneScheduler.of(probed, t1, cells, settings, one_kernel=one_kernel, n_blocks=2)
    rows = components + len(jax.tree.leaves(numbers))

    def period(run: Backward) -> Backward:
        index, before = run.kept.latest()
        after, record = scheduler.run(before, StepRecorder())
        outcome = scheduler.store(run.outcome, after.lane_state)
        refilled = scheduler.refill(after)
        back = ~scheduler.unfinished(refilled) | (index + 1 == run.needed)
        count = jnp.where(back, after.iterations - before.iterations, 0)
        adjoint = _taken_back(scheduler, moving, measured, after.lane_state, record, count, run.adjoint)
        # A cell that had made no step was at its start.
        began = back & (before.lane_state.steps == 0) & (before.lane_state.cell < cells)
        to = jnp.where(began, before.lane_state.cell, size)
        return Backward(
            kept=run.kept.dropped(back).added(index + 1, refilled, ~back),
            needed=jnp.where(back, index, run.needed),
            outcome=outcome,
            adjoint=jnp.where(back, adjoint, run.adjoint),
            gradient=run.gradient.at[:, to].set(adjoint, mode="drop"),
        )

    run = Backward(
        kept=Checkpoints.of(scheduler.start()),
        needed=jnp.asarray(jnp.iinfo(jnp.arange(0).dtype).max),
        outcome=scheduler.empty(),
        adjoint=jnp.zeros((rows, scheduler.lanes), states.dtype),
        gradient=jnp.zeros((rows, size), states.dtype),
    )
    run = jax.lax.while_loop(lambda run: uncounted(run.needed > 0, run.outcome.steps[0]), period, run)
    by_number = jax.tree.unflatten(jax.tree.structure(numbers), list(run.gradient[components:]))
    return run.outcome._replace(state=run.outcome.state[:components]), run.gradient[:components], by_number


def _without_probe(lane_state: LaneState) -> LaneState:
    """The lanes with the states alone, without the variations."""
    return lane_state._replace(state=lane_state.state[: lane_state.state.shape[0] // 2])


def _taken_back(
    scheduler: LaneScheduler,
    moving: Any,
    measured: Measured,
    lane_state: LaneState,
    record: StepRecord,
    count: Int[Array, ""],
    adjoint: Float[Array, "rows lanes"],
) -> Float[Array, "rows lanes"]:
    """Carry the derivatives from the end of a period to its start; in lanes that have ended, the derivatives begin
    there.
    """
    weights = Weights.of(scheduler.control.tableau)
    # Selected here: XLA 0.10.2 aborts on a kernel that takes the initial states of all cells if they are constants.
    problem = dataclasses.replace(scheduler.in_lanes(lane_state)[0], tangents=())
    lane_state = _without_probe(lane_state)

    def loop(carry: Any) -> Any:
        lane_state, record, count, adjoint = carry
        ended = lane_state.status != RUNNING
        adjoint = jnp.where(ended, _at_the_end(problem, moving, measured, lane_state), adjoint)

        def step(carry: Any) -> Any:
            index, *along = carry
            step_record = jax.tree.map(functools.partial(_read, at=index - 1), record)
            return index - 1, *step_taken_back(weights, problem, moving, *step_record, *along)

        room = jnp.zeros((1 + len(weights.fractions), *lane_state.state.shape), adjoint.dtype)
        return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (count, adjoint, room))[1]

    return scheduler.in_kernel(loop)((lane_state, record, count, adjoint))


def _at_the_end(
    problem: AbstractProblem, moving: Any, measured: Measured, lane_state: LaneState
) -> Float[Array, "rows lanes"]:
    """The derivatives of the measured quantity with respect to the final state and the parameters."""
    numbers, rest = eqx.partition(problem, moving)

    def value(numbers: Any, state: States) -> Lanes:
        return measured(eqx.combine(numbers, rest), lane_state._replace(state=state))

    by_number, by_state = jax.vjp(value, numbers, lane_state.state)[1](jnp.ones_like(lane_state.time))
    return jnp.concatenate([by_state, *(row[None] for row in jax.tree.leaves(by_number))])


class Weights(NamedTuple):
    """The coefficients of a Runge-Kutta method that its adjoint needs.

    `fractions`: the position of each stage in the step; `rows`: the weights of each stage but the first; `shares`: for
    each stage, the share of its rate in the end of the step and in the later stages.
    """

    fractions: Float[np.ndarray, " stages"]
    rows: tuple[Float[np.ndarray, " before"], ...]
    shares: Float[np.ndarray, "stages 1+stages"]

    @classmethod
    def of(cls, tableau: diffrax.ButcherTableau) -> "Weights":
        """The weights of a method, without a last stage that only serves the next step."""
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
    room: Stages,
) -> tuple[Float[Array, "rows lanes"], Stages]:
    """Carry derivatives from the end of a Runge-Kutta step to its start (Hager, Numer. Math. 87 (2000) 247).

    The stages are computed in loops, as in `explicit_step`.

    **Arguments:**

    - `weights`: the method.
    - `problem`, `moving`: the problem, with leaves that are scalars or have one number per lane; the leaves with
      respect to which to differentiate.
    - `time`, `state`, `length`: where the step starts, and its length; 0 if no step was made.
    - `adjoint`: derivatives at the end of the step, with respect to the state and the parameters.
    - `room`: working memory for the derivatives with respect to the end and the stages; finite.

    **Returns:** the derivatives at the start, and the working memory for reuse.
    """
    numbers, rest = eqx.partition(problem, moving)
    components, stages = state.shape[0], len(weights.fractions)
    fractions = jnp.asarray(weights.fractions)

    def stage_made(stage: Int[Array, ""], carry: tuple[Stages, Stages]) -> tuple[Stages, Stages]:
        along, rates = carry
        rate = problem.field(time + fractions[stage] * length, _read(along, at=stage))
        rates = written_by_component(rates, rate, at=stage)
        return written_in_place(along, moved_state(stage, weights.rows, state, length, rates), at=stage + 1), rates

    none = jnp.zeros((stages, *state.shape), state.dtype)
    begun = written_in_place(none, state, at=jnp.zeros((), int)), none[1:]
    along, _ = over_stages(stages - 1, stage_made, begun)

    def pull(at: Lanes, numbers: Any, parts: tuple[Lanes, ...], by_rate: tuple[Lanes, ...]) -> tuple[Lanes, ...]:
        def field(numbers: Any, parts: tuple[Lanes, ...]) -> States:
            return eqx.combine(numbers, rest).field(at, parts)

        by_number, by_part = jax.vjp(field, numbers, parts)[1](jnp.stack(by_rate))
        return (*by_part, *jax.tree.leaves(by_number))

    def stage_taken_back(done: Int[Array, ""], carry: Any) -> Any:
        stage, (by_stage, total) = stages - 1 - done, carry
        by_rate = jax.lax.optimization_barrier(moved_state(stage, weights.shares, nothing, length, by_stage))
        at = time + fractions[stage] * length
        pulled = pull(at, numbers, tuple(jnp.unstack(_read(along, at=stage))), tuple(jnp.unstack(by_rate)))
        # If no step was made, values may not be finite.
        pulled = jax.lax.optimization_barrier(jnp.where(length > 0.0, jnp.stack(pulled), 0.0))
        return written_in_place(by_stage, pulled[:components], at=stage + 1), total + pulled

    nothing, ends = jnp.zeros_like(state), written_in_place(room, adjoint[:components], at=jnp.zeros((), int))
    room, total = over_stages(stages, stage_taken_back, (ends, jnp.zeros_like(adjoint)))
    return adjoint + total, room


def _read(whole: Array, at: Int[Array, ""]) -> Array:
    """One of the arrays stacked in another."""
    return jax.lax.dynamic_index_in_dim(whole, at, 0, keepdims=False)
