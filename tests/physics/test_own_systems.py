"""Users' own systems against numbers and closed forms that nobody here computed."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from rigid_systems import GRAVITY, BallOnTurntable, Bicycle, Disc
from scipy.linalg import null_space

from nonholonomic import AbstractMode, Hybrid, simulate
from nonholonomic.systems.mechanics import Lagrange

#: Basu-Mandal, Chatterjee and Papadopoulos, Proc. R. Soc. A 463 (2007) 1983, Table 1: q, its rates, and its accelerations, in
#: the order of `Bicycle`; x, y, theta and the rotations of the wheels are 0.
PLACE = [0.0, 0.0, 0.2440472102925, 0.0, 0.9501292851472, 3.1257073014894, 0.2311385135743, 0.0, 0.0]
RATE = [-2.8069345714545, -0.1480982396001, 0.1058778746261, 0.7830033527065, 0.6068425835418, -0.0119185528069]
RATE += [0.4859824687093, 8.9129896614890, 8.0133620584155]
ACCELERATION = [-0.5041626315047, -0.3449706619454, -1.4604528332980, 0.8353281706379, -7.8555281128244]
ACCELERATION += [0.1205543897884, -4.6198904039403, 1.8472554144217, 2.4548072904550]

#: Meijaard, Papadopoulos, Ruina and Schwab, Proc. R. Soc. A 463 (2007) 1955, Table 2: by speed [m/s].
EIGENVALUES = {
    4.0: [0.413253315211239 + 3.07910818603205j, -1.42944427361326, -12.1586142657644],
    5.0: [-0.77534188219585 + 4.46486771378823j, -0.32286642900409, -14.07838969279822],
}


@pytest.fixture(scope="module")
def bicycle():
    """Acceleration and its Jacobian, and the Jacobian of the constraints, by place and rate: compiled once."""
    system = Bicycle()

    def described(state):
        q, rate = jnp.split(state, 2)
        acceleration = Lagrange(system).acceleration(0.0, q, rate)
        return jnp.concatenate([rate, acceleration]), jnp.concatenate([system.heights(q), system.slips(q, rate)])

    @jax.jit
    def evaluated(state):
        # The values are those of the first of the forward passes.
        (motion, constraint_values), slopes = jax.vmap(lambda direction: jax.jvp(described, (state,), (direction,)))(
            jnp.eye(18)
        )
        return motion[0, 9:], constraint_values[0], *(slope.T for slope in slopes)

    return lambda q, rate: tuple(map(np.asarray, evaluated(jnp.asarray([*q, *rate]))))


def test_the_accelerations_of_the_nonlinear_benchmark_bicycle(bicycle):
    """All nine to 1e-10; the published state keeps to the ground and does not slip."""
    acceleration, constraint_values, _, _ = bicycle(PLACE, RATE)
    assert_close(constraint_values, 0.0, atol=1e-11)
    assert_close(acceleration, ACCELERATION, atol=1e-10)


@pytest.mark.parametrize("speed", [4.0, 5.0])
def test_the_eigenvalues_of_the_benchmark_bicycle(bicycle, speed):
    """Weave, capsize and castering of the upright ride, from JAX's derivative of the equations along the constraints."""
    q = [0.0, 0.0, 0.3, 0.0, 0.5 * np.pi, np.pi, 0.0, 0.0, 0.0]
    rate = [-speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, speed / 0.3, speed / 0.35]
    acceleration, _, motion, constraint_values = bicycle(q, rate)
    assert_close(acceleration, 0.0, atol=1e-12)
    tangent = null_space(constraint_values)
    assert tangent.shape == (18, 10)
    eigenvalues = np.linalg.eigvals(np.linalg.lstsq(tangent, motion @ tangent)[0])
    for eigenvalue in EIGENVALUES[speed]:
        assert np.min(np.abs(eigenvalues - eigenvalue)) < 1e-9


class Disc2D(AbstractMode):
    """A disc in a plane without gravity above an elastic floor: place and velocity."""

    radius: float = 0.1

    def field(self, t, y):
        return jnp.concatenate([y[2:], jnp.zeros(2)])

    def margin(self, t, y):
        return y[1] - self.radius

    def reset(self, t, y):
        return y * jnp.array([1.0, 1.0, 1.0, -1.0]), 0


@pytest.mark.slow
def test_the_gradient_of_an_elastic_impact_is_exact():
    """From (-1, 1) with (2, -2) for 1 s: the final height is 2 r - y0 - v, so its gradient is (0, -1) (issue 97 of nimble)."""

    def height(place):
        start = jnp.concatenate([place, jnp.array([2.0, -2.0])])
        return simulate(Hybrid([Disc2D()]), start, 1.0, times=jnp.array([1.0])).state[0, 1]

    value, slopes = jax.value_and_grad(height)(jnp.array([-1.0, 1.0]))
    assert_close(value, 1.2, rtol=1e-14)
    assert_close(slopes, [0.0, -1.0], atol=1e-14)


class TwoDiscs(AbstractMode):
    """Two equal discs on a line, which collide elastically and so exchange their velocities."""

    radius: float = 0.1

    def field(self, t, y):
        return jnp.concatenate([y[2:], jnp.zeros(2)])

    def margin(self, t, y):
        return y[1] - y[0] - 2.0 * self.radius

    def reset(self, t, y):
        return jnp.array([y[0], y[1], y[3], y[2]]), 0


@pytest.mark.slow
def test_the_gradient_of_a_collision_is_exact():
    """At 0 and 0.52 with 1 m/s and 0 for 1 s: the second ends where the first would be, a diameter ahead: (1, 0, 1, 0)."""

    def second(start):
        return simulate(Hybrid([TwoDiscs()]), start, 1.0, times=jnp.array([1.0])).state[0, 1]

    value, slopes = jax.value_and_grad(second)(jnp.array([0.0, 0.52, 1.0, 0.0]))
    assert_close(value, 1.2, rtol=1e-14)
    assert_close(slopes, [1.0, 0.0, 1.0, 0.0], atol=1e-14)


@eqx.filter_jit
def acceleration_of(system, q, rate):
    return Lagrange(system).acceleration(0.0, q, rate)


def test_the_steady_circles_of_a_rolling_disc():
    """gamma'^2 = 4 (g / r) sin b / ((6 - 5 rho sin b) rho cos b), rho the disc's radius over that of the path, b its lean.

    Lean, heading rate and rotation rate then stay as they are.
    """
    disc, lean, ratio = Disc(), 0.5, 0.7
    spin = np.sqrt(4 * GRAVITY / disc.radius * np.sin(lean) / ((6 - 5 * ratio * np.sin(lean)) * ratio * np.cos(lean)))
    q, rate = np.array([0.0, 0.0, 0.3, lean, 0.0]), np.array([0.0, 0.0, -ratio * spin, 0.0, spin])
    constraint_values = np.asarray(disc.constraints(q))
    rate[:2] = -np.linalg.solve(constraint_values[:, :2], constraint_values @ rate)
    assert_close(acceleration_of(disc, q, rate)[2:], 0.0, atol=1e-12)
    wrong_rate = rate * np.array([1.0, 1.0, 1.01, 1.0, 1.0])
    assert abs(acceleration_of(disc, q, wrong_rate)[3]) > 1e-2


def turntable_start(turning):
    """A ball that rolls on a turntable with a velocity of its own."""
    ball, q = BallOnTurntable(), np.array([0.2, 0.0, 0.1, 0.2, 0.0, 0.0])
    free = np.array([0.05, -0.02, 0.0, 0.0, 0.0, turning])
    constraint_values = np.asarray(ball.constraints(q))
    free[2:4] = -np.linalg.solve(constraint_values[:, 2:4], constraint_values @ free)
    return ball, q, free


def test_the_velocity_of_a_ball_on_a_turntable_turns_at_two_sevenths_of_its_rate():
    """v' = (2/7) Omega x v for a solid ball that rolls, wherever it is (Earnshaw 1844): it runs in circles."""
    ball, q, rate = turntable_start(3.0)
    expected = 2.0 / 7.0 * 3.0 * np.array([-rate[1], rate[0]])
    assert_close(acceleration_of(ball, q, rate)[:2], expected, atol=1e-12)


@pytest.mark.slow
def test_a_ball_on_a_turntable_runs_in_circles():
    """The same over 2 s."""
    ball, q, rate = turntable_start(3.0)
    run = simulate(ball, (q, rate), 2.0, times=np.array([1.0, 2.0]))
    for time, velocity in zip((1.0, 2.0), run.state[:, 6:8], strict=True):
        c, s = np.cos(6.0 / 7.0 * time), np.sin(6.0 / 7.0 * time)
        assert_close(velocity, np.array([[c, -s], [s, c]]) @ rate[:2], atol=1e-9)
