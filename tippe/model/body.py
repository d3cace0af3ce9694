"""Bodies of revolution: the eccentric sphere, its mass and inertia when turned from one material, and convex bodies.

A convex body touches the arena at the point that is farthest down along the arena's normal n. The height of the centre
of mass above the arena is a function H of c = cos(theta) = e.n alone, the support function, and the contact point is at

r = A e - B n,   A(c) = -H'(c),   B(c) = H(c) - c H'(c)

from the centre of mass. A sphere has H = R - a c, so A and B are its offset and radius; for other bodies they depend on
c.
"""

import abc
import contextlib
import itertools
import re
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.geometry import Component, Vector, as_function, scale, sum_vectors
from nonholonomic.text import readable_unit, shown
from nonholonomic.validation import Bound, Bounded, as_number, explaining, is_traced, require, warn


class ContactGeometry(NamedTuple):
    """The contact point: it is at r = offset e - radius n from the centre of mass.

    - `offset`, `radius`: A and B [m].
    - `coupling`: m A / I1 [1/m], which the equation of the normal force needs.
    - `growth`: A'(c) [m]; `None` for a sphere, where it vanishes.

    A sphere's contact geometry does not depend on the inclination, so this is also the meridian of a sphere.
    """

    offset: Float[Array, "..."]
    radius: Float[Array, "..."]
    coupling: Float[Array, "..."]
    growth: Component = None

    def at(self, cosine: Float[Array, "..."]) -> "ContactGeometry":
        """The contact geometry at every cos(theta)."""
        return self

    def contact(self, axis: Vector) -> Vector:
        """The vector r from the centre of mass to the contact [m], in the frame (t1, t2, n)."""
        a = self.offset
        return (a * axis[0], a * axis[1], a * axis[2] - self.radius)


class AbstractMeridian(eqx.Module):
    """The meridian of a body other than a sphere, in the form that the equations of motion use."""

    @abc.abstractmethod
    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        """The contact geometry at cos(theta)."""


class AbstractBody(Bounded):
    """A convex body of revolution about the axis e.

    `mass` [kg]; `I1`, `I3`: moments of inertia about the centre of mass, across and along the axis [kg m^2].

    The arena's frame moves with the point at the height `size` above the contact.
    """

    mass: eqx.AbstractVar[Float[Array, "..."]]
    I1: eqx.AbstractVar[Float[Array, "..."]]
    I3: eqx.AbstractVar[Float[Array, "..."]]

    @property
    @abc.abstractmethod
    def meridian(self) -> AbstractMeridian | ContactGeometry:
        """The body's meridian."""

    @property
    @abc.abstractmethod
    def size(self) -> Float[Array, "..."]:
        """A length of the body [m], the unit for places and velocities: for a sphere the radius."""

    @property
    def moments(self) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The magnitudes of the moments of inertia across and along the axis [kg m^2]."""
        return self.I1, self.I3

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        yield Bound(self.I3, "I3", at_most=2.0 * self.I1, why="I3 <= 2 I1 for every rigid body")


# Mass, centre of mass and moments of inertia of a top turned from one material, in closed form.
#
# Every part is a homogeneous solid of revolution about the z axis with density 1. A slice of radius r and thickness dz at
# height z contributes pi r^2 to the volume, pi r^2 z to the first moment, pi r^4 / 2 to the moment of inertia about the
# axis, and pi r^4 / 4 + pi r^2 z^2 to that about a transverse axis through the origin (the moment of inertia of a thin
# disc and the parallel-axis theorem; Landau and Lifshitz, Mechanics, section 32). The integrals over z are below; volume and
# first moment of the truncated ball are those of a spherical segment (Harris and Stocker, Handbook of Mathematics and
# Computational Science, 1998, section 4.8.4).

Number = Float[Array, "..."]

#: Volume [m^3], first moment along the axis [m^4], axial and transverse second moments about the origin [m^5].
Moments = tuple[Number, Number, Number, Number]


def truncated_ball(radius: Number, cut: Number) -> Moments:
    """A ball about the origin without the part above z = `cut`: r^2 = radius^2 - z^2 from -radius to `cut`."""

    # The integrals over r^4 and over r^2 z^2, up to `cut` and up to the lowest point.
    fourth_to, fourth_from = (radius**4 * z - 2.0 * radius**2 * z**3 / 3.0 + z**5 / 5.0 for z in (cut, -radius))
    vertical_to, vertical_from = (radius**2 * z**3 / 3.0 - z**5 / 5.0 for z in (cut, -radius))
    axial = jnp.pi / 2.0 * (fourth_to - fourth_from)
    volume = jnp.pi * (2.0 * radius**3 / 3.0 + radius**2 * cut - cut**3 / 3.0)
    first = -jnp.pi / 4.0 * (radius**2 - cut**2) ** 2
    return volume, first, axial, axial / 2.0 + jnp.pi * (vertical_to - vertical_from)


def cylinder(radius: Number, low: Number, high: Number) -> Moments:
    """A cylinder between two heights."""
    section = jnp.pi * radius**2
    axial = section * (high - low) * radius**2 / 2.0
    first = section * (high**2 - low**2) / 2.0
    return section * (high - low), first, axial, axial / 2.0 + section * (high**3 - low**3) / 3.0


def half_ball(radius: Number, centre: Number) -> Moments:
    """The upper half of a ball about a point on the axis."""
    volume, moment = 2.0 * jnp.pi * radius**3 / 3.0, jnp.pi * radius**4 / 4.0
    axial = 2.0 * volume * radius**2 / 5.0
    return volume, volume * centre + moment, axial, axial + 2.0 * moment * centre + volume * centre**2


#: The lengths of a turned top that are assumed unless they are given: with them, tops with usual stems are of group II.
ASSUMED = {"cut": "cut = 0.35 radius + 1.1 stem_radius", "stem_length": "stem_length 5 % beyond where the rim touches"}


def _turned(lengths: dict[str, Any], xp=jnp) -> tuple[Number, ...]:
    """Volume, offset, axial and transverse moments with density 1, and the height of the stem's end above the centre of
    the sphere. **Arguments and errors:** as for `Top.turned`; `xp`: `numpy` for many quick trials."""
    for name, length in lengths.items():
        if length is not None or name not in ASSUMED:
            require(length, name, above=None if name.startswith("hole") else 0.0, at_least=0.0)
    is_drilled = bool(lengths["hole_radius"] or lengths["hole_depth"])
    names = ("radius", "stem_radius", "hole_radius", "hole_depth")
    radius, stem_radius, hole_radius, hole_depth = (xp.asarray(lengths[name], dtype=float) for name in names)
    usual_cut = 0.35 * radius + 1.1 * xp.minimum(stem_radius, 0.45 * radius)
    cut = usual_cut if lengths["cut"] is None else xp.asarray(lengths["cut"], dtype=float)
    require(cut, "cut", below=radius, why="the radius of the sphere")
    rim = xp.sqrt(radius**2 - cut**2)
    require(stem_radius, "stem_radius", below=rim, why="the radius of the flat that the cut leaves")
    # The height of the centre of the stem's end. On the level plane, sphere and stem touch together where cos(theta) is
    # (stem_radius - radius) / tip; the rim touches where it is -cut / radius.
    least_tip = radius * (radius - stem_radius) / cut
    usual_length = 1.05 * least_tip - cut + stem_radius
    stem_length = usual_length if lengths["stem_length"] is None else xp.asarray(lengths["stem_length"], dtype=float)
    require(stem_length, "stem_length", above=stem_radius, why="the stem ends in a half ball")
    if is_drilled:
        require(hole_radius, "hole_radius", above=stem_radius, why="the hole is drilled around the stem")
        require(hole_radius, "hole_radius", below=rim, why="the radius of the flat that the cut leaves")
        wall = cut + xp.sqrt(radius**2 - hole_radius**2)
        require(hole_depth, "hole_depth", above=0.0, below=wall, why="the hole must not pierce the sphere")
    tip = cut + stem_length - stem_radius
    reason = "else the rim of the cut touches the table before the stem; lengthen the stem, or cut less off"
    require(stem_length, "stem_length", above=least_tip - cut + stem_radius, why=reason)
    # Of the whole top with density 1, about the centre of the sphere.
    bottom = cut - hole_depth
    hole, shaft = cylinder(hole_radius, bottom, cut), cylinder(stem_radius, bottom, tip)
    parts = (truncated_ball(radius, cut), scale(-1.0, hole), shaft, half_ball(stem_radius, tip))
    volume, first, axial, transverse = sum_vectors(*parts)
    offset = -first / volume
    reason = "the centre of mass lies above the centre of the sphere: shorten the stem, or drill a hole around it"
    require(offset, "offset", at_least=0.0, why=reason)
    return volume, offset, axial, transverse - volume * offset**2, tip


def _remedy(lengths: dict[str, Any], message: str) -> str:
    """The message about lengths of which no top can be turned, with a length of three digits that would do instead of one
    of them, if there is one."""
    message = re.sub(r"\d+\.\d{6,}", lambda number: f"{float(number[0]):.4g}", message)
    numbers = {name: as_number(0.0 if value is None else value) for name, value in lengths.items()}
    if any(not isinstance(number, jax.Array) or is_traced(number) or number.ndim for number in numbers.values()):
        return message
    for diameter in ("stem_radius", "radius"):
        with contextlib.suppress(ValueError):
            _turned(lengths | {diameter: 0.5 * float(numbers[diameter])}, np)
            message += f"; is {diameter} = {shown(lengths[diameter])} the diameter?"
    names = ("stem_length", "cut", "hole_radius", "hole_depth", "stem_radius")
    assumed = [name for name in ASSUMED if lengths[name] is None]
    for name in sorted(names, key=lambda name: (name not in assumed, not message.startswith(name))):
        start = abs(float(numbers[name])) or float(numbers["radius"])
        for power in (sign * k for k in range(50) for sign in (1, -1)):
            number = f"{start * 1.03**power:.3g}"
            with contextlib.suppress(ValueError):
                _turned(lengths | {name: float(number)}, np)
                measure = f"{name} was assumed, measure it: " if name in assumed else ""
                return f"{message}; {measure}{name} = {number} would do"
    return message


# The body: an eccentric sphere whose mass is symmetric about the axis through its two centres.

#: Units that are often used by mistake, in SI units.
MASSES, LENGTHS = {"": 1.0, "in g": 1e-3}, {"": 1.0, "in mm": 1e-3, "in cm": 1e-2, "the diameter": 0.5}
INERTIAS = {"": 1.0, "in kg cm^2": 1e-4, "in kg mm^2": 1e-6, "in g cm^2": 1e-7, "in g mm^2": 1e-9}

#: Least density of the material of a turned top that is not suspicious [kg/m^3].
LEAST_DENSITY = 50.0
#: Mean densities [kg/m^3]: below that of a table-tennis ball, of a light wood, above that of osmium, and of brass.
LEAST_MEAN, LEAST_WOOD, GREATEST_DENSITY, BRASS = 80.0, 320.0, 23_000.0, 9000.0
#: The radius [m] above which another unit is suspected, the greatest that it may have in that unit, the greatest of half a
#: diameter, and the plausible range of I1 / (m R^2).
GREATEST_RADIUS, GREATEST_TOY, SMALL_TOY = 1.0, 0.1, 0.04
RATIOS = (0.1, 2.0)


class Stem(Bounded):
    """The rounded end of a stem: a second sphere on which a top can touch the plane (`tippe.md`, section 4).

    **Arguments:**

    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of its centre from the centre of mass, along e [m], positive; not from the sphere's centre.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> stem = tippe.Stem(radius=0.005, offset=0.016)
    >>> top = tippe.Top(mass=0.006, radius=0.015, offset=0.003, I1=8e-7, I3=7e-7, stem=stem)
    >>> top.stem
    Stem(radius=0.005 m, offset=0.016 m)

    ```
    """

    units: ClassVar[dict[str, str]] = {"radius": "m", "offset": "m"}

    radius: Float[Array, "..."] = eqx.field(
        converter=as_number, metadata={"range": {"above": 0.0, "name": "stem radius"}}
    )
    offset: Float[Array, "..."] = eqx.field(
        converter=as_number, metadata={"range": {"above": 0.0, "name": "stem offset"}}
    )


class Top(AbstractBody):
    """A tippe top: a sphere with its centre of mass off its centre, symmetric about the axis e, with or without a stem.

    The centre of mass lies at -`offset` e from the sphere's centre, where e is the direction of the stem.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of the centre of mass from the sphere's centre [m], at least 0 and less than `radius`. The stem is
      stated from the centre of mass: in a table or a fit over `offset` alone, it moves along the sphere by as much, and its
      distance from the sphere's centre, `stem.offset` - `offset`, changes. For a stem that stays on the sphere, let
      `stem.offset` grow by as much, in the columns of a table with `scattered=True`; in a fit, free it too.
    - `I1`: transverse moment of inertia about the centre of mass [kg m^2], positive.
    - `I3`: axial moment of inertia [kg m^2], positive and at most 2 `I1`, as for every rigid body.
    - `stem`: a `Stem`, or `None`. Its centre must be farther along e than the sphere's centre, and neither sphere may
      contain the other.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> top
    Top(mass=0.02 kg, radius=0.02 m, offset=0.006 m, I1=2.994e-06 kg m², I3=3.2e-06 kg m²)
    >>> float(top.offset / top.radius)
    0.3

    ```
    """

    units: ClassVar[dict[str, str]] = {"mass": "kg", "radius": "m", "offset": "m", "I1": "kg m2", "I3": "kg m2"}
    advice: ClassVar[dict[str, str]] = {"diameter": "the radius is half the diameter"}
    advice |= dict.fromkeys(("offset", "I1", "I3"), "Top.turned computes offset, I1 and I3 from the shape")

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    radius: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    offset: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.NOT_NEGATIVE)
    I1: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    I3: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    stem: Stem | None = None
    #: The lengths that `turned` has assumed, as text.
    assumed: str | None = eqx.field(static=True, default=None, init=False)

    @classmethod
    @explaining
    def turned(
        cls,
        radius: ArrayLike,
        density: ArrayLike | None = None,
        *,
        mass: ArrayLike | None = None,
        cut: ArrayLike | None = None,
        stem_radius: ArrayLike,
        stem_length: ArrayLike | None = None,
        hole_radius: ArrayLike = 0.0,
        hole_depth: ArrayLike = 0.0,
    ) -> "Top":
        """A top turned from one material: a sphere with its cap cut off, a cylindrical stem, and optionally a hole
        around the stem.

        Mass, offset, I1, I3 and the stem follow from the shape in closed form, and you can differentiate them. The top
        touches with its sphere or with the half ball at the stem's end. `tippe.steady.group` returns whether the top
        turns over.

        **Arguments:** (lengths in metres)

        - `radius`: radius of the sphere.
        - `density`: density of the material [kg/m^3]: beech 700, acrylic 1180, aluminium 2700; or, instead, `mass`: mass
          of the whole top [kg].
        - `cut`: height of the flat above the centre of the sphere, less than `radius`; the sphere is cut off above the
          flat. By default, 0.35 `radius` + 1.1 `stem_radius`, with which most tops turn over.
        - `stem_radius`: radius of the stem, which is a cylinder that ends in a half ball.
        - `stem_length`: length of the stem above the flat. By default, the half ball's centre is 5 % farther from the
          sphere's centre than it must be for the stem to touch the table before the rim. The top shows what is `assumed`.
        - `hole_radius`, `hole_depth`: a hole drilled from the flat around the stem; the stem stands on the bottom of
          the hole.

        **Returns:** a `Top`.

        **Raises:** `ValueError` for a shape that cannot be turned, whose centre of mass lies above the centre of the
        sphere, or whose rim would touch the table before its stem; and unless there is one of `density` and `mass`.

        The formulas are the integrals over thin discs (Landau and Lifshitz, Mechanics, section 32), in `tippe/model/body.py`.

        **Example:** a beech ball 4 cm across, drilled around a stem 1 cm thick.

        ```
        >>> import tippe
        >>> shape = {"cut": 0.015, "stem_radius": 0.005, "stem_length": 0.012, "hole_radius": 0.012, "hole_depth": 0.020}
        >>> top = tippe.Top.turned(0.020, 700.0, **shape)
        >>> print(f"{1e3 * top.mass:.1f} g, centre of mass {1e3 * top.offset:.2f} mm below the centre")
        17.8 g, centre of mass 1.77 mm below the centre
        >>> tippe.steady.group(top)
        'II'

        ```
        """
        if (density is None) == (mass is None):
            wrong = "neither" if density is None else "both"
            raise ValueError(f"Top.turned takes density [kg/m^3] or mass [kg], not {wrong}")
        require(density if mass is None else mass, "density" if mass is None else "mass", above=0.0)
        if density is not None and not is_traced(density) and np.any(np.asarray(density) < LEAST_DENSITY):
            min_density = float(np.min(density))
            warn(
                f"density = {min_density:g} kg/m^3 is less than that of balsa wood, 100 kg/m^3: was it in g/cm^3? "
                f"{min_density:g} g/cm^3 are {1e3 * min_density:g} kg/m^3; if it is the mass, pass mass={min_density:g}"
            )
        lengths = {"radius": radius, "cut": cut, "stem_radius": stem_radius, "stem_length": stem_length}
        lengths |= {"hole_radius": hole_radius, "hole_depth": hole_depth}
        try:
            volume, offset, axial, transverse, tip = _turned(lengths)
        except ValueError as error:
            raise ValueError(_remedy(lengths, str(error))) from None
        density = as_number(density) if mass is None else as_number(mass) / volume
        assumed = [text for name, text in ASSUMED.items() if lengths[name] is None]
        stem = Stem(as_number(stem_radius), tip + offset)
        top = cls(density * volume, radius, offset, density * transverse, density * axial, stem)
        object.__setattr__(top, "assumed", ", ".join(assumed) or None)
        return top

    def __check_init__(self):
        if self.stem is not None and not isinstance(self.stem, Stem):
            raise ValueError(f"stem = {shown(self.stem)} must be a Stem")

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        yield Bound(self.offset, "offset", below=self.radius, why="the centre of mass lies inside the sphere")
        if self.stem is not None:
            reach = self.offset + jnp.abs(self.radius - self.stem.radius)
            yield Bound(self.stem.offset, "stem offset", above=reach, why="neither sphere lies within the other")

    @property
    def meridian(self) -> ContactGeometry:
        return ContactGeometry(self.offset, self.radius, self.mass * self.offset / self.I1)

    @property
    def size(self) -> Float[Array, "..."]:
        return self.radius

    @property
    def stem_angle(self) -> Float[Array, "..."]:
        """The inclination theta [rad] at which sphere and stem touch a level plane together; the stem alone carries the
        top at larger angles. NaN without a stem.

        The centre of mass is at the heights R - a cos(theta) and R_s - a_s cos(theta) above the plane when the sphere or
        the stem touches, so cos(theta) = (R_s - R) / (a_s - a).
        """
        if self.stem is None:
            return jnp.full(jnp.shape(self.radius), jnp.nan)
        return jnp.arccos((self.stem.radius - self.radius) / (self.stem.offset - self.offset))

    def suspicion(self) -> str | None:
        if is_traced(self):
            return None
        values = {name: np.asarray(getattr(self, name), dtype=float) for name in self.units}
        mass, radius, offset, I1, _ = values.values()
        density, ratio = mass / (4.0 / 3.0 * np.pi * radius**3), I1 / (mass * radius**2)

        def fits(m: float, r: float, inertia: float, least: float, greatest: float) -> bool:
            """Whether mass, radius and I1 times these factors are those of a top."""
            mean, part = density * m / r**3, ratio * inertia / (m * r**2)
            within = (mean >= least) & (mean < GREATEST_DENSITY) & (part >= RATIOS[0]) & (part <= RATIOS[1])
            return bool(np.all(within & (r * radius <= greatest)))

        # A very light sphere is legal, and suspicious only where with half its radius it is a small one of wood or heavier.
        is_legal = fits(1.0, 1.0, 1.0, 0.0, GREATEST_RADIUS)
        if is_legal and np.all(density >= LEAST_MEAN):
            return None
        if np.all((mass >= LEAST_MEAN) & (mass < GREATEST_DENSITY) & (1e-3 * density > BRASS)):
            return f"mass = {np.max(mass):g} kg is unusual for a top: was it a density? Top.turned takes density"
        # Moments of inertia in no unit were computed from the mass and the lengths.
        options = itertools.product(MASSES, ["the diameter"] if is_legal else LENGTHS, (None, *INERTIAS))
        for in_mass, in_length, in_inertia in sorted(options, key=lambda units: sum(map(bool, units))):
            m, r = MASSES[in_mass], LENGTHS[in_length]
            inertia = m * r**2 if in_inertia is None else INERTIAS[in_inertia]
            if fits(m, r, inertia, *((LEAST_WOOD, SMALL_TOY) if is_legal else (LEAST_MEAN, GREATEST_TOY))):
                in_offset = in_length if np.any(offset >= r * radius) else ""
                asked = dict(zip(values, (in_mass, in_length, in_offset, in_inertia, in_inertia), strict=True))
                factors = dict(zip(values, (m, r, LENGTHS[in_offset], inertia, inertia), strict=True))
                odd = [
                    f"{name} = {np.max(values[name]):g} {readable_unit(self.units[name])}"
                    for name in values
                    if asked[name]
                ]
                right = [f"{name}={np.max(values[name]) * factors[name]:.4g}" for name in values if factors[name] != 1]
                words = "is unusual for a top: was it" if len(odd) == 1 else "are unusual for a top: were they"
                units = " and ".join(dict.fromkeys(filter(None, asked.values())))
                return f"{', '.join(odd)} {words} {units}? Then {', '.join(right)}"
        if np.any(radius > GREATEST_RADIUS):
            unit = "mm" if np.max(radius) > 10.0 else "cm"
            return f"radius = {np.max(radius):g} m is large for a top: was it in {unit}?"
        is_dense = np.any(density >= GREATEST_DENSITY)
        suspect = f"mass = {np.max(density):.3g} kg/m^3 of volume" if is_dense else f"I1 = {np.max(ratio):.3g} m R^2"
        question = f"{suspect} is unusual for a top: are mass, radius and I1 in kg, m and kg m^2?"
        return None if is_legal else question


# Bodies of revolution other than spheres: the spheroid, and any convex body that a support function describes.
#
# Source of the support function: Bonnesen and Fenchel, Theorie der konvexen Koerper (1934), section 15; of the motion on a
# plane: Moffatt and Shimomura, Nature 416 (2002) 385, and Moffatt, Shimomura and Branicki, Proc. R. Soc. A 460 (2004) 3643.

#: Number of inclinations at which a support function is checked for convexity.
SAMPLES = 65


class SpheroidBody(AbstractBody):
    """A spheroid: prolate like an egg if `polar` exceeds `equatorial`, otherwise oblate like a pebble. At theta = pi/2
    the spheroid lies on its equator; at 0 and pi it stands on a pole. The scene must have a level or tilted plane, and
    a friction law other than `SetValuedCoulomb`.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `equatorial`, `polar`: half axes [m], across the axis e and along it, positive.
    - `I1`, `I3`: moments of inertia about the centre of mass [kg m^2], across the axis and along it, positive, I3 <= 2
      I1. For a homogeneous spheroid they are m (equatorial^2 + polar^2) / 5 and 2/5 m equatorial^2.
    - `offset`: distance of the centre of mass from the centre, against e [m], at least 0 and less than `polar`.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:** an egg that stands up.

    ```
    >>> import math, tippe
    >>> egg = tippe.SpheroidBody(mass=0.05, equatorial=0.02, polar=0.028, I1=1.184e-5, I3=8e-6)
    >>> egg
    SpheroidBody(mass=0.05 kg, equatorial=0.02 m, polar=0.028 m, I1=1.184e-05 kg m², I3=8e-06 kg m², offset=0 m)
    >>> launch = tippe.Launch(theta=math.pi / 2 + 0.05, spin=0.0, angular_velocity=(0.0, 0.0, 200.0))
    >>> time = tippe.inversion_time(tippe.Scene(egg, friction=tippe.Viscous(0.3)), launch, t1=5.0, tolerance=1e-6)
    >>> print(f"it stands within 0.05 pi after {time:.1f} s")
    it stands within 0.05 pi after 2.4 s

    ```
    """

    units: ClassVar[dict[str, str]] = {"mass": "kg", "equatorial": "m", "polar": "m", "I1": "kg m2", "I3": "kg m2"}
    units |= {"offset": "m"}

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    equatorial: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    polar: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    I1: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    I3: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    offset: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0, metadata=Bound.NOT_NEGATIVE)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        yield Bound(self.offset, "offset", below=self.polar, why="the centre of mass lies inside the spheroid")

    @property
    def meridian(self) -> "SpheroidMeridian":
        square = self.equatorial * self.equatorial
        excess = self.polar * self.polar - square
        return SpheroidMeridian(square, excess, self.offset, self.mass / self.I1)

    @property
    def size(self) -> Float[Array, "..."]:
        return jnp.maximum(self.equatorial, self.polar)


class SpheroidMeridian(AbstractMeridian):
    """H = q - a c with q^2 = b^2 + (p^2 - b^2) c^2, b and p the half axes.

    `square`: b^2; `excess`: p^2 - b^2 [m^2]; `offset`: a [m]; `per_inertia`: m / I1 [1/m^2].
    """

    square: Float[Array, "..."]
    excess: Float[Array, "..."]
    offset: Float[Array, "..."]
    per_inertia: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        squared = self.square + self.excess * cosine * cosine
        per_height = 1.0 / jnp.sqrt(squared)
        offset = self.offset - self.excess * cosine * per_height
        radius = self.square * per_height
        growth = -self.excess * radius / squared
        return ContactGeometry(offset, radius, self.per_inertia * offset, growth)


class ConvexBody(AbstractBody):
    """A convex body of revolution, given by its support function, for the same scenes as a `SpheroidBody`.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `support`: function of c = cos(theta), the height [m] of the centre of mass above a plane that the body touches
      while its axis is inclined by theta: R - a c for a sphere, sqrt(b^2 + (p^2 - b^2) c^2) for a spheroid. Write it
      with `jax.numpy`, twice differentiable, positive, and convex: both radii of curvature, H - c H' and H - c H' + (1
      - c^2) H'', must be positive, which is checked at 65 inclinations. If it is an `equinox.Module`, its numbers are
      parameters of the scene.
    - `I1`, `I3`: moments of inertia about the centre of mass [kg m^2], across the axis and along it, positive, I3 <= 2 I1.

    **Raises:** `ValueError` for numbers outside these ranges, or an illegal support function.

    **Example:** an egg whose blunt end points down at theta = 0.

    ```
    >>> import jax.numpy as jnp, tippe
    >>> def support(c):
    ...     return jnp.sqrt(4e-4 + 3.84e-4 * c * c) - 1e-3 * c * (1.0 + c * c)
    >>> egg = tippe.ConvexBody(mass=0.05, support=support, I1=1.2e-5, I3=8e-6)
    >>> print(f"{egg.meridian.at(0.0).radius:.3f} m")
    0.020 m

    ```
    """

    units: ClassVar[dict[str, str]] = {"mass": "kg", "I1": "kg m2", "I3": "kg m2"}

    mass: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    support: Any = eqx.field(converter=lambda value: as_function(value, "support", ("c",)))
    I1: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)
    I3: Float[Array, "..."] = eqx.field(converter=as_number, metadata=Bound.POSITIVE)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        height, radius, meridian = (jnp.min(part, axis=0) for part in self._samples())
        yield Bound(height, "least support", above=0.0, why="the centre of mass lies inside the body")
        for radius_part in (radius, meridian):
            yield Bound(radius_part, "least radius of curvature by support", above=0.0, why="the body is convex")

    def _samples(self) -> tuple[Float[Array, "samples ..."], ...]:
        """Height and the two radii of curvature at the checked inclinations [m]."""

        def sample(cosine: Float[Array, ""]) -> tuple[Float[Array, "..."], ...]:
            lever = self.meridian.at(cosine)
            return self.support(cosine), lever.radius, lever.radius - (1.0 - cosine * cosine) * lever.growth

        return jax.vmap(sample)(jnp.cos(jnp.linspace(0.0, jnp.pi, SAMPLES)))

    @property
    def meridian(self) -> "SupportMeridian":
        return SupportMeridian(self.support, self.mass / self.I1)

    @property
    def size(self) -> Float[Array, "..."]:
        return jnp.max(self._samples()[0], axis=0)


class SupportMeridian(AbstractMeridian):
    """The contact geometry by differentiation of the support function; `per_inertia`: m / I1 [1/m^2]."""

    support: Callable[[Float[Array, "..."]], Float[Array, "..."]]
    per_inertia: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        cosine = as_number(cosine)
        unit = jnp.ones_like(cosine)

        def slope(c: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
            height, along = jax.jvp(self.support, (c,), (unit,))
            return along, height

        rise, bend, height = jax.jvp(slope, (cosine,), (unit,), has_aux=True)
        return ContactGeometry(-rise, height - cosine * rise, -self.per_inertia * rise, -bend)
