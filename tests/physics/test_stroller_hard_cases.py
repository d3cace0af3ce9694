"""Where charts fail: jackknife, poles, equator, loss of contact, loss of rank (`stroller.md`, section 9)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_formulations import Multipliers
from scipy.integrate import quad
from scipy.optimize import brentq
from stroller_chart import Chart

import stroller
from stroller import Launch, Scene, Sphere, Spheroid, Stroller

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
M, L, J = 1.7, 0.7, 0.4


def front_mass(phi):
    return M * np.cos(phi) ** 2 + J * np.sin(phi) ** 2 / L**2


@pytest.fixture(scope="module")
def jackknife():
    """Reverse with a free absolute fork, a little to the left: the fork swings over."""
    scene = Scene(BODY, fork="absolute")
    return scene, stroller.simulate(scene, Launch((0.0, 0.0), 0.0, -1.2, 0.1, 0.05), 20.0, tolerance=1e-12)


def test_reversing_with_a_free_fork_jackknifes_and_settles(jackknife):
    """Row 13: through phi = pi/2 to the root of P sin(phi) / (l sqrt(M_w)) = s + Omega beyond it."""
    _, run = jackknife
    assert run.status == "completed"
    assert run.jackknifed_at.size == 1
    P, fork_rate = float(run.state[0, 5]), float(run.state[0, 6])
    final_steering = float(run.steering[-1])

    def excess(phi):
        return P * np.sin(phi) / (L * np.sqrt(front_mass(phi))) - fork_rate

    sign = np.sign(final_steering)
    root = sign * brentq(lambda phi: excess(sign * phi), np.pi / 2, np.pi - 1e-6, xtol=1e-15)
    np.testing.assert_allclose(final_steering, root, atol=1e-8)
    np.testing.assert_allclose(run.steering_rate[-1], 0.0, atol=1e-8)


def test_jackknifes_are_found_between_steps_of_any_length():
    """At rest the sprung fork swings as A cos(k t) a little past a right angle: the crossings come in close pairs."""
    scene, amplitude, rate = Scene(Stroller(M, L, J, 0.05, steering_spring=0.3)), 1.575, np.sqrt(0.3 / 0.05)
    half = np.arccos(0.5 * np.pi / amplitude)
    expected = np.array([half, *(turn * np.pi + side * half for turn in (1, 2, 3) for side in (-1, 1))]) / rate
    for tolerance, atol in ((1e-6, 1e-5), (1e-9, 1e-8)):
        run = stroller.simulate(scene, Launch((0.0, 0.0), 0.0, 0.0, amplitude), 5.0, times=[5.0], tolerance=tolerance)
        assert float(run.stats.steps) < 70
        np.testing.assert_allclose(run.jackknifed_at, expected, atol=atol)


@pytest.mark.slow
def test_contact_is_lost_as_the_fall_along_a_meridian_has_it():
    """Straight down a sphere v^2 = v0^2 + 2 g R (cos a0 - cos a), and the ground pulls from v^2 = g R cos a on.

    The time does not depend on the lengths of the steps, nor on whether they end there.
    """
    radius, g, speed, start = 5.0, 9.81, 1.0, np.pi / 2 - 1.3
    end = np.arccos((speed**2 / (g * radius) + 2.0 * np.cos(start)) / 3.0)

    def slowness(angle):
        return radius / np.sqrt(speed**2 + 2.0 * g * radius * (np.cos(start) - np.cos(angle)))

    expected = quad(slowness, start, end, epsabs=1e-13, epsrel=1e-13)[0]
    scene = Scene(Stroller(10.0, 0.05, 1.0, 0.05), surface=Sphere(radius))
    launch = Launch((0.0, 1.3), -np.pi / 2, speed)
    for solver, atol in ((None, 1e-9), (stroller.ImplicitMidpoint(1e-3), 1e-6)):
        run = stroller.simulate(scene, launch, 2.5, times=[2.5], solver=solver)
        np.testing.assert_allclose(run.contact_lost_at, expected, atol=atol)
        assert run.status == "contact_lost"


def test_everything_is_regular_through_the_jackknife(jackknife):
    """Energy, no-slip and forces through phi = pi/2; the rear axle goes from reverse to forward there."""
    scene, run = jackknife
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-10)
    np.testing.assert_allclose(run.constraint, 0.0, atol=1e-12)
    assert np.all(np.isfinite(run.side_force))
    assert float(run.speed[0]) < 0.0 < float(run.speed[-1])
    time = float(run.jackknifed_at[0])
    single_sample = stroller.simulate(
        scene, Launch((0.0, 0.0), 0.0, -1.2, 0.1, 0.05), 20.0, times=[time], tolerance=1e-12
    )
    np.testing.assert_allclose(single_sample.steering[0] % np.pi, np.pi / 2, atol=1e-10)
    assert f"jackknifed      at {time:.6g} s" in str(run)


def test_multiplier_form_goes_through_the_jackknife_too(jackknife):
    """W keeps its rank at phi = pi/2: the canonical equations give the same run."""
    scene, run = jackknife
    formulation = Multipliers(Chart(scene))
    q = jnp.array([0.0, 0.0, 0.0, 0.1])
    rate = jnp.array([-1.2, 0.0, float(run.yaw_rate[0]), 0.05])
    end = integrate(formulation, formulation.state(q, rate), 10.0)
    np.testing.assert_allclose(end[:2], run.place[100], atol=1e-9)
    np.testing.assert_allclose(end[3], run.steering[100], atol=1e-9)


def integrate(formulation, start, t1):
    """State at t1 by Dopri8 at 1e-12."""
    import diffrax

    sol = diffrax.diffeqsolve(
        diffrax.ODETerm(formulation.field),
        diffrax.Dopri8(),
        0.0,
        t1,
        None,
        start,
        stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )
    return sol.ys[0]


def test_side_force_at_the_jackknife_is_the_limit_of_its_neighbours():
    """lambda_2 = J Omega' / (l cos(phi)) is 0/0 at phi = pi/2, where the forces are yet those of the multipliers."""
    scene = Scene(BODY, Spheroid(2.0, 1.1), fork="absolute")

    def forces_at(steering):
        state = scene.state(Launch((0.3, 0.5), 0.4, 0.0, steering, 0.7)).at[7].set(0.9)
        return jnp.stack(scene.dynamics.side_force(0.0, state, None))

    forces = [forces_at(np.pi / 2 + d) for d in (-1e-5, 0.0, 1e-5)]
    np.testing.assert_allclose(forces[1], 0.5 * (forces[0] + forces[2]), rtol=1e-8)
    assert np.all(np.abs(forces[1]) > 0.1)


@pytest.mark.parametrize("side", [pytest.param("outside", marks=pytest.mark.slow), "inside"])
def test_over_the_pole(side):
    """A straight ride through the pole of the axis stays in its meridian plane, and a steered one is smooth there."""
    sign = 1.0 if side == "outside" else -1.0
    scene = Scene(BODY, Spheroid(2.0, 1.1), side=side)
    launch = Launch((0.3, sign * (np.pi / 2 - 0.4)), sign * np.pi / 2, 2.0)
    run = stroller.simulate(scene, launch, 1.0, tolerance=1e-13)
    sideways = run.position[:, 1] * np.cos(0.3) - run.position[:, 0] * np.sin(0.3)
    np.testing.assert_allclose(sideways, 0.0, atol=1e-12)
    assert float(run.position[0, 0]) > 0.5 > -0.5 > float(run.position[-1, 0])
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-10)


def test_start_on_the_pole_itself():
    """A ride from the pole is the one that another azimuth describes with the heading turned by as much."""
    scene = Scene(BODY, Spheroid(2.0, 1.1))
    runs = [
        stroller.simulate(scene, Launch((mu, np.pi / 2), 0.4 - mu, 1.0, 0.3), 1.0, tolerance=1e-12) for mu in (0.0, 1.3)
    ]
    np.testing.assert_allclose(runs[0].position, runs[1].position, atol=1e-13)


def test_across_the_equator_of_the_bowl():
    """Inside, fast enough to be pressed on: up over the equator and back, with contact all the way."""
    scene = Scene(BODY, Spheroid(2.0, 1.8), side="inside")
    run = stroller.simulate(scene, Launch((0.3, -0.8), 0.6, 9.0, 0.1), 3.0, tolerance=1e-13)
    latitude = np.asarray(run.place[:, 1])
    assert latitude.min() < -0.3 < 0.3 < latitude.max()
    assert run.status == "completed"
    assert float(jnp.min(run.normal_force)) > 0.0
    np.testing.assert_allclose(run.energy_residual / run.energy[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(run.constraint, 0.0, atol=1e-12)
    np.testing.assert_allclose(run.departure, 0.0, atol=1e-10)


def test_loss_of_contact_is_reported_where_the_ball_leaves_the_sphere():
    """Outside a sphere, from rest near the top: contact ends at cos(angle) = 2/3 (1 + v0^2 / (2 g R))."""
    R, v0 = 1.4, 0.5
    run = stroller.simulate(Scene(BODY, Sphere(R)), Launch((0.0, np.pi / 2), 0.0, v0), 1.5, tolerance=1e-10)
    assert run.status == "contact_lost"
    times = np.linspace(0.0, 1.5, 1501)
    fine_run = stroller.simulate(
        Scene(BODY, Sphere(R)), Launch((0.0, np.pi / 2), 0.0, v0), 1.5, times=times, tolerance=1e-10
    )
    np.testing.assert_allclose(run.contact_lost_at, fine_run.contact_lost_at, atol=1e-8)
    height = np.interp(fine_run.contact_lost_at, times, np.asarray(fine_run.position[:, 2])) / R
    np.testing.assert_allclose(height, 2.0 / 3.0 * (1.0 + v0**2 / (2.0 * 9.81 * R)), atol=1e-5)
    assert "contact lost" in str(run)


def test_projected_heading_crosses_the_equator_with_its_speed_reversed():
    """Section 3: trajectories do cross, and the horizontal speed changes sign there, while the energy stays regular."""
    scene = Scene(BODY, Spheroid(2.0, 1.1), heading="projected", side="inside", gravity=1.0)
    run = stroller.simulate(scene, Launch((0.3, -0.5), 0.2, 4.0, 0.1), 1.0, tolerance=1e-12)
    latitude = np.asarray(run.place[:, 1])
    assert latitude.min() < -0.1 < 0.1 < latitude.max()
    assert np.all(np.sign(run.speed) == -np.sign(latitude))
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-9)
    np.testing.assert_allclose(run.constraint, 0.0, atol=1e-12)
    assert run.rank_lost_at == np.inf


def test_projected_heading_loses_rank_on_the_equator():
    """Section 3: at eta = 0 with th - mu = pi/2 the rear axle's form vanishes; the run says that it came by."""
    scene = Scene(BODY, Spheroid(2.0, 1.1), heading="projected", side="inside")
    place = jnp.array([0.0, 1e-6, np.pi / 2, 0.3])
    W = Chart(scene).constraints(place.at[0].set(0.0).at[1].set(0.0))
    assert np.linalg.matrix_rank(np.asarray(W), tol=1e-12) == 1
    state = scene.state(Launch((0.0, -1e-6), np.pi / 2, 0.0))
    np.testing.assert_allclose(scene.dynamics.rank(state), 0.0, atol=1e-10)
    run = stroller.simulate(scene, Launch((0.0, -1e-6), np.pi / 2, 0.0, 0.0), 1e-3, tolerance=1e-8)
    assert run.status in ("rank_lost", "failed")
    assert run.rank_lost_at == 0.0
    assert "rank lost" in str(run)


def test_rank_is_kept_by_the_intrinsic_heading():
    """M_w / (m + J / l^2) is never less than the smaller of its parts."""
    scene = Scene(BODY, Spheroid(2.0, 1.1))
    angles = jnp.linspace(-3.0, 3.0, 41)
    states = scene.state(Launch((0.0 * angles, angles / 2.1), angles, 0.0, angles))
    expected = min(M, J / L**2) / (M + J / L**2)
    assert float(jnp.min(scene.dynamics.rank(states))) >= expected * (1.0 - 1e-12)


def test_gradients_are_finite_through_the_jackknife(jackknife):
    """Reverse-mode derivatives of the end with respect to the launch, across phi = pi/2."""
    scene, _ = jackknife

    def end(steering):
        return stroller.simulate(scene, Launch((0.0, 0.0), 0.0, -1.2, steering, 0.05), 8.0, times=[8.0]).place[-1]

    slope = jax.jit(jax.jacrev(end))(0.1)
    difference = (end(0.1 + 1e-5) - end(0.1 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, rtol=1e-4)
