"""What drives the stroller: a function of time and motion that gives the drive force and the steering torque.

Any function `(t, motion) -> (force, torque)` will do. It is called with arrays of any shape, one number per lane, so
write it with `jax.numpy` and without `if`. An `equinox.Module` may hold numbers to differentiate by.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple, TypeAlias

import equinox as eqx
from jaxtyping import Array, Float

from nonholonomic.geometry import Vector
from nonholonomic.validation import Bound, Bounded, as_number


class Motion(NamedTuple):
    """What an input may use of the stroller's state.

    `position` [m] of the rear axle and `heading` [1], a unit vector, are tuples of components in the ground's axes, the
    third `None` on a plane; `steering` [rad], `speed` [m/s] of the rear axle, `front_speed` [m/s] at which the front
    wheel rolls, `yaw_rate` [rad/s] and `steering_rate` [rad/s], positive to the driver's left.
    """

    position: Vector
    heading: Vector
    steering: Float[Array, "..."]
    speed: Float[Array, "..."]
    front_speed: Float[Array, "..."]
    yaw_rate: Float[Array, "..."]
    steering_rate: Float[Array, "..."]


Input: TypeAlias = Callable[[Float[Array, "..."], Motion], tuple[Float[Array, "..."], Float[Array, "..."]]]


class Steady(Bounded):
    """A constant drive force and steering torque.

    **Arguments:**

    - `force`: drive force [N] along the heading at the rear axle.
    - `torque`: torque [N m] of the frame on the fork, positive to the driver's left.
    """

    force: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)
    torque: Float[Array, "..."] = eqx.field(converter=as_number, default=0.0)

    def bounds(self) -> Iterator[Bound]:
        yield Bound(self.force, "force")
        yield Bound(self.torque, "torque")

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        return self.force, self.torque
