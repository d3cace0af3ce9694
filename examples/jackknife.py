"""A stroller pushed backwards with a free fork: it jackknifes, and continues forwards."""

from typing import Any

import numpy as np

import stroller


def draw() -> Any:
    """The plot, a matplotlib figure."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    scene = stroller.Scene(body, fork="absolute")
    launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=-2.0, steering=0.02, steering_rate=0.06)
    ride = stroller.simulate(scene, launch, 4.0, times=np.linspace(0.0, 4.0, 2001), tolerance=1e-7)
    figure = ride.portrait("position.x", "position.y")
    times = ", ".join(f"{time:.2f} s" for time in ride.jackknifed_at)
    figure.axes[0].set(aspect="equal", title=f"jackknifed at {times}" if times else "it does not jackknife")
    return figure


if __name__ == "__main__":
    draw().savefig("jackknife.png", dpi=150)
