"""First derivatives of event times, or of sums over samples, with respect to any number of parameters: the discrete adjoint
of an ensemble solve.

A run is cut into periods, and the steps of each period are recorded. After the last period, a backward pass carries the
derivatives with respect to the states from the last period to the first. The records of the latest
periods are kept; a period whose record is gone is computed again from the latest checkpoint before it. The cost does not
depend on the number of parameters, and the memory does not depend on the length of the runs. Step lengths are held
fixed, as in `variation.py`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.xla_cpu import compiled_alone, current_platform, uncounted, written_by_component, written_in_place
from ..integration import AbstractProblem, Lanes, LaneState, Outcome, Settings, States
from ..integration.problem import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, time_at_jump
from ..integration.runge_kutta import Integers, Stages, inner_stages, moved_state, over_stages
from ..integration.samples import Record, SampleTimes, components, recorded_step
from ..integration.scheduler import InLanes, LaneScheduler, Recorder, SchedulerState, outcome_of, with_crossing_times
from . import variation
from .variation import RunOptions, Tangent, Tangents, VariationalProblem, delay, tangent_scale

# The periods of an ensemble solve that are kept for its adjoint: where some of them begin and end, and the steps of the
# latest ones.

#: Number of checkpoints. With more periods, some checkpoints are dropped and computed again from an earlier one. With
#: the 64 lanes of a CPU the checkpoints take 3 MB, with the 32768 of an accelerator 1.5 GB.
SLOTS = 64

#: Number of steps that are kept for each cell, on average, and the memory [bytes] that all of them may take.
STEPS_KEPT, MAX_BYTES = 1024, {"cpu": 1 << 26}


class StepRecord(NamedTuple):
    """The steps of a period: where each step began, and its length, 0 for a lane that did not move.

    For runs with samples, `sample` is the index of the sample on which the step ended, the number of samples if there is
    none; and `fixed` are the components that the tangent does not move there.
    """

    time: Float[Array, "iterations lanes"]
    state: Float[Array, "iterations components lanes"]
    length: Float[Array, "iterations lanes"]
    sample: Int[Array, "iterations lanes"] | None = None
    fixed: Bool[Array, "iterations components lanes"] | None = None


#: A period without its steps, as a tree of arrays: the lanes before it, and after it but before their refill; or other states
#: of a run.
Period: TypeAlias = PyTree


class Checkpoints(NamedTuple):
    """Some of the periods, and their numbers, -1 in free places."""

    numbers: Int[Array, " slots"]
    periods: Period

    @classmethod
    def none(cls, example: Period) -> "Checkpoints":
        """No periods. **Arguments:** `example`: a period, for the shapes."""
        room = jax.tree.map(lambda leaf: jnp.zeros((SLOTS, *leaf.shape), leaf.dtype), example)
        return cls(jnp.full(SLOTS, -1), room)

    def latest(self) -> tuple[Int[Array, ""], Period, "Checkpoints"]:
        """The number of the latest period, -1 if there is none, the period, and the checkpoints without it."""
        slot = jnp.argmax(self.numbers)
        without = self._replace(numbers=self.numbers.at[slot].set(-1))
        return self.numbers[slot], read(self.periods, slot), without

    def added(self, number: Int[Array, ""], period: Period) -> "Checkpoints":
        """Add a period; if all places are taken, drop the period whose neighbours are closest, but not the first."""
        order = jnp.argsort(self.numbers)
        earlier = self.numbers[order]
        gaps = jnp.append(earlier[2:], number) - earlier[:-1]
        slot = order[jnp.where(earlier[0] < 0, 0, 1 + jnp.argmin(gaps))]
        room = written_in_place(self.periods, period, at=slot)
        return Checkpoints(self.numbers.at[slot].set(number), room)


class LatestSteps(NamedTuple):
    """The steps of all iterations from number `first` on, in a ring with room for a period beyond its end."""

    first: Int[Array, ""]
    ring: StepRecord

    @classmethod
    def none(cls, example: StepRecord, cells: int) -> "LatestSteps":
        """No steps. **Arguments:** `example`: the steps of a period, for the shapes; `cells`: number of cells."""
        period, lanes = example.length.shape
        bytes_of_step = sum(leaf.dtype.itemsize * leaf.size for leaf in jax.tree.leaves(example)) // period
        max_steps = MAX_BYTES.get(current_platform(), 1 << 31) // bytes_of_step
        size = period + max(period, min(max_steps, STEPS_KEPT * -(-cells // lanes)))
        room = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape[1:]), leaf.dtype), example)
        return cls(jnp.zeros((), int), room)

    def added(self, first: Int[Array, ""], steps: StepRecord) -> "LatestSteps":
        """Add the steps of a period that begins with iteration number `first`; where an earlier period is computed again,
        the steps after it are gone."""
        period = len(steps.length)
        size = len(self.ring.length) - period

        def written(stack: Array, rows: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(stack, rows, first % size, 0)

        oldest = jnp.maximum(jnp.minimum(self.first, first), first + period - size)
        return LatestSteps(oldest, jax.tree.map(written, self.ring, steps))

    def of_period(self, first: Int[Array, ""], period: int) -> StepRecord:
        """The steps of a period that begins with iteration number `first`."""
        start = first % (len(self.ring.length) - period)
        return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, period), self.ring)


def read(stacks: PyTree, index: Int[Array, ""]) -> PyTree:
    """A tree of stacks of arrays, (stack, ...), with one array of each stack."""
    return jax.tree.map(lambda stack: jax.lax.dynamic_index_in_dim(stack, index, 0, keepdims=False), stacks)


class Passes(NamedTuple):
    """State of a forward pass, which computes the parts of runs, and of a backward pass, which carries derivatives through
    them. The parts are periods of lanes, or rounds of modes.

    `frontier` holds the runs at the start of the next part to compute, and `number` its number; the backward pass takes
    the part before number `limit` next. A checkpoint is a tuple that begins with the runs at the start of a part. `other` is
    what else the forward pass computes, and `adjoint` what the backward pass carries.
    """

    frontier: PyTree
    number: Int[Array, ""]
    limit: Int[Array, ""]
    checkpoints: Checkpoints
    other: PyTree
    adjoint: PyTree


#: (number of a part, runs at its start, what else is computed) -> the runs after it, its checkpoint, what else is computed.
Forward: TypeAlias = Callable[[Int[Array, ""], PyTree, PyTree], tuple[PyTree, Period, PyTree]]

#: (number of a part, its checkpoint, what else has been computed, derivatives at the end of the part) -> those at its start.
Backward: TypeAlias = Callable[[Int[Array, ""], Period, PyTree, PyTree], PyTree]


def there_and_back(
    start: tuple[PyTree, Period, PyTree, PyTree],
    most: int | Int[Array, ""],
    is_running: Callable[[PyTree], Bool[Array, ""]],
    is_kept: Callable[[Period, PyTree], Bool[Array, ""]],
    forward: Forward,
    backward: Backward,
) -> Passes:
    """Compute all parts of runs, and carry derivatives from the last part to the first. A part without a checkpoint is
    computed again from the latest checkpoint before it.

    **Arguments:**

    - `start`: the runs before the first part, an example of a checkpoint, what else is computed, and the derivatives
      after the last part.
    - `most`: the greatest number of parts.
    - `is_running`: whether there is another part.
    - `is_kept`: whether all that `backward` needs of a part with a checkpoint is still kept.
    - `forward`, `backward`: compute a part, and carry the derivatives through it.
    """
    frontier, example, other, adjoint = start

    def is_ahead(run: Passes) -> Bool[Array, ""]:
        return uncounted(is_running(run.frontier) & (run.number < run.limit), run.number)

    def computed(run: Passes) -> Passes:
        frontier, part, other = forward(run.number, run.frontier, run.other)
        checkpoints = run.checkpoints.added(run.number, part)
        return Passes(frontier, run.number + 1, run.limit, checkpoints, other, run.adjoint)

    def is_next(run: Passes) -> Bool[Array, ""]:
        number, part, _ = run.checkpoints.latest()
        is_next = (number >= 0) & (number == run.limit - 1)
        return uncounted(is_next & is_kept(part, run.other), run.number)

    def taken_back(run: Passes) -> Passes:
        number, part, checkpoints = run.checkpoints.latest()
        adjoint = backward(number, part, run.other, run.adjoint)
        return run._replace(limit=number, checkpoints=checkpoints, adjoint=adjoint)

    def once(run: Passes) -> Passes:
        run = jax.lax.while_loop(is_ahead, computed, run)
        run = run._replace(limit=jnp.minimum(run.limit, run.number))
        run = jax.lax.while_loop(is_next, taken_back, run)
        number, (frontier, *_), checkpoints = run.checkpoints.latest()
        return run._replace(frontier=frontier, number=number, checkpoints=checkpoints)

    zero = jnp.zeros((), int)
    run = Passes(frontier, zero, jnp.asarray(most), Checkpoints.none(example), other, adjoint)
    return jax.lax.while_loop(lambda run: uncounted(run.limit > 0, run.number), once, run)


class SampledCotangents(NamedTuple):
    """The cotangents of the samples, of the time at which a run leaves the domain, and of the state at the horizon."""

    states: Float[Array, "cells times components"]
    end_time: Float[Array, " cells"]
    end_state: Float[Array, "components cells"]


class StepRecorder(Recorder):
    """Records where each step began, and its length. The time of the event at the end of a run is differentiated; or, with
    samples, a sum over the samples and the end: steps then end on the samples, where their cotangents enter.
    """

    times: SampleTimes | None = None
    cotangents: SampledCotangents | None = None

    # As many iterations as fit in the caches with their record; a period ends with a refill.
    period: ClassVar[int] = 128
    refill_cost = 2.0

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: None) -> Record:
        leaves = (lane_state.time, without_probe(lane_state).state, lane_state.length)
        steps = StepRecord(*(jnp.zeros((self.period, *leaf.shape), leaf.dtype) for leaf in leaves))
        accepted, sample = jnp.ones_like(lane_state.bracketing), jnp.zeros_like(lane_state.steps)
        if self.times is not None:
            sample = self.times.after(lane_state.time, lane_state)
            samples, fixed = jnp.zeros(steps.length.shape, sample.dtype), jnp.zeros(steps.state.shape, bool)
            steps = steps._replace(sample=samples, fixed=fixed)
        return Record(accepted, sample, steps)

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: Record, iteration: Int[Array, ""]
    ) -> tuple[LaneState, Record]:
        state = without_probe(lane_state).state

        def entry(new_lanes: LaneState, length: Lanes, sample: Integers | None) -> StepRecord:
            fixed = None if sample is None else new_lanes.state[len(state) :] == 0.0
            length = jnp.where(new_lanes.time > lane_state.time, length, 0.0)
            return StepRecord(lane_state.time, state, length, sample, fixed)

        return recorded_step(self.times, in_lanes, lane_state, record, iteration, entry)

    def arriving(self, lane_state: LaneState, steps: StepRecord) -> Float[Array, "iterations components lanes"] | None:
        """The derivatives of the sum with respect to the states at the ends of the steps, apart from those through later
        states; `None` without samples."""
        if self.times is None or self.cotangents is None or steps.fixed is None:
            return None
        rows = self.cotangents.states.at[self.times.cell_of(lane_state), steps.sample].get(mode="fill", fill_value=0.0)
        # Where the derivative is zero, a NaN cotangent, such as that of theta at the pole, has no effect.
        return jnp.where(steps.fixed, 0.0, jnp.moveaxis(rows, -1, 1))

    def end(self, problem: AbstractProblem, time: Lanes, state: States) -> Lanes | None:
        """The function of the state that vanishes at the end of a run whose time is differentiated."""
        return problem.event_function(state) if self.times is None else problem.domain_margin(time, state)

    def measured(self, problem: AbstractProblem, lane_state: LaneState) -> tuple[Lanes, States]:
        """The quantities to differentiate, for lanes that have ended: the time of the event, or that at which a run leaves
        the domain; and the state."""
        time, state = lane_state.time, lane_state.state
        if self.end(problem, time, state) is None:
            return jnp.zeros_like(time), state
        # First order: the event is located to 1e-10 of a step, and its time is not differentiated again.
        later = delay(functools.partial(self.end, problem, time), state, problem.field(time, state))
        return time_at_jump(problem, time, state, time + later), state

    def share_of_end(self, lane_state: LaneState) -> tuple[Lanes, States]:
        """The factors of the measured quantities in what is differentiated."""
        if self.times is None or self.cotangents is None:
            return jnp.ones_like(lane_state.time), jnp.zeros_like(lane_state.state)
        cell, has_left = self.times.cell_of(lane_state), (lane_state.status == LEFT_DOMAIN) & (lane_state.time > 0.0)
        at_end = jnp.where(lane_state.status == REACHED_END, self.cotangents.end_state[:, cell], 0.0)
        return jnp.where(has_left, self.cotangents.end_time[cell], 0.0), at_end


#: A tree of booleans like a problem: the leaves with respect to which to differentiate.
Moving: TypeAlias = PyTree


class Derivatives(NamedTuple):
    """Derivatives of the measured quantity with respect to the state and to the parameters, a tree of arrays."""

    state: Float[Array, "components *lanes"]
    numbers: PyTree


def solve_with_adjoint(
    problem: AbstractProblem, probe: Tangent, ends_on_event: bool, options: RunOptions, recorder: StepRecorder
) -> tuple[Outcome, Derivatives]:
    """Run every cell to its end, and differentiate what a recorder measures.

    **Arguments:**

    - `probe`: a tangent of the problem. Its variation is also integrated and takes part in step-size control, so that
      the steps suit tangents even where the state is at rest.
    - `ends_on_event`: as for `VariationalProblem`.

    **Returns:** the `Outcome`, without crossing times; and the derivatives of every cell with respect to its initial
    state and to the parameters that the tangent moves, one per cell, in a tree like the problem with `None` for the other
    leaves and for those that do not matter.
    """
    components, size = problem.start()[0].shape

    def field_and_end(problem: AbstractProblem, states: States) -> PyTree:
        zero = jnp.zeros_like(states[0])
        return problem.field(zero, states), recorder.end(problem, zero, states), problem.jumps(zero, states)

    moving = variation.moving_leaves(problem, probe, field_and_end)
    # One value per cell of the numbers that the tangent moves, and of their rates.
    active = variation.where_active(problem, probe)
    active, probe = (jax.tree.map(lambda leaf: variation.with_cells(leaf, size), tree) for tree in (active, probe))
    problem = eqx.combine(active, problem)
    numbers = eqx.filter(problem, moving)
    scheduler = LaneScheduler.of(
        VariationalProblem(problem, (probe,), ends_on_event), *options, one_kernel=True, n_blocks=2
    )
    # Without tangents, a `VariationalProblem` is the problem itself, with the option not to end on its event.
    moving, numbers = (VariationalProblem(leaves, (), ends_on_event) for leaves in (moving, numbers))

    def forward(_: Int[Array, ""], before: SchedulerState, other: PyTree) -> tuple[SchedulerState, Period, PyTree]:
        after, record = scheduler.run(before, recorder)
        latest_steps, outcome = other
        other = (latest_steps.added(before.iterations, record.rows), scheduler.store(outcome, after.lane_state))
        return scheduler.refill(after), (before, after), other

    def is_kept(period: Period, other: PyTree) -> Bool[Array, ""]:
        return period[0].iterations >= other[0].first

    def backward(
        _: Int[Array, ""], period: Period, other: PyTree, carried: tuple[Derivatives, Derivatives]
    ) -> tuple[Derivatives, Derivatives]:
        (before, after), (adjoint, gradient) = period, carried
        steps = other[0].of_period(before.iterations, recorder.period)
        count = after.iterations - before.iterations
        adjoint = period_taken_back(scheduler, moving, recorder, after.lane_state, steps, count, adjoint)
        # A cell that had made no step was at its start.
        at_its_start = (before.lane_state.steps == 0) & (before.lane_state.cell < scheduler.cells)
        cell = jnp.where(at_its_start, before.lane_state.cell, scheduler.capacity)
        gradient = jax.tree.map(
            lambda of_cells, of_lanes: of_cells.at[..., cell].set(of_lanes, mode="drop"), gradient, adjoint
        )
        return adjoint, gradient

    start = scheduler.start()
    state, states = (without_probe(lanes).state for lanes in (start.lane_state, scheduler.fresh))
    record = jax.eval_shape(lambda: recorder.begin(scheduler.in_lanes(start.lane_state), start.lane_state, None).rows)
    other = (LatestSteps.none(record, scheduler.capacity), outcome_of(scheduler.fresh))
    carried = (Derivatives(state, scheduler.pick(numbers, start.lane_state.cell)), Derivatives(states, numbers))
    run = there_and_back(
        (start, (start, start), other, jax.tree.map(jnp.zeros_like, carried)),
        jnp.iinfo(jnp.arange(0).dtype).max,
        scheduler.unfinished,
        is_kept,
        forward,
        backward,
    )
    outcome, gradient = run.other[1], run.adjoint[1]
    return outcome._replace(state=outcome.state[:components]), Derivatives(gradient.state, gradient.numbers.problem)


def period_taken_back(
    scheduler: LaneScheduler,
    moving: Moving,
    recorder: StepRecorder,
    lane_state: LaneState,
    steps: StepRecord,
    count: Int[Array, ""],
    adjoint: Derivatives,
) -> Derivatives:
    """Carry the derivatives from the end of a period to its start; in lanes that have ended, the derivatives begin there."""
    tableau, lane_state = scheduler.control.tableau, without_probe(lane_state)
    # Selected here: XLA 0.10.2 aborts on a kernel that takes the initial states of all cells if they are constants.
    problem = dataclasses.replace(scheduler.in_lanes(lane_state)[0], tangents=())
    record = (steps.time, steps.state, steps.length, recorder.arriving(lane_state, steps))

    def loop(carry: PyTree) -> Derivatives:
        lane_state, share, record, count, adjoint = carry
        ended = lane_state.status != RUNNING
        numbers, static = eqx.partition(problem, moving)

        def measured(numbers: PyTree, state: States) -> PyTree:
            return recorder.measured(eqx.combine(numbers, static).problem, lane_state._replace(state=state))

        by_number, by_state = jax.vjp(measured, numbers, lane_state.state)[1](share)
        at_end = Derivatives(by_state, by_number)
        adjoint = jax.tree.map(functools.partial(jnp.where, ended), at_end, adjoint)

        def step(carry: tuple[Array, Derivatives, StageMemory]) -> tuple[Array, Derivatives, StageMemory]:
            index, adjoint, memory = carry
            time, state, length, at_end = read(record, index - 1)
            if at_end is not None:
                adjoint = adjoint._replace(state=adjoint.state + at_end)
            return index - 1, *step_taken_back(tableau, problem, moving, time, state, length, adjoint, memory)

        state, stages = lane_state.state, 1 + inner_stages(tableau)
        sizes = (stages, stages - 1, stages + 1)
        memory = StageMemory(*(jnp.zeros((size, *state.shape), state.dtype) for size in sizes))
        return jax.lax.while_loop(lambda carry: carry[0] > 0, step, (count, adjoint, memory))[1]

    return scheduler.in_kernel(loop)((lane_state, recorder.share_of_end(lane_state), record, count, adjoint))


def without_probe(lane_state: LaneState) -> LaneState:
    """The lanes with the states alone, without the variations."""
    return lane_state._replace(state=lane_state.state[: lane_state.state.shape[0] // 2])


class StageMemory(NamedTuple):
    """Memory for the stages of a step, which all steps share; what it holds before a step does not matter.

    `states`, `rates`: the states and the field at the stages; `adjoints`: the derivatives with respect to the end of
    the step and to the stages.
    """

    states: Stages
    rates: Array
    adjoints: Stages


def step_taken_back(
    tableau: diffrax.ButcherTableau,
    problem: AbstractProblem,
    moving: Moving,
    time: Lanes,
    state: States,
    length: Lanes,
    adjoint: Derivatives,
    memory: StageMemory,
) -> tuple[Derivatives, StageMemory]:
    """Carry derivatives from the end of a Runge-Kutta step to its start (Hager, Numer. Math. 87 (2000) 247).

    The stages are computed in loops, as in `explicit_step`.

    **Arguments:**

    - `tableau`: the method; a last stage that only serves the next step does not count.
    - `problem`, `moving`: the problem, with leaves that are scalars or have one number per lane; the leaves with
      respect to which to differentiate.
    - `time`, `state`, `length`: where the step starts, and its length; 0 if no step was made.
    - `adjoint`: derivatives at the end of the step.
    - `memory`: memory for the stages.

    **Returns:** the derivatives at the start, and the memory for reuse.
    """
    numbers, static = eqx.partition(problem, moving)
    inner = inner_stages(tableau)
    stages, rows = 1 + inner, tableau.a_lower[:inner]
    fractions = jnp.array([0.0, *tableau.c[:inner]])
    # For each stage, the share of its rate in the end of the step and in the later stages.
    shares = np.zeros((stages, 1 + stages))
    shares[:, 0] = tableau.b_sol[:stages]
    for stage, row in enumerate(rows, start=1):
        shares[: len(row), 1 + stage] = row

    def stage_made(stage: Int[Array, ""], carry: tuple[Stages, Array]) -> tuple[Stages, Array]:
        stage_states, rates = carry
        rate = problem.field(time + fractions[stage] * length, read(stage_states, stage))
        rates = written_by_component(rates, rate, at=stage)
        return written_in_place(stage_states, moved_state(stage, rows, state, length, rates), at=stage + 1), rates

    start = jnp.zeros((), int)
    initial_stages = written_in_place(memory.states, state, at=start), memory.rates
    stage_states, rates = over_stages(stages - 1, stage_made, initial_stages)

    def stage_taken_back(count: Int[Array, ""], carry: tuple[Stages, Derivatives]) -> tuple[Stages, Derivatives]:
        stage, (by_stage, total) = stages - 1 - count, carry
        by_rate = jax.lax.optimization_barrier(moved_state(stage, shares, zero_state, length, by_stage))
        stage_time = time + fractions[stage] * length

        def field(numbers: PyTree, parts: tuple[Lanes, ...]) -> States:
            return eqx.combine(numbers, static).field(stage_time, parts)

        pull = jax.vjp(field, numbers, tuple(jnp.unstack(read(stage_states, stage))))[1]
        by_number, by_part = pull(jnp.stack(jnp.unstack(by_rate)))
        # If no step was made, values may not be finite.
        by_state = jax.lax.optimization_barrier(jnp.where(length > 0.0, jnp.stack(by_part), 0.0))
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
    problem: AbstractProblem, moving: Moving, time: Lanes, state: States, adjoint: Derivatives
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
        def across(numbers: PyTree, state: States) -> States:
            return eqx.combine(numbers, static).across_jump(near, state)

        # Round-off apart, the states of both sides differ only in their clocks.
        near_state = state + (near - time) * problem.field(time, state)
        by_number, by_state = jax.vjp(across, numbers, near_state)[1](adjoint.state)
        by_number = jax.tree.map(lambda term: jnp.where(is_jump, term, 0.0), by_number)
        state_before = jnp.where(is_jump, by_state, adjoint.state)
        return Derivatives(state_before, jax.tree.map(jnp.add, adjoint.numbers, by_number))

    return jax.lax.cond(jnp.any(is_jump), taken_back, lambda: adjoint)


# Derivatives of the event times of many cells along tangents of a problem.
#
# Up to `MOST_FORWARD` tangents are integrated forward, as variations beside the run (`variation.py`); for more tangents,
# each run takes one backward pass.

#: Up to this many tangents are integrated forward, in pairs. The cost relative to a table without derivatives, at a
#: tolerance of 1e-8, for 2, 3, 4 and 6 parameters, is on the plane 3.4, 6.4, 6.3, 9.6 forward and 5.0, 5.7, 5.6, 5.5
#: backward, in a cylinder 3.6, 7.6, 7.6, 11 forward and 5.6, 6.8, 6.8, 7.6 backward (jax 0.10).
MOST_FORWARD = 2


def solve_ensemble_with_tangents(
    problem: AbstractProblem,
    tangents: Tangents,
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    nonterminal: bool = False,
    one_kernel: bool | None = None,
    traced: bool = False,
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell, and differentiate the time of its event along tangents.

    **Arguments:** as for `solve_ensemble`, and

    - `tangents`: tangents of the problem, as for `VariationalProblem`. Their variations, or a mixture of the
      variations, take part in step-size control.
    - `one_kernel`: as for `solve_ensemble`. If it is false, all tangents are integrated forward, whatever their number,
      so that the result can be differentiated again.

    **Returns:** the `Outcome`, and for each tangent the derivative of `crossing_time`, 0 where that is infinite.
    Source: implicit function theorem at the event; step lengths are held fixed.

    **Example:** half-lives, and their derivatives with respect to the rates.

    >>> from nonholonomic.derivatives import solve_ensemble_with_tangents
    >>> problem, tangents = Decays(jnp.array([1.0, 2.0])), (Decays(jnp.ones(2)),)
    >>> outcome, slopes = solve_ensemble_with_tangents(problem, tangents, t1, jnp.asarray(2), settings)
    >>> print(outcome.crossing_time.round(6), slopes[0].round(6))
    [0.693147 0.346574] [-0.693147 -0.173287]
    """
    one_kernel = not traced if one_kernel is None else one_kernel
    solve = _in_program if traced else _alone
    return solve(problem, tangents, (t1, cells, settings), nonterminal, one_kernel)


def ensemble_solve_with_tangents(
    problem: AbstractProblem, tangents: Tangents, options: RunOptions, nonterminal: bool, one_kernel: bool
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """`solve_ensemble_with_tangents`, not compiled."""
    if nonterminal:
        outcome = LaneScheduler.of(problem, *options, nonterminal=True, one_kernel=one_kernel).solve()[0]
        # The derivatives need the run only up to the event, whose time is now known.
        options = (jnp.where(jnp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0), *options[1:])
    if one_kernel and problem.fits_one_kernel and len(tangents) > MOST_FORWARD:
        ended, slopes = _slopes_by_adjoint(problem, tangents, not nonterminal, options)
    else:
        ended, slopes = variation.slopes_by_variations(problem, tangents, not nonterminal, options, one_kernel)
    if not nonterminal:
        outcome = with_crossing_times(problem, ended)
    return outcome, [slope_of_event(outcome, ended, slope, nonterminal) for slope in slopes]


def slope_of_event(
    outcome: Outcome, ended: Outcome, slope: Float[Array, " cells"], nonterminal: bool
) -> Float[Array, " cells"]:
    """The derivative of the time of an event: 0 without one, and NaN if it is unknown. **Arguments:** `outcome`, `ended`: of
    the runs, without and with their variations; `slope`: as from `slopes_by_variations`."""
    # An event at the start has a fixed time, whatever the tangent.
    has_delay = jnp.isfinite(outcome.crossing_time) & (ended.end_time > 0.0)
    # With its variations a run takes other steps: where it does not reach the event, it has no derivative.
    arrived = ended.status == (REACHED_END if nonterminal else CROSSED)
    return jnp.where(has_delay, jnp.where(arrived, slope, jnp.nan), 0.0)


_alone, _in_program = compiled_alone(ensemble_solve_with_tangents), eqx.filter_jit(ensemble_solve_with_tangents)


def _slopes_by_adjoint(
    problem: AbstractProblem, tangents: Tangents, ends_on_event: bool, options: RunOptions
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """The result of `slopes_by_variations`, at a cost that does not depend on the number of tangents."""
    shares = shares_of(len(tangents)).tolist()
    probe = jax.tree.map(lambda *rates: sum(c * rate for c, rate in zip(shares, rates, strict=True)), *tangents)
    ended, (by_start, by_number) = solve_with_adjoint(problem, probe, ends_on_event, options, StepRecorder())

    def slope(direction: Tangent) -> Float[Array, " cells"]:
        start = eqx.filter_jvp(lambda problem: problem.start()[0], (problem,), (direction,))[1]
        pairs = zip(
            jax.tree.leaves(by_number), jax.tree.leaves(variation.where_active(direction, by_number)), strict=True
        )
        shares = [jnp.sum((gradient * rate).reshape(-1, by_start.shape[1]), axis=0) for gradient, rate in pairs]
        return sum(shares, jnp.zeros(by_start.shape[1]) if start is None else jnp.sum(by_start * start, axis=0))

    return ended, [slope(direction) for direction in tangents]


# The derivatives of a sum over the samples of a run with respect to any number of parameters, by one backward pass.
#
# The run is repeated, with steps that also suit a tangent, and its steps are recorded. The backward pass adds the cotangent
# of each sample where it passes the sample's time. Neither the cost nor the memory depends on the number of parameters, apart
# from the field's own share.


def samples_pulled_back(
    build: Callable[..., AbstractProblem],
    point: tuple[Float[Array, "... cells"], ...],
    cotangents: SampledCotangents,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    settings: Settings,
    rates: list[Float[Array, "... cells"]] | None = None,
) -> list[Float[Array, "... cells"]]:
    """The cotangents of a problem's numbers from those of its samples.

    **Arguments:**

    - `build`: numbers -> problem; `point`: the numbers, with the cells last.
    - `cotangents`: those of the samples, 0 after the end of a run, and of the end.
    - `times`, `t1`, `settings`: as for `solve_with_samples`.
    - `rates`: a tangent of the numbers, which the steps must suit; by default one that moves every number.

    **Returns:** the cotangents, in the shapes of the numbers; NaN in cells that fail with the steps that suit the tangent.
    """
    problem, cells = build(*point), point[0].shape[-1]
    probe = variation.tangents_of(build, point, [tuple(mixture(point) if rates is None else rates)])[0]
    recorder = StepRecorder(SampleTimes.of(times, cells, components), cotangents)
    options = (t1, jnp.asarray(cells), settings)
    outcome, (by_start, by_number) = solve_with_adjoint(problem, probe, False, options, recorder)
    sample_times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), cells)).T
    is_moved = VariationalProblem(problem, (probe,), False).start()[0][len(by_start) :] != 0.0
    initial = jnp.where((sample_times <= 0.0)[..., None] & is_moved.T[:, None], cotangents.states, 0.0)
    is_lost = jnp.any(jnp.any(cotangents.states != 0.0, axis=-1) & (sample_times > outcome.end_time[:, None]), axis=1)
    is_lost |= jnp.any(cotangents.end_state != 0.0, axis=0)
    by_start = by_start + jnp.sum(initial, axis=1).T

    def numbers_and_start(*point: Float[Array, "... cells"]) -> PyTree:
        problem = build(*point)
        return variation.where_active(problem, by_number), problem.start()[0]

    by_point = jax.vjp(numbers_and_start, *point)[1]((by_number, by_start))
    return [jnp.where(is_lost & (outcome.status == FAILED), jnp.nan, part) for part in by_point]


def mixture(point: tuple[Float[Array, "... cells"], ...]) -> list[Float[Array, "... cells"]]:
    """A direction that moves every number by a share of its own size."""
    counts = [number[..., 0].size for number in point]
    shares = np.split(shares_of(sum(counts)), np.cumsum(counts)[:-1])
    return [
        jnp.asarray(share).reshape(*number.shape[:-1], 1) * tangent_scale(number)
        for share, number in zip(shares, point, strict=True)
    ]


def shares_of(count: int) -> Float[np.ndarray, " count"]:
    """Shares for a mixture of some tangents that are unlikely to cancel. The mixture is about as large as each tangent, so
    that steps are as short as for one tangent.
    """
    return (0.5 + np.modf(0.618 * np.arange(count))[0]) / count
