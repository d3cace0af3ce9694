"""Arenas: the surfaces on which a body slides, rolls or drives.

Every surface answers two kinds of question, and a new surface is one new class.

In a frame that moves with the body, (t1, t2, n) with n the unit normal from the arena into the room where the body is:
how the frame turns with the velocity (the shape operator), which way is up, and how the place changes. This is what the
equations of motion need; components that vanish identically are `None` (see `vector.py`).

In the fixed frame (x, y, z), z up: position, normal, frame. This is what a picture needs. A model formulated in the
fixed frame uses the surface as a ground (see `ground.py`).
"""

import abc
import math
from collections.abc import Iterable, Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..validation import Bound, Bounded, as_number, is_traced, require_all
from .ground import AbstractGround, AbstractQuadric, Place
from .vector import Component, Vector, dot, multiply, subtract

Tangent = tuple[Component, Component]


def carried(vector: tuple[Component, ...], turning: Tangent) -> tuple[Component, ...]:
    """Rate of the components of a fixed vector in a moving frame with t1' = o1 n, t2' = o2 n, n' = -(o1 t1 + o2 t2)."""
    along_normal = dot(turning, vector[:2])
    return (multiply(turning[0], vector[2]), multiply(turning[1], vector[2]), subtract(None, along_normal))


class AbstractSurface(Bounded):
    """A surface described by a moving frame (t1, t2, n), with n pointing into the room where the body is.

    With V the velocity along the surface, the normal turns as n' = -(o1 t1 + o2 t2), where (o1, o2) = S V and S is the
    shape operator, positive where the surface is concave towards the room. The frame does not turn about n, so the
    components of a fixed vector change as `carried` states.

    **Example:**

    ```
    >>> import nonholonomic
    >>> bowl = nonholonomic.Sphere(radius=0.5)
    >>> isinstance(bowl, nonholonomic.AbstractSurface)
    True
    >>> bowl.parallel(0.02)
    Sphere(radius=0.48 m)

    ```
    """

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterable[Bound]:
        """The ranges of the surface's numbers in which a ball of the given radius [m] fits."""
        return ()

    @abc.abstractmethod
    def parallel(self, distance: Float[ArrayLike, "..."]) -> "AbstractSurface":
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


def none_if_zero(value: Any) -> Any:
    """A number as an array, or `None` if it is known to be zero everywhere, so that it costs nothing."""
    if value is None:
        return None
    number = as_number(value)
    return number if is_traced(number) or np.any(np.asarray(number) != 0.0) else None


class Plane(AbstractSurface, AbstractGround):
    """A plane; its frame does not turn. A level plane, the only kind for a rolling ball, adds no terms.

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

    axes: ClassVar[int] = 2
    units: ClassVar[dict[str, str]] = {"tilt": "rad"}

    tilt: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None)

    def bounds(self) -> Iterator[Bound]:
        if self.tilt is not None:
            yield Bound(self.tilt, "tilt", at_least=-math.pi / 2.0, at_most=math.pi / 2.0)

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "Plane":
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

    @property
    def up(self) -> Vector:
        return (None, None, 1.0) if self.tilt is None else (jnp.sin(self.tilt), None, jnp.cos(self.tilt))

    def outward(self, position: Vector) -> Vector:
        return (None, None, 1.0)

    def outward_rate(self, position: Vector, velocity: Vector) -> Vector:
        return (None, None, None)

    def elevation(self, position: Vector) -> Component:
        return dot(position, self.up)

    def gaussian_curvature(self, position: Vector) -> Component:
        return None

    def chart(self, place: Place) -> tuple[Vector, Vector, Vector]:
        one = jnp.ones_like(place[0])
        return (place[0], place[1], None), (one, jnp.zeros_like(one), None), (jnp.zeros_like(one), one, None)

    def place_at(self, position: Vector) -> Place:
        return position[:2]

    def departure(self, position: Vector) -> Component:
        return None

    def in_fixed_frame(self, vector: Vector) -> tuple[Any, Any, Any]:
        x, y, z = vector
        z = jnp.zeros_like(x) if z is None else z
        if self.tilt is None:
            return (x, y, z)
        sine, cosine = jnp.sin(self.tilt), jnp.cos(self.tilt)
        return (x * cosine - z * sine, y, x * sine + z * cosine)


class Cylinder(AbstractSurface):
    """The inside of a cylinder with a horizontal axis along y; t1 points along growing eta, t2 along y.

    **Arguments:**

    - `radius`: radius of the arena [m], positive.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Cylinder(radius=0.3)
    Cylinder(radius=0.3 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m"}

    radius: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=0.0)

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=distance, why="the body must fit inside")

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "Cylinder":
        require_all(self.room(distance))
        return Cylinder(self.radius - distance)

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


class Sphere(AbstractSurface, AbstractQuadric):
    """A sphere (its inside, for a rolling ball); the frame is carried parallel to itself, so no place is singular.

    The place is the vertical seen in the moving frame; `cyclic` adds the horizontal x axis seen in it.

    **Arguments:**

    - `radius`: radius of the arena [m], positive.

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

    def room(self, distance: Float[ArrayLike, "..."]) -> Iterator[Bound]:
        yield Bound(self.radius, "surface radius", above=distance, why="the body must fit inside")

    def parallel(self, distance: Float[ArrayLike, "..."]) -> "Sphere":
        require_all(self.room(distance))
        return Sphere(self.radius - distance)

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

    @property
    def semi_axes(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.radius, self.radius
