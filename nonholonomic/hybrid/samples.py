"""Single hybrid runs, sampled at given times inside other transformations, with their derivatives."""

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
from ..xla_cpu import greatest
from .ensemble import Carry, HybridOutcome, after_reset, after_solve, at_start, traced_rounds
from .mode import AbstractBatchedMode, TransitionPath
from .path import BETWEEN
from .saltation import VariationalMode, variational_modes, variational_start

#: From some modules (scene, launch, ...) and the tolerance to the modes of a single run, the number of the first mode,
#: and the initial state.
Build = Callable[[Any, Array], tuple[tuple[AbstractBatchedMode, ...], Array, Float[Array, "components 1"]]]


#: In the derivative of `HybridSamples`: the entries that have none.
UNCHANGED: Any = None


class HybridSamples(NamedTuple):
    """A hybrid run at given times, all floats.

    - `shown`: the output rows, NaN after the end of the run; `number`: index of the mode at each time, or `BETWEEN`.
    - `end_time`, `end_state`, `end_mode`: when, where and in which mode the run ended; `status`: the status code.
    - `steps`, `rejected`; `counts`: the counters.

    **Example:** as for `hybrid_samples`.

    >>> from nonholonomic.hybrid import HybridSamples
    >>> HybridSamples._fields[:3]
    ('shown', 'number', 'end_time')
    """

    shown: Float[Array, "shown times"]
    number: Float[Array, " times"]
    end_time: Float[Array, ""]
    end_state: Float[Array, " components"]
    end_mode: Float[Array, ""]
    status: Float[Array, ""]
    steps: Float[Array, ""]
    rejected: Float[Array, ""]
    counts: Float[Array, " kinds"]


def hybrid_samples(
    build: Build,
    modules: Any,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    counters: int,
) -> HybridSamples:
    """Run one cell through its modes inside a transformation and sample it, with derivatives that take part in
    step-size control.

    **Arguments:**

    - `build`: function of the modules and the tolerance that returns the modes of one cell, the index of the first
      mode, (1,), and the start, (components, 1). Functions are compared by identity, so do not create a new one for
      each call.
    - `modules`: the tree whose numbers are differentiable; there are no second derivatives.
    - `times`: times of the samples [s], increasing; `t1`: horizon [s]. Neither is differentiable.
    - `settings`: settings with an explicit Runge-Kutta solver; their tolerance may be traced.
    - `counters`: number of counters, the rows of `Transition.counts`.

    **Returns:** `HybridSamples`; the output rows and the end time have derivatives, NaN after a grazing event.

    **Raises:** `ValueError` for derivatives with respect to the times, and for second derivatives.

    **Example:** the height at 0.8 s, after a bounce, and its derivative with respect to the restitution: v (t - T) with
    the speed v at the ground, and the time T of the bounce.

    >>> from nonholonomic.hybrid import hybrid_samples
    >>> def build(restitution, tolerance):
    ...     return (Bounce(restitution),), jnp.zeros(1, int), jnp.array([[1.0], [0.0]])
    >>> def height(restitution):
    ...     return hybrid_samples(build, restitution, jnp.array([0.8]), jnp.asarray(1.0), settings, 1).shown[0, 0]
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
def _refused(primals: Any, tangents: Any) -> Any:
    if tangents[0] is not None:
        raise ValueError(
            "derivatives with respect to times or t1 are not available for runs with resets; differentiate with respect to "
            "the start or the parameters"
        )
    return primals[0], jnp.zeros_like(primals[0])


class HybridSampling(AbstractSampling):
    """Samples of a hybrid run."""

    in_blocks = False

    movable: int
    spec: ProblemSpec
    places: Any = eqx.field(static=True)
    counters: int = eqx.field(static=True)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> HybridSamples:
        numbers, (*horizon, tolerance), spec = self._sorted(leaves)
        settings = spec.settings.with_tolerance(tolerance)
        samples, _ = _sampled_with_tangents(spec.built(numbers, tolerance), (), horizon, settings, self.counters)
        return jax.tree.map(lambda part: part[None], samples)

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[HybridSamples, list[HybridSamples]]:
        if nested:
            raise ValueError(
                "second derivatives are not available through changes of mode; take differences of a gradient instead"
            )
        numbers, (*horizon, tolerance), spec = self._sorted(leaves)
        settings = spec.settings.with_tolerance(tolerance)

        def build(numbers: tuple[Array, ...], cells: int | None) -> Any:
            return spec.built(numbers, tolerance)

        built, tangents, gather = tangents_by(build, active, numbers, None)

        def run(group: tuple[Any, ...]) -> tuple[HybridSamples, list[HybridSamples]]:
            return _sampled_with_tangents(
                built, tuple((tangent[0], tangent[2]) for tangent in group), horizon, settings, self.counters
            )

        samples, slopes = in_groups(run, tangents)
        return jax.tree.map(lambda part: part[None], (samples, gather(slopes)))


def _sampled_with_tangents(
    built: Any, tangents: tuple[Any, ...], horizon: Sequence[Array], settings: Settings, counters: int
) -> tuple[HybridSamples, list[HybridSamples]]:
    """The run, and its derivative along each tangent."""
    (modes, first, state), (times, t1) = built, horizon
    variational, start = (
        variational_modes(modes, tangents, settings.tolerance, False),
        variational_start(state, tangents),
    )
    ended, output = _rounds_with_samples(variational, first, start, times, t1, settings, counters)
    return _as_samples(ended, output, times, len(state), len(tangents))


class Filled(NamedTuple):
    """The samples so far: output rows, their variations, mode numbers, NaN where still missing; and the time [s] of the
    first grazing event, infinite if there was none.
    """

    shown: Float[Array, "shown times"]
    variations: Float[Array, "tangents shown times"]
    number: Float[Array, " times"]
    grazing_time: Float[Array, ""]

    def with_samples(self, mask: Bool[Array, " times"], output: tuple[Array, Array], number: Array | int) -> "Filled":
        """Fill in missing samples."""
        mask = mask & jnp.isnan(self.number)
        rows, variations = (
            jnp.where(mask, new, old) for new, old in zip(output, (self.shown, self.variations), strict=True)
        )
        return self._replace(shown=rows, variations=variations, number=jnp.where(mask, number, self.number))


def _rounds_with_samples(
    modes: tuple[VariationalMode, ...],
    first: Array,
    state: Float[Array, "components 1"],
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    counters: int,
) -> Carry:
    """Run round by round, as in `traced_solve_hybrid`, with samples of every mode and of the transition to the next."""
    count = len(modes[0].tangents)
    core_state = VariationalMode.parts(modes[0], state)[0][:-1]
    missing = jnp.full((len(jax.eval_shape(modes[0].mode.shown, core_state)), len(times)), jnp.nan)
    empty = Filled(missing, jnp.zeros((count, *missing.shape)), missing[0], jnp.full((), jnp.inf))

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[Array, " 1"]) -> Carry:
        def solved() -> Carry:
            run, output = carry
            number = run.mode[0]
            mode = mode_numbered(modes, numbers, number)
            # In a batch, all runs take this branch; runs in another mode spend no time in this one.
            times_in_mode, left = times - run.end_time, jnp.where(active, greatest(t1 - run.end_time, 0.0), 0.0)
            outcome, samples = solve_with_samples(
                mode.problem(run.state), times_in_mode, left, jnp.asarray(1), settings, n_blocks=1 + count
            )
            run_after = after_solve(jnp, run, outcome, t1)
            is_inside = (times_in_mode >= 0.0) & (times <= run_after.end_time)
            return run_after, output.with_samples(is_inside, mode.output_rows(samples[0].T), number)

        return jax.lax.cond(active[0], solved, lambda: carry)

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " 1"]) -> Carry:
        def rows_on_path(mode: AbstractBatchedMode, record: TransitionPath | None, left: Float[Array, " 1"]) -> Any:
            # If the event happens later, less time passes from the event to a fixed time, and to the horizon.
            return None if record is None else _rows_in_transition(mode, record, times - t1 + left)

        def after_transition() -> Carry:
            run, output = carry
            left = greatest(t1 - run.end_time, 0.0)
            mode = mode_numbered(modes, numbers, run.mode[0])
            transition, rows, variations = mode.reset_with_path(run.state, left, rows_on_path)
            run_after = after_reset(jnp, run, transition, t1)
            if rows is not None:
                is_inside = (times > run.end_time) & (times <= run_after.end_time)
                output = output.with_samples(is_inside, (rows, variations), BETWEEN)
            grazes = run_after.counts[-1, 0] > run.counts[-1, 0]
            grazing_time = jnp.where(grazes, jnp.minimum(output.grazing_time, run.end_time[0]), output.grazing_time)
            return run_after, output._replace(grazing_time=grazing_time)

        return jax.lax.cond(lost[0], after_transition, lambda: carry)

    return traced_rounds((at_start(jnp, first, state, 1, counters + 1), empty), program_groups(modes), solve, reset)


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


def mode_numbered(modes: tuple[VariationalMode, ...], numbers: Sequence[int], selected: Array) -> VariationalMode:
    """The mode numbered `selected` in one of the `program_groups`."""
    mode = modes[numbers[0]]
    for number in numbers[1:]:

        def leaf(old: Any, new: Any, number: int = number) -> Any:
            return old if old is new or not eqx.is_array(old) else jnp.where(selected == number, new, old)

        mode = jax.tree.map(leaf, mode, modes[number])
    return mode


def _rows_in_transition(
    mode: AbstractBatchedMode, record: TransitionPath, times_in_mode: Float[Array, " times"]
) -> Float[Array, "shown times"]:
    """The output rows some times [s] after the end of a mode; meaningless after the last stretch."""
    ends = record.ends[:, 0]
    stretch = jnp.minimum(
        jnp.searchsorted(jax.lax.stop_gradient(ends), jax.lax.stop_gradient(times_in_mode)), len(ends) - 1
    )
    start_time = jnp.where(stretch > 0, ends[jnp.maximum(stretch - 1, 0)], 0.0)
    motions = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[stretch][..., 0], 0, -1), record.motions)
    return mode.between(motions, jnp.where(jnp.isfinite(start_time), times_in_mode - start_time, 0.0))


def _as_samples(
    ended: HybridOutcome[Array], output: Filled, times: Float[Array, " times"], size: int, count: int
) -> tuple[HybridSamples, list[HybridSamples]]:
    """The samples, and their derivative along each tangent."""
    end_time, status, grazes = ended.end_time[0], ended.status[0], ended.counts[-1, 0] > 0
    invalid = jnp.where(times > output.grazing_time, jnp.nan, 0.0)
    # The variation of the time follows that of the state; a horizon does not move.
    delays = [ended.state[k * (size + 1) + size, 0] for k in range(1, count + 1)]
    delays = [jnp.where(status == REACHED_END, 0.0, jnp.where(grazes, jnp.nan, delay)) for delay in delays]
    numbers = (ended.mode[0], status, ended.steps[0], ended.rejected[0], ended.counts[:-1, 0])
    counters_and_codes = (part.astype(float) for part in numbers)
    samples = HybridSamples(output.shown, output.number, end_time, ended.state[:size, 0], *counters_and_codes)
    slopes = [
        HybridSamples(output.variations[k] + invalid, UNCHANGED, delays[k], *(UNCHANGED,) * 6) for k in range(count)
    ]
    return samples, slopes
