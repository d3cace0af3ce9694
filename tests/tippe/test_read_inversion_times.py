"""Launches and measured times from the file of a class."""

import math

import numpy as np
import pytest

import tippe

#: A file of a class: comments, units in headers, decimal commas, lost measurements, and a top that did not turn over.
CLASS = """# class 8b, wooden top

angle [deg];spin [rpm];time [s];group
4,0;1100;3,47;A
4,0;1250;n/a;A
5,5;1400;3,49;B

5,5;;3,60;B
4,0;600;{};C
"""
COLUMNS = {"theta": "angle", "spin": ("spin", "rpm"), "time": ("time [s]", "s")}
OPTIONS = {"error": 0.05, "t1": 30.0, "decimal": ","}


def read(folder, text, columns=COLUMNS, **options):
    (folder / "class.csv").write_text(text, encoding="utf-8")
    return tippe.read_inversion_times(folder / "class.csv", columns, **OPTIONS | options)


@pytest.mark.parametrize(
    ("cell", "options", "until"),
    [
        ("inf", {}, None),
        ("-", {"never": "-", "until": 10.0}, 10.0),
        ("\u2014", {"never": ["-", "\u2014"]}, None),
        ("stays up", {"never": "stays up"}, None),
        (">20", {}, [30.0, 30.0, 20.0]),
        ("> 20,0", {"until": 10.0}, [10.0, 10.0, 20.0]),
    ],
)
def test_the_file_of_a_class_becomes_launches_and_times(tmp_path, cell, options, until):
    data = read(tmp_path, CLASS.format(cell), **options)
    np.testing.assert_allclose(data.launch.theta, np.radians([4.0, 5.5, 4.0]))
    np.testing.assert_allclose(data.launch.spin, np.array([1100.0, 1400.0, 600.0]) * math.pi / 30.0)
    np.testing.assert_allclose(data.time, [3.47, 3.49, np.inf])
    assert data.labels[1] == "theta 5.5 deg, spin 1400 rpm"
    assert (float(data.error), float(data.t1)) == (0.05, 30.0)
    assert (data.until is None) == (until is None)
    np.testing.assert_allclose(data.until or [] if until is None else data.until, until or [])


def test_numbers_without_a_column_are_those_of_the_launch_and_errors_may_have_a_column(tmp_path):
    text = "spin [rpm],time [s],reading [ms]\n1000,3.2,50\n1200,3.4,100\n"
    launch = tippe.Launch(0.1, 0.0, velocity=(0.0, 0.2))
    data = read(tmp_path, text, None, launch=launch, error={"time": "reading"}, decimal=".", student=4.0)
    assert float(data.launch.theta) == launch.theta
    assert float(data.launch.velocity[1]) == 0.2
    np.testing.assert_allclose(data.launch.spin, np.array([1000.0, 1200.0]) * math.pi / 30.0)
    np.testing.assert_allclose(data.error, [0.05, 0.1])
    assert float(data.student) == 4.0


@pytest.mark.parametrize(
    ("cell", "change", "message"),
    [
        ("-", {}, "time .s. = '-' in line 9 .* pass never='-' if it did not happen; write n/a for a lost measurement"),
        ("stays", {}, "time .s. = 'stays' in line 9 .* is not a number: if it stands for .* pass it as never"),
        ("0", {}, "time .s. = '0' in line 9 of .* must be greater than 0"),
        ("4,2", {"decimal": "."}, "time .s. = '3,47' in line 4 .* pass decimal=','"),
        ("4,2", {"never": 3}, "never = 3 must be a text, such as '-', or a list of them"),
        ("4,2", {"error": {"time": 0.05}}, "error: 'time' = 0.05 must be .standard error, unit., such as .1.0, 's'."),
        (
            "4,2",
            {"error": {"theta": 1.0}},
            "error = {'theta': 1.0} must be {'time': .standard error, unit.} or a number",
        ),
        ("4,2", {"error": [0.05, 0.1]}, "error must be one number .s."),
        ("4,2", {"error": 0.0}, "error = 0.0 must be greater than 0.0"),
        ("4,2", {"columns": {"theta": "angle", "spin": "spin"}}, "must have 'time', the measured time of each launch"),
        ("4,2", {"columns": {"spin": "spin", "time": "time"}}, "must have 'theta', or launch must be a Launch"),
        (
            "4,2",
            {"columns": COLUMNS | {"spin": ("spin", "rad/s")}},
            "contradicts the header 'spin .rpm.', whose unit is rpm",
        ),
        (
            "4,2",
            {"columns": COLUMNS | {"tilt": "angle"}},
            "columns: 'tilt' must be one of time, theta, spin, eta, azimuth",
        ),
        (
            "4,2",
            {"columns": COLUMNS | {"theta": ("angle", 1.0)}},
            "theta = 4 rad in line 4 .*: is the column in degrees",
        ),
        ("4,2", {"columns": None}, "columns must have 'theta', or launch must"),
        ("4,2", {"launch": 3.0}, "launch = 3.0 must be a Launch"),
        ("4,2", {"t1": 4.0}, "time = 4.2 must be less than 4.0"),
    ],
)
def test_faults_of_a_file_are_named(tmp_path, cell, change, message):
    columns, options = (
        change.get("columns", COLUMNS),
        {name: part for name, part in change.items() if name != "columns"},
    )
    with pytest.raises(ValueError, match=message):
        read(tmp_path, CLASS.format(cell), columns, **options)


def test_a_file_without_a_whole_line_is_refused(tmp_path):
    with pytest.raises(ValueError, match="must have at least one line with theta, spin, time"):
        read(tmp_path, "angle [deg];spin [rpm];time [s]\n4;n/a;3,4\n4;1000;\n")


def test_a_recording_names_the_reader_of_launches(tmp_path):
    (tmp_path / "class.csv").write_text(CLASS.format("3,4"))
    with pytest.raises(ValueError, match=r"time = 3.4 s in line 9 .* tippe.read_inversion_times for a file"):
        tippe.read_recording(tmp_path / "class.csv", COLUMNS, launch=tippe.Launch(0.1, 0.0), decimal=",")
    with pytest.raises(ValueError, match=r"increasing list: a recording is one run, .* use tippe.InversionTimes"):
        tippe.Recording(tippe.Launch(0.1, 0.0), [3.47, 3.4], [0.1, 0.1], 0.1)
