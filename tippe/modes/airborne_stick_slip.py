"""Slipping, rolling and flying over any arena, the level plane included, under set-valued Coulomb friction.

Slipping and rolling are as in `sticking.py`, flight as in `airborne.py`, with the states and passive quadratures of
`airborne.py`.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nonholonomic.hybrid import Transition
from nonholonomic.integration import AbstractProblem
from nonholonomic.integration.status import LEFT_DOMAIN, RUNNING

from ..model.scene import Scene
from ..model.stick_slip import AT_REST, ContactMode, StickSlip
from ..model.top import Top
from .sticking import ROLLING as STICKS
from .sticking import StickSlipMode
from .airborne import FLYING, OWN, SLIDING, Fly, lift_off
from .flying_mode import AbstractFlyingMode
from .inversion_problem import InversionProblem
from .trajectory_problem import Quadratures

#: The numbers of the modes; flying has the same number as in `airborne.py`.
SLIPPING, ROLLING = SLIDING, 2


class Touch(AbstractFlyingMode):
    """Slipping or rolling on the arena; `last` is whether the last crossing of the angle counts."""

    kind: ContactMode
    last: bool = eqx.field(static=True)

    @property
    def contact_state(self) -> StickSlipMode:
        """The mode of runs that end where the contact is lost."""
        passive, size = (Quadratures(self.scene.body.I3), OWN) if self.with_quadratures else (None, None)
        return StickSlipMode(self.kind, self.cos_angle, self.scales, self.last, passive, size)

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        return self.contact_state.problem(state)

    def shown(self, state: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
        return _at_no_distance(self.contact_state.shown(state))

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "21 times"]:
        return _at_no_distance(self.contact_state.between(motion, passed))

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Stick, slip, or fly where the contact is lost. Counts flights, and changes from slip to rolling."""
        transition = self.contact_state.reset_map(state, left)
        state_after = transition.state
        if self.kind.rolls:
            state_after = jnp.concatenate(
                [self.kind.stick_slip.rolling.carried_along(state_after[:OWN]), state_after[OWN:]]
            )
        flies = (transition.status == LEFT_DOMAIN) & (self.kind.loss(state_after[:OWN]) == 0)
        mode = jnp.where(transition.mode == STICKS, ROLLING, SLIPPING)
        return transition._replace(
            mode=jnp.where(flies, FLYING, mode),
            state=jnp.where(flies, lift_off(self.scene, state_after, self.with_quadratures), transition.state),
            status=jnp.where(flies, RUNNING, transition.status),
            counts=jnp.concatenate([flies.astype(int)[None], transition.counts]),
        )


class Land(Fly):
    """Flying over the arena, to a contact that slips or rolls."""

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Strike the arena; then rebound, or continue to slip or roll."""
        transition, stick_slip = super().reset_map(state, left), self.scene.dynamics
        assert isinstance(stick_slip, StickSlip)
        rests = stick_slip.slip_speed(transition.state[:OWN]) <= AT_REST * stick_slip.speed
        mode = jnp.where(rests, ROLLING, SLIPPING)
        counts = jnp.concatenate([transition.counts, jnp.zeros_like(transition.counts)])
        return transition._replace(mode=jnp.where(transition.mode == FLYING, FLYING, mode), counts=counts)


def airborne_stick_slip_modes(
    scene: Scene[Top], problem: InversionProblem, tolerance: float, last: bool, with_quadratures: bool = False
) -> tuple[tuple[AbstractFlyingMode, ...], Int[Array, " cells"]]:
    """The modes of runs, and the index of the mode in which each starts. **Arguments:** as for `sliding.modes`."""
    stick_slip, arguments = problem.dynamics, (scene, problem.scales, problem.cos_angle, with_quadratures)
    assert isinstance(stick_slip, StickSlip)
    slips, rolls = (
        Touch(*arguments, ContactMode(stick_slip, jnp.asarray(tolerance, float), rolls_first), last)
        for rolls_first in (False, True)
    )
    rests = stick_slip.slip_speed(problem.states[:OWN]) <= AT_REST * stick_slip.speed
    return (slips, Land(*arguments), rolls), jnp.where(rests, ROLLING, SLIPPING)


def _at_no_distance(rows: Float[Array, "19 times"]) -> Float[Array, "21 times"]:
    """The output rows of states in contact."""
    return jnp.concatenate([rows, jnp.zeros_like(rows[:2])])
