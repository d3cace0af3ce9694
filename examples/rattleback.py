"""A rattleback: spun one way it turns back soon, spun the other way late; the angle between its axes decides how soon."""

from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import tippe

#: Kane and Levinson's semi-axes [m] and centre of mass, and the principal moments of the rattleback's inertia [kg m^2].
SHAPE, CENTRE, MOMENTS = (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), (2e-4, 1.6e-3, 1.7e-3)
TILT, ANGLES = 0.02, np.linspace(-0.1, 0.1, 61)


def scene(angle: Any) -> tippe.Scene:
    """A rattleback that rolls, whose axes of inertia are turned by an angle about the vertical."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    turn = jnp.stack([jnp.stack([c, -s, 0.0 * c]), jnp.stack([s, c, 0.0 * c]), jnp.array([0.0, 0.0, 1.0])])
    return tippe.Scene(
        tippe.Ellipsoid(1.0, SHAPE, CENTRE, turn @ jnp.diag(jnp.array(MOMENTS)) @ turn.T), friction=tippe.NoSlip()
    )


def draw() -> Any:
    """The plot, a matplotlib figure."""
    figure, (motion, times) = plt.subplots(1, 2, figsize=(10.0, 3.6), layout="constrained")
    for spin, colour in ((-5.0, "C0"), (5.0, "C3")):
        run = tippe.simulate(scene(0.0143), tippe.Launch(TILT, spin), t1=12.0, tolerance=1e-8)
        motion.plot(run.t, run.normal_spin, lw=0.8, color=colour, label=f"spun at {spin:+g} rad/s")

        def reversal(angle: Any, spin: float = spin) -> Any:
            return tippe.reversal_time(scene(angle), tippe.Launch(TILT, spin), t1=15.0, tolerance=1e-8)

        times.plot(ANGLES, jax.vmap(reversal)(ANGLES), ".", color=colour, label=f"spun at {spin:+g} rad/s")
    motion.axhline(0.0, color="gray", lw=0.5)
    motion.set(xlabel="time [s]", ylabel="spin about the vertical [rad/s]")
    times.set(xlabel="angle from curvature to inertia [rad]", ylabel="time of the first reversal [s]")
    times.locator_params(axis="x", nbins=5)
    for ax in (motion, times):
        ax.legend(fontsize=8)
    plt.close(figure)
    return figure


if __name__ == "__main__":
    draw().savefig("rattleback.png", dpi=150)
