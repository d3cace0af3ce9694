"""What drives the stroller: a function of time and motion that gives the drive force and the steering torque.

Any function `(t, motion) -> (force, torque)` will do. It is called with arrays of any shape, one number per lane, so
write it with `jax.numpy` and without `if`. An `equinox.Module` may hold numbers to differentiate by.
"""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
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


class Program:
    """The operations of a function; two programs are equal if they read the same, so that neither is compiled twice."""

    def __init__(self, jaxpr: Any):
        self.jaxpr = jaxpr
        self.text = str(jaxpr)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Program) and self.text == other.text

    def __hash__(self) -> int:
        return hash(self.text)


class Formula(eqx.Module):
    """A function as an input that is a module: the arrays it holds are leaves, and its operations are compared as such.

    So a function that is defined again, as in a notebook's cell, does not compile again.
    """

    held: tuple[Array, ...]
    program: Program = eqx.field(static=True)

    @classmethod
    def of(cls, controls: Input, t: Any, motion: Any) -> "Formula":
        """The formula of a function that can be called with scalars such as these, of which only the types count."""
        closed = jax.make_jaxpr(lambda *at: tuple(map(as_number, controls(*at))))(t, motion)
        return cls(tuple(closed.consts), Program(closed.jaxpr))

    def __call__(self, t: Float[Array, "..."], motion: Motion) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        leaves = jnp.broadcast_arrays(*jax.tree.leaves((t, motion)))
        run = jax.extend.core.jaxpr_as_fun(jax.extend.core.ClosedJaxpr(self.program.jaxpr, self.held))
        for _ in range(leaves[0].ndim):
            run = jax.vmap(run)
        force, torque = run(*leaves)
        return force, torque
