"""Runs with stick and slip: the cells of a table, and a single run with its path."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.hybrid import AbstractBatchedMode, Transition, TransitionPath
from nonholonomic.integration import AbstractProblem, ExtendedProblem
from nonholonomic.integration.status import CROSSED, LEFT_DOMAIN, REACHED_END, RUNNING

from ..model.dynamics import NO_COSINE
from ..model.scene import Scene
from ..model.slip_onset import Onset
from ..model.state import COS_THETA
from ..model.stick_slip import AT_REST, Change, ContactMode, StickSlip
from ..model.top import Top
from .inversion_problem import InversionProblem
from .trajectory_problem import Quadratures, TrajectoryProblem

#: The numbers of the two modes.
SLIPPING, ROLLING = range(2)


def contact_energy(
    scene: Scene[Top], state: Float[Array, "components cells"], number: Int[Array, " cells"]
) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    """The least and the greatest energy [J] that a state in a mode may have; here these are the same."""
    assert isinstance(scene.dynamics, StickSlip)
    rolls = scene.dynamics.rolling.carried_along(state)
    total = scene.energy(jnp.where(number == ROLLING, rolls, state))
    return total, total


class StickSlipMode(AbstractBatchedMode):
    """Slipping or rolling until theta reaches an angle; with `last`, the last crossing counts.

    For a single run whose path is kept, `passive` quadratures follow the first `size` components. For the cells of a
    table both are `None`. Without an angle, a run ends when the spin about the normal reverses; `spin` is the initial
    spin.
    """

    kind: ContactMode
    # An array, or `None`.
    cos_angle: Any
    scales: Float[Array, "components cells"]
    last: bool = eqx.field(static=True)
    passive: Quadratures | None = None
    size: int | None = eqx.field(static=True, default=None)
    spin: Float[Array, "..."] | None = None

    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        return self._under(self.kind, state)

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "components times"]:
        """The velocity of a rolling top follows from the other components of its state."""
        if not self.kind.rolls:
            return state
        core_state = self.kind.stick_slip.rolling.carried_along(state[: self._size(state)])
        return jnp.concatenate([core_state, state[self._size(state) :]])

    def between(self, motion: tuple[Onset, Array], passed: Float[Array, " times"]) -> Float[Array, "components times"]:
        onset, wait = motion
        return onset.at((passed - wait) / jnp.where(onset.length > 0.0, onset.length, 1.0))

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Stick, slip, or end if the contact is lost. Counts the changes from slip to rolling."""
        slipping = self._under(self.kind.stick_slip.slipping, state)
        change = self.kind.ended(state, self._size(state), lambda point: slipping.field(left, point), self.scales, left)
        onset, length = change.onset, change.onset.length
        wait_fraction = -change.wait / jnp.where(length > 0.0, length, 1.0)
        is_falling = (self._event(state) > 0.0) & (self._event(change.state) <= 0.0)
        if self.spin is None:
            crosses = is_falling & ~change.rolls & ~change.lost
            cosine = onset.of_components(slice(COS_THETA, COS_THETA + 1))
            fraction = cosine.falls_to_zero(lambda part: part[0] - self.cos_angle, wait_fraction)
        else:
            # The impulse that stops a slip changes the spin, too.
            crosses = is_falling & ~change.lost
            fraction = onset.falls_to_zero(self._event, wait_fraction)
        # Only a launch beyond the event, from which the top slips at once, reaches this point beyond the event.
        is_beyond = (self._event(state) <= 0.0) & (not self.last)
        crossing = jnp.where(is_beyond, 0.0, change.wait + fraction * length)
        crosses |= is_beyond
        ends = crosses & (not self.last)
        status = jnp.where(change.elapsed >= left, REACHED_END, RUNNING)
        status = jnp.where(change.lost, LEFT_DOMAIN, jnp.where(ends, CROSSED, status))
        return Transition(
            mode=jnp.where(is_beyond | change.lost, int(self.kind.rolls), jnp.where(change.rolls, ROLLING, SLIPPING)),
            state=jnp.where(is_beyond, state, jnp.where(ends, onset.at(fraction), change.state)),
            elapsed=jnp.where(ends, crossing, change.elapsed),
            status=status,
            crossing_time=jnp.where(crosses, crossing, jnp.inf),
            counts=(change.rolls & ~change.lost & ~is_beyond & (not self.kind.rolls)).astype(int)[None],
            record=None if self.passive is None else _recorded(change),
        )

    def _event(self, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        """The function whose fall to zero ends a run."""
        if self.spin is None:
            return state[COS_THETA] - self.cos_angle
        return self.kind.stick_slip.normal_spin(state[: self._size(state)]) / self.spin

    def _size(self, state: Float[Array, "components ..."]) -> int:
        """Number of components in the equations of motion."""
        return len(state) if self.size is None else self.size

    def _under(self, equations: Any, state: Float[Array, "components cells"]) -> AbstractProblem:
        """The motion from some states under given equations."""
        size = self._size(state)
        problem = InversionProblem(equations, self.cos_angle, state[:size], self.scales[:size], self.spin)
        if self.passive is None:
            return problem
        return ExtendedProblem(problem, self.passive, state[size:], self.scales[size:], ends_on_event=False)


def _recorded(change: Change) -> TransitionPath:
    """The beginning of a slip, if there is one."""
    ends = jnp.where(change.rolls | change.lost, jnp.inf, change.elapsed)
    motions = jax.tree.map(lambda leaf: leaf[None], (change.onset, change.wait))
    return TransitionPath(ends[None], motions, jnp.ones((1, len(ends)), int))


def stick_slip_modes(
    scene: Scene[Top] | None,
    problem: InversionProblem,
    tolerance: float,
    last: bool,
    passive: Quadratures | None = None,
    size: int | None = None,
) -> tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]:
    """The modes of runs, and the index of the mode in which each starts.

    **Arguments:**

    - `problem`: the problem of launches in a scene with `SetValuedCoulomb`.
    - `tolerance`: relative tolerance of the integration; `last`: whether the last crossing counts.
    - `passive`, `size`: as for `StickSlipMode`.
    """
    stick_slip = problem.dynamics
    assert isinstance(stick_slip, StickSlip)
    kinds = (ContactMode(stick_slip, jnp.asarray(tolerance, float), rolls) for rolls in (False, True))
    options = (problem.cos_angle, problem.scales, last, passive, size, problem.spin)
    both_modes = tuple(StickSlipMode(kind, *options) for kind in kinds)
    return both_modes, _first_mode(stick_slip, problem.states)


@compiled_setup
def _first_mode(stick_slip: StickSlip, states: Float[Array, "components cells"]) -> Int[Array, " cells"]:
    """The index of the mode in which each cell starts."""
    return jnp.where(stick_slip.slip_speed(states) <= AT_REST * stick_slip.speed, ROLLING, SLIPPING)


def contact_modes(
    run: TrajectoryProblem, tolerance: Any
) -> tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"], Float[Array, "components cells"]]:
    """The modes of runs whose path is kept, the index of each first mode, and the initial states.

    **Arguments:** `run`: one run, or the runs of some cells, in a scene with `SetValuedCoulomb`; `tolerance`: relative
    tolerance of the integration.
    """
    state, scales = (values if values.ndim == 2 else values[:, None] for values in run.start())
    problem = InversionProblem(run.problem.dynamics, jnp.asarray(NO_COSINE), state[: run.leading], scales)
    assert isinstance(run.passive, Quadratures)
    return (*stick_slip_modes(None, problem, tolerance, False, run.passive, run.leading), state)
