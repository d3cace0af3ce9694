"""`python -m tippe`, and `python -m tippe --paper`."""

import argparse
import dataclasses
import json

import numpy as np
import pytest
import xarray

import tippe
from nonholonomic.views.pages import NO_VIEW
from tippe import __main__ as job
from tippe.__main__ import main
from tippe.modes.problems import INVERTED
from tippe.paper import parser
from tippe.runs.view import theta_over_time

SMALL = ["--paper", "--theta", "0.1", "0.3", "--eta", "0", "--t1", "12", "--tolerance", "1e-7"]


@pytest.mark.slow
def test_the_papers_tables_are_printed_written_and_drawn(tmp_path, capsys):
    assert main([*SMALL, "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "numbers of the paper's Table 1 are lost" in printed
    assert "first [s]" in printed
    assert "9.98" in printed
    assert (tmp_path / "out" / "theta.png").read_bytes().startswith(b"\x89PNG")
    page_path = tmp_path / "out" / "index.html"
    assert printed.rstrip().endswith(f"To see it, open {page_path}")
    page = page_path.read_text()
    assert "<td>9.98" in page
    assert 'id="floats"' in page
    assert "data:image/png" in page
    with xarray.open_dataset(tmp_path / "out" / "cylinder.h5", engine="h5netcdf") as data:
        assert data["first_time"].dims == ("theta", "eta")
        assert json.loads(data.attrs["request"])["scene.surface"] == "Cylinder"
    # The same again is read from the files; another scene in the same folder is refused.
    assert main([*SMALL, "--out", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    assert main([*SMALL, "--mu", "0.2", "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr().err
    assert "scene.friction.mu is 0.3 in the file and 0.2 here" in printed


def test_the_main_job_prints_writes_and_draws(tmp_path, capsys, monkeypatch, rutstam_scene):
    """Its own top has a stem and a cylinder; these scenes have smaller programs, which other tests compile, too."""
    flying = dataclasses.replace(rutstam_scene, contact="hybrid")
    monkeypatch.setattr(job, "scene", lambda options, arena: flying)
    # A page that is kept would be that of other scenes.
    monkeypatch.setenv("NONHOLONOMIC_CACHE", "0")
    arguments = ["--theta", "6", "18", "--mu", "0.2", "0.3", "--rpm", "1480", "--t1", "8", "--out", str(tmp_path)]
    page_of_launch, horizons = job.page_of_launch, []
    monkeypatch.setattr(job, "page_of_launch", lambda *given: horizons.append(given[2]) or page_of_launch(*given))
    assert main(arguments) == 0
    # That of the tables.
    assert horizons == [8.0]
    printed = capsys.readouterr().out
    assert printed.startswith(
        "A wooden top: 17.8 g, 40 mm across, a stem 10 mm thick, its centre of mass 1.77 mm below"
    )
    assert "I1 / I3 = 0.952 lies between 1 - a / R = 0.911 and 1 + a / R = 1.089, so it can turn over." in printed
    slip = "Coulomb friction mu falls to zero below a slip speed of 0.05 m/s."
    assert slip in printed
    assert printed.rstrip().endswith(f"To see the top move, open {tmp_path / 'index.html'}")
    assert "4 of 8 tops have turned over within 8 s." in printed
    rows = [line.split() for line in printed.splitlines() if line.strip().startswith("18 deg")]
    run = tippe.simulate(rutstam_scene, tippe.Launch.degrees(18, 1480), 8.0)
    first = run.t[np.argmax(np.asarray(run.theta) > 0.95 * np.pi)]
    # A step of the run is up to 0.05 s long.
    assert [float(row[-1]) for row in rows] == pytest.approx([float(first)] * 2, abs=0.06)
    with xarray.open_dataset(tmp_path / "plane.h5", engine="h5netcdf") as data:
        assert data["time"].dims == ("theta", "mu")
    page = (tmp_path / "index.html").read_text()
    assert "<td>18 deg</td>" in page
    assert "4 of 8 tops have turned over within 8 s." in page
    assert "window.live" in page
    assert slip in page
    assert "A tippe top on a table" in page
    assert "data:image/png" in page
    # The same again, without three.js: the tables are read, and the page says what is missing.
    monkeypatch.setattr("nonholonomic.views.pages.PACKAGE", "no_such_package")
    assert main(arguments) == 0
    assert capsys.readouterr().out.rstrip().endswith(NO_VIEW)
    page = (tmp_path / "index.html").read_text()
    assert "<td>18 deg</td>" in page
    assert "window.live" not in page
    assert "jupyter-threejs-sage is not installed" in page
    # Other options in the same folder are refused in the words of the command line.
    assert main([*arguments, "--rpm", "1500"]) == 2
    printed = capsys.readouterr().err
    assert f"{tmp_path} holds another run: " in printed
    assert printed.rstrip().endswith(f"name another folder with --out, or remove {tmp_path}")


@pytest.mark.slow
def test_the_wooden_top_turns_over(tmp_path, capsys):
    """On the table and in the cylinder. The last cell of the cylinder stands on its stem for seconds before 171 deg."""
    assert main(["--out", str(tmp_path)]) == 0
    for arena in ("plane", "cylinder"):
        table = tippe.Table.load(tmp_path / f"{arena}.h5")
        assert (table.status == "inverted").all()
        np.testing.assert_array_equal(table.time, table.stem_time)
        # Neighbours differ little: no cell waits for an angle.
        assert np.abs(np.diff(np.log(table.time), axis=0)).max() < 0.3
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert (
        "A top has turned over when its stem first carries it (it may fall back); on a table the stem touches at 133 deg."
        in printed
    )
    scene = job.scene(job.parser().parse_args(["--mu", "0.5"]), "cylinder")
    times = np.array([3.0, 6.0, 10.0])
    theta = theta_over_time(scene, tippe.Launch.degrees(18, 1900), times, 1e-6, ("launch.theta", "scene.friction.mu"))
    np.testing.assert_allclose(np.degrees(theta[:2]), [145.0, 161.0], atol=8.0)
    assert theta[2] < INVERTED + 0.02


def test_the_same_command_reads_its_results_in_another_folder(tmp_path, capsys, monkeypatch, rutstam_scene):
    flying = dataclasses.replace(rutstam_scene, contact="hybrid")
    monkeypatch.setattr(job, "scene", lambda options, arena: flying)
    monkeypatch.setattr(job, "enable_compilation_cache", lambda: tmp_path)
    arguments = ["--theta", "6", "18", "--mu", "0.2", "0.3", "--rpm", "1480", "--t1", "8"]
    assert main([*arguments, "--out", str(tmp_path / "a")]) == 0
    first = capsys.readouterr().out
    assert "compilation included" in first

    def none(*arguments, **keywords):
        raise AssertionError("computed again")

    for name in ("theta_over_time", "sliders"):
        monkeypatch.setattr(job, name, none)
    assert main([*arguments, "--out", str(tmp_path / "b")]) == 0
    again = capsys.readouterr().out
    assert f"read from {tmp_path}, where an earlier run stored the results of these options" in again
    assert again[: again.index("8 runs")] == first[: first.index("8 runs")]
    for name in ("plane.h5", "cylinder.h5", "index.html", "theta.png"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes()
    # Other options are computed, and refused in a folder with other tables.
    assert main([*arguments, "--tolerance", "1e-5", "--out", str(tmp_path / "b")]) == 2
    assert "tolerance is 1e-06 in the file and 1e-05 here" in capsys.readouterr().err


def test_cells_in_the_folder_are_not_kept(tmp_path, monkeypatch, rutstam_scene):
    """Another version of the packages may have computed them."""
    monkeypatch.setattr(job, "scene", lambda options, arena: rutstam_scene)
    options = job.parser().parse_args(["--theta", "6", "--mu", "0.3", "--out", str(tmp_path)])
    job.table(options, "plane", None)
    job.table(options, "plane", tmp_path)
    assert not job.are_kept(tmp_path, job.facts(options, "plane"))
    (tmp_path / "plane.h5").unlink()
    job.table(options, "plane", tmp_path)
    assert job.are_kept(tmp_path, job.facts(options, "plane"))


def test_theta_over_time_is_that_of_the_run(rutstam_scene):
    """In contact and in flight; each time is a run of its own, and more times than one block of a table has."""
    scene, launch = dataclasses.replace(rutstam_scene, contact="hybrid"), tippe.Launch.degrees(18, 1480)
    times = np.linspace(0.0, 8.0, 70)
    theta = theta_over_time(scene, launch, times, 1e-9, ("launch.theta", "scene.friction.mu"))
    run = tippe.simulate(rutstam_scene, launch, 8.0, times=times)
    np.testing.assert_allclose(theta, run.theta, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--mass", "-1"], "mass = -1.0 must be greater than 0.0"),
        (["--offset", "0.03"], "offset = 0.03 must be less than 0.02"),
        (["--cylinder-radius", "0.01"], "surface radius = 0.01 must be greater than 0.02"),
        (["--theta", "4"], "theta = .*4.* must be at most pi rad"),
        (["--mu", "nan"], "mu = nan must be finite"),
        (["--out", "/proc/nowhere"], "/proc/nowhere"),
        (["--surface", "plane", "steep"], "--surface plane steep must be one of: sphere RADIUS, "),
        (["--surface", "torus", "0.3", "0.01"], r"tube = 0.01 must be greater than 0.02 \(the body must fit inside\)"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, capsys, tmp_path):
    import re

    assert main([*SMALL, "--out", str(tmp_path), *arguments]) == 2
    printed = capsys.readouterr().err.strip()
    assert re.search(message, printed)
    assert len(printed.splitlines()) == 1


def test_every_option_is_explained():
    for word in ("[deg]", "revolutions per minute", "--paper", "tippe.presets", "[m/s]"):
        assert word in job.parser().format_help()
    printed = parser().format_help()
    for word in ("mass [kg]", "cylinder", "[rad/s]", "slip speed", "horizon", "Table 1"):
        assert word in printed


def test_the_picture_of_one_launch_states_its_angle_and_fits_a_phone():
    options = argparse.Namespace(top="wooden", rpm=1900.0, mu=[0.1, 0.3, 0.5], theta=[3.0, 12.0, 18.0])
    times = np.linspace(0.0, 5.0, 11)
    plane = tippe.Table(
        {"theta": np.array(options.theta), "mu": np.array(options.mu)}, {"time": np.full((3, 3), 2.8)}, {}, {}
    )
    figure = job.picture(options, times, np.minimum(0.2 + times, 3.1), plane)
    assert figure.axes[0].get_title() == "wooden top, 1900 rpm, θ(0) = 12°, mu = 0.3, on a table"
    assert figure.axes[0].get_legend() is None
    assert figure.get_figwidth() <= 8.0
    assert figure.get_supxlabel().startswith("The dot is the time at which the stem first carries the top.")
    # Without a dot, nothing is said of one.
    plane.variables["time"][:] = np.inf
    assert job.picture(options, times, 0.2 + 0.0 * times, plane).get_supxlabel() == "Not turned over by 5 s."
