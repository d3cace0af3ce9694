"""Inversion times through stick and slip, for a block of cells of a table."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.lockstep import CROSSED, FAILED, GUARD_LOST, REACHED_END, RUNNING
from nonholonomic.phases import UNRESOLVED, AbstractPhase, Journey, Passage, travel

from ..dynamics import COS_THETA
from ..inversion import ABSOLUTE, InversionProblem
from ..launch import Launch
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


def stick_slip_cells(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: float,
    tolerance: float,
    last: bool,
    solver: diffrax.AbstractERK,
    size: int,
    count: int,
) -> dict[str, Any]:
    """The variables of an inversion table of scenes with `SetValuedCoulomb`.

    **Arguments:** as for `inversion_table`; `scene` and `launch` hold scalars or one number per cell, `last` is whether the
    last crossing counts, `size` the number of cells, of which the first `count` are to be run.

    **Returns:** name -> values, one for each cell; `status` numbers the words of `STICK_SLIP_WORDS`.
    """
    journey = ride(scene, launch, t1, angle, tolerance, last, solver, size, count)
    crossed = journey.status == CROSSED
    if last:
        above = journey.state[COS_THETA] <= np.cos(angle)
        crossed = (journey.status == REACHED_END) & above & np.isfinite(journey.crossing_time)
    others = {GUARD_LOST: 2, FAILED: 3, UNRESOLVED: 4}
    status = np.select([crossed, *(journey.status == code for code in others)], [0, *others.values()], 1)
    return {
        "time": np.where(crossed, journey.crossing_time, np.inf),
        "status": status.astype(np.int8),
        "end_time": journey.end_time,
        "end_theta": np.asarray(scene.theta(jnp.asarray(journey.state))),
        "steps": journey.steps,
        "rejected": journey.rejected,
        "sticks": journey.counts[0],
    }


def ride(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: float,
    tolerance: float,
    last: bool,
    solver: diffrax.AbstractERK,
    size: int,
    count: int,
) -> Journey:
    """Run every cell through its phases. **Arguments:** as for `stick_slip_cells`. **Returns:** a `Journey`."""
    problem = InversionProblem.of(scene, launch, angle, size)
    both = problem.dynamics
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
