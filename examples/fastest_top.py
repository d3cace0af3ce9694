"""Design: which offset and inertia turn a top over fastest at a given spin, with a least normal force kept throughout?

The constraint is a residual of its own: 0 while the least normal force met on the way is at least the limit, steep below
it. The optimum may lean on it a little. Each candidate is seen at 400 times; the winner is run again step by step.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import tippe
from nonholonomic.identify import identify
from nonholonomic.likelihood import Measurements
from nonholonomic.unknown import Free

SPIN, THETA, T1, LEAST, STIFF = 120.0, 0.1, 8.0, 0.5, 1e-3
MASS, RADIUS, ANGLE = 0.02, 0.02, 0.75 * np.pi
FREE = {"offset / radius": Free(0.25, 0.1, 0.5), "I1 / I3": Free(0.95, 0.85, 1.1)}


def scene(numbers: dict) -> tippe.Scene:
    I3 = 0.4 * MASS * RADIUS**2
    top = tippe.Top(MASS, RADIUS, numbers["offset / radius"] * RADIUS, numbers["I1 / I3"] * I3, I3)
    return tippe.Scene(top, friction=tippe.Viscous(0.3))


def time_and_force(numbers: dict) -> jax.Array:
    """Inversion time [s], interpolated, and by how much the normal force falls below the limit, per weight."""
    times = jnp.linspace(0.0, T1, 400)
    adjoint = diffrax.ForwardMode()
    run = tippe.simulate(scene(numbers), tippe.Launch(THETA, SPIN), T1, times=times, tolerance=1e-6, adjoint=adjoint)
    theta = jnp.where(jnp.isfinite(run.theta), run.theta, 0.0)
    after = jnp.argmax(theta > ANGLE)
    share = (ANGLE - theta[after - 1]) / (theta[after] - theta[after - 1])
    time = times[after - 1] + share * (times[after] - times[after - 1])
    force = jnp.min(jnp.where((jnp.arange(400) < after) & (theta > 0.0), run.normal_force, jnp.inf)) / (MASS * 9.81)
    worst = jnp.stack([jnp.asarray(2.0 * T1), jnp.zeros(())])
    return jnp.where(after > 0, jnp.stack([time, jnp.minimum(force - LEAST, 0.0)]), worst)


def main() -> None:
    # The "measurements": a time of 0 s, with an error so large that it is a wish, and no lack of normal force.
    wish = Measurements(np.array([0.0, 0.0]), np.array([1.0, STIFF]))
    found = identify(
        jax.vmap(time_and_force), wish, FREE, starts=4, spread=3.0, max_steps=20, labels=("time", "force lacking")
    )
    print("fastest:", ", ".join(f"{name} = {value:.4f}" for name, value in found.estimates.items()))
    print("starts ended at times of", np.sqrt(np.sort(found.end_deviances)).round(3), "s (with penalty)")
    run = tippe.simulate(scene(found.estimates), tippe.Launch(THETA, SPIN), T1)
    before = np.argmax(np.asarray(run.theta) > ANGLE)
    least = float(np.min(run.normal_force[:before])) / (MASS * 9.81)
    print(
        f"simulated: inverts at {run.t[before]:.3f} s, least normal force on the way {least:.4f} of the weight, {LEAST} asked"
    )
    print("The fastest of four starts, no proof. At 0.5 the limit does not bind; 0.95 none of them met.")


if __name__ == "__main__":
    main()
