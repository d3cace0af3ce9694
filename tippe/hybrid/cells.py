"""Inversion times through flights and impacts, for a block of cells of a table."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np

from nonholonomic.lockstep import CROSSED, FAILED, REACHED_END
from nonholonomic.phases import UNRESOLVED, Journey, travel

from ..dynamics import COS_THETA
from ..inversion import ABSOLUTE
from ..launch import Launch
from ..scene import Scene
from .free_body import balls
from .sliding import first_ball, phases


def hybrid_cells(
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
    """The variables of an inversion table of hybrid scenes.

    **Arguments:** as for `inversion_table`; `scene` and `launch` hold scalars or one number per cell, `last` is whether the
    last crossing counts, `size` the number of cells, of which the first `count` are to be run.

    **Returns:** name -> values, one for each cell; `status` numbers the words of `HYBRID_WORDS`.
    """
    journey = ride(scene, launch, t1, angle, tolerance, last, solver, size, count)
    crossed = journey.status == CROSSED
    if last:
        above = journey.state[COS_THETA] <= np.cos(angle)
        crossed = (journey.status == REACHED_END) & above & np.isfinite(journey.crossing_time)
    others = {FAILED: 3, UNRESOLVED: 4}
    status = np.select([crossed, *(journey.status == code for code in others)], [0, *others.values()], 1)
    return {
        "time": np.where(crossed, journey.crossing_time, np.inf),
        "status": status.astype(np.int8),
        "end_time": journey.end_time,
        "end_theta": np.asarray(scene.theta(jnp.asarray(journey.state))),
        "steps": journey.steps,
        "rejected": journey.rejected,
        "hops": journey.counts[0],
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
    """Run every cell through its phases. **Arguments:** as for `hybrid_cells`. **Returns:** a `Journey`."""

    def per_cell(values: Any) -> Any:
        return jnp.broadcast_to(values.reshape(values.shape[0], -1), (values.shape[0], size))

    state, scales = per_cell(scene.state(launch)), per_cell(scene.scales(launch))
    spheres = balls(scene.body)
    cos_angle = jnp.cos(angle)
    return travel(
        phases(scene, scales, cos_angle, last),
        np.asarray(first_ball(spheres, state)),
        np.asarray(state),
        t1,
        count,
        tolerance,
        ABSOLUTE * tolerance,
        kinds=1,
        solver=solver,
        passes=last,
    )
