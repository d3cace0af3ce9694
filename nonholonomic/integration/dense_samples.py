"""Sample many runs at closely spaced times, by interpolation inside steps."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Int

from ..compilation.xla_cpu import written_in_place
from .continuous_extension import StatesInside, StepEnd, continuous_extension, second_derivative
from .runge_kutta import Lanes, States
from .sample_times import Collected, Rows, SampleTimes
from .scheduler import AbstractRecorder, InLanes
from .step import LaneState, after_step, past_jump, trial_step, until_jump

#: Rows of a record, and the number of filled rows at which a period ends. The record fits the caches.
ROWS, ROWS_OF_PERIOD = 128, 112

#: The greatest number of samples in a step, so that they fit the rows that are left.
MAX_SAMPLES_IN_STEP = ROWS - ROWS_OF_PERIOD


class DenseRecord(NamedTuple):
    """Record of a period.

    `second`: the second derivative of the state where each lane is; `sample`, `sample_time`: index and time [s] of each
    lane's next sample; the time is infinite if there is none; `rows`: the samples, of which `filled` rows are filled.
    """

    second: States
    sample: Int[Array, " lanes"]
    sample_time: Lanes
    rows: Rows
    filled: Int[Array, ""]


class DenseSampleRecorder(AbstractRecorder):
    """Collects the samples of every cell, which lie inside steps; `middle_weights`: of the pair, `AbstractTunedPair.middle`."""

    times: SampleTimes
    middle_weights: tuple[float, ...] = eqx.field(static=True)

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Collected) -> DenseRecord:
        point = (lane_state.length, lane_state.time, lane_state.state, lane_state.rate)
        return DenseRecord(
            second_derivative(in_lanes[0], *point),
            collected.sample,
            self.times.time_of(collected.sample, lane_state),
            self.times.empty_rows(ROWS, lane_state),
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
        near = until_jump(problem, control, lane_state)
        length, trial = trial_step(problem, near, lane_state)
        near_lanes = after_step(problem, near, atol, lane_state, length, trial)
        new_lanes = past_jump(problem, control, near, lane_state, near_lanes)
        length = stop_gradient(length)
        end_time = lane_state.time + length
        second = second_derivative(problem, length, end_time, trial.state, trial.rate)
        start = StepEnd(lane_state.time, lane_state.state, lane_state.rate, record.second)
        end = StepEnd(end_time, trial.state, trial.rate, second)
        states_inside = continuous_extension(self.middle_weights, problem, start, end, length, trial.rates)
        has_moved = new_lanes.time > lane_state.time
        last_time = jnp.where(has_moved, new_lanes.time, -jnp.inf)
        record = self._with_samples(record, new_lanes, last_time, (lane_state.time, length), states_inside)
        if new_lanes is not near_lanes:
            has_jumped = new_lanes.time > near_lanes.time
            of_far_side = second_derivative(problem, length, new_lanes.time, new_lanes.state, new_lanes.rate)
            second = jnp.where(has_jumped, of_far_side, second)
        return new_lanes, record._replace(second=jnp.where(has_moved, second, record.second))

    def _with_samples(
        self,
        record: DenseRecord,
        lane_state: LaneState,
        last_time: Lanes,
        step: tuple[Lanes, Lanes],
        states_inside: StatesInside,
    ) -> DenseRecord:
        """Add the samples up to `last_time`, all inside the latest step; `step`: start and length of that step [s]."""
        start_time, length = step

        def add(record: DenseRecord) -> DenseRecord:
            is_sample = record.sample_time <= last_time
            state = states_inside((record.sample_time - start_time) / length)
            entry = Rows(state, jnp.where(is_sample, record.sample, len(self.times)))
            rows = jax.tree.map(functools.partial(written_in_place, at=record.filled), record.rows, entry)
            sample = record.sample + is_sample
            sample_time = self.times.time_of(sample, lane_state)
            return DenseRecord(record.second, sample, sample_time, rows, record.filled + 1)

        return jax.lax.while_loop(lambda record: jnp.any(record.sample_time <= last_time), add, record)

    def collect(self, collected: Collected, record: DenseRecord, ended: LaneState, refilled: LaneState) -> Collected:
        return self.times.collect(collected, record.rows, record.sample, ended, refilled)
