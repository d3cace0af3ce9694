"""Sensitive cells of the top: launches near the threshold of inversion, and chaos."""

import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measure import timed

import tippe
from hard.row import Row
from tippe import steady

sys.path.append(str(Path(__file__).parents[2] / "tests" / "physics"))
from lagrange_top import inversion

TOP = tippe.Top(0.02, 0.02, 0.006, 131.0 / 350.0 * 8e-6, 3.2e-6)
PLANE = tippe.Scene(TOP, tippe.Plane(), tippe.Viscous(0.3))
NUMBERS = {name: float(getattr(TOP, name)) for name in ("mass", "radius", "offset", "I1", "I3")}
ANGLE = math.pi - 0.1

#: Without spin, in a cylinder of three radii.
CHAOTIC = {"theta": 2.425475, "spin": 0.0, "eta": 0.692372, "azimuth": -1.796338}


def threshold_spin(factor: float) -> float:
    """Spin at which a launch from theta(0) = 0.1 has this multiple of the threshold's Jellett constant."""
    _, threshold = steady.jellett_thresholds(PLANE)
    return factor * float(threshold / (TOP.I3 * (TOP.radius * math.cos(0.1) - TOP.offset)))


def just_above_the_threshold() -> Row:
    """The time grows as the logarithm of the distance from the threshold, and its error with it: the table says by how much."""
    factors = np.array([1.0005, 1.005, 1.1])
    spins = [threshold_spin(factor) for factor in factors]
    run = timed(lambda: tippe.inversion_table(PLANE, theta=0.1, spin=spins, t1=40.0, angle=ANGLE, errors=True), 1)
    table = run.result
    references = [inversion(NUMBERS | {"theta": 0.1, "spin": spin, "mu": 0.3}, 40.0, ANGLE, 1e-13)[1] for spin in spins]
    return Row(
        f"Jellett's constant {', '.join(f'{factor:g}' for factor in factors)} times the threshold's",
        f"inverts after {', '.join(table.digits())} s",
        float(np.max(np.abs(table.time - references) / table.time_error)),
        0.5,
        "Lagrange's equations, SciPy, over the table's own error estimate",
        int(table.steps.sum()),
        run.cpu,
        ", ".join(np.unique(table.status)),
    )


def just_below_the_threshold() -> Row:
    """Below the threshold the top ends tumbling steadily at the angle that its Jellett constant selects."""
    spin = threshold_spin(0.99)
    run = timed(lambda: tippe.inversion_table(PLANE, theta=0.1, spin=[spin], t1=200.0, angle=ANGLE, errors=True), 1)
    table = run.result
    launch = tippe.Launch(0.1, spin)
    jellett = float(PLANE.jellett(PLANE.state(launch)))
    low, high = 2.7, 3.1
    for _ in range(60):
        middle = 0.5 * (low + high)
        is_below = float(steady.tumbling(PLANE, middle).jellett) < jellett
        low, high = (middle, high) if is_below else (low, middle)
    return Row(
        "Jellett's constant 0.99 times the threshold's, 200 s",
        f"never inverts, tumbles at {float(table.end_theta[0]):.6f} rad; both runs agree: error {table.time_error[0]:g}",
        abs(float(table.end_theta[0]) - low),
        1e-6,
        "steady tumbling of the same Jellett constant [rad]",
        int(table.steps[0]),
        run.cpu,
        str(table.status[0]),
    )


def rate_of_the_rise() -> Row:
    """The Lyapunov exponent of a standing top is its greatest eigenvalue."""
    run = timed(lambda: tippe.lyapunov_exponent(PLANE, tippe.Launch(0.0, 155.0), 30.0), 1)
    expected = float(steady.growth_rate(steady.standing_matrix(PLANE, 155.0)))
    return Row(
        "Lyapunov exponent of the upright top, 155 rad/s, 30 s",
        f"{float(run.result.exponent):.6f} /s",
        abs(float(run.result.exponent) - expected),
        1e-6,
        "eigenvalue [1/s]",
        int(run.result.steps),
        run.cpu,
        str(run.result.status),
    )


def orderly_without_friction() -> Row:
    """The frictionless top on the plane is integrable: its exponent vanishes as ln t / t."""
    scene = tippe.Scene(TOP)
    launch = tippe.Launch([0.3, 1.0, 2.0], [100.0, 60.0, 80.0])
    run = timed(lambda: tippe.lyapunov_exponent(scene, launch, 300.0), 1)
    return Row(
        "Lyapunov exponents on the plane without friction, 300 s",
        "orderly",
        float(np.max(np.abs(run.result.exponent))),
        0.03,
        "0, integrable [1/s]",
        int(run.result.steps.sum()),
        run.cpu,
        ", ".join(np.unique(run.result.status)),
    )


def chaos_in_a_cylinder() -> Row:
    """Without friction a top that rocks in a cylinder is chaotic: a table of its times would hold no digit to believe."""
    scene = tippe.Scene(TOP, tippe.Cylinder(0.06))
    run = timed(lambda: tippe.lyapunov_exponent(scene, tippe.Launch(**CHAOTIC), 7.0), 1)
    launches = CHAOTIC | {"theta": CHAOTIC["theta"] + 1e-9 * np.arange(16)}
    exponents = tippe.lyapunov_exponent(scene, tippe.Launch(**launches), 300.0)
    scatter = float(np.std(exponents.exponent)) / math.sqrt(len(exponents.exponent))
    times = run.result.times[4::3]

    def tilts(shift: float) -> np.ndarray:
        launch = CHAOTIC | {"theta": CHAOTIC["theta"] + shift, "surface_radius": 0.06}
        return np.array([inversion(NUMBERS | launch, time, math.pi, 1e-12)[2] for time in times])

    parted = np.log(np.abs(tilts(1e-7) - tilts(0.0)))
    rates = [np.polyfit(times, logarithm, 1)[0] for logarithm in (parted, times * run.result.running[4::3])]
    return Row(
        "no friction, no spin, in a cylinder of three radii: parting of nearby launches in 7 s",
        f"{rates[1]:.2f} /s; {exponents.exponent.mean():.2f} +- {scatter:.2f} /s over 300 s, mean of 16: chaos",
        float(abs(rates[1] / rates[0] - 1.0)),
        0.3,
        "two runs of Lagrange's equations, SciPy (relative)",
        int(run.result.steps),
        run.cpu,
        ", ".join(np.unique(exponents.status)),
    )


def rows() -> list[Callable[[], Row]]:
    """The rows of this file, in the order of the table."""
    return [
        just_above_the_threshold,
        just_below_the_threshold,
        rate_of_the_rise,
        orderly_without_friction,
        chaos_in_a_cylinder,
    ]
