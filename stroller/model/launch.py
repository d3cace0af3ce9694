"""Launches: how a ride starts."""

import math
from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.parameters import as_one
from nonholonomic.validation import IN_DEGREES, Bound, Bounded, as_number, largest, shown


def as_launch(value: Any) -> Any:
    """A list of launches as one `Launch` whose numbers are lists; anything else stays unchanged, for later checks."""
    return as_one(value, "launch", Launch)


#: Largest usual angles [rad]: a front wheel that turns by half a turn, and a heading after two turns.
USUAL = {"steering": math.pi, "heading": 4.0 * math.pi}


def as_place(value: Any) -> Any:
    """Two or three numbers as a tuple of arrays; anything else stays unchanged, for later checks."""
    try:
        numbers = tuple(value)
    except TypeError:
        return value
    return tuple(as_number(number) for number in numbers)


def suspected_degrees(module: Bounded) -> str | None:
    """The suspicion that an angle of a module, of those that have usual values, is in degrees; `None` if none is."""
    for name, limit in USUAL.items():
        if (magnitude := largest(getattr(module, name, None))) > limit:
            return f"{name} = {magnitude:g} rad is large{IN_DEGREES.format(f'{magnitude:g}')}"
    return None


#: Speeds above this [m/s] suggest kilometres per hour.
FASTEST = 60.0


class Launch(Bounded):
    """A launch: position of the rear axle, heading, speed and steering.

    **Arguments:**

    - `place`: position on the surface. On a plane, paraboloid or graph, (x, y) [m], which on a tilted plane are
      measured along the plane. On a sphere or spheroid, azimuth and reduced latitude [rad]. On a torus, azimuth and
      angle about the tube [rad]. On a cylinder, distance along the axis [m] and angle from the lowest line [rad]. Any
      surface also accepts (x, y, z) [m] in the fixed frame.
    - `heading`: angle psi [rad] of the heading from the surface's east towards its north: from x towards y on a plane.
      The projected heading of the paper is the angle theta [rad] of its horizontal projection from x towards y.
    - `speed`: speed v [m/s] of the rear axle along the heading, negative in reverse; the horizontal speed where the
      heading is projected.
    - `steering`: angle phi [rad] of the front wheel, positive to the driver's left.
    - `steering_rate`: rate phi' of the steering angle [rad/s].

    **Raises:** `ValueError` for numbers that are not finite, or a place that does not have two or three numbers.

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

    place: tuple[Float[Array, "..."], ...] = eqx.field(converter=as_place)
    heading: Float[Array, "..."] = eqx.field(converter=as_number)
    speed: Float[Array, "..."] = eqx.field(converter=as_number)
    steering: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    steering_rate: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def __check_init__(self):
        if not (isinstance(self.place, tuple) and len(self.place) in (2, 3)):
            raise ValueError(f"place = {shown(self.place)} must be a pair of numbers, or (x, y, z) [m]")

    def suspicion(self) -> str | None:
        fastest = largest(self.speed)
        if fastest > FASTEST:
            return f"speed = {fastest:g} m/s is fast: was it in km/h? {fastest:g} km/h are {fastest / 3.6:.4g} m/s"
        return suspected_degrees(self)

    def bounds(self) -> Iterator[Bound]:
        for k, number in enumerate(self.place):
            yield Bound(number, f"place[{k}]")
        for name in ("heading", "speed", "steering", "steering_rate"):
            yield Bound(getattr(self, name), name)
