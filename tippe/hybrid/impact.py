"""Impact of a sphere of the top on the plane, with the scene's own friction (Routh's incremental method).

During an impact the configuration stands still and the contact force f N acts as in contact, f being the scene's friction per
unit normal force: with the normal impulse p in place of time, d(tangential impulse)/dp = f(slip), the slip changing with
the impulses (Routh, Dynamics of a System of Rigid Bodies, 1905, art. 198; Stronge, Impact Mechanics, ch. 4). It is the
limit of a stiff contact with the same law, and so needs no law of its own: a stop of the slip, a reversal, and friction
that depends on the speed come out by themselves. The clock is the velocity gained along the normal, of which Newton's
restitution e_N gives the end, (1 + e_N) times the speed of approach. With friction Newton's rule may ask for more energy than
there was (Stronge, section 3.3); the impact then ends earlier, where the kinetic energy is what it was before.
"""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.ensemble import lanes_for, traced_march
from nonholonomic.lockstep import FAILED, GUARD_LOST, AbstractProblem
from nonholonomic.vector import Vector, cross, dot, scale, sum_vectors

from ..friction import AbstractFriction, Slip
from ..top import Top
from .free_body import Ball, FreeBody, angular_velocity

Cells = Float[Array, " cells"]

#: Relative tolerance of an impact's integration: impacts are rare, so they may cost.
TOLERANCE = 1e-12

#: A contact less stiff than this part of the frictionless one is jammed.
JAMMED = 1e-6

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
    """Impacts, with the velocity gained along the normal [m/s] as the time, and the tangential impulse [N s] as the state."""

    friction: AbstractFriction
    approach: Approach

    def start(self) -> tuple[Float[Array, "2 cells"], Float[Array, "2 cells"]]:
        speed = jnp.abs(self.approach.velocity[2])
        # The least positive scale: a sphere that does not approach has no impulse to be measured by.
        scales = jnp.maximum(speed, 1e-12) / self.approach.response[2][2]
        return jnp.zeros((2, *speed.shape)), jnp.stack([scales, scales])

    def normal_impulse(self, gained: Cells, tangential: Float[Array, "2 cells"]) -> Cells:
        """The normal impulse [N s] by which, with the tangential one, a velocity along the normal is gained."""
        column = self.approach.response[2]
        return (gained - column[0] * tangential[0] - column[1] * tangential[1]) / column[2]

    def load(self, gained: Cells, tangential: Float[Array, "2 cells"]) -> tuple[Cells, Cells]:
        """Friction per unit normal impulse at a stage of the impact."""
        impulse = (*tangential, self.normal_impulse(gained, tangential))
        changes = [dot(self.approach.response[i], impulse) for i in (0, 1)]
        slip = Slip(*(before + change for before, change in zip(self.approach.velocity[:2], changes, strict=True)))
        f1, f2 = self.friction.per_normal_force(slip).force
        zero = jnp.zeros_like(gained)
        return (zero if f1 is None else f1), (zero if f2 is None else f2)

    def stiffness(self, load: tuple[Cells, Cells]) -> Cells:
        """Velocity gained along the normal per unit normal impulse [1/kg]; as 1 + m a A of the equations of motion."""
        return dot(self.approach.response[2], (*load, 1.0))

    def field(self, time: Cells, state: Float[Array, "2 cells"]) -> Float[Array, "2 cells"]:
        load = self.load(time, state)
        return jnp.stack(load) / self.stiffness(load)

    def crossing(self, state: Float[Array, "2 cells"]) -> None:
        return None

    def guard(self, time: Cells, state: Float[Array, "2 cells"]) -> Cells:
        # Where friction pulls the sphere into the plane faster than the impulse pushes it out, rigid bodies jam.
        stiffness = self.stiffness(self.load(time, state)) / self.approach.response[2][2]
        # In compression the sphere still approaches; in restitution the energy that was lost is not to come back in full.
        speed = self.approach.velocity[2]
        impulse = (*state, self.normal_impulse(time, state))
        change = tuple(dot(column, impulse) for column in self.approach.response)
        gain = dot(impulse, self.approach.velocity) + 0.5 * dot(impulse, change)
        allowed = -gain * self.approach.response[2][2] / jnp.maximum(speed**2, 1e-24) + 1e-12
        approaches = -(speed + time) / jnp.maximum(jnp.abs(speed), 1e-12)
        return jnp.minimum(stiffness, jnp.maximum(approaches, allowed))


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

    **Returns:** the body after it; and where the impact has no solution.
    """
    meets = approach(body, ball, free)
    problem = Impact(friction, meets)
    gained = (1.0 + restitution) * jnp.maximum(-meets.velocity[2], 0.0)
    cells = gained.shape[0]
    outcome, _ = traced_march(
        problem,
        gained,
        jnp.asarray(cells),
        jnp.asarray(TOLERANCE),
        jnp.asarray(TOLERANCE),
        solver=diffrax.Dopri5(),
        lanes=lanes_for(cells),
        max_steps=MOST_STEPS,
    )
    tangential = outcome.state
    impulse = (tangential[0], tangential[1], problem.normal_impulse(outcome.end_time, tangential))
    velocity = sum_vectors(free.velocity, scale(1.0 / body.mass, impulse))
    momentum = sum_vectors(free.momentum, cross(meets.arm, impulse))
    soft = problem.stiffness(problem.load(outcome.end_time, tangential)) < JAMMED * meets.response[2][2]
    jams = (outcome.status == FAILED) | ((outcome.status == GUARD_LOST) & soft)
    return FreeBody(velocity, free.height, free.axis, momentum), jams
