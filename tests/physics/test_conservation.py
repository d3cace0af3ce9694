"""Quantities that are constant or change at a known rate: energy, Jellett's constant, the length of the axis."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import random_states, rutstam_top

import tippe
from nonholonomic.integration import Settings

LAWS = {
    "frictionless": tippe.Frictionless(),
    "viscous": tippe.Viscous(0.3),
    "coulomb": tippe.Coulomb(0.3, 0.05),
}
TORQUES = {
    "contensou": tippe.Contensou(0.3, 2e-3, 0.05),
    "rolling": tippe.Rolling(1e-3, 2.0, tippe.Viscous(0.3)),
    "both": tippe.Rolling(1e-3, 2.0, tippe.Contensou(0.3, 2e-3, 0.05)),
}
ARENAS = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(0.3), "sphere": tippe.Sphere(0.3)}


@pytest.mark.parametrize("law", [pytest.param(law, marks=pytest.mark.slow if law != "coulomb" else ()) for law in LAWS])
def test_jelletts_constant_on_the_plane(law):
    """lambda is constant to 1e-9 over 30 s for every friction at the contact point, and |e| = 1 with it."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), LAWS[law])
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0), 30.0, tolerance=1e-11)
    assert run.status == "completed"
    assert_close(run.jellett, run.jellett[0], rtol=1e-9)
    assert run.stats["axis_drift"] < 1e-9


def test_the_axis_keeps_its_length_without_projection(rutstam_scene):
    """|e| = 1 to 1e-9 at tolerance 1e-10, through the whole inversion."""
    run = tippe.simulate(rutstam_scene, tippe.Launch(0.1, 155.0), 8.0, tolerance=1e-10)
    assert run.stats["axis_drift"] < 1e-9


#: Whose rates of energy at random states are all that the ordinary run looks at.
LONGER = [("coulomb", "cylinder"), ("frictionless", "cylinder"), *((law, "sphere") for law in LAWS)]


@pytest.mark.parametrize(
    ("law", "arena"),
    [
        pytest.param(law, arena, marks=pytest.mark.slow if (law, arena) in LONGER else ())
        for law in LAWS
        for arena in ARENAS
    ],
)
def test_energy_changes_by_the_work_of_friction(law, arena):
    """dE = integral of N f.v_s dt to 1e-8 of E; without friction E is constant, with it E never grows."""
    scene = tippe.Scene(rutstam_top(), ARENAS[arena], LAWS[law])
    run = tippe.simulate(scene, tippe.Launch(0.3, 100.0, eta=0.4 if arena != "plane" else 0.0), 2.0, tolerance=1e-10)
    energy = np.asarray(run.energy)
    assert run.stats["energy_residual"] < 1e-8 * energy[0]
    assert np.all(np.diff(energy) <= 1e-12 * energy[0])
    if law == "frictionless":
        assert_close(energy, energy[0], rtol=1e-9)


@pytest.mark.parametrize("arena", ARENAS)
@pytest.mark.parametrize("law", LAWS | TORQUES)
def test_rates_of_energy_and_jellett_at_random_states(arena, law):
    """dE/dt = N (f.v_s + tau.w) <= 0 and dlambda/dt = R L.n' + N tau.(R n - a e), at 200 random states."""
    scene = tippe.Scene(rutstam_top(), ARENAS[arena], (LAWS | TORQUES)[law])
    states = random_states(scene, 200)
    rates = scene.field(states)
    _, energy_rate = jax.jvp(scene.energy, (states,), (rates,))
    scale = np.abs(np.asarray(scene.energy(states))) * 100.0
    assert_close(energy_rate / scale, scene.friction_power(states) / scale, atol=1e-13)
    assert np.all(np.asarray(scene.friction_power(states)) * np.sign(scene.normal_force(states)) <= 0.0)
    _, jellett_rate = jax.jvp(scene.jellett, (states,), (rates,))
    motion = scene.dynamics.motion(states)
    turning = [jnp.zeros(200) if part is None else part for part in motion.frame_rate]
    expected = -scene.body.radius * (turning[0] * states[5] + turning[1] * states[6])
    torque = jnp.stack([jnp.zeros(200) if part is None else part for part in motion.friction.torque])
    arm = jnp.asarray([[0.0], [0.0], [1.0]]) * scene.body.radius - scene.body.offset * states[2:5]
    expected = expected + motion.normal_force * jnp.sum(torque * arm, axis=0)
    assert (law in TORQUES) == bool(jnp.any(torque != 0.0))
    size = float(scene.body.radius) * float(scene.body.I3) * 100.0 * 100.0
    assert_close(jellett_rate / size, expected / size, atol=1e-13)


def test_jellett_is_not_constant_in_the_cylinder():
    """There it changes by R L.n' along the way, by tens of percent."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.2), tippe.Viscous(0.3))
    run = tippe.simulate(scene, tippe.Launch(0.1, 120.0, eta=0.3), 3.0)
    assert float(jnp.max(jnp.abs(run.jellett / run.jellett[0] - 1.0))) > 0.1


def test_position_is_the_integral_of_velocity(rutstam_scene):
    """The path's rate, on dense output, is the velocity of the centre: plane, cylinder and sphere."""
    for arena in ARENAS.values():
        scene = tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3))
        run = tippe.simulate(scene, tippe.Launch(0.4, 120.0, eta=0.3), 0.5, tolerance=1e-11)
        middle, step = np.linspace(0.1, 0.4, 7), 1e-4
        state_after, state_before = run.at(middle + step), run.at(middle - step)
        difference = (np.asarray(state_after.position) - np.asarray(state_before.position)) / (2.0 * step)
        assert_close(difference, run.at(middle).velocity, atol=2e-5)
        assert_close(np.linalg.norm(run.axis, axis=1), 1.0, atol=1e-10)


def test_a_frictionless_run_goes_back_to_its_start():
    """Reversing velocity and angular momentum retraces the way (time reversal)."""
    from nonholonomic.integration import follow
    from tippe.modes.problems import trajectory_problem

    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Frictionless())
    run = trajectory_problem((scene, tippe.Launch(0.3, 60.0, eta=0.5)))
    end_state = follow(run, 1.0, Settings(1e-12)).states[:10, -1]
    sign = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0, 1.0])
    start = run.problem.states
    reversed_run = eqx.tree_at(lambda run: run.problem.states, run, jnp.asarray(end_state * sign))
    home = follow(reversed_run, 1.0, Settings(1e-12)).states[:10, -1] * sign
    assert_close(home[2:5], start[2:5], atol=1e-8)
    assert_close(home[8:], start[8:], atol=1e-8)
