"""Bodies of revolution that are no spheres, on a plane: their limits, an independent program, balances, and the rising egg."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from egg_reference import Egg
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from tops import random_states, rutstam_top

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


def same_motion(first: tippe.Scene, second: tippe.Scene) -> None:
    """Whether two scenes give the same rates, forces, energies and Jellett's quantities at 50 states."""
    states = random_states(first, 50)
    for name in ("field", "normal_force", "slip_velocity", "energy", "jellett"):
        expected = np.atleast_2d(getattr(first, name)(states))
        size = np.abs(expected).max(axis=1, keepdims=True)
        assert_close(getattr(second, name)(states) / size, expected / size, atol=1e-12)


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
    errors = []
    for change in (1e-5, 1e-6):
        body = egg(0.02 * (1.0 + change), 0.004)
        top = tippe.Top(body.mass, 0.02, 0.004, body.I1, body.I3)
        scenes = [tippe.Scene(shape, friction=LAWS["coulomb"]) for shape in (body, top)]
        states = random_states(scenes[0], 50)
        errors.append(np.abs(np.subtract(*(np.asarray(scene.normal_force(states)) for scene in scenes))).max())
    assert 9.0 < errors[0] / errors[1] < 11.0


@pytest.mark.parametrize("polar", [0.028, 0.013])
def test_a_spheroid_by_its_support_function(polar):
    body = egg(polar, 0.003)
    same_motion(tippe.Scene(body, friction=LAWS["coulomb"]), tippe.Scene(by_support(body), friction=LAWS["coulomb"]))


@pytest.mark.parametrize(("law", "tilt"), [("frictionless", 0.0), ("coulomb", 0.3), ("both", 0.0)])
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
    lever = scene.body.meridian.at(e[2])
    torque = jnp.stack([jnp.zeros(200) if part is None else part for part in motion.friction.torque])
    r = jnp.stack(lever.contact(tuple(e)))
    expected = -lever.growth * rates[4] * (scene.body.I3 * motion.spin - e[2] * L[2])
    expected -= motion.normal_force * jnp.sum(torque * r, axis=0)
    rate = jax.jvp(scene.jellett, (states,), (rates,))[1]
    size = float(scene.body.size * scene.body.I3) * 1e4
    assert_close(rate / size, expected / size, atol=1e-13)
    if law == "frictionless":
        axial = jnp.sum(rates[2:5] * L + e * rates[5:8], axis=0)
        assert_close(axial / 1e-2, 0.0, atol=1e-12)
        assert np.all(np.asarray(rates[7]) == 0.0)


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
    motion, expected = run.at(times), REFERENCE.run(REFERENCE.start(**START, turning=TURNING, velocity=VELOCITY), times)
    assert_close(motion.position, expected[:, :3], atol=1e-9)
    assert_close(motion.velocity, expected[:, 3:6], atol=1e-8)
    assert_close(motion.rotation, expected[:, 6:15].reshape(-1, 3, 3), atol=1e-8)
    assert_close(motion.angular_velocity, expected[:, 15:18], atol=1e-6)
    _, N, r = zip(*map(REFERENCE.motion, expected), strict=True)
    assert_close(motion.normal_force, N, atol=1e-8)
    assert_close(motion.contact, expected[:, :3] + np.array(r), atol=1e-9)
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


def test_what_is_drawn_of_a_run_stands_on_the_plane(run):
    """The lowest corner of the egg's mesh, turned and put where the page has it, is at z = 0 but for the mesh's width."""
    ((show,),) = [stage.shows for stage in run.stages()]
    (body,), lowest_points = show.bodies, []
    corners = np.concatenate([mesh.vertices for mesh in body.meshes])
    square = (corners[:, 0] ** 2 + corners[:, 1] ** 2) / 0.02**2 + (corners[:, 2] - 0.003) ** 2 / 0.028**2
    assert_close(square, 1.0, atol=1e-9)
    for position, turning in zip(
        body.position[::50], Rotation.from_quat(body.orientation[::50]).as_matrix(), strict=True
    ):
        lowest_points.append((corners @ turning.T + position)[:, 2].min())
    assert min(lowest_points) > -1e-9
    assert max(lowest_points) < 1e-4


# The egg that rises


def balanced(body: tippe.SpheroidBody, turning: float, raised: float) -> tippe.Launch:
    """Steady precession, raised a little from lying flat: (I3 w3 - I1 W c) W = -m g A, the centre of mass at rest."""
    theta = math.pi / 2.0 + raised
    c, A = math.cos(theta), float(body.meridian.at(math.cos(theta)).offset)
    axial = float(body.I1) * turning * c - float(body.mass) * 9.81 * A / turning
    return tippe.Launch(theta, axial / float(body.I3) - turning * c, angular_velocity=(0.0, 0.0, turning))


def slow_rise(body: tippe.SpheroidBody, force, turning: float, raised: float, angle: float) -> float:
    """Time [s] to an angle if the egg precesses steadily at every moment, N its weight and the force per N given by the slip.

    With L = I1 W n + D e, D = -m g A / W, the slip is across e and n, v = sin(theta) [W A + (w3 - W c) B], and the force F
    there changes L.n at the rate A F sin(theta) and L.e at the rate B F sin(theta). Moffatt and Shimomura (2002) leave D out,
    as W grows without bound.
    """
    m, b, p, I1, I3 = (float(x) for x in (body.mass, body.equatorial, body.polar, body.I1, body.I3))

    def lever(c):
        height = np.sqrt(b * b + (p * p - b * b) * c * c)
        return -(p * p - b * b) * c / height, b * b / height

    def momenta(x):
        turning, c = x
        D = -m * 9.81 * lever(c)[0] / turning
        return np.array((I1 * turning + D * c, I1 * turning * c + D))

    def rate(_, x):
        (turning, c), (A, B) = x, lever(x[1])
        sine = np.sqrt(1.0 - c * c)
        slip = sine * (turning * A + (momenta(x)[1] / I3 - turning * c) * B)
        steps = np.diag((1e-6 * turning, 1e-7))
        jacobian = np.stack([(momenta(x + h) - momenta(x - h)) / (2.0 * h.sum()) for h in steps], axis=1)
        return np.linalg.solve(jacobian, m * 9.81 * force(slip) * sine * np.array((A, B)))

    def reached(_, x):
        return x[1] - math.cos(angle)

    reached.terminal = True
    return solve_ivp(rate, (0.0, 100.0), (turning, -math.sin(raised)), events=reached, rtol=1e-9, atol=1e-12).t[-1]


def rising_time(mu: float, polar: float, raised: float, angle: float) -> float:
    """Moffatt and Shimomura's rate under viscous friction, integrated: tan(theta - pi/2) grows as exp(k t)."""
    k = 2.5 * mu * 9.81 * (polar**2 - 0.02**2) / (polar**2 + 0.02**2)
    return math.log(math.tan(angle - math.pi / 2.0) / math.tan(raised)) / k


def test_the_slow_rise_tends_to_that_of_moffatt_and_shimomura():
    """As the inverse square of the spin."""
    limit = rising_time(0.3, 0.028, 0.1, 3.0)
    errors = [slow_rise(egg(), lambda v: -0.3 * v, spin, 0.1, 3.0) - limit for spin in (400.0, 800.0)]
    assert 0.0 < errors[1] < 0.01 * limit
    assert 3.9 < errors[0] / errors[1] < 4.2


def reaches(run: tippe.Trajectory, angle: float) -> float:
    """When a run first reaches an angle [s]."""
    index = int(np.argmax(np.asarray(run.theta) >= angle))
    assert index > 0
    times = np.linspace(float(run.t[index - 1]), float(run.t[index]), 200)
    return float(np.interp(angle, run.at(times).theta, times))


LAW = tippe.Coulomb(0.2, 0.05)


@pytest.fixture(scope="module")
def risen() -> tippe.Trajectory:
    return tippe.simulate(tippe.Scene(egg(), friction=LAW), balanced(egg(), 140.0, 0.2), 0.9, tolerance=1e-7)


def test_an_egg_rises(risen):
    """From lying to nearly upright, in the time of a slow rise but for what it moves; Jellett's quantity drifts by percents."""
    assert risen.status == "completed"
    rate_of_rise = slow_rise(egg(), lambda v: -0.2 * v / math.hypot(v, 0.05), 140.0, 0.2, 2.9)
    assert_close(reaches(risen, 2.9), rate_of_rise, rtol=0.05)
    drift = np.asarray(risen.jellett) / float(risen.jellett[0]) - 1.0
    assert 1e-3 < np.abs(drift).max() < 0.02
    assert float(risen.position[-1, 2]) > 0.0275


def test_a_table_of_eggs(risen):
    """It has the time of the run, and says which do not rise."""
    launch = balanced(egg(), 140.0, 0.2)
    axes = {"launch.angular_velocity[2]": [140.0, 30.0]}
    table = tippe.inversion_table(
        risen.scene, theta=float(launch.theta), spin=float(launch.spin), t1=0.9, angle=2.9, tolerance=1e-7, axes=axes
    )
    assert table.status.tolist() == ["inverted", "not_inverted"]
    assert_close(table.time[0], reaches(risen, 2.9), rtol=1e-4)
    assert "polar=0.028 m" in repr(risen.scene.body)


@pytest.mark.slow
def test_rising_times_of_fast_eggs():
    """Viscous: 2 % off a slow rise at 100 rad/s and less the faster; a still faster one jumps on the way."""
    body = egg()
    scene, errors = tippe.Scene(body, friction=tippe.Viscous(0.3)), []
    for spin in (100.0, 140.0, 200.0):
        time = tippe.inversion_time(scene, balanced(body, spin, 0.1), 5.0, tolerance=1e-8)
        errors.append(float(time) / slow_rise(body, lambda v: -0.3 * v, spin, 0.1, 0.95 * math.pi) - 1.0)
    assert 0.0 < errors[2] < errors[1] < errors[0] < 0.025
    assert errors[2] < 0.006
    assert tippe.simulate(scene, balanced(body, 280.0, 0.1), 5.0, tolerance=1e-8).status == "contact_lost"


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda body: body, by_support], ids=["spheroid", "support"])
def test_derivatives_of_rising_times(make):
    """By half axis, friction and angular velocity, against differences; forward and reverse, and as a table has them."""

    def time(polar, mu, turning):
        body = make(tippe.SpheroidBody(0.05, 0.02, polar, 1.184e-5, 8e-6))
        launch = tippe.Launch(1.8, 0.0, angular_velocity=(0.0, 0.0, turning))
        return tippe.inversion_time(tippe.Scene(body, friction=tippe.Viscous(mu)), launch, 3.0, 2.6, 1e-11)

    numbers = (jnp.asarray(0.028), jnp.asarray(0.3), jnp.asarray(140.0))
    gradient = jax.grad(time, argnums=(0, 1, 2))(*numbers)
    for k in range(3):
        sides = [time(*numbers[:k], numbers[k] * (1.0 + step), *numbers[k + 1 :]) for step in (1e-5, -1e-5)]
        difference = (sides[0] - sides[1]) / (2e-5 * numbers[k])
        assert_close(gradient[k], difference, rtol=1e-5)
