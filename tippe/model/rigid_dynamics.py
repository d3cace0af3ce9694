"""The equations of motion of a body of any shape and inertia on an arena, free of trigonometry and of coordinate
singularities.

The state is that of a top (`launch.py`) with an additional vector: in the arena's frame (t1, t2, n) the velocity (u1,
u2) of the centre of mass along the arena, the body's z axis e, the angular momentum L about the centre of mass, the
arena's place, and the body's x axis c. With d = e x c, the components of n in the body's axes are (c.n, d.n, e.n),
which determine the contact (`rigid_body.py`).

With r from the centre of mass to the contact, the laws of motion are L' = r x F + N tau and m u' = F - m g z; the contact
persists if the contact point has no velocity along n. The frame moves with the contact point, whose velocity along the arena
is q' = (1 - H S)^-1 (v - H (n x w)), with the slip velocity v, the shape operator S of the arena, and the operator H whose
eigenvalues are the body's principal radii of curvature; n' = -S q'. Source: Newton and Euler; for the contact, Montana, Int. J.
Robotics Research 7 (1988) 17; for rolling, Garcia and Hubbard, Proc. R. Soc. A 418 (1988) 165, and Kane and Levinson, Int. J.
Non-Linear Mechanics 17 (1982) 175.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.compilation.xla_cpu import stored
from nonholonomic.geometry import (
    AbstractFrame,
    Component,
    FrameMotion,
    Place,
    PlaneFrame,
    Tangent,
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

from .dynamics import AbstractContactDynamics, Motion
from .friction import AbstractFriction, ContactLoad, NoSlip, Slip, length
from .launch import AXIS, Launch, joined, parts
from .rigid_body import AbstractRigidBody, SymmetricMatrix


class Attitude(NamedTuple):
    """The attitude and rotation of a body, and its contact point.

    - `axes`: the body's axes x, y and z in the frame (t1, t2, n).
    - `normal`, `momentum`, `angular_velocity`: n, angular momentum and angular velocity in the body's axes.
    - `lever`: the vector r from the centre of mass to the contact [m] in the body's axes.
    - `fixed_rates`: rates of change of the components of n and of r if n is fixed, as on a plane.
    """

    axes: tuple[Vector, Vector, Vector]
    normal: Vector
    momentum: Vector
    angular_velocity: Vector
    lever: Vector
    fixed_rates: tuple[Vector, Vector]

    def in_frame(self, vector: Vector) -> Vector:
        """A vector in the frame, from its components in the body's axes."""
        x, y, z = (scale(part, axis) for part, axis in zip(vector, self.axes, strict=True))
        return sum_vectors(x, y, z)

    @property
    def axis_rates(self) -> tuple[Vector, Vector]:
        """Rates of change of the body's axes x and z, which turn with it."""
        (x, y, z), (w1, w2, w3) = self.axes, self.angular_velocity
        return tuple(w3 * b - w2 * c for b, c in zip(y, z, strict=True)), tuple(
            w2 * a - w1 * b for a, b in zip(x, y, strict=True)
        )

    def in_body(self, vector: Vector) -> Vector:
        """A vector in the body's axes, from its components in the frame."""
        return tuple(dot(vector, axis) for axis in self.axes)


class ContactMotion(NamedTuple):
    """The motion of the contact point.

    - `normal_rate`, `lever_rate`: rates of change of the components of n and of r in the body's axes.
    - `contact_velocity`: velocity of the contact point along the arena [m/s]; `frame`: motion of the frame.
    """

    normal_rate: Vector
    lever_rate: Vector
    contact_velocity: Tangent
    frame: FrameMotion


class AbstractRigidDynamics(AbstractContactDynamics):
    """A scene with a rigid body, with the precomputed combinations of its numbers; in place of `Dynamics`."""

    frame: eqx.AbstractVar[AbstractFrame]
    body: eqx.AbstractVar[AbstractRigidBody]
    gravity: eqx.AbstractVar[Float[Array, "..."]]
    inverse: eqx.AbstractVar[SymmetricMatrix]

    @property
    def mass(self) -> Float[Array, "..."]:
        """Mass of the body [kg]."""
        return self.body.mass

    @property
    def weight(self) -> Float[Array, "..."]:
        return self.body.mass * self.gravity

    @property
    def size(self) -> Float[Array, "..."]:
        """A length of the body [m]."""
        return self.body.size

    @abc.abstractmethod
    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion.

        **Arguments:** `state`: (11 + the arena's place, ...).

        **Returns:** a `Motion`, whose `spin_momentum` is the angular velocity about the body's z axis.
        """

    def attitude(self, state: Float[Array, "components ..."]) -> Attitude:
        """The attitude and rotation of the body, and its contact point."""
        _, e, L, place = parts(state)
        c = tuple(place[-3:])
        axes = (c, cross(e, c), e)
        n = tuple(axis[2] for axis in axes)
        momentum = tuple(dot(L, axis) for axis in axes)
        angular_velocity = stored(*self.inverse.times(momentum))
        normal_rate = cross(n, angular_velocity)
        lever, lever_rate = self.body.contact(n, normal_rate)
        return Attitude(axes, n, momentum, angular_velocity, lever, (normal_rate, lever_rate))

    def contact_motion(self, place: Place, attitude: Attitude, slip: Tangent) -> ContactMotion:
        """The motion of the contact point. **Arguments:** `place`: place of the frame; `slip`: velocity v along the
        arena [m/s]."""
        normal_rate, lever_rate = attitude.fixed_rates
        over_body = attitude.in_frame(lever_rate)
        contact_velocity = (add(slip[0], over_body[0]), add(slip[1], over_body[1]))
        if isinstance(self.frame, PlaneFrame):
            return ContactMotion(
                normal_rate, lever_rate, contact_velocity, self.frame.frame_motion(place, contact_velocity)
            )
        # If n turns along a tangent, the contact moves against it over the body, by H.
        tangents = [tuple(axis[k] for axis in attitude.axes) for k in (0, 1)]
        first, second = (attitude.in_frame(self.body.contact(attitude.normal, t)[1]) for t in tangents)
        H11, H12, H22, *contact_velocity = stored(-first[0], -first[1], -second[1], *contact_velocity)
        frame, path = self.frame.convex_motion(place, (contact_velocity[0], contact_velocity[1]), (H11, H12, H22))
        path = stored(*path)
        frame_part = attitude.in_body((subtract(None, frame.frame_rate[0]), subtract(None, frame.frame_rate[1]), None))
        lever_rate_in_body = attitude.in_body((subtract(path[0], slip[0]), subtract(path[1], slip[1]), None))
        return ContactMotion(sum_vectors(normal_rate, frame_part), lever_rate_in_body, path, frame)

    def angular_velocity(self, state: Float[Array, "components ..."]) -> Vector:
        """Angular velocity of the body in the frame [rad/s]."""
        attitude = self.attitude(state)
        return attitude.in_frame(attitude.angular_velocity)

    def mass_from_contact(self, state: Float[Array, "components ..."]) -> Vector:
        """Vector from the contact to the centre of mass [m], in the frame."""
        attitude = self.attitude(state)
        return scale(-1.0, attitude.in_frame(attitude.lever))

    def energy(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Kinetic energy plus weight times the height of the centre of mass [J]."""
        (u1, u2), _, _, place = parts(self.carried_along(state))
        attitude, place = self.attitude(state), place[:-3]
        vertical_speed = -dot(attitude.angular_velocity, cross(attitude.lever, attitude.normal))
        rotation = 0.5 * dot(attitude.angular_velocity, attitude.momentum)
        height = add(self.frame.height(place), dot(self.mass_from_contact(state), self.frame.vertical(place)))
        return self.body.mass * (0.5 * (u1**2 + u2**2 + vertical_speed**2) + self.gravity * height) + rotation

    def normal_spin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Angular velocity about the arena's normal [rad/s]."""
        attitude = self.attitude(state)
        return dot(attitude.angular_velocity, attitude.normal)

    def carried_rates(
        self,
        state: Float[Array, "components ..."],
        attitude: Attitude,
        contact: ContactMotion,
        push: Tangent,
        rise: Component,
        torque: tuple[Component, ...],
    ) -> tuple[Component, ...]:
        """Rate of change of the state's components, in the frame that moves with the contact.

        **Arguments:** `push`: force along the arena, over the mass [m/s^2]; `rise`: velocity of the centre of mass along n
        [m/s]; `torque`: L' [N m].
        """
        _, e, L, place = parts(state)
        o, up, place_rate, _ = contact.frame
        x_rate, z_rate = attitude.axis_rates
        u1_dot = add(push[0], multiply(-self.gravity, up[0]), multiply(o[0], rise))
        u2_dot = add(push[1], multiply(-self.gravity, up[1]), multiply(o[1], rise))
        e_dot, L_dot = sum_vectors(z_rate, rate_in_frame(e, o)), sum_vectors(torque, rate_in_frame(L, o))
        return (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate, *sum_vectors(x_rate, rate_in_frame(place[-3:], o)))

    def start(
        self, launch: Launch, place: tuple[Float[Array, "..."], ...], axis: Vector, angular_velocity: Vector
    ) -> Float[Array, "components ..."]:
        """The state at the start of a run.

        **Arguments:** `place`: place of the frame; `axis`, `angular_velocity`: axis e and angular velocity [rad/s], in the
        frame.
        """
        zero = jnp.zeros_like(launch.theta)
        # The body's axes are those of the frame, rotated about a direction across n, so that z becomes e.
        x, y = jnp.cos(launch.azimuth), jnp.sin(launch.azimuth)
        fall = 1.0 - axis[2]
        c = (1.0 - fall * x * x, -fall * x * y, -axis[0])
        axes = (c, cross(axis, c), axis)
        momentum = self.body.inertia.tensor.times(tuple(dot(angular_velocity, axis) for axis in axes))
        x, y, z = (scale(part, axis) for part, axis in zip(momentum, axes, strict=True))
        state = joined(launch.velocity or (zero, zero), axis, sum_vectors(x, y, z), place, c)
        return self.carried_along(state)

    def carried_along(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state with the velocity that the friction law imposes; only `NoSlip` imposes a velocity."""
        return state


class RigidSlipping(AbstractRigidDynamics):
    """The equations of motion under a friction law that determines the force from the slip."""

    frame: AbstractFrame
    body: AbstractRigidBody
    gravity: Float[Array, "..."]
    inverse: SymmetricMatrix
    friction: AbstractFriction
    per_mass: Float[Array, "..."]

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion, solving for the normal force with friction included.

        With q = r x n and J the inertia, all in the body's axes, the centre of mass rises at u.n = -w.q. Its second rate gives
        N (1 + m (J^-1 q).M) = m (g z.n + u.S q' - (J^-1 q).(L x w) - w.q'), M the moment per unit normal force.
        """
        (u1, u2), _, _, place = parts(state)
        attitude = self.attitude(state)
        r, swing = (
            attitude.in_frame(attitude.lever),
            attitude.in_frame(cross(attitude.angular_velocity, attitude.lever)),
        )
        slip_x, slip_y = stored(u1 + swing[0], u2 + swing[1])
        contact = self.contact_motion(place[:-3], attitude, (slip_x, slip_y))
        o, up, _, room = contact.frame
        slip = Slip(slip_x, slip_y, attitude.in_frame(attitude.angular_velocity))
        friction = self.friction.per_normal_force(slip)
        f1, f2 = friction.force
        moment = stored(*sum_vectors(cross(r, (f1, f2, 1.0)), friction.torque))

        lever, normal = attitude.lever, attitude.normal
        rise = cross(lever, normal)
        arm = self.inverse.times(rise)
        lever_rate_in_body = sum_vectors(cross(contact.lever_rate, normal), cross(lever, contact.normal_rate))
        bend = dot(arm, cross(attitude.momentum, attitude.angular_velocity)) + dot(
            attitude.angular_velocity, tuple(lever_rate_in_body)
        )
        mass = self.body.mass
        painleve_factor = 1.0 + mass * dot(arm, attitude.in_body(moment))
        pull = add(multiply(self.gravity, up[2]), dot((u1, u2), o))
        N = mass * (pull - bend) / painleve_factor

        thrust = N * self.per_mass
        push = (multiply(thrust, f1), multiply(thrust, f2))
        u3 = None if o == (None, None) else -dot(attitude.angular_velocity, rise)
        rates = self.carried_rates(state, attitude, contact, push, u3, scale(N, moment))
        return Motion(
            rates, N, friction, slip, contact.contact_velocity, o, attitude.angular_velocity[2], painleve_factor, room
        )


class RigidRolling(AbstractRigidDynamics):
    """The equations of motion of a body whose contact point is at rest: the nonholonomic constraint itself.

    The velocity follows from attitude and angular momentum; its two components in the state are integrated but not
    used.
    """

    frame: AbstractFrame
    body: AbstractRigidBody
    gravity: Float[Array, "..."]
    inverse: SymmetricMatrix

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion; `friction` is the force along the arena per unit normal force."""
        return self._evaluate(state)[0]

    def _evaluate(self, state: Float[Array, "components ..."]) -> tuple[Motion, Vector]:
        """The motion and the reaction F in the frame.

        In the body's axes, with the velocity r x w of the centre of mass and r' the rate of r as a vector,
        (J + m (r^2 - r r^T)) w' = L x w + m r x (r' x w + g z), and F = m (r' x w + r x w' + g z).
        """
        place, attitude = parts(state).place, self.attitude(state)
        m, r, w = self.body.mass, attitude.lever, attitude.angular_velocity
        contact = self.contact_motion(place[:-3], attitude, (None, None))
        o, up, _, room = contact.frame
        r_dot = sum_vectors(contact.lever_rate, cross(w, r))
        steady_push = sum_vectors(cross(tuple(r_dot), w), scale(self.gravity, attitude.in_body(up)))
        torque = sum_vectors(cross(attitude.momentum, w), scale(m, cross(r, tuple(steady_push))))
        w_dot = self._about_contact(r).solve(stored(*torque))
        reaction = attitude.in_frame(scale(m, sum_vectors(steady_push, cross(r, w_dot))))
        F = stored(*reaction)

        push = (F[0] / m, F[1] / m)
        u3 = None if o == (None, None) else dot(attitude.normal, cross(r, w))
        rates = self.carried_rates(state, attitude, contact, push, u3, cross(attitude.in_frame(r), F))
        load = ContactLoad((F[0] / F[2], F[1] / F[2]))
        zero = jnp.zeros_like(F[2])
        slip = Slip(zero, zero, attitude.in_frame(w))
        return Motion(rates, F[2], load, slip, contact.contact_velocity, o, w[2], 1.0 + zero, room), F

    def _about_contact(self, lever: Vector) -> SymmetricMatrix:
        """The inertia about the contact, J + m (r^2 - r r^T), in the body's axes."""
        m, r, square, inertia = self.body.mass, lever, dot(lever, lever), self.body.inertia
        return SymmetricMatrix(
            inertia.xx + m * (square - r[0] * r[0]),
            inertia.yy + m * (square - r[1] * r[1]),
            inertia.zz + m * (square - r[2] * r[2]),
            inertia.xy - m * r[0] * r[1],
            inertia.xz - m * r[0] * r[2],
            inertia.yz - m * r[1] * r[2],
        )

    def reaction(self, state: Float[Array, "components ..."]) -> Vector:
        """As `rolling.RollingDynamics.reaction`."""
        return self._evaluate(state)[1]

    def grip(self, state: Float[Array, "components ..."], mu: Float[Array, "..."]) -> Float[Array, "..."]:
        """As `rolling.RollingDynamics.grip`."""
        F1, F2, N = self.reaction(state)
        return (mu * N - length(F1, F2)) / (self.body.mass * self.gravity)

    def with_slip(self, state: Float[Array, "components ..."], slip: Slip) -> Float[Array, "components ..."]:
        """As `rolling.RollingDynamics.with_slip`."""
        (u1, u2), e, _, place = parts(state)
        attitude = self.attitude(state)
        r, w, m = attitude.lever, attitude.angular_velocity, self.body.mass
        # In the body's axes: the velocity u of the centre of mass, and v.
        u = attitude.in_body((u1, u2, -dot(w, cross(r, attitude.normal))))
        v = attitude.in_body((slip.x, slip.y, None))
        jump = sum_vectors(v, scale(-1.0, u))
        w = self._about_contact(r).solve(sum_vectors(attitude.momentum, scale(m, cross(r, jump))))
        u = attitude.in_frame(sum_vectors(cross(r, w), v))
        return joined(u[:2], e, attitude.in_frame(self.body.inertia.tensor.times(w)), place)

    def unit_impulse(self, state: Float[Array, "components ..."], axis: int) -> tuple[Component, ...]:
        """As `rolling.RollingDynamics.unit_impulse`."""
        attitude = self.attitude(state)
        v = tuple(part[axis] for part in attitude.axes)
        w = self._about_contact(attitude.lever).solve(scale(self.body.mass, cross(attitude.lever, v)))
        return scale(self.body.mass, attitude.in_frame(sum_vectors(cross(attitude.lever, w), v)))

    def with_unit_axes(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state with the body's axes at unit length and at right angles."""
        e, x = state[AXIS] / jnp.linalg.norm(state[AXIS], axis=0), state[-3:]
        x = x - jnp.sum(e * x, axis=0) * e
        return state.at[AXIS].set(e).at[-3:].set(x / jnp.linalg.norm(x, axis=0))

    def carried_along(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state with the velocity r x w of the centre of mass."""
        attitude = self.attitude(state)
        u = attitude.in_frame(cross(attitude.lever, attitude.angular_velocity))
        return state.at[:2].set(jnp.stack(jnp.broadcast_arrays(*u[:2], state[0])[:2]))


def rigid_dynamics(
    body: AbstractRigidBody, frame: AbstractFrame, friction: AbstractFriction, gravity: Float[Array, "..."]
) -> AbstractRigidDynamics:
    """The equations of motion of a body on an arena; arguments as for `Dynamics.of`."""
    inverse = body.inertia.tensor.inverse
    if isinstance(friction, NoSlip):
        return RigidRolling(frame, body, gravity, inverse)
    return RigidSlipping(frame, body, gravity, inverse, friction, 1.0 / body.mass)
