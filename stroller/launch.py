"""How a run starts."""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.validation import Bound, Bounded, as_number


def as_pair(value: Any) -> Any:
    """A pair of numbers as a tuple of arrays; anything else is left for the check."""
    try:
        first, second = value
    except (TypeError, ValueError):
        return value
    return (as_number(first), as_number(second))


class Launch(Bounded):
    """A start: where the rear axle is, where the stroller heads, how fast it rolls and steers.

    **Arguments:**

    - `place`: (x, y) [m] on a plane, along the plane; (mu, eta) [rad], azimuth and reduced latitude, on a sphere or
      spheroid.
    - `heading`: angle psi [rad] of the heading from x towards y on a plane, from east towards north on a spheroid; the
      paper's projected heading is the angle theta [rad] of its horizontal projection from x towards y.
    - `speed`: speed v [m/s] of the rear axle along the heading, negative in reverse; the horizontal speed where the
      heading is projected.
    - `steering`: angle phi [rad] of the front wheel, positive to the driver's left.
    - `steering_rate`: its rate phi' [rad/s].

    **Raises:** `ValueError` for numbers that are not finite, or a place that is not a pair.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    Launch(place=(0, 0) m or rad, heading=0.3 rad, speed=2 m/s, steering=0 rad, steering_rate=0 rad/s)

    ```
    """

    units: ClassVar[dict[str, str]] = {
        "place": "m or rad",
        "heading": "rad",
        "speed": "m s-1",
        "steering": "rad",
        "steering_rate": "rad s-1",
    }

    place: tuple[Float[Array, "..."], Float[Array, "..."]] = eqx.field(converter=as_pair)
    heading: Float[Array, "..."] = eqx.field(converter=as_number)
    speed: Float[Array, "..."] = eqx.field(converter=as_number)
    steering: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    steering_rate: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def __check_init__(self):
        if not (isinstance(self.place, tuple) and len(self.place) == 2):
            raise ValueError(f"place = {self.place!r} must be a pair of numbers, (x, y) [m] or (mu, eta) [rad]")

    def bounds(self) -> Iterator[Bound]:
        for number, name in zip(self.place, ("place[0]", "place[1]"), strict=True):
            yield Bound(number, name)
        for name in ("heading", "speed", "steering", "steering_rate"):
            yield Bound(getattr(self, name), name)
