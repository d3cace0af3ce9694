"""Read recordings, and launches with measured times, from a file of columns, in the units of the file."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..text import likely
from ..validation import as_path, require, shown
from .recording import Quantities
from .text_table import DASHES, TextTable


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
    >>> from nonholonomic.identification import Quantities, read_columns
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "levels.csv"
    ...     length = path.write_text("clock [s];level [%]\\n0,1;90\\n0,2;n/a\\n0,3;80\\n")
    ...     columns = {"time": "clock", "level": "level"}
    ...     read_columns(path, columns, None, None, Quantities({}, {"level": "1"}, frozenset()), decimal=",").value
    array([0.9, 0.8])
    """
    known = {"time": "s", "frame": "1"} | dict(quantities.units)
    file, columns = _opened(path, columns, decimal, known, quantities.columns)
    names = quantities.of(tuple(name for name in columns if name not in ("time", "frame")))
    times = _times(file, columns, fps)
    value = np.stack([file.numbers(name, columns[name], known[name]) for name in names], axis=1)
    mask = np.isfinite(times) & np.any(np.isfinite(value), axis=1)
    _require_increasing(file, times, mask, quantities)
    errors = None
    if error is not None:
        if not isinstance(error, Mapping) or set(error) != set(names):
            form = ", ".join(f"{name!r}: (standard error, unit)" for name in names)
            raise ValueError(f"error = {shown(error)} must be {{{form}}}, or None")
        errors = np.stack([file.errors(name, error[name], known[name]) for name in names], axis=1)[mask]
    if len(names) == 1:
        return Read(times[mask], value[mask, 0], None if errors is None else errors[:, 0], names[0])
    return Read(times[mask], value[mask], errors, names)


class ReadLaunches(NamedTuple):
    """The launches of a file and their times, in SI units.

    - `numbers`: name of a number of the launch -> (launches,).
    - `time`: (launches,), infinite where the event did not happen; `until`: (launches,), the time until which it did
      not happen, NaN where the file does not state one.
    - `error`: a standard error for all, or (launches,).
    - `lines`: the number of each launch's line in the file.
    """

    numbers: dict[str, Float[np.ndarray, " launches"]]
    time: Float[np.ndarray, " launches"]
    until: Float[np.ndarray, " launches"]
    error: Float[np.ndarray, "*launches"]
    lines: tuple[int, ...]


def read_launches(
    path: Any, columns: Any, error: Any, units: Mapping[str, str], decimal: str = ".", never: Any = ()
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
    file, columns = _opened(path, columns, decimal, {"time": "s"} | dict(units), {})
    if "time" not in columns:
        raise ValueError(f"columns = {shown(columns)} must have 'time', the measured time of each launch")
    names = [name for name in columns if name != "time"]
    time, until = _times_of_launches(file, columns["time"], never)
    numbers = {name: file.numbers(name, columns[name], units[name]) for name in names}
    errors = _errors_of_times(file, error)
    mask = ~np.any(np.isnan([time, *numbers.values(), np.broadcast_to(errors, time.shape)]), axis=0)
    if not np.any(mask):
        raise ValueError(f"path = {str(file.path)!r} must have at least one line with {', '.join(columns)}")
    return ReadLaunches(
        {name: value[mask] for name, value in numbers.items()},
        time[mask],
        until[mask],
        errors[mask] if errors.ndim else errors,
        tuple(line for line, is_whole in zip(file.lines, mask, strict=True) if is_whole),
    )


def _opened(
    path: Any, columns: Any, decimal: Any, known: Mapping[str, str], several: Mapping[str, tuple[str, ...]]
) -> tuple[TextTable, Mapping[str, Any]]:
    """The file and its columns, checked. **Arguments:** `known`: name of a column -> its SI unit; `several`: names that
    stand for several columns."""
    if decimal not in (".", ","):
        raise ValueError(f"decimal = {shown(decimal)} must be '.' or ','")
    if columns is not None and (not isinstance(columns, Mapping) or not columns):
        raise ValueError(
            f"columns = {shown(columns)} must be a dictionary, such as {{'theta': ('tilt', 'deg')}}, or None"
        )
    file = TextTable.read(as_path(path, "path"), decimal)
    columns = file.named(known) if columns is None else columns
    for name in columns:
        if name in several:
            raise ValueError(f"columns: {name!r} must be a single column: {', '.join(several[name])}")
        if name not in known:
            hint = "; did you mean 'time'?" if name == "t" else likely(name, known)
            raise ValueError(f"columns: {shown(name)} must be one of {', '.join(known)}{hint}")
    return file, columns


def _times_of_launches(
    file: TextTable, header_and_unit: Any, never: Any
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]:
    """The times of all lines, infinite where the event did not happen, and the limits that the file states."""
    words = (never,) if isinstance(never, str) else never
    if not isinstance(words, tuple | list) or not all(isinstance(word, str) for word in words):
        raise ValueError(f"never = {shown(never)} must be a text, such as '-', or a list of them")
    header, _ = file.parts("time", header_and_unit, "s", "columns")
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
    time = file._replace(cells={**file.cells, header: plain}).numbers(
        "time",
        header_and_unit,
        "s",
        remark=": if it stands for an event that did not happen, pass it as never",
        infinite=True,
    )
    for line, cell, value in zip(file.lines, cells, time, strict=True):
        if value <= 0.0:
            raise ValueError(f"{header} = {cell!r} in line {line} of {str(file.path)!r} must be greater than 0")
    return np.where(is_limit, np.inf, time), np.where(is_limit, time, np.nan)


def _errors_of_times(file: TextTable, error: Any) -> Float[np.ndarray, "*lines"]:
    """The standard errors of the times [s]."""
    if isinstance(error, Mapping):
        if set(error) != {"time"}:
            raise ValueError(
                f"error = {shown(error)} must be {{'time': (standard error, unit)}} or a number of seconds"
            )
        return file.errors("time", error["time"], "s")
    require(error, "error", above=0.0)
    if np.ndim(error) != 0:
        raise ValueError("error must be one number [s], or {'time': (header of a column of standard errors, unit)}")
    return np.asarray(error, float)


def _require_increasing(file: TextTable, times: np.ndarray, mask: np.ndarray, quantities: Quantities) -> None:
    """Raise `ValueError` unless the times of the samples increase."""
    lines, seen = np.asarray(file.lines)[mask], times[mask]
    for k in np.flatnonzero(np.diff(seen) <= 0.0)[:1]:
        raise ValueError(
            f"time = {seen[k + 1]:.6g} s in line {lines[k + 1]} of {str(file.path)!r} must be later than "
            f"{seen[k]:.6g} s in line {lines[k]}{quantities.one_run}"
        )


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
