"""Two reduced forms of the tippe top on the plane: Rutstam's equations, and the paper's reduction by Routh and Jellett.

Both need friction at a point: with a contact torque, Jellett's quantity is not constant. Both use the nodal frame (tx,
ty, z): tx along the horizontal projection of the axis e, ty = z x tx. Unlike the vector form, both are singular where
sin(theta) = 0.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from euler_angles import from_vector_state
from jaxtyping import Array, Float

from nonholonomic.text import shown
from tippe.friction import Slip
from tippe.model.body import Top
from tippe.model.dynamics import AXIS, VELOCITY
from tippe.model.scene import Scene


def nodal(state: Float[Array, " 8"], vector: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Components of a horizontal vector along tx and ty, for a state of the vector form."""
    e1, e2, _ = state[AXIS]
    level = jnp.hypot(e1, e2)
    c, s = e1 / level, e2 / level
    return jnp.stack([c * vector[0] + s * vector[1], c * vector[1] - s * vector[0]])


def point_friction(scene: Scene[Top], slip: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Tangential force per unit normal force [1] along (tx, ty), zeros if there is none.

    **Arguments:** `slip`: velocity of the contact point along (tx, ty) [m/s].

    **Raises:** `ValueError` for a law that has a torque.
    """
    zero = jnp.zeros_like(slip[0])
    force, torque = scene.friction.per_normal_force(Slip(slip[0], slip[1], (zero, zero, zero)))
    if torque != (None, None, None):
        raise ValueError(
            f"friction = {shown(scene.friction)} must act at a point, without a torque, for the reduced forms"
        )
    return jnp.stack([zero if part is None else part for part in force])


# Rutstam's equations


def rutstam_state(scene: Scene[Top], state: Float[Array, " 8"]) -> Float[Array, " 6"]:
    """Rutstam's state (theta, theta', phi', omega3, nu_x, nu_y) for a state of the vector form, nu the slip [m/s]."""
    _, theta, _, _, _, theta_dot, phi_dot, _ = from_vector_state(scene, state)
    slip = nodal(state, scene.slip_velocity(state))
    return jnp.concatenate([jnp.stack([theta, theta_dot, phi_dot, scene.spin(state)]), slip])


def rutstam_normal_force(scene: Scene[Top], state: Float[Array, " 6"]) -> Float[Array, ""]:
    """Normal force g_n [N] of Rutstam (2012), with friction f per unit normal force in place of -mu nu."""
    body = scene.body
    theta, theta_dot, phi_dot, omega, *slip = state
    force_x, _ = point_friction(scene, jnp.stack(slip))
    m, R, I1, I3, al = body.mass, body.radius, body.I1, body.I3, body.offset / body.radius
    s, c = jnp.sin(theta), jnp.cos(theta)
    swing = c * (I1 * phi_dot**2 * s**2 + I1 * theta_dot**2) - I3 * phi_dot * omega * s**2
    load = m * scene.gravity * I1 + m * R * al * swing
    return load / (I1 + m * R**2 * al**2 * s**2 + m * R**2 * al * s * (1.0 - al * c) * force_x)


@eqx.filter_jit
def rutstam_rate(scene: Scene[Top], state: Float[Array, " 6"]) -> Float[Array, " 6"]:
    """Rutstam's equations (1.10)-(1.15), SIGMA 8 (2012) 019, for any friction along the slip.

    **Arguments:**

    - `scene`: a `Scene` on the plane. The law's force per unit normal force replaces Rutstam's viscous -mu nu.
    - `state`: (theta, theta', phi', omega3, nu_x, nu_y) in rad, rad/s and m/s.

    **Returns:** its rate, (6,).
    """
    body = scene.body
    theta, theta_dot, phi_dot, omega, slip_x, slip_y = state
    m, R, I1, I3, al = body.mass, body.radius, body.I1, body.I3, body.offset / body.radius
    s, c = jnp.sin(theta), jnp.cos(theta)
    N = rutstam_normal_force(scene, state)
    F_x, F_y = N * point_friction(scene, jnp.stack([slip_x, slip_y]))
    theta_2 = s / I1 * (I1 * phi_dot**2 * c - I3 * omega * phi_dot - R * al * N) - R * F_x / I1 * (1.0 - al * c)
    phi_2 = (I3 * theta_dot * omega - 2.0 * I1 * theta_dot * phi_dot * c + F_y * R * (al - c)) / (I1 * s)
    omega_1 = F_y * R * s / I3
    turn = phi_dot * omega * (I3 * (1.0 - al * c) - I1) + N * R * al * (1.0 - al * c)
    turn = turn - I1 * al * (theta_dot**2 + phi_dot**2 * s**2)
    slip_x_1 = R * s / I1 * turn + F_x / (m * I1) * (I1 + m * R**2 * (1.0 - al * c) ** 2) + phi_dot * slip_y
    slip_y_1 = F_y / (m * I1 * I3) * (I1 * I3 + m * R**2 * I3 * (al - c) ** 2 + m * R**2 * I1 * s**2)
    slip_y_1 = slip_y_1 + omega * theta_dot * R / I1 * (I3 * (al - c) + I1 * c) - phi_dot * slip_x
    return jnp.stack([theta_dot, theta_2, phi_2, omega_1, slip_x_1, slip_y_1])


# The paper's reduction, equations (1) and (6)-(10) corrected


class JellettState(NamedTuple):
    """The state that remains when psi is eliminated by beta1 and phi' by Jellett's constant.

    - `theta`, `theta_dot`: inclination [rad] and its rate.
    - `spin_momentum`: beta1 = I3 omega3 [kg m^2/s], which friction changes.
    - `velocity_x`, `velocity_y`: velocity of the centre of mass [m/s] along tx and ty.
    """

    theta: Float[Array, ""]
    theta_dot: Float[Array, ""]
    spin_momentum: Float[Array, ""]
    velocity_x: Float[Array, ""]
    velocity_y: Float[Array, ""]


def jellett_state(scene: Scene[Top], state: Float[Array, " 8"]) -> JellettState:
    """The reduced state for a state of the vector form; Jellett's constant itself is `scene.jellett(state)`."""
    chart = from_vector_state(scene, state)
    velocity = nodal(state, state[VELOCITY])
    return JellettState(chart[1], chart[5], scene.body.I3 * scene.spin(state), velocity[0], velocity[1])


def jellett_constant(
    scene: Scene[Top], theta: Float[Array, ""], phi_dot: Float[Array, ""], spin_momentum: Float[Array, ""]
) -> Float[Array, ""]:
    """The paper's (1), corrected: J = beta1 (R cos(theta) - a) + I1 phi' R sin(theta)^2 [kg m^3/s]."""
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    return spin_momentum * (body.radius * c - body.offset) + body.I1 * phi_dot * body.radius * s**2


def spin_momentum_from_jellett(
    scene: Scene[Top], theta: Float[Array, ""], phi_dot: Float[Array, ""], jellett: Float[Array, ""]
) -> Float[Array, ""]:
    """The paper's (8), right as printed on the plane: beta1 = (J - I1 phi' R sin(theta)^2) / (R cos(theta) - a).

    It fails where R cos(theta) = a; `precession_from_jellett` solves the same relation where sin(theta) is not 0.
    """
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    return (jellett - body.I1 * phi_dot * body.radius * s**2) / (body.radius * c - body.offset)


def precession_from_jellett(
    scene: Scene[Top], theta: Float[Array, ""], spin_momentum: Float[Array, ""], jellett: Float[Array, ""]
) -> Float[Array, ""]:
    """Precession phi' [rad/s] = (J - beta1 (R cos(theta) - a)) / (R I1 sin(theta)^2)."""
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    return (jellett - spin_momentum * (body.radius * c - body.offset)) / (body.radius * body.I1 * s**2)


def spin_rate(
    scene: Scene[Top], theta: Float[Array, ""], phi_dot: Float[Array, ""], spin_momentum: Float[Array, ""]
) -> Float[Array, ""]:
    """The paper's (10), right on the plane: psi' = beta1 / I3 - phi' cos(theta) [rad/s]."""
    return spin_momentum / scene.body.I3 - phi_dot * jnp.cos(theta)


def spin_rate_from_jellett(
    scene: Scene[Top], theta: Float[Array, ""], phi_dot: Float[Array, ""], jellett: Float[Array, ""]
) -> Float[Array, ""]:
    """The paper's (7), right as printed on the plane: psi' [rad/s] from Jellett's constant alone."""
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    lever = body.radius * c - body.offset
    spin_part = jellett - body.I1 * phi_dot * body.radius * s**2 - body.I3 * phi_dot * c * lever
    return spin_part / (body.I3 * lever)


def lagrangian(
    scene: Scene[Top], theta: Float[Array, ""], rates: Float[Array, " 3"], velocity: Float[Array, " 2"]
) -> Float[Array, ""]:
    """The paper's (6), corrected, in coordinates of the centre of mass [J].

    L = (m (x'^2 + y'^2 + a^2 theta'^2 sin(theta)^2) + I1 theta'^2 + I1 phi'^2 sin(theta)^2
    + I3 (psi' + phi' cos(theta))^2) / 2 - m g (R - a cos(theta)); the printed form lacks the term in a^2.

    **Arguments:**

    - `rates`: (theta', phi', psi') [rad/s].
    - `velocity`: horizontal velocity of the centre of mass [m/s].
    """
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    theta_dot, phi_dot, psi_dot = rates
    translation = body.mass * (velocity @ velocity + (body.offset * theta_dot * s) ** 2)
    rotation = body.I1 * (theta_dot**2 + (phi_dot * s) ** 2) + body.I3 * (psi_dot + phi_dot * c) ** 2
    return 0.5 * (translation + rotation) - body.mass * scene.gravity * (body.radius - body.offset * c)


def routhian(
    scene: Scene[Top],
    theta: Float[Array, ""],
    rates: Float[Array, " 2"],
    velocity: Float[Array, " 2"],
    spin_momentum: Float[Array, ""],
) -> Float[Array, ""]:
    """The paper's (9), corrected: the Routhian R = L - beta1 psi' [J], with psi' eliminated by (10).

    R = (m (x'^2 + y'^2 + a^2 theta'^2 sin(theta)^2) + I1 theta'^2 + I1 phi'^2 sin(theta)^2) / 2 + beta1 phi' cos(theta)
    - beta1^2 / (2 I3) - m g (R - a cos(theta)). The printed (9) lacks the gyroscopic term and has the opposite sign of
      the next term: it is the value of the kinetic energy, from which no equation of motion follows.

    **Arguments:** as for `lagrangian`, with `rates` (theta', phi').
    """
    body, s, c = scene.body, jnp.sin(theta), jnp.cos(theta)
    theta_dot, phi_dot = rates
    kinetic = body.mass * (velocity @ velocity + (body.offset * theta_dot * s) ** 2)
    kinetic = 0.5 * (kinetic + body.I1 * (theta_dot**2 + (phi_dot * s) ** 2))
    gyroscopic = spin_momentum * phi_dot * c - spin_momentum**2 / (2.0 * body.I3)
    return kinetic + gyroscopic - body.mass * scene.gravity * (body.radius - body.offset * c)


@eqx.filter_jit
def jellett_rate(scene: Scene[Top], state: JellettState, jellett: Float[Array, ""]) -> JellettState:
    """Routh's equation for theta, with beta1 driven by friction and phi' from Jellett's constant.

    d/dt dR/dtheta' - dR/dtheta = N f_x (a cos(theta) - R), beta1' = N f_y R sin(theta), and
    N = m (g + a (theta'' sin(theta) + theta'^2 cos(theta))), which is (12) of the paper on the plane.

    **Arguments:**

    - `scene`: a `Scene` on the plane, with any friction along the slip.
    - `state`: a `JellettState`.
    - `jellett`: the constant J [kg m^3/s].

    **Returns:** the rate of the state, as a `JellettState`.
    """
    body = scene.body
    theta, theta_dot, spin_momentum, v_x, v_y = state
    R, a, s, c = body.radius, body.offset, jnp.sin(theta), jnp.cos(theta)
    phi_dot = precession_from_jellett(scene, theta, spin_momentum, jellett)
    psi_dot = spin_rate(scene, theta, phi_dot, spin_momentum)
    velocity = jnp.stack([v_x, v_y])

    def of_rate(rate, angle):
        return routhian(scene, angle, jnp.stack([rate, phi_dot]), velocity, spin_momentum)

    inertia = jax.grad(jax.grad(of_rate))(theta_dot, theta)
    drift = jax.grad(jax.grad(of_rate), argnums=1)(theta_dot, theta) * theta_dot
    push = jax.grad(of_rate, argnums=1)(theta_dot, theta) - drift

    slip = jnp.stack([v_x + (a * c - R) * theta_dot, v_y + a * phi_dot * s + R * psi_dot * s])
    f_x, f_y = point_friction(scene, slip)
    lever = f_x * (a * c - R)
    # inertia theta'' = push + N lever, and N is linear in theta''.
    bare = body.mass * (scene.gravity + a * theta_dot**2 * c)
    theta_2 = (push + bare * lever) / (inertia - body.mass * a * s * lever)
    N = bare + body.mass * a * s * theta_2
    return JellettState(
        theta=theta_dot,
        theta_dot=theta_2,
        spin_momentum=N * f_y * R * s,
        velocity_x=N * f_x / body.mass + phi_dot * v_y,
        velocity_y=N * f_y / body.mass - phi_dot * v_x,
    )
