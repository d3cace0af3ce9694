"""Data of fits of any model: recorded runs, and times of events."""

import abc
import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..identification import AbstractRecording, Measurements, Quantities, as_quantity
from ..integration import Settings
from ..text import likely, one_line, readable_unit
from ..validation import as_number, as_number_or_none, require, shown
from .event_time import time_of_event
from .model import AbstractModel, model_of, require_event

#: Number of standard errors after `t1` in which an event is still predicted.
BEYOND = 8.0

#: Quantities with a period of a whole turn.
ANGLES = frozenset({"azimuth", "eta", "heading", "spin_angle"})


@dataclasses.dataclass(frozen=True)
class AnyQuantities(Quantities):
    """Quantities of a model that is not yet known: names, or components of vectors such as "position.x"."""

    def of(self, quantity: Any) -> tuple[str, ...]:
        names = quantity if isinstance(quantity, tuple) else (quantity,)
        if not names or not all(isinstance(name, str) for name in names) or len(set(names)) < len(names):
            raise ValueError(
                f"quantity = {shown(quantity)} must name quantities, such as 'theta' or ('q0', 'q1'), each once"
            )
        return names


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
    - `input`: the input of a stroller; `jumps`: times [s] at which it jumps, as for `stroller.simulate`.
    - `side`: "before" or "after": the state that a sample at the time of a reset is; a level after a dose is "after".

    **Raises:** `ValueError` for shapes that do not fit.

    **Example:**

    >>> import nonholonomic
    >>> heights = nonholonomic.Recording([1.0, 0.0], [0.1, 0.2], [0.95, 0.80], 0.01, "y0")
    >>> heights.labels
    ('y0(0.1 s)', 'y0(0.2 s)')
    """

    quantity: str | tuple[str, ...] = eqx.field(static=True, default="y0", converter=as_quantity)
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    input: Any = None
    jumps: Any = None
    side: str = eqx.field(static=True, default="before")
    quantities: ClassVar[Quantities] = AnyQuantities({}, {}, ANGLES)

    @property
    def series_units(self) -> tuple[str, ...]:
        # The system knows them; see `units_of`.
        return ("1",) * len(self.columns)

    def units_of(self, model: AbstractModel) -> tuple[str, ...]:
        return tuple(readable_unit(model.quantities[name.partition(".")[0]].unit) or "1" for name in self.columns)

    def model(self, system: Any) -> AbstractModel:
        """The model of the recorded run, checked."""
        model = model_of(system, self.launch, None, self.input, self.jumps).without_event()
        known = [*model.quantities, *_components(model)]
        for name in self.columns:
            if name not in known:
                default = " (the default)" if self.quantity == "y0" else ""
                raise ValueError(f"quantity: {name!r}{default} must be one of {', '.join(known)}{likely(name, known)}")
            if "." not in name and model.quantities[name].components is not None:
                raise ValueError(f"quantity: {name!r} has several components: name them, such as '{name}.x'")
        return model

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities to which the columns belong."""
        return tuple(dict.fromkeys(column.partition(".")[0] for column in self.columns))

    def columns_of(self, model: AbstractModel, values: dict[str, Array]) -> list[Float[Array, " times"]]:
        """The columns of the recording from the values of quantities."""
        columns = []
        for column in self.columns:
            name, _, component = column.partition(".")
            dims = model.quantities[name].components
            columns.append(values[name] if dims is None else values[name][:, model.components[dims].index(component)])
        return columns


def _components(model: AbstractModel) -> list[str]:
    """The names of the components of all vectors of a model."""
    return [
        f"{name}.{component}"
        for name, quantity in model.quantities.items()
        if quantity.components is not None
        for component in model.components[quantity.components]
    ]


class AbstractEventTimes(eqx.Module):
    """Measured times of an event, in one series with a prediction for each.

    - `launch`: the start of the runs.
    - `time`: (n,) [s], infinite where the event did not happen while you watched; or (n, 2), two times between which the
      event happened: (0, a) before a, (b, inf) later than b, (a, b) between a and b, (t, t) at t.
    - `error`: standard errors [s], a scalar or (n,); for a limit, the error of the clock.
    - `t1`: horizon of the model's runs [s]; `until`: time [s] until which you watched, a scalar or (n,), or `None` for `t1`.
    - `student`: degrees of freedom of Student's t distribution of the errors, or `None`.
    """

    launch: eqx.AbstractVar[Any]
    time: eqx.AbstractVar[Float[Array, "n *two"]]
    error: eqx.AbstractVar[Float[Array, "..."]]
    t1: eqx.AbstractVar[Float[Array, ""]]
    until: eqx.AbstractVar[Any]
    student: eqx.AbstractVar[Any]

    #: Whether times through several modes come from the programs of tables, which is faster for flights in closed form.
    by_tables: ClassVar[bool] = False

    def __repr__(self) -> str:
        return one_line(self)

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
    def of_each_time(self) -> dict[str, Any]:
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

    @property
    @abc.abstractmethod
    def labels(self) -> tuple[str, ...]:
        """A label for each time."""

    @abc.abstractmethod
    def model(self, system: Any) -> AbstractModel:
        """The model of the timed run, checked. The numbers of its start have a value per run if there are several."""

    def predicted(self, model: AbstractModel, t1: Any, settings: Settings) -> Float[Array, ""]:
        """The predicted time of one run."""
        return time_of_event(model, t1, settings, False)

    def of_ends(self, model: AbstractModel, t1: Any, time: Any, ends: dict[str, Any]) -> Any:
        """The predictions from a table: from the times of events, infinite without an event, and the ends of the runs."""
        return time

    def labels_in(self, unit: Any) -> tuple[str, ...]:
        """Labels for a picture, with numbers in other units."""
        return self.labels

    @property
    def horizon(self) -> Float[Array, ""]:
        """The end of the runs [s]: beyond `t1`, so that a time that is a few errors later is still predicted."""
        return self.t1 + BEYOND * jnp.max(self.error)

    @property
    def size(self) -> int:
        """Number of predictions."""
        return len(self.time)

    @property
    def seen(self) -> Int[np.ndarray, " n"]:
        """Indices of the measured predictions, which are all predictions."""
        return np.arange(self.size)

    @property
    def series_units(self) -> tuple[str, ...]:
        """The unit of the only series of the measurements."""
        return ("s",)

    def units_of(self, model: AbstractModel) -> tuple[str, ...]:
        """The unit of each series, for the model of the run."""
        return self.series_units


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
    - `input`: the input of a stroller; `jumps`: times [s] at which it jumps, as for `stroller.simulate`.
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

    launch: Any
    time: Float[Array, "n *two"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    event: Callable[..., Any] | None = None
    input: Any = None
    until: Any = eqx.field(converter=as_number_or_none, default=None)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    jumps: Any = None

    def __check_init__(self):
        if isinstance(self.launch, list | tuple) and any(isinstance(part, eqx.Module) for part in self.launch):
            raise ValueError(
                f"launch must be one launch, not a list of {len(self.launch)}: make an EventTimes of each, and pass identify a "
                "list of them"
            )

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"time {k + 1}" for k in range(self.size))

    def model(self, system: Any) -> AbstractModel:
        model = model_of(system, self.launch, self.event, self.input, self.jumps)
        require_event(model)
        return model
