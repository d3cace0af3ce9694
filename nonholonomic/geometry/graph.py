"""Open surfaces: the paraboloid and the graph of any smooth function."""

import abc
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..validation import Bound, as_number
from .function import as_function, partials, second_derivative
from .level import AbstractLevel
from .surface import OPEN, AbstractSurface, Place
from .vector import Component, Vector, dot, scale, subtract, sum_vectors, tangents

#: Newton steps to the nearest point of a paraboloid, from above: enough for the worst positions.
NEWTON_STEPS = 12

#: A negligible distance [m], to avoid division by zero.
TINY = 1e-100


class AbstractOpen(AbstractSurface):
    """A surface above the whole x-y plane.

    A place on it is (x, y) [m]; east is the projection of x onto the surface, and north is to its left.
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


class Paraboloid(AbstractOpen):
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
    is_wavy: ClassVar[bool] = False

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
        gradient_rate = (-velocity[0], -velocity[1], None)
        correction = scale(subtract(None, dot(normal, gradient_rate)), normal)
        rate = scale(per_length, sum_vectors(gradient_rate, correction))
        return (rate[0], rate[1], rate[2])

    def gaussian_curvature(self, position: Vector) -> Component:
        x, y, _ = position
        return (self.p / (x * x + y * y + self.p * self.p)) ** 2

    def offset(self, position: Vector) -> Component:
        return (position[2] - self.ground(position[0], position[1])) * self.normal(position)[2]

    def nearest(self, position: Vector) -> Vector:
        # At a distance s from the axis, s^3 / (2 p^2) + (1 - z / p) s = r; the greatest root is the nearest point.
        # Above this root the cubic is convex, so Newton's method converges from above.
        x, y, z = position
        square = x * x + y * y
        r = jnp.sqrt(jnp.maximum(square, TINY * TINY))
        rise, bend = 1.0 - z / self.p, 1.0 / (2.0 * self.p * self.p)

        def fallen(s: Component, r: Component, rise: Component, bend: Component) -> Component:
            return s - ((bend * s * s + rise) * s - r) / (3.0 * bend * s * s + rise)

        constants = jax.lax.stop_gradient((r, rise, bend))
        s = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, s: fallen(s, *constants), _above_the_root(*constants))
        s = fallen(s, r, rise, bend)
        # On the axis, above the centre of curvature, all directions are equally near.
        part, x = s / r, x + jnp.where(square == 0.0, TINY, 0.0)
        return (part * x, part * y, s * s / (2.0 * self.p))


def _above_the_root(r: Component, rise: Component, bend: Component) -> Component:
    """An upper bound of the greatest root s of bend s^3 + rise s = r, for r and bend above 0."""
    cube = r / bend
    fourth_root = jnp.sqrt(jnp.sqrt(cube))
    # A cube root is expensive. By the inequality of means, (2 c + cube / c^2) / 3 is not below the cube root for any c;
    # this c is close to the root.
    c = fourth_root * jnp.sqrt(jnp.sqrt(fourth_root))
    bound = jnp.sqrt(jnp.maximum(-rise / bend, 0.0)) + (2.0 * c + cube / (c * c)) / 3.0
    return jnp.where(rise > 0.0, jnp.minimum(bound, r / jnp.where(rise > 0.0, rise, 1.0)), bound)


def _disc(sectors: int, starts: int) -> Float[np.ndarray, "sectors starts 3"]:
    """Points spread evenly over sectors of the unit disc of x and y."""
    distance = np.sqrt((np.arange(starts) + 0.5) / starts)
    # The golden ratio prevents neighbouring radii from having similar angles.
    part = (np.arange(starts) * 0.5 * (np.sqrt(5.0) - 1.0)) % 1.0
    angle = 2.0 * np.pi * (np.arange(sectors)[:, None] + part) / sectors
    return np.stack([distance * np.cos(angle), distance * np.sin(angle), 0.0 * angle], axis=2)


class Graph(AbstractOpen, AbstractLevel):
    """The surface z = height(x, y) of any smooth function.

    **Arguments:**

    - `height`: returns z [m] for x and y [m], numbers. Write it with `jax.numpy` and without `if`. It may look up measured
      heights, as `jax.numpy.interp` and `jax.scipy.interpolate.RegularGridInterpolator` do. If it is an
      `equinox.Module`, its numbers are parameters of the scene, which you can sweep and differentiate.

    **Raises:** `ValueError` if `height` is not a function of x and y.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> hills = nonholonomic.Graph(lambda x, y: 0.1 * jnp.cos(x) * jnp.cos(y))
    >>> print(hills.elevation((0.0, 0.0, 0.1)))
    0.1

    ```
    """

    starts: ClassVar[Float[np.ndarray, "sectors starts 3"]] = _disc(5, 12)

    height: Any = eqx.field(converter=lambda height: as_function(height, "height", ("x", "y")))

    def ground(self, x: Float[Array, "..."], y: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.height(x, y)

    def level(self, position: Vector) -> Component:
        return position[2] - self.height(position[0], position[1])

    def onto(self, position: Vector) -> Vector:
        x, y, z = jnp.broadcast_arrays(*position)
        return (x, y, self.height(x, y) + 0.0 * z)

    def gradient(self, position: Vector) -> Vector:
        slope = partials(self.height, position[:2])
        return (-slope[0], -slope[1], jnp.ones_like(slope[0]))

    def second_derivative(self, position: Vector, a: Vector, b: Vector) -> Component:
        return -second_derivative(self.height, position[:2], a[:2], b[:2])
