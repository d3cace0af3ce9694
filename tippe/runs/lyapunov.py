"""The Lyapunov exponent of a launch: whether nearby launches diverge exponentially, and how fast."""

import dataclasses
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from nonholonomic.derivatives import exponent_of, growth
from nonholonomic.geometry import cross, vector_of
from nonholonomic.integration import Settings, explicit_tableau
from nonholonomic.integration.checks import tolerance_bound
from nonholonomic.integration.status import LEFT_DOMAIN, REACHED_END
from nonholonomic.progress import status_line
from nonholonomic.validation import require, require_kind

from ..model.contact_dynamics import LOSSES
from ..model.dynamics import NO_COSINE
from ..model.launch import Launch
from ..model.rigid_body import AbstractRigidBody
from ..model.scene import Scene
from ..model.state import joined, parts
from ..modes.inversion_problem import InversionProblem
from .run_kind import run_kind_of

#: Number of time intervals with recorded growth; half of them give the exponent and its scatter.
STRETCHES = 32


class LyapunovExponent(NamedTuple):
    """The largest Lyapunov exponent of a run, or of each of several.

    - `exponent`: mean rate [1/s] of exponential divergence in the second half of the run; NaN if the run ended early.
    - `error`: error of the exponent [1/s]; an exponent below twice its error does not indicate chaos.
    - `status`: "completed", "contact_lost", "jammed", "does_not_fit" or "failed".
    - `end_time`: time at which the run ended [s]; `steps`: numbers of accepted and rejected steps.
    - `times`: 32 times [s], (32,); `running`: the mean rate of divergence [1/s] from the start to each of these times,
      (32, ...).

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> found = tippe.lyapunov_exponent(scene, tippe.Launch(1e-3, [155.0, 120.0]), t1=4.0, tolerance=1e-6)
    >>> print(found.status, found.running.shape)
    ['completed' 'completed'] (32, 2)

    ```
    """

    exponent: Float[np.ndarray, "..."]
    error: Float[np.ndarray, "..."]
    status: Shaped[np.ndarray, "..."]
    end_time: Float[np.ndarray, "..."]
    steps: Int[np.ndarray, "..."]
    times: Float[np.ndarray, " stretches"]
    running: Float[np.ndarray, "stretches ..."]


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
    9; see `nonholonomic/derivatives/lyapunov.py`.

    **Arguments:**

    - `scene`, `launch`: each number is a scalar or an array with one number per launch, (n,).
    - `t1`: time [s] to follow the motion, positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** a `LyapunovExponent`, its arrays of shape () or (n,).

    **Raises:** `ValueError` for arguments outside these ranges, and for a scene with `contact="hybrid"` or `SetValuedCoulomb`.

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
    if not run_kind_of(scene).smooth:
        raise ValueError(
            "contact = 'hybrid' and SetValuedCoulomb have no exponents: variations end at a change of mode"
        )
    require(t1, "t1", above=0.0)
    tolerance_bound(tolerance).require()
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves((scene, launch))} - {()}
    if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
        raise ValueError(f"scene and launch must hold scalars or one number per launch, not arrays of shapes {shapes}")
    shape = shapes.pop() if shapes else ()
    cells = int(np.prod(shape, dtype=int))
    # No angle has this cosine, so only the loss or jam of a contact ends a run before the horizon.
    problem = InversionProblem.of(scene, launch, jnp.pi, cells)
    # A turning frame turns by a different angle for each launch, and the difference would count as divergence.
    problem = dataclasses.replace(problem, dynamics=scene.dynamics, cos_angle=jnp.asarray(NO_COSINE))
    growths = growth(problem, generic_direction(scene, launch, cells), float(t1), STRETCHES, settings)
    exponent, error = exponent_of(growths.logarithm, float(t1))
    is_complete = growths.status == REACHED_END
    loss_words = np.array([status.word for status in LOSSES])[
        np.asarray(problem.dynamics.loss(jnp.asarray(growths.state)))
    ]
    words = np.select([is_complete, growths.status == LEFT_DOMAIN], ["completed", loss_words], "failed")
    times = t1 * np.arange(1, STRETCHES + 1) / STRETCHES
    elapsed = np.minimum(times[:, None], growths.end_time)
    # A run of zero length has no divergence.
    running = np.cumsum(growths.logarithm, axis=0) / np.where(elapsed > 0.0, elapsed, 1.0)
    return LyapunovExponent(
        exponent=np.where(is_complete, exponent, np.nan).reshape(shape),
        error=np.where(is_complete, error, np.nan).reshape(shape),
        status=words.reshape(shape),
        end_time=growths.end_time.reshape(shape),
        steps=growths.steps.reshape(shape),
        times=times,
        running=running.reshape(STRETCHES, *shape),
    )


def generic_direction(scene: Scene, launch: Launch, cells: int) -> Float[Array, "components cells"]:
    """A generic direction, tangent to the set of states: the body's axes keep their length and right angle, and the
    vertical keeps length 1; a body that rolls keeps rolling."""
    magnitudes, state = scene.scales(launch), scene.state(launch)
    u1, u2, r1, r2, r3, *L = (magnitudes[i] * jnp.cos(1.0 + i) for i in range(8))
    _, e, _, last = parts(state)
    frame, (place, _) = scene.frame, scene.start(launch)
    place = frame.frame_motion(place, (scene.body.size, scene.body.size)).place_rate
    rigid = isinstance(scene.body, AbstractRigidBody)
    x_axis = cross((r1, r2, r3), vector_of(last[-3:])) if rigid else ()
    direction = joined((u1, u2), cross((r1, r2, r3), e), tuple(L), place, x_axis)
    if rigid:
        direction = jax.jvp(scene.dynamics.carried_along, (state,), (direction,))[1]
    return jnp.broadcast_to(direction.reshape(len(direction), -1), (len(direction), cells))
