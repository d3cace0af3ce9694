"""Sliding on one sphere as a phase of the motion, and what follows it: a flight, the other sphere, or the end."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.lockstep import CROSSED, FAILED, REACHED_END, RUNNING, AbstractProblem
from nonholonomic.phases import UNRESOLVED, AbstractPhase, Passage

from ..dynamics import COS_THETA, Dynamics
from ..scene import Scene
from .flight import angle_reached, flown, fly
from .free_body import Ball, FreeBody, balls, freed, gap, gap_rate, grounded, standing_on
from .impact import strike

Cells = Float[Array, " cells"]

#: Both spheres stay on the plane: a double contact, which is not modelled. A slow top ends so, leaning on its stem: it rocks
#: from one sphere to the other, ever less, until the one parts from the plane more slowly than `CLOSING_SPEED`. A further
#: code of `Passage.status`.
BOTH_CONTACTS = 6

#: A rebound slower than this part of sqrt(g R) is none: the contact closes. Its height would be half the square of it, in R.
CLOSING_SPEED = 1e-5

#: Two spheres are at the plane together if neither is farther from it than this part of R.
TOUCHING = 1e-9

#: Bounces in a row after which a cell is given up.
MOST_BOUNCES = 1000


class Sliding(AbstractProblem):
    """Sliding on one sphere until theta reaches an angle, the contact is lost or the other sphere touches the plane."""

    dynamics: Dynamics
    own: Ball
    other: Ball | None
    cos_angle: Float[Array, "..."]
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Cells, state: Float[Array, "components cells"]) -> Float[Array, "components cells"]:
        return self.dynamics.field(state)

    def crossing(self, state: Float[Array, "components cells"]) -> Cells:
        return state[COS_THETA] - self.cos_angle

    def guard(self, time: Cells, state: Float[Array, "components cells"]) -> Cells:
        margin = self.dynamics.contact_margin(state)
        if self.other is None:
            return margin
        return jnp.minimum(margin, clearance(self.own, self.other, state))


def clearance(own: Ball, other: Ball, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
    """Distance of the other sphere from the plane as a part of the own radius, plus the round-off of a change of spheres."""
    height = own.radius - other.radius + (other.offset - own.offset) * state[COS_THETA]
    return height / own.radius + 1e-12


class Slide(AbstractPhase):
    """Sliding on the sphere numbered `number`, in the order of `free_body.balls`, up to an angle of theta.

    The number is an array, so that one program serves both spheres; `last` says whether the run goes on through the angle.
    """

    scene: Scene
    scales: Float[Array, "components cells"]
    cos_angle: Float[Array, "..."]
    number: Int[Array, ""]
    last: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> Sliding:
        own, other = _own_and_other(balls(self.scene.body), self.number)
        return Sliding(standing_on(self.scene.dynamics, own), own, other, self.cos_angle, state, self.scales)

    def leave(self, state: Float[Array, "components cells"], left: Cells) -> Passage:
        """Fly, and bounce, until a sphere stays on the plane; or let the other sphere land where it is that which touches.

        Counted are the flights.
        """
        touches, start = lost_contact(self.scene, self.number, state)

        def hop(carry: tuple[Air, Array]) -> tuple[Air, Array]:
            air, count = carry
            arrives = touches & (count == 0)
            after, landed = take_flight(self.scene, air, self.cos_angle, left, self.last)
            after = _where(arrives, air, after)
            after = _where(arrives | landed, land(self.scene, after), after)
            return _where(air.open, after, air), count + 1

        def under_way(carry: tuple[Air, Array]) -> Array:
            return jnp.any(carry[0].open) & (carry[1] < MOST_BOUNCES)

        air, _ = jax.lax.while_loop(under_way, hop, (start, jnp.zeros((), int)))
        status = jnp.where(air.open, UNRESOLVED, air.status)
        return Passage(air.ball, grounded(air.free), air.elapsed, status, air.crossing_time, air.flights[None])


class Air(NamedTuple):
    """A top that may be in the air.

    - `free`, `elapsed` [s]: the body and the time since the contact was lost.
    - `ball`: the sphere that touched last; `rising`: whether it left with a speed.
    - `status`: `RUNNING`, or how the run ended; `crossing_time` [s] of the event, infinite if there was none.
    - `flights`: so far; `open`: whether there is no contact and the run goes on.
    """

    free: FreeBody
    elapsed: Cells
    ball: Int[Array, " cells"]
    rising: Bool[Array, " cells"]
    status: Int[Array, " cells"]
    crossing_time: Cells
    flights: Int[Array, " cells"]
    open: Bool[Array, " cells"]


def first_ball(spheres: tuple[Ball, ...], state: Float[Array, "components ..."]) -> Int[Array, "..."]:
    """The number of the sphere on which a launch stands: the lower one."""
    if len(spheres) == 1:
        return jnp.zeros(state.shape[1:], int)
    main, stem = spheres
    return (clearance(main, stem, state) < 0.0).astype(int)


def lost_contact(
    scene: Scene, number: Int[Array, ""], state: Float[Array, "components cells"]
) -> tuple[Bool[Array, " cells"], Air]:
    """What has ended sliding on the sphere with a number: whether the other sphere touches the plane; and the top then."""
    own, other = _own_and_other(balls(scene.body), number)
    zero = jnp.zeros_like(state[0])
    touches = jnp.zeros(zero.shape, bool)
    if other is not None:
        touches = clearance(own, other, state) <= standing_on(scene.dynamics, own).contact_margin(state)
    start = Air(
        free=freed(scene.body, own, state),
        elapsed=zero,
        ball=jnp.where(touches, 1 - number, number),
        rising=jnp.zeros(zero.shape, bool),
        status=jnp.full(zero.shape, RUNNING),
        crossing_time=jnp.full_like(zero, jnp.inf),
        flights=jnp.zeros(zero.shape, int),
        open=jnp.ones(zero.shape, bool),
    )
    return touches, start


def take_flight(
    scene: Scene, air: Air, cos_angle: Float[Array, "..."], left: Cells, last: bool
) -> tuple[Air, Bool[Array, " cells"]]:
    """One flight, until a sphere reaches the plane, theta the angle (unless `last`), or the time from the loss `left` [s].

    **Returns:** the top at its end; and where a sphere has reached the plane.
    """
    body, gravity = scene.body, scene.gravity
    flight = fly(body, gravity, balls(body), air.free, air.ball, air.rising, jnp.maximum(left - air.elapsed, 0.0))
    reached = angle_reached(body, air.free, cos_angle, flight.duration, last)
    crosses = jnp.isfinite(reached) & (not last)
    duration = jnp.where(crosses, reached, flight.duration)
    landed = flight.landed & ~crosses & ~flight.lost
    status = jnp.where(crosses, CROSSED, jnp.where(flight.landed, air.status, REACHED_END))
    after = Air(
        free=flown(body, gravity, air.free, duration),
        elapsed=air.elapsed + duration,
        ball=jnp.where(landed, flight.ball, air.ball),
        rising=air.rising,
        status=jnp.where(flight.lost, FAILED, status),
        crossing_time=jnp.where(jnp.isfinite(reached), air.elapsed + reached, air.crossing_time),
        flights=air.flights + 1,
        open=landed,
    )
    return after, landed


def land(scene: Scene, air: Air) -> Air:
    """The impact of the sphere that has reached the plane; slow rebounds are none, and the contact closes."""
    body, spheres = scene.body, balls(scene.body)
    own, other = _own_and_other(spheres, air.ball)
    speed = jnp.maximum(-gap_rate(body, own, air.free), 0.0)
    restitution = (
        jnp.zeros_like(speed) if scene.restitution is None else jnp.broadcast_to(scene.restitution, speed.shape)
    )
    closing = CLOSING_SPEED * jnp.sqrt(scene.gravity * body.radius)
    rebounds = restitution * speed > closing
    free, jams = strike(body, scene.friction, own, air.free, jnp.where(rebounds, restitution, 0.0))
    status = jnp.where(jams, FAILED, air.status)
    if other is not None:
        both = (gap(other, free) < TOUCHING * body.radius) & (gap_rate(body, other, free) <= closing)
        status = jnp.where(both & ~rebounds & ~jams, BOTH_CONTACTS, status)
    return air._replace(free=free, rising=rebounds, status=status, open=rebounds & ~jams)


def _where(condition: Bool[Array, " cells"], this: Any, that: Any) -> Any:
    """Each leaf of one tree where a condition holds, of the other elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), this, that)


def _own_and_other(spheres: tuple[Ball, ...], number: Int[Array, "..."]) -> tuple[Ball, Ball | None]:
    """The sphere with a number, and the other if there is one."""
    if len(spheres) == 1:
        return spheres[0], None
    main, stem = spheres
    return _where(number == 0, main, stem), _where(number == 0, stem, main)
