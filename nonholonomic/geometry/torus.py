"""The torus with a vertical axis."""

from collections.abc import Iterator
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound, as_number
from .surface import AbstractSurface, Place
from .vector import Component, Vector, dot, scale, subtract, sum_vectors


class Torus(AbstractSurface):
    """A ring-shaped tube about the vertical axis, its middle at the height of the origin.

    A place on it is (mu, eta) [rad]: azimuth, and angle about the tube from its outermost circle upwards, so that -pi/2 is
    its lowest circle and pi/2 its highest.

    **Arguments:**

    - `ring`: radius [m] of the circle along the middle of the tube, positive.
    - `tube`: radius [m] of the tube, positive and less than `ring`.

    **Example:**

    ```
    >>> import nonholonomic
    >>> tube = nonholonomic.Torus(ring=2.0, tube=0.5)
    >>> print(round(float(tube.gaussian_curvature((2.5, 0.0, 0.0))), 6))
    0.8

    ```
    """

    units: ClassVar[dict[str, str]] = {"ring": "m", "tube": "m"}
    is_wavy: ClassVar[bool] = False

    ring: Float[Array, "..."] = eqx.field(converter=as_number)
    tube: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.ring, "ring", above=0.0)
        yield Bound(self.tube, "tube", above=0.0)
        yield Bound(
            self.tube, "tube", below=self.ring, why="the radius of the ring: otherwise the tube would intersect itself"
        )

    def from_middle(self, position: Vector) -> Vector:
        """The vector [m] to a position from the nearest point of the circle along the middle of the tube."""
        x, y, z = position
        part = 1.0 - self.ring / jnp.sqrt(x * x + y * y)
        return (part * x, part * y, z)

    def normal(self, position: Vector) -> Vector:
        spoke = self.from_middle(position)
        return scale(1.0 / jnp.sqrt(dot(spoke, spoke)), spoke)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        (x, y, _), spoke = position, self.from_middle(position)
        per_axis = 1.0 / (x * x + y * y)
        # The nearest point of the circle moves along it at this rate about the axis.
        turn = self.ring * (x * velocity[1] - y * velocity[0]) * per_axis * jnp.sqrt(per_axis)
        moving = (velocity[0] + y * turn, velocity[1] - x * turn, velocity[2])
        per_length = 1.0 / jnp.sqrt(dot(spoke, spoke))
        normal = scale(per_length, spoke)
        correction = scale(subtract(None, dot(normal, moving)), normal)
        return scale(per_length, sum_vectors(moving, correction))

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.tube

    def gaussian_curvature(self, position: Vector) -> Component:
        # cos(eta) / (tube (ring + tube cos(eta))), with the distance from the axis for ring + tube cos(eta).
        from_axis = jnp.sqrt(position[0] ** 2 + position[1] ** 2)
        return (1.0 - self.ring / from_axis) / self.tube**2

    def nearest(self, position: Vector) -> Vector:
        correction = scale(subtract(None, self.distance(position)), self.normal(position))
        foot = sum_vectors(position, correction)
        return (foot[0], foot[1], foot[2])

    def distance(self, position: Vector) -> Component:
        spoke = self.from_middle(position)
        return jnp.sqrt(dot(spoke, spoke)) - self.tube

    def place_at(self, position: Vector) -> Place:
        x, y, z = position
        return (jnp.arctan2(y, x), jnp.arctan2(z, jnp.sqrt(x * x + y * y) - self.ring))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        (mu, eta), zero = place, jnp.zeros_like(place[0])
        cm, sm, ce, se = jnp.cos(mu), jnp.sin(mu), jnp.cos(eta), jnp.sin(eta)
        from_axis = self.ring + self.tube * ce
        return (from_axis * cm, from_axis * sm, self.tube * se), (-sm, cm, zero), (-se * cm, -se * sm, ce)
