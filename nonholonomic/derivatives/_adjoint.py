"""First derivatives of event times with respect to any number of parameters: the discrete adjoint of an ensemble solve.

A run is cut into periods, and the steps of each period are recorded. After the last period, a backward pass carries the
derivatives of the event times with respect to the states from the last period to the first. The records of the latest
periods are kept; a period whose record is gone is computed again from the latest checkpoint before it. The cost does not
depend on the number of parameters, and the memory does not depend on the length of the runs. Step lengths are held
fixed, as in `variation.py`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import uncounted, written_by_component, written_in_place
from ..integration import AbstractProblem, Lanes, LaneState, Outcome, Settings, States
from ..integration.runge_kutta import Stages, moved_state, over_stages
from ..integration.scheduler import AbstractRecorder, InLanes, LaneScheduler, SchedulerState
from ..integration.status import RUNNING
from ..integration.step import length_to_try, try_step, until_jump
from .periods import Checkpoints, LatestSteps, StepRecord, read
from .variation import VariationalProblem

#: The quantities measured at the end of a run: (problem, lane state) -> a tree of arrays with the lanes last,
#: differentiable with respect to the problem's parameters and the lanes' states.
Measured = Callable[[Any, LaneState], Any]


class StepRecorder(AbstractRecorder):
    """Records where each step began, and its length; the derivatives begin at the ends of the runs."""

    # As many iterations as fit in the caches with their record; a period ends with a refill.
    period: ClassVar[int] = 128
    refill_cost = 2.0

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: None) -> StepRecord:
        leaves = (lane_state.time, without_probe(lane_state).state, lane_state.length)
        return StepRecord(*(jnp.zeros((self.period, *leaf.shape), leaf.dtype) for leaf in leaves))

    def has_room(self, record: StepRecord, iteration: Int[Array, ""]) -> Bool[Array, ""]:
        return iteration < self.period

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: StepRecord, iteration: Int[Array, ""]
    ) -> tuple[LaneState, StepRecord]:
        next_state = try_step(*in_lanes, lane_state)
        tried_length = length_to_try(until_jump(*in_lanes[:2], lane_state), lane_state)
        length = jnp.where(next_state.time > lane_state.time, tried_length, 0.0)
        entry = StepRecord(lane_state.time, without_probe(lane_state).state, length)
        return next_state, jax.tree.map(functools.partial(written_in_place, at=iteration), record, entry)

    def steps(self, record: Any) -> StepRecord:
        """The steps in the record of a period."""
        return record

    def arriving(self, lane_state: LaneState, steps: StepRecord) -> Float[Array, "iterations components lanes"] | None:
        """The derivatives of the measured quantity with respect to the states at the ends of the steps, apart from those
        through later states; `None` if the quantity depends only on the ends of the runs."""
        return None

    def share_of_end(self, lane_state: LaneState) -> Any:
        """The factors of the measured quantities at the end of the runs in the lanes."""
        return jnp.ones_like(lane_state.time)


class Derivatives(NamedTuple):
    """Derivatives of the measured quantity with respect to the state and to the parameters, a tree of arrays."""

    state: Float[Array, "components lanes"]
    numbers: Any


class Backward(NamedTuple):
    """State of the forward pass and of the backward pass.

    `frontier` holds the lanes at the start of the next period to compute, and `number` its number. The backward pass takes
    the period before number `limit` next. `adjoint` holds the derivatives for the cell in each lane, `gradient` those of
    every cell with respect to its initial state.
    """

    frontier: SchedulerState
    number: Int[Array, ""]
    limit: Int[Array, ""]
    checkpoints: Checkpoints
    latest_steps: LatestSteps
    outcome: Outcome
    adjoint: Derivatives
    gradient: Derivatives


def solve_with_adjoint(
    problem: VariationalProblem,
    moving: Any,
    probe: Any,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    measured: Measured,
    recorder: StepRecorder | None = None,
    one_kernel: bool = False,
) -> tuple[Outcome, Float[Array, "components cells"], Any]:
    """Run every cell to its end, and differentiate a quantity at the end with respect to the problem's parameters.

    **Arguments:** as for `ensemble_solve`, except `nonterminal`, and

    - `problem`: without tangents.
    - `moving`: a tree of booleans like the problem: the leaves with respect to which to differentiate, scalars or
      (..., cells).
    - `probe`: a tangent of the inner problem. Its variation is also integrated and takes part in step-size control, so
      that the steps suit tangents even where the state is at rest.
    - `measured`: the quantity to differentiate.
    - `recorder`: the recorder of the steps, which may add derivatives at the ends of the steps.

    **Returns:** the `Outcome`, without crossing times; the derivatives of every cell with respect to its initial state;
    and those with respect to the parameters, one per cell, in a tree like the problem with `None` for the other leaves.
    """
    components, size = problem.start()[0].shape
    numbers, problem_with_probe = _with_probe(problem, moving, probe, size)
    scheduler = LaneScheduler.of(problem_with_probe, t1, cells, settings, one_kernel=one_kernel, n_blocks=2)
    passes = Passes(scheduler, moving, measured, StepRecorder() if recorder is None else recorder)
    run = passes.start(numbers)
    run = jax.lax.while_loop(lambda run: uncounted(run.limit > 0, run.outcome.steps[0]), passes.there_and_back, run)
    return run.outcome._replace(state=run.outcome.state[:components]), run.gradient.state, run.gradient.numbers


def _with_probe(problem: VariationalProblem, moving: Any, probe: Any, size: int) -> tuple[Any, VariationalProblem]:
    """The chosen parameters with one value per cell, and the problem with them and the probe.

    **Arguments:** as for `solve_with_adjoint`; `size`: number of cells, padding included.
    """
    numbers, static = eqx.partition(problem, moving)
    numbers = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (*jnp.shape(leaf)[:-1], size)), numbers)
    problem = eqx.combine(numbers, static)
    # The chosen parameters now have one value per cell, so their rates must, too.
    probe = jax.tree.map(
        lambda rate, number: None if rate is None else jnp.broadcast_to(rate, jnp.shape(number)),
        probe,
        problem.problem,
        is_leaf=lambda rate: rate is None,
    )
    return numbers, dataclasses.replace(problem, tangents=(probe,))


@dataclasses.dataclass(frozen=True, eq=False)
class Passes:
    """The forward pass, which computes periods, and the backward pass, which carries derivatives through them.

    `moving`, `measured`, `recorder`: as for `solve_with_adjoint`.
    """

    scheduler: LaneScheduler
    moving: Any
    measured: Measured
    recorder: StepRecorder

    def start(self, numbers: Any) -> Backward:
        """Both passes before the first period. **Arguments:** `numbers`: the parameters, with one value per cell."""
        scheduler, start = self.scheduler, self.scheduler.start()
        in_lanes = scheduler.in_lanes(start.lane_state)
        state, states = (without_probe(lanes).state for lanes in (start.lane_state, scheduler.fresh))
        record = jax.eval_shape(lambda: self.recorder.steps(self.recorder.begin(in_lanes, start.lane_state, None)))
        return Backward(
            frontier=start,
            number=jnp.zeros((), int),
            limit=jnp.asarray(jnp.iinfo(jnp.arange(0).dtype).max),
            checkpoints=Checkpoints.none((start, start)),
            latest_steps=LatestSteps.none(record, scheduler.capacity),
            outcome=scheduler.empty(),
            adjoint=jax.tree.map(jnp.zeros_like, Derivatives(state, scheduler.pick(numbers, start.lane_state.cell))),
            gradient=jax.tree.map(jnp.zeros_like, Derivatives(states, numbers)),
        )

    def there_and_back(self, run: Backward) -> Backward:
        """Compute all periods up to the one that the backward pass needs, and take back those whose steps are kept."""
        run = jax.lax.while_loop(self.is_ahead, self.forward, run)
        run = run._replace(limit=jnp.minimum(run.limit, run.number))
        run = jax.lax.while_loop(self.is_recorded, self.backward, run)
        # The steps before are gone: continue from the latest checkpoint.
        number, (lanes_before, _) = run.checkpoints.latest()
        return run._replace(
            frontier=lanes_before,
            number=number,
            checkpoints=run.checkpoints.without_latest(),
            latest_steps=run.latest_steps._replace(first=lanes_before.iterations),
        )

    def is_ahead(self, run: Backward) -> Bool[Array, ""]:
        """Whether a period that the backward pass needs has not been computed."""
        return uncounted(self.scheduler.unfinished(run.frontier) & (run.number < run.limit), run.number)

    def forward(self, run: Backward) -> Backward:
        """Compute the next period, and record its steps."""
        lanes_after, record = self.scheduler.run(run.frontier, self.recorder)
        return run._replace(
            frontier=self.scheduler.refill(lanes_after),
            number=run.number + 1,
            checkpoints=run.checkpoints.added(run.number, (run.frontier, lanes_after)),
            latest_steps=run.latest_steps.added(run.frontier.iterations, self.recorder.steps(record)),
            outcome=self.scheduler.store(run.outcome, lanes_after.lane_state),
        )

    def is_recorded(self, run: Backward) -> Bool[Array, ""]:
        """Whether the steps of the period that the backward pass takes next are kept."""
        number, (lanes_before, _) = run.checkpoints.latest()
        recorded = (number == run.limit - 1) & (lanes_before.iterations >= run.latest_steps.first)
        return uncounted((run.checkpoints.depth > 0) & recorded, run.number)

    def backward(self, run: Backward) -> Backward:
        """Carry the derivatives through the latest period."""
        scheduler, (number, (lanes_before, lanes_after)) = self.scheduler, run.checkpoints.latest()
        steps = run.latest_steps.of_period(lanes_before.iterations, self.recorder.period)
        count = lanes_after.iterations - lanes_before.iterations
        adjoint = self.taken_back(lanes_after.lane_state, steps, count, run.adjoint)
        # A cell that had made no step was at its start.
        at_its_start = (lanes_before.lane_state.steps == 0) & (lanes_before.lane_state.cell < scheduler.cells)
        cell = jnp.where(at_its_start, lanes_before.lane_state.cell, scheduler.capacity)
        gradient = jax.tree.map(
            lambda of_cells, of_lanes: of_cells.at[..., cell].set(of_lanes, mode="drop"), run.gradient, adjoint
        )
        checkpoints = run.checkpoints.without_latest()
        return run._replace(limit=number, checkpoints=checkpoints, adjoint=adjoint, gradient=gradient)

    def taken_back(
        self, lane_state: LaneState, steps: StepRecord, count: Int[Array, ""], adjoint: Derivatives
    ) -> Derivatives:
        """Carry the derivatives from the end of a period to its start; in lanes that have ended, the derivatives begin
        there.
        """
        weights, lane_state = Weights.of(self.scheduler.control.tableau), without_probe(lane_state)
        # Selected here: XLA 0.10.2 aborts on a kernel that takes the initial states of all cells if they are constants.
        problem = dataclasses.replace(self.scheduler.in_lanes(lane_state)[0], tangents=())
        arriving, share = self.recorder.arriving(lane_state, steps), self.recorder.share_of_end(lane_state)
        record = (steps.time, steps.state, steps.length, arriving)

        def loop(carry: Any) -> Any:
            lane_state, share, record, count, adjoint = carry
            ended = lane_state.status != RUNNING
            at_end = _at_the_end(problem, self.moving, self.measured, lane_state, share)
            adjoint = jax.tree.map(functools.partial(jnp.where, ended), at_end, adjoint)

            def step(carry: Any) -> Any:
                index, adjoint, memory = carry
                time, state, length, at_end = jax.tree.map(functools.partial(read, index=index - 1), record)
                if at_end is not None:
                    adjoint = adjoint._replace(state=adjoint.state + at_end)
                point = (time, state, length)
                return index - 1, *step_taken_back(weights, problem, self.moving, *point, adjoint, memory)

            memory = StageMemory.of(len(weights.fractions), lane_state.state)
            return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (count, adjoint, memory))[1]

        return self.scheduler.in_kernel(loop)((lane_state, share, record, count, adjoint))


def without_probe(lane_state: LaneState) -> LaneState:
    """The lanes with the states alone, without the variations."""
    return lane_state._replace(state=lane_state.state[: lane_state.state.shape[0] // 2])


def _at_the_end(
    problem: AbstractProblem, moving: Any, measured: Measured, lane_state: LaneState, share: Any
) -> Derivatives:
    """The derivatives with respect to the final state and the parameters. **Arguments:** `share`: as `share_of_end`."""
    numbers, static = eqx.partition(problem, moving)

    def value(numbers: Any, state: States) -> Any:
        return measured(eqx.combine(numbers, static), lane_state._replace(state=state))

    by_number, by_state = jax.vjp(value, numbers, lane_state.state)[1](share)
    return Derivatives(by_state, by_number)


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
        for stage, row in enumerate(rows, start=1):
            shares[: len(row), 1 + stage] = row
        return cls(fractions, tuple(rows), shares)


class StageMemory(NamedTuple):
    """Memory for the stages of a step, which all steps share; what it holds before a step does not matter.

    `states`, `rates`: the states and the field at the stages; `adjoints`: the derivatives with respect to the end of
    the step and to the stages.
    """

    states: Stages
    rates: Stages
    adjoints: Stages

    @classmethod
    def of(cls, stages: int, state: States) -> "StageMemory":
        """Memory for a number of stages."""
        return cls(*(jnp.zeros((count, *state.shape), state.dtype) for count in (stages, stages - 1, stages + 1)))


def step_taken_back(
    weights: Weights,
    problem: AbstractProblem,
    moving: Any,
    time: Lanes,
    state: States,
    length: Lanes,
    adjoint: Derivatives,
    memory: StageMemory,
) -> tuple[Derivatives, StageMemory]:
    """Carry derivatives from the end of a Runge-Kutta step to its start (Hager, Numer. Math. 87 (2000) 247).

    The stages are computed in loops, as in `explicit_step`.

    **Arguments:**

    - `weights`: the method.
    - `problem`, `moving`: the problem, with leaves that are scalars or have one number per lane; the leaves with
      respect to which to differentiate.
    - `time`, `state`, `length`: where the step starts, and its length; 0 if no step was made.
    - `adjoint`: derivatives at the end of the step.
    - `memory`: memory for the stages.

    **Returns:** the derivatives at the start, and the memory for reuse.
    """
    numbers, static = eqx.partition(problem, moving)
    stages = len(weights.fractions)
    fractions = jnp.asarray(weights.fractions)

    def stage_made(stage: Int[Array, ""], carry: tuple[Stages, Stages]) -> tuple[Stages, Stages]:
        stage_states, rates = carry
        rate = problem.field(time + fractions[stage] * length, read(stage_states, index=stage))
        rates = written_by_component(rates, rate, at=stage)
        return written_in_place(
            stage_states, moved_state(stage, weights.rows, state, length, rates), at=stage + 1
        ), rates

    start = jnp.zeros((), int)
    initial_stages = written_in_place(memory.states, state, at=start), memory.rates
    stage_states, rates = over_stages(stages - 1, stage_made, initial_stages)

    def pull(stage_time: Lanes, numbers: Any, parts: tuple[Lanes, ...], by_rate: tuple[Lanes, ...]) -> Any:
        def field(numbers: Any, parts: tuple[Lanes, ...]) -> States:
            return eqx.combine(numbers, static).field(stage_time, parts)

        by_number, by_part = jax.vjp(field, numbers, parts)[1](jnp.stack(by_rate))
        return jnp.stack(by_part), by_number

    def stage_taken_back(count: Int[Array, ""], carry: Any) -> Any:
        stage, (by_stage, total) = stages - 1 - count, carry
        by_rate = jax.lax.optimization_barrier(moved_state(stage, weights.shares, zero_state, length, by_stage))
        stage_time = time + fractions[stage] * length
        by_state, by_number = pull(
            stage_time, numbers, tuple(jnp.unstack(read(stage_states, index=stage))), tuple(jnp.unstack(by_rate))
        )
        # If no step was made, values may not be finite.
        by_state = jax.lax.optimization_barrier(jnp.where(length > 0.0, by_state, 0.0))
        total = jax.tree.map(
            lambda sum_so_far, term: sum_so_far + jnp.where(length > 0.0, term, 0.0),
            total,
            Derivatives(by_state, by_number),
        )
        return written_in_place(by_stage, by_state, at=stage + 1), total

    zero_state, ends = jnp.zeros_like(state), written_in_place(memory.adjoints, adjoint.state, at=start)
    adjoints, total = over_stages(stages, stage_taken_back, (ends, adjoint))
    # A step that was rejected begins on the same far side as the one that follows.
    begin = jnp.where(length > 0.0, time, jnp.nan)
    return jump_taken_back(problem, moving, begin, state, total), StageMemory(stage_states, rates, adjoints)


def jump_taken_back(
    problem: AbstractProblem, moving: Any, time: Lanes, state: States, adjoint: Derivatives
) -> Derivatives:
    """Carry derivatives from the far side of a jump to its near side, in the lanes whose step begins on a far side.

    **Arguments:** as for `step_taken_back`; `time`, `state`: those of the far side; the time is NaN if no step was made.
    """
    jumps = problem.jumps(time, state)
    if jumps is None:
        return adjoint
    numbers, static = eqx.partition(problem, moving)
    near = jumps.before(time)
    is_jump = jnp.isfinite(near)
    near = jnp.where(is_jump, near, time)

    def taken_back() -> Derivatives:
        def across(numbers: Any, state: States) -> States:
            return eqx.combine(numbers, static).across_jump(near, state)

        # Round-off apart, the states of both sides differ only in their clocks.
        near_state = state + (near - time) * problem.field(time, state)
        by_number, by_state = jax.vjp(across, numbers, near_state)[1](adjoint.state)
        by_number = jax.tree.map(lambda term: jnp.where(is_jump, term, 0.0), by_number)
        state_before = jnp.where(is_jump, by_state, adjoint.state)
        return Derivatives(state_before, jax.tree.map(jnp.add, adjoint.numbers, by_number))

    return jax.lax.cond(jnp.any(is_jump), taken_back, lambda: adjoint)
