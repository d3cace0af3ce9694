"""Nearest points to positions anywhere, also beyond centres of curvature, against the least distance over a dense grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from scipy.spatial import cKDTree

from nonholonomic import Graph, Implicit, Paraboloid, Spheroid

COUNT = 400
WAVE = np.hypot(60.0, 10.0)


def positions(sizes) -> np.ndarray:
    """Positions (COUNT, 3) within a box, some of them on its axes."""
    drawn = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 3)) * sizes
    drawn[:6] = np.array([[0, 0, 0], [0, 0, 0.5], [0.5, 0, 0], [0, 0.9, 0], [0, 0, -0.9], [0.5, 0.5, 1e-12]]) * sizes
    return drawn


def feet(surface, at) -> np.ndarray:
    """Nearest points (COUNT, 3)."""
    return np.stack(jax.jit(lambda place: surface.nearest(place))(tuple(jnp.asarray(at.T)))).T


def check_least(surface, at, profile, points) -> None:
    """No point of a profile is closer than the nearest one, and that one is on the surface.

    The profile is a curve (2, n) of points so close that the distance from it is right to 2e-5 m; `seen` are the positions
    beside it.
    """
    foot = feet(surface, at)
    assert_close(np.linalg.norm(at - foot, axis=1), cKDTree(profile.T).query(points.T)[0], atol=2e-5)
    assert_close(jax.jit(lambda place: surface.offset(place))(tuple(jnp.asarray(foot.T))), 0.0, atol=1e-14)


@pytest.mark.parametrize("semi_axes", [(0.3, 0.1), (0.1, 0.3), (0.3, 0.3)], ids=["oblate", "prolate", "sphere"])
def test_nearest_point_of_a_spheroid(semi_axes):
    """From inside and outside, the middle included."""
    (a, c), eta = semi_axes, np.linspace(-np.pi / 2.0, np.pi / 2.0, 40_001)
    at = positions(np.array([1.5 * a, 1.5 * a, 1.5 * c]))
    points = np.stack([np.hypot(at[:, 0], at[:, 1]), at[:, 2]])
    check_least(Spheroid(a, c), at, np.stack([a * np.cos(eta), c * np.sin(eta)]), points)


def test_nearest_point_of_a_paraboloid():
    """From below and above, the axis included."""
    at, r = positions(np.array([0.5, 0.5, 1.0])), np.linspace(-2.0, 2.0, 200_001)
    points = np.stack([np.hypot(at[:, 0], at[:, 1]), at[:, 2]])
    check_least(Paraboloid(0.3), at, np.stack([r, r * r / 0.6]), points)


def test_nearest_point_of_ripples():
    """From up to four wavelengths above, where a dozen crests are about as near."""
    ripples = Graph(lambda x, y: 0.006 * jnp.sin(60.0 * x + 10.0 * y))
    at, s = positions(np.array([0.3, 0.3, 0.2])), np.linspace(-1.0, 1.0, 200_001)
    across = at[:, :2] @ np.array([60.0, 10.0]) / WAVE
    at[:, 2] = np.abs(at[:, 2]) + 0.006 * np.sin(WAVE * across)
    check_least(ripples, at, np.stack([s, 0.006 * np.sin(WAVE * s)]), np.stack([across, at[:, 2]]))


def test_nearest_point_of_a_function_is_that_of_the_same_spheroid():
    """Inside; its derivatives too."""
    egg, same = Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 0.09 - z * z / 0.01), Spheroid(0.3, 0.1)
    at = positions(np.array([0.2, 0.2, 0.06]))[6:]
    assert_close(feet(egg, at), feet(same, at), atol=1e-12)
    place = tuple(jnp.asarray(at.T))
    moved = (place, (jnp.zeros(len(at)), jnp.zeros(len(at)), jnp.ones(len(at))))
    slopes = []
    for surface in (egg, same):
        rates = jax.jit(
            lambda *arguments, surface=surface: jax.jvp(lambda *place: surface.nearest(place), *arguments)[1]
        )
        slopes.append(np.stack(rates(*moved)))
    assert_close(*slopes, rtol=1e-6, atol=1e-9)


def test_gap_below_a_ball():
    """Its sign is that of the distance less the radius, wherever the ball is; near the surface it is that, to first order."""
    egg, same, radius = Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 0.09 - z * z / 0.01), Spheroid(0.3, 0.1), 0.012
    at = positions(np.array([0.2, 0.2, 0.06]))[6:]
    site = jax.jit(lambda place: egg.ball_gap(place, radius, 1.0))(tuple(jnp.asarray(at.T)))
    true = np.linalg.norm(at - feet(same, at), axis=1) - radius
    inside = np.sum((at / np.array([0.3, 0.3, 0.1])) ** 2, axis=1) < 1.0
    true, gap = np.where(inside, true, -true - 2.0 * radius), np.asarray(site.gap)
    np.testing.assert_array_equal(np.sign(gap), np.sign(true))
    near = np.abs(true) < 1e-3
    assert near.any()
    assert_close(gap[near], true[near], atol=2e-5)
