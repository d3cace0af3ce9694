"""The body: an eccentric sphere whose mass is symmetric about the axis through its two centres."""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.validation import Bound, Bounded, as_number


class Stem(Bounded):
    """The rounded end of a stem: a second sphere with which a top can touch the plane (`tippe.md`, section 4).

    **Arguments:**

    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of its centre from the centre of mass, along e [m], positive.

    **Raises:** `ValueError` for numbers outside these ranges.
    """

    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.radius, "stem radius", above=0.0)
        yield Bound(self.offset, "stem offset", above=0.0)


class Top(Bounded):
    """A tippe top: a sphere with the centre of mass off its centre, symmetric about the axis e, and the stem's end if any.

    The centre of mass lies at -`offset` e from the sphere's centre, e being the direction of the stem.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of the centre of mass from the sphere's centre [m], at least 0 and less than `radius`.
    - `I1`: transverse moment of inertia about the centre of mass [kg m^2], positive.
    - `I3`: axial moment of inertia [kg m^2], positive and at most 2 `I1` (no rigid body exceeds it).
    - `stem`: a `Stem`, its centre farther along e than the sphere's and neither sphere within the other, or `None`.

    **Raises:** `ValueError` for numbers outside these ranges.
    """

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number)
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)
    stem: Stem | None = None

    def __check_init__(self):
        if self.stem is not None and not isinstance(self.stem, Stem):
            raise ValueError(f"stem = {self.stem!r} must be a Stem")

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        yield Bound(self.radius, "radius", above=0.0)
        yield Bound(self.offset, "offset", at_least=0.0)
        yield Bound(self.offset, "offset", below=self.radius, why="the centre of mass lies inside the sphere")
        yield Bound(self.I1, "I1", above=0.0)
        yield Bound(self.I3, "I3", above=0.0)
        yield Bound(self.I3, "I3", at_most=2.0 * self.I1, why="I3 <= 2 I1 for every rigid body")
        if self.stem is not None:
            reach = self.offset + jnp.abs(self.radius - self.stem.radius)
            yield Bound(self.stem.offset, "stem offset", above=reach, why="neither sphere lies within the other")
