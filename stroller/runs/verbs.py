"""The functions of the stroller, on those of `nonholonomic.runs`."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import diffrax
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.integration.checks import require_run
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.parameters import full_axes
from nonholonomic.progress import status_line
from nonholonomic.runs import Options, TableForm, explore_model, table_of
from nonholonomic.sweeps import Table
from nonholonomic.validation import require_outside, shown
from nonholonomic.views import Page

from ..model.input import Input, check_input
from ..model.launch import Launch
from ..model.scene import Scene
from .explore import TOLERANCE
from .model import TAKEN, RideModel
from .simulate import ride
from .trajectory import Trajectory

#: The names in a table of rides. A ride continues if contact is lost, as if the ground could pull.
FORM = TableForm(
    words=("completed", "contact_lost", "rank_lost", "failed"),
    named={"event": "contact_lost"},
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
    times: Float[ArrayLike, " times"] | None = None,
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
    return ride(RideModel.of(scene, launch, input, None, jumps), t1, times, tolerance, solver, max_steps, adjoint)


def sweep(
    scene: Scene,
    launch: Launch,
    t1: float,
    *,
    axes: dict[str, Any],
    input: Input | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: Any = None,
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


@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: Any = None,
    sliders: dict[str, tuple[float, float]] | None = None,
    t1: float = 8.0,
    input: Input | None = None,
    unit: str | Sequence[str] | None = None,
    jumps: Sequence[Any] | Array | None = None,
) -> Page:
    """Make a page with sliders that simulates the ride in the browser while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the
    Runge-Kutta pair and the step-size control are generated from those of `simulate` and of tables, at a tolerance of
    1e-7. The page also computes a map, over two of the sliders, of the distance between the ends of the ride; click on
    the map to set both sliders. The address of the page contains the slider values, so that you can copy a link to a
    ride. Press space to play or pause, and r to reset the sliders.

    **Arguments:**

    - `scene`, `launch`, `input`: the ride at the start, as for `simulate`.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value. The end of a name is enough if only one parameter
      matches, such as "launch.speed", "launch.steering" or "inertia". By default speed, steering angle, heading and
      friction.
    - `t1`: horizon [s].
    - `unit`: unit of the curves, such as "deg" for all angles.
    - `jumps`: times [s] at which the input jumps, as for `simulate`.

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with two sliders.

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> page = stroller.explore(scene, launch, sliders={"speed": (0.5, 3.0), "launch.steering": (-0.5, 0.5)}, t1=2.0)
    >>> len(page.html) < 2.5e6
    True

    ```
    """
    check_run(scene, launch, t1, input, TOLERANCE, jumps)
    return explore_model(RideModel.of(scene, launch, input, None, jumps), path, sliders, float(t1), unit)


def check_run(scene: Any, launch: Any, t1: Any, input: Any, tolerance: Any, jumps: Any = None) -> None:
    """Raise `ValueError` unless scene, launch, horizon, input and tolerance are legal and the scene can start with the
    launch."""
    lists = "axes of sweep take lists, and jax.vmap maps over them"
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check(launch)
    check_input(input, scene, launch, jumps)
