"""Plane, cylinder and sphere in a frame that moves with the body, for a top that runs on them.

The frame is (t1, t2, n), with n the unit normal from the arena into the room where the body is: how it turns with the
velocity (the shape operator), which way is up, and how the place changes. Components that vanish identically are `None`
(see `vector.py`).
"""

import abc
import dataclasses
from collections.abc import Iterable, Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ..validation import Bound, as_number, require_all
from .surface import Place
from .vector import Component, Vector, dot, multiply, subtract

Tangent = tuple[Component, Component]


def carried(vector: tuple[Component, ...], turning: Tangent) -> tuple[Component, ...]:
    """Rate of the components of a fixed vector in a moving frame with t1' = o1 n, t2' = o2 n, n' = -(o1 t1 + o2 t2)."""
    along_normal = dot(turning, vector[:2])
    return (multiply(turning[0], vector[2]), multiply(turning[1], vector[2]), subtract(None, along_normal))


class AbstractMovingFrame(eqx.Module):
    """A surface described by a moving frame (t1, t2, n), with n pointing into the room where the body is.

    With V the velocity along the surface, the normal turns as n' = -(o1 t1 + o2 t2), where (o1, o2) = S V and S is the
    shape operator, positive where the surface is concave towards the room. The frame does not turn about n, so the
    components of a fixed vector change as `carried` states.
    """

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterable[Bound]:
        """The ranges of the surface's numbers in which a ball of the given radius [m] fits."""
        return ()

    @abc.abstractmethod
    def parallel(self, distance: Float[ArrayLike, "..."]) -> "AbstractMovingFrame":
        """The surface at the given distance [m] into the room, on which the centre of a ball of that radius runs.

        **Raises:** `ValueError` if such a ball does not fit.
        """

    @abc.abstractmethod
    def place(self, eta: Float[ArrayLike, "..."]) -> Place:
        """The integrated coordinates at the angle `eta` [rad] from the lowest point, in the x-z plane."""

    @abc.abstractmethod
    def place_rate(self, place: Place, turning: Tangent) -> Place:
        """Rate of change [1/s] of `place` when the frame turns at the given rates [rad/s]."""

    @abc.abstractmethod
    def turning(self, velocity: Tangent) -> Tangent:
        """Rates (o1, o2) = S V [rad/s] at which the normal turns for the velocity (V1, V2) [m/s]."""

    @abc.abstractmethod
    def vertical(self, place: Place) -> Vector:
        """Components of the upward vertical in the moving frame."""

    @abc.abstractmethod
    def height(self, place: Place) -> Component:
        """Height [m] above the lowest point of the surface."""

    @abc.abstractmethod
    def cyclic(self, eta: Float[ArrayLike, "..."]) -> Place:
        """Cyclic coordinates at the start, integrated only if the position is wanted too."""

    @abc.abstractmethod
    def cyclic_rate(self, cyclic: Place, velocity: Tangent, turning: Tangent) -> Place:
        """Rate of change of `cyclic`."""

    @abc.abstractmethod
    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        """Angle eta [rad] from the lowest point."""

    @abc.abstractmethod
    def frame(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        """The vectors t1, t2 and n in the fixed frame (x, y, z), each a tuple of three arrays."""

    @abc.abstractmethod
    def position(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        """Position (x, y, z) [m] in the fixed frame; the origin is the arena's centre, or its point below the start."""


class PlaneFrame(AbstractMovingFrame):
    """A plane; its frame does not turn."""

    tilt: eqx.AbstractVar[Float[Array, "..."] | None]

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "PlaneFrame":
        if self.tilt is not None:
            raise ValueError(f"surface = {self!r} must be level for a rolling ball")
        return self

    def place(self, eta: Float[ArrayLike, "..."]) -> Place:
        return ()

    def place_rate(self, place: Place, turning: Tangent) -> Place:
        return ()

    def turning(self, velocity: Tangent) -> Tangent:
        return (None, None)

    def vertical(self, place: Place) -> Vector:
        return (None, None, 1.0)

    def height(self, place: Place) -> Component:
        return None

    def cyclic(self, eta: Float[ArrayLike, "..."]) -> Place:
        zero = jnp.zeros_like(as_number(eta))
        return (zero, zero)

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, turning: Tangent) -> Place:
        return velocity

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return jnp.zeros_like(cyclic[0])

    def frame(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        zero, one = jnp.zeros_like(cyclic[0]), jnp.ones_like(cyclic[0])
        return (one, zero, zero), (zero, one, zero), (zero, zero, one)

    def position(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        return (cyclic[0], cyclic[1], jnp.zeros_like(cyclic[0]))


class CylinderFrame(AbstractMovingFrame):
    """The inside of a cylinder; t1 points along growing eta, t2 along y."""

    radius: eqx.AbstractVar[Float[Array, "..."]]

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=distance, why="the body must fit inside")

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "CylinderFrame":
        require_all(self.room(distance))
        return dataclasses.replace(self, radius=self.radius - distance)

    def place(self, eta: Float[ArrayLike, "..."]) -> Place:
        return (jnp.sin(eta), jnp.cos(eta))

    def place_rate(self, place: Place, turning: Tangent) -> Place:
        sine, cosine = place
        return (multiply(turning[0], cosine), -multiply(turning[0], sine))

    def turning(self, velocity: Tangent) -> Tangent:
        return (velocity[0] / self.radius, None)

    def vertical(self, place: Place) -> Vector:
        sine, cosine = place
        return (sine, None, cosine)

    def height(self, place: Place) -> Component:
        return self.radius * (1.0 - place[1])

    def cyclic(self, eta: Float[ArrayLike, "..."]) -> Place:
        eta = as_number(eta)
        return (eta, jnp.zeros_like(eta))

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, turning: Tangent) -> Place:
        return (turning[0], velocity[1])

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return cyclic[0]

    def frame(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        sine, cosine = place
        zero, one = jnp.zeros_like(sine), jnp.ones_like(sine)
        return (cosine, zero, sine), (zero, one, zero), (-sine, zero, cosine)

    def position(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        sine, cosine = place
        return (self.radius * sine, cyclic[1], -self.radius * cosine)


class SphereFrame(AbstractMovingFrame):
    """The inside of a sphere; the frame is carried parallel to itself, so no place is singular.

    The place is the vertical seen in the moving frame; `cyclic` adds the horizontal x axis seen in it.
    """

    radius: eqx.AbstractVar[Float[Array, "..."]]

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=distance, why="the body must fit inside")

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "SphereFrame":
        require_all(self.room(distance))
        return dataclasses.replace(self, radius=self.radius - distance)

    def place(self, eta: Float[ArrayLike, "..."]) -> Place:
        eta = as_number(eta)
        return (jnp.sin(eta), jnp.zeros_like(eta), jnp.cos(eta))

    def place_rate(self, place: Place, turning: Tangent) -> Place:
        return carried(place, turning)

    def turning(self, velocity: Tangent) -> Tangent:
        return (velocity[0] / self.radius, velocity[1] / self.radius)

    def vertical(self, place: Place) -> Vector:
        return (place[0], place[1], place[2])

    def height(self, place: Place) -> Component:
        return self.radius * (1.0 - place[2])

    def cyclic(self, eta: Float[ArrayLike, "..."]) -> Place:
        eta = as_number(eta)
        return (jnp.cos(eta), jnp.zeros_like(eta), -jnp.sin(eta))

    def cyclic_rate(self, cyclic: Place, velocity: Tangent, turning: Tangent) -> Place:
        return carried(cyclic, turning)

    def angle(self, place: Place, cyclic: Place) -> Float[Array, "..."]:
        return jnp.arctan2(jnp.hypot(place[0], place[1]), place[2])

    def frame(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        x, z = cyclic, place
        y = (z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0])
        return (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])

    def position(self, place: Place, cyclic: Place) -> tuple[Any, Any, Any]:
        normal = self.frame(place, cyclic)[2]
        return tuple(-self.radius * component for component in normal)
