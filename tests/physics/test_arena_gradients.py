"""Derivatives of inversion times on arenas that are neither plane nor of constant curvature."""

import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe

#: Arenas, and a place from which the top turns over within some seconds.
ARENAS = [
    pytest.param(tippe.Graph(lambda x, y: x * x + 0.9 * y * y), (-0.05, 0.02), id="Graph"),
    pytest.param(tippe.Paraboloid(0.25), (0.05, 0.02), id="Paraboloid"),
    pytest.param(tippe.Spheroid(0.5, 0.4), (0.4, 0.05), id="Spheroid"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("arena", "place"), ARENAS)
def test_the_slope_of_a_time_is_that_of_differences(arena, place):
    """By the spin, against central differences extrapolated from two steps, of the steps the one at which they agree best."""
    side = "inside" if isinstance(arena, tippe.Spheroid) else None
    scene = tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3), side=side)
    steps = 0.3 / 4.0 ** np.arange(7)
    spin = 150.0 + np.concatenate([[0.0], steps, -steps])
    axes = {"launch.place[0]": place[0], "launch.place[1]": place[1], "launch.velocity[1]": 0.1}
    axes |= {"launch.velocity[0]": 0.0}
    table = tippe.inversion_table(
        scene, theta=0.2, spin=spin, t1=8.0, angle=0.8 * np.pi, axes=axes, tolerance=1e-11, sensitivities=["spin"]
    )
    assert (table.status == "inverted").all()
    differences = (table.time[1:8] - table.time[8:]) / (2.0 * steps)
    extrapolated = (16.0 * differences[1:] - differences[:-1]) / 15.0
    position = np.argmin(np.abs(np.diff(extrapolated)))
    assert_close(table.time_by_spin[0], extrapolated[position + 1], rtol=1e-6)
