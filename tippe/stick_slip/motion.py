"""Stick and slip under Coulomb's law as it stands: the two kinds of motion, when each ends, and what follows.

Within the friction cone rolling is the only motion near zero slip, and a slip reaches zero in finite time. The direction of
a slip has no limit there, and steps shrink with its speed; so the slip is stopped by a blow where its speed has fallen to
`STICK_SPEED`. Friction would have taken the same momentum in the short time that was left, and the state errs in second
order of that speed. A slip begins where rolling would need `EXCESS` more friction than there is, with the speed that has
gathered since the cone was left; the state errs in third order of that time (`tests/physics/test_sticking.py` has the
figures).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nonholonomic.surface import AbstractSurface

from ..dynamics import Dynamics, Motion, stacked
from ..friction import AbstractFriction, SetValuedCoulomb, Slip, length
from ..rolling import RollingDynamics
from ..top import Top

#: Slip speed, in units of sqrt(g R), at which a slip is over.
STICK_SPEED = 1e-7

#: Friction that rolling lacks, as a fraction of the weight, where it turns into a slip.
EXCESS = 1e-4

#: By how much the least slip that begins is faster than one that is over.
FASTER = 10.0

#: Coarser relative tolerances are taken for this one: with them steps would leap over the end of a slip, to and fro.
COARSEST = 1e-7

#: What a slip has gathered is trusted up to this age, in units of sqrt(R / g).
OLDEST = 0.1


class StickSlip(eqx.Module):
    """The equations of motion of a scene with `SetValuedCoulomb`, in place of `Dynamics`.

    A state whose contact is at rest rolls, any other slips.

    - `slipping`: the equations of motion under the full force; `rolling`: those without slip.
    - `mu`: coefficient of friction [1].
    """

    slipping: Dynamics
    rolling: RollingDynamics
    mu: Float[Array, "..."]

    @classmethod
    def of(
        cls, body: Top, surface: AbstractSurface, friction: AbstractFriction, gravity: Float[Array, "..."]
    ) -> "StickSlip":
        """The equations for a body on an arena.

        **Arguments:** as for `Scene`, with a `SetValuedCoulomb`.
        """
        assert isinstance(friction, SetValuedCoulomb)
        slipping = Dynamics.of(body, surface, friction, gravity)
        return cls(slipping, RollingDynamics.of(body, surface, gravity), friction.mu)

    @property
    def parallel(self) -> AbstractSurface:
        """The surface on which the sphere's centre runs."""
        return self.slipping.parallel

    @property
    def speed(self) -> Float[Array, "..."]:
        """The speed sqrt(g R) [m/s]."""
        return jnp.sqrt(self.slipping.gravity * self.slipping.radius)

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """Evaluate the equations of the kind of motion that the state is in.

        **Arguments:**

        - `state`: (8 + the arena's place, ...) as `dynamics.py` states it.

        **Returns:** a `Motion`.
        """
        slips = self.slip_left(state) > -0.5 * STICK_SPEED
        kinds = (self.slipping.motion(state), self.rolling.motion(state))
        return jax.tree.map(lambda slipping, rolling: jnp.where(slips, slipping, rolling), *kinds)

    def field(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """Rate of change of the state, (components, ...)."""
        return stacked(self.motion(state).rate, state)

    def contact_margin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Normal force as a fraction of the weight, plus the round-off that a start with N = 0 exactly is allowed."""
        return self.motion(state).normal_force / (self.slipping.mass * self.slipping.gravity) + 1e-12

    def jams(self, state: Float[Array, "components ..."]) -> Bool[Array, "..."]:
        """Whether a contact whose margin is zero has jammed, which only one that slips can do; else it is lost."""
        return self.slipping.jams(state)

    def slip_left(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Slip speed above that at which a slip is over, in units of sqrt(g R)."""
        slip = self.slipping.motion(state).slip
        return length(slip.x, slip.y) / self.speed - STICK_SPEED

    def grip_left(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """What a rolling top has left before it slips, as a fraction of the weight."""
        return self.rolling.grip(state, self.mu) + EXCESS

    def settled(
        self, state: Float[Array, "components ..."]
    ) -> tuple[Float[Array, "components ..."], Bool[Array, "..."]]:
        """What becomes of a state whose slip is over, or that has rolled and cannot any longer.

        **Arguments:**

        - `state`: (components, ...), its slip at most a few times `STICK_SPEED`.

        **Returns:** the state from which the motion goes on, and whether it rolls.
        """
        nothing = jnp.zeros_like(state[0])
        still = self.rolling.with_slip(state, Slip(nothing, nothing))
        margin, rate = jax.jvp(
            lambda rolling: self.rolling.grip(rolling, self.mu), (still,), (self.rolling.field(still),)
        )
        holds = margin >= 0.0

        # The slip sets in against the force that is missing.
        F1, F2, _ = self.rolling.reaction(still)
        size = length(F1, F2)
        size = jnp.where(size > 0.0, size, 1.0)

        def slipping(speed: Float[Array, "..."]) -> Float[Array, "components ..."]:
            return self.rolling.with_slip(still, Slip(-speed * F1 / size, -speed * F2 / size))

        # Since the cone was left, a time ago, the slip's acceleration has grown from zero in proportion to that time.
        least = FASTER * STICK_SPEED * self.speed
        slow = slipping(least)
        _, acceleration = jax.jvp(self._slip_speed, (slow,), (self.slipping.field(slow),))
        leaving = (margin > -2.0 * EXCESS) & (rate < 0.0)
        age = jnp.where(leaving, margin / jnp.where(leaving, rate, 1.0), 0.0)
        age = jnp.minimum(age, OLDEST * self.slipping.radius / self.speed)
        gathered = jnp.maximum(0.5 * acceleration * age, least)
        return jnp.where(holds, still, slipping(gathered)), holds

    def _slip_speed(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        slip = self.slipping.motion(state).slip
        return length(slip.x, slip.y)


class Kind(eqx.Module):
    """One of the two kinds of motion of a `StickSlip`, in place of `Dynamics`: its contact margin is what ends it.

    - `both`: the scene's equations.
    - `rolls`: which of the two.
    """

    both: StickSlip
    rolls: bool = eqx.field(static=True)

    @property
    def parallel(self) -> AbstractSurface:
        """The surface on which the sphere's centre runs."""
        return self.both.parallel

    def motion(self, state: Float[Array, "components ..."]) -> Motion:
        """The equations of motion of this kind."""
        return (self.both.rolling if self.rolls else self.both.slipping).motion(state)

    def field(self, state: Float[Array, "components ..."]) -> Float[Array, "components ..."]:
        """Rate of change of the state, (components, ...)."""
        return stacked(self.motion(state).rate, state)

    def contact_margin(self, state: Float[Array, "components ..."]) -> Float[Array, "..."]:
        """Positive while this kind of motion lasts. Rolling leaves the friction cone before the normal force is zero."""
        if self.rolls:
            return self.both.grip_left(state)
        return jnp.minimum(self.both.slipping.contact_margin(state), self.both.slip_left(state))

    def jams(self, state: Float[Array, "components ..."]) -> Bool[Array, "..."]:
        """Whether a contact whose margin is zero has jammed; a rolling one does not."""
        return self.both.jams(state) & (not self.rolls)

    def ended(
        self, state: Float[Array, "components ..."]
    ) -> tuple[Float[Array, "components ..."], Bool[Array, "..."], Bool[Array, "..."]]:
        """What follows where this kind of motion has ended.

        **Arguments:**

        - `state`: (components, ...), where the margin is 0.

        **Returns:** the state from which the motion goes on, whether it rolls then, and whether it is the contact that was
        lost instead.
        """
        after, rolls = self.both.settled(state)
        if self.rolls:
            return after, rolls, jnp.zeros_like(rolls)
        lost = self.both.slipping.contact_margin(state) <= self.both.slip_left(state)
        return jnp.where(lost, state, after), rolls, lost


@eqx.filter_jit
def started(
    both: StickSlip, state: Float[Array, "components ..."]
) -> tuple[Float[Array, "components ..."], Bool[Array, "..."]]:
    """The start of a run: a contact at rest sticks or begins to slip.

    **Arguments:**

    - `both`: the scene's equations.
    - `state`: (components, ...).

    **Returns:** the state from which the run starts, and whether it rolls.
    """
    settled, rolls = both.settled(state)
    rests = both.slip_left(state) <= 0.0
    return jnp.where(rests, settled, state), rests & rolls
