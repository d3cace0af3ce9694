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
from jaxtyping import Array, Float, Int, PyTree

from .. import sweeps
from ..compilation.tracing import TracedFunction
from ..compilation.xla_cpu import programs_in
from ..derivatives import tangent_scale, tangents_by
from ..hybrid import HybridOutcome
from ..integration import Outcome, solve_by_diffrax
from ..integration.problem import DEFAULT_MAX_STEPS, Settings, Status
from ..kernels import CELLS_OF_KERNEL, chosen_gpu, place_of_jax, require_device
from ..sweeps import Axis, Table, Variable, axis, cells_to_check, chunk_for, scattered_cells, size_of
from ..sweeps.grid import EQUATIONS, FOR_A_TIME, REMARK, SHOWN_IN, Values, columns
from ..sweeps.table import LOCATED, NUDGE, cells_with, errors_of, other_tolerances
from ..text import shown, unit_of
from ..validation import as_number, explaining, require_flag, require_outside, require_whole, warn
from .event import SILENT, Ensemble, Event, counted, modes_of, status_of
from .model import AbstractModel, AbstractSceneModel, Number, check_horizon, model_of, require_event, settings_for_lanes
from .simulate import Samples, samples_of

# The cells of a table: event times, how and where runs end, samples, error bounds and derivatives.

#: The words for how a run ends, in the order of `Status`.
WORDS = tuple(status.word for status in sorted(Status)[1:])

#: Descriptions of the counters of every run.
COUNTED = {"steps": "steps", "rejected": "rejected steps"}


#: The parameters of some cells, or their results: name -> values.
Cells = dict[str, Values]


class TableForm(NamedTuple):
    """The names in a table of a kind of model.

    - `named`: statuses in place of others.
    - `event`: what the event is, for descriptions of variables.
    - `run`: the word for a run in descriptions.
    - `time`, `of_time`: name and description of the variable of the event's time; `order`: the variables in order, by default
      as they come.
    - `left_open`: what a run that ends at the first event leaves open, if it is to be said.
    - `nan_if_failed`: whether the time of a run without a result is NaN; otherwise it is infinite.
    """

    named: dict[Status, Status] | None = None
    event: str = "event"
    nan_if_failed: bool = True
    time: str = "time"
    of_time: str = "time of the event"
    run: str = "run"
    order: tuple[str, ...] | None = None
    left_open: str = ""

    @property
    def codes(self) -> np.ndarray:
        """The integer in a table for each integer of `Status` from 0 on."""
        named = self.named or {}
        return np.array([named.get(status, status) for status in sorted(Status)[1:]], np.int8)


class TableJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process.

    - `model`: with scalars; `form`: the names in the table.
    - `t1`: horizon [s]; `crossing`: "first", "last", "both" or "after"; `settings`: those of the integration.
    - `slopes`: full name of a parameter -> name of the variable with the derivative of the time.
    - `errors`: whether to run every cell again at other tolerances.
    - `samples`: the quantities at given times, or `None`; `timed`: whether runs are timed, not only sampled.
    - `by_diffrax`: whether Diffrax solves smooth runs, one by one, as a slow reference.
    - `nudge`: relative change of the initial states of runs with resets, which shows how resets amplify round-off.
    - `listed`: the numbers of scattered cells, which the results include; without a grid, the only axis counts the cells.
    """

    model: AbstractModel
    form: TableForm
    t1: float
    crossing: str
    settings: Settings
    slopes: dict[str, str] | None = None
    errors: bool = False
    samples: Samples | None = None
    timed: bool = True
    by_diffrax: bool = False
    nudge: float = 0.0
    listed: tuple[Axis, ...] = ()

    @property
    def times(self) -> tuple[str, ...]:
        """The variables that are times of events."""
        if not self.model.has_event and self.form.order is None:
            return ()
        return ("first_time", "last_time") if self.crossing == "both" else (self.form.time,)

    @property
    def continues(self) -> bool:
        """Whether a run continues through its event."""
        own = self.model.continues and self.model.event is None and self.model.has_event
        return self.crossing != "first" or own

    @property
    def has_kernel(self) -> bool:
        """Whether a kernel can run the cells."""
        has_samples = self.samples is None or (self.samples.has_kernel and self.model.smooth)
        return has_samples and not self.by_diffrax

    @property
    def variables(self) -> dict[str, Variable]:
        """The variables of the table, without derivatives."""
        if not self.timed:
            return self.samples.variables(self.model) | self._ending({}) if self.samples is not None else {}
        event = self.form.event
        words = {f"{name}_time": f"{name} {event} time" for name in ("first", "last")}
        words[self.form.time] = self.form.of_time.format(crossing=self.crossing)
        words = {name: words[name] for name in self.times}
        words |= {name: text for name, (text, _) in self.model.further_times.items()}
        variables = {name: Variable("s", np.float64, long_name=text) for name, text in words.items()}
        variables |= self._ending({} if self.samples is not None else self.model.ends)
        if self.slopes and not self.model.smooth:
            variables |= {"grazes": Variable("1", np.int8, long_name="whether an event on the way was grazing")}
        if self.errors:
            words = {name: f"error of the {variables[name].long_name}" for name in self.bounded}
            words |= {name: f"difference of the runs in {text}" for name, text in self.model.counters.items()}
            errors = {f"{name}_error": variables[name]._replace(long_name=text) for name, text in words.items()}
            errors["status_error"] = Variable("1", np.int8, long_name="whether the runs disagree on the status")
            variables |= errors
        if self.samples is not None:
            variables |= self.samples.variables(self.model)
        return variables if self.form.order is None else {name: variables[name] for name in self.form.order}

    def _ending(self, ends: dict[str, Variable]) -> dict[str, Variable]:
        """The variables that describe how a run ended."""
        counts = COUNTED | self.model.counters
        of_end = {
            "status": Variable("1", np.int8, WORDS, long_name=f"how the {self.form.run} ended"),
            "end_time": Variable("s", np.float64, long_name=f"end of the {self.form.run}"),
        }
        return of_end | ends | {name: Variable("1", np.int64, long_name=words) for name, words in counts.items()}

    @property
    def bounded(self) -> tuple[str, ...]:
        """The variables that get error bounds."""
        ends = self.model.ends if self.samples is None else ()
        return (*self.times, *self.model.further_times, "end_time", *ends)

    def __call__(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells, of which only the first `count` are run."""
        if self.listed:
            values = [axis.values[columns["cell"]] for axis in self.listed]
            numbers, names = ([getattr(axis, key) for axis in self.listed] for key in ("number", "name"))
            job = self._replace(listed=())
            return job(dict(zip(numbers, values, strict=True)), count) | dict(zip(names, values, strict=True))
        size = next((len(values) for values in columns.values()), 1)
        with place_of_jax(size, self.settings.device):
            return self._of_cells(columns, count)

    def _of_cells(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells of a grid, of which only the first `count` are run."""
        if self.by_diffrax and count == 0:
            # Diffrax always computes a whole chunk, so a call only to compile would compute the first chunk twice.
            return {}
        legal = self.model.legal_cells(columns)
        # Without columns, there is one cell.
        legal = None if legal is None else np.atleast_1d(legal)
        if legal is None or legal[:count].all():
            return self._of_legal(columns, count)
        # The legal cells come first, and only they run: with the same program as any others.
        order = np.argsort(~legal | (np.arange(len(legal)) >= count), kind="stable")
        ordered = {name: values[order] for name, values in columns.items()}
        variables = self._of_legal(ordered, int(legal[:count].sum()))
        results, illegal = {}, {"status": self.form.codes[Status.ILLEGAL]}
        for name, values in variables.items():
            # Illegal cells are NaN, or 0 for integers, with the status "illegal".
            values = np.asarray(values)[np.argsort(order)]
            nothing = illegal.get(name, np.nan if np.issubdtype(values.dtype, np.floating) else 0)
            is_legal = legal.reshape(-1, *(1,) * (values.ndim - 1))
            results[name] = np.where(is_legal, values, nothing).astype(values.dtype)
        return results

    def _of_legal(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells, of which only the first `count` are run, which are legal."""
        size = next((len(values) for values in columns.values()), 1)
        cells = self.model.replaced(columns)
        sampled: dict[str, Any] = {}
        if self.samples is not None:
            status, sampled = self.samples.solve(cells, self.t1, size, count, self.settings)
            sampled["status"] = self.form.codes[np.asarray(status)]
        if not self.timed:
            return sampled
        variables = self._results(cells, columns, size, count, self.slopes)
        if self.errors:
            tolerances = map(as_number, other_tolerances(float(self.settings.tolerance)))
            runs = [variables]
            for number, tolerance in enumerate(tolerances, 1):
                job = self._replace(settings=self.settings.with_tolerance(tolerance), nudge=number * NUDGE)
                runs.append(job._results(cells, columns, size, count, None))
            # Where events are located: the error of a component is relative to the largest of its unit.
            ends = self.model.ends
            least: dict[str, float | Float[np.ndarray, " cells"]] = dict.fromkeys(self.bounded, 0.0)
            has_event = (not self.model.smooth) | (variables["status"] != self.form.codes[Status.COMPLETED])
            for name in [name for name in ends if name in least]:
                alike = [np.abs(variables[other]) for other in ends if ends[other].unit == ends[name].unit]
                least[name] = LOCATED * np.where(has_event, np.max(alike, axis=0), 0.0)
            least["end_time"] = 0.0 if self.model.smooth else LOCATED * variables["end_time"]
            variables |= errors_of(runs, least, tuple(self.model.counters), self.form.codes[list(SILENT)])
        return sampled | variables

    def _results(
        self, cells: AbstractModel, columns: Cells, size: int, count: int, slopes: dict[str, str] | None
    ) -> Cells:
        """The variables of one run of every cell."""
        derivatives, grazing, settings = {}, False, self.settings
        if slopes:
            names = tuple(slopes)
            ensemble, tangents, scales = _with_tangents(
                self.model, columns, names, settings.tolerance, size, self.continues
            )
            outcome, along, grazing = ensemble.solve_with_tangents(tangents, self.t1, count, settings)
            derivatives = {
                slopes[name]: np.asarray(slope) / np.asarray(scale)
                for name, slope, scale in zip(names, along, scales, strict=True)
            }
        else:
            ensemble = Ensemble.of(cells, size, settings.tolerance, self.continues).nudged(self.nudge)
            if self.by_diffrax:
                assert ensemble.problem is not None
                outcome = solve_by_diffrax(ensemble.problem, jnp.asarray(self.t1), settings)
            else:
                outcome = ensemble.solve(self.t1, count, settings)
        status, ends = at_the_end(cells, ensemble, outcome, settings.tolerance)
        has_event = np.asarray(status) == Status.EVENT
        variables = {}
        if self.times:
            time: Any = np.where(has_event, outcome.crossing_time, np.inf)
            if self.continues and self.crossing == "first" and isinstance(outcome, Outcome):
                time = outcome.first_crossing
            is_silent = self.form.nan_if_failed & np.isin(status, SILENT)
            variables[self.times[-1]] = np.where(is_silent, np.nan, time)
        ends = ends if self.samples is None else {}
        variables |= jax.tree.map(np.asarray, ends | counted(self.model, outcome))
        variables["status"] = self.form.codes[np.asarray(status)]
        if self.crossing == "both":
            if isinstance(outcome, HybridOutcome):
                # With several modes, the first event needs a separate solve, which ends there.
                variables["first_time"] = first_events(cells, self.t1, size, count, settings, self.nudge)[1]
            else:
                is_unresolved = np.asarray(status) == Status.UNRESOLVED
                variables["first_time"] = np.where(is_unresolved, np.inf, np.asarray(outcome.first_crossing))
        for name, (_, other) in cells.further_times.items():
            if jax.tree.structure(other) == jax.tree.structure(cells) and self.crossing != "last":
                variables[name] = variables[self.times[0]]
            else:
                variables[name] = first_events(other, self.t1, size, count, settings, self.nudge)[1]
        variables |= {name: np.where(has_event, slope, 0.0) for name, slope in derivatives.items()}
        if slopes and not self.model.smooth:
            variables["grazes"] = (has_event & np.asarray(grazing)).astype(np.int8)
        return variables


def first_events(
    cells: AbstractModel, t1: Number, size: int, count: int, settings: Settings, nudge: float = 0.0
) -> tuple[Int[np.ndarray, " cells"], Float[np.ndarray, " cells"], dict[str, Array]]:
    """The `Status` of runs that end on their event, the times of the events, infinite in cells that end otherwise, and the
    variables that describe the ends. **Arguments:** `nudge`: as in `TableJob`."""
    ensemble = Ensemble.of(cells, size, settings.tolerance, False).nudged(nudge)
    outcome = ensemble.solve(t1, count, settings)
    status, ends = at_the_end(cells, ensemble, outcome, settings.tolerance)
    status = np.asarray(status)
    return status, np.where(status == Status.EVENT, outcome.crossing_time, np.inf), ends


# Compiled once for all chunks.
@eqx.filter_jit
def at_the_end(
    cells: AbstractModel, ensemble: Ensemble, outcome: Outcome | HybridOutcome, tolerance: Float[Array, ""]
) -> tuple[Array, dict[str, Array]]:
    """The `Status` of all cells, and the variables that describe their ends."""
    return status_of(cells, ensemble, outcome, tolerance), cells.at_end(outcome, ensemble.starts)


@eqx.filter_jit
def _with_tangents(
    model: AbstractModel, columns: dict[str, Any], names: tuple[str, ...], tolerance: Number, size: int, continues: bool
) -> tuple[Ensemble, tuple[Ensemble, ...], list[Float[Array, "..."]]]:
    """The runs of all cells, the tangents along the named parameters, and the scale of each tangent."""

    def build(values: tuple[Array, ...], _: int | None) -> Ensemble:
        moved = model.replaced(columns | dict(zip(names, values, strict=True)))
        return Ensemble.of(moved, size, tolerance, continues)

    cells = model.replaced(columns)
    point = tuple(jnp.asarray(cells.value(name), float) for name in names)
    ensemble, tangents, _ = tangents_by(build, tuple(range(len(names))), point, size)
    return ensemble, tangents, [tangent_scale(value) for value in point]


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
    part = part.function if isinstance(part, TracedFunction) else part
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


# A table over a grid.

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
    for name in sensitivities:
        if "[*]" in name and name not in named and not eqx.tree_equal(model, model.replaced({name: model.value(name)})):
            raise ValueError(f"sensitivities: {name!r} stands for several numbers, which differ; name them one by one")
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
