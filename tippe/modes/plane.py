"""The modes on the level plane: sliding on one sphere or on both; and flights and impacts in closed form, until a sphere
stays on the plane.

Between two contacts, L is constant and e turns about it at the rate |L| / I1 (`tippe.md`, section 3). The distance of a
sphere from the plane is therefore a parabola plus a cosine. Between inflections, which are known, its slope is
monotone: each interval has at most one minimum, and at most one root between points of different sign. The search for
the landing is therefore complete.

A single run whose path is kept has seven passive quadratures after its state: the position (x, y) of the centre of
mass [m], the vector c of `problems.py`, the rotation angle of the top about its axis [rad], and the work of
friction and impacts [J].
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup, greatest
from nonholonomic.geometry import Vector, cross, dot, scale, subtract, sum_vectors
from nonholonomic.hybrid import AbstractHoppingMode, Transition, TransitionPath
from nonholonomic.integration import AbstractProblem, Lanes, States
from nonholonomic.integration.dense import halved
from nonholonomic.integration.problem import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED

from ..model.body import Number, Top
from ..model.dynamics import COS_THETA, Dynamics, parts
from ..model.scene import Scene
from .impact import Ball, FreeBody, LeaningDynamics, balls, own_and_other, select, standing_on, still_parting, strike
from .problems import AbstractFlyingMode, InversionProblem, Quadratures, Started

#: Most intervals between inflections that are searched for a landing; the search skips those where the top is too high.
MOST_STRETCHES = 20_000


#: The passive quadratures.
Passive = Float[Array, "7 ..."]


class Cone(NamedTuple):
    """Motion of the axis: e(t) = `parallel` + `perpendicular` cos(W t) + `binormal` sin(W t), where W is `rate` [rad/s]."""

    rate: Float[Array, "..."]
    parallel: Vector
    perpendicular: Vector
    binormal: Vector


class Descent(NamedTuple):
    """The distance [m] of a sphere from the plane, g0 + v t - g t^2 / 2 - c (1 - cos W t) - s (W t - sin W t).

    This form is accurate even just after the beginning of a flight. `start` is g0, and `speed` the rate v [m/s] at the
    start.
    """

    start: Lanes
    speed: Lanes
    gravity: Lanes
    rate: Lanes
    cosine: Lanes
    sine: Lanes

    def value(self, time: Lanes) -> Lanes:
        angle = self.rate * time
        # angle - sin(angle), without cancellation where the angle is small.
        square, series = angle * angle, 1.0
        for k in (14, 12, 10, 8, 6, 4):
            series = 1.0 - square / (k * (k + 1)) * series
        less_sine = jnp.where(jnp.abs(angle) < 0.5, angle * square / 6.0 * series, angle - jnp.sin(angle))
        swing = 2.0 * self.cosine * jnp.sin(0.5 * angle) ** 2 + self.sine * less_sine
        return self.start + time * (self.speed - 0.5 * self.gravity * time) - swing

    def slope(self, time: Lanes) -> Lanes:
        angle = self.rate * time
        swing = self.cosine * jnp.sin(angle) + self.sine * 2.0 * jnp.sin(0.5 * angle) ** 2
        return self.speed - self.gravity * time - self.rate * swing


def precession(body: Top, free: FreeBody) -> tuple[Vector, Float[Array, "..."]]:
    """The direction of L, about which the axis of a free body turns, and the rate [rad/s]."""
    size = jnp.sqrt(dot(free.momentum, free.momentum))
    return scale(1.0 / jnp.where(size == 0.0, 1.0, size), free.momentum), size / body.I1


def cone(body: Top, free: FreeBody) -> Cone:
    """Motion of the axis of a free body."""
    direction, rate = precession(body, free)
    parallel = scale(dot(direction, free.axis), direction)
    perpendicular = tuple(subtract(e, p) for e, p in zip(free.axis, parallel, strict=True))
    return Cone(rate, parallel, perpendicular, cross(direction, free.axis))


def flown(body: Top, gravity: Float[Array, "..."], free: FreeBody, time: Float[Array, "..."]) -> FreeBody:
    """A free body after a time [s]."""
    (direction, rate), (u1, u2, u3) = precession(body, free), free.velocity
    height = free.height + time * (u3 - 0.5 * gravity * time)
    return FreeBody((u1, u2, u3 - gravity * time), height, turned(free.axis, direction, rate * time), free.momentum)


def turned(vector: Vector, axis: Vector, angle: Float[Array, "..."]) -> Vector:
    """A vector turned about a unit axis by an angle [rad]."""
    parallel, binormal = scale(dot(axis, vector), axis), cross(axis, vector)
    perpendicular = tuple(subtract(v, p) for v, p in zip(vector, parallel, strict=True))
    return sum_vectors(parallel, scale(jnp.cos(angle), perpendicular), scale(jnp.sin(angle), binormal))


def landing(descent: Descent, max_time: Lanes) -> tuple[Lanes, Bool[Array, " cells"]]:
    """Time at which the distance first falls below zero, after a start at zero or above.

    **Arguments:** `max_time`: time [s] to search.

    **Returns:** the time [s], infinite if it is more than `max_time`; and whether the search failed.
    """
    g, rate, amplitude = descent.gravity, descent.rate, jnp.hypot(descent.cosine, descent.sine)
    # The distance lies between two parabolas, mean +- amplitude.
    mean, drift = descent.start - descent.cosine, descent.speed - descent.sine * rate
    end = jnp.minimum(max_time, _roots(mean + amplitude, drift, g)[1] * (1.0 + 1e-9))
    high_from, high_to, is_never_high = _roots(mean - amplitude, drift, g)
    high_from, high_to = (jnp.where(is_never_high, jnp.inf, time) for time in (high_from, high_to))
    # The distance is convex where rate^2 amplitude cos(rate t - phase) < -g, for angles between bend and 2 pi - bend.
    mode = jnp.arctan2(descent.sine, descent.cosine)
    ratio = g / jnp.maximum(rate**2 * amplitude, jnp.finfo(g.dtype).tiny)
    bend = jnp.arccos(-jnp.minimum(ratio, 1.0))
    has_no_inflection = ratio >= 1.0

    def search(carry):
        low, high, located, is_over, count = carry
        start = jnp.where((low > high_from) & (low < high_to), high_to, low)
        angles = [jnp.mod(mode + side * bend - rate * start, 2.0 * jnp.pi) for side in (1.0, -1.0)]
        # Skip the inflection just reached.
        angles = [jnp.where(angle < 1e-9, 2.0 * jnp.pi, angle) for angle in angles]
        wait = jnp.where(has_no_inflection, jnp.inf, jnp.minimum(*angles) / jnp.where(has_no_inflection, 1.0, rate))
        next_time = jnp.minimum(start + wait, end)
        ends_below = descent.value(next_time) < 0.0
        dips = (descent.slope(start) < 0.0) & (descent.slope(next_time) > 0.0)
        active = ~located & ~is_over
        # Few flights dip before they land.
        bottom = jax.lax.cond(
            jnp.any(active & dips),
            lambda: halved(lambda t: descent.slope(t) < 0.0, start, next_time)[1],
            lambda: next_time,
        )
        dips &= descent.value(bottom) < 0.0
        is_hit = ends_below | dips
        low = jnp.where(active, jnp.where(is_hit, start, next_time), low)
        high = jnp.where(active & is_hit, jnp.where(dips, bottom, next_time), high)
        return low, high, located | (active & is_hit), is_over | (active & ~is_hit & (next_time >= end)), count + 1

    zero, false = jnp.zeros_like(end), jnp.zeros(end.shape, bool)
    low, high, located, is_over, _ = jax.lax.while_loop(
        lambda carry: jnp.any(~carry[2] & ~carry[3]) & (carry[4] < MOST_STRETCHES),
        search,
        (zero, zero, false, false, 0),
    )
    # At the very start, the distance is zero: it must have been positive since.
    time = halved(lambda t: descent.value(t) >= 0.0, low, high)[1]
    return jnp.where(located, time, jnp.inf), ~located & ~is_over


def _roots(height: Lanes, speed: Lanes, gravity: Lanes) -> tuple[Lanes, Lanes, Bool[Array, " cells"]]:
    """Times between which a body thrown from a height is above zero; and whether it never is."""
    square = speed**2 + 2.0 * gravity * height
    root = jnp.sqrt(greatest(square, 0.0))
    return (speed - root) / gravity, (speed + root) / gravity, square <= 0.0


def angle_reached(body: Top, free: FreeBody, cos_angle: Float[Array, "..."], horizon: Lanes, last: bool) -> Lanes:
    """Time in flight at which theta rises through an angle, for the first or for the last time; infinite if theta does
    not reach the angle by `horizon`.

    Along the normal the axis is a constant plus a cosine, so the times are known in closed form.
    """
    motion = cone(body, free)
    height = jnp.hypot(motion.perpendicular[2], motion.binormal[2])
    part = (cos_angle - motion.parallel[2]) / jnp.maximum(height, jnp.finfo(horizon.dtype).tiny)
    crosses = (jnp.abs(part) < 1.0) & (motion.rate > 0.0)
    angle = jnp.arctan2(motion.binormal[2], motion.perpendicular[2]) + jnp.arccos(jnp.clip(part, -1.0, 1.0))
    turn, rate = 2.0 * jnp.pi, jnp.where(motion.rate > 0.0, motion.rate, 1.0)
    angle = jnp.mod(angle, turn)
    if last:
        angle = angle + turn * jnp.floor((rate * horizon - angle) / turn)
    time = angle / rate
    return jnp.where(crosses & (time >= 0.0) & (time <= horizon), time, jnp.inf)


# The motion after a loss of contact on the level plane: flights in closed form and impacts, until a sphere stays on
# the plane.

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
    elapsed: Lanes
    ball: Int[Array, " cells"]
    rising: Bool[Array, " cells"]
    falls: Bool[Array, " cells"] | None
    status: Int[Array, " cells"]
    crossing_time: Lanes
    flights: Int[Array, " cells"]
    open: Bool[Array, " cells"]
    log_rates: Lanes
    quadratures: Passive | None = None


def take_flight(
    scene: Scene[Top], air: Air, cos_angle: Float[Array, "..."], left: Lanes, last: bool
) -> tuple[Air, Bool[Array, " cells"]]:
    """One flight, until a sphere reaches the plane, theta reaches the angle (unless `last`), or the time since the loss
    of contact reaches `left` [s].

    **Returns:** the top at the end of the flight; and whether a sphere has reached the plane.
    """
    body, gravity, free = scene.body, scene.gravity, air.free
    motion = cone(body, free)
    max_time = greatest(left - air.elapsed, 0.0)
    times, speeds, has_failed = [], [], jnp.zeros(max_time.shape, bool)
    for number, ball in enumerate(balls(body)):
        # The distance of the sphere from the plane. A sphere that was at rest when the normal force vanished rises with the
        # third power of time.
        is_touching = air.ball == number
        at_rest = is_touching & ~air.rising
        start = jnp.where(is_touching, 0.0, greatest(free.gap(ball), 0.0))
        speed = free.gap_rate(body, ball)
        speed = jnp.where(at_rest, 0.0, jnp.where(is_touching, greatest(speed, 0.0), speed))
        cosine, sine = ball.offset * motion.perpendicular[2], ball.offset * motion.binormal[2]
        # Where the normal force vanishes, the distance has no curvature: the remainder is round-off, and may only rise.
        upper_bound = -gravity / jnp.maximum(motion.rate**2, jnp.finfo(cosine.dtype).tiny)
        cosine = jnp.where(at_rest, jnp.minimum(cosine, upper_bound), cosine)
        descent = Descent(start, speed, jnp.broadcast_to(gravity, start.shape), motion.rate, cosine, sine)
        # The search is by bisection, which has no derivative.
        time, given_up = landing(*stop_gradient((descent, max_time)))
        # The derivatives of the time are those of an implicit function.
        value, slope = descent.value(time), stop_gradient(descent.slope(time))
        is_regular = jnp.isfinite(time) & (slope < 0.0)
        late = jnp.where(is_regular, (value - stop_gradient(value)) / jnp.where(is_regular, slope, 1.0), 0.0)
        times.append(time - late)
        speeds.append(-descent.slope(jnp.where(jnp.isfinite(time), times[-1], 0.0)))
        has_failed |= given_up
    first, time = jnp.argmin(jnp.stack(times), axis=0), jnp.min(jnp.stack(times), axis=0)
    lands = time <= max_time
    duration = jnp.where(lands, time, max_time)
    speed = jnp.take_along_axis(jnp.stack(speeds), first[None], axis=0)[0]
    log_rate = jnp.log(jnp.maximum(speed, jnp.finfo(speed.dtype).tiny))

    crossing_time = angle_reached(body, free, cos_angle, duration, last)
    crosses = jnp.isfinite(crossing_time) & (not last)
    duration = jnp.where(crosses, crossing_time, duration)
    has_landed = lands & ~crosses & ~has_failed
    status = jnp.where(crosses, CROSSED, jnp.where(lands, air.status, REACHED_END))
    air_after = air._replace(
        free=flown(body, gravity, free, duration),
        elapsed=air.elapsed + duration,
        ball=jnp.where(has_landed, first, air.ball),
        status=jnp.where(has_failed, FAILED, status),
        crossing_time=jnp.where(jnp.isfinite(crossing_time), air.elapsed + crossing_time, air.crossing_time),
        flights=air.flights + 1,
        open=has_landed,
        log_rates=air.log_rates + jnp.where(has_landed, log_rate, 0.0),
        quadratures=None if air.quadratures is None else quadratures_after(body, free, air.quadratures, duration),
    )
    return air_after, has_landed


def land(scene: Scene[Top], air: Air) -> Air:
    """The impact of the sphere that has reached the plane; a slow rebound closes the contact."""
    contact_ball, other_ball = own_and_other(scene.body, air.ball)
    blow = strike(scene, contact_ball, air.free)
    status = jnp.where(blow.fails, FAILED, air.status)
    after_impact = air._replace(free=blow.free, rising=blow.rebounds, open=blow.rebounds, status=status)
    if other_ball is not None:
        # The other sphere also strikes if it is at the plane, or the top comes to rest on both.
        leaning = LeaningDynamics.of(scene)
        stopped_body, dissipates = leaning.stopped(air.free)
        rates = (free.gap_rate(scene.body, other_ball) for free in (air.free, blow.free))
        falls, rests = blow.at_other(scene, air.free.gap(other_ball), *rates, may_rest=dissipates)
        free, number, definite = leaning.settled(stopped_body)
        after_impact = after_impact._replace(
            free=select(rests, free, blow.free),
            ball=jnp.where(rests, number, jnp.where(falls, 1 - air.ball, air.ball)),
            falls=falls,
            status=jnp.where(rests & ~definite & (status == RUNNING), UNRESOLVED, status),
            open=blow.rebounds | falls,
        )
    if air.quadratures is not None:
        before, after = (free.energy(scene.body, scene.gravity) for free in (air.free, after_impact.free))
        *path, work = air.quadratures
        after_impact = after_impact._replace(quadratures=jnp.stack([*path, work + (after - before)]))
    return after_impact._replace(open=after_impact.open & ~blow.fails)


def quadratures_after(body: Top, free: FreeBody, quadratures: Passive, time: Number) -> Passive:
    """The passive quadratures after some time [s] in flight."""
    x, y, *c_vector, angle, work = quadratures
    u1, u2, _ = free.velocity
    spin_rate = dot(free.axis, free.momentum) / body.I3
    # c moves with the axis without rotation about the axis: its angular velocity is L / I1 - (e.L / I1) e, that of the axis
    # about L, without the component along e.
    direction, rate = precession(body, free)
    about_axis = turned(tuple(c_vector), free.axis, -dot(free.axis, free.momentum) / body.I1 * time)
    c_vector = turned(about_axis, direction, rate * time)
    return jnp.stack([x + u1 * time, y + u2 * time, *c_vector, angle + spin_rate * time, work + 0.0 * time])


def clearance(dynamics: Dynamics, contact_ball: Ball, other_ball: Ball, state: States) -> Float[Array, "..."]:
    """Distance of the other sphere from the plane as a fraction of the radius of the touching sphere, plus the
    round-off allowed at lift-off.
    """
    _, e, L, _ = parts(state[:OWN])
    rate = (other_ball.offset - contact_ball.offset) * dynamics.per_transverse * (L[0] * e[1] - L[1] * e[0])
    return height(contact_ball, other_ball, state) / contact_ball.radius + still_parting(
        rate, dynamics.gravity, contact_ball.radius
    )


def height(contact_ball: Ball, other_ball: Ball, state: States) -> Float[Array, "..."]:
    """Distance [m] of the other sphere from the plane, for a top that stands on the sphere `contact_ball`."""
    return contact_ball.radius - other_ball.radius + (other_ball.offset - contact_ball.offset) * state[COS_THETA]


#: Most consecutive bounces before a run fails.
MOST_BOUNCES = 10_000

#: Angle by which the axis turns between the default output times of a flight [rad].
SHOWN = 0.4


class SlidingOnOne(InversionProblem):
    """Sliding on one of two spheres until theta reaches an angle, the contact is lost or jams, or the other sphere
    lands.
    """

    contact_ball: Ball = eqx.field(kw_only=True)
    other_ball: Ball = eqx.field(kw_only=True)

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        assert isinstance(self.dynamics, Dynamics)
        return (*super().margins(time, state), clearance(self.dynamics, self.contact_ball, self.other_ball, state))


class Slide(AbstractFlyingMode, AbstractHoppingMode):
    """Sliding on the sphere numbered `number`, in the order of `balls`, up to an angle of theta.

    `number` is an array, so that one program serves both spheres. With `last`, a run continues through the angle. A
    single run whose path is kept records its flights.
    """

    most_hops: ClassVar[int] = MOST_BOUNCES

    number: Int[Array, ""]
    last: bool = eqx.field(static=True)

    def problem(self, state: States) -> AbstractProblem:
        contact_ball, other_ball = own_and_other(self.scene.body, self.number)
        cos_angle = self.cos_angle_for(self.number == 1)
        contact = (standing_on(self.scene.dynamics, contact_ball), cos_angle, state[:OWN], self.scales[:OWN])
        problem = InversionProblem(*contact, flies=True)
        if other_ball is not None:
            problem = SlidingOnOne(*contact, flies=True, contact_ball=contact_ball, other_ball=other_ball)
        return self.extended(problem, Quadratures(of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        contact_ball, _ = own_and_other(self.scene.body, self.number)
        return shown(self.scene.body, FreeBody.of(self.scene.body, contact_ball, state), state[OWN:])

    def between(self, motion: tuple[FreeBody, Passive], passed: Float[Array, " times"]) -> Float[Array, "17 times"]:
        free, quadratures = motion
        free_after = flown(self.scene.body, self.scene.gravity, free, passed)
        return shown(self.scene.body, free_after, quadratures_after(self.scene.body, free, quadratures, passed))

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Fly, and bounce, until a sphere stays on the plane; or let the other sphere land if it touches the plane.

        Counts the flights.
        """
        start, record = self.lost(state), None
        if self.with_quadratures:
            flight = TransitionPath(start.elapsed, (start.free, start.quadratures), start.flights)
            record = jax.tree.map(lambda leaf: jnp.zeros((MOST_BOUNCES, *leaf.shape), leaf.dtype), flight)
            record = record._replace(ends=jnp.inf + record.ends)
        air, record = self.all_hops(start, left, record, self._with_flight)
        return self.closed(air)._replace(record=record)

    def _with_flight(
        self, record: TransitionPath | None, air_before: Air, air_after: Air, _: Air
    ) -> TransitionPath | None:
        """The record of a single run, if there is one, with the flight between two states added, if there was one."""
        if record is None:
            return None
        place, has_flown = air_before.flights[0], air_after.flights > air_before.flights
        angle = cone(self.scene.body, air_before.free).rate * (air_after.elapsed - air_before.elapsed)
        new = TransitionPath(
            jnp.where(has_flown, air_after.elapsed, jnp.inf),
            (air_before.free, air_before.quadratures),
            1 + (angle / SHOWN).astype(int),
        )
        return jax.tree.map(lambda leaves, leaf: leaves.at[place].set(leaf), record, new)

    def lost(self, state: States) -> Air:
        """The top at the end of sliding: its contact is lost or jams, or the other sphere is at the plane."""
        contact_ball, other_ball = own_and_other(self.scene.body, self.number)
        zero, dynamics = jnp.zeros_like(state[0]), standing_on(self.scene.dynamics, contact_ball)
        falls, ball, jams = None, jnp.broadcast_to(self.number, zero.shape), dynamics.loss(state) > 0
        if other_ball is not None:
            falls = clearance(dynamics, contact_ball, other_ball, state) <= dynamics.contact_margin(state)
            ball, jams = jnp.where(falls, 1 - self.number, self.number), jams & ~falls
        # A launch beyond the angle and without contact ends at once.
        is_beyond = ~jams & (state[COS_THETA] <= self.cos_angle) & (not self.last)
        return Air(
            free=FreeBody.of(self.scene.body, contact_ball, state),
            elapsed=zero,
            ball=ball,
            rising=jnp.zeros(zero.shape, bool),
            falls=falls,
            status=jnp.where(is_beyond, CROSSED, jnp.where(jams, LEFT_DOMAIN, RUNNING)),
            crossing_time=jnp.where(is_beyond, zero, jnp.inf),
            flights=jnp.zeros(zero.shape, int),
            open=~jams & ~is_beyond,
            log_rates=zero,
            quadratures=state[OWN:] if self.with_quadratures else None,
        )

    def hop(self, air: Air, left: Lanes) -> tuple[Air, Air]:
        """One flight of a top whose contact is open, and the impact at its end."""
        air_after, has_landed = take_flight(self.scene, air, self.cos_angle, left, self.last)
        if air.falls is not None:
            air_after, has_landed = select(air.falls, air, air_after), air.falls | has_landed
        air_landed = land(self.scene, air_after)
        if air.falls is not None:
            # The stem begins to carry the top as it bears a force or an impulse, if the sphere was the last to touch before.
            # A sphere that is about to strike without a flight is not the sphere that touched last.
            last_ball = jnp.where(air.falls, 1 - air.ball, air.ball)
            # On both spheres, the stem carries a part of the top, but the sphere still touches.
            rests_on_stem = ~air_landed.open & (air_landed.ball == 1 if self.last else air_landed.ball != 0)
            takes_over = (last_ball == 0) & ((air_after.ball == 1) | rests_on_stem) & self.awaits_stem
            air_landed = air_landed._replace(
                crossing_time=jnp.where(takes_over, air_landed.elapsed, air_landed.crossing_time),
                status=air_landed.status if self.last else jnp.where(takes_over, CROSSED, air_landed.status),
                open=air_landed.open if self.last else air_landed.open & ~takes_over,
            )
        return air_after, select(air.open, select(has_landed, air_landed, air_after), air)

    def motion_in(self, air: Air) -> tuple[FreeBody, Passive | None]:
        return air.free, air.quadratures

    def closed(self, air: Air) -> Transition:
        """The transition for a top that has returned to the plane, or whose run has ended."""
        status, state = jnp.where(air.open, UNRESOLVED, air.status), air.free.contact_state
        if air.quadratures is not None:
            state = jnp.concatenate([state, air.quadratures])
        counts = air.flights[None]
        return Transition(air.ball, state, air.elapsed, status, air.crossing_time, counts, log_rates=air.log_rates)


class Lean(AbstractFlyingMode):
    """Sliding on both spheres; numbered after the modes of the single spheres. `last`: as for `Slide`."""

    last: bool = eqx.field(static=True)

    # Few tops come to rest on both spheres.
    rare = True

    def problem(self, state: States) -> AbstractProblem:
        # The stem carries a part of the top, so its first event has happened; the sphere still touches, so, with `last`,
        # that event has not.
        contact = (LeaningDynamics.of(self.scene), self.cos_angle_for(not self.last), state[:OWN], self.scales[:OWN])
        return self.extended(InversionProblem(*contact, flies=True), Quadratures(of_mass=True), state)

    def shown(self, state: Float[Array, "15 times"]) -> Float[Array, "17 times"]:
        return shown(self.scene.body, FreeBody.of(self.scene.body, balls(self.scene.body)[0], state), state[OWN:])

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Slide on the sphere whose normal force has not vanished."""
        leaning, body = LeaningDynamics.of(self.scene), self.scene.body
        number, free = leaning.heavier(state), leaning.at_rest(FreeBody.of(body, balls(body)[0], state))
        state = jnp.concatenate([free.contact_state, state[OWN:]])
        zero = jnp.zeros_like(state[0])
        running, zeros = jnp.full(zero.shape, RUNNING), jnp.zeros((1, *zero.shape), int)
        leaves_sphere = (number == 1) & self.awaits_stem & self.last
        return Transition(number, state, zero, running, jnp.where(leaves_sphere, 0.0, jnp.inf), zeros)


def hopping_modes(scene: Scene[Top], problem: InversionProblem, last: bool, with_quadratures: bool = False) -> Started:
    """The modes of runs, sliding on each sphere and on both if there are two; and the index of the mode in which each
    starts.

    **Arguments:**

    - `scene`: a scene with `contact="hybrid"`; `problem`: the problem of its launches, which stand on their lower
      sphere.
    - `last`: whether the last crossing counts; `with_quadratures`: as for `AbstractFlyingMode`.
    """
    spheres, arguments = balls(scene.body), (scene, problem.scales, problem.cos_angle, with_quadratures)
    slides = tuple(Slide(*arguments, jnp.asarray(number), last) for number in range(len(spheres)))
    if len(spheres) == 1:
        return slides, jnp.zeros(problem.states.shape[1:], int)
    return (*slides, Lean(*arguments, last)), _first_mode(scene.body, problem.states)


@compiled_setup
def _first_mode(body: Top, states: States) -> Int[Array, " cells"]:
    """The number of the lower of the two spheres."""
    main, stem = balls(body)
    return (height(main, stem, states) < 0.0).astype(int)


def shown(body: Top, free: FreeBody, quadratures: Passive) -> Float[Array, "17 ..."]:
    """The output rows of a body that may fly.

    **Arguments:** `quadratures`: position (x, y) of the centre of mass [m], the vector c of `problems.py`, spin
    angle [rad], work [J].

    **Returns:** the state as in contact; position (x, y) of the sphere's centre, c, spin angle, work; and the distance
    of the top's own sphere from the plane [m] with its rate [m/s].
    """
    main = balls(body)[0]
    place = [x + main.offset * e for x, e in zip(quadratures[:2], free.axis[:2], strict=True)]
    distance = (free.gap(main), free.gap_rate(body, main))
    rows = (*free.velocity[:2], *free.axis, *free.momentum, *place, *quadratures[2:], *distance)
    return jnp.stack(jnp.broadcast_arrays(*rows))
