"""Slipping, rolling and flying over any arena, the level plane included, under Coulomb's law as it stands.

What slips and rolls is as in `stick_slip_runs.py`, what flies as in `airborne.py`; the states and what rides along are those of
the latter.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nonholonomic.hybrid import Passage
from nonholonomic.integration import GUARD_LOST, RUNNING, AbstractProblem

from ..model.scene import Scene
from ..model.stick_slip import AT_REST, Kind, StickSlip
from . import stick_slip_runs
from .airborne import FLYING, OWN, SLIDING, Fly, parted
from .flying_phase import AbstractFlyingPhase
from .inversion_problem import InversionProblem

#: The numbers of the phases; flying has that of `airborne.py`.
SLIPPING, ROLLING = SLIDING, 2


class Touch(AbstractFlyingPhase):
    """Slipping or rolling on the arena; `last` is whether the last crossing of the angle counts."""

    kind: Kind
    last: bool = eqx.field(static=True)

    @property
    def grounded(self) -> stick_slip_runs.StickSlipPhase:
        """The phase of runs that end where the contact is lost."""
        size = OWN if self.rides else None
        return stick_slip_runs.StickSlipPhase(self.kind, self.cos_angle, self.scales, self.last, self.axial, size)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        return self.grounded.problem(state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        return _at_no_distance(self.grounded.shown(state))

    def between(self, motion: tuple[Array, ...], passed: Float[Array, " times"]) -> Float[Array, "21 times"]:
        return _at_no_distance(self.grounded.between(motion, passed))

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Stick, slip, or fly where the contact is lost. It counts flights, and changes from slip to rolling."""
        there = self.grounded.leave(state, left)
        whole = there.state
        if self.kind.rolls:
            whole = jnp.concatenate([self.kind.both.rolling.carried_along(whole[:OWN]), whole[OWN:]])
        flies = (there.status == GUARD_LOST) & (self.kind.loss(whole[:OWN]) == 0)
        phase = jnp.where(there.phase == stick_slip_runs.ROLLING, ROLLING, SLIPPING)
        return there._replace(
            phase=jnp.where(flies, FLYING, phase),
            state=jnp.where(flies, parted(self.scene, whole, self.rides), there.state),
            status=jnp.where(flies, RUNNING, there.status),
            counts=jnp.concatenate([flies.astype(int)[None], there.counts]),
        )


class Land(Fly):
    """Flying over the arena, to a contact that slips or rolls."""

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Strike the arena; rebound, or slip or roll on."""
        there, both = super().leave(state, left), self.scene.dynamics
        assert isinstance(both, StickSlip)
        rests = both.slip_speed(there.state[:OWN]) <= AT_REST * both.speed
        phase = jnp.where(rests, ROLLING, SLIPPING)
        counts = jnp.concatenate([there.counts, jnp.zeros_like(there.counts)])
        return there._replace(phase=jnp.where(there.phase == FLYING, FLYING, phase), counts=counts)


def phases(
    scene: Scene, problem: InversionProblem, tolerance: float, last: bool, rides: bool = False
) -> tuple[tuple[AbstractFlyingPhase, ...], Int[Array, " cells"]]:
    """The phases of runs, and the number of that in which each starts. **Arguments:** as for those of `sliding.py`."""
    both, given = problem.dynamics, (scene, problem.scales, problem.cos_angle, rides)
    assert isinstance(both, StickSlip)
    slips, rolls = (Touch(*given, Kind(both, jnp.asarray(tolerance, float), one), last) for one in (False, True))
    rests = both.slip_speed(problem.states[:OWN]) <= AT_REST * both.speed
    return (slips, Land(*given), rolls), jnp.where(rests, ROLLING, SLIPPING)


def _at_no_distance(shown: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
    """What a path shows of states in contact."""
    return jnp.concatenate([shown, jnp.zeros_like(shown[:2])])
