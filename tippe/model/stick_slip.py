"""Stick and slip under exact Coulomb friction: both kinds of motion, their ends, and the motion that follows.

Within the friction cone, rolling is the only motion near zero slip, and a slip reaches zero in finite time. There the
direction of the slip has no limit, and steps shrink with the slip speed. Therefore an impulse stops the slip when the
remaining sliding distance, v^2 / (2 |v'|), is `LEFT` times the tolerance in units of R. Friction would have given the
same impulse in the remaining time, so the error of the state is of the order of this distance, and proportional to the
tolerance. Rolling ends where mu N = |F_t|; there a separate step begins the slip (`slip_onset.py`), with an estimated
error within the tolerance (`tests/physics/test_stick_slip.py`).
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.compilation.xla_cpu import greatest
from nonholonomic.geometry import AbstractFrame

from .contact_dynamics import FITS, NO_LOAD, AbstractDynamics, Motion, carries_no_load
from .contact_load import Slip
from .dynamics import Dynamics
from .friction import AbstractFriction, Frictionless, SetValuedCoulomb, length
from .rigid_body import AbstractRigidBody
from .rigid_dynamics import RigidRolling, RigidSlipping
from .rolling import RollingDynamics
from .slip_onset import Onset, slip_onset
from .top import Top

#: The remaining sliding distance at which a slip is stopped, over the tolerance and the radius. The error of the state
#: is at most a tenth of the tolerance. The impulse comes too early by the speed over the deceleration: 8e-8 s at a
#: tolerance of 1e-11.
LEFT = 0.1

#: Slip speed, in units of sqrt(g R), below which a state counts as rolling; rounding errors leave a smaller speed. No
#: run depends on it; where a slip begins, the forces of both kinds of motion are equal in the limit.
AT_REST = 1e-10

#: Round-off allowed in the grip of rolling: a top that stands upright needs no grip. It delays a slip by this value
#: over the rate of the grip, about 1e-14 s.
ROUNDING = 1e-13


class StickSlip(AbstractDynamics):
    """The equations of motion of a scene with `SetValuedCoulomb`, in place of `Dynamics`.

    A state whose contact is at rest rolls; any other state slips.

    - `slipping`: the equations of motion under the full force; `rolling`: the equations without slip.
    - `mu`: coefficient of friction [1].
    """

    slipping: Dynamics | RigidSlipping
    rolling: RollingDynamics | RigidRolling
    mu: Float[Array, "..."]

    @classmethod
    def of(
        cls,
        body: Top | AbstractRigidBody,
        frame: AbstractFrame,
        friction: AbstractFriction,
        gravity: Float[Array, "..."],
    ) -> "StickSlip":
        """The equations for a body on an arena.

        **Arguments:** as for `Dynamics.of`, with a `SetValuedCoulomb`.
        """
        assert isinstance(friction, SetValuedCoulomb)
        if isinstance(body, AbstractRigidBody):
            arguments = (frame, body, gravity, body.inertia.tensor.inverse)
            return cls(RigidSlipping(*arguments, friction, 1.0 / body.mass), RigidRolling(*arguments), friction.mu)
        slipping = Dynamics.of(body, frame, friction, gravity)
        return cls(slipping, RollingDynamics.of(body, frame, gravity), friction.mu)

    @property
    def frame(self) -> AbstractFrame:
        """The frame of the body on the arena."""
        return self.slipping.frame

    @property
    def speed(self) -> Float[Array, "..."]:
        """The speed sqrt(g R) [m/s]."""
        return jnp.sqrt(self.slipping.gravity * self.rolling.size)

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of motion for the state's kind of motion.

        **Arguments:**

        - `state`: (8 + the arena's place, ...) as `tippe/model/dynamics.py` states it.

        **Returns:** a `Motion`.
        """
        slips = self.slip_speed(state) > AT_REST * self.speed
        kinds = (self.slipping.motion(state), self.rolling.motion(state))
        return jax.tree.map(lambda slipping, rolling: jnp.where(slips, slipping, rolling), *kinds)

    def margins(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], ...]:
        """Normal force as a fraction of the weight, plus a round-off allowance for a start with N = 0 exactly; and the
        remaining room, if the arena has places where the body does not fit."""
        motion = self.motion(state)
        margin = motion.normal_force / (self.slipping.mass * self.slipping.gravity) + NO_LOAD
        return (margin,) if motion.room is None else (margin, motion.room - FITS)

    def loss(self, state: Float[Array, "components ..."]) -> Int[Array, "..."]:
        """How a contact with zero margin has ended: a code in `LOSSES`. Only a slipping contact can jam."""
        return self.slipping.loss(state)

    def slip_speed(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Speed of the contact point along the arena [m/s]."""
        slip = self.slipping.motion(state).slip
        return length(slip.x, slip.y)

    def normal_spin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Angular velocity of a rigid body about the arena's normal [rad/s]."""
        return self.rolling.angular_velocity(state)[2]

    def stopped(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """The state after the impulse that stops the slip, with the body's axes at unit length.

        Step errors change this length, so the slip after the impulse would be as large as these errors; but
        where a slip begins, its direction tolerates only rounding errors.
        """
        zero = jnp.zeros_like(state[0])
        return self.rolling.with_slip(self.rolling.with_unit_axes(state), Slip(zero, zero))

    def lifts_off(self, state: Float[Array, "components ..."]) -> Bool[Array, "..."]:
        """Whether a contact at rest separates at once: without a force at the contact point, the arena would have to
        pull.

        Unless the contact jams, the normal force has the same sign for the ending roll, for the following slip and
        without friction.
        """
        return dataclasses.replace(self.slipping, friction=Frictionless()).motion(state).normal_force <= 0.0

    def grip_left(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """The reserve of a rolling top before it slips, as a fraction of the weight."""
        return self.rolling.grip(state, self.mu) + ROUNDING


class Change(NamedTuple):
    """The transition at the end of a mode.

    - `state`: the state that follows, and whether it `rolls`; `lost`: whether the contact is lost instead.
    - `onset`: the beginning of the slip if the top does not roll; it starts `wait` [s] after the mode has ended.
    - `elapsed`: time until the motion continues [s].
    """

    state: Float[Array, "components ..."]
    rolls: Bool[Array, "..."]
    lost: Bool[Array, "..."]
    onset: Onset
    wait: Float[Array, "..."]
    elapsed: Float[Array, "..."]


class ContactMode(AbstractDynamics):
    """One of the two kinds of motion of a `StickSlip`, in place of `Dynamics`; its contact margin falls to zero at its
    end.

    - `stick_slip`: the equations of the scene; `tolerance`: relative tolerance of the integration.
    - `rolls`: whether the top rolls or slips.
    """

    stick_slip: StickSlip
    tolerance: Float[Array, ""]
    rolls: bool = eqx.field(static=True)

    @property
    def frame(self) -> AbstractFrame:
        """The frame of the body on the arena."""
        return self.stick_slip.frame

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """The equations of motion of this kind."""
        return (self.stick_slip.rolling if self.rolls else self.stick_slip.slipping).motion(state)

    def margins(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], ...]:
        """Positive while this kind of motion lasts. Rolling leaves the friction cone before the normal force
        vanishes."""
        if self.rolls:
            grip, room = self.stick_slip.grip_left(state), self.stick_slip.rolling.motion(state).room
            return (grip,) if room is None else (grip, room - FITS)
        return (*self.stick_slip.slipping.margins(state), self.slip_left(state))

    def unloaded(
        self, state: Float[Array, "components ..."], scales: Float[Array, "components ..."]
    ) -> Bool[Array, "..."]:
        """See `AbstractDynamics.unloaded`."""
        return carries_no_load(self, self.stick_slip.slipping.weight, state, scales)

    def normal_spin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """As `StickSlip.normal_spin`."""
        return self.stick_slip.normal_spin(state)

    def slip_left(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Excess of the slip speed over the speed at which a slip ends, in units of sqrt(g R). A slip that grows does
        not end."""
        speed, change = self._slowing(state)
        way = LEFT * self.tolerance * self.stick_slip.rolling.size
        return (speed - jnp.sqrt(2.0 * way * greatest(-change, 0.0))) / self.stick_slip.speed

    def _slowing(self, state: Float[Array, "components ..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The slip's speed [m/s] and its rate."""
        return jax.jvp(self.stick_slip.slip_speed, (state,), (self.stick_slip.slipping.field(state),))

    def loss(self, state: Float[Array, "components ..."]) -> Int[Array, "..."]:
        """How a contact with zero margin has ended: a code in `LOSSES`."""
        return self.stick_slip.loss(state)

    def ended(
        self,
        state: Float[Array, "components ..."],
        size: int,
        slipping: Callable[[Float[Array, "components ..."]], Float[Array, "components ..."]],
        scales: Float[Array, "components ..."],
        left: Float[Array, "..."],
    ) -> Change:
        """The change that follows the end of this kind of motion.

        **Arguments:**

        - `state`: (components, ...), at zero margin; the equations use the first `size` components.
        - `slipping`: rate of the whole state during slip; `scales`: its magnitudes.
        - `left`: time [s] to the horizon; the beginning of a slip is not longer.
        """
        stick_slip, core_state, quadratures = self.stick_slip, state[:size], state[size:]
        stopped_state = stick_slip.stopped(core_state)
        zero = jnp.zeros_like(core_state[0])
        if self.rolls:
            sticks = zero > 0.0
            # The mode ended because of the grip or the room, or there was no contact to begin with, as after an impact.
            room, lost = stick_slip.rolling.motion(core_state).room, stick_slip.lifts_off(stopped_state)
            lost |= self.unloaded(core_state, scales[:size])
            lost = lost if room is None else lost | (room - FITS <= stick_slip.grip_left(core_state))
            wait = zero
        else:
            sticks = stick_slip.rolling.grip(stopped_state, stick_slip.mu) >= 0.0
            lost = stick_slip.slipping.contact_margin(core_state) <= self.slip_left(core_state)
            # A slip that reverses continues through zero, which it reaches in its remaining time. A slip along which the
            # force of rolling pulls does not reverse: it begins anew.
            speed, change = self._slowing(core_state)
            slip, (F1, F2, _) = stick_slip.slipping.motion(core_state).slip, stick_slip.rolling.reaction(stopped_state)
            reverses = (change < 0.0) & (slip.x * F1 + slip.y * F2 > 0.0)
            wait = jnp.where(reverses & ~sticks & ~lost, -speed / jnp.where(reverses, change, 1.0), 0.0)
            wait = jnp.minimum(wait, left)
            stopped_state = stopped_state + wait * stick_slip.rolling.field(
                stopped_state + 0.5 * wait * stick_slip.rolling.field(stopped_state)
            )
            quadratures = quadratures + wait * slipping(state)[size:]
            # Until then, the force of rolling may have returned into the friction cone.
            sticks = stick_slip.rolling.grip(stopped_state, stick_slip.mu) >= 0.0
        new_state = jnp.concatenate([stopped_state, quadratures])
        slips = ~(sticks | lost)
        max_duration = jnp.where(slips, left - wait, 0.0)
        laws = (stick_slip.slipping, stick_slip.rolling, stick_slip.mu)
        onset = slip_onset(*laws, slipping, new_state, size, scales, max_duration, self.tolerance)
        state_after = jnp.where(slips, onset.end, jnp.where(lost, state, new_state))
        return Change(state_after, sticks, lost, onset, wait, wait + jnp.where(slips, onset.length, 0.0))
