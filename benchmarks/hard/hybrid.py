"""Contact loss, flight, landing and the stem, against an event-driven reference in NumPy and SciPy and closed forms.

The reference is tests/physics/hop_reference.py: other equations, flight integrated, impacts by a matrix exponential.
"""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measure import timed

import tippe
from hard.limits import rutstam_top
from hard.row import Row, of_runs, of_table

#: The reference's results, by number of its cases.
REFERENCE = list(
    csv.DictReader((Path(__file__).parents[2] / "tests/physics/hop_reference.csv").read_text().splitlines())
)


def leine_glocker_top() -> tippe.Top:
    """The top of Leine and Glocker (2003), with its stem."""
    return tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))


def _against_reference(number: int, case: str, happens: str, bound: float) -> Row:
    """A case of the reference at a tolerance of 1e-11; with a wrong number of flights, the error is infinite."""
    expected = {name: float(value) for name, value in REFERENCE[number].items() if name != "status"}
    friction = tippe.Viscous(expected["mu"])
    if expected["slip_speed"]:
        friction = tippe.Coulomb(expected["mu"], expected["slip_speed"])
    top = leine_glocker_top() if expected["stem_radius"] else rutstam_top()
    scene = tippe.Scene(top, friction=friction, contact="hybrid", restitution=expected["restitution"])
    arguments = {"tolerance": 1e-11} | {name: expected[name] for name in ("theta", "spin", "t1", "angle")}
    run = timed(lambda: tippe.inversion_table(scene, **arguments), 1)
    table = run.result
    flights = int(table.hops)
    error = abs(float(table.time) - expected["time"]) if flights == int(expected["flights"]) else np.inf
    label = f"{happens} ({flights} flights)" if flights else happens
    return of_table(case, label, error, bound, "SciPy, time [s]", run)


def hops() -> Row:
    """Rutstam's top at 2.6 times Jellett's threshold: contact is lost repeatedly."""
    return _against_reference(1, "viscous 0.3, 200 rad/s: N reaches 0", "lands, inverts", 1e-7)


def bounces() -> Row:
    """The top of `hops` with restitution: every landing is a finite series of bounces."""
    return _against_reference(4, "the same, e_N = 0.5", "bounces out, inverts", 1e-7)


def coulomb_hops() -> Row:
    """With regularised Coulomb friction, the top of `hops` loses contact at half the spin."""
    return _against_reference(5, "Coulomb 0.3, 0.05 m/s, 155 rad/s", "lands, inverts", 1e-7)


def over_to_the_stem() -> Row:
    """Leine and Glocker's top: it moves from its sphere to its stem and back, and finally onto its stem."""
    return _against_reference(7, "two spheres, Coulomb, 180 rad/s", "goes over to its stem", 1e-7)


def jellett_through_hops() -> Row:
    """Jellett's quantity of a top without a stem is constant, because forces and impacts act at the contact point."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.3)
    run = timed(lambda: tippe.simulate(scene, tippe.Launch(0.1, 250.0), 7.0, tolerance=1e-11), 1)
    ride = run.result
    error = float(np.max(np.abs(ride.jellett / ride.jellett[0] - 1.0)))
    happens = f"Jellett's quantity stays ({len(ride.hops)} flights)"
    return of_runs("250 rad/s, e_N = 0.3, 7 s", happens, error, 1e-9, "exact, relative", run)


def energy_through_hops() -> Row:
    """The energy never grows in flights, impacts and changes of the touching sphere."""
    scene = tippe.Scene(leine_glocker_top(), friction=tippe.Coulomb(0.3, 0.05), contact="hybrid")
    run = timed(lambda: tippe.simulate(scene, tippe.Launch(0.1, 250.0), 4.0, tolerance=1e-10), 1)
    ride = run.result
    error = float(np.max(np.diff(ride.energy))) / float(ride.energy[0])
    happens = f"energy falls only ({len(ride.hops)} flights)"
    return of_runs("two spheres, 250 rad/s, 4 s", happens, error, 1e-8, "greatest rise, relative", run)


def leaning_on_the_stem() -> Row:
    """A top too slow to rise rocks between sphere and stem, slides on both, and falls back onto its sphere."""
    expected = {name: float(value) for name, value in REFERENCE[9].items() if name != "status"}
    scene = tippe.Scene(leine_glocker_top(), friction=tippe.Coulomb(0.3, 0.05), contact="hybrid")
    arguments = {"theta": 0.1, "tolerance": 1e-11} | {name: expected[name] for name in ("spin", "t1", "angle")}
    run = timed(lambda: tippe.inversion_table(scene, **arguments), 1)
    table = run.result
    error = abs(float(table.end_theta) - expected["end_theta"])
    happens = f"leans from {expected['leans']:.3f} to {expected['parted']:.3f} s, falls back"
    return of_table("two spheres, 140 rad/s, 3 s", happens, error, 1e-8, "SciPy, theta [rad]", run)


def leaning_for_ever() -> Row:
    """A slower top rolls at the angle at which both spheres touch, while the load on its stem decreases to zero."""
    scene = tippe.Scene(leine_glocker_top(), friction=tippe.Coulomb(0.3, 0.05), contact="hybrid")
    run = timed(lambda: tippe.inversion_table(scene, theta=0.1, spin=120.0, t1=30.0), 1)
    table = run.result
    top, stem = scene.body, scene.body.stem
    both_touch = math.acos(float((stem.radius - top.radius) / (stem.offset - top.offset)))
    error = abs(float(table.end_theta) - both_touch)
    return of_table(
        "two spheres, 120 rad/s, 30 s", "rocks, leans for ever", error, 1e-7, "closed form, theta [rad]", run
    )


def rows() -> list[Callable[[], Row]]:
    """The rows of this file, in the order of the table."""
    return [
        hops,
        bounces,
        coulomb_hops,
        over_to_the_stem,
        jellett_through_hops,
        energy_through_hops,
        leaning_on_the_stem,
        leaning_for_ever,
    ]
