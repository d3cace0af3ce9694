"""The top on any arena: an independent program, the forms of its own arenas, and where it does not fit."""

import csv
import math
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arena_reference import SAMPLES, Top, cases
from conftest import assert_close, rutstam_top
from scipy.integrate import solve_ivp

import tippe
from nonholonomic.geometry import CarriedFrame
from nonholonomic.validation import as_number
from tippe.dynamics import Dynamics
from tippe.friction import AbstractFriction, ContactLoad

REFERENCE = list(csv.DictReader(Path(__file__).with_name("arena_reference.csv").read_text().splitlines()))
ARENAS = ("tilted plane", "paraboloid", "graph", "spheroid", "outside of a sphere", "torus")


class AnyArena(eqx.Module):
    """The functions of all arenas of the reference, of which `chosen` picks one in each lane: one program serves them all."""

    chosen: jax.Array
    p1: jax.Array
    p2: jax.Array

    def __call__(self, x, y, z):
        p1, p2 = self.p1, self.p2
        quadric = 1.0 - (x * x + y * y) / p1**2 - z * z / p2**2
        levels = (
            z * jnp.cos(p1) - x * jnp.sin(p1),
            z - (x * x + y * y) / (2.0 * p1),
            z - p1 * jnp.sin(p2 * x) * jnp.cos(p2 * y),
            quadric,
            -quadric,
            p2**2 - (jnp.sqrt(x * x + y * y) - p1) ** 2 - z * z,
        )
        return sum(jnp.where(self.chosen == k, level, 0.0) for k, level in enumerate(levels))


class AnyLaw(AbstractFriction):
    """Viscous friction where the slip speed is 0, and regularised Coulomb friction elsewhere."""

    mu: jax.Array = eqx.field(converter=as_number)
    slip_speed: jax.Array = eqx.field(converter=as_number)

    def per_normal_force(self, slip):
        viscous = self.slip_speed == 0.0
        speed = jnp.sqrt(slip.x * slip.x + slip.y * slip.y + jnp.where(viscous, 1.0, self.slip_speed) ** 2)
        factor = -self.mu / jnp.where(viscous, 1.0, speed)
        return ContactLoad((factor * slip.x, factor * slip.y))


def columns(*names):
    return tuple(jnp.array([float(row[name]) for row in REFERENCE]) for name in names)


@pytest.fixture(scope="module")
def against_the_reference():
    """All scenes of the reference, run in one block at a tolerance of 1e-11."""
    chosen = jnp.array([float(ARENAS.index(row["arena"])) for row in REFERENCE])
    p1, p2, mu, slip_speed, theta, spin, azimuth, t1 = columns(
        "p1", "p2", "mu", "slip_speed", "theta", "spin", "azimuth", "t1"
    )
    places, velocities = columns("q1", "q2", "q3"), columns("v1", "v2")
    turning = columns("w1", "w2", "w3")
    times = jnp.linspace(0.0, float(t1[0]), SAMPLES + 1)[1:]

    @jax.jit
    @jax.vmap
    def run(chosen, p1, p2, law, given, place, velocity, turning):
        scene = tippe.Scene(rutstam_top(), tippe.Implicit(AnyArena(chosen, p1, jnp.where(p2 == 0.0, 1.0, p2))), law)
        theta, spin, azimuth = given
        launch = tippe.Launch(theta, spin, azimuth=azimuth, place=place, velocity=velocity, angular_velocity=turning)
        found = tippe.simulate(scene, launch, t1[0], times, 1e-11)
        return found.position, found.axis, found.normal_force, found.status, found.end_time

    law = jax.vmap(AnyLaw)(mu, slip_speed)
    return run(chosen, p1, p2, law, (theta, spin, azimuth), places, velocities, turning)


@pytest.mark.parametrize("number", range(len(REFERENCE)), ids=lambda k: f"{REFERENCE[k]['arena']} {k % 2}")
def test_an_independent_program_sees_the_same(against_the_reference, number):
    """Newton-Euler with a multiplier in the fixed frame, the foot found anew at every step: centre, axis, force, end."""
    position, axis, force, status, end = (part[number] for part in against_the_reference)
    row = {name: value if name in ("arena", "status") else float(value) for name, value in REFERENCE[number].items()}
    assert status == {"reached t1": 0, "contact_lost": 1}[row["status"]]
    assert_close(end, row["end_time"], atol=1e-8)
    weight, compared = 0.02 * 9.81, 0
    for k in range(1, SAMPLES + 1):
        if k * row["t1"] / SAMPLES > row["end_time"]:
            assert not np.isfinite(position[k - 1]).any()
            continue
        assert_close(position[k - 1], [row[f"O{i}_{k}"] for i in range(3)], atol=1e-8)
        assert_close(axis[k - 1], [row[f"e{i}_{k}"] for i in range(3)], atol=1e-8)
        assert_close(force[k - 1] / weight, row[f"N_{k}"] / weight, atol=1e-7)
        compared += 1
    assert compared >= SAMPLES - 1


def test_the_reference_is_what_its_program_says():
    """Rates and force at the start of every case."""
    for case, row in zip(cases(), REFERENCE, strict=True):
        top = Top(case)
        y = top.start()
        assert_close(top.near, [float(row[f"q{i}"]) for i in (1, 2, 3)], atol=1e-14)
        rates, force = top.motion(y)
        assert np.isfinite(rates).all()
        assert force > 0.0


OWN = {
    "plane": (tippe.Plane(), None, {}),
    "tilted plane": (tippe.Plane(0.3), None, {}),
    "cylinder": (tippe.Cylinder(0.3), None, {"eta": 0.4}),
    "outside of a cylinder": (tippe.Cylinder(0.3), "outside", {"eta": 3.0}),
    "sphere": (tippe.Sphere(0.3), None, {"eta": 0.4}),
    "outside of a sphere": (tippe.Sphere(0.3), "outside", {"eta": 3.0}),
}


@pytest.mark.parametrize("name", OWN)
def test_the_forms_of_their_own_move_as_the_general_one(name):
    """The same launch under both equations for 0.3 s: axis and centre in the fixed frame, and the spin."""
    surface, side, place = OWN[name]
    scene = tippe.Scene(rutstam_top(), surface, tippe.Coulomb(0.3, 0.1), side=side)
    launch = tippe.Launch(0.8, 100.0, azimuth=0.5, velocity=(0.1, -0.05), angular_velocity=(3.0, -2.0, 1.0), **place)
    state, (own_place, own_path) = scene.state(launch), scene.start(launch)
    general = CarriedFrame(surface, scene.body.radius, jnp.asarray(20.0), surface.sign(side, "inside"))
    axes = scene.frame.axes(own_place, own_path)
    centre, normal = scene.frame.position(own_place, own_path), axes[2]
    foot = tuple(c - scene.body.radius * n for c, n in zip(centre, normal, strict=True))
    first = (*surface.in_own_axes(foot), *surface.in_own_axes(axes[0]))
    found = []
    for frame, start, path in ((scene.frame, own_place, own_path), (general, first, ())):
        dynamics = Dynamics.of(scene.body, frame, scene.friction, scene.gravity)
        size = 8 + len(start)
        y = np.concatenate([state[:8], np.array([0.0 if part is None else float(part) for part in (*start, *path)])])

        @jax.jit
        def rate(y, dynamics=dynamics, frame=frame, size=size):
            motion = dynamics.motion(y[:size])
            riding = frame.cyclic_rate(tuple(y[size:]), motion.velocity, motion.turning)
            return jnp.stack([0.0 * y[0] if part is None else part for part in (*motion.rate, *riding)])

        y = solve_ivp(lambda _, y, rate=rate: np.asarray(rate(y)), (0.0, 0.3), y, "DOP853", rtol=1e-12, atol=1e-14).y[
            :, -1
        ]
        where = (tuple(y[8:size]), tuple(y[size:]))
        axes = np.array(frame.axes(*map(lambda part: tuple(map(jnp.asarray, part)), where)), dtype=float)
        centre = np.array(frame.position(*map(lambda part: tuple(map(jnp.asarray, part)), where)), dtype=float)
        found.append(np.concatenate([y[2:5] @ axes, centre, y[5:8] @ axes / float(scene.body.I3 * 100.0)]))
    assert_close(found[0], found[1], atol=1e-10)


def test_the_run_ends_where_the_ball_no_longer_fits():
    """A ball of 20 mm in a trough whose curvature grows beyond 1/R along it: the run ends there, in words, on every road."""
    trough = tippe.Graph(lambda x, y: y * y * (5.0 + 150.0 * x))
    scene = tippe.Scene(rutstam_top(), trough, tippe.Viscous(0.3))
    launch = tippe.Launch(0.3, 50.0, place=(0.0, 0.0), velocity=(0.4, 0.0))
    run = tippe.simulate(scene, launch, 1.0)
    assert run.status == "does_not_fit"
    assert float(run.end_time) < 1.0
    # At the bottom of the trough the curvature is 10 + 300 x, so it is 1/R at x = 2/15.
    assert_close(run.contact[-1, 0], 2.0 / 15.0, rtol=1e-3)
    axes = {"launch.place[0]": [0.0], "launch.place[1]": 0.0, "launch.velocity[0]": [-0.4, 0.4]}
    table = tippe.inversion_table(scene, theta=0.3, spin=50.0, t1=0.5, axes=axes)
    assert table.status.tolist() == [["not_inverted", "does_not_fit"]]
    assert_close(table.end_time[0, 1], float(run.end_time), rtol=1e-6)


def test_what_an_arena_does_not_have_is_refused():
    top = rutstam_top()
    bowl, ball = tippe.Scene(top, tippe.Paraboloid(0.3)), tippe.Scene(top, tippe.Sphere(0.3))
    level = tippe.Scene(top, tippe.Implicit(lambda x, y, z: z))
    for scene, launch, message in (
        (bowl, tippe.Launch(0.1, 1.0, eta=0.3), r"eta = 0\.3 must be"),
        (bowl, tippe.Launch(0.1, 1.0, place=(0.1, 0.1, 0.5)), "from the surface"),
        (ball, tippe.Launch(0.1, 1.0, place=(0.1, 4.0)), r"place\[1\] = 4\.0 must be at most"),
        (level, tippe.Launch(0.1, 1.0), r"place = None must be \(x, y, z\)"),
        (level, tippe.Launch(0.1, 1.0, place=(0.0, 0.0)), r"must be \(x \[m\], y \[m\], z \[m\]\)"),
    ):
        with pytest.raises(ValueError, match=message):
            tippe.simulate(scene, launch, 1.0)
    for make, message in (
        (lambda: tippe.Launch(0.1, 1.0, place=0.3), r"place = 0\.3 must be"),
        (lambda: tippe.Launch(0.1, 1.0, velocity=(1.0, 2.0, 3.0)), "velocity = .* must be two numbers"),
        (lambda: tippe.Launch(0.1, 1.0, 0.2, place=(0.0, 0.0)), r"eta = 0\.2 must be at most 0\.0 \(place is given\)"),
        (lambda: tippe.Launch(0.1, 1.0, angular_velocity=(1.0, math.inf, 0.0)), r"angular_velocity\[1\] = inf"),
        (lambda: tippe.Scene(top, tippe.Paraboloid(0.3), side="inside"), "side = 'inside' must be 'above'"),
        (lambda: tippe.Scene(top, tippe.Torus(0.3, 0.01)), r"surface tube = 0\.01 must be greater than 0\.02"),
    ):
        with pytest.raises(ValueError, match=message):
            make()


def test_a_place_may_be_given_by_its_names_or_as_a_point():
    """On a sphere (mu, eta) and (x, y, z); in both t1 is the projection of x, and the velocity is that of the centre."""
    scene = tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.Viscous(0.3))
    mu, eta = 0.7, 1.1
    point = 0.3 * np.array([np.sin(eta) * np.cos(mu), np.sin(eta) * np.sin(mu), -np.cos(eta)])
    states = [
        scene.state(
            tippe.Launch(0.4, 90.0, azimuth=0.3, place=place, velocity=(0.1, 0.2), angular_velocity=(1.0, 2.0, 3.0))
        )
        for place in ((mu, eta), tuple(point))
    ]
    assert_close(states[0], states[1], atol=1e-14)
    motion = scene.dynamics.motion(states[0])
    assert_close(jnp.stack(motion.velocity), [0.1, 0.2], atol=1e-15)
    launch = tippe.Launch(0.4, 90.0, place=(mu, eta))
    t1, t2, n = np.array(scene.frame.axes(*scene.start(launch)), dtype=float)
    assert_close(n, -point / 0.3, atol=1e-15)
    expected = np.array([1.0, 0.0, 0.0]) - n[0] * n
    assert_close(t1, expected / np.linalg.norm(expected), atol=1e-15)
    assert_close(t2, np.cross(n, t1), atol=1e-15)
