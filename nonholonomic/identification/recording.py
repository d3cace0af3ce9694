"""Recorded runs: quantities sampled at the times of a clock, from arrays and from files of columns."""

import csv
import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..text import SYNONYMS, UNITS, Stated, counted, in_unit, likely, one_line, readable_unit, shown, unit_of
from ..validation import IN_DEGREES, Explaining, as_number, as_path, require, warn
from .posterior import Measurements

# Only for type checkers: models stand above fits.
if TYPE_CHECKING:
    from ..runs import AbstractModel

# Recorded runs: quantities sampled at the times of a clock, converted to measurements.


@dataclasses.dataclass(frozen=True)
class Quantities:
    """The quantities that can be recorded of a run.

    - `columns`: name of a quantity with several columns -> their names.
    - `units`: name of a column -> its SI unit; empty if any quantity of a model can be recorded, such as "theta", or a
      component of a vector, such as "position.x".
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

    def of(self, quantity: str | tuple[str, ...]) -> tuple[str, ...]:
        """The columns of a quantity, of a column, or of a tuple of them.

        **Raises:** `ValueError` for an unknown column, or one that is named twice.
        """
        words = quantity if isinstance(quantity, tuple) else (quantity,)
        known = {**self.columns, **{name: (name,) for name in self.units}}
        columns: list[str] = []
        for word in words:
            if not isinstance(word, str) or (known and word not in known):
                names = ", ".join(map(repr, known)) or "the names of quantities, such as 'theta' or ('q0', 'q1')"
                raise ValueError(f"quantity = {shown(word)} must be one of {names}")
            columns += known.get(word, (word,))
        if not columns or len(set(columns)) < len(columns):
            raise ValueError(f"quantity = {shown(quantity)} must name at least one column, and each only once")
        return tuple(columns)

    @property
    def one_run(self) -> str:
        """An addition to the message that the times of a recording do not increase."""
        instead = f"; for launches with a measured time each, use {self.launches}" if self.launches else ""
        return f": a recording is one run, sampled at increasing times{instead}"

    def place(self, column: str) -> tuple[str, int | str | None]:
        """The quantity to which a column belongs, and the index or the name of the component; `None` for a quantity of one
        column."""
        for quantity, columns in self.columns.items():
            if column in columns:
                return quantity, columns.index(column)
        name, _, component = column.partition(".")
        return name, component or None


def as_quantity(words: object) -> Any:
    """A word, or a tuple of words.

    **Example:**

    >>> from nonholonomic.identification import as_quantity
    >>> as_quantity(["x", "y"])
    ('x', 'y')
    """
    return tuple(words) if isinstance(words, list) else words


class AbstractData(Stated, metaclass=Explaining):
    """A set of data of a fit.

    In a fit of runs, it has a method `model(system)` that returns the checked model of the runs; the numbers of its start have
    a value per run if there are several.
    """

    #: Which predictions were measured, in the order of their times.
    seen: ClassVar[np.ndarray]

    #: What was measured, and a label for each number.
    measurements: ClassVar[Measurements]
    labels: ClassVar[tuple[str, ...]]

    def __repr__(self) -> str:
        return one_line(self)

    def labels_in(self, unit: str | Sequence[str] | None) -> tuple[str, ...]:
        """Labels for a picture, with numbers in other units if they have any."""
        return self.labels


def numbered(labels: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """The labels of all sets of data, with the number of the set if there are several."""
    several = len(labels) > 1
    return tuple(f"{k}: {label}" if several else label for k, part in enumerate(labels, 1) for label in part)


#: Samples of a top or a stroller are usually closer together [s]; others may have times in milliseconds.
FAR_APART = 5.0

#: Errors of angles [rad] are usually smaller; others may be in degrees.
LARGE_ERROR = 0.5


class AbstractRecording(AbstractData):
    """A recorded run: quantities sampled at the times of a clock.

    **Arguments:**

    - `launch`: the launch; all its numbers must be scalars.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for one column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: what was recorded: a quantity, a column, or a tuple of them. The attribute `quantities` of a subclass lists
      what can be recorded.
    - `t0`: the clock's reading [s] at the launch.
    - `student`: degrees of freedom of Student's t distribution of the errors; `None` for Gaussian errors.
    - `side`: "before" or "after": the state that a sample at the time of a reset is.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** a class of recordings of a decay.

    >>> import equinox as eqx
    >>> from nonholonomic.identification import AbstractRecording, Quantities
    >>> class DecayRecording(AbstractRecording):
    ...     quantity: str = eqx.field(static=True, default="level")
    ...     quantities = Quantities({}, {"level": "1"}, frozenset())
    >>> DecayRecording(None, [1.0, 2.0], [0.37, 0.135], 0.005).labels
    ('level(1 s)', 'level(2 s)')
    """

    quantities: eqx.AbstractClassVar[Quantities]
    launch: Any
    times: Float[Array, " times"] = eqx.field(converter=as_number)
    value: Float[Array, "times *columns"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] | None = eqx.field(converter=as_number)
    quantity: str | tuple[str, ...] = eqx.field(static=True, converter=as_quantity)
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number, default=None)
    side: str = eqx.field(static=True, default="before")

    @property
    def units(self) -> dict[str, str]:
        columns = {self.quantities.units.get(column, "1") for column in self.columns}
        return {"times": "s", "t0": "s"} | dict.fromkeys(
            ("value", "error"), columns.pop() if len(columns) == 1 else "1"
        )

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
        if self.student is not None:
            require(self.student, "student", above=0.0)
            if np.ndim(self.student) != 0:
                raise ValueError(f"student must be one number, not of shape {np.shape(self.student)}")
        # Unusual units: samples too far apart for seconds, and angles too large for radians.
        if self.quantities.usual and len(times) > 1 and (apart := np.median(np.diff(times))) > FAR_APART:
            warn(f"times: samples are {apart:g} s apart; times are in seconds: did you mean 1e-3 * times?")
        errors, samples = (
            np.max(np.where(seen, np.abs(numbers), 0.0).reshape(len(times), -1), axis=0)
            for numbers in (0.0 if self.error is None else np.asarray(self.error), np.asarray(self.value))
        )
        for name, error, sample in zip(self.columns, errors, samples, strict=True):
            if self.quantities.units.get(name) == "rad" and error > LARGE_ERROR:
                warn(f"error of {name} = {error:g} rad is large{IN_DEGREES.format(f'{error:g}')}")
            if sample > self.quantities.usual.get(name, math.inf):
                warn(
                    f"{name} = {sample:g} rad is large; recorded angles are in radians: did you mean np.radians({name})?"
                )

    @property
    def columns(self) -> tuple[str, ...]:
        """The names of the columns of a sample."""
        return self.quantities.of(self.quantity)

    @property
    def names(self) -> tuple[str, ...]:
        """The quantities to which the columns belong."""
        return tuple(dict.fromkeys(self.quantities.place(column)[0] for column in self.columns))

    def columns_of(self, model: "AbstractModel", values: dict[str, Array]) -> list[Float[Array, " times"]]:
        """The columns of the recording from the values of quantities. **Arguments:** `model`: that of the run."""
        columns = []
        for name, part in map(self.quantities.place, self.columns):
            dims = model.quantities[name].components
            index = model.components[dims].index(part) if isinstance(part, str) and dims is not None else part
            columns.append(values[name] if index is None else values[name][:, index])
        return columns

    @property
    def seen(self) -> np.ndarray:
        """Which samples are not missing, in the order of their times."""
        return ~np.isnan(np.asarray(self.value).reshape(-1))

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each sample, such as `theta(0.1 s)`; missing samples are omitted."""
        unit, factor = in_unit("s", unit_of(self))
        times = factor * np.asarray(self.times)
        all_labels = [f"{column}({time:.4g} {unit})" for time in times for column in self.columns]
        return tuple(label for label, is_seen in zip(all_labels, self.seen, strict=True) if is_seen)

    def units_of(self, model: "AbstractModel") -> tuple[str, ...]:
        """The unit of each series, for the model of the run."""
        names = (self.quantities.place(column)[0] for column in self.columns)
        return tuple(readable_unit(model.quantities[name].unit) or "1" for name in names)

    @property
    def measurements(self) -> Measurements:
        """The samples as `Measurements`, a series for each column; missing samples are omitted."""
        value = np.asarray(self.value).reshape(len(self.times), len(self.columns))
        if self.error is None:
            # A first guess: the scatter of the second differences, or of the values if there are too few.
            error = np.ones(len(self.columns))
            for k, column in enumerate(value.T):
                observed = column[np.isfinite(column)]
                second = np.diff(observed, 2)
                guess = np.median(np.abs(second)) / 0.6745 / math.sqrt(6.0) if len(second) > 2 else 0.0
                error[k] = guess or 0.1 * float(np.ptp(observed)) or 1.0
        else:
            error = np.reshape(self.error, value.shape) if np.size(self.error) == value.size else np.asarray(self.error)
        is_angle = np.array([name in self.quantities.angles for name in self.columns])

        def each(numbers_of: ArrayLike) -> np.ndarray:
            return np.broadcast_to(numbers_of, value.shape).reshape(-1)[self.seen]

        return Measurements(
            each(value),
            each(error),
            period=each(np.where(is_angle, 2.0 * math.pi, math.inf)),
            student=math.inf if self.student is None else float(self.student),
            series=each(np.arange(len(self.columns))),
            time=each((np.asarray(self.times) - float(self.times[0]))[:, None]),
            estimated=self.error is None,
        )


# A text file of columns with a header line, read in the units of the file.

#: Hyphens and dashes in place of a number.
DASHES = ("-", "--", "\u2013", "\u2014")

#: Cells, in lower case, that stand for a missing sample.
MISSING = ("", "nan", "n/a", "#n/a", "na", "null", "none", *DASHES)

#: What describes a column: a header with its unit, or a header (for an error, possibly a number) and a unit or factor.
Column = object

#: A path, and columns by name.
AnyPath = str | PathLike[str]
Columns = Mapping[str, Column] | None

#: The SI units of quantities, by their names.
Units = Mapping[str, str]


class TextTable(NamedTuple):
    """A text file of columns.

    - `cells`: header -> cells as text; `lines`: the number of each row's line in the file; `decimal`: the decimal mark;
      `repeated`: the headers that the file has more than once.
    - `columns`: name of a column of the model -> (header, unit), or a header with its unit; `units`: name -> SI unit.
    """

    path: Path
    cells: dict[str, list[str]]
    lines: list[int]
    decimal: str
    repeated: tuple[str, ...]
    columns: Mapping[str, Column]
    units: Units

    @classmethod
    def read(
        cls, path: AnyPath, columns: Columns, decimal: str, units: Units, several: Mapping[str, tuple[str, ...]]
    ) -> "TextTable":
        """Read and check a file of columns. **Arguments:** `several`: names that stand for several columns."""
        if decimal not in (".", ","):
            raise ValueError(f"decimal = {shown(decimal)} must be '.' or ','")
        if columns is not None and (not isinstance(columns, Mapping) or not columns):
            raise ValueError(f"columns = {shown(columns)} must be a dictionary, such as {{'theta': ('tilt', 'deg')}}")
        path = as_path(path, "path")
        lines = enumerate(_text(path).splitlines(), start=1)
        text = [(number, line) for number, line in lines if line.strip() and not line.lstrip().startswith("#")]
        if len(text) < 2:
            raise ValueError(f"path = {str(path)!r} must have a header line and at least one line of numbers")
        marks = ("\t", ";") if decimal == "," else ("\t", ";", ",")
        mark = next((mark for mark in marks if mark in text[0][1]), None)
        if mark is None and decimal == "," and "," in text[0][1]:
            raise ValueError(
                f"path = {str(path)!r}: the header separates columns by commas, so decimal must be '.': separate the columns "
                "by semicolons"
            )
        # Blanks also stand between a name and its unit, as in "theta [deg]".
        part = re.compile(r"\S+(?:\s+[\[(][^\])]*[\])])?")
        try:
            rows = [next(csv.reader([line], delimiter=mark)) if mark else part.findall(line) for _, line in text]
        except csv.Error as error:
            raise ValueError(f"path = {str(path)!r} is not a text file of columns: {error}") from None
        headers = [header.strip() for header in rows[0]]
        for (number, _), row in zip(text, rows, strict=True):
            if len(row) != len(headers):
                comma = mark == "," and len(row) > len(headers)
                hint = "; to read decimal commas, separate columns by semicolons and pass decimal=','" if comma else ""
                raise ValueError(f"path = {str(path)!r}: line {number} has {len(row)} cells, not {len(headers)}{hint}")
        cells = {header: [row[k].strip() for row in rows[1:]] for k, header in enumerate(headers)}
        repeated = tuple(header for header in cells if headers.count(header) > 1)
        file = cls(path, cells, [number for number, _ in text[1:]], decimal, repeated, columns or {}, units)
        if columns is None:
            return file._replace(columns=file.named())
        for name in columns:
            if name in several:
                raise ValueError(f"columns: {name!r} must be a single column: {', '.join(several[name])}")
            if name not in units:
                hint = "; did you mean 'time'?" if name == "t" else likely(name, units)
                raise ValueError(f"columns: {shown(name)} must be one of {', '.join(units)}{hint}")
        return file

    def named(self) -> dict[str, Column]:
        """The columns whose headers are names of the model's columns, with their headers."""
        columns: dict[str, Column] = {}
        for header in self.cells:
            name, unit = _split(header)
            name = name.lower()
            if name in self.units:
                if name in columns:
                    raise self._ambiguous("columns", name, [columns[name], header])
                si = self.units[name]
                # Only a number without a unit needs none in its header.
                if not unit and si != "1":
                    raise ValueError(
                        f"columns: the header {name!r} must have a unit, such as '{name} [{si}]'; or pass columns, a dictionary"
                    )
                columns[name] = header if unit else (header, "1")
        if not columns.keys() - {"time", "frame"}:
            raise ValueError(
                f"path = {str(self.path)!r}: no header is the name of a quantity with its unit, such as 'theta [deg]': pass "
                f"columns, a dictionary; the headers are {', '.join(self.cells)}"
            )
        return columns

    @property
    def unit(self) -> tuple[str, ...]:
        """The units of the columns, as far as they have a name."""
        sizes = ((UNITS[self.units[name]], self.parts(name)[1]) for name in self.columns)
        return tuple(unit for known, size in sizes for unit in known if known[unit] == size)

    def numbers(self, name: str, remark: str = "", infinite: bool = False, error: Columns = None) -> np.ndarray:
        """A column in SI units, NaN where it is missing.

        **Arguments:** `remark`: an addition to the message about a cell that is not a number; `infinite`: whether numbers
        may be infinite; `error`: as for `read_columns`, for the standard errors of the column.
        """
        header, size = self.parts(name, error)
        if not isinstance(header, str):
            require(header, f"error of {name}", above=0.0)
            return np.full(len(self.lines), size * float(header))
        numbers = np.full(len(self.lines), math.nan)
        for row, (line, cell) in enumerate(zip(self.lines, self.cells[header], strict=True)):
            if cell.lower() in MISSING:
                continue
            place = f"{header} = {cell!r} in line {line} of {str(self.path)!r}"
            if self.decimal == "," and "." in cell:
                raise ValueError(
                    f"{place} has a decimal point, or a mark of thousands, although decimal = ',': remove marks of thousands "
                    "from the file; if its numbers have decimal points, leave out decimal"
                )
            try:
                # Python also reads 1_000.
                numbers[row] = float("_" if "_" in cell else cell.replace(",", ".") if self.decimal == "," else cell)
            except ValueError:
                hint = ": pass decimal=',' if it has a decimal comma" if "," in cell and self.decimal == "." else remark
                raise ValueError(f"{place} is not a number{hint}") from None
            if math.isinf(numbers[row]) and not infinite:
                raise ValueError(f"{place} must be finite: write n/a, or nothing, for a missing sample")
        return size * numbers

    def parts(self, name: str, error: Columns = None) -> tuple[Any, float]:
        """The header of a column (or, for an error, possibly a number), and the factor that converts the file's numbers to
        SI units. **Arguments:** as for `numbers`."""
        argument, column = ("columns", self.columns[name]) if error is None else ("error", error[name])
        si, of_header = self.units[name], None
        first, unit = column if isinstance(column, tuple | list) and len(column) == 2 else (column, None)
        if isinstance(first, str):
            matches = [first] if first in self.cells else [full for full in self.cells if _split(full)[0] == first]
            if len(matches) > 1 or not set(self.repeated).isdisjoint(matches):
                raise self._ambiguous(argument, name, matches)
            if not matches:
                raise ValueError(
                    f"{argument}: {name!r} = {shown(first)} must be one of the headers of {str(self.path)!r}: "
                    f"{', '.join(self.cells)}{likely(first, [*self.cells, *(_split(full)[0] for full in self.cells)])}"
                )
            first = matches[0]
            of_header = _split(first)[1] or None
        elif argument == "columns" or unit is None:
            first = unit = None
        unit = of_header if unit is None else unit
        if unit is None:
            known = "deg" if si == "rad" else next(iter(UNITS[si]))
            expected = f"(header, unit), such as ('tilt', {known!r}), or a header with its unit, like 'tilt [{known}]'"
            if argument == "error":
                expected = f"(standard error, unit), such as (1.0, {known!r}), or (header of a column of standard errors, unit)"
            if first is not None:
                expected = f"(header, unit), such as ({first!r}, {known!r}), because the header has no known unit"
            raise ValueError(f"{argument}: {name!r} = {shown(column)} must be {expected}")
        if not isinstance(unit, str):
            require(unit, f"unit of {name}")
            return first, float(unit)
        factors, plain = UNITS[si], SYNONYMS.get(unit, unit)
        if plain not in factors:
            raise ValueError(f"unit of {name} = {shown(unit)} must be one of {', '.join(factors)}, or a number of {si}")
        if of_header is not None and SYNONYMS.get(of_header, of_header) != plain:
            raise ValueError(
                f"{argument}: {name!r} = {shown(column)} contradicts the header {first!r}, whose unit is {of_header}, "
                f"not {unit}: pass the header alone, {name!r}: {first!r}; if the header is wrong, correct it or pass "
                f"({first!r}, {factors[plain]:.9g}), with the number of {si} in a {plain}"
            )
        return first, factors[plain]

    def _ambiguous(self, argument: str, name: str, headers: Sequence[object]) -> ValueError:
        """The error for a column that the file has more than once."""
        listed = " or ".join(shown(header) for header in (headers if len(headers) > 1 else [*headers, *headers]))
        return ValueError(
            f"{argument}: {name!r} could be {listed}, columns of {str(self.path)!r}: rename one of them in the file, or pass "
            "the whole header if it differs from the other"
        )


def _text(path: Path) -> str:
    """The text of a file in UTF-8, or as spreadsheets write it: in UTF-16 with a mark, or in Windows' encoding."""
    raw = path.read_bytes()
    if raw.startswith((b"PK\x03\x04", b"\xd0\xcf\x11\xe0")):
        raise ValueError(f"path = {str(path)!r} is an Excel file, or another archive: save the sheet as CSV")
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _split(header: str) -> tuple[str, str]:
    """The name and the unit of a header, such as "tilt [deg]", "tilt (deg)" or "tilt / deg"; no unit if there is none."""
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\]]+)\]|\(([^)]+)\)|\s/\s*(\S+))", header.strip())
    if match is None:
        return header.strip(), ""
    unit = next(part for part in match.groups()[1:] if part).strip()
    known = unit in SYNONYMS or any(unit in units for units in UNITS.values())
    return (match[1].strip(), unit) if known else (header.strip(), "")


# Read recordings, and launches with measured times, from a file of columns, in the units of the file.


class Read(NamedTuple):
    """The contents of a file: times [s]; samples in SI units, NaN where missing; their errors or `None`; the quantity; and the
    units of the file.

    A single column is given by its name, and its samples are (times,).
    """

    times: Float[np.ndarray, " times"]
    value: Float[np.ndarray, "times *columns"]
    error: Float[np.ndarray, "times *columns"] | None
    quantity: str | tuple[str, ...]
    unit: tuple[str, ...]


def read_columns(
    path: AnyPath, columns: Columns, fps: float | None, error: Columns, quantities: Quantities, decimal: str = "."
) -> Read:
    """Read samples from a text file with a header line and columns separated by commas, semicolons, tabs or blanks.

    **Arguments:**

    - `path`: path of the file. Lines that begin with # are ignored; empty cells and the words in `MISSING`, such as `nan`
      and `n/a`, are missing samples.
    - `columns`: name of a column of the model -> (header, unit); the unit is one of `UNITS`, or a factor that converts
      the file's numbers to SI units. `"time"` is the clock; `"frame"` is the number of the frame and needs `fps`. A
      header with its unit, such as "tilt [deg]", needs no other unit. With `None`, all headers that are names of columns
      of the model with their units, such as "theta [deg]".
    - `fps`: frames per second. Without a column for the frame, each line is a frame.
    - `error`: name of a column -> (standard error or header of its column, unit), for some or all columns; or `None`.
    - `quantities`: the quantities that can be recorded.
    - `decimal`: "," for a file with decimal commas, whose columns are not separated by commas.

    **Returns:** times, values, errors, quantity and units.

    **Raises:** `ValueError` that names the file, the column and the problem.

    **Example:**

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from nonholonomic.identification import Quantities, read_columns
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "levels.csv"
    ...     length = path.write_text("clock [s];level [%]\\n0,1;90\\n0,2;n/a\\n0,3;80\\n")
    ...     columns = {"time": "clock", "level": "level"}
    ...     read_columns(path, columns, None, None, Quantities({}, {"level": "1"}, frozenset()), decimal=",").value
    array([0.9, 0.8])
    """
    known = {"time": "s", "frame": "1"} | dict(quantities.units)
    file = TextTable.read(path, columns, decimal, known, quantities.columns)
    names = quantities.of(tuple(name for name in file.columns if name not in ("time", "frame")))
    has_time, has_frame = ("time" in file.columns, "frame" in file.columns)
    if fps is None:
        if not has_time or has_frame:
            raise ValueError("fps must be given, or the columns must have 'time'")
        times = file.numbers("time")
    else:
        require(fps, "fps", above=0.0)
        if has_time:
            raise ValueError(f"fps = {shown(fps)} must be omitted because 'time' is among the columns")
        times = (file.numbers("frame") if has_frame else np.arange(len(file.lines))) / float(fps)
    value = np.stack([file.numbers(name) for name in names], axis=1)
    is_sample = np.any(np.isfinite(value), axis=1)
    mask = np.isfinite(times) & is_sample
    lines, seen = np.asarray(file.lines)[mask], times[mask]
    for k in np.flatnonzero(np.diff(seen) <= 0.0)[:1]:
        raise ValueError(
            f"time = {seen[k + 1]:.6g} s in line {lines[k + 1]} of {str(file.path)!r} must be later than "
            f"{seen[k]:.6g} s in line {lines[k]}{quantities.one_run}"
        )
    if any(lost := is_sample & np.isnan(times)):
        left_out = counted(int(np.sum(lost)), "line")
        warn(
            f"path = {str(file.path)!r}: {left_out} without a time left out, the first in line {file.lines[np.argmax(lost)]}"
        )
    for k in (k for k, name in enumerate(names) if known[name] == "rad"):
        _, size = file.parts(names[k])
        largest = np.nanmax(np.abs(value[:, k]), initial=0.0) / size
        if size < 1.0 and 0.2 < largest <= math.pi:
            warn(f"{names[k]} is at most {largest:.3g} deg in {str(file.path)!r}: is this column in rad?")
    errors = None
    if error is not None:
        if not isinstance(error, Mapping) or set(error) != set(names):
            form = ", ".join(f"{name!r}: (standard error, unit)" for name in names)
            raise ValueError(f"error = {shown(error)} must be {{{form}}}, or None")
        errors = np.stack([file.numbers(name, error=error) for name in names], axis=1)[mask]
    if len(names) == 1:
        return Read(times[mask], value[mask, 0], None if errors is None else errors[:, 0], names[0], file.unit)
    return Read(times[mask], value[mask], errors, names, file.unit)


class ReadLaunches(NamedTuple):
    """The launches of a file and their times, in SI units.

    - `numbers`: name of a number of the launch -> (launches,).
    - `time`: (launches,), infinite where the event did not happen; `until`: (launches,), the time until which it did
      not happen, NaN where the file does not state one.
    - `error`: a standard error for all, or (launches,).
    - `lines`: the number of each launch's line in the file; `unit`: the units of the file.
    """

    numbers: dict[str, Float[np.ndarray, " launches"]]
    time: Float[np.ndarray, " launches"]
    until: Float[np.ndarray, " launches"]
    error: Float[np.ndarray, "*launches"]
    lines: tuple[int, ...]
    unit: tuple[str, ...]


def read_launches(
    path: AnyPath,
    columns: Columns,
    error: float | Mapping[str, Column],
    units: Units,
    decimal: str = ".",
    never: str | Sequence[str] = (),
) -> ReadLaunches:
    """Read launches and the measured time of an event of each from a text file with a header line, a launch per line.

    Lines with a missing cell are lost measurements, which are left out. A time such as ">30" is a lower limit.

    **Arguments:**

    - `path`, `decimal`: as for `read_columns`.
    - `columns`: `"time"`, or a name of `units` -> (header, unit) or a header with its unit, as for `read_columns`.
    - `error`: standard error of the times [s]; or `{"time": (standard error or header of its column, unit)}`.
    - `units`: name of a number of the launch -> its SI unit.
    - `never`: a cell, or several, that stand for an event that did not happen, such as "-".

    **Returns:** a `ReadLaunches`.

    **Raises:** `ValueError` that names the file, the line or column, and the problem.

    **Example:** the second measurement was lost, and the third launch did not fall within the time of observation.

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from nonholonomic.identification import read_launches
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "falls.csv"
    ...     length = path.write_text("height [cm];time [s]\\n100;0,45\\n120;n/a\\n150;-\\n")
    ...     falls = read_launches(path, None, 0.01, {"height": "m"}, decimal=",", never="-")
    >>> print(falls.numbers["height"], falls.time, falls.lines)
    [1.  1.5] [0.45  inf] (2, 4)
    """
    file = TextTable.read(path, columns, decimal, {"time": "s"} | dict(units), {})
    if "time" not in file.columns:
        raise ValueError(f"columns = {shown(file.columns)} must have 'time', the measured time of each launch")
    time, until = _times_of_launches(file, never)
    numbers = {name: file.numbers(name) for name in file.columns if name != "time"}
    if isinstance(error, Mapping):
        if set(error) != {"time"}:
            raise ValueError(f"error = {shown(error)} must be {{'time': (standard error, unit)}} or a number [s]")
        errors = file.numbers("time", error=error)
    else:
        require(error, "error", above=0.0)
        if np.ndim(error) != 0:
            raise ValueError("error must be one number [s], or {'time': (header of a column of standard errors, unit)}")
        errors = np.asarray(error, float)
    mask = ~np.any(np.isnan([time, *numbers.values(), np.broadcast_to(errors, time.shape)]), axis=0)
    if not np.any(mask):
        raise ValueError(f"path = {str(file.path)!r} must have at least one line with {', '.join(file.columns)}")
    return ReadLaunches(
        {name: value[mask] for name, value in numbers.items()},
        time[mask],
        until[mask],
        errors[mask] if errors.ndim else errors,
        tuple(line for line, is_whole in zip(file.lines, mask, strict=True) if is_whole),
        file.unit,
    )


#: A number for each line of a file.
OfLines = Float[np.ndarray, " lines"]


def _times_of_launches(file: TextTable, never: str | Sequence[str]) -> tuple[OfLines, OfLines]:
    """The times of all lines, infinite where the event did not happen, and the limits that the file states."""
    words = (never,) if isinstance(never, str) else never
    if not isinstance(words, tuple | list) or not all(isinstance(word, str) for word in words):
        raise ValueError(f"never = {shown(never)} must be a text, such as '-', or a list of them")
    header, _ = file.parts("time")
    cells = file.cells[header]
    for line, cell in zip(file.lines, cells, strict=True):
        # People write a dash for a lost measurement and for an event that did not happen.
        if cell in DASHES and cell not in words:
            raise ValueError(
                f"{header} = {cell!r} in line {line} of {str(file.path)!r} can be a lost measurement or an event that did not "
                f"happen: pass never={cell!r} if it did not happen; write n/a for a lost measurement"
            )
    is_limit = np.array([cell.startswith(">") for cell in cells])
    plain = ["inf" if cell in words else cell.removeprefix(">").strip() for cell in cells]
    remark = ": if it stands for an event that did not happen, pass it as never"
    time = file._replace(cells={**file.cells, header: plain}).numbers("time", remark, infinite=True)
    for line, cell, value in zip(file.lines, cells, time, strict=True):
        if value <= 0.0:
            raise ValueError(f"{header} = {cell!r} in line {line} of {str(file.path)!r} must be greater than 0")
    return np.where(is_limit, np.inf, time), np.where(is_limit, time, np.nan)
