"""Recorded rides of strollers, from arrays and from files."""

from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.identification import AbstractRecording, Quantities, as_quantity, read_columns
from nonholonomic.runs import AbstractModel
from nonholonomic.validation import as_number, as_number_or_none, require_kind

from ..model.input import Input
from ..model.launch import USUAL, Launch
from ..model.scene import Scene
from ..runs.model import RideModel

#: The quantities of a ride that can be recorded, with the names of a `Trajectory`'s properties.
QUANTITIES = Quantities(
    columns={"position": ("x", "y", "z")},
    units=dict.fromkeys(("x", "y", "z"), "m")
    | {"heading": "rad", "steering": "rad", "speed": "m/s", "yaw_rate": "rad/s", "steering_rate": "rad/s"},
    angles=frozenset({"heading"}),
    usual=USUAL,
)


class Recording(AbstractRecording):
    """A recorded ride: quantities sampled at the times of a clock.

    **Arguments:**

    - `launch`: a `Launch`; all its numbers must be scalars.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for a single column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: "position" ("x", "y", "z") [m] of the rear axle in the fixed frame, "heading", "steering" [rad],
      "speed" [m/s], "yaw_rate" or "steering_rate" [rad/s], all as in `Trajectory`; or a tuple of some of these words. A
      heading may differ by whole turns.
    - `input`, `jumps`: the input of the ride and the times at which it jumps, as for `simulate`.
    - `t0`: the clock's reading [s] at the launch. Before this time, the stroller is at its launch position.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for data with outliers;
      `None` for Gaussian errors.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** two positions in the plane, seen from above.

    >>> import stroller
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.0)
    >>> track = stroller.Recording(launch, [0.5, 1.0], [[0.5, 0.0], [1.0, 0.02]], 0.01, ("x", "y"))
    >>> track.labels
    ('x(0.5 s)', 'y(0.5 s)', 'x(1 s)', 'y(1 s)')
    """

    launch: Launch
    quantity: str | tuple[str, ...] = eqx.field(static=True, default="position", converter=as_quantity)
    input: Input | None = None
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    jumps: Any = None
    quantities: ClassVar[Quantities] = QUANTITIES

    def model(self, scene: Scene) -> AbstractModel:
        """The model of the recorded ride, checked."""
        require_kind(scene, "data: the scene of a stroller.Recording", Scene)
        scene.check(self.launch)
        return RideModel.of(scene, self.launch, self.input, None, self.jumps)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, several="identify takes a list of recordings")


def read_recording(
    path: Any,
    columns: Any = None,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Any = None,
    input: Input | None = None,
    t0: float = 0.0,
    student: float | None = None,
    decimal: str = ".",
    jumps: Any = None,
) -> Recording:
    """A recording of a ride from a text file of columns with a header line (CSV).

    **Arguments:**

    - `path`: path of the file. Columns are separated by commas, semicolons, tabs or blanks; empty cells, `nan`, `n/a` and
      `-` are missing samples; lines that begin with # are ignored.
    - `columns`: quantity -> (header of its column, unit): `"time"`, or `"frame"`, and any of `"x"`, `"y"`, `"z"`,
      `"heading"`, `"steering"`, `"speed"`, `"yaw_rate"`, `"steering_rate"`. Units are s, ms, min; rad, deg, rev; rad/s,
      deg/s, rpm, rev/s; m, cm, mm; m/s, cm/s, mm/s, km/h; or a factor that converts the file's numbers to SI units,
      such as metres per pixel. If the header has the unit, as "speed [km/h]", the header is enough. By default, the
      columns whose headers are quantities with units, such as "time [s]" and "speed [km/h]".
    - `fps`: frames per second, if there is no `"time"`. If there is no `"frame"` either, every line is a frame.
    - `launch`: a `Launch`, with guesses for unknown numbers; `input`, `jumps`, `t0`, `student`: as for `Recording`.
    - `error`: quantity -> (standard error or the header of its column, unit); with `None`, errors are estimated from
      the residuals.
    - `decimal`: "," if the file has decimal commas.

    **Returns:** a `Recording`.

    **Raises:** `ValueError` that names the column and the problem.

    **Example:** a speedometer, read every second.

    >>> import pathlib, tempfile, stroller
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "ride.csv"
    >>> _ = path.write_text("speed\\n5.4\\n5.0\\n4.7\\n")
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.5)
    >>> ride = stroller.read_recording(path, {"speed": ("speed", "km/h")}, fps=1, launch=launch)
    >>> print(ride.times, ride.value.round(2))
    [0. 1. 2.] [1.5  1.39 1.31]
    """
    table = read_columns(path, columns, fps, error, QUANTITIES, decimal)
    return Recording(launch, *table, input=input, t0=t0, student=student, jumps=jumps)
