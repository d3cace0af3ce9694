"""Friction of tops that hop, from the times of an independent program."""

import csv
from pathlib import Path

import numpy as np
from tops import rutstam_top

import tippe

HOPS = list(csv.DictReader((Path(__file__).parents[1] / "physics" / "hop_reference.csv").read_text().splitlines()))[:4]


def test_friction_from_times_of_tops_that_hop():
    """Four launches, of 7 to 77 flights. The slope of such a time by friction has the wrong sign; differences have not."""
    assert min(float(row["flights"]) for row in HOPS) > 6.0
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid")
    times = np.array([float(row["time"]) for row in HOPS])
    data = tippe.InversionTimes(tippe.Launch(0.1, [float(row["spin"]) for row in HOPS]), times, 0.02, t1=20.0)
    fit = tippe.identify(scene, data, {"mu": 0.25}, tolerance=1e-7)
    assert fit.verdict.good, str(fit)
    error = fit.standard_errors["scene.friction.mu"]
    assert error < 1e-3
    assert abs(fit.estimates["scene.friction.mu"] - float(HOPS[0]["mu"])) < 3.0 * error
