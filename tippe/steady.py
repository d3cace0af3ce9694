"""Steady motions of the tippe top, their stability, and the resulting thresholds and groups (`tippe.md`, section 6).

A standing top spins with its axis along the normal: upright (stem out, theta = 0) or inverted (stem in, theta = pi). On
the plane, tumbling tops lie between: the axis precesses at a fixed inclination, with the centre of mass at rest and
without slip. The formulas hold for friction laws that vanish only with the slip, not for `Contensou` and `Rolling`,
under which every spin decays; alpha = a / R and gamma = I1 / I3. For a top with a stem, the formulas describe the
motions on the top's own sphere; only `inverted_critical_spin` refers to the stem, on which such a top stands inverted.

The stability matrices are Jacobians of the scene's own field, without the directions that are neutral by symmetry or by
conservation, so an eigenvalue with a positive real part always means instability.

**Example:**

```
>>> import tippe
>>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
>>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
>>> from tippe import steady
>>> steady.group(top)
'II'
>>> print(f"an inverted top is stable above {steady.inverted_critical_spin(scene):.2f} rad/s")
an inverted top is stable above 41.31 rad/s
>>> print(f"{steady.tumbling(scene, 1.0).precession:.2f} rad/s")
37.24 rad/s

```
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic import validation
from nonholonomic.geometry import CarriedFrame, Torus
from nonholonomic.integration.dense import sign_changes
from nonholonomic.parameters import numbers
from nonholonomic.text import shown
from nonholonomic.validation import as_number, require, require_kind, require_scalars

from .model.body import Top
from .model.dynamics import AXIS, PLACE, joined, parts
from .model.rigid import AbstractRigidBody
from .model.scene import Launch, Scene

# Checks of the arguments of steady motions; traced numbers pass.

#: A number or an array.
Number = Float[ArrayLike, "..."]

#: Advice in messages about lists, and about what is no motion.
MANY, A_MOTION = "jax.vmap maps over several", ", as tumbling(scene, theta) returns it"


def _require_top(body: object, caller: str | None = None) -> None:
    """Raise `ValueError` unless the body is a `Top`; with known scalars, if a `caller` is named."""
    if not isinstance(body, Top):
        raise ValueError(f"body = {shown(body)} must be a Top: the formulas are those of a sphere")
    if caller is not None:
        validation.require_outside(body, caller, "steady.proportions")
        require_scalars(numbers("body", body), MANY)


def _require_scene_of_a_top(scene: Scene, any_arena: bool = False) -> None:
    """Raise `ValueError` unless this is a scene of a `Top`, on a level plane if not on `any_arena`."""
    require_kind(scene, "scene", Scene)
    _require_top(scene.body)
    if not (scene.level or any_arena):
        raise ValueError(
            f"surface = {shown(scene.surface)} must be a Plane without tilt: on other arenas, no top tumbles steadily"
        )


def _require_standing(scene: Scene, spin: object, inverted: object) -> None:
    """Raise `ValueError` unless the body of a scene can stand and spin, and the other arguments are legal."""
    require_kind(scene, "scene", Scene)
    if isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be a body of revolution, such as a Top or a SpheroidBody, to stand and spin"
        )
    require(spin, "spin")
    validation.require_flag(inverted, "inverted")


# Tumbling tops on the plane: the motion, its stability, its energy and its state.


class Tumbling(NamedTuple):
    """A steady precession on the plane, in which the centre of mass is at rest and the contact point does not slip.

    - `theta`: inclination [rad].
    - `precession`: phi' [rad/s].
    - `spin`: omega3 [rad/s].
    - `jellett`: Jellett's constant [kg m^3/s].

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> print(f"it turns about its axis at {motion.spin:.2f} rad/s")
    it turns about its axis at 8.95 rad/s
    """

    theta: Float[Array, "..."]
    precession: Float[Array, "..."]
    spin: Float[Array, "..."]
    jellett: Float[Array, "..."]


def tumbling(scene: Scene[Top], theta: Number) -> Tumbling:
    """The tumbling top at an inclination; of the two solutions, the one with positive phi'.

    phi'^2 = m g a / D, omega3 = (cos - alpha) phi', J = R G phi', with D = I3 (alpha - cos) + I1 cos and
    G = I1 sin^2 + I3 (cos - alpha)^2 (Rutstam 2012, eq. 2.8).

    **Arguments:**

    - `scene`: a `Scene` on the plane.
    - `theta`: inclination [rad] with D > 0, which holds for every inclination in group II.

    **Raises:** `ValueError` if the arena is not a plane, or if no tumbling top exists at the inclination.

    **Example:** with the scene of the module.

    >>> print(f"{steady.tumbling(scene, 2.0).precession:.2f} rad/s")
    33.55 rad/s
    """
    theta = as_number(theta)
    lever, inertia = _lever_and_inertia(scene, theta)
    require(lever, "I3 (alpha - cos(theta)) + I1 cos(theta)", above=0.0, why="no tumbling top at this inclination")
    alpha, _ = proportions(scene.body)
    precession = jnp.sqrt(scene.body.mass * scene.gravity * scene.body.offset / lever)
    spin = (jnp.cos(theta) - alpha) * precession
    return Tumbling(theta, precession, spin, scene.body.radius * inertia * precession)


def tumbling_is_stable(scene: Scene[Top], theta: Number) -> Float[Array, "..."]:
    """Whether the tumbling top is stable: J^2 grows with theta, that is, 4 D^2 + G (I1 - I3) > 0.

    **Example:** with the scene of the module.

    >>> bool(steady.tumbling_is_stable(scene, 1.0))
    True
    """
    lever, inertia = _lever_and_inertia(scene, theta)
    return 4.0 * lever**2 + inertia * (scene.body.I1 - scene.body.I3) > 0.0


def effective_energy(scene: Scene[Top], theta: Number, jellett: Number) -> Float[Array, "..."]:
    """Least energy [J] of a top with the given inclination and Jellett's constant: J^2 / (2 R^2 G) + m g (R - a cos).

    Its extrema over theta are the steady motions, and its minima are the stable motions.

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> print(f"{1e3 * steady.effective_energy(scene, 1.0, motion.jellett):.3f} mJ")
    4.886 mJ
    """
    _, inertia = _lever_and_inertia(scene, theta)
    require(jellett, "jellett")
    body = scene.body
    height = body.radius - body.offset * jnp.cos(theta)
    return as_number(jellett) ** 2 / (2.0 * body.radius**2 * inertia) + body.mass * scene.gravity * height


def tumbling_angles(scene: Scene[Top], jellett: float, samples: int = 2001) -> list[float]:
    """Every inclination [rad] at which a tumbling top has the given Jellett's constant, in increasing order.

    **Arguments:**

    - `scene`: a `Scene` on the plane with concrete numbers.
    - `jellett`: Jellett's constant [kg m^3/s], of either sign.
    - `samples`: number of grid points for finding brackets; each bracket is then bisected.

    **Example:** with the scene of the module.

    >>> jellett = steady.tumbling(scene, 1.0).jellett
    >>> print([round(theta, 3) for theta in steady.tumbling_angles(scene, float(jellett))])
    [1.0]
    """
    _require_scene_of_a_top(scene)
    require(jellett, "jellett")
    require_scalars(numbers("scene", scene, functions=False) | {"jellett": jellett}, MANY)
    validation.require_whole(samples, "samples", 4)
    grid = jnp.linspace(0.0, jnp.pi, samples)

    def slope(theta):
        return jax.vmap(jax.grad(lambda angle: effective_energy(scene, angle, jellett)))(theta) / jnp.sin(theta)

    return [float(root) for root in sign_changes(slope, grid[1:-1])]


def tumbling_state(scene: Scene[Top], motion: Tumbling) -> Float[Array, " 8"]:
    """States of the vector form of a tumbling top whose axis leans towards t1.

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> print(f"{1e3 * scene.energy(steady.tumbling_state(scene, motion)):.3f} mJ")
    4.886 mJ
    """
    _require_scene_of_a_top(scene)
    require_kind(motion, "motion", Tumbling, A_MOTION)
    body, s, c = scene.body, jnp.sin(motion.theta), jnp.cos(motion.theta)
    zero = jnp.zeros_like(s)
    transverse, axial = -body.I1 * motion.precession * s, body.I3 * motion.spin
    return joined((zero, zero), (s, zero, c), (transverse * c + axial * s, zero, -transverse * s + axial * c))


def quarter_turn(state: Float[Array, " 8"]) -> Float[Array, " 8"]:
    """Rate of a state on the plane if everything turns about the vertical at 1 rad/s.

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> state = steady.tumbling_state(scene, motion)
    >>> change = scene.field(state) - motion.precession * steady.quarter_turn(state)
    >>> bool(abs(change).max() < 1e-12)
    True
    """
    if len(np.shape(state)) == 0 or np.shape(state)[0] != 8:
        raise ValueError(
            f"state of shape {np.shape(state)} must have the 8 components of a top on the plane along its first axis, as "
            "tumbling_state has"
        )
    (u1, u2), (e1, e2, _), (L1, L2, _), _ = parts(state)
    zero = jnp.zeros_like(u1)
    return joined((-u2, u1), (-e2, e1, zero), (-L2, L1, zero))


def _lever_and_inertia(scene: Scene[Top], theta: Number) -> tuple[Array, Array]:
    """D = I3 (alpha - cos) + I1 cos and G = I1 sin^2 + I3 (cos - alpha)^2 [kg m^2].

    **Raises:** `ValueError` unless this is a scene on the plane, and theta an angle [rad] in [0, pi], or several.
    """
    _require_scene_of_a_top(scene)
    require(theta, "theta", at_least=0.0, at_most=np.pi, unit="rad")
    alpha, _ = proportions(scene.body)
    s, c = jnp.sin(theta), jnp.cos(theta)
    lever = scene.body.I3 * (alpha - c) + scene.body.I1 * c
    return lever, scene.body.I1 * s**2 + scene.body.I3 * (c - alpha) ** 2


# The group of a top, and the thresholds of its standing motions on the plane, in closed form.


def proportions(body: Top) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """The two numbers that classify a top: alpha = a / R and gamma = I1 / I3.

    **Raises:** `ValueError` for a body other than a `Top`, for which these formulas do not hold.

    **Example:** with the scene of the module.

    >>> alpha, gamma = steady.proportions(top)
    >>> print(f"{alpha:.2f} {gamma:.3f}")
    0.30 0.936
    """
    _require_top(body)
    return body.offset / body.radius, body.I1 / body.I3


def group(body: Top) -> str:
    """The group of a top (Rutstam 2012; Ciocci et al. 2012).

    **Returns:** "I" if gamma < 1 - alpha: the top stands upright at every spin; "III" if gamma > 1 + alpha: the top
    never stands inverted, and ends tumbling; "II" otherwise: the top inverts if Jellett's constant is large enough.

    **Example:** with the scene of the module.

    >>> steady.group(top)
    'II'
    """
    _require_top(body, "steady.group")
    alpha, gamma = (float(number) for number in proportions(body))
    return "I" if gamma <= 1.0 - alpha else "III" if gamma >= 1.0 + alpha else "II"


def folds(body: Top) -> bool:
    """Whether Jellett's constant has an extremum over the tumbling angles of a top of group II, which causes
    hysteresis.

    There is none if gamma > 1 - delta, delta = (1 + 6 alpha + alpha^2 - (1 - alpha) sqrt(1 + 14 alpha + alpha^2)) / 8.

    **Example:** with the scene of the module.

    >>> steady.folds(top), steady.folds(tippe.Top(0.02, 0.02, 0.006, I1=2.5e-6, I3=3.2e-6))
    (False, True)
    """
    _require_top(body, "steady.folds")
    alpha, gamma = proportions(body)
    delta = (1.0 + 6.0 * alpha + alpha**2 - (1.0 - alpha) * jnp.sqrt(1.0 + 14.0 * alpha + alpha**2)) / 8.0
    return bool(gamma < 1.0 - delta)


def upright_critical_spin(scene: Scene[Top]) -> Float[Array, "..."]:
    """Spin [rad/s] above which the upright top on the plane is unstable; infinite if there is none. omega^2 = m g a (1
    - alpha)^2 / (I3 (gamma - 1 + alpha)).

    **Example:** with the scene of the module.

    >>> print(f"{steady.upright_critical_spin(scene):.1f} rad/s")
    27.7 rad/s
    """
    _require_scene_of_a_top(scene, any_arena=True)
    alpha, gamma = proportions(scene.body)
    weight = scene.body.mass * scene.gravity * scene.body.offset
    return _root_of_ratio(weight * (1.0 - alpha) ** 2 / scene.body.I3, gamma - 1.0 + alpha)


def inverted_critical_spin(scene: Scene[Top]) -> Float[Array, "..."]:
    """Spin [rad/s] above which the inverted top on the plane (on its stem, if any) is stable; infinite if there is
    none. omega^2 = m g a (1 + alpha)^2 / (I3 (1 + alpha - gamma)), for a stem with its offset and radius (`tippe.md`,
    sections 4, 6).

    **Example:** with the scene of the module.

    >>> print(f"{steady.inverted_critical_spin(scene):.1f} rad/s")
    41.3 rad/s
    """
    _require_scene_of_a_top(scene, any_arena=True)
    (_, gamma), body = proportions(scene.body), scene.body
    sphere = body if body.stem is None else body.stem
    alpha, weight = sphere.offset / sphere.radius, body.mass * scene.gravity * sphere.offset
    return _root_of_ratio(weight * (1.0 + alpha) ** 2 / body.I3, 1.0 + alpha - gamma)


def jellett_thresholds(scene: Scene[Top]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Jellett's constant [kg m^3/s] of the standing tops at their critical spins, upright and inverted.

    Below the first constant, the upright top is stable; above the second, the inverted top is stable (Rutstam's
    lambda_thres).

    **Raises:** `ValueError` for a top with a stem: Jellett's constants of its sphere and of its stem differ.

    **Example:** with the scene of the module.

    >>> print(" ".join(f"{jellett:.2e}" for jellett in steady.jellett_thresholds(scene)))
    1.24e-06 3.44e-06
    """
    _require_scene_of_a_top(scene, any_arena=True)
    (alpha, _), body = proportions(scene.body), scene.body
    if body.stem is not None:
        raise ValueError(
            f"stem = {shown(body.stem)} must be None: a top with a stem does not keep Jellett's constant as it inverts; "
            "upright_critical_spin and inverted_critical_spin say from which spin it leaves the upright position and stays "
            "on its stem"
        )
    upright = (1.0 - alpha) * body.radius * body.I3 * upright_critical_spin(scene)
    inverted = (1.0 + alpha) * body.radius * body.I3 * inverted_critical_spin(scene)
    return upright, inverted


def _root_of_ratio(value: Float[Array, "..."], excess: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root of value / excess, or infinity if the excess is not positive."""
    return jnp.where(excess > 0.0, jnp.sqrt(value / jnp.where(excess > 0.0, excess, 1.0)), jnp.inf)


# Matrices of the linear motion near steady motions, and their growth rates.
#
# The matrices are Jacobians of the scene's own field, without the directions that are neutral by symmetry or by
# conservation, so an eigenvalue with a positive real part always means instability.


def standing_state(scene: Scene, spin: Float[ArrayLike, ""], inverted: bool = False) -> Float[Array, " components"]:
    """States of the vector form of a standing top at the arena's lowest point.

    **Arguments:**

    - `scene`: a `Scene` on any arena.
    - `spin`: angular velocity about the axis [rad/s].
    - `inverted`: whether the stem points into the arena.

    **Example:** with the scene of the module.

    >>> print(f"{scene.theta(steady.standing_state(scene, 100.0, inverted=True)):.4f} rad")
    3.1416 rad
    """
    _require_standing(scene, spin, inverted)
    state = scene.state(Launch(0.0, spin))
    # The axis and the angular momentum point along n; only their components 4 and 7 are not 0.
    return state.at[np.array([4, 7])].multiply(-1.0 if inverted else 1.0)


def standing_matrix(scene: Scene, spin: Float[ArrayLike, ""], inverted: bool = False) -> Float[Array, "k k"]:
    """Matrix [1/s] of the linear motion near a standing top, on any arena.

    The matrix omits components along n, which change only at second order, the direction of the frame, and
    displacements along which the arena is symmetric. A scene with `contact="hybrid"` is treated like one with "stop".

    **Arguments:** as for `standing_state`.

    **Returns:** (k, k), for the velocity, axis, angular momentum and place across n, in the units of `Scene.scales`.

    **Example:** with the scene of the module.

    >>> steady.standing_matrix(scene, 50.0, inverted=True).shape
    (6, 6)
    """
    _require_standing(scene, spin, inverted)
    require_scalars(numbers("scene", scene, functions=False) | {"spin": spin}, MANY)
    body = dataclasses.replace(scene.body, stem=None) if scene.contact == "hybrid" else scene.body
    scene = dataclasses.replace(scene, body=body, contact="stop", restitution=None)
    return _standing_matrix(scene, as_number(spin), bool(inverted))


@eqx.filter_jit
def _standing_matrix(scene: Scene, spin: Float[Array, ""], inverted: bool) -> Float[Array, "k k"]:
    state = standing_state(scene, spin, inverted)
    # The place components that matter near the arena's lowest point.
    places = max(len(scene.frame.lengths) - 1, 0)
    if isinstance(scene.frame, CarriedFrame):
        # The foot (x, y, z), whose z is along n, and the first tangent, which is only the frame's choice of axes.
        places = 1 if isinstance(scene.surface, Torus) else 2
    components = [0, 1, 2, 3, 5, 6, *range(PLACE.start, PLACE.start + places)]
    scales = scene.scales(Launch(0.0, spin))
    jacobian = jax.jacfwd(scene.field)(state) * scales / scales[:, None]
    return jacobian[np.ix_(components, components)]


def tumbling_matrix(scene: Scene[Top], motion: Tumbling) -> Float[Array, "5 5"]:
    """Matrix [1/s] of the linear motion near a tumbling top, in a frame that precesses with it.

    The matrix covers the five directions that preserve |e| and Jellett's constant, without the turn about the vertical.

    **Arguments:**

    - `scene`: a `Scene` on the plane, with friction.
    - `motion`: a motion from `tumbling`.

    **Example:** with the scene of the module.

    >>> motion = steady.tumbling(scene, 1.0)
    >>> print(f"{steady.growth_rate(steady.tumbling_matrix(scene, motion)):.2f} 1/s")
    -0.35 1/s
    """
    _require_scene_of_a_top(scene)
    require_kind(motion, "motion", Tumbling, A_MOTION)
    values = {f"motion.{name}": value for name, value in motion._asdict().items()}
    require_scalars(numbers("scene", scene, functions=False) | values, MANY)
    return _tumbling_matrix(scene, motion)


@eqx.filter_jit
def _tumbling_matrix(scene: Scene[Top], motion: Tumbling) -> Float[Array, "5 5"]:
    state = tumbling_state(scene, motion)
    scales = scene.scales(Launch(motion.theta, motion.spin))

    # The rate in the frame that precesses.
    jacobian = jax.jacfwd(lambda state: scene.field(state) - motion.precession * quarter_turn(state))(state)
    scaled_state = state / scales
    length = jax.grad(lambda x: jnp.sum((x * scales)[AXIS] ** 2))(scaled_state)
    jellett = jax.grad(lambda x: scene.jellett(x * scales))(scaled_state)
    excluded_directions = jnp.stack([length, jellett, quarter_turn(state) / scales], axis=1)
    basis = jnp.linalg.qr(excluded_directions / jnp.linalg.norm(excluded_directions, axis=0), mode="complete")[0][:, 3:]
    return basis.T @ (jacobian * scales / scales[:, None]) @ basis


def growth_rate(matrix: Float[Array, "k k"]) -> Float[Array, ""]:
    """Largest real part [1/s] of the eigenvalues of a stability matrix: positive if the motion is unstable.

    **Example:** with the scene of the module.

    >>> print(f"{steady.growth_rate(steady.standing_matrix(scene, 50.0, inverted=True)):.2f} 1/s")
    -0.80 1/s
    """
    shape = np.shape(matrix)
    if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
        raise ValueError(f"matrix must be square, not of shape {shape}, as standing_matrix is; {MANY}")
    require(matrix, "matrix")
    return jnp.max(jnp.linalg.eigvals(matrix).real)
