"""The body: an eccentric sphere whose mass is symmetric about the axis through its two centres."""

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.validation import as_number, require


class Top(eqx.Module):
    """A tippe top without stem: a sphere with the centre of mass off its centre, symmetric about the axis e.

    The centre of mass lies at -`offset` e from the sphere's centre, e being the direction of the stem.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of the centre of mass from the sphere's centre [m], at least 0 and less than `radius`.
    - `I1`: transverse moment of inertia about the centre of mass [kg m^2], positive.
    - `I3`: axial moment of inertia [kg m^2], positive and at most 2 `I1` (no rigid body exceeds it).

    **Raises:** `ValueError` for numbers outside these ranges.
    """

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number)
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)

    def __check_init__(self):
        require(self.mass, "mass", above=0.0)
        require(self.radius, "radius", above=0.0)
        require(self.offset, "offset", at_least=0.0)
        require(self.offset, "offset", below=self.radius, why="the centre of mass lies inside the sphere")
        require(self.I1, "I1", above=0.0)
        require(self.I3, "I3", above=0.0)
        require(self.I3, "I3", at_most=2.0 * self.I1, why="I3 <= 2 I1 for every rigid body")
