"""Recorded motion of tops: fitted from start to end, read from files, refused."""

import math

import jax
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top
from viscous_top import Body, azimuth, follow, start, theta

import stroller
import tippe


def problem_of(scene, data, free):
    return tippe.log_density(scene, data, free).problem


LAUNCHES = {"theta": (0.4, 0.5), "spin": (100.0, 110.0), "azimuth": (0.7, 3.0), "t0": (0.013, 0.2), "samples": (30, 24)}
LAUNCHES |= {"velocity[0]": (0.0, 0.08)}
NOISE, MU = 0.01, 0.3


def film(k):
    """Times [s] of a camera's clock, theta and azimuth [rad] of a top of the independent program, with noise."""
    top, count = rutstam_top(), LAUNCHES["samples"][k]
    body = Body(top.mass, top.radius, top.offset, top.I1, top.I3, MU)
    clock = (0.02 if k == 0 else 0.21) + 0.01 * np.arange(count)
    state = start(body, LAUNCHES["theta"][k], LAUNCHES["spin"][k])
    # The program's top leans along x; the whole is turned by the azimuth afterwards.
    turn = LAUNCHES["azimuth"][k]
    state[3:5] += LAUNCHES["velocity[0]"][k] * np.array([math.cos(turn), -math.sin(turn)])
    states = follow(body, state, clock - LAUNCHES["t0"][k])
    exact = np.stack([theta(states), azimuth(states) + LAUNCHES["azimuth"][k]], axis=1)
    value = exact + NOISE * np.random.default_rng(k).normal(size=exact.shape)
    # A camera sees an azimuth up to whole turns.
    value[:, 1] = (value[:, 1] + math.pi) % (2.0 * math.pi) - math.pi
    return clock, value


@pytest.fixture(scope="module")
def fit(tmp_path_factory, rutstam_scene):
    """Friction from two films, each with its own launch and unknown clock and azimuth; one is read from a file, with samples
    that are missing; of the other one the errors and the velocity of the hand are not known."""
    path = tmp_path_factory.mktemp("films") / "film.csv"
    clock, value = film(0)
    value[5], value[7, 1], value[11] = np.nan, np.nan, np.nan
    cells = [f"{1e3 * t:.9g};{math.degrees(a):.9g};{p:.9g}" for t, (a, p) in zip(clock, value, strict=True)]
    path.write_text("# a film\nt / ms;tilt;azimuth\n" + "\n".join(cells).replace("nan", "") + "\n")
    columns = {"time": ("t / ms", "ms"), "theta": ("tilt", "deg"), "azimuth": ("azimuth", "rad")}
    error = {"theta": (math.degrees(NOISE), "deg"), "azimuth": (NOISE, "rad")}
    first = tippe.read_recording(path, columns, launch=tippe.Launch(0.4, 100.0, velocity=(0.0, 0.0)), error=error)
    second = tippe.Recording(tippe.Launch(0.5, 110.0, velocity=(0.0, 0.0)), *film(1), None, ("theta", "azimuth"))
    free = {"mu": 0.2, "data[0].launch.azimuth": 0.5, "data[1].launch.azimuth": 2.7, "data[0].t0": 0.01}
    free |= {"data[1].t0": tippe.Free(0.19, prior=(0.2, 0.05)), "data[1].launch.velocity[0]": 0.0}
    return tippe.identify(rutstam_scene, [first, second], free)


def test_friction_from_a_film(rutstam_scene, tmp_path):
    """The short form of the two films: theta alone, in degrees, a sample missing, by a clock that is not known."""
    clock, value = film(0)
    value[5, 0] = np.nan
    cells = [f"{t:.15g},{math.degrees(angle):.15g}" for t, (angle, _) in zip(clock, value, strict=True)]
    (tmp_path / "film.csv").write_text("time [s],theta [deg]\n" + "\n".join(cells))
    error = {"theta": (math.degrees(NOISE), "deg")}
    recording = tippe.read_recording(tmp_path / "film.csv", launch=tippe.Launch(0.4, 100.0), error=error)
    fit = tippe.identify(rutstam_scene, recording, {"mu": 0.2, "data[0].t0": 0.01}, tolerance=1e-6, progress=False)
    assert fit.status == "converged"
    assert len(fit.residuals) == len(clock) - 1
    assert fit.units == {"scene.friction.mu": "s m-1", "data[0].t0": "s"}
    for name, exact in {"scene.friction.mu": MU, "data[0].t0": LAUNCHES["t0"][0]}.items():
        assert abs(fit.estimates[name] - exact) < 4.0 * fit.standard_errors[name], name
    assert fit.standard_errors["scene.friction.mu"] < 0.05
    # Texts and pictures are in the unit of the file; the numbers are in SI units.
    assert_close([row.value for row in fit.residuals[:5]], value[:5, 0], rtol=1e-12)
    first = fit.residuals[0]
    measured = f" {math.degrees(first.value):.6g} +- {math.degrees(NOISE):.2g}"
    row = f"{measured:20}  {math.degrees(first.prediction):.6g} deg  {first.residual:+.2f}"
    assert row in fit.details
    assert_close(first.residual, (first.value - first.prediction) / NOISE)
    # A launch that was measured is not exact.
    assert "no concerns, but held fixed as if exact: launch.theta and launch.spin; if these" in str(fit)
    panel = fit.plot().axes[0]
    assert panel.get_ylabel() == "theta [deg]"
    assert_close(panel.containers[0].lines[0].get_ydata(), [math.degrees(row.value) for row in fit.residuals])
    assert fit.plot(unit="rad").axes[0].get_ylabel() == "theta [rad]"


@pytest.mark.slow
def test_friction_from_two_films_with_clocks_and_azimuths_of_their_own(fit):
    truth = {"scene.friction.mu": MU}
    truth |= {
        f"data[{k}].{name}": LAUNCHES[name.split(".")[-1]][k] for k in (0, 1) for name in ("launch.azimuth", "t0")
    }
    truth["data[1].launch.velocity[0]"] = LAUNCHES["velocity[0]"][1]
    assert fit.status == "converged"
    assert set(fit.estimates) == set(truth)
    for name, value in truth.items():
        assert abs(fit.estimates[name] - value) < 4.0 * fit.standard_errors[name], name
    assert fit.standard_errors["scene.friction.mu"] < 0.02
    assert fit.verdict.good, str(fit)


@pytest.mark.slow
def test_missing_samples_are_left_out_and_unknown_errors_are_found(fit):
    labels = [row.label for row in fit.residuals]
    assert len(labels) == 2 * (30 + 24) - 5
    assert "1: theta(70 ms)" not in labels
    assert "1: theta(90 ms)" in labels
    assert "1: azimuth(90 ms)" not in labels
    # Each column of the second film has an error of its own.
    for column in ("theta", "azimuth"):
        errors = {row.error for row in fit.residuals if row.label.startswith(f"2: {column}")}
        assert len(errors) == 1
        assert 0.6 * NOISE < errors.pop() < 1.5 * NOISE
    assert math.isnan(fit.verdict.p_value)
    assert len(fit.verdict.series) == 4


TIMED = {"time": ("t", "s"), "theta": ("tilt", "deg")}
HEADERS = "t,tilt,x\n0.0,5,1\n0.1,6,2\n"


@pytest.mark.parametrize(
    ("text", "columns", "fps", "message"),
    [
        (HEADERS, {}, 25.0, "columns = {} must be a dictionary"),
        (HEADERS, {"theta": ("tilt", "mm")}, 25.0, "unit of theta = 'mm' must be one of rad, deg, rev"),
        (HEADERS, {"theta": ("angle", "deg")}, 25.0, "'angle' must be one of the headers of"),
        (HEADERS, {"theta": "tilt"}, 25.0, r"'theta' = 'tilt' must be \(header, unit\)"),
        (HEADERS, {"phi": ("tilt", "deg")}, 25.0, "columns: 'phi' must be one of time, frame, theta"),
        (HEADERS, {"t": ("t", "s")}, None, "columns: 't' must be one of time, frame, theta, .*; did you mean 'time'"),
        (HEADERS, {"position": ("x", "m")}, 25.0, "'position' must be a single column"),
        (HEADERS, {"theta": ("tilt", "deg")}, None, "fps must be given"),
        (HEADERS, {"time": ("t", "s"), "theta": ("tilt", "deg")}, 25.0, "fps = 25.0 must be omitted"),
        (HEADERS.replace("6", "six"), {"theta": ("tilt", "deg")}, 25.0, "tilt = 'six' in line 3"),
        (HEADERS + "1\n", {"theta": ("tilt", "deg")}, 25.0, "line 4 has 1 cells, not 3"),
        # The numbers of lines are those of the file.
        ("# a film\n\n" + HEADERS.replace("6", "six"), {"theta": ("tilt", "deg")}, 25.0, "tilt = 'six' in line 5"),
        ("# a film\n" + HEADERS + "\n1\n", {"theta": ("tilt", "deg")}, 25.0, "line 6 has 1 cells, not 3"),
        (HEADERS.replace(",", ";").replace("0.1", "0,1"), TIMED, None, "t = '0,1' in line 3 .* pass decimal=','"),
        (
            "t,tilt\n0,1,5\n",
            TIMED,
            None,
            "line 2 has 3 cells, not 2; to read decimal commas, separate columns by semic",
        ),
        (
            "t,tilt\n0,1\n",
            None,
            None,
            "no header is the name of a quantity with its unit, such as 'theta .deg.': pass columns",
        ),
        ("time,theta [deg]\n0,1\n", None, None, "the header 'time' must have a unit, such as 'time .s.'"),
        ("t,tilt [mm]\n0,1\n", {"theta": "tilt"}, 25.0, "unit of theta = 'mm' must be one of rad"),
        (
            HEADERS,
            {"theta": "Winkel"},
            25.0,
            "columns: 'theta' = 'Winkel' must be one of the headers of .*: t, tilt, x",
        ),
        (HEADERS, {"time": ("t", "s"), "theta": ("tilt", "rad")}, None, r"theta = 5 at 0 s \(sample 1\) .* in degrees"),
        (
            HEADERS.replace("0.1", "0.0"),
            TIMED,
            None,
            "time = 0 s in line 3 .* 0 s in line 2: .* use tippe.InversionTimes",
        ),
        (
            "t [ms],tilt\n1,5\n",
            TIMED,
            None,
            "'time' = .'t', 's'. contradicts the header 't .ms.', whose unit is ms, not s",
        ),
        ("PK\x03\x04", TIMED, None, r"film\.csv' is an Excel file, or another archive: save the sheet as CSV"),
        (HEADERS, {"theta": ("tlit", "deg")}, 25.0, "'tlit' must be one of the headers of .*; did you mean 'tilt'"),
        (HEADERS.replace("x", "tilt"), TIMED, None, "'theta' could be 'tilt' or 'tilt', columns of .*: rename one"),
        (
            "t,tilt [deg],tilt [rad]\n0,5,0.1\n1,6,0.2\n",
            TIMED,
            None,
            r"'theta' could be 'tilt \[deg\]' or 'tilt \[rad\]', columns of",
        ),
        (
            "time [s],theta [deg],Theta [rad]\n0,5,0.1\n1,6,0.2\n",
            None,
            None,
            r"'theta' could be 'theta \[deg\]' or 'Theta \[rad\]'",
        ),
        (
            HEADERS.replace("6", "inf"),
            TIMED,
            None,
            "tilt = 'inf' in line 3 of .* must be finite: write n/a, or nothing",
        ),
        (HEADERS.replace("0.1", "1e999"), TIMED, None, "t = '1e999' in line 3 of .* must be finite"),
        (HEADERS.replace("6", "1_0"), TIMED, None, "tilt = '1_0' in line 3 of .* is not a number"),
        (
            HEADERS.replace("6", "6" * 200_000),
            TIMED,
            None,
            r"path = .*film\.csv' is not a text file of columns: field larger",
        ),
    ],
)
def test_files_that_cannot_be_read_are_refused(tmp_path, text, columns, fps, message):
    (tmp_path / "film.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        tippe.read_recording(tmp_path / "film.csv", columns, fps, launch=tippe.Launch(0.1, 100.0))


def test_marks_of_thousands_are_not_read_as_decimal_points(tmp_path):
    """With decimal commas, 1.100 rpm are eleven hundred; columns that are not read may have anything twice."""
    (tmp_path / "film.csv").write_text("time [s];spin [rpm];note;note\n0,1;1.100;a;b\n0,2;1.200;a;b\n")
    with pytest.raises(
        ValueError, match=r"spin .rpm. = '1\.100' in line 2 .* mark of thousands, although decimal = ','"
    ):
        tippe.read_recording(tmp_path / "film.csv", launch=tippe.Launch(0.1, 100.0), decimal=",")
    (tmp_path / "film.csv").write_text("time [s];spin [rpm];note;note\n0,1;1100;a;b\n0,2;1200,5;a;b\n")
    film = tippe.read_recording(tmp_path / "film.csv", launch=tippe.Launch(0.1, 100.0), decimal=",")
    np.testing.assert_allclose(film.value, np.array([1100.0, 1200.5]) * math.pi / 30.0)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        ({"theta": 2.0}, r"error: 'theta' = 2.0 must be \(standard error, unit\), such as \(1.0, 'deg'\)"),
        (2.0, r"error = 2.0 must be {'theta': \(standard error, unit\)}, or None"),
        ({"theta": ("tilt_", "deg")}, "error: 'theta' = 'tilt_' must be one of the headers .*; did you mean 'tilt'?"),
        ({"theta": (-1.0, "deg")}, "error of theta = -1.0 must be greater than 0.0"),
    ],
)
def test_errors_of_a_file_are_refused_by_their_own_name(tmp_path, error, message):
    (tmp_path / "film.csv").write_text(HEADERS)
    with pytest.raises(ValueError, match=message):
        tippe.read_recording(tmp_path / "film.csv", TIMED, launch=tippe.Launch(0.1, 100.0), error=error)


FILES = {
    "a spreadsheet with decimal commas": ("Zeit;tilt (°)\r\n0,1;5,7\r\n0,2;n/a\r\n0,3;6,3\r\n", ","),
    "units in headers": ("# film 3\n\nZeit / ms\ttilt [deg]\n100\t5.7\n200\t-\n300\t6.3\n", "."),
    "blanks": ("time [s]   theta [deg]\n0.1  5.7\n0.2  NaN\n0.3  6.3\n", "."),
}
COLUMNS = {
    "a spreadsheet with decimal commas": {"time": ("Zeit", "s"), "theta": "tilt"},
    "units in headers": {"time": "Zeit", "theta": "tilt [deg]"},
    "blanks": None,
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_a_class_has_files_of_its_own(tmp_path, name, encoding):
    text, decimal = FILES[name]
    (tmp_path / "film.csv").write_bytes(text.encode(encoding))
    film = tippe.read_recording(tmp_path / "film.csv", COLUMNS[name], launch=tippe.Launch(0.1, 100.0), decimal=decimal)
    np.testing.assert_allclose(film.times, [0.1, 0.3])
    np.testing.assert_allclose(film.value, np.radians([5.7, 6.3]))


def test_angles_in_degrees_are_suspected():
    """An inclination of more than pi is refused, a large direction is suspected only: it may count turns."""
    launch, times = tippe.Launch(0.1, 100.0), [0.0, 0.1]
    with pytest.warns(
        UserWarning, match=r"azimuth = 170 rad is large; recorded angles are in radians: did you mean np"
    ):
        tippe.Recording(launch, times, [[0.1, 20.0], [0.1, -170.0]], 0.01, ("theta", "azimuth"))
    ride = stroller.Launch((0.0, 0.0), 0.0, 1.0)
    with pytest.warns(UserWarning, match="steering = 25 rad is large"):
        stroller.Recording(ride, times, [np.nan, 25.0], 0.01, "steering")


def test_a_file_without_some_times_or_with_radians_called_degrees_is_asked_about(tmp_path):
    launch = tippe.Launch(0.1, 100.0)
    (tmp_path / "film.csv").write_text("time [s],theta [deg]\n0.1,5.7\n,6.1\n0.3,\n,\n0.5,6.3\n,6.4\n")
    with pytest.warns(UserWarning, match="2 lines without a time left out, the first in line 3"):
        film = tippe.read_recording(tmp_path / "film.csv", launch=launch)
    np.testing.assert_allclose(film.times, [0.1, 0.5])
    (tmp_path / "film.csv").write_text("time [s],theta [deg]\n0.1,0.1\n0.2,2.9\n")
    with pytest.warns(UserWarning, match="theta is at most 2.9 deg in .*: is this column in rad?"):
        tippe.read_recording(tmp_path / "film.csv", launch=launch)


def test_a_recording_shows_the_units_of_its_file(tmp_path):
    (tmp_path / "film.csv").write_text("time [ms],theta [deg],azimuth [deg]\n100,5,90\n200,6.5,100\n")
    columns = {"time": "time", "theta": "theta"}
    film = tippe.read_recording(
        tmp_path / "film.csv", columns, error={"theta": (0.5, "deg")}, launch=tippe.Launch.degrees(5.0, 1500.0)
    )
    assert "times=[100, 200] ms, value=[5, 6.5] deg, error=[0.5, 0.5] deg, quantity='theta', t0=0 ms" in repr(film)
    assert film.labels == ("theta(100 ms)", "theta(200 ms)")
    assert "value=[0.1] rad, error=0.01 rad" in repr(tippe.Recording(tippe.Launch(0.1, 100.0), [0.1], [0.1], 0.01))
    mixed = tippe.Recording(tippe.Launch(0.1, 100.0), [0.1], [[0.1, 0.2]], 0.01, ("theta", "x"))
    assert "value=[0.1, 0.2], error=0.01," in repr(mixed)


def test_times_in_milliseconds_are_suspected():
    with pytest.warns(UserWarning, match=r"samples are 33 s apart; times are in seconds: did you mean 1e-3 \* times"):
        tippe.Recording(tippe.Launch(0.1, 150.0), 33.0 * np.arange(1, 5), np.full(4, 0.3), 0.01)
    with pytest.warns(UserWarning, match=r"time = 5970 s is long for a top; .*did you mean 1e-3 \* time"):
        tippe.InversionTimes(tippe.Launch(0.1, 150.0), [5970.0], 10.0, t1=20000.0)


def test_a_prior_may_be_a_standard_deviation_about_the_start(rutstam_scene):
    film = tippe.Recording(tippe.Launch(0.1, 9.0), [0.0, 1.0], [0.1, 0.2], 0.1)
    short, full = (problem_of(rutstam_scene, (film,), {"mu": tippe.Free(0.3, prior=p)}) for p in (0.1, (0.3, 0.1)))
    assert jax.tree.all(jax.tree.map(np.array_equal, short.unknowns, full.unknowns))
    assert tippe.Free(0.0, prior=0.2).unit == 0.2
    densities = [tippe.log_density(rutstam_scene, film, {"mu": 0.3}, {"mu": prior}) for prior in (0.1, (0.3, 0.1))]
    assert [float(np.asarray(part)) for part in densities[0].problem.unknowns.priors[0]] == [0.3, 0.1]
    for prior, message in (
        (
            (0.1, 0.2, 0.3),
            "prior of mu = .0.1, 0.2, 0.3. must be a mean and a standard deviation, or only",
        ),
        (-0.1, "standard deviation of the prior of mu = -0.1 must be greater"),
    ):
        with pytest.raises(ValueError, match=message):
            problem_of(rutstam_scene, (film,), {"mu": tippe.Free(0.3, prior=prior)})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"value": [1.0]}, "value must be of shape"),
        ({"value": [np.nan, np.nan]}, "at least one number"),
        ({"times": [1.0, 0.5]}, "increasing"),
        ({"quantity": "phi"}, "quantity = 'phi' must be one of"),
        ({"quantity": ("theta", "theta")}, "each only once"),
        ({"error": [0.1, 0.1, 0.1]}, "error must be one number"),
        ({"error": 0.0}, "error = 0.0 must be greater"),
        ({"t0": 2.0}, "t0 = 2.0 must be less than"),
        ({"student": -1.0}, "student = -1.0"),
    ],
)
def test_bad_recordings_are_refused(change, message):
    arguments = {"times": [0.0, 1.0], "value": [1.0, 1.1], "error": 0.1} | change
    with pytest.raises(ValueError, match=message):
        tippe.Recording(tippe.Launch(0.1, 9.0), **arguments)


def test_names_of_one_film_of_each_and_of_all(rutstam_scene):
    film = tippe.Recording(tippe.Launch(0.1, 9.0), [0.0, 1.0], [0.1, 0.2], 0.1)
    times = tippe.InversionTimes(tippe.Launch(0.1, [9.0, 10.0]), [1.0, 2.0], 0.1, t1=5.0)
    problem = problem_of(
        rutstam_scene, (film, times, film), {"data[*].t0": 0.0, "mu": 0.3, "data[1].launch.azimuth": 0.1}
    )
    assert list(problem.names) == ["data[0].t0", "data[2].t0", "scene.friction.mu", "data[1].launch.azimuth"]
    assert problem.unknowns.lower.tolist() == [-np.inf, -np.inf, 0.0, -np.inf]
    for free, message in (
        ({"data[1].t0": 0.0}, r"'data\[1\].t0' must be one of"),
        ({"data[0].launch.velocity[0]": 0.0}, "must be one of"),
        ({"launch.theta": 0.1, "data[0].launch.theta": 0.1}, "named twice, alone and for all data"),
        ({"data[0].launch.theta": -0.1}, "theta = -0.1"),
    ):
        with pytest.raises(ValueError, match=message):
            problem_of(rutstam_scene, (film, times, film), free)
