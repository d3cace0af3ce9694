"""The functions of the stroller: rides, tables, crossings, fits, plots and pages."""

from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import diffrax
import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.identification import (
    AbstractRecording,
    Free,
    Identification,
    LogDensity,
    Quantities,
    as_quantity,
    read_columns,
)
from nonholonomic.integration.problem import DEFAULT_MAX_STEPS, Status
from nonholonomic.parameters import full_axes
from nonholonomic.runs.identify import Data, Prior, fit_runs, posterior_of_runs
from nonholonomic.runs.model import AbstractModel
from nonholonomic.runs.sweep import Options, table_of
from nonholonomic.runs.table import TableForm
from nonholonomic.sweeps import Table
from nonholonomic.terminal import status_line
from nonholonomic.text import shown
from nonholonomic.validation import require_kind, require_outside

from ..model.input import Input
from ..model.scene import Scene
from ..model.vehicle import USUAL, Launch
from .model import TAKEN, RideModel, check_run
from .trajectory import Trajectory, ride

# The functions of the stroller, on those of `nonholonomic.runs`.

#: The names in a table of rides. A ride continues if contact is lost, as if the ground could pull.
FORM = TableForm(
    named={Status.EVENT: Status.CONTACT_LOST},
    event="loss of contact",
    nan_if_failed=False,
    time="contact_time",
    run="ride",
    order=TAKEN,
)


@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: Float[ArrayLike, ""],
    input: Input | None = None,
    times: Float[ArrayLike, " times"] | Sequence[float] | None = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 65536,
    adjoint: diffrax.AbstractAdjoint | None = None,
    jumps: Sequence[Any] | Array | None = None,
) -> Trajectory:
    """Simulate a ride from a launch until `t1`.

    **Arguments:**

    - `scene`: a `Scene`.
    - `launch`: a `Launch`.
    - `t1`: end of the run [s], positive.
    - `input`: a function `(t, motion) -> (drive force [N], steering torque [N m])` (see `input.py`), or `None`.
    - `times`: times [s] to report, increasing, within [0, t1]; by default 201 equally spaced ones.
    - `tolerance`: relative tolerance of an adaptive solver, in [1e-14, 1e-2]; the absolute tolerance is a tenth of it,
      in units of the scene's magnitudes.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations, or an `ImplicitMidpoint`; by default
      `diffrax.Dopri8()`; inside transformations without `adjoint`, if all numbers of scene and launch are scalars,
      `nonholonomic.integration.Oscillatory8()`.
    - `max_steps`: a run that needs more steps fails; at least 1.
    - `adjoint`: an adjoint method of Diffrax, such as `RecursiveCheckpointAdjoint()`, with which Diffrax
      differentiates. By default, this package computes forward and reverse derivatives; the gradient of a loss function
      costs about five runs, whatever the number of parameters, which may be arrays, such as the weights of an input.
    - `jumps`: times [s] at which the input jumps or has a kink, so that steps end there. The times of comparisons of the time
      with numbers, such as `t > 1.0`, and the knots of `jnp.interp` are found without being named here.

    **Returns:** a `Trajectory`; its `status` states how the run ended.

    **Raises:** `ValueError` for arguments out of range, lists in place of numbers, an illegal launch, times that do not
    increase, a solver without an error estimate, and an input that is not a function, cannot be traced, or is not
    finite at the start.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, stroller.Steady(1.0, 0.1), times=[0.5, 1.0], tolerance=1e-6)
    >>> print(f"{run.speed[-1]:.3f} m/s, {run.heading[-1]:.3f} rad, {run.status}")
    1.472 m/s, 0.980 rad, completed

    ```
    """
    check_run(scene, launch, t1, input, tolerance, jumps)
    return ride(RideModel.of(scene, launch, input, None, jumps), t1, times, tolerance, solver, adjoint, max_steps)


def sweep(
    scene: Scene,
    launch: Launch,
    t1: float,
    *,
    axes: dict[str, Any],
    input: Input | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
    jumps: Sequence[Any] | Array | None = None,
) -> Table:
    """The ends of all rides over a grid of parameters, in one batched call on all cores.

    **Arguments:**

    - `scene`, `launch`, `input`: as for `simulate`; all numbers must be scalars.
    - `t1`: end of every ride [s].
    - `axes`: name of a parameter -> values, such as `{"launch.speed": [1.0, 2.0], "polar": [0.8, 0.9]}`; the end of a
      full name is enough if it is unique. The parts of the place are `"launch.place[0]"` and `"launch.place[1]"`; the
      names of parameters of an input that is a module begin with `"input."`. The first axis varies slowest. With `{}`,
      the table has a single ride.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `progress`: whether to show progress, on a terminal or in a notebook.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes` or of a Dask client;
      by default, a thread for each core. On the same kind of processor, all executors give bitwise equal results.
    - `max_steps`: a ride that needs more steps, including rejected ones, fails; at least 1.
    - `jumps`: times [s] at which the input jumps, as for `simulate`.

    **Returns:** a `Table` of the rides' ends: position `x`, `y`, `z` [m] in the fixed frame, `heading`, `end_steering`
    [rad], `end_speed` [m/s], `energy` [J], `residual` [J] of energy against work, `contact_time` [s] at which the
    ground first had to pull (infinite if never; the ride continues), `end_time` [s], `status` ("completed",
    "contact_lost", "rank_lost" if a projected heading ended the ride, "failed"), `steps` and `rejected`.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> axes = {"launch.speed": [1.0, 2.0], "scene.body.wheelbase": [0.6, 0.7]}
    >>> table = stroller.sweep(scene, launch, 1.0, axes=axes, tolerance=1e-6)
    >>> print(table.end_speed.round(3))
    [[0.779 0.779]
     [1.558 1.558]]

    ```
    """
    require_outside((scene, launch, t1, axes, input, jumps), "sweep", "simulate")
    check_run(scene, launch, t1, input, tolerance, jumps)
    if not isinstance(axes, dict) or not all(isinstance(number, str) for number in axes):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, full name of a parameter -> values")
    model = RideModel.of(scene, launch, input, None, jumps)
    options = Options(tolerance, solver, max_steps, path=path, progress=progress, executor=executor)
    return table_of(model, full_axes(axes, model.known), float(t1), "first", options, FORM)


# Estimate parameters of a stroller, its ground and its launch from recorded rides, and their posterior.

#: The words for data that can be fitted.
EXPECTED = "a Recording or a nonholonomic.EventTimes"


def identify(
    scene: Scene,
    data: Data | Sequence[Data],
    free: Mapping[str, Free | float],
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> Identification:
    """Estimate parameters of a scene and its launch from measurements, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: a `Recording`, or a list of several, which are fitted together; `nonholonomic.Recording` and `EventTimes`, too.
    - `free`: full name of a parameter -> a `Free` or only the start value: `"scene.friction.rolling"`, or `"rolling"`
      if no other name ends so; `"launch.place[0]"` and `"launch.place[1]"` are parts of the place. A parameter of the
      launch, and `"t0"`, the reading of a recording's clock at the launch, are the same in all recordings;
      `"data[1].launch.heading"` belongs to the second recording, and `"data[*].t0"` is a separate parameter for each.
      Parameters that cannot be negative are fitted by their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.result`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> fit = stroller.identify(scene, data, {"rolling": 1.5}, progress=False)
    >>> print(f"{fit.estimates['scene.friction.rolling']:.2f} N s/m, {fit.status}")
    2.00 N s/m, converged

    ```
    """
    search = {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}
    require_kind(scene, "scene", Scene)
    return fit_runs(scene, data, free, EXPECTED, tolerance, search)


def log_density(
    scene: Scene,
    data: Data | Sequence[Data],
    free: Mapping[str, Free | float],
    priors: Mapping[str, Prior] | None = None,
    *,
    tolerance: float = 1e-8,
) -> LogDensity:
    """The log of the posterior density of the parameters of a scene and its launch, as a function of unbounded coordinates.

    **Arguments:** `scene`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:** rolling friction from two speeds, with a prior of 10 %.

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> density = stroller.log_density(scene, data, {"rolling": 2.0}, priors={"rolling": (2.0, 0.2)})
    >>> density.names, density.start.shape
    (('scene.friction.rolling',), (1,))

    ```
    """
    require_kind(scene, "scene", Scene)
    return posterior_of_runs(scene, data, free, priors, EXPECTED, tolerance)


# Recorded rides of strollers, from arrays and from files.

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
    - `t0`: the clock's reading [s] at the launch. Before this time, the stroller is at its launch position.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for data with outliers;
      `None` for Gaussian errors.
    - `side`: as for `nonholonomic.Recording`; a ride has no resets.
    - `input`, `jumps`: the input of the ride and the times at which it jumps, as for `simulate`.

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
    jumps: Sequence[float] | Array | None = None
    quantities: ClassVar[Quantities] = QUANTITIES

    def model(self, scene: object) -> AbstractModel:
        """The model of the recorded ride, checked."""
        require_kind(scene, "data: the scene of a stroller.Recording", Scene)
        assert isinstance(scene, Scene)
        scene.check(self.launch)
        return RideModel.of(scene, self.launch, self.input, None, self.jumps)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, several="identify takes a list of recordings")


def read_recording(
    path: str | PathLike[str],
    columns: Mapping[str, object] | None = None,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Mapping[str, object] | None = None,
    input: Input | None = None,
    t0: float = 0.0,
    student: float | None = None,
    decimal: str = ".",
    jumps: Sequence[float] | Array | None = None,
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
