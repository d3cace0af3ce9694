"""The plane, level or tilted."""

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..validation import Bound
from .surface import CLOSED, OPEN, AbstractSurface, Place
from .vector import Component, Vector, dot, none_if_zero


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
