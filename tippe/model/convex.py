"""Bodies of revolution other than spheres: the spheroid, and any convex body that a support function describes.

Source of the support function: Bonnesen and Fenchel, Theorie der konvexen Koerper (1934), section 15; of the motion on a plane:
Moffatt and Shimomura, Nature 416 (2002) 385, and Moffatt, Shimomura and Branicki, Proc. R. Soc. A 460 (2004) 3643.
"""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import as_function
from nonholonomic.validation import Bound, as_number

from .body import AbstractBody, AbstractMeridian, ContactGeometry

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

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    equatorial: Float[Array, "..."] = eqx.field(converter=as_number)
    polar: Float[Array, "..."] = eqx.field(converter=as_number)
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)
    offset: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        yield Bound(self.equatorial, "equatorial", above=0.0)
        yield Bound(self.polar, "polar", above=0.0)
        yield Bound(self.offset, "offset", at_least=0.0)
        yield Bound(self.offset, "offset", below=self.polar, why="the centre of mass lies inside the spheroid")
        yield from self.inertia_bounds()

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

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    support: Any = eqx.field(converter=lambda value: as_function(value, "support", ("c",)))
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.mass, "mass", above=0.0)
        yield from self.inertia_bounds()
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

    support: Any
    per_inertia: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        cosine = as_number(cosine)
        unit = jnp.ones_like(cosine)

        def slope(c: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
            height, along = jax.jvp(self.support, (c,), (unit,))
            return along, height

        rise, bend, height = jax.jvp(slope, (cosine,), (unit,), has_aux=True)
        return ContactGeometry(-rise, height - cosine * rise, -self.per_inertia * rise, -bend)
