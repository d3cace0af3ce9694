"""The stroller on level and tilted planes against closed forms (`stroller.md`, section 8)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipk

import stroller
from stroller import Damping, Launch, Plane, RollingResistance, Scene, Stroller

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
M, L, J = 1.7, 0.7, 0.4


def reduced_mass(phi):
    return M + J * jnp.tan(phi) ** 2 / L**2


def test_locked_steering_on_a_level_plane_runs_a_circle():
    """Row 1: the radius is l / tan(phi), the period 2 pi R / v, the speed constant."""
    phi, v = 0.4, 1.3
    R = L / np.tan(phi)
    period = 2.0 * np.pi * R / v
    run = stroller.simulate(Scene(BODY), Launch((0.2, -0.5), 0.3, v, phi), period, tolerance=1e-13)
    centre = np.array([0.2 - R * np.sin(0.3), -0.5 + R * np.cos(0.3)])
    np.testing.assert_allclose(np.hypot(*(run.place - centre).T), R, rtol=1e-11)
    np.testing.assert_allclose(run.place[-1], [0.2, -0.5], atol=1e-11)
    np.testing.assert_allclose(run.speed, v, rtol=1e-13)


@pytest.mark.parametrize("fork", ["relative", "absolute"])
def test_speed_times_root_of_the_reduced_mass_is_constant_while_steering(fork):
    """Row 2: without a force v sqrt(M(phi)) is constant, and so is s or s + Omega."""
    scene = Scene(BODY, fork=fork)
    run = stroller.simulate(scene, Launch((0.0, 0.0), 0.0, 1.3, -0.6, 1.0), 2.0, tolerance=1e-13)
    assert np.ptp(run.steering) > 0.3
    np.testing.assert_allclose(run.speed * jnp.sqrt(reduced_mass(run.steering)), run.state[0, 5], rtol=5e-12)
    fork_rate = run.steering_rate + (run.yaw_rate if fork == "absolute" else 0.0)
    np.testing.assert_allclose(fork_rate, fork_rate[0], rtol=1e-12)


def test_rolling_damping_slows_the_stroller_exponentially():
    """Row 3: v = v0 exp(-c t / M(phi)) at locked steering, a constant M."""
    scene = Scene(BODY, friction=Damping(0.3))
    run = stroller.simulate(scene, Launch((0.0, 0.0), 0.0, 1.3, 0.4), 10.0, tolerance=1e-14)
    np.testing.assert_allclose(run.speed, 1.3 * jnp.exp(-0.3 * run.t / reduced_mass(0.4)), rtol=5e-14)
    rate = scene.dynamics.field(0.0, run.state[0])[5]
    np.testing.assert_allclose(rate / run.state[0, 5], -0.3 / reduced_mass(0.4), rtol=1e-15)


def test_heading_on_a_tilted_plane_is_a_pendulum():
    """Row 4: th'' = -(m g sin(alpha) tan(phi) / (M l)) cos(th); period 4 K(sin^2(A/2)) / omega0 about th = -pi/2."""
    alpha, phi, amplitude = 0.3, 0.4, 1.1
    omega0 = np.sqrt(M * 9.81 * np.sin(alpha) * np.tan(phi) / (float(reduced_mass(phi)) * L))
    period = 4.0 * ellipk(np.sin(amplitude / 2.0) ** 2) / omega0
    times = period * np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    run = stroller.simulate(
        Scene(BODY, Plane(alpha)),
        Launch((0.0, 0.0), amplitude - np.pi / 2, 0.0, phi),
        period,
        times=times,
        tolerance=1e-14,
    )
    angle = run.heading + np.pi / 2
    np.testing.assert_allclose(angle, amplitude * np.array([1.0, 0.0, -1.0, 0.0, 1.0]), atol=2e-13)
    # Where the pendulum passes its lowest point, an error of the angle is one of the period times the rate.
    np.testing.assert_allclose(angle[1] / (run.yaw_rate[1] * period), 0.0, atol=2e-14)


def test_rolling_resistance_stops_the_stroller_after_its_distance():
    """Section 7: v0^2 / (2 c g) on a level plane; 2.2938 m against 2.2936 m at v_s = 0.01 m/s, the rest as v_s^2."""
    v, c = 1.5, 0.05
    distance = v**2 / (2.0 * c * 9.81)
    errors = []
    for creep in (0.02, 0.01):
        scene = Scene(BODY, friction=RollingResistance(c, creep))
        run = stroller.simulate(scene, Launch((0.0, 0.0), 0.0, v), 6.0, tolerance=1e-10)
        errors.append(float(run.place[-1, 0]) - distance)
    np.testing.assert_allclose(errors[1], 2e-4, atol=1e-4)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=1e-3)


def test_side_forces_at_locked_steering_are_those_of_a_turn():
    """Section 2: lambda_2 = J Omega' / (l cos(phi)) = 0 and lambda_1 = m v Omega on a steady circle."""
    run = stroller.simulate(Scene(BODY), Launch((0.0, 0.0), 0.0, 1.3, 0.4), 1.0, tolerance=1e-12)
    np.testing.assert_allclose(run.side_force[:, 0], M * 1.3**2 * np.tan(0.4) / L, rtol=1e-11)
    np.testing.assert_allclose(run.side_force[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(run.normal_force, M * 9.81, rtol=1e-15)


def test_side_forces_add_up_to_the_centripetal_force():
    """The wheels' forces across, from the second derivative of the path: m a = lambda_1 left + lambda_2 left_f + F."""
    scene = Scene(Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3), Plane(0.2), gravity=9.81, fork="absolute")
    state = scene.state(Launch((0.1, 0.2), 0.7, 1.3, 0.5, 0.8))

    def centre_velocity(state):
        g, rate = scene.dynamics.geometry(state), scene.dynamics.field(0.0, state)
        return jnp.stack([rate[0], rate[1]]) + 0.3 * g.motion.yaw_rate * jnp.stack(g.left[:2])

    _, acceleration = jax.jvp(centre_velocity, (state,), (scene.dynamics.field(0.0, state),))
    rear, front = scene.dynamics.side_force(0.0, state, None)
    left = jnp.array([-jnp.sin(0.7), jnp.cos(0.7)])
    left_front = jnp.array([-jnp.sin(1.2), jnp.cos(1.2)])
    force = rear * left + front * left_front - jnp.array([1.7 * 9.81 * jnp.sin(0.2), 0.0])
    np.testing.assert_allclose(force, 1.7 * acceleration, rtol=1e-13)


def test_stroller_at_rest_on_a_slope_is_held_by_its_wheels():
    """Statics: across the slope the side forces are m g sin(alpha) (1 - b/l) and m g sin(alpha) b/l, like the loads."""
    scene = Scene(Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3), Plane(0.2))
    run = stroller.simulate(scene, Launch((0.0, 0.0), -np.pi / 2, 0.0), 0.1, tolerance=1e-10)
    shares = np.array([1.0 - 0.3 / 0.7, 0.3 / 0.7])
    np.testing.assert_allclose(run.side_force[0], M * 9.81 * np.sin(0.2) * shares, rtol=1e-13)
    np.testing.assert_allclose(run.load[0], M * 9.81 * np.cos(0.2) * shares, rtol=1e-13)
    np.testing.assert_allclose(run.grip()[0], np.tan(0.2), rtol=1e-13)
    margin = run.grip_margin(0.5)[0]
    np.testing.assert_allclose(margin, M * 9.81 * (0.5 * np.cos(0.2) - np.sin(0.2)) * shares, rtol=1e-13)


def test_centre_of_mass_ahead_of_the_axle_comes_to_rest_at_the_lowest_point_of_its_circle():
    """At rest at locked steering, e_up v + b left_up Omega = 0: tan(th) = l / (b tan(phi)); and the energy adds up."""
    scene = Scene(Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3), Plane(0.2), Damping(2.0))
    run = stroller.simulate(scene, Launch((0.0, 0.0), -np.pi / 2, 0.0, 0.5), 80.0, tolerance=1e-11)
    np.testing.assert_allclose(np.tan(run.heading[-1]), 0.7 / (0.3 * np.tan(0.5)), rtol=1e-8)
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-10)
    assert float(run.energy[-1]) < float(run.energy[0]) - 0.1


def test_spring_returns_the_fork():
    """With v = 0 the fork swings at sqrt(k / J_f)."""
    scene = Scene(Stroller(1.7, 0.7, 0.4, 0.05, steering_spring=0.3))
    run = stroller.simulate(scene, Launch((0.0, 0.0), 0.0, 0.0, 0.2), 5.0, tolerance=1e-12)
    np.testing.assert_allclose(run.steering, 0.2 * jnp.cos(jnp.sqrt(0.3 / 0.05) * run.t), atol=1e-11)


def test_rolling_speed_of_the_absolute_fork_decays_forward_and_grows_in_reverse():
    """Row 13: s = 0 at a fixed phi is an equilibrium of the free fork with the rate -m v sec^2(phi) / (l M)."""
    scene = Scene(BODY, fork="absolute")
    for v in (1.3, -0.8):
        state = scene.state(Launch((0.0, 0.0), 0.0, v, 0.4))
        field, jacobian = scene.dynamics.field(0.0, state), jax.jacfwd(lambda s: scene.dynamics.field(0.0, s))(state)
        np.testing.assert_allclose(field[4:], 0.0, atol=1e-15)
        eigenvalues = np.linalg.eigvals(jacobian[4:, 4:])
        expected = -M * v / np.cos(0.4) ** 2 / (L * float(reduced_mass(0.4)))
        nonzero = eigenvalues[np.argmax(np.abs(eigenvalues))]
        np.testing.assert_allclose(nonzero, expected, rtol=1e-12)
