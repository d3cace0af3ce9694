"""What holds on every arena at any state: rates of energy and of Jellett's quantity, moments about a vertical, limits.

All of it is asked of the equations of motion, seen from the fixed frame, so that nothing is integrated.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from tippe.model.dynamics import joined, parts

#: Lanes: thirds of them, and halves.
COUNT = 36
RADIUS, OFFSET = 0.02, 0.006


class Dish(eqx.Module):
    """A dish with a rim, the same all about the vertical."""

    depth: float

    def __call__(self, x, y):
        return -self.depth * jnp.exp(-5.0 * (x * x + y * y))


class Egg(eqx.Module):
    """Positive inside of an egg that stands on its blunt end."""

    size: float

    def __call__(self, x, y, z):
        return self.size**2 - (1.0 + z) * (x * x + y * y) - z * z


#: Every arena with its side, and a point next to it about which places are drawn.
ARENAS = {
    "plane": (tippe.Plane(), None, (0.0, 0.0, 0.0)),
    "tilted plane": (tippe.Plane(0.3), None, (0.0, 0.0, 0.0)),
    "cylinder": (tippe.Cylinder(0.3), None, (0.1, 0.2, -0.3)),
    "outside of a cylinder": (tippe.Cylinder(0.3), "outside", (0.1, 0.2, 0.3)),
    "sphere": (tippe.Sphere(0.3), None, (0.1, 0.05, -0.25)),
    "outside of a sphere": (tippe.Sphere(0.3), "outside", (0.1, 0.05, 0.25)),
    "spheroid": (tippe.Spheroid(0.4, 0.25), None, (0.2, 0.1, -0.2)),
    "outside of a spheroid": (tippe.Spheroid(0.3, 0.5), "outside", (0.2, 0.1, 0.4)),
    "torus": (tippe.Torus(0.4, 0.15), None, (0.4, 0.1, -0.14)),
    "outside of a torus": (tippe.Torus(0.4, 0.15), "outside", (0.3, 0.1, 0.14)),
    "paraboloid": (tippe.Paraboloid(0.3), None, (0.1, -0.05, 0.02)),
    "dish": (tippe.Graph(Dish(0.1)), None, (0.15, 0.1, 0.0)),
    "hills": (tippe.Graph(lambda x, y: 0.03 * jnp.sin(7.0 * x) * jnp.cos(5.0 * y)), None, (0.1, -0.05, 0.0)),
    "egg": (tippe.Implicit(Egg(0.3)), None, (0.1, 0.05, -0.25)),
}
#: Those that a turn about the vertical leaves as they are.
NOT_OF_REVOLUTION = ("tilted plane", "cylinder", "outside of a cylinder", "hills")


class Start(NamedTuple):
    """Tops on an arena, a lane each: the scene, place and path of its frame there, and the state."""

    scene: tippe.Scene
    where: tuple
    state: jax.Array

    @classmethod
    def at_random(cls, arena, body, law, spread=0.03):
        """Feet about a place of an arena, any axis, spins to 200 rad/s, slips to 1 m/s, the same in the fixed frame on all."""
        (surface, side, place_guess), random = arena, np.random.default_rng(7)
        scene = tippe.Scene(body, surface, law, side=side)

        def draw(*shape):
            # Both halves of the lanes are the same tops.
            return np.tile(random.normal(size=(*shape, COUNT // 2)), 2)

        place_near = tuple(jnp.asarray(part + spread * draw()) for part in place_guess)
        place_and_path = scene.frame.start(tuple(filled(surface.nearest(surface.in_own_axes(place_near)))))
        V, e, L = (draw(3) for _ in range(3))
        e, L = e / np.linalg.norm(e, axis=0), 100.0 * body.I3 * L
        u = 0.3 * V - body.offset * jnp.cross(L, e, axis=0) / body.I1
        u, e, L = (tuple(jnp.einsum("jx,ijx->ix", vector, axes_at(scene, place_and_path))) for vector in (u, e, L))
        return cls(scene, place_and_path, joined(u[:2], e, L, place_and_path[0]))


def filled(vector):
    """A vector as (3, lanes), zeros where it vanishes identically."""
    return jnp.stack([jnp.zeros(COUNT) if part is None else jnp.broadcast_to(part, (COUNT,)) for part in vector])


def axes_at(scene, place_and_path):
    """The frame's vectors in the fixed frame, (3, 3, lanes)."""
    return jnp.stack([filled(axis) for axis in scene.frame.pose(*place_and_path).axes])


def in_space(scene, place_and_path, vector):
    """A vector of the frame, in the fixed frame."""
    return jnp.einsum("ix,ijx->jx", filled(vector), axes_at(scene, place_and_path))


class Seen(NamedTuple):
    """A top in the fixed frame: centre of mass, its velocity, axis, angular momentum, normal; energy, Jellett's quantity."""

    place: jax.Array
    velocity: jax.Array
    axis: jax.Array
    momentum: jax.Array
    normal: jax.Array
    energy: jax.Array
    jellett: jax.Array


def quantities_of(scene, state, cyclic):
    u, e, L, place = parts(state)
    place_and_path, offset = (place, cyclic), scene.body.offset
    turning = jnp.cross(filled(L), filled(e), axis=0) / scene.body.I1
    axis, normal = in_space(scene, place_and_path, e), axes_at(scene, place_and_path)[2]
    velocity = in_space(scene, place_and_path, (*u, -offset * turning[2]))
    centre = filled(scene.frame.pose(*place_and_path).position)
    numbers = (in_space(scene, place_and_path, L), normal, scene.energy(state), scene.jellett(state))
    return Seen(centre - offset * axis, velocity, axis, *numbers)


def inner(a, b):
    return np.sum(np.asarray(a) * np.asarray(b), axis=0)


def by_lanes(*values):
    """A number for each lane, as many of each value."""
    return np.repeat(np.asarray(values), COUNT // len(values))


@pytest.mark.parametrize("name", ARENAS)
def test_what_changes_and_what_stays(name):
    """At random states, a third with friction, a third without, a third of them homogeneous balls without.

    E' is the power of friction, which only takes. lambda' = R L.n' - N tau.r, r = a e - R n, where n' is the derivative of the
    normal at the moving foot. Without friction the moment about the vertical, m (s x s')_z + L_z, stays on surfaces of
    revolution: of a ball each part of it, the first of which is Clairaut's constant rho^2 phi'.
    """
    top, inertia = rutstam_top(), 0.4 * 0.02 * RADIUS**2
    numbers = {"offset": by_lanes(OFFSET, OFFSET, 0.0), "I1": by_lanes(float(top.I1), float(top.I1), inertia)}
    body = tippe.Top(0.02, RADIUS, **numbers, I3=inertia)
    law = tippe.Rolling(by_lanes(1e-3, 0.0, 0.0), 2.0, tippe.Contensou(by_lanes(0.3, 0.0, 0.0), 2e-3, 0.05))
    scene, place_and_path, state = Start.at_random(ARENAS[name], body, law)
    motion = scene.dynamics.motion(state)
    rates = (scene.field(state), scene.frame.cyclic_rate(place_and_path[1], motion.velocity, motion.frame_rate))
    quantities, rate = jax.jvp(lambda *arguments: quantities_of(scene, *arguments), (state, place_and_path[1]), rates)
    rubs, balls = by_lanes(1, 0, 0) > 0, by_lanes(0, 0, 1) > 0

    assert_close(rate.place, quantities.velocity, atol=1e-12)
    assert_close(inner(rate.axis, quantities.axis), 0.0, atol=1e-10)
    power = np.asarray(scene.friction_power(state))
    assert_close(rate.energy, power, atol=1e-11 * np.max(np.abs(quantities.energy)))
    assert np.all((power * np.sign(motion.normal_force) < 0.0) == rubs)

    torque = motion.normal_force * in_space(scene, place_and_path, motion.friction.torque)
    by_turning = RADIUS * inner(quantities.momentum, rate.normal)
    assert name.endswith("plane") == bool(np.all(by_turning == 0.0))
    by_torque = inner(torque, body.offset * quantities.axis - RADIUS * quantities.normal)
    assert np.all((by_torque != 0.0) == rubs)
    assert_close(rate.jellett, by_turning - by_torque, atol=1e-11 * np.max(np.abs(quantities.jellett)))

    s, bend, momentum_rate = (np.asarray(part) for part in (quantities.place, rate.velocity, rate.momentum[2]))
    size = 0.02 * np.max(np.abs(s)) * (9.81 + np.max(np.abs(bend)))
    orbital = 0.02 * (s[0] * bend[1] - s[1] * bend[0])
    is_conserved = np.max(np.abs(orbital + momentum_rate)[~rubs]) < 1e-12 * size
    assert is_conserved == (name not in NOT_OF_REVOLUTION)
    assert_close(momentum_rate[balls], 0.0, atol=1e-12 * size)


#: Sizes of an arena that tends to another with them: half of the lanes each.
SIZES = by_lanes(1e-3, 1e-4)


class Limit(NamedTuple):
    """An arena of these sizes, and the one that it tends to as they go to 0, as a power of them; how far apart the feet are."""

    near: tuple
    limit: tuple
    power: int = 1
    spread: np.ndarray | float = 0.03


BOTTOM = (0.0, 0.0, 0.0)
LIMITS = {
    "a torus of huge ring is a cylinder": Limit(
        (tippe.Torus(0.3 / SIZES, 0.3), None, (0.3 / SIZES + 0.1, 0.0, -0.25)),
        (tippe.Cylinder(0.3), None, (0.1, 0.0, -0.25)),
    ),
    "a spheroid of equal axes is a sphere": Limit(
        (tippe.Spheroid(0.3, 0.3 * (1.0 + SIZES)), None, ARENAS["sphere"][2]), ARENAS["sphere"]
    ),
    "a paraboloid is a sphere near its bottom": Limit(
        (tippe.Paraboloid(0.3), None, BOTTOM), (tippe.Sphere(0.3), None, (0.0, 0.0, -0.3)), 2, SIZES
    ),
    "a sphere of huge radius is a plane": Limit(
        (tippe.Sphere(0.3 / SIZES), None, (0.0, 0.0, -0.3 / SIZES)), ARENAS["plane"]
    ),
    "a dish of no depth is a plane": Limit((tippe.Graph(Dish(SIZES)), None, BOTTOM), ARENAS["plane"]),
    "a slope of no tilt is a plane": Limit((tippe.Plane(SIZES), None, BOTTOM), ARENAS["plane"]),
}


def forces(arena, spread):
    """Normal force, friction per newton of it and the turning of the frame, (3, lanes) in the fixed frame."""
    law = tippe.Rolling(1e-3, 2.0, tippe.Contensou(0.3, 2e-3, 0.05))
    scene, place_and_path, state = Start.at_random(arena, rutstam_top(), law, spread)
    motion = scene.dynamics.motion(state)
    vectors = ((None, None, motion.normal_force), (*motion.friction.force, None), motion.friction.torque)
    turning = (*motion.frame_rate, None)
    return [np.asarray(in_space(scene, place_and_path, vector)) for vector in (*vectors, turning)]


def departure(arena, limit_arena, spread):
    """Greatest difference on two arenas for each lane: of the forces, each by its size, and of the turning [rad/s]."""
    pairs = list(zip(forces(arena, spread), forces(limit_arena, spread), strict=True))
    sizes = [np.max(np.abs(a)) for a, _ in pairs[:-1]] + [1.0]
    return np.max([np.max(np.abs(a - b), axis=0) / size for (a, b), size in zip(pairs, sizes, strict=True)], axis=0)


@pytest.mark.parametrize("name", LIMITS)
def test_limits(name):
    """All forces tend to those on the other arena, at the rate at which the surfaces do."""
    case = LIMITS[name]
    departures = departure(case.near, case.limit, case.spread)
    large_departure, small_departure = np.max(departures[: COUNT // 2]), np.max(departures[COUNT // 2 :])
    assert 0.0 < large_departure < 0.1
    assert_close(large_departure / small_departure, 10.0**case.power, rtol=0.1)


def test_a_graph_of_zero_is_a_plane():
    assert np.max(departure((tippe.Graph(Dish(0.0)), None, BOTTOM), ARENAS["plane"], 0.03)) < 1e-15
