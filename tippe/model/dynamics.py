"""The equations of motion of the tippe top, in vector form and free of trigonometry (`tippe.md`, section 2).

The state is that of `state.py`: velocity, axis and angular momentum in the arena's moving frame (t1, t2, n), and the place.
The velocity along n follows from the axis, because the contact persists. Cyclic coordinates (position, spin angle) are not
part of it.
"""

import dataclasses
from typing import Self

from jaxtyping import Array, Bool, Float

from nonholonomic.compilation.xla_cpu import stored, stored_with_tangents
from nonholonomic.geometry import (
    AbstractFrame,
    Vector,
    add,
    cross,
    dot,
    multiply,
    rate_in_frame,
    scale,
    subtract,
    sum_vectors,
)

from .body import AbstractBody, AbstractMeridian
from .contact_dynamics import AbstractContactDynamics, Motion
from .contact_load import Slip
from .friction import AbstractFriction
from .state import parts

#: The cosine of no angle, for runs without a target angle.
NO_COSINE = -2.0

#: Rate of a frame that turns with an inverting top, as a fraction of L_n / I1 (`Dynamics.turning`). Among 0.5, 0.7,
#: 0.85 and 1, this is the fastest at equal error, or close to it, in five scenes on the plane: 1 to 2.6 times as fast
#: as a frame at rest.
TURNING = 0.7


class Dynamics(AbstractContactDynamics):
    """A scene, with precomputed combinations of its numbers that every evaluation needs.

    `turns` is the additional rate of the frame about n, as a fraction of L_n / I1; `None` if there is none.
    """

    frame: AbstractFrame
    friction: AbstractFriction
    meridian: AbstractMeridian
    mass: Float[Array, "..."]
    gravity: Float[Array, "..."]
    per_mass: Float[Array, "..."]
    per_transverse: Float[Array, "..."]
    axial_excess: Float[Array, "..."]
    turns: Float[Array, "..."] | None = None

    @classmethod
    def of(
        cls, body: AbstractBody, frame: AbstractFrame, friction: AbstractFriction, gravity: Float[Array, "..."]
    ) -> "Dynamics":
        """The equations for a body on an arena.

        **Arguments:** `frame`: the frame of the body on the arena; the others as for `Scene`.
        """
        return cls(
            frame=frame,
            friction=friction,
            meridian=body.meridian,
            mass=body.mass,
            gravity=gravity,
            per_mass=1.0 / body.mass,
            per_transverse=1.0 / body.I1,
            axial_excess=1.0 / body.I3 - 1.0 / body.I1,
        )

    @property
    def weight(self) -> Float[Array, "..."]:
        return self.mass * self.gravity

    def turning(self, turns: Float[Array, "..."]) -> Self:
        """The same equations in a frame that turns about n, for an arena on which all directions across n are
        equivalent.

        While a top inverts, L has a nearly constant direction in a frame at rest, and the axis turns about L at the
        rate L / I1. In the turning frame, both turn at a fraction of this rate, so steps are longer. Errors are smaller
        because they no longer add up along a circle.
        """
        return dataclasses.replace(self, turns=turns)

    def unloaded(
        self, state: Float[Array, "components ..."], scales: Float[Array, "components ..."]
    ) -> Bool[Array, "..."] | None:
        """See `AbstractDynamics.unloaded`. On a level plane, N = 0 can last only for an instant."""
        return None if self.turns is not None else super().unloaded(state, scales)

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion, solving for the normal force with friction included.

        **Arguments:**

        - `state`: (8 + the arena's place, ...) as `state.py` describes it.

        **Returns:** a `Motion`; `rate` is (m/s^2, 1/s, N m, 1/s). Source: `tippe.md`, section 2 (i)-(iii); for other
        bodies on the plane, with the A and B of `body.py` in place of a and R, and with the second derivative of the
        height, H' c'' + H'' c'^2, in N.
        """
        (u1, u2), e, L, place = parts(state)
        a, R, coupling, growth = self.meridian.at(e[2])

        # The axis turns with the body. V is the velocity of the centre of a sphere that would touch the arena like the
        # body, and o the rate at which the frame turns. The frame moves with the point at the height `size` above the
        # contact, whose velocity is `path`.
        e_dot = stored_with_tangents(*scale(self.per_transverse, cross(L, e)))
        V = (u1 + a * e_dot[0], u2 + a * e_dot[1])
        changing = multiply(growth, e_dot[2])
        path = (add(V[0], multiply(changing, e[0])), add(V[1], multiply(changing, e[1])))
        o, up, place_rate, room = self.frame.frame_motion(place, path)

        spin_momentum = dot(L, e)
        along_axis = self.axial_excess * spin_momentum
        w1 = self.per_transverse * L[0] + along_axis * e[0]
        w2 = self.per_transverse * L[1] + along_axis * e[1]
        w3 = self.per_transverse * L[2] + along_axis * e[2] if self.friction.uses_spin else None
        slip_x, slip_y = stored(V[0] - R * w2, V[1] + R * w1)
        slip = Slip(slip_x, slip_y, (w1, w2, w3))
        friction = self.friction.per_normal_force(slip)
        f1, f2 = friction.force

        # Moment per unit normal force: of (f1, f2, 1) at the contact r = a e - R n, and of the torque at the contact.
        r1, r2, r3 = a * e[0], a * e[1], a * e[2] - R
        M1 = subtract(r2, multiply(r3, f2))
        M2 = subtract(multiply(r3, f1), r1)
        M3 = subtract(multiply(r1, f2), multiply(r2, f1))
        M1, M2, M3 = sum_vectors((M1, M2, M3), friction.torque)

        M1, M2, M3 = stored(M1, M2, M3)

        # n . acceleration of the centre = centripetal; N occurs on both sides through M.
        centripetal = dot(V, o)
        pull = add(multiply(self.gravity, up[2]), centripetal)
        load = self.mass * pull - coupling * (L[0] * e_dot[1] - L[1] * e_dot[0])
        load = subtract(load, multiply(self.mass, changing, e_dot[2]))
        painleve_factor = 1.0 + coupling * (M1 * e[1] - M2 * e[0])
        load, painleve_factor = stored_with_tangents(load, painleve_factor)
        N = load / painleve_factor

        thrust = N * self.per_mass
        u3 = multiply(-a, e_dot[2]) if o != (None, None) else None
        u1_dot = add(multiply(thrust, f1), multiply(-self.gravity, up[0]), multiply(o[0], u3))
        u2_dot = add(multiply(thrust, f2), multiply(-self.gravity, up[1]), multiply(o[1], u3))
        e_dot = sum_vectors(e_dot, rate_in_frame(e, o))
        L_dot = sum_vectors(scale(N, (M1, M2, M3)), rate_in_frame(L, o))
        if self.turns is not None:
            turn = self.turns * self.per_transverse * L[2]
            u1_dot, u2_dot = add(u1_dot, turn * u2), subtract(u2_dot, turn * u1)
            e_dot, L_dot = sum_vectors(e_dot, turned(e, turn)), sum_vectors(L_dot, turned(L, turn))
        rate = (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate)
        return Motion(rate, N, friction, slip, path, o, spin_momentum, painleve_factor, room)


def turned(vector: Vector, rate: Float[Array, "..."]) -> Vector:
    """Rate of the components of a fixed vector in a frame that turns about n at a given rate [rad/s]."""
    return rate * vector[1], -(rate * vector[0]), None
