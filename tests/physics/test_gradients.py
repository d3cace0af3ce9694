"""Derivatives of inversion times against extrapolated central differences (`make_gradient_reference.py`)."""

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from make_gradient_reference import ANGLE, MOVED, columns_of, extrapolated, roots_of
from tops import rutstam_top

import tippe
from nonholonomic.integration import Oscillatory8, Settings
from nonholonomic.runs.table import TableJob
from tippe.runs.model import INVERSIONS, TopModel

ROWS = list(csv.DictReader(Path(__file__).with_name("gradient_reference.csv").read_text().splitlines()))


def relative_errors(family: str, tolerance: float) -> np.ndarray:
    """Of the derivatives by mu, theta, spin and offset in every scene of a family."""
    rows = [row for row in ROWS if row["family"] == family]
    names = list(MOVED.values())
    model = TopModel.timed(**roots_of(rows[0]), angle=ANGLE)
    settings, slopes = Settings(tolerance, Oscillatory8()), {name: name for name in names}
    table = TableJob(model, INVERSIONS, 8.0, "first", settings, slopes)(columns_of(rows), len(rows))
    expected = np.array([[float(row[f"by_{name}"]) for row in rows] for name in MOVED])
    return np.abs(np.stack([table[name] for name in names]) / expected - 1.0)


@pytest.mark.parametrize(
    "family",
    [
        pytest.param("plane-viscous", marks=pytest.mark.oldest),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("cylinder-Coulomb", "plane-Coulomb", "cylinder-viscous", "sphere-viscous")
        ),
    ],
)
def test_derivatives_agree_with_extrapolated_differences(family):
    """By mu, theta, spin and offset, relative error below 1e-5 at tolerance 1e-11."""
    assert relative_errors(family, 1e-11).max() < 1e-5


def test_the_reference_is_better_than_what_it_is_used_for():
    assert len(ROWS) == 28
    assert max(float(row[f"error_{name}"]) for row in ROWS for name in MOVED) < 1e-7


@pytest.fixture(scope="module")
def threshold_scan():
    """Rutstam's top, launched with 0.99 to 1.05 times the spin of the threshold: times to pi - 0.1, and their slopes."""
    top = rutstam_top(235.0 / 625.0)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    alpha, gamma = float(top.offset / top.radius), float(top.I1 / top.I3)
    threshold = float(top.radius) * math.sqrt(float(top.mass * 9.81 * top.offset * top.I3) / (1 + alpha - gamma))
    spin = threshold * (1 + alpha) ** 2 / float(top.I3 * top.radius) / (math.cos(0.1) - alpha)
    factors = np.array([0.9, 0.97, 0.99, 1.001, 1.003, 1.01, 1.05])
    steps = 1e-4 * (factors - 0.985) / 1.6 ** np.arange(8)[:, None]
    spins = spin * np.concatenate([[factors], factors + steps, factors - steps])
    # The last one loses contact.
    spins = np.append(spins.ravel(), 250.0)
    table = tippe.inversion_table(
        scene, theta=0.1, spin=spins, t1=40.0, angle=math.pi - 0.1, tolerance=1e-12, sensitivities=["spin"]
    )
    return factors, steps * spin, table


@pytest.mark.slow
def test_across_the_threshold_the_derivative_is_right_or_flagged(threshold_scan):
    """Above, it agrees with differences as the time grows without bound; below, and where contact is lost, the cell says so
    and the slope is 0."""
    factors, steps, table = threshold_scan
    times, slopes, status = table.time[:-1].reshape(17, -1), table.time_by_spin, table.status
    below = factors < 0.995
    assert (status[: len(factors)] == np.where(below, "not_inverted", "inverted")).all()
    assert (slopes[: len(factors)][below] == 0.0).all()
    assert (status[-1], slopes[-1]) == ("contact_lost", 0.0)
    for cell in np.flatnonzero(~below):
        expected, error = extrapolated((times[1:9, cell] - times[9:, cell]) / (2.0 * steps[:, cell]))
        assert abs(slopes[cell] - expected) < 1e-5 * abs(expected) + 10.0 * error
