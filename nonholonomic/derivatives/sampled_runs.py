"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..integration import AbstractProblem, CoreProblem, Outcome, Settings, sample, solve_with_samples
from ..integration.problem import LEFT_DOMAIN, REACHED_END, event_time
from ..validation import as_number
from .adjoint import SampledCotangents, samples_pulled_back
from .differentiable import AbstractDifferentiableSolve, Gradient, Leaves, Structure, differentiable_solve
from .variation import Tangent, Tangents, VariationalProblem, by_active, in_groups, probed, tangent_along, tangents_by

# Samples of a run as a differentiable solve: its leaves, and how they are assembled into a problem.


#: The times of the samples and the horizon [s], in a block with the cells last; the settings; and the ends of the steps [s]
#: of a solver without an error estimate.
Options: TypeAlias = tuple[Array, Array, Settings, Array | None]


class AbstractSampling(AbstractDifferentiableSolve):
    """Samples of a run. The leaves are the numbers of some modules, followed by all other arrays.

    - `build`: builds what is run from the modules; `axes`: the number of axes of each of their numbers, without an axis of
      cells.
    - `structure`, `rest`: the places of the leaves among the modules' numbers, the `Options` and the rest of the modules;
      and what is not an array there.
    """

    build: Callable[..., PyTree] = eqx.field(static=True)
    axes: tuple[int, ...] = eqx.field(static=True)
    structure: Structure = eqx.field(static=True)
    rest: PyTree

    #: Up to this many numbers, the derivatives with respect to all of them are integrated forward, beside the run; with
    #: more, a gradient takes one backward pass.
    most_forward: ClassVar[float] = jnp.inf

    @property
    def movable(self) -> int:
        return len(self.axes)

    def built(self, modules: PyTree, tolerance: Array, cells: int | None) -> PyTree:
        """The problem of the modules, or what else is run; `cells` is `None` if the run is not in a block."""
        return self.build(modules, cells)

    @abc.abstractmethod
    def sampled(self, built: PyTree, tangents: Tangents, options: Options, nested: bool) -> tuple[PyTree, list[PyTree]]:
        """The samples, and their derivative along each tangent, the cells first; `nested`: as for `value_and_tangents`."""

    def prefers_adjoint(self, active: tuple[int, ...], leaves: Leaves) -> bool:
        return sum(leaves[k].size for k in active) > self.most_forward

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def differentiable(self, primal: "SampledRun") -> "SampledRun":
        return SampledRun(primal.states, primal.quadratures, primal.end_time)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> PyTree:
        build, numbers, options, lanes = self.builder(cells, leaves)
        return self.sampled(build(numbers, lanes), (), options, False)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[PyTree, list[PyTree]]:
        build, numbers, options, lanes = self.builder(cells, leaves)
        built, tangents, gather = tangents_by(build, active, numbers, lanes)
        samples, slopes = in_groups(lambda group: self.sampled(built, group, options, nested), tangents)
        return samples, gather(slopes)

    def push_forward(self, active: tuple[int, ...], cells: int, leaves: Leaves, tangents: tuple[Array, ...]) -> PyTree:
        build, numbers, options, _ = self.builder(cells, leaves)
        directions = [_cells_last(part, self.axes[k], cells) for k, part in zip(active, tangents, strict=True)]
        built, direction, size = tangent_along(build, active, numbers, tuple(directions), cells)
        _, (slope,) = self.sampled(built, (direction,), options, False)
        return jax.tree.map(lambda part: part * size.reshape(-1, *[1] * (part.ndim - 1)), slope)

    def builder(self, cells: int, leaves: Leaves) -> tuple[Callable[..., PyTree], Leaves, Options, int | None]:
        """What the leaves stand for.

        **Returns:** a function (the modules' numbers, cells) -> problem; the modules' numbers, in a block scalars or with
        the cells last; the options; and the number of cells, `None` outside of blocks.
        """
        parts = eqx.combine(jax.tree.unflatten(self.structure, leaves), self.rest)
        numbers, (times, t1, settings, grid), others = parts
        numbers, structure = jax.tree.flatten(numbers)
        if self.in_blocks:
            numbers = [_cells_last(number, axes, cells) for number, axes in zip(numbers, self.axes, strict=True)]
            # One tolerance serves the whole ensemble: the smallest of the batch.
            settings = settings.with_tolerance(jnp.min(settings.tolerance))
            times = times if times.ndim == 1 else times.T

        def build(numbers: tuple[Array, ...], cells: int | None) -> PyTree:
            modules = eqx.combine(jax.tree.unflatten(structure, numbers), others)
            return self.built(modules, settings.tolerance, cells)

        return build, tuple(numbers), (times, t1, settings, grid), cells if self.in_blocks else None


def _cells_last(number: Float[Array, "..."], axes: int, cells: int) -> Float[Array, "..."]:
    """A number of a module, with `axes` axes of its own after an axis of cells if it has one: a scalar, or an array with
    the cells in its last axis."""
    if axes == 0:
        return number
    if number.ndim == axes:
        return jnp.broadcast_to(number[..., None], (*number.shape, cells))
    return jnp.moveaxis(number, 0, -1)


def solve_for_samples(
    sampling: Callable[..., AbstractSampling],
    build: Callable[..., PyTree],
    modules: PyTree,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
) -> Any:
    """Solve for the samples of a run.

    **Arguments:** `sampling`: a function that returns the solve, given the fields of an `AbstractSampling`; `build`: a
    function that returns the problem, given the modules and what else the solve passes on (the function is compared by
    identity); other arguments as for `sampled_run`.
    """
    numbers, others = eqx.partition(modules, eqx.is_inexact_array)
    axes = tuple(map(jnp.ndim, jax.tree.leaves(numbers)))
    # Arrays, such as those of the solver, may be traced, so they belong to the leaves.
    arrays, rest = eqx.partition((numbers, (times, as_number(t1), settings, grid), others), eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    run = differentiable_solve(sampling(build, axes, structure, rest), *leaves)
    # A number that is zero, and whose derivative is that of the horizon.
    extension = jnp.where(run.status == REACHED_END, t1 - jax.lax.stop_gradient(t1), 0.0)
    return run._replace(end_time=run.end_time + extension)


#: Build a problem from some modules (scene, launch, ...) and a number of cells, `None` for a single run.
Build: TypeAlias = Callable[[PyTree, int | None], AbstractProblem]


#: In place of numbers that a `SampledRun` lacks.
ABSENT: Any = None


class SampledRun(NamedTuple):
    """A run at given times, as floats.

    - `states`: the core components (the problem's `leading` ones) or, of a run through modes, the output rows; NaN after
      the end. `quadratures`: the passive quadratures, `None` if there are none; if a program does not use them, the
      ensemble runs without them.
    - `end_time`, `end_state`, `status`: when, where and how the run ended, a code of `integration.problem`.
    - `steps`, `rejected`, `extremes`: as in `integration.Outcome`.
    - `number`, `end_mode`, `counts`: of a run through modes, the index of the mode, or `BETWEEN`, at each time, and at the
      end; and the counters.

    The derivative of a run has only the first three, and the others are `None`.

    **Example:** as for `sampled_run`.

    >>> from nonholonomic.derivatives import SampledRun
    >>> SampledRun._fields[:3]
    ('states', 'quadratures', 'end_time')
    """

    states: Float[Array, "*cells times rows"]
    quadratures: Float[Array, "*cells times quadratures"] | None
    end_time: Float[Array, "*cells"]
    end_state: Float[Array, "*cells components"] = ABSENT
    status: Float[Array, "*cells"] = ABSENT
    steps: Float[Array, "*cells"] = ABSENT
    rejected: Float[Array, "*cells"] = ABSENT
    extremes: Float[Array, "*cells 3"] = ABSENT
    number: Float[Array, "*cells times"] | None = None
    end_mode: Float[Array, "*cells"] | None = None
    counts: Float[Array, "*cells counters"] | None = None


#: A sampled run, and its derivative along each tangent.
Sampled = tuple[SampledRun, list[SampledRun]]


def sampled_run(
    build: Build,
    modules: PyTree,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
    *,
    adjoint: diffrax.AbstractAdjoint | None = None,
    arrays_in_lanes: bool = False,
) -> SampledRun:
    """Run a problem inside a transformation and sample it, with derivatives that take part in step-size control.

    With an explicit Runge-Kutta solver and scalar modules, a batch is solved as one ensemble, one lane per run;
    otherwise Diffrax integrates each run. In an ensemble, the gradient of a function of the samples takes one backward
    pass, whatever the number of parameters.

    **Arguments:**

    - `build`: function from the modules to the problem. Functions are compared by identity, so do not create a new one
      for each call.
    - `modules`: the tree whose numbers are differentiable.
    - `times`: times of the samples [s], increasing; `t1`: horizon [s].
    - `settings`: the tolerance may be traced.
    - `grid`: the ends of the steps [s], concrete, for a solver without an error estimate.
    - `adjoint`: how Diffrax differentiates its steps, if Diffrax shall integrate the run. A generic tangent then keeps the
      steps short enough for tangents; steps that end on a `grid` need none.
    - `arrays_in_lanes`: whether `build` accepts arrays in the modules, with the cells in their last axis, so that a batch
      with arrays is also solved as one ensemble.

    **Returns:** a `SampledRun`; its states and the time of its end have derivatives.

    **Example:**

    >>> from nonholonomic.derivatives import sampled_run
    >>> def final(rate):
    ...     return sampled_run(build, (rate,), jnp.array([0.1, 0.3]), jnp.asarray(0.3), settings).states[-1, 0]
    >>> print(f"{jax.grad(final)(2.0):.6f}")  # -0.3 exp(-0.6)
    -0.164643
    """
    if adjoint is not None:
        problem = build(modules, None)
        run = probed(problem) if grid is None else problem
        outcome, states = sample(run, times, t1, settings, grid=grid, adjoint=adjoint)
        size = len(problem.start()[0])
        outcome = outcome._replace(state=outcome.state[:size])
        return _with_slopes(VariationalProblem(problem, (), False), outcome, states[:size].T)[0]
    arrays = [leaf for leaf in jax.tree.leaves(modules) if eqx.is_array(leaf) and leaf.ndim > 0]
    in_lanes = all(arrays_in_lanes and eqx.is_inexact_array(leaf) for leaf in arrays)
    kind = BlockSampling if in_lanes and isinstance(settings.for_lanes, diffrax.AbstractERK) else SingleSampling
    samples = solve_for_samples(kind, build, modules, times, t1, settings, grid)
    # Separate calls: all arguments of a custom derivative count as used.
    states = _at_times(samples.states, None, times, modules, build)
    if samples.quadratures is None:
        return samples._replace(states=states)
    return samples._replace(states=states, quadratures=_at_times(samples.quadratures, states, times, modules, build))


@eqx.filter_custom_jvp
def _at_times(
    samples: Float[Array, "times rows"],
    leading: Float[Array, "times components"] | None,
    times: Float[Array, " times"],
    modules: PyTree,
    build: Build,
) -> Float[Array, "times rows"]:
    """The samples themselves, with derivatives with respect to their times from the field. The samples are the core
    components or, if `leading` contains the core components, the passive quadratures.
    """
    return samples


@_at_times.def_jvp
def _later(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    (samples, leading, times, modules, build), (sample_rates, _, time_rates, *_) = primals, tangents
    sample_rates = jnp.zeros_like(samples) if sample_rates is None else sample_rates
    # Second derivatives need samples that move with the times.
    samples = _at_times(samples, leading, times, modules, build)
    if time_rates is None:
        return samples, sample_rates
    problem = build(modules, None)
    full_problem = core_problem(problem) if leading is None else problem
    states = samples if leading is None else jnp.concatenate([leading, samples], axis=-1)
    rates = jax.vmap(full_problem.field)(times, states)[:, -samples.shape[-1] :]
    return samples, sample_rates + jnp.where(jnp.isfinite(rates), rates * time_rates[:, None], 0.0)


def with_later_changes(
    variational: VariationalProblem, times: Float[Array, " times"], samples: Float[Array, "*cells times components"]
) -> Float[Array, "*cells times components"]:
    """The samples, with derivatives of their variations with respect to the times, for second derivatives."""
    passed, size = times - jax.lax.stop_gradient(times), samples.shape[-1] // (1 + len(variational.tangents))
    rates = jax.vmap(lambda time, state: variational.field(time, state.T).T, (0, -2), -2)(times, samples)[..., size:]
    return samples.at[..., size:].add(jnp.where(jnp.isfinite(rates), rates, 0.0) * passed[:, None])


def core_problem(problem: AbstractProblem) -> AbstractProblem:
    """A problem without its passive quadratures."""
    return problem if problem.leading is None else CoreProblem(problem, problem.leading)


#: Samples of the core components and of the passive quadratures, `None` without these.
Samples = tuple[Float[Array, "*cells times components"], Float[Array, "*cells times quadratures"] | None]


def parted(problem: AbstractProblem, states: Float[Array, "*cells times all"]) -> Samples:
    """Split states into the core components and the passive quadratures."""
    if problem.leading is None:
        return states, None
    return states[..., : problem.leading], states[..., problem.leading :]


class BlockSampling(AbstractSampling):
    """Samples by an ensemble solve, with passive quadratures or, if `core_only`, without them."""

    core_only: bool = eqx.field(static=True, default=False)

    #: For 64 rides with 6 and 16 numbers, the gradient costs 8 and 17 values forward, and 5.5 and 4.8 backward (jax 0.10).
    most_forward = 2

    def built(self, modules: PyTree, tolerance: Array, cells: int | None) -> AbstractProblem:
        problem = super().built(modules, tolerance, cells)
        return core_problem(problem) if self.core_only else problem

    def sampled(self, built: AbstractProblem, tangents: Tangents, options: Options, nested: bool) -> Sampled:
        variational, (times, t1, settings, _) = VariationalProblem(built, tangents, False), options
        arguments = (variational, times, t1, jnp.asarray(built.start()[0].shape[1]), settings)
        outcome, samples = solve_with_samples(*arguments, n_blocks=1 + len(tangents), one_kernel=not nested)
        samples = with_later_changes(variational, times, samples) if nested else samples
        return _with_slopes(variational, outcome, samples)

    def pull_back(self, active: tuple[int, ...], cells: int, leaves: Leaves, cotangents: SampledRun) -> Gradient:
        solve = dataclasses.replace(self, core_only=True) if cotangents.quadratures is None else self
        build, numbers, (times, t1, settings, _), _ = solve.builder(cells, leaves)
        rebuilt, point = by_active(build, active, numbers, cells)
        problem, by_end = rebuilt(*point), cotangents.end_time
        zeros = jnp.zeros((cells, len(times), len(problem.start()[0])))
        pairs = zip(parted(problem, zeros), (cotangents.states, cotangents.quadratures), strict=True)
        by_states = jnp.concatenate(
            [zero if part is None else part for zero, part in pairs if zero is not None], axis=-1
        )
        by_end = jnp.zeros(cells) if by_end is None else by_end
        by_samples = SampledCotangents(by_states, by_end, zeros[:, 0].T)
        by_point = samples_pulled_back(rebuilt, point, by_samples, times, t1, settings)
        return [jnp.moveaxis(part, -1, 0) for part in by_point]

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        fields = SampledRun._fields
        quadratures = any(fields[part % len(fields)] == "quadratures" for part in wanted)
        return self if quadratures else dataclasses.replace(self, core_only=True)


def _with_slopes(
    variational: VariationalProblem, outcome: Outcome, samples: Float[Array, "*cells times components"]
) -> Sampled:
    """The samples and their derivative along each tangent, from the samples of states and variations."""
    states, *variations = jnp.split(samples, 1 + len(variational.tangents), axis=-1)
    time, status = outcome.end_time, outcome.status
    end, *end_variations = variational.parts(outcome.state)

    def end_time(problem: AbstractProblem, state: Float[Array, "components *cells"]) -> Float[Array, "*cells"]:
        return event_time(problem, lambda point: problem.domain_margin(time, point), time, state)

    def slope(direction: Tangent, variation: Array, at_end: Array) -> SampledRun:
        if variational.problem.domain_margin(time, end) is None:
            end_delay = jnp.zeros_like(time)
        else:
            end_delay = eqx.filter_jvp(end_time, (variational.problem, end), (direction, at_end))[1]
            end_delay = jnp.where((status == LEFT_DOMAIN) & (time > 0.0), end_delay, 0.0)
        changes = parted(variational.problem, jnp.where(jnp.isnan(states), 0.0, variation))
        return SampledRun(*changes, end_delay)

    slopes = [slope(*parts) for parts in zip(variational.tangents, variations, end_variations, strict=True)]
    counts = (status, outcome.steps, outcome.rejected, jnp.moveaxis(outcome.extremes, 0, -1))
    end, _ = parted(variational.problem, jnp.moveaxis(end, 0, -1))
    numbers = (part.astype(float) for part in counts)
    return SampledRun(*parted(variational.problem, states), time, end, *numbers), slopes


class SingleSampling(AbstractSampling):
    """Samples by Diffrax, with any of its solvers."""

    in_blocks = False

    def sampled(self, built: AbstractProblem, tangents: Tangents, options: Options, nested: bool) -> Sampled:
        variational, (times, t1, settings, grid) = VariationalProblem(built, tangents, False), options
        outcome, states = sample(variational, jax.lax.stop_gradient(times), t1, settings, grid=grid)
        states = with_later_changes(variational, times, states.T) if nested else states.T
        samples, slopes = _with_slopes(variational, outcome, states)

        def jump_times(problem: AbstractProblem) -> Array | None:
            jumps = problem.jumps(jnp.zeros_like(t1), problem.start()[0])
            return None if jumps is None else jumps.times

        for number, direction in enumerate(tangents if jump_times(built) is not None else ()):
            # Diffrax's steps do not move with a jump.
            moved = eqx.filter_jvp(jump_times, (built,), (direction,))[1]
            if moved is not None:
                missing = jnp.where(jnp.any(moved != 0.0), jnp.nan, 0.0)
                slopes[number] = jax.tree.map(lambda part, missing=missing: part + missing, slopes[number])
        return jax.tree.map(lambda part: part[None], (samples, slopes))
