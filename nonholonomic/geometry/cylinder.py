"""The cylinder with a horizontal axis."""

from collections.abc import Iterator
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound, as_number
from .surface import AbstractSurface, Place
from .vector import Component, Vector, add, dot, multiply, scale, subtract


class Cylinder(AbstractSurface):
    """A cylinder whose axis is the y axis.

    A place on it is (y, eta): along the axis [m], and the angle [rad] about it from the lowest line, towards x; east is y
    and north is along growing eta.

    **Arguments:**

    - `radius`: radius [m], positive.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Cylinder(radius=0.3)
    Cylinder(radius=0.3 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m"}
    is_wavy: ClassVar[bool] = False

    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("y", "m"), ("eta", "rad"))

    radius: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=0.0)

    def normal(self, position: Vector) -> Vector:
        per_length = 1.0 / _across(position)
        return (multiply(per_length, position[0]), None, multiply(per_length, position[2]))

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        normal, radial_velocity = self.normal(position), (velocity[0], None, velocity[2])
        correction = scale(subtract(None, dot(normal, radial_velocity)), normal)
        per_length = 1.0 / _across(position)
        return (
            multiply(per_length, add(velocity[0], correction[0])),
            None,
            multiply(per_length, add(velocity[2], correction[2])),
        )

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.radius

    def gaussian_curvature(self, position: Vector) -> Component:
        return None

    def nearest(self, position: Vector) -> Vector:
        part = self.radius / _across(position)
        return (multiply(part, position[0]), position[1], multiply(part, position[2]))

    def distance(self, position: Vector) -> Component:
        return _across(position) - self.radius

    def place_at(self, position: Vector) -> Place:
        return (position[1], jnp.arctan2(position[0], -position[2]))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        axial, eta = place
        sine, cosine, zero = jnp.sin(eta), jnp.cos(eta), jnp.zeros_like(eta)
        return (
            (self.radius * sine, axial, -self.radius * cosine),
            (zero, jnp.ones_like(eta), zero),
            (cosine, zero, sine),
        )


def _across(position: Vector) -> Component:
    """Distance [m] of a position from the axis."""
    return jnp.sqrt(position[0] * position[0] + position[2] * position[2])
