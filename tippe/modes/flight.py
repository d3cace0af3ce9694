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

from nonholonomic.geometry import Vector, cross, dot, scale, subtract, sum_vectors
from nonholonomic.integration.zeros import halved
from nonholonomic.xla_cpu import greatest

from ..model.top import Top
from .free_body import Ball, FreeBody, gap, gap_rate

Cells = Float[Array, " cells"]

#: Most intervals between inflections that are searched for a landing; the search skips those where the top is too high.
MOST_STRETCHES = 20_000


class Cone(NamedTuple):
    """Motion of the axis: e(t) = `along` + `across` cos(W t) + `ahead` sin(W t), where W is `rate` [rad/s]."""

    rate: Float[Array, "..."]
    along: Vector
    across: Vector
    ahead: Vector


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
    still = size == 0.0
    direction = scale(1.0 / jnp.where(still, 1.0, size), free.momentum)
    along = scale(dot(direction, free.axis), direction)
    across = tuple(subtract(e, p) for e, p in zip(free.axis, along, strict=True))
    return Cone(size / body.I1, along, across, cross(direction, free.axis))


def flown(body: Top, gravity: Float[Array, "..."], free: FreeBody, time: Float[Array, "..."]) -> FreeBody:
    """A free body after a time [s]."""
    precession = cone(body, free)
    angle = precession.rate * time
    turned = (precession.along, scale(jnp.cos(angle), precession.across), scale(jnp.sin(angle), precession.ahead))
    u1, u2, u3 = free.velocity
    height = free.height + time * (u3 - 0.5 * gravity * time)
    return FreeBody((u1, u2, u3 - gravity * time), height, sum_vectors(*turned), free.momentum)


def c_in_flight(body: Top, free: FreeBody, across: Vector, time: Float[Array, "..."]) -> Vector:
    """A vector across the axis after a time [s]; it moves with the axis without rotation about the axis.

    Its angular velocity is L / I1 - (e.L / I1) e: that of the axis about L, without the component along e.
    """
    size = jnp.sqrt(dot(free.momentum, free.momentum))
    direction = scale(1.0 / jnp.where(size == 0.0, 1.0, size), free.momentum)
    about_axis = turned(across, free.axis, -dot(free.axis, free.momentum) / body.I1 * time)
    return turned(about_axis, direction, size / body.I1 * time)


def turned(vector: Vector, axis: Vector, angle: Float[Array, "..."]) -> Vector:
    """A vector turned about a unit axis by an angle [rad]."""
    along, ahead = scale(dot(axis, vector), axis), cross(axis, vector)
    across = tuple(subtract(v, p) for v, p in zip(vector, along, strict=True))
    return sum_vectors(along, scale(jnp.cos(angle), across), scale(jnp.sin(angle), ahead))


def fly(
    body: Top,
    gravity: Float[Array, "..."],
    spheres: tuple[Ball, ...],
    free: FreeBody,
    parted: Int[Array, " cells"],
    rising: Bool[Array, " cells"],
    most: Cells,
) -> Flight:
    """Fly until a sphere lands, for a limited time.

    **Arguments:**

    - `spheres`: the spheres that can land.
    - `free`: the body at the start.
    - `parted`: index of the sphere that has just left the plane.
    - `rising`: whether that sphere leaves with a speed, as after an impact. Otherwise the sphere was at rest when the
      normal force vanished, and its distance grows with the third power of time.
    - `most`: time [s] at which the flight is cut off.

    **Returns:** a `Flight`.
    """
    times, speeds, lost = [], [], jnp.zeros(most.shape, bool)
    for number, ball in enumerate(spheres):
        descent = _descent(body, gravity, ball, free, (parted == number) & ~rising, parted == number)
        # The search is by bisection, which has no derivative.
        time, given_up = landing(*stop_gradient((descent, most)))
        times.append(landed_at(descent, time))
        speeds.append(-descent.slope(jnp.where(jnp.isfinite(time), times[-1], 0.0)))
        lost |= given_up
    first = jnp.argmin(jnp.stack(times), axis=0)
    time = jnp.min(jnp.stack(times), axis=0)
    landed = time <= most
    duration = jnp.where(landed, time, most)
    speed = jnp.take_along_axis(jnp.stack(speeds), first[None], axis=0)[0]
    log_rate = jnp.log(jnp.maximum(speed, jnp.finfo(speed.dtype).tiny))
    return Flight(duration, landed, first, lost, log_rate)


def _descent(
    body: Top,
    gravity: Float[Array, "..."],
    ball: Ball,
    free: FreeBody,
    at_rest: Bool[Array, " cells"],
    touching: Bool[Array, " cells"],
) -> Descent:
    """The distance of a sphere from the plane in flight."""
    precession = cone(body, free)
    start = jnp.where(touching, 0.0, greatest(gap(ball, free), 0.0))
    speed = gap_rate(body, ball, free)
    speed = jnp.where(at_rest, 0.0, jnp.where(touching, greatest(speed, 0.0), speed))
    cosine, sine = ball.offset * precession.across[2], ball.offset * precession.ahead[2]
    # Where the normal force vanishes, the distance has no curvature: the remainder is round-off, and may only rise.
    unbent = -gravity / jnp.maximum(precession.rate**2, jnp.finfo(cosine.dtype).tiny)
    cosine = jnp.where(at_rest, jnp.minimum(cosine, unbent), cosine)
    gravity = jnp.broadcast_to(gravity, start.shape)
    return Descent(start, speed, gravity, precession.rate, cosine, sine)


def landing(descent: Descent, most: Cells) -> tuple[Cells, Bool[Array, " cells"]]:
    """Time at which the distance first falls below zero, after a start at zero or above.

    **Arguments:** `most`: time [s] to search.

    **Returns:** the time [s], infinite if it is more than `most`; and whether the search failed.
    """
    g, rate, amplitude = descent.gravity, descent.rate, jnp.hypot(descent.cosine, descent.sine)
    # The distance lies between two parabolas, mean +- amplitude.
    mean, drift = descent.start - descent.cosine, descent.speed - descent.sine * rate
    end = jnp.minimum(most, _last_root(mean + amplitude, drift, g) * (1.0 + 1e-9))
    high_from, high_to = _roots(mean - amplitude, drift, g)
    # The distance is convex where rate^2 amplitude cos(rate t - phase) < -g, for angles between bend and 2 pi - bend.
    mode = jnp.arctan2(descent.sine, descent.cosine)
    ratio = g / jnp.maximum(rate**2 * amplitude, jnp.finfo(g.dtype).tiny)
    bend = jnp.arccos(-jnp.minimum(ratio, 1.0))
    straight = ratio >= 1.0

    def next_inflection(time: Cells) -> Cells:
        ahead = [jnp.mod(mode + side * bend - rate * time, 2.0 * jnp.pi) for side in (1.0, -1.0)]
        # Skip the inflection just reached.
        ahead = [jnp.where(angle < 1e-9, 2.0 * jnp.pi, angle) for angle in ahead]
        return jnp.where(straight, jnp.inf, time + jnp.minimum(*ahead) / jnp.where(straight, 1.0, rate))

    def search(carry):
        low, high, located, over, count = carry
        begin = jnp.where((low > high_from) & (low < high_to), high_to, low)
        stop = jnp.minimum(next_inflection(begin), end)
        falls = descent.value(stop) < 0.0
        dips = (descent.slope(begin) < 0.0) & (descent.slope(stop) > 0.0)
        bottom = halved(lambda t: descent.slope(t) < 0.0, begin, stop)[1]
        dips &= descent.value(bottom) < 0.0
        hit = falls | dips
        active = ~located & ~over
        low = jnp.where(active, jnp.where(hit, begin, stop), low)
        high = jnp.where(active & hit, jnp.where(dips, bottom, stop), high)
        return low, high, located | (active & hit), over | (active & ~hit & (stop >= end)), count + 1

    def searching(carry):
        _, _, located, over, count = carry
        return jnp.any(~located & ~over) & (count < MOST_STRETCHES)

    zero, no = jnp.zeros_like(end), jnp.zeros(end.shape, bool)
    low, high, located, over, _ = jax.lax.while_loop(searching, search, (zero, zero, no, no, 0))
    # At the very start, the distance is zero: it must have been positive since.
    time = halved(lambda t: descent.value(t) >= 0.0, low, high)[1]
    return jnp.where(located, time, jnp.inf), ~located & ~over


def landed_at(descent: Descent, time: Cells) -> Cells:
    """A time at which the distance is zero, with its derivatives (implicit function theorem)."""
    value, slope = descent.value(time), stop_gradient(descent.slope(time))
    known = jnp.isfinite(time) & (slope < 0.0)
    return time - jnp.where(known, (value - stop_gradient(value)) / jnp.where(known, slope, 1.0), 0.0)


def _roots(height: Cells, speed: Cells, gravity: Cells) -> tuple[Cells, Cells]:
    """Times between which a body thrown from a height is above zero; infinite if it never is."""
    square = speed**2 + 2.0 * gravity * height
    root = jnp.sqrt(greatest(square, 0.0))
    never = square <= 0.0
    return (
        jnp.where(never, jnp.inf, (speed - root) / gravity),
        jnp.where(never, jnp.inf, (speed + root) / gravity),
    )


def _last_root(height: Cells, speed: Cells, gravity: Cells) -> Cells:
    """Time at which a body thrown from a height, nonnegative up to round-off, is at zero again."""
    return (speed + jnp.sqrt(greatest(speed**2 + 2.0 * gravity * height, 0.0))) / gravity


def angle_reached(body: Top, free: FreeBody, cos_angle: Float[Array, "..."], until: Cells, last: bool) -> Cells:
    """Time in flight at which theta rises through an angle, for the first or for the last time; infinite if theta does
    not reach the angle by `until`.

    Along the normal the axis is a constant plus a cosine, so the times are known in closed form.
    """
    precession = cone(body, free)
    height = jnp.hypot(precession.across[2], precession.ahead[2])
    part = (cos_angle - precession.along[2]) / jnp.maximum(height, jnp.finfo(until.dtype).tiny)
    crosses = (jnp.abs(part) < 1.0) & (precession.rate > 0.0)
    angle = jnp.arctan2(precession.ahead[2], precession.across[2]) + jnp.arccos(jnp.clip(part, -1.0, 1.0))
    turn, rate = 2.0 * jnp.pi, jnp.where(precession.rate > 0.0, precession.rate, 1.0)
    angle = jnp.mod(angle, turn)
    if last:
        angle = angle + turn * jnp.floor((rate * until - angle) / turn)
    time = angle / rate
    return jnp.where(crosses & (time >= 0.0) & (time <= until), time, jnp.inf)
