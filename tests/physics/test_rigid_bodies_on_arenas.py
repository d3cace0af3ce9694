"""Bodies of any shape and inertia on curved arenas: limits, an independent program, balances, ends of contact, derivatives."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from rigid import AZIMUTH, CENTRE, INERTIA, LAW, ODD, ODD_INERTIA, SHAPE, TILT, as_ellipsoid, turned_anyhow
from rigid_arena_reference import OnArena, turn
from rigid_reference import quaternion
from tops import random_states, rutstam_top

import tippe

ARENAS = {
    "cylinder": (tippe.Cylinder(0.3), "inside"),
    "sphere": (tippe.Sphere(0.2), "outside"),
    "spheroid": (tippe.Spheroid(0.5, 0.3), "inside"),
    "paraboloid": (tippe.Paraboloid(0.3), None),
    "graph": (tippe.Graph(lambda x, y: 0.1 * jnp.sin(3.0 * x + 1.0) * jnp.cos(2.0 * y + 0.5)), None),
}
DISC_LAW = tippe.Rolling(1e-3, 2.0, tippe.Contensou(0.3, 2e-3, 0.05))


def states_on(arena, side, count: int):
    """States of a body with nothing special about them."""
    return turned_anyhow(random_states(tippe.Scene(rutstam_top(), arena, side=side), count))


def odd_on(arena, side, law) -> tippe.Scene:
    return tippe.Scene(tippe.Ellipsoid(*ODD, ODD_INERTIA), arena, law, side=side)


# Limits and other formulations


@pytest.mark.parametrize("name", ARENAS)
def test_a_top_moves_as_it_does_by_its_own_equations(name):
    """Rates, forces, slips, energies and powers at 50 states, under sliding, drilling and rolling friction."""
    arena, side = ARENAS[name]
    state = states_on(arena, side, 50)
    states = state[:-3]
    top, rigid = (
        tippe.Scene(body, arena, DISC_LAW, side=side) for body in (rutstam_top(), as_ellipsoid(rutstam_top()))
    )
    for quantity in ("field", "normal_force", "slip_velocity", "energy", "friction_power"):
        expected = np.atleast_2d(getattr(top, quantity)(states))
        size = np.maximum(np.abs(expected).max(axis=1, keepdims=True), 1e-12)
        assert_close(np.atleast_2d(getattr(rigid, quantity)(state))[: len(size)] / size, expected / size, atol=1e-13)


@pytest.mark.parametrize("rolls", [False, True], ids=["sliding", "rolling"])
@pytest.mark.parametrize("name", ["cylinder", "spheroid"])
def test_forces_and_contact_are_those_of_an_independent_program(name, rolls):
    """At 10 states in the fixed frame: the contact point, the reaction, and the acceleration of the centre of mass."""
    arena, side = ARENAS[name]
    scene = odd_on(arena, side, tippe.NoSlip() if rolls else LAW)
    states = scene.dynamics.carried_along(states_on(arena, side, 10))
    slide = None if rolls else lambda v: -0.3 * v / math.hypot(*v, 0.05)
    reference = OnArena(*ODD, ODD_INERTIA, slide, arena=name, p1=0.3 if name == "cylinder" else 0.5, p2=0.3)
    motion = scene.dynamics.motion(states)
    f1, f2 = motion.friction.force
    frame, rise = scene.frame, tuple(-part for part in scene.dynamics.rotation(states)[1])
    place_and_path = (tuple(states[8:-3]), (jnp.zeros(10),) * (2 if name == "cylinder" else 0))
    axes = np.array(
        jnp.broadcast_arrays(*(part for axis in frame.pose(*place_and_path).axes for part in axis))
    ).reshape(3, 3, 10)
    foot = np.array(jnp.broadcast_arrays(*frame.pose(*place_and_path).position))
    turning, slip = np.stack(scene.dynamics.rotation(states)[0]), np.asarray(scene.slip_velocity(states))
    for k, state in enumerate(np.asarray(states).T):
        to_fixed = axes[:, :, k].T
        Q = to_fixed @ np.stack([state[-3:], np.cross(state[2:5], state[-3:]), state[2:5]], axis=1)
        lever = -to_fixed @ np.array([part[k] for part in rise])
        w = to_fixed @ turning[:, k]
        u = to_fixed @ np.append(slip[:, k], 0.0) - np.cross(w, lever)
        y = np.concatenate([foot[:, k] - lever, u, quaternion(Q), w])
        _, force = reference.motion(y, foot[:, k])
        N = float(motion.normal_force[k])
        size = abs(force).max()
        assert_close(to_fixed @ [f1[k] * N, f2[k] * N, N] / size, force / size, atol=1e-8)
        lever_after, lever_before = (
            reference.contact(y[:3] + s * u, turn(s * w) @ Q, foot[:, k])[0] for s in (1e-5, -1e-5)
        )
        velocity = np.array([float(part[k]) for part in motion.velocity])
        assert_close(
            to_fixed.T @ (lever_after - lever_before) / 2e-5, [*velocity, 0.0], atol=1e-6 * np.abs(velocity).max()
        )


# Balances


@pytest.mark.parametrize("name", ["cylinder", "graph"])
def test_energy_changes_as_friction_works(name):
    """dE/dt = N f.v_s <= 0 at 100 states under friction; rolling keeps the energy, and the contact point at rest."""
    arena, side = ARENAS[name]
    sliding, rolling = odd_on(arena, side, LAW), odd_on(arena, side, tippe.NoSlip())
    states = states_on(arena, side, 100)
    size = 100.0 * np.abs(np.asarray(sliding.energy(states)))
    power = jax.jvp(sliding.energy, (states,), (sliding.field(states),))[1]
    work = np.asarray(sliding.friction_power(states))
    assert_close(power / size, work / size, atol=1e-13)
    assert np.all(work * np.sign(sliding.normal_force(states)) <= 0.0)
    states = rolling.dynamics.carried_along(states)
    rate = rolling.field(states)
    assert_close(jax.jvp(rolling.energy, (states,), (rate,))[1] / size, 0.0, atol=1e-13)
    imposed = jax.jvp(rolling.dynamics.carried_along, (states,), (rate,))[1]
    assert_close((imposed - rate)[:2] / np.abs(rate[:2]).max(), 0.0, atol=1e-13)


@pytest.fixture(scope="module")
def run() -> tippe.Trajectory:
    """A rattleback that rolls along a gutter, its long axis along it."""
    inertia = ((1.6e-3, -2e-5, 0.0), (-2e-5, 2e-4, 0.0), (0.0, 0.0, 1.7e-3))
    scene = tippe.Scene(tippe.Ellipsoid(1.0, (0.03, 0.2, 0.02), CENTRE, inertia), tippe.Cylinder(0.5), tippe.NoSlip())
    return tippe.simulate(scene, tippe.Launch(0.02, 0.5, place=(0.0, 0.1)), t1=0.5)


@pytest.mark.slow
def test_a_run_in_a_cylinder(run):
    """The contact point is on the arena and at rest, the velocity is the position's rate, and the energy stays."""
    assert run.status == "completed"
    assert run.stats["energy_residual"] < 1e-9
    assert_close(np.hypot(run.contact[:, 0], run.contact[:, 2]), 0.5, rtol=1e-13)
    arm = np.asarray(run.contact - run.position)
    assert_close(np.asarray(run.velocity) + np.cross(run.angular_velocity, arm), 0.0, atol=1e-11)
    times, step = np.linspace(0.1, 0.4, 5), 1e-4
    rate = (np.asarray(run.at(times + step).position) - np.asarray(run.at(times - step).position)) / (2.0 * step)
    assert_close(run.at(times).velocity, rate, atol=1e-5)
    assert run.to_table().eta.shape == run.t.shape


# Times, ends of contact, derivatives


def reversals(radii, spin, **options) -> tippe.Table:
    """Times of a rattleback that rolls in bowls of some radii [m]."""
    scene = tippe.Scene(tippe.Ellipsoid(1.0, SHAPE, CENTRE, INERTIA), tippe.Sphere(4.0), tippe.NoSlip())
    axes, start = {"surface.radius": radii}, {"theta": TILT, "azimuth": AZIMUTH, "spin": spin}
    return tippe.reversal_table(scene, **start, axes=axes, t1=4.0, progress=False, **options)


@pytest.mark.slow
def test_reversals_in_bowls_and_how_contact_ends():
    """In a bowl of 10^8 m a rattleback reverses when it does on the plane, at 2.6846470 s. Where the bowl is more curved than
    the body, a run ends at once. A fast rattleback jumps."""
    table = reversals([1.0, 4.0, 1e8], [-5.0, -40.0], tolerance=1e-10)
    assert table.status.tolist()[0] == ["does_not_fit", "reversed", "reversed"]
    assert table.status[1, -1] == "contact_lost"
    assert table.end_time[0, 0] == 0.0
    assert_close(table.time[0, -1], 2.6846470, atol=1e-7)
    assert abs(table.time[0, 1] - table.time[0, -1]) > 0.1


@pytest.mark.slow
def test_derivatives_by_the_bowls_radius():
    """Against central differences, the best of three steps."""
    errors = []
    for step in (1e-2, 1e-3, 1e-4):
        table = reversals([4.0 - step, 4.0, 4.0 + step], -5.0, tolerance=1e-12, sensitivities=["surface.radius"])
        difference = (table.time[2] - table.time[0]) / (2.0 * step)
        errors.append(abs(float(table.time_by_radius[1] / difference) - 1.0))
    assert min(errors) < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("name", ARENAS)
def test_a_top_inverts_when_it_does_by_its_own_equations(name):
    """The time to 1.2 rad, within a nanosecond, at a tolerance of 1e-13; on top of a sphere, to 0.35 rad."""
    arena, side = ARENAS[name]
    place = {"sphere": (0.3, math.pi - 0.02), "paraboloid": (0.02, 0.03), "graph": (-0.84, -0.22)}.get(name)
    launch, angle = tippe.Launch(0.3, 140.0, place=place), 0.35 if name == "sphere" else 1.2
    scenes = (
        tippe.Scene(body, arena, tippe.Viscous(0.3), side=side) for body in (rutstam_top(), as_ellipsoid(rutstam_top()))
    )
    times = [float(tippe.inversion_time(scene, launch, 9.0, angle, tolerance=1e-13)) for scene in scenes]
    assert math.isfinite(times[0])
    assert_close(times[1], times[0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("rolls", [False, True], ids=["sliding", "rolling"])
def test_runs_are_those_of_an_independent_program(rolls):
    """0.3 s of an odd body in a spheroidal bowl."""
    arena, side = ARENAS["spheroid"]
    scene = odd_on(arena, side, tippe.NoSlip() if rolls else LAW)
    run = tippe.simulate(scene, tippe.Launch(0.4, 30.0, azimuth=0.3, place=(0.5, 0.4)), t1=0.3, tolerance=1e-12)
    slide = None if rolls else lambda v: -0.3 * v / math.hypot(*v, 0.05)
    reference = OnArena(*ODD, ODD_INERTIA, slide, arena="spheroid", p1=0.5, p2=0.3)
    first = run.at([0.0])
    y = np.concatenate(
        [first.position[0], first.velocity[0], quaternion(np.asarray(first.rotation[0])), first.angular_velocity[0]]
    )
    times = np.array([0.1, 0.3])
    expected = reference.run(y, times, rtol=1e-9)
    states = run.at(times)
    assert_close(states.position, expected[:, :3], atol=1e-7)
    assert_close(states.angular_velocity, expected[:, 10:], atol=1e-4)
