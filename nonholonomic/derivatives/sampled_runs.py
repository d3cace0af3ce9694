"""Runs sampled at given times, as functions for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

import abc
import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Self, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..integration import AbstractProblem, CoreProblem, Lanes, LaneState, Settings, States, sample, solve_with_samples
from ..integration.dense import SampledSolution
from ..integration.problem import FAILED, LEFT_DOMAIN, REACHED_END, event_time
from ..integration.runge_kutta import Integers
from ..integration.samples import Record, SampleTimes, components, step_towards_sample
from ..integration.scheduler import NO_EXTREMES, InLanes
from ..validation import as_number
from .adjoint import StepRecord, StepRecorder, shares_of, solve_with_adjoint, time_of_zero, without_probe
from .differentiable import AbstractDifferentiableSolve, Structure, differentiable_solve
from .variation import (
    Tangent,
    Tangents,
    VariationalProblem,
    by_active,
    in_groups,
    moving_leaves,
    probed,
    tangent_along,
    tangent_scale,
    tangents_by,
    tangents_of,
)

# The derivatives of a sum over the samples of a run with respect to any number of parameters, by one backward pass.
#
# The run is repeated, with steps that also suit a tangent, and its steps are recorded (`adjoint.py`). The backward pass
# adds the cotangent of each sample where it passes the sample's time. Neither the cost nor the memory depends on the number
# of parameters, apart from the field's own share.


class SampledCotangents(NamedTuple):
    """The cotangents of the samples, of the time at which a run leaves the domain, and of the state at the horizon."""

    states: Float[Array, "cells times components"]
    end_time: Float[Array, " cells"]
    end_state: Float[Array, "components cells"]

    @classmethod
    def of(
        cls,
        problem: AbstractProblem,
        times: int,
        core: Float[Array, "cells times components"] | None,
        quadratures: Float[Array, "cells times quadratures"] | None,
        end_time: Float[Array, " cells"] | None,
    ) -> "SampledCotangents":
        """The cotangents of a problem's core components, quadratures and end time, zero where they are `None`."""
        components, cells = problem.start()[0].shape
        leading = components if problem.leading is None else problem.leading
        states = [
            jnp.zeros((cells, times, size)) if part is None else part
            for part, size in ((core, leading), (quadratures, components - leading))
        ]
        end_time = jnp.zeros(cells) if end_time is None else end_time
        return cls(jnp.concatenate(states, axis=-1), end_time, jnp.zeros((components, cells)))


class SampledStepRecorder(StepRecorder):
    """Records steps that end on the samples; the cotangents of the samples enter where the steps end."""

    times: SampleTimes
    cotangents: SampledCotangents

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: None) -> Record:
        steps = super().begin(in_lanes, lane_state, collected)
        sample = self.times.after(lane_state.time, lane_state)
        samples, fixed = jnp.zeros(steps.length.shape, sample.dtype), jnp.zeros(steps.state.shape, bool)
        return Record(jnp.ones(sample.shape, bool), sample, steps._replace(sample=samples, fixed=fixed))

    def step(
        self, in_lanes: InLanes, lane_state: LaneState, record: Record, iteration: Int[Array, ""]
    ) -> tuple[LaneState, Record]:
        state = without_probe(lane_state).state

        def entry(new_lanes: LaneState, length: Lanes, sample: Integers) -> StepRecord:
            moved = jnp.where(new_lanes.time > lane_state.time, length, 0.0)
            return StepRecord(lane_state.time, state, moved, sample, new_lanes.state[len(state) :] == 0.0)

        return step_towards_sample(self.times, in_lanes, lane_state, record, iteration, entry)

    def steps(self, record: Record) -> StepRecord:
        return record.rows

    def arriving(self, lane_state: LaneState, steps: StepRecord) -> Float[Array, "iterations components lanes"]:
        assert steps.fixed is not None
        rows = self.cotangents.states.at[self.times.cell_of(lane_state), steps.sample].get(mode="fill", fill_value=0.0)
        # Where the derivative is zero, a NaN cotangent, such as that of theta at the pole, has no effect.
        return jnp.where(steps.fixed, 0.0, jnp.moveaxis(rows, -1, 1))

    def share_of_end(self, lane_state: LaneState) -> tuple[Lanes, States]:
        cell, has_left = self.times.cell_of(lane_state), (lane_state.status == LEFT_DOMAIN) & (lane_state.time > 0.0)
        at_end = jnp.where(lane_state.status == REACHED_END, self.cotangents.end_state[:, cell], 0.0)
        return jnp.where(has_left, self.cotangents.end_time[cell], 0.0), at_end

    def measured(self, problem: AbstractProblem, lane_state: LaneState) -> tuple[Lanes, States]:
        """The time at which a run leaves the domain, and the state at the end."""
        time, state = lane_state.time, lane_state.state
        if problem.domain_margin(time, state) is None:
            return jnp.zeros_like(time), state
        return time_of_zero(problem, lambda state: problem.domain_margin(time, state), time, state), state


def samples_pulled_back(
    build: Callable[..., AbstractProblem],
    point: tuple[Float[Array, "... cells"], ...],
    cotangents: SampledCotangents,
    times: Float[Array, "times *cells"],
    t1: Float[Array, "..."],
    settings: Settings,
    rates: list[Float[Array, "... cells"]] | None = None,
) -> list[Float[Array, "... cells"]]:
    """The cotangents of a problem's numbers from those of its samples.

    **Arguments:**

    - `build`: numbers -> problem; `point`: the numbers, with the cells last.
    - `cotangents`: those of the samples, 0 after the end of a run, and of the end.
    - `times`, `t1`, `settings`: as for `solve_with_samples`.
    - `rates`: a tangent of the numbers, which the steps must suit; by default one that moves every number.

    **Returns:** the cotangents, in the shapes of the numbers; NaN in cells that fail with the steps that suit the tangent.
    """
    problem, cells = build(*point), point[0].shape[-1]
    probe = tangents_of(build, point, [tuple(mixture(point) if rates is None else rates)])[0]

    def field_and_margin(problem: AbstractProblem, states: States) -> PyTree:
        time = jnp.zeros_like(states[0])
        return problem.field(time, states), problem.domain_margin(time, states), problem.jumps(time, states)

    moving = moving_leaves(problem, probe, field_and_margin)
    recorder = SampledStepRecorder(SampleTimes.of(times, cells, components), cotangents)
    options = (t1, jnp.asarray(cells), settings)
    outcome, (by_start, by_number) = solve_with_adjoint(problem, moving, probe, False, options, recorder)
    sample_times = jnp.broadcast_to(times if times.ndim == 2 else times[:, None], (len(times), cells)).T
    is_moved = VariationalProblem(problem, (probe,), False).start()[0][len(by_start) :] != 0.0
    initial = jnp.where((sample_times <= 0.0)[..., None] & is_moved.T[:, None], cotangents.states, 0.0)
    is_lost = jnp.any(jnp.any(cotangents.states != 0.0, axis=-1) & (sample_times > outcome.end_time[:, None]), axis=1)
    is_lost |= jnp.any(cotangents.end_state != 0.0, axis=0)
    by_start = by_start + jnp.sum(initial, axis=1).T

    def numbers_and_start(*point: Float[Array, "... cells"]) -> PyTree:
        problem = build(*point)
        return eqx.filter(problem, moving), problem.start()[0]

    by_point = jax.vjp(numbers_and_start, *point)[1]((by_number, by_start))
    return [jnp.where(is_lost & (outcome.status == FAILED), jnp.nan, part) for part in by_point]


def mixture(point: tuple[Float[Array, "... cells"], ...]) -> list[Float[Array, "... cells"]]:
    """A direction that moves every number by a share of its own size."""
    counts = [number[..., 0].size for number in point]
    shares = np.split(shares_of(sum(counts)), np.cumsum(counts)[:-1])
    return [
        jnp.asarray(share).reshape(*number.shape[:-1], 1) * tangent_scale(number)
        for share, number in zip(shares, point, strict=True)
    ]


def is_reversible(problem: AbstractProblem) -> bool:
    """Whether the field of a single run has a backward pass; a loop without a fixed number of iterations has none."""
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)

    def summed(arrays: PyTree, state: States) -> Float[Array, ""]:
        return jnp.sum(eqx.combine(arrays, static).field(jnp.zeros_like(state[0]), state))

    try:
        jax.eval_shape(jax.grad(summed, (0, 1)), arrays, problem.start()[0])
    except ValueError:
        return False
    return True


# Samples of a run as a differentiable solve: its leaves, and how they are assembled into a problem.


#: The times of the samples and the horizon [s], in a block with the cells last.
Horizon: TypeAlias = tuple[Array, Array]


class ProblemSpec(eqx.Module):
    """How to build a problem from numbers and how to integrate it, except for the tolerance."""

    build: Callable[..., PyTree] = eqx.field(static=True)
    structure: Structure = eqx.field(static=True)
    rest: PyTree
    settings: Settings
    grid: Float[Array, " steps"] | None
    # The numbers of axes of the modules' numbers, without an axis of cells.
    axes: tuple[int, ...] = eqx.field(static=True)

    def of(self, numbers: tuple[Array, ...], *extra: object) -> PyTree:
        """Build the problem from the modules, with their numbers replaced, and from the extra arguments of `build`."""
        return self.build(eqx.combine(jax.tree.unflatten(self.structure, numbers), self.rest), *extra)


class AbstractSampling(AbstractDifferentiableSolve):
    """Samples of a run. The leaves are the modules' numbers, the times, the horizon, the tolerance and the arrays of
    the spec. `spec` is the rest of the spec, and `places` the positions of the arrays in it.
    """

    spec: eqx.AbstractVar[ProblemSpec]
    places: eqx.AbstractVar[Structure]

    @abc.abstractmethod
    def built(self, spec: ProblemSpec, numbers: tuple[Array, ...], cells: int | None) -> PyTree:
        """The problem of the modules' numbers, or what else is run; `cells` is `None` if the run is not in a block."""

    @abc.abstractmethod
    def sampled(
        self, built: PyTree, tangents: Tangents, horizon: Horizon, spec: ProblemSpec, nested: bool
    ) -> tuple[PyTree, list[PyTree]]:
        """The samples, and their derivative along each tangent, the cells first; `nested`: as for `value_and_tangents`."""

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isnan(value)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> PyTree:
        build, numbers, horizon, spec, lanes = self.builder(cells, leaves)
        return self.sampled(build(numbers, lanes), (), horizon, spec, False)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[PyTree, list[PyTree]]:
        build, numbers, horizon, spec, lanes = self.builder(cells, leaves)
        built, tangents, gather = tangents_by(build, active, numbers, lanes)
        samples, slopes = in_groups(lambda group: self.sampled(built, group, horizon, spec, nested), tangents)
        return samples, gather(slopes)

    def push_forward(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], tangents: tuple[Array, ...]
    ) -> PyTree:
        build, numbers, horizon, spec, _ = self.builder(cells, leaves)
        directions = [_cells_last(part, self.spec.axes[k], cells) for k, part in zip(active, tangents, strict=True)]
        built, direction, size = tangent_along(build, active, numbers, tuple(directions), cells)
        _, (slope,) = self.sampled(built, (direction,), horizon, spec, False)
        return jax.tree.map(lambda part: part * size.reshape(-1, *[1] * (part.ndim - 1)), slope)

    def whole_spec(self, leaves: tuple[Array, ...]) -> ProblemSpec:
        """The spec with its arrays."""
        return eqx.combine(self.spec, jax.tree.unflatten(self.places, leaves[self.movable + 3 :]))

    def builder(
        self, cells: int, leaves: tuple[Array, ...]
    ) -> tuple[Callable[..., PyTree], tuple[Array, ...], Horizon, ProblemSpec, int | None]:
        """What the leaves stand for.

        **Returns:** a function (the modules' numbers, cells) -> problem; the modules' numbers, in a block scalars or with
        the cells last; the horizon; the whole spec, with the tolerance; and the number of cells, `None` outside of blocks.
        """
        numbers, spec = leaves[: self.movable], self.whole_spec(leaves)
        times, t1, tolerance = leaves[self.movable : self.movable + 3]
        if self.in_blocks:
            numbers = tuple(_cells_last(number, axes, cells) for number, axes in zip(numbers, spec.axes, strict=True))
            # One tolerance serves the whole ensemble: the smallest of the batch.
            times, tolerance = times if times.ndim == 1 else times.T, jnp.min(tolerance)
        spec = dataclasses.replace(spec, settings=spec.settings.with_tolerance(tolerance))
        build = functools.partial(self.built, spec)
        return build, numbers, (times, t1), spec, cells if self.in_blocks else None


def _cells_last(number: Float[Array, "..."], axes: int, cells: int) -> Float[Array, "..."]:
    """A number of a module, with `axes` axes of its own after an axis of cells if it has one: a scalar, or an array with
    the cells in its last axis."""
    if axes == 0:
        return number
    if number.ndim == axes:
        return jnp.broadcast_to(number[..., None], (*number.shape, cells))
    return jnp.moveaxis(number, 0, -1)


def solve_for_samples(
    sampling: Callable[[int, ProblemSpec, Structure], AbstractSampling],
    build: Callable[..., PyTree],
    modules: PyTree,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
) -> Any:
    """Solve for the samples of a run.

    **Arguments:** `sampling`: a function that returns the solve, given its first three fields; `build`: a function that
    returns the problem, given the modules and extra arguments of the solve (the function is compared by identity);
    other arguments as for `sampled_run`.
    """
    numbers, static = eqx.partition(modules, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(numbers)
    # Arrays, such as those of the solver, may be traced, so they belong to the leaves.
    arrays, spec = eqx.partition(
        ProblemSpec(build, structure, static, settings.with_tolerance(None), grid, tuple(map(jnp.ndim, leaves))),
        eqx.is_array,
    )
    arrays_of_spec, places = jax.tree.flatten(arrays)
    return differentiable_solve(
        sampling(len(leaves), spec, places), *leaves, times, as_number(t1), settings.tolerance, *arrays_of_spec
    )


#: Build a problem from some modules (scene, launch, ...) and a number of cells, `None` for a single run.
Build: TypeAlias = Callable[[PyTree, int | None], AbstractProblem]


#: Up to this many numbers, the derivatives with respect to all of them are integrated forward, beside the run; with more,
#: a gradient takes one backward pass. For 64 rides with 6 and 16 numbers, the gradient costs 8 and 17 values forward, and
#: 5.5 and 4.8 backward (jax 0.10).
MOST_FORWARD = 2

#: In the derivative of a `SampledRun`: end state, status, and numbers and lengths of steps.
NOT_DIFFERENTIATED: tuple[Any, ...] = (None,) * 5


class SampledRun(NamedTuple):
    """A run at given times, as floats: its states, NaN after its end; when and where it ended; the status code
    (`REACHED_END`, `LEFT_DOMAIN` or `FAILED`); the numbers of accepted and rejected steps; and the extremes of their
    lengths, as in `integration.Outcome`.

    `states` and `end_state` are the core components (the problem's `leading` ones), and `quadratures` are the passive
    quadratures, `None` if there are none. If a program does not use `quadratures`, the ensemble runs without them.

    **Example:** as for `sampled_run`.

    >>> from nonholonomic.derivatives import SampledRun
    >>> SampledRun._fields[:3]
    ('states', 'quadratures', 'end_time')
    """

    states: Float[Array, "*cells times components"]
    quadratures: Float[Array, "*cells times quadratures"] | None
    end_time: Float[Array, "*cells"]
    end_state: Float[Array, "*cells components"]
    status: Float[Array, "*cells"]
    accepted: Float[Array, "*cells"]
    rejected: Float[Array, "*cells"]
    extremes: Float[Array, "*cells 3"]


def sampled_run(
    build: Build,
    modules: PyTree,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
    *,
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
    arrays = [leaf for leaf in jax.tree.leaves(modules) if eqx.is_array(leaf) and leaf.ndim > 0]
    in_lanes = all(arrays_in_lanes and eqx.is_inexact_array(leaf) for leaf in arrays)
    kind = BlockSampling if in_lanes and isinstance(settings.for_lanes, diffrax.AbstractERK) else SingleSampling
    samples = solve_for_samples(kind, build, modules, jax.lax.stop_gradient(times), t1, settings, grid)
    # Separate calls: all arguments of a custom derivative count as used.
    states = _at_times(samples.states, None, times, modules, build)
    quadratures = (
        None if samples.quadratures is None else _at_times(samples.quadratures, samples.states, times, modules, build)
    )
    return samples._replace(states=states, quadratures=quadratures)


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
    if time_rates is None:
        return samples, sample_rates
    problem, size = build(modules, None), samples.shape[-1]
    full_problem = core_problem(problem) if leading is None else problem
    states = samples if leading is None else jnp.concatenate([leading, samples], axis=-1)
    rates = jax.vmap(full_problem.field)(times, states)[:, -size:]
    return samples, sample_rates + jnp.where(jnp.isfinite(rates), rates * time_rates[:, None], 0.0)


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


def sampled_run_by_diffrax(
    problem: AbstractProblem,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
    adjoint: diffrax.AbstractAdjoint,
    grid: Float[Array, " steps"] | None = None,
) -> SampledRun:
    """Run a problem and let Diffrax differentiate its steps. A probe (`probed`) keeps the steps short enough for
    tangents; fixed steps (`grid`) need none.

    **Arguments:** as for `sampled_run`; `adjoint`: how Diffrax differentiates.

    **Returns:** a `SampledRun`.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.derivatives import sampled_run_by_diffrax
    >>> times, adjoint = jnp.array([0.1, 0.3]), diffrax.ForwardMode()
    >>> run = sampled_run_by_diffrax(Decays(jnp.asarray(2.0)), times, jnp.asarray(0.3), settings, adjoint)
    >>> print(run.states[:, 0].round(6))
    [0.818731 0.548812]
    """
    size = len(problem.start()[0])
    leading = size if problem.leading is None else problem.leading
    full_problem = probed(problem) if grid is None else problem
    path = sample(full_problem, times, t1, settings, grid=grid, adjoint=adjoint)
    status, accepted, rejected = (part.astype(float) for part in (_status(path, t1), path.accepted, path.rejected))
    states = parted(problem, path.states[:size].T)
    return SampledRun(
        *states, path.end_time, path.end_state[:leading], status, accepted, rejected, jnp.asarray(NO_EXTREMES)
    )


def _status(path: SampledSolution, t1: Float[Array, ""]) -> Int[Array, ""]:
    """The status code of a single run."""
    return jnp.where(path.lost, LEFT_DOMAIN, jnp.where(path.end_time < t1, FAILED, REACHED_END))


class BlockSampling(AbstractSampling):
    """Samples by an ensemble solve, with passive quadratures or, if `core_only`, without them."""

    movable: int
    spec: ProblemSpec
    places: Structure = eqx.field(static=True)
    core_only: bool = eqx.field(static=True, default=False)

    def built(self, spec: ProblemSpec, numbers: tuple[Array, ...], cells: int | None) -> AbstractProblem:
        problem = spec.of(numbers, cells)
        return core_problem(problem) if self.core_only else problem

    def sampled(
        self, built: AbstractProblem, tangents: Tangents, horizon: Horizon, spec: ProblemSpec, nested: bool
    ) -> tuple[SampledRun, list[SampledRun]]:
        return _samples_and_slopes(VariationalProblem(built, tangents, False), horizon, spec.settings, not nested)

    def prefers_adjoint(self, active: tuple[int, ...], leaves: tuple[Array, ...]) -> bool:
        if sum(leaves[k].size for k in active) <= MOST_FORWARD:
            return False
        return is_reversible(self.whole_spec(leaves).of(leaves[: self.movable], None))

    def differentiable(self, primal: SampledRun) -> SampledRun:
        return SampledRun(primal.states, primal.quadratures, primal.end_time, *NOT_DIFFERENTIATED)

    def pull_back(
        self, active: tuple[int, ...], cells: int, leaves: tuple[Array, ...], cotangents: SampledRun
    ) -> list[Float[Array, "cells ..."]]:
        solve = dataclasses.replace(self, core_only=True) if cotangents.quadratures is None else self
        build, numbers, (times, t1), spec, _ = solve.builder(cells, leaves)
        rebuilt, point = by_active(build, active, numbers, cells)
        by_samples = SampledCotangents.of(rebuilt(*point), len(times), *cotangents[:3])
        by_point = samples_pulled_back(rebuilt, point, by_samples, times, t1, spec.settings)
        return [jnp.moveaxis(part, -1, 0) for part in by_point]

    def for_parts(self, wanted: tuple[int, ...]) -> Self:
        fields = SampledRun._fields
        quadratures = any(fields[part % len(fields)] == "quadratures" for part in wanted)
        return self if quadratures else dataclasses.replace(self, core_only=True)


@eqx.filter_jit
def _samples_and_slopes(
    variational: VariationalProblem, horizon: Horizon, settings: Settings, one_kernel: bool
) -> tuple[SampledRun, list[SampledRun]]:
    """The samples of the cells, and their derivative along each tangent."""
    cells = jnp.asarray(variational.problem.start()[0].shape[1])
    options = {"n_blocks": 1 + len(variational.tangents), "one_kernel": one_kernel}
    outcome, samples = solve_with_samples(variational, *horizon, cells, settings, **options)
    counts = (outcome.steps - outcome.rejected, outcome.rejected, outcome.extremes.T)
    return _found(variational, samples, (outcome.end_time, outcome.state, outcome.status), counts)


def _found(
    variational: VariationalProblem,
    samples: Float[Array, "*cells times components"],
    ends: tuple[Float[Array, "*cells"], Float[Array, "components *cells"], Int[Array, "*cells"]],
    counts: tuple[Int[Array, "*cells"], Int[Array, "*cells"], Float[Array, "*cells 3"]],
) -> tuple[SampledRun, list[SampledRun]]:
    """The samples and their derivative along each tangent, given the time, the state and the status at which the runs
    ended."""
    states, *variations = jnp.split(samples, 1 + len(variational.tangents), axis=-1)
    time, end, status = ends
    end, *end_variations = variational.parts(end)

    def end_time(problem: AbstractProblem, state: Float[Array, "components *cells"]) -> Float[Array, "*cells"]:
        return event_time(problem, lambda point: problem.domain_margin(time, point), time, state)

    def slope(direction: Tangent, variation: Array, at_end: Array) -> SampledRun:
        if variational.problem.domain_margin(time, end) is None:
            end_delay = jnp.zeros_like(time)
        else:
            end_delay = eqx.filter_jvp(end_time, (variational.problem, end), (direction, at_end))[1]
            end_delay = jnp.where((status == LEFT_DOMAIN) & (time > 0.0), end_delay, 0.0)
        changes = parted(variational.problem, jnp.where(jnp.isnan(states), 0.0, variation))
        return SampledRun(*changes, end_delay, *NOT_DIFFERENTIATED)

    slopes = [slope(*parts) for parts in zip(variational.tangents, variations, end_variations, strict=True)]
    numbers = (part.astype(float) for part in (status, *counts))
    end, _ = parted(variational.problem, jnp.moveaxis(end, 0, -1))
    return SampledRun(*parted(variational.problem, states), time, end, *numbers), slopes


class SingleSampling(AbstractSampling):
    """Samples by Diffrax, with any of its solvers."""

    in_blocks = False

    movable: int
    spec: ProblemSpec
    places: Structure = eqx.field(static=True)

    def built(self, spec: ProblemSpec, numbers: tuple[Array, ...], cells: int | None) -> AbstractProblem:
        return spec.of(numbers, None)

    def sampled(
        self, built: AbstractProblem, tangents: Tangents, horizon: Horizon, spec: ProblemSpec, nested: bool
    ) -> tuple[SampledRun, list[SampledRun]]:
        variational, (_, t1) = VariationalProblem(built, tangents, False), horizon
        path = sample(variational, *horizon, spec.settings, grid=spec.grid)
        ends = (path.end_time, path.end_state, _status(path, t1))
        counts = (path.accepted, path.rejected, jnp.asarray(NO_EXTREMES))
        samples, slopes = _found(variational, path.states.T, ends, counts)

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
