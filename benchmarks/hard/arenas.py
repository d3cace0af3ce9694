"""Arenas given by a function: where contact is lost, where the ball no longer fits, and how far a foot drifts.

The reference is tests/physics/arena_reference.py: Euler's equations in the fixed frame, the foot found anew at every step.
"""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from measure import timed

import tippe
from hard.limits import rutstam_top
from hard.row import Row, of_runs

#: The reference's results; the last two lose their contact.
REFERENCE = list(
    csv.DictReader((Path(__file__).parents[2] / "tests/physics/arena_reference.csv").read_text().splitlines())
)


def over_the_crest() -> Row:
    """A top that crosses the crest of a wave at 2.1 m/s: time of the loss of contact, and the axis at that time."""
    row = next(case for case in REFERENCE if case["arena"] == "graph" and case["status"] == "contact_lost")
    number = {name: float(value) for name, value in row.items() if name not in ("arena", "status")}
    waves = tippe.Graph(lambda x, y: number["p1"] * jnp.sin(number["p2"] * x) * jnp.cos(number["p2"] * y))
    scene = tippe.Scene(rutstam_top(), waves, tippe.Coulomb(number["mu"], number["slip_speed"]))
    launch = tippe.Launch(
        number["theta"],
        number["spin"],
        azimuth=number["azimuth"],
        place=(number["q1"], number["q2"]),
        velocity=(number["v1"], number["v2"]),
        angular_velocity=(number["w1"], number["w2"], number["w3"]),
    )
    run = timed(lambda: tippe.simulate(scene, launch, number["t1"], tolerance=1e-11), 1)
    error = abs(float(run.result.end_time) - number["end_time"])
    outcome = f"loses contact at {float(run.result.end_time):.6f} s"
    return of_runs("2.1 m/s over waves of 40 mm", outcome, error, 1e-7, "SciPy by events, time [s]", run)


def no_room() -> Row:
    """A top in a trough that narrows: the run ends where the curvature of the trough is that of the ball."""
    trough = tippe.Graph(lambda x, y: y * y * (5.0 + 150.0 * x))
    launch = tippe.Launch(0.0, 50.0, place=(0.0, 0.0), velocity=(0.4, 0.0))
    run = timed(lambda: tippe.simulate(tippe.Scene(rutstam_top(), trough), launch, 1.0), 1)
    place = float(run.result.contact[-1, 0])
    case = "a trough with a curvature of 10 + 300 x, 1/R = 50 /m"
    return of_runs(case, f"ends at x = {place:.5f} m", abs(place - 2.0 / 15.0), 1e-4, "x = 2/15 [m]", run)


def a_thousand_seconds_in_a_bowl() -> Row:
    """1000 s in a bowl given by a function: greatest distance of the foot from the bowl."""
    bowl = tippe.Graph(lambda x, y: 2.0 * jnp.sqrt(0.25 + x * x + y * y))
    scene = tippe.Scene(rutstam_top(), bowl, tippe.Viscous(0.02))
    launch = tippe.Launch(0.3, 20.0, place=(0.1, 0.05), velocity=(0.2, 0.1))
    run = timed(lambda: tippe.simulate(scene, launch, 1000.0, tolerance=1e-6), 1)
    feet = tuple(np.asarray(run.result.states[8:11]))
    offset = float(np.max(np.abs(scene.surface.offset(feet))) / 0.02)
    error = offset if run.result.status == "completed" else math.nan
    return of_runs("1000 s in a bowl, tolerance 1e-6", "the foot stays on it", error, 1e-6, "on the arena [R]", run)


def rows() -> list[Callable[[], Row]]:
    """The rows of this file."""
    return [over_the_crest, no_room, a_thousand_seconds_in_a_bowl]
