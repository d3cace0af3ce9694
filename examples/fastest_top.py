"""Design: which offset and inertia turn a top over fastest at a given spin, with a least normal force kept throughout?

The constraint is a lower limit, as of a censored measurement: it costs nothing well above it and much some `STIFF` below.
Each candidate is seen at 1600 times, the winner again at 16000.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import tippe
from nonholonomic.identify import identify
from nonholonomic.likelihood import Measurements
from nonholonomic.unknown import Free

SPIN, THETA, T1, LEAST, STIFF = 120.0, 0.1, 8.0, 0.92, 3e-3
MASS, RADIUS, ANGLE = 0.02, 0.02, 0.75 * np.pi
FREE = {"offset / radius": Free(0.35, 0.1, 0.5), "I1 / I3": Free(1.0, 0.85, 1.1)}


def scene(numbers: dict) -> tippe.Scene:
    I3 = 0.4 * MASS * RADIUS**2
    top = tippe.Top(MASS, RADIUS, numbers["offset / radius"] * RADIUS, numbers["I1 / I3"] * I3, I3)
    return tippe.Scene(top, friction=tippe.Viscous(0.3))


def time_and_force(numbers: dict) -> jax.Array:
    """Inversion time [s], interpolated, and the least normal force on the way, per weight."""
    times = jnp.linspace(0.0, T1, 1600)
    adjoint = diffrax.ForwardMode()
    run = tippe.simulate(scene(numbers), tippe.Launch(THETA, SPIN), T1, times=times, tolerance=1e-6, adjoint=adjoint)
    theta = jnp.nan_to_num(run.theta)
    after = jnp.argmax(theta > ANGLE)
    share = (ANGLE - theta[after - 1]) / (theta[after] - theta[after - 1])
    time = times[after - 1] + share * (times[after] - times[after - 1])
    force = jnp.min(jnp.where((jnp.arange(1600) < after) & (theta > 0.0), run.normal_force, jnp.inf)) / (MASS * 9.81)
    worst = jnp.stack([jnp.asarray(2.0 * T1), jnp.ones(())])
    return jnp.where(after > 0, jnp.stack([time, force]), worst)


def main() -> None:
    # The "measurements": a time of 0 s, with an error so large that it is a wish, and enough normal force.
    wish = Measurements(np.array([0.0, LEAST + 2.0 * STIFF]), np.array([1.0, STIFF]), np.array([False, True]))
    labels = ("time", "least force")
    found = identify(jax.vmap(time_and_force), wish, FREE, starts=4, spread=2.0, max_steps=80, labels=labels)
    print("fastest:", ", ".join(f"{name} = {value:.4f}" for name, value in found.estimates.items()))
    print("starts ended at times of", np.sqrt(np.sort(found.end_deviances)).round(3), "s (with penalty)")
    run = tippe.simulate(scene(found.estimates), tippe.Launch(THETA, SPIN), T1, np.linspace(0.0, T1, 16000))
    before = np.searchsorted(np.maximum.accumulate(run.theta), ANGLE)
    least = float(np.min(run.normal_force[:before])) / (MASS * 9.81)
    print(
        f"simulated: turned over at {run.t[min(before, len(run.t) - 1)]:.3f} s, least normal force {least:.4f} of the weight"
    )
    words = "keeps" if least >= LEAST else "breaks", "leans" if least < LEAST + 0.01 else "does not lean"
    print(f"{LEAST} was asked: this top {words[0]} the limit and {words[1]} on it. The best of four starts, no proof.")


if __name__ == "__main__":
    main()
