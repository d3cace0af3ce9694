"""The stroller on spheres and spheroids against closed forms and geodesy (`stroller.md`, section 8)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from scipy.special import ellipk
from stroller_chart import Chart

import stroller
from nonholonomic.systems.mechanics import Hamel
from stroller import Damping, Launch, Scene, Sphere, Spheroid, Steady, Stroller

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
M, L, J = 1.7, 0.7, 0.4
WEIGHTLESS = 0.0


@pytest.fixture(scope="module")
def geodesic():
    """A straight ride without gravity on a flat spheroid, and the spheroid."""
    ground = Spheroid(1.3, 0.8)
    run = stroller.simulate(
        Scene(BODY, ground, gravity=WEIGHTLESS), Launch((0.3, 0.2), 0.7, 1.1), 10.0, tolerance=1e-13
    )
    return run, ground


def test_straight_ride_keeps_speed_and_clairauts_constant(geodesic):
    """Row 5: phi = 0, g = 0: v and h_mu cos(psi) are constant."""
    run, ground = geodesic
    np.testing.assert_allclose(run.speed, 1.1, rtol=1e-13)
    clairaut = ground.equatorial * jnp.cos(run.place[:, 1]) * jnp.cos(run.heading)
    np.testing.assert_allclose(clairaut, clairaut[0], rtol=1.6e-10)
    np.testing.assert_allclose(run.departure, 0.0, atol=1e-11)
    assert np.ptp(run.place[:, 1]) > 1.0


@pytest.mark.parametrize("flattening", [0.005, 0.013])
def test_straight_ride_is_a_geodesic_of_geographiclib(flattening):
    """Row 5: the place and azimuth after 1 to 12 radians of travel are those of Karney's direct problem."""
    radius, polar = 1.0, 1.0 - flattening
    run = stroller.simulate(
        Scene(BODY, Spheroid(radius, polar), gravity=WEIGHTLESS), Launch((0.3, 0.2), 0.7, 1.0), 12.0, tolerance=1e-14
    )
    earth = Geodesic(radius, flattening)
    latitude = np.degrees(np.arctan(np.tan(0.2) / polar))
    for k in range(20, 201, 60):
        destination = earth.Direct(latitude, np.degrees(0.3), 90.0 - np.degrees(0.7), float(run.t[k]))
        eta, mu = np.arctan(polar * np.tan(np.radians(destination["lat2"]))), np.radians(destination["lon2"])
        expected = [np.cos(eta) * np.cos(mu), np.cos(eta) * np.sin(mu), polar * np.sin(eta)]
        np.testing.assert_allclose(run.position[k], expected, atol=3e-12)
        angle = np.radians(90.0 - destination["azi2"]) - run.heading[k]
        np.testing.assert_allclose(np.angle(np.exp(1j * angle)), 0.0, atol=3e-12)


def test_locked_steering_on_a_sphere_runs_a_small_circle():
    """Row 6: tan(rho/R) = l / (R tan(phi)), closing after 2 pi R sin(rho/R) / v; int Omega dt = 2 pi cos(rho/R)."""
    R, phi, v = 1.4, 0.6, 1.2
    rho = R * np.arctan(L / (R * np.tan(phi)))
    period = 2.0 * np.pi * R * np.sin(rho / R) / v
    scene = Scene(BODY, Sphere(R), gravity=WEIGHTLESS)
    run = stroller.simulate(scene, Launch((0.3, -0.2), 0.7, v, phi), period, tolerance=1e-13)
    np.testing.assert_allclose(run.position[-1], run.position[0], atol=6e-11)
    np.testing.assert_allclose(run.direction[-1], run.direction[0], atol=6e-11)
    start, normal = run.position[0], run.position[0] / R
    left = np.cross(normal, run.direction[0])
    centre = np.cos(rho / R) * start + R * np.sin(rho / R) * left
    np.testing.assert_allclose(run.position @ centre, R**2 * np.cos(rho / R), rtol=6e-11)
    np.testing.assert_allclose(run.yaw_rate * period, 2.0 * np.pi * np.cos(rho / R), rtol=1e-12)


def test_a_large_spheroid_is_a_plane():
    """Row 7: near the pole the ride tends to the plane's as 1/R^2 with the radius of curvature R = A^2/c there."""
    plane = stroller.simulate(Scene(BODY), Launch((0.0, 0.0), 0.3, 1.0, 0.4), 2.0, tolerance=1e-13)
    errors = []
    for size in (50.0, 100.0, 200.0):
        scene = Scene(BODY, Spheroid(1.3 * size, 0.8 * size), gravity=WEIGHTLESS)
        # East is +x and north is +y at the pole of the azimuth -pi/2.
        run = stroller.simulate(scene, Launch((-np.pi / 2, np.pi / 2), 0.3, 1.0, 0.4), 2.0, tolerance=1e-13)
        errors.append(float(jnp.linalg.norm(run.position[-1, :2] - plane.position[-1, :2])))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    np.testing.assert_allclose(ratios, 4.0, atol=5e-3)


def test_straight_ride_through_the_bottom_of_a_bowl_is_a_pendulum():
    """Row 8: inside a sphere, through its pole, with the period 4 sqrt(R/g) K(sin^2(A/2))."""
    R, amplitude = 1.4, 1.0
    period = 4.0 * np.sqrt(R / 9.81) * ellipk(np.sin(amplitude / 2.0) ** 2)
    times = period * np.array([0.0, 0.25, 0.5, 1.0])
    scene = Scene(BODY, Sphere(R), side="inside")
    launch = Launch((0.4, amplitude - np.pi / 2), -np.pi / 2, 0.0)
    run = stroller.simulate(scene, launch, period, times=times, tolerance=1e-13)
    radial_distance = jnp.hypot(run.position[:, 0], run.position[:, 1]) / R
    np.testing.assert_allclose(radial_distance, np.sin(amplitude) * np.array([1.0, 0.0, 1.0, 1.0]), atol=1e-10)
    np.testing.assert_allclose(radial_distance[1] * R / (run.speed[1] * period), 0.0, atol=1e-10)
    np.testing.assert_allclose(run.speed[1], np.sqrt(2.0 * 9.81 * R * (1.0 - np.cos(amplitude))), rtol=1e-11)
    np.testing.assert_allclose(run.normal_force[1], M * 9.81 * (3.0 - 2.0 * np.cos(amplitude)), rtol=1e-11)
    assert run.status == "completed"


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_parallel_is_a_relative_equilibrium(speed):
    """Row 9: tan(phi) = l S / h_mu rides along a parallel at any speed and any gravity."""
    ground, eta = Spheroid(2.0, 1.1), 0.6
    h_eta, h_mu = np.hypot(2.0 * np.sin(eta), 1.1 * np.cos(eta)), 2.0 * np.cos(eta)
    phi = np.arctan(L * 2.0 * np.sin(eta) / h_eta / h_mu)
    run = stroller.simulate(Scene(BODY, ground), Launch((0.3, eta), 0.0, speed, phi), 3.0, tolerance=1e-12)
    np.testing.assert_allclose(run.place[:, 1], eta, atol=1e-11)
    np.testing.assert_allclose(run.speed, speed, rtol=1e-11)
    np.testing.assert_allclose(run.place[:60, 0], 0.3 + speed * run.t[:60] / h_mu, atol=1e-11)


@pytest.mark.slow
def test_small_oscillation_about_a_parallel():
    """Row 9: at g = 0 its frequency is v sqrt(K + (S / h_mu)^2); from the eigenvalues of the reduced motion."""
    eta, v = 0.6, 1.3
    h_eta, h_mu = np.hypot(2.0 * np.sin(eta), 1.1 * np.cos(eta)), 2.0 * np.cos(eta)
    S = 2.0 * np.sin(eta) / h_eta
    phi = np.arctan(L * S / h_mu)
    chart = Chart(Scene(BODY, Spheroid(2.0, 1.1), gravity=WEIGHTLESS))
    state = jnp.array([eta, 0.3, 0.0, phi, v / np.cos(phi), 0.0])
    jacobian = jax.jit(jax.jacfwd(lambda state: Hamel(chart).field(0.0, state)))(state)
    # eta and psi oscillate at fixed steering and speed.
    frequency = np.max(np.imag(np.linalg.eigvals(np.asarray(jacobian)[np.ix_([0, 2], [0, 2])])))
    curvature = 1.1**2 / h_eta**4
    np.testing.assert_allclose(frequency, v * np.sqrt(curvature + (S / h_mu) ** 2), rtol=1e-13)
    # And of the P-form, whose pairs of eigenvalues it must be among.
    scene = chart.scene
    start = scene.state(Launch((0.3, eta), 0.0, v, phi))
    rates = np.linalg.eigvals(jax.jit(jax.jacfwd(lambda state: frame_field(scene, state)))(start))
    assert np.min(np.abs(rates - 1j * frequency)) < 5e-9


def frame_field(scene, state):
    """The field of the P-form less a turn about the axis, which makes the parallel a fixed point."""
    field = scene.dynamics.field(0.0, state)
    rate = 1.3 / (2.0 * jnp.cos(0.6))
    turn = jnp.array([-state[1], state[0], 0.0, -state[4], state[3], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    return field - rate * turn


def test_path_at_locked_steering_does_not_depend_on_the_forces():
    """Row 10: with gravity, friction and drive the same path is run at another speed."""
    ground, launch = Spheroid(2.0, 1.1), Launch((0.3, -0.9), 0.7, 3.0, 0.25)
    driven = Scene(BODY, ground, Damping(0.9, 0.2, 0.1), gravity=3.0)
    slow_run = stroller.simulate(driven, launch, 1.0, Steady(force=1.0), tolerance=1e-13)
    assert float(slow_run.speed[-1]) < 2.5
    # The work of a force of 1 N is the length of the path.
    times = slow_run.state[::40, 11] / 3.0
    free = Scene(BODY, ground, gravity=WEIGHTLESS)
    free_run = stroller.simulate(free, launch, float(times[-1]), times=times, tolerance=1e-13)
    np.testing.assert_allclose(free_run.position, slow_run.position[::40], atol=7e-11)
    np.testing.assert_allclose(free_run.direction, slow_run.direction[::40], atol=7e-11)


@pytest.mark.slow
def test_motion_without_friction_has_an_invariant_measure():
    """Row 11: h_eta h_mu sqrt(M(phi)) in (eta, mu, psi, phi, v, s), thus times cos(phi) in the front wheel's speed."""
    chart = Chart(Scene(BODY, Spheroid(2.0, 1.1)))
    hamel = Hamel(chart)

    def flow(state):
        h_eta, h_mu = jnp.sqrt(chart.ground_metric(state))
        density = h_eta * h_mu * jnp.sqrt(M * jnp.cos(state[3]) ** 2 + J * jnp.sin(state[3]) ** 2 / L**2)
        return density * hamel.field(0.0, state)

    random = np.random.default_rng(5)
    states = jnp.asarray(random.uniform([-1.2, -3, -3, -3, -2, -2], [1.2, 3, 3, 3, 2, 2], (20, 6)))
    jacobians = jax.jit(jax.vmap(jax.jacfwd(flow)))(states)
    divergence = jnp.trace(jacobians, axis1=1, axis2=2)
    np.testing.assert_allclose(divergence / jnp.max(jnp.abs(jacobians), axis=(1, 2)), 0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("side", "fork"), [pytest.param("outside", "relative", marks=pytest.mark.slow), ("inside", "absolute")]
)
def test_energy_is_the_work_done(side, fork):
    """Row 12: with every friction, a drive and a steering torque, E(t) = E(0) + work; and dE/dt is the power."""
    scene = Scene(BODY, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side=side, fork=fork)

    def push(t, motion):
        return 0.3 * jnp.cos(t) + 0.0 * motion.speed, 0.1 * jnp.sin(2.0 * t) - 0.2 * motion.steering

    run = stroller.simulate(scene, Launch((0.3, -0.6), 0.5, 1.5, 0.2, 0.1), 10.0, push, tolerance=1e-13)
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=7e-11)
    assert abs(float(run.work[-1])) > 1.0
    power = jax.vmap(lambda t, y: jax.jvp(scene.energy, (y,), (scene.dynamics.field(t, y, push),))[1])(run.t, run.state)
    np.testing.assert_allclose(power, sum(run.power), atol=1e-13)


def test_straight_projected_ride_is_a_vertical_section():
    """Row 14: with the paper's heading, phi = 0 goes straight in the map, and locked steering runs a circle there."""
    scene = Scene(BODY, Spheroid.from_oblate(2.0, 0.8), heading="projected")
    run = stroller.simulate(scene, Launch((0.3, 0.9), 0.5, 1.0), 1.0, tolerance=1e-13)
    x, y = run.position[:, 0], run.position[:, 1]
    deviation = (x - x[0]) * np.sin(0.5) - (y - y[0]) * np.cos(0.5)
    np.testing.assert_allclose(deviation, 0.0, atol=1e-11)
    steered = stroller.simulate(scene, Launch((0.3, 0.9), 0.5, 1.0, 0.5), 1.5, tolerance=1e-13)
    x, y = steered.position[:, 0], steered.position[:, 1]
    radius = L / np.tan(0.5)
    centre = x[0] - radius * np.sin(0.5), y[0] + radius * np.cos(0.5)
    np.testing.assert_allclose(np.hypot(x - centre[0], y - centre[1]), radius, rtol=1e-11)
    assert float(np.ptp(steered.position[:, 2])) > 0.1
