"""Surfaces as a body feels them: frames, shape operators, heights, against finite differences of the position."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close

from nonholonomic.geometry import Cylinder, Plane, Sphere, add, carried, cross, dot, multiply, scale, subtract

SURFACES = {"plane": Plane(), "cylinder": Cylinder(0.3), "sphere": Sphere(0.3)}


def moved(surface, velocity, eta, time):
    """Place and cyclic coordinates after moving with the given velocity components, by small Runge-Kutta steps."""
    start = (surface.place(jnp.asarray(eta)), surface.cyclic(jnp.asarray(eta)))

    def rate(both):
        turning = surface.turning(velocity)
        return surface.place_rate(both[0], turning), surface.cyclic_rate(both[1], velocity, turning)

    def step(both, _):
        k1 = rate(both)
        k2 = rate(jax.tree.map(lambda x, k: x + 0.5 * dt * k, both, k1))
        k3 = rate(jax.tree.map(lambda x, k: x + 0.5 * dt * k, both, k2))
        k4 = rate(jax.tree.map(lambda x, k: x + dt * k, both, k3))
        return jax.tree.map(lambda x, a, b, c, d: x + dt / 6.0 * (a + 2 * b + 2 * c + d), both, k1, k2, k3, k4), None

    dt = time / 200
    return jax.lax.scan(step, start, length=200)[0]


@pytest.mark.parametrize("name", SURFACES)
def test_the_frame_is_orthonormal_and_turns_as_stated(name):
    """t1, t2, n orthonormal; position' = V1 t1 + V2 t2; n' = -(o1 t1 + o2 t2); the vertical is z."""
    surface, velocity = SURFACES[name], (jnp.asarray(0.3), jnp.asarray(-0.2))
    place, cyclic = moved(surface, velocity, 0.4, 0.5)
    frame = np.array(surface.frame(place, cyclic), dtype=float)
    assert_close(frame @ frame.T, np.eye(3), atol=1e-10)
    assert_close(np.linalg.det(frame), 1.0, atol=1e-10)
    turning = surface.turning(velocity)
    rates = (surface.place_rate(place, turning), surface.cyclic_rate(cyclic, velocity, turning))
    _, position_rate = jax.jvp(lambda *both: jnp.stack(surface.position(*both)), (place, cyclic), rates)
    assert_close(position_rate, 0.3 * frame[0] - 0.2 * frame[1], atol=1e-10)
    _, normal_rate = jax.jvp(lambda *both: jnp.stack(surface.frame(*both)[2]), (place, cyclic), rates)
    turns = np.array([0.0 if part is None else float(part) for part in turning])
    assert_close(normal_rate, -(turns[0] * frame[0] + turns[1] * frame[1]), atol=1e-10)
    vertical = np.array([0.0 if part is None else float(part) for part in surface.vertical(place)])
    assert_close(vertical, frame[:, 2], atol=1e-10)


@pytest.mark.parametrize("name", ["cylinder", "sphere"])
def test_height_is_the_rise_above_the_lowest_point(name):
    surface = SURFACES[name]
    place, cyclic = moved(surface, (jnp.asarray(0.3), jnp.asarray(-0.2)), 0.4, 0.5)
    assert_close(surface.height(place), float(surface.position(place, cyclic)[2]) + 0.3, atol=1e-12)
    for eta in (0.0, 0.7, -0.7, np.pi / 2.0):
        place, cyclic = surface.place(jnp.asarray(eta)), surface.cyclic(jnp.asarray(eta))
        assert_close(surface.angle(place, cyclic), abs(eta) if name == "sphere" else eta, atol=1e-12)


@pytest.mark.parametrize("name", ["cylinder", "sphere"])
def test_the_parallel_surface_is_where_the_centre_runs(name):
    surface = SURFACES[name]
    inner = surface.parallel(0.02)
    place, cyclic = surface.place(jnp.asarray(0.4)), surface.cyclic(jnp.asarray(0.4))
    normal = np.array(surface.frame(place, cyclic)[2])
    assert_close(inner.position(place, cyclic), np.array(surface.position(place, cyclic)) + 0.02 * normal, atol=1e-15)


def test_a_fixed_vector_keeps_its_length_in_a_turning_frame():
    vector, turning = (1.0, 2.0, 3.0), (0.4, -0.7)
    assert_close(dot(carried(vector, turning), vector), 0.0, atol=1e-15)


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
