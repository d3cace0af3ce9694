"""The frictionless and the rolling top as quadratures: theta(t) against integration, and the constants they rest on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from quadrature import FrictionlessNutation, RollingNutation, rolling_rate, swing
from scipy.integrate import solve_ivp

import tippe

SCENE = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 131 / 350 * 8e-6, 3.2e-6))

frictionless_rate = jax.jit(lambda _, y: SCENE.field(y))
rolling = jax.jit(lambda _, y: rolling_rate(SCENE, y))

#: theta [rad], spin [rad/s], further angular velocity [rad/s]: cuspidal, from a general state, slow and wide.
STARTS = [(0.1, 155.0, (0.0, 0.0, 0.0)), (0.6, 155.0, (3.0, -5.0, 2.0)), (1.2, 60.0, (0.0, 0.0, 0.0))]


def axis_and_angular_velocity(theta, spin, extra):
    axis = jnp.array([np.sin(theta), 0.0, np.cos(theta)])
    return axis, spin * axis + jnp.array(extra)


def integrate(rate, start, times, size):
    solution = solve_ivp(
        lambda t, y: np.asarray(rate(t, y)), (0.0, times[-1]), np.asarray(start), "DOP853", times, rtol=1e-13, atol=size
    )
    assert solution.success
    return jnp.asarray(solution.y)


@pytest.mark.parametrize(("theta", "spin", "extra"), STARTS)
def test_frictionless_nutation_is_a_quadrature(theta, spin, extra):
    """theta(t) over ten periods to 1e-9 (`tippe.md`, section 5 c), from standing and from moving centres of mass."""
    axis, w = axis_and_angular_velocity(theta, spin, extra)
    momentum = SCENE.body.I1 * w + (SCENE.body.I3 - SCENE.body.I1) * (w @ axis) * axis
    start = jnp.concatenate([jnp.array([0.05, -0.02]), axis, momentum])
    motion = swing(FrictionlessNutation.of(SCENE, start), axis[2], jnp.cross(w, axis)[2])
    times = np.linspace(0.0, 10.0 * float(motion.period), 101)
    size = 1e-15 * np.asarray(SCENE.scales(tippe.Launch(theta, spin)))
    theta_t = SCENE.theta(integrate(frictionless_rate, start, times, size))
    np.testing.assert_allclose(motion.theta(times), theta_t, rtol=0.0, atol=1e-9)
    lowest, highest = motion.range
    assert highest - lowest > 1e-3
    np.testing.assert_allclose([jnp.min(theta_t), jnp.max(theta_t)], [lowest, highest], atol=0.02 * (highest - lowest))


@pytest.mark.parametrize(("theta", "spin", "extra"), STARTS)
def test_rolling_nutation_is_a_quadrature(theta, spin, extra):
    """theta(t) over ten periods to 1e-9, from energy, Jellett's constant and Routh's (`tippe.md`, section 5 d)."""
    axis, w = axis_and_angular_velocity(theta, spin, extra)
    motion = swing(RollingNutation.of(SCENE, axis, w), axis[2], jnp.cross(w, axis)[2])
    times = np.linspace(0.0, 10.0 * float(motion.period), 101)
    solution = integrate(rolling, jnp.concatenate([axis, w]), times, 1e-14)
    theta_t = jnp.arctan2(jnp.hypot(solution[0], solution[1]), solution[2])
    np.testing.assert_allclose(motion.theta(times), theta_t, rtol=0.0, atol=1e-9)


def test_the_frictionless_period_is_that_of_a_separate_integration():
    """Rutstam's top from theta = 0.1 at 155 rad/s: theta comes back to its turning point after one period."""
    launch = tippe.Launch(0.1, 155.0)
    start = SCENE.state(launch)
    motion = swing(FrictionlessNutation.of(SCENE, start), start[4], jnp.zeros(()))
    np.testing.assert_allclose(motion.theta(motion.period), 0.1, rtol=1e-12)
    np.testing.assert_allclose(motion.theta(0.5 * motion.period), motion.range[0], rtol=1e-12)


def test_the_rolling_top_keeps_energy_jelletts_and_rouths_constants():
    """Drift over a second below 1e-11 of each: so it keeps its swing, and never inverts."""
    axis, w = axis_and_angular_velocity(*STARTS[1])
    solution = integrate(rolling, jnp.concatenate([axis, w]), np.linspace(0.0, 1.0, 11), 1e-14)
    constants = jax.vmap(lambda y: RollingNutation.of(SCENE, y[:3], y[3:]), in_axes=1)(solution)
    for values in (constants.energy, constants.jellett, constants.routh):
        np.testing.assert_allclose(values, values[0], rtol=1e-11)
