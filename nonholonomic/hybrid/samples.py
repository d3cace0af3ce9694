"""Hybrid runs of many cells with samples at given times, and the derivatives of a sum over the samples with respect to any
number of parameters, by one backward pass.

A sample is the state in a mode, or the output rows between two modes. The runs are computed round by round, and some rounds
are kept as checkpoints. The backward pass takes the rounds in reverse: the transpose of the saltation matrix carries the
cotangents through every reset (`saltation.py`), and the adjoint of the motion carries them through the mode
(`derivatives/adjoint.py`). The motion is repeated from its start for the time that it lasted, so that no event is located
again. The cost does not depend on the number of parameters where the reset map has a transpose; other reset maps are
differentiated along every number of their mode. The memory is that of the samples, of the checkpoints, and of the adjoint of
one mode.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.components import over_cells
from ..compilation.xla_cpu import compiled_alone
from ..derivatives.adjoint import SampledCotangents, mixture, samples_pulled_back, there_and_back
from ..derivatives.differentiable import contracted
from ..derivatives.sampled_runs import AbstractSampling, Options, Sampled, SampledRun, solve_for_samples
from ..derivatives.variation import Tangent, by_active, in_groups, tangents_of, where_active, with_cells
from ..integration import AbstractProblem, Components, Jumps, Lanes, Settings, States, solve_with_samples
from ..integration.problem import LEFT_DOMAIN, REACHED_END, RUNNING
from ..integration.samples import Times
from ..integration.scheduler import of_cells
from . import ensemble
from .ensemble import BETWEEN, MOST_ROUNDS, AbstractBatchedMode, AbstractHoppingMode, Advance, Carry, HybridOutcome
from .saltation import Tangents, VariationalMode, along, moved_with_event, with_variations

#: The runs of many cells; and the modes, the index of the first mode of every cell, and the initial states.
Runs: TypeAlias = HybridOutcome[Array]
Built = tuple[ensemble.Modes, Int[Array, " cells"], States]

#: The times of samples in every cell [s]; and the factors of the output rows there, if only a sum of them is needed.
CellTimes = Float[Array, "times cells"]
Weights = Float[Array, "shown times cells"] | None

# Output rows of runs between two modes, at given times, for many cells at once.

#: A sample this much later than the last stretch of a transition, as a fraction of the horizon, still belongs to it.
ROUND_OFF = 1e-13


def reset_with_rows(
    mode: AbstractBatchedMode, state: States, left: Lanes, times: CellTimes, t1: Lanes, weights: Weights = None
) -> tuple[ensemble.Transition, Array | None]:
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
    mode: AbstractBatchedMode, record: ensemble.TransitionPath, times: Float[Array, " times"]
) -> Float[Array, "shown times"]:
    """The output rows of one cell; after the last stretch they are meaningless."""
    ends = record.ends
    stretch = jnp.minimum(jnp.searchsorted(stop_gradient(ends), stop_gradient(times)), len(ends) - 1)
    start_time = jnp.where(stretch > 0, ends[jnp.maximum(stretch - 1, 0)], 0.0)
    motions = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[stretch], 0, -1), record.motions)
    return mode.between(motions, jnp.where(jnp.isfinite(start_time), times - start_time, 0.0))


def _hops_with_rows(
    mode: AbstractHoppingMode, state: States, left: Lanes, times: CellTimes, slack: Lanes, weights: Weights
) -> tuple[ensemble.Transition, Float[Array, "*shown_times cells"]]:
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
        mode = ensemble.mode_numbered(of_cells(modes, cell), numbers, runs.mode)
        times_in_mode = times_here - runs.end_time
        problem, left = mode.problem(runs.state), ensemble.time_left(runs, horizon)
        options = {"n_blocks": n_blocks, "one_kernel": True}
        outcome, samples = solve_with_samples(problem, times_in_mode, left, count, settings, **options)
        after = ensemble.after_solve(runs, outcome, horizon)
        # A sample at the time of a reset is the state before it.
        is_last = abs(times_here - after.end_time) <= ensemble.resolution(runs.end_time, after.end_time)
        is_last &= outcome.status == LEFT_DOMAIN
        samples = jnp.moveaxis(samples, -1, 0).swapaxes(1, 2)
        samples = jnp.where(is_last, outcome.state[:, None], samples)
        is_within = (times_in_mode >= 0.0) & (times_here <= after.end_time)
        is_new = (is_within | is_last) & jnp.isnan(output.number)
        state = jnp.where(is_new, samples, output.state)
        return after, output._replace(state=state, number=jnp.where(is_new, runs.mode, output.number))

    def reset(numbers: Sequence[int], cell: Int[Array, " cells"], _: Int[Array, ""], carry: Carry) -> Carry:
        (runs, output), times_here, horizon = carry, times[:, cell], t1[cell]

        def with_rows(
            mode: AbstractBatchedMode, state: States, left: Lanes
        ) -> tuple[ensemble.Transition, Array | None]:
            # If the event happens later, less time passes from the event to a fixed time, and to the horizon.
            return reset_with_rows(mode, state, left, times_here - horizon + left, horizon)

        mode = ensemble.mode_numbered(of_cells(modes, cell), numbers, runs.mode)
        transition, rows, variations = mode.reset_with_path(runs.state, ensemble.time_left(runs, horizon), with_rows)
        after = ensemble.after_reset(runs, transition, horizon)
        if rows is not None:
            rows = jnp.concatenate([rows[None], variations])
            is_new = (times_here > runs.end_time) & (times_here <= after.end_time) & jnp.isnan(output.number)
            between, number = jnp.where(is_new, rows, output.between), jnp.where(is_new, BETWEEN, output.number)
            output = output._replace(between=between, number=number)
        grazes = after.counts[-1] > runs.counts[-1]
        grazing_time = jnp.where(grazes, jnp.minimum(output.grazing_time, runs.end_time), output.grazing_time)
        return after, output._replace(grazing_time=grazing_time)

    groups, size = ensemble.program_groups(modes), times.shape[1]
    missing, state = jnp.full((len(start.state), *times.shape), jnp.nan), modes[0].parts(start.state)[0][:-1]

    def records(mode: AbstractBatchedMode) -> bool:
        return isinstance(mode, AbstractHoppingMode) or jax.eval_shape(mode.reset_map, state, t1).record is not None

    between = None
    # The resets with their variations would have the same shapes, and take long to trace.
    if any(records(modes[group[0]].mode) for group in groups):
        shown, variations = jax.eval_shape(over_cells(VariationalMode.output_rows, modes[0]), missing)
        between = jnp.zeros((1 + len(variations), *shown.shape))
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
    modes: ensemble.Modes,
    mode: Int[Array, " cells"],
    state: States,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: ensemble.Count,
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
    built: Built,
    tangents: Tangents,
    horizon: tuple[Array, Array],
    cells: ensemble.Count,
    settings: Settings,
    counters: int,
) -> tuple[SampledRun, list[SampledRun]]:
    """The runs, and their derivative along each tangent."""
    (modes, first, state), (times, t1) = built, horizon
    size, runs = state.shape
    times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), runs))

    def run(group: Tangents) -> tuple[SampledRun, list[SampledRun]]:
        variational, states = with_variations(modes, state, group, settings.tolerance, False)
        start = ensemble.at_start(first, states, cells, counters + 1)
        rounds = sampled_rounds(variational, start, times, jnp.broadcast_to(t1, (runs,)), settings, 1 + len(group))
        ended, output = ensemble.all_rounds(*rounds)
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


# Samples of a run as a differentiable solve.

#: From some modules (scene, launch, ...), the tolerance and a number of cells to the modes, the index of the first mode
#: of every cell, and the initial states.
Build = Callable[[PyTree, Array, int], Built]

#: A number of the modes, or several.
Leaf = Float[Array, "... cells"]


#: Up to this many numbers, those of a single run are always integrated forward: the run waits for its program, not for its
#: steps, and the backward pass takes up to twice as long to compile.
MOST_FORWARD_ALONE = 32


def hybrid_samples(
    build: Build, modules: PyTree, times: Times, t1: Float[Array, ""], settings: Settings, counters: int
) -> SampledRun:
    """Run one cell through its modes inside a transformation and sample it, with derivatives that take part in
    step-size control. A batch under `vmap` is solved as one ensemble. The gradient of a function of its samples by many
    numbers takes one backward pass.

    **Arguments:**

    - `build`: function of the modules, the tolerance and the number of cells that returns the modes, the index of each
      cell's first mode, (cells,), and the starts, (components, cells). Functions are compared by identity, so do not
      create a new one for each call.
    - `modules`: the tree whose numbers, all scalars, are differentiable; there are no second derivatives.
    - `times`: times of the samples [s], increasing; `t1`: horizon [s]. Neither is differentiable.
    - `settings`: settings with an explicit Runge-Kutta solver; their tolerance may be traced.
    - `counters`: number of counters, the rows of `Transition.counts`.

    **Returns:** a `SampledRun`; the output rows and the end time have derivatives, NaN after a grazing event.

    **Raises:** `ValueError` for derivatives with respect to the times, and for second derivatives.

    **Example:** the height at 0.8 s, after a bounce, and its derivative with respect to the restitution: v (t - T) with
    the speed v at the ground, and the time T of the bounce.

    >>> from nonholonomic.hybrid import hybrid_samples
    >>> def build(restitution, tolerance, cells):
    ...     start = jnp.array([[1.0], [0.0]])
    ...     return (Bounce(restitution),), jnp.zeros(cells, int), jnp.broadcast_to(start, (2, cells))
    >>> def height(restitution):
    ...     return hybrid_samples(build, restitution, jnp.array([0.8]), jnp.asarray(1.0), settings, 1).states[0, 0]
    >>> slope, speed = jax.grad(height)(0.6), np.sqrt(2 * 9.81)
    >>> print(f"{slope:.6f} {speed * (0.8 - speed / 9.81):.6f}")
    1.543558 1.543558
    """
    sampling = functools.partial(HybridSampling, counters=counters)
    return solve_for_samples(sampling, build, modules, _fixed(times), t1, settings)


@eqx.filter_custom_jvp
def _fixed(times: Float[Array, " times"]) -> Float[Array, " times"]:
    """The times themselves, marked as not differentiable."""
    return times


@_fixed.def_jvp
def _refused(primals, tangents):
    if tangents[0] is not None:
        raise ValueError(
            "derivatives with respect to times or t1 are not available for runs with resets; differentiate with respect to "
            "the start or the parameters"
        )
    return primals[0], jnp.zeros_like(primals[0])


class HybridSampling(AbstractSampling):
    """Samples of hybrid runs."""

    counters: int = eqx.field(static=True)

    #: For 64 bouncing balls, the gradient by 3 and 5 numbers costs 6 and 7 values forward, and 6 backward; for 64 hopping
    #: tops, that by 10 numbers costs 24 forward and 12 backward (jax 0.10).
    most_forward = 6

    def built(self, modules: PyTree, tolerance: Array, cells: int | None) -> Built:
        return self.build(modules, tolerance, cells)

    def sampled(self, built: Built, tangents: tuple[Tangent, ...], options: Options, nested: bool) -> Sampled:
        if nested:
            raise ValueError("second derivatives do not exist through changes of mode; take differences of a gradient")
        tangents, settings = tuple((tangent[0], tangent[2]) for tangent in tangents), options[2]
        return sampled_with_tangents(built, tangents, options[:2], built[2].shape[1], settings, self.counters)

    def pull_back(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], cotangents: SampledRun
    ) -> list[Lanes]:
        if cells == 1 and len(active) <= MOST_FORWARD_ALONE:
            slopes = self.value_and_tangents(active, False, cells, *leaves)[1]
            return [jax.vmap(contracted)(slope, cotangents) for slope in slopes]
        build, numbers, (times, t1, settings, _), _ = self.builder(cells, leaves)
        rebuilt, point = by_active(build, active, numbers, cells)
        times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), cells))
        shown, end_time = cotangents.states, cotangents.end_time
        if shown is None:
            modes, _, state = rebuilt(*point)
            shown = jnp.zeros((cells, len(times), len(jax.eval_shape(modes[0].shown, state))))
        end_time = jnp.zeros(cells) if end_time is None else end_time
        options = (times, jnp.broadcast_to(t1, (cells,)), settings, self.counters)
        return hybrid_samples_pulled_back(rebuilt, point, shown.T, end_time, *options)


# The backward pass.


class EndlessProblem(AbstractProblem):
    """A problem without its event and without the end of its domain."""

    whole: AbstractProblem

    @property
    def fits_one_kernel(self) -> bool:
        return self.whole.fits_one_kernel

    def start(self) -> tuple[States, States]:
        return self.whole.start()

    def field(self, time: Lanes, state: Components) -> States:
        return self.whole.field(time, state)

    def domain_margin(self, time: Lanes, state: States) -> None:
        return None

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.whole.jumps(time, state)


class Costate(NamedTuple):
    """Derivatives of the sum with respect to the runs at the start of a round.

    - `state`: those by the state; `start_time`: those by the time at which the mode begins.
    - `numbers`: those by the moving numbers of every mode, from all later rounds.
    - `invalid`: whether a grazing event lies between the start of the round and a sample with a cotangent.
    """

    state: States
    start_time: Lanes
    numbers: list[list[Array]]
    invalid: Bool[Array, " cells"]


class Kept(NamedTuple):
    """What is kept of a round: the runs at its start, and at the ends of the modes before the resets; the status after the
    round; and whether the event there was grazing."""

    before: HybridOutcome[Array]
    ended: HybridOutcome[Array]
    status: Int[Array, " cells"]
    grazes: Bool[Array, " cells"]


def hybrid_samples_pulled_back(
    build: Callable[..., Built],
    point: tuple[Leaf, ...],
    shown: Float[Array, "shown times cells"],
    end_time: Lanes,
    times: Float[Array, "times cells"],
    t1: Lanes,
    settings: Settings,
    counters: int,
) -> list[Leaf]:
    """The cotangents of the numbers of hybrid runs from those of their samples.

    **Arguments:**

    - `build`: numbers -> modes, the index of the first mode of every cell, and the initial states; `point`: the numbers,
      with the cells last.
    - `shown`, `end_time`: the cotangents of the output rows, 0 where there is no sample, and of the times of the ends of
      the runs.
    - The others as for `solve_hybrid_with_samples`.

    **Returns:** the cotangents, in the shapes of the numbers; NaN in cells with a grazing event before a sample that
    matters, and in cells that fail with the steps of the backward pass.
    """
    modes, first, state = build(*point)
    tangent = tangents_of(lambda *point: build(*point)[::2], point, [tuple(mixture(point))])
    variational, states = with_variations(modes, state, tangent, settings.tolerance, False)
    cells = state.shape[1]
    start = ensemble.at_start(first, states, cells, counters + 1)
    (runs, output), groups, solve, reset = sampled_rounds(variational, start, times, t1, settings, 2)
    # At the start, only the output rows that the tangent moves count.
    initial = output._replace(state=states[:, None], number=first[None], between=None)
    _, (rate,) = output_rows(variational, initial)
    shown = jnp.where((times <= 0.0) & (rate == 0.0), 0.0, shown)

    # The samples so far, and the rounds that they belong to.
    def forward(number: Int[Array, ""], before: HybridOutcome[Array], recorded: Carry) -> tuple[PyTree, Kept, Carry]:
        output, owner = recorded
        (ended, _), (after, new_output) = ensemble.one_round((before, output), groups, solve, reset)
        is_new = jnp.isnan(output.number) & ~jnp.isnan(new_output.number)
        kept = Kept(before, ended, after.status, after.counts[-1] > before.counts[-1])
        return after, kept, (new_output, jnp.where(is_new, number, owner))

    def backward(number: Int[Array, ""], kept: Kept, recorded: Carry, costate: Costate) -> Costate:
        (output, owner), running = recorded, kept.before.status == RUNNING
        # The derivatives begin at the ends of the runs; a horizon does not move.
        ends = running & ((kept.status != RUNNING) | (number == MOST_ROUNDS - 1))
        by_end = jnp.where(kept.status == REACHED_END, 0.0, end_time)
        costate = costate._replace(start_time=jnp.where(ends, by_end, costate.start_time))
        stage = Round(variational, kept, output, owner == number, times, t1, shown)
        for group in groups:
            active = running & functools.reduce(jnp.logical_or, (kept.before.mode == mode for mode in group))
            lost = active & (kept.ended.status == LEFT_DOMAIN)
            (costate,) = ensemble.advanced(stage.through_reset, group, (costate,), lost)
            (costate,) = ensemble.advanced(functools.partial(stage.through_motion, settings), group, (costate,), active)
        return costate

    no_cells = jnp.zeros(cells, bool)
    none = [[jnp.zeros((*jnp.shape(leaf)[:-1], cells)) for leaf in mode.active_numbers()[0]] for mode in variational]
    costate = Costate(jnp.zeros_like(state), jnp.zeros(cells), none, no_cells)
    recorded, example = (output, jnp.full(times.shape, -1)), Kept(runs, runs, runs.status, no_cells)
    costate = there_and_back(
        (runs, example, recorded, costate),
        MOST_ROUNDS,
        lambda runs: jnp.any(runs.status == RUNNING),
        lambda kept, recorded: jnp.asarray(True),
        forward,
        backward,
    ).adjoint

    def numbers_and_start(*point: Leaf) -> PyTree:
        modes, _, state = build(*point)
        numbers = [jax.tree.leaves(where_active(mode, rate)) for mode, rate in zip(modes, tangent[0][0], strict=True)]
        return jax.tree.map(lambda number: with_cells(number, cells), numbers), state

    by_point = jax.vjp(numbers_and_start, *point)[1]((costate.numbers, costate.state))
    return [jnp.where(costate.invalid, jnp.nan, part) for part in by_point]


class Round(NamedTuple):
    """A round of some runs, for the backward pass. The arrays have the cells last.

    - `modes`: with a tangent that moves all numbers; `output`, `owned`: the samples, and those of the part.
    - `times`, `t1`: times of the samples and ends of the runs [s]; `shown`: the cotangents of the samples.
    """

    modes: tuple[VariationalMode, ...]
    kept: Kept
    output: Recorded
    owned: Bool[Array, "times cells"]
    times: Float[Array, "times cells"]
    t1: Lanes
    shown: Float[Array, "shown times cells"]

    def through_reset(
        self, group: Sequence[int], cell: Int[Array, " cells"], count: Int[Array, ""], carry: tuple[Costate]
    ) -> tuple[Costate]:
        """Carry the derivatives of some cells from the start of the next mode to the end of the mode."""
        (costate,), part = carry, of_cells(self, cell)
        numbers, _, build = part.mode(group)
        primal, duration = part.primal(part.kept.ended)
        left, by_time = ensemble.time_left(part.kept.ended, part.t1), costate.start_time
        weights = jnp.where(part.owned & (part.output.number == BETWEEN), part.shown, 0.0)

        def share(primal: States, start_time: Lanes, *numbers: Array) -> Array:
            """The share of the later run in the sum; the reset moves with the event (`saltation.py`)."""
            mode = build(*numbers)
            state, later = moved_with_event(mode.problem(primal), primal, duration)
            start_time = start_time + later
            left_then = left - start_time
            transition, rows = reset_with_rows(
                mode, state, left_then, part.times - part.t1 + left_then, part.t1, weights
            )
            by_end = weighted(by_time, start_time + transition.elapsed)
            total = by_end + jnp.sum(weighted(costate.state, transition.state), axis=0)
            return total if rows is None else total + rows

        matters = jnp.any(costate.state != 0.0, axis=0) | (by_time != 0.0) | jnp.any(weights != 0.0, axis=(0, 1))
        gradients = _gradients(share, (primal, jnp.zeros_like(duration), *numbers))
        by_primal, by_start_time, *by_numbers = (jnp.where(matters, gradient, 0.0) for gradient in gradients)
        invalid = costate.invalid | (matters & part.kept.grazes)
        return (Costate(by_primal, by_start_time, part.added(group, costate.numbers, by_numbers), invalid),)

    def through_motion(
        self,
        settings: Settings,
        group: Sequence[int],
        cell: Int[Array, " cells"],
        count: ensemble.Count,
        carry: tuple[Costate],
    ) -> tuple[Costate]:
        """Carry the derivatives of some cells from the end of the mode to its start."""
        (costate,), part = carry, of_cells(self, cell)
        before, ended, *_ = part.kept
        numbers, rates, build = part.mode(group)
        start, variation = (rows[:-1] for rows in part.modes[0].parts(before.state))
        duration = jnp.where(ended.status == REACHED_END, ensemble.time_left(before, part.t1), part.primal(ended)[1])
        duration = jnp.where(jnp.arange(len(cell)) < count, duration, 0.0)
        owned = part.owned & (part.output.number != BETWEEN)
        samples = jnp.where(owned, part.output.state[: len(start)], start[:, None])

        def rows(
            samples: Float[Array, "components times cells"], start_time: Float[Array, "times cells"], *numbers: Array
        ):
            def of_cell(mode: AbstractBatchedMode, states: Array, start_time: Array, duration: Array) -> Array:
                # If the mode begins later, the state has advanced less at the same time.
                rates = stop_gradient(mode.problem(states).field(duration, states))
                return mode.shown(states - rates * start_time)

            elapsed = jnp.broadcast_to(duration, start_time.shape)
            return over_cells(of_cell, build(*numbers))(samples, start_time, elapsed)

        pull = jax.vjp(rows, samples, jnp.zeros_like(part.times), *numbers)[1]
        by_samples, by_start_time, *by_numbers = pull(jnp.where(owned, part.shown, 0.0))
        by_samples, by_start_time = (jnp.where(owned, by, 0.0) for by in (by_samples, by_start_time))
        # Rounding may put a sample after the end of the mode.
        times_in_mode = part.times - before.end_time
        times_in_mode = jnp.where(owned, jnp.minimum(times_in_mode, duration), times_in_mode)
        at_end = jnp.where(ended.status == LEFT_DOMAIN, costate.state, 0.0)
        by_start, *by_problem = samples_pulled_back(
            lambda state, *numbers: EndlessProblem(build(*numbers).problem(state)),
            (start, *numbers),
            SampledCotangents(jnp.transpose(by_samples, (2, 1, 0)), jnp.zeros_like(duration), at_end),
            times_in_mode,
            duration,
            settings,
            [variation, *rates],
        )
        by_numbers = [one + other for one, other in zip(by_numbers, by_problem, strict=True)]
        start_time = costate.start_time + jnp.sum(by_start_time, axis=0)
        added = part.added(group, costate.numbers, by_numbers)
        return (costate._replace(state=by_start, start_time=start_time, numbers=added),)

    def primal(self, runs: HybridOutcome[Array]) -> tuple[States, Lanes]:
        """The states of the runs, and the time since their modes began."""
        state = self.modes[0].parts(runs.state)[0]
        return state[:-1], state[-1]

    def mode(self, group: Sequence[int]) -> tuple[list[Leaf], list[Array], Callable[..., AbstractBatchedMode]]:
        """The moving numbers of the modes, their rates, and the modes as a function of the numbers."""
        mode = ensemble.mode_numbered(self.modes, group, self.kept.before.mode)
        (numbers, build), (rates,) = mode.active_numbers(), mode.directions()
        sizes = len(self.t1)
        return [with_cells(leaf, sizes) for leaf in numbers], [with_cells(leaf, sizes) for leaf in rates], build

    def added(self, group: Sequence[int], numbers: list[list[Array]], shares: list[Array]) -> list[list[Array]]:
        """The derivatives with respect to the numbers of all modes, with the shares of this group."""

        def of_mode(number: int, sums: list[Array]) -> list[Array]:
            is_here = self.kept.before.mode == number
            return [total + jnp.where(is_here, share, 0.0) for total, share in zip(sums, shares, strict=True)]

        return [of_mode(number, sums) if number in group else sums for number, sums in enumerate(numbers)]


def _gradients(function: Callable[..., Lanes], point: tuple[Leaf, ...]) -> list[Leaf]:
    """The derivatives of a value in every cell with respect to the cell's numbers."""
    try:
        value, pull = jax.vjp(function, *point)
        return list(pull(jnp.ones_like(value)))
    except ValueError:
        # A loop without a fixed number of iterations has no transpose: one tangent for each number.
        zeros = tuple(jnp.zeros_like(number) for number in point)
        entries = [(k, index) for k, number in enumerate(point) for index in np.ndindex(number.shape[:-1])]
        tangents = [(*zeros[:k], zeros[k].at[index].set(1.0), *zeros[k + 1 :]) for k, index in entries]
        slopes = along(function, point, tangents)[1]
        sizes = np.cumsum([np.prod(number.shape[:-1], dtype=int) for number in point])[:-1]
        return [part.reshape(number.shape) for part, number in zip(jnp.split(slopes, sizes), point, strict=True)]
