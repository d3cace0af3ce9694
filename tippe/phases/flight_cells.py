"""The rides of a block of cells of a table through flights and impacts."""

import diffrax
import numpy as np

from nonholonomic.integration import Journey, Settings, travel

from ..inversion import InversionProblem
from ..scene import Scene
from .free_body import balls
from .sliding import first_ball, phases


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

    - `scene`: with `contact="hybrid"`, its numbers scalars or one per cell.
    - `problem`: of the scene and its launches, all of them, of which the first `count` are to be run.
    - `t1`, `tolerance`, `solver`: as for `inversion_table`; `last` is whether the last crossing counts.

    **Returns:** a `Journey`, whose counts are the flights.
    """
    return travel(
        phases(scene, problem.scales, problem.cos_angle, last),
        np.asarray(first_ball(balls(scene.body), problem.states)),
        np.asarray(problem.states),
        t1,
        count,
        Settings(tolerance, solver),
        kinds=1,
        passes=last,
    )
