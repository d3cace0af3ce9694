"""Phase portraits, theta' over theta, of three launches."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.6), layout="constrained")
    for spin, ax in zip((70.0, 100.0, 155.0), axes, strict=True):
        run = tippe.simulate(scene, tippe.Launch(0.3, spin), t1=8.0, tolerance=1e-6)
        run.at(np.linspace(0.0, float(run.end_time), 4001)).portrait(ax=ax)
        ax.set_title(f"spin {spin:g} rad/s")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("phase_portraits.png", dpi=150)
