"""The rides of a block of cells of a table through stick and slip."""

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.lockstep import GUARD_LOST, RUNNING
from nonholonomic.phases import AbstractPhase, Journey, Passage, travel

from ..inversion import ABSOLUTE, InversionProblem
from ..scene import Scene
from .motion import COARSEST, Kind, StickSlip, started

#: The numbers of the two phases.
SLIPPING, ROLLING = range(2)


class StickSlipPhase(AbstractPhase):
    """Slipping or rolling up to an angle of theta."""

    kind: Kind
    cos_angle: Float[Array, "..."]
    scales: Float[Array, "components cells"]

    def problem(self, state: Float[Array, "components cells"]) -> InversionProblem:
        return InversionProblem(self.kind, self.cos_angle, state, self.scales)

    def leave(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Passage:
        """Stick, slip, or end where the contact is lost. Counted is how often a slip has turned into rolling."""
        after, rolls, lost = self.kind.ended(state)
        nothing = jnp.zeros_like(left)
        return Passage(
            phase=jnp.where(rolls, ROLLING, SLIPPING),
            state=after,
            elapsed=nothing,
            status=jnp.where(lost, GUARD_LOST, RUNNING),
            crossing_time=nothing + jnp.inf,
            counts=(rolls & ~lost & (not self.kind.rolls)).astype(int)[None],
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
    phases = tuple(StickSlipPhase(Kind(both, rolls), problem.cos_angle, problem.scales) for rolls in (False, True))
    states, rolls = started(both, problem.states)
    rtol = min(tolerance, COARSEST)
    return travel(
        phases,
        np.where(np.asarray(rolls), ROLLING, SLIPPING),
        np.asarray(states),
        t1,
        count,
        rtol,
        ABSOLUTE * rtol,
        kinds=1,
        solver=solver,
        passes=last,
    )
