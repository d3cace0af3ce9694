"""What is measured of a tippe top: inversion times of launches, and recorded motion."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.identification import AbstractRecording, Measurements, Quantities, as_quantity, predicted
from nonholonomic.parameters import numbers, one_line, with_numbers
from nonholonomic.validation import as_number, as_number_or_none, require

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.checks import check_event
from ..runs.extended_times import extended_inversion_time
from ..runs.trajectory import simulate

#: What can be recorded of a top: as the properties of a `Trajectory` call it.
QUANTITIES = Quantities(
    columns={"position": ("x", "y", "z"), "axis": ("axis_x", "axis_y", "axis_z")},
    units={"theta": "rad", "azimuth": "rad", "eta": "rad", "spin": "rad/s"}
    | dict.fromkeys(("x", "y", "z"), "m")
    | dict.fromkeys(("axis_x", "axis_y", "axis_z"), "1"),
    angles=frozenset({"azimuth", "eta"}),
)

#: How far [rad] a recorded theta may be outside [0, pi] if its errors are smaller, or not known.
NOISE = 0.3

#: Parameters by name, one value a row.
Values = dict[str, Float[Array, " rows"]]


class InversionTimes(eqx.Module):
    """Measured inversion times of some launches.

    Over a nutation period the time is a staircase in every parameter, so its slope differs from its trend; where theta grows
    without falling back it is smooth. Small angles at the launch, angles to be reached of 0.6 to 0.8 pi, and several
    launches keep the steps below the errors.

    **Arguments:**

    - `launch`: a `Launch` whose numbers are one for all or (launches,).
    - `time`: (launches,) [s], infinite for a launch that was not seen to invert; or (launches, 2), between which two times it
      inverted: (0, a) before a, (b, inf) not until b, (a, b) between a and b, (t, t) at t.
    - `error`: standard errors [s], one for all or (launches,); those of a limit are of the clock that it was read off.
    - `t1`: until when the model follows a launch [s]: several times the longest time measured, because a start may be far off.
    - `until`: until when a launch of infinite time was watched [s], one for all or (launches,); `t1` by default. Its
      likelihood is one-sided: the probability of a time beyond `until`.
    - `angle`: angle [rad] that counted as inverted.
    - `student`: degrees of freedom of Student's t distribution of the errors, against outliers, such as 4; `None`: Gaussian.

    **Raises:** `ValueError` for numbers out of range or shapes that do not fit.

    **Example:** the second launch was seen to invert between two frames, the third had not inverted after 6 s.

    >>> import numpy as np, tippe
    >>> launch = tippe.Launch(theta=0.1, spin=[150.0, 120.0, 60.0])
    >>> data = tippe.InversionTimes(launch, [(5.2, 5.2), (5.4, 5.6), (6.0, np.inf)], error=0.02, t1=20.0)
    >>> data.measurements.censored.tolist()
    [False, True, True]
    """

    launch: Launch
    time: Float[Array, "launches *two"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    until: Any = eqx.field(converter=as_number_or_none, default=None)
    angle: Float[Array, ""] = eqx.field(converter=as_number, default=0.95 * math.pi)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s", "angle": "rad"}

    def __repr__(self) -> str:
        return one_line(self)

    def __check_init__(self):
        shape = np.shape(self.time)
        if len(shape) not in (1, 2) or shape[0] == 0 or shape[1:] not in ((), (2,)):
            raise ValueError(f"time must be a non-empty list of times or of pairs of them, not of shape {shape}")
        require(self.t1, "t1", above=0.0)
        check_event(self.angle, "first")
        given = np.asarray(self.time)
        if np.any(np.isnan(given)):
            raise ValueError("time must be numbers, infinite where a launch did not invert")
        if self.until is not None:
            require(self.until, "until", above=0.0, at_most=self.t1, why="t1")
        first, last = self._limits
        require(first[first == last], "time", above=0.0, below=self.t1, why="t1")
        require(first, "time", at_least=0.0, at_most=self.t1, why="t1")
        if np.any(last < first):
            raise ValueError(f"time = {given[np.argmax(last < first)]} must be a time, or two in order")
        if self.student is not None:
            require(self.student, "student", above=0.0)
        alike = numbers("launch", self.launch) | {"error": self.error, "until": self.until}
        for name, value in alike.items():
            if value is not None and np.shape(value) not in ((), shape[:1]):
                raise ValueError(f"{name} must be one number or one for each launch, not of shape {np.shape(value)}")

    @property
    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        """After which time, and until which, every launch inverted."""
        time = np.asarray(self.time)
        if time.ndim == 2:
            return time[:, 0], time[:, 1]
        until = self.t1 if self.until is None else self.until
        return np.where(np.isfinite(time), time, np.asarray(until)), time

    @property
    def measurements(self) -> Measurements:
        """The times as `Measurements`."""
        first, last = self._limits
        before = (first == 0.0) & np.isfinite(last)
        student = math.inf if self.student is None else float(self.student)
        return Measurements(np.where(before, -np.inf, first), self.error, upper=last, student=student)

    @property
    def series_units(self) -> tuple[str, ...]:
        """The unit of the only series of the measurements."""
        return ("s",)

    @property
    def size(self) -> int:
        """How many numbers are predicted."""
        return len(self.time)

    @property
    def seen(self) -> np.ndarray:
        """Which of the predictions were measured: all."""
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
        """Times of all launches in every row, all of them lanes of one block."""
        launches = len(self.time)
        lanes = _launches(self.launch, launches, rows)
        lanes |= {name: jnp.repeat(value, launches) for name, value in values.items() if name != "t0"}

        def one(lane: dict[str, Array]) -> Float[Array, ""]:
            roots = with_numbers({"scene": scene, "launch": _one_of(self.launch)}, lane)
            return extended_inversion_time(roots["scene"], roots["launch"], self.t1, self.angle, tolerance)

        return jax.vmap(one)(lanes).reshape(rows, launches)


class Recording(AbstractRecording):
    """A recorded run: some quantities at the readings of a clock.

    **Arguments:**

    - `launch`: a `Launch`, every number a scalar.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for one column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors, one for all, (columns,), or of the shape of `value`; `None`: to be estimated for each column
      from the scatter about the fit.
    - `quantity`: "theta", "azimuth", "eta" [rad], "spin" [rad/s], "position" ("x", "y", "z") [m] of the sphere's centre or
      "axis" ("axis_x", "axis_y", "axis_z") [1] in the fixed frame, as in `Trajectory`; or a tuple of some of these words.
      Azimuth and eta may be given up to whole turns.
    - `t0`: the clock's reading [s] at the launch. Until then the top is where it is launched.
    - `student`: degrees of freedom of Student's t distribution of the errors, against outliers, such as 4; `None`: Gaussian.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** two frames of a film, in the second of which the azimuth could not be read off.

    >>> import numpy as np, tippe
    >>> value = [[0.11, 0.3], [0.14, np.nan]]
    >>> film = tippe.Recording(tippe.Launch(0.1, 150.0), [0.0, 0.04], value, [0.01, 0.1], ("theta", "azimuth"))
    >>> film.labels
    ('theta(0 s)', 'azimuth(0 s)', 'theta(0.04 s)')
    """

    launch: Launch
    quantity: str | tuple[str, ...] = eqx.field(static=True, default="theta", converter=as_quantity)
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    quantities: ClassVar[Quantities] = QUANTITIES

    def __check_init__(self):
        # Of the right shapes, if this comes to its end.
        super().__check_init__()
        if "theta" not in self.columns:
            return
        value, error = np.asarray(self.value), 0.0 if self.error is None else 5.0 * np.asarray(self.error)
        reach = np.maximum(NOISE, np.broadcast_to(error, value.shape)).reshape(len(self.times), -1)
        place = self.columns.index("theta")
        theta, reach = value.reshape(reach.shape)[:, place], reach[:, place]
        seen = ~np.isnan(theta)
        theta, reach = theta[seen], reach[seen]
        require(theta, "theta", at_least=-reach, at_most=math.pi + reach, why="with room for its errors", unit="rad")


def predict_recordings(
    scene: Scene, recordings: list[tuple[Recording, Values]], rows: int, tolerance: Float[Array, ""]
) -> list[Float[Array, "rows samples"]]:
    """What is recorded of several runs, in every row, as for `nonholonomic.identification.predicted`."""

    def run(lane: Values, times: Float[Array, " times"]) -> Any:
        roots = with_numbers({"scene": scene, "launch": recordings[0][0].launch}, lane)
        return simulate(roots["scene"], roots["launch"], times[-1], times, tolerance)

    return predicted(recordings, rows, run, column_of)


def column_of(run: Any, name: str) -> Float[Array, " times"]:
    """A column of a trajectory."""
    for quantity, columns in QUANTITIES.columns.items():
        if name in columns:
            return getattr(run, quantity)[:, columns.index(name)]
    return getattr(run, name)


def _launches(launch: Launch, count: int, rows: int) -> Values:
    """The numbers of all launches in every row, those that are one for each of them."""
    found = {name: value for name, value in numbers("launch", launch).items() if value is not None and np.ndim(value)}
    return {name: jnp.tile(value, rows) for name, value in found.items()}


def _one_of(launch: Launch) -> Launch:
    """The first of several launches."""
    return jax.tree.map(lambda leaf: leaf if jnp.ndim(leaf) == 0 else leaf[0], launch)
