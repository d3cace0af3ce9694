"""Two strollers coast over hills from the same place with slightly different headings (needs the extra `view`)."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp

import stroller


def hills(x, y):
    """Height of the ground [m]."""
    return 0.3 * jnp.sin(0.8 * x) * jnp.sin(0.8 * y)


def draw() -> Any:
    """The page with both rides."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    scene = stroller.Scene(body, surface=stroller.Graph(hills), friction=stroller.Damping(1.0))
    launches = [stroller.Launch(place=(0.0, 0.0), heading=heading, speed=3.0) for heading in (0.6, 0.8)]
    first, second = (stroller.simulate(scene, start, t1=6.0, tolerance=1e-7) for start in launches)
    return first.view(others=[second], overlaid=True)


if __name__ == "__main__":
    draw().save(Path("over_the_hills.html"))
