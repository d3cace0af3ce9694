"""Poincare's equations for the tippe top: the paper's (2) corrected, and the top as data for the general formulations.

The frame of the configuration space has the cyclic field X_1 = d/dpsi, and the fields d/dtheta, (d/dphi - cos(theta)
d/dpsi) / sin(theta), d/deta, d/dy and d/dgap. All commute with X_1; the bracket of the first two has X_1 as a
component, through which beta1 enters the equations.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from euler_angles import Accelerations, metric, per_normal_force, potential, slip_velocity, spread
from jaxtyping import Array, Float
from other_formulations import structure_constants

from nonholonomic.systems.mechanics import AbstractSystem
from tippe.model.body import Top
from tippe.model.scene import Scene

#: Index of the cyclic angle psi among (eta, y, theta, phi, psi, gap).
PSI = 4


def nodal_frame(q: Float[Array, " n"]) -> Float[Array, "n n"]:
    """The frame of the module as columns, in the order of the coordinates (eta, y, theta, phi, psi, ...).

    The field in the place of phi is (d/dphi - cos(theta) d/dpsi) / sin(theta).
    """
    s, c = jnp.sin(q[2]), jnp.cos(q[2])
    return jnp.eye(q.size, dtype=q.dtype).at[3, 3].set(1.0 / s).at[PSI, 3].set(-c / s)


@eqx.filter_jit
def by_equation_2(scene: Scene[Top], state: Float[Array, " 8"]) -> Accelerations:
    """The paper's (2) with its indices right and with friction: Poincare's equations after Routh's reduction.

    d/dt dR/dv^rho - c^l_mu,rho v^mu dR/dv^l - c^1_mu,rho v^mu beta1 - X_rho R = Q_rho, R = L - beta1 v^1,
    beta1' = Q_1, with [X_mu, X_rho] = c^l_mu,rho X_l. The printed form has c^l instead of c^1 and omits the forces Q;
    with friction, beta1 is then not constant (`tippe.md`, section 1).

    **Arguments:**

    - `scene`: a `Scene` on a `Plane` or a `Cylinder`, with any friction.
    - `state`: (8,) as in `euler_angles.py`.

    **Returns:** `Accelerations`.
    """
    q, q_dot = spread(state)
    frame = nodal_frame(q)
    v = jnp.linalg.solve(frame, q_dot)
    indices = np.delete(np.arange(6), PSI)
    velocities = v[indices]

    def parts(place):
        # R = rest.A rest / 2 + beta1 b.rest - beta1^2 / (2 g_11) - U, where g is the metric in the frame.
        fields = nodal_frame(place)
        g = fields.T @ metric(scene, place) @ fields
        b = g[PSI, indices] / g[PSI, PSI]
        return g[np.ix_(indices, indices)] - g[PSI, PSI] * jnp.outer(b, b), b, g[PSI, PSI]

    A, b, axial = parts(q)
    beta = axial * (v[PSI] + b @ velocities)

    def routhian(place):
        A, b, axial = parts(place)
        kinetic = 0.5 * velocities @ A @ velocities + beta * (b @ velocities) - 0.5 * beta**2 / axial
        return kinetic - potential(scene, place)

    def momenta(place):
        A, b, _ = parts(place)
        return A @ velocities + beta * b

    p = momenta(q)
    _, drift = jax.jvp(momenta, (q,), (q_dot,))
    c = structure_constants(nodal_frame, q)
    gyroscopic = (
        jnp.einsum("lmr,m,l->r", c[np.ix_(indices, np.arange(6), indices)], v, p) + beta * v @ c[PSI][:, indices]
    )
    gradient = frame[:, indices].T @ jax.grad(routhian)(q)

    # With the generalised forces Q = N contact, the equations are linear in the four remaining v', and in N.
    contact = frame.T @ per_normal_force(scene, q, q_dot)
    column = contact[PSI] * b - contact[indices]
    system = jnp.concatenate([A[:, :4], column[:, None]], axis=1)
    solution = jnp.linalg.solve(system, gyroscopic + gradient - drift)
    rest_dot, N = jnp.append(solution[:4], 0.0), solution[4]

    def velocity(place, velocities, beta):
        _, b, axial = parts(place)
        return nodal_frame(place) @ jnp.insert(velocities, PSI, beta / axial - b @ velocities)

    _, second_rates = jax.jvp(velocity, (q, velocities, beta), (q_dot, rest_dot, N * contact[PSI]))
    return Accelerations(second_rates[:5], N)


class TopSystem(AbstractSystem):
    """The top in contact, as data for the general formulations: coordinates (eta, y, theta, phi, psi).

    **Arguments:**

    - `scene`: a `Scene` on a `Plane` or a `Cylinder`. Its friction is not used, because friction needs the normal
      force.
    - `rolling`: whether the contact point is at rest, the only case in which the top is nonholonomic.
    """

    scene: Scene[Top]
    rolling: bool = eqx.field(static=True, default=False)

    @property
    def dimension(self) -> int:
        return 5

    def metric(self, q: Float[Array, " 5"]) -> Float[Array, "5 5"]:
        return metric(self.scene, jnp.append(q, 0.0))[:5, :5]

    def potential(self, q: Float[Array, " 5"]) -> Float[Array, ""]:
        return potential(self.scene, jnp.append(q, 0.0))

    def constraints(self, q: Float[Array, " 5"]) -> Float[Array, "k 5"]:
        if not self.rolling:
            return jnp.zeros((0, 5), q.dtype)
        full_place = jnp.append(q, 0.0)
        return jax.jacfwd(lambda rate: slip_velocity(self.scene, full_place, jnp.append(rate, 0.0)))(jnp.zeros_like(q))

    def frame(self, q: Float[Array, " 5"]) -> Float[Array, "5 5"]:
        """The nodal frame; when rolling, the first three fields move the centre so that the slip vanishes."""
        frame = nodal_frame(q)
        if not self.rolling:
            return frame
        slip = self.constraints(q)
        turning = frame[:, 2:]
        carried = turning.at[:2].add(-jnp.linalg.solve(slip[:, :2], slip @ turning))
        return jnp.concatenate([carried, frame[:, :2]], axis=1)


def from_angles(state: Float[Array, " 8"]) -> tuple[Float[Array, " 5"], Float[Array, " 5"]]:
    """Coordinates and rates of `TopSystem` for a state of `euler_angles.py`; the cyclic coordinates are set to 0."""
    q, q_dot = spread(state)
    return q[:5], q_dot[:5]
