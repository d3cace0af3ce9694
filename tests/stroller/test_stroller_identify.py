"""Numbers of a stroller from a recorded ride."""

import jax
import numpy as np
import pytest
from close import assert_close

import nonholonomic
import stroller
import tippe

LAUNCH = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.5, steering=0.3)
TIMES = np.array([0.5, 1.0, 1.5])


def scene(rolling=2.0, wheelbase=0.7):
    body = stroller.Stroller(mass=12.0, wheelbase=wheelbase, inertia=1.5, steering_inertia=0.05)
    return stroller.Scene(body, friction=stroller.Damping(rolling))


def test_damping_from_recorded_speeds(tmp_path, caplog):
    """From a file, whose clock was started at an unknown time; a speed of rolling resistance falls as exp(-c t / m)."""
    clock, path = np.array([1.0, 1.25, 1.5, 2.0]), tmp_path / "ride.csv"
    speeds = stroller.simulate(scene(), LAUNCH, 1.1, times=clock - 0.9).speed
    path.write_text("t,v\n" + "\n".join(f"{t},{3.6 * v:.12g}" for t, v in zip(clock, speeds, strict=True)))
    columns = {"time": ("t", "s"), "speed": ("v", "km/h")}
    data = stroller.read_recording(path, columns, launch=LAUNCH, error={"speed": (0.036, "km/h")})
    fit = stroller.identify(scene(), data, {"rolling": 1.0, "t0": 0.8})
    assert fit.status == "converged"
    assert_close(list(fit.estimates.values()), [2.0, 0.9], rtol=1e-4)
    with jax.log_compiles():
        second_fit = stroller.identify(scene(), data, {"rolling": 1.5, "t0": 0.85}, tolerance=1e-7)
    assert not [text for text in caplog.messages if "Finished XLA compilation" in text]
    assert_close(list(second_fit.estimates.values()), [2.0, 0.9], rtol=1e-4)
    posterior = stroller.log_density(scene(), data, {"rolling": 1.5, "t0": 0.85}, tolerance=1e-7)
    # As many rows as in an exploration of the fit, whose program they share.
    rows = np.tile(np.stack([second_fit.coordinates, posterior.start]), (256, 1))
    predicted = posterior.predict(rows)
    assert_close(predicted[0], speeds, rtol=1e-6)
    assert np.max(np.abs(predicted[1] - speeds)) > 0.01


#: On a straight ride, half of the speed is lost after log(2) m / c.
HALVED = nonholonomic.EventTimes(
    stroller.Launch((0.0, 0.0), 0.0, 1.5), [np.log(2.0) * 6.0], 0.01, 9.0, lambda t, motion: motion.speed - 0.75
)


def test_the_time_of_an_event_is_predicted():
    posterior = stroller.log_density(scene(), HALVED, {"rolling": 1.5})
    assert_close(posterior.predict(np.log([[2.0], [1.5]]))[:, 0], np.log(2.0) * 12.0 / np.array([2.0, 1.5]), rtol=1e-7)


@pytest.mark.slow
def test_damping_from_the_time_of_an_event():
    fit = stroller.identify(scene(), HALVED, {"rolling": 1.5}, starts=2, progress=False)
    assert_close(fit.estimates["scene.friction.rolling"], 2.0, rtol=1e-6)


@pytest.mark.slow
def test_damping_and_wheelbase_from_an_exact_path():
    path = stroller.simulate(scene(), LAUNCH, 1.5, times=TIMES).position
    data = stroller.Recording(LAUNCH, TIMES, path, 0.01)
    free = {"rolling": 1.0, "scene.body.wheelbase": 1.2}
    fit = stroller.identify(scene(), data, free, tolerance=1e-7)
    assert fit.status == "converged"
    assert_close(list(fit.estimates.values()), [2.0, 0.7], rtol=1e-4)
    assert fit.residuals[0].label == "x(0.5 s)"


def test_what_cannot_be_fitted_is_refused():
    data = stroller.Recording(LAUNCH, TIMES, np.zeros((3, 3)), 0.01)
    for free, message in (({"drag": 1.0}, "must be one of"), ({"wheelbase": -1.0}, "wheelbase")):
        for use in (stroller.identify, stroller.log_density):
            with pytest.raises(ValueError, match=message):
                use(scene(), data, free)
    with pytest.raises(ValueError, match="priors: 'drag' must be one of"):
        stroller.log_density(scene(), data, {"rolling": 2.0}, {"drag": 0.1})
    with pytest.raises(ValueError, match="starts = 0 must be"):
        stroller.identify(scene(), "no data", {"wheelbase": 1.0}, starts=0)
    with pytest.raises(ValueError, match="must be a Recording"):
        stroller.identify(scene(), 1.0, {"wheelbase": 1.0})
    with pytest.raises(ValueError, match="or a list of them; read a file with read_recording"):
        stroller.identify(scene(), "ride.csv", {"wheelbase": 1.0})
    table = nonholonomic.Table({"x": np.arange(2.0)}, {"y": np.ones(2)}, {}, {})
    with pytest.raises(ValueError, match=r"data = Table over x \(2\).* must be a Recording"):
        stroller.identify(scene(), table, {"wheelbase": 1.0})
    film = tippe.Recording(tippe.Launch(0.1, 150.0), [0.0, 0.1], [0.1, 0.1], 0.01)
    with pytest.raises(ValueError, match=r"data: the scene of a tippe\.Recording is a stroller\.Scene and must"):
        stroller.identify(scene(), film, {"rolling": 1.0})
    with pytest.raises(ValueError, match="quantity = 'theta'"):
        stroller.Recording(LAUNCH, TIMES, np.zeros(3), 0.01, quantity="theta")
    with pytest.raises(ValueError, match="value must be of shape"):
        stroller.Recording(LAUNCH, TIMES, np.zeros(3), 0.01)
