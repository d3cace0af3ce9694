"""Draw the paper's map of inversion times and their derivatives: `python paper/inversion_map.py`, writes inversion_map.png."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import tippe


def main() -> None:
    """Compute 101 x 101 launches with the derivative by the coefficient of friction, and draw both."""
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    theta, spin = np.linspace(0.02, 0.8, 101), np.linspace(60.0, 160.0, 101)
    table = tippe.inversion_table(scene, theta=theta, spin=spin, t1=20.0, tolerance=1e-8, sensitivities=["mu"])
    slope = np.asarray(table["time_by_mu"])
    time = np.where(np.isfinite(table["time"]), table["time"], np.nan)
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained", sharey=True)
    titles = ("time until the top has turned over [s]", r"its derivative by $\mu$ [s / (s/m)]")
    for ax, values, title in zip(axes, (time, np.where(np.isnan(time), np.nan, slope)), titles, strict=True):
        low, high = np.nanquantile(values, (0.02, 0.98))
        mesh = ax.pcolormesh(spin, theta, values, vmin=low, vmax=high, rasterized=True)
        figure.colorbar(mesh, ax=ax, label=title, extend="both")
        ax.set(xlabel="spin [rad/s]", facecolor="0.85")
    axes[0].set_ylabel(r"$\theta(0)$ [rad]")
    figure.savefig(Path(__file__).with_name("inversion_map.png"), dpi=200)


if __name__ == "__main__":
    main()
