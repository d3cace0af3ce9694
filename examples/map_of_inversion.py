"""A map of inversion times on a plane, with the border from Jellett's constant."""

from typing import Any

import numpy as np

import tippe
from tippe import steady


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    theta, spin = np.linspace(0.02, 1.2, 63), np.linspace(30.0, 180.0, 64)
    figure = tippe.inversion_table(scene, theta=theta, spin=spin, t1=12.0, tolerance=1e-6).plot()
    _, threshold = steady.jellett_thresholds(scene)
    border = float(threshold / top.I3) / (0.02 * np.cos(theta) - 0.006)
    figure.axes[0].plot(theta, border, "r--", linewidth=1.0)
    figure.axes[0].set_ylim(30.0, 180.0)
    return figure


if __name__ == "__main__":
    draw().savefig("map_of_inversion.png", dpi=150)
