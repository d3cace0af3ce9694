"""The periods of an ensemble solve that are kept for its adjoint: where some of them begin and end, and the steps of the
latest ones.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import written_in_place

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
Period = Any


class Checkpoints(NamedTuple):
    """Some of the periods, the earliest first.

    There are `depth` of them; `index` holds their numbers, `slot` their places in `periods`.
    """

    depth: Int[Array, ""]
    index: Int[Array, " slots"]
    slot: Int[Array, " slots"]
    periods: Period

    @classmethod
    def none(cls, example: Period) -> "Checkpoints":
        """No periods. **Arguments:** `example`: a period, for the shapes."""
        room = jax.tree.map(lambda leaf: jnp.zeros((SLOTS, *leaf.shape), leaf.dtype), example)
        return cls(jnp.zeros((), int), jnp.zeros(SLOTS, int), jnp.arange(SLOTS), room)

    def latest(self) -> tuple[Int[Array, ""], Period]:
        """The latest period, and its number."""
        last = self.depth - 1
        return self.index[last], jax.tree.map(functools.partial(read, index=self.slot[last]), self.periods)

    def without_latest(self) -> "Checkpoints":
        """All but the latest period."""
        return self._replace(depth=self.depth - 1)

    def added(self, index: Int[Array, ""], period: Period) -> "Checkpoints":
        """Add a period; if all slots are full, drop the period whose neighbours are closest."""
        position = jnp.arange(SLOTS)
        is_full = self.depth == SLOTS
        following = jnp.where(position == SLOTS - 1, index, jnp.roll(self.index, -1))
        gap = jnp.where(position == 0, jnp.iinfo(self.index.dtype).max, following - jnp.roll(self.index, 1))
        victim = jnp.where(is_full, jnp.argmin(gap), self.depth)
        free = self.slot[victim]
        shifts = is_full & (position >= victim)
        end = jnp.minimum(self.depth, SLOTS - 1)
        indices = jnp.where(shifts, jnp.roll(self.index, -1), self.index).at[end].set(index)
        slots = jnp.where(shifts, jnp.roll(self.slot, -1), self.slot).at[end].set(free)
        room = jax.tree.map(functools.partial(written_in_place, at=free), self.periods, period)
        return Checkpoints(jnp.minimum(self.depth + 1, SLOTS), indices, slots, room)


class LatestSteps(NamedTuple):
    """The steps of all iterations from number `first` on, in a ring with room for a period beyond its end."""

    first: Int[Array, ""]
    ring: StepRecord

    @classmethod
    def none(cls, example: StepRecord, cells: int) -> "LatestSteps":
        """No steps. **Arguments:** `example`: the steps of a period, for the shapes; `cells`: number of cells."""
        period, lanes = example.length.shape
        bytes_of_step = sum(leaf.dtype.itemsize * leaf.size for leaf in jax.tree.leaves(example)) // period
        max_steps = MAX_BYTES.get(jax.default_backend(), 1 << 31) // bytes_of_step
        size = period + max(period, min(max_steps, STEPS_KEPT * -(-cells // lanes)))
        room = jax.tree.map(lambda leaf: jnp.zeros((size, *leaf.shape[1:]), leaf.dtype), example)
        return cls(jnp.zeros((), int), room)

    def added(self, first: Int[Array, ""], steps: StepRecord) -> "LatestSteps":
        """Add the steps of a period that begins with iteration number `first`."""
        period = len(steps.length)
        size = len(self.ring.length) - period

        def written(stack: Array, rows: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(stack, rows, first % size, 0)

        oldest = jnp.maximum(self.first, first + period - size)
        return LatestSteps(oldest, jax.tree.map(written, self.ring, steps))

    def of_period(self, first: Int[Array, ""], period: int) -> StepRecord:
        """The steps of a period that begins with iteration number `first`."""
        start = first % (len(self.ring.length) - period)
        return jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, period), self.ring)


def read(stack: Array, index: Int[Array, ""]) -> Array:
    """One of the arrays stacked in another."""
    return jax.lax.dynamic_index_in_dim(stack, index, 0, keepdims=False)
