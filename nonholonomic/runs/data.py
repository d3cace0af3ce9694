"""Data of fits of any model: recorded runs, and times of events."""

import abc
import dataclasses
import math
from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..identification import AbstractRecording, Measurements, Quantities, as_quantity
from ..integration import Settings
from ..text import likely
from ..validation import as_number, as_number_or_none, require, shown
from .event_time import time_of_event
from .model import AbstractModel, model_of, require_event

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
    - `input`: the input of a stroller.

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
    quantities: ClassVar[Quantities] = AnyQuantities({}, {}, ANGLES)

    @property
    def series_units(self) -> tuple[str, ...]:
        return ("1",) * len(self.columns)

    def model(self, system: Any) -> AbstractModel:
        """The model of the recorded run, checked."""
        model = model_of(system, self.launch, None, self.input).without_event()
        known = [*model.quantities, *_components(model)]
        for name in self.columns:
            if name not in known:
                raise ValueError(f"quantity: {name!r} must be one of {', '.join(known)}{likely(name, known)}")
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
    """Measured times of an event, in one series with a prediction for each."""

    time: eqx.AbstractVar[Float[Array, "n *two"]]
    error: eqx.AbstractVar[Float[Array, "..."]]
    t1: eqx.AbstractVar[Float[Array, ""]]

    #: Whether times through several modes come from the programs of tables, which is faster for flights in closed form.
    by_tables: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def labels(self) -> tuple[str, ...]:
        """A label for each time."""

    @property
    @abc.abstractmethod
    def measurements(self) -> Measurements:
        """The times as measurements."""

    @abc.abstractmethod
    def model(self, system: Any) -> AbstractModel:
        """The model of the timed run, checked. The numbers of its start have a value per run if there are several."""

    @abc.abstractmethod
    def predicted(self, model: AbstractModel, t1: Any, settings: Settings) -> Float[Array, ""]:
        """The predicted time of one run."""

    def of_ends(self, model: AbstractModel, t1: Any, time: Any, ends: dict[str, Any]) -> Any:
        """The predictions from a table: from the times of events, infinite without an event, and the ends of the runs."""
        return time

    def labels_in(self, unit: Any) -> tuple[str, ...]:
        """Labels for a picture, with numbers in other units."""
        return self.labels

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


class EventTimes(AbstractEventTimes):
    """Measured times of the event of a run.

    **Arguments:**

    - `launch`: the start, as for `simulate`.
    - `time`: measured times [s], (n,), of runs from the same start.
    - `error`: standard errors [s]: a scalar, or (n,).
    - `t1`: horizon [s] of the runs.
    - `event`: a function `event(t, motion)`, whose fall through zero is the event, as for `event_time`; by default the event of
      the system itself.
    - `input`: the input of a stroller.

    **Raises:** `ValueError` for shapes that do not fit.

    **Example:**

    >>> import nonholonomic
    >>> falls = nonholonomic.EventTimes([1.0, 0.0], [0.45, 0.46], 0.005, t1=2.0, event=lambda t, y: y[0])
    >>> falls.labels
    ('time 1', 'time 2')
    """

    launch: Any
    time: Float[Array, " n"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    event: Callable[..., Any] | None = None
    input: Any = None

    def __check_init__(self):
        if isinstance(self.launch, list | tuple) and any(isinstance(part, eqx.Module) for part in self.launch):
            raise ValueError(
                f"launch must be one launch, not a list of {len(self.launch)}: make an EventTimes of each, and pass identify a "
                "list of them"
            )
        require(self.time, "time", above=0.0)
        require(self.t1, "t1", above=0.0)
        require(self.error, "error", above=0.0)
        if np.ndim(self.time) != 1 or not np.size(self.time):
            raise ValueError(f"time must be a list of measured times, not of shape {np.shape(self.time)}")
        if np.shape(self.error) not in ((), np.shape(self.time)):
            raise ValueError(f"error must be one number or of shape {np.shape(self.time)}, not {np.shape(self.error)}")

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(f"time {k + 1}" for k in range(self.size))

    @property
    def measurements(self) -> Measurements:
        time = np.asarray(self.time)
        return Measurements(time, np.broadcast_to(self.error, time.shape), student=math.inf)

    def model(self, system: Any) -> AbstractModel:
        model = model_of(system, self.launch, self.event, self.input)
        require_event(model)
        return model

    def predicted(self, model: AbstractModel, t1: Any, settings: Settings) -> Float[Array, ""]:
        time = time_of_event(model, t1, settings, False)
        return jnp.where(jnp.isfinite(time), time, jnp.nan)
