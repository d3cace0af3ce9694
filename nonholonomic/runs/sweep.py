"""Tables of many runs of any model, over a grid of its parameters and starts."""

import dataclasses
import hashlib
import re
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, PyTree

from .. import sweeps
from ..compilation.xla_cpu import programs_in
from ..integration.problem import DEFAULT_MAX_STEPS, Settings, Status, require_times
from ..kernels import CELLS_OF_KERNEL, chosen_gpu, place_of_jax, require_device
from ..sweeps import Axis, Quantity, Table, Variable, axis, cells_to_check, chunk_for, scattered_cells, size_of
from ..sweeps.grid import EQUATIONS, FOR_A_TIME, REMARK, SHOWN_IN, columns
from ..sweeps.table import cells_with
from ..text import likely, shown, unit_of
from ..validation import as_number, explaining, require_flag, require_outside, require_whole, warn
from .event import Event, modes_of
from .model import AbstractModel, AbstractSceneModel, Number, check_horizon, model_of, require_event, settings_for_lanes
from .simulate import Samples
from .table import TableForm, TableJob

# A checksum of the equations of a model, so that a table does not resume with the cells of other equations.

#: The packages whose code changes only with the version, which tables compare too.
PACKAGES = ("nonholonomic", "tippe", "stroller", "jax", "equinox")

#: The address of an object in the text of a program.
ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def has_users_code(part: object) -> bool:
    """Whether a tree of modules has a function, or a module of a class, that is not of these packages."""
    if isinstance(part, eqx.Module):
        if type(part).__module__.partition(".")[0] not in PACKAGES:
            return True
        return any(has_users_code(getattr(part, field.name)) for field in dataclasses.fields(part))
    if isinstance(part, tuple | list | dict):
        return any(map(has_users_code, part.values() if isinstance(part, dict) else part))
    # Functions can also be compiled or methods. An object that can be called, such as a partial function, has data.
    is_own = str(getattr(part, "__module__", "")).partition(".")[0] in PACKAGES
    return callable(part) and not (is_own and hasattr(part, "__qualname__"))


def checksum_of(model: AbstractModel) -> str:
    """A checksum of the operations that compute the rates, the events and the resets of a model, and of the constants in them,
    but not of its parameters."""
    arrays, static = eqx.partition(model, eqx.is_array)

    def equations(arrays: PyTree) -> list[Array | None]:
        modes, _, state = modes_of(eqx.combine(arrays, static), 1, jnp.asarray(1e-9), ())
        parts, time = [], jnp.zeros(1)
        for mode in modes:
            problem = mode.problem(state)
            values = (problem.field(time, state), problem.event_function(state), problem.domain_margin(time, state))
            parts += [values, mode.reset_map(state, jnp.ones(1))]
        return parts

    program = jax.make_jaxpr(equations)(arrays)
    checksum = hashlib.sha256(ADDRESS.sub("", str(program)).encode())
    # The text of a program does not show all digits of the constants.
    for inner in programs_in(program):
        parts = getattr(inner, "consts", ())
        for equation in inner.eqns:
            literals = [operand.val for operand in equation.invars if isinstance(operand, Literal)]
            parts = [*parts, *literals, *jax.tree.leaves(list(equation.params.values()))]
        for array in (np.asarray(part) for part in parts if isinstance(part, Array | np.ndarray | np.generic)):
            checksum.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return checksum.hexdigest()[:16]


#: Greatest number of values in the samples of a chunk: 256 MB.
MOST_SAMPLED = 1 << 25

#: Smallest number of cells in a chunk of a large table of an own system.
LEAST_CHUNK = 1024

#: A table warns of cells with more steps than this, and more than this multiple of the median.
SLOW_STEPS, SLOW = 10_000, 30


class Options(NamedTuple):
    """The options of every table; see `sweep`."""

    tolerance: float = 1e-9
    solver: diffrax.AbstractERK | None = None
    max_steps: int = DEFAULT_MAX_STEPS
    scattered: bool = False
    errors: bool = False
    sensitivities: Sequence[str] = ()
    path: str | Path | None = None
    progress: bool = True
    executor: Executor | None = None
    device: str | None = None

    @property
    def settings(self) -> Settings:
        """The settings of the integration, checked."""
        require_whole(self.max_steps, "max_steps", 1)
        require_device(self.device)
        return settings_for_lanes(self.tolerance, self.solver, int(self.max_steps), self.device)


@explaining
def sweep(
    system: object,
    start: object,
    t1: float,
    *,
    axes: dict[str, object],
    event: Event = None,
    crossing: str = "first",
    times: Any = None,
    quantities: Sequence[str] = (),
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    scattered: bool = False,
    max_steps: int = DEFAULT_MAX_STEPS,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    device: str | None = None,
    input: object = None,
    jumps: object = None,
) -> Table:
    """Event times, ends and samples of all runs over a grid of parameters, in one batched call on all cores.

    **Arguments:**

    - `system`, `start`, `event`, `tolerance`, `solver`, `input`, `jumps`: as for `event_time`. Without an event, runs end at
      `t1`.
    - `t1`: horizon [s].
    - `axes`: full name of a parameter -> values, such as `{"scene.friction.mu": [0.1, 0.2]}` or
      `{"system.modes[0].drag": [0.1, 0.2], "start[1]": [0.0, 1.0]}`; the end of a name is enough if it is unique. The
      start of an `AbstractSystem` has the names `"start.q[0]"` and `"start.rate[0]"`, and parameters of an event that is
      an `equinox.Module` have names such as `"event.level"`. `"modes[*].drag"` gives all modes that have a drag the same
      value. The first axis varies slowest.
    - `crossing`: "first"; "last" for the last fall of the event function through zero, after which the function stays
      below zero until `t1`; "both" for both times from one run.
    - `times`, `quantities`: times [s] within [0, t1] and names of quantities, to sample every run.
    - `errors`: whether to run every cell again at 1e-2 and 1e-4 of the tolerance, for error bounds.
    - `sensitivities`: names of the parameters with respect to which the times are differentiated.
    - `scattered`: whether the lists are columns of equal length instead of axes of a grid.
    - `max_steps`: a run that needs more steps, including rejected ones, fails; at least 1. In a run with resets, the
      limit applies to each time in a mode.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted sweep.
    - `progress`: whether to show progress, on a terminal or in a notebook.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes`; by default a thread
      for each core. For other processes, define classes and functions at the top level of a module.
    - `device`: "cpu" or "gpu"; by default, large tables run on a GPU if there is one ([Performance](/performance.md#gpus)).

    **Returns:** a `Table` with `time` [s] of the event, infinite without one; `status`: "event", "completed" if the
    run reached `t1`, "stopped" if a mode without a reset ended, "failed", "unresolved" (for example after 2000 resets
    of your own system), or a word of the system; `end_time` [s]; the state at the end, such as `y0`, `q0` and
    `rate0`, or `end_theta`; `steps` and `rejected`; and for a system with resets their number, such as `switches`.
    With `sensitivities`, the table also contains the derivative of `time` with respect to each parameter, such as
    `time_by_drag` for `"system.modes[0].drag"`, and for a system with resets `grazes`: 1 if the derivative is NaN
    because the margin of a mode only touched zero. With `errors`, `time_error` and so on are bounds: infinite if the
    runs disagree on the status. With `times`, the table contains the quantities, NaN after the end of a run, in
    place of the ends; without an event, runs are only sampled.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> decay = nonholonomic.Hybrid([Decay(rate=2.0)], event=lambda t, y: y[0] - 0.5)
    >>> table = nonholonomic.sweep(decay, [1.0], t1=1.0, axes={"rate": [0.5, 1.0, 2.0]}, progress=False)
    >>> print(table.time.round(6), table.status)
    [     inf 0.693147 0.346574] ['completed' 'event' 'event']

    ```
    """
    require_outside((system, start, t1, axes, input), "sweep", "simulate or event_time")
    if crossing not in ("first", "last", "both"):
        raise ValueError(f"crossing = {shown(crossing)} must be 'first', 'last' or 'both'")
    model = model_of(system, start, event, input, jumps)
    check_horizon(t1, tolerance)
    samples = samples_of(model.quantities, times, quantities, t1)
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor, device)
    timed = samples is None or event is not None
    for name, option in {"errors": errors, "sensitivities": list(sensitivities)}.items() if not timed else ():
        if option:
            raise ValueError(
                f"{name} = {shown(option)}: these are {name} of the time of an event, and without event= the runs are only "
                "sampled; pass event=, or leave out times and quantities"
            )
    return table_of(model, axes, t1, options, crossing, samples=samples, timed=timed)


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


def table_of(
    model: AbstractModel,
    axes: object,
    t1: float,
    options: Options,
    crossing: str = "first",
    form: TableForm = TableForm(),  # noqa: B008  Nothing changes it.
    *,
    samples: Samples | None = None,
    timed: bool = True,
) -> Table:
    """The table of a model. **Arguments:** `axes`: as for `sweep`; the others as for `TableJob`, checked."""
    named = full_axes(axes, model.full_name)
    sensitivities = full_sensitivities(model, options.sensitivities, crossing)
    labels = model.label([*named, *(name for name in sensitivities if name not in named)])
    grid = [axis(labels[name][0], name, labels[name][1], values, labels[name][2]) for name, values in named.items()]
    slopes = {name: f"time_by_{labels[name][0]}" for name in sensitivities}
    job = TableJob(model, form, float(t1), crossing, options.settings, slopes, options.errors, samples, timed)
    check_cells(model, grid, options)
    request = {"t1": float(t1)} | ({} if crossing == "first" else {"crossing": crossing})
    return compute_table(job, grid, request, options)


def full_axes(axes: object, full_name: Callable[[str, str], str]) -> dict[str, PyTree]:
    """The axes of a grid under full names; a name may be the end of a full name, such as `"offset"`.

    **Arguments:** `axes`: name -> values; `full_name`: function of the argument and a name, as of an `AbstractModel`.

    **Raises:** `ValueError` for anything but a dictionary, for a name that matches none or several parameters, and for a
    parameter that is named twice.
    """
    if not isinstance(axes, dict) or not all(isinstance(name, str) for name in axes):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, name of a number -> values")
    by_full_name = {full_name("axes", name): values for name, values in axes.items()}
    if len(by_full_name) < len(axes):
        raise ValueError(f"axes = {', '.join(axes)}: a number is named twice")
    return by_full_name


def full_sensitivities(model: AbstractModel, names: object, crossing: str) -> list[str]:
    """The full names of the parameters with respect to which to differentiate, checked."""
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"sensitivities = {shown(names)} must be a list of names, such as ['scene.friction.mu']")
    full_names = [model.full_name("sensitivities", name) for name in names]
    if len(set(full_names)) < len(full_names):
        raise ValueError(f"sensitivities = {shown(names)} must name every parameter only once")
    if full_names:
        require_event(model, "sensitivities are those of the event's time: ")
        model.require_differentiable(False, crossing == "last")
        if crossing == "both":
            raise ValueError(
                "crossing = 'both' must be 'first' or 'last' for sensitivities, which differentiate one time"
            )
    return full_names


def check_cells(model: AbstractModel, grid: list[Axis], options: Options) -> None:
    """Raise `ValueError` unless the model may run in every cell of a grid."""
    require_flag(options.errors, "errors")
    require_flag(options.scattered, "scattered")
    model.check_axes(grid, [scattered_cells(grid)] if options.scattered else cells_to_check(grid))


def compute_table(job: TableJob, grid: list[Axis], request: dict[str, Any], options: Options) -> Table:
    """Compute the cells of a grid, which were checked.

    **Arguments:** `request`: the request of the table, without the model, the samples and the options.
    """
    variables, slopes = job.variables, job.slopes or {}
    for name, (_, unit, _) in job.model.label([*slopes]).items():
        slope, inverse = slopes[name], f"{unit}-1" if unit.isalpha() else f"({unit})-1"
        unit = "s" if unit == "1" else f"s {inverse}"
        variables |= {slope: Variable(unit, np.float64, long_name=f"{job.form.event} time by {name}")}
    request = job.model.description() | {axis.number: "an axis" for axis in grid} | request
    integrator = job.settings.for_single_runs if job.by_diffrax else job.settings.for_lanes
    request |= {"tolerance": float(options.tolerance), "solver": type(integrator).__name__}
    request |= {SHOWN_IN: unit_of(job.model), REMARK: "" if job.continues else job.form.left_open}
    if job.crossing == "both" and job.form.named is not None:
        request[FOR_A_TIME] = [job.form.named[status].word for status in (Status.EVENT, Status.COMPLETED)]
    request |= {"max_steps": int(options.max_steps), "errors": bool(options.errors), "sensitivities": list(slopes)}
    if options.path is not None and has_users_code(job.model.__reduce__()[1]):
        request |= {EQUATIONS: checksum_of(job.model)}
    if options.scattered:
        checksum = hashlib.sha256()
        for axis in grid:
            checksum.update(axis.number.encode() + np.ascontiguousarray(axis.values, float).tobytes())
        request |= {"cells": checksum.hexdigest()[:16]}
        variables = {axis.name: Variable(axis.unit, np.float64, long_name=axis.long_name) for axis in grid} | variables
        job = job._replace(listed=tuple(grid))
        grid = [Axis("cell", "cell", "1", np.arange(len(grid[0].values)), "cell")]
    cells, is_scene = size_of(grid), isinstance(job.model, AbstractSceneModel)
    chunk = None if is_scene or cells <= 4 * LEAST_CHUNK else max(LEAST_CHUNK, chunk_for(cells))
    by_kernel = job._replace(settings=dataclasses.replace(job.settings, device="gpu"))
    of_kernel = min(CELLS_OF_KERNEL, 1 << (cells - 1).bit_length())
    uses_kernel = job.has_kernel and chosen_gpu(
        cells, options.device, lambda: by_kernel(columns(grid, 0, of_kernel), 0)
    )
    if uses_kernel:
        job, chunk = by_kernel, of_kernel
    elif options.device == "gpu":
        job = job._replace(settings=dataclasses.replace(job.settings, device="cpu"))
        if not job.has_kernel:
            warn("device = 'gpu': no kernel computes these samples, or runs by Diffrax; the table runs on the CPU")
    inner, most = [], None
    if job.samples is not None:
        request |= {"quantities": list(job.samples.names)}
        inner = job.samples.inner(job.model)
        # A run has about a dozen components. A kernel keeps the quantities alone, most of which have up to three.
        numbers = (3 * len(job.samples.names) if uses_kernel else 12) * len(job.samples.times)
        most = max(16, 1 << (MOST_SAMPLED // numbers).bit_length() - 1)
    running = {"path": options.path, "progress": options.progress, "executor": options.executor}
    with place_of_jax(cells, job.settings.device):
        table = sweeps.sweep(job, grid, variables, request, chunk=chunk, most=most, inner=inner, **running)
    illegal = cells_with(table, "status", Status.ILLEGAL.word)
    if len(illegal):
        values = {name: float(value[0]) for name, value in columns(grid, int(illegal[0]), 1).items()}
        if job.listed:
            values = {axis.number: float(axis.values[illegal[0]]) for axis in job.listed}
        reason = ""
        try:
            job.model.replaced(values).check()
        except ValueError as error:
            named = ", ".join(f"{name} = {value:.6g}" for name, value in values.items())
            reason = f"; {'the first is at ' * bool(named)}{named}: {error}"
        warn(f"{len(illegal)} of {cells} cells are illegal: results are NaN, and their status is 'illegal'{reason}")
    # The coordinates of scenes are regular.
    if "steps" in table and not is_scene:
        steps = np.ravel(table["steps"])
        slow = steps > max(SLOW_STEPS, SLOW * float(np.median(steps)))
        if np.any(slow):
            warn(
                f"{np.sum(slow)} of {cells} cells need more than {SLOW} times as many steps as others, up to {np.max(steps)}: "
                "simulate one of them; it warns if its coordinates are singular, like Euler angles at their pole"
            )
    return table
