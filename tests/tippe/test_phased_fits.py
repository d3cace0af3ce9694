"""Friction of tops that hop, from the times of an independent program."""

import csv
from pathlib import Path

import numpy as np
import pytest
from tops import rutstam_top

import tippe
from nonholonomic.identification import sample

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


def test_draws_of_a_top_that_sticks_are_those_of_its_fit():
    """Friction from the time at 0.6 pi. Its posterior cannot be differentiated."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(0.3))

    def data(time):
        return tippe.InversionTimes(tippe.Launch(1.5, [120.0]), [time], 0.01, t1=2.0, angle=0.6 * np.pi)

    def density(time, mu):
        return tippe.log_density(scene, data(time), {"mu": mu}, tolerance=1e-6)

    # So many rows, here and in the fit, that one program serves all.
    exact = density(1.0, 0.3).predict(np.full((80, 1), np.log(0.3)))[0, 0]
    fit = tippe.identify(scene, data(exact), {"mu": 0.27}, starts=24, tolerance=1e-6, progress=False)
    low, high = fit.interval("mu")
    assert low < 0.3 < high
    posterior = density(exact, 0.35)
    draws = sample(posterior, fit.coordinates, fit.coordinate_covariance, draws=400, progress=False)
    ends = np.quantile(draws.values["scene.friction.mu"], [0.025, 0.975])
    assert np.max(np.abs(ends - [low, high])) < 0.15 * (high - low)
    repeated = posterior.replicate(np.full((80, 1), np.log(0.3)))[:, 0]
    assert abs(np.mean(repeated) - exact) < 4.0 * 0.01 / np.sqrt(80)
    with pytest.raises(ValueError, match="cannot be compiled or differentiated: use `sample`"):
        posterior.value_and_gradient(posterior.start)
