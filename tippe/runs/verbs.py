"""`simulate` and `explore` of tops, on the functions of `nonholonomic.runs`."""

from typing import Any

import diffrax
from jaxtyping import Array, Float

from nonholonomic.progress import status_line
from nonholonomic.runs import explore_model
from nonholonomic.views import Page

from ..model.launch import Launch
from ..model.scene import Scene
from .checks import check_run
from .explore import TOLERANCE
from .flight_trajectory import HybridTrajectory
from .model import TopModel
from .trajectory import Trajectory


@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    times: Any = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory | HybridTrajectory:
    """Simulate one launch until `t1`, or until contact is lost or jams; with `contact="hybrid"`, through flights and
    impacts.

    Inside a transformation (`jit`, `vmap`, `grad`) `times` must be given; entries after the end of the run (see
    `status` and `end_time`) are then NaN. A batch from `vmap` is solved as one ensemble, like the cells of a table. If
    a program under `jit` does not use path, rotation or work, they are not integrated.

    **Arguments:**

    - `scene`, `launch`: all their numbers must be scalars.
    - `t1`: horizon [s].
    - `times`: times of the result [s], increasing, within [0, t1]; by default those of the accepted steps. Outside
      transformations, times after the end of the run are omitted; `Trajectory.at` returns the run at other times.
    - `tolerance`: relative tolerance, in [1e-14, 1e-2]; absolute tolerances are `tolerance`/10 in units of `Scene.scales`.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations; by default `Dopri8()`; inside
      transformations without an `adjoint`, `nonholonomic.integration.Oscillatory8()`.
    - `adjoint`: an adjoint method of Diffrax, such as `RecursiveCheckpointAdjoint()`, with which Diffrax integrates a
      traced run. This is cheaper for a loss function with many parameters, but can miss a loss of contact shorter than
      a step. By default, this package computes forward and reverse derivatives, at the cost of about one run for each
      parameter.

    **Returns:** a `Trajectory`, or a `HybridTrajectory` for a hybrid scene.

    **Raises:** `ValueError` for arguments out of range, and for times that are all after the end of the run. For a
    hybrid scene or `SetValuedCoulomb` inside a transformation, also for an `adjoint`, for a solver that is not an explicit
    Runge-Kutta method, for derivatives with respect to `times`, and for second derivatives.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=1.0, tolerance=1e-6)
    >>> print(f"{run.theta[-1]:.3f} rad, {run.spin[-1]:.1f} rad/s, {run.status}")
    0.025 rad, 154.0 rad/s, completed

    ```
    """
    check_run(scene, launch, t1, tolerance, "jax.vmap(simulate) takes lists, and so does trajectory_table")
    return TopModel(scene=scene, launch=launch).simulate(t1, times, tolerance, solver, adjoint)


@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: Any = None,
    sliders: dict[str, tuple[float, float]] | None = None,
    t1: float = 8.0,
) -> Page:
    """Make a page with sliders that simulates the top in the browser while you move a slider. The page is one file that
    needs no network; a notebook shows the returned `Page`. The equations of motion, the Runge-Kutta pair, the step-size
    control and the location of the event are generated from those of `inversion_table`, or, under `NoSlip`, of
    `reversal_table`, so times and statuses are the same, at a tolerance of 1e-7. The page also computes a map of these
    times over two of the sliders; click on the map to set both. The address of the page contains the slider values, so
    that you can copy a link to a run. Press space to play or pause, and r to reset the sliders.

    **Arguments:**

    - `scene`, `launch`: the run at the start; all numbers must be scalars.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value. The end of a name is enough if only one parameter
      matches, such as "theta", "spin", "mu", "friction.mu" or "offset". By default theta, spin, the coefficient of
      friction and, for a top without a stem, the offset; under `NoSlip` theta and spin in both senses.
    - `t1`: horizon [s].

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with two sliders.

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> page = tippe.explore(scene, tippe.Launch(0.1, 155.0), sliders={"theta": (0.05, 0.5), "spin": (60.0, 200.0)})
    >>> len(page.html) < 2.5e6
    True

    ```
    """
    check_run(scene, launch, t1, TOLERANCE)
    return explore_model(TopModel(scene=scene, launch=launch), path, sliders, float(t1))
