"""The normal force while a top rises, for spins up to the first jump."""

from typing import Any

import numpy as np

import tippe


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    times = np.linspace(0.0, 7.0, 3501)
    table = tippe.trajectory_table(
        scene, theta=0.1, spin=[180.0, 150.0, 120.0], times=times, quantities=["normal_force"], tolerance=1e-6
    )
    figure = table.plot("normal_force")
    figure.axes[0].axhline(float(top.mass * scene.gravity), color="0.5", linewidth=0.8)
    return figure


if __name__ == "__main__":
    draw().savefig("contact_forces.png", dpi=150)
