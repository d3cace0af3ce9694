"""Bodies of revolution that are no spheres, on a plane: their limits, an independent program, balances, and the rising egg."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, random_states, rutstam_top
from egg_reference import Egg

import tippe

LAWS = {
    "frictionless": tippe.Frictionless(),
    "coulomb": tippe.Coulomb(0.3, 0.05),
    "both": tippe.Rolling(1e-3, 2.0, tippe.Contensou(0.3, 2e-3, 0.05)),
}


def egg(polar: float = 0.028, offset: float = 0.0) -> tippe.SpheroidBody:
    """The homogeneous spheroid of 50 g with the equatorial half axis 2 cm; its centre of mass is shifted all the same."""
    mass, equatorial = 0.05, 0.02
    I1, I3 = mass * (equatorial**2 + polar**2) / 5.0, 0.4 * mass * equatorial**2
    return tippe.SpheroidBody(mass, equatorial, polar, I1, I3, offset)


def by_support(body: tippe.SpheroidBody) -> tippe.ConvexBody:
    """The same body by its support function."""
    square, excess, offset = body.equatorial**2, body.polar**2 - body.equatorial**2, body.offset
    return tippe.ConvexBody(body.mass, lambda c: jnp.sqrt(square + excess * c * c) - offset * c, body.I1, body.I3)


def same_motion(one: tippe.Scene, other: tippe.Scene) -> None:
    """Whether two scenes give the same rates, forces, energies and Jellett's quantities at 50 states."""
    states = random_states(one, 50)
    for name in ("field", "normal_force", "slip_velocity", "energy", "jellett"):
        expected = np.atleast_2d(getattr(one, name)(states))
        size = np.abs(expected).max(axis=1, keepdims=True)
        assert_close(getattr(other, name)(states) / size, expected / size, atol=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_sphere_by_its_support_function_is_the_top(tilt):
    """H = R - a cos(theta), and a spheroid of equal half axes."""
    top, arena, law = rutstam_top(), tippe.Plane(tilt), LAWS["both"]
    scene = tippe.Scene(top, arena, law)
    by_function = tippe.ConvexBody(top.mass, lambda c: top.radius - top.offset * c, top.I1, top.I3)
    same_motion(scene, tippe.Scene(by_function, arena, law))
    ball = tippe.SpheroidBody(top.mass, top.radius, top.radius, top.I1, top.I3, top.offset)
    same_motion(scene, tippe.Scene(ball, arena, law))


def test_a_spheroid_tends_to_the_sphere():
    """The departure of the normal force is proportional to polar - equatorial."""
    off = []
    for change in (1e-5, 1e-6):
        body = egg(0.02 * (1.0 + change), 0.004)
        top = tippe.Top(body.mass, 0.02, 0.004, body.I1, body.I3)
        scenes = [tippe.Scene(one, friction=LAWS["coulomb"]) for one in (body, top)]
        states = random_states(scenes[0], 50)
        off.append(np.abs(np.subtract(*(np.asarray(one.normal_force(states)) for one in scenes))).max())
    assert 9.0 < off[0] / off[1] < 11.0


@pytest.mark.parametrize("polar", [0.028, 0.013])
def test_a_spheroid_by_its_support_function(polar):
    body = egg(polar, 0.003)
    same_motion(tippe.Scene(body, friction=LAWS["coulomb"]), tippe.Scene(by_support(body), friction=LAWS["coulomb"]))


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_rates_of_energy_and_jellett_at_random_states(law, tilt):
    """dE/dt = N (f.v_s + tau.w) <= 0; dJ/dt = -A' c' (L.e - c L.n) - N tau.r; frictionless L.e, and L_z on the level."""
    scene = tippe.Scene(egg(offset=0.003), tippe.Plane(tilt), LAWS[law])
    states = random_states(scene, 200)
    rates = scene.field(states)
    power = jax.jvp(scene.energy, (states,), (rates,))[1]
    size = np.abs(np.asarray(scene.energy(states))) * 100.0
    assert_close(power / size, scene.friction_power(states) / size, atol=1e-13)
    assert np.all(np.asarray(scene.friction_power(states)) * np.sign(scene.normal_force(states)) <= 0.0)
    motion, e, L = scene.dynamics.motion(states), states[2:5], states[5:8]
    lever = scene.body.outline.at(e[2])
    torque = jnp.stack([jnp.zeros(200) if part is None else part for part in motion.friction.torque])
    r = jnp.stack(lever.contact(tuple(e)))
    expected = -lever.growth * rates[4] * (motion.spin_momentum - e[2] * L[2])
    expected -= motion.normal_force * jnp.sum(torque * r, axis=0)
    found = jax.jvp(scene.jellett, (states,), (rates,))[1]
    size = float(scene.body.size * scene.body.I3) * 1e4
    assert_close(found / size, expected / size, atol=1e-13)
    if law == "frictionless":
        axial = jnp.sum(rates[2:5] * L + e * rates[5:8], axis=0)
        assert_close(axial / 1e-2, 0.0, atol=1e-12)
        assert tilt != 0.0 or np.all(np.asarray(rates[7]) == 0.0)


REFERENCE = Egg(0.05, 0.02, 0.028, 0.003, 1.184e-5, 8e-6, 0.3, 0.05)
START = {"theta": 1.3, "azimuth": 0.5, "spin": 40.0}
TURNING, VELOCITY = (3.0, -2.0, 120.0), (0.1, -0.05)


def launched(reference: Egg) -> tuple[tippe.Scene, tippe.Launch]:
    """Scene and launch of a reference."""
    law = tippe.Coulomb(reference.mu, reference.slip_speed) if reference.slip_speed else tippe.Viscous(reference.mu)
    body = tippe.SpheroidBody(reference.mass, reference.b, reference.p, reference.I1, reference.I3, reference.a)
    return tippe.Scene(body, friction=law), tippe.Launch(**START, angular_velocity=TURNING, velocity=VELOCITY)


@pytest.fixture(scope="module")
def run() -> tippe.Trajectory:
    return tippe.simulate(*launched(REFERENCE), 0.15, tolerance=1e-11)


def test_an_independent_program_sees_the_same_motion(run):
    """Newton-Euler with a multiplier: centre of mass, rotation, velocities and N to 1e-8."""
    times = np.linspace(0.05, 0.15, 3)
    found, expected = run.at(times), REFERENCE.run(REFERENCE.start(**START, turning=TURNING, velocity=VELOCITY), times)
    assert_close(found.position, expected[:, :3], atol=1e-9)
    assert_close(found.velocity, expected[:, 3:6], atol=1e-8)
    assert_close(found.rotation, expected[:, 6:15].reshape(-1, 3, 3), atol=1e-8)
    assert_close(found.angular_velocity, expected[:, 15:18], atol=1e-6)
    _, N, r = zip(*map(REFERENCE.motion, expected), strict=True)
    assert_close(found.normal_force, N, atol=1e-8)
    assert_close(found.contact, expected[:, :3] + np.array(r), atol=1e-9)
    assert np.ptp(run.normal_force) > 0.02


def test_what_a_run_says_of_itself(run):
    """The contact is on the plane, its material point moves with the slip velocity, energy goes as friction works."""
    assert_close(run.contact[:, 2], 0.0, atol=1e-15)
    arm = np.asarray(run.contact - run.position)
    assert_close(
        np.asarray(run.velocity) + np.cross(run.angular_velocity, arm), np.pad(run.slip, [(0, 0), (0, 1)]), atol=1e-12
    )
    assert run.stats["energy_residual"] < 1e-10 * float(run.energy[0])
    assert np.all(np.diff(run.energy) < 0.0)
