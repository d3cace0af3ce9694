"""Leaning: the top slides on its sphere and on its stem at once.

Both spheres touch the plane at one angle theta only, so the axis turns about the normal at some rate W, e' = W n x e,
and the centre of mass stays at its height h = R_j - a_j c, c = cos theta. With L = A e + I1 W n and the momenta p = L.n
and b = L.e,

    A = (b - c p) / (1 - c^2),   I1 W = p - c A,   w = s e + W n,   s = A / I1 + (1 / I3 - 1 / I1) b,

and the slip of sphere j is v_j = u + (s R_j + W a_j) n x e. With the friction f_j per unit normal force, each from its
own slip, the vertical force on the centre of mass and the torque that raises the axis vanish if

    N_0 + N_1 = m g,   N_0 m_0 + N_1 m_1 = -A W (1 - c^2),   m_j = a_j (1 - c^2) + h f_j.e - tau_j.(n x e),

with tau_j the torque per unit normal force of a law that has one. Then m u' = N_0 f_0 + N_1 f_1, and with
t_j = f_j.(n x e) the momenta change by p' = sum N_j (a_j t_j + tau_j.n) and b' = sum N_j (R_j t_j + tau_j.e).

The slips differ only across the direction of leaning. So m_1 - m_0 is (a_1 - a_0) (1 - c^2) without friction and with
viscous friction; Coulomb's law can make it vanish if mu h is more than (a_1 - a_0) sin theta. One of the two normal
forces vanishes before that.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.geometry import Component, add, cross, dot, multiply, scale, subtract, sum_vectors

from ..model.contact_dynamics import AbstractDynamics
from ..model.contact_load import Slip
from ..model.friction import AbstractFriction
from ..model.scene import Scene
from ..model.state import angular_velocity, parts
from ..model.top import Top
from .free_body import FreeBody, axis_rate, balls, contact_state, gap_rate
from .impact import approach

#: The number of this contact mode, next to those of the spheres, 0 and 1.
BOTH = 2

#: A contact ends when its normal force is below minus this fraction of the weight. A top that begins to roll on its
#: sphere presses its stem less and less, but never lifts it; without this margin, errors of a nearly zero force would
#: determine the step lengths. Ending the contact late changes velocities by the square of this value: ten times or a
#: tenth of it changes an inversion time by 4e-16.
HOLDS = 1e-8

#: Where m_1 - m_0 is less than this fraction of its value without friction, rigid-body mechanics does not determine the
#: motion. Used for a status only.
INDEFINITE = 1e-6


class LeaningMotion(NamedTuple):
    """The equations of motion evaluated at one state: the rate of the state of `tippe/model/dynamics.py`, and both
    normal forces [N].

    `friction_power` [W] is that of both contacts, `None` without friction; `definiteness` is m_1 - m_0 as a fraction of
    its value without friction.
    """

    rate: tuple[Component, ...]
    normal_forces: tuple[Float[Array, "..."], Float[Array, "..."]]
    friction_power: Component
    spin_momentum: Float[Array, "..."]
    definiteness: Float[Array, "..."]


class LeaningDynamics(AbstractDynamics):
    """The equations of motion of a top with a stem while both of its spheres touch the plane.

    The state has the layout of `tippe/model/dynamics.py`. Its cos theta is constant to the bit; the part of L along
    n x e, which would change theta and is round-off, is integrated but not used.
    """

    body: Top
    friction: AbstractFriction
    gravity: Float[Array, "..."]

    @classmethod
    def of(cls, scene: Scene[Top]) -> "LeaningDynamics":
        """The equations for the top of a scene."""
        return cls(scene.body, scene.friction, scene.gravity)

    def motion(self, state: Float[Array, "components ..."]) -> LeaningMotion:
        """Evaluate the equations of motion.

        **Arguments:**

        - `state`: (8, ...), with the axis at the angle at which both spheres touch.

        **Returns:** a `LeaningMotion`; `rate` is (m/s^2, 1/s, N m).
        """
        spheres, m, I1, I3 = balls(self.body), self.body.mass, self.body.I1, self.body.I3
        u, e, L, _ = parts(state)
        c, p, b = e[2], L[2], dot(e, L)
        perpendicular = (-e[1], e[0])
        sine2 = dot(perpendicular, perpendicular)
        axial_rate = (b - c * p) / sine2
        precession = (p - c * axial_rate) / I1
        rolling = axial_rate / I1 + (1.0 / I3 - 1.0 / I1) * b

        w = (rolling * e[0], rolling * e[1], rolling * c + precession if self.friction.uses_spin else None)
        velocities = [sum_vectors(u, scale(rolling * R + precession * a, perpendicular)) for a, R in spheres]
        slips = [Slip(x, y, w) for x, y in velocities]
        loads = [self.friction.per_normal_force(slip) for slip in slips]
        height = spheres[0].radius - spheres[0].offset * c
        m_0, m_1 = (
            subtract(
                add(ball.offset * sine2, multiply(height, dot(load.force, e[:2]))), dot(perpendicular, load.torque[:2])
            )
            for ball, load in zip(spheres, loads, strict=True)
        )
        weight = m * self.gravity
        N_1 = -(axial_rate * precession * sine2 + weight * m_0) / (m_1 - m_0)
        normal = (weight - N_1, N_1)

        u_dot = scale(1.0 / m, sum_vectors(*(scale(N, load.force) for N, load in zip(normal, loads, strict=True))))
        pulls = [dot(perpendicular, load.force) for load in loads]
        triples = list(zip(spheres, pulls, loads, strict=True))
        p_dot = dot(normal, tuple(add(multiply(ball.offset, t), load.torque[2]) for ball, t, load in triples))
        b_dot = dot(normal, tuple(add(multiply(ball.radius, t), dot(load.torque, e)) for ball, t, load in triples))
        # L turns with the axis, including its part across; so b changes by its own rate alone.
        growth = multiply(1.0 / sine2, subtract(b_dot, multiply(c, p_dot)))
        L_dot = sum_vectors(scale(growth, e[:2]), (-precession * L[1], precession * L[0]))
        rate = (*u_dot, *scale(precession, perpendicular), None, *L_dot, p_dot)
        power = dot(normal, tuple(load.power(slip) for load, slip in zip(loads, slips, strict=True)))
        stiff = (m_1 - m_0) / ((spheres[1].offset - spheres[0].offset) * sine2)
        return LeaningMotion(rate, normal, power, b, stiff)

    def margins(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], ...]:
        """Both normal forces as fractions of the weight, plus `HOLDS`."""
        weight = self.body.mass * self.gravity
        return tuple(force / weight + HOLDS for force in self.motion(state).normal_forces)

    def heavier(self, state: Float[Array, "components ..."]) -> Int[Array, "..."]:
        """The number of the sphere with the greater normal force: contact remains there when the other force vanishes."""
        N_0, N_1 = self.motion(state).normal_forces
        return (N_1 > N_0).astype(int)

    def stopped(self, free: FreeBody) -> tuple[FreeBody, Bool[Array, "..."]]:
        """The end of rocking: the total effect of all remaining impacts on a top whose spheres are both at the plane.

        The top rocks from sphere to sphere with decreasing amplitude, and infinitely many impacts take a finite time T.
        In addition to the impulses of leaning for T, sphere j gets the impulse P_j (f_j, 1), and P_j tau_j if the law
        has a torque. Together, these stop both speeds along the normal, g + G P = 0. During T, both slips change only
        by the order of the speeds g, so the error is of the order of their square.

        **Returns:** the body after these impulses, before `at_rest`; and whether their friction dissipates energy. One
        P_j is negative: during T, the load of this sphere is reduced. If the friction of this sphere adds energy now,
        it dissipates energy after the impact of the other sphere (det G > 0).
        """
        spheres, zero = balls(self.body), jnp.zeros_like(free.height)
        w1, w2, w3 = angular_velocity(self.body, free.axis, free.momentum)
        forces, torques, gains = [], [], []
        for ball in spheres:
            contact = approach(self.body, ball, free)
            slip = Slip(*contact.velocity[:2], (w1, w2, w3 if self.friction.uses_spin else None))
            load = self.friction.per_normal_force(slip)
            forces.append(tuple(zero if part is None else part for part in (*load.force, 1.0 + zero)))
            torques.append(sum_vectors(cross(contact.arm, forces[-1]), load.torque))
            gains.append(zero if (power := load.power(slip)) is None else power)
        speeds = [gap_rate(self.body, ball, free) for ball in spheres]
        rates = [axis_rate(self.body, free.axis, turn)[2] for turn in torques]
        (G_00, G_01), (G_10, G_11) = ([1.0 / self.body.mass + ball.offset * rate for rate in rates] for ball in spheres)
        determinant = G_00 * G_11 - G_01 * G_10
        per = 1.0 / jnp.where(determinant == 0.0, 1.0, determinant)
        impulses = (per * (G_01 * speeds[1] - G_11 * speeds[0]), per * (G_10 * speeds[0] - G_00 * speeds[1]))
        total = sum_vectors(*(scale(P, force) for P, force in zip(impulses, forces, strict=True)))
        velocity = sum_vectors(free.velocity, scale(1.0 / self.body.mass, total))
        momentum = sum_vectors(free.momentum, *(scale(P, turn) for P, turn in zip(impulses, torques, strict=True)))
        return FreeBody(velocity, free.height, free.axis, momentum), dot(impulses, tuple(gains)) <= 0.0

    def settled(self, free: FreeBody) -> tuple[FreeBody, Int[Array, "..."], Bool[Array, "..."]]:
        """The contacts of a top whose spheres are both at rest at the plane. The normal forces must not be negative,
        and the force on a sphere that leaves the plane is zero. If m_1 - m_0 is positive, there is a single solution:
        the top stands on both spheres if this takes two positive forces, otherwise on the sphere with the positive
        force.

        **Returns:** the body, exactly at rest along the normal (`at_rest`); `BOTH`, or the number of the sphere on
        which it stands; and whether this is the only solution.
        """
        free = at_rest(self.body, free)
        state = contact_state(free)
        number = jnp.where(self.contact_margin(state) > 0.0, BOTH, self.heavier(state))
        return free, number, self.motion(state).definiteness > INDEFINITE


def at_rest(body: Top, free: FreeBody) -> FreeBody:
    """A body whose spheres are both at the plane, with its remaining speeds along the normal removed.

    theta becomes the angle at which both spheres touch. L loses its component along n x e, the only one that changes
    theta; impulses along the normal at both spheres would have this effect. L.n, L.e, Jellett's quantity of either
    sphere and the slip do not change; the energy decreases by the energy of the removed motion.
    """
    main, stem = balls(body)
    e, L = free.axis, free.momentum
    c = jnp.broadcast_to((stem.radius - main.radius) / (stem.offset - main.offset), e[2].shape)
    square = e[0] ** 2 + e[1] ** 2
    # The length of e is unchanged.
    factor = jnp.sqrt((square + e[2] ** 2 - c**2) / square)
    perpendicular = (-e[1], e[0])
    L = (*sum_vectors(L[:2], scale(-dot(perpendicular, L[:2]) / square, perpendicular)), L[2])
    velocity = (free.velocity[0], free.velocity[1], jnp.zeros_like(c))
    return FreeBody(velocity, main.radius - main.offset * c, (*scale(factor, e[:2]), c), L)
