"""Recorded motion of tops: fitted from start to end, read from files, refused."""

import math

import numpy as np
import pytest
from conftest import rutstam_top
from viscous_top import Body, azimuth, follow, start, theta

import tippe

LAUNCHES = {"theta": (0.4, 0.5), "spin": (100.0, 110.0), "azimuth": (0.7, 3.0), "t0": (0.013, 0.2), "samples": (30, 24)}
NOISE, MU = 0.01, 0.3


def film(k):
    """Times [s] of a camera's clock, theta and azimuth [rad] of a top of the independent program, with noise."""
    top, count = rutstam_top(), LAUNCHES["samples"][k]
    body = Body(top.mass, top.radius, top.offset, top.I1, top.I3, MU)
    clock = (0.02 if k == 0 else 0.21) + 0.01 * np.arange(count)
    states = follow(body, start(body, LAUNCHES["theta"][k], LAUNCHES["spin"][k]), clock - LAUNCHES["t0"][k])
    exact = np.stack([theta(states), azimuth(states) + LAUNCHES["azimuth"][k]], axis=1)
    value = exact + NOISE * np.random.default_rng(k).normal(size=exact.shape)
    # A camera sees an azimuth up to whole turns.
    value[:, 1] = (value[:, 1] + math.pi) % (2.0 * math.pi) - math.pi
    return clock, value


@pytest.fixture(scope="module")
def fit(tmp_path_factory, rutstam_scene):
    """Friction from two films, each with its own launch and unknown clock and azimuth; one is read from a file, with samples
    that are missing, and of the other one the errors are not known."""
    path = tmp_path_factory.mktemp("films") / "film.csv"
    clock, value = film(0)
    value[5], value[7, 1], value[11] = np.nan, np.nan, np.nan
    cells = [f"{1e3 * t:.9g};{math.degrees(a):.9g};{p:.9g}" for t, (a, p) in zip(clock, value, strict=True)]
    path.write_text("# a film\nt / ms;tilt;azimuth\n" + "\n".join(cells).replace("nan", "") + "\n")
    columns = {"time": ("t / ms", "ms"), "theta": ("tilt", "deg"), "azimuth": ("azimuth", "rad")}
    error = {"theta": (math.degrees(NOISE), "deg"), "azimuth": (NOISE, "rad")}
    first = tippe.read_recording(path, columns, launch=tippe.Launch(0.4, 100.0), error=error)
    second = tippe.Recording(tippe.Launch(0.5, 110.0), *film(1), None, ("theta", "azimuth"))
    free = {"mu": 0.2, "data[0].launch.azimuth": 0.5, "data[1].launch.azimuth": 2.7, "data[0].t0": 0.01}
    return tippe.identify(rutstam_scene, [first, second], free | {"data[1].t0": tippe.Free(0.19, prior=(0.2, 0.05))})


def test_friction_from_two_films_with_clocks_and_azimuths_of_their_own(fit):
    truth = {"scene.friction.mu": MU}
    truth |= {
        f"data[{k}].{name}": LAUNCHES[name.split(".")[-1]][k] for k in (0, 1) for name in ("launch.azimuth", "t0")
    }
    assert fit.status == "converged"
    assert list(fit.estimates) == ["scene.friction.mu", *(n for n in fit.estimates if n != "scene.friction.mu")]
    for name, value in truth.items():
        assert abs(fit.estimates[name] - value) < 4.0 * fit.standard_errors[name], name
    assert fit.standard_errors["scene.friction.mu"] < 0.02
    assert fit.verdict.good, str(fit)


def test_missing_samples_are_left_out_and_unknown_errors_are_found(fit):
    labels = [row.label for row in fit.residuals]
    assert len(labels) == 2 * (30 + 24) - 5
    assert "1: theta(0.07 s)" not in labels
    assert "1: theta(0.09 s)" in labels
    assert "1: azimuth(0.09 s)" not in labels
    # Each column of the second film has an error of its own.
    for column in ("theta", "azimuth"):
        errors = {row.error for row in fit.residuals if row.label.startswith(f"2: {column}")}
        assert len(errors) == 1
        assert 0.6 * NOISE < errors.pop() < 1.5 * NOISE
    assert math.isnan(fit.verdict.p_value)
    assert len(fit.verdict.series) == 4
