"""Open surfaces: the paraboloid and the graph of any smooth function."""

import abc
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound, as_number
from .function import as_function, partials, second_derivative
from .level import AbstractDifferentiated, AbstractLevel
from .surface import OPEN, AbstractSurface, Place
from .vector import Component, Vector, dot, scale, subtract, sum_vectors, tangents


class AbstractOpen(AbstractSurface):
    """A surface above the whole x-y plane.

    A place on it is (x, y) [m]; east is the projection of x on the surface, and north is to the left of it.
    """

    sides: ClassVar[Mapping[str, float]] = OPEN
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("x", "m"), ("y", "m"))

    def place_at(self, position: Vector) -> Place:
        return position[:2]

    def elevation(self, position: Vector) -> Component:
        return position[2]

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        x, y = jnp.broadcast_arrays(*place)
        position = (x, y, self.ground(x, y))
        return position, *tangents(self.normal(position))

    @abc.abstractmethod
    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height z [m] of the surface at (x, y) [m]."""


class Paraboloid(AbstractOpen, AbstractLevel):
    """The bowl z = (x^2 + y^2) / (2 p).

    **Arguments:**

    - `p`: radius of curvature [m] at the lowest point, positive.

    **Example:**

    ```
    >>> import nonholonomic
    >>> bowl = nonholonomic.Paraboloid(p=0.5)
    >>> print(bowl.elevation((0.5, 0.0, 0.25)))
    0.25

    ```
    """

    units: ClassVar[dict[str, str]] = {"p": "m"}

    p: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.p, "p", above=0.0)

    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        return (x * x + y * y) / (2.0 * self.p)

    def normal(self, position: Vector) -> Vector:
        x, y, _ = position
        per_length = 1.0 / jnp.sqrt(x * x + y * y + self.p * self.p)
        return (-x * per_length, -y * per_length, self.p * per_length)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        x, y, _ = position
        per_length, normal = 1.0 / jnp.sqrt(x * x + y * y + self.p * self.p), self.normal(position)
        turning = (-velocity[0], -velocity[1], None)
        along = scale(subtract(None, dot(normal, turning)), normal)
        rate = scale(per_length, sum_vectors(turning, along))
        return (rate[0], rate[1], rate[2])

    def gaussian_curvature(self, position: Vector) -> Component:
        x, y, _ = position
        return (self.p / (x * x + y * y + self.p * self.p)) ** 2

    def offset(self, position: Vector) -> Component:
        return (position[2] - self.ground(position[0], position[1])) * self.normal(position)[2]


class Graph(AbstractOpen, AbstractDifferentiated):
    """The surface z = height(x, y) of any smooth function.

    **Arguments:**

    - `height`: gives z [m] for x and y [m]. It is called with arrays of any shape, a number for each lane, so it is written
      with `jax.numpy` and without `if`. The numbers of an `equinox.Module` are numbers of the scene, to be swept and
      differentiated by.

    **Raises:** `ValueError` for what is not such a function.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> hills = nonholonomic.Graph(lambda x, y: 0.1 * jnp.cos(x) * jnp.cos(y))
    >>> print(hills.elevation((0.0, 0.0, 0.1)))
    0.1

    ```
    """

    height: Any = eqx.field(converter=lambda height: as_function(height, "height", ("x", "y")))

    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.height(x, y)

    def gradient(self, position: Vector) -> Vector:
        slope = partials(self.height, position[:2])
        return (-slope[0], -slope[1], jnp.ones_like(slope[0]))

    def second_derivative(self, position: Vector, a: Vector, b: Vector) -> Component:
        return -second_derivative(self.height, position[:2], a[:2], b[:2])

    def offset(self, position: Vector) -> Component:
        return (position[2] - self.height(position[0], position[1])) * self.normal(position)[2]
