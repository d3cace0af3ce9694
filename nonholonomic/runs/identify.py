"""Fits of any model: their data, and the predictions that are compared with the data."""

import contextlib
import dataclasses
import itertools
import math
import warnings
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import greatest
from ..identification.posterior import Free, LogDensity, Measurements, Prior, as_free, own_name
from ..identification.recording import AbstractData, AbstractRecording, Quantities, as_quantity, numbered
from ..identification.result import Identification, check_search, most_likely
from ..integration.problem import MOST_STEPS, Settings, tolerance_bound
from ..parameters import full_name, require_apart
from ..sweeps.running import workers
from ..terminal import status_line
from ..text import in_unit, likely, shown, unit_of
from ..validation import as_number, explaining, nan_unless, require
from .event import SILENT, Event, time_of_event
from .model import AbstractModel, check_run, model_of, require_event
from .simulate import sampled
from .table import first_events

# Data of fits of any model: recorded runs, and times of events.

#: Number of standard errors after `t1` in which an event is still predicted.
BEYOND = 8.0

#: Quantities with a period of a whole turn.
ANGLES = frozenset({"azimuth", "eta", "heading", "spin_angle"})


class Recording(AbstractRecording):
    """A recorded run: quantities of a state, sampled at the times of a clock.

    **Arguments:**

    - `launch`: the start, as for `simulate`.
    - `times`: (times,), increasing.
    - `value`: (times,) for a single quantity, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: names of the recorded quantities, such as "theta", "speed", "y0" or ("q0", "q1"); a component of a
      vector is "position.x".
    - `t0`: the clock's reading at the start.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for outliers; `None`:
      Gaussian.
    - `side`: "before" or "after": the state that a sample at the time of a reset is; a level after a dose is "after".
    - `input`, `jumps`: the input of a run and the times [s] at which it jumps, as for `event_time`.

    **Raises:** `ValueError` for shapes that do not fit.

    **Example:**

    >>> import nonholonomic
    >>> heights = nonholonomic.Recording([1.0, 0.0], [0.1, 0.2], [0.95, 0.80], 0.01, "y0")
    >>> heights.labels
    ('y0(0.1 s)', 'y0(0.2 s)')
    """

    quantity: str | tuple[str, ...] = eqx.field(static=True, default="y0", converter=as_quantity)
    input: Any = None
    jumps: Sequence[float] | Array | None = None
    quantities: ClassVar[Quantities] = Quantities({}, {}, ANGLES)

    def model(self, system: object) -> AbstractModel:
        """The model of the recorded run, checked."""
        model = model_of(system, self.launch, None, self.input, self.jumps).without_event()
        vectors = {name: q.components for name, q in model.quantities.items() if q.components is not None}
        known = [*model.quantities, *(f"{name}.{part}" for name in vectors for part in model.components[vectors[name]])]
        for name in self.columns:
            if name not in known:
                default = " (the default)" if self.quantity == "y0" else ""
                raise ValueError(f"quantity: {name!r}{default} must be one of {', '.join(known)}{likely(name, known)}")
            if name in vectors:
                raise ValueError(f"quantity: {name!r} has several components: name them, such as '{name}.x'")
        return model


#: A number of every cell of a table.
Cells = Float[np.ndarray, " cells"]


class AbstractEventTimes(AbstractData):
    """Measured times of an event, in one series with a prediction for each.

    - `launch`: the start of the runs.
    - `time`: (n,) [s], infinite where the event did not happen while you watched; or (n, 2), two times between which the
      event happened: (0, a) before a, (b, inf) later than b, (a, b) between a and b, (t, t) at t.
    - `error`: standard errors [s], a scalar or (n,); for a limit, the error of the clock.
    - `t1`: horizon of the model's runs [s]; `until`: time [s] until which you watched, a scalar or (n,), or `None` for `t1`.
    - `student`: degrees of freedom of Student's t distribution of the errors, or `None`.
    """

    launch: Any
    time: Float[Array, "n *two"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    until: eqx.AbstractVar[Float[Array, "..."] | None]
    student: eqx.AbstractVar[Float[Array, ""] | None]

    def __check_init__(self):
        shape = np.shape(self.time)
        if not isinstance(self.time, jax.Array):
            raise ValueError(f"time = {shown(self.time)} must be a list of numbers")
        if len(shape) not in (1, 2) or shape[0] == 0 or shape[1:] not in ((), (2,)):
            raise ValueError(f"time must be a non-empty list of times or of pairs of them, not of shape {shape}")
        require(self.t1, "t1", above=0.0)
        measured = np.asarray(self.time)
        if np.any(np.isnan(measured)):
            row = int(np.argmax(np.isnan(measured).reshape(len(measured), -1).any(axis=1)))
            raise ValueError(
                f"time[{row}] = {shown(measured[row])} must be a number, infinite where the event did not happen: leave "
                "out the launch of a measurement that was lost, with its time"
            )
        if self.until is not None:
            require(self.until, "until", above=0.0)
            require(self.until, "until", at_most=self.t1, why="t1")
        first, last = self._limits
        exact = first[first == last]
        require(exact, "time", above=0.0)
        require(exact, "time", below=self.t1, why="t1")
        require(first, "time", at_least=0.0)
        require(first, "time", at_most=self.t1, why="t1")
        if np.any(last < first):
            raise ValueError(f"time = {measured[np.argmax(last < first)]} must be a time, or two in order")
        require(self.error, "error", above=0.0)
        if self.student is not None:
            require(self.student, "student", above=0.0)
        for name, value in self.of_each_time.items():
            if value is not None and np.shape(value) not in ((), shape[:1]):
                raise ValueError(
                    f"{name} must be one number or one for each of the {shape[0]} times, not of shape {np.shape(value)}"
                )

    @property
    def of_each_time(self) -> dict[str, Float[Array, "..."] | None]:
        """The numbers that may differ from time to time, by name."""
        return {"error": self.error, "until": self.until}

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The limits between which every event happened."""
        time = np.asarray(self.time)
        if time.ndim == 2:
            return time[:, 0], time[:, 1]
        until = self.t1 if self.until is None else self.until
        return np.where(np.isfinite(time), time, np.asarray(until)), time

    @property
    def measurements(self) -> Measurements:
        """The times as measurements."""
        first, last = self._limits
        is_before = (first == 0.0) & np.isfinite(last)
        student = math.inf if self.student is None else float(self.student)
        return Measurements(np.where(is_before, -np.inf, first), self.error, upper=last, student=student)

    def predicted(self, model: AbstractModel, t1: Float[Array, ""], settings: Settings) -> Float[Array, ""]:
        """The predicted time of one run."""
        return time_of_event(model, t1, settings, False)

    def of_ends(self, model: AbstractModel, t1: Cells, time: Cells, ends: dict[str, Float[Array, " cells"]]) -> Cells:
        """The predictions from a table: from the times of events, infinite without an event, and the ends of the runs."""
        return time

    @property
    def horizon(self) -> Float[Array, ""]:
        """The end of the runs [s]: beyond `t1`, so that a time that is a few errors later is still predicted."""
        return self.t1 + BEYOND * jnp.max(self.error)

    @property
    def seen(self) -> Bool[np.ndarray, " n"]:
        """Which predictions were measured: all of them."""
        return np.ones(len(self.time), bool)

    def units_of(self, model: AbstractModel) -> tuple[str, ...]:
        """The unit of the only series of the measurements."""
        return ("s",)


class EventTimes(AbstractEventTimes):
    """Measured times of the event of a run.

    **Arguments:**

    - `launch`: the start, as for `simulate`.
    - `time`: measured times [s] of runs from the same start: (n,), infinite if the event did not happen while you watched;
      or (n, 2), two times between which the event happened: (0, a) before a, (b, inf) later than b, (a, b) between a and b.
    - `error`: standard errors [s]: a scalar, or (n,); for a limit, the error of the clock.
    - `t1`: horizon [s] of the runs.
    - `event`: a function `event(t, motion)`, whose fall through zero is the event, as for `event_time`; by default the event of
      the system itself.
    - `input`, `jumps`: the input of a run and the times [s] at which it jumps, as for `event_time`.
    - `until`: time [s] until which you watched a run without the event, a scalar or (n,); `t1` by default.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for outliers; `None`: Gaussian.

    **Raises:** `ValueError` for numbers out of range or shapes that do not fit.

    **Example:** the third run had not ended after 1 s.

    >>> import nonholonomic
    >>> times = [0.45, 0.46, float("inf")]
    >>> falls = nonholonomic.EventTimes([1.0, 0.0], times, 0.005, t1=2.0, event=lambda t, y: y[0], until=1.0)
    >>> falls.labels, falls.measurements.censored.tolist()
    (('time 1', 'time 2', 'time 3'), [False, False, True])
    """

    event: Event = None
    input: Any = None
    until: Float[Array, "..."] | None = eqx.field(converter=as_number, default=None)
    student: Float[Array, ""] | None = eqx.field(converter=as_number, default=None)
    jumps: Sequence[float] | Array | None = None

    def __check_init__(self):
        if isinstance(self.launch, list | tuple) and any(isinstance(part, eqx.Module) for part in self.launch):
            raise ValueError(
                f"launch must be one launch, not a list of {len(self.launch)}: make an EventTimes of each, and pass identify a "
                "list of them"
            )

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"time {k + 1}" for k in range(len(self.time)))

    def model(self, system: object) -> AbstractModel:
        model = model_of(system, self.launch, self.event, self.input, self.jumps)
        require_event(model)
        return model


# Predictions of sets of data of any model, for many sets of parameters at once: the runs are lanes of one batch.

#: Spacing [s] of model times for samples before the launch: so small that nothing moves.
INSTANT = 1e-9

#: Spacing [s] of times that are added to give recordings the same length.
AT_ONCE = 1e-6

#: Parameters of one set of data, name -> (rows,).
Values = dict[str, Float[Array, " rows"]]

#: The horizon of a timed run [s]; or the times of samples, and the clock's reading at the start; with an axis for lanes.
Horizon = Float[Array, "*lanes"] | tuple[Float[Array, "*lanes times"], Float[Array, "*lanes"]]

#: A set of data of runs.
Data = AbstractRecording | AbstractEventTimes

#: The free numbers of a fit, and their priors, by their names.
FreeNumbers = Mapping[str, Free | float]
Priors = Mapping[str, Prior] | None


class Source(eqx.Module):
    """A set of data and the model of its runs: one run, or one for each value of the numbers of the model's start."""

    data: Data
    model: AbstractModel

    @property
    def runs(self) -> int:
        """Number of runs."""
        sizes = [len(leaf) for leaf in jax.tree.leaves(self.model) if eqx.is_array(leaf) and leaf.ndim]
        return max(sizes, default=1)

    @property
    def key(self) -> Hashable:
        """Sets of data with equal keys are lanes of one batch."""
        arrays = jax.tree.structure(eqx.filter(self.model, eqx.is_array))
        columns = getattr(self.data, "columns", None)
        return type(self.data), arrays, columns, getattr(self.data, "side", None), id(getattr(self.data, "event", None))


class DataModel(eqx.Module):
    """Predictions of several sets of data of a system, in the form that `nonholonomic.identification.result` expects.

    `seen`: indices of the predictions that were measured; `fixed`: the numbers of the first start that are neither zero nor
    among the unknowns, and the clock of recordings if it is not.
    """

    data: tuple[Source, ...]
    seen: Int[Array | np.ndarray, " n"]
    settings: Settings
    fixed: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def recorded(self) -> tuple[Data, ...]:
        """The sets of data, for curves between their samples."""
        return tuple(source.data for source in self.data)

    def with_times(self, moved: Callable[[AbstractRecording], dict[str, Array | np.ndarray]]) -> "DataModel":
        """The model of recordings at other times, of which `moved` returns the new fields of each."""
        sources = []
        for source in self.data:
            data = source.data
            if isinstance(data, AbstractRecording):
                data = dataclasses.replace(data, **moved(data))
            sources.append(Source(data, source.model))
        return dataclasses.replace(self, data=tuple(sources))

    @property
    def on_host(self) -> bool:
        """Whether derivatives through the modes of the runs mislead; such a model is neither traced nor differentiated."""
        return self.data[0].model.fit_slopes == "differences"

    def slopes(self, names: Iterable[str]) -> str:
        """The slopes that guide a fit of the named unknowns."""
        # Runs with resets have no derivatives with respect to the times of samples.
        moves_times = any(own_name(name) == "t0" for name in names)
        if moves_times and not all(source.model.smooth for source in self.data):
            return "differences"
        model = self.data[0].model
        return "differences" if model.compiles_slowly else model.fit_slopes

    def __call__(self, parameters: Values) -> Float[Array, "rows n"]:
        rows = len(next(iter(parameters.values())))
        values = [of_data(parameters, k) for k in range(len(self.data))]
        groups: dict[Hashable, list[int]] = {}
        for k, source in enumerate(self.data):
            groups.setdefault((source.key, tuple(values[k])), []).append(k)
        parts: dict[int, Array] = {}
        for indices in groups.values():
            sources = [self.data[k] for k in indices]
            predict = _predicted
            if self.on_host:
                predict = _compiled if isinstance(sources[0].data, AbstractRecording) else _predicted_by_tables
            lanes = predict(sources, [values[k] for k in indices], rows, self.settings)
            of_runs = lanes.reshape(rows, -1, *lanes.shape[1:])
            firsts = np.cumsum([0, *(source.runs for source in sources)])
            for k, source, first in zip(indices, sources, firsts, strict=False):
                of_source = of_runs[:, first : first + source.runs]
                if isinstance(source.data, AbstractRecording):
                    parts[k] = of_source[:, 0, : len(source.data.times)].reshape(rows, -1)
                else:
                    parts[k] = jnp.broadcast_to(of_source, (rows, len(source.data.time)))
        return jnp.concatenate([parts[k] for k in range(len(self.data))], axis=1)[:, self.seen]


def _lanes(
    sources: list[Source], values: list[Values], rows: int
) -> tuple[AbstractModel, Bool[Array, " lanes"], Horizon]:
    """The runs of sets of data with equal keys in every row of parameters, one row after the other.

    **Returns:** the model with a value per lane for each number; whether these values are legal; and the horizons of timed
    runs [s], or the times of samples and the clock's readings at the start.
    """
    counts = [source.runs for source in sources]

    def in_lanes(of_each: list[Array]) -> Array:
        """A number of each source: one for all, a value per run, or a column with a value per row."""
        parts = [jnp.broadcast_to(number, (rows, count)) for number, count in zip(of_each, counts, strict=True)]
        return jnp.concatenate(parts, axis=1).reshape(-1)

    arrays, static = eqx.partition([source.model for source in sources], eqx.is_array)
    model = eqx.combine(jax.tree.map(lambda *leaves: in_lanes([*leaves]), *arrays), static[0])
    moved = {name: in_lanes([jnp.asarray(of_source[name])[:, None] for of_source in values]) for name in values[0]}
    recordings = [source.data for source in sources if isinstance(source.data, AbstractRecording)]
    if not recordings:
        horizon = in_lanes([source.data.horizon for source in sources if isinstance(source.data, AbstractEventTimes)])
    else:
        size = max(len(data.times) for data in recordings)
        # Recordings get the same length by times shortly after the last one.
        later = AT_ONCE * jnp.arange(1, size + 1)
        clocks = [jnp.append(data.times, data.times[-1] + later[: size - len(data.times)]) for data in recordings]
        clock = in_lanes([data.t0 for data in recordings])
        horizon = (jnp.tile(jnp.stack(clocks), (rows, 1)), moved.pop("t0", clock))
    moved.pop("t0", None)

    def of_lane(model: AbstractModel, values: dict[str, Array]) -> tuple[AbstractModel, Array]:
        model = model.replaced(values)
        return model, model.legal()

    model, is_legal = eqx.filter_vmap(of_lane)(model, moved)
    return model, is_legal, horizon


def _predicted(sources: list[Source], values: list[Values], rows: int, settings: Settings) -> Float[Array, "lanes ..."]:
    """The predictions in all lanes; NaN for illegal parameters, and after the end of a run."""
    data: Any = sources[0].data

    def of_lane(model: AbstractModel, is_legal: Array, horizon: Horizon) -> Array:
        if not isinstance(horizon, tuple):
            return nan_unless(is_legal, data.predicted(model, horizon, settings))
        # Samples before the launch are taken at the launch. An illegal run might never end, so it ends at its start.
        clock, t0 = horizon
        times = greatest(clock - t0, INSTANT * jnp.arange(clock.shape[0]))
        times = jnp.where(is_legal, times, 0.0)
        # A sample at the time of a reset, as accurately as it is known, is the state before it.
        times = times * (1.0 + INSTANT) if data.side == "after" else times
        run = sampled(model, data.names, times, times[-1], settings)
        columns = data.columns_of(model, model.read(data.names, times, run.rows, run.mode))
        return nan_unless(is_legal, jnp.stack(columns, axis=-1))

    return eqx.filter_vmap(of_lane)(*_lanes(sources, values, rows))


_compiled = eqx.filter_jit(_predicted)
_compiled_lanes = eqx.filter_jit(_lanes)


def _predicted_by_tables(
    sources: list[Source], values: list[Values], rows: int, settings: Settings
) -> Float[Array, "*lanes"]:
    """The times of events in all lanes, by the programs of tables; NaN for illegal parameters and for runs that failed or are
    unresolved."""
    data, (model, is_legal, horizon) = sources[0].data, _compiled_lanes(sources, values, rows)
    assert isinstance(data, AbstractEventTimes)
    is_legal = np.asarray(is_legal)
    size, count = len(is_legal), int(is_legal.sum())
    predictions = np.full(size, np.nan)
    if count:
        # However many lanes are legal, there are as many cells, hence one program; only the first cells run.
        order = np.argsort(~is_legal, kind="stable")
        order[count:] = order[0]
        cells, t1 = jax.tree.map(lambda leaf: leaf[order] if eqx.is_array(leaf) else leaf, (model, horizon))
        # Without cells, new programs are compiled together, by two threads. A single core stays in this one.
        for first in (0, count) if workers() > 1 else (count,):
            status, time, ends = first_events(cells, np.asarray(t1), size, first, settings)
        time = data.of_ends(cells, t1, time, ends)
        predictions[order[:count]] = np.where(np.isin(status, SILENT), np.nan, time)[:count]
    return jnp.asarray(predictions)


# Estimate parameters of any model from recorded runs and from times of events, and their posterior.

#: Stands for every set of data that has the parameter.
EACH = "data[*]."

Value = TypeVar("Value")

#: The words for data that can be fitted.
EXPECTED = "a nonholonomic.Recording or EventTimes"


@explaining
def identify(
    system: object,
    data: Data | Sequence[Data],
    free: FreeNumbers,
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> Identification:
    """Estimate parameters and starts of a system from recorded runs and times of events, with errors and undetermined
    combinations.

    **Arguments:**

    - `system`: a scene, a `Hybrid`, or an `AbstractSystem`, with the values of the parameters that are not free.
    - `data`: a `Recording` or an `EventTimes`, or a list of several to be fitted together; for scenes, also the data of
      `tippe.identify` and `stroller.identify`.
    - `free`: full name of a parameter -> a `nonholonomic.Free` or only the start value. Examples of names are
      `"scene.friction.mu"` or `"system.modes[0].drag"`, or `"drag"` if no other name ends so, `"modes[*].drag"` for all
      modes that have a drag, `"launch.theta"`, `"start[0]"`, `"start.q[0]"` and `"t0"`, the reading of a recording's
      clock at the start. `"start[0]"` and `"t0"` are the same in all recordings; `"data[1].start[0]"` belongs to the
      second recording, and `"data[*].t0"` is a separate parameter for each. In systems with resets, `"t0"` cannot be
      free.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.result`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> data = nonholonomic.Recording([1.0], [0.5, 1.0, 1.5], [0.37, 0.135, 0.05], 0.005)
    >>> fit = nonholonomic.identify(nonholonomic.Hybrid([Decay(1.0)]), data, {"rate": 1.0}, progress=False)
    >>> print(f"{fit.estimates['system.modes[0].rate']:.2f}")
    1.99

    ```
    """
    search = {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}
    return fit_runs(system, data, free, EXPECTED, tolerance, search)


@explaining
def log_density(
    system: object, data: Data | Sequence[Data], free: FreeNumbers, priors: Priors = None, *, tolerance: float = 1e-8
) -> LogDensity:
    """The log of the posterior density of a system's parameters, as a function of unbounded coordinates.

    **Arguments:** `system`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler; for tops with several modes it
    has values only, for `sample`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:** the rate of a decay.

    ```
    >>> import nonholonomic
    >>> from nonholonomic.identification import sample
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> data = nonholonomic.Recording([1.0], [0.5, 1.0, 1.5], [0.37, 0.135, 0.05], 0.005)
    >>> density = nonholonomic.log_density(nonholonomic.Hybrid([Decay(1.0)]), data, {"rate": 1.0})
    >>> draws = sample(density, draws=200, progress=False)
    >>> print(f"{draws.values['system.modes[0].rate'].mean():.2f}")
    1.99

    ```
    """
    return posterior_of_runs(system, data, free, priors, EXPECTED, tolerance)


def fit_runs(
    system: object,
    data: Data | Sequence[Data],
    free: FreeNumbers,
    expected: str,
    tolerance: float,
    search: dict[str, Any],
    slopes: str | None = None,
) -> Identification:
    """Fit sets of data of runs.

    **Arguments:** as for `identify`; `expected`: the data that are expected, in words; `search`: how to search, name of an
    argument -> value; `slopes`: "exact" or "differences", by default as the model requires.
    """
    check_search(**search)
    with status_line("fitting", search.pop("progress")):
        density = posterior_of_runs(system, data, free, None, expected, tolerance, slopes)
        sources = density.problem.model.data
        return most_likely(density, numbered([source.data.labels for source in sources]), **search)


def posterior_of_runs(
    system: object,
    data: Data | Sequence[Data],
    free: FreeNumbers,
    priors: Priors,
    expected: str,
    tolerance: float,
    slopes: str | None = None,
) -> LogDensity:
    """The posterior, given sets of data of runs.

    **Arguments:** as for `log_density`; `expected`, `slopes`: as for `fit_runs`.

    **Raises:** `ValueError` unless there is at least one set of data, and all sets are recordings or times of events.
    """
    several: tuple[Any, ...] = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not several or not all(isinstance(source, AbstractData) for source in several):
        reader = "; read a file with read_recording" if isinstance(data, str | Path) else ""
        raise ValueError(f"data = {shown(data)} must be {expected}, or a list of them{reader}")
    tolerance_bound(tolerance).require()
    sources = tuple(Source(source, source.model(system)) for source in several)
    for source in sources:
        data = source.data
        end = data.times[-1] - data.t0 if isinstance(data, AbstractRecording) else data.horizon
        check_run(source.model, end, tolerance)
    unknowns = free_numbers(free, sources)
    require_apart("free", unknowns)
    require_room(sources[0].model, unknowns)
    seen = np.flatnonzero(np.concatenate([source.seen for source in several]))
    first, own = sources[0].model, set(map(own_name, unknowns))
    starts = [name for name in first.known if name.startswith(("launch.", "start")) and name not in own]
    fixed = tuple(name for name in starts if np.ndim(first.value(name)) == 0 and np.any(first.value(name)))
    if "t0" not in own and any(isinstance(source, AbstractRecording) for source in several):
        fixed += ("t0",)
    model = DataModel(sources, seen, Settings(tolerance, max_steps=MOST_STEPS), fixed)
    if priors is not None and not isinstance(priors, dict):
        raise ValueError(
            f"priors = {shown(priors)} must be a dictionary, name of a number -> (mean, standard deviation), only the standard "
            "deviation, or a function"
        )
    by_name = {full_name("priors", name, list(unknowns)): prior for name, prior in (priors or {}).items()}
    parts, units, series_shown = [], [], []
    for source in sources:
        part = source.data.measurements
        # The series are renumbered consecutively.
        parts.append(eqx.tree_at(lambda part: part.series, part, part.series + len(units)))
        own = source.data.units_of(source.model)[: int(np.max(part.series)) + 1]
        units += own
        series_shown += [in_unit(si, unit_of(source.data))[0] for si in own]
    measurements = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    density = LogDensity.of(model, measurements, unknowns, by_name, tuple(units), slopes or model.slopes(unknowns))
    label, shorts = sources[0].model.label, map(own_name, unknowns)
    own_units = tuple("s" if short == "t0" else label([short])[short][1] for short in shorts)
    # Recorded degrees are no reason to show a spin in degrees per second.
    unit = (*unit_of(*(data.launch for data in several), *several), "rad/s")
    return dataclasses.replace(density, series_shown=tuple(series_shown), own_units=own_units, unit=unit)


def require_room(model: AbstractModel, unknowns: dict[str, Free]) -> None:
    """Raise `ValueError` for an unknown that no value near its start value leaves with a legal start of the run, as where the
    constraints of a system depend on it."""
    for name, unknown in unknowns.items():
        reasons = []
        for value in (0.99 * unknown.start, 1.01 * unknown.start) if own_name(name) in model.known else ():
            # The values of the user have been asked about already.
            with contextlib.suppress(ValueError), warnings.catch_warnings(action="ignore"):
                near = {own_name(name): value}
                # Values that the modules refuse are bounds of the search.
                model.require_values(near)
                try:
                    model.replaced(near).check()
                except ValueError as error:
                    reasons.append(str(error))
        if len(reasons) == 2:
            raise ValueError(
                f"free: {name} = {unknown.start:.6g} is legal for this start and its neighbours are not: {reasons[0]}; start "
                f"at rest, or where the constraints hold whatever {name} is"
            )


def of_data(parameters: dict[str, Value], k: int) -> dict[str, Value]:
    """The parameters of one set of data: the shared parameters, and its own parameters without the prefix `data[k].`."""
    prefix = f"data[{k}]."
    pairs = ((name.removeprefix(prefix), value) for name, value in parameters.items())
    return {name: value for name, value in pairs if not name.startswith("data[")}


def free_numbers(free: FreeNumbers, sources: Sequence[Source]) -> dict[str, Free]:
    """The unknowns of a model and its data: their full names, and a lower bound of 0 for parameters that cannot be negative.

    **Arguments:** `free`: name, or its unambiguous end, -> a `Free` or a start value. `data[1].launch.azimuth` is a
    parameter of the second set of data alone, and `data[*].launch.azimuth` stands for one parameter of each set. A
    parameter of a launch without a prefix is shared.

    **Returns:** full name -> `Free`.

    **Raises:** `ValueError` for an unknown name or illegal start values.
    """
    first, own = sources[0].model, []
    for source in sources:
        names = [name for name in source.model.known if name.startswith(("start", "launch"))]
        own.append([*names, "t0"] if isinstance(source.data, AbstractRecording) else names)
    shared = [name for name in first.known if name not in own[0]]

    def check(values: dict[str, float]) -> None:
        first.require_values({own_name(name): value for name, value in values.items() if own_name(name) != "t0"})

    of_any = list(dict.fromkeys(itertools.chain(*own)))
    of_each = [f"data[{k}].{name}" for k, names in enumerate(own) for name in names]
    unknowns: dict[str, Free] = {}
    for written, unknown in as_free(free).items():
        if str(written).startswith(EACH):
            end = full_name("free", written.removeprefix(EACH), of_any)
            names = [name for name in of_each if own_name(name) == end]
        else:
            known = of_each if str(written).startswith("data[") else [*shared, *of_any]
            names = [full_name("free", written, known)]
        for name in names:
            if name in unknowns:
                raise ValueError(f"free: {name!r} is named twice")
            unknowns[name] = unknown
    for name in unknowns:
        if own_name(name) != name and own_name(name) in unknowns:
            raise ValueError(f"free: {name!r} is named twice, alone and for all data")
    for k in range(len(own)):
        check({name: unknown.start for name, unknown in of_data(unknowns, k).items()})
    for name, unknown in unknowns.items():
        if unknown.lower == -math.inf and unknown.upper == math.inf:
            try:
                check({name: -(abs(unknown.start) or 1.0)})
            except ValueError:
                unknowns[name] = unknown._replace(lower=0.0)
    return as_free(unknowns)
