"""A rising egg: a prolate spheroid, spun while it lies, stands up if it is fast enough and does not jump."""

import math
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import tippe

MASS, EQUATORIAL, POLAR, MU = 0.05, 0.02, 0.028, 0.3
I1, I3 = MASS * (EQUATORIAL**2 + POLAR**2) / 5.0, 0.4 * MASS * EQUATORIAL**2
SPINS, RAISED = (35.0, 80.0, 140.0, 280.0), 0.1


def launch(turning: float) -> tippe.Launch:
    """Steady precession about the vertical, one end raised a little: (I3 w3 - I1 W c) W = -m g A."""
    theta = math.pi / 2.0 + RAISED
    c, egg = math.cos(theta), tippe.SpheroidBody(MASS, EQUATORIAL, POLAR, I1, I3)
    axial = I1 * turning * c - MASS * 9.81 * float(egg.meridian.at(c).offset) / turning
    return tippe.Launch(theta, axial / I3 - turning * c, angular_velocity=(0.0, 0.0, turning))


def fast_limit(times: Any) -> Any:
    """Moffatt and Shimomura's rise under viscous friction, in the limit of fast spin: tan(theta - pi/2) grows as exp(k
    t)."""
    k = 2.5 * MU * 9.81 * (POLAR**2 - EQUATORIAL**2) / (POLAR**2 + EQUATORIAL**2)
    return math.pi / 2.0 + np.arctan(math.tan(RAISED) * np.exp(k * times))


def draw() -> Any:
    """The plot, a matplotlib figure."""
    egg = tippe.SpheroidBody(MASS, EQUATORIAL, POLAR, I1, I3)
    scene = tippe.Scene(egg, friction=tippe.Viscous(MU))
    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.6), layout="constrained")
    for spin in SPINS:
        run = tippe.simulate(scene, launch(spin), t1=3.0, tolerance=1e-7)
        end = float(run.end_time)
        run = run.at(np.linspace(0.0, end, 1201))
        rows = (run.theta, run.jellett / run.jellett[0], run.normal_force / (MASS * 9.81))
        for ax, values in zip(axes, rows, strict=True):
            ax.plot(run.t, values, lw=1.0, label=f"{spin:g} rad/s{', jumps' * (run.status == 'contact_lost')}")
    times = np.linspace(0.0, 3.0, 301)
    axes[0].plot(times, fast_limit(times), "k--", lw=1.0, label="limit of great spin")
    for ax, label in zip(axes, ("theta [rad]", "Jellett's quantity / start", "normal force / weight"), strict=True):
        ax.set(xlabel="time [s]", ylabel=label)
    axes[0].legend(fontsize=8)
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("rising_egg.png", dpi=150)
