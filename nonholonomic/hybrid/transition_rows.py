"""Output rows of runs between two modes, at given times, for many cells at once."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .mode import AbstractBatchedMode, AbstractHoppingMode, Transition, TransitionPath, over_cells

#: A sample this much later than the last stretch of a transition, as a fraction of the horizon, still belongs to it.
ROUND_OFF = 1e-13


def reset_with_rows(
    mode: AbstractBatchedMode,
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
    times: Float[Array, "times cells"],
    t1: Float[Array, " cells"],
    weights: Float[Array, "shown times cells"] | None = None,
) -> tuple[Transition, Array | None]:
    """The transition to the next mode, and the output rows on the way.

    **Arguments:** `state`, `left`: as for `AbstractBatchedMode.reset_map`; `times`: the times of the samples [s],
    counted from the end of the mode; `t1`: horizon [s]; `weights`: factors of the rows, if only a sum of them is needed.

    **Returns:** the `Transition`, and the rows, which are meaningless at times outside the transition, or with `weights`
    their weighted sum in every cell; `None` if the mode records no path.
    """
    if isinstance(mode, AbstractHoppingMode):
        return _hops_with_rows(mode, state, left, times, ROUND_OFF * t1, weights)
    transition = mode.reset_map(state, left)
    if transition.record is None:
        return transition, None
    rows = over_cells(_rows_of_path, mode)(transition.record, times)
    return transition, rows if weights is None else jnp.sum(weighted(weights, rows), axis=(0, 1))


def weighted(weights: Float[Array, "..."], values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Values times their weights; a value without a weight may be anything."""
    return jnp.where(weights == 0.0, 0.0, weights * values)


def _rows_of_path(
    mode: AbstractBatchedMode, record: TransitionPath, times: Float[Array, " times"]
) -> Float[Array, "shown times"]:
    """The output rows of one cell; after the last stretch they are meaningless."""
    ends = record.ends
    stretch = jnp.minimum(jnp.searchsorted(jax.lax.stop_gradient(ends), jax.lax.stop_gradient(times)), len(ends) - 1)
    start_time = jnp.where(stretch > 0, ends[jnp.maximum(stretch - 1, 0)], 0.0)
    motions = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[stretch], 0, -1), record.motions)
    return mode.between(motions, jnp.where(jnp.isfinite(start_time), times - start_time, 0.0))


class Hops(NamedTuple):
    """A succession of stretches: the current one, the number of stretches so far, the output rows or their weighted sum,
    and the index of the next sample in every cell."""

    stretch: Any
    count: Int[Array, ""]
    rows: Float[Array, "*shown_times cells"]
    sample: Int[Array, " cells"]


def _hops_with_rows(
    mode: AbstractHoppingMode,
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
    times: Float[Array, "times cells"],
    slack: Float[Array, " cells"],
    weights: Float[Array, "shown times cells"] | None,
) -> tuple[Transition, Float[Array, "*shown_times cells"]]:
    """The stretches one by one, each with the samples inside it. No path is kept, whose length is not known."""
    cells = jnp.arange(len(left))

    def with_values(rows: Array, row: Int[Array, " cells"], values: Float[Array, "shown cells"]) -> Array:
        if weights is None:
            return rows.at[:, row, cells].set(values, mode="drop", unique_indices=True)
        factors = weights.at[:, row, cells].get(mode="fill", fill_value=0.0)
        return rows + jnp.sum(weighted(factors, values), axis=0)

    def hop(hops: Hops) -> Hops:
        stretch, count, rows, sample = hops
        end, following = mode.hop(stretch, left)
        motion = mode.motion_in(stretch)
        # Rounding may put the end of the last stretch before a sample at the end of the transition.
        reach = end.elapsed + jnp.where(following.open, 0.0, slack)

        def next_time(sample: Int[Array, " cells"]) -> Float[Array, " cells"]:
            time = times[jnp.minimum(sample, len(times) - 1), cells]
            return jnp.where(sample < len(times), time, jnp.inf)

        def is_inside(sample: Int[Array, " cells"]) -> Bool[Array, " cells"]:
            return stretch.open & (next_time(sample) <= reach)

        def filled(carry: tuple[Array, Array]) -> tuple[Array, Array]:
            rows, sample = carry
            inside = is_inside(sample)
            passed = jnp.where(inside, next_time(sample) - stretch.elapsed, 0.0)
            row = jnp.where(inside, sample, len(times))
            return with_values(rows, row, mode.between(motion, passed)), sample + inside

        rows, sample = jax.lax.while_loop(lambda carry: jnp.any(is_inside(carry[1])), filled, (rows, sample))
        return Hops(following, count + 1, rows, sample)

    def goes_on(hops: Hops) -> Bool[Array, ""]:
        return jnp.any(hops.stretch.open) & (hops.count < mode.most_hops)

    start = mode.lost(state)
    row = jax.eval_shape(mode.between, mode.motion_in(start), start.elapsed)
    rows = jnp.zeros((len(row), *times.shape) if weights is None else left.shape)
    hops = Hops(start, jnp.zeros((), int), rows, jnp.sum(times <= 0.0, axis=0))
    hops = jax.lax.while_loop(goes_on, hop, hops)
    return mode.closed(hops.stretch), hops.rows
