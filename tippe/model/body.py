"""What a body of revolution says of itself: its inertia, and where it touches the arena.

A convex body touches at the point that is farthest down the arena's normal n. Seen from the centre of mass the height above the
arena is a function H of c = cos(theta) = e.n alone, the support function, and the contact is at

    r = A e - B n,   A(c) = -H'(c),   B(c) = H(c) - c H'(c).

A sphere has H = R - a c, so A and B are its offset and radius; on any other body they change as it leans.
"""

import abc
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Vector
from nonholonomic.validation import Bound, Bounded


class ContactGeometry(NamedTuple):
    """Where a body touches: the contact is at r = offset e - radius n from the centre of mass.

    - `offset`, `radius`: A and B [m].
    - `coupling`: m A / I1 [1/m], which the equation of the normal force needs.
    - `growth`: A'(c) [m]; `None` on a sphere, where it vanishes.
    """

    offset: Float[Array, "..."]
    radius: Float[Array, "..."]
    coupling: Float[Array, "..."]
    growth: Component = None

    def contact(self, axis: Vector) -> Vector:
        """The vector r from the centre of mass to the contact [m], in the frame (t1, t2, n)."""
        a = self.offset
        return (a * axis[0], a * axis[1], a * axis[2] - self.radius)


class AbstractMeridian(eqx.Module):
    """The meridian of a body, as the equations of motion ask for it."""

    @abc.abstractmethod
    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        """The lever at cos(theta)."""


class Round(AbstractMeridian):
    """A sphere, which touches on the same lever however it leans; the fields are those of `ContactGeometry`."""

    offset: Float[Array, "..."]
    radius: Float[Array, "..."]
    coupling: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        return ContactGeometry(self.offset, self.radius, self.coupling)


class AbstractBody(Bounded):
    """A convex body of revolution about the axis e.

    `mass` [kg]; `I1`, `I3`: moments of inertia about the centre of mass, across and along the axis [kg m^2].

    The arena's frame carries the point along that is `size` above the contact. What is reported of the motion is the path of
    one of the body's points on its axis: by default the centre of mass.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    I1: eqx.AbstractVar[Float[Array, "..."]]
    I3: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abc.abstractmethod
    def meridian(self) -> AbstractMeridian:
        """Where it touches."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "..."]:
        """A length of it [m], by which places and velocities are measured: of a sphere the radius."""

    @property
    def offset_of_path(self) -> Component:
        """How far along e from the centre of mass the point is whose path is reported [m]; `None`: not at all."""
        return None

    def mass_from_frame(self, axis: Vector) -> Vector:
        """From the point that the frame carries to the centre of mass [m], in (t1, t2, n)."""
        r1, r2, r3 = self.meridian.at(axis[2]).contact(axis)
        return (-r1, -r2, -r3 - self.size)

    def path_from_frame(self, axis: Vector) -> Vector:
        """From the point that the frame carries to the one whose path is reported [m]."""
        return self.mass_from_frame(axis)

    def inertia_bounds(self) -> Iterator[Bound]:
        """The ranges of the moments of inertia."""
        yield Bound(self.I1, "I1", above=0.0)
        yield Bound(self.I3, "I3", above=0.0)
        yield Bound(self.I3, "I3", at_most=2.0 * self.I1, why="I3 <= 2 I1 for every rigid body")
