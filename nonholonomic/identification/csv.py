"""Read recordings from a file of columns, in the units of the file."""

import csv
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..parameters import UNITS
from ..validation import as_path, require, shown
from .recording import Quantities


class Read(NamedTuple):
    """The contents of a file: times [s]; samples in SI units, NaN where missing; their errors or `None`; and the
    quantity.

    A single column is given by its name, and its samples are (times,).
    """

    times: Float[np.ndarray, " times"]
    value: Float[np.ndarray, "times *columns"]
    error: Float[np.ndarray, "times *columns"] | None
    quantity: str | tuple[str, ...]


def read_columns(path: Any, columns: Any, fps: float | None, error: Any, quantities: Quantities) -> Read:
    """Read samples from a text file with a header line and columns separated by commas, semicolons, tabs or blanks.

    **Arguments:**

    - `path`: path of the file. Lines that begin with # are ignored; empty cells and `nan` are missing samples.
    - `columns`: name of a column of the model -> (header, unit); the unit is one of `UNITS`, or a factor that converts
      the file's numbers to SI units. `"time"` is the clock; `"frame"` is the number of the frame and needs `fps`.
    - `fps`: frames per second. Without a column for the frame, each line is a frame.
    - `error`: name of a column -> (standard error or header of its column, unit), for some or all columns; or `None`.
    - `quantities`: the quantities that can be recorded.

    **Returns:** times, values, errors and quantity.

    **Raises:** `ValueError` that names the file, the column and the problem.

    **Example:**

    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> from nonholonomic.identification import read_columns
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "levels.csv"
    ...     length = path.write_text("clock,level\\n0.1,90\\n0.2,80\\n")
    ...     columns = {"time": ("clock", "s"), "level": ("level", "%")}
    ...     read_columns(path, columns, None, None, Recording.quantities).value
    array([0.9, 0.8])
    """
    if not isinstance(columns, Mapping) or not columns:
        raise ValueError(f"columns = {shown(columns)} must be a dictionary, such as {{'theta': ('tilt', 'deg')}}")
    table = _table(as_path(path, "path"))
    names = quantities.of(tuple(name for name in columns if name not in ("time", "frame")))
    for name in columns:
        if name not in ("time", "frame", *names):
            raise ValueError(f"columns: {name!r} must be a single column: time, frame, {', '.join(quantities.units)}")
    times = _times(table, columns, fps, path)
    value = np.stack([_column(table, name, columns[name], quantities.units[name], path) for name in names], axis=1)
    mask = np.isfinite(times) & np.any(np.isfinite(value), axis=1)
    errors = None
    if error is not None:
        if not isinstance(error, Mapping) or set(error) != set(names):
            raise ValueError(f"error = {shown(error)} must be a dictionary with {', '.join(names)}, or None")
        units = quantities.units
        errors = np.stack([_errors(table, name, error[name], units[name], path) for name in names], axis=1)[mask]
    if len(names) == 1:
        return Read(times[mask], value[mask, 0], None if errors is None else errors[:, 0], names[0])
    return Read(times[mask], value[mask], errors, names)


def _table(path: Path) -> dict[str, list[str]]:
    """The cells of every column, as text, by header."""
    lines = [
        line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.strip() and line.lstrip()[0] != "#"
    ]
    if len(lines) < 2:
        raise ValueError(f"path = {str(path)!r} must have a header line and at least one line of numbers")
    parted = next((mark for mark in ("\t", ";", ",") if mark in lines[0]), None)
    rows = list(csv.reader(lines, delimiter=parted)) if parted else [line.split() for line in lines]
    headers = [header.strip() for header in rows[0]]
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(headers):
            raise ValueError(f"path = {str(path)!r}: line {number} has {len(row)} cells, not {len(headers)}")
    return {header: [row[k].strip() for row in rows[1:]] for k, header in enumerate(headers)}


def _times(table: dict[str, list[str]], columns: Mapping[str, Any], fps: Any, path: Any) -> np.ndarray:
    """The clock's readings in all lines [s]."""
    if fps is not None:
        require(fps, "fps", above=0.0)
        if "time" in columns:
            raise ValueError(f"fps = {shown(fps)} must be omitted because 'time' is among the columns")
        if "frame" not in columns:
            return np.arange(len(next(iter(table.values())))) / float(fps)
        return _column(table, "frame", columns["frame"], "1", path) / float(fps)
    if "time" not in columns or "frame" in columns:
        raise ValueError("fps must be given, or the columns must have 'time'")
    return _column(table, "time", columns["time"], "s", path)


def _column(table: dict[str, list[str]], name: str, header_and_unit: Any, si: str, path: Any) -> np.ndarray:
    """A column in SI units, NaN where it is empty."""
    header, size = _parts(name, header_and_unit, si)
    if header not in table:
        raise ValueError(f"columns: {header!r} must be one of the headers of {str(path)!r}: {', '.join(table)}")
    values = []
    for number, cell in enumerate(table[header], start=2):
        try:
            values.append(float(cell) if cell else math.nan)
        except ValueError:
            raise ValueError(f"{header} = {cell!r} in line {number} of {str(path)!r} is not a number") from None
    return size * np.array(values)


def _errors(table: dict[str, list[str]], name: str, header_and_unit: Any, si: str, path: Any) -> np.ndarray:
    """The standard errors of a column."""
    first, size = _parts(name, header_and_unit, si)
    if isinstance(first, str):
        return _column(table, name, header_and_unit, si, path)
    require(first, f"error of {name}", above=0.0)
    return np.full(len(next(iter(table.values()))), size * float(first))


def _parts(name: str, header_and_unit: Any, si: str) -> tuple[Any, float]:
    """The header (or, for an error, possibly a number), and the factor that converts the file's numbers to SI units."""
    if not isinstance(header_and_unit, tuple) or len(header_and_unit) != 2:
        raise ValueError(
            f"columns: {name!r} = {shown(header_and_unit)} must be (header, unit), such as ('tilt', 'deg')"
        )
    first, unit = header_and_unit
    factors = UNITS[si]
    if isinstance(unit, str):
        if unit not in factors:
            raise ValueError(f"unit of {name} = {shown(unit)} must be one of {', '.join(factors)}, or a number of {si}")
        return first, factors[unit]
    require(unit, f"unit of {name}")
    return first, float(unit)
