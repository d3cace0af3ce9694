"""Impact of a sphere of the top on the plane, with the scene's own friction (Routh's incremental method).

During an impact the configuration stands still and the contact force f N acts as in contact, f being the scene's friction per
unit normal force: with the normal impulse p in place of time, d(tangential impulse)/dp = f(slip), the slip changing with
the impulses (Routh, Dynamics of a System of Rigid Bodies, 1905, art. 198; Stronge, Impact Mechanics, ch. 4). It is the
limit of a stiff contact with the same law, and so needs no law of its own: a stop of the slip, a reversal, and friction
that depends on the speed come out by themselves. Newton's restitution e_N says when it ends: once the velocity along the normal
is e_N times the speed of approach. With friction Newton's rule may ask for more energy than there was (Stronge, section 3.3);
the impact then ends earlier, where the kinetic energy is what it was before.

There is always an end. Strong friction can pull the sphere into the plane faster than the impulse pushes it out (a jam), so
the velocity along the normal is no clock. But friction only takes energy, the slip comes to an end, and a contact that does
not slip is pushed out, because the response to an impulse is positive definite.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.geometry import Vector, cross, dot, scale, sum_vectors
from nonholonomic.integration import GUARD_LOST, AbstractProblem, Settings, traced_march

from ..friction import AbstractFriction, Slip
from ..state import angular_velocity
from ..top import Top
from .free_body import Ball, FreeBody

Cells = Float[Array, " cells"]

#: Relative tolerance of an impact's integration: impacts are rare, so they may cost. Ten times the value moves inversion times
#: after hundreds of them by 1e-14.
TOLERANCE = 1e-12

#: An impact has failed if it takes this many times the normal impulse that would stop the sphere without friction.
LARGEST = 1e9

#: Steps after which an impact has failed.
MOST_STEPS = 100_000


class Approach(NamedTuple):
    """A sphere about to strike: from the centre of mass to the contact point [m], velocity of that point [m/s].

    `response` is the symmetric matrix W with (change of that velocity) = W (impulse) [1/kg], as three columns.
    """

    arm: Vector
    velocity: Vector
    response: tuple[Vector, Vector, Vector]


class Impact(AbstractProblem):
    """Impacts, with the normal impulse as the time and the tangential impulse as the state.

    Both are in units of the impulse that would stop the sphere if there were no friction. `gained` is the velocity along the
    normal [m/s] by which the impact is over.
    """

    friction: AbstractFriction
    approach: Approach
    gained: Cells

    @property
    def speed(self) -> Cells:
        """Speed along the normal before the impact [m/s]; positive, because a sphere at rest has none to be measured by."""
        return jnp.maximum(jnp.abs(self.approach.velocity[2]), 1e-12)

    def impulse(self, normal: Cells, tangential: Float[Array, "2 cells"]) -> Vector:
        """The impulse [N s] at a stage of the impact."""
        unit = self.speed / self.approach.response[2][2]
        return (tangential[0] * unit, tangential[1] * unit, normal * unit)

    def start(self) -> tuple[Float[Array, "2 cells"], Float[Array, "2 cells"]]:
        none = jnp.zeros((2, *self.gained.shape))
        return none, jnp.ones_like(none)

    def field(self, time: Cells, state: Float[Array, "2 cells"]) -> Float[Array, "2 cells"]:
        impulse = self.impulse(time, state)
        changes = [dot(self.approach.response[i], impulse) for i in (0, 1)]
        slip = Slip(*(before + change for before, change in zip(self.approach.velocity[:2], changes, strict=True)))
        force = self.friction.per_normal_force(slip).force
        return jnp.stack([jnp.zeros_like(time) if component is None else component for component in force])

    def crossing(self, state: Float[Array, "2 cells"]) -> None:
        return None

    def guard(self, time: Cells, state: Float[Array, "2 cells"]) -> Cells:
        impulse, response = self.impulse(time, state), self.approach.response
        change = tuple(dot(column, impulse) for column in response)
        missing = (self.gained - change[2]) / self.speed
        # In compression the sphere still approaches; in restitution the energy that was lost is not to come back in full.
        approaches = -(self.approach.velocity[2] + change[2]) / self.speed
        gain = dot(impulse, self.approach.velocity) + 0.5 * dot(impulse, change)
        return jnp.minimum(missing, jnp.maximum(approaches, -gain * response[2][2] / self.speed**2))

    def ended(self, time: Cells, state: Float[Array, "2 cells"]) -> Vector:
        """The impulse [N s] of an impact whose end has been located: put right by one step of Newton's method.

        The search leaves an error of 1e-10, its square is round-off.
        """
        left, slope = jax.jvp(self.guard, (time, state), (jnp.ones_like(time), self.field(time, state)))
        step = -left / jnp.where(slope == 0.0, 1.0, slope)
        step = jnp.where(jnp.abs(step) < 1e-6, step, 0.0)
        return self.impulse(time + step, state + step * self.field(time, state))


def approach(body: Top, ball: Ball, free: FreeBody) -> Approach:
    """How a sphere of a free body meets the plane.

    W = 1/m - [r]x J^-1 [r]x, r = a e - R n (`tippe.md`, section 3).
    """
    arm = (
        ball.offset * free.axis[0],
        ball.offset * free.axis[1],
        ball.offset * free.axis[2] - ball.radius,
    )
    turning = angular_velocity(body, free.axis, free.momentum)
    velocity = sum_vectors(free.velocity, cross(turning, arm))
    zero, one = jnp.zeros_like(arm[0]), jnp.ones_like(arm[0])

    def gained(impulse: Vector) -> Vector:
        turned = angular_velocity(body, free.axis, cross(arm, impulse))
        return sum_vectors(scale(1.0 / body.mass, impulse), cross(turned, arm))

    return Approach(arm, velocity, (gained((one, zero, zero)), gained((zero, one, zero)), gained((zero, zero, one))))


def strike(
    body: Top, friction: AbstractFriction, ball: Ball, free: FreeBody, restitution: Cells
) -> tuple[FreeBody, Bool[Array, " cells"]]:
    """The body after a sphere of it has struck the plane; unchanged where the sphere does not approach the plane.

    The impulse acts at the contact point, so Jellett's quantity of that sphere stays as it is.

    **Arguments:**

    - `friction`: the scene's law.
    - `free`: the body before the impact.
    - `restitution`: Newton's coefficient e_N [1]; the rebound is slower where it would take energy from nowhere.

    **Returns:** the body after it; and where the impact could not be computed (`MOST_STEPS`, `LARGEST`).
    """
    meets = approach(body, ball, free)
    gained = (1.0 + restitution) * jnp.maximum(-meets.velocity[2], 0.0)
    problem = Impact(friction, meets, gained)
    cells = gained.shape[0]
    outcome, _ = traced_march(
        problem,
        jnp.asarray(LARGEST),
        jnp.asarray(cells),
        Settings(TOLERANCE, diffrax.Dopri5(), absolute=1.0, max_steps=MOST_STEPS),
    )
    impulse = problem.ended(outcome.end_time, outcome.state)
    velocity = sum_vectors(free.velocity, scale(1.0 / body.mass, impulse))
    momentum = sum_vectors(free.momentum, cross(meets.arm, impulse))
    return FreeBody(velocity, free.height, free.axis, momentum), outcome.status != GUARD_LOST
