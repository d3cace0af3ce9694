"""What printed thresholds and angles determine about a top: Rutstam's (SIGMA 8 (2012) 019) and Cohen's (1977).

They follow from the top in closed form. As in a laboratory, a threshold lies between two launches, one of which
inverts; an angle is read from a video to 1 degree, a rate of rotation to 1 %.
"""

import warnings
from collections.abc import Callable

import jax
import jax.numpy as jnp

import tippe
from nonholonomic.identification import Measurements, identify
from tippe import steady


def scene(mass: float, radius: float, printed: dict) -> tippe.Scene:
    top = tippe.Top(mass, radius, printed["offset"], printed["I1"], printed["I3"])
    return tippe.Scene(top, friction=tippe.Viscous(printed["mu"]))


def thresholds(printed: dict) -> jnp.ndarray:
    """Spins [rad/s] above which Rutstam's top inverts if launched upright, and above which standing upright is unstable."""
    of, lever = scene(0.02, 0.02, printed), 0.02 - printed["offset"]
    return jnp.stack([steady.jellett_thresholds(of)[1] / (lever * printed["I3"]), steady.upright_critical_spin(of)])


def final_motion(printed: dict) -> jnp.ndarray:
    """Final inclination [rad], phi' and psi' [rad/s] of Cohen's top, launched at 0.1 rad with 100 rad/s."""
    of = scene(0.015, 0.025, printed)
    launched = 100.0 * printed["I3"] * (0.025 * jnp.cos(0.1) - printed["offset"])
    theta = jnp.asarray(2.0)
    for _ in range(8):
        jellett, slope = jax.value_and_grad(lambda theta: steady.tumbling(of, theta).jellett - launched)(theta)
        theta = theta - jellett / slope
    motion = steady.tumbling(of, theta)
    return jnp.stack([theta, motion.precession, motion.spin - motion.precession * jnp.cos(theta)])


def shown(title: str, model: Callable, data: Measurements, start: dict) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tippe.FitWarning)  # that they leave much open is the point
        fit = identify(jax.vmap(model), data, {name: tippe.Free(at, 0.0) for name, at in start.items()}, progress=False)
    print(title, "of the published top:", *(f"{number:.4g}" for number in model(start)))
    for value, words in zip(fit.identifiability.singular_values, fit.identifiability.words, strict=True):
        print(f"  {words}: " + (f"known to {100.0 / value:.2g} %" if value > 1e-3 else "not at all"))


def main() -> None:
    bracket = Measurements([75.0, 26.0], 0.5, upper=[79.0, 29.0])
    rutstam = {"offset": 0.006, "I1": 235 / 625 * 8e-6, "I3": 0.4 * 8e-6, "mu": 0.3}
    shown("Rutstam's thresholds", thresholds, bracket, rutstam)
    read_off = Measurements([2.077, 55.8, -11.16], [0.0175, 0.56, 0.5])
    cohen = {"offset": 0.005, "I1": 0.4 * 9.375e-6, "I3": 0.32 * 9.375e-6, "mu": 0.3}
    shown("Cohen's final motion", final_motion, read_off, cohen)


if __name__ == "__main__":
    main()
