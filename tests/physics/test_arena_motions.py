"""Whole motions on grounds of any shape: an independent program, energy, drift, Clairaut's constant, derivatives.

The grounds are one family of which every number may be 0, and the friction is one law, so that one program runs them all.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arena_reference import SAMPLES, cases, recorded
from close import assert_close
from hypothesis import given, settings, strategies
from make_gradient_reference import extrapolated
from tops import rutstam_top

import tippe
from nonholonomic.parameters import with_numbers

REFERENCE = recorded()


class Ground(eqx.Module):
    """Two waves, a bowl, and a trough that narrows: z = sum h sin(a x + b y + c) + bowl (x^2 + y^2) / 2 + y^2 (t + u x)."""

    first: tuple = (0.0, 0.0, 0.0, 0.0)
    second: tuple = (0.0, 0.0, 0.0, 0.0)
    bowl: float = 0.0
    trough: tuple = (0.0, 0.0)

    def __call__(self, x, y):
        waves = sum(h * jnp.sin(a * x + b * y + c) for h, a, b, c in (self.first, self.second))
        return waves + 0.5 * self.bowl * (x * x + y * y) + y * y * (self.trough[0] + self.trough[1] * x)


def scene_on(ground, mu=0.3, slip_speed=0.05, gravity=9.81):
    return tippe.Scene(rutstam_top(), tippe.Graph(ground), tippe.Coulomb(mu, slip_speed), gravity)


def launched(place, velocity=(0.0, 0.0), turning=(0.0, 0.0, 0.0), theta=0.3, spin=100.0, azimuth=0.0):
    """A launch with all its numbers given, so that all launches share a program."""
    return tippe.Launch(theta, spin, azimuth=azimuth, place=place, velocity=velocity, angular_velocity=turning)


def moments(run):
    """Moment about the vertical through the origin [kg m^2/s]: m (s x s')_z + L_z."""
    body, e = run.scene.body, np.asarray(run.axis)
    w = np.asarray(run.angular_velocity)
    L = float(body.I1) * w + float(body.I3 - body.I1) * np.sum(w * e, axis=1, keepdims=True) * e
    s = np.asarray(run.position) - float(body.offset) * e
    s_rate = np.asarray(run.velocity) - float(body.offset) * np.cross(w, e)
    return float(body.mass) * (s[:, 0] * s_rate[:, 1] - s[:, 1] * s_rate[:, 0]) + L[:, 2]


WAVES = [k for k, case in enumerate(cases()) if case.arena == "graph" and case.slip_speed > 0.0]


@pytest.mark.parametrize("number", WAVES, ids=lambda k: REFERENCE[k]["status"])
def test_an_independent_program_sees_the_same_motion_over_waves(number):
    """The rows of `arena_reference.csv` over waves, with Coulomb friction: centre, axis, normal force; how and when it ends."""
    row, case = REFERENCE[number], cases()[number]
    # sin(k x) cos(k y) is the sum of two waves of half the height.
    half, k = 0.5 * case.p1, case.p2
    scene = scene_on(Ground((half, k, k, 0.0), (half, k, -k, 0.0)), case.mu, case.slip_speed)
    place = (row["q1"], row["q2"])
    launch = launched(place, (case.v1, case.v2), (case.w1, case.w2, case.w3), case.theta, case.spin, case.azimuth)
    run = tippe.simulate(scene, launch, row["t1"], row["t1"] * np.arange(1, SAMPLES + 1) / SAMPLES, 1e-11)
    assert run.status == row["status"]
    assert_close(run.end_time, row["end_time"], atol=1e-8)
    assert len(run.t) >= 1
    for sample in range(1, len(run.t) + 1):
        assert_close(run.position[sample - 1], [row[f"O{i}_{sample}"] for i in range(3)], atol=1e-8)
        assert_close(run.axis[sample - 1], [row[f"e{i}_{sample}"] for i in range(3)], atol=1e-8)
        assert_close(run.normal_force[sample - 1], row[f"N_{sample}"], atol=1e-8)


def test_clairauts_constant_of_a_whole_motion():
    """Without friction, in a bowl, over two seconds of tumbling: the moment about the vertical, and the energy."""
    scene = scene_on(Ground(bowl=1.0 / 0.3), mu=0.0)
    run = tippe.simulate(scene, launched((0.1, -0.06), (0.2, 0.3), (4.0, -6.0, 2.0), 0.6), 2.0, tolerance=1e-11)
    assert run.status == "completed"
    values = moments(run)
    assert np.ptp(run.position, axis=0).min() > 0.01
    assert_close(values, values[0], atol=1e-9 * np.max(np.abs(values)))
    assert_close(run.energy, run.energy[0], rtol=1e-9)


def off_the_arena(run):
    """The greatest distance of the foot from the arena, in units of R."""
    frame = run.scene.frame
    feet = tuple(jnp.asarray(run.states[8:11]))
    return float(jnp.max(jnp.abs(frame.surface.offset(feet))) / run.scene.body.radius)


def test_the_foot_stays_on_the_arena():
    """The constraint drifts by less than the tolerance; for a thousand seconds below."""
    scene = scene_on(Ground((0.01, 7.0, 7.0, 0.0), (0.01, 7.0, -7.0, 0.0), bowl=1.0), mu=0.02)
    launch = launched((0.1, 0.05), (0.2, 0.1), spin=30.0)
    run = tippe.simulate(scene, launch, 10.0, tolerance=1e-5)
    assert run.status == "completed"
    assert 1e-12 < off_the_arena(run) < 1e-5


#: Arenas of the general form, and where a top starts on them.
LONG = {
    "graph": (tippe.Graph(lambda x, y: (x * x + y * y) / 0.6 + 0.005 * jnp.cos(9.0 * x)), (0.1, 0.05)),
    "torus": (tippe.Torus(0.5, 0.3), (0.0, 0.3)),
    "spheroid": (tippe.Spheroid(0.3, 0.25), (0.0, 0.3)),
    "cylinder": (
        tippe.Implicit(lambda x, y, z: 0.3 - jnp.sqrt(x * x + z * z)),
        (0.3 * math.sin(0.2), 0.0, -0.3 * math.cos(0.2)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
@pytest.mark.parametrize("arena", LONG)
def test_the_foot_stays_on_the_arena_for_a_thousand_seconds(arena, tolerance):
    """Without friction, so that the top moves about to the end."""
    surface, place = LONG[arena]
    scene = tippe.Scene(rutstam_top(), surface, tippe.Frictionless())
    launch = tippe.Launch(0.3, 20.0, place=place, velocity=(0.2, 0.1))
    run = tippe.simulate(scene, launch, 1000.0, np.linspace(0.0, 1000.0, 501), tolerance)
    assert run.status == "completed"
    # It still moves about by three radii.
    assert np.ptp(np.asarray(run.position)[450:], axis=0).max() > 3.0 * float(scene.body.radius)
    assert 1e-3 * tolerance < off_the_arena(run) < tolerance


def into_a_narrow():
    """A ball of 20 mm in a trough whose curvature grows beyond 1/R along it: the scene, and what its launch is made of."""
    return scene_on(Ground(trough=(5.0, 150.0)), mu=0.0), {"theta": 0.0, "spin": 50.0}


def test_the_run_ends_where_the_ball_no_longer_fits():
    scene, launch = into_a_narrow()
    run = tippe.simulate(scene, launched((0.0, 0.0), (0.4, 0.0), **launch), 1.0)
    assert run.status == "does_not_fit"
    assert float(run.end_time) < 1.0
    # At the bottom of the trough the curvature is 10 + 300 x, so it is 1/R at x = 2/15.
    assert_close(run.contact[-1], (2.0 / 15.0, 0.0, 0.0), atol=1e-4)


@pytest.mark.slow
def test_a_table_says_where_the_ball_no_longer_fits():
    """The same time as the single run; the other way there is room."""
    scene, launch = into_a_narrow()
    run = tippe.simulate(scene, launched((0.0, 0.0), (0.4, 0.0), **launch), 1.0)
    axes = {"launch.place[0]": [0.0], "launch.place[1]": 0.0, "launch.velocity[0]": [-0.4, 0.4]}
    table = tippe.inversion_table(scene, **launch, t1=0.5, axes=axes)
    assert table.status.tolist() == [["not_inverted", "does_not_fit"]]
    assert_close(table.end_time[0, 1], float(run.end_time), rtol=1e-6)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(strategies.integers(0, 2**32 - 1))
def test_on_random_ground_energy_never_grows(seed):
    """Runs are finite or flagged, and friction accounts for the loss of energy."""
    random = np.random.default_rng(seed)

    def wave():
        length, heading = 0.02 * math.exp(random.uniform(math.log(2.0), math.log(50.0))), random.uniform(-3.0, 3.0)
        return (
            length * random.uniform(0.0, 0.3),
            math.cos(heading) / length,
            math.sin(heading) / length,
            random.uniform(-3, 3),
        )

    ground = Ground(wave(), wave(), random.uniform(-2.0, 3.0), tuple(random.uniform(-1.0, 1.0, 2)))
    scene = scene_on(ground, random.uniform(0.0, 1.0), random.uniform(0.02, 1.0), random.uniform(1.0, 30.0))
    numbers = random.uniform(-1.0, 1.0, 8)
    launch = launched(
        tuple(0.2 * numbers[:2]),
        tuple(numbers[2:4]),
        tuple(30.0 * numbers[4:7]),
        3.0 * abs(numbers[7]),
        random.uniform(-300, 300),
    )
    run = tippe.simulate(scene, launch, 0.3, tolerance=1e-9)
    assert run.status in ("completed", "contact_lost", "does_not_fit", "jammed")
    energy = np.asarray(run.energy)
    size = np.ptp(energy) + float(scene.body.I3 * launch.spin**2 + scene.body.mass * scene.gravity * scene.body.radius)
    assert np.all(np.isfinite(run.states))
    assert np.all(np.diff(energy) <= 1e-9 * size)
    assert run.stats["energy_residual"] < 1e-6 * size


#: The parameters with respect to which the forces are differentiated.
NUMBERS = {
    "scene.surface.height.bowl": 1.0 / 0.5,
    "scene.surface.height.first[0]": 0.002,
    "scene.friction.mu": 0.3,
    "launch.place[0]": 0.05,
    "launch.velocity[1]": 0.1,
}


def test_derivatives_of_the_forces_by_ground_friction_and_launch():
    """Of the rates of the state and of the normal force, against scanned differences."""
    roots = {
        "scene": scene_on(Ground((0.002, 30.0, 10.0, 0.3), bowl=2.0)),
        "launch": launched((0.05, 0.02), (0.0, 0.1)),
    }

    @jax.jit
    def forces(*values):
        copies = with_numbers(roots, dict(zip(NUMBERS, values, strict=True)))
        state = copies["scene"].state(copies["launch"])
        return jnp.append(copies["scene"].field(state), copies["scene"].normal_force(state))

    # Arrays, for which there is one program whichever number is moved.
    numbers_of_law = tuple(map(np.asarray, NUMBERS.values()))
    jacobian = np.stack(jax.jit(jax.jacfwd(forces, tuple(range(len(numbers_of_law)))))(*numbers_of_law))
    for k, value in enumerate(numbers_of_law):

        def difference(step, k=k):
            forces_above, forces_below = (
                forces(*numbers_of_law[:k], numbers_of_law[k] + sign * step, *numbers_of_law[k + 1 :])
                for sign in (1.0, -1.0)
            )
            return (forces_above - forces_below) / (2.0 * step)

        steps = 1e-2 * value / 1.6 ** np.arange(8)
        differences = np.stack([difference(step) for step in steps])
        expected, error = np.transpose([extrapolated(column) for column in differences.T])
        size = np.max(np.abs(expected))
        assert size > 1e-3
        assert_close(jacobian[k], expected, atol=1e-9 * size)
        assert np.max(error) < 1e-9 * size
