"""The tippe top in Euler angles, by Lagrange's equations, on plane and cylinder: an independent check of the vector
form.

The coordinates are those of the paper, q = (eta, y, theta, phi, psi) (the paper's x is y here): the place across the
arena (eta [rad] from the lowest line of a cylinder, or x [m] on a plane), the place y [m] along it, and Euler angles in
the arena's moving frame (t1, t2, n), in which the axis is e = sin(theta) (cos(phi) t1 + sin(phi) t2) + cos(theta) n.
The state is (eta, theta, phi, eta', y', theta', phi', psi'); y and psi are cyclic.

Unlike the vector form, these coordinates are singular where sin(theta) = 0; they are for comparison only.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import rate_in_frame
from nonholonomic.text import shown
from tippe.friction import Slip
from tippe.model.body import Top
from tippe.model.dynamics import AXIS, MOMENTUM, PLACE, VELOCITY
from tippe.model.scene import Launch, Scene


def across(scene: Scene[Top]) -> tuple[Float[Array, ""] | float, float]:
    """The length [m] and the turning angle [rad] of the frame per unit of the coordinate across the arena: (1, 0) on a
    plane, (rho, 1) on a cylinder.

    **Arguments:**

    - `scene`: a `Scene` on a `Plane` or a `Cylinder`; rho is the radius of the path of the centre.

    **Raises:** `ValueError` for an arena that is curved in both directions.
    """
    curvature, slope = scene.frame.frame_motion(scene.start(Launch(0.0, 0.0))[0], (1.0, 0.0)).frame_rate
    if slope is not None:
        raise ValueError(f"surface = {shown(scene.surface)} must be a Plane or a Cylinder for these coordinates")
    return (1.0, 0.0) if curvature is None else (1.0 / curvature, 1.0)


def from_vector_state(scene: Scene[Top], state: Float[Array, " components"]) -> Float[Array, " 8"]:
    """The state in Euler angles that corresponds to a state of the vector form.

    **Arguments:**

    - `scene`: a `Scene` on a `Plane` or a `Cylinder`.
    - `state`: (8 or 10,) as in `tippe/model/dynamics.py`.

    **Returns:** (eta or x, theta, phi, and the rates of eta or x, y, theta, phi, psi), an array (8,) in rad, m and s; x
    is 0.
    """
    metric, angle_metric = across(scene)
    e, L = state[AXIS], state[MOMENTUM]
    spinning = jnp.cross(L, e) / scene.body.I1
    velocity = state[VELOCITY] + scene.body.offset * spinning[:2]
    turning = scene.frame.frame_motion(tuple(state[PLACE]), (velocity[0], velocity[1])).frame_rate
    components = jnp.stack(
        [a if b is None else a + b for a, b in zip(spinning, rate_in_frame(tuple(e), turning), strict=True)]
    )

    def angles(axis):
        return jnp.stack([jnp.arctan2(jnp.hypot(axis[0], axis[1]), axis[2]), jnp.arctan2(axis[1], axis[0])])

    (theta, phi), (theta_dot, phi_dot) = jax.jvp(angles, (e,), (components,))
    eta = jnp.arctan2(*state[PLACE]) if angle_metric else jnp.zeros_like(theta)
    eta_dot = velocity[0] / metric
    psi_dot = L @ e / scene.body.I3 - phi_dot * e[2] + angle_metric * eta_dot * e[1]
    return jnp.stack([eta, theta, phi, eta_dot, velocity[1], theta_dot, phi_dot, psi_dot])


def metric(scene: Scene[Top], q: Float[Array, " 6"]) -> Float[Array, "6 6"]:
    """Kinetic metric G: the kinetic energy is q'.G q' / 2 = m |O' - a e'|^2 / 2 + I1 (p^2 + q^2) / 2 + I3 omega3^2 / 2.

    With `potential`, this is the paper's (6), completed and extended to the cylinder.

    **Arguments:**

    - `q`: (eta or x, y, theta, phi, psi, gap) in rad and m; the gap opens the contact, to find the force that closes
      it.

    **Returns:** (6, 6); O', e' and (p, q, omega3) as in `contact_motion`.
    """
    body = scene.body
    centre, spinning, turning = jax.jacfwd(lambda rate: contact_motion(scene, q, rate))(jnp.zeros_like(q))
    centre_of_mass = centre - body.offset * spinning
    inertia = jnp.stack([body.I1, body.I1, body.I3])
    return body.mass * centre_of_mass.T @ centre_of_mass + (turning.T * inertia) @ turning


def potential(scene: Scene[Top], q: Float[Array, " 6"]) -> Float[Array, ""]:
    """Potential energy [J], up to a constant: weight times the height of the centre of mass; `q` as for `metric`."""
    place, _ = scene.start(Launch(0.0, 0.0, eta=q[0]))
    parts = (jnp.zeros(()) if part is None else jnp.asarray(part) for part in scene.frame.vertical(place))
    vertical = jnp.stack(list(parts))
    height = q[5] * vertical[2] - scene.body.offset * axes(q[2], q[3])[2] @ vertical
    return scene.body.mass * scene.gravity * (height + scene.frame.height(place))


def axes(theta: Float[Array, ""], phi: Float[Array, ""]) -> Float[Array, "3 3"]:
    """The right-handed axes e1 = de/dtheta, e2 (horizontal) and e, as rows, in the frame (t1, t2, n)."""
    s, c, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    zero = jnp.zeros_like(s)
    return jnp.stack([jnp.stack([c * cp, c * sp, -s]), jnp.stack([-sp, cp, zero]), jnp.stack([s * cp, s * sp, c])])


def contact_motion(
    scene: Scene[Top], q: Float[Array, " 6"], q_dot: Float[Array, " 6"]
) -> tuple[Float[Array, " 3"], Float[Array, " 3"], Float[Array, " 3"]]:
    """Velocity of the sphere's centre, rate of the axis, and angular velocity about (e1, e2, e).

    **Arguments:** `q` as for `metric`; `q_dot`, its rates.

    **Returns:** O' [m/s] and e' [1/s] in the frame (t1, t2, n), and (p, q, omega3) [rad/s], the frame turning at
    -eta' t2.
    """
    metric, angle_metric = across(scene)
    _, _, theta, phi, _, gap = q
    eta_dot, y_dot, theta_dot, phi_dot, psi_dot, gap_dot = q_dot
    turning = angle_metric * eta_dot
    s, c, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    rates = jnp.stack(
        [-(phi_dot * s + turning * c * sp), theta_dot - turning * cp, psi_dot + phi_dot * c - turning * s * sp]
    )
    e1, e2, _ = axes(theta, phi)
    velocity = jnp.stack([(metric - angle_metric * gap) * eta_dot, y_dot, gap_dot])
    return velocity, rates[1] * e1 - rates[0] * e2, rates


def slip_velocity(scene: Scene[Top], q: Float[Array, " 6"], q_dot: Float[Array, " 6"]) -> Float[Array, " 2"]:
    """Velocity of the material contact point along the arena, V - R w x n [m/s]; arguments as above."""
    velocity = contact_motion(scene, q, q_dot)[0]
    w = angular_velocity(scene, q, q_dot)
    return jnp.stack([velocity[0] - scene.body.radius * w[1], velocity[1] + scene.body.radius * w[0]])


def angular_velocity(scene: Scene[Top], q: Float[Array, " 6"], q_dot: Float[Array, " 6"]) -> Float[Array, " 3"]:
    """Angular velocity of the body in the frame (t1, t2, n) [rad/s]; arguments as above."""
    return contact_motion(scene, q, q_dot)[2] @ axes(q[2], q[3])


def friction_per_normal_force(
    scene: Scene[Top], slip: Float[Array, " 2"], turning: Float[Array, " 3"]
) -> tuple[Float[Array, " 2"], Float[Array, " 3"]]:
    """Tangential force [1] and torque [m] per unit normal force, zeros if there is none.

    **Arguments:**

    - `slip`: velocity of the contact point along the arena [m/s].
    - `turning`: angular velocity of the body in the frame (t1, t2, n) [rad/s].
    """
    load = scene.friction.per_normal_force(Slip(slip[0], slip[1], tuple(turning)))
    zero = jnp.zeros_like(slip[0])
    force, torque = (jnp.stack([zero if part is None else part for part in vector]) for vector in load)
    return force, torque


def per_normal_force(scene: Scene[Top], q: Float[Array, " 6"], q_dot: Float[Array, " 6"]) -> Float[Array, " 6"]:
    """Generalised forces of the contact per unit normal force, d gap/dq + f . dv/dq' + tau . dw/dq'; arguments as above."""

    def moving(rate):
        return slip_velocity(scene, q, rate), angular_velocity(scene, q, rate)

    force, torque = friction_per_normal_force(scene, *moving(q_dot))
    reach, turn = jax.jacfwd(moving)(q_dot)
    return force @ reach + torque @ turn + jnp.zeros_like(q).at[5].set(1.0)


def spread(state: Float[Array, " 8"]) -> tuple[Float[Array, " 6"], Float[Array, " 6"]]:
    """Coordinates (eta, y, theta, phi, psi, gap) and their rates; the cyclic ones and the gap are set to 0."""
    zero = jnp.zeros_like(state[0])
    return jnp.stack([state[0], zero, state[1], state[2], zero, zero]), jnp.append(state[3:], zero)


class Accelerations(NamedTuple):
    """Second rates of (eta or x, y, theta, phi, psi) [rad/s^2, m/s^2], and the normal force [N]."""

    second_rates: Float[Array, " 5"]
    normal_force: Float[Array, ""]


@eqx.filter_jit
def by_lagrange(scene: Scene[Top], state: Float[Array, " 8"]) -> Accelerations:
    """Lagrange's equations, by automatic differentiation of the energies, with a multiplier for the contact.

    d/dt dT/dq' - dT/dq + dU/dq = N (d gap/dq + f . dv/dq' + tau . dw/dq'), gap'' = 0: six equations, linear in q'' and in N.

    **Arguments:**

    - `scene`: a `Scene` on a `Plane` or a `Cylinder`, with any friction.
    - `state`: (8,), as in the module's docstring.

    **Returns:** `Accelerations`.
    """
    q, q_dot = spread(state)

    def lagrangian(place):
        return 0.5 * q_dot @ metric(scene, place) @ q_dot - potential(scene, place)

    mass, swell = jax.jvp(lambda place: metric(scene, place), (q,), (q_dot,))
    system = jnp.concatenate([mass[:, :5], -per_normal_force(scene, q, q_dot)[:, None]], axis=1)
    solution = jnp.linalg.solve(system, jax.grad(lagrangian)(q) - swell @ q_dot)
    return Accelerations(solution[:5], solution[5])


def equations(scene: Scene[Top], state: Float[Array, " 8"]) -> tuple[Float[Array, "6 6"], Float[Array, " 6"]]:
    """The paper's (11), corrected, with (12) among its rows: A (eta'', y'', theta'', phi'', psi'', N) = b.

    The first three rows are the momentum of the centre of mass along t1, t2 and n, of which the third is (12); the
    others are the angular momentum about the centre of mass along e1, e2 and e:

        m s'' = N (f1, f2, 1) - m g z,   s'' = O'' - a e''
        I1 p' + I3 omega3 q - I1 q sigma = N M.e1,   I1 q' + I1 p sigma - I3 omega3 p = N M.e2,   I3 omega3' = N M.e

    with M = r x (f1, f2, 1) + tau, r = a e - R n, p = -(phi' sin(theta) + eta' cos(theta) sin(phi)),
    q = theta' - eta' cos(phi), sigma = phi' cos(theta) - eta' sin(theta) sin(phi), omega3 = psi' + sigma.

    **Arguments:** as for `by_lagrange`.

    **Returns:** A (6, 6) and b (6,).
    """
    body = scene.body
    metric, angle_metric = across(scene)
    q, q_dot = spread(state)
    eta, theta, phi, eta_dot, _, theta_dot, phi_dot, psi_dot = state
    turning = angle_metric * eta_dot
    s, c, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    e1, e2, e = axes(theta, phi)
    zero, unit = jnp.zeros_like(s), jnp.ones_like(s)

    # e'' = turns eta'' (-e3, 0, e1) + theta'' e1 + phi'' sin(theta) e2 + bend: the frame turns at -eta' t2.
    components = theta_dot * e1 + phi_dot * s * e2
    lean = jnp.stack([cp, sp, zero])
    bend = -(theta_dot**2) * e + 2.0 * c * theta_dot * phi_dot * e2 - phi_dot**2 * s * lean
    bend += 2.0 * turning * jnp.stack([-components[2], zero, components[0]])
    bend -= turning**2 * jnp.stack([e[0], zero, e[2]])
    swing = angle_metric * jnp.stack([-e[2], zero, e[0]])

    f, torque = friction_per_normal_force(scene, slip_velocity(scene, q, q_dot), angular_velocity(scene, q, q_dot))
    push = jnp.append(f, unit)
    moment = jnp.cross(body.offset * e - body.radius * jnp.stack([zero, zero, unit]), push) + torque

    p, q2 = -(phi_dot * s + turning * c * sp), theta_dot - turning * cp
    sigma = phi_dot * c - turning * s * sp
    spin = body.I3 * (psi_dot + sigma)
    # Parts of p', q' and omega3' without second rates.
    p_rest = -(phi_dot * theta_dot * c + turning * (c * cp * phi_dot - s * sp * theta_dot))
    q_rest = turning * sp * phi_dot
    spin_rest = -phi_dot * theta_dot * s - turning * (c * sp * theta_dot + s * cp * phi_dot)

    centripetal = metric * angle_metric * eta_dot**2 * jnp.stack([zero, zero, unit])
    vertical = jnp.stack([angle_metric * jnp.sin(eta), zero, jnp.cos(angle_metric * eta)])
    m, a = body.mass, body.offset
    momentum = jnp.stack(
        [
            m * (metric * jnp.stack([unit, zero, zero]) - a * swing),
            m * jnp.stack([zero, unit, zero]),
            -m * a * e1,
            -m * a * s * e2,
            jnp.zeros(3, q.dtype),
            -push,
        ],
        axis=1,
    )
    row1 = jnp.stack([-body.I1 * angle_metric * c * sp, zero, zero, -body.I1 * s, zero, -(moment @ e1)])
    row2 = jnp.stack([-body.I1 * angle_metric * cp, zero, body.I1, zero, zero, -(moment @ e2)])
    row3 = jnp.stack([-body.I3 * angle_metric * s * sp, zero, zero, body.I3 * c, body.I3, -(moment @ e)])
    matrix = jnp.concatenate([momentum, jnp.stack([row1, row2, row3])])
    right = jnp.concatenate(
        [
            -m * (centripetal - a * bend + scene.gravity * vertical),
            -jnp.stack(
                [
                    body.I1 * p_rest + spin * q2 - body.I1 * q2 * sigma,
                    body.I1 * q_rest + body.I1 * p * sigma - spin * p,
                    body.I3 * spin_rest,
                ]
            ),
        ]
    )
    return matrix, right


@eqx.filter_jit
def by_equation_11(scene: Scene[Top], state: Float[Array, " 8"]) -> Accelerations:
    """Solution of `equations`: the paper's (11) and (12), corrected; arguments and result as for `by_lagrange`."""
    solution = jnp.linalg.solve(*equations(scene, state))
    return Accelerations(solution[:5], solution[5])


def normal_force(scene: Scene[Top], state: Float[Array, " 8"], second_rates: Float[Array, " 5"]) -> Float[Array, ""]:
    """The paper's (12), corrected: the normal force [N] for a motion.

    N/m = g cos(eta) + rho eta'^2 + a (theta'' sin(theta) + theta'^2 cos(theta)) + a eta'^2 cos(theta)
    - 2 a eta' e_t' - a eta'' e_t, with e_t = sin(theta) cos(phi); on the plane the terms in eta are absent.

    **Arguments:**

    - `state`: (8,), as in the module's docstring.
    - `second_rates`: (5,) as in `Accelerations`.
    """
    metric, angle_metric = across(scene)
    eta, theta, phi, eta_dot, _, theta_dot, phi_dot, _ = state
    turning = angle_metric * eta_dot
    s, c, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    e_t_dot = c * cp * theta_dot - s * sp * phi_dot
    axis = second_rates[2] * s + theta_dot**2 * c + turning**2 * c
    axis = axis - angle_metric * second_rates[0] * s * cp - 2.0 * turning * e_t_dot
    pull = scene.gravity * jnp.cos(angle_metric * eta) + metric * turning**2
    return scene.body.mass * (pull + scene.body.offset * axis)


def state_rate(accelerations: Accelerations, state: Float[Array, " 8"]) -> Float[Array, " 8"]:
    """Rate of change of the state, given its accelerations."""
    return jnp.concatenate([state[3:4], state[5:7], accelerations.second_rates])
