"""A single run through stick and slip, with its path."""

from nonholonomic.hybrid import HybridPath, solve_hybrid_dense
from nonholonomic.integration import Settings

from ..modes.sticking import contact_modes
from ..modes.trajectory_problem import TrajectoryProblem


def solve_stick_slip_dense(run: TrajectoryProblem, t1: float, settings: Settings) -> HybridPath:
    """One run, mode by mode, until `t1` or until contact is lost.

    **Arguments:**

    - `run`: a run in a scene with `SetValuedCoulomb`.
    - `t1`, `settings`: as for `follow`.

    **Returns:** a `HybridPath`, whose counts include the changes from slip to rolling.
    """
    modes, first, state = contact_modes(run, settings.tolerance)
    return solve_hybrid_dense(modes, int(first[0]), state[:, 0], t1, settings, counters=1)
