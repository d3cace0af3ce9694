"""The misprinted formulas of the paper on the top in the cylinder, as printed; `tippe_audit.py` has the verdict on each.

"Modeling of Dynamics Object with Non-Holonomic Constraints Based on Maple in Cylinder Coordinate R x S^1 x SO(3)"; the module
`tippe/paper.py` has the numbers of this paper.
"""

import jax.numpy as jnp
from euler_angles import across
from jaxtyping import Array, Float

from tippe import Launch, Scene, Top
from tippe.paper import BETA1, GRAM, PrintedTable, Row

#: beta1 of Tables 2 and 3 with the unit of the table's header [kg m^2/s].
BETA1_AS_PRINTED = 2500.0 * GRAM


def launch(table: PrintedTable, row: Row, body: Top) -> Launch:
    """The launch of a row, with the spin from beta1 = I3 omega3 at t = 0 and everything else at rest."""
    return Launch(row.theta, BETA1 / body.I3, eta=table.eta)


# Formulas as printed


def rotation_generators(place: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The last lines of (3)-(5) as printed: fields about x, y, z in the coordinates (r, eta, y), a column each.

    They are the rotations y d/dz - z d/dy and so on for x = r sin(eta), z = r cos(eta). Only the second is tangent to
    the cylinder.
    """
    r, eta, y = place
    s, c = jnp.sin(eta), jnp.cos(eta)
    zero, unit = jnp.zeros_like(s), jnp.ones_like(s)
    about_x = jnp.stack([y * c, -y / r * s, -r * c])
    about_y = jnp.stack([zero, unit, zero])
    about_z = jnp.stack([-y * s, -y / r * c, r * s])
    return jnp.stack([about_x, about_y, about_z], axis=1)


def printed_jellett(
    scene: Scene[Top], theta: Float[Array, ""], omega3: Float[Array, ""], eta_dot: Float[Array, ""]
) -> Float[Array, ""]:
    """(1) as printed: C n (R cos(theta) + A eta' R sin(theta)^2), with n the spin omega3, C = I3 and A = I1."""
    body = scene.body
    return body.I3 * omega3 * (body.radius * jnp.cos(theta) + body.I1 * eta_dot * body.radius * jnp.sin(theta) ** 2)


def printed_kinetic_energy(
    scene: Scene[Top],
    theta: Float[Array, ""],
    theta_dot: Float[Array, ""],
    phi_dot: Float[Array, ""],
    beta1: Float[Array, ""],
) -> Float[Array, ""]:
    """(9) as printed: (I theta'^2 + I sin(theta)^2 phi'^2 + beta1^2 / I3) / 2 [J]."""
    body = scene.body
    return 0.5 * (body.I1 * (theta_dot**2 + (jnp.sin(theta) * phi_dot) ** 2) + beta1**2 / body.I3)


def printed_normal_force(scene: Scene[Top], state: Float[Array, " 8"], theta_2: Float[Array, ""]) -> Float[Array, ""]:
    """(12) as printed, last expression: m (g cos(eta) + a (theta'' sin(theta) + theta'^2 cos(theta)) + r eta'^2) [N].

    **Arguments:**

    - `state`: (8,) as in `tests/witnesses/euler_angles.py`; r is taken as rho, the better of its two readings.
    - `theta_2`: theta'' [rad/s^2].
    """
    metric, turns = across(scene)
    eta, theta, _, eta_dot, _, theta_dot, _, _ = state
    swing = theta_2 * jnp.sin(theta) + theta_dot**2 * jnp.cos(theta)
    pull = scene.gravity * jnp.cos(turns * eta) + metric * (turns * eta_dot) ** 2
    return scene.body.mass * (pull + scene.body.offset * swing)
