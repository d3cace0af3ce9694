"""Inversion tables: their axes, cells, scenes and faults; `test_table_files.py` has their files."""

import json
import math

import diffrax
import jax
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import nonholonomic
import tippe
from nonholonomic.sweeps import running as sweeping

THETA, SPIN = [0.08, 0.1, 0.12], [90.0, 110.0]


@pytest.fixture(scope="module")
def table(rutstam_scene_module) -> tippe.Table:
    return tippe.inversion_table(rutstam_scene_module, theta=THETA, spin=SPIN, t1=12.0)


@pytest.fixture(scope="module")
def rutstam_scene_module() -> tippe.Scene:
    return tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))


def test_axes_come_in_their_order_and_scalars_are_none(rutstam_scene_module):
    table = tippe.inversion_table(
        rutstam_scene_module, theta=[0.1, 0.2], spin=[100.0, 120.0, 140.0], eta=0.0, mu=[0.2, 0.3, 0.4, 0.5], t1=0.1
    )
    assert list(table.coords) == ["theta", "mu", "spin"]
    assert table.time.shape == table.status.shape == table.shape == (2, 4, 3)
    assert table.units["mu"] == "s m-1"
    single = tippe.inversion_table(rutstam_scene_module, theta=0.1, spin=100.0, t1=0.1)
    assert single.shape == ()
    assert single.status == "not_inverted"


def test_a_sweep_from_a_launch_in_degrees_is_shown_in_degrees(rutstam_scene_module, tmp_path):
    """Its numbers stay in SI units."""
    launch, theta = tippe.Launch.degrees(theta=6, rpm=1500), np.radians([6.0, 9.0, 12.0])
    axes = {"launch.theta": theta, "mu": [0.2, 0.3]}
    table = nonholonomic.sweep(rutstam_scene_module, launch, 0.1, axes=axes, path=tmp_path / "table.h5")
    in_radians = nonholonomic.sweep(rutstam_scene_module, tippe.Launch(launch.theta, launch.spin), 0.1, axes=axes)
    np.testing.assert_array_equal(table["launch.theta"], theta)
    np.testing.assert_array_equal(table.end_theta, in_radians.end_theta)
    low, high = np.degrees([table.end_theta.min(), table.end_theta.max()])
    assert f"end_theta [deg]: {low:.6g} to {high:.6g}" in repr(table)
    assert "end_theta [rad]" in repr(in_radians)
    assert "6 to 12</td>" in table._repr_html_()
    assert "θ(0) [deg]</td>" in table._repr_html_()
    (panel,) = table.plot("end_theta").axes
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("θ(0) [deg]", "θ at the end of the run [deg]")
    assert_close(panel.get_lines()[0].get_xdata(), [6.0, 9.0, 12.0], rtol=1e-14)
    assert table.plot("end_theta", unit="rad").axes[0].get_xlabel() == "θ(0) [rad]"
    # Where nothing that is drawn is an angle.
    assert table.plot("steps", x="mu", at={"launch.theta": theta[1]}).axes[0].get_title() == "θ(0) = 9 deg"
    assert repr(tippe.Table.load(tmp_path / "table.h5")) == repr(table)


def test_a_table_takes_a_launch(rutstam_scene_module):
    launch = tippe.Launch.degrees(theta=[6, 9, 12], rpm=1500, azimuth=90)
    arguments = {"mu": [0.2, 0.3], "t1": 0.1}
    table = tippe.inversion_table(rutstam_scene_module, launch, **arguments)
    numbers = {"theta": launch.theta, "spin": launch.spin, "azimuth": launch.azimuth}
    in_radians = tippe.inversion_table(rutstam_scene_module, **numbers, **arguments)
    assert list(table.coords) == ["theta", "mu"]
    np.testing.assert_array_equal(table.theta, launch.theta)
    np.testing.assert_array_equal(table.end_theta, in_radians.end_theta)
    assert "end_theta [deg]" in repr(table)
    assert "end_theta [rad]" in repr(in_radians)
    with pytest.raises(
        ValueError, match=r"launch must be left out where its numbers are given; or pass these by axes=\{.*: \[\.\.\.\]"
    ):
        tippe.inversion_table(rutstam_scene_module, launch, theta=0.1, **arguments)
    with pytest.raises(ValueError, match="spin = None is not a number: pass a launch"):
        tippe.inversion_table(rutstam_scene_module, theta=0.1, **arguments)
    # An axis replaces a number of the launch.
    one = tippe.Launch.degrees(theta=6, rpm=1500, azimuth=90)
    table = tippe.inversion_table(rutstam_scene_module, one, axes={"launch.theta": launch.theta}, **arguments)
    assert list(table.coords) == ["mu", "theta"]
    np.testing.assert_array_equal(table.end_theta.T, in_radians.end_theta)


def test_a_run_that_needs_more_than_the_most_steps_has_failed(table, rutstam_scene_module, tmp_path):
    """A file of another limit is another request."""
    arguments = {"theta": THETA, "spin": SPIN, "t1": 12.0, "path": tmp_path / "table.h5"}
    with pytest.warns(UserWarning, match=r"6 of 6 runs have failed: t1 = 12 s is too long: .* more than 40 steps"):
        short_table = tippe.inversion_table(rutstam_scene_module, max_steps=40, **arguments)
    assert (short_table.status == "failed").all()
    assert (short_table["steps"] == 40).all()
    assert json.loads(short_table.attributes["request"])["max_steps"] == 40
    assert json.loads(table.attributes["request"])["max_steps"] == 2_000_000
    with pytest.raises(ValueError, match="max_steps is 40 in the file"):
        tippe.inversion_table(rutstam_scene_module, **arguments)


def test_every_cell_is_inversion_time(table, rutstam_scene_module):
    for i, theta in enumerate(THETA):
        for j, spin in enumerate(SPIN):
            expected = tippe.inversion_time(rutstam_scene_module, tippe.Launch(theta, spin), 12.0)
            assert_close(table.time[i, j], expected, rtol=1e-8)
    assert (table.status == "inverted").all()
    assert_close(table.end_theta, 0.95 * math.pi, atol=1e-7)


def test_scattered_cells_are_those_of_the_grid(table, rutstam_scene_module, tmp_path):
    """Launches that are no grid, in one call: the same numbers to the bit, and the columns among the variables."""
    cell_indices = np.array([[0, 1], [2, 0], [1, 1], [2, 0]])
    columns = {"theta": np.array(THETA)[cell_indices[:, 0]], "spin": np.array(SPIN)[cell_indices[:, 1]]}
    arguments = {"t1": 12.0, "scattered": True, "path": tmp_path / "cells.h5"}
    cells = tippe.inversion_table(rutstam_scene_module, **columns, **arguments)
    assert cells.shape == (4,)
    assert cells.dims("time") == ("cell",)
    for name, values in columns.items():
        np.testing.assert_array_equal(cells[name], values)
    np.testing.assert_array_equal(cells.time, table.time[tuple(cell_indices.T)])
    assert cells.units["theta"] == "rad"
    second_table = tippe.inversion_table(rutstam_scene_module, **columns, **arguments)
    np.testing.assert_array_equal(second_table.time, cells.time)
    with pytest.raises(ValueError, match="another run: cells is"):
        tippe.inversion_table(rutstam_scene_module, **columns | {"theta": columns["theta"][::-1]}, **arguments)


@pytest.mark.parametrize(
    ("lists", "message"),
    [
        ({"theta": [0.1, 0.2], "spin": [100.0]}, "takes lists of one length, not theta of 2, spin of 1"),
        ({"theta": 0.1, "spin": 100.0}, "takes lists of one length, not none"),
        ({"theta": [0.1, 3.3], "spin": 100.0}, "theta = 3.3 must be at most"),
        ({"theta": [0.1], "spin": 1.0, "scattered": 1}, "scattered = 1 must be True or False"),
    ],
)
def test_scattered_cells_that_fit_no_columns_are_refused(rutstam_scene_module, lists, message):
    with pytest.raises(ValueError, match=message):
        tippe.inversion_table(rutstam_scene_module, t1=1.0, **{"scattered": True} | lists)


@pytest.mark.parametrize("arena", [tippe.Plane(), pytest.param(tippe.Cylinder(0.3), marks=pytest.mark.slow)])
def test_the_same_table_by_vmapped_diffrax(arena):
    """Equal to ten times the tolerance; status in every cell, contact loss among them."""
    scene = tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3))
    arguments = {"theta": THETA, "spin": [60.0, 110.0, 190.0], "t1": 12.0, "tolerance": 1e-9}
    fast = tippe.inversion_table(scene, **arguments)
    # Its pair errs a hundred times as much at the same tolerance.
    slow = tippe.inversion_table(scene, method="diffrax", **arguments | {"tolerance": 1e-11})
    assert (fast.status == slow.status).all()
    assert set(np.unique(fast.status)) == {"not_inverted", "inverted", "contact_lost"}
    inverted = fast.status == "inverted"
    assert_close(fast.time[inverted], slow.time[inverted], rtol=1e-8)
    # Diffrax looks for the loss of contact where steps end only, so it may miss a first, short one.
    assert np.all(fast.end_time <= slow.end_time + 1e-7)


@pytest.mark.slow
def test_starts_beyond_the_end_by_vmapped_diffrax():
    """On the ceiling of a cylinder and beyond the angle a run is over as it begins, by either method."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    arguments = {"theta": [0.1, 3.1], "eta": [0.0, 3.0], "spin": 150.0, "t1": 0.1, "tolerance": 1e-6}
    fast, slow = (tippe.inversion_table(scene, method=method, **arguments) for method in ("ensemble", "diffrax"))
    assert slow.status.tolist() == [["not_inverted", "contact_lost"], ["inverted", "contact_lost"]]
    for name in ("status", "time", "end_time"):
        np.testing.assert_array_equal(slow[name], fast[name])


@pytest.mark.slow
def test_contact_is_lost_where_the_normal_force_first_vanishes(rutstam_scene_module):
    table = tippe.inversion_table(rutstam_scene_module, theta=[0.1], spin=[190.0], t1=12.0, tolerance=1e-10)
    run = tippe.simulate(rutstam_scene_module, tippe.Launch(0.1, 190.0), 12.0, tolerance=1e-10)
    assert run.status == "contact_lost"
    assert_close(run.end_time, table.end_time[0, 0], atol=1e-7)
    assert_close(run.theta[-1], table.end_theta[0, 0], atol=1e-6)
    force = np.asarray(run.at(np.linspace(0.0, float(run.end_time), 40001)).normal_force)
    weight = 0.02 * 9.81
    assert force[:-1].min() > 0.0
    assert abs(force[-1]) < 1e-6 * weight


def test_a_further_axis_by_its_path(rutstam_scene_module):
    offsets = [0.005, 0.006]
    table = tippe.inversion_table(
        rutstam_scene_module, theta=0.1, spin=155.0, t1=20.0, axes={"scene.body.offset": offsets}
    )
    assert list(table.coords) == ["offset"]
    assert_close(table.time[1], 5.9693, atol=6e-5)


@pytest.mark.slow
def test_grids_larger_than_a_block_are_cut_and_joined(rutstam_scene_module, monkeypatch):
    """The order of cells survives blocks, threads and refilled lanes."""
    monkeypatch.setattr(sweeping, "chunk_for", lambda cells: 16)
    theta, spin = np.linspace(0.05, 0.6, 9), np.linspace(60.0, 200.0, 11)
    arguments = {"theta": theta, "spin": spin, "t1": 4.0, "tolerance": 1e-5, "solver": diffrax.Bosh3()}
    cut = tippe.inversion_table(rutstam_scene_module, **arguments)
    monkeypatch.undo()
    table = tippe.inversion_table(rutstam_scene_module, **arguments)
    assert (cut.status == table.status).all()
    assert_close(cut.end_theta, table.end_theta, atol=1e-9)
    assert_close(cut.end_time, table.end_time, rtol=1e-9)


def test_a_scene_that_changes_only_in_numbers_does_not_compile_again(rutstam_scene_module, caplog):
    other_scene = tippe.Scene(tippe.Top(0.03, 0.025, 0.005, 5e-6, 5.5e-6), tippe.Plane(), tippe.Viscous(0.2))
    # Not the module's table: what was compiled for it may have been forgotten since.
    tippe.inversion_table(rutstam_scene_module, theta=[0.1, 0.2, 0.3], spin=[100.0, 110.0], t1=1.0)
    with jax.log_compiles():
        tippe.inversion_table(other_scene, theta=[0.07, 0.11, 0.2], spin=[95.0, 130.0], t1=9.0)
    assert not [text for text in caplog.messages if "Finished XLA compilation" in text and "ensemble_solve" in text]


def test_mu_under_rolling_resistance_is_that_of_the_sliding_law():
    """So is its unit, and a table over the lever is one over any other number."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Rolling(1e-4, 1.0, tippe.Coulomb(0.3, 0.1)))
    arguments = {"theta": 0.1, "spin": 100.0, "t1": 0.01, "solver": diffrax.Bosh3()}
    table = tippe.inversion_table(scene, mu=[0.1, 0.2], axes={"scene.friction.resistance": [0.0, 1e-4]}, **arguments)
    assert table.coords.keys() == {"mu", "resistance"}
    assert (table.units["mu"], table.units["resistance"]) == ("1", "m")


ARENAS = (tippe.Plane(), tippe.Cylinder(0.3), tippe.Sphere(0.3))
LAWS = (tippe.Frictionless(), tippe.Viscous(0.3), tippe.Coulomb(0.3, 0.05), tippe.Contensou(0.3, 5e-4, 0.05))
SCENES = [(arena, law) for arena in ARENAS for law in (*LAWS, *(tippe.Rolling(1e-4, 1.0, law) for law in LAWS))]
#: What is compiled for a scene: a program that goes on beyond the event, one with slopes, and one by another method.
ASKED = (
    {"crossing": "both"},
    {"crossing": "last", "sensitivities": ["offset", "spin"]},
    {"solver": diffrax.Tsit5()},
)
#: A field of which components vanish identically, and the longest one.
QUICK = ((0, 2), (17, 0))


@pytest.mark.parametrize(
    ("arena", "law", "asked"),
    [
        pytest.param(*pair, asked, marks=[pytest.mark.oldest if (place, kind) in QUICK else pytest.mark.slow])
        for place, pair in enumerate(SCENES)
        for kind, asked in enumerate(ASKED)
    ],
)
@pytest.mark.filterwarnings("ignore:friction = Frictionless")
def test_every_scene_compiles(arena, law, asked):
    """XLA aborts on calls with arguments that they do not use: arenas and laws go through its single kernel here."""
    scene = tippe.Scene(rutstam_top(), arena, law)
    table = tippe.inversion_table(scene, theta=[0.1, 0.2], spin=[90.0, 95.0], t1=0.02, **asked)
    assert (table.status == "not_inverted").all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"theta": None}, "theta = None is not a number"),
        ({"spin": None}, "spin = None is not a number"),
        ({"axes": {"launch.theta": [0.1]}}, "'launch.theta' has its own argument"),
        ({"axes": [0.1]}, "axes = .* must be a dictionary"),
        ({"t1": [1.0, 2.0]}, r"t1 must be one number, not of shape \(2,\)"),
        ({"angle": [1.0, 2.0]}, r"angle must be one number, not of shape \(2,\)"),
        ({"path": 5}, "path = 5 must be the path of a file"),
        (
            {"axes": {"scene.body.radius": [0.01, 0.02], "scene.body.offset": [0.005, 0.015]}},
            "offset = 0.015 must be less than 0.01",
        ),
        ({"theta": []}, "theta must be a number or a non-empty list"),
        ({"theta": [0.1, math.nan]}, "theta = .* must be finite"),
        ({"theta": [0.1, 3.2]}, "theta = .* must be at most pi rad"),
        ({"theta": [[0.1]]}, "theta must be a number or a non-empty list"),
        ({"mu": [-0.1, 0.2]}, "mu = .* must be at least 0.0"),
        ({"axes": {"scene.body.weight": [1.0]}}, "axes: 'scene.body.weight' .*scene.body.mass"),
        ({"axes": {"scene.body.offset": [0.006, 0.03]}}, "offset = .* must be less than 0.02"),
        ({"method": "magic"}, "method = 'magic' must be"),
        ({"crossing": "last", "method": "diffrax"}, "crossing = 'last' must be 'first'"),
        ({"t1": 0.0}, "t1 = 0.0 must be greater than 0.0"),
        ({"t1": "8"}, "t1 = '8' is not a number"),
        ({"max_steps": 0.5}, "max_steps = 0.5 must be a whole number of at least 1"),
        ({"errors": "no"}, "errors = 'no' must be True or False"),
    ],
)
def test_bad_tables_are_refused_before_anything_compiles(rutstam_scene_module, change, message):
    with pytest.raises(ValueError, match=message):
        tippe.inversion_table(rutstam_scene_module, **({"theta": THETA, "spin": SPIN, "t1": 1.0} | change))


def test_a_frictionless_scene_has_no_mu_to_vary():
    scene = tippe.Scene(rutstam_top())
    with pytest.raises(ValueError, match=r"unknown axis: 'scene\.friction\.mu'"):
        tippe.inversion_table(scene, theta=0.1, spin=100.0, mu=[0.1, 0.2], t1=1.0)


def test_a_table_prints_and_draws(table):
    assert "theta (3), spin (2)" in str(table)
    assert "6 inverted (runs end when first inverted, and crossing='both' tells which stay so)" in str(table)
    figure = table.plot()
    assert figure.axes[0].get_xlabel() == "θ(0) [rad]"
    assert figure.axes[0].get_ylabel() == "first inversion time [s]"
    with pytest.raises(ValueError, match="variable = 'status' must be a numeric variable"):
        table.plot("status")
    with pytest.raises(AttributeError, match="the table has no 'tme'; it has time"):
        _ = table.tme


@pytest.mark.parametrize("arena", [pytest.param(tippe.Plane(), marks=pytest.mark.slow), tippe.Cylinder(0.3)])
def test_first_and_last_crossing_come_from_one_run(arena):
    """From the cylinder's wall theta swings past the angle and back, so the two differ; each is what its own table says."""
    scene = tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3))
    eta = 0.0 if isinstance(arena, tippe.Plane) else math.pi / 2.0
    arguments = {"theta": np.linspace(0.1, 0.4, 4), "spin": 100.0, "eta": eta, "t1": 15.0, "angle": 2.5}
    table = tippe.inversion_table(scene, crossing="both", errors=True, **arguments)
    first = tippe.inversion_table(scene, crossing="first", **arguments)
    last = tippe.inversion_table(scene, crossing="last", **arguments)
    assert_close(table.first_time, first.time, rtol=1e-11)
    assert_close(table.last_time, last.time, rtol=1e-11)
    assert table.status.tolist() == last.status.tolist()
    # These runs do not end at the first crossing.
    assert "(runs end" not in str(table) + str(last)
    assert last.label("time") == "last inversion time [s]"
    assert np.isfinite(table.first_time).any()
    if isinstance(arena, tippe.Cylinder):
        assert (table.last_time > table.first_time).any()
    assert table.digits("last_time").shape == table.digits("first_time").shape == (4,)
    assert "time" not in table.variables


@pytest.mark.slow
@pytest.mark.parametrize("name", ["last", "first"])
def test_both_crossings_through_phases(name):
    """Flights: the crossing of a run that goes on."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid")
    arguments = {"theta": [0.1], "spin": 200.0, "t1": 8.0}
    table = tippe.inversion_table(scene, crossing="both", **arguments)
    assert_close(table.variables[f"{name}_time"], tippe.inversion_table(scene, crossing=name, **arguments).time)


def test_both_crossings_have_no_one_derivative():
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
    with pytest.raises(ValueError, match="crossing = 'both' must be 'first' or 'last' for sensitivities"):
        tippe.inversion_table(scene, theta=[0.1], spin=100.0, t1=1.0, crossing="both", sensitivities=["friction.mu"])


def test_lists_of_places_on_a_closed_surface():
    """By (x, y, z), of which (0, 0, 0) is no place: where the top starts is checked cell by cell."""
    scene = tippe.Scene(rutstam_top(), tippe.Sphere(0.3), tippe.Viscous(0.3))
    arguments = {"theta": 0.1, "spin": 100.0, "t1": 0.01, "tolerance": 1e-6}
    places = {"launch.place[0]": [0.18, -0.18], "launch.place[2]": -0.24}
    table = tippe.inversion_table(scene, axes=places, **arguments)
    assert (table.status == "not_inverted").all()
    with pytest.raises(ValueError, match="distance"):
        tippe.inversion_table(scene, axes=places | {"launch.place[0]": [0.18, 0.2]}, **arguments)
