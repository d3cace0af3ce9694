"""Measured times of launches: of inversion, and of reversal. Inversion times can be read from a file."""

import dataclasses
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.identification import read_launches
from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers
from nonholonomic.runs import AbstractEventTimes
from nonholonomic.text import distinguishing_labels
from nonholonomic.validation import as_number, as_number_or_none, is_traced, require_kind, require_scalars
from nonholonomic.warning import warn

from ..model.launch import Launch, as_launch
from ..model.scene import Scene
from ..runs.checks import angle_of, check_event, check_reversible, event_of, require_rigid
from ..runs.extended_times import beyond_horizon, time_of_inversion
from ..runs.model import TopModel

#: Measured times are usually shorter [s]; longer ones may be in milliseconds.
LONG = 500.0

#: The numbers of a launch that a file can contain, with their SI units.
UNITS = {"theta": "rad", "spin": "rad/s", "eta": "rad", "azimuth": "rad"}

#: The least and the greatest values of angles in a file [rad].
LIMITS = {"theta": (0.0, math.pi), "eta": (-math.pi, math.pi)}

_beyond_horizon = jax.jit(beyond_horizon)


class AbstractTimes(AbstractEventTimes):
    """Measured times of an event of launches; see `InversionTimes`."""

    launch: Launch = eqx.field(converter=as_launch)
    time: Float[Array, "launches *two"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    until: Any = eqx.field(converter=as_number_or_none, default=None)
    by_tables = True

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, " or a list of launches")
        # What is no number is refused later.
        seconds = (
            np.asarray(self.time) if isinstance(self.time, jax.Array) and not is_traced(self.time) else np.zeros(0)
        )
        if np.any(np.isfinite(seconds)) and (middle := np.median(seconds[np.isfinite(seconds)])) > LONG:
            warn(f"time = {middle:g} s is long for a top; times are in seconds: did you mean 1e-3 * time?")

    @property
    def of_each_time(self) -> dict[str, Any]:
        return numbers("launch", self.launch) | super().of_each_time

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each launch."""
        theta, spin, _ = np.broadcast_arrays(self.launch.theta, self.launch.spin, np.zeros(self.size))
        return tuple(f"theta {angle:.4g}, spin {rate:.4g}" for angle, rate in zip(theta, spin, strict=True))

    def labels_in(self, unit: Any) -> tuple[str, ...]:
        """What differs between the launches."""
        launches = [
            jax.tree.map(lambda leaf, k=k: leaf if jnp.ndim(leaf) == 0 else leaf[k], self.launch)
            for k in range(self.size)
        ]
        return tuple(distinguishing_labels([("launch",)] * self.size, launches, unit=unit))


class InversionTimes(AbstractTimes):
    """Measured inversion times of launches. As a parameter varies, the time jumps by a nutation period, so its slope
    differs from its trend; the time is smooth only if theta grows monotonically. Small initial angles, target angles of
    0.6 to 0.8 pi, and several launches keep the jumps below the errors.

    **Arguments:**

    - `launch`: a list of launches; or one `Launch` whose numbers are scalars or arrays (launches,).
    - `time`: (launches,) [s], infinite for a top that did not invert while you watched; or (launches, 2), two times
      between which the top inverted: (0, a) before a, (b, inf) later than b, (a, b) between a and b, (t, t) at t.
    - `error`: standard errors [s], a scalar or (launches,); for a limit, the error of the clock.
    - `t1`: horizon of the model's runs [s]: choose several times the longest measured time, because start values may be
      far off.
    - `until`: time [s] until which you watched a launch that did not invert, a scalar or (launches,); `t1` by default.
      The likelihood of such a launch is the probability of a time beyond `until`.
    - `angle`: angle [rad] that counted as inverted; by default as for `inversion_time`.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for data with outliers;
      `None` for Gaussian errors.

    **Raises:** `ValueError` for numbers out of range or shapes that do not fit.

    **Example:** the second launch inverted between two frames, the third had not inverted after 6 s.

    >>> import numpy as np, tippe
    >>> launch = tippe.Launch(theta=0.1, spin=[150.0, 120.0, 60.0])
    >>> data = tippe.InversionTimes(launch, [(5.2, 5.2), (5.4, 5.6), (6.0, np.inf)], error=0.02, t1=20.0)
    >>> data.measurements.censored.tolist()
    [False, True, True]
    """

    angle: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s", "angle": "rad"}

    def __check_init__(self):
        check_event(self.angle, "first")

    @property
    def horizon(self) -> Float[Array, ""]:
        # Predictions continue smoothly beyond it.
        return self.t1

    def model(self, system: Any) -> TopModel:
        require_kind(system, "scene", Scene)
        return TopModel.timed(system, self.launch, event_of(system, self.angle))

    def predicted(self, model: Any, t1: Any, settings: Settings) -> Float[Array, ""]:
        return time_of_inversion(model, t1, settings)

    def of_ends(self, model: Any, t1: Any, time: Any, ends: dict[str, Any]) -> Any:
        angle = angle_of(model.scene, self.angle)
        later = _beyond_horizon(ends["end_theta"], model.launch.theta, angle, t1)
        return np.where(np.isfinite(time), time, np.asarray(later))


class ReversalTimes(AbstractTimes):
    """Measured times at which bodies such as a rattleback reversed their spin (see `reversal_time`).

    **Arguments:**

    - `launch`, `time`, `error`, `t1`, `until`, `student`: as for `InversionTimes`; a time is infinite if the spin did not
      reverse while you watched.

    **Raises:** `ValueError` for numbers out of range or shapes that do not fit.

    **Example:** three times of a rattleback, which did not reverse in the other sense within 6 s. The product of inertia, or
    any other number of the stone, is then an unknown of `identify(scene, data, {"inertia.xy": -1.8e-5})`.

    >>> import tippe
    >>> launch = tippe.Launch(theta=0.02, spin=[-4.0, -5.0, -6.0, 5.0])
    >>> data = tippe.ReversalTimes(launch, [2.11, 2.60, 2.98, float("inf")], error=0.02, t1=8.0, until=6.0)
    >>> data.measurements.censored.tolist()
    [False, False, False, True]
    """

    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s"}

    def model(self, system: Any) -> TopModel:
        require_kind(system, "scene", Scene)
        require_rigid(system)
        check_reversible(self.launch, {})
        return TopModel.timed(system, self.launch, None)


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
