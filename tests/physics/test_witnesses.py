"""The vector form of the tippe top against formulations derived on their own: accelerations and trajectories."""

import itertools

import equinox as eqx
import euler_angles
import jax
import jax.numpy as jnp
import numpy as np
import other_formulations
import poincare
import pytest
import quadrature
import reduced_tops
from scipy.integrate import solve_ivp

import tippe
from nonholonomic.systems.mechanics import Hamel

STATES = 1000
ARENAS = ["plane", "cylinder"]
#: Friction at a point, then friction with a torque about the normal and along the arena.
POINT = ["frictionless", "viscous", "coulomb"]
FRICTIONS = [*POINT, "torques"]


def random_scenes(rng, count, arena, friction):
    """Tops, arenas and frictions drawn at random, one per lane."""

    def between(low, high):
        return rng.uniform(low, high, count)

    mass, radius = between(0.005, 0.05), between(0.015, 0.03)
    I3 = between(0.3, 0.45) * mass * radius**2
    body = tippe.Top(mass, radius, between(0.05, 0.4) * radius, between(0.7, 1.3) * I3, I3)
    surfaces = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(radius * between(4.0, 40.0))}
    frictions = {
        "frictionless": tippe.Frictionless(),
        "viscous": tippe.Viscous(between(0.05, 0.5)),
        "coulomb": tippe.Coulomb(between(0.05, 0.5), between(0.005, 0.2)),
        "torques": tippe.Rolling(
            between(0.0, 0.1) * radius,
            between(0.1, 10.0),
            tippe.Contensou(between(0.05, 0.5), between(0.0, 0.3) * radius, between(0.005, 0.2)),
        ),
    }
    return tippe.Scene(body, surfaces[arena], frictions[friction], between(5.0, 15.0))


def random_states(rng, scenes, count):
    """States with any axis, up to some 150 rad/s and 1 m/s."""
    e = rng.normal(size=(3, count))
    e /= np.linalg.norm(e, axis=0)
    w = 50.0 * rng.normal(size=(3, count))
    I1, I3 = np.asarray(scenes.body.I1), np.asarray(scenes.body.I3)
    L = I1 * w + (I3 - I1) * np.sum(w * e, axis=0) * e
    eta = rng.uniform(-np.pi, np.pi, count)
    place = jnp.asarray(scenes.start(tippe.Launch(0.0, 0.0, eta=eta))[0]).reshape(-1, count)
    return jnp.concatenate([0.4 * rng.normal(size=(2, count)), e, L, place])


def legal_cases(arena, friction):
    """1000 scenes and states in contact (N > 0), away from the chart's poles."""
    rng = np.random.default_rng([ARENAS.index(arena), FRICTIONS.index(friction), 2021])
    count = 4 * STATES
    scenes = random_scenes(rng, count, arena, friction)
    states = random_states(rng, scenes, count)
    legal = (scenes.normal_force(states) > 0.0) & (jnp.hypot(states[2], states[3]) > 0.05)
    indices = np.flatnonzero(legal)[:STATES]
    assert len(indices) == STATES
    return jax.tree.map(lambda leaf: leaf[indices], scenes), states[:, indices].T


@eqx.filter_jit
@eqx.filter_vmap
def from_vector_form(scene, state):
    """State and rate in Euler angles, by the chain rule from the vector form, with the normal force and the lengths."""
    chart, rate = jax.jvp(lambda s: euler_angles.from_vector_state(scene, s), (state,), (scene.field(state),))
    metric = euler_angles.across(scene)[0] * jnp.ones(())
    return chart, rate[3:], scene.normal_force(state), jnp.stack([metric, 1.0, scene.body.radius])


def relative_error(value, expected, lengths):
    """Largest error of the accelerations, as a share of the largest acceleration of the same state, all in 1/s^2."""
    metric, y, radius = lengths.T
    one = jnp.ones_like(radius)
    units = jnp.stack([metric / radius, y / radius, one, one, one], axis=1)
    return jnp.max(jnp.abs(value - expected) * units, axis=1) / jnp.max(jnp.abs(expected) * units, axis=1)


@pytest.mark.parametrize(
    ("arena", "friction"),
    [
        pytest.param(*pair, marks=[] if pair == ("plane", "viscous") else pytest.mark.slow)
        for pair in itertools.product(ARENAS, FRICTIONS)
    ],
)
def test_lagrange_poincare_and_the_corrected_paper_give_the_accelerations_of_the_vector_form(arena, friction):
    """Four derivations, 1000 random tops, arenas and states each: q'' to 1e-10, and N to 1e-10 of the weight."""
    scenes, states = legal_cases(arena, friction)
    chart, expected, normal_force, lengths = from_vector_form(scenes, states)
    for formulation_ in (euler_angles.by_lagrange, euler_angles.by_equation_11, poincare.by_equation_2):
        acceleration = eqx.filter_jit(eqx.filter_vmap(formulation_))(scenes, chart)
        assert jnp.max(relative_error(acceleration.second_rates, expected, lengths)) < 1e-10
        weight = scenes.body.mass * scenes.gravity
        assert jnp.max(jnp.abs(acceleration.normal_force - normal_force) / (weight + normal_force)) < 1e-10


@pytest.mark.parametrize("friction", POINT)
def test_rutstam_and_the_jellett_reduction_give_the_accelerations_of_the_vector_form(friction):
    """Rutstam's six equations and the reduction by beta1 and Jellett's constant, 1000 random states on the plane."""
    scenes, states = legal_cases("plane", friction)

    @eqx.filter_jit
    @eqx.filter_vmap
    def errors(scene, state):
        rate = scene.field(state)
        scales = jnp.array([1.0, 1.0, 1.0, 1.0, scene.body.radius, scene.body.radius])
        chart, expected = jax.jvp(lambda s: reduced_tops.rutstam_state(scene, s), (state,), (rate,))
        rutstam = (reduced_tops.rutstam_rate(scene, chart) - expected) / scales

        chart, expected = jax.jvp(lambda s: reduced_tops.jellett_state(scene, s), (state,), (rate,))
        jellett_rate = reduced_tops.jellett_rate(scene, chart, scene.jellett(state))
        scales = reduced_tops.JellettState(1.0, 1.0, scene.body.I3, scene.body.radius, scene.body.radius)
        jellett = jnp.stack(jax.tree.map(lambda a, b, unit: (a - b) / unit, jellett_rate, expected, scales))
        # Rates in 1/s^2, as a share of the squared angular velocity and of g / R together.
        w = jnp.linalg.norm(state[5:8]) / scene.body.I1
        scale = w**2 + scene.gravity / scene.body.radius
        return jnp.max(jnp.abs(rutstam)) / scale, jnp.max(jnp.abs(jellett)) / scale

    rutstam, jellett = errors(scenes, states)
    assert jnp.max(rutstam) < 1e-10
    assert jnp.max(jellett) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("arena", [pytest.param("plane", marks=pytest.mark.slow), "cylinder"])
def test_the_general_formulations_give_the_accelerations_of_the_frictionless_top(arena):
    """Multipliers, Hamel, connection and bracket, from nothing but metric and potential, 1000 random states."""
    scenes, states = legal_cases(arena, "frictionless")
    chart, expected, _, lengths = from_vector_form(scenes, states)
    for kind in (
        other_formulations.Multipliers,
        Hamel,
        other_formulations.ConstrainedConnection,
        other_formulations.ReducedBracket,
    ):

        @eqx.filter_jit
        @eqx.filter_vmap
        def accelerations(scene, angles, kind=kind):
            return kind(poincare.TopSystem(scene)).acceleration(0.0, *poincare.from_angles(angles))

        assert jnp.max(relative_error(accelerations(scenes, chart), expected, lengths)) < 1e-10


@pytest.mark.parametrize("arena", [pytest.param("plane", marks=pytest.mark.slow), "cylinder"])
def test_the_general_reduction_by_a_cyclic_angle_gives_the_accelerations_of_the_frictionless_top(arena):
    """Hamel's equations of the Routhian without psi, the paper's (2) in the frame of the coordinates."""
    scenes, states = legal_cases(arena, "frictionless")
    chart, expected, _, lengths = from_vector_form(scenes, states)

    @eqx.filter_jit
    @eqx.filter_vmap
    def accelerations(scene, angles):
        q, rate = poincare.from_angles(angles)
        system = poincare.TopSystem(scene)
        reduced_system = other_formulations.Routhian(system, poincare.PSI, system.metric(q)[poincare.PSI] @ rate)
        return Hamel(reduced_system).acceleration(0.0, q[: poincare.PSI], rate[: poincare.PSI])

    acceleration = accelerations(scenes, chart)
    # psi'' is not among the equations; it follows from the momentum.
    complete_acceleration = jnp.concatenate([acceleration, expected[:, poincare.PSI :]], axis=1)
    assert jnp.max(relative_error(complete_acceleration, expected, lengths)) < 1e-10


def rolling_chart(scene, state):
    """State in Euler angles of a top that rolls on the plane, from its axis and angular velocity."""
    body, axis, w = scene.body, state[:3], state[3:]
    velocity = jnp.cross(body.offset * axis - body.radius * jnp.array([0.0, 0.0, 1.0]), w)
    momentum = body.I1 * w + (body.I3 - body.I1) * (w @ axis) * axis
    return euler_angles.from_vector_state(scene, jnp.concatenate([velocity[:2], axis, momentum]))


@pytest.mark.slow
def test_the_nonholonomic_formulations_give_the_accelerations_of_the_rolling_top():
    """Slip forbidden by multipliers, in Hamel's frame, or by a connection: 1000 random states of the rolling top."""
    scenes, states = legal_cases("plane", "frictionless")
    rolling = jnp.concatenate([states[:, 2:5], states[:, 5:8] / scenes.body.I1[:, None]], axis=1)

    @eqx.filter_jit
    @eqx.filter_vmap
    def chart(scene, state):
        return jax.jvp(lambda s: rolling_chart(scene, s), (state,), (quadrature.rolling_rate(scene, state),))

    angles, rates = chart(scenes, rolling)
    lengths = jnp.stack([jnp.ones(STATES), jnp.ones(STATES), scenes.body.radius], axis=1)
    for kind in (other_formulations.Multipliers, Hamel, other_formulations.ConstrainedConnection):

        @eqx.filter_jit
        @eqx.filter_vmap
        def accelerations(scene, angles, kind=kind):
            return kind(poincare.TopSystem(scene, rolling=True)).acceleration(0.0, *poincare.from_angles(angles))

        assert jnp.max(relative_error(accelerations(scenes, angles), rates[:, 3:], lengths)) < 1e-10


# Trajectories


def top(ratio=131 / 350):
    """Rutstam's top, with I1 = ratio m R^2."""
    return tippe.Top(0.02, 0.02, 0.006, ratio * 8e-6, 3.2e-6)


def run(parts, t1, count=26):
    """Integrate several fields side by side with DOP853 at 1e-12; (field, start, size of a component) each."""
    start_states = [np.asarray(start) for _, start, _ in parts]
    sizes = [np.broadcast_to(size, np.shape(start)) for _, start, size in parts]
    ends = np.cumsum([len(start) for start in start_states])
    start_indices = ends - [len(start) for start in start_states]

    @jax.jit
    def rate(y):
        return jnp.concatenate([field(y[i:j]) for (field, _, _), i, j in zip(parts, start_indices, ends, strict=True)])

    solution = solve_ivp(
        lambda _, y: np.asarray(rate(y)),
        (0.0, t1),
        np.concatenate(start_states),
        method="DOP853",
        rtol=1e-12,
        atol=1e-14 * np.concatenate(sizes),
        t_eval=np.linspace(0.0, t1, count),
    )
    assert solution.success
    return [solution.y[i:j] for i, j in zip(start_indices, ends, strict=True)]


ANGLES = np.array([1.0, 1.0, 1.0, 10.0, 0.1, 10.0, 10.0, 10.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "friction",
    [
        pytest.param(tippe.Viscous(0.3), id="viscous"),
        pytest.param(tippe.Coulomb(0.2, 0.1), id="coulomb", marks=pytest.mark.slow),
    ],
)
def test_trajectories_of_all_formulations_on_the_plane_agree_for_five_seconds(friction):
    """A rising top: theta, omega3 and Jellett's constant from five formulations, to 1e-8."""
    scene, launch = tippe.Scene(top(), friction=friction), tippe.Launch(0.3, 100.0)
    start = scene.state(launch)
    constant = scene.jellett(start)
    angles = euler_angles.from_vector_state(scene, start)

    def jellett(y):
        return jnp.stack(reduced_tops.jellett_rate(scene, reduced_tops.JellettState(*y), constant))

    def euler(form):
        return lambda y: euler_angles.state_rate(form(scene, y), y)

    vector, rutstam, routh, lagrange, second = run(
        [
            (scene.field, start, scene.scales(launch)),
            (lambda y: reduced_tops.rutstam_rate(scene, y), reduced_tops.rutstam_state(scene, start), 1.0),
            (jellett, jnp.stack(reduced_tops.jellett_state(scene, start)), np.array([1.0, 10.0, 1e-4, 0.1, 0.1])),
            (euler(euler_angles.by_lagrange), angles, ANGLES),
            (euler(poincare.by_equation_2), angles, ANGLES),
        ],
        5.0,
    )
    theta, spin = scene.theta(vector), scene.spin(vector)
    assert theta[-1] > 1.0
    for trajectory in (rutstam[0], routh[0], lagrange[1], second[1]):
        np.testing.assert_allclose(trajectory, theta, rtol=0.0, atol=1e-8)
    for trajectory in (rutstam[3], routh[2] / scene.body.I3):
        np.testing.assert_allclose(trajectory, spin, rtol=0.0, atol=1e-8 * 100.0)
    np.testing.assert_allclose(scene.jellett(vector), constant, rtol=1e-11)


@pytest.mark.slow
def test_trajectories_of_all_formulations_in_the_cylinder_agree_for_five_seconds():
    """A top thrown up the wall: theta, eta and their rates from three formulations, to 1e-8."""
    scene = tippe.Scene(top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    launch = tippe.Launch(0.4, 80.0, eta=0.5, azimuth=1.0)
    start = scene.state(launch)
    angles = euler_angles.from_vector_state(scene, start)

    def euler(form):
        return lambda y: euler_angles.state_rate(form(scene, y), y)

    vector, lagrange, printed, second = run(
        [
            (scene.field, start, scene.scales(launch)),
            (euler(euler_angles.by_lagrange), angles, ANGLES),
            (euler(euler_angles.by_equation_11), angles, ANGLES),
            (euler(poincare.by_equation_2), angles, ANGLES),
        ],
        5.0,
    )
    expected = jax.vmap(lambda s: euler_angles.from_vector_state(scene, s), in_axes=1, out_axes=1)(jnp.asarray(vector))
    assert np.max(np.abs(expected[0])) > 0.3
    for trajectory in (lagrange, printed, second):
        for row in (0, 1, 3, 4):
            np.testing.assert_allclose(trajectory[row], expected[row], rtol=0.0, atol=1e-8)


@pytest.mark.slow
def test_jelletts_quantity_in_the_cylinder_drifts_by_r_times_l_dot_n_prime():
    """J - J0 = integral of R L.n' dt to 1e-9 of J0, with n' = -S V, and J changes much (`tippe.md`, section 1)."""
    scene = tippe.Scene(top(235 / 625), tippe.Cylinder(0.2), tippe.Viscous(0.3))
    launch = tippe.Launch(0.3, 120.0, eta=0.6, azimuth=0.4)
    start = scene.state(launch)
    size = float(scene.jellett(start))
    path_radius = 0.2 - 0.02

    def augmented(y):
        state = y[:-1]
        e, L = state[2:5], state[5:8]
        velocity = state[0] + scene.body.offset * (L[1] * e[2] - L[2] * e[1]) / scene.body.I1
        # n = (-sin(eta), 0, cos(eta)) turns as n' = -eta' t1.
        drift = -scene.body.radius * L[0] * velocity / path_radius
        return jnp.append(scene.field(state), drift / size)

    scales = np.append(np.asarray(scene.scales(launch)), 1.0)
    (run_,) = run([(augmented, jnp.append(start, 0.0), scales)], 3.0, count=301)
    change = scene.jellett(run_[:-1]) / size - 1.0
    np.testing.assert_allclose(change, run_[-1], rtol=0.0, atol=1e-9)
    assert np.max(change) - np.min(change) > 0.1
