"""Estimate parameters of a top from measurements: recordings, inversion times, fits and posteriors."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from os import PathLike
from typing import ClassVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from nonholonomic import identification
from nonholonomic.derivatives import differentiable_solve
from nonholonomic.integration import Settings
from nonholonomic.parameters import numbers
from nonholonomic.runs.identify import AbstractEventTimes, Cells, Data, FreeNumbers, Priors, fit_runs, posterior_of_runs
from nonholonomic.runs.model import AbstractModel
from nonholonomic.text import distinguishing_labels, unit_of
from nonholonomic.validation import as_number, is_traced, require_kind, require_scalars, warn

from .model.scene import Launch, Scene, as_launch
from .modes.problems import angle_of, event_of
from .runs.model import TopModel, of_launches
from .runs.verbs import ExtendedTime, beyond_horizon, check_event, check_reversible, check_smooth

#: The words for data that can be fitted.
EXPECTED = "an InversionTimes, a ReversalTimes or a Recording"


@of_launches
def identify(
    scene: Scene,
    data: Data,
    free: FreeNumbers,
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    slopes: str | None = None,
    progress: bool = True,
) -> identification.Identification:
    """Estimate parameters of a scene and its launches from measurements, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: an `InversionTimes`, a `ReversalTimes` or a `Recording`, or a list of several, which are fitted together;
      `nonholonomic.EventTimes` and `nonholonomic.Recording`, too.
    - `free`: full name of a parameter -> a `Free` or only the start value: `"scene.friction.mu"`, or `"friction.mu"` if
      no other name ends so. A parameter of the launch, and `"t0"`, the reading of a recording's clock at the launch,
      are the same in all data; `"data[1].launch.azimuth"` belongs to the second set of data, and `"data[*].t0"` is a
      separate parameter for each recording. Parameters that cannot be negative are fitted by their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.result`.
    - `slopes`: "exact", the derivatives of the equations; or "differences", central differences in every parameter. Slopes
      only guide the search; errors and intervals do not depend on them. By default, slopes are exact if a run is one
      smooth motion, and differences through flights, impacts, stick and slip.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range, for an unknown name, and for exact slopes through several
    modes. (Such slopes exist, but because the time jumps with every flight, they may have the opposite sign of the
    trend.)

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> launch = tippe.Launch(theta=[0.2, 0.2, 0.3, 0.2], spin=[155.0, 140.0, 110.0, 60.0])
    >>> data = tippe.InversionTimes(launch, time=[5.60, 5.53, 5.52, float("inf")], error=0.05, t1=8.0)
    >>> fit = tippe.identify(scene, data, {"friction.mu": 0.25}, tolerance=1e-6, progress=False)
    >>> print(f"{fit.estimates['scene.friction.mu']:.3f} s/m, {fit.status}")
    0.300 s/m, converged

    ```
    """
    search = {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}
    require_kind(scene, "scene", Scene)
    if slopes == "exact":
        check_smooth(scene, "identify with slopes = 'exact'")
    return fit_runs(scene, data, free, EXPECTED, tolerance, search, slopes)


@of_launches
def log_density(
    scene: Scene, data: Data, free: FreeNumbers, priors: Priors = None, *, tolerance: float = 1e-8
) -> identification.LogDensity:
    """The log of the posterior density of a scene's parameters, as a function of unbounded coordinates.

    The coordinate of a parameter that cannot be negative is its logarithm (see `Free`). A parameter without a prior has
    a flat prior in its coordinate; between two bounds, the prior is uniform in the parameter itself.

    **Arguments:**

    - `scene`, `data`, `free`, `tolerance`: as for `identify`. If the error of a recording is `None`, the error is also
      an unknown.
    - `priors`: name of a free parameter -> (mean, standard deviation) of a Gaussian prior; only the standard deviation, if
      the mean is the start value; or a function, written in JAX, that returns the log density of the parameter. They
      take precedence over those of `Free`.

    **Returns:** a `LogDensity`: a function of coordinates (unknowns,) for any sampler, with `value_and_gradient` for
    samplers without JAX, `values` to convert back to parameters, `names` and `start`. With flights or set-valued friction, it
    has values only: use it with `sample`.

    **Raises:** `ValueError` for arguments out of range and an unknown name.

    **Example:** friction from one time, with a prior of 10 %.

    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=3.0e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> data = tippe.InversionTimes(tippe.Launch(0.2, [110.0]), [5.6], error=0.1, t1=20.0)
    >>> density = tippe.log_density(scene, data, {"mu": 0.3}, priors={"mu": (0.3, 0.03)})
    >>> density.names, density.start.shape
    (('scene.friction.mu',), (1,))
    """
    require_kind(scene, "scene", Scene)
    return posterior_of_runs(scene, data, free, priors, EXPECTED, tolerance)


# Measured times of launches: of inversion, and of reversal. Inversion times can be read from a file.

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
    until: Float[Array, "..."] | None = eqx.field(converter=as_number, default=None)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, " or a list of launches")
        # What is no number is refused later.
        is_known = isinstance(self.time, jax.Array) and not is_traced(self.time)
        seconds = np.asarray(self.time) if is_known else np.zeros(0)
        if np.any(np.isfinite(seconds)) and (middle := np.median(seconds[np.isfinite(seconds)])) > LONG:
            warn(f"time = {middle:g} s is long for a top; times are in seconds: did you mean 1e-3 * time?")

    @property
    def of_each_time(self) -> dict[str, Float[Array, "..."] | None]:
        return numbers("launch", self.launch) | super().of_each_time

    @property
    def labels(self) -> tuple[str, ...]:
        """What differs between the launches."""
        return self.labels_in(unit_of(self.launch))

    def labels_in(self, unit: str | Sequence[str] | None) -> tuple[str, ...]:
        # In NumPy: JAX would take a millisecond for each launch.
        launch = jax.tree.map(np.asarray, self.launch)
        count = len(self.time)
        launches = [
            jax.tree.map(lambda leaf, k=k: leaf if np.ndim(leaf) == 0 else leaf[k], launch) for k in range(count)
        ]
        return tuple(distinguishing_labels([("launch",)] * count, launches, unit=unit, longest=math.inf))


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

    angle: Float[Array, ""] | None = eqx.field(converter=as_number, default=None)
    student: Float[Array, ""] | None = eqx.field(converter=as_number, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s", "angle": "rad"}

    def __check_init__(self):
        check_event(self.angle, "first")

    @property
    def horizon(self) -> Float[Array, ""]:
        # Predictions continue smoothly beyond it.
        return self.t1

    def model(self, system: object) -> TopModel:
        scene = require_kind(system, "scene", Scene)
        return TopModel.timed(scene, self.launch, event_of(scene, self.angle))

    def predicted(self, model: TopModel, t1: Float[Array, ""], settings: Settings) -> Float[Array, ""]:
        return differentiable_solve(*ExtendedTime.of(model, t1, settings, False))

    def of_ends(self, model: TopModel, t1: Cells, time: Cells, ends: dict[str, Float[Array, " cells"]]) -> Cells:
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

    student: Float[Array, ""] | None = eqx.field(converter=as_number, default=None)
    units: ClassVar[dict[str, str]] = {"time": "s", "error": "s", "t1": "s", "until": "s"}

    def model(self, system: object) -> TopModel:
        scene = require_kind(system, "scene", Scene)
        check_reversible(scene, self.launch)
        return TopModel.timed(scene, self.launch, None)


@of_launches
def read_inversion_times(
    path: str | PathLike[str],
    columns: Mapping[str, object] | None = None,
    *,
    error: float | Mapping[str, object],
    t1: float,
    launch: Launch | None = None,
    until: float | None = None,
    angle: float | None = None,
    student: float | None = None,
    decimal: str = ".",
    never: str | Sequence[str] = (),
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
    table = identification.read_launches(path, columns, error, UNITS, decimal, never)
    for name, (least, greatest) in LIMITS.items():
        for line, value in zip(table.lines, table.numbers[name], strict=True) if name in table.numbers else ():
            if not least <= value <= greatest:
                raise ValueError(
                    f"{name} = {value:.6g} rad in line {line} of {str(path)!r} must be between {least:.4g} and pi rad: is the "
                    f"column in degrees? Pass columns={{{name!r}: (header, 'deg')}}"
                )
    is_stated = np.isfinite(table.until)
    limits = np.where(is_stated, table.until, t1 if until is None else until) if np.any(is_stated) else until
    if launch is not None:
        require_kind(launch, "launch", Launch)
        require_scalars({name: getattr(launch, name) for name in UNITS}, "the file has the numbers that differ")
    for name in ("theta", "spin") if launch is None else ():
        if name not in table.numbers:
            raise ValueError(
                f"columns must have {name!r}, or launch must be a Launch with the {name} of all launches, such as "
                "launch=tippe.Launch(theta=0.1, spin=150.0)"
            )
    launches = Launch(**table.numbers) if launch is None else dataclasses.replace(launch, **table.numbers)
    launches = launches.stated_in((*table.unit, *unit_of(launch)))
    return InversionTimes(launches, table.time, table.error, t1, until=limits, angle=angle, student=student)


# Recorded runs of tops, from arrays and from files.

#: The quantities of a top that can be recorded, with the names of a `Trajectory`'s properties.
QUANTITIES = identification.Quantities(
    columns={"position": ("x", "y", "z"), "axis": ("axis_x", "axis_y", "axis_z")},
    units={"theta": "rad", "azimuth": "rad", "eta": "rad", "spin": "rad/s"}
    | dict.fromkeys(("x", "y", "z"), "m")
    | dict.fromkeys(("axis_x", "axis_y", "axis_z"), "1"),
    angles=frozenset({"azimuth", "eta"}),
    usual={"azimuth": 4.0 * math.pi, "eta": 4.0 * math.pi},
    launches="tippe.InversionTimes, or tippe.read_inversion_times for a file",
)

#: Distance [rad] by which a recorded theta may be outside [0, pi] if its errors are smaller or unknown.
NOISE = 0.3


class Recording(identification.AbstractRecording):
    """A recorded run: quantities sampled at the times of a clock.

    **Arguments:**

    - `launch`: a `Launch`; all its numbers must be scalars.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for a single column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: "theta", "azimuth", "eta" [rad], "spin" [rad/s], "position" ("x", "y", "z") [m] of the sphere's centre
      or "axis" ("axis_x", "axis_y", "axis_z") [1] in the fixed frame, as in `Trajectory`; or a tuple of some of these
      words. Azimuth and eta may differ by whole turns.
    - `t0`: the clock's reading [s] at the launch. Before this time, the top is at its launch position.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for data with outliers;
      `None` for Gaussian errors.
    - `side`: "before" or "after": the state that a sample at the time of an impact is.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** two frames of a video; in the second, the azimuth was unreadable.

    >>> import numpy as np, tippe
    >>> value = [[0.11, 0.3], [0.14, np.nan]]
    >>> film = tippe.Recording(tippe.Launch(0.1, 150.0), [0.0, 0.04], value, [0.01, 0.1], ("theta", "azimuth"))
    >>> film.labels
    ('theta(0 s)', 'azimuth(0 s)', 'theta(0.04 s)')
    """

    launch: Launch
    quantity: str | tuple[str, ...] = eqx.field(static=True, default="theta", converter=identification.as_quantity)
    quantities: ClassVar[identification.Quantities] = QUANTITIES

    def model(self, scene: object) -> AbstractModel:
        """The model of the recorded run."""
        known = require_kind(scene, "data: the scene of a tippe.Recording", Scene)
        return TopModel(scene=known, launch=self.launch)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, several="identify takes a list of recordings")
        # If no check fails, the shapes are right.
        super().__check_init__()
        if "theta" not in self.columns:
            return
        value, error = np.asarray(self.value), 0.0 if self.error is None else 5.0 * np.asarray(self.error)
        reach = np.maximum(NOISE, np.broadcast_to(error, value.shape)).reshape(len(self.times), -1)
        place = self.columns.index("theta")
        theta, reach = value.reshape(reach.shape)[:, place], reach[:, place]
        seen = ~np.isnan(theta)
        is_outside = seen & ((theta < -reach) | (theta > math.pi + reach))
        for row in np.flatnonzero(is_outside)[:1]:
            number, degrees = f"{theta[row]:g}", math.degrees(theta[row])
            hint = (
                f"pi rad: was it recorded in degrees? Pass np.radians({number}), or the unit 'deg' when you read a file"
            )
            # Radians of round degrees were in degrees before.
            if abs(degrees - round(degrees, 3)) < 1e-9:
                number, hint = f"{degrees:g} deg", "180 deg"
            place = f"{number} at {float(self.times[row]):.6g} s (sample {row + 1})"
            raise ValueError(f"theta = {place} must be, with room for its errors, between 0 and {hint}")


@of_launches
def read_recording(
    path: str | PathLike[str],
    columns: Mapping[str, object] | None = None,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Mapping[str, object] | None = None,
    t0: float = 0.0,
    student: float | None = None,
    decimal: str = ".",
) -> Recording:
    """A recording of a top from a text file of columns with a header line (CSV).

    **Arguments:**

    - `path`: path of the file. Columns are separated by commas, semicolons, tabs or blanks; empty cells, `nan`, `n/a` and
      `-` are missing samples; lines that begin with # are ignored.
    - `columns`: quantity -> (header of its column, unit): `"time"`, or `"frame"`, and any of `"theta"`, `"azimuth"`,
      `"eta"`, `"spin"`, `"x"`, `"y"`, `"z"`, `"axis_x"`, `"axis_y"`, `"axis_z"`. Units are s, ms, min; rad, deg, rev;
      rad/s, deg/s, rpm, rev/s; m, cm, mm; 1, %; or a factor that converts the file's numbers to SI units, such as
      metres per pixel. If the header has the unit, as "tilt [deg]", the header is enough. By default, the columns whose
      headers are quantities with units, such as "time [s]" and "theta [deg]".
    - `fps`: frames per second, if there is no `"time"`. If there is no `"frame"` either, every line is a frame.
    - `launch`: a `Launch`, with guesses for unknown numbers.
    - `error`: quantity -> (standard error or the header of its column, unit); with `None`, errors are estimated from
      the residuals.
    - `t0`, `student`: as for `Recording`.
    - `decimal`: "," if the file has decimal commas.

    **Returns:** a `Recording`.

    **Raises:** `ValueError` that names the column and the problem.

    **Example:** three frames of a video at 50 frames per second, the second of which is unreadable.

    >>> import pathlib, tempfile, tippe
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "film.csv"
    >>> _ = path.write_text("frame,tilt\\n0,5.7\\n1,\\n2,6.3\\n")
    >>> launch = tippe.Launch(theta=0.1, spin=150.0)
    >>> columns = {"frame": ("frame", "1"), "theta": ("tilt", "deg")}
    >>> film = tippe.read_recording(path, columns, fps=50, launch=launch, error={"theta": (1.0, "deg")})
    >>> print(film.times, film.value.round(4))
    [0.   0.04] [0.0995 0.11  ]
    """
    table = identification.read_columns(path, columns, fps, error, QUANTITIES, decimal)
    return Recording(launch, *table[:-1], t0, student).stated_in(table.unit)
