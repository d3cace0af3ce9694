"""Two tops on the plane that can be solved by a quadrature: without friction, and rolling without slip.

In both, energy and two further constants leave one degree of freedom, z = cos(theta), with
mu(z) z'^2 / 2 = f(z) (`tippe.md`, section 5 c and d): z swings between two neighbouring zeros of f. Written with
z = (z1 + z2) / 2 - (z2 - z1) / 2 cos(chi), f = (z - z1) (z2 - z) P(z) with P > 0, and time is a smooth periodic
integral,

    t(chi) = integral of sqrt(mu(z) / (2 P(z))) dchi,

which a few cosines represent to rounding error. P is minus the second divided difference of f, computed from f'' by
Hermite and Genocchi's formula, so that nothing cancels where the swing is narrow or near its ends.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration.dense import halved
from tippe.model.body import Top
from tippe.model.dynamics import AXIS, MOMENTUM, VELOCITY
from tippe.model.scene import Scene

#: Gauss points for the divided difference along each direction, and cosines for the time as a function of chi.
POINTS, COSINES = 24, 96
#: First step of z in the search for a turning point: well above the noise of f, well below the width of a swing.
FIRST_STEP = 1e-6


class AbstractNutation(eqx.Module):
    """A top with one degree of freedom left, mu(z) z'^2 / 2 = f(z) with z = cos(theta)."""

    @abc.abstractmethod
    def inertia(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """The factor mu(z) [kg m^2]."""

    @abc.abstractmethod
    def drive(self, z: Float[Array, ""]) -> Float[Array, ""]:
        """f(z) = sin(theta)^2 times the energy available for nutation [J], analytic on [-1, 1]."""


class FrictionlessNutation(AbstractNutation):
    """The frictionless top: energy, beta1 = p_psi and p_phi are constant, and so is the horizontal velocity.

    f = (1 - z^2) (E - beta1^2 / (2 I3) - m g (R - a z)) - (p_phi - beta1 z)^2 / (2 I1), mu = I1 + m a^2 (1 - z^2),
    where E is the energy without that of the horizontal motion of the centre of mass.

    **Arguments:**

    - `scene`: a `Scene` on the plane; its friction is not used.
    - `energy`: E [J].
    - `precession_momentum`, `spin_momentum`: p_phi = L.z and beta1 = L.e [kg m^2/s].
    """

    scene: Scene[Top]
    energy: Float[Array, ""]
    precession_momentum: Float[Array, ""]
    spin_momentum: Float[Array, ""]

    @classmethod
    def of(cls, scene: Scene[Top], state: Float[Array, " 8"]) -> "FrictionlessNutation":
        """The nutation that starts at a state of the vector form."""
        drift = 0.5 * scene.body.mass * jnp.sum(state[VELOCITY] ** 2)
        return cls(scene, scene.energy(state) - drift, state[MOMENTUM][2], state[AXIS] @ state[MOMENTUM])

    def inertia(self, z: Float[Array, ""]) -> Float[Array, ""]:
        body = self.scene.body
        return body.I1 + body.mass * body.offset**2 * (1.0 - z * z)

    def drive(self, z: Float[Array, ""]) -> Float[Array, ""]:
        body = self.scene.body
        weight = body.mass * self.scene.gravity
        left = self.energy - self.spin_momentum**2 / (2.0 * body.I3) - weight * (body.radius - body.offset * z)
        return (1.0 - z * z) * left - (self.precession_momentum - self.spin_momentum * z) ** 2 / (2.0 * body.I1)


class RollingNutation(AbstractNutation):
    """The top that rolls on the plane without slip: energy, Jellett's constant and Routh's are constant.

    Routh's D = I3 omega3 sqrt(gamma + sigma (alpha - z)^2 + sigma gamma (1 - z^2)), gamma = I1 / I3,
    sigma = m R^2 / I3, gives omega3; b = I1 phi' sin(theta)^2 = (lambda - (R z - a) I3 omega3) / R then follows;
    f = (1 - z^2) (E - I3 omega3^2 / 2 - m g (R - a z)) - b^2 / (2 I1)
    - m ((a - R z) b / I1 + R omega3 (1 - z^2))^2 / 2 and mu = I1 + m (a^2 - 2 a R z + R^2).

    **Arguments:**

    - `scene`: a `Scene` on the plane; its friction is not used.
    - `energy`: E [J].
    - `jellett`: lambda [kg m^3/s].
    - `routh`: D [kg m^2/s].
    """

    scene: Scene[Top]
    energy: Float[Array, ""]
    jellett: Float[Array, ""]
    routh: Float[Array, ""]

    @classmethod
    def of(cls, scene: Scene[Top], axis: Float[Array, " 3"], angular_velocity: Float[Array, " 3"]) -> "RollingNutation":
        """The nutation that starts at a state of `rolling_rate`."""
        body = scene.body
        w, z = angular_velocity, axis[2]
        contact = body.offset * axis - body.radius * jnp.array([0.0, 0.0, 1.0])
        velocity = jnp.cross(contact, w)
        spin = w @ axis
        momentum = body.I1 * w + (body.I3 - body.I1) * spin * axis
        height = body.radius - body.offset * z
        energy = 0.5 * (body.mass * velocity @ velocity + w @ momentum) + body.mass * scene.gravity * height
        return cls(scene, energy, -momentum @ contact, body.I3 * spin * jnp.sqrt(routh_factor(scene, z)))

    def inertia(self, z: Float[Array, ""]) -> Float[Array, ""]:
        body = self.scene.body
        return body.I1 + body.mass * (body.offset**2 - 2.0 * body.offset * body.radius * z + body.radius**2)

    def drive(self, z: Float[Array, ""]) -> Float[Array, ""]:
        body = self.scene.body
        R, a = body.radius, body.offset
        omega = self.routh / (body.I3 * jnp.sqrt(routh_factor(self.scene, z)))
        b = (self.jellett - (R * z - a) * body.I3 * omega) / R
        left = self.energy - 0.5 * body.I3 * omega**2 - body.mass * self.scene.gravity * (R - a * z)
        sideways = (a - R * z) * b / body.I1 + R * omega * (1.0 - z * z)
        return (1.0 - z * z) * left - b**2 / (2.0 * body.I1) - 0.5 * body.mass * sideways**2


def routh_factor(scene: Scene[Top], z: Float[Array, ""]) -> Float[Array, ""]:
    """(D / (I3 omega3))^2 = gamma + sigma (alpha - z)^2 + sigma gamma (1 - z^2) at z = cos(theta)."""
    body = scene.body
    gamma, sigma, alpha = body.I1 / body.I3, body.mass * body.radius**2 / body.I3, body.offset / body.radius
    return gamma + sigma * (alpha - z) ** 2 + sigma * gamma * (1.0 - z * z)


@eqx.filter_jit
def rolling_rate(scene: Scene[Top], state: Float[Array, " 6"]) -> Float[Array, " 6"]:
    """Rate of the top that rolls on the plane without slip (`tippe.md`, section 5 d).

    (J + m (r^2 - r r^T)) w' = -w x L + m r x (r' x w) + m g r x z, e' = w x e, with r = a e - R z and r' = a e'.

    **Arguments:**

    - `scene`: a `Scene` on the plane; its friction is not used.
    - `state`: axis e [1] and angular velocity w [rad/s], (6,).

    **Returns:** their rates, (6,).
    """
    body = scene.body
    e, w = state[:3], state[3:]
    up = jnp.array([0.0, 0.0, 1.0])
    r = body.offset * e - body.radius * up
    inertia = body.I1 * jnp.eye(3) + (body.I3 - body.I1) * jnp.outer(e, e)
    e_dot = jnp.cross(w, e)
    # J changes with e; its rate is already contained in w x L, which is taken in the turning body.
    torque = -jnp.cross(w, inertia @ w) + body.mass * jnp.cross(r, jnp.cross(body.offset * e_dot, w))
    torque = torque + body.mass * scene.gravity * jnp.cross(r, up)
    full_inertia = inertia + body.mass * (r @ r * jnp.eye(3) - jnp.outer(r, r))
    return jnp.concatenate([e_dot, jnp.linalg.solve(full_inertia, torque)])


class Swing(eqx.Module):
    """The motion theta(t) of a nutation, exact to rounding error; created by `swing`.

    - `middle`, `half`: middle and half width of the swing of z = cos(theta).
    - `cosines`: coefficients [s] of dt/dchi = c0 + c1 cos(chi) + ...
    - `phase`: chi [rad] at t = 0.
    """

    middle: Float[Array, ""]
    half: Float[Array, ""]
    cosines: Float[Array, " k"]
    phase: Float[Array, ""]

    @property
    def period(self) -> Float[Array, ""]:
        """Period of theta [s]."""
        return 2.0 * math.pi * self.cosines[0]

    @property
    def range(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Smallest and largest theta [rad]."""
        return jnp.arccos(self.middle + self.half), jnp.arccos(self.middle - self.half)

    def pace(self, chi: Float[Array, "..."]) -> Float[Array, "..."]:
        """dt/dchi [s]."""
        return jnp.cos(jnp.arange(self.cosines.size) * chi[..., None]) @ self.cosines

    def elapsed(self, chi: Float[Array, "..."]) -> Float[Array, "..."]:
        """Time [s] since chi = 0."""
        order = jnp.arange(1, self.cosines.size)
        return self.cosines[0] * chi + jnp.sin(order * chi[..., None]) @ (self.cosines[1:] / order)

    def theta(self, t: Float[Array, "..."]) -> Float[Array, "..."]:
        """Angle [rad] from the normal to the axis at the times [s]."""
        due_time = t + self.elapsed(self.phase)

        def newton(_, chi):
            return chi - (self.elapsed(chi) - due_time) / self.pace(chi)

        chi = jax.lax.fori_loop(0, 30, newton, due_time / self.cosines[0])
        return jnp.arccos(self.middle - self.half * jnp.cos(chi))


@eqx.filter_jit
def swing(nutation: AbstractNutation, z: Float[Array, ""], z_dot: Float[Array, ""]) -> Swing:
    """The nutation as a function of time.

    **Arguments:**

    - `nutation`: a `FrictionlessNutation` or `RollingNutation`.
    - `z`, `z_dot`: cos(theta) at t = 0 and its rate [1/s].

    **Returns:** a `Swing`.
    """
    low, high = turning_point(nutation, z, -1.0), turning_point(nutation, z, 1.0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)

    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    nodes, weights = 0.5 * (1.0 + nodes), 0.5 * weights
    curvature = jax.vmap(jax.grad(jax.grad(nutation.drive)))

    def pace(chi):
        point = middle - half * jnp.cos(chi)
        first = nodes[:, None]
        second = (1.0 - first) * nodes[None, :]
        where = point + first * (low - point) + second * (high - point)
        share = weights[:, None] * weights[None, :] * (1.0 - first)
        divided = jnp.sum(share * curvature(where.ravel()).reshape(where.shape))
        return jnp.sqrt(-0.5 * nutation.inertia(point) / divided)

    angles = (jnp.arange(COSINES) + 0.5) * (math.pi / COSINES)
    waves = jnp.cos(jnp.arange(COSINES)[:, None] * angles)
    cosines = (2.0 / COSINES) * waves @ jax.lax.map(pace, angles)
    motion = Swing(middle, half, cosines.at[0].divide(2.0), jnp.zeros_like(z))
    # Near a turning point, the rate determines the phase; z does not.
    rough = jnp.arccos(jnp.clip((middle - z) / half, -1.0, 1.0))
    phase = jnp.arctan2(z_dot * motion.pace(rough), middle - z)
    return eqx.tree_at(lambda s: s.phase, motion, phase)


def turning_point(nutation: AbstractNutation, z: Float[Array, ""], direction: float) -> Float[Array, ""]:
    """The zero of f next to z in the given direction (+1 or -1), or z itself if f decreases in that direction.

    The step doubles until f is negative, at the latest beyond a pole; then the bracket is bisected.
    """

    def ahead(step):
        return jnp.clip(z + direction * step, -1.0, 1.0)

    def double(bracket):
        return bracket[1], 2.0 * bracket[1]

    def positive(bracket):
        return (nutation.drive(ahead(bracket[1])) > 0.0) & (bracket[1] < 2.0)

    first = jnp.asarray(FIRST_STEP, dtype=z.dtype)
    bracket = jax.lax.while_loop(positive, double, (jnp.zeros_like(first), first))
    low, high = halved(lambda step: nutation.drive(ahead(step)) > 0.0, *bracket)
    return ahead(0.5 * (low + high))
