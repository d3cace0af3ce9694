"""Poles and limits of the top: launches and scenes at the ends of their legal range."""

import math
from collections.abc import Callable

import numpy as np
from measure import timed

import tippe
from hard.row import Row


def rutstam_top() -> tippe.Top:
    """Rutstam's top (SIGMA 8 (2012) 019) with I1 = 131/350 m R^2."""
    return tippe.Top(0.02, 0.02, 0.006, 131.0 / 350.0 * 8e-6, 3.2e-6)


def upright_exactly() -> Row:
    """theta(0) = 0: the axis stays on the normal, an unstable equilibrium that round-off must not leave."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    run = timed(lambda: tippe.inversion_table(scene, theta=0.0, spin=155.0, t1=100.0), 1)
    table = run.result
    ended = float(table.end_theta) if np.isinf(table.time) and np.isfinite(table.end_theta) else math.nan
    return Row(
        "theta(0) = 0 exactly, 155 rad/s, 100 s",
        "never leaves",
        ended,
        0.0,
        "theta = 0 [rad]",
        int(table.steps),
        run.cpu,
        str(table.status),
    )


def rows() -> list[Callable[[], Row]]:
    """The rows of this file, in the order of the table."""
    return [upright_exactly]
