"""The body: an eccentric sphere whose mass is symmetric about the axis through its two centres."""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Vector
from nonholonomic.validation import Bound, Bounded, as_number, is_traced, require, shown
from nonholonomic.warning import warn

from .body import AbstractBody, Round
from .turned import Shape

#: Units that are often used for moments of inertia by mistake, in kg m^2.
INERTIAS = {"kg cm^2": 1e-4, "kg mm^2": 1e-6, "g cm^2": 1e-7, "g mm^2": 1e-9}

#: Least density of the material of a turned top that is not suspicious [kg/m^3].
LEAST_DENSITY = 50.0
#: A mean density [kg/m^3] above that of osmium.
GREATEST_DENSITY = 23_000.0
#: The radius [m] above which another unit is suspected, and the plausible range of I1 / (m R^2).
GREATEST_RADIUS = 1.0
RATIOS = (0.1, 2.0)


class Stem(Bounded):
    """The rounded end of a stem: a second sphere on which a top can touch the plane (`tippe.md`, section 4).

    **Arguments:**

    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of its centre from the centre of mass, along e [m], positive.

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

    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.radius, "stem radius", above=0.0)
        yield Bound(self.offset, "stem offset", above=0.0)


class Top(AbstractBody):
    """A tippe top: a sphere with its centre of mass off its centre, symmetric about the axis e, with or without a stem.

    The centre of mass lies at -`offset` e from the sphere's centre, where e is the direction of the stem.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `radius`: radius of the sphere [m], positive.
    - `offset`: distance of the centre of mass from the sphere's centre [m], at least 0 and less than `radius`.
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

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number)
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)
    stem: Stem | None = None

    @classmethod
    def turned(
        cls,
        radius: Any,
        density: Any = None,
        *,
        mass: Any = None,
        cut: Any,
        stem_radius: Any,
        stem_length: Any,
        hole_radius: Any = 0.0,
        hole_depth: Any = 0.0,
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
          flat.
        - `stem_radius`: radius of the stem, which is a cylinder that ends in a half ball.
        - `stem_length`: length of the stem above the flat.
        - `hole_radius`, `hole_depth`: a hole drilled from the flat around the stem; the stem stands on the bottom of
          the hole.

        **Returns:** a `Top`.

        **Raises:** `ValueError` for a shape that cannot be turned, whose centre of mass lies above the centre of the
        sphere, or whose rim would touch the table before its stem; and unless there is one of `density` and `mass`.

        The formulas are the integrals over thin discs (Landau and Lifshitz, Mechanics, section 32), in `tippe/model/turned.py`.

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
                f"{min_density:g} g/cm^3 are {1e3 * min_density:g} kg/m^3"
            )
        lengths = {"radius": radius, "cut": cut, "stem_radius": stem_radius, "stem_length": stem_length}
        shape = Shape.checked(lengths | {"hole_radius": hole_radius, "hole_depth": hole_depth})
        moments = shape.moments
        offset = -moments.first / moments.volume
        reason = "the centre of mass lies above the centre of the sphere: shorten the stem, or drill a hole around it"
        require(offset, "offset", at_least=0.0, why=reason)
        transverse = moments.transverse - moments.volume * offset**2
        stem = Stem(shape.stem_radius, shape.tip + offset)
        density = as_number(density) if mass is None else as_number(mass) / moments.volume
        return cls(density * moments.volume, shape.radius, offset, density * transverse, density * moments.axial, stem)

    def __check_init__(self):
        if self.stem is not None and not isinstance(self.stem, Stem):
            raise ValueError(f"stem = {shown(self.stem)} must be a Stem")

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        yield Bound(self.radius, "radius", above=0.0)
        yield Bound(self.offset, "offset", at_least=0.0)
        yield Bound(self.offset, "offset", below=self.radius, why="the centre of mass lies inside the sphere")
        yield from self.inertia_bounds()
        if self.stem is not None:
            reach = self.offset + jnp.abs(self.radius - self.stem.radius)
            yield Bound(self.stem.offset, "stem offset", above=reach, why="neither sphere lies within the other")

    @property
    def meridian(self) -> Round:
        return Round(self.offset, self.radius, self.mass * self.offset / self.I1)

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

    @property
    def offset_of_path(self) -> Float[Array, "..."]:
        return self.offset

    def mass_from_frame(self, axis: Vector) -> Vector:
        return (-self.offset * axis[0], -self.offset * axis[1], -self.offset * axis[2])

    def path_from_frame(self, axis: Vector) -> Vector:
        # The frame moves with the centre of the sphere, whose path is also reported.
        return (None, None, None)

    def suspicion(self) -> str | None:
        numbers = (self.mass, self.radius, self.I1)
        if any(is_traced(number) or not isinstance(number, jax.Array) for number in numbers):
            return None
        mass, radius, I1 = (np.asarray(number, dtype=float) for number in numbers)
        max_radius = float(np.max(radius))
        if max_radius > GREATEST_RADIUS:
            unit = "mm" if max_radius > 10.0 else "cm"
            return f"radius = {max_radius:g} m is large for a top: was it in {unit}?"
        ratios = I1 / (mass * radius**2)
        odd_ratios = np.ravel(ratios[(ratios < RATIOS[0]) | (ratios > RATIOS[1])])
        if odd_ratios.size:
            ratio = float(odd_ratios[0])
            mistakes = {f"I1 in {unit}": factor for unit, factor in INERTIAS.items()} | {"the mass in g": 1e3}
            suspects = [mistake for mistake, factor in mistakes.items() if RATIOS[0] <= ratio * factor <= RATIOS[1]]
            question = f"was {suspects[0]}?" if suspects else "are mass, radius and I1 in kg, m and kg m^2?"
            return f"I1 = {ratio:.3g} m R^2 is out of the range {RATIOS} of bodies like a top: {question}"
        if np.all(mass < GREATEST_DENSITY * 4.0 / 3.0 * np.pi * radius**3):
            return None
        heaviest, smallest = float(np.max(mass)), float(np.min(radius))
        return (
            f"mass = {heaviest:g} kg in a sphere of radius {smallest:g} m is denser than any metal: was it in g? "
            f"{heaviest:g} g are {heaviest / 1e3:g} kg"
        )
