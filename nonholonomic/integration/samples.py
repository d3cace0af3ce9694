"""Sample many runs at given times, with the lanes that also locate event times.

Steps end on the requested times, so a sample has the accuracy of the method; between two samples the steps have even
lengths. The state is recorded after each iteration, and the samples of a period are stored together.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..xla_cpu import written_in_place
from .problem import AbstractProblem
from .runge_kutta import Lanes
from .scheduler import AbstractRecorder, InLanes, LaneScheduler, Outcome
from .settings import Settings
from .status import FAILED, REACHED_END, RUNNING
from .step import LaneState, try_step

#: Largest factor by which a step is stretched to end on a sample: its error stays below the tolerance, because steps
#: are proposed with a margin of `step.SAFETY`.
STRETCH = 1.08

#: The values to keep of some states: (the cells in the lanes, (iterations, components, lanes)) -> a tree of arrays
#: (iterations, lanes, ...).
Read = Callable[[Int[Array, " lanes"], Float[Array, "iterations components lanes"]], Any]


def components(cells: Int[Array, " lanes"], states: Float[Array, "iterations components lanes"]) -> Array:
    """The states themselves."""
    return jnp.moveaxis(states, 1, -1)


class Reached(NamedTuple):
    """Record of a period: the state after each iteration, and the number of the sample there, if any."""

    state: Float[Array, "iterations components lanes"]
    sample: Int[Array, "iterations lanes"]


class Collected(NamedTuple):
    """The number of the next sample in every lane, and the samples so far: a tree of arrays (cells, times, ...)."""

    sample: Int[Array, " lanes"]
    samples: Any


class SampleRecorder(AbstractRecorder):
    """Lets steps end on the sample times of every cell, and collects the samples.

    `times` are the times of the samples [s]; `first` is the number of each cell's first sample after its start; `read`
    returns the values to keep.
    """

    times: Float[Array, "times *cells"]
    first: Int[Array, " cells"]
    read: Read = eqx.field(static=True)

    # As many iterations as fit the caches with their record.
    period = 64

    @classmethod
    def of(cls, times: Float[Array, "times *cells"], cells: int, read: Read) -> "SampleRecorder":
        """The recorder of the samples of some cells."""
        return cls(times, jnp.broadcast_to(jnp.sum(times <= 0.0, axis=0), (cells,)), read)

    def at_start(self, lane_state: LaneState, starts: Float[Array, "components cells"]) -> Collected:
        """The samples at the start."""
        is_initial = (self.times <= 0.0).reshape(len(self.times), -1).T

        def of_start(values: Float[Array, "1 cells ..."]) -> Float[Array, "cells times ..."]:
            values = jnp.moveaxis(values, 0, 1)
            return jnp.where(is_initial.reshape(*is_initial.shape, *[1] * (values.ndim - 2)), values, jnp.nan)

        first_values = self.read(jnp.arange(len(self.first)), starts[None])
        return Collected(self._begin(lane_state), jax.tree.map(of_start, first_values))

    def begin(self, lane_state: LaneState, collected: Collected) -> tuple[Bool[Array, " lanes"], Array, Reached]:
        room = jnp.zeros((self.period, *lane_state.state.shape), lane_state.state.dtype)
        empty = Reached(room, jnp.full((self.period, *collected.sample.shape), len(self.times)))
        return jnp.ones(collected.sample.shape, bool), collected.sample, empty

    def step(
        self,
        in_lanes: InLanes,
        lane_state: LaneState,
        record: tuple[Bool[Array, " lanes"], Array, Reached],
        iteration: Int[Array, ""],
    ) -> tuple[LaneState, tuple[Bool[Array, " lanes"], Array, Reached]]:
        """The record also contains whether the last step was accepted, and the number of the next sample."""
        (problem, control, atol), (accepted, sample, reached) = in_lanes, record
        count, horizon = len(self.times), jnp.broadcast_to(control.t1, lane_state.time.shape)
        next_time = self._time_of(sample, lane_state)
        target = jnp.where(sample < count, jnp.minimum(next_time, horizon), horizon)
        even_length = _even(lane_state.length, target - lane_state.time, lane_state.bracketing)
        # The step after a rejected step is shorter on purpose, because it may have to end on a minimum of a margin.
        length = jnp.where(accepted, even_length, jnp.minimum(even_length, lane_state.length))
        lane_state = lane_state._replace(length=length)
        new_lanes = try_step(problem, control._replace(t1=target), atol, lane_state)
        at_target = (lane_state.status == RUNNING) & (new_lanes.status == REACHED_END)
        is_sample = at_target & (sample < count) & (new_lanes.time >= next_time)
        goes_on = at_target & (new_lanes.time < horizon)
        status = jnp.where(new_lanes.steps < control.max_steps, RUNNING, FAILED)
        new_lanes = new_lanes._replace(status=jnp.where(goes_on, status, new_lanes.status))
        entry = Reached(new_lanes.state, jnp.where(is_sample, sample, count))
        reached = jax.tree.map(functools.partial(written_in_place, at=iteration), reached, entry)
        return new_lanes, (new_lanes.time > lane_state.time, sample + is_sample, reached)

    def collect(
        self, collected: Collected, record: tuple[Array, Array, Reached], ended: LaneState, refilled: LaneState
    ) -> Collected:
        _, sample, reached = record
        cell = self._cell(ended)

        def added(samples: Float[Array, "cells times ..."], rows: Float[Array, "iterations lanes ..."]) -> Array:
            return samples.at[cell[None], reached.sample].set(rows, mode="drop", unique_indices=True)

        samples = jax.tree.map(added, collected.samples, self.read(cell, reached.state))
        return Collected(jnp.where(refilled.cell != ended.cell, self._begin(refilled), sample), samples)

    def _cell(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        return jnp.minimum(lane_state.cell, len(self.first) - 1)

    def _begin(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        """The number of the first sample after the start in every lane."""
        return self.first[self._cell(lane_state)]

    def _time_of(self, sample: Int[Array, " lanes"], lane_state: LaneState) -> Lanes:
        """The time of a sample in every lane."""
        index = jnp.minimum(sample, len(self.times) - 1)
        return self.times[index] if self.times.ndim == 1 else self.times[index, self._cell(lane_state)]


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

    - `times`: times of the samples [s], increasing, at least 0; (times,) for all cells or (times, cells). Runs do not
      reach times after `t1`.
    - `read`: function of cells (lanes,) and states (iterations, components, lanes) that returns the values to keep, a
      tree of arrays (iterations, lanes, ...); by default the states themselves. Keeping less saves time and memory.

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
    recorder = SampleRecorder.of(times, scheduler.capacity, read)
    at_start = recorder.at_start(scheduler.start().lane_state, scheduler.fresh.state)
    outcome, _, collected = scheduler.recorded(recorder, at_start)
    return outcome, collected.samples


def _even(length: Lanes, left: Lanes, bracketing: Array) -> Lanes:
    """The length of a step, changed a little if one or two steps then end on the next sample."""
    reach = STRETCH * length
    fitting = jnp.where(reach >= left, left, jnp.where(2.0 * reach >= left, 0.5 * left, length))
    return jnp.where(bracketing, length, fitting)
