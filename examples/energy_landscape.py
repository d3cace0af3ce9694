"""The least energy of a top with a given Jellett constant; friction moves a top down to the minimum."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe
from tippe import steady


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    theta = np.linspace(0.0, np.pi, 401)
    weight = float(top.mass * scene.gravity * top.radius)
    figure, ax = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
    for spin in (25.0, 40.0, 60.0, 80.0, 110.0):
        jellett = float(top.I3) * spin * (0.02 - 0.006)
        ax.plot(theta, np.asarray(steady.effective_energy(scene, theta, jellett)) / weight, label=f"{spin:g} rad/s")
    ax.set(xlabel="θ [rad]", ylabel="least energy / m g R", yscale="log")
    ax.set_xticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    ax.set_yticks([1.0, 2.0, 3.0, 4.0, 6.0], ["1", "2", "3", "4", "6"])
    ax.minorticks_off()
    ax.legend(title="spin at θ = 0")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("energy_landscape.png", dpi=150)
