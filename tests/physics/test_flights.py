"""Flights and impacts by themselves: brute force, the free motion, another program's impacts, conservation."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from hop_reference import Case
from hop_reference import resolve_impact as reference_impact
from stems import jellett
from test_hops import scene_of
from tops import rutstam_top

import tippe
from tippe.model.dynamics import angular_velocity
from tippe.modes.impact import FreeBody, balls, resolve_impact
from tippe.modes.plane import Descent, angle_reached, cone, flown, landing

search = eqx.filter_jit(landing)


def random_descents(count: int, seed: int) -> Descent:
    """Distances of every kind: high and low, fast and slow, with many waves and with less than one."""
    random = np.random.default_rng(seed)
    rate = 10.0 ** random.uniform(0.0, 3.0, count)
    amplitude, mode = 10.0 ** random.uniform(-4.0, -2.0, count), random.uniform(0.0, 2.0 * np.pi, count)
    start = np.where(random.random(count) < 0.5, 0.0, 10.0 ** random.uniform(-6.0, -2.0, count))
    speed = 1e-3 + random.uniform(0.0, 1.0, count) ** 3 - np.where(start > 0.0, 0.3, 0.0)
    cosine, sine = amplitude * np.cos(mode), amplitude * np.sin(mode)
    return Descent(*map(jnp.asarray, (start, speed, np.full(count, 9.81), rate, cosine, sine)))


def test_landings_by_brute_force():
    """No root is missed: the first sign change on 100 000 samples, refined, for 300 random flights."""
    descent = random_descents(300, 1)
    time, has_failed = search(descent, jnp.full(300, 10.0))
    assert not np.asarray(has_failed).any()
    assert np.isfinite(time).all()
    values = np.asarray(jax.jit(lambda d, t: d.value(t))(descent, time))
    assert np.max(np.abs(values)) < 1e-15
    for i in range(300):
        coefficients = [float(number[i]) for number in descent]

        def value(t, coefficients=coefficients):
            start, speed, gravity, rate, cosine, sine = coefficients
            swing = cosine * (1.0 - np.cos(rate * t)) + sine * (rate * t - np.sin(rate * t))
            return start + speed * t - gravity * t * t / 2.0 - swing

        samples = np.linspace(1e-9, 1.01 * float(time[i]), 100_000)
        negative = np.flatnonzero(value(samples) < -1e-16)
        assert negative.size
        assert abs(samples[negative[0]] - float(time[i])) <= 2.0 * (samples[1] - samples[0]) + 1e-9


def test_a_flight_that_begins_with_the_third_power_of_time():
    """From N = 0 the distance is c (W t)^3 / 6 - g t^2 (W t)^2 / 24 at first: a graze of 1e-9 m and its landing are seen."""
    rate, gravity = 200.0, 9.81
    slopes = -(10.0 ** np.linspace(-7.0, -5.0, 300))
    one = np.ones(300)
    descent = Descent(
        *map(jnp.asarray, (0 * one, 0 * one, gravity * one, rate * one, -gravity / rate**2 * one, slopes))
    )
    time, has_failed = search(descent, jnp.asarray(one))
    assert not np.asarray(has_failed).any()
    first_order = 4.0 * -slopes * rate / gravity
    assert_close(time, first_order, rtol=2e-2)


def test_flight_is_the_free_motion():
    """Closed form against Euler's equations, differentiated: e' = L x e / I1, and the angle's time is when it is reached."""
    body = rutstam_top()
    free = free_bodies(6, 2)
    time = jnp.linspace(0.01, 0.05, 6)
    body_after, rate = jax.jvp(lambda t: flown(body, 9.81, free, t), (time,), (jnp.ones(6),))
    e, L = np.stack(body_after.axis), np.stack(free.momentum)
    assert_close(np.stack(rate.axis), np.cross(L, e, axis=0) / float(body.I1), atol=1e-9)
    assert_close(np.linalg.norm(e, axis=0), 1.0, atol=1e-14)
    assert_close(body_after.energy(body, 9.81), free.energy(body, 9.81), rtol=1e-13)
    for last in (False, True):
        cos_angle = cone(body, free).parallel[2] + 0.01
        times = angle_reached(body, free, cos_angle, 0.5 * jnp.ones(6), last)
        assert np.isfinite(times).all()
        height, height_rate = jax.jvp(lambda t: flown(body, 9.81, free, t).axis[2], (times,), (jnp.ones(6),))
        assert_close(height, cos_angle, atol=1e-12)
        assert np.all(height_rate < 0.0)


# Impact


def free_bodies(count: int, seed: int) -> FreeBody:
    """Bodies that fall on the plane, with any axis and turning fast."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=(3, count))
    axis /= np.linalg.norm(axis, axis=0)
    momentum = 3.2e-6 * 100.0 * random.normal(size=(3, count))
    velocity = np.concatenate([random.normal(scale=0.3, size=(2, count)), -3.0 * np.ones((1, count))])
    return FreeBody(
        tuple(jnp.asarray(velocity)), jnp.full(count, 0.02), tuple(jnp.asarray(axis)), tuple(jnp.asarray(momentum))
    )


@pytest.mark.parametrize("slip_speed", [0.0, pytest.param(0.05, marks=pytest.mark.slow)])
def test_impacts(slip_speed):
    """Against a matrix exponential or SciPy; Newton's restitution; Jellett's quantity to round-off; energy never grows."""
    case = Case(0.02, 0.02, 0.006, 131 / 350 * 8e-6, 3.2e-6, 0.3, 0.1, 0.0, slip_speed=slip_speed)
    body, friction = rutstam_top(), scene_of(case).friction
    ball, free = balls(body)[0], free_bodies(60, 3)
    restitution = jnp.asarray(np.repeat([0.0, 0.5, 1.0], 20))
    free_after, jams = eqx.filter_jit(resolve_impact)(body, friction, ball, free, restitution)
    assert not np.asarray(jams).any()
    assert_close(jellett(ball, free_after), jellett(ball, free), atol=1e-20)
    has_failed = free.energy(body, 9.81) - free_after.energy(body, 9.81)
    assert np.min(has_failed) > -1e-12
    # Newton's restitution, unless it would take energy from nowhere.
    approach, rebound = -free.gap_rate(body, ball), free_after.gap_rate(body, ball)
    is_exact = np.abs(rebound - restitution * approach) < 1e-12
    assert is_exact[:40].all()
    assert is_exact.sum() > 50
    assert np.all((rebound <= restitution * approach + 1e-12) & (is_exact | (np.abs(has_failed) < 1e-9)))
    state_before, end_state = state_of(body, free), state_of(body, free_after)
    for i in np.flatnonzero(is_exact)[::6]:
        single_case = Case(**{**case.__dict__, "restitution": float(restitution[i])})
        expected, _ = reference_impact(single_case, state_before[:, i], (0.006, 0.02))
        assert_close(end_state[:, i], expected, rtol=1e-9, atol=1e-9)


def state_of(body: tippe.Top, free: FreeBody) -> np.ndarray:
    """Place, velocity, axis and angular velocity, as the reference has them."""
    turning = angular_velocity(body, free.axis, free.momentum)
    zero = jnp.zeros_like(free.height)
    return np.stack([zero, zero, free.height, *free.velocity, *free.axis, *turning])
