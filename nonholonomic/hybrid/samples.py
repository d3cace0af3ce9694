"""Hybrid runs sampled at given times: of many cells at once, and inside other transformations, with derivatives."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..compilation.xla_cpu import compiled_alone
from ..derivatives import in_groups, tangents_by
from ..derivatives.sampled_runs import AbstractSampling, ProblemSpec, solve_for_samples
from ..derivatives.variation import by_active, tangent_along
from ..integration import Settings
from ..integration.problem import REACHED_END
from .ensemble import at_start, traced_rounds
from .mode import AbstractBatchedMode, over_cells, weighted
from .saltation import variational_modes, variational_start
from .sampled_adjoint import hybrid_samples_pulled_back, output_rows, program_groups, sampled_rounds

#: From some modules (scene, launch, ...), the tolerance and a number of cells to the modes, the index of the first mode
#: of every cell, and the initial states.
Build = Callable[[Any, Array, int], tuple[tuple[AbstractBatchedMode, ...], Array, Float[Array, "components cells"]]]


#: Up to this many numbers, the derivatives are integrated forward; with more, a gradient takes one backward pass. For 64
#: bouncing balls, the gradient by 3 and 5 numbers costs 6 and 7 values forward, and 6 backward; for 64 hopping tops, that
#: by 10 numbers costs 24 forward and 12 backward (jax 0.10). A single run waits for its program, not for its steps, and
#: the backward pass takes up to twice as long to compile.
MOST_FORWARD, MOST_FORWARD_ALONE = 6, 32

#: In the derivative of `HybridSamples`: the entries that have none.
UNCHANGED: Any = None


class HybridSamples(NamedTuple):
    """Hybrid runs at given times, all floats.

    - `shown`: the output rows, NaN after the end of the run; `number`: index of the mode at each time, or `BETWEEN`.
    - `end_time`, `end_state`, `end_mode`: when, where and in which mode the run ended; `status`: the status code.
    - `steps`, `rejected`, `extremes`: as in `HybridOutcome`; `counts`: the counters.

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
    extremes: Float[Array, "*cells 3"]
    counts: Float[Array, "*cells kinds"]


def hybrid_samples(
    build: Build, modules: Any, times: Float[Array, " times"], t1: Float[Array, ""], settings: Settings, counters: int
) -> HybridSamples:
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
        build, numbers, horizon, settings = self._builder(leaves)
        return _sampled_with_tangents(build(numbers, cells), (), horizon, cells, settings, self.counters)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[HybridSamples, list[HybridSamples]]:
        if nested:
            raise ValueError(
                "second derivatives are not available through changes of mode; take differences of a gradient instead"
            )
        build, numbers, horizon, settings = self._builder(leaves)
        built, tangents, gather = tangents_by(build, active, numbers, cells)

        def run(group: tuple[Any, ...]) -> tuple[HybridSamples, list[HybridSamples]]:
            hybrid_tangents = tuple((tangent[0], tangent[2]) for tangent in group)
            return _sampled_with_tangents(built, hybrid_tangents, horizon, cells, settings, self.counters)

        samples, slopes = in_groups(run, tangents)
        return samples, gather(slopes)

    def prefers_adjoint(self, active: tuple[int, ...], leaves: tuple[Array, ...]) -> bool:
        if len(active) <= MOST_FORWARD:
            return False
        typed = [jax.ShapeDtypeStruct(jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves]
        try:
            jax.eval_shape(functools.partial(_backward, self), *typed)
        except ValueError:
            return False
        return True

    def differentiable(self, primal: HybridSamples) -> HybridSamples:
        return HybridSamples(primal.shown, UNCHANGED, primal.end_time, *(UNCHANGED,) * 7)

    def push_forward(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], tangents: tuple[Array, ...]
    ) -> HybridSamples:
        build, numbers, horizon, settings = self._builder(leaves)
        built, direction, size = tangent_along(build, active, numbers, tangents, cells)
        hybrid_tangent = (direction[0], direction[2])
        _, (slope,) = _sampled_with_tangents(built, (hybrid_tangent,), horizon, cells, settings, self.counters)
        return jax.tree.map(lambda part: part * size.reshape(-1, *[1] * (part.ndim - 1)), slope)

    def pull_back(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], cotangents: HybridSamples
    ) -> list[Float[Array, " cells"]]:
        if cells == 1 and len(active) <= MOST_FORWARD_ALONE:
            slopes = self.value_and_tangents(active, False, cells, *leaves)[1]
            return [_product(slope, cotangents) for slope in slopes]
        build, numbers, (times, t1), settings = self._builder(leaves)
        rebuilt, point = by_active(build, active, numbers, cells)
        times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), cells))
        shown, end_time = cotangents.shown, cotangents.end_time
        if shown is None:
            modes, _, state = rebuilt(*point)
            shown = jnp.zeros((cells, len(jax.eval_shape(modes[0].shown, state)), len(times)))
        end_time = jnp.zeros(cells) if end_time is None else end_time
        options = (times, jnp.broadcast_to(t1, (cells,)), settings, self.counters)
        return hybrid_samples_pulled_back(rebuilt, point, jnp.moveaxis(shown, 0, -1), end_time, *options)

    def _builder(self, leaves: tuple[Array, ...]) -> tuple[Callable[..., Any], tuple[Array, ...], Any, Settings]:
        """A function (the modules' numbers, cells) -> modes and start; the numbers; times and horizon; the settings."""
        numbers, (times, t1, tolerance), spec = self._sorted(leaves)
        # One tolerance serves the whole ensemble: the smallest of the batch.
        settings = spec.settings.with_tolerance(jnp.min(tolerance))

        def build(numbers: tuple[Array, ...], cells: int | None) -> Any:
            return spec.built(numbers, settings.tolerance, cells)

        return build, numbers, (times if times.ndim == 1 else times.T, t1), settings


def _product(slope: HybridSamples, cotangents: HybridSamples) -> Float[Array, " cells"]:
    """The derivative of a sum over samples, from their derivatives and their cotangents; a derivative that is zero counts
    for nothing, whatever the cotangent."""
    pairs = ((slope.shown, cotangents.shown), (slope.end_time, cotangents.end_time))
    terms = [weighted(one, other).reshape(len(one), -1) for one, other in pairs if other is not None]
    return sum((jnp.sum(term, axis=1) for term in terms), jnp.zeros(len(slope.end_time)))


# Compiled, so that JAX traces it once for equal solves.
@eqx.filter_jit
def _backward(sampling: HybridSampling, *leaves: Array) -> list[Any]:
    """The backward passes of the fields and of the output rows of a single run, for their shapes.

    **Raises:** `ValueError` if one of them has a loop without a fixed number of iterations.
    """
    build, numbers, _, _ = sampling._builder(leaves)
    modes, _, state = build(numbers, 1)

    def of_mode(mode: AbstractBatchedMode) -> Any:
        arrays, static = eqx.partition(mode, eqx.is_inexact_array)

        def values(arrays: Any, state: Float[Array, "components cells"]) -> Any:
            mode = eqx.combine(arrays, static)
            shown = over_cells(lambda mode, states: mode.shown(states), mode)(state[:, None])
            return mode.problem(state).field(jnp.zeros_like(state[0]), state), shown

        results, pull = jax.vjp(values, arrays, state)
        return pull(jax.tree.map(jnp.ones_like, results))

    return [of_mode(modes[group[0]]) for group in program_groups(modes)]


def _sampled_with_tangents(
    built: Any, tangents: tuple[Any, ...], horizon: tuple[Array, Array], cells: Any, settings: Settings, counters: int
) -> tuple[HybridSamples, list[HybridSamples]]:
    """The runs, and their derivative along each tangent."""
    (modes, first, state), (times, t1) = built, horizon
    size, runs = state.shape
    times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), runs))
    variational = variational_modes(modes, tangents, settings.tolerance, False)
    start = at_start(jnp, first, variational_start(state, tangents), cells, counters + 1)
    rounds = sampled_rounds(variational, start, times, jnp.broadcast_to(t1, (runs,)), settings, 1 + len(tangents))
    ended, output = traced_rounds(*rounds)
    rows, variations = output_rows(variational, output)
    grazes = ended.counts[-1] > 0
    invalid = jnp.where(times > output.grazing_time, jnp.nan, 0.0)
    counters_and_codes = (ended.mode, ended.status, ended.steps, ended.rejected, ended.extremes, ended.counts[:-1])
    parts = (rows, output.number, ended.end_time, ended.state[:size], *counters_and_codes)
    samples = HybridSamples(*(jnp.moveaxis(part.astype(float), -1, 0) for part in parts))

    def slope(k: int, rows: Float[Array, "shown times cells"]) -> HybridSamples:
        # The variation of the time follows that of the state; a horizon does not move.
        delay = jnp.where(grazes, jnp.nan, ended.state[(k + 1) * (size + 1) + size])
        delay = jnp.where(ended.status == REACHED_END, 0.0, delay)
        return HybridSamples(jnp.moveaxis(rows + invalid, -1, 0), UNCHANGED, delay, *(UNCHANGED,) * 7)

    return samples, [slope(k, part) for k, part in enumerate(variations)]
