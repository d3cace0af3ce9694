"""Surfaces in closed form: plane, cylinder, sphere, spheroid and torus."""

import abc
import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound, as_number, require
from .surface import CLOSED, OPEN, AbstractSurface, Place
from .vector import Component, Vector, add, dot, multiply, none_if_zero, planar_length, scale, subtract, sum_vectors

# The plane, level or tilted.


class Plane(AbstractSurface):
    """A plane through the origin; its axes are x, along which it rises, y, and its normal. A level plane adds no terms.

    A place on it is (x, y) [m], along the plane; east is its x axis and north y.

    **Arguments:**

    - `tilt`: angle [rad] by which the plane rises along its own x axis, in [-pi/2, pi/2].

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Plane()
    Plane()
    >>> tippe.Plane(tilt=0.1)
    Plane(tilt=0.1 rad)

    ```
    """

    units: ClassVar[dict[str, str]] = {"tilt": "rad"}
    is_wavy: ClassVar[bool] = False

    axes: ClassVar[int] = 2
    # "outside" is accepted for the only side of a plane, so that grounds can be compared.
    sides: ClassVar[Mapping[str, float]] = {"outside": CLOSED["outside"], **OPEN}
    coordinates: ClassVar[tuple[tuple[str, str], ...]] = (("x", "m"), ("y", "m"))

    tilt: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None)

    def bounds(self) -> Iterator[Bound]:
        if self.tilt is not None:
            yield Bound(self.tilt, "tilt", at_least=-math.pi / 2.0, at_most=math.pi / 2.0, unit="rad")

    @property
    def up(self) -> Vector:
        return (None, None, 1.0) if self.tilt is None else (jnp.sin(self.tilt), None, jnp.cos(self.tilt))

    def normal(self, position: Vector) -> Vector:
        return (None, None, 1.0)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        return (None, None, None)

    def elevation(self, position: Vector) -> Component:
        return dot(position, self.up)

    def gaussian_curvature(self, position: Vector) -> Component:
        return None

    def nearest(self, position: Vector) -> Vector:
        return (position[0], position[1], None)

    def place_at(self, position: Vector) -> Place:
        return position[:2]

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        unit = jnp.ones_like(place[0])
        return (place[0], place[1], None), (unit, jnp.zeros_like(unit), None), (jnp.zeros_like(unit), unit, None)

    def in_fixed_frame(self, vector: Vector) -> tuple[Any, Any, Any]:
        x, y, z = vector
        z = jnp.zeros_like(x) if z is None else z
        if self.tilt is None:
            return (x, y, z)
        sine, cosine = jnp.sin(self.tilt), jnp.cos(self.tilt)
        return (x * cosine - z * sine, y, x * sine + z * cosine)

    def in_own_axes(self, vector: Vector) -> Vector:
        if self.tilt is None:
            return vector
        (x, y, z), sine, cosine = vector, jnp.sin(self.tilt), jnp.cos(self.tilt)
        return (x * cosine + z * sine, y, z * cosine - x * sine)


# The cylinder with a horizontal axis.


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


# Sphere and spheroid: the quadrics of revolution about the vertical.

#: Newton steps to the nearest point of a spheroid: enough for the worst positions.
NEWTON_STEPS = 12

#: A negligible distance [m], to avoid division by zero.
TINY = 1e-100


class AbstractQuadric(AbstractSurface):
    """A sphere or spheroid r.N r = 1, N = diag(1/A^2, 1/A^2, 1/c^2), about the origin, its axis vertical.

    A place on it is (mu, eta) [rad], azimuth and reduced latitude: -pi/2 at the lowest point, pi/2 at the highest.
    """

    is_wavy: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Equatorial radius A and polar semi-axis c [m]."""

    def gradient(self, vector: Vector) -> Vector:
        """The product of N and a vector. For a position r on the surface, N r [1/m] points along the normal."""
        equatorial, polar = self.semi_axes
        across, along = 1.0 / (equatorial * equatorial), 1.0 / (polar * polar)
        return (multiply(across, vector[0]), multiply(across, vector[1]), multiply(along, vector[2]))

    def normal(self, position: Vector) -> Vector:
        # Normalised even though N r has unit length on the surface, so that a drift off the surface does not grow.
        gradient = self.gradient(position)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), gradient)

    def normal_rate(self, position: Vector, velocity: Vector) -> Vector:
        gradient, normal = self.gradient(position), self.normal(position)
        gradient_rate = self.gradient(velocity)
        along = scale(subtract(None, dot(normal, gradient_rate)), normal)
        return scale(1.0 / jnp.sqrt(dot(gradient, gradient)), sum_vectors(gradient_rate, along))

    def bending(self, position: Vector, a: Vector, b: Vector) -> tuple[Component, Component, Component]:
        # The gradient's size changes the normal only along n, which is perpendicular to a and b.
        gradient, by_a = self.gradient(position), self.gradient(a)
        per_size = 1.0 / jnp.sqrt(dot(gradient, gradient))
        aa, ab, bb = dot(a, by_a), dot(b, by_a), dot(b, self.gradient(b))
        return per_size * aa, per_size * ab, per_size * bb

    def elevation(self, position: Vector) -> Component:
        return position[2] + self.semi_axes[1]

    def gaussian_curvature(self, position: Vector) -> Component:
        equatorial, polar = self.semi_axes
        gradient = self.gradient(position)
        return 1.0 / (equatorial**2 * polar * dot(gradient, gradient)) ** 2

    def place_at(self, position: Vector) -> Place:
        equatorial, polar = self.semi_axes
        x, y, z = position
        return (jnp.arctan2(y, x), jnp.arctan2(z / polar, planar_length(x, y) / equatorial))

    def charted(self, place: Place) -> tuple[Vector, Vector, Vector]:
        (equatorial, polar), (mu, eta) = self.semi_axes, place
        east = (-jnp.sin(mu), jnp.cos(mu), jnp.zeros_like(mu))
        outwards, across, along = (jnp.cos(mu), jnp.sin(mu)), equatorial * jnp.cos(eta), polar * jnp.sin(eta)
        inwards, rise = -equatorial * jnp.sin(eta), polar * jnp.cos(eta)
        per_length = 1.0 / jnp.sqrt(inwards**2 + rise**2)
        north = scale(per_length, (inwards * outwards[0], inwards * outwards[1], rise))
        return (across * outwards[0], across * outwards[1], along), east, north

    def place_bounds(self, place: Place, size: Any) -> Iterator[Bound]:
        yield from super().place_bounds(place, size)
        if len(place) == 2:
            limit = math.pi / 2.0 + 1e-12
            reason = "reduced latitude, from -pi/2 to pi/2"
            yield Bound(place[1], "place[1]", at_least=-limit, at_most=limit, why=reason, unit="rad")


class Sphere(AbstractQuadric):
    """A sphere about the origin.

    **Arguments:**

    - `radius`: radius [m], positive.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Sphere(radius=0.5)
    Sphere(radius=0.5 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m"}

    radius: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=0.0)

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.radius, self.radius

    def nearest(self, position: Vector) -> Vector:
        return scale(self.radius / jnp.sqrt(dot(position, position)), position)

    def distance(self, position: Vector) -> Component:
        return jnp.sqrt(dot(position, position)) - self.radius


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

        **Example:**

        ```
        >>> import stroller
        >>> stroller.Spheroid.from_oblate(a=2.0, xi=0.8)
        Spheroid(equatorial=2.67487 m, polar=1.77621 m)

        ```
        """
        a, xi = as_number(a), as_number(xi)
        require(a, "a", above=0.0)
        require(xi, "xi", above=0.0)
        return cls(equatorial=a * jnp.cosh(xi), polar=a * jnp.sinh(xi))

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.equatorial, self.polar

    def offset(self, position: Vector) -> Component:
        gradient = self.gradient(position)
        return 0.5 * (dot(position, gradient) - 1.0) / jnp.sqrt(dot(gradient, gradient))

    def nearest(self, position: Vector) -> Vector:
        # q = (1 + t N)^-1 r, with the greatest t for which q is on the surface: this is the nearest solution. The
        # inverse length of N^1/2 q is almost linear in t, so Newton's method needs few steps (Moré and Sorensen, SIAM
        # Journal on Scientific and Statistical Computing 4 (1983) 553).
        equatorial, polar = self.semi_axes
        x, y, z = position
        # Where the nearest points in all directions are equally near, take the point in the direction of growing
        # coordinates.
        radial, axial = jnp.sqrt(jnp.maximum(x * x + y * y, TINY * TINY)), jnp.maximum(jnp.abs(z), TINY)
        minor = jnp.minimum(equatorial, polar)
        numbers = (equatorial * radial, polar * axial, equatorial**2 - minor**2, polar**2 - minor**2)

        def closer(s: Component, u: Component, v: Component, p: Component, q: Component) -> Component:
            a, b = u / (s + p), v / (s + q)
            square = a * a + b * b
            return s + square * (jnp.sqrt(square) - 1.0) / (a * a / (s + p) + b * b / (s + q))

        u, v, p, q = constants = jax.lax.stop_gradient(numbers)
        s = jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, s: closer(s, *constants), jnp.maximum(u - p, v - q))
        s = closer(s, *numbers)
        radial_factor, axial_factor = equatorial**2 / (s + numbers[2]), polar**2 / (s + numbers[3])
        x = x + jnp.where((x == 0.0) & (y == 0.0), TINY, 0.0)
        return (radial_factor * x, radial_factor * y, axial_factor * (z + jnp.where(z == 0.0, TINY, 0.0)))


# The torus with a vertical axis.


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
