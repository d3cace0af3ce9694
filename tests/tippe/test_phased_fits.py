"""Friction of tops that hop, from the times of an independent program."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tops import rutstam_top

import tippe

HOPS = list(csv.DictReader((Path(__file__).parents[1] / "physics" / "hop_reference.csv").read_text().splitlines()))[:4]


def fit_of_friction(rows, **options):
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid")
    times = np.array([float(row["time"]) for row in rows])
    data = tippe.InversionTimes(tippe.Launch(0.1, [float(row["spin"]) for row in rows]), times, 0.02, t1=8.0)
    return tippe.identify(scene, data, {"mu": 0.25}, **options)


def check(fit, greatest_error):
    assert fit.verdict.good, str(fit)
    error = fit.standard_errors["scene.friction.mu"]
    assert error < greatest_error
    assert abs(fit.estimates["scene.friction.mu"] - float(HOPS[0]["mu"])) < 3.0 * error


@pytest.mark.slow
def test_friction_from_times_of_tops_that_hop():
    """Two launches, of 7 and 23 flights. The slope of such a time by friction has the wrong sign; differences have not."""
    assert min(float(row["flights"]) for row in HOPS[:2]) > 6.0
    check(fit_of_friction(HOPS[:2], tolerance=1e-6, starts=2), 2e-3)


@pytest.mark.slow
def test_friction_from_times_of_tops_that_hop_often():
    """Four launches, of 7 to 77 flights."""
    check(fit_of_friction(HOPS, tolerance=1e-7), 1e-3)
