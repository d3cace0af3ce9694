"""Two meanings of "the wheels do not slip sideways" on curved ground; on a plane they are equal.

In both, the rear axle moves with the velocity w cos(phi) d and the heading turns at the rate w nu sin(phi) / l, where w
is the one free speed of the motion. They differ in the direction d, in the factor nu, and in the vector that turns.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface, Component, Vector, cross, dot, multiply, scale, subtract, sum_vectors

VERTICAL: Vector = (None, None, 1.0)


class AbstractHeading(eqx.Module):
    """The heading, and how it directs and turns the stroller. Vectors are in the ground's axes."""

    @abc.abstractmethod
    def axes(self, ground: AbstractSurface) -> int:
        """Number of components of the heading that do not vanish identically."""

    @abc.abstractmethod
    def unit(self, heading: Vector, normal: Vector) -> Vector:
        """The heading, corrected for a drift off the ground or off unit length.

        An exact heading is unchanged, and so is its rate.
        """

    @abc.abstractmethod
    def direction(self, heading: Vector, normal: Vector, side: float) -> Vector:
        """The vector d along the ground, from the outward normal and the side: 1 outside, -1 inside."""

    @abc.abstractmethod
    def square(self, direction: Vector) -> Component:
        """The square d.d."""

    @abc.abstractmethod
    def lead(self, normal: Vector, side: float) -> Component:
        """The factor nu."""

    @abc.abstractmethod
    def rate(self, heading: Vector, normal: Vector, normal_rate: Vector, turn: Component, side: float) -> Vector:
        """Rate [1/s] of a heading that turns at the rate `turn` [rad/s] to the driver's left."""

    @abc.abstractmethod
    def at_angle(self, angle: Float[Array, "..."], east: Vector, north: Vector) -> Vector:
        """The heading at an angle [rad], given the unit vectors of the place."""

    @abc.abstractmethod
    def angle(self, heading: Vector, east: Vector, north: Vector) -> Float[Array, "..."]:
        """The angle [rad] of a heading, in (-pi, pi]."""


class Intrinsic(AbstractHeading):
    """The heading is a unit vector e along the ground that turns about the normal: d = e, nu = 1 (section 4)."""

    def axes(self, ground: AbstractSurface) -> int:
        return ground.axes

    def unit(self, heading: Vector, normal: Vector) -> Vector:
        tangent = sum_vectors(heading, scale(subtract(None, dot(heading, normal)), normal))
        return scale(1.0 / jnp.sqrt(dot(tangent, tangent)), tangent)

    def direction(self, heading: Vector, normal: Vector, side: float) -> Vector:
        return heading

    def square(self, direction: Vector) -> Component:
        return 1.0

    def lead(self, normal: Vector, side: float) -> Component:
        return 1.0

    def rate(self, heading: Vector, normal: Vector, normal_rate: Vector, turn: Component, side: float) -> Vector:
        yaw = scale(multiply(side, turn), normal)
        return cross(sum_vectors(yaw, cross(normal, normal_rate)), heading)

    def at_angle(self, angle: Float[Array, "..."], east: Vector, north: Vector) -> Vector:
        return sum_vectors(scale(jnp.cos(angle), east), scale(jnp.sin(angle), north))

    def angle(self, heading: Vector, east: Vector, north: Vector) -> Float[Array, "..."]:
        return jnp.arctan2(dot(heading, north), dot(heading, east))


class Projected(AbstractHeading):
    """The heading is a horizontal unit vector h, as in the paper: d = h n_z - z (h.n), nu = n_z (section 3).

    The velocity along d has the horizontal component n_z h, so the paper's speed is w cos(phi) n_z, which passes
    through zero at the equator. Where d = 0 the constraints lose rank.
    """

    def axes(self, ground: AbstractSurface) -> int:
        return 2

    def unit(self, heading: Vector, normal: Vector) -> Vector:
        return scale(1.0 / jnp.sqrt(dot(heading, heading)), heading)

    def direction(self, heading: Vector, normal: Vector, side: float) -> Vector:
        lift = scale(subtract(None, dot(heading, normal)), VERTICAL)
        return scale(side, sum_vectors(scale(normal[2], heading), lift))

    def square(self, direction: Vector) -> Component:
        return dot(direction, direction)

    def lead(self, normal: Vector, side: float) -> Component:
        return multiply(side, normal[2])

    def rate(self, heading: Vector, normal: Vector, normal_rate: Vector, turn: Component, side: float) -> Vector:
        # The driver's left is to the left as seen from above on either side, as in the paper's equations.
        return cross(scale(turn, VERTICAL), heading)

    def at_angle(self, angle: Float[Array, "..."], east: Vector, north: Vector) -> Vector:
        return (jnp.cos(angle), jnp.sin(angle), None)

    def angle(self, heading: Vector, east: Vector, north: Vector) -> Float[Array, "..."]:
        return jnp.arctan2(heading[1], heading[0])
