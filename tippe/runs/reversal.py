"""Reversal times: when a body such as a rattleback reverses its spin about the arena's normal."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import diffrax
from jaxtyping import Array, Float

from nonholonomic.integration import Settings, explicit_tableau
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.progress import status_line
from nonholonomic.runs import Options
from nonholonomic.sweeps import Table
from nonholonomic.validation import require_kind, require_outside

from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from .checks import check_reversible, check_run
from .inversion_time import first_or_last_time
from .table import event_table


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
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    return first_or_last_time(scene, launch, t1, None, "first", settings)


def reversal_table(
    scene: Scene,
    *,
    theta: Any,
    spin: Any,
    azimuth: Any = 0.0,
    mu: Any = None,
    t1: float,
    tolerance: float = 1e-9,
    path: Any = None,
    axes: dict[str, Any] | None = None,
    solver: diffrax.AbstractERK | None = None,
    scattered: bool = False,
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> Table:
    """Times of the first reversal of spin over a grid of launches and scenes, in one batched call on all cores.

    **Arguments:** as for `inversion_table`; the body of the scene is an `Ellipsoid` or a `RigidBody`, and the spin is not zero.
    Axes have names such as `"scene.body.inertia.xy"` and `"scene.body.semi_axes[0]"`.

    **Returns:** a `Table` like that of `inversion_table`, with the time [s] at which the spin about the arena's normal
    first vanishes, infinite if it does not, and `status`: "reversed", "not_reversed" by `t1`, "contact_lost", "failed",
    "jammed".

    **Raises:** as for `inversion_table`, and `ValueError` for another body and a launch without spin.

    **Example:** a rattleback reverses sooner in one sense than in the other.

    ```
    >>> import tippe
    >>> inertia = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]
    >>> body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), inertia)
    >>> scene = tippe.Scene(body, friction=tippe.NoSlip())
    >>> table = tippe.reversal_table(scene, theta=0.02, spin=[-5.0, 5.0], t1=9.0, tolerance=1e-6)
    >>> print(table.time.round(2), table.status)
    [2.61 8.17] ['reversed' 'reversed']

    ```
    """
    require_outside((scene, theta, spin, azimuth, mu, axes, t1), "reversal_table", "reversal_time")
    require_kind(scene, "scene", Scene)
    require_rigid(scene)
    launch_values = {"theta": theta, "mu": mu, "spin": spin, "azimuth": azimuth}
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor)
    return event_table(scene, launch_values, axes, t1, None, options)


def require_rigid(scene: Scene) -> None:
    """Raise `ValueError` unless the body can reverse its spin."""
    if not isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be an Ellipsoid or a RigidBody for times of reversal: a body of revolution keeps its "
            "sense of rotation"
        )
