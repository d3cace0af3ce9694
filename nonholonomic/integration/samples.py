"""Sample many runs at given times, at the ends of steps or by interpolation inside them.

Steps end on the requested times; between two samples the steps have even lengths. The state is recorded after each
iteration, and the samples of a period are stored together. Dense samples lie inside steps.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.xla_cpu import written_in_place
from .problem import FAILED, REACHED_END, RUNNING, AbstractProblem, Settings
from .runge_kutta import AbstractTunedPair, Integers, Lanes, Mask, States, weighted_sum
from .scheduler import InLanes, LaneScheduler, Outcome, Recorder, Tried
from .step import LaneState, after_step, trial_step, until_jump

# The times at which the cells of a problem are sampled, and the samples so far.

#: The times of one run [s].
Times = Float[Array, " times"]

#: The values to keep of some states: (the cells in the lanes, (rows, components, lanes)) -> a tree of arrays
#: (rows, lanes, ...).
Read = Callable[[Integers, Float[Array, "rows components *lanes"]], PyTree]


def components(cells: Integers, states: Float[Array, "rows components *lanes"]) -> Array:
    """The states themselves."""
    return jnp.moveaxis(states, 1, -1)


class Rows(NamedTuple):
    """The samples of a period: in each row the states of all lanes, and the index of each lane's sample; where a lane has
    none, the index is the number of samples."""

    state: Float[Array, "rows components *lanes"]
    sample: Int[Array, "rows *lanes"]


class Collected(NamedTuple):
    """The index of the next sample in every lane, and the samples so far: a tree of arrays (cells, times, ...)."""

    sample: Integers
    samples: PyTree


class SampleTimes(eqx.Module):
    """The times of the samples of every cell [s], the index of each cell's first sample after its start, and the values
    to keep."""

    times: Float[Array, "times *cells"]
    first: Int[Array, " cells"]
    read: Read = eqx.field(static=True)

    @classmethod
    def of(cls, times: Float[Array, "times *cells"], cells: int, read: Read) -> "SampleTimes":
        """The times of the samples of some cells."""
        times = stop_gradient(times)
        return cls(times, jnp.broadcast_to(jnp.sum(times <= 0.0, axis=0), (cells,)), read)

    def __len__(self) -> int:
        return len(self.times)

    def at_start(self, lane_state: LaneState, starts: Float[Array, "components cells"]) -> Collected:
        """The samples at the start."""
        is_initial = (self.times <= 0.0).reshape(len(self), -1).T

        def of_start(values: Float[Array, "1 cells ..."]) -> Float[Array, "cells times ..."]:
            values = jnp.moveaxis(values, 0, 1)
            return jnp.where(is_initial.reshape(*is_initial.shape, *[1] * (values.ndim - 2)), values, jnp.nan)

        first_values = self.read(jnp.arange(len(self.first)), starts[None])
        return Collected(self.first[self.cell_of(lane_state)], jax.tree.map(of_start, first_values))

    def after(self, time: Lanes, lane_state: LaneState) -> Integers:
        """The index of the first sample after a time in every lane."""
        times = self.times[:, None] if self.times.ndim == 1 else self.times[:, self.cell_of(lane_state)]
        return jnp.sum(times <= time, axis=0)

    def time_of(self, sample: Integers, lane_state: LaneState) -> Lanes:
        """The time of a sample in every lane, infinite after the last one."""
        index = jnp.minimum(sample, len(self) - 1)
        time = self.times[index] if self.times.ndim == 1 else self.times[index, self.cell_of(lane_state)]
        return jnp.where(sample < len(self), time, jnp.inf)

    def cell_of(self, lane_state: LaneState) -> Integers:
        """The cells in the lanes; the last one in a lane without a cell."""
        return jnp.minimum(lane_state.cell, len(self.first) - 1)


class SampleRecorder(Recorder):
    """Lets steps end on the sample times of every cell, and collects the samples. The records have `rows`, and `sample`, the
    index of each lane's next sample."""

    times: SampleTimes

    # As many iterations as fit the caches with their record.
    period: ClassVar[int] = 64

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Collected) -> PyTree:
        accepted = jnp.ones(collected.sample.shape, bool)
        return Record(accepted, collected.sample, self.empty_rows(self.period, lane_state))

    def step(self, in_lanes: InLanes, lane_state: LaneState, record: PyTree, iteration: Int[Array, ""]) -> Tried:
        arguments = (self.times, in_lanes, lane_state, record, iteration)
        return recorded_step(*arguments, lambda new_lanes, _, sample: Rows(new_lanes.state, sample))

    def empty_rows(self, count: int, lane_state: LaneState) -> Rows:
        """Rows without samples."""
        state = jnp.zeros((count, *lane_state.state.shape), lane_state.state.dtype)
        return Rows(state, jnp.full((count, *lane_state.time.shape), len(self.times)))

    def collect(self, collected: Collected, record: PyTree, ended: LaneState, refilled: LaneState) -> Collected:
        cell, rows = self.times.cell_of(ended), record.rows

        def added(samples: Float[Array, "cells times ..."], values: Float[Array, "rows lanes ..."]) -> Array:
            return samples.at[cell[None], rows.sample].set(values, mode="drop", unique_indices=True)

        samples = jax.tree.map(added, collected.samples, self.times.read(cell, rows.state))
        sample = jnp.where(refilled.cell != ended.cell, self.times.first[self.times.cell_of(refilled)], record.sample)
        return Collected(sample, samples)


# Sample many runs at closely spaced times, by interpolation inside steps.

#: Rows of a record, and the number of filled rows at which a period ends. The record fits the caches.
ROWS, ROWS_OF_PERIOD = 128, 112

#: The greatest number of samples in a step, so that they fit the rows that are left.
MAX_SAMPLES_IN_STEP = ROWS - ROWS_OF_PERIOD


# States inside a step: a continuous extension of a pair of orders 8 and 7. The extension needs no more stages. The
# stages, together with the second derivatives of the state at both ends of the step, determine the state in the
# middle to seventh order (`AbstractTunedPair.middle`); the extension is the polynomial of degree 7 with the states
# and rates at both ends and in the middle, and with the second derivatives at the ends. It costs one derivative and
# one evaluation of the field per step, a sixth of a step.

#: A function of the places in a step, as fractions of the step, that returns the states there.
StatesInside = Callable[[Lanes], States]


class StepEnd(NamedTuple):
    """One end of a step: time [s], state, and the first and second derivatives of the state."""

    time: Lanes
    state: States
    rate: States
    second: States


def second_derivative(problem: AbstractProblem, length: Lanes, time: Lanes, state: States, rate: States) -> States:
    """The second derivative of the state: the derivative of the field along the motion.

    Where this derivative is not finite, as for the norm of a zero velocity, it is a difference quotient over a small part
    of the step of the given length [s].
    """
    along_motion = jax.linearize(problem.field, time, state)[1]
    second = jax.lax.optimization_barrier(along_motion(jnp.ones_like(time), rate))

    def with_quotient() -> States:
        # With this delay, the errors by curvature and by round-off are about equal.
        delay = jnp.sqrt(jnp.finfo(state.dtype).eps) * length
        quotient = (problem.field(time + delay, state + delay * rate) - rate) / delay
        return jnp.where(jnp.isfinite(second), second, quotient)

    # The components are added one by one, for all lanes at once, as in `scaled_error`.
    total = jnp.sum(functools.reduce(operator.add, second))
    return jax.lax.cond(jnp.isfinite(total), lambda: second, with_quotient)


def continuous_extension(
    middle_weights: Sequence[float],
    problem: AbstractProblem,
    start: StepEnd,
    end: StepEnd,
    length: Lanes,
    rates: Sequence[States],
) -> StatesInside:
    """The states inside a step.

    **Arguments:** `middle_weights`: those of the pair (`AbstractTunedPair.middle`); `start`, `end`: the ends of the step;
    `length`: its length [s]; `rates`: the field at its stages.
    """
    seconds = weighted_sum(middle_weights[len(rates) :], (start.second, end.second))
    middle = start.state + length * (weighted_sum(middle_weights[: len(rates)], rates) + length * seconds)
    middle = jax.lax.optimization_barrier(middle)
    middle_rate = jax.lax.optimization_barrier(problem.field(start.time + 0.5 * length, middle))

    vectors = (start.state, start.rate, start.second, end.state, end.rate, end.second, middle, middle_rate)

    def states_inside(place: Lanes) -> States:
        # Behind a barrier; otherwise the compiler would compute the weights again for every component.
        factors = jax.lax.optimization_barrier(jnp.stack(hermite_factors(place, length)))
        return functools.reduce(operator.add, map(operator.mul, factors, vectors))

    return states_inside


def hermite_factors(place: Lanes, length: Lanes) -> tuple[Lanes, ...]:
    """The factors of value, slope and second derivative at the start and at the end of a step, and of value and slope in the
    middle, in the polynomial of degree 7 that matches all of them.

    **Arguments:** `place`: where to evaluate the polynomial, as a fraction of the step; `length`: length of the step [s].
    """
    left, from_middle = 1.0 - place, place - 0.5

    def of_end(near: Lanes, far: Lanes, length: Lanes) -> tuple[Lanes, ...]:
        # Vanishes triply at the other end, and doubly in the middle; the series of 1 / vanishing is 1 + 7 near + 30 near^2.
        vanishing, delay = far**3 * (2.0 * from_middle) ** 2, near * length
        slope = 1.0 + 7.0 * near
        return vanishing * (slope + 30.0 * near**2), vanishing * delay * slope, vanishing * 0.5 * delay**2

    of_middle = (4.0 * place * left) ** 3
    return *of_end(place, left, length), *of_end(left, place, -length), of_middle, of_middle * from_middle * length


# The samples.


class DenseRecord(NamedTuple):
    """Record of a period.

    `second`: the second derivative of the state where each lane is; `sample`, `sample_time`: index and time [s] of each
    lane's next sample; the time is infinite if there is none; `rows`: the samples, of which `filled` rows are filled.
    """

    second: States
    sample: Integers
    sample_time: Lanes
    rows: Rows
    filled: Int[Array, ""]


class DenseSampleRecorder(SampleRecorder):
    """Collects the samples of every cell, which lie inside steps; `middle_weights`: of the pair, `AbstractTunedPair.middle`."""

    middle_weights: tuple[float, ...] = eqx.field(static=True)

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Collected) -> DenseRecord:
        point = (lane_state.length, lane_state.time, lane_state.state, lane_state.rate)
        return DenseRecord(
            second_derivative(in_lanes[0], *point),
            collected.sample,
            self.times.time_of(collected.sample, lane_state),
            self.empty_rows(ROWS, lane_state),
            jnp.zeros((), int),
        )

    def has_room(self, record: DenseRecord, iteration: Int[Array, ""]) -> Bool[Array, ""]:
        return record.filled < ROWS_OF_PERIOD

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: DenseRecord, iteration: Int[Array, ""]
    ) -> tuple[LaneState, DenseRecord]:
        problem, control, atol = in_lanes
        furthest_time = self.times.time_of(record.sample + MAX_SAMPLES_IN_STEP - 1, lane_state)
        lane_state = lane_state._replace(length=jnp.minimum(lane_state.length, furthest_time - lane_state.time))
        length, trial = trial_step(problem, control, lane_state)
        new_lanes = after_step(problem, control, atol, lane_state, length, trial)
        length = stop_gradient(length)
        end_time = lane_state.time + length
        second = second_derivative(problem, length, end_time, trial.state, trial.rate)
        start = StepEnd(lane_state.time, lane_state.state, lane_state.rate, record.second)
        end = StepEnd(end_time, trial.state, trial.rate, second)
        states_inside = continuous_extension(self.middle_weights, problem, start, end, length, trial.rates)
        has_moved = new_lanes.time > lane_state.time
        last_time = jnp.where(has_moved, new_lanes.time, -jnp.inf)

        def add(record: DenseRecord) -> DenseRecord:
            is_sample = record.sample_time <= last_time
            state = states_inside((record.sample_time - lane_state.time) / length)
            entry = Rows(state, jnp.where(is_sample, record.sample, len(self.times)))
            rows = written_in_place(record.rows, entry, at=record.filled)
            sample = record.sample + is_sample
            return DenseRecord(record.second, sample, self.times.time_of(sample, new_lanes), rows, record.filled + 1)

        # The samples up to `last_time` are all inside this step.
        record = jax.lax.while_loop(lambda record: jnp.any(record.sample_time <= last_time), add, record)
        if problem.jumps(new_lanes.time, new_lanes.state) is not None:
            has_jumped = new_lanes.time > end_time
            of_far_side = second_derivative(problem, length, new_lanes.time, new_lanes.state, new_lanes.rate)
            second = jnp.where(has_jumped, of_far_side, second)
        return new_lanes, record._replace(second=jnp.where(has_moved, second, record.second))


#: Largest factor by which a step is stretched to end on a sample: its error stays below the tolerance, because steps
#: are proposed with a margin of `step.SAFETY`.
STRETCH = 1.08


class Record(NamedTuple):
    """Record of a period: whether the last step was accepted and the index of the next sample, in every lane; and what is kept
    of each iteration, a tree of arrays (rows, ...)."""

    accepted: Mask
    sample: Integers
    rows: PyTree


def recorded_step(
    times: SampleTimes | None,
    in_lanes: InLanes,
    lane_state: LaneState,
    record: Record,
    iteration: Int[Array, ""],
    entry: Callable[..., PyTree],
) -> tuple[LaneState, Record]:
    """Try a step in every lane that does not pass its next sample, if there are samples, and record it.

    **Arguments:** as for `Recorder.step`; `entry`: function of the lanes after the step, of the length that was tried [s], and
    of the index of the sample on which each step ended, or the number of samples, that returns what to keep.
    """
    problem, control, atol = in_lanes
    if times is None:
        length, trial = trial_step(problem, control, lane_state)
        new_lanes = after_step(problem, control, atol, lane_state, length, trial)
        return new_lanes, record._replace(
            rows=written_in_place(record.rows, entry(new_lanes, length, None), at=iteration)
        )
    next_time = times.time_of(record.sample, lane_state)
    control_to_target = control._replace(t1=jnp.minimum(next_time, control.t1))
    # Even lengths up to the sample or, if it comes first, to the jump.
    target = until_jump(problem, control_to_target, lane_state).t1
    length, left = lane_state.length, target - lane_state.time
    reach = STRETCH * length
    # Changed a little if one or two steps then end on the sample; NaN if its time is NaN, so that the run ends.
    fitting = jnp.where(reach >= left, left, jnp.where(2.0 * reach >= left, 0.5 * left, jnp.minimum(length, left)))
    even_length = jnp.where(lane_state.bracketing, length, fitting)
    # The step after a rejected step is shorter on purpose, because it may have to end on a minimum of a margin.
    lane_state = lane_state._replace(length=jnp.where(record.accepted, even_length, jnp.minimum(even_length, length)))
    length, trial = trial_step(problem, control_to_target, lane_state)
    new_lanes = after_step(problem, control_to_target, atol, lane_state, length, trial)
    at_target = (lane_state.status == RUNNING) & (new_lanes.status == REACHED_END)
    goes_on = at_target & (new_lanes.time < control.t1)
    status = jnp.where(new_lanes.steps < control.max_steps, RUNNING, FAILED)
    new_lanes = new_lanes._replace(status=jnp.where(goes_on, status, new_lanes.status))
    is_sample = at_target & (new_lanes.time >= next_time)
    row = entry(new_lanes, length, jnp.where(is_sample, record.sample, len(times)))
    rows = written_in_place(record.rows, row, at=iteration)
    return new_lanes, Record(new_lanes.time > lane_state.time, record.sample + is_sample, rows)


def solve_with_samples(
    problem: AbstractProblem,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    n_blocks: int = 1,
    one_kernel: bool = False,
    read: Read = components,
    dense: bool = False,
) -> tuple[Outcome, PyTree]:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`, and sample it.

    **Arguments:** as for `LaneScheduler.of`, and

    - `times`: times of the samples [s], strictly increasing, at least 0; (times,) for all cells or (times, cells). Runs do not
      reach times after `t1`. Samples are not differentiable with respect to `times`, nor, if `dense`, to `t1`.
    - `read`: function of cells (lanes,) and states (rows, components, lanes) that returns the values to keep, a
      tree of arrays (rows, lanes, ...); by default the states themselves. Keeping less saves time and memory.
    - `dense`: whether to interpolate the samples inside steps of `Oscillatory8` or `Stabilized8`,
      which takes less time where there are more samples than steps. Otherwise steps end on
      the samples.

    **Returns:** the `Outcome`, without crossing times; and the kept values at the times, with the first axes (cells,
    times), NaN after the end of a run. By default, these are an array (cells, times, components).

    **Example:**

    >>> from nonholonomic.integration import solve_with_samples
    >>> times = jnp.array([0.1, 0.3])
    >>> _, states = solve_with_samples(problem, times, jnp.asarray(5.0), jnp.asarray(3), settings)
    >>> print(states[..., 0].round(6))
    [[0.904837 0.740818]
     [0.818731 0.548812]
     [0.67032       nan]]
    """
    scheduler = LaneScheduler.of(problem, t1, cells, settings, n_blocks=n_blocks, one_kernel=one_kernel)
    sample_times = SampleTimes.of(times, scheduler.capacity, read)
    solver, recorder = settings.for_lanes, SampleRecorder(sample_times)
    if dense and isinstance(solver, AbstractTunedPair):
        recorder = DenseSampleRecorder(sample_times, solver.middle)
    at_start = sample_times.at_start(scheduler.start().lane_state, scheduler.fresh.state)
    outcome, _, collected = scheduler.solve(recorder, at_start)
    return outcome, collected.samples
