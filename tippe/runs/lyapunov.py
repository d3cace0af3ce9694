"""The Lyapunov exponents of launches: whether two nearby launches diverge exponentially, and how fast."""

import diffrax
import jax
import numpy as np

from nonholonomic.integration import Settings, explicit_tableau
from nonholonomic.integration.checks import tolerance_bound
from nonholonomic.progress import status_line
from nonholonomic.runs import LyapunovExponent, exponent_of_model
from nonholonomic.validation import require, require_kind

from ..model.launch import Launch
from ..model.scene import Scene
from .model import TopModel


@status_line("simulating")
def lyapunov_exponent(
    scene: Scene,
    launch: Launch,
    t1: float,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
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

    **Returns:** a `LyapunovExponent`, its arrays of shape () or (n,).

    **Raises:** `ValueError` for arguments outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> found = tippe.lyapunov_exponent(scene, tippe.Launch(1e-3, [155.0, 120.0]), t1=4.0, tolerance=1e-6)
    >>> print(found.exponent.round(1))  # 1/s, while the top rises
    [1.2 1.2]

    ```
    """
    require_kind(scene, "scene", Scene)
    require_kind(launch, "launch", Launch)
    require(t1, "t1", above=0.0)
    tolerance_bound(tolerance).require()
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves((scene, launch))} - {()}
    if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
        raise ValueError(f"scene and launch must hold scalars or one number per launch, not arrays of shapes {shapes}")
    model = TopModel(scene=scene, launch=launch).without_event()
    return exponent_of_model(model, float(t1), settings, shapes.pop() if shapes else ())
