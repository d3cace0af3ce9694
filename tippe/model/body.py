"""The interface of bodies of revolution: inertia, and the contact point on the arena.

A convex body touches the arena at the point that is farthest down along the arena's normal n. The height of the centre
of mass above the arena is a function H of c = cos(theta) = e.n alone, the support function, and the contact point is at

r = A e - B n,   A(c) = -H'(c),   B(c) = H(c) - c H'(c)

from the centre of mass. A sphere has H = R - a c, so A and B are its offset and radius; for other bodies they depend on
c.
"""

import abc
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Vector
from nonholonomic.validation import Bound, Bounded


class ContactGeometry(NamedTuple):
    """The contact point: it is at r = offset e - radius n from the centre of mass.

    - `offset`, `radius`: A and B [m].
    - `coupling`: m A / I1 [1/m], which the equation of the normal force needs.
    - `growth`: A'(c) [m]; `None` for a sphere, where it vanishes.
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
    """The meridian of a body, in the form that the equations of motion use."""

    @abc.abstractmethod
    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        """The contact geometry at cos(theta)."""


class Round(AbstractMeridian):
    """A sphere, whose contact geometry does not depend on the inclination; the fields are those of
    `ContactGeometry`."""

    offset: Float[Array, "..."]
    radius: Float[Array, "..."]
    coupling: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        return ContactGeometry(self.offset, self.radius, self.coupling)


class AbstractBody(Bounded):
    """A convex body of revolution about the axis e.

    `mass` [kg]; `I1`, `I3`: moments of inertia about the centre of mass, across and along the axis [kg m^2].

    The arena's frame moves with the point at the height `size` above the contact. Runs report the path of a point on
    the body's axis, by default the centre of mass.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    I1: eqx.AbstractVar[Float[Array, "..."]]
    I3: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abc.abstractmethod
    def meridian(self) -> AbstractMeridian:
        """The body's meridian."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "..."]:
        """A length of the body [m], the unit for places and velocities: for a sphere the radius."""

    @property
    def offset_of_path(self) -> Component:
        """Distance along e from the centre of mass to the point whose path is reported [m]; `None` for the centre of
        mass."""
        return None

    def mass_from_frame(self, axis: Vector) -> Vector:
        """Vector from the point with which the frame moves to the centre of mass [m], in (t1, t2, n)."""
        r1, r2, r3 = self.meridian.at(axis[2]).contact(axis)
        return (-r1, -r2, -r3 - self.size)

    def path_from_frame(self, axis: Vector) -> Vector:
        """Vector from the point with which the frame moves to the point whose path is reported [m]."""
        return self.mass_from_frame(axis)

    def inertia_bounds(self) -> Iterator[Bound]:
        """The ranges of the moments of inertia."""
        yield Bound(self.I1, "I1", above=0.0)
        yield Bound(self.I3, "I3", above=0.0)
        yield Bound(self.I3, "I3", at_most=2.0 * self.I1, why="I3 <= 2 I1 for every rigid body")
