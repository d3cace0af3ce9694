"""A top that is so fast that it leaves the ground while it rises: its height in each flight."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.0)
    run = tippe.simulate(scene, tippe.Launch(theta=0.1, spin=200.0), t1=6.0, tolerance=1e-6)
    close = run.at(np.linspace(4.7, 5.5, 4001))
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 4.6), layout="constrained", sharex=True)
    axes[0].plot(close.t, 1e6 * (close.position[:, 2] - float(top.radius)), linewidth=0.8)
    axes[0].set(ylabel="above the ground [µm]", title=f"{len(run.hops)} flights in all")
    axes[1].plot(close.t, close.normal_force, linewidth=0.8)
    axes[1].set(xlabel="time [s]", ylabel="normal force [N]")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("flights.png", dpi=150)
