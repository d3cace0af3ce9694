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
    draws = np.random.default_rng(1).uniform(-1.0, 1.0, (COUNT, 3)) * sizes
    draws[:6] = np.array([[0, 0, 0], [0, 0, 0.5], [0.5, 0, 0], [0, 0.9, 0], [0, 0, -0.9], [0.5, 0.5, 1e-12]]) * sizes
    return draws


def feet(surface, centres) -> np.ndarray:
    """Nearest points (COUNT, 3)."""
    return np.stack(jax.jit(lambda place: surface.nearest(place))(tuple(jnp.asarray(centres.T)))).T


def check_least(surface, centres, profile, points) -> None:
    """No point of a profile is closer than the nearest one, and that one is on the surface.

    The profile is a curve (2, n) of points so close that the distance from it is right to 2e-5 m; `seen` are the positions
    beside it.
    """
    foot = feet(surface, centres)
    assert_close(np.linalg.norm(centres - foot, axis=1), cKDTree(profile.T).query(points.T)[0], atol=2e-5)
    assert_close(jax.jit(lambda place: surface.offset(place))(tuple(jnp.asarray(foot.T))), 0.0, atol=1e-14)


@pytest.mark.parametrize("semi_axes", [(0.3, 0.1), (0.1, 0.3), (0.3, 0.3)], ids=["oblate", "prolate", "sphere"])
def test_nearest_point_of_a_spheroid(semi_axes):
    """From inside and outside, the middle included."""
    (a, c), eta = semi_axes, np.linspace(-np.pi / 2.0, np.pi / 2.0, 40_001)
    centres = positions(np.array([1.5 * a, 1.5 * a, 1.5 * c]))
    points = np.stack([np.hypot(centres[:, 0], centres[:, 1]), centres[:, 2]])
    check_least(Spheroid(a, c), centres, np.stack([a * np.cos(eta), c * np.sin(eta)]), points)


def test_nearest_point_of_a_paraboloid():
    """From below and above, the axis included."""
    centres, r = positions(np.array([0.5, 0.5, 1.0])), np.linspace(-2.0, 2.0, 200_001)
    points = np.stack([np.hypot(centres[:, 0], centres[:, 1]), centres[:, 2]])
    check_least(Paraboloid(0.3), centres, np.stack([r, r * r / 0.6]), points)


def test_nearest_point_of_ripples():
    """From up to four wavelengths above, where a dozen crests are about as near."""
    ripples = Graph(lambda x, y: 0.006 * jnp.sin(60.0 * x + 10.0 * y))
    centres, s = positions(np.array([0.3, 0.3, 0.2])), np.linspace(-1.0, 1.0, 200_001)
    wave_phase = centres[:, :2] @ np.array([60.0, 10.0]) / WAVE
    centres[:, 2] = np.abs(centres[:, 2]) + 0.006 * np.sin(WAVE * wave_phase)
    check_least(ripples, centres, np.stack([s, 0.006 * np.sin(WAVE * s)]), np.stack([wave_phase, centres[:, 2]]))


def test_nearest_point_of_a_function_is_that_of_the_same_spheroid():
    """Inside; its derivatives too."""
    egg, spheroid = Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 0.09 - z * z / 0.01), Spheroid(0.3, 0.1)
    centres = positions(np.array([0.2, 0.2, 0.06]))[6:]
    assert_close(feet(egg, centres), feet(spheroid, centres), atol=1e-12)
    place = tuple(jnp.asarray(centres.T))
    tangent = (place, (jnp.zeros(len(centres)), jnp.zeros(len(centres)), jnp.ones(len(centres))))
    slopes = []
    for surface in (egg, spheroid):
        rates = jax.jit(
            lambda *arguments, surface=surface: jax.jvp(lambda *place: surface.nearest(place), *arguments)[1]
        )
        slopes.append(np.stack(rates(*tangent)))
    assert_close(*slopes, rtol=1e-6, atol=1e-9)


def test_gap_below_a_ball():
    """Its sign is that of the distance less the radius, wherever the ball is; near the surface it is that, to first order."""
    egg, spheroid, radius = (
        Implicit(lambda x, y, z: 1.0 - (x * x + y * y) / 0.09 - z * z / 0.01),
        Spheroid(0.3, 0.1),
        0.012,
    )
    centres = positions(np.array([0.2, 0.2, 0.06]))[6:]
    site = jax.jit(lambda place: egg.ball_gap(place, radius, 1.0))(tuple(jnp.asarray(centres.T)))
    exact = np.linalg.norm(centres - feet(spheroid, centres), axis=1) - radius
    is_inside = np.sum((centres / np.array([0.3, 0.3, 0.1])) ** 2, axis=1) < 1.0
    exact, gap = np.where(is_inside, exact, -exact - 2.0 * radius), np.asarray(site.gap)
    np.testing.assert_array_equal(np.sign(gap), np.sign(exact))
    is_near = np.abs(exact) < 1e-3
    assert is_near.any()
    assert_close(gap[is_near], exact[is_near], atol=2e-5)
