"""The 40 random scenes of `inversion_reference.csv`, computed by Lagrange's equations in NumPy and SciPy."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from close import assert_close

import tippe

FILE = Path(__file__).with_name("inversion_reference.csv")
ROWS = list(csv.DictReader(FILE.read_text().splitlines()))
FAMILIES = sorted({row["family"] for row in ROWS})
#: Those of the ordinary run: each arena and each law once.
SHORT = ("plane-viscous", "cylinder-Coulomb")


def computed(rows: list[dict[str, str]]) -> list[tippe.Table]:
    """Every row by `inversion_table` at tolerance 1e-10; the scenes differ in numbers only, so one program serves."""
    times = []
    for row in rows:
        number = {name: float(value) for name, value in row.items() if name not in ("family", "status") and value}
        arena = tippe.Cylinder(number["surface_radius"]) if "surface_radius" in number else tippe.Plane()
        law = (
            tippe.Coulomb(number["mu"], number["slip_speed"]) if "slip_speed" in number else tippe.Viscous(number["mu"])
        )
        top = tippe.Top(*(number[name] for name in ("mass", "radius", "offset", "I1", "I3")))
        launch = {name: number[name] for name in ("theta", "spin", "eta", "azimuth")}
        scene = tippe.Scene(top, arena, law, number["gravity"])
        times.append(tippe.inversion_table(scene, t1=number["t1"], tolerance=1e-10, **launch))
    return times


@pytest.mark.parametrize(
    "family", [pytest.param(family, marks=() if family in SHORT else pytest.mark.slow) for family in FAMILIES]
)
def test_inversion_and_contact_loss_agree_with_lagranges_equations(family):
    """Status in every row; times of inversion and of contact loss to 1e-8 relative, the angle of loss to 1e-7 rad."""
    rows = [row for row in ROWS if row["family"] == family]
    tables = computed(rows)
    assert [str(table.status) for table in tables] == [row["status"] for row in rows]
    ended = [(table, row) for table, row in zip(tables, rows, strict=True) if row["status"] != "not_inverted"]
    times = [float(table.end_time) for table, _ in ended]
    assert_close(times, [float(row["time"]) for _, row in ended], rtol=1e-8)
    inverted = [float(table.time) for table, row in ended if row["status"] == "inverted"]
    assert_close(inverted, [float(row["time"]) for _, row in ended if row["status"] == "inverted"], rtol=1e-8)
    failures = [
        (float(table.end_theta), float(row["final_theta"])) for table, row in ended if row["status"] == "contact_lost"
    ]
    assert_close(*zip(*failures, strict=True), atol=1e-7)


def test_the_reference_is_a_healthy_mixture():
    words, counts = np.unique([row["status"] for row in ROWS], return_counts=True)
    assert dict(zip(words, counts, strict=True)) == {"contact_lost": 12, "inverted": 20, "not_inverted": 8}
    assert max(float(row["reference_error"]) for row in ROWS) < 1e-9


@pytest.mark.slow
def test_the_reference_repeats_itself():
    """The first row of every family, integrated again by the reference program at 1e-12."""
    from lagrange_top import Scene, inversion

    fields = {field.name for field in dataclasses.fields(Scene)}
    for family in FAMILIES:
        row = next(row for row in ROWS if row["family"] == family and row["status"] == "inverted")
        scene = Scene(**{name: float(value) for name, value in row.items() if value and name in fields})
        status, time, _ = inversion(scene, float(row["t1"]), 0.95 * np.pi, 1e-12)
        assert status == row["status"]
        assert_close(time, float(row["time"]), rtol=1e-9)
