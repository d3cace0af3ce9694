"""The functions for single launches, on those of `nonholonomic.runs`."""

from collections.abc import Sequence
from typing import Any

import diffrax
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.integration import Settings, explicit_tableau
from nonholonomic.integration.checks import run_bounds
from nonholonomic.progress import status_line
from nonholonomic.runs import LyapunovExponent, TableJob, explore_model, exponent_of_model, time_of_event
from nonholonomic.validation import is_traced, require_all, require_kind, require_outside
from nonholonomic.views import Page
from nonholonomic.warning import warn

from ..model.launch import Launch
from ..model.scene import Scene
from .checks import check_event, check_reversible, check_run, event_of, require_rigid, warn_if_it_cannot_invert
from .explore import TOLERANCE
from .flight_trajectory import HybridTrajectory
from .model import INVERSIONS, REVERSALS, TopModel
from .run_kind import why_unresolved
from .table import too_many_steps
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
    unit: str | Sequence[str] | None = None,
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
    - `unit`: unit of the curves, such as "deg" for all angles.

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
    return explore_model(TopModel(scene=scene, launch=launch), path, sliders, float(t1), unit)


@status_line("simulating")
def inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[ArrayLike, ""] | None = None,
    tolerance: float = 1e-9,
    crossing: str = "first",
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time at which the top has turned over; works under `jit`, `vmap`, `grad`, `jvp` and their compositions.

    The derivative comes from the implicit function theorem at the event; it is 0 if the result is infinite. Together
    with derivatives, a time costs two to three times as much for one parameter, four times for two, and six to eight
    times for more (`nonholonomic/derivatives/slopes.py`). Second derivatives use forward mode.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`; all numbers must be scalars.
    - `t1`: horizon [s], positive.
    - `angle`: angle [rad] that theta reaches, in (0, pi]. By default, a top with a stem has turned over when the stem
      first carries it, and any other body when theta reaches 0.95 pi.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `crossing`: "first" for the first time theta reaches the angle, "last" for the crossing after which theta stays
      above the angle until `t1`; for the contact of a stem, the time after which the sphere does not touch until `t1`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if the top has not inverted by `t1`, or loses contact or jams before; NaN
    if the integration failed, if the run is unresolved, or if numbers inside a transformation are out of range.

    With `contact="hybrid"` and `SetValuedCoulomb`, first derivatives include flights, impacts, stick and slip
    (`nonholonomic/hybrid/saltation.py`). If an earlier event is grazing (within the tolerance, it may not happen), the
    derivative is NaN; the variable `grazes` of `inversion_table` reports this.

    **Raises:** `ValueError` for arguments outside these ranges, for a run that needs more than 2 000 000 steps, for
    second derivatives through changes of mode, and for derivatives of the last contact of a stem.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> time = tippe.inversion_time(scene, tippe.Launch(0.1, 155.0), t1=8.0, tolerance=1e-6)
    >>> print(f"{time:.2f} s")
    5.97 s

    ```
    """
    check_run(scene, launch, t1, tolerance)
    check_event(angle, crossing)
    warn_if_it_cannot_invert(scene, launch, launch.theta, angle)
    model = TopModel.timed(scene, launch, event_of(scene, angle))
    return first_or_last_time(model, t1, crossing, Settings(tolerance, solver))


@status_line("simulating")
def reversal_time(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time at which the spin about the arena's normal first vanishes; works under `jit`, `vmap`, `grad`, `jvp` and their
    compositions.

    Derivatives with respect to every number of the body, its inertia, the friction law and the launch use the implicit
    function theorem at the event; they are 0 if the result is infinite.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`, every number a scalar; the body is an `Ellipsoid` or a `RigidBody`, and the spin is
      not zero.
    - `t1`: horizon [s], positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if the spin has not reversed by `t1`, or the contact was lost before; NaN if the
    integration failed, or if numbers inside a transformation are out of range.

    **Raises:** `ValueError` for arguments outside these ranges, for another body, and for a run that needs more than 2 000 000
    steps.

    **Example:** the rattleback of `Ellipsoid`.

    ```
    >>> import tippe
    >>> inertia = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]
    >>> body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), inertia)
    >>> scene = tippe.Scene(body, friction=tippe.NoSlip())
    >>> print(f"{tippe.reversal_time(scene, tippe.Launch(0.02, spin=-5.0), t1=5.0, tolerance=1e-6):.2f} s")
    2.61 s

    ```
    """
    check_run(scene, launch, t1, tolerance, "reversal_table takes lists, and jax.vmap maps over them")
    require_rigid(scene)
    check_reversible(launch, {})
    return first_or_last_time(TopModel.timed(scene, launch, None), t1, "first", Settings(tolerance, solver))


def first_or_last_time(model: TopModel, t1: Any, crossing: str, settings: Settings) -> Float[Array, ""]:
    """The time of the event of a launch. **Arguments:** as for `inversion_time`, checked.

    **Raises:** `ValueError` for a run that needed too many steps. A warning states any other failure.
    """
    explicit_tableau(settings.for_lanes)
    time = time_of_event(model, t1, settings, crossing == "last")
    if is_traced((model, t1, time, settings)) or not np.isnan(time):
        return time
    # Repeat the run to find the cause.
    t1, form = float(t1), REVERSALS if model.reverses else INVERSIONS
    cell = {name: values[0] for name, values in TableJob(model, form, t1, crossing, settings)({}, 1).items()}
    word = form.words[cell["status"]]
    if word == "failed" and cell["steps"] >= settings.max_steps:
        raise ValueError(too_many_steps(t1, settings.max_steps, cell["end_time"]))
    reason = f": {why_unresolved(model.kind)}" if word == "unresolved" else ""
    end = f"at {cell['end_time']:.6g} s, at {cell['end_theta']:.6g} rad"
    warn(f"the {form.event} time is NaN: the run ended as {word!r} {end}{reason}")
    return time


@status_line("simulating")
def lyapunov_exponent(
    scene: Scene, launch: Launch, t1: float, tolerance: float = 1e-9, solver: diffrax.AbstractERK | None = None
) -> LyapunovExponent:
    """The largest Lyapunov exponent of one launch or of many at once, by the variational equation.

    The exponent is positive if nearby launches diverge exponentially. While a top rises, the exponent is the rate of
    the rise; in chaotic motion, the exponent stays positive as `t1` grows. Source: Benettin et al., Meccanica 15 (1980)
    9; see `nonholonomic/derivatives/lyapunov.py`. Tangents pass
    through flights, impacts, stick and slip by the saltation matrix.

    **Arguments:**

    - `scene`, `launch`: each number is a scalar or an array with one number per launch, (n,).
    - `t1`: time [s] to follow the motion, positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** a `LyapunovExponent`, its arrays of shape () or (n,): the mean rate of divergence in the second half of each
    run, and its error.

    **Raises:** `ValueError` for arguments outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> exponents = tippe.lyapunov_exponent(scene, tippe.Launch(1e-3, [155.0, 120.0]), t1=4.0, tolerance=1e-6)
    >>> print(exponents.exponent.round(1))  # 1/s, while the top rises
    [1.2 1.2]

    ```
    """
    require_kind(scene, "scene", Scene)
    require_kind(launch, "launch", Launch)
    require_outside((scene, launch, t1, tolerance), "lyapunov_exponent", "lists in the launch in place of vmap")
    require_all(run_bounds(t1, tolerance))
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves((scene, launch))} - {()}
    if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
        raise ValueError(f"scene and launch must hold scalars or one number per launch, not arrays of shapes {shapes}")
    model = TopModel(scene=scene, launch=launch).without_event()
    return exponent_of_model(model, float(t1), settings, shapes.pop() if shapes else ())
