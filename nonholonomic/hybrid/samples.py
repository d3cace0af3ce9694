"""Hybrid runs sampled at given times: of many cells at once, and inside other transformations, with derivatives."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..derivatives import in_groups, tangents_by
from ..derivatives.sampling import AbstractSampling, ProblemSpec, solve_for_samples
from ..integration import Settings, solve_with_samples
from ..integration.status import REACHED_END
from ..xla_cpu import compiled_alone, greatest
from .ensemble import Carry, HybridOutcome, after_reset, after_solve, at_start, chosen, padded, traced_rounds
from .mode import AbstractBatchedMode, mode_of_cells, over_cells
from .path import BETWEEN
from .saltation import VariationalMode, variational_modes, variational_start
from .transition_rows import reset_with_rows

#: From some modules (scene, launch, ...), the tolerance and a number of cells to the modes, the index of the first mode
#: of every cell, and the initial states.
Build = Callable[[Any, Array, int], tuple[tuple[AbstractBatchedMode, ...], Array, Float[Array, "components cells"]]]


#: In the derivative of `HybridSamples`: the entries that have none.
UNCHANGED: Any = None


class HybridSamples(NamedTuple):
    """Hybrid runs at given times, all floats.

    - `shown`: the output rows, NaN after the end of the run; `number`: index of the mode at each time, or `BETWEEN`.
    - `end_time`, `end_state`, `end_mode`: when, where and in which mode the run ended; `status`: the status code.
    - `steps`, `rejected`; `counts`: the counters.

    **Example:** as for `hybrid_samples`.

    >>> from nonholonomic.hybrid import HybridSamples
    >>> HybridSamples._fields[:3]
    ('shown', 'number', 'end_time')
    """

    shown: Float[Array, "*cells shown times"]
    number: Float[Array, "*cells times"]
    end_time: Float[Array, "*cells"]
    end_state: Float[Array, "*cells components"]
    end_mode: Float[Array, "*cells"]
    status: Float[Array, "*cells"]
    steps: Float[Array, "*cells"]
    rejected: Float[Array, "*cells"]
    counts: Float[Array, "*cells kinds"]


def hybrid_samples(
    build: Build,
    modules: Any,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    counters: int,
) -> HybridSamples:
    """Run one cell through its modes inside a transformation and sample it, with derivatives that take part in
    step-size control. A batch under `vmap` is solved as one ensemble.

    **Arguments:**

    - `build`: function of the modules, the tolerance and the number of cells that returns the modes, the index of each
      cell's first mode, (cells,), and the starts, (components, cells). Functions are compared by identity, so do not
      create a new one for each call.
    - `modules`: the tree whose numbers, all scalars, are differentiable; there are no second derivatives.
    - `times`: times of the samples [s], increasing; `t1`: horizon [s]. Neither is differentiable.
    - `settings`: settings with an explicit Runge-Kutta solver; their tolerance may be traced.
    - `counters`: number of counters, the rows of `Transition.counts`.

    **Returns:** `HybridSamples`; the output rows and the end time have derivatives, NaN after a grazing event.

    **Raises:** `ValueError` for derivatives with respect to the times, and for second derivatives.

    **Example:** the height at 0.8 s, after a bounce, and its derivative with respect to the restitution: v (t - T) with
    the speed v at the ground, and the time T of the bounce.

    >>> from nonholonomic.hybrid import hybrid_samples
    >>> def build(restitution, tolerance, cells):
    ...     start = jnp.array([[1.0], [0.0]])
    ...     return (Bounce(restitution),), jnp.zeros(cells, int), jnp.broadcast_to(start, (2, cells))
    >>> def height(restitution):
    ...     return hybrid_samples(build, restitution, jnp.array([0.8]), jnp.asarray(1.0), settings, 1).shown[0, 0]
    >>> slope, speed = jax.grad(height)(0.6), np.sqrt(2 * 9.81)
    >>> print(f"{slope:.6f} {speed * (0.8 - speed / 9.81):.6f}")
    1.543558 1.543558
    """
    sampling = functools.partial(HybridSampling, counters=counters)
    return solve_for_samples(sampling, build, modules, _fixed(times), t1, settings)


@compiled_alone
def solve_hybrid_with_samples(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Array,
    state: Float[Array, "components cells"],
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    cells: Any,
    settings: Settings,
    *,
    counters: int,
    tangents: tuple[tuple[tuple[Any, ...], Any], ...] = (),
) -> tuple[HybridSamples, list[HybridSamples]]:
    """Run every cell through its modes to `t1`, or to where the model ends, and sample it.

    **Arguments:** as for `solve_hybrid`, and

    - `times`: times of the samples [s], strictly increasing, at least 0; (times,) for all cells or (times, cells).
    - `tangents`: as for `solve_hybrid_with_tangents`.

    **Returns:** `HybridSamples`, with the cells along the first axis, and their derivative along each tangent, in which
    only `shown` and `end_time` are present.

    **Example:** the heights of both balls at 0.8 s, after a bounce.

    >>> from nonholonomic.hybrid import solve_hybrid_with_samples
    >>> times = jnp.array([0.8])
    >>> samples, _ = solve_hybrid_with_samples(modes, first, start, times, 1.0, 2, settings, counters=1)
    >>> print(samples.shown[:, 0, 0].round(6), samples.number[:, 0])
    [0.330492 0.639204] [0. 0.]
    """
    built = (modes, jnp.asarray(mode), jnp.asarray(state))
    horizon = (jnp.asarray(times), jnp.asarray(t1))

    def run(group: tuple[Any, ...]) -> tuple[HybridSamples, list[HybridSamples]]:
        return _sampled_with_tangents(built, group, horizon, cells, settings, counters)

    return in_groups(run, tangents)


@eqx.filter_custom_jvp
def _fixed(times: Float[Array, " times"]) -> Float[Array, " times"]:
    """The times themselves, marked as not differentiable."""
    return times


@_fixed.def_jvp
def _refused(primals: Any, tangents: Any) -> Any:
    if tangents[0] is not None:
        raise ValueError(
            "derivatives with respect to times or t1 are not available for runs with resets; differentiate with respect to "
            "the start or the parameters"
        )
    return primals[0], jnp.zeros_like(primals[0])


class HybridSampling(AbstractSampling):
    """Samples of hybrid runs."""

    movable: int
    spec: ProblemSpec
    places: Any = eqx.field(static=True)
    counters: int = eqx.field(static=True)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> HybridSamples:
        numbers, horizon, settings, spec = self._parts(leaves)
        built = spec.built(numbers, settings.tolerance, cells)
        return _sampled_with_tangents(built, (), horizon, cells, settings, self.counters)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[HybridSamples, list[HybridSamples]]:
        if nested:
            raise ValueError(
                "second derivatives are not available through changes of mode; take differences of a gradient instead"
            )
        numbers, horizon, settings, spec = self._parts(leaves)

        def build(numbers: tuple[Array, ...], cells: int | None) -> Any:
            return spec.built(numbers, settings.tolerance, cells)

        built, tangents, gather = tangents_by(build, active, numbers, cells)

        def run(group: tuple[Any, ...]) -> tuple[HybridSamples, list[HybridSamples]]:
            hybrid_tangents = tuple((tangent[0], tangent[2]) for tangent in group)
            return _sampled_with_tangents(built, hybrid_tangents, horizon, cells, settings, self.counters)

        samples, slopes = in_groups(run, tangents)
        return samples, gather(slopes)

    def _parts(self, leaves: tuple[Array, ...]) -> tuple[tuple[Array, ...], tuple[Array, Array], Settings, ProblemSpec]:
        """The modules' numbers; times and horizon; the settings; and the spec."""
        numbers, (times, t1, tolerance), spec = self._sorted(leaves)
        # One tolerance serves the whole ensemble: the smallest of the batch.
        settings = spec.settings.with_tolerance(jnp.min(tolerance))
        return numbers, (times if times.ndim == 1 else times.T, t1), settings, spec


def _sampled_with_tangents(
    built: Any, tangents: tuple[Any, ...], horizon: tuple[Array, Array], cells: Any, settings: Settings, counters: int
) -> tuple[HybridSamples, list[HybridSamples]]:
    """The runs, and their derivative along each tangent."""
    (modes, first, state), (times, t1) = built, horizon
    size = state.shape[1]
    times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), size))
    variational = variational_modes(modes, tangents, settings.tolerance, False)
    start = at_start(jnp, first, variational_start(state, tangents), cells, counters + 1)
    ended, output = _rounds_with_samples(
        variational, start, times, jnp.broadcast_to(t1, (size,)), settings, 1 + len(tangents)
    )
    rows, variations = _output_rows(variational, output)
    return _as_samples(ended, output, rows, variations, times, len(state))


class Recorded(NamedTuple):
    """The samples so far: states of the modes, and their mode, NaN where still missing; the output rows between modes
    with their variations, the rows first, `None` if no mode records its path; and the time [s] of the first grazing
    event, infinite if there was none.
    """

    state: Float[Array, "components times cells"]
    number: Float[Array, "times cells"]
    between: Float[Array, "values shown times cells"] | None
    grazing_time: Float[Array, " cells"]


def _rounds_with_samples(
    modes: tuple[VariationalMode, ...],
    start: HybridOutcome[Array],
    times: Float[Array, "times cells"],
    t1: Float[Array, " cells"],
    settings: Settings,
    n_blocks: int,
) -> Carry:
    """Run round by round, as in `traced_solve_hybrid`, with samples of every mode and of the transition to the next."""
    size = times.shape[1]

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[Array, " cells"]) -> Carry:
        def solved() -> Carry:
            (runs, output), cell = carry, padded(active)
            mode = mode_of_cells(mode_numbered(modes, numbers, runs.mode), cell)
            # Runs in another mode spend no time in this one.
            left = jnp.where(active, greatest(t1 - runs.end_time, 0.0), 0.0)
            times_in_mode = times - runs.end_time
            outcome, samples = solve_with_samples(
                mode.problem(runs.state[:, cell]),
                times_in_mode,
                left,
                jnp.asarray(size),
                settings,
                n_blocks=n_blocks,
                one_kernel=True,
            )
            after = chosen(active, after_solve(jnp, runs, outcome, t1), runs)
            is_new = active & (times_in_mode >= 0.0) & (times <= after.end_time) & jnp.isnan(output.number)
            state = jnp.where(is_new, jnp.moveaxis(samples, -1, 0).swapaxes(1, 2), output.state)
            return after, output._replace(state=state, number=jnp.where(is_new, runs.mode, output.number))

        return jax.lax.cond(jnp.any(active), solved, lambda: carry)

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " cells"]) -> Carry:
        def after_transition() -> Carry:
            (runs, output), cell = carry, padded(lost)
            transition, rows = _reset(numbers, runs, cell)
            after = chosen(lost, after_reset(jnp, runs, transition, t1), runs)
            if rows is not None:
                assert output.between is not None
                is_new = lost & (times > runs.end_time) & (times <= after.end_time) & jnp.isnan(output.number)
                output = output._replace(
                    between=jnp.where(is_new, rows, output.between), number=jnp.where(is_new, BETWEEN, output.number)
                )
            grazes = after.counts[-1] > runs.counts[-1]
            grazing_time = jnp.where(grazes, jnp.minimum(output.grazing_time, runs.end_time), output.grazing_time)
            return after, output._replace(grazing_time=grazing_time)

        return jax.lax.cond(jnp.any(lost), after_transition, lambda: carry)

    def _reset(numbers: Sequence[int], runs: HybridOutcome[Array], cell: Array) -> tuple[Any, Array | None]:
        """The transition of some cells, and its output rows with their variations."""

        def with_rows(mode: AbstractBatchedMode, state: Array, left: Array) -> Any:
            # If the event happens later, less time passes from the event to a fixed time, and to the horizon.
            return reset_with_rows(mode, state, left, times[:, cell] - t1[cell] + left, t1[cell])

        mode: Any = mode_of_cells(mode_numbered(modes, numbers, runs.mode), cell)
        left = greatest(t1[cell] - runs.end_time[cell], 0.0)
        transition, rows, variations = mode.reset_with_path(runs.state[:, cell], left, with_rows)
        return transition, None if rows is None else jnp.concatenate([rows[None], variations])

    groups = program_groups(modes)
    rows = [jax.eval_shape(functools.partial(_reset, group), start, jnp.arange(size))[1] for group in groups]
    between = next((jnp.zeros(shape.shape) for shape in rows if shape is not None), None)
    missing = jnp.full((len(start.state), *times.shape), jnp.nan)
    empty = Recorded(missing, missing[0], between, jnp.full(size, jnp.inf))
    return traced_rounds((start, empty), groups, solve, reset)


def _output_rows(
    modes: tuple[VariationalMode, ...], output: Recorded
) -> tuple[Float[Array, "shown times cells"], Float[Array, "tangents shown times cells"]]:
    """The output rows, NaN where a sample is missing, and their variations."""

    def of_mode(mode: VariationalMode, states: Float[Array, "components times"]) -> Any:
        return mode.output_rows(states)

    rows = jax.tree.map(jnp.full_like, jax.eval_shape(over_cells(of_mode, modes[0]), output.state), (jnp.nan, 0.0))
    for number, mode in enumerate(modes):
        of_this = over_cells(of_mode, mode)(output.state)
        rows = jax.tree.map(functools.partial(jnp.where, output.number == number), of_this, rows)
    if output.between is not None:
        between = (output.between[0], output.between[1:])
        rows = jax.tree.map(functools.partial(jnp.where, output.number == BETWEEN), between, rows)
    return rows


def program_groups(modes: tuple[AbstractBatchedMode, ...]) -> list[tuple[int, ...]]:
    """The indices of the modes, in groups. The modes of a group differ only in the values of their arrays, so they
    share a program."""
    groups: list[list[int]] = []
    for number, mode in enumerate(modes):
        shape = _shape(mode)
        group = next((group for group in groups if eqx.tree_equal(_shape(modes[group[0]]), shape)), None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return [tuple(group) for group in groups]


def _shape(mode: AbstractBatchedMode) -> Any:
    """A mode with the shapes of its arrays in place of their values."""
    return jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)) if eqx.is_array(leaf) else leaf, mode)


def mode_numbered(modes: tuple[VariationalMode, ...], numbers: Sequence[int], selected: Array) -> Any:
    """The mode numbered `selected` in one of the `program_groups`."""
    mode = modes[numbers[0]]
    for number in numbers[1:]:

        def leaf(old: Any, new: Any, number: int = number) -> Any:
            return old if old is new or not eqx.is_array(old) else jnp.where(selected == number, new, old)

        mode = jax.tree.map(leaf, mode, modes[number])
    return mode


def _as_samples(
    ended: HybridOutcome[Array],
    output: Recorded,
    rows: Float[Array, "shown times cells"],
    variations: Float[Array, "tangents shown times cells"],
    times: Float[Array, "times cells"],
    size: int,
) -> tuple[HybridSamples, list[HybridSamples]]:
    """The samples, and their derivative along each tangent."""
    grazes = ended.counts[-1] > 0
    invalid = jnp.where(times > output.grazing_time, jnp.nan, 0.0)
    counters_and_codes = (ended.mode, ended.status, ended.steps, ended.rejected, ended.counts[:-1])
    parts = (rows, output.number, ended.end_time, ended.state[:size], *counters_and_codes)
    samples = HybridSamples(*(jnp.moveaxis(part.astype(float), -1, 0) for part in parts))

    def slope(k: int, rows: Float[Array, "shown times cells"]) -> HybridSamples:
        # The variation of the time follows that of the state; a horizon does not move.
        delay = jnp.where(grazes, jnp.nan, ended.state[(k + 1) * (size + 1) + size])
        delay = jnp.where(ended.status == REACHED_END, 0.0, delay)
        return HybridSamples(jnp.moveaxis(rows + invalid, -1, 0), UNCHANGED, delay, *(UNCHANGED,) * 6)

    return samples, [slope(k, part) for k, part in enumerate(variations)]
