"""Bodies of any shape and inertia: published reversals, limits, an independent program, balances, integrals, derivatives."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from rigid import (
    AZIMUTH,
    CENTRE,
    INERTIA,
    LAW,
    ODD,
    ODD_INERTIA,
    SHAPE,
    TILT,
    any_states,
    as_ellipsoid,
    egg,
    odd_scene,
    rattleback,
    turned_anyhow,
)
from rigid_reference import UP, Rattleback, quaternion
from scipy.spatial.transform import Rotation
from tops import random_states, rutstam_top

import tippe

# Published numbers


def test_kane_and_levinsons_rattleback_reverses_when_two_programs_say():
    """The first zero of omega.gamma at 2.6846470 s for -5 rad/s and 11.4588456 s for 5 rad/s; a fast one jumps."""
    table = tippe.reversal_table(
        rattleback(), theta=TILT, azimuth=AZIMUTH, spin=[-5.0, 5.0, -40.0], t1=12.0, tolerance=1e-10, progress=False
    )
    assert table.status.tolist() == ["reversed", "reversed", "contact_lost"]
    assert_close(table.time[:2], [2.6846470, 11.4588456], atol=5e-8)
    launch = tippe.Launch(TILT, -5.0, azimuth=AZIMUTH)
    assert_close(tippe.reversal_time(rattleback(), launch, 12.0, tolerance=1e-10), 2.6846470, atol=5e-8)


# Limits and other formulations


@pytest.mark.parametrize("tilt", [0.0, 0.3])
@pytest.mark.parametrize("body", [rutstam_top(), egg()], ids=["top", "egg"])
def test_a_body_of_revolution_moves_as_it_does_by_its_own_equations(body, tilt):
    """Rates, forces, energies and -L.r at 50 states, under sliding, drilling and rolling friction."""
    law, arena = tippe.Rolling(1e-3, 2.0, tippe.Contensou(0.3, 2e-3, 0.05)), tippe.Plane(tilt)
    round_scene, rigid = tippe.Scene(body, arena, law), tippe.Scene(as_ellipsoid(body), arena, law)
    states = random_states(round_scene, 50)
    state = turned_anyhow(states)
    for name in ("field", "normal_force", "slip_velocity", "energy", "jellett", "spin", "friction_power"):
        expected = np.atleast_2d(getattr(round_scene, name)(states))
        size = np.abs(expected).max(axis=1, keepdims=True)
        assert_close(np.atleast_2d(getattr(rigid, name)(state))[: len(size)] / size, expected / size, atol=1e-13)


@pytest.mark.parametrize(
    ("law", "arena"),
    [(LAW, tippe.Plane()), (tippe.NoSlip(), tippe.Plane()), (LAW, tippe.Sphere(0.2))],
    ids=["sliding", "rolling", "in a bowl"],
)
def test_a_support_function_gives_the_ellipsoid(law, arena):
    """h(d)^2 = sum of (a d)^2; the numbers of a module are numbers of the scene."""

    class Reach(eqx.Module):
        semi_axes: tuple

        def __call__(self, d):
            return jnp.sqrt(sum((a * part) ** 2 for a, part in zip(self.semi_axes, d, strict=True)))

    scene = tippe.Scene(tippe.Ellipsoid(*ODD, ODD_INERTIA), arena, law)
    body = tippe.RigidBody(ODD[0], ODD_INERTIA, Reach(ODD[1]), ODD[2])
    states = turned_anyhow(random_states(tippe.Scene(rutstam_top(), arena), 50))
    expected = np.asarray(scene.field(states))
    size = np.abs(expected).max(axis=1, keepdims=True)
    assert_close(tippe.Scene(body, arena, law).field(states) / size, expected / size, atol=1e-13)
    assert len(jax.tree.leaves(body.support)) == 3


@pytest.mark.parametrize("rolls", [False, True])
def test_accelerations_and_forces_are_those_of_an_independent_program(rolls):
    """At 20 states: nine linear equations for accelerations and force, where the simulator eliminates."""
    law = tippe.NoSlip() if rolls else LAW
    scene = odd_scene(law)
    states = scene.dynamics.carried_along(any_states(20))
    motion = scene.dynamics.motion(states)
    f1, f2 = motion.friction.force
    rate = np.asarray(scene.dynamics.field(states))
    slide = None if rolls else lambda v: -0.3 * v / math.hypot(*v, 0.05)
    reference = Rattleback(*ODD, ODD_INERTIA, slide)
    turning = np.stack(scene.dynamics.rotation(states)[0])
    rise = np.asarray(jax.jvp(scene.path_from_frame, (states,), (jnp.asarray(rate),))[1][2])
    for k, state in enumerate(np.asarray(states).T):
        Q = np.stack([state[8:11], np.cross(state[2:5], state[8:11]), state[2:5]], axis=1)
        y = np.concatenate([np.zeros(3), (*state[:2], rise[k]), quaternion(Q), turning[:, k]])
        rates, force = reference.motion(y)
        N = float(motion.normal_force[k])
        size = abs(force).max()
        assert_close(np.array([f1[k] * N, f2[k] * N, N]) / size, force / size, atol=1e-11)
        # L' = r x F, and u' = F / m.
        torque = np.cross(reference.lever(Q)[0], force)
        assert_close(rate[5:8, k] / size, torque / size, atol=1e-13)
        assert_close(rate[:2, k] / size, rates[3:5] / size, atol=1e-9)


# Balances and integrals


@pytest.mark.parametrize("law", [tippe.Frictionless(), LAW, tippe.NoSlip()], ids=["frictionless", "sliding", "rolling"])
def test_energy_changes_as_friction_works(law):
    """dE/dt = N f.v_s <= 0 at 200 states of a body with nothing special about it; pure rolling keeps the energy."""
    scene = odd_scene(law)
    states = any_states(200)
    power = jax.jvp(scene.energy, (states,), (scene.field(states),))[1]
    size = np.abs(np.asarray(scene.energy(states))) * 100.0
    work = np.zeros(200) if isinstance(law, tippe.NoSlip) else np.asarray(scene.friction_power(states))
    assert_close(power / size, work / size, atol=1e-13)
    assert np.all(work * np.sign(scene.normal_force(states)) <= 0.0)


def chaplygins_ball(law: tippe.AbstractFriction) -> tippe.Scene:
    return tippe.Scene(tippe.Ellipsoid(0.1, (0.02,) * 3, (0.0,) * 3, ODD_INERTIA), friction=law)


def test_chaplygins_ball_keeps_its_integrals():
    """Angular momentum about the contact, a fixed vector, and energy; under friction with slip its vertical component."""
    scene = chaplygins_ball(tippe.NoSlip())
    states = any_states(100)

    def about_contact(state):
        w = jnp.stack(scene.dynamics.rotation(state)[0])
        return state[5:8] + 0.1 * 0.02**2 * (w - UP[:, None] * w[2])

    rate = jax.jvp(about_contact, (states,), (scene.field(states),))[1]
    size = np.abs(np.asarray(about_contact(states))).max() * 100.0
    assert_close(rate / size, 0.0, atol=1e-13)
    sliding = chaplygins_ball(LAW)
    assert_close(sliding.field(states)[7] / size, 0.0, atol=1e-13)


@pytest.fixture(scope="module")
def run() -> tippe.Trajectory:
    return tippe.simulate(rattleback(), tippe.Launch(0.02, -5.0), t1=0.6)


def test_a_run_of_a_rattleback(run):
    """It keeps its energy, its contact point is on the plane and at rest, and what the reaction needs of grip is reported."""
    assert run.status == "completed"
    assert run.stats["energy_residual"] < 1e-9 * float(run.energy[0])
    assert_close(run.contact[:, 2], 0.0, atol=1e-15)
    arm = np.asarray(run.contact - run.position)
    assert_close(np.asarray(run.velocity) + np.cross(run.angular_velocity, arm), 0.0, atol=1e-11)
    assert_close(run.reaction[:, 2], run.normal_force, rtol=1e-14)
    assert_close(run.grip, np.hypot(*np.asarray(run.reaction)[:, :2].T) / run.normal_force, rtol=1e-12)
    assert 0.02 < float(run.grip.max()) < 2.0
    data = run.to_table()
    assert_close(data.normal_spin, np.asarray(run.angular_velocity)[:, 2], atol=1e-12)
    assert data.units["grip"] == "1"


def test_a_run_is_that_of_an_independent_program(run):
    reference = Rattleback(1.0, SHAPE, CENTRE, INERTIA)
    times = np.array([0.1, 0.3])
    expected = reference.run(reference.start(0.02, 0.0, -5.0), times, rtol=1e-10)
    states = run.at(times)
    assert_close(states.position, expected[:, :3], atol=1e-9)
    assert_close(states.velocity, expected[:, 3:6], atol=1e-8)
    assert_close(states.angular_velocity, expected[:, 10:], atol=1e-7)


def test_what_is_drawn_stands_on_the_plane(run):
    """The lowest corner of the mesh, turned and put where the page has it, is at z = 0 but for the mesh's width."""
    ((show,),) = [stage.shows for stage in run.stages()]
    (body,) = show.bodies
    corners = np.concatenate([mesh.vertices for mesh in body.meshes])
    assert_close((((corners + np.array(CENTRE)) / SHAPE) ** 2).sum(axis=1), 1.0, atol=1e-12)
    lowest_points = [
        (corners @ turning.T + position)[:, 2].min()
        for position, turning in zip(
            body.position[::50], Rotation.from_quat(body.orientation[::50]).as_matrix(), strict=True
        )
    ]
    assert min(lowest_points) > -1e-9
    assert max(lowest_points) < 1e-3


# Times and derivatives


@pytest.mark.parametrize(
    "sensitivities", [[], pytest.param(["inertia.xx"], marks=pytest.mark.slow)], ids=["time", "derivative"]
)
def test_an_unbalanced_top_inverts_when_the_balanced_one_does(sensitivities):
    """At 5.9693325388 s, by the equations of a top; and a row of moments, with the derivative of the table."""
    scene = tippe.Scene(as_ellipsoid(rutstam_top()), friction=tippe.Viscous(0.3))
    I1, step = float(rutstam_top().I1), 1e-11
    table = tippe.inversion_table(
        scene,
        theta=0.1,
        spin=155.0,
        t1=8.0,
        tolerance=1e-12,
        axes={"inertia.xx": [I1 - step, I1, I1 + step]},
        sensitivities=sensitivities,
        progress=False,
    )
    assert_close(table.time[1], 5.9693325388, atol=1e-9)
    if sensitivities:
        difference = (table.time[2] - table.time[0]) / (2.0 * step)
        assert_close(table.time_by_xx[1], difference, rtol=1e-4)


@pytest.mark.slow
def test_limits_have_the_same_times_to_a_nanosecond():
    """Inversion times of a top, and rising times of an egg, by both sets of equations."""
    law = tippe.Viscous(0.3)
    rising_body = tippe.SpheroidBody(0.05, 0.02, 0.028, 1.184e-5, 8e-6)
    for body, launch, angle in (
        (rutstam_top(), tippe.Launch(0.1, 155.0), 0.95 * math.pi),
        (rising_body, tippe.Launch(1.8, 0.0, angular_velocity=(0.0, 0.0, 140.0)), 2.6),
    ):
        round_time, rigid_time = (
            float(tippe.inversion_time(tippe.Scene(shape, friction=law), launch, 8.0, angle, tolerance=1e-13))
            for shape in (body, as_ellipsoid(body))
        )
        assert math.isfinite(round_time)
        assert_close(rigid_time, round_time, atol=1e-9)


@pytest.mark.slow
def test_reversals_are_those_of_an_independent_program():
    """Both directions of Kane and Levinson's rattleback, to 1e-8 s."""
    reference = Rattleback(1.0, SHAPE, CENTRE, INERTIA)
    for spin in (-5.0, 5.0):
        expected = reference.reversal(reference.start(TILT, AZIMUTH, spin), 12.0)
        time = tippe.reversal_time(rattleback(), tippe.Launch(TILT, spin, azimuth=AZIMUTH), 12.0, tolerance=1e-13)
        assert_close(time, expected, atol=1e-8)


def time_of_reversal(numbers, tolerance: float = 1e-11):
    """By every component of inertia, shape, centre of mass and launch."""
    mass, axes, centre, inertia, theta, azimuth, spin = numbers
    scene = tippe.Scene(tippe.Ellipsoid(mass, tuple(axes), tuple(centre), inertia), friction=tippe.NoSlip())
    return tippe.reversal_time(scene, tippe.Launch(theta, spin, azimuth=azimuth), t1=5.0, tolerance=tolerance)


@pytest.mark.slow
def test_derivatives_by_every_component():
    """Reverse mode against central differences, the best of four steps; illegal traced numbers give NaN."""
    point = (
        jnp.asarray(1.0),
        jnp.array(SHAPE),
        jnp.array([1e-4, 2e-4, -0.01]),
        jnp.array(INERTIA),
        *map(jnp.asarray, (0.02, 0.1, -5.0)),
    )
    slopes = jax.grad(time_of_reversal)(point)
    leaves, structure = jax.tree.flatten(point)
    run = jax.jit(lambda numbers: time_of_reversal(numbers, 1e-12))
    for k, (leaf, slope) in enumerate(zip(leaves, jax.tree.leaves(slopes), strict=True)):
        for index in np.ndindex(leaf.shape):
            mirrored = index[::-1] if len(index) == 2 else index
            size = max(abs(float(leaf[index])), 1e-4 if len(index) == 2 else 1e-2)
            expected = float(slope[index]) + (float(slope[mirrored]) if mirrored != index else 0.0)
            errors = []
            for step in (1e-3 * size, 1e-4 * size, 1e-5 * size, 1e-6 * size):
                move = np.zeros(leaf.shape)
                move[index] = move[mirrored] = step
                sides = [
                    run(jax.tree.unflatten(structure, [*leaves[:k], leaf + sign * move, *leaves[k + 1 :]]))
                    for sign in (1.0, -1.0)
                ]
                errors.append(abs(float(sides[0] - sides[1]) / (2.0 * step) - expected))
            assert min(errors) < 1e-5 * abs(expected) + 1e-7, (k, index)
    for place, number in ((1, -0.03), (3, -1.0)):
        illegal = [*leaves]
        illegal[place] = leaves[place].at[(1,) * leaves[place].ndim].set(number)
        assert math.isnan(run(jax.tree.unflatten(structure, illegal)))
    assert math.isnan(run((*point[:-1], jnp.zeros(()))))


@pytest.mark.slow
def test_the_inertia_of_a_rattleback_is_found_from_its_motion():
    """Product of inertia and depth of the centre of mass from a recorded tilt with an error of 0.1 mrad."""
    times = np.linspace(0.05, 1.5, 40)
    run = tippe.simulate(rattleback(), tippe.Launch(0.02, -5.0), t1=1.5, times=times)
    random = np.random.default_rng(5)
    value = np.asarray(run.theta) + 1e-4 * random.normal(size=40)
    data = tippe.Recording(tippe.Launch(0.02, -5.0), times, value, 1e-4, "theta")
    free = {"inertia.xy": -1.8e-5, "centre_of_mass[2]": -0.0101}
    fit = tippe.identify(rattleback(), data, free, progress=False)
    for name, value in (("scene.body.inertia.xy", -2e-5), ("scene.body.centre_of_mass[2]", -0.01)):
        assert abs(fit.estimates[name] - value) < 4.0 * fit.standard_errors[name]
        assert fit.standard_errors[name] < 0.02 * abs(value)


# Refusals


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: tippe.Ellipsoid(1.0, SHAPE, CENTRE, np.diag([1.0, 1.0, 3.0])),
            "sum of the other two; here they are 1, 1, 3",
        ),
        (lambda: tippe.Ellipsoid(1.0, SHAPE, CENTRE, np.diag([1.0, 1.0, 0.0])), "positive; here they are 0, 1, 1"),
        (lambda: tippe.Ellipsoid(1.0, SHAPE, CENTRE, [[1, 2, 0], [0, 1, 0], [0, 0, 1]]), r"inertia\[0\]\[1\] = 2"),
        (lambda: tippe.Ellipsoid(1.0, SHAPE, CENTRE, [1, 2, 3]), r"must be a \(3, 3\) matrix"),
        (lambda: tippe.Ellipsoid(1.0, SHAPE[:2], CENTRE, INERTIA), "semi_axes .* three numbers"),
        (lambda: tippe.Ellipsoid(1.0, SHAPE, (0.0, 0.0, -0.03), INERTIA), "centre of mass lies inside"),
        (lambda: tippe.RigidBody(1.0, INERTIA, lambda d: 0.1 + 0.1 * d[0] ** 4), "strictly convex"),
        (lambda: tippe.RigidBody(1.0, INERTIA, lambda d: d), r"one number for \(direction \(3,\)\)"),
        (lambda: tippe.Scene(egg(), tippe.Cylinder(1.0)), "a Plane for a SpheroidBody; .* Ellipsoid"),
        (
            lambda: tippe.Scene(chaplygins_ball(LAW).body, tippe.Sphere(1.0), contact="hybrid"),
            "must be 'stop' for an Ellipsoid",
        ),
        (lambda: tippe.Scene(rattleback().body, tippe.Sphere(0.19)), "radius = 0.19 must be greater than 0.2"),
        (
            lambda: tippe.Scene(egg(), friction=tippe.SetValuedCoulomb(0.3)),
            "single mode for a SpheroidBody, .* Ellipsoid",
        ),
        (lambda: tippe.Scene(rutstam_top(), friction=tippe.NoSlip()), "another law for a Top"),
        (lambda: tippe.Rolling(1e-3, 1.0, tippe.NoSlip()), "must be a sliding law"),
        (
            lambda: tippe.simulate(rattleback(), tippe.Launch(0.1, 1.0, velocity=(1.0, 0.0)), 1.0),
            "velocity .* left out",
        ),
        (
            lambda: tippe.reversal_time(tippe.Scene(egg()), tippe.Launch(0.1, 1.0), 1.0),
            "a body of revolution keeps its sense",
        ),
        (lambda: tippe.reversal_time(rattleback(), tippe.Launch(0.1, 0.0), 1.0), "spin = 0.0"),
        (lambda: tippe.reversal_table(rattleback(), theta=0.1, spin=[0.0, 1.0], t1=1.0), "spin = 0.0"),
        (lambda: tippe.explore(rattleback(), tippe.Launch(0.1, 0.0)), "spin = 0.0"),
    ],
)
def test_what_is_not_possible_is_refused_by_name(make, words):
    with pytest.raises(ValueError, match=words):
        make()
