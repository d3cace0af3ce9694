"""Impact of a sphere of the top on the plane, with the scene's own friction, torque included (Routh's incremental
method).

During an impact, the configuration is fixed and the contact load acts as in contact, where f and tau are the scene's
friction force and torque per unit normal force. With the normal impulse p in place of time, d(tangential impulse)/dp =
f and d(impulse of the torque)/dp = tau, and slip and angular velocity change with the impulses (Routh, Dynamics of a
System of Rigid Bodies, 1905, art. 198; Stronge, Impact Mechanics, ch. 4). This is the limit of a stiff contact with the
same law, so it needs no separate law: a stop of the slip, a reversal, and friction that depends on the speed all follow
from it. Newton's restitution e_N determines the end of the impact: the velocity along the normal is then e_N times the
speed of approach. With friction, Newton's rule may require more energy than there was (Stronge, section 3.3); the
impact then ends earlier, when the kinetic energy equals that before the impact.

Every impact ends. Strong friction can pull the sphere into the plane faster than the impulse pushes it out (a
jam), so the velocity along the normal is not monotone. But friction only dissipates energy, so the slip comes to an
end, and a contact that does not slip is pushed out, because the response to an impulse is positive definite. The same
holds with a torque, which also only dissipates energy: velocity and angular velocity of the contact respond to force
and torque by a positive definite matrix.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.compilation.xla_cpu import greatest, least
from nonholonomic.geometry import Vector, cross, dot, scale, sum_vectors
from nonholonomic.integration import AbstractProblem, Settings, traced_solve_ensemble
from nonholonomic.integration.settings import MOST_STEPS
from nonholonomic.integration.status import LEFT_DOMAIN

from ..model.contact_load import ContactLoad, Slip
from ..model.friction import AbstractFriction
from ..model.state import angular_velocity
from ..model.top import Top
from .free_body import Ball, FreeBody

Cells = Float[Array, " cells"]

#: Relative tolerance of an impact's integration: impacts are rare, so this cost is small. A tenfold value changes
#: inversion times after hundreds of impacts by 1e-14.
TOLERANCE = 1e-12

#: An impact has failed if it takes this many times the normal impulse that would stop the sphere without friction.
LARGEST = 1e9

#: A rebound slower than this fraction of sqrt(g R) closes the contact. During the time T of the remaining bounces, the
#: sliding top gets the impulse that these bounces would give it, so the error is of the order of the square of this
#: value. On the plane, a tenfold value changes inversion times by a relative 3e-12 if a top bounces, and by 4e-11 if it
#: rocks from sphere to sphere with decreasing amplitude until it leans on both (`LeaningDynamics.stopped`); the value
#: itself causes an error of 3e-13. On other arenas, a tenfold value changes positions and axes after the last bounce by
#: 5e-13, and inversion times after 270 flights in a bowl by a relative 3e-13. Contact begins too early by T.
CLOSING_SPEED = 1e-5

#: Two spheres touch the arena together if neither is farther from it than this fraction of R. On the plane, ten times
#: or a tenth of this value does not change a time at all.
TOUCHING = 1e-9


class Approach(NamedTuple):
    """A sphere about to strike: vector from the centre of mass to the contact point [m], and velocity of that point
    [m/s].

    `response` is the symmetric matrix W with (change of that velocity) = W (impulse) [1/kg], as three columns. `axis`
    and `angular_velocity` are the axis and the angular velocity [rad/s] of the body.
    """

    arm: Vector
    velocity: Vector
    response: tuple[Vector, Vector, Vector]
    axis: Vector
    angular_velocity: Vector


class ContactImpulse(NamedTuple):
    """Impulses at the contact: of the force [N s], and of the torque [N m s], `None` under a law that has no torque."""

    force: Vector
    torque: Vector | None


class Impact(AbstractProblem):
    """Impacts, with the normal impulse as the time; the state is the tangential impulse and, if the law has a torque,
    the impulse of the torque.

    The unit of impulses is the impulse that would stop the sphere without friction; impulses of a torque are in this
    unit times the sphere's radius. `gained` is the velocity along the normal [m/s] at which the impact ends.
    """

    body: Top
    friction: AbstractFriction
    approach: Approach
    radius: Float[Array, "..."]
    gained: Cells

    @property
    def speed(self) -> Cells:
        """Speed along the normal before the impact [m/s], positive because it is the unit of the impulses."""
        return greatest(jnp.abs(self.approach.velocity[2]), 1e-12)

    def impulse(self, normal: Cells, state: Float[Array, "rows cells"]) -> ContactImpulse:
        """The impulses at a stage of the impact."""
        unit = self.speed / self.approach.response[2][2]
        force = (state[0] * unit, state[1] * unit, normal * unit)
        return ContactImpulse(force, tuple(row * unit * self.radius for row in state[2:]) or None)

    def changes(self, impulse: ContactImpulse) -> tuple[Vector, Vector]:
        """Changes of the velocity of the contact point [m/s] and of the angular velocity [rad/s] by an impulse."""
        contact, torque = self.approach, cross(self.approach.arm, impulse.force)
        velocity = tuple(dot(column, impulse.force) for column in contact.response)
        if impulse.torque is not None:
            angular_change = angular_velocity(self.body, contact.axis, impulse.torque)
            velocity = sum_vectors(velocity, cross(angular_change, contact.arm))
            torque = sum_vectors(torque, impulse.torque)
        return velocity, angular_velocity(self.body, contact.axis, torque)

    def load(self, velocity: Vector, w: Vector) -> ContactLoad:
        """Friction force and torque per unit normal impulse."""
        drilling = w[2] if self.friction.uses_spin else None
        return self.friction.per_normal_force(Slip(velocity[0], velocity[1], (w[0], w[1], drilling)))

    def start(self) -> tuple[Float[Array, "rows cells"], Float[Array, "rows cells"]]:
        has_torque = self.load(self.approach.velocity, self.approach.angular_velocity).torque != (None, None, None)
        zeros = jnp.zeros((5 if has_torque else 2, *self.gained.shape))
        return zeros, jnp.ones_like(zeros)

    def field(self, time: Cells, state: Float[Array, "rows cells"]) -> Float[Array, "rows cells"]:
        contact, (velocity, w) = self.approach, self.changes(self.impulse(time, state))
        load = self.load(sum_vectors(contact.velocity, velocity), sum_vectors(contact.angular_velocity, w))
        torque = scale(1.0 / self.radius, load.torque) if len(state) > 2 else ()
        rows = [jnp.zeros_like(time) if component is None else component for component in (*load.force, *torque)]
        return jnp.stack(jnp.broadcast_arrays(*rows, time)[:-1])

    def event_function(self, state: Float[Array, "rows cells"]) -> None:
        return None

    def domain_margin(self, time: Cells, state: Float[Array, "rows cells"]) -> Cells:
        impulse, response = self.impulse(time, state), self.approach.response
        change, angular_change = self.changes(impulse)
        missing = (self.gained - change[2]) / self.speed
        # In compression, the sphere still approaches; in restitution, the margin is the dissipated energy that need not
        # be returned.
        approaches = -(self.approach.velocity[2] + change[2]) / self.speed
        gain = dot(impulse.force, self.approach.velocity) + 0.5 * dot(impulse.force, change)
        if impulse.torque is not None:
            gain = (
                gain + dot(impulse.torque, self.approach.angular_velocity) + 0.5 * dot(impulse.torque, angular_change)
            )
        shortfall = -gain * response[2][2] / self.speed**2
        return least(missing, jnp.where(approaches > shortfall, approaches, shortfall))

    def ended(self, time: Cells, state: Float[Array, "rows cells"]) -> ContactImpulse:
        """The impulses of an impact whose end has been located, corrected by one step of Newton's method.

        The search leaves an error of 1e-10, and this step leaves its square, which is round-off.
        """
        left, slope = jax.jvp(self.domain_margin, (time, state), (jnp.ones_like(time), self.field(time, state)))
        step = -left / jnp.where(slope == 0.0, 1.0, slope)
        step = jnp.where(jnp.abs(step) < 1e-6, step, 0.0)
        return self.impulse(time + step, state + step * self.field(time, state))


def approach(body: Top, ball: Ball, free: FreeBody) -> Approach:
    """Velocity, lever arm and response of a sphere of a free body at the plane.

    W = 1/m - [r]x J^-1 [r]x, r = a e - R n (`tippe.md`, section 3).
    """
    arm = (ball.offset * free.axis[0], ball.offset * free.axis[1], ball.offset * free.axis[2] - ball.radius)
    w = angular_velocity(body, free.axis, free.momentum)
    velocity = sum_vectors(free.velocity, cross(w, arm))
    zero, unit = jnp.zeros_like(arm[0]), jnp.ones_like(arm[0])

    def impulse_gain(impulse: Vector) -> Vector:
        angular_change = angular_velocity(body, free.axis, cross(arm, impulse))
        return sum_vectors(scale(1.0 / body.mass, impulse), cross(angular_change, arm))

    response = (impulse_gain((unit, zero, zero)), impulse_gain((zero, unit, zero)), impulse_gain((zero, zero, unit)))
    return Approach(arm, velocity, response, free.axis, w)


def resolve_impact(
    body: Top, friction: AbstractFriction, ball: Ball, free: FreeBody, restitution: Cells
) -> tuple[FreeBody, Bool[Array, " cells"]]:
    """The body after one of its spheres has struck the plane; unchanged if the sphere does not approach the plane.

    An impulse at the contact point leaves Jellett's quantity of that sphere unchanged; an impulse of a torque changes
    it.

    **Arguments:**

    - `friction`: the scene's law.
    - `free`: the body before the impact.
    - `restitution`: Newton's coefficient e_N [1]; the rebound is slower if it would otherwise create energy.

    **Returns:** the body after the impact; and whether the impact could not be computed (`MOST_STEPS`, `LARGEST`).
    """
    contact = approach(body, ball, free)
    impulse_gain = (1.0 + restitution) * greatest(-contact.velocity[2], 0.0)
    problem = Impact(body, friction, contact, ball.radius, impulse_gain)
    horizon, cells = jnp.asarray(LARGEST), jnp.asarray(impulse_gain.shape[0])
    settings = Settings(TOLERANCE, diffrax.Dopri5(), absolute=1.0, max_steps=MOST_STEPS)
    outcome, _ = traced_solve_ensemble(problem, horizon, cells, settings)
    impulse = problem.ended(outcome.end_time, outcome.state)
    return apply_impulse(body, contact, free, impulse), outcome.status != LEFT_DOMAIN


def apply_impulse(body: Top, contact: Approach, free: FreeBody, impulse: ContactImpulse) -> FreeBody:
    """A free body after an impulse at its contact."""
    velocity = sum_vectors(free.velocity, scale(1.0 / body.mass, impulse.force))
    momentum = sum_vectors(free.momentum, cross(contact.arm, impulse.force))
    if impulse.torque is not None:
        momentum = sum_vectors(momentum, impulse.torque)
    return FreeBody(velocity, free.height, free.axis, momentum)
