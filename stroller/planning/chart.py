"""Flat maps of the ground, on which paths are searched: x and y where the ground names its places so, and otherwise the
tangent plane between start and goal, whose points the nearest points of the ground represent."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface, cross, scale

from ..model.dynamics import padded


def is_flat(surface: AbstractSurface) -> bool:
    """Whether the ground names its places by two lengths, x and y."""
    return tuple(surface.coordinates) == (("x", "m"), ("y", "m"))


class Chart(eqx.Module):
    """A map of the ground. On a curved one, `origin` and the unit vectors `east` and `north` span the tangent plane."""

    surface: AbstractSurface
    origin: Float[Array, " 3"] | None = None
    east: Float[Array, " 3"] | None = None
    north: Float[Array, " 3"] | None = None

    @classmethod
    def between(cls, surface: AbstractSurface, side: float, start: Any, goal: Any) -> "Chart":
        """A map for a start and a goal, whose positions are in the ground's axes."""
        if is_flat(surface):
            return cls(surface)
        middle = surface.nearest(padded((jnp.asarray(start) + jnp.asarray(goal)) / 2.0))
        position, east, _ = surface.chart(surface.place_at(middle))
        north = scale(side, cross(surface.normal(position), east))
        zero = jnp.zeros(())
        columns = [jnp.stack([zero if part is None else zero + part for part in v]) for v in (position, east, north)]
        return cls(surface, *columns)

    def position(self, point: Float[Array, " 2"]) -> Float[Array, " axes"]:
        """The position [m] of a point of the map, in the ground's axes."""
        if self.origin is None or self.east is None or self.north is None:
            place = self.surface.charted((point[0], point[1]))[0]
        else:
            place = self.surface.nearest(padded(self.origin + point[0] * self.east + point[1] * self.north))
        return jnp.stack(place[: self.surface.axes])

    def point(self, pose: Any) -> np.ndarray:
        """The point and the heading (x, y, angle) on the map of a pose."""
        axes = self.surface.axes
        place, heading = np.asarray(pose[:axes]), np.asarray(pose[axes:])
        if self.origin is not None:
            plane = np.stack([np.asarray(self.east), np.asarray(self.north)])
            place, heading = plane @ (place - np.asarray(self.origin)), plane @ heading
        return np.array([place[0], place[1], np.arctan2(heading[1], heading[0])])

    @eqx.filter_jit
    def poses(self, points: Float[Array, "n 3"]) -> Float[Array, "n components"]:
        """The poses of points and headings on the map."""

        def pose(point):
            place, along = jax.jvp(self.position, (point[:2],), (jnp.stack([jnp.cos(point[2]), jnp.sin(point[2])]),))
            return jnp.concatenate([place, along / jnp.sqrt(jnp.sum(along**2))])

        return jax.vmap(pose)(points)
