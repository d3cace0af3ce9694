"""A single run through stick and slip, with its path."""

from nonholonomic.hybrid import PhasedPath, follow_phases
from nonholonomic.integration import Settings

from ..modes.stick_slip_runs import contact_phases
from ..modes.trajectory_problem import TrajectoryProblem


def follow_stick_slip(run: TrajectoryProblem, t1: float, settings: Settings) -> PhasedPath:
    """One run, phase by phase, until `t1` or until contact is lost.

    **Arguments:**

    - `run`: of a scene with `SetValuedCoulomb`.
    - `t1`, `settings`: as for `follow`.

    **Returns:** a `PhasedPath`, whose counts tell how often slipping has turned into rolling.
    """
    both, first, state = contact_phases(run, settings.tolerance)
    return follow_phases(both, int(first[0]), state[:, 0], t1, settings, kinds=1)
