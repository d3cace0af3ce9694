"""Rides inside a spheroid from above: free, and with friction."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import stroller


def draw() -> Any:
    """The picture, a matplotlib figure."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    launch = stroller.Launch(place=(0.0, -0.8), heading=0.3, speed=5.0, steering=0.1)
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.5), layout="constrained")
    for damping, ax in zip((0.0, 1.0), axes, strict=True):
        scene = stroller.Scene(body, stroller.Spheroid(6.0, 3.0), stroller.Damping(damping), side="inside")
        ride = stroller.simulate(scene, launch, 30.0, times=np.linspace(0.0, 30.0, 3001), tolerance=1e-7)
        ride.portrait("position.x", "position.y", ax=ax)
        ax.set(aspect="equal", title=f"damping {damping:g} N s/m")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("bowl_rides.png", dpi=150)
