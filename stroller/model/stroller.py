"""The body: a rigid frame on two rear wheels, with one front wheel in a fork that steers."""

from collections.abc import Iterator
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.geometry import none_if_zero
from nonholonomic.validation import Bound, Bounded, as_number, largest

#: A wheelbase above this [m], more than any vehicle's, suggests millimetres or centimetres.
LONGEST = 20.0


class Stroller(Bounded):
    """A stroller: wheels without mass or width, the steering axis through the front wheel's contact point.

    **Arguments:**

    - `mass`: mass [kg], positive.
    - `wheelbase`: distance l [m] from the middle of the rear axle to the front contact point, positive.
    - `inertia`: moment of inertia J [kg m^2] in yaw about the middle of the rear axle, positive.
    - `steering_inertia`: moment of inertia J_f [kg m^2] of the fork about the steering axis, positive.
    - `steering_spring`: stiffness [N m/rad] of a spring that pulls the fork straight, at least 0.
    - `centre`: distance b [m] of the centre of mass ahead of the rear axle, in [0, `wheelbase`], which loads the front
      wheel. `inertia` must be at least `mass` b^2. The equations hold for b > 0 on a plane.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    Stroller(mass=12 kg, wheelbase=0.7 m, inertia=1.5 kg m², steering_inertia=0.05 kg m²)

    ```
    """

    units: ClassVar[dict[str, str]] = {
        "mass": "kg",
        "wheelbase": "m",
        "inertia": "kg m2",
        "steering_inertia": "kg m2",
        "steering_spring": "N m rad-1",
        "centre": "m",
    }

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    wheelbase: Float[Array, "..."] = eqx.field(converter=as_number)
    inertia: Float[Array, "..."] = eqx.field(converter=as_number)
    steering_inertia: Float[Array, "..."] = eqx.field(converter=as_number)
    steering_spring: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None)
    centre: Float[Array, "..."] | None = eqx.field(converter=none_if_zero, default=None)

    def suspicion(self) -> str | None:
        longest = largest(self.wheelbase)
        if longest <= LONGEST:
            return None
        unit, metres = ("mm", longest / 1e3) if longest > 10.0 * LONGEST else ("cm", longest / 1e2)
        return f"wheelbase = {longest:g} m is long: was it in {unit}? {longest:g} {unit} are {metres:g} m"

    def bounds(self) -> Iterator[Bound]:
        for name in ("mass", "wheelbase", "inertia", "steering_inertia"):
            yield Bound(getattr(self, name), name, above=0.0)
        if self.steering_spring is not None:
            yield Bound(self.steering_spring, "steering_spring", at_least=0.0)
        if self.centre is not None:
            yield Bound(self.centre, "centre", at_least=0.0)
            yield Bound(self.centre, "centre", at_most=self.wheelbase, why="the wheelbase")
            min_inertia = self.mass * self.centre**2
            yield Bound(
                self.inertia, "inertia", at_least=min_inertia, why="mass centre^2, as it is about the rear axle"
            )
