"""theta(t) of launches on both sides of Jellett's threshold."""

from typing import Any

import numpy as np

import tippe


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    times = np.linspace(0.0, 10.0, 1001)
    table = tippe.trajectory_table(scene, theta=0.1, spin=np.linspace(60.0, 160.0, 8), times=times, tolerance=1e-6)
    figure = table.plot("theta")
    figure.axes[0].set_yticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    return figure


if __name__ == "__main__":
    draw().savefig("fan_of_theta.png", dpi=150)
