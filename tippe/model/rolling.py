"""The top that rolls without slipping, in vector form and free of trigonometry (`tippe.md`, section 5 d).

The state has the layout of `dynamics.py`, so that a run can slip and roll in turn. While the top rolls, its velocity
follows from axis and angular momentum, u = r x w with r = a e - R n from the centre of mass to the contact; the two
velocity components of the state are integrated but not used.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.compilation.xla_cpu import stored
from nonholonomic.geometry import (
    AbstractFrame,
    Component,
    Tangent,
    Vector,
    add,
    cross,
    dot,
    multiply,
    rate_in_frame,
    scale,
    stacked,
    subtract,
    sum_vectors,
)

from .contact_dynamics import Motion
from .contact_load import ContactLoad, Slip
from .friction import length
from .state import AXIS, angular_velocity, joined, parts
from .top import Top


class RollingDynamics(eqx.Module):
    """The equations of motion of a body whose contact point is at rest on the arena.

    Friction is the force that rolling requires; the caller must check whether the friction law allows it
    (`RollingDynamics.grip`).
    """

    frame: AbstractFrame
    radius: Float[Array, "..."]
    offset: Float[Array, "..."]
    mass: Float[Array, "..."]
    gravity: Float[Array, "..."]
    I1: Float[Array, "..."]
    I3: Float[Array, "..."]

    @classmethod
    def of(cls, body: Top, frame: AbstractFrame, gravity: Float[Array, "..."]) -> "RollingDynamics":
        """The equations for a body on an arena.

        **Arguments:** as for `Dynamics.of`.
        """
        return cls(frame, body.radius, body.offset, body.mass, gravity, body.I1, body.I3)

    @property
    def size(self) -> Float[Array, "..."]:
        """A length of the body [m]: the radius."""
        return self.radius

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion and the reaction.

        **Arguments:**

        - `state`: (8 + the arena's place, ...) as `tippe/model/dynamics.py` states it.

        **Returns:** a `Motion`; `friction` is the force along the arena per unit normal force.
        """
        return self._evaluate(state)[0]

    def field(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """Rate of change of the state, (components, ...)."""
        return stacked(self.motion(state).rate, state)

    def reaction(self, state: Float[Array, "components ..."]) -> Vector:
        """Force of the arena on the top [N] in the moving frame: the components along the arena, and the normal
        force."""
        return self._evaluate(state)[1]

    def grip(self, state: Float[Array, "components ..."], mu: Float[Array, "..."]) -> Float[Array, "..."]:
        """Reserve of friction, mu N - |F_t|, as a fraction of the weight; negative where the top must slip.

        **Arguments:**

        - `state`: (8 + the arena's place, ...).
        - `mu`: coefficient of friction [1].
        """
        F1, F2, N = self.reaction(state)
        return (mu * N - length(F1, F2)) / (self.mass * self.gravity)

    def carried_along(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state with the velocity that follows from axis and angular momentum of the rolling top."""
        _, e, L, place = parts(state)
        u = cross(self._contact(e), angular_velocity(self, e, L))
        return joined(u[:2], e, L, place)

    def _evaluate(self, state: Float[Array, "components ..."]) -> tuple[Motion, Vector]:
        """The motion and the reaction F (`tippe.md`, section 5 d).

        (J + m (r^2 - r r^T)) w' = -w x L + m r x (r' x w) + m g r x z, with r' = a e' - R n'; then u' = r' x w + r x w',
        F = m (u' + g z), and L' = r x F.
        """
        _, e, L, place = parts(state)
        R, a, m = self.radius, self.offset, self.mass

        w = angular_velocity(self, e, L)
        e_dot = cross(w, e)
        V: Tangent = (R * w[1], -R * w[0])
        o, up, place_rate, room = self.frame.frame_motion(place, V)
        r = self._contact(e)
        # n' = -(o1 t1 + o2 t2), and r' as a vector, not as the rate of its components.
        r_dot = sum_vectors(scale(a, e_dot), scale(R, (*o, None)))
        u = cross(r, w)

        steady_push = sum_vectors(cross(r_dot, w), scale(self.gravity, up))
        torque = sum_vectors(scale(m, cross(r, steady_push)), cross(L, w))
        w_dot = self._over_inertia(e, r, torque)
        push = sum_vectors(steady_push, cross(r, w_dot))

        u1_dot = add(push[0], multiply(-self.gravity, up[0]), multiply(o[0], u[2]))
        u2_dot = add(push[1], multiply(-self.gravity, up[1]), multiply(o[1], u[2]))
        F = scale(m, push)
        e_dot = sum_vectors(e_dot, rate_in_frame(e, o))
        L_dot = sum_vectors(cross(r, F), rate_in_frame(L, o))
        rate = (u1_dot, u2_dot, *e_dot, *L_dot, *place_rate)
        zero = jnp.zeros_like(F[2])
        load = ContactLoad((F[0] / F[2], F[1] / F[2]))
        slip = Slip(zero, zero, (w[0], w[1], None))
        return Motion(rate, F[2], load, slip, V, o, dot(L, e), 1.0 + zero, room), F

    def with_slip(self, state: Float[Array, "components ..."], slip: Slip) -> Float[Array, "components ..."]:
        """The state after an impulse at the contact that gives the contact point the given velocity along the arena.

        The angular momentum about the contact, K = L - m r x u, does not change in the impulse: w solves (J + m (r^2 -
        r r^T)) w = K + m r x v, and u = r x w + v. Jellett's quantity is constant, and an impulse that stops the slip
        dissipates the energy of v in the metric of the contact's inertia.

        **Arguments:**

        - `state`: (8 + the arena's place, ...).
        - `slip`: velocity v of the contact point after the impulse [m/s].

        **Returns:** the state, of the same shape.
        """
        (u1, u2), e, L, place = parts(state)
        r = self._contact(e)
        e_dot = cross(angular_velocity(self, e, L), e)
        u = (u1, u2, multiply(-self.offset, e_dot[2]))
        v = (slip.x, slip.y, None)
        lever = cross(r, sum_vectors(v, scale(-1.0, u)))
        w = self._over_inertia(e, r, sum_vectors(L, scale(self.mass, lever)))
        u = sum_vectors(cross(r, w), v)
        axial_rate = dot(w, e)
        L = sum_vectors(scale(self.I1, w), scale((self.I3 - self.I1) * axial_rate, e))
        return joined(u[:2], e, L, place)

    def with_unit_axes(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state with the axis at unit length."""
        axis = state[AXIS]
        return state.at[AXIS].set(axis / jnp.sqrt(jnp.sum(axis * axis, axis=0)))

    def unit_impulse(self, state: Float[Array, "components ..."], axis: int) -> tuple[Component, ...]:
        """The impulse at the contact that changes the velocity of the contact point by 1 m/s along an axis of the arena
        [N s].

        **Arguments:**

        - `state`: (8 + the arena's place, ...); `axis`: 0 for t1, 1 for t2.
        """
        e = parts(state).axis
        r, unit = self._contact(e), jnp.ones_like(state[0])
        v = (unit, None, None) if axis == 0 else (None, unit, None)
        w = self._over_inertia(e, r, scale(self.mass, cross(r, v)))
        return scale(self.mass, sum_vectors(cross(r, w), v))

    def _contact(self, e: Vector) -> Vector:
        """From the centre of mass to the contact, r = a e - R n [m]."""
        return (self.offset * e[0], self.offset * e[1], self.offset * e[2] - self.radius)

    def angular_velocity(self, state: Float[Array, "components ..."]) -> Vector:
        """Angular velocity of the body [rad/s] in the moving frame."""
        _, e, L, _ = parts(state)
        return angular_velocity(self, e, L)

    def _over_inertia(self, e: Vector, r: Vector, torque: tuple[Component, ...]) -> Vector:
        """Solution x of (J + m (r^2 - r r^T)) x = torque, J = I1 + (I3 - I1) e e^T.

        With A = I1 + m r^2, A x = torque - (I3 - I1) (e.x) e + m (r.x) r; its products with e and r are two equations for
        e.x and r.x, whose determinant is positive.
        """
        m, excess = self.mass, self.I3 - self.I1
        r2, er = dot(r, r), dot(e, r)
        A = self.I1 + m * r2
        te, tr = dot(torque, e), dot(torque, r)
        determinant = (self.I3 + m * r2) * self.I1 + m * excess * er * er
        ex = (self.I1 * te + m * er * tr) / determinant
        rx = ((self.I3 + m * r2) * tr - excess * er * te) / determinant
        torque_residual = sum_vectors(torque, scale(subtract(None, excess * ex), e), scale(m * rx, r))
        return stored(*scale(1.0 / A, torque_residual))
