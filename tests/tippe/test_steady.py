"""Steady motions of the tippe top: zeros of the field, thresholds against eigenvalues, groups."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tippe
from nonholonomic.integration.dense import sign_changes
from tippe import steady

RNG = np.random.default_rng(7)


def body(alpha, gamma, mass=0.02, radius=0.02, inertia=0.4):
    """A top from its proportions alpha = a / R, gamma = I1 / I3 and inertia = I3 / (m R^2)."""
    I3 = inertia * mass * radius**2
    return tippe.Top(mass, radius, alpha * radius, gamma * I3, I3)


def scene(alpha, gamma, mu=0.3, surface=None):
    return tippe.Scene(body(alpha, gamma), surface or tippe.Plane(), tippe.Viscous(mu))


@eqx.filter_jit
@eqx.filter_vmap(in_axes=(0, 0, None))
def standing_growth(top_scene, spin, inverted):
    return steady.growth_rate(steady.standing_matrix(top_scene, spin, inverted))


@eqx.filter_jit
@eqx.filter_vmap
def tumbling_growth(top_scene, motion):
    return steady.growth_rate(steady.tumbling_matrix(top_scene, motion))


def many(count, alpha, gamma):
    """Scenes on the plane, one per lane."""
    mass, radius = RNG.uniform(0.005, 0.05, count), RNG.uniform(0.01, 0.03, count)
    tops = body(alpha, gamma, mass, radius, RNG.uniform(0.3, 0.45, count))
    return tippe.Scene(
        tops, friction=tippe.Viscous(RNG.uniform(0.1, 0.5, count)), gravity=RNG.uniform(5.0, 15.0, count)
    )


def lanes_of_group_two(count):
    alpha = RNG.uniform(0.05, 0.4, count)
    return many(count, alpha, RNG.uniform(np.maximum(1.01 - alpha, 0.51), 0.99 + alpha))


@pytest.mark.parametrize(
    "surface", [tippe.Plane(), tippe.Cylinder(0.3), tippe.Sphere(0.3)], ids=["plane", "cylinder", "sphere"]
)
@pytest.mark.parametrize("inverted", [False, True], ids=["upright", "inverted"])
def test_a_standing_top_is_a_zero_of_the_field(surface, inverted):
    """At the lowest point, at any spin, to 1e-12."""
    top_scene = scene(0.3, 0.94, surface=surface)
    np.testing.assert_allclose(top_scene.field(steady.standing_state(top_scene, 80.0, inverted)), 0.0, atol=1e-12)


def test_a_tumbling_top_is_a_zero_of_the_field_seen_while_precessing():
    """300 tops of group II at any inclination: residual below 1e-12 of phi' times the state (Rutstam 2012, eq. 2.8)."""
    scenes = lanes_of_group_two(300)
    motion = steady.tumbling(scenes, RNG.uniform(0.05, 3.09, 300))

    @jax.vmap
    def residual(top_scene, motion):
        state = steady.tumbling_state(top_scene, motion)
        rate = motion.precession * steady.quarter_turn(state)
        scales = top_scene.scales(tippe.Launch(motion.theta, motion.spin))
        residual_rate = jnp.abs(top_scene.field(state) - rate) / scales / motion.precession
        return (
            jnp.max(residual_rate),
            top_scene.jellett(state) / motion.jellett - 1.0,
            top_scene.normal_force(state) / top_scene.body.mass / top_scene.gravity,
        )

    residual_rate, jellett, weights = residual(scenes, motion)
    assert jnp.max(residual_rate) < 1e-12
    np.testing.assert_allclose(jellett, 0.0, atol=1e-12)
    np.testing.assert_allclose(weights, 1.0, rtol=1e-12)


@pytest.mark.parametrize("inverted", [False, True], ids=["upright", "inverted"])
def test_eigenvalues_of_a_standing_top_change_sign_at_the_critical_spin(inverted):
    """300 tops: the growth rate changes sign within 1e-6 of the formula's spin, upwards upright, downwards inverted."""
    scenes = lanes_of_group_two(300)
    critical = (steady.inverted_critical_spin if inverted else steady.upright_critical_spin)(scenes)
    sign = -1.0 if inverted else 1.0
    assert jnp.all(sign * standing_growth(scenes, critical * (1.0 + 1e-6), inverted) > 0.0)
    assert jnp.all(sign * standing_growth(scenes, critical * (1.0 - 1e-6), inverted) < 0.0)


@pytest.mark.parametrize(
    ("surface", "same"),
    [
        (tippe.Spheroid(0.3, 0.3), tippe.Sphere(0.3)),
        (tippe.Paraboloid(0.3), tippe.Sphere(0.3)),
        (tippe.Graph(lambda x, y: 0.3 - jnp.sqrt(0.09 - x * x - y * y)), tippe.Sphere(0.3)),
    ],
    ids=["spheroid", "paraboloid", "graph"],
)
def test_a_standing_top_feels_only_the_curvature_of_the_arena(surface, same):
    """Arenas of one curvature at the lowest point have the same eigenvalues, whatever frame the equations are in."""
    matrices, expected = (
        np.linalg.eigvals(steady.standing_matrix(scene(0.3, 0.94, surface=arena), 100.0, inverted=True))
        for arena in (surface, same)
    )
    assert len(matrices) == len(expected)
    np.testing.assert_allclose(np.sort_complex(matrices), np.sort_complex(expected), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("surface", "growth"),
    [
        (tippe.Plane(), None),
        (tippe.Cylinder(0.3), -0.1614),
        (tippe.Sphere(0.3), -0.0760),
        (tippe.Torus(0.6, 0.3), None),
    ],
    ids=["plane", "cylinder", "sphere", "torus"],
)
def test_a_standing_top_is_as_stable_whether_or_not_it_may_fly(surface, growth):
    """Inverted, 100 rad/s: "hybrid" and "stop" agree, and no direction of symmetry counts as marginal."""
    stopping_scene = scene(0.3, 0.94, surface=surface)
    hopping_scene = dataclasses.replace(stopping_scene, contact="hybrid", restitution=0.5)
    rates = [
        float(steady.growth_rate(steady.standing_matrix(variant, 100.0, inverted=True)))
        for variant in (stopping_scene, hopping_scene)
    ]
    assert rates[0] == rates[1]
    assert rates[0] < -1e-3
    if growth is not None:
        assert rates[0] == pytest.approx(growth, rel=2e-3)


def test_tops_of_groups_one_and_three_have_no_critical_spin():
    """Group I stands upright at every spin; group III never stands inverted: 1000 rad/s and more make no difference."""
    alpha, spins = 0.3, np.linspace(1.0, 3000.0, 50)
    for gamma, inverted, name in ((0.65, False, "I"), (1.35, True, "III")):
        top_scene = scene(alpha, gamma)
        assert steady.group(top_scene.body) == name
        assert (steady.inverted_critical_spin if inverted else steady.upright_critical_spin)(top_scene) == jnp.inf
        lanes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, spins.shape), top_scene)
        growth = standing_growth(lanes, jnp.asarray(spins), inverted)
        assert jnp.all(growth > 0.0) if inverted else jnp.all(growth < 0.0)
    assert steady.group(body(alpha, 0.94)) == "II"


def test_a_tumbling_top_is_stable_where_jelletts_constant_grows_with_the_angle():
    """600 tops: the sign of the growth rate is that of the criterion, except within 1e-4 of marginal."""
    scenes = lanes_of_group_two(600)
    theta = jnp.asarray(RNG.uniform(0.05, 3.09, 600))
    motion = steady.tumbling(scenes, theta)
    growth = tumbling_growth(scenes, motion)
    slope = (
        jax.vmap(jax.grad(lambda angle, top_scene: steady.tumbling(top_scene, angle).jellett))(theta, scenes)
        / motion.jellett
    )
    clear = jnp.abs(slope) > 1e-4
    stable = steady.tumbling_is_stable(scenes, theta)
    assert jnp.sum(clear & stable) > 100
    assert jnp.sum(clear & ~stable) > 10
    assert jnp.all((growth < 0.0)[clear] == stable[clear])
    assert jnp.all((slope > 0.0)[clear] == stable[clear])


def test_the_growth_rate_of_a_tumbling_top_vanishes_at_the_fold_of_jelletts_constant():
    """alpha = 0.3, gamma = 0.75: the sign changes within 1e-6 in spin of the extremum of J over theta."""
    top_scene = scene(0.3, 0.75)
    assert steady.folds(top_scene.body)
    slope = jax.jit(jax.vmap(jax.grad(lambda theta: steady.tumbling(top_scene, theta).jellett)))
    folds = sign_changes(slope, jnp.linspace(0.01, 3.13, 500))
    assert folds.size > 0
    spins_near_folds = jnp.concatenate([folds - 3e-8, folds + 3e-8])
    motion = steady.tumbling(top_scene, spins_near_folds)
    lanes = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, spins_near_folds.shape), top_scene)
    growth_before, growth_after = jnp.split(tumbling_growth(lanes, motion), 2)
    assert jnp.all(growth_before * growth_after < 0.0)
    spins = motion.spin.reshape(2, -1)
    assert jnp.all(jnp.abs(spins[1] / spins[0] - 1.0) < 1e-6)


def test_jelletts_constant_has_a_fold_exactly_where_the_classification_says():
    """2000 tops of group II: an extremum of J over the tumbling angles exists if and only if gamma < 1 - delta."""
    count = 2000
    scenes = lanes_of_group_two(count)
    theta = jnp.linspace(1e-4, np.pi - 1e-4, 4001)
    stable = jax.jit(jax.vmap(lambda top_scene: jnp.all(steady.tumbling_is_stable(top_scene, theta))))(scenes)
    expected = [steady.folds(jax.tree.map(lambda leaf, lane=lane: leaf[lane], scenes.body)) for lane in range(count)]
    assert 100 < sum(expected) < count - 100
    assert np.array_equal(~np.asarray(stable), expected)


def test_thresholds_of_rutstams_top():
    """lambda_thres = 3.4575e-6 kg m^3/s, upright unstable above 27.41 rad/s (Rutstam, SIGMA 8 (2012) 019)."""
    top_scene = scene(0.3, 235 / 250)
    upright, inverted = steady.jellett_thresholds(top_scene)
    np.testing.assert_allclose(inverted, 3.4575e-6, rtol=2e-5)
    np.testing.assert_allclose(steady.upright_critical_spin(top_scene), 27.41, rtol=2e-4)
    np.testing.assert_allclose(
        inverted / (top_scene.body.I3 * (top_scene.body.radius - top_scene.body.offset)), 77.18, rtol=2e-4
    )
    # A standing top has the constant of the tumbling tops next to it.
    jellett_near = steady.tumbling(top_scene, jnp.array([1e-6, np.pi - 1e-6])).jellett
    np.testing.assert_allclose(jellett_near, [upright, inverted], rtol=1e-9)


def test_cohens_top_with_a_smaller_axial_inertia_tumbles_at_an_intermediate_angle():
    """I3 = 0.8 I1, 100 rad/s from theta = 0.1: theta = 2.077 rad, phi' = 55.8, psi' = -11.16 rad/s (Cohen 1977)."""
    I1 = 0.4 * 0.015 * 0.025**2
    top_scene = tippe.Scene(tippe.Top(0.015, 0.025, 0.005, I1, 0.8 * I1), friction=tippe.Viscous(0.3))
    assert steady.group(top_scene.body) == "III"
    angles = steady.tumbling_angles(top_scene, float(top_scene.jellett(top_scene.state(tippe.Launch(0.1, 100.0)))))
    ends = [theta for theta in angles if steady.tumbling_is_stable(top_scene, theta)]
    motion = steady.tumbling(top_scene, ends[0])
    psi_dot = motion.spin - motion.precession * jnp.cos(motion.theta)
    np.testing.assert_allclose([*ends, motion.precession, psi_dot], [2.07687, 55.784, -11.157], rtol=1e-4)


def test_the_steady_motions_are_the_extrema_of_the_effective_energy():
    """Minima where the tumbling top is stable, maxima where it is not, at the same Jellett constant."""
    top_scene = scene(0.3, 0.75)
    energy = jax.grad(lambda theta, jellett: steady.effective_energy(top_scene, theta, jellett))
    curvature = jax.grad(energy)
    angles = set()
    for theta in np.linspace(0.1, 3.0, 30):
        motion = steady.tumbling(top_scene, theta)
        stable = bool(steady.tumbling_is_stable(top_scene, theta))
        angles.add(stable)
        # The effective energy has its extremum there, and the angles found from J include it.
        assert abs(energy(motion.theta, motion.jellett)) < 1e-14
        assert (curvature(motion.theta, motion.jellett) > 0.0) == stable
    assert angles == {True, False}
    angles_found = steady.tumbling_angles(top_scene, float(motion.jellett))
    assert any(abs(theta - 3.0) < 1e-9 for theta in angles_found)


def test_no_steady_tumbling_where_the_lever_is_negative_or_the_arena_is_curved():
    """Group I has no tumbling top near the upright one; a cylinder has none at all."""
    with pytest.raises(ValueError, match="no tumbling top at this inclination"):
        steady.tumbling(scene(0.3, 0.6), 0.1)
    with pytest.raises(ValueError, match="must be a Plane"):
        steady.tumbling(scene(0.3, 0.94, surface=tippe.Cylinder(0.3)), 1.0)


TOP_SCENE = scene(0.3, 0.94)
SEVERAL = tippe.Top(0.02, 0.02, jnp.array([0.006, 0.005]), 3e-6, 3.2e-6)
RIGID = tippe.Ellipsoid(0.1, (0.02, 0.02, 0.03), (0.0, 0.0, 0.0), np.diag([1e-5, 1e-5, 2e-5]))

REFUSED = {
    "no body": (lambda: steady.group(0.3), "body = 0.3 must be a Top"),
    "several tops": (lambda: steady.folds(SEVERAL), r"body\.offset must be one number, not of shape \(2,\).*jax\.vmap"),
    "a traced top": (lambda: jax.jit(steady.group)(TOP_SCENE.body), "inside jit.*use steady.proportions"),
    "no scene": (lambda: steady.jellett_thresholds(TOP_SCENE.body), r"scene = Top\(.*must be a Scene"),
    "another body": (
        lambda: steady.standing_state(tippe.Scene(RIGID), 10.0),
        "body = Ellipsoid must be a body of revolution, such as a Top",
    ),
    "a word for the spin": (lambda: steady.standing_state(TOP_SCENE, "fast"), "spin = 'fast' is not a number"),
    "several spins": (
        lambda: steady.standing_matrix(TOP_SCENE, [10.0, 20.0]),
        r"spin must be one number, not of shape \(2,\).*jax\.vmap",
    ),
    "a word for a flag": (
        lambda: steady.standing_matrix(TOP_SCENE, 10.0, "upright"),
        "inverted = 'upright' must be True or False",
    ),
    "degrees": (
        lambda: steady.tumbling(TOP_SCENE, 45.0),
        r"theta = 45\.0 must be at most pi rad.*np\.radians\(45\.0\)",
    ),
    "degrees of an energy": (lambda: steady.effective_energy(TOP_SCENE, 45.0, 1e-6), r"np\.radians\(45\.0\)"),
    "a slope": (
        lambda: steady.tumbling_is_stable(scene(0.3, 0.94, surface=tippe.Plane(0.1)), 1.0),
        r"surface = Plane\(tilt=0\.1 rad\) must be a Plane without tilt",
    ),
    "no constant": (lambda: steady.tumbling_angles(TOP_SCENE, np.nan), "jellett = nan must be finite"),
    "too few samples": (
        lambda: steady.tumbling_angles(TOP_SCENE, 1e-6, samples=2),
        "samples = 2 must be a whole number",
    ),
    "no motion": (lambda: steady.tumbling_matrix(TOP_SCENE, 1.0), r"motion = 1\.0 must be a Tumbling, as tumbling\("),
    "the state of another arena": (
        lambda: steady.quarter_turn(np.zeros(10)),
        r"state of shape \(10,\) must have the 8",
    ),
    "no matrix": (lambda: steady.growth_rate(np.ones(3)), r"matrix must be square, not of shape \(3,\)"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_an_illegal_argument_is_refused_with_its_name_and_a_fix(name):
    call, message = REFUSED[name]
    with pytest.raises(ValueError, match=message):
        call()
