"""Moving frames as a body feels them: axes, shape operators, heights, against finite differences of the position."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.geometry import (
    Cylinder,
    Graph,
    Implicit,
    Paraboloid,
    Plane,
    Sphere,
    Spheroid,
    Torus,
    add,
    cross,
    dot,
    multiply,
    rate_in_frame,
    scale,
    subtract,
)
from nonholonomic.geometry.frames import frame_of

DISTANCE, PULL = jnp.asarray(0.02), jnp.asarray(20.0)
SURFACES = {
    "plane": (Plane(), 1.0),
    "tilted": (Plane(0.3), 1.0),
    "cylinder": (Cylinder(0.3), -1.0),
    "outside of a cylinder": (Cylinder(0.3), 1.0),
    "sphere": (Sphere(0.3), -1.0),
    "outside of a sphere": (Sphere(0.3), 1.0),
    "spheroid": (Spheroid(0.4, 0.3), -1.0),
    "torus": (Torus(0.5, 0.2), -1.0),
    "outside of a torus": (Torus(0.5, 0.2), 1.0),
    "paraboloid": (Paraboloid(0.3), 1.0),
    "graph": (Graph(lambda x, y: 0.1 * jnp.sin(3.0 * x) * jnp.cos(2.0 * y)), 1.0),
    "implicit": (Implicit(lambda x, y, z: 0.1 - x**4 - 2.0 * y**4 - z**2), 1.0),
}
OWN = {name: SURFACES[name] for name in list(SURFACES)[:6]}
FOOT = (0.11, -0.07)


def carried_frame(surface, side):
    return frame_of(surface, side, DISTANCE, PULL, carried=True)


def foot_of(name):
    """A generic point of the surface, in the surface's axes."""
    surface, _ = SURFACES[name]
    x, y = FOOT
    start_foot = (jnp.asarray(x), jnp.asarray(y), jnp.asarray(-0.29))
    if name.endswith("torus"):
        start_foot = (jnp.asarray(x + 0.4), jnp.asarray(y), jnp.asarray(-0.16))
    foot = surface.nearest(start_foot)
    return tuple(jnp.zeros(()) if part is None else part for part in foot)


def at_angle(frame, eta):
    """The start of a frame at the angle eta of a cylinder or a sphere of the radius 0.3."""
    return frame.start((0.3 * jnp.sin(eta), jnp.zeros(()), -0.3 * jnp.cos(eta)), along_eta=True)


def moved(frame, start, velocity, time, steps=200):
    """Place and cyclic coordinates after moving with the given velocity components, by small Runge-Kutta steps."""

    def rate(point):
        frame_motion = frame.frame_motion(point[0], velocity)
        return frame_motion.place_rate, frame.cyclic_rate(point[1], velocity, frame_motion.frame_rate)

    def step(point, _):
        k1 = rate(point)
        k2 = rate(jax.tree.map(lambda x, k: x + 0.5 * dt * k, point, k1))
        k3 = rate(jax.tree.map(lambda x, k: x + 0.5 * dt * k, point, k2))
        k4 = rate(jax.tree.map(lambda x, k: x + dt * k, point, k3))
        return jax.tree.map(lambda x, a, b, c, d: x + dt / 6.0 * (a + 2 * b + 2 * c + d), point, k1, k2, k3, k4), None

    dt = time / steps
    return jax.jit(lambda: jax.lax.scan(step, start, length=steps)[0])()


def numbers(parts):
    return np.array([0.0 if part is None else float(part) for part in parts])


@pytest.mark.parametrize("name", SURFACES)
def test_the_frame_is_orthonormal_and_turns_as_stated(name):
    """t1, t2, n orthonormal; position' = V1 t1 + V2 t2; n' = -(o1 t1 + o2 t2); the vertical is z, the height its component."""
    frame, velocity = frame_of(*SURFACES[name], DISTANCE, PULL), (jnp.asarray(0.3), jnp.asarray(-0.2))
    place, cyclic = moved(frame, frame.start(foot_of(name)), velocity, 0.2)
    axes = np.array(frame.pose(place, cyclic).axes, dtype=float)
    assert_close(axes @ axes.T, np.eye(3), atol=1e-10)
    assert_close(np.linalg.det(axes), 1.0, atol=1e-10)
    frame_motion = frame.frame_motion(place, velocity)
    rates = (frame_motion.place_rate, frame.cyclic_rate(cyclic, velocity, frame_motion.frame_rate))
    _, position_rate = jax.jvp(lambda *point: jnp.stack(frame.pose(*point).position), (place, cyclic), rates)
    assert_close(position_rate, 0.3 * axes[0] - 0.2 * axes[1], atol=1e-9)
    o1, o2 = numbers(frame_motion.frame_rate)
    for axis, expected in enumerate((o1 * axes[2], o2 * axes[2], -(o1 * axes[0] + o2 * axes[1]))):
        _, rate = jax.jvp(lambda *point, axis=axis: jnp.stack(frame.pose(*point).axes[axis]), (place, cyclic), rates)
        assert_close(rate, expected, atol=1e-9)
    assert_close(numbers(frame.vertical(place)), axes[:, 2], atol=1e-10)
    assert_close(numbers(frame_motion.vertical), axes[:, 2], atol=1e-10)
    _, climb = jax.jvp(lambda place: jnp.asarray(frame.height(place)) * 1.0, (place,), (frame_motion.place_rate,))
    assert_close(climb, position_rate[2], atol=1e-9)


@pytest.mark.parametrize("name", OWN)
def test_a_frame_of_its_own_is_the_carried_one_in_fewer_numbers(name):
    """From the same foot, and t1 along it, both are at the same place with the same axes later, and say the same rates."""
    velocity, positions = (jnp.asarray(0.3), jnp.asarray(-0.2)), []
    frame_of_surface, frame_by_carrying = frame_of(*SURFACES[name], DISTANCE, PULL), carried_frame(*SURFACES[name])
    start = frame_of_surface.start(foot_of(name))
    place, _ = frame_by_carrying.start(foot_of(name))
    first = SURFACES[name][0].in_own_axes(frame_of_surface.pose(*start).axes[0])
    for frame, frame_start in ((frame_of_surface, start), (frame_by_carrying, ((*place[:3], *first), ()))):
        arrival = moved(frame, frame_start, velocity, 0.2)
        frame_motion = frame.frame_motion(arrival[0], velocity)
        height = float(frame.height(arrival[0]) - frame.height(frame_start[0]))
        positions.append(
            np.concatenate(
                [
                    np.ravel(np.array(frame.pose(*arrival).axes, dtype=float)),
                    np.ravel(np.array(frame.pose(*arrival).position, dtype=float)),
                    numbers(frame_motion.frame_rate),
                    numbers(frame_motion.vertical),
                    [height],
                ]
            )
        )
    assert_close(positions[0], positions[1], atol=1e-10)


def test_the_foot_is_drawn_back_to_the_surface():
    """A drift decays at the stated rate, and the surface is reached where the foot came from."""
    frame = carried_frame(*SURFACES["graph"])
    place, _ = frame.start(foot_of("graph"))
    place_off_surface = (place[0], place[1], place[2] + 1e-4, *place[3:])
    distance_before = float(frame.surface.distance(place_off_surface[:3]))
    place_after, _ = moved(frame, (place_off_surface, ()), (jnp.asarray(0.3), jnp.asarray(-0.2)), 0.1)
    assert_close(frame.surface.distance(place_after[:3]), distance_before * np.exp(-2.0), rtol=0.05)


def test_room_is_left_where_the_ball_fits_and_ends_at_the_curvature_of_the_ball():
    """On a paraboloid the curvature is greatest at the bottom, 1/p."""
    for p, fits in ((0.021, True), (0.019, False)):
        frame = frame_of(Paraboloid(p), 1.0, DISTANCE, PULL)
        place, _ = frame.start((jnp.zeros(()),) * 3)
        room = float(frame.frame_motion(place, (jnp.asarray(0.1), jnp.asarray(0.0))).room)
        assert (room > 0.0) is fits
    assert_close(room, 1.0 - 0.02 / 0.019, atol=1e-12)


@pytest.mark.parametrize("name", ["cylinder", "sphere", "outside of a cylinder", "outside of a sphere"])
def test_the_angle_counts_from_the_lowest_point(name):
    frame = frame_of(*SURFACES[name], DISTANCE, PULL)
    radius = 0.3 - 0.02 if frame.side > 0.0 else 0.32
    for eta in (0.0, 0.7, -0.7, np.pi / 2.0, 2.0):
        place = at_angle(frame, eta)
        assert_close(frame.pose(*place).angle, abs(eta) if "sphere" in name else eta, atol=1e-12)
        assert_close(frame.pose(*place).position, (radius * np.sin(eta), 0.0, -radius * np.cos(eta)), atol=1e-12)
        assert_close(frame.height(place[0]), 0.3 - radius * np.cos(eta), atol=1e-12)


def test_a_cylinder_turns_as_the_conventions_say():
    """Inside n = (-sin eta, 0, cos eta) and t1 = (cos eta, 0, sin eta); outside, on top, t1 is x."""
    frame = frame_of(Cylinder(0.3), -1.0, DISTANCE, PULL)
    t1, t2, n = frame.pose(*at_angle(frame, 0.4)).axes
    assert_close(
        np.array([t1, t2, n]), [(np.cos(0.4), 0, np.sin(0.4)), (0, 1, 0), (-np.sin(0.4), 0, np.cos(0.4))], atol=1e-15
    )
    frame = frame_of(Cylinder(0.3), 1.0, DISTANCE, PULL)
    assert_close(np.array(frame.pose(*at_angle(frame, np.pi)).axes), np.eye(3), atol=1e-15)


@pytest.mark.parametrize("name", ["cylinder", "sphere", "outside of a cylinder", "outside of a sphere"])
def test_a_carried_frame_starts_with_the_axes_of_the_frame_of_its_own(name):
    """At every eta, the papers' 1.571 included, and from a foot: `Launch` promises one t1 for all kinds of contact."""
    frame_of_surface, frame_by_carrying = frame_of(*SURFACES[name], DISTANCE, PULL), carried_frame(*SURFACES[name])
    for eta in (0.0, 0.7, -1.5, 1.571, np.pi / 2.0, 2.0, -2.5, np.pi):
        axes = [
            np.array(frame.pose(*at_angle(frame, eta)).axes, dtype=float)
            for frame in (frame_of_surface, frame_by_carrying)
        ]
        assert_close(axes[1], axes[0], atol=1e-12)
        foot = tuple(jnp.asarray(x) for x in (0.3 * np.sin(eta), 0.0, -0.3 * np.cos(eta)))
        if "sphere" in name:
            foot = (foot[0], jnp.asarray(0.1), foot[2])
            foot = scale(0.3 / jnp.sqrt(dot(foot, foot)), foot)
        axes = [
            np.array(frame.pose(*frame.start(foot)).axes, dtype=float)
            for frame in (frame_of_surface, frame_by_carrying)
        ]
        assert_close(axes[1], axes[0], atol=1e-12)


def test_a_fixed_vector_keeps_its_length_in_a_turning_frame():
    vector, turning = (1.0, 2.0, 3.0), (0.4, -0.7)
    assert_close(dot(rate_in_frame(vector, turning), vector), 0.0, atol=1e-15)


def test_exact_zeros_cost_nothing():
    """`None` is zero: sums skip it, products with it are it."""
    assert add(None, None) is None
    assert add(1.0, None, 2.0) == 3.0
    assert subtract(None, 2.0) == -2.0
    assert subtract(2.0, None) == 2.0
    assert subtract(None, None) is None
    assert multiply(2.0, None) is None
    assert multiply(2.0, 3.0) == 6.0
    assert scale(2.0, (1.0, None)) == (2.0, None)
    assert cross((1.0, None, None), (None, 1.0, None)) == (None, None, 1.0)
    assert dot((None, None), (1.0, 2.0)) is None
