"""What Tables 2 and 3 of the paper on the cylinder say about its lost Table 1: seven numbers and the cylinder's radius.

Rows "not reversed" count with a one-sided likelihood, times to a second; the friction's law is not stated (here viscous).
"""

import jax.numpy as jnp
import numpy as np

import tippe
from nonholonomic.identify import identify
from nonholonomic.likelihood import Measurements
from nonholonomic.unknown import Free
from tippe import paper
from tippe.extended_times import extended_inversion_times

HORIZON = 30.0
ROWS = [(table, row) for table in (paper.TABLE_2, paper.TABLE_3) for row in table.rows]
THETA = np.array([row.theta for _, row in ROWS])
# The wall itself has N = 0 at rest: start a hair below it.
ETA = np.array([min(table.eta, np.pi / 2.0 - 1e-6) for table, _ in ROWS])
FREE = {
    "mass [g]": Free(28.8, 5.0, 50.0),
    "radius [mm]": Free(19.5, 15.0, 30.0),
    "offset / radius": Free(0.196, 0.1, 0.35),
    "I1 / I3": Free(0.91, 0.85, 1.1),
    "I3 / m R^2": Free(0.43, 0.3, 0.45),
    "cylinder / radius": Free(15.9, 5.0, 100.0),
    "azimuth": Free(-3.0, prior=(-3.0, 1.0)),
    "mu [s/m]": Free(0.3, 0.0, prior=(0.3, 0.03)),
}


def model(numbers: dict) -> jnp.ndarray:
    """Times of reversal of all rows of both tables [s], for every set of numbers."""
    rows, sets = len(ROWS), len(numbers["azimuth"])
    mass, radius, alpha, ratio, inertia, cylinder, azimuth, mu = (jnp.repeat(numbers[name], rows) for name in FREE)
    mass, radius = mass * paper.GRAM, radius * 1e-3
    I3 = inertia * mass * radius**2
    top = tippe.Top(mass, radius, alpha * radius, ratio * I3, I3)
    scene = tippe.Scene(top, tippe.Cylinder(cylinder * radius), tippe.Viscous(mu))
    launch = tippe.Launch(np.tile(THETA, sets), paper.BETA1 / I3, eta=np.tile(ETA, sets), azimuth=azimuth)
    return extended_inversion_times(scene, launch, HORIZON, 0.95 * np.pi, 1e-6, rows * sets).reshape(sets, rows)


def main() -> None:
    data = Measurements([row.time or HORIZON for _, row in ROWS], 1.0, [row.time is None for _, row in ROWS])
    labels = tuple(f"Table {2 if table is paper.TABLE_2 else 3}, theta {row.theta:.3g}" for table, row in ROWS)
    found = identify(model, data, FREE, starts=2, max_steps=10, labels=labels)
    print(found)
    misfit = max(1.0, (found.deviance / found.degrees) ** 0.5)
    if found.deviance > 2.0 * found.degrees:
        print("This top does not reproduce the tables: what follows is how sharply they would fix one near it.")
    print(f"Residuals are {misfit:.2g} times the errors of 1 s. With errors so large the tables fix, near this point,")
    for value, words in zip(found.identifiability.singular_values, found.identifiability.words, strict=True):
        error = misfit / max(value, 1e-300)
        print(f"  {words}: " + (f"to {100.0 * error:.2g} %" if error < 1.0 else "not at all"))


if __name__ == "__main__":
    main()
