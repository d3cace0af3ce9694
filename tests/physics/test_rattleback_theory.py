"""The linear theory of reversal: exponents about a steady spin, growth in a run, reversal of a slow spin."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from rattleback_theory import QUARTER, Oscillations
from rigid import INERTIA, SHAPE, rattleback
from rigid_reference import Rattleback
from scipy.linalg import expm

import tippe
from tippe.runs.model import TopModel

THEORY = Oscillations.of_ellipsoid(1.0, SHAPE, 0.01, INERTIA)


def with_product(product: float) -> Oscillations:
    """The same body with another product of inertia."""
    inertia = np.array(INERTIA)
    inertia[0, 1] = inertia[1, 0] = product
    return dataclasses.replace(THEORY, inertia=inertia)


def rates_seen_by_the_body(y, n):
    """Rates of q and of the angular momentum across z, by the simulator's equations at a spin n."""
    dynamics, (q1, q2, L1, L2) = rattleback().dynamics, y
    up = jnp.sqrt(1.0 - q1**2 - q2**2)
    part = 1.0 / (1.0 + up)
    first, second = 1.0 - part * q1 * q1, -part * q1 * q2
    turn = jnp.array([[first, second, -q1], [second, 1.0 - part * q2 * q2, -q2], [q1, q2, up]])
    momentum = turn @ jnp.array([L1, L2, INERTIA[2][2] * n])
    state = jnp.concatenate([jnp.zeros(2), turn[:, 2], momentum, turn[:, 0]])

    def seen(state):
        attitude = dynamics.attitude(state)
        return jnp.stack([*attitude.normal[:2], *attitude.momentum[:2]])

    return jax.jvp(seen, (state,), (dynamics.field(state),))[1]


@pytest.mark.parametrize("n", [-5.0, 0.5, 12.0])
def test_exponents_about_a_steady_spin_are_those_of_the_theory(n):
    """Two pairs: one oscillation grows and the other decays."""
    exponents = np.linalg.eigvals(np.asarray(jax.jacfwd(rates_seen_by_the_body)(jnp.zeros(4), n)))
    expected = np.linalg.eigvals(THEORY.matrix(n))
    assert_close(np.sort_complex(exponents), np.sort_complex(expected), atol=1e-10)
    assert (expected.real > 0.0).sum() == 2


def test_one_sense_of_spin_lets_pitch_grow_and_the_other_roll():
    """For a slow spin the rates are proportional to it, and in the ratio of the squared frequencies, with opposite signs; to
    first order in the product of inertia they are a closed form, and without a product there is no growth."""
    rates, frequencies = THEORY.slow_growth()
    exponents = np.linalg.eigvals(THEORY.matrix(1e-3))
    exponents = exponents[np.argsort(exponents.imag)][2:]
    assert_close(exponents.real / 1e-3, rates, rtol=1e-7)
    assert_close(exponents.imag, frequencies, rtol=1e-7)
    errors = []
    for product in (-2e-5, -2e-6):
        body = with_product(product)
        errors.append(np.abs(body.small_angle_growth()[0] / body.slow_growth()[0] - 1.0).max())
        (slow_growth, fast_growth), squares = body.small_angle_growth()[0], body.small_angle_growth()[1] ** 2
        assert_close(fast_growth / slow_growth, -squares[1] / squares[0], rtol=1e-12)
    assert errors[0] < 1e-3
    assert_close(errors[1] / errors[0], 1e-2, rtol=0.02)
    assert_close(np.linalg.eigvals(with_product(0.0).matrix(2.0)).real, 0.0, atol=1e-10)


def test_a_small_tilt_grows_as_the_theory_says():
    """A tilt of 1e-6 grows 22 times in a run of 1 s: q(t) = exp(A t) q(0), to 1e-5 of it."""
    run, times = tippe.simulate(rattleback(), tippe.Launch(1e-6, -5.0), 1.0, tolerance=1e-10), np.linspace(0.1, 1.0, 7)
    tilts = np.asarray(run.at(times).rotation)[:, 2, :2]
    # The angular velocity is along z, so that E q' + n q = 0 at the start.
    q = np.array([-np.sin(1e-6), 0.0])
    start = np.concatenate([q, -5.0 * QUARTER @ q])
    expected = np.array([(expm(THEORY.matrix(-5.0) * time) @ start)[:2] for time in times])
    assert np.abs(expected).max() > 5e-6
    assert_close(tilts / 1e-6, expected / 1e-6, atol=1e-4)


@pytest.mark.slow
def test_a_slow_spin_reverses_as_the_amplitude_equations_say():
    """n = -N tanh(s N (t - t0)), for pitch alone; the error falls with the square of the spin."""
    errors = []
    for spin, theta in ((-0.5, 0.002), (-0.25, 0.001)):
        time = float(tippe.reversal_time(rattleback(), tippe.Launch(theta, spin), 60.0, tolerance=1e-9))
        errors.append(time / THEORY.reversal(spin, theta) - 1.0)
    assert 0.0 < errors[1] < 0.3 * errors[0] < 0.01


def test_nearby_rattlebacks_part_within_the_states_of_a_rolling_body():
    """The direction from which an exponent is computed keeps the axes orthonormal and the contact point at rest."""
    scene, launch = rattleback(), tippe.Launch(0.3, -5.0, azimuth=0.4)
    state = scene.state(launch)

    def kept(state):
        e, x = state[2:5], state[-3:]
        return jnp.stack([e @ e, e @ x, x @ x, *(scene.dynamics.carried_along(state) - state)[:2]])

    direction = TopModel(scene=scene, launch=launch).direction(1)[:, 0]
    assert_close(jax.jvp(kept, (state,), (direction,))[1], 0.0, atol=1e-15)
    assert np.abs(direction).min() > 0.0


@pytest.mark.slow
def test_the_lyapunov_exponent_of_a_steady_spin_is_the_growth_rate():
    """2.1207 /s at -5 rad/s, where pitch grows, and 0.2025 /s at 5 rad/s, where roll does."""
    exponents = tippe.lyapunov_exponent(rattleback(), tippe.Launch(0.0, [-5.0, 5.0]), 400.0)
    expected = [np.linalg.eigvals(THEORY.matrix(n)).real.max() for n in (-5.0, 5.0)]
    assert exponents.status.tolist() == ["completed"] * 2
    assert_close(exponents.exponent, expected, rtol=2e-3)


@pytest.mark.slow
def test_cwittens_rattleback():
    """The parameters of a public program in Julia: energy, constraint, and the first reversal against SciPy. Its F is taken as
    minus our xy, as in Kane and Levinson; with the other sign the body keeps its spin of -2 rad/s."""
    shape, centre = (1.618, 1.0, 1.0), (0.0, 0.0, -0.1875)
    inertia = ((0.05796875, -0.025, 0.0), (-0.025, 0.0903294, 0.0), (0.0, 0.0, 0.1223607))
    turning = (0.01, -0.02, 0.0)
    scene = tippe.Scene(tippe.Ellipsoid(0.2, shape, centre, inertia), friction=tippe.NoSlip())
    launch = tippe.Launch(0.0, -2.0, angular_velocity=turning)
    run = tippe.simulate(scene, launch, 40.0, tolerance=1e-11)
    assert run.status == "completed"
    assert run.stats["energy_residual"] < 1e-11 * float(run.energy[0])
    arm = np.asarray(run.contact - run.position)
    assert_close(np.asarray(run.velocity) + np.cross(run.angular_velocity, arm), 0.0, atol=1e-12)
    reference = Rattleback(0.2, shape, centre, inertia)
    expected = reference.reversal(reference.start(0.0, 0.0, -2.0, turning), 40.0, rtol=1e-11)
    assert_close(tippe.reversal_time(scene, launch, 40.0, tolerance=1e-12), expected, atol=1e-7)
