"""Sample many runs at given times, with the lanes that also locate event times.

Steps have their natural lengths; samples inside a step come from a continuous extension. The samples of a period are
stored together.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from ..xla_cpu import written_in_place
from .continuous_extension import StatesInside, StepEnd, continuous_extension, second_derivative, states_by_steps
from .oscillatory import Oscillatory8
from .problem import AbstractProblem
from .runge_kutta import Lanes, States
from .scheduler import AbstractRecorder, InLanes, LaneScheduler, Outcome
from .settings import Settings
from .step import LaneState, after_step, trial_step

#: Rows of a record, of which a period fills at least the first part before it ends: as many as fit the caches.
ROWS, ROWS_OF_PERIOD = 128, 112

#: The greatest number of samples in a step, so that they fit the rows that are left.
MAX_SAMPLES_IN_STEP = ROWS - ROWS_OF_PERIOD

#: The values to keep of some states: (the cells in the lanes, (rows, components, lanes)) -> a tree of arrays
#: (rows, lanes, ...).
Read = Callable[[Int[Array, " lanes"], Float[Array, "rows components lanes"]], Any]


def components(cells: Int[Array, " lanes"], states: Float[Array, "rows components lanes"]) -> Array:
    """The states themselves."""
    return jnp.moveaxis(states, 1, -1)


class Rows(NamedTuple):
    """The samples of a period: in each row the states of all lanes, and the number of each lane's sample; the number of
    samples where a lane has none."""

    state: Float[Array, "rows components lanes"]
    sample: Int[Array, "rows lanes"]


class Record(NamedTuple):
    """Record of a period.

    `second`: the second derivative of the state where each lane is; `sample`, `sample_time`: the number and the time [s]
    of the next sample in every lane, infinite if there is none; `rows`: the samples, of which `filled` rows are filled.
    """

    second: States
    sample: Int[Array, " lanes"]
    sample_time: Lanes
    rows: Rows
    filled: Int[Array, ""]


class Collected(NamedTuple):
    """The number of the next sample in every lane, and the samples so far: a tree of arrays (cells, times, ...)."""

    sample: Int[Array, " lanes"]
    samples: Any


class SampleRecorder(AbstractRecorder):
    """Collects the samples of every cell.

    `times` are the times of the samples [s]; `first` is the number of each cell's first sample after its start; `read`
    returns the values to keep; `solver` is the method of the steps.
    """

    times: Float[Array, "times *cells"]
    first: Int[Array, " cells"]
    solver: diffrax.AbstractSolver
    read: Read = eqx.field(static=True)

    @classmethod
    def of(
        cls, times: Float[Array, "times *cells"], cells: int, solver: diffrax.AbstractSolver, read: Read
    ) -> "SampleRecorder":
        """The recorder of the samples of some cells."""
        times = stop_gradient(times)
        return cls(times, jnp.broadcast_to(jnp.sum(times <= 0.0, axis=0), (cells,)), solver, read)

    def at_start(self, lane_state: LaneState, starts: Float[Array, "components cells"]) -> Collected:
        """The samples at the start."""
        is_initial = (self.times <= 0.0).reshape(len(self.times), -1).T

        def of_start(values: Float[Array, "1 cells ..."]) -> Float[Array, "cells times ..."]:
            values = jnp.moveaxis(values, 0, 1)
            return jnp.where(is_initial.reshape(*is_initial.shape, *[1] * (values.ndim - 2)), values, jnp.nan)

        first_values = self.read(jnp.arange(len(self.first)), starts[None])
        return Collected(self._begin(lane_state), jax.tree.map(of_start, first_values))

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Collected) -> Record:
        second = self._second_derivative(
            in_lanes[0], lane_state.length, lane_state.time, lane_state.state, lane_state.rate
        )
        room = jnp.zeros((ROWS, *lane_state.state.shape), lane_state.state.dtype)
        rows = Rows(room, jnp.full((ROWS, *collected.sample.shape), len(self.times)))
        sample_time = self._time_of(collected.sample, lane_state)
        return Record(second, collected.sample, sample_time, rows, jnp.zeros((), int))

    def has_room(self, record: Record, iteration: Int[Array, ""]) -> Bool[Array, ""]:
        return record.filled < ROWS_OF_PERIOD

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: Record, iteration: Int[Array, ""]
    ) -> tuple[LaneState, Record]:
        problem, control, atol = in_lanes
        lane_state = lane_state._replace(length=self._limited_length(lane_state, record.sample))
        length, trial = trial_step(problem, control, lane_state)
        new_lanes = after_step(problem, control, atol, lane_state, length, trial)
        length = stop_gradient(length)
        start = StepEnd(lane_state.time, lane_state.state, lane_state.rate, record.second)
        end_time = lane_state.time + length
        second = self._second_derivative(problem, length, end_time, trial.state, trial.rate)
        if isinstance(self.solver, Oscillatory8):
            end = StepEnd(end_time, trial.state, trial.rate, second)
            states_inside = continuous_extension(problem, start, end, length, trial.rates)
        else:
            states_inside = states_by_steps(problem, control.tableau, start, length)
        has_moved = new_lanes.time > lane_state.time
        last_time = jnp.where(has_moved, new_lanes.time, -jnp.inf)
        record = self._with_samples(record, new_lanes, last_time, (lane_state.time, length), states_inside)
        return new_lanes, record._replace(second=jnp.where(has_moved, second, record.second))

    def _second_derivative(
        self, problem: AbstractProblem, length: Lanes, time: Lanes, state: States, rate: States
    ) -> States:
        """The second derivative of the state, which only `Oscillatory8` needs."""
        needed = isinstance(self.solver, Oscillatory8)
        return second_derivative(problem, length, time, state, rate) if needed else jnp.zeros_like(state)

    def _limited_length(self, lane_state: LaneState, sample: Int[Array, " lanes"]) -> Lanes:
        """The lengths of the steps, limited so that their samples fit the record."""
        furthest_time = self._time_of(sample + MAX_SAMPLES_IN_STEP - 1, lane_state)
        return jnp.minimum(lane_state.length, furthest_time - lane_state.time)

    def _with_samples(
        self,
        record: Record,
        lane_state: LaneState,
        last_time: Lanes,
        step: tuple[Lanes, Lanes],
        states_inside: StatesInside,
    ) -> Record:
        """The record with all samples up to a time, which lie in the latest step; `step`: its start and length [s]."""
        start_time, length = step

        def add(record: Record) -> Record:
            is_sample = record.sample_time <= last_time
            state = states_inside((record.sample_time - start_time) / length)
            entry = Rows(state, jnp.where(is_sample, record.sample, len(self.times)))
            rows = jax.tree.map(functools.partial(written_in_place, at=record.filled), record.rows, entry)
            sample = record.sample + is_sample
            return Record(record.second, sample, self._time_of(sample, lane_state), rows, record.filled + 1)

        return jax.lax.while_loop(lambda record: jnp.any(record.sample_time <= last_time), add, record)

    def collect(self, collected: Collected, record: Record, ended: LaneState, refilled: LaneState) -> Collected:
        cell = self._cell(ended)

        def added(samples: Float[Array, "cells times ..."], rows: Float[Array, "rows lanes ..."]) -> Array:
            return samples.at[cell[None], record.rows.sample].set(rows, mode="drop", unique_indices=True)

        samples = jax.tree.map(added, collected.samples, self.read(cell, record.rows.state))
        next_sample = jnp.where(refilled.cell != ended.cell, self._begin(refilled), record.sample)
        return Collected(next_sample, samples)

    def _cell(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        return jnp.minimum(lane_state.cell, len(self.first) - 1)

    def _begin(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        """The number of the first sample after the start in every lane."""
        return self.first[self._cell(lane_state)]

    def _time_of(self, sample: Int[Array, " lanes"], lane_state: LaneState) -> Lanes:
        """The time of a sample in every lane, infinite after the last one."""
        index = jnp.minimum(sample, len(self.times) - 1)
        time = self.times[index] if self.times.ndim == 1 else self.times[index, self._cell(lane_state)]
        return jnp.where(sample < len(self.times), time, jnp.inf)


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
) -> tuple[Outcome, Any]:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`, and sample it.

    **Arguments:** as for `LaneScheduler.of`, and

    - `times`: times of the samples [s], strictly increasing, at least 0; (times,) for all cells or (times, cells). Runs do not
      reach times after `t1`.
    - `read`: function of cells (lanes,) and states (rows, components, lanes) that returns the values to keep, a
      tree of arrays (rows, lanes, ...); by default the states themselves. Keeping less saves time and memory.

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
    recorder = SampleRecorder.of(times, scheduler.capacity, settings.for_lanes, read)
    at_start = recorder.at_start(scheduler.start().lane_state, scheduler.fresh.state)
    outcome, _, collected = scheduler.recorded(recorder, at_start)
    return outcome, collected.samples
