"""The time of inversion of one launch, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

import diffrax
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.integration import Settings, explicit_tableau
from nonholonomic.progress import status_line
from nonholonomic.runs import TableJob, time_of_event
from nonholonomic.validation import is_traced, warn

from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.inversion_problem import StemContact
from .checks import check_event, check_run, warn_if_it_cannot_invert
from .model import INVERSIONS, REVERSALS, TopModel
from .run_kind import why_unresolved
from .table import too_many_steps
from .turned_over import event_of


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
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    warn_if_it_cannot_invert(scene, launch, launch.theta, angle)
    return first_or_last_time(scene, launch, t1, event_of(scene, angle), crossing, settings)


def first_or_last_time(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    angle: Float[Array, ""] | StemContact | None,
    crossing: str,
    settings: Settings,
) -> Float[Array, ""]:
    """The time at which theta reaches an angle, or at which the stem carries the top, or, without an angle, at which the
    spin about the normal reverses.

    **Arguments:** as for `inversion_time`, checked.
    """
    model = TopModel.timed(scene, launch, angle)
    time = time_of_event(model, t1, settings, crossing == "last")
    if not any(is_traced(leaf) for leaf in jax.tree.leaves((model, t1, time, settings))) and np.isnan(time):
        explain_failure(model, float(t1), crossing, settings)
    return time


def explain_failure(model: TopModel, t1: float, crossing: str, settings: Settings) -> None:
    """Raise `ValueError` for a run that needed too many steps; warn of any other failure. This repeats the run to find
    the cause.

    **Arguments:** as for `inversion_time`.
    """
    form = REVERSALS if model.reverses else INVERSIONS
    cell = {name: values[0] for name, values in TableJob(model, form, t1, crossing, settings)({}, 1).items()}
    word = form.words[cell["status"]]
    if word == "failed" and cell["steps"] >= settings.max_steps:
        raise ValueError(too_many_steps(t1, settings.max_steps, cell["end_time"]))
    reason = f": {why_unresolved(model.kind)}" if word == "unresolved" else ""
    end = f"at {cell['end_time']:.6g} s, at {cell['end_theta']:.6g} rad"
    warn(f"the {form.event} time is NaN: the run ended as {word!r} {end}{reason}")
