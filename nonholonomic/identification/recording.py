"""Recorded runs: quantities sampled at the times of a clock, converted to measurements."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..text import one_line
from ..validation import as_number, as_number_or_none, require, shown
from ..warning import warn
from .likelihood import Measurements


@dataclasses.dataclass(frozen=True)
class Quantities:
    """The quantities that can be recorded of a run.

    - `columns`: name of a quantity with several columns -> their names.
    - `units`: name of a column -> its SI unit.
    - `angles`: columns with a period of a whole turn.
    - `usual`: column of an angle -> a magnitude [rad] that it rarely exceeds.
    - `launches`: what takes several launches with a measured time each, for messages.

    **Example:**

    >>> from nonholonomic.identification import Quantities
    >>> Quantities({"place": ("x", "y")}, {"x": "m", "y": "m", "angle": "rad"}, frozenset({"angle"})).of(("place", "angle"))
    ('x', 'y', 'angle')
    """

    columns: Mapping[str, tuple[str, ...]]
    units: Mapping[str, str]
    angles: frozenset[str]
    usual: Mapping[str, float] = dataclasses.field(default_factory=dict)
    launches: str = ""

    def of(self, quantity: Any) -> tuple[str, ...]:
        """The columns of a quantity, of a column, or of a tuple of them.

        **Raises:** `ValueError` for an unknown column, or one that is named twice.
        """
        words = quantity if isinstance(quantity, tuple) else (quantity,)
        columns: list[str] = []
        for word in words:
            columns_of_name = {**self.columns, **{name: (name,) for name in self.units}}
            if not isinstance(word, str) or word not in columns_of_name:
                raise ValueError(f"quantity = {shown(word)} must be one of {', '.join(map(repr, columns_of_name))}")
            columns += columns_of_name[word]
        if not columns or len(set(columns)) < len(columns):
            raise ValueError(f"quantity = {shown(quantity)} must name at least one column, and each only once")
        return tuple(columns)

    @property
    def one_run(self) -> str:
        """An addition to the message that the times of a recording do not increase."""
        instead = f"; for launches with a measured time each, use {self.launches}" if self.launches else ""
        return f": a recording is one run, sampled at increasing times{instead}"

    def place(self, column: str) -> tuple[str, int | None]:
        """The quantity to which a column belongs, and the index of the component; `None` for a quantity of one column."""
        for quantity, columns in self.columns.items():
            if column in columns:
                return quantity, columns.index(column)
        return column, None


def as_quantity(words: Any) -> Any:
    """A word, or a tuple of words.

    **Example:**

    >>> from nonholonomic.identification import as_quantity
    >>> as_quantity(["x", "y"])
    ('x', 'y')
    """
    return tuple(words) if isinstance(words, list) else words


#: Samples of a top or a stroller are usually closer together [s]; others may have times in milliseconds.
FAR_APART = 5.0


class AbstractRecording(eqx.Module):
    """A recorded run: quantities sampled at the times of a clock.

    **Arguments:**

    - `launch`: the launch; all its numbers must be scalars.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for one column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: what was recorded: a quantity, a column, or a tuple of them.
    - `t0`: the clock's reading [s] at the launch.
    - `student`: degrees of freedom of Student's t distribution of the errors; `None` for Gaussian errors. The attribute
      `quantities` of a subclass lists what can be recorded. Its field `side`, where it has one, says which state a sample
      at the time of a reset is: the one "before" or "after" it.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** a class of recordings of a decay.

    >>> import equinox as eqx
    >>> from nonholonomic.identification import AbstractRecording, Quantities
    >>> class DecayRecording(AbstractRecording):
    ...     quantity: str = eqx.field(static=True, default="level")
    ...     t0: float = 0.0
    ...     student: None = None
    ...     quantities = Quantities({}, {"level": "1"}, frozenset())
    >>> DecayRecording(None, [1.0, 2.0], [0.37, 0.135], 0.005).labels
    ('level(1 s)', 'level(2 s)')
    """

    launch: Any
    times: Float[Array, " times"] = eqx.field(converter=as_number)
    value: Float[Array, "times *columns"] = eqx.field(converter=as_number)
    error: Any = eqx.field(converter=as_number_or_none)
    quantity: eqx.AbstractVar[str | tuple[str, ...]]
    t0: eqx.AbstractVar[Float[Array, ""]]
    student: eqx.AbstractVar[Float[Array, ""] | None]
    quantities: eqx.AbstractClassVar[Quantities]
    units: ClassVar[dict[str, str]] = {"times": "s", "t0": "s"}
    # Without an annotation: a subclass may have a field of this name.
    side = "before"

    def __repr__(self) -> str:
        return one_line(self)

    def __check_init__(self):
        if self.side not in ("before", "after"):
            raise ValueError(f'side = {shown(self.side)} must be "before" or "after": samples at the time of a reset')
        require(self.times, "times")
        times = np.asarray(self.times, dtype=float)
        if times.ndim != 1 or not len(times) or np.any(np.diff(times) <= 0.0):
            raise ValueError(f"times = {shown(self.times)} must be an increasing list{self.quantities.one_run}")
        require(self.t0, "t0", below=times[-1], why="the last time")
        shape = (len(times), len(self.columns)) if len(self.columns) > 1 else (len(times),)
        if np.shape(self.value) != shape:
            raise ValueError(
                f"value must be of shape {shape} for {', '.join(self.columns)}, not {np.shape(self.value)}"
            )
        seen = ~np.isnan(np.asarray(self.value))
        if not np.any(seen):
            raise ValueError("value must have at least one number; missing samples are NaN")
        require(np.asarray(self.value)[seen], "value")
        if self.error is not None:
            if np.shape(self.error) not in ((), shape[1:], shape):
                raise ValueError(f"error must be one number, one for each column, or of shape {shape}")
            require(np.broadcast_to(self.error, shape)[seen], "error", above=0.0)
        self._suspect_units()
        if self.student is not None:
            require(self.student, "student", above=0.0)
            if np.ndim(self.student) != 0:
                raise ValueError(f"student must be one number, not of shape {np.shape(self.student)}")

    def _suspect_units(self) -> None:
        """Warn of angles that are unusually large for radians, and of samples too far apart for seconds."""
        if self.quantities.usual and len(self.times) > 2 and (apart := np.median(np.diff(self.times))) > FAR_APART:
            warn(f"times: samples are {apart:g} s apart; times are in seconds: did you mean 1e-3 * times?")
        samples = np.abs(np.asarray(self.value)).reshape(len(self.times), -1)
        for name, limit in self.quantities.usual.items():
            if name not in self.columns:
                continue
            greatest_angle = np.nanmax(samples[:, self.columns.index(name)], initial=0.0)
            if greatest_angle > limit:
                warn(
                    f"{name} = {greatest_angle:g} rad is large; recorded angles are in radians: did you mean "
                    f"np.radians({name})?"
                )

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns of a sample."""
        return self.quantities.of(self.quantity)

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities to which the columns belong."""
        return tuple(dict.fromkeys(self.quantities.place(column)[0] for column in self.columns))

    def columns_of(self, model: Any, values: dict[str, Array]) -> list[Float[Array, " times"]]:
        """The columns of the recording from the values of quantities. **Arguments:** `model`: that of the run."""
        places = [self.quantities.place(column) for column in self.columns]
        return [values[name] if part is None else values[name][:, part] for name, part in places]

    @property
    def size(self) -> int:
        """Number of predictions, including those of missing samples."""
        return np.size(self.value)

    @property
    def seen(self) -> np.ndarray:
        """Indices of the samples that are not missing, ordered by time."""
        return np.flatnonzero(~np.isnan(np.asarray(self.value).reshape(-1)))

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each sample, such as `theta(0.1 s)`; missing samples are omitted."""
        all_labels = [f"{column}({time:.4g} s)" for time in np.asarray(self.times) for column in self.columns]
        return tuple(all_labels[i] for i in self.seen)

    def labels_in(self, unit: Any) -> tuple[str, ...]:
        """Labels for a picture, which has the times below its curves."""
        return self.labels

    @property
    def series_units(self) -> tuple[str, ...]:
        """The unit of each column, which is a series of the measurements."""
        return tuple(self.quantities.units[name] for name in self.columns)

    def units_of(self, model: Any) -> tuple[str, ...]:
        """The unit of each series, for the model of the run."""
        return self.series_units

    @property
    def measurements(self) -> Measurements:
        """The samples as `Measurements`, a series for each column; missing samples are omitted."""
        value = np.asarray(self.value).reshape(len(self.times), len(self.columns))
        error = noise(value) if self.error is None else np.asarray(self.error)
        if error.shape == np.shape(self.value):
            error = error.reshape(value.shape)
        period = [2.0 * math.pi if name in self.quantities.angles else math.inf for name in self.columns]

        def each(numbers_of: Any) -> np.ndarray:
            return np.broadcast_to(numbers_of, value.shape).reshape(-1)[self.seen]

        return Measurements(
            each(value),
            each(error),
            period=each(period),
            student=math.inf if self.student is None else float(self.student),
            series=each(np.arange(len(self.columns))),
            time=each((np.asarray(self.times) - float(self.times[0]))[:, None]),
            estimated=self.error is None,
        )


def noise(value: Float[np.ndarray, "times columns"]) -> Float[np.ndarray, " columns"]:
    """A first guess of the errors: the scatter of the second differences, or of the values if there are too few."""

    def of(column: np.ndarray) -> float:
        observed = column[np.isfinite(column)]
        second = np.diff(observed, 2)
        guess = np.median(np.abs(second)) / 0.6745 / math.sqrt(6.0) if len(second) > 2 else 0.0
        return guess or 0.1 * float(np.ptp(observed)) or 1.0

    return np.array([of(column) for column in value.T])
