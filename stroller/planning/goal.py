"""What a plan must achieve, and what it must not exceed."""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.validation import Bound, Bounded, as_number, as_number_or_none, shown

from ..model.launch import as_place, suspected_degrees

#: A bound [any unit] that nothing reaches.
UNLIMITED = 1e9

#: The greatest steering angle [rad] of plans without a limit of their own.
MOST_STEERING = 1.2


class Goal(Bounded):
    """Where a plan ends, and how fast.

    **Arguments:**

    - `place`: position of the rear axle, in the surface's coordinates, as in `Launch`.
    - `heading`: angle [rad] of the heading, as in `Launch`; `None` for any heading.
    - `speed`: speed [m/s] of the rear axle, negative in reverse.
    - `within`: greatest error at the end: of the place [m], of the heading [rad] and of the speed [m/s]; positive.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Goal(place=(1.9, 0.3), heading=0.0)
    Goal(place=(1.9, 0.3) m or rad, heading=0 rad, speed=0 m/s, within=0.05)

    ```
    """

    units: ClassVar[dict[str, str]] = {"place": "m or rad", "heading": "rad", "speed": "m s-1", "within": "1"}

    place: tuple[Float[Array, ""], ...] = eqx.field(converter=as_place)
    heading: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    speed: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    within: Float[Array, ""] = eqx.field(converter=as_number, default=0.05)

    def __check_init__(self):
        if not (isinstance(self.place, tuple) and len(self.place) in (2, 3)):
            raise ValueError(f"place = {shown(self.place)} must be a pair of numbers, or (x, y, z) [m]")

    def suspicion(self) -> str | None:
        return suspected_degrees(self)

    def bounds(self) -> Iterator[Bound]:
        for k, number in enumerate(self.place if isinstance(self.place, tuple) else ()):
            yield Bound(number, f"place[{k}]")
        if self.heading is not None:
            yield Bound(self.heading, "heading")
        yield Bound(self.speed, "speed")
        yield Bound(self.within, "within", above=0.0)


def as_range(value: Any) -> Any:
    """A bound as the pair (-bound, bound); a pair and `None` stay as they are."""
    if value is None:
        return None
    try:
        return tuple(as_number(number) for number in tuple(value))
    except TypeError:
        bound = as_number(value)
        return (-bound, bound) if isinstance(bound, Array) else value


class Limits(Bounded):
    """The ranges that a plan must not leave, each a pair (low, high) or one number b for (-b, b); `None` for no limit.
    A plan may exceed a limit by 0.001 of its range, so that a limit can be the very value at the start or at the goal, as
    in `speed=(0.0, 0.8)` for a plan that never reverses.

    **Arguments:**

    - `steering`: steering angle [rad]; by default, plans steer by at most 1.2 rad.
    - `speed`: speed [m/s] of the rear axle.
    - `force`: drive force [N].
    - `torque`: steering torque [N m].
    - `grip`: coefficient of friction that the tyres need.

    **Raises:** `ValueError` if a range is empty or not made of numbers.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Limits(steering=1.0, speed=(-0.5, 0.8))
    Limits(steering=(-1, 1) rad, speed=(-0.5, 0.8) m/s)

    ```
    """

    units: ClassVar[dict[str, str]] = {"steering": "rad", "speed": "m s-1", "force": "N", "torque": "N m", "grip": "1"}

    steering: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    speed: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    force: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    torque: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    grip: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)

    def __check_init__(self):
        for name in self.units:
            value = getattr(self, name)
            if value is not None and not (isinstance(value, tuple) and len(value) == 2):
                raise ValueError(f"{name} = {shown(value)} must be a bound, such as 1.0, or a pair (low, high)")

    def suspicion(self) -> str | None:
        return suspected_degrees(self)

    def bounds(self) -> Iterator[Bound]:
        for name in self.units:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) == 2:
                yield Bound(value[0], f"{name}[0]")
                yield Bound(value[1], f"{name}[1]", above=value[0], why="the lower bound")

    def ranges(self) -> dict[str, tuple[float, float]]:
        """The limits by name; those that are `None` are left out."""
        pairs = {name: getattr(self, name) for name in self.units}
        return {name: (float(pair[0]), float(pair[1])) for name, pair in pairs.items() if pair is not None}

    def arrays(self, reserve: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all quantities, narrowed by a share of each range.

        **Arguments:** `reserve`: the share.
        """
        free = {"steering": (-MOST_STEERING, MOST_STEERING)}
        ranges = {name: (-UNLIMITED, UNLIMITED) for name in self.units} | free | self.ranges()
        low, high = np.array([ranges[name] for name in self.units]).T
        narrowed = reserve * (high - low) / 2.0
        return low + narrowed, high - narrowed
