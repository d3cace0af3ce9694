"""The times at which the cells of a problem are sampled, and the samples so far."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from .runge_kutta import Lanes
from .step import LaneState

#: The values to keep of some states: (the cells in the lanes, (rows, components, lanes)) -> a tree of arrays
#: (rows, lanes, ...).
Read = Callable[[Int[Array, " lanes"], Float[Array, "rows components lanes"]], Any]


def components(cells: Int[Array, " lanes"], states: Float[Array, "rows components lanes"]) -> Array:
    """The states themselves."""
    return jnp.moveaxis(states, 1, -1)


class Rows(NamedTuple):
    """The samples of a period: in each row the states of all lanes, and the index of each lane's sample; where a lane has
    none, the index is the number of samples."""

    state: Float[Array, "rows components lanes"]
    sample: Int[Array, "rows lanes"]


class Collected(NamedTuple):
    """The index of the next sample in every lane, and the samples so far: a tree of arrays (cells, times, ...)."""

    sample: Int[Array, " lanes"]
    samples: Any


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
        return Collected(self.first_in(lane_state), jax.tree.map(of_start, first_values))

    def first_in(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        """The index of the first sample after the start in every lane."""
        return self.first[self._cell(lane_state)]

    def after(self, time: Lanes, lane_state: LaneState) -> Int[Array, " lanes"]:
        """The index of the first sample after a time in every lane."""
        times = self.times[:, None] if self.times.ndim == 1 else self.times[:, self._cell(lane_state)]
        return jnp.sum(times <= time, axis=0)

    def time_of(self, sample: Int[Array, " lanes"], lane_state: LaneState) -> Lanes:
        """The time of a sample in every lane, infinite after the last one."""
        index = jnp.minimum(sample, len(self) - 1)
        time = self.times[index] if self.times.ndim == 1 else self.times[index, self._cell(lane_state)]
        return jnp.where(sample < len(self), time, jnp.inf)

    def empty_rows(self, count: int, lane_state: LaneState) -> Rows:
        """Rows without samples."""
        state = jnp.zeros((count, *lane_state.state.shape), lane_state.state.dtype)
        return Rows(state, jnp.full((count, *lane_state.time.shape), len(self)))

    def collect(
        self, collected: Collected, rows: Rows, sample: Int[Array, " lanes"], ended: LaneState, refilled: LaneState
    ) -> Collected:
        """The samples with those of a period; `sample` is the index of the next sample in every lane."""
        cell = self._cell(ended)

        def added(samples: Float[Array, "cells times ..."], values: Float[Array, "rows lanes ..."]) -> Array:
            return samples.at[cell[None], rows.sample].set(values, mode="drop", unique_indices=True)

        samples = jax.tree.map(added, collected.samples, self.read(cell, rows.state))
        return Collected(jnp.where(refilled.cell != ended.cell, self.first_in(refilled), sample), samples)

    def _cell(self, lane_state: LaneState) -> Int[Array, " lanes"]:
        return jnp.minimum(lane_state.cell, len(self.first) - 1)
