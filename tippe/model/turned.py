"""Mass, centre of mass and moments of inertia of a top turned from one material, in closed form.

Every part is a homogeneous solid of revolution about the z axis with density 1. A slice of radius r and thickness dz at
height z contributes pi r^2 to the volume, pi r^2 z to the first moment, pi r^4 / 2 to the moment of inertia about the
axis, and pi r^4 / 4 + pi r^2 z^2 to that about a transverse axis through the origin (the moment of inertia of a thin
disc and the
parallel-axis theorem; Landau and Lifshitz, Mechanics, section 32). The integrals over z are below; volume and first moment of
the truncated ball are those of a spherical segment (Harris and Stocker, Handbook of Mathematics and Computational Science,
1998, section 4.8.4).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.validation import as_number, require

Number = Float[Array, ""]


class Moments(NamedTuple):
    """Volume [m^3], first moment along the axis [m^4], axial and transverse second moments about the origin [m^5]."""

    volume: Number
    first: Number
    axial: Number
    transverse: Number

    def plus(self, other: "Moments", sign: float = 1.0) -> "Moments":
        """Both solids together, or, with `sign` -1, this solid without the other."""
        return Moments(*(a + sign * b for a, b in zip(self, other, strict=True)))


def truncated_ball(radius: Number, cut: Number) -> Moments:
    """A ball about the origin without the part above z = `cut`: r^2 = radius^2 - z^2 from -radius to `cut`."""

    def axial(z):
        return radius**4 * z - 2.0 * radius**2 * z**3 / 3.0 + z**5 / 5.0

    def vertical(z):
        return radius**2 * z**3 / 3.0 - z**5 / 5.0

    transverse = jnp.pi / 2.0 * (axial(cut) - axial(-radius))
    return Moments(
        jnp.pi * (2.0 * radius**3 / 3.0 + radius**2 * cut - cut**3 / 3.0),
        -jnp.pi / 4.0 * (radius**2 - cut**2) ** 2,
        transverse,
        transverse / 2.0 + jnp.pi * (vertical(cut) - vertical(-radius)),
    )


def cylinder(radius: Number, low: Number, high: Number) -> Moments:
    """A cylinder between two heights."""
    section = jnp.pi * radius**2
    transverse = section * (high - low) * radius**2 / 2.0
    return Moments(
        section * (high - low),
        section * (high**2 - low**2) / 2.0,
        transverse,
        transverse / 2.0 + section * (high**3 - low**3) / 3.0,
    )


def half_ball(radius: Number, centre: Number) -> Moments:
    """The upper half of a ball about a point on the axis."""
    volume, moment = 2.0 * jnp.pi * radius**3 / 3.0, jnp.pi * radius**4 / 4.0
    second = 2.0 * volume * radius**2 / 5.0
    return Moments(volume, volume * centre + moment, second, second + 2.0 * moment * centre + volume * centre**2)


class Shape(NamedTuple):
    """The shape of a turned top: lengths [m], with heights above the centre of its sphere along the stem."""

    radius: Number
    cut: Number
    stem_radius: Number
    stem_length: Number
    hole_radius: Number
    hole_depth: Number

    @classmethod
    def checked(cls, lengths: dict[str, Any]) -> "Shape":
        """A shape with checked numbers.

        **Raises:** `ValueError` for numbers that are impossible for such a top.
        """
        for name, length in lengths.items():
            if name.startswith("hole"):
                require(length, name, at_least=0.0)
            else:
                require(length, name, above=0.0)
        shape = cls(**{name: as_number(length) for name, length in lengths.items()})
        radius, cut, stem = shape.radius, shape.cut, shape.stem_radius
        require(cut, "cut", below=radius, why="the radius of the sphere")
        rim = jnp.sqrt(radius**2 - cut**2)
        require(stem, "stem_radius", below=rim, why="the radius of the flat that the cut leaves")
        require(shape.stem_length, "stem_length", above=stem, why="the stem ends in a half ball")
        if lengths["hole_radius"] or lengths["hole_depth"]:
            require(shape.hole_radius, "hole_radius", above=stem, why="the hole is drilled around the stem")
            require(shape.hole_radius, "hole_radius", below=rim, why="the radius of the flat that the cut leaves")
            wall = cut + jnp.sqrt(radius**2 - shape.hole_radius**2)
            require(shape.hole_depth, "hole_depth", above=0.0, below=wall, why="the hole must not pierce the sphere")
        # On the level plane, sphere and stem touch together where cos(theta) is (stem - radius) / tip; the rim touches
        # where it is -cut / radius.
        reason = "else the rim of the cut touches the table before the stem; lengthen the stem, or cut less off"
        require(shape.tip, "cut + stem_length - stem_radius", above=radius * (radius - stem) / cut, why=reason)
        return shape

    @property
    def tip(self) -> Number:
        """Height of the centre of the stem's end [m]."""
        return self.cut + self.stem_length - self.stem_radius

    @property
    def moments(self) -> Moments:
        """Moments of the whole top with density 1, about the centre of the sphere."""
        bottom = self.cut - self.hole_depth
        return (
            truncated_ball(self.radius, self.cut)
            .plus(cylinder(self.hole_radius, bottom, self.cut), -1.0)
            .plus(cylinder(self.stem_radius, bottom, self.tip))
            .plus(half_ball(self.stem_radius, self.tip))
        )
