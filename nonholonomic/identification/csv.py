"""Read recordings from a file of columns, in the units of the file."""

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..text import UNITS, likely
from ..validation import as_path, require, shown
from .recording import Quantities

#: Cells, in lower case, that stand for a missing sample.
MISSING = ("", "nan", "n/a", "#n/a", "na", "null", "none", "-", "--")

#: Other words for units in headers.
SYNONYMS = {"°": "deg", "degree": "deg", "degrees": "deg", "°/s": "deg/s", "radian": "rad", "radians": "rad"}
SYNONYMS |= {"sec": "s", "second": "s", "seconds": "s", "1/min": "rpm", "rev/min": "rpm", "U/min": "rpm"}


class Read(NamedTuple):
    """The contents of a file: times [s]; samples in SI units, NaN where missing; their errors or `None`; and the
    quantity.

    A single column is given by its name, and its samples are (times,).
    """

    times: Float[np.ndarray, " times"]
    value: Float[np.ndarray, "times *columns"]
    error: Float[np.ndarray, "times *columns"] | None
    quantity: str | tuple[str, ...]


def read_columns(
    path: Any, columns: Any, fps: float | None, error: Any, quantities: Quantities, decimal: str = "."
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

    **Returns:** times, values, errors and quantity.

    **Raises:** `ValueError` that names the file, the column and the problem.

    **Example:**

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from nonholonomic.identification import read_columns
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "levels.csv"
    ...     length = path.write_text("clock [s];level [%]\\n0,1;90\\n0,2;n/a\\n0,3;80\\n")
    ...     columns = {"time": "clock", "level": "level"}
    ...     read_columns(path, columns, None, None, Recording.quantities, decimal=",").value
    array([0.9, 0.8])
    """
    if decimal not in (".", ","):
        raise ValueError(f"decimal = {shown(decimal)} must be '.' or ','")
    if columns is not None and (not isinstance(columns, Mapping) or not columns):
        raise ValueError(
            f"columns = {shown(columns)} must be a dictionary, such as {{'theta': ('tilt', 'deg')}}, or None"
        )
    file = TextTable.read(as_path(path, "path"), decimal)
    known = {"time": "s", "frame": "1"} | dict(quantities.units)
    columns = file.named(known) if columns is None else columns
    for name in columns:
        if name in quantities.columns:
            raise ValueError(f"columns: {name!r} must be a single column: {', '.join(quantities.columns[name])}")
        if name not in known:
            hint = "; did you mean 'time'?" if name == "t" else likely(name, known)
            raise ValueError(f"columns: {shown(name)} must be one of {', '.join(known)}{hint}")
    names = quantities.of(tuple(name for name in columns if name not in ("time", "frame")))
    times = _times(file, columns, fps)
    value = np.stack([file.numbers(name, columns[name], known[name]) for name in names], axis=1)
    mask = np.isfinite(times) & np.any(np.isfinite(value), axis=1)
    errors = None
    if error is not None:
        if not isinstance(error, Mapping) or set(error) != set(names):
            raise ValueError(f"error = {shown(error)} must be a dictionary with {', '.join(names)}, or None")
        errors = np.stack([_errors(file, name, error[name], known[name]) for name in names], axis=1)[mask]
    if len(names) == 1:
        return Read(times[mask], value[mask, 0], None if errors is None else errors[:, 0], names[0])
    return Read(times[mask], value[mask], errors, names)


class TextTable(NamedTuple):
    """The cells of a file as text: header -> cells; the number of each row's line in the file; and the decimal mark."""

    path: Path
    cells: dict[str, list[str]]
    lines: list[int]
    decimal: str

    @classmethod
    def read(cls, path: Path, decimal: str) -> "TextTable":
        """Read a file of columns."""
        text = [(number, line) for number, line in enumerate(_text(path).splitlines(), start=1) if _has_cells(line)]
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
        rows = [next(csv.reader([line], delimiter=mark)) if mark else part.findall(line) for _, line in text]
        headers = [header.strip() for header in rows[0]]
        for (number, _), row in zip(text, rows, strict=True):
            if len(row) != len(headers):
                comma = mark == "," and len(row) > len(headers)
                hint = (
                    "; to read decimal commas, separate the columns by semicolons and pass decimal=','" if comma else ""
                )
                raise ValueError(f"path = {str(path)!r}: line {number} has {len(row)} cells, not {len(headers)}{hint}")
        cells = {header: [row[k].strip() for row in rows[1:]] for k, header in enumerate(headers)}
        return cls(path, cells, [number for number, _ in text[1:]], decimal)

    def named(self, known: Mapping[str, str]) -> dict[str, Any]:
        """The columns whose headers are names of the model's columns, with their headers."""
        columns = {}
        for header in self.cells:
            name, unit = _split(header)
            if name.lower() in known:
                columns[name.lower()] = header if unit else (header, _unit_of(name.lower(), known))
        if not columns.keys() - {"time", "frame"}:
            raise ValueError(
                f"path = {str(self.path)!r}: no header is the name of a quantity with its unit, such as 'theta [deg]': pass "
                f"columns, a dictionary; the headers are {', '.join(self.cells)}"
            )
        return columns

    def numbers(self, name: str, header_and_unit: Any, si: str) -> np.ndarray:
        """A column in SI units, NaN where it is missing."""
        header, size = self._parts(name, header_and_unit, si)
        if header not in self.cells:
            raise ValueError(
                f"columns: {shown(header)} must be one of the headers of {str(self.path)!r}: {', '.join(self.cells)}"
                f"{likely(header, self.cells)}"
            )
        numbers = zip(self.lines, self.cells[header], strict=True)
        return size * np.array([self._number(header, line, cell) for line, cell in numbers])

    def _number(self, header: str, line: int, cell: str) -> float:
        if cell.lower() in MISSING:
            return math.nan
        try:
            return float(cell.replace(",", ".") if self.decimal == "," else cell)
        except ValueError:
            hint = ": pass decimal=',' if it has a decimal comma" if "," in cell and self.decimal == "." else ""
            raise ValueError(
                f"{header} = {cell!r} in line {line} of {str(self.path)!r} is not a number{hint}"
            ) from None

    def _parts(self, name: str, header_and_unit: Any, si: str) -> tuple[Any, float]:
        """The header (or, for an error, possibly a number), and the factor that converts the file's numbers to SI units."""
        if isinstance(header_and_unit, str):
            # A header that has a unit, with or without it.
            headers = {_split(header)[0]: header for header in self.cells}
            header = headers.get(header_and_unit, header_and_unit)
            header_and_unit = (header, _split(header)[1]) if _split(header)[1] else header_and_unit
        if not isinstance(header_and_unit, tuple) or len(header_and_unit) != 2:
            raise ValueError(
                f"columns: {name!r} = {shown(header_and_unit)} must be (header, unit), such as ('tilt', 'deg'), or a header "
                "with its unit, such as 'tilt [deg]'"
            )
        first, unit = header_and_unit
        if not isinstance(unit, str):
            require(unit, f"unit of {name}")
            return first, float(unit)
        factors, plain = UNITS[si], SYNONYMS.get(unit, unit)
        if plain not in factors:
            raise ValueError(f"unit of {name} = {shown(unit)} must be one of {', '.join(factors)}, or a number of {si}")
        return first, factors[plain]


def _text(path: Path) -> str:
    """The text of a file in UTF-8, or as spreadsheets write it: in UTF-16 with a mark, or in Windows' encoding."""
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _has_cells(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _split(header: str) -> tuple[str, str]:
    """The name and the unit of a header, such as "tilt [deg]", "tilt (deg)" or "tilt / deg"; no unit if there is none."""
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\]]+)\]|\(([^)]+)\)|\s/\s*(\S+))", header.strip())
    if match is None:
        return header.strip(), ""
    unit = next(part for part in match.groups()[1:] if part).strip()
    known = unit in SYNONYMS or any(unit in units for units in UNITS.values())
    return (match[1].strip(), unit) if known else (header.strip(), "")


def _unit_of(name: str, known: Mapping[str, str]) -> str:
    """The unit of a column whose header has none: only a number without a unit needs none."""
    if known[name] != "1":
        raise ValueError(
            f"columns: the header {name!r} must have a unit, such as '{name} [{known[name]}]'; or pass columns, a dictionary"
        )
    return "1"


def _times(file: TextTable, columns: Mapping[str, Any], fps: Any) -> np.ndarray:
    """The clock's readings in all lines [s]."""
    if fps is not None:
        require(fps, "fps", above=0.0)
        if "time" in columns:
            raise ValueError(f"fps = {shown(fps)} must be omitted because 'time' is among the columns")
        if "frame" not in columns:
            return np.arange(len(file.lines)) / float(fps)
        return file.numbers("frame", columns["frame"], "1") / float(fps)
    if "time" not in columns or "frame" in columns:
        raise ValueError("fps must be given, or the columns must have 'time'")
    return file.numbers("time", columns["time"], "s")


def _errors(file: TextTable, name: str, header_and_unit: Any, si: str) -> np.ndarray:
    """The standard errors of a column."""
    first = header_and_unit[0] if isinstance(header_and_unit, tuple) and header_and_unit else header_and_unit
    if isinstance(first, str):
        return file.numbers(name, header_and_unit, si)
    first, size = file._parts(name, header_and_unit, si)
    require(first, f"error of {name}", above=0.0)
    return np.full(len(file.lines), size * float(first))
