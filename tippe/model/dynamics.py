"""The state of a top in contact, and the equations of motion of the top that slides or rolls, in vector form and free of
trigonometry.

The state is the velocity, axis and angular momentum in the arena's moving frame (t1, t2, n), and the place. The velocity
along n follows from the axis, because the contact persists. Cyclic coordinates (position, spin angle) are not part of it.
"""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import least, stored, stored_with_tangents
from nonholonomic.geometry import AbstractFrame, Component, PlaneFrame, Tangent, Vector, add, cross, dot
from nonholonomic.geometry.vector import multiply, planar_length, rate_in_frame, scale, stacked, subtract, sum_vectors
from nonholonomic.integration import Components, States
from nonholonomic.integration.problem import Status

from ..friction import AbstractFriction, ContactLoad, Slip, length
from .body import AbstractBody, AbstractMeridian, ContactGeometry, Top

# The state of a top in contact, and its parts by name.
#
# In the arena's moving frame (t1, t2, n): velocity (u1, u2) of the centre of mass along the arena [m/s], axis (e1, e2,
# e3) [1], angular momentum (L1, L2, L3) about the centre of mass [kg m^2/s], then the arena's place. The components are
# along axis 0.

#: Indices of the parts in a state.
VELOCITY, AXIS, MOMENTUM, PLACE = slice(0, 2), slice(2, 5), slice(5, 8), slice(8, None)

#: Index of the component of the axis along n, cos(theta).
COS_THETA = 4


class Parts(NamedTuple):
    """The parts of a state."""

    velocity: Tangent
    axis: Vector
    momentum: Vector
    place: tuple[Component, ...]


def parts(state: Components) -> Parts:
    """Split a state into its parts."""
    u1, u2, e1, e2, e3, L1, L2, L3, *place = (state[k] for k in range(len(state)))
    return Parts((u1, u2), (e1, e2, e3), (L1, L2, L3), tuple(place))


def joined(*vectors: tuple[Component, ...]) -> States:
    """The state made of its parts, in order; a component is a scalar or has one number per lane."""
    return jnp.stack(jnp.broadcast_arrays(*(component for part in vectors for component in part)))


def to_frame(vector: Vector, axes: tuple[Vector, Vector, Vector]) -> Vector:
    """Components of a vector along three axes."""
    return tuple(dot(vector, axis) for axis in axes)


def from_frame(vector: Vector, axes: tuple[Vector, Vector, Vector]) -> Vector:
    """The vector with given components along three axes."""
    return sum_vectors(*(scale(part, axis) for part, axis in zip(vector, axes, strict=True)))


def inclination(axis: Vector) -> Float[Array, "..."]:
    """The angle theta [rad] from the arena's normal to the axis, in [0, pi]."""
    return jnp.arctan2(planar_length(axis[0], axis[1]), axis[2])


def angular_velocity(body: AbstractBody, axis: Vector, momentum: Vector) -> Vector:
    """w = L / I1 + (1 / I3 - 1 / I1) (L.e) e [rad/s]."""
    factor = multiply(1.0 / body.I3 - 1.0 / body.I1, dot(momentum, axis))
    return sum_vectors(scale(1.0 / body.I1, momentum), scale(factor, axis))


# The interface of the equations of motion of a body in contact, and how a contact ends.

#: Value of `Motion.painleve_factor` at which a contact counts as jammed. N grows as its inverse, and the factor falls
#: to zero as the square root of the remaining time, so a run ends too early by about 1e-4 s times the square of this
#: value. In `tests/physics/test_strong_friction.py`, this is 1e-12 s, and 1e-10 s with ten times the value; there, the
#: error of theta is 5e-13, and that of velocities 1e-4.
JAMMED = 1e-4

#: Value of `Motion.room` at which the ball no longer fits, because a curvature of the arena reaches 1/R. There the foot
#: moves as the square root of the remaining time, so a run ends too early by about 0.1 s times the square of this
#: value.
FITS = 1e-4

#: Normal force as a fraction of the weight that round-off leaves of N = 0.
NO_LOAD = 1e-12

#: How far a motion is followed, as a fraction of the state's magnitudes, to see whether a contact without load gains one.
AHEAD = 1e-3

#: The ways in which a contact can end; the index is the code of the word.
LOSSES = (Status.CONTACT_LOST, Status.JAMMED, Status.DOES_NOT_FIT)


class Motion(NamedTuple):
    """The result of the equations of motion for one state, with all vectors in the moving frame.

    `painleve_factor` is the factor of N in its equation, 1 + m a A in `tippe.md`, section 2: 1 without an offset, and 0
    if friction pulls the top down as strongly as N pushes it up. `velocity` is that of the point with which the frame
    moves, and `spin` the angular velocity about the axis. `room` is positive where the ball fits, `None` if it fits everywhere.
    """

    rate: tuple[Component, ...]
    normal_force: Float[Array, "..."]
    friction: ContactLoad
    slip: Slip
    velocity: Tangent
    frame_rate: Tangent
    spin: Float[Array, "..."]
    painleve_factor: Float[Array, "..."]
    room: Component

    @property
    def friction_power(self) -> Component:
        """Power of friction N (f.v_s + tau.w) [W], at most 0; `None` without friction."""
        return multiply(self.normal_force, self.friction.power(self.slip))


class AbstractDynamics(eqx.Module):
    """Equations of motion, with the precomputed combinations of a scene's numbers; they hold while all margins are
    positive."""

    @property
    def weight(self: Any) -> Float[Array, "..."]:
        """Weight of the body [N], for equations with the fields `body` and `gravity`."""
        return self.body.mass * self.gravity

    @abc.abstractmethod
    def motion(self, state: Components) -> Any:
        """Evaluate the equations of motion.

        **Arguments:** `state`: velocity, axis and angular momentum, and the place, as above.

        **Returns:** a `Motion`, or at least the `rate` of one.
        """

    @abc.abstractmethod
    def margins(self, state: States) -> tuple[Float[Array, "..."], ...]:
        """The smooth functions whose least value is the contact margin."""

    def field(self, state: Components) -> States:
        """Rate of change of the state, (components, ...)."""
        return stacked(self.motion(state).rate, state)

    def contact_margin(self, state: States) -> Float[Array, "..."]:
        """The least of `margins`."""
        return least(*self.margins(state))

    def unloaded(self, state: States, scales: States) -> Bool[Array, "..."] | None:
        """A mask of the states with N = 0, up to round-off, whose motion does not increase N; `None` if the contact
        margin alone decides.

        On a wall the first derivative of N may vanish too; so the state moves on by the midpoint rule, by the part `AHEAD`
        of the magnitudes `scales`, to see whether N grows.
        """
        state, scales = jnp.asarray(state), jnp.asarray(scales)
        motion = self.motion(state)
        rate = stacked(motion.rate, state)
        fastest = jnp.max(jnp.abs(rate) / scales, axis=0)
        time = AHEAD / jnp.where(fastest > 0.0, fastest, 1.0)
        later = self.motion(state + time * self.field(state + 0.5 * time * rate))
        threshold = NO_LOAD * self.weight
        return (jnp.abs(motion.normal_force) <= threshold) & ~(later.normal_force > threshold)


class AbstractContactDynamics(AbstractDynamics):
    """Equations of motion of a body on a single contact, which ends as one of `LOSSES`."""

    @abc.abstractmethod
    def rotation(self, state: Components) -> tuple[Vector, Vector]:
        """Angular velocity of the body [rad/s], and the vector r from its centre of mass to the contact [m], in the
        moving frame."""

    def normal_spin(self, state: States) -> Float[Array, "..."]:
        """Angular velocity about the arena's normal [rad/s]."""
        return self.rotation(state)[0][2]

    def carried_along(self, state: States) -> States:
        """The state with the velocity that the law of the contact imposes; only rolling imposes a velocity."""
        return state

    def margins(self, state: States) -> tuple[Float[Array, "..."], ...]:
        """The margin for each of `LOSSES`: the normal force as a fraction of the weight, plus a round-off allowance for
        a start with N = 0; the excess of the Painlevé factor over `JAMMED`; and the excess of the room over `FITS`, if
        the arena has places where the ball does not fit."""
        motion = self.motion(state)
        lost, jammed = motion.normal_force / self.weight + NO_LOAD, motion.painleve_factor - JAMMED
        return (lost, jammed) if motion.room is None else (lost, jammed, motion.room - FITS)

    def loss(self, state: States) -> Int[Array, "..."]:
        """How a contact with zero margin has ended: a code in `LOSSES`."""
        lost, *others = self.margins(state)
        # At the located end, the margin is round-off of either sign; if another margin has vanished, N is many times
        # the weight.
        return len(others) - jnp.argmin(jnp.stack([*others[::-1], jnp.maximum(lost, 0.0)]), axis=0)


class AbstractRollingDynamics(AbstractContactDynamics):
    """Equations of motion of a body whose contact point is at rest on the arena.

    Friction is the force that rolling requires; the caller must check whether the friction law allows it (`grip`). The
    velocity, r x w with r from the centre of mass to the contact, follows from axis and angular momentum; its two
    components in the state are integrated but not used.
    """

    body: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def evaluate(self, state: Components) -> tuple[Motion, Vector]:
        """The motion, whose `friction` is the force along the arena per unit normal force; and the force of the arena on
        the body [N] in the moving frame: the components along the arena, and the normal force."""

    def motion(self, state: Components) -> Motion:
        return self.evaluate(state)[0]

    def grip(self, state: States, mu: Float[Array, "..."]) -> Float[Array, "..."]:
        """Reserve of friction, mu N - |F_t|, as a fraction of the weight; negative where the top must slip.

        **Arguments:**

        - `state`: (8 + the arena's place, ...).
        - `mu`: coefficient of friction [1].
        """
        F1, F2, N = self.evaluate(state)[1]
        return (mu * N - length(F1, F2)) / self.weight

    @abc.abstractmethod
    def over_inertia(self, state: Components, lever: Vector, torque: Vector) -> Vector:
        """Solution x of (J + m (r^2 - r r^T)) x = torque in the moving frame, with the inertia J about the centre of mass
        and the vector r from there to the contact."""

    @abc.abstractmethod
    def momentum(self, state: States, w: Vector) -> Vector:
        """The angular momentum J w about the centre of mass, in the moving frame."""

    @abc.abstractmethod
    def with_unit_axes(self, state: States) -> States:
        """The state with the body's axes at unit length, and at right angles."""

    def carried_along(self, state: States) -> States:
        w, r = self.rotation(state)
        return state.at[VELOCITY].set(jnp.stack(jnp.broadcast_arrays(*cross(r, w)[:2], state[0])[:2]))

    def with_slip(self, state: States, slip: Slip) -> States:
        """The state after an impulse at the contact that gives the contact point the given velocity along the arena.

        The angular momentum about the contact, K = L - m r x u, does not change in the impulse: w solves (J + m (r^2 -
        r r^T)) w = K + m r x v, u = r x w + v, and L = J w. Jellett's quantity is constant, and an impulse that
        stops the slip dissipates the energy of v in the metric of the contact's inertia.

        **Arguments:**

        - `state`: (8 + the arena's place, ...).
        - `slip`: velocity v of the contact point after the impulse [m/s].

        **Returns:** the state, of the same shape.
        """
        (w, r), (u, e, L, place) = self.rotation(state), parts(state)
        m, v, swing = self.body.mass, (slip.x, slip.y, None), cross(r, w)
        about_contact = sum_vectors(L, scale(-m, cross(r, (*u, swing[2]))))
        w = self.over_inertia(state, r, sum_vectors(about_contact, scale(m, cross(r, v))))
        # K + m r x u would be the same, but the rounding errors of w would be left in the slip.
        return joined(sum_vectors(cross(r, w), v)[:2], e, self.momentum(state, w), place)

    def unit_impulse(self, state: States, axis: int) -> tuple[Component, ...]:
        """The impulse at the contact that changes the velocity of the contact point by 1 m/s along an axis of the arena
        [N s].

        **Arguments:**

        - `state`: (8 + the arena's place, ...); `axis`: 0 for t1, 1 for t2.
        """
        _, r = self.rotation(state)
        unit = jnp.ones_like(state[0])
        v = (unit, None, None) if axis == 0 else (None, unit, None)
        w = self.over_inertia(state, r, scale(self.body.mass, cross(r, v)))
        return scale(self.body.mass, sum_vectors(cross(r, w), v))


#: The cosine of no angle, for runs without a target angle.
NO_COSINE = -2.0

#: Rate of a frame that turns about n with an inverting top, as a fraction of L_n / I1, for an arena on which all directions
#: across n are equivalent. While a top inverts, L has a nearly constant direction in a frame at rest, and the axis turns about
#: L at the rate L / I1. In the turning frame, both turn at a fraction of this rate, so steps are longer. Errors are smaller
#: because they no longer add up along a circle. Among 0.5, 0.7, 0.85 and 1, this is the fastest at equal error, or close to
#: it, in five scenes on the plane: 1 to 2.6 times as fast as a frame at rest.
TURNING = 0.7


class Dynamics(AbstractContactDynamics):
    """A scene, with precomputed combinations of its numbers that every evaluation needs.

    `turns` is the additional rate of the frame about n, as a fraction of L_n / I1; `None` if there is none.
    """

    frame: AbstractFrame
    friction: AbstractFriction
    meridian: AbstractMeridian | ContactGeometry
    mass: Float[Array, "..."]
    gravity: Float[Array, "..."]
    per_mass: Float[Array, "..."]
    per_transverse: Float[Array, "..."]
    axial_excess: Float[Array, "..."]
    turns: Float[Array, "..."] | None = None

    @property
    def weight(self) -> Float[Array, "..."]:
        return self.mass * self.gravity

    def rotation(self, state: Components) -> tuple[Vector, Vector]:
        _, e, L, _ = parts(state)
        w = sum_vectors(scale(self.per_transverse, L), scale(self.axial_excess * dot(L, e), e))
        return w, self.meridian.at(e[2]).contact(e)

    def unloaded(self, state: States, scales: States) -> Bool[Array, "..."] | None:
        # On a level plane, N = 0 can last only for an instant.
        frame = self.frame
        return None if isinstance(frame, PlaneFrame) and frame.slope is None else super().unloaded(state, scales)

    def motion(self, state: Components) -> Motion:
        """Evaluate the equations of motion, solving for the normal force with friction included.

        **Arguments:**

        - `state`: (8 + the arena's place, ...).

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
        o, up, place_rate, room, _ = self.frame.frame_motion(place, path)

        spin_momentum = dot(L, e)
        along_axis = self.axial_excess * spin_momentum
        w1 = self.per_transverse * L[0] + along_axis * e[0]
        w2 = self.per_transverse * L[1] + along_axis * e[1]
        w3 = self.per_transverse * L[2] + along_axis * e[2]
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
        u3 = multiply(-a, e_dot[2])
        u1_dot = add(multiply(thrust, f1), multiply(-self.gravity, up[0]), multiply(o[0], u3))
        u2_dot = add(multiply(thrust, f2), multiply(-self.gravity, up[1]), multiply(o[1], u3))
        e_dot = sum_vectors(e_dot, rate_in_frame(e, o))
        L_dot = sum_vectors(scale(N, (M1, M2, M3)), rate_in_frame(L, o))
        rate = (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate)
        if self.turns is not None:
            turn = self.turns * self.per_transverse * L[2]
            u_turn, e_turn, L_turn = [(turn * y, -(turn * x)) for x, y, *_ in ((u1, u2), e, L)]
            rate = sum_vectors(rate, (*u_turn, *e_turn, None, *L_turn, None, *[None] * len(place)))
        spin = (self.per_transverse + self.axial_excess) * spin_momentum
        return Motion(rate, N, friction, slip, path, o, spin, painleve_factor, room)


class RollingDynamics(AbstractRollingDynamics):
    """The top that rolls without slipping, in vector form and free of trigonometry (`tippe.md`, section 5 d).

    The state has the layout of `Dynamics`, so that a run can slip and roll in turn. While the top rolls, u = r x w with
    r = a e - R n from the centre of mass to the contact.
    """

    frame: AbstractFrame
    body: Top
    gravity: Float[Array, "..."]

    def rotation(self, state: Components) -> tuple[Vector, Vector]:
        _, e, L, _ = parts(state)
        return angular_velocity(self.body, e, L), self.body.meridian.contact(e)

    def evaluate(self, state: Components) -> tuple[Motion, Vector]:
        """The motion and the reaction F.

        (J + m (r^2 - r r^T)) w' = -w x L + m r x (r' x w) + m g r x z, with r' = a e' - R n'; then u' = r' x w + r x w',
        F = m (u' + g z), and L' = r x F.
        """
        (w, r), (_, e, L, place) = self.rotation(state), parts(state)
        R, a, m = self.body.radius, self.body.offset, self.body.mass
        e_dot = cross(w, e)
        V: Tangent = (R * w[1], -R * w[0])
        o, up, place_rate, room, _ = self.frame.frame_motion(place, V)
        # n' = -(o1 t1 + o2 t2), and r' as a vector, not as the rate of its components.
        r_dot = sum_vectors(scale(a, e_dot), scale(R, (*o, None)))
        u = cross(r, w)

        steady_push = sum_vectors(cross(r_dot, w), scale(self.gravity, up))
        torque = sum_vectors(scale(m, cross(r, steady_push)), cross(L, w))
        w_dot = self.over_inertia(state, r, torque)
        push = sum_vectors(steady_push, cross(r, w_dot))

        u1_dot = add(push[0], multiply(-self.gravity, up[0]), multiply(o[0], u[2]))
        u2_dot = add(push[1], multiply(-self.gravity, up[1]), multiply(o[1], u[2]))
        F = scale(m, push)
        e_dot = sum_vectors(e_dot, rate_in_frame(e, o))
        L_dot = sum_vectors(cross(r, F), rate_in_frame(L, o))
        rate = (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate)
        zero = jnp.zeros_like(F[2])
        load = ContactLoad((F[0] / F[2], F[1] / F[2]))
        slip = Slip(zero, zero, w)
        return Motion(rate, F[2], load, slip, V, o, dot(w, e), 1.0 + zero, room), F

    def momentum(self, state: States, w: Vector) -> Vector:
        e = parts(state).axis
        return sum_vectors(scale(self.body.I1, w), scale((self.body.I3 - self.body.I1) * dot(w, e), e))

    def with_unit_axes(self, state: States) -> States:
        axis = state[AXIS]
        return state.at[AXIS].set(axis / jnp.sqrt(jnp.sum(axis * axis, axis=0)))

    def over_inertia(self, state: Components, lever: Vector, torque: Vector) -> Vector:
        # J = I1 + (I3 - I1) e e^T. With A = I1 + m r^2, A x = torque - (I3 - I1) (e.x) e + m (r.x) r; its products with e
        # and r are two equations for e.x and r.x, whose determinant is positive.
        e, r = parts(state).axis, lever
        m, I1, I3 = self.body.mass, self.body.I1, self.body.I3
        excess, r2, er = I3 - I1, dot(r, r), dot(e, r)
        te, tr = dot(torque, e), dot(torque, r)
        determinant = (I3 + m * r2) * I1 + m * excess * er * er
        ex = (I1 * te + m * er * tr) / determinant
        rx = ((I3 + m * r2) * tr - excess * er * te) / determinant
        torque_residual = sum_vectors(torque, scale(subtract(None, excess * ex), e), scale(m * rx, r))
        return stored(*scale(1.0 / (I1 + m * r2), torque_residual))
