"""The posterior of friction, offset and I1 / I3 from ten times, and its predictions (needs blackjax; matplotlib to
plot)."""

import sys

import jax
import numpy as np

import tippe
from nonholonomic.identification import sample

THETA, SPIN = np.repeat([0.005, 0.015], 5), np.tile([70.0, 80.0, 100.0, 120.0, 150.0], 2)
ANGLE, ERROR, TRUE_MU, TRUE_OFFSET = 0.5 * np.pi, 0.02, 0.3, 0.0035
INERTIA = 0.02 * 0.02**2
I1 = 131 / 350 * INERTIA


def scene(mu: float, offset: float) -> tippe.Scene:
    return tippe.Scene(tippe.Top(0.02, 0.02, offset, I1, 0.4 * INERTIA), friction=tippe.Viscous(mu))


def measured() -> tippe.InversionTimes:
    top = scene(TRUE_MU, TRUE_OFFSET)
    times = jax.vmap(lambda a, w: tippe.inversion_time(top, tippe.Launch(a, w), t1=60.0, angle=ANGLE))(THETA, SPIN)
    noisy_times = np.asarray(times) + ERROR * np.random.default_rng(1).normal(size=len(THETA))
    return tippe.InversionTimes(tippe.Launch(THETA, SPIN), noisy_times, ERROR, t1=60.0, angle=ANGLE)


def free_numbers() -> dict[str, tippe.Free]:
    """I3 is known; I1 has a prior of 3 %, from weighing and measuring, and friction a prior of a third."""
    free = {"friction.mu": tippe.Free(0.3, 0.0, prior=(0.3, 0.1)), "offset": tippe.Free(0.0035, 0.0)}
    return free | {"scene.body.I1": tippe.Free(I1, 0.0, prior=(I1, 0.03 * I1))}


def main(path: str | None = None) -> None:
    data, free = measured(), free_numbers()
    density = tippe.log_density(scene(0.3, 0.0035), data, free)
    draws = sample(density)
    print(draws)
    replicas = density.replicate(draws.coordinates.reshape(-1, len(free))[::10])
    coverage = np.mean((np.sort(replicas, axis=0)[2] < data.time) & (data.time < np.sort(replicas, axis=0)[-3]))
    print(f"{100.0 * coverage:.0f} % of the times lie where the posterior predicts them")
    if path is not None:
        from matplotlib.figure import Figure

        axes = Figure(layout="constrained").subplots()
        axes.violinplot(1e3 * (replicas - data.time), positions=range(len(data.time)), showextrema=False)
        axes.axhline(0.0, color="k", linewidth=0.8)
        axes.set_xticks(range(len(data.time)), data.labels, rotation=60, fontsize=7)
        axes.set_ylabel("predicted less measured inversion time [ms]")
        axes.figure.savefig(path)


if __name__ == "__main__":
    main(*sys.argv[1:2])
