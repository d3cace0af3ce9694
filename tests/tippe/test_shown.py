"""Scenes and runs show themselves; numbers in another unit are suspected; a run goes to xarray, a file and a picture."""

import copy
import dataclasses
import json
import pickle
import re
import warnings

import jax
import numpy as np
import pytest
import xarray
from close import assert_close
from tops import rutstam_top

import nonholonomic
import tippe
from nonholonomic import views
from nonholonomic.views.stage import css
from tippe.__main__ import main

GOOD = {"mass": 0.02, "radius": 0.02, "offset": 0.006, "I1": 2.994e-6, "I3": 3.2e-6}


@pytest.fixture(scope="module")
def run():
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    return tippe.simulate(scene, tippe.Launch(0.1, 155.0), 1.0, tolerance=1e-6)


def test_a_scene_tells_its_numbers_with_units():
    scene = tippe.Scene(tippe.Top(**GOOD), tippe.Cylinder(0.3), tippe.Coulomb(0.3, 0.01))
    printed = str(scene)
    assert "Top(mass=0.02 kg, radius=0.02 m, offset=0.006 m, I1=2.994e-06 kg m², I3=3.2e-06 kg m²)" in printed
    assert "Cylinder(radius=0.3 m)" in printed
    assert "Coulomb(mu=0.3, slip_speed=0.01 m/s)" in printed
    assert "gravity   9.81 m/s²" in printed
    assert "Cylinder(radius=0.3 m)" in scene._repr_html_()
    with pytest.raises(ValueError, match=re.escape("friction = Cylinder(radius=0.3 m) must be")):
        tippe.Scene(tippe.Top(**GOOD), friction=tippe.Cylinder(0.3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 20.0}, "radius = 20 m is unusual for a top: was it in mm? Then radius=0.02"),
        ({"radius": 2.0}, "radius = 2 m is unusual for a top: was it in cm? Then radius=0.02"),
        ({"radius": 300.0}, "radius = 300 m is large for a top: was it in mm?"),
        (
            {"I1": 29.94, "I3": 32.0},
            "I1 = 29.94 kg m², I3 = 32 kg m² are unusual for a top: were they in g cm^2? Then I1=2.994e-06",
        ),
        ({"mass": 20.0}, "mass = 20 kg is unusual for a top: was it in g? Then mass=0.02"),
        (
            {"I1": [2.994e-6, 1e-3], "I3": 3.2e-6},
            "I1 = 125 m R^2 is unusual for a top: are mass, radius and I1 in kg, m",
        ),
        (
            {"mass": [0.02, 1.0, 20.0], "I1": [3e-6, 1.5e-4, 3e-3], "I3": [3.2e-6, 1.6e-4, 3.2e-3]},
            "mass = 5.97e+05 kg/m^3",
        ),
        # All in g and mm, with the moments of inertia in SI units or in g mm^2.
        (
            {"mass": 18.0, "radius": 19.0, "offset": 6.0},
            "mass = 18 kg, radius = 19 m, offset = 6 m are unusual for a top: were they in g and in mm? "
            "Then mass=0.018, radius=0.019, offset=0.006",
        ),
        (
            {"mass": 18.0, "radius": 19.0, "offset": 6.0, "I1": 2600.0, "I3": 2650.0},
            "were they in g and in mm? Then mass=0.018, radius=0.019, offset=0.006, I1=2.6e-06, I3=2.65e-06",
        ),
        # With the moments of inertia of the top, and computed from the diameter.
        ({"radius": 0.04}, "radius = 0.04 m is unusual for a top: was it the diameter? Then radius=0.02"),
        ({"radius": 0.04, "I1": 1.2e-5, "I3": 1.28e-5}, "was it the diameter? Then radius=0.02, I1=3e-06, I3=3.2e-06"),
    ],
)
def test_another_unit_is_suspected(change, message):
    with pytest.warns(UserWarning, match=re.escape(message)) as caught:
        tippe.Top(**GOOD | change)
    assert len(caught) == 1


def test_light_tops_and_those_in_units_of_their_own_are_not_suspected():
    # A table-tennis ball, and a top with unit mass and unit radius.
    tippe.Top(2.7e-3, 0.02, 0.0, 7.2e-7, 7.2e-7)
    tippe.Top(1.0, 1.0, 0.3, 0.374, 0.4)


def test_a_suspicion_is_told_once():
    with warnings.catch_warnings(record=True) as records:
        warnings.simplefilter("default")
        for _ in range(3):
            tippe.Top(**GOOD | {"mass": 21.0})
    assert len(records) == 1


def test_theta_changes_at_its_rate(run):
    times = np.linspace(0.2, 0.8, 601)
    fine_run = run.at(times)
    slopes = np.gradient(np.asarray(fine_run.theta), times)
    assert_close(fine_run.theta_rate[1:-1], slopes[1:-1], atol=0.02 * np.abs(slopes).max())


def test_a_run_goes_to_xarray_and_to_a_file(run, tmp_path):
    data = run.to_xarray()
    assert data["theta"].dims == ("time",)
    assert data["position"].dims == ("time", "component")
    assert data["theta"].attrs == {"units": "rad", "long_name": "inclination θ"}
    np.testing.assert_array_equal(data["normal_force"], run.normal_force)
    run.save(tmp_path / "run.h5")
    with xarray.open_dataset(tmp_path / "run.h5", engine="h5netcdf") as dataset:
        assert set(dataset.variables) == set(data.variables)
        np.testing.assert_array_equal(dataset["axis"], run.axis)
    table = tippe.Table.load(tmp_path / "run.h5")
    np.testing.assert_array_equal(table["work"], run.work)
    assert '"status": "completed"' in table.attributes["request"]
    assert json.loads(table.attributes["request"])["launch.spin"] == float(run.launch.spin)


def test_a_portrait_draws_one_quantity_over_another(run):
    drawing = run.portrait().axes[0]
    assert_close(drawing.get_lines()[0].get_xdata(), run.theta)
    assert_close(drawing.get_lines()[0].get_ydata(), run.theta_rate)
    assert drawing.get_xlabel() == "inclination θ [rad]"
    path = run.portrait("position.x", "position.y").axes[0]
    assert_close(path.get_lines()[0].get_ydata(), run.position[:, 1])
    assert path.get_aspect() == 1.0
    with pytest.raises(ValueError, match=r"y = 'position' must be one of theta, .*position\.x"):
        run.portrait("theta", "position")


def test_a_run_shows_itself(run):
    assert "completed at 1 s\n  Launch(theta=0.1 rad, spin=155 rad/s, eta=0 rad, azimuth=0 rad)\n  theta: 0.1" in repr(
        run
    )
    assert "completed at 1 s" in run._repr_html_()


def test_a_run_tells_whether_the_top_turned_over(run):
    assert "not turned over\n" in str(run)
    inverted = tippe.simulate(run.scene, tippe.Launch(2.9, 300.0), 1.0, tolerance=1e-6)
    assert f"turned over at {inverted.inversion_time:.6g} s" in str(inverted)
    assert 0.0 < inverted.inversion_time < 1.0
    group_I = tippe.Top(**GOOD | {"offset": 0.002, "I1": 2.5e-6})
    upright = tippe.simulate(
        tippe.Scene(group_I, friction=tippe.Viscous(0.3)), tippe.Launch(0.1, 155.0), 1.0, tolerance=1e-6
    )
    assert "not turned over: a top of group I (tippe.steady.group) cannot" in str(upright)
    slow, still = (tippe.simulate(run.scene, tippe.Launch(theta, 20.0), 1.0, tolerance=1e-6) for theta in (0.1, 0.0))
    assert "not turned over: below 27.65 rad/s, it is stable upright" in str(slow)
    assert "not turned over: it starts exactly upright" in str(still)
    sliding = tippe.simulate(tippe.Scene(rutstam_top()), tippe.Launch(0.1, 155.0), 0.1, tolerance=1e-6)
    assert "not turned over: without friction no top turns over" in str(sliding)


def test_a_top_that_fell_back_is_not_called_inverted(run, monkeypatch):
    monkeypatch.setattr(tippe.Trajectory, "inversion_time", 0.4)
    assert "turned over at 0.4 s, but fell back\n" in str(run)
    ((time, words),) = run.marks
    assert (time, words) == (0.4, "turned over at 0.4 s, fell back")


def test_one_time_is_a_time(run):
    assert_close(run.at(0.5).theta, run.at([0.5]).theta)
    assert run.at(0.5).position.shape == (1, 3)


def test_a_run_goes_to_pandas(run, tmp_path):
    frame = run.to_dataframe()
    assert_close(frame["position.x"], run.position[:, 0])
    assert frame.attrs["units"]["theta"] == "rad"
    in_degrees = run.to_dataframe(unit=("deg", "rpm"))
    assert_close(in_degrees["theta [deg]"], np.degrees(run.theta), rtol=1e-12)
    assert_close(in_degrees["spin [rpm]"], np.asarray(run.spin) * 30.0 / np.pi, rtol=1e-12)
    assert_close(in_degrees["position.x [m]"], frame["position.x"])
    assert (in_degrees.attrs["units"]["theta"], in_degrees.attrs["units"]["spin"]) == ("deg", "rpm")
    # Back again, by a file; a launch in degrees needs no other words.
    stated = dataclasses.replace(run, launch=tippe.Launch.degrees(theta=5.0, rpm=1500.0)).to_dataframe()
    assert stated.equals(in_degrees)
    stated[["time [s]", "theta [deg]"]].to_csv(tmp_path / "run.csv", index=False)
    recording = tippe.read_recording(tmp_path / "run.csv", launch=run.launch)
    assert_close(np.ravel(recording.value), run.theta, rtol=1e-12)
    with pytest.raises(ValueError, match="unit = 'degree celsius' must be one of"):
        run.to_dataframe(unit="degree celsius")
    with pytest.raises(
        AttributeError, match=re.escape("no 'to_datafrme'; did you mean 'to_dataframe'? It has t, theta")
    ):
        _ = run.to_datafrme
    with pytest.raises(AttributeError, match=re.escape("no 'xqxqx'. It has t, theta, eta")):
        _ = run.xqxqx
    with pytest.raises(AttributeError, match="no 'to_csv'; files of other programs come from to_dataframe"):
        _ = run.to_csv


def test_quantities_are_drawn_over_time_by_name_and_in_degrees(run):
    panels = run.plot("theta", "position", unit="deg").axes
    assert_close(panels[0].get_lines()[0].get_ydata(), np.degrees(run.theta))
    assert [panel.get_ylabel() for panel in panels] == ["inclination θ [deg]", "position of the centre [m]"]
    assert panels[1].get_xlabel() == "time [s]"
    assert [text.get_text() for text in panels[1].get_legend().get_texts()] == ["x", "y", "z"]
    assert_close(panels[1].get_lines()[1].get_ydata(), run.position[:, 1])
    assert [line.get_color() for line in panels[1].get_lines()] == [css(colour) for colour in views.COLOURS[:3]]
    (component,) = run.plot(["position.y"], unit=("cm", "ms")).axes
    assert (component.get_ylabel(), component.get_xlabel()) == ("position of the centre, y\n[cm]", "time [ms]")
    assert_close(component.get_lines()[0].get_xydata(), np.stack([1e3 * run.t, 100.0 * run.position[:, 1]], axis=-1))
    (spin,) = run.plot("spin", unit=["deg", "rpm"]).axes
    assert spin.get_ylabel() == "spin ω₃ [rpm]"
    portrait = run.portrait(unit="deg").axes[0]
    assert_close(portrait.get_lines()[0].get_ydata(), np.degrees(run.theta_rate))
    assert portrait.get_ylabel() == "θ' [deg/s]"
    curves = run.plot(unit="deg").axes
    assert curves[0].get_ylabel() == "inclination θ [deg]"
    slower = run.at([0.5, 1.0])
    tilted = dataclasses.replace(slower, scene=tippe.Scene(run.scene.body, tippe.Plane(0.1), run.scene.friction))
    legend = run.plot("theta", others=[tilted], unit=("deg", "rpm")).axes[0].get_legend()
    theta, spin = np.degrees(slower.theta[0]), float(slower.spin[0]) * 30.0 / np.pi
    assert legend.get_texts()[1].get_text() == f"θ {theta:.3g} deg, {spin:.4g} rpm, …"


def test_a_launch_in_degrees_is_shown_in_degrees(run):
    """In texts, pictures and pages, unless another unit is asked for; the numbers themselves are in SI units."""
    launch = tippe.Launch.degrees(theta=6, rpm=1500)
    assert repr(launch) == "Launch(theta=6 deg, spin=1500 rpm, eta=0 deg, azimuth=0 deg)"
    assert_close(launch.theta, np.radians(6.0), rtol=1e-15)
    in_degrees = tippe.simulate(run.scene, launch, 1.0, tolerance=1e-6)
    assert in_degrees.launch is launch
    # A table shows the least and the greatest value, in other words.
    assert f"theta: 6 deg at the start, {np.degrees(in_degrees.theta[-1]):.6g} deg at the end" in str(in_degrees)
    assert re.search(r"theta.*: \S+ to \S+", str(in_degrees.to_table()))
    (panel,) = in_degrees.plot("theta").axes
    assert_close(panel.get_lines()[0].get_ydata(), np.degrees(in_degrees.theta))
    assert in_degrees.plot("theta", unit="rad").axes[0].get_ylabel() == "inclination θ [rad]"
    # A quantity without an angle, in its own unit.
    assert in_degrees.plot("energy").axes[0].get_ylabel() == "energy [J]"
    assert in_degrees.portrait().axes[0].get_xlabel() == "inclination θ [deg]"
    assert "theta [deg]: " in repr(in_degrees.to_table())
    assert r'\u03b8", "unit": "deg"' in in_degrees.view().html
    assert r'\u03b8", "unit": "deg"' in in_degrees.explore().html
    several = tippe.InversionTimes([launch, tippe.Launch(0.1, 155.0)], [5.0, 6.0], 0.1, t1=20.0).launch
    assert_close(several.theta, [np.radians(6.0), 0.1], rtol=1e-15)
    assert "spin=[1500, 1480.14] rpm" in repr(several)
    for copied in (pickle.loads(pickle.dumps(launch)), copy.deepcopy(launch)):
        assert repr(copied) == repr(tippe.Launch(launch.theta, launch.spin))
    # Its structure is that of any launch; the numbers of a gradient are no angles.
    assert jax.tree.structure(launch) == jax.tree.structure(tippe.Launch(0.1, 155.0))
    assert repr(jax.grad(lambda launch: 2.0 * launch.spin)(launch)).startswith("Launch(theta=0 rad, spin=2 rad/s")
    assert "velocity=(0.1, 0.2, 0.3) rad/s" in repr(tippe.Launch.degrees(6, 1500, angular_velocity=(0.1, 0.2, 0.3)))
    again = nonholonomic.simulate(run.scene, launch, 1.0, tolerance=1e-6)
    assert again.plot("theta").axes[0].get_ylabel() == "inclination θ [deg]"
    assert r'\u03b8", "unit": "deg"' in nonholonomic.explore(run.scene, launch, t1=1.0).html


def test_labels_are_what_differs(run):
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.2))
    other = tippe.simulate(scene, tippe.Launch(0.1, 155.0), 1.0, tolerance=1e-6)

    def texts(**options):
        return [
            text.get_text() for text in run.plot("theta", others=[other], **options).axes[0].get_legend().get_texts()
        ]

    assert texts() == ["mu 0.3 s/m", "mu 0.2 s/m"]
    assert texts(label=["rough", "smooth"]) == ["rough", "smooth"]
    figures = [run.plot(others=[other]), run.plot("theta", others=[other])]
    colours = [[line.get_color() for line in figure.axes[0].get_lines()] for figure in figures]
    assert colours == [[css(colour) for colour in views.COLOURS[:2]]] * 2
    legend = figures[0].axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["mu 0.3 s/m", "mu 0.2 s/m"]
    # A name stands above one panel; lines beyond the colours are dashed.
    _, slip, last = run.plot("theta", "slip", "energy", others=[other]).axes
    assert [text.get_text() for text in slip.get_legend().get_texts()] == ["t1", "t2"]
    assert last.get_legend() is None
    first, *_, seventh = run.plot("theta", others=6 * [other]).axes[0].get_lines()
    assert seventh.get_color() == first.get_color()
    assert [first.get_linestyle(), seventh.get_linestyle()] == ["-", "--"]
    (panel,) = run.plot("theta", label="my top").axes
    assert panel.get_legend().get_texts()[0].get_text() == "my top"
    assert run.plot("theta").axes[0].get_legend() is None
    assert run.plot("theta").get_suptitle() == run.plot().get_suptitle() == "rutstam top, θ(0) = 0.1 rad, 155 rad/s"
    long = [f"a rough table at {k} degrees Celsius, in the morning" for k in (20, 30)]
    assert texts(label=long) == ["a rough table at 20 degrees C…", "a rough table at 30 degrees C…"]
    for options in ({}, {"overlaid": True}):
        stages = run.stages([other], label=["rough", "smooth"], **options)
        assert [show.name for stage in stages for show in stage.shows] == ["rough", "smooth"]
    assert "<title>rough; smooth</title>" in run.view(others=[other], label=["rough", "smooth"]).html
    assert "<title>my top</title>" in run.explore(label="my top").html
    with pytest.raises(ValueError, match=re.escape("label = 'my top' must have 2 texts, one for each run")):
        run.view(others=[other], label="my top")
    assert other.plot("energy", ax=panel) is panel
    assert len(panel.get_lines()) == 2


def test_pictures_and_pages_mark_when_a_top_has_turned_over(run):
    turned = tippe.simulate(run.scene, tippe.Launch(3.1, 155.0), 1.0, tolerance=1e-6)
    words = "turned over at 0 s"
    assert (turned.marks, run.marks) == (((0.0, words),), ())
    assert turned.stages()[0].shows[0].marks == turned.marks
    assert words in turned.view().html
    assert words not in run.view().html
    for figure in (turned.plot("theta", "spin"), turned.plot()):
        first, second, *_ = figure.axes
        assert [text.get_text() for text in first.get_legend().get_texts()] == [words]
        assert second.get_legend() is None
        for panel in (first, second):
            assert panel.get_lines()[-1].get_linestyle() == ":"
            assert panel.get_lines()[-1].get_xdata() == [0.0, 0.0]


def test_plots_that_cannot_be_drawn_are_refused(run):
    for arguments, options, message in (
        (("tehta",), {}, "quantity = 'tehta' must be one of theta, .*did you mean 'theta'"),
        (("theta",), {"unit": "mm"}, r"unit = 'mm' fits nothing that is drawn: theta \[rad\], time \[s\]"),
        ((), {"unit": "%"}, "unit = '%' must be one of"),
        (("theta",), {"unit": "dge"}, "unit = 'dge' must be one of s, ms, .*did you mean 'deg'"),
        (("theta", "spin"), {"ax": object()}, "ax takes one quantity, not 2: theta, spin"),
        ((), {"ax": object()}, "ax takes one quantity: name it"),
        ((run,), {}, r"others = a run must be a list of runs: write others=\[run\]"),
        (("theta",), {"label": ["a", "b"]}, r"label = \['a', 'b'\] must have 1 texts"),
        (("theta", 3.0), {}, r"quantity = 3\.0 must name a quantity, such as 'theta'"),
    ):
        with pytest.raises(ValueError, match=message):
            run.plot(*arguments, **options)


@pytest.mark.parametrize(("command", "package"), [(main, tippe)])
def test_the_command_tells_its_version(command, package, capsys):
    with pytest.raises(SystemExit, match="0"):
        command(["--version"])
    assert capsys.readouterr().out.strip() == f"nonholonomic {package.__version__}"
    with pytest.raises(SystemExit, match="0"):
        command(["--help"])
    assert "default: None" not in capsys.readouterr().out


def test_a_folder_that_cannot_be_written_is_refused_first(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("tippe.__main__.inversion_table", lambda *arguments, **options: pytest.fail("it ran"))
    (tmp_path / "file").write_text("")
    assert main(["--out", str(tmp_path / "file")]) == 2
    assert "--out = " in capsys.readouterr().err
