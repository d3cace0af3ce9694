"""Measured inversion times of launches."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.identification import Measurements
from nonholonomic.parameters import numbers, one_line, with_numbers
from nonholonomic.validation import as_number, as_number_or_none, require, require_kind, shown

from ..model.launch import Launch, as_launch
from ..model.scene import Scene
from ..runs.checks import check_event
from ..runs.extended_times import extended_inversion_time
from ..runs.turned_over import angle_of

#: Parameters by name, one value per row.
Values = dict[str, Float[Array, " rows"]]


class InversionTimes(eqx.Module):
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

    launch: Launch = eqx.field(converter=as_launch)
    time: Float[Array, "launches *two"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    until: Any = eqx.field(converter=as_number_or_none, default=None)
    angle: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s", "angle": "rad"}

    def __repr__(self) -> str:
        return one_line(self)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, " or a list of launches")
        shape = np.shape(self.time)
        if not isinstance(self.time, jax.Array):
            raise ValueError(f"time = {shown(self.time)} must be a list of numbers")
        if len(shape) not in (1, 2) or shape[0] == 0 or shape[1:] not in ((), (2,)):
            raise ValueError(f"time must be a non-empty list of times or of pairs of them, not of shape {shape}")
        require(self.t1, "t1", above=0.0)
        check_event(self.angle, "first")
        measured = np.asarray(self.time)
        if np.any(np.isnan(measured)):
            raise ValueError("time must be numbers, infinite where a launch did not invert")
        if self.until is not None:
            require(self.until, "until", above=0.0, at_most=self.t1, why="t1")
        first, last = self._limits
        require(first[first == last], "time", above=0.0, below=self.t1, why="t1")
        require(first, "time", at_least=0.0, at_most=self.t1, why="t1")
        if np.any(last < first):
            raise ValueError(f"time = {measured[np.argmax(last < first)]} must be a time, or two in order")
        require(self.error, "error", above=0.0)
        if self.student is not None:
            require(self.student, "student", above=0.0)
        key = numbers("launch", self.launch) | {"error": self.error, "until": self.until}
        for name, value in key.items():
            if value is not None and np.shape(value) not in ((), shape[:1]):
                raise ValueError(
                    f"{name} must be one number or one for each of the {shape[0]} times, not of shape {np.shape(value)}"
                )

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """The limits between which every launch inverted."""
        time = np.asarray(self.time)
        if time.ndim == 2:
            return time[:, 0], time[:, 1]
        until = self.t1 if self.until is None else self.until
        return np.where(np.isfinite(time), time, np.asarray(until)), time

    @property
    def measurements(self) -> Measurements:
        """The times as `Measurements`."""
        first, last = self._limits
        is_before = (first == 0.0) & np.isfinite(last)
        student = math.inf if self.student is None else float(self.student)
        return Measurements(np.where(is_before, -np.inf, first), self.error, upper=last, student=student)

    @property
    def series_units(self) -> tuple[str, ...]:
        """The unit of the only series of the measurements."""
        return ("s",)

    @property
    def size(self) -> int:
        """Number of predictions."""
        return len(self.time)

    @property
    def seen(self) -> np.ndarray:
        """Indices of the measured predictions, which are all predictions."""
        return np.arange(self.size)

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each launch."""
        columns = np.broadcast_arrays(
            np.asarray(self.launch.theta), np.asarray(self.launch.spin), np.asarray(self._limits[0])
        )
        return tuple(f"theta {theta:.4g}, spin {spin:.4g}" for theta, spin in zip(*columns[:2], strict=True))

    def predict(
        self, scene: Scene, values: Values, rows: int, tolerance: Float[Array, ""]
    ) -> Float[Array, "rows launches"]:
        """Times of all launches in every row, computed as lanes of one ensemble."""
        launches = len(self.time)
        lanes = _launches(self.launch, launches, rows)
        lanes |= {name: jnp.repeat(value, launches) for name, value in values.items() if name != "t0"}

        def time_of_lane(lane: dict[str, Array]) -> Float[Array, ""]:
            roots = with_numbers({"scene": scene, "launch": _one_of(self.launch)}, lane)
            angle = angle_of(roots["scene"], self.angle)
            return extended_inversion_time(roots["scene"], roots["launch"], self.t1, angle, tolerance)

        return jax.vmap(time_of_lane)(lanes).reshape(rows, launches)


def _launches(launch: Launch, count: int, rows: int) -> Values:
    """The numbers of all launches in every row that differ between launches."""
    lists = {name: value for name, value in numbers("launch", launch).items() if value is not None and np.ndim(value)}
    return {name: jnp.tile(value, rows) for name, value in lists.items()}


def _one_of(launch: Launch) -> Launch:
    """The first of several launches."""
    return jax.tree.map(lambda leaf: leaf if jnp.ndim(leaf) == 0 else leaf[0], launch)
