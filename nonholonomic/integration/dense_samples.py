"""Sample many runs at closely spaced times, by interpolation inside steps."""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Int

from ..compilation.xla_cpu import written_in_place
from .problem import AbstractProblem
from .runge_kutta import Lanes, States, weighted_sum
from .sample_times import Collected, Rows, SampleTimes
from .scheduler import AbstractRecorder, InLanes
from .step import LaneState, after_step, past_jump, trial_step, until_jump

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
