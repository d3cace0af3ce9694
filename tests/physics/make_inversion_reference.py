"""Draws 40 scenes and writes inversion_reference.csv, the outcomes that a simulator has to reproduce.

How the set was drawn. Ten scenes of each family: plane or cylinder, viscous or Coulomb (regularised).
Uniformly, and rounded to five significant digits before the run, so that the file holds the exact input:
mass 5 to 50 g, radius R 15 to 30 mm, offset/R 0.1 to 0.35, I3/(m R^2) 0.3 to 0.45, I1/I3 0.9 to 1.1,
mu 0.1 to 0.5 (s/m if viscous), slip_speed 0.02 to 0.2 m/s, theta 0.05 to 0.5 rad, azimuth -pi to pi,
surface_radius 5 to 30 R and eta -1 to 1 rad on the cylinder; gravity 9.81 m/s^2.
The spin is 0.5 to 3 times the one at which the launch has Jellett's constant of the threshold of
inversion on the plane. t1 = 8 s for all.

Chance alone gives few inversions, least of all in the cylinder with viscous friction. So each family is
filled to a QUOTA of outcomes: draws are taken in turn, and one whose outcome (as a quick run at rtol 1e-8
sees it) has had its quota is passed over. Within an outcome nothing is chosen, but a draw is thrown away if
  - there is no threshold, or the spin would be above 400 rad/s (I1/I3 far from 1 at a small offset);
  - the runs end differently, or the times or angles of the two accurate ones differ by more than 1e-9
    relative, or of the quick one by more than 1e-4 (a first crossing that grazes the angle, a touch of
    N = 0, or a motion that multiplies errors);
  - an event was missed by less than MARGIN (theta short of the angle, as a difference of cosines; normal
    force above zero, in weights), as a less accurate program may then rightly report the other outcome.
What became of every draw is counted and printed.

Columns in SI units; surface_radius is empty on the plane, slip_speed if viscous. status is inverted
(time: theta first at 0.95 pi), contact_lost (time: normal force first zero) or not_inverted (time inf);
final_theta is theta at that time, or at t1. Values are from rtol 1e-13. reference_error is the largest relative
difference of time and final_theta to a second run, with rtol 1e-12, other charts and other steps: it is
mostly the error of that second run, and so larger than the error of the values.

Run: python make_inversion_reference.py   (about two minutes)
"""

import csv
from collections import Counter
from dataclasses import asdict
from math import cos, inf, pi, sqrt
from pathlib import Path

import numpy as np
from lagrange_top import Scene, follow

SEED = 20240611
T1, ANGLE, MARGIN, AGREEMENT, ROUGH_AGREEMENT = 8.0, 0.95 * pi, 1e-3, 1e-9, 1e-4
FAMILIES = ("plane-viscous", "plane-Coulomb", "cylinder-viscous", "cylinder-Coulomb")
QUOTA = {"inverted": 5, "contact_lost": 3, "not_inverted": 2}
FASTEST = 400.0
PARAMETERS = (
    "mass",
    "radius",
    "offset",
    "I1",
    "I3",
    "surface_radius",
    "mu",
    "slip_speed",
    "gravity",
    "theta",
    "spin",
    "eta",
    "azimuth",
)


def five_digits(value):
    return float(f"{value:.5g}")


def threshold_spin(mass, R, a, I1, I3, theta, gravity=9.81):
    """Spin [rad/s] at which Jellett's constant of the launch equals that of inversion; inf if there is none."""
    alpha, gamma = a / R, I1 / I3
    if gamma >= 1 + alpha or gamma <= 1 - alpha or R * cos(theta) <= a:
        return inf
    return R * sqrt(mass * gravity * a * I3 * (1 + alpha) ** 4 / (1 + alpha - gamma)) / (I3 * (R * cos(theta) - a))


def draw(rng, family):
    """One scene; its spin is infinite if it has no threshold."""
    mass, R = rng.uniform(0.005, 0.05), rng.uniform(0.015, 0.03)
    a, I3 = R * rng.uniform(0.1, 0.35), mass * R * R * rng.uniform(0.3, 0.45)
    I1, theta = I3 * rng.uniform(0.9, 1.1), rng.uniform(0.05, 0.5)
    spin = threshold_spin(mass, R, a, I1, I3, theta) * rng.uniform(0.5, 3.0)
    values = dict(
        mass=mass,
        radius=R,
        offset=a,
        I1=I1,
        I3=I3,
        theta=theta,
        spin=spin,
        azimuth=rng.uniform(-pi, pi),
        mu=rng.uniform(0.1, 0.5),
    )
    if family.endswith("Coulomb"):
        values["slip_speed"] = rng.uniform(0.02, 0.2)
    if family.startswith("cylinder"):
        values |= dict(surface_radius=R * rng.uniform(5, 30), eta=rng.uniform(-1, 1))
    return Scene(**{name: five_digits(value) for name, value in values.items()})


def difference(first, second):
    """Largest relative difference of the times and angles of two outcomes."""
    times = 0.0 if first[1] == second[1] else abs(first[1] / second[1] - 1)
    return max(times, abs(first[2] / second[2] - 1))


def judge(scene, quota):
    """(status, time, theta, error) of a scene, or in a word why it is not taken."""
    if scene.spin > FASTEST:
        return "too fast or no threshold"
    coarse_run = follow(scene, T1, ANGLE, rtol=1e-8)
    if quota.get(coarse_run[0], 1) == 0:
        return "quota full: " + coarse_run[0]
    fine_run = follow(scene, T1, ANGLE, rtol=1e-13, pole="x", closest=0.3)
    check = follow(scene, T1, ANGLE, rtol=1e-12, pole="y", closest=0.5)
    if not fine_run[0] == check[0] == coarse_run[0] or fine_run[0] not in quota:
        return f"unclear: {coarse_run[0]}, {check[0]}, {fine_run[0]}"
    error = difference(fine_run, check)
    if error > AGREEMENT or difference(fine_run, coarse_run) > ROUGH_AGREEMENT:
        return f"sensitive: {fine_run[0]}"
    least_gap = min(
        gap for name, gap in zip(("inverted", "contact_lost"), fine_run[3], strict=True) if name != fine_run[0]
    )
    return "close miss: " + fine_run[0] if least_gap < MARGIN else (*fine_run[:3], error)


def rows(family, rng, count):
    """The rows of one family, as the columns of the file have them; counts what became of the draws."""
    quota = dict(QUOTA)
    while any(quota.values()):
        scene = draw(rng, family)
        result = judge(scene, quota)
        count[result if isinstance(result, str) else "taken: " + result[0]] += 1
        if not isinstance(result, str):
            quota[result[0]] -= 1
            fields = {name: "" if value is None else value for name, value in asdict(scene).items()}
            yield (family, *(fields[name] for name in PARAMETERS), T1, *map(plain, result))


def plain(value):
    """A word, or a plain Python number, which csv writes so that it reads back exactly."""
    return value if isinstance(value, str) else float(value)


def main():
    """Write the file next to this script."""
    with open(Path(__file__).with_name("inversion_reference.csv"), "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("family", *PARAMETERS, "t1", "status", "time", "final_theta", "reference_error"))
        for number, family in enumerate(FAMILIES):
            count = Counter()
            table.writerows(rows(family, np.random.default_rng((SEED, number)), count))
            print(family, *sorted(count.items()), sep="\n  ", flush=True)


if __name__ == "__main__":
    main()
