"""The interface of the equations of motion of a body in contact, and how a contact ends."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import least
from nonholonomic.geometry import Component, Tangent, multiply, stacked
from nonholonomic.integration.status import Status

from .contact_load import ContactLoad, Slip

#: Value of `Motion.painleve_factor` at which a contact counts as jammed. N grows as its inverse, and the factor falls
#: to zero as the square root of the remaining time, so a run ends too early by about 1e-4 s times the square of this
#: value. In `tests/physics/test_strong_friction.py`, this is 1e-12 s, and 1e-10 s with ten times the value; there, the
#: error of theta is 5e-13, and that of velocities 1e-4.
JAMMED = 1e-4

#: Value of `Motion.room` at which the ball no longer fits, because a curvature of the arena reaches 1/R. There the foot
#: moves as the square root of the remaining time, so a run ends too early by about 0.1 s times the square of this
#: value.
FITS = 1e-4

#: Normal force as a fraction of the weight that round-off leaves of N = 0.
NO_LOAD = 1e-12

#: How far a motion is followed, as a fraction of the state's magnitudes, to see whether a contact without load gains one.
AHEAD = 1e-3

#: The ways in which a contact can end; the index is the code of the word.
LOSSES = (Status.CONTACT_LOST, Status.JAMMED, Status.DOES_NOT_FIT)


class Motion(NamedTuple):
    """The result of the equations of motion for one state, with all vectors in the moving frame.

    `painleve_factor` is the factor of N in its equation, 1 + m a A in `tippe.md`, section 2: 1 without an offset, and 0
    if friction pulls the top down as strongly as N pushes it up. `velocity` is that of the point with which the frame
    moves. `room` is positive where the ball fits, `None` if it fits everywhere.
    """

    rate: tuple[Component, ...]
    normal_force: Float[Array, "..."]
    friction: ContactLoad
    slip: Slip
    velocity: Tangent
    frame_rate: Tangent
    spin_momentum: Float[Array, "..."]
    painleve_factor: Float[Array, "..."]
    room: Component

    @property
    def friction_power(self) -> Component:
        """Power of friction N (f.v_s + tau.w) [W], at most 0; `None` without friction."""
        return multiply(self.normal_force, self.friction.power(self.slip))


class AbstractDynamics(eqx.Module):
    """Equations of motion, with the precomputed combinations of a scene's numbers; they hold while all margins are
    positive."""

    @abc.abstractmethod
    def motion(self, state: Float[Array, "components ..."]) -> Any:
        """Evaluate the equations of motion.

        **Arguments:** `state`: as `state.py` describes it.

        **Returns:** a `Motion`, or at least the `rate` of one.
        """

    @abc.abstractmethod
    def margins(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], ...]:
        """The smooth functions whose least value is the contact margin."""

    def unloaded(
        self, state: Float[Array, "components ..."], scales: Float[Array, "components ..."]
    ) -> Bool[Array, "..."] | None:
        """A mask of the states whose contact carries no load and is about to carry none; `None` if the contact margin
        alone decides."""
        return None

    def field(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """Rate of change of the state, (components, ...)."""
        return stacked(self.motion(state).rate, state)

    def contact_margin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """The least of `margins`."""
        return least(*self.margins(state))


class AbstractContactDynamics(AbstractDynamics):
    """Equations of motion of a body on a single contact, which ends as one of `LOSSES`."""

    @property
    @abc.abstractmethod
    def weight(self) -> Float[Array, "..."]:
        """Weight of the body [N]."""

    def margins(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], ...]:
        """The margin for each of `LOSSES`: the normal force as a fraction of the weight, plus a round-off allowance for
        a start with N = 0; the excess of the Painlevé factor over `JAMMED`; and the excess of the room over `FITS`, if
        the arena has places where the ball does not fit."""
        motion = self.motion(state)
        lost, jammed = motion.normal_force / self.weight + NO_LOAD, motion.painleve_factor - JAMMED
        return (lost, jammed) if motion.room is None else (lost, jammed, motion.room - FITS)

    def unloaded(
        self, state: Float[Array, "components ..."], scales: Float[Array, "components ..."]
    ) -> Bool[Array, "..."]:
        """See `AbstractDynamics.unloaded`."""
        return carries_no_load(self, self.weight, state, scales)

    def loss(self, state: Float[Array, "components ..."]) -> Int[Array, "..."]:
        """How a contact with zero margin has ended: a code in `LOSSES`."""
        lost, *others = self.margins(state)
        # At the located end, the margin is round-off of either sign; if another margin has vanished, N is many times
        # the weight.
        return len(others) - jnp.argmin(jnp.stack([*others[::-1], jnp.maximum(lost, 0.0)]), axis=0)


def carries_no_load(
    dynamics: AbstractDynamics,
    weight: Float[Array, "..."],
    state: Float[Array, "components ..."],
    scales: Float[Array, "components ..."],
) -> Bool[Array, "..."]:
    """A mask of the states with N = 0, up to round-off, whose motion does not increase N.

    On a wall the first derivative of N may vanish too; so the state moves on by the midpoint rule, by the part `AHEAD`
    of the magnitudes `scales`, to see whether N grows.
    """
    state, scales = jnp.asarray(state), jnp.asarray(scales)
    motion = dynamics.motion(state)
    rate = stacked(motion.rate, state)
    fastest = jnp.max(jnp.abs(rate) / scales, axis=0)
    time = AHEAD / jnp.where(fastest > 0.0, fastest, 1.0)
    later = dynamics.motion(state + time * dynamics.field(state + 0.5 * time * rate))
    return (jnp.abs(motion.normal_force) <= NO_LOAD * weight) & ~(later.normal_force > NO_LOAD * weight)
