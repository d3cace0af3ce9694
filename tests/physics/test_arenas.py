"""The top on any arena: an independent program, the forms of its own arenas, and where it does not fit."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arena_reference import SAMPLES, Top, cases, recorded
from close import assert_close
from scipy.integrate import solve_ivp
from tops import rutstam_top

import tippe
from nonholonomic.geometry.frames import frame_of
from nonholonomic.validation import as_number
from tippe.friction import AbstractFriction, ContactLoad

REFERENCE = recorded()


class AnyLaw(AbstractFriction):
    """Viscous friction where the slip speed is 0, and regularised Coulomb friction elsewhere."""

    mu: jax.Array = eqx.field(converter=as_number)
    slip_speed: jax.Array = eqx.field(converter=as_number)

    def per_normal_force(self, slip):
        viscous = self.slip_speed == 0.0
        speed = jnp.sqrt(slip.x * slip.x + slip.y * slip.y + jnp.where(viscous, 1.0, self.slip_speed) ** 2)
        factor = -self.mu / jnp.where(viscous, 1.0, speed)
        return ContactLoad((factor * slip.x, factor * slip.y))


def surface_of(case):
    """The arena of a case as its own class, with the side."""
    graph = tippe.Graph(lambda x, y: case.p1 * jnp.sin(case.p2 * x) * jnp.cos(case.p2 * y))
    return {
        "tilted plane": (tippe.Plane(case.p1), None),
        "paraboloid": (tippe.Paraboloid(case.p1), None),
        "graph": (graph, None),
        "spheroid": (tippe.Spheroid(case.p1, case.p2) if case.p2 > 0.0 else None, None),
        "outside of a sphere": (tippe.Sphere(case.p1), "outside"),
        "outside of a spheroid": (tippe.Spheroid(case.p1, case.p2) if case.p2 > 0.0 else None, "outside"),
        "torus": (tippe.Torus(case.p1, case.p2) if 0.0 < case.p2 < case.p1 else None, None),
    }[case.arena]


def scene_of(case, place):
    """Scene and launch of a case."""
    surface, side = surface_of(case)
    scene = tippe.Scene(rutstam_top(), surface, AnyLaw(case.mu, case.slip_speed), side=side)
    arguments = {"place": place, "velocity": (case.v1, case.v2), "angular_velocity": (case.w1, case.w2, case.w3)}
    return scene, tippe.Launch(case.theta, case.spin, azimuth=case.azimuth, **arguments)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(REFERENCE)), ids=lambda k: f"{REFERENCE[k]['arena']} {k % 2}")
def test_an_independent_program_sees_the_same_motion(number):
    """Newton-Euler with a multiplier in the fixed frame, the foot found anew at every step: centre, axis, force, end."""
    row = REFERENCE[number]
    scene, launch = scene_of(cases()[number], tuple(row[f"q{i}"] for i in (1, 2, 3)))
    times = row["t1"] * np.arange(1, SAMPLES + 1) / SAMPLES
    run = tippe.simulate(scene, launch, row["t1"], times, 1e-11)
    assert run.status == row["status"]
    assert_close(run.end_time, row["end_time"], atol=1e-8)
    assert len(run.t) == np.sum(times <= row["end_time"])
    for k in range(1, len(run.t) + 1):
        assert_close(run.position[k - 1], [row[f"O{i}_{k}"] for i in range(3)], atol=1e-8)
        assert_close(run.axis[k - 1], [row[f"e{i}_{k}"] for i in range(3)], atol=1e-8)
        assert_close(run.normal_force[k - 1], row[f"N_{k}"], atol=1e-8)


@pytest.mark.parametrize("case", cases(), ids=lambda case: f"{case.arena} {case.slip_speed}")
def test_an_independent_program_sees_the_same_forces(case):
    """At the start, on the arena's own class: velocity, normal force, friction, and the rate at which the axis turns."""
    top = Top(case)
    y = top.start()
    scene, launch = scene_of(case, tuple(top.near))
    rates, force = top.motion(y)
    state = scene.state(launch)
    motion, axes = scene.dynamics.motion(state), np.array(scene.frame.pose(*scene.start(launch)).axes, dtype=float)
    assert_close(state[2:5] @ axes, y[6:9], atol=1e-13)
    assert_close(motion.normal_force, force, rtol=1e-11)
    e, L = state[2:5] @ axes, state[5:8] @ axes
    assert_close(np.array(motion.velocity) @ axes[:2], y[3:6] + case.offset * np.cross(y[9:12], y[6:9]), atol=1e-13)
    assert_close(np.cross(L, e) / case.I1, rates[6:9], atol=1e-10)
    push = force * (axes[2] + np.array(motion.friction.force) @ axes[:2])
    assert_close(push / case.mass - np.array([0.0, 0.0, case.gravity]), rates[3:6], atol=1e-9)


OWN = {
    "plane": (tippe.Plane(), None, {}),
    "tilted plane": (tippe.Plane(0.3), None, {}),
    "cylinder": (tippe.Cylinder(0.3), None, {"eta": 0.4}),
    "outside of a cylinder": (tippe.Cylinder(0.3), "outside", {"eta": 3.0}),
    "sphere": (tippe.Sphere(0.3), None, {"eta": 0.4}),
    "outside of a sphere": (tippe.Sphere(0.3), "outside", {"eta": 3.0}),
}


SLOWER = ("plane", "cylinder", "outside of a sphere")


@pytest.mark.parametrize("name", [pytest.param(arena, marks=[pytest.mark.slow] * (arena in SLOWER)) for arena in OWN])
def test_the_forms_of_their_own_move_as_the_general_one(name):
    """The same launch under both equations for 0.3 s: axis and centre in the fixed frame, and the spin."""
    surface, side, place = OWN[name]
    scene = tippe.Scene(rutstam_top(), surface, tippe.Coulomb(0.3, 0.1), side=side)
    launch = tippe.Launch(0.8, 100.0, azimuth=0.5, velocity=(0.1, -0.05), angular_velocity=(3.0, -2.0, 1.0), **place)
    state, (own_place, own_path) = scene.state(launch), scene.start(launch)
    general_frame = frame_of(surface, surface.sign(side, "inside"), scene.body.radius, jnp.asarray(20.0), carried=True)
    axes, centre, _ = scene.frame.pose(own_place, own_path)
    normal = axes[2]
    foot = tuple(c - scene.body.radius * n for c, n in zip(centre, normal, strict=True))
    first = (*surface.in_own_axes(foot), *surface.in_own_axes(axes[0]))
    motions = []
    for frame, start, path in ((scene.frame, own_place, own_path), (general_frame, first, ())):
        dynamics = dataclasses.replace(scene.dynamics, frame=frame)
        size = 8 + len(start)
        y = np.concatenate([state[:8], np.array([0.0 if part is None else float(part) for part in (*start, *path)])])

        @jax.jit
        def rate(y, dynamics=dynamics, frame=frame, size=size):
            motion = dynamics.motion(y[:size])
            riding = frame.cyclic_rate(tuple(y[size:]), motion.velocity, motion.frame_rate)
            return jnp.stack([0.0 * y[0] if part is None else part for part in (*motion.rate, *riding)])

        y = solve_ivp(lambda _, y, rate=rate: np.asarray(rate(y)), (0.0, 0.3), y, "DOP853", rtol=1e-12, atol=1e-14).y[
            :, -1
        ]
        place_and_path = (tuple(y[8:size]), tuple(y[size:]))
        pose = frame.pose(*map(lambda part: tuple(map(jnp.asarray, part)), place_and_path))
        axes, centre = np.array(pose.axes, dtype=float), np.array(pose.position, dtype=float)
        motions.append(np.concatenate([y[2:5] @ axes, centre, y[5:8] @ axes / float(scene.body.I3 * 100.0)]))
    assert_close(motions[0], motions[1], atol=1e-10)


def test_what_an_arena_does_not_have_is_refused():
    top = rutstam_top()
    bowl, ball = tippe.Scene(top, tippe.Paraboloid(0.3)), tippe.Scene(top, tippe.Sphere(0.3))
    level = tippe.Scene(top, tippe.Implicit(lambda x, y, z: z))
    for scene, launch, message in (
        (bowl, tippe.Launch(0.1, 1.0, eta=0.3), r"eta = 0\.3 must be"),
        (bowl, tippe.Launch(0.1, 1.0, place=(0.1, 0.1, 0.5)), "from the surface"),
        (ball, tippe.Launch(0.1, 1.0, place=(0.1, 4.0)), r"place\[1\] = 4\.0 must be at most"),
        (level, tippe.Launch(0.1, 1.0), r"place must be given, as \(x, y, z\)"),
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
    t1, t2, n = np.array(scene.frame.pose(*scene.start(launch)).axes, dtype=float)
    assert_close(n, -point / 0.3, atol=1e-15)
    expected = np.array([1.0, 0.0, 0.0]) - n[0] * n
    assert_close(t1, expected / np.linalg.norm(expected), atol=1e-15)
    assert_close(t2, np.cross(n, t1), atol=1e-15)
