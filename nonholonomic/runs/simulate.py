"""Simulate one run of any model."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Num

from ..compilation.xla_cpu import compiled_alone, compiled_for_one
from ..derivatives import SampledRun, sampled_run
from ..hybrid import HybridOutcome, hybrid_samples, solve_hybrid_with_samples
from ..integration.problem import AbstractProblem, Settings, Status, legal_run, require_times
from ..integration.samples import Times, solve_with_samples
from ..integration.scheduler import Outcome, of_cells
from ..kernels import by_kernel, solve_smooth_with_samples
from ..sweeps import Axis, Quantity, Variable
from ..terminal import status_line
from ..text import likely, shown
from ..validation import as_known, as_number, explaining, is_traced, nan_unless, warn
from .event import counted, modes_of, problem_of
from .model import AbstractModel, Names, Number, Start, check_run, model_of, run_of, settings_for_lanes
from .trajectory import Trajectory

# Quantities of many runs at given times, in lanes.

#: Tables with at least this many samples interpolate them inside steps. Runs often take about as many steps; tables of
#: runs with many more steps take up to a sixth longer, those with fewer up to two thirds less time.
DENSE = 1000


#: The `Status` of runs, and the variables of their table.
Solved = tuple[Int[Array, " cells"], dict[str, Array]]


@dataclasses.dataclass(frozen=True)
class Samples:
    """The samples in a table: the times [s], and the names of the quantities."""

    #: The name and the unit of the axis along the samples.
    along: ClassVar[tuple[str, str]] = ("time", "s")

    #: Whether a kernel can take these samples of smooth runs.
    has_kernel: ClassVar[bool] = True

    times: Num[np.ndarray, " times"]
    names: tuple[str, ...]

    def variables(self, model: AbstractModel) -> dict[str, Variable]:
        """The variables of the table with the quantities."""
        variables = {}
        for name in self.names:
            unit, long_name, components, *_ = model.quantities[name]
            dims = (self.along[0], components) if components else self.along[:1]
            variables[name] = Variable(unit, np.float64, inner=dims, long_name=long_name)
        return variables

    def inner(self, model: AbstractModel) -> list[Axis]:
        """The dimensions of these variables."""
        dims = dict.fromkeys(model.quantities[name].components for name in self.names)
        vectors = [Axis(dim, dim, "1", np.array(model.components[dim])) for dim in dims if dim is not None]
        name, unit = self.along
        return [Axis(name, name, unit, self.times, name), *vectors]

    def solve(self, cells: AbstractModel, t1: float, size: int, count: int, settings: Settings) -> Solved:
        """The `Status` of all cells, of which only the first `count` are run, and the variables of the table."""
        names, times = self.names, jnp.asarray(self.times, float)
        horizon = (jnp.asarray(t1, float), jnp.asarray(count), settings)
        if cells.smooth:
            problem, read = problem_of(cells, size, names), OfOneRun(cells, names)

            def solve(gpu: Any) -> tuple[Outcome, dict[str, Array]]:
                return solve_smooth_with_samples(problem, self.times, *horizon, run=gpu, read=read)

            solved = by_kernel(solve, settings.device, count)
            if solved is None:
                outcome, status, values = _followed(problem, cells, names, times, horizon)
            else:
                outcome, values = solved
                status = cells.ended(outcome, settings.tolerance)
            values |= counted(cells, outcome)
        else:
            start, counters = modes_of(cells, size, settings.tolerance, names), len(cells.counters)
            run, _ = solve_hybrid_with_samples(*start, times, *horizon, counters=counters)
            status, values = _read_samples(cells, names, times, run, settings.tolerance)
        return status, jax.tree.map(np.asarray, values)


def samples_of(known: dict[str, Quantity], times: Any, quantities: Any, t1: Number | None) -> Samples | None:
    """The samples of a table, checked. **Arguments:** `known`: the quantities of the model."""
    if times is None and not len(quantities):
        return None
    if times is None or isinstance(quantities, str) or not isinstance(quantities, Sequence) or not quantities:
        raise ValueError(f"quantities = {shown(quantities)} must be a list of names, with the times to sample them")
    require_names(known, quantities)
    require_times(as_number(times), t1)
    return Samples(np.asarray(times, float), tuple(quantities))


def require_names(known: dict[str, Quantity], quantities: Sequence[str]) -> None:
    """Raise `ValueError` unless this is a list of names of quantities, each named once."""
    if isinstance(quantities, str) or not isinstance(quantities, Sequence):
        raise ValueError(f"quantities = {shown(quantities)} must be a list of names")
    for name in quantities:
        if name not in known:
            raise ValueError(f"quantities: {shown(name)} must be one of {', '.join(known)}{likely(name, known)}")
        if list(quantities).count(name) > 1:
            raise ValueError(f"quantities: {shown(name)} must be named only once")


class OfOneRun(eqx.Module):
    """The named quantities of a state of one run, (components, 1), of a model whose numbers have the run in their last axis."""

    model: AbstractModel
    names: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, state: Float[Array, "components 1"]) -> dict[str, Array]:
        model = of_cells(self.model, 0)
        return model.read(self.names, jnp.asarray(jnp.nan), state[:, 0], None)


# Compiled on its own, not inside other transformed functions; otherwise it does not get the compiler's options.
@compiled_alone
def _followed(
    problem: Any, cells: AbstractModel, names: tuple[str, ...], times: Times, horizon: tuple[Array, Array, Settings]
) -> tuple[Outcome, Int[Array, " cells"], dict[str, Float[Array, "cells times ..."]]]:
    """The outcome of the runs, their `Status`, and the named quantities at the samples."""

    def read(cell: Int[Array, "*lanes"], states: Float[Array, "rows components *lanes"]) -> dict[str, Array]:
        of_lanes = of_cells(cells, cell)
        return eqx.filter_vmap(
            lambda model, states: model.read(names, jnp.full(len(states), jnp.nan), states.T, None),
            in_axes=(own_axis, -1),
            out_axes=1,
        )(of_lanes, states)

    options: Any = {"one_kernel": True, "read": read, "dense": len(times) >= DENSE}
    outcome, samples = solve_with_samples(problem, times, *horizon, **options)
    return outcome, cells.ended(outcome, horizon[-1].tolerance), samples


def own_axis(leaf: Any) -> int | None:
    return 0 if eqx.is_array(leaf) and leaf.ndim else None


def modes_of_run(modules: tuple[AbstractModel, Names], tolerance: Array, cells: int) -> Start:
    """The modes of some runs, as `hybrid_samples` builds them."""
    model, names = modules
    return modes_of(model, cells, tolerance, names)


def nan_where(is_missing: Bool[Array, " times"], values: dict[str, Array]) -> dict[str, Array]:
    """Quantities, the times along the first axis, with NaN at some times."""
    return {
        name: jnp.where(is_missing.reshape(-1, *[1] * (value.ndim - 1)), jnp.nan, value)
        for name, value in values.items()
    }


def mode_at(number: Float[Array, "..."]) -> Int[Array, "..."]:
    """The index of the mode at each sample, -1 between two modes and after the end."""
    return jnp.where(jnp.isnan(number), -1, number).astype(int)


def outcome_of(samples: SampledRun) -> HybridOutcome[Array]:
    """How sampled runs, with the cells along the first axis, have ended."""
    parts = (samples.status, samples.steps, samples.rejected)
    status, steps, rejected = (jax.lax.stop_gradient(part).astype(int) for part in parts)
    mode, counts = samples.end_mode, samples.counts
    mode = jnp.zeros_like(status) if mode is None else mode.astype(int)
    counts = jnp.zeros((0, len(mode)), int) if counts is None else counts.astype(int).T
    ending = (jnp.full_like(samples.end_time, jnp.inf), samples.end_time, samples.end_state.T)
    extremes = jax.lax.stop_gradient(samples.extremes).T
    return HybridOutcome(status, *ending, steps, rejected, extremes, mode, jnp.zeros_like(status), counts)


@eqx.filter_jit
def _read_samples(
    cells: AbstractModel, names: tuple[str, ...], times: Times, samples: SampledRun, tolerance: Float[Array, ""]
) -> Solved:
    """The `Status` of runs of several modes, and the variables of the table."""

    def of_cell(model: AbstractModel, rows: Array, number: Array, end_time: Array) -> dict[str, Array]:
        return nan_where(times > end_time, model.read(names, times, rows.T, mode_at(number)))

    outcome = outcome_of(samples)
    axes = (own_axis, 0, 0, 0)
    values = eqx.filter_vmap(of_cell, in_axes=axes)(cells, samples.states, samples.number, samples.end_time)
    return cells.ended(outcome, tolerance), values | counted(cells, outcome)


#: Default number of times to report.
DEFAULT_TIMES = 201

#: A run warns of steps that are shorter than this fraction of its longest step, if its mean step is below the second one.
SHORT, MEAN = 1e-6, 0.05


@explaining
@status_line("simulating")
def simulate(
    system: object,
    start: object,
    t1: Float[ArrayLike, ""],
    times: Float[ArrayLike, " times"] | Sequence[float] | None = None,
    tolerance: Float[ArrayLike, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    input: object = None,
    jumps: object = None,
) -> Any:
    """Simulate one run of a system to `t1`; works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and their compositions.

    A run continues through all resets and through the system's event. Derivatives use the saltation matrix at resets.

    **Arguments:**

    - `system`, `start`, `tolerance`, `input`, `jumps`: as for `event_time`.
    - `t1`: end of the run [s], positive.
    - `times`: times [s] to report, increasing, within [0, t1]; by default those of `tippe.simulate` for a top, and
      otherwise 201 equally spaced ones.
    - `solver`: an explicit Runge-Kutta solver of Diffrax; for scenes as for `tippe.simulate` and `stroller.simulate`.
    - `adjoint`: for scenes, `RecursiveCheckpointAdjoint()` or `ForwardMode()` of Diffrax.

    A run of your own system may have at most 2000 resets; then it ends as "unresolved". Inside transformations, samples after
    the end of a run are NaN, and their derivatives 0, so that a loss can leave them out.

    **Returns:** a `tippe.Trajectory`, a `stroller.Trajectory` or, for your own system, a `nonholonomic.Trajectory`;
    `run[name]` is a quantity at the times, and `status` states how the run ended.

    **Raises:** `ValueError` for arguments out of range, times that do not increase, functions that return a wrong type
    or shape, and second derivatives through resets.

    **Example:** a pendulum as an `AbstractSystem`.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Pendulum(nonholonomic.AbstractSystem):
    ...     length: float
    ...     dimension = 1
    ...
    ...     def metric(self, q):
    ...         return jnp.array([[self.length**2]])
    ...
    ...     def potential(self, q):
    ...         return -9.81 * self.length * jnp.cos(q[0])
    >>> run = nonholonomic.simulate(Pendulum(length=1.0), ([0.1], [0.0]), t1=2.0, times=[1.0, 2.0])
    >>> print(f"{run.status}, {run.state[-1, 0]:.6f} rad, {run.state[-1, 1]:.6f} rad/s")
    completed, 0.099974 rad, 0.007169 rad/s

    ```
    """
    model = model_of(system, start, None, input, jumps)
    check_run(model, t1, tolerance)
    return run_of(model, t1, times, tolerance, solver, adjoint)


def simulate_model(
    model: AbstractModel,
    t1: ArrayLike,
    times: ArrayLike | Sequence[float] | None,
    tolerance: ArrayLike,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory:
    """The run of your own system. It continues through its event, which only its page shows.

    **Arguments:** as for `run_of`; `adjoint` is not used.
    """
    times = evenly_spaced(as_known(t1)) if times is None else times
    require_times(times, t1)
    settings = settings_for_lanes(tolerance, solver)
    eventless = model.without_event()
    unchecked = is_traced((eventless, times, t1, tolerance))
    # Inside `jit`, a new array is traced.
    is_alone = not is_traced((as_number(0.0), eventless, times, t1, tolerance))
    run_sampled = _sampled_alone if eventless.compiles_slowly and is_alone else _sampled
    run, extremes = run_sampled(eventless, as_number(times), as_number(t1), settings, unchecked)
    if not is_traced(extremes):
        shortest, time, longest, end_time = np.asarray(extremes)
        # At a kink, only a few steps are short.
        if shortest < SHORT * longest and end_time < MEAN * longest * int(run.steps):
            warn(
                f"most of {int(run.steps)} steps are short; near t = {time:.6g} s, they get as short as {shortest:.1g} s, and "
                f"elsewhere they are up to {longest:.1g} s long: are the coordinates singular there, like Euler angles at "
                "their pole, or does a function jump? Errors may exceed the tolerance by far, and derivatives leave out a jump "
                "that depends on the state: let it end a mode of a Hybrid"
            )
    return dataclasses.replace(run, model=model)


def evenly_spaced(t1: Number) -> Float[Array, " times"]:
    """The default times of output; known inside a transformation if `t1` is known."""
    return jnp.linspace(0.0, t1, DEFAULT_TIMES) if is_traced(t1) else as_known(np.linspace(0.0, t1, DEFAULT_TIMES))


class SampledRows(eqx.Module):
    """A run at given times, inside a transformation.

    - `rows`: the output rows, (rows, times), NaN after the end, of a smooth run without passive components; `passive`:
      the passive components of a smooth run, if any, which are not integrated unless they are used.
    - `mode`: the index of the mode at each time, or `None`.
    - `outcome`: how the run ended, as that of one cell.
    """

    rows: Float[Array, "rows times"]
    passive: Float[Array, "passive times"] | None
    mode: Int[Array, " times"] | None
    outcome: HybridOutcome[Array]


def sampled(
    model: AbstractModel,
    names: Names,
    times: Times,
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> SampledRows:
    """A run at given times, with derivatives that take part in step-size control.

    **Arguments:**

    - `names`: the quantities that will be read, or `None`.
    - `grid`: the ends of the steps [s] of a solver without an error estimate; `adjoint`: how Diffrax differentiates.
    - The others as for `simulate`, legal.
    """
    if model.smooth:
        prepared, in_lanes = model.for_lanes() if adjoint is None else (model, False)
        options = {"adjoint": adjoint, "arrays_in_lanes": in_lanes}
        run = sampled_run(problem_of_run, (prepared, names), times, t1, settings, grid, **options)
    else:
        run = hybrid_samples(modes_of_run, (model, names), times, t1, settings, len(model.counters))
    outcome = outcome_of(jax.tree.map(lambda part: part[None], run))
    passive = None if run.quadratures is None else run.quadratures.T
    return SampledRows(run.states.T, passive, None if run.number is None else mode_at(run.number), outcome)


def sampled_if_legal(
    model: AbstractModel,
    times: Times,
    t1: Float[Array, ""],
    settings: Settings,
    grid: Float[Array, " steps"] | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    were_checked: bool = False,
) -> tuple[Bool[Array, ""], Int[Array, ""], SampledRows]:
    """Whether all numbers, which may be traced, are legal; how the run ended, as an integer of `Status`; and the run with the
    rows for all quantities, of zero length if the numbers are not legal, unless there is a `grid`.

    **Arguments:** `were_checked`: whether the numbers were checked, so that the program need not contain the rules; the others
    as for `sampled`.
    """
    if were_checked:
        run = sampled(model, None, times, t1, settings, grid, adjoint)
        return jnp.asarray(True), model.ended(run.outcome, settings.tolerance)[0], run
    is_legal, horizon, tolerance = legal_run(model.legal(), t1, settings.tolerance, times)
    if grid is None:
        t1, times = horizon, jnp.where(is_legal, times, 0.0)
    if adjoint is not None:
        # An illegal run has zero length, but Diffrax would differentiate it.
        model = nan_unless(is_legal, model)
    settings = settings.with_tolerance(tolerance)
    run = sampled(model, None, times, t1, settings, grid, adjoint)
    # The derivatives of a run of zero length are 0; here, those of an illegal run become NaN.
    numbers = [leaf for leaf in jax.tree.leaves(model) if eqx.is_inexact_array(leaf)]
    changes = [jnp.where(jnp.isfinite(leaf), leaf - jax.lax.stop_gradient(leaf), 0.0) for leaf in numbers]
    change = jnp.where(is_legal, 0.0, jnp.nan) * sum(map(jnp.sum, changes))
    status = jnp.where(is_legal, model.ended(run.outcome, tolerance)[0], int(Status.ILLEGAL))
    # Selected, so that what is not a number in the cotangents of a legal run does not reach the sum.
    return is_legal, status, dataclasses.replace(run, rows=jnp.where(is_legal, run.rows, run.rows + change))


def problem_of_run(modules: tuple[AbstractModel, Names], cells: int | None) -> AbstractProblem:
    """The problem of a run, as `sampled_run` builds it."""
    model, names = modules
    return problem_of(model, cells, names)


def _run_and_extremes(
    model: AbstractModel, times: Float[Array, " times"], t1: Float[Array, ""], settings: Settings, unchecked: bool
) -> tuple[Trajectory, Float[Array, "4"]]:
    """The run, or NaN and "illegal" if a traced number is out of range; and the extremes of its steps, as in
    `integration.Outcome`, and its end [s], which are known inside `grad`. **Arguments:** `unchecked`: whether a number is
    traced."""
    is_legal, status, samples = sampled_if_legal(model, times, t1, settings, were_checked=not unchecked)
    outcome, names = samples.outcome, model.names
    values = model.read(names, times, nan_unless(is_legal, samples.rows), samples.mode)
    is_reached = is_legal & jnp.all(jnp.isfinite(samples.rows), axis=0)
    mode = jnp.where(is_reached, 0 if samples.mode is None else samples.mode, -1)
    run = Trajectory(
        t=times,
        state=jnp.stack([values[name] for name in names], axis=-1),
        mode=mode,
        end_time=nan_unless(is_legal, outcome.end_time[0]),
        switches=sum((count[0] for count in outcome.counts), jnp.zeros((), int)),
        steps=outcome.steps[0],
        rejected=outcome.rejected[0],
        code=status,
        model=model,
        t1=t1,
        settings=settings,
        names=names,
    )
    return run, jax.lax.stop_gradient(jnp.append(outcome.extremes[:, 0], outcome.end_time[0]))


_sampled, _sampled_alone = eqx.filter_jit(_run_and_extremes), compiled_for_one(_run_and_extremes)
