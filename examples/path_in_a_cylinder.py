"""The path of a top's centre inside a cylinder, and its inclination, for a start at the wall."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, surface=tippe.Cylinder(0.3), friction=tippe.Viscous(0.3))
    times = np.linspace(0.0, 8.0, 4001)
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0, eta=1.2), t1=8.0, times=times, tolerance=1e-6)
    figure, ax = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    dots = ax.scatter(run.position[:, 1], run.eta, c=run.theta, s=2.0, vmin=0.0, vmax=np.pi)
    figure.colorbar(dots, label="θ [rad]")
    ax.set(xlabel="y along the axis of the cylinder [m]", ylabel="η [rad]")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("path_in_a_cylinder.png", dpi=150)
