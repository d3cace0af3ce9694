"""Motions of the top that are known in closed form (tippe.md, section 7)."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from scipy.special import ellipk
from tops import homogeneous_ball, rutstam_top

import nonholonomic
import tippe
from nonholonomic.integration import Settings, follow
from tippe.modes.problems import trajectory_problem

GRAVITY = 9.81


def thrown(scene: tippe.Scene, velocity: float, times, tolerance: float = 1e-11):
    """A ball thrown along t1 without spin: states at the given times. A launch starts at rest, so the run is made here."""
    run = trajectory_problem((scene, tippe.Launch(theta=0.7, spin=0.0)))
    run = eqx.tree_at(lambda run: run.problem.states, run, run.problem.states.at[0].set(velocity))
    path = follow(run, float(times[-1]), Settings(tolerance))
    return jnp.asarray(path.at(np.asarray(times)))[:8]


def test_slip_of_a_homogeneous_ball_decays_exponentially():
    """Viscous friction: v_s = v0 exp(-(7/2) mu g t), ending at 5 v0/7 (tippe.md, section 7, row 1)."""
    scene = tippe.Scene(homogeneous_ball(), tippe.Plane(), tippe.Viscous(0.3))
    times = np.linspace(0.05, 1.5, 8)
    states = thrown(scene, 1.0, times)
    assert_close(scene.slip_velocity(states)[0], np.exp(-3.5 * 0.3 * GRAVITY * times), rtol=1e-9, atol=1e-15)
    # V = V_end + (v0 - V_end) exp(...), V_end = 5/7.
    assert_close(states[0], 5.0 / 7.0 + 2.0 / 7.0 * np.exp(-3.5 * 0.3 * GRAVITY * times), rtol=1e-10)


def test_a_bowling_ball_stops_sliding_at_the_known_time_and_speed():
    """Coulomb, slip speed to zero: v = v0 - mu g t until t* = 2 v0/(7 mu g), then 5 v0/7; error about slip_speed^2."""
    mu, end = 0.3, 2.0 / (7.0 * 0.3 * GRAVITY)
    times = np.linspace(0.1, 0.98, 12) * end
    errors = []
    for slip_speed in (1e-2, 1e-3):
        scene = tippe.Scene(homogeneous_ball(), tippe.Plane(), tippe.Coulomb(mu, slip_speed))
        states = thrown(scene, 1.0, np.append(times, 3.0 * end))
        errors.append(float(np.max(np.abs(states[0, :-1] - (1.0 - mu * GRAVITY * times)))))
        assert_close(states[0, -1], 5.0 / 7.0, rtol=1e-9)
    assert errors[0] < 7e-4
    assert errors[1] < 8e-6
    assert 60.0 < errors[0] / errors[1] < 110.0


def test_a_free_ball_turns_about_its_angular_momentum():
    """Frictionless, offset 0: e rotates about L at |L|/I1 (tippe.md, section 7, row 3)."""
    mass, radius = 0.05, 0.02
    top = tippe.Top(mass, radius, 0.0, 0.4 * mass * radius**2, 0.5 * mass * radius**2)
    scene = tippe.Scene(top, tippe.Plane(), tippe.Frictionless())
    run = trajectory_problem((scene, tippe.Launch(theta=0.7, spin=0.0)))
    momentum = np.array([1.0, -2.0, 3.0]) * 3e-4
    run = eqx.tree_at(lambda run: run.problem.states, run, run.problem.states.at[5:8].set(momentum))
    end = 2.0
    path = follow(run, end, Settings(1e-12))
    angle, axis = np.linalg.norm(momentum) / float(top.I1) * end, momentum / np.linalg.norm(momentum)
    e = np.asarray(run.problem.states[2:5])
    expected = e * math.cos(angle) + np.cross(axis, e) * math.sin(angle) + axis * (axis @ e) * (1.0 - math.cos(angle))
    assert_close(path.states[2:5, -1], expected, atol=2e-10)


@pytest.mark.parametrize("arena", [pytest.param(tippe.Cylinder(0.2), marks=pytest.mark.slow), tippe.Sphere(0.2)])
def test_a_frictionless_ball_swings_as_a_pendulum(arena):
    """No spin, amplitude 1.2: period 4 sqrt(rho/g) K(sin^2(A/2)) = 0.934689 s for rho = 0.18 (section 7, row 4)."""
    scene = tippe.Scene(homogeneous_ball(), arena, tippe.Frictionless())
    period = 4.0 * math.sqrt(0.18 / GRAVITY) * ellipk(math.sin(0.6) ** 2)
    assert_close(period, 0.934689, atol=5e-7)
    run = tippe.simulate(
        scene, tippe.Launch(0.4, 0.0, eta=1.2), 5.0 * period, times=[4.75 * period, 5.0 * period], tolerance=1e-12
    )
    x = np.asarray(run.position[:, 0])
    assert_close(x, [0.0, 0.18 * math.sin(1.2)], atol=1e-10)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:surface.radius = .* is larger than a room")
def test_the_cylinder_tends_to_the_plane():
    """Radius 1e4 R: e after 0.2 s differs from the plane's as 1/radius (section 7, row 11)."""
    launch = tippe.Launch(0.1, 155.0)
    body = rutstam_top()
    ends = {}
    for factor in (1e2, 1e3, 1e4, None):
        arena = tippe.Plane() if factor is None else tippe.Cylinder(factor * 0.02)
        scene = tippe.Scene(body, arena, tippe.Viscous(0.3))
        ends[factor] = np.asarray(tippe.simulate(scene, launch, 0.2, times=[0.2], tolerance=1e-11).axis[0])
    gaps = [np.linalg.norm(ends[factor] - ends[None]) for factor in (1e2, 1e3, 1e4)]
    assert gaps[2] < 2e-5
    assert_close([gaps[0] / gaps[1], gaps[1] / gaps[2]], 10.0, rtol=0.15)
    # The inversion time, too; not in proportion, because theta comes close to the pole on its way.
    times = [
        float(tippe.inversion_time(tippe.Scene(body, arena, tippe.Viscous(0.3)), launch, 10.0, tolerance=1e-11))
        for arena in (tippe.Plane(), tippe.Cylinder(200.0), tippe.Cylinder(2000.0))
    ]
    near, far = abs(times[1] - times[0]), abs(times[2] - times[0])
    assert far < 1e-4 * times[0]
    assert near > 5.0 * far


def test_the_wall_start_presses_on_the_arena_at_once():
    """eta = pi/2 from rest: N(0) = 0, then N = (3/2) m g^2 t^2 / (rho (1 + m a A)) > 0 (section 8)."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    for theta in (0.1, 0.5, 1.2):
        run = tippe.simulate(scene, tippe.Launch(theta, 80.0, eta=math.pi / 2.0), 2e-3, times=[2e-3])
        assert run.status == "completed"
        m, a, I1 = 0.02, 0.006, 131.0 / 350.0 * 8e-6
        # Slip at the start: w x (-R n), with w = spin e, so f.e = 0 and A has no friction in it.
        A = a * math.sin(theta) ** 2 / I1
        expected = 1.5 * m * GRAVITY**2 * 4e-6 / (0.28 * (1.0 + m * a * A))
        assert_close(run.normal_force[0], expected, rtol=5e-3)


@pytest.mark.parametrize(
    "friction",
    [
        tippe.Viscous(0.3),
        *(pytest.param(law, marks=pytest.mark.slow) for law in (tippe.SetValuedCoulomb(0.3), tippe.NoSlip())),
    ],
    ids=["slides", "sticks", "rolls"],
)
def test_a_sphere_on_a_vertical_wall_loses_contact_at_once(friction):
    """Nothing presses it on the wall: N = 0 for ever, and a spin about the normal does not change that."""
    sphere = tippe.Top(0.02, 0.02, 0.0, 3.2e-6, 3.2e-6)
    if isinstance(friction, tippe.NoSlip):
        sphere = tippe.Ellipsoid(0.02, (0.02, 0.02, 0.02), (0.0, 0.0, 0.0), 3.2e-6 * np.eye(3))
    scene = tippe.Scene(sphere, tippe.Plane(math.pi / 2.0), friction)
    run = tippe.simulate(scene, tippe.Launch(0.0, 20.0), 0.5)
    assert (run.status, run.end_time) == ("contact_lost", 0.0)
    table = nonholonomic.sweep(scene, tippe.Launch(0.0, 20.0), 0.5, axes={"spin": [10.0, 20.0]}, progress=False)
    assert list(table.status) == 2 * ["contact_lost"]
    assert list(table.end_time) == [0.0, 0.0]
