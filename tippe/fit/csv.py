"""Recordings of tops from files."""

from typing import Any

from nonholonomic.identification import read_columns

from ..model.launch import Launch
from .data import QUANTITIES, Recording


def read_recording(
    path: Any,
    columns: Any,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Any = None,
    t0: float = 0.0,
    student: float | None = None,
) -> Recording:
    """A recording of a top from a text file of columns with a line of headers (CSV).

    **Arguments:**

    - `path`: of the file. Columns are parted by commas, semicolons, tabs or blanks; empty cells and `nan` are missing samples;
      lines that begin with # are left out.
    - `columns`: what a column is -> (its header, its unit): `"time"`, or `"frame"`, and any of `"theta"`, `"azimuth"`, `"eta"`,
      `"spin"`, `"x"`, `"y"`, `"z"`, `"axis_x"`, `"axis_y"`, `"axis_z"`. Units are s, ms, min; rad, deg, rev; rad/s, deg/s, rpm,
      rev/s; m, cm, mm; 1, %; or a number, the SI units that one of the file is, such as the metres of a pixel.
    - `fps`: frames a second, where there is no `"time"`; without a `"frame"` every line is one.
    - `launch`: a `Launch`, as far as it is known.
    - `error`: what a column is -> (its standard error, or the header of a column of them, unit); `None`: to be estimated.
    - `t0`, `student`: as for `Recording`.

    **Returns:** a `Recording`.

    **Raises:** `ValueError` that names the column and what is wrong with it.

    **Example:** three frames of a film at 50 frames a second, the second of them unreadable.

    >>> import pathlib, tempfile, tippe
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "film.csv"
    >>> _ = path.write_text("frame,tilt\\n0,5.7\\n1,\\n2,6.3\\n")
    >>> launch = tippe.Launch(theta=0.1, spin=150.0)
    >>> columns = {"frame": ("frame", "1"), "theta": ("tilt", "deg")}
    >>> film = tippe.read_recording(path, columns, fps=50, launch=launch, error={"theta": (1.0, "deg")})
    >>> print(film.times, film.value.round(4))
    [0.   0.04] [0.0995 0.11  ]
    """
    read = read_columns(path, columns, fps, error, QUANTITIES)
    return Recording(launch, *read, t0, student)
