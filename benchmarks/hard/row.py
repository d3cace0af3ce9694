"""One hard case: what happened, how wrong it was, against what, and what it cost."""

import math
from typing import Any, NamedTuple

import numpy as np
from measure import Timed


class Row(NamedTuple):
    """A line of the table of hard cases.

    - `case`: the difficulty of the scene, with its numbers.
    - `happens`: what the simulator does.
    - `error`: the measured error, or the distance of a measured order from the one it should be.
    - `bound`: upper bound of the error, about ten times the error when the row was written.
    - `against`: the independent reference of the error, and its unit.
    - `steps`: accepted and rejected steps of one run.
    - `cpu`: CPU time of one run [s], compilation apart.
    - `status`: how the run ended, in the words of the result.
    """

    case: str
    happens: str
    error: float
    bound: float
    against: str
    steps: int
    cpu: float
    status: str

    @property
    def ok(self) -> bool:
        """Whether the error is a number within its bound."""
        return math.isfinite(self.error) and self.error <= self.bound

    def cells(self, name: str) -> dict[str, str]:
        """The row as text, for the table and the CSV."""
        return {
            "row": name,
            "case": self.case,
            "what happens": self.happens,
            "error": f"{self.error:.1e}",
            "bound": f"{self.bound:.1e}",
            "against": self.against,
            "steps": str(self.steps),
            "cpu ms": f"{1e3 * self.cpu:.3g}",
            "status": self.status,
            "ok": "yes" if self.ok else "NO",
        }


def of_table(case: str, happens: str, error: Any, bound: float, against: str, run: Timed) -> Row:
    """The row of a table of one or more cells: the steps of all of them, the status of the first."""
    table = run.result
    steps, status = int(np.sum(table.steps)), str(np.ravel(table.status)[0])
    return Row(case, happens, float(error), bound, against, steps, run.cpu, status)


def of_runs(case: str, happens: str, error: Any, bound: float, against: str, run: Timed) -> Row:
    """The row of one or more trajectories: the steps of all of them, the status of the first."""
    runs = run.result if isinstance(run.result, list) else [run.result]
    steps = sum(trajectory.stats["accepted"] + trajectory.stats["rejected"] for trajectory in runs)
    return Row(case, happens, float(error), bound, against, steps, run.cpu, runs[0].status)
