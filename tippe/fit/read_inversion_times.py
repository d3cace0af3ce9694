"""Read measured inversion times of many launches from a file."""

import dataclasses
import math
from typing import Any

import numpy as np

from nonholonomic.identification import read_launches
from nonholonomic.validation import require_kind, require_scalars

from ..model.launch import Launch
from .inversion_times import InversionTimes

#: The numbers of a launch that a file can contain, with their SI units.
UNITS = {"theta": "rad", "spin": "rad/s", "eta": "rad", "azimuth": "rad"}

#: The least and the greatest values of angles [rad].
LIMITS = {"theta": (0.0, math.pi), "eta": (-math.pi, math.pi)}


def read_inversion_times(
    path: Any,
    columns: Any = None,
    *,
    error: Any,
    t1: float,
    launch: Launch | None = None,
    until: float | None = None,
    angle: float | None = None,
    student: float | None = None,
    decimal: str = ".",
    never: Any = (),
) -> InversionTimes:
    """Launches of a top and their inversion times from a text file with a header line and a launch in every line (CSV).

    A line without a time, or without a number of its launch, is a lost measurement and is left out: empty cells, `nan`
    and `n/a`. A top that did not turn over is a measurement, too: write `inf`, or ">30" if you watched for 30 s, or pass
    the word of your file as `never`.

    **Arguments:**

    - `path`, `decimal`: as for `read_recording`.
    - `columns`: quantity -> (header of its column, unit): `"time"`, and any of `"theta"`, `"spin"`, `"eta"`, `"azimuth"`,
      with units as for `read_recording`. If the header has the unit, as "angle [deg]", the header is enough. By default,
      the columns whose headers are these quantities with units, such as "theta [deg]", "spin [rpm]" and "time [s]".
    - `error`: standard error of the times [s]; or `{"time": (standard error or header of its column, unit)}`.
    - `launch`: a `Launch` with the numbers that all launches share and that have no column; without `launch`, `theta`
      and `spin` must have columns.
    - `t1`, `until`, `angle`, `student`: as for `InversionTimes`. A limit in the file, such as ">30", takes precedence
      over `until`.
    - `never`: a text, or a list of texts, that stand for a top that did not turn over while you watched, such as "-".

    **Returns:** an `InversionTimes`.

    **Raises:** `ValueError` that names the column or the line of the file, and the problem.

    **Example:** the second time was lost, and the fourth top did not turn over.

    >>> import pathlib, tempfile, tippe
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "class.csv"
    >>> lines = ["# class 8b", "angle [deg];spin [rpm];time [s]", "4,0;1100;3,47", "4,0;1250;n/a", "5,5;1400;3,49", "4,0;600;-"]
    >>> _ = path.write_text("\\n".join(lines))
    >>> columns = {"theta": ("angle", "deg"), "spin": ("spin", "rpm"), "time": ("time", "s")}
    >>> data = tippe.read_inversion_times(path, columns, error=0.05, t1=30.0, until=10.0, decimal=",", never="-")
    >>> print(data.time, data.launch.spin.round(1))
    [3.47 3.49  inf] [115.2 146.6  62.8]
    """
    table = read_launches(path, columns, error, UNITS, decimal, never)
    for name, (least, greatest) in LIMITS.items():
        for line, value in zip(table.lines, table.numbers[name], strict=True) if name in table.numbers else ():
            if not least <= value <= greatest:
                raise ValueError(
                    f"{name} = {value:.6g} rad in line {line} of {str(path)!r} must be between {least:.4g} and pi rad: is the "
                    f"column in degrees? Pass columns={{{name!r}: (header, 'deg')}}"
                )
    is_stated = np.isfinite(table.until)
    limits = np.where(is_stated, table.until, t1 if until is None else until) if np.any(is_stated) else until
    launches = _launches(table.numbers, launch)
    times: Any = {"time": table.time, "error": table.error, "t1": t1, "until": limits}
    return InversionTimes(launch=launches, **times, angle=angle, student=student)


def _launches(numbers: dict[str, np.ndarray], launch: Launch | None) -> Launch:
    """The launches of a file."""
    if launch is not None:
        require_kind(launch, "launch", Launch)
        require_scalars({name: getattr(launch, name) for name in UNITS}, "the file has the numbers that differ")
        return dataclasses.replace(launch, **numbers)
    for name in ("theta", "spin"):
        if name not in numbers:
            raise ValueError(
                f"columns must have {name!r}, or launch must be a Launch with the {name} of all launches, such as "
                "launch=tippe.Launch(theta=0.1, spin=150.0)"
            )
    return Launch(**numbers)
