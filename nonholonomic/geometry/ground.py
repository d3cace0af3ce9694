"""Surfaces as seen from the fixed frame, for a body that drives on them.

A ground has its own axes, in which positions, headings and normals are given: x east, y north and z
along the normal on a plane; x and y across and z along the axis of symmetry, which is vertical, on a spheroid. There is
no pole, no edge and no angle in these components. `chart` and `place_at` convert between them and the two coordinates that a
person would give.
"""

import abc
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound, Bounded, as_number, require
from .vector import Component, Vector, dot, multiply, scale, subtract, sum_vectors

Place = tuple[Float[Array, "..."], ...]


class AbstractGround(Bounded):
    """A surface to drive on. `outward` is its unit normal n away from the centre of curvature, upwards on a plane."""

    #: How many of a position's three components do not vanish identically.
    axes: ClassVar[int] = 3

    @property
    @abc.abstractmethod
    def up(self) -> Vector:
        """Components of the upward vertical in the ground's axes."""

    @abc.abstractmethod
    def outward(self, position: Vector) -> Vector:
        """Unit normal n at a position [m]."""

    @abc.abstractmethod
    def outward_rate(self, position: Vector, velocity: Vector) -> Vector:
        """Rate n' [1/s] of the normal for a velocity [m/s] along the ground."""

    @abc.abstractmethod
    def elevation(self, position: Vector) -> Component:
        """Height [m] of a position: above the lowest point, or above the origin of a plane."""

    @abc.abstractmethod
    def gaussian_curvature(self, position: Vector) -> Component:
        """Gaussian curvature K [1/m^2] at a position."""

    @abc.abstractmethod
    def chart(self, place: Place) -> tuple[Vector, Vector, Vector]:
        """Position [m], and the unit vectors east and north there, at a place: (x, y) [m] or (mu, eta) [rad]."""

    @abc.abstractmethod
    def place_at(self, position: Vector) -> Place:
        """The place of a position: (x, y) [m] on a plane, (mu, eta) [rad], azimuth and reduced latitude, otherwise."""

    @abc.abstractmethod
    def departure(self, position: Vector) -> Component:
        """How far a position is off the ground, relative to the ground's size."""

    @abc.abstractmethod
    def in_fixed_frame(self, vector: Vector) -> tuple[Any, Any, Any]:
        """Components of a vector in the fixed frame (x, y, z), z up."""


class AbstractQuadric(AbstractGround):
    """A sphere or spheroid r.N r = 1, N = diag(1/A^2, 1/A^2, 1/c^2), about the origin, its axis vertical."""

    @property
    @abc.abstractmethod
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Equatorial radius A and polar semi-axis c [m]."""

    def gradient(self, vector: Vector) -> Vector:
        """The vector N r [1/m]; also N times any other vector."""
        equatorial, polar = self.semi_axes
        across, along = 1.0 / (equatorial * equatorial), 1.0 / (polar * polar)
        return (multiply(across, vector[0]), multiply(across, vector[1]), multiply(along, vector[2]))

    @property
    def up(self) -> Vector:
        return (None, None, 1.0)

    def outward(self, position: Vector) -> Vector:
        # Normalised even where N r has unit length on the surface, so that a drift off it does not amplify itself.
        gradient = self.gradient(position)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), gradient)

    def outward_rate(self, position: Vector, velocity: Vector) -> Vector:
        gradient, normal = self.gradient(position), self.outward(position)
        turning = self.gradient(velocity)
        along = scale(subtract(None, dot(normal, turning)), normal)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), sum_vectors(turning, along))

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.semi_axes[1]

    def gaussian_curvature(self, position: Vector) -> Component:
        equatorial, polar = self.semi_axes
        gradient = self.gradient(position)
        return 1.0 / (equatorial**2 * polar * dot(gradient, gradient)) ** 2

    def chart(self, place: Place) -> tuple[Vector, Vector, Vector]:
        (equatorial, polar), (mu, eta) = self.semi_axes, place
        east = (-jnp.sin(mu), jnp.cos(mu), jnp.zeros_like(mu))
        outwards, across, along = (jnp.cos(mu), jnp.sin(mu)), equatorial * jnp.cos(eta), polar * jnp.sin(eta)
        inwards, rise = -equatorial * jnp.sin(eta), polar * jnp.cos(eta)
        per_length = 1.0 / jnp.sqrt(inwards**2 + rise**2)
        north = scale(per_length, (inwards * outwards[0], inwards * outwards[1], rise))
        return (across * outwards[0], across * outwards[1], along), east, north

    def place_at(self, position: Vector) -> Place:
        equatorial, polar = self.semi_axes
        x, y, z = position
        return (jnp.arctan2(y, x), jnp.arctan2(z / polar, jnp.hypot(x, y) / equatorial))

    def departure(self, position: Vector) -> Component:
        return jnp.sqrt(dot(position, self.gradient(position))) - 1.0

    def in_fixed_frame(self, vector: Vector) -> tuple[Any, Any, Any]:
        x, y, z = vector
        return (x, y, jnp.zeros_like(x) if z is None else z)


class Spheroid(AbstractQuadric):
    """An ellipsoid of revolution with a vertical axis, oblate or prolate.

    **Arguments:**

    - `equatorial`: equatorial radius A [m], positive.
    - `polar`: polar semi-axis c [m], positive.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Spheroid(equatorial=6.0, polar=3.0)
    Spheroid(equatorial=6 m, polar=3 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"equatorial": "m", "polar": "m"}

    equatorial: Float[Array, "..."] = eqx.field(converter=as_number)
    polar: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.equatorial, "equatorial", above=0.0)
        yield Bound(self.polar, "polar", above=0.0)

    @classmethod
    def from_oblate(cls, a: Float[Array, "..."], xi: Float[Array, "..."]) -> "Spheroid":
        """The spheroid of constant xi in oblate spheroidal coordinates: A = a cosh xi, c = a sinh xi.

        **Arguments:**

        - `a`: focal radius [m], positive.
        - `xi`: coordinate [1], positive.

        **Raises:** `ValueError` for numbers outside these ranges.
        """
        a, xi = as_number(a), as_number(xi)
        require(a, "a", above=0.0)
        require(xi, "xi", above=0.0)
        return cls(equatorial=a * jnp.cosh(xi), polar=a * jnp.sinh(xi))

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.equatorial, self.polar
