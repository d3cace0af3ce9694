"""Recorded runs of tops, from arrays and from files."""

import math
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.identification import AbstractRecording, Quantities, as_quantity, read_columns
from nonholonomic.runs import AbstractModel
from nonholonomic.validation import as_number, as_number_or_none, require_kind

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.model import TopModel

#: The quantities of a top that can be recorded, with the names of a `Trajectory`'s properties.
QUANTITIES = Quantities(
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


class Recording(AbstractRecording):
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
    quantity: str | tuple[str, ...] = eqx.field(static=True, default="theta", converter=as_quantity)
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    side: str = eqx.field(static=True, default="before")
    quantities: ClassVar[Quantities] = QUANTITIES

    def model(self, scene: Scene) -> AbstractModel:
        """The model of the recorded run."""
        require_kind(scene, "data: the scene of a tippe.Recording", Scene)
        return TopModel(scene=scene, launch=self.launch)

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
            raise ValueError(
                f"theta = {theta[row]:g} at {float(self.times[row]):.6g} s (sample {row + 1}) must be between 0 and pi rad, "
                f"with room for its errors: was it recorded in degrees? Pass np.radians({theta[row]:g}), or the unit 'deg' "
                "when you read a file"
            )


def read_recording(
    path: Any,
    columns: Any = None,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Any = None,
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
    table = read_columns(path, columns, fps, error, QUANTITIES, decimal)
    return Recording(launch, *table, t0, student)
