"""The rides of a block of cells of a table through stick and slip."""

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration import CROSSED, GUARD_LOST, REACHED_END, RUNNING, AbstractPhase, Journey, Passage, travel

from ..inversion import ABSOLUTE, InversionProblem
from ..scene import Scene
from ..state import COS_THETA
from .stick_slip import AT_REST, Kind, StickSlip

#: The numbers of the two phases.
SLIPPING, ROLLING = range(2)


class StickSlipPhase(AbstractPhase):
    """Slipping or rolling up to an angle of theta; `last` is whether the last crossing of it counts."""

    kind: Kind
    cos_angle: Float[Array, "..."]
    scales: Float[Array, "components cells"]
    last: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> InversionProblem:
        return InversionProblem(self.kind, self.cos_angle, state, self.scales)

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Stick, slip, or end where the contact is lost. Counted is how often a slip has turned into rolling."""
        change = self.kind.ended(state, len(state), self.kind.both.slipping.field, self.scales, left)
        onset, length = change.onset, change.onset.length
        began = -change.wait / jnp.where(length > 0.0, length, 1.0)
        falls = (state[COS_THETA] > self.cos_angle) & (change.state[COS_THETA] <= self.cos_angle)
        crosses = falls & ~change.rolls & ~change.lost
        fraction = onset.falls_to(COS_THETA, self.cos_angle, began)
        crossing = change.wait + fraction * length
        ends = crosses & (not self.last)
        status = jnp.where(change.elapsed >= left, REACHED_END, RUNNING)
        status = jnp.where(change.lost, GUARD_LOST, jnp.where(ends, CROSSED, status))
        return Passage(
            phase=jnp.where(change.rolls, ROLLING, SLIPPING),
            state=jnp.where(ends, onset.at(fraction), change.state),
            elapsed=jnp.where(ends, crossing, change.elapsed),
            status=status,
            crossing_time=jnp.where(crosses, crossing, jnp.inf),
            counts=(change.rolls & ~change.lost & (not self.kind.rolls)).astype(int)[None],
        )


def ride(
    scene: Scene,
    problem: InversionProblem,
    t1: float,
    tolerance: float,
    last: bool,
    solver: diffrax.AbstractERK,
    count: int,
) -> Journey:
    """Run cells through their phases.

    **Arguments:**

    - `scene`: with `SetValuedCoulomb`, its numbers scalars or one per cell.
    - `problem`: of the scene and its launches, all of them, of which the first `count` are to be run.
    - `t1`, `tolerance`, `solver`: as for `inversion_table`; `last` is whether the last crossing counts.

    **Returns:** a `Journey`, whose counts tell how often slipping has turned into rolling.
    """
    both = scene.dynamics
    assert isinstance(both, StickSlip)
    kinds = (Kind(both, jnp.asarray(tolerance, float), rolls) for rolls in (False, True))
    phases = tuple(StickSlipPhase(kind, problem.cos_angle, problem.scales, last) for kind in kinds)
    rests = both.slip_speed(problem.states) <= AT_REST * both.speed
    return travel(
        phases,
        np.where(np.asarray(rests), ROLLING, SLIPPING),
        np.asarray(problem.states),
        t1,
        count,
        tolerance,
        ABSOLUTE * tolerance,
        kinds=1,
        solver=solver,
        passes=last,
    )
