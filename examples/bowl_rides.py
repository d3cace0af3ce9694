"""Rides inside a spheroid, seen from above and steered to and fro: coasting, and pulled against friction."""

from typing import Any

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import stroller


def draw() -> Any:
    """The plot, a matplotlib figure."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    launch = stroller.Launch(place=(0.0, -0.8), heading=0.3, speed=3.0)
    times = np.linspace(0.0, 40.0, 4001)
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 4.5), layout="constrained")
    for force, damping, ax in zip((0.0, 6.0), (0.0, 2.0), axes, strict=True):
        scene = stroller.Scene(body, stroller.Spheroid(6.0, 3.0), stroller.Damping(damping), side="inside")

        def helm(t, motion, force=force):
            return force, 0.2 * jnp.sin(t) - motion.steering - 0.3 * motion.steering_rate

        ride = stroller.simulate(scene, launch, 40.0, helm, times=times, tolerance=1e-7)
        ride.portrait("position.x", "position.y", ax=ax)
        ax.set(aspect="equal", title=f"pulled with {force:g} N, damping {damping:g} N s/m")
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("bowl_rides.png", dpi=150)
