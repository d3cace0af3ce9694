"""The periods of an ensemble solve that are kept for its adjoint: where some of them begin and end, and the steps of the
latest ones.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..integration.scheduler import SchedulerState
from ..xla_cpu import written_in_place

#: Number of checkpoints. With more periods, some checkpoints are dropped and computed again from an earlier one. With
#: the 64 lanes of a CPU the checkpoints take 3 MB, with the 32768 of an accelerator 1.5 GB.
KEPT = 64

#: Number of steps that are kept for each cell, on average, and the memory [bytes] that all of them may take.
STEPS_KEPT, MOST_KEPT = 1024, {"cpu": 1 << 26}


class StepRecord(NamedTuple):
    """The steps of a period: where each step began, and its length, 0 for a lane that did not move."""

    time: Float[Array, "iterations lanes"]
    state: Float[Array, "iterations components lanes"]
    length: Float[Array, "iterations lanes"]


class Period(NamedTuple):
    """A period without its steps: the lanes before it, and after it but before their refill."""

    before: SchedulerState
    after: SchedulerState


class Checkpoints(NamedTuple):
    """Some of the periods, the earliest first.

    There are `depth` of them; `index` holds their numbers, `slot` their places in `periods`.
    """

    depth: Int[Array, ""]
    index: Int[Array, " slots"]
    slot: Int[Array, " slots"]
    periods: Period

    @classmethod
    def none(cls, like: Period) -> "Checkpoints":
        """No periods. **Arguments:** `like`: a period, for the shapes."""
        room = jax.tree.map(lambda leaf: jnp.zeros((KEPT, *leaf.shape), leaf.dtype), like)
        return cls(jnp.zeros((), int), jnp.zeros(KEPT, int), jnp.arange(KEPT), room)

    def latest(self) -> tuple[Int[Array, ""], Period]:
        """The latest period, and its number."""
        last = self.depth - 1
        return self.index[last], jax.tree.map(functools.partial(read, at=self.slot[last]), self.periods)

    def without_latest(self) -> "Checkpoints":
        """All but the latest period."""
        return self._replace(depth=self.depth - 1)

    def added(self, index: Int[Array, ""], period: Period) -> "Checkpoints":
        """Add a period; if all slots are full, drop the period whose neighbours are closest."""
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
        room = jax.tree.map(functools.partial(written_in_place, at=free), self.periods, period)
        return Checkpoints(jnp.minimum(self.depth + 1, KEPT), indices, slots, room)


class LatestSteps(NamedTuple):
    """The steps of all iterations from number `since` on, in a ring with room for a period beyond its end."""

    since: Int[Array, ""]
    ring: StepRecord

    @classmethod
    def none(cls, like: StepRecord, cells: int) -> "LatestSteps":
        """No steps. **Arguments:** `like`: the steps of a period, for the shapes; `cells`: number of cells."""
        period, lanes = like.length.shape
        each = sum(leaf.dtype.itemsize * leaf.size for leaf in like) // period
        most = MOST_KEPT.get(jax.default_backend(), 1 << 31) // each
        size = period + max(period, min(most, STEPS_KEPT * -(-cells // lanes)))
        room = StepRecord(*(jnp.zeros((size, *leaf.shape[1:]), leaf.dtype) for leaf in like))
        return cls(jnp.zeros((), int), room)

    def added(self, first: Int[Array, ""], steps: StepRecord) -> "LatestSteps":
        """Add the steps of a period that begins with iteration number `first`."""
        period = len(steps.length)
        size = len(self.ring.length) - period

        def written(whole: Array, rows: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(whole, rows, first % size, 0)

        since = jnp.maximum(self.since, first + period - size)
        return LatestSteps(since, jax.tree.map(written, self.ring, steps))

    def of_period(self, first: Int[Array, ""], period: int) -> StepRecord:
        """The steps of a period that begins with iteration number `first`."""
        at = first % (len(self.ring.length) - period)
        return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, at, period), self.ring)


def read(whole: Array, at: Int[Array, ""]) -> Array:
    """One of the arrays stacked in another."""
    return jax.lax.dynamic_index_in_dim(whole, at, 0, keepdims=False)
