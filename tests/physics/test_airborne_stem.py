"""A top with a stem over any arena: an independent program, the plane as a limit, slopes, and where it leans."""

import dataclasses

import arena_hop_reference
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arena_hop_reference import SAMPLES
from arena_stem_reference import CASES, StemCase, TwoSpheres, recorded
from close import assert_close
from hop_reference import CASES as ON_THE_PLANE
from test_leaning import REFERENCE as FOUND_ON_THE_PLANE

import tippe
from nonholonomic.hybrid.ensemble import program_groups
from tippe.modes.airborne import ON_STEM, STRIKING, Fly
from tippe.runs.model import TopModel

REFERENCE = recorded()
STEM = tippe.Stem(radius=5e-3, offset=0.016)
TOP = tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=STEM)

#: A restitution with which no rebound is fast enough to be one, in the same program as those with rebounds.
NONE_TO_SPEAK_OF = 1e-9


def stem_scene(surface: tippe.Cylinder | tippe.Paraboloid, restitution: float) -> tippe.Scene:
    return tippe.Scene(TOP, surface, tippe.Viscous(0.3), contact="hybrid", restitution=restitution)


def check_against_the_program(number: int, surface: tippe.Cylinder | tippe.Paraboloid) -> tippe.HybridTrajectory:
    """Places and axes of a case to 1e-10, and as many flights but for those too short to be followed."""
    case, row = CASES[number], REFERENCE[number]
    assert isinstance(case, StemCase)
    launch = tippe.Launch(
        case.theta,
        case.spin,
        azimuth=case.azimuth,
        place=(row["q1"], row["q2"], row["q3"]),
        velocity=(case.v1, case.v2),
        angular_velocity=(case.w1, case.w2, case.w3),
    )
    scene = stem_scene(surface, case.restitution)
    run = tippe.simulate(scene, launch, case.t1, tolerance=1e-12, solver=diffrax.Tsit5())
    assert run.status == "completed"
    samples = run.at(case.t1 * np.array(SAMPLES))
    for name, values, size in (("O", samples.position, case.radius), ("e", samples.axis, 1.0)):
        expected = [[row[f"{name}{i}_{k}"] for i in range(3)] for k in range(1, len(SAMPLES) + 1)]
        assert_close(values, expected, atol=1e-10 * size)
    in_contact = samples.contact >= 0
    forces, slips = (np.array([row[f"{name}_{k}"] for k in range(1, len(SAMPLES) + 1)]) for name in ("N", "slip"))
    np.testing.assert_array_equal(in_contact, forces > 0.0)
    assert_close(samples.normal_force, forces, atol=1e-9 * case.mass * case.gravity)
    assert_close(np.linalg.norm(samples.slip, axis=1)[in_contact], slips[in_contact], atol=1e-10)
    assert 10 < len(run.hops) <= row["hops"]
    assert {-1, 0} <= set(run.contact)
    # Friction and blows take energy only, and it is all accounted for.
    assert run.stats["energy_residual"] < 1e-12 * float(run.energy[0])
    assert np.diff(run.energy).max() < 1e-12 * float(run.energy[0])
    return run


@pytest.mark.slow
def test_both_spheres_bounce_in_a_cylinder():
    """A top thrown onto its stem and a top that starts on its stem agree with a reference in NumPy and SciPy."""
    run = check_against_the_program(0, tippe.Cylinder(CASES[0].p1))
    assert run.contact[0] == 0
    run_on_stem = check_against_the_program(1, tippe.Cylinder(CASES[1].p1))
    on_stem = run_on_stem.contact == 1
    assert on_stem.any()
    assert min(REFERENCE[k][f"landings_{sphere}"] for k in (0, 1) for sphere in (0, 1)) > 0
    # The top's own sphere is off the arena while the stem slides.
    assert (run_on_stem.distance[0][on_stem] > 0.0).all()


@pytest.mark.filterwarnings("ignore:surface.radius = .* is larger than a room")
@pytest.mark.slow
def test_a_top_that_leans_ends_as_unresolved():
    """In a huge cylinder it rocks from sphere to sphere until both are at rest, when it would on the plane."""
    number = next(k for k, case in enumerate(ON_THE_PLANE) if case.theta == 2.4)
    case, expected = ON_THE_PLANE[number], FOUND_ON_THE_PLANE[number]
    scene, lean_time = stem_scene(tippe.Cylinder(1e3), NONE_TO_SPEAK_OF), float(expected["leans"])
    # As in the test above, a place, a velocity and an angular velocity are given: the program is the same.
    launch = tippe.Launch(
        case.theta, case.spin, place=(0.0, 0.0, -1e3), velocity=(0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0)
    )
    run = tippe.simulate(scene, launch, 2.0 * lean_time, tolerance=1e-12, solver=diffrax.Tsit5())
    assert run.status == "unresolved"
    assert "unresolved: sphere and stem came to rest on the arena together" in str(run)
    assert_close(run.end_time, lean_time, atol=1e-4)
    assert_close(run.theta[-1], np.arccos((STEM.radius - TOP.radius) / (STEM.offset - TOP.offset)), atol=1e-4)


def test_both_spheres_share_their_programs_in_a_batch():
    """Sliding on either sphere, and flying and striking, differ in the values of their arrays only."""
    model = TopModel(scene=stem_scene(tippe.Cylinder(0.3), 0.3), launch=tippe.Launch(0.1, 180.0))
    modes, _, _ = model.modes(1, jnp.asarray(1e-9), None, False)
    assert program_groups(modes) == [(0, 2), (1, 3)]


@pytest.mark.slow
def test_a_batch_is_its_single_runs():
    """`vmap` of `simulate` compiles for a minute of CPU time."""
    scene, times = stem_scene(tippe.Cylinder(0.3), 0.3), jnp.linspace(0.0, 0.05, 6)

    def run(theta):
        return tippe.simulate(scene, tippe.Launch(theta, 180.0), 0.05, times, 1e-10)

    def observe(theta):
        outcome = run(theta)
        return outcome.theta, outcome.contact, outcome.stats["hops"]

    batch = jax.jit(jax.vmap(observe))(jnp.array([0.1, 2.3]))
    for theta, inclination, contact, hops in zip((0.1, 2.3), *batch, strict=True):
        single = run(theta)
        assert_close(inclination, single.theta, atol=1e-8)
        np.testing.assert_array_equal(contact, single.contact)
        assert hops == len(single.hops)
    assert set(np.asarray(batch[1]).ravel()) == {0, 1}


@pytest.mark.slow
def test_both_spheres_bounce_in_a_bowl():
    check_against_the_program(2, tippe.Paraboloid(CASES[2].p1))


@pytest.mark.slow
def test_a_huge_cylinder_is_the_plane():
    """The difference between tables decreases with the curvature, to 1e-7 of the times."""
    arguments = {"theta": 0.1, "spin": [180.0, 190.0], "t1": 1.6, "angle": 0.95 * np.pi, "tolerance": 1e-11}
    friction, errors = tippe.Coulomb(0.3, 0.05), []
    plane = tippe.inversion_table(tippe.Scene(TOP, friction=friction, contact="hybrid"), **arguments)
    assert (plane.status == "inverted").any()
    for radius in (1e3, 1e4):
        scene = tippe.Scene(TOP, tippe.Cylinder(radius), friction, contact="hybrid")
        table = tippe.inversion_table(scene, **arguments)
        np.testing.assert_array_equal(table.status, plane.status)
        errors.append(np.abs(table.end_theta - plane.end_theta).max() + np.abs(table.end_time - plane.end_time).max())
    assert errors[1] < 0.2 * errors[0]
    assert errors[1] < 1e-5


@pytest.mark.slow
def test_slopes_go_through_the_blows_of_both():
    """Derivatives of inversion times in a cylinder, against central differences."""
    arguments = {"theta": 2.3, "angle": 2.7, "t1": 0.7, "progress": False}
    scene = tippe.Scene(TOP, tippe.Cylinder(0.3), tippe.Coulomb(0.3, 0.05), contact="hybrid", restitution=0.2)
    table = tippe.inversion_table(
        scene, spin=[180.0, 200.0], tolerance=1e-11, sensitivities=["spin", "mu"], **arguments
    )
    assert (table.status == "inverted").all()
    assert (table.hops > 0).all()
    assert (table.grazes == 0).all()
    step, mu_step = 2e-3, 3e-6
    spins = [spin + d for spin in (180.0, 200.0) for d in (-step, step)]
    time = tippe.inversion_table(scene, spin=spins, tolerance=1e-12, **arguments).time.reshape(2, 2)
    assert_close(table.time_by_spin, np.diff(time, axis=1)[:, 0] / (2.0 * step), rtol=1e-5)
    mus = [0.3 - mu_step, 0.3 + mu_step]
    time = tippe.inversion_table(scene, spin=[180.0, 200.0], mu=mus, tolerance=1e-12, **arguments).time
    assert_close(table.time_by_mu, np.diff(time.reshape(2, 2), axis=0)[0] / (2.0 * mu_step), rtol=1e-4)


@pytest.mark.slow
def test_torques_and_other_arenas():
    """Rolling resistance and a disc of contact, down a tilted plane and off a ball: energy closes; the same inside `jit`."""
    friction = tippe.Rolling(3e-4, 5.0, tippe.Contensou(0.3, 1e-3, 0.05))
    for surface, place, side in (
        (tippe.Plane(0.3), (0.0, 0.0), None),
        (tippe.Sphere(0.3), (0.0, 0.0, 0.3), "outside"),
    ):
        scene = tippe.Scene(TOP, surface, friction, contact="hybrid", restitution=0.3, side=side)
        launch = tippe.Launch(2.3, 150.0, place=place, velocity=(0.0, 0.2), angular_velocity=(40.0, -60.0, 0.0))
        run = tippe.simulate(scene, launch, 0.15, tolerance=1e-11)
        assert run.status == "completed"
        assert 1 in run.contact or len(run.hops) > 0
        assert run.stats["energy_residual"] < 1e-9 * float(run.energy[0])
        assert np.diff(run.energy).max() < 1e-9 * float(run.energy[0])
    times = jnp.linspace(0.01, 0.15, 8)
    traced = jax.jit(lambda launch: tippe.simulate(scene, launch, 0.15, times))(launch)
    assert_close(traced.axis, run.at(times).axis, atol=1e-6)


@pytest.mark.slow
def test_one_blow_may_throw_the_other_sphere_into_the_arena(monkeypatch):
    """Strong friction does it: what strikes next, and the motion after the blow, for tops that lean along a cylinder."""
    monkeypatch.setattr(arena_hop_reference, "RESTITUTION", 0.0)
    case, random, cells = CASES[0], np.random.default_rng(3), 60
    case = dataclasses.replace(case, mu=8.0)
    scene = tippe.Scene(
        TOP, tippe.Cylinder(case.p1), tippe.Viscous(case.mu), contact="hybrid", restitution=NONE_TO_SPEAK_OF
    )
    theta = np.arccos((STEM.radius - TOP.radius) / (STEM.offset - TOP.offset)) + 1e-13
    e = np.array((0.0, np.sin(theta), np.cos(theta)))
    place = np.array((0.0, 0.0, float(STEM.radius - STEM.offset * e[2]) - case.p1))
    u, w = random.normal(size=(3, cells)) * [[0.3], [0.3], [0.1]], random.normal(scale=50.0, size=(3, cells))
    L = float(TOP.I1) * w + float(TOP.I3 - TOP.I1) * (e @ w) * e[:, None]
    rest = np.zeros((2, cells))
    states = np.concatenate([np.tile(place[:, None], cells), u, np.tile(e[:, None], cells), L, rest])
    mode = Fly(scene, jnp.ones((14, cells)), jnp.asarray(-2.0), False, jnp.asarray(True))
    transition = eqx.filter_jit(mode.reset_map)(jnp.asarray(states), jnp.ones(cells))
    top, outcomes = TwoSpheres(case), []
    for sphere in top.spheres:
        sphere.near = np.array((0.0, 0.0, -case.p1))
    for k in range(cells):
        y = np.concatenate([place, u[:, k], e, w[:, k]])
        if top.speed(1, y) > -1e-3:
            continue
        state_after, _ = top.struck(1, y)
        is_thrown = top.speed(0, state_after) < -1e-4
        assert int(transition.mode[k]) == (STRIKING if is_thrown else ON_STEM)
        outcomes.append(is_thrown)
        if is_thrown:
            assert_close(transition.state[3:6, k], state_after[3:6], atol=1e-10)
    assert {True, False} == set(outcomes)
