"""The motion after a loss of contact on the level plane: flights in closed form and impacts, until a sphere stays on
the plane."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import dot
from nonholonomic.integration.status import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED

from ..model.dynamics import Dynamics
from ..model.scene import Scene
from ..model.state import COS_THETA, parts
from ..model.top import Top
from .flight import angle_reached, c_in_flight, flown, fly
from .free_body import Ball, FreeBody, as_free_body, balls, energy, gap, gap_rate, standing_on, still_parting
from .impact import CLOSING_SPEED, TOUCHING, resolve_impact
from .leaning import LeaningDynamics

Cells = Float[Array, " cells"]

#: Number of components of a state, without the passive quadratures that may follow.
OWN = 8


class Air(NamedTuple):
    """A top that may be in the air.

    - `free`, `elapsed` [s]: the body and the time since the contact was lost.
    - `ball`: the sphere that touched last; `rising`: whether it left with a speed; `falls`: whether the other sphere is
      about to strike the plane without a flight; `None` for a top without a stem. Once the contact is closed, `ball` is
      the index of the mode.
    - `status`: `RUNNING`, or how the run ended, `LEFT_DOMAIN` if it has jammed; `crossing_time` [s] of the event,
      infinite if there was none.
    - `flights`: number of flights so far; `open`: whether there is no contact and the run continues.
    - `log_rates`: logarithms of the rates at the landings, as in `Transition`.
    - `quadratures`: the passive quadratures of a single run.
    """

    free: FreeBody
    elapsed: Cells
    ball: Int[Array, " cells"]
    rising: Bool[Array, " cells"]
    falls: Bool[Array, " cells"] | None
    status: Int[Array, " cells"]
    crossing_time: Cells
    flights: Int[Array, " cells"]
    open: Bool[Array, " cells"]
    log_rates: Cells
    quadratures: Float[Array, "7 cells"] | None = None


def lost_contact(scene: Scene[Top], number: Int[Array, ""], state: Float[Array, "components cells"]) -> Air:
    """The top at the end of sliding on the sphere with the given number: its contact is lost or jams, or the other
    sphere is at the plane.
    """
    contact_ball, other_ball = own_and_other(balls(scene.body), number)
    zero = jnp.zeros_like(state[0])
    dynamics = standing_on(scene.dynamics, contact_ball)
    falls, ball, jams = None, jnp.broadcast_to(number, zero.shape), dynamics.loss(state) > 0
    if other_ball is not None:
        falls = clearance(dynamics, contact_ball, other_ball, state) <= dynamics.contact_margin(state)
        ball, jams = jnp.where(falls, 1 - number, number), jams & ~falls
    return Air(
        free=as_free_body(scene.body, contact_ball, state),
        elapsed=zero,
        ball=ball,
        rising=jnp.zeros(zero.shape, bool),
        falls=falls,
        status=jnp.where(jams, LEFT_DOMAIN, RUNNING),
        crossing_time=jnp.full_like(zero, jnp.inf),
        flights=jnp.zeros(zero.shape, int),
        open=~jams,
        log_rates=zero,
    )


def take_flight(
    scene: Scene[Top], air: Air, cos_angle: Float[Array, "..."], left: Cells, last: bool
) -> tuple[Air, Bool[Array, " cells"]]:
    """One flight, until a sphere reaches the plane, theta reaches the angle (unless `last`), or the time since the loss
    of contact reaches `left` [s].

    **Returns:** the top at the end of the flight; and whether a sphere has reached the plane.
    """
    body, gravity = scene.body, scene.gravity
    flight = fly(body, gravity, balls(body), air.free, air.ball, air.rising, greatest(left - air.elapsed, 0.0))
    crossing_time = angle_reached(body, air.free, cos_angle, flight.duration, last)
    crosses = jnp.isfinite(crossing_time) & (not last)
    duration = jnp.where(crosses, crossing_time, flight.duration)
    has_landed = flight.landed & ~crosses & ~flight.lost
    status = jnp.where(crosses, CROSSED, jnp.where(flight.landed, air.status, REACHED_END))
    air_after = Air(
        free=flown(body, gravity, air.free, duration),
        elapsed=air.elapsed + duration,
        ball=jnp.where(has_landed, flight.ball, air.ball),
        rising=air.rising,
        falls=air.falls,
        status=jnp.where(flight.lost, FAILED, status),
        crossing_time=jnp.where(jnp.isfinite(crossing_time), air.elapsed + crossing_time, air.crossing_time),
        flights=air.flights + 1,
        open=has_landed,
        log_rates=air.log_rates + jnp.where(has_landed, flight.log_rate, 0.0),
        quadratures=None if air.quadratures is None else quadratures_after(body, air.free, air.quadratures, duration),
    )
    return air_after, has_landed


def land(scene: Scene[Top], air: Air) -> Air:
    """The impact of the sphere that has reached the plane; a slow rebound closes the contact."""
    body, spheres = scene.body, balls(scene.body)
    contact_ball, other_ball = own_and_other(spheres, air.ball)
    speed = greatest(-gap_rate(body, contact_ball, air.free), 0.0)
    restitution = (
        jnp.zeros_like(speed) if scene.restitution is None else jnp.broadcast_to(scene.restitution, speed.shape)
    )
    closing = CLOSING_SPEED * jnp.sqrt(scene.gravity * body.radius)
    rebounds = restitution * speed > closing
    free, fails = resolve_impact(body, scene.friction, contact_ball, air.free, jnp.where(rebounds, restitution, 0.0))
    after_impact = air._replace(free=free, rising=rebounds, open=rebounds, status=jnp.where(fails, FAILED, air.status))
    if other_ball is not None:
        after_impact = _with_other(scene, air, after_impact, other_ball, (speed <= closing) & ~rebounds, closing)
    if air.quadratures is not None:
        energy_change = energy(body, scene.gravity, after_impact.free) - energy(body, scene.gravity, air.free)
        *path, work = air.quadratures
        after_impact = after_impact._replace(quadratures=jnp.stack([*path, work + energy_change]))
    return after_impact._replace(open=after_impact.open & ~fails)


def _with_other(
    scene: Scene[Top], air: Air, after_impact: Air, other_ball: Ball, is_slow: Bool[Array, " cells"], closing: Cells
) -> Air:
    """Effect of an impact on the other sphere if that is at the plane: it also strikes, or the top comes to rest on
    both.

    **Arguments:** `air`: the top before the impact; `after_impact`: the top after the impact; `is_slow`: mask of the impacts
    that are so slow that they may be the last.
    """
    touches = gap(other_ball, air.free) < TOUCHING * scene.body.radius
    falls = touches & (gap_rate(scene.body, other_ball, after_impact.free) < -closing)
    stopped_body, dissipates = LeaningDynamics.of(scene).stopped(air.free)
    rests = touches & is_slow & (jnp.abs(gap_rate(scene.body, other_ball, air.free)) <= closing) & dissipates
    free, number, definite = LeaningDynamics.of(scene).settled(stopped_body)
    falls &= ~rests
    return after_impact._replace(
        free=select(rests, free, after_impact.free),
        ball=jnp.where(rests, number, jnp.where(falls, 1 - air.ball, air.ball)),
        falls=falls,
        status=jnp.where(rests & ~definite & (after_impact.status == RUNNING), UNRESOLVED, after_impact.status),
        open=after_impact.open | falls,
    )


def stem_takes_over(
    air: Air, strikes: Bool[Array, " cells"], air_landed: Air, stem_counts: Float[Array, "..."], last: bool
) -> Air:
    """The top after an impact, with the event that the stem begins to carry it: the stem bears a force or an impulse, and
    the sphere was the last to touch before.

    **Arguments:** `air`: the top before the flight, if any, and the impact; `strikes`: mask of the tops whose stem is the
    sphere that strikes; `air_landed`: the top after the impact; `stem_counts`: as for `InversionProblem`; `last`:
    whether the run continues.
    """
    assert air.falls is not None
    # A sphere that is about to strike without a flight is not the sphere that touched last.
    last_ball = jnp.where(air.falls, 1 - air.ball, air.ball)
    # On both spheres, the stem carries a part of the top, but the sphere still touches.
    comes_to_rest_on_stem = ~air_landed.open & (air_landed.ball == 1 if last else air_landed.ball != 0)
    takes_over = (last_ball == 0) & (strikes | comes_to_rest_on_stem) & (stem_counts > 0.0)
    return air_landed._replace(
        crossing_time=jnp.where(takes_over, air_landed.elapsed, air_landed.crossing_time),
        status=air_landed.status if last else jnp.where(takes_over, CROSSED, air_landed.status),
        open=air_landed.open if last else air_landed.open & ~takes_over,
    )


def quadratures_after(
    body: Top, free: FreeBody, quadratures: Float[Array, "7 ..."], time: Float[Array, "..."]
) -> Float[Array, "7 ..."]:
    """The passive quadratures after some time [s] in flight."""
    x, y, *c_vector, angle, work = quadratures
    u1, u2, _ = free.velocity
    spin_rate = dot(free.axis, free.momentum) / body.I3
    c_vector = c_in_flight(body, free, tuple(c_vector), time)
    return jnp.stack([x + u1 * time, y + u2 * time, *c_vector, angle + spin_rate * time, work + 0.0 * time])


def clearance(
    dynamics: Dynamics, contact_ball: Ball, other_ball: Ball, state: Float[Array, "components ..."]
) -> Float[Array, "..."]:
    """Distance of the other sphere from the plane as a fraction of the radius of the touching sphere, plus the
    round-off allowed at lift-off.
    """
    _, e, L, _ = parts(state[:OWN])
    rate = (other_ball.offset - contact_ball.offset) * dynamics.per_transverse * (L[0] * e[1] - L[1] * e[0])
    return height(contact_ball, other_ball, state) / contact_ball.radius + still_parting(
        rate, dynamics.gravity, contact_ball.radius
    )


def height(contact_ball: Ball, other_ball: Ball, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
    """Distance [m] of the other sphere from the plane, for a top that stands on the sphere `contact_ball`."""
    return contact_ball.radius - other_ball.radius + (other_ball.offset - contact_ball.offset) * state[COS_THETA]


def own_and_other(spheres: tuple[Ball, ...], number: Int[Array, "..."]) -> tuple[Ball, Ball | None]:
    """The numbered sphere, and the other if there is one."""
    if len(spheres) == 1:
        return spheres[0], None
    main, stem = spheres
    return select(number == 0, main, stem), select(number == 0, stem, main)


def select(condition: Bool[Array, " cells"], first: Any, second: Any) -> Any:
    """Each leaf of one tree where a condition holds, and of the other tree elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), first, second)
