"""Hybrid runs of many cells with samples at given times: the states in the modes, and the output rows between two modes."""

import functools
from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.components import over_cells
from ..compilation.xla_cpu import compiled_alone
from ..derivatives import SampledRun, in_groups
from ..integration import Lanes, Settings, States, solve_with_samples
from ..integration.problem import LEFT_DOMAIN, REACHED_END
from ..integration.scheduler import of_cells
from .ensemble import (
    BETWEEN,
    AbstractBatchedMode,
    AbstractHoppingMode,
    Advance,
    Carry,
    Count,
    HybridOutcome,
    Modes,
    Transition,
    TransitionPath,
    after_reset,
    after_solve,
    all_rounds,
    at_start,
    mode_numbered,
    program_groups,
    resolution,
    time_left,
)
from .saltation import Tangents, VariationalMode, with_variations

#: The runs of many cells; and the modes, the index of the first mode of every cell, and the initial states.
Runs: TypeAlias = HybridOutcome[Array]
Built = tuple[Modes, Int[Array, " cells"], States]

#: The times of samples in every cell [s]; and the factors of the output rows there, if only a sum of them is needed.
CellTimes = Float[Array, "times cells"]
Weights = Float[Array, "shown times cells"] | None

# Output rows of runs between two modes, at given times, for many cells at once.

#: A sample this much later than the last stretch of a transition, as a fraction of the horizon, still belongs to it.
ROUND_OFF = 1e-13


def reset_with_rows(
    mode: AbstractBatchedMode, state: States, left: Lanes, times: CellTimes, t1: Lanes, weights: Weights = None
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


def _hops_with_rows(
    mode: AbstractHoppingMode, state: States, left: Lanes, times: CellTimes, slack: Lanes, weights: Weights
) -> tuple[Transition, Float[Array, "*shown_times cells"]]:
    """The stretches one by one, each with the samples inside it. No path is kept, whose length is not known."""
    cells = jnp.arange(len(left))

    def with_values(rows: Array, row: Int[Array, " cells"], values: Float[Array, "shown cells"]) -> Array:
        if weights is None:
            return rows.at[:, row, cells].set(values, mode="drop", unique_indices=True)
        factors = weights.at[:, row, cells].get(mode="fill", fill_value=0.0)
        return rows + jnp.sum(weighted(factors, values), axis=0)

    def next_time(sample: Int[Array, " cells"]) -> Lanes:
        time = times[jnp.minimum(sample, len(times) - 1), cells]
        return jnp.where(sample < len(times), time, jnp.inf)

    def with_samples(
        kept: tuple[Array, Int[Array, " cells"]], stretch: PyTree, end: PyTree, following: PyTree
    ) -> tuple[Array, Int[Array, " cells"]]:
        """The output rows or their sum, and the index of the next sample in every cell, after a stretch."""
        motion = mode.motion_in(stretch)
        # Rounding may put the end of the last stretch before a sample at the end of the transition.
        reach = end.elapsed + jnp.where(following.open, 0.0, slack)

        def is_inside(sample: Int[Array, " cells"]) -> Bool[Array, " cells"]:
            return stretch.open & (next_time(sample) <= reach)

        def filled(kept: tuple[Array, Array]) -> tuple[Array, Array]:
            rows, sample = kept
            inside = is_inside(sample)
            passed = jnp.where(inside, next_time(sample) - stretch.elapsed, 0.0)
            row = jnp.where(inside, sample, len(times))
            return with_values(rows, row, mode.between(motion, passed)), sample + inside

        return jax.lax.while_loop(lambda kept: jnp.any(is_inside(kept[1])), filled, kept)

    start = mode.lost(state)
    row = jax.eval_shape(mode.between, mode.motion_in(start), start.elapsed)
    rows = jnp.zeros((len(row), *times.shape) if weights is None else left.shape)
    stretch, (rows, _) = mode.all_hops(start, left, (rows, jnp.sum(times <= 0.0, axis=0)), with_samples)
    return mode.closed(stretch), rows


# The rounds of hybrid runs with samples at given times, and the output rows of the samples.


class Recorded(NamedTuple):
    """The samples so far: states of the modes, and their mode, NaN where still missing; the output rows between modes
    with their variations, the rows first, `None` if no mode records its path; and the time [s] of the first grazing
    event, infinite if there was none.
    """

    state: Float[Array, "components times cells"]
    number: Float[Array, "times cells"]
    between: Float[Array, "values shown times cells"] | None
    grazing_time: Lanes


def sampled_rounds(
    modes: tuple[VariationalMode, ...], start: Runs, times: CellTimes, t1: Lanes, settings: Settings, n_blocks: int
) -> tuple[Carry, list[tuple[int, ...]], Advance, Advance]:
    """The rounds of `solve_hybrid` with samples of every mode and of the transition to the next.

    **Returns:** the arguments of `all_rounds`; the carry is a `HybridOutcome` and the `Recorded` samples.
    """

    def solve(numbers: Sequence[int], cell: Int[Array, " cells"], count: Int[Array, ""], carry: Carry) -> Carry:
        (runs, output), times_here, horizon = carry, times[:, cell], t1[cell]
        mode = mode_numbered(of_cells(modes, cell), numbers, runs.mode)
        times_in_mode = times_here - runs.end_time
        problem, left = mode.problem(runs.state), time_left(runs, horizon)
        options = {"n_blocks": n_blocks, "one_kernel": True}
        outcome, samples = solve_with_samples(problem, times_in_mode, left, count, settings, **options)
        after = after_solve(runs, outcome, horizon)
        # A sample at the time of a reset is the state before it.
        is_last = abs(times_here - after.end_time) <= resolution(runs.end_time, after.end_time)
        is_last &= outcome.status == LEFT_DOMAIN
        samples = jnp.moveaxis(samples, -1, 0).swapaxes(1, 2)
        samples = jnp.where(is_last, outcome.state[:, None], samples)
        is_within = (times_in_mode >= 0.0) & (times_here <= after.end_time)
        is_new = (is_within | is_last) & jnp.isnan(output.number)
        state = jnp.where(is_new, samples, output.state)
        return after, output._replace(state=state, number=jnp.where(is_new, runs.mode, output.number))

    def reset(numbers: Sequence[int], cell: Int[Array, " cells"], _: Int[Array, ""], carry: Carry) -> Carry:
        (runs, output), times_here = carry, times[:, cell]
        transition, rows = _reset(numbers, cell, runs)
        after = after_reset(runs, transition, t1[cell])
        if rows is not None:
            is_new = (times_here > runs.end_time) & (times_here <= after.end_time) & jnp.isnan(output.number)
            between, number = jnp.where(is_new, rows, output.between), jnp.where(is_new, BETWEEN, output.number)
            output = output._replace(between=between, number=number)
        grazes = after.counts[-1] > runs.counts[-1]
        grazing_time = jnp.where(grazes, jnp.minimum(output.grazing_time, runs.end_time), output.grazing_time)
        return after, output._replace(grazing_time=grazing_time)

    def _reset(numbers: Sequence[int], cell: Int[Array, " cells"], runs: Runs) -> tuple[Transition, Array | None]:
        """The transition of some cells, and its output rows with their variations."""
        horizon = t1[cell]

        def with_rows(mode: AbstractBatchedMode, state: States, left: Lanes) -> tuple[Transition, Array | None]:
            # If the event happens later, less time passes from the event to a fixed time, and to the horizon.
            return reset_with_rows(mode, state, left, times[:, cell] - horizon + left, horizon)

        mode = mode_numbered(of_cells(modes, cell), numbers, runs.mode)
        transition, rows, variations = mode.reset_with_path(runs.state, time_left(runs, horizon), with_rows)
        return transition, None if rows is None else jnp.concatenate([rows[None], variations])

    groups, size = program_groups(modes), times.shape[1]
    rows = [jax.eval_shape(functools.partial(_reset, group), jnp.arange(size), start)[1] for group in groups]
    between = next((jnp.zeros(shape.shape) for shape in rows if shape is not None), None)
    missing = jnp.full((len(start.state), *times.shape), jnp.nan)
    empty = Recorded(missing, missing[0], between, jnp.full(size, jnp.inf))
    return (start, empty), groups, solve, reset


def output_rows(
    modes: tuple[VariationalMode, ...], output: Recorded
) -> tuple[Float[Array, "shown times cells"], Float[Array, "tangents shown times cells"]]:
    """The output rows, NaN where a sample is missing, and their variations."""
    shapes = jax.eval_shape(over_cells(VariationalMode.output_rows, modes[0]), output.state)
    rows = jax.tree.map(jnp.full_like, shapes, (jnp.nan, 0.0))
    for number, mode in enumerate(modes):
        of_this = over_cells(VariationalMode.output_rows, mode)(output.state)
        rows = jax.tree.map(functools.partial(jnp.where, output.number == number), of_this, rows)
    if output.between is not None:
        between = (output.between[0], output.between[1:])
        rows = jax.tree.map(functools.partial(jnp.where, output.number == BETWEEN), between, rows)
    return rows


@compiled_alone
def solve_hybrid_with_samples(
    modes: Modes,
    mode: Int[Array, " cells"],
    state: States,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: Count,
    settings: Settings,
    *,
    counters: int,
    tangents: Tangents = (),
) -> tuple[SampledRun, list[SampledRun]]:
    """Run every cell through its modes to `t1`, or to where the model ends, and sample it.

    **Arguments:** as for `solve_hybrid`, and

    - `times`: times of the samples [s], strictly increasing, at least 0; (times,) for all cells or (times, cells).
    - `tangents`: as for `solve_hybrid_with_tangents`.

    **Returns:** a `SampledRun`, with the cells along the first axis, and its derivative along each tangent.

    **Example:** the heights of both balls at 0.8 s, after a bounce.

    >>> from nonholonomic.hybrid import solve_hybrid_with_samples
    >>> times = jnp.array([0.8])
    >>> samples, _ = solve_hybrid_with_samples(modes, first, start, times, 1.0, 2, settings, counters=1)
    >>> print(samples.states[:, 0, 0].round(6), samples.number[:, 0])
    [0.330492 0.639204] [0. 0.]
    """
    built = (modes, jnp.asarray(mode), jnp.asarray(state))
    return sampled_with_tangents(built, tangents, (jnp.asarray(times), jnp.asarray(t1)), cells, settings, counters)


def sampled_with_tangents(
    built: Built, tangents: Tangents, horizon: tuple[Array, Array], cells: Count, settings: Settings, counters: int
) -> tuple[SampledRun, list[SampledRun]]:
    """The runs, and their derivative along each tangent."""
    (modes, first, state), (times, t1) = built, horizon
    size, runs = state.shape
    times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), runs))

    def run(group: Tangents) -> tuple[SampledRun, list[SampledRun]]:
        variational, states = with_variations(modes, state, group, settings.tolerance, False)
        start = at_start(first, states, cells, counters + 1)
        rounds = sampled_rounds(variational, start, times, jnp.broadcast_to(t1, (runs,)), settings, 1 + len(group))
        ended, output = all_rounds(*rounds)
        rows, variations = output_rows(variational, output)
        grazes = ended.counts[-1] > 0
        invalid = jnp.where(times > output.grazing_time, jnp.nan, 0.0)
        counts = (ended.steps, ended.rejected, ended.extremes, output.number, ended.mode, ended.counts[:-1])
        parts = (ended.end_time, ended.state[:size], ended.status, *counts)
        others = (jnp.moveaxis(part.astype(float), -1, 0) for part in parts)
        samples = SampledRun(rows.T, None, *others)
        slopes = []
        for k, variation in enumerate(variations):
            # The variation of the time follows that of the state; a horizon does not move.
            delay = jnp.where(grazes, jnp.nan, ended.state[(k + 1) * (size + 1) + size])
            delay = jnp.where(ended.status == REACHED_END, 0.0, delay)
            slopes.append(SampledRun((variation + invalid).T, None, delay))
        return samples, slopes

    return in_groups(run, tangents)
