"""Distances between a convex polygon that moves and obstacles: convex polygons and discs.

Arrays have the shape (..., vertices, 2), counterclockwise. The functions use only operators and methods that NumPy and
JAX share, so that the optimiser and the check share them.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

#: Square of a length [m^2] that keeps the slope of a distance finite where the distance vanishes.
SMALLEST_SQUARE = 1e-18


def _least(values: Any, axis: int) -> Any:
    """The least of some values along an axis, with the derivative of that value.

    JAX divides the derivative of `min` by the number of values that equal the result: if XLA computes a value again and
    rounds it differently, that number is zero.
    """
    xp: Any = np if isinstance(values, np.ndarray) else jnp
    return xp.take_along_axis(values, xp.expand_dims(values.argmin(axis), axis), axis).squeeze(axis)


def _next(polygon: Any) -> Any:
    return polygon[..., np.roll(np.arange(polygon.shape[-2]), -1), :]


def _face_gaps(polygon: Any, points: Any) -> Any:
    """How far points (..., points, 2) are outside each face of a polygon: (..., faces, points)."""
    edge = _next(polygon) - polygon
    length = (edge * edge).sum(-1) ** 0.5
    normal_x, normal_y = edge[..., 1] / length, -edge[..., 0] / length
    offset = normal_x * polygon[..., 0] + normal_y * polygon[..., 1]
    x, y = points[..., None, :, 0], points[..., None, :, 1]
    return normal_x[..., None] * x + normal_y[..., None] * y - offset[..., None]


def separation(first: Any, second: Any) -> Any:
    """Greatest gap [m] between two polygons across a face of either.

    This is the exact depth of penetration (negative) of polygons that overlap (the separating-axis theorem; Ericson,
    Real-Time Collision Detection (2005), section 5.2), and a lower bound of the distance of others.
    """
    one, other = (-_least(-_least(_face_gaps(*pair), -1), -1) for pair in ((first, second), (second, first)))
    return one + (other - one).clip(0.0)


def _edge_distance(polygon: Any, points: Any) -> Any:
    """Distance [m] of points (..., points, 2) from the boundary of a polygon."""
    edge = (_next(polygon) - polygon)[..., :, None, :]
    along = points[..., None, :, :] - polygon[..., :, None, :]
    part = ((along * edge).sum(-1) / (edge * edge).sum(-1)).clip(0.0, 1.0)
    away = along - part[..., None] * edge
    return (_least((away * away).sum(-1), -2) + SMALLEST_SQUARE) ** 0.5


def signed_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distance [m] between two polygons, or minus the depth of penetration if they overlap."""
    gap = separation(first, second)
    corners = np.minimum(_edge_distance(first, second).min(-1), _edge_distance(second, first).min(-1))
    return np.where(gap > 0.0, corners, gap)


def disc_distance(polygon: Any, centre: Any, radius: Any) -> Any:
    """Distance [m] between a polygon and a disc, or minus the depth of penetration if they overlap."""
    point = centre[..., None, :]
    inside = _face_gaps(polygon, point).max(-2)[..., 0] < 0.0
    return _edge_distance(polygon, point)[..., 0] * (1.0 - 2.0 * inside) - radius
