"""Writes gradient_reference.csv: derivatives of the inversion times of 28 scenes by extrapolated central differences.

The scenes are the 20 of inversion_reference.csv that invert, and 8 inside a sphere, drawn like those of the cylinder there
(viscous friction). For each of mu, theta, spin and offset the inversion time is computed at tolerance 1e-13 at the scene's
value times 1 +- 1e-3 / 1.6^k, k = 0 to 15, and the central differences are extrapolated to step 0 by Neville's scheme; of all
its entries the one counts that differs least from its neighbours (Ridders, Adv. Eng. Softw. 4 (1982) 75), and that
difference is the error the file states. No derivative of the program enters.

Run: python make_gradient_reference.py   (some minutes)
"""

import csv
import math
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

import tippe
from nonholonomic.integration import Settings, solve_ensemble
from nonholonomic.integration.problem import CROSSED
from nonholonomic.parameters import with_numbers
from tippe.modes.problems import InversionProblem

HERE = Path(__file__).parent
ANGLE, TOLERANCE, STEP, RATIO, STEPS = 0.95 * math.pi, 1e-13, 1e-3, 1.6, 16
MOVED = {"mu": "scene.friction.mu", "theta": "launch.theta", "spin": "launch.spin", "offset": "scene.body.offset"}
NUMBERS = {name: f"scene.body.{name}" for name in ("mass", "radius", "offset", "I1", "I3")}
NUMBERS |= {"mu": "scene.friction.mu", "slip_speed": "scene.friction.slip_speed", "gravity": "scene.gravity"}
NUMBERS |= {"surface_radius": "scene.surface.radius"}
NUMBERS |= {name: f"launch.{name}" for name in ("theta", "spin", "eta", "azimuth")}


def roots_of(row: dict[str, str]) -> dict[str, Any]:
    """Scene and launch of the kind that a row describes; its numbers come by `columns_of`."""
    surface = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(1.0), "sphere": tippe.Sphere(1.0)}
    law = {"viscous": tippe.Viscous(0.1), "Coulomb": tippe.Coulomb(0.1, 0.1)}
    arena, friction = row["family"].split("-")
    scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.001, 1e-5, 1e-5), surface[arena], law[friction])
    return {"scene": scene, "launch": tippe.Launch(0.1, 100.0)}


def columns_of(rows: list[dict[str, str]]) -> dict[str, np.ndarray]:
    """Path of every number -> its values in the rows."""
    parameters = [name for name in NUMBERS if rows[0].get(name)]
    return {NUMBERS[name]: np.array([float(row[name]) for row in rows]) for name in parameters}


def times_of(row: dict[str, str], columns: dict[str, np.ndarray], t1: float) -> np.ndarray:
    """Inversion times, infinite where there is none."""
    size = len(columns["launch.theta"])
    roots = with_numbers(roots_of(row), columns)
    problem = InversionProblem.of(roots["scene"], roots["launch"], ANGLE, size)
    outcome, _ = solve_ensemble(problem, jnp.asarray(t1), jnp.asarray(size), Settings(TOLERANCE, lanes=32))
    return np.where(outcome.status == CROSSED, outcome.crossing_time, np.inf)


def extrapolated(differences: np.ndarray) -> tuple[float, float]:
    """The limit of central differences with steps that shrink by `RATIO`, and its error."""
    previous, estimate, error = [], math.nan, math.inf
    for difference in differences:
        row = [difference]
        for k, old_estimate in enumerate(previous, start=1):
            factor = RATIO ** (2 * k)
            row.append((factor * row[k - 1] - old_estimate) / (factor - 1.0))
            change = max(abs(row[k] - row[k - 1]), abs(row[k] - old_estimate))
            if change < error:
                estimate, error = row[k], change
        previous = row
    return estimate, error


def derivatives(rows: list[dict[str, str]]) -> list[dict[str, Any]]:
    """The rows of one family with their times, derivatives and errors."""
    columns = columns_of(rows)
    steps = STEP / RATIO ** np.arange(STEPS)
    factors = 1.0 + np.concatenate([[0.0], steps, -steps])
    cells = {path: [] for path in columns}
    for path_of_number in MOVED.values():
        for path, values in columns.items():
            cells[path].append(np.outer(values, factors if path == path_of_number else np.ones_like(factors)))
    change = {path: np.stack(values).reshape(-1) for path, values in cells.items()}
    times = times_of(rows[0], change, 8.0).reshape(len(MOVED), len(rows), len(factors))
    derivative_rows = []
    for index, row in enumerate(rows):
        result = {name: row.get(name, "") for name in ("family", *NUMBERS)} | {"time": repr(float(times[0, index, 0]))}
        for number, (name, path) in enumerate(MOVED.items()):
            times_above, times_below = times[number, index, 1 : 1 + STEPS], times[number, index, 1 + STEPS :]
            slope, error = extrapolated((times_above - times_below) / (2.0 * steps * columns[path][index]))
            result |= {f"by_{name}": repr(float(slope)), f"error_{name}": f"{error / abs(slope):.1e}"}
        derivative_rows.append(result)
    return derivative_rows


def spheres() -> list[dict[str, str]]:
    """Eight scenes inside a sphere that invert, the first of a seeded sequence."""
    random = np.random.default_rng(20261121)
    rows = []
    for _ in range(256):
        mass, radius = random.uniform(0.005, 0.05), random.uniform(0.015, 0.03)
        alpha, axial, ratio = random.uniform(0.1, 0.35), random.uniform(0.3, 0.45), random.uniform(0.9, 1.1)
        inertia = axial * mass * radius**2
        threshold = math.sqrt(
            mass * 9.81 * alpha * radius * (1 + alpha) ** 4 / (inertia * max(1 + alpha - ratio, 1e-3))
        )
        theta = random.uniform(0.05, 0.5)
        row = {"mass": mass, "radius": radius, "offset": alpha * radius, "I1": ratio * inertia, "I3": inertia}
        row |= {"mu": random.uniform(0.1, 0.5), "gravity": 9.81, "surface_radius": radius * random.uniform(5, 30)}
        row |= {"theta": theta, "spin": threshold / (math.cos(theta) - alpha) * random.uniform(0.8, 2.0)}
        row |= {"eta": random.uniform(-1, 1), "azimuth": random.uniform(-math.pi, math.pi)}
        rows.append({"family": "sphere-viscous"} | {name: f"{value:.5g}" for name, value in row.items()})
    times = times_of(rows[0], columns_of(rows), 8.0)
    return [row for row, time in zip(rows, times, strict=True) if math.isfinite(time)][:8]


if __name__ == "__main__":
    rows = list(csv.DictReader((HERE / "inversion_reference.csv").read_text().splitlines()))
    rows = [row for row in rows if row["status"] == "inverted"] + spheres()
    families = dict.fromkeys(row["family"] for row in rows)
    lines = [result for family in families for result in derivatives([row for row in rows if row["family"] == family])]
    with (HERE / "gradient_reference.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(lines[0]))
        writer.writeheader()
        writer.writerows(lines)
    for row in lines:
        print(row["family"], row["time"], *(f"{name} {row['by_' + name]} ({row['error_' + name]})" for name in MOVED))
