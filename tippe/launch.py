"""How a run starts."""

import math
from collections.abc import Iterator
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.validation import Bound, Bounded, as_number


class Launch(Bounded):
    """A start with the angular velocity along the axis, w = spin e, and the centre at rest.

    **Arguments:**

    - `theta`: angle [rad] from the arena's normal to the axis, in [0, pi]; 0 is stem out, pi is stem in.
    - `spin`: angular velocity about the axis [rad/s].
    - `eta`: angle [rad] of the place from the arena's lowest point, in [-pi, pi].
    - `azimuth`: direction [rad] in which the axis leans, from growing eta towards y.

    **Raises:** `ValueError` for numbers outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Launch(theta=0.1, spin=155.0)
    Launch(theta=0.1 rad, spin=155 rad/s, eta=0 rad, azimuth=0 rad)

    ```
    """

    units: ClassVar[dict[str, str]] = {"theta": "rad", "spin": "rad s-1", "eta": "rad", "azimuth": "rad"}

    theta: Float[Array, "..."] = eqx.field(converter=as_number)
    spin: Float[Array, "..."] = eqx.field(converter=as_number)
    eta: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    azimuth: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.theta, "theta", at_least=0.0, at_most=math.pi)
        yield Bound(self.spin, "spin")
        yield Bound(self.eta, "eta", at_least=-math.pi, at_most=math.pi)
        yield Bound(self.azimuth, "azimuth")
