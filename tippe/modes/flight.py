"""Flight in closed form: the centre of mass on a parabola, the axis on a cone about the angular momentum.

Between two contacts, L is constant and e turns about it at the rate |L| / I1 (`tippe.md`, section 3). The distance of a
sphere from the plane is therefore a parabola plus a cosine. Between inflections, which are known, its slope is
monotone: each interval has at most one minimum, and at most one root between points of different sign. The search for
the landing is therefore complete.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import Vector, cross, dot, scale, subtract, sum_vectors
from nonholonomic.integration.zeros import halved

from ..model.top import Top
from .free_body import Ball, FreeBody, gap, gap_rate

Cells = Float[Array, " cells"]

#: Most intervals between inflections that are searched for a landing; the search skips those where the top is too high.
MOST_STRETCHES = 20_000


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

    start: Cells
    speed: Cells
    gravity: Cells
    rate: Cells
    cosine: Cells
    sine: Cells

    def value(self, time: Cells) -> Cells:
        angle = self.rate * time
        swing = 2.0 * self.cosine * jnp.sin(0.5 * angle) ** 2 + self.sine * angle_less_sine(angle)
        return self.start + time * (self.speed - 0.5 * self.gravity * time) - swing

    def slope(self, time: Cells) -> Cells:
        angle = self.rate * time
        swing = self.cosine * jnp.sin(angle) + self.sine * 2.0 * jnp.sin(0.5 * angle) ** 2
        return self.speed - self.gravity * time - self.rate * swing


class Flight(NamedTuple):
    """How a flight ended: its duration [s], whether a sphere landed, and which sphere.

    `lost` is true where the search for the landing failed; `log_rate` is the logarithm of the speed of landing.
    """

    duration: Cells
    landed: Bool[Array, " cells"]
    ball: Int[Array, " cells"]
    lost: Bool[Array, " cells"]
    log_rate: Cells


def angle_less_sine(angle: Float[Array, "..."]) -> Float[Array, "..."]:
    """x - sin x, without cancellation where x is small."""
    square = angle * angle
    series = 1.0
    for k in (14, 12, 10, 8, 6, 4):
        series = 1.0 - square / (k * (k + 1)) * series
    return jnp.where(jnp.abs(angle) < 0.5, angle * square / 6.0 * series, angle - jnp.sin(angle))


def cone(body: Top, free: FreeBody) -> Cone:
    """Motion of the axis of a free body."""
    size = jnp.sqrt(dot(free.momentum, free.momentum))
    is_still = size == 0.0
    direction = scale(1.0 / jnp.where(is_still, 1.0, size), free.momentum)
    parallel = scale(dot(direction, free.axis), direction)
    perpendicular = tuple(subtract(e, p) for e, p in zip(free.axis, parallel, strict=True))
    return Cone(size / body.I1, parallel, perpendicular, cross(direction, free.axis))


def flown(body: Top, gravity: Float[Array, "..."], free: FreeBody, time: Float[Array, "..."]) -> FreeBody:
    """A free body after a time [s]."""
    precession = cone(body, free)
    angle = precession.rate * time
    axis_parts = (
        precession.parallel,
        scale(jnp.cos(angle), precession.perpendicular),
        scale(jnp.sin(angle), precession.binormal),
    )
    u1, u2, u3 = free.velocity
    height = free.height + time * (u3 - 0.5 * gravity * time)
    return FreeBody((u1, u2, u3 - gravity * time), height, sum_vectors(*axis_parts), free.momentum)


def c_in_flight(body: Top, free: FreeBody, vector: Vector, time: Float[Array, "..."]) -> Vector:
    """A vector across the axis after a time [s]; it moves with the axis without rotation about the axis.

    Its angular velocity is L / I1 - (e.L / I1) e: that of the axis about L, without the component along e.
    """
    size = jnp.sqrt(dot(free.momentum, free.momentum))
    direction = scale(1.0 / jnp.where(size == 0.0, 1.0, size), free.momentum)
    about_axis = turned(vector, free.axis, -dot(free.axis, free.momentum) / body.I1 * time)
    return turned(about_axis, direction, size / body.I1 * time)


def turned(vector: Vector, axis: Vector, angle: Float[Array, "..."]) -> Vector:
    """A vector turned about a unit axis by an angle [rad]."""
    parallel, binormal = scale(dot(axis, vector), axis), cross(axis, vector)
    perpendicular = tuple(subtract(v, p) for v, p in zip(vector, parallel, strict=True))
    return sum_vectors(parallel, scale(jnp.cos(angle), perpendicular), scale(jnp.sin(angle), binormal))


def fly(
    body: Top,
    gravity: Float[Array, "..."],
    spheres: tuple[Ball, ...],
    free: FreeBody,
    last_ball: Int[Array, " cells"],
    rising: Bool[Array, " cells"],
    max_time: Cells,
) -> Flight:
    """Fly until a sphere lands, for a limited time.

    **Arguments:**

    - `spheres`: the spheres that can land.
    - `free`: the body at the start.
    - `last_ball`: index of the sphere that has just left the plane.
    - `rising`: whether that sphere leaves with a speed, as after an impact. Otherwise the sphere was at rest when the
      normal force vanished, and its distance grows with the third power of time.
    - `max_time`: time [s] at which the flight is cut off.

    **Returns:** a `Flight`.
    """
    times, speeds, has_failed = [], [], jnp.zeros(max_time.shape, bool)
    for number, ball in enumerate(spheres):
        descent = _descent(body, gravity, ball, free, (last_ball == number) & ~rising, last_ball == number)
        # The search is by bisection, which has no derivative.
        time, given_up = landing(*stop_gradient((descent, max_time)))
        times.append(landed_at(descent, time))
        speeds.append(-descent.slope(jnp.where(jnp.isfinite(time), times[-1], 0.0)))
        has_failed |= given_up
    first = jnp.argmin(jnp.stack(times), axis=0)
    time = jnp.min(jnp.stack(times), axis=0)
    has_landed = time <= max_time
    duration = jnp.where(has_landed, time, max_time)
    speed = jnp.take_along_axis(jnp.stack(speeds), first[None], axis=0)[0]
    log_rate = jnp.log(jnp.maximum(speed, jnp.finfo(speed.dtype).tiny))
    return Flight(duration, has_landed, first, has_failed, log_rate)


def _descent(
    body: Top,
    gravity: Float[Array, "..."],
    ball: Ball,
    free: FreeBody,
    at_rest: Bool[Array, " cells"],
    is_touching: Bool[Array, " cells"],
) -> Descent:
    """The distance of a sphere from the plane in flight."""
    precession = cone(body, free)
    start = jnp.where(is_touching, 0.0, greatest(gap(ball, free), 0.0))
    speed = gap_rate(body, ball, free)
    speed = jnp.where(at_rest, 0.0, jnp.where(is_touching, greatest(speed, 0.0), speed))
    cosine, sine = ball.offset * precession.perpendicular[2], ball.offset * precession.binormal[2]
    # Where the normal force vanishes, the distance has no curvature: the remainder is round-off, and may only rise.
    upper_bound = -gravity / jnp.maximum(precession.rate**2, jnp.finfo(cosine.dtype).tiny)
    cosine = jnp.where(at_rest, jnp.minimum(cosine, upper_bound), cosine)
    gravity = jnp.broadcast_to(gravity, start.shape)
    return Descent(start, speed, gravity, precession.rate, cosine, sine)


def landing(descent: Descent, max_time: Cells) -> tuple[Cells, Bool[Array, " cells"]]:
    """Time at which the distance first falls below zero, after a start at zero or above.

    **Arguments:** `max_time`: time [s] to search.

    **Returns:** the time [s], infinite if it is more than `max_time`; and whether the search failed.
    """
    g, rate, amplitude = descent.gravity, descent.rate, jnp.hypot(descent.cosine, descent.sine)
    # The distance lies between two parabolas, mean +- amplitude.
    mean, drift = descent.start - descent.cosine, descent.speed - descent.sine * rate
    end = jnp.minimum(max_time, _last_root(mean + amplitude, drift, g) * (1.0 + 1e-9))
    high_from, high_to = _roots(mean - amplitude, drift, g)
    # The distance is convex where rate^2 amplitude cos(rate t - phase) < -g, for angles between bend and 2 pi - bend.
    mode = jnp.arctan2(descent.sine, descent.cosine)
    ratio = g / jnp.maximum(rate**2 * amplitude, jnp.finfo(g.dtype).tiny)
    bend = jnp.arccos(-jnp.minimum(ratio, 1.0))
    has_no_inflection = ratio >= 1.0

    def next_inflection(time: Cells) -> Cells:
        angles = [jnp.mod(mode + side * bend - rate * time, 2.0 * jnp.pi) for side in (1.0, -1.0)]
        # Skip the inflection just reached.
        angles = [jnp.where(angle < 1e-9, 2.0 * jnp.pi, angle) for angle in angles]
        return jnp.where(
            has_no_inflection, jnp.inf, time + jnp.minimum(*angles) / jnp.where(has_no_inflection, 1.0, rate)
        )

    def search(carry):
        low, high, located, is_over, count = carry
        start = jnp.where((low > high_from) & (low < high_to), high_to, low)
        next_time = jnp.minimum(next_inflection(start), end)
        ends_below = descent.value(next_time) < 0.0
        dips = (descent.slope(start) < 0.0) & (descent.slope(next_time) > 0.0)
        bottom = halved(lambda t: descent.slope(t) < 0.0, start, next_time)[1]
        dips &= descent.value(bottom) < 0.0
        is_hit = ends_below | dips
        active = ~located & ~is_over
        low = jnp.where(active, jnp.where(is_hit, start, next_time), low)
        high = jnp.where(active & is_hit, jnp.where(dips, bottom, next_time), high)
        return low, high, located | (active & is_hit), is_over | (active & ~is_hit & (next_time >= end)), count + 1

    def searching(carry):
        _, _, located, is_over, count = carry
        return jnp.any(~located & ~is_over) & (count < MOST_STRETCHES)

    zero, false = jnp.zeros_like(end), jnp.zeros(end.shape, bool)
    low, high, located, is_over, _ = jax.lax.while_loop(searching, search, (zero, zero, false, false, 0))
    # At the very start, the distance is zero: it must have been positive since.
    time = halved(lambda t: descent.value(t) >= 0.0, low, high)[1]
    return jnp.where(located, time, jnp.inf), ~located & ~is_over


def landed_at(descent: Descent, time: Cells) -> Cells:
    """A time at which the distance is zero, with its derivatives (implicit function theorem)."""
    value, slope = descent.value(time), stop_gradient(descent.slope(time))
    is_regular = jnp.isfinite(time) & (slope < 0.0)
    return time - jnp.where(is_regular, (value - stop_gradient(value)) / jnp.where(is_regular, slope, 1.0), 0.0)


def _roots(height: Cells, speed: Cells, gravity: Cells) -> tuple[Cells, Cells]:
    """Times between which a body thrown from a height is above zero; infinite if it never is."""
    square = speed**2 + 2.0 * gravity * height
    root = jnp.sqrt(greatest(square, 0.0))
    is_below = square <= 0.0
    return (
        jnp.where(is_below, jnp.inf, (speed - root) / gravity),
        jnp.where(is_below, jnp.inf, (speed + root) / gravity),
    )


def _last_root(height: Cells, speed: Cells, gravity: Cells) -> Cells:
    """Time at which a body thrown from a height, nonnegative up to round-off, is at zero again."""
    return (speed + jnp.sqrt(greatest(speed**2 + 2.0 * gravity * height, 0.0))) / gravity


def angle_reached(body: Top, free: FreeBody, cos_angle: Float[Array, "..."], horizon: Cells, last: bool) -> Cells:
    """Time in flight at which theta rises through an angle, for the first or for the last time; infinite if theta does
    not reach the angle by `horizon`.

    Along the normal the axis is a constant plus a cosine, so the times are known in closed form.
    """
    precession = cone(body, free)
    height = jnp.hypot(precession.perpendicular[2], precession.binormal[2])
    part = (cos_angle - precession.parallel[2]) / jnp.maximum(height, jnp.finfo(horizon.dtype).tiny)
    crosses = (jnp.abs(part) < 1.0) & (precession.rate > 0.0)
    angle = jnp.arctan2(precession.binormal[2], precession.perpendicular[2]) + jnp.arccos(jnp.clip(part, -1.0, 1.0))
    turn, rate = 2.0 * jnp.pi, jnp.where(precession.rate > 0.0, precession.rate, 1.0)
    angle = jnp.mod(angle, turn)
    if last:
        angle = angle + turn * jnp.floor((rate * horizon - angle) / turn)
    time = angle / rate
    return jnp.where(crosses & (time >= 0.0) & (time <= horizon), time, jnp.inf)
