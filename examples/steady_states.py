"""Steady states of a top: inclination over Jellett's constant, with solid lines for stable states."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe
from tippe import steady


def draw() -> Any:
    """The plot, a matplotlib figure."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    theta = np.linspace(1e-3, np.pi - 1e-3, 400)
    motion = steady.tumbling(scene, theta)
    stable = np.asarray(steady.tumbling_is_stable(scene, theta))
    low, high = (float(threshold) for threshold in steady.jellett_thresholds(scene))
    figure, ax = plt.subplots(figsize=(6.0, 4.2), layout="constrained")
    ax.plot(np.where(stable, motion.jellett, np.nan), theta, "C0")
    ax.plot(np.where(stable, np.nan, motion.jellett), theta, "C0:")
    for angle, edges in ((0.0, ((0.0, low), (low, 2.0 * high))), (np.pi, ((high, 2.0 * high), (0.0, high)))):
        for line, edge in zip(("C0-", "C0:"), edges, strict=True):
            ax.plot(edge, (angle, angle), line)
    ax.set(xlabel="Jellett's constant [kg m³/s]", ylabel="θ [rad]", xlim=(0.0, 1.6 * high))
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("steady_states.png", dpi=150)
