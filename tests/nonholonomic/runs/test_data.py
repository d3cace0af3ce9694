"""Data of fits of any model: limits of times, units, and repeated measurements."""

import jax.numpy as jnp
import matplotlib.figure
import numpy as np
import pytest
import scipy.stats
from close import assert_close

import nonholonomic
import tippe

SEEN = np.array([0.33, 0.36, 0.35])
ERROR = 0.02


class Decay(nonholonomic.AbstractMode):
    rate: float

    def field(self, t, y):
        return -self.rate * y


def below_half(t, y):
    return y[0] - 0.5


def decay(rate):
    return nonholonomic.Hybrid([Decay(rate)], event=below_half)


def quantiles(log_likelihood, rates):
    """The quantiles of the 95 % interval, by quadrature with the prior density 1 / rate, that of a fit in logarithms."""
    density = np.exp(log_likelihood - np.max(log_likelihood)) / rates
    return np.interp([0.025, 0.975], np.cumsum(density) / np.sum(density), rates)


@pytest.mark.parametrize(
    ("launch", "times", "limits", "log_likelihood"),
    [
        # From 2, the level is reached at log(4) / rate, which one watched for less than that.
        (
            2.0,
            [np.inf, np.inf],
            dict(t1=3.0, until=0.70),
            lambda time: 2.0 * scipy.stats.norm.logsf(0.70, 2.0 * time, ERROR),
        ),
        (
            2.0,
            [(0.66, 0.70)],
            dict(t1=3.0),
            lambda time: np.log(
                scipy.stats.norm.cdf(0.70, 2.0 * time, ERROR) - scipy.stats.norm.cdf(0.66, 2.0 * time, ERROR)
            ),
        ),
        (1.0, [(0.0, 0.34)], dict(t1=3.0), lambda time: scipy.stats.norm.logcdf(0.34, time, ERROR)),
        (2.0, [np.inf, np.inf], dict(t1=0.70), lambda time: 2.0 * scipy.stats.norm.logsf(0.70, 2.0 * time, ERROR)),
    ],
    ids=["did not happen", "between two times", "before a time", "by the horizon"],
)
def test_limits_of_times_count_with_their_probability(launch, times, limits, log_likelihood):
    seen = nonholonomic.EventTimes([1.0], SEEN, ERROR, t1=3.0)
    limits = nonholonomic.EventTimes([launch], times, ERROR, **limits)
    fit = nonholonomic.identify(decay(2.0), [seen, limits], {"rate": 2.0}, starts=2, progress=False)
    rates = np.linspace(1.5, 2.6, 4001)
    time = np.log(2.0) / rates
    total = log_likelihood(time) + np.sum(scipy.stats.norm.logpdf(SEEN[:, None], time, ERROR), axis=0)
    low, high = quantiles(total, rates)
    assert_close(fit.interval("rate"), (low, high), rtol=0.0, atol=0.06 * (high - low))


def test_event_times_with_a_heavy_tail_ignore_an_outlier():
    times = [0.34, 0.35, 0.355, 0.345, 0.42]
    data = nonholonomic.EventTimes([1.0], times, 0.01, t1=3.0, student=1.0)
    fit = nonholonomic.identify(decay(2.0), data, {"rate": 2.0}, starts=2, progress=False)
    assert_close(fit.estimates["rate"], np.log(2.0) / 0.3475, rtol=0.03)
    assert list(fit.estimates) == ["system.modes[0].rate"]
    with pytest.raises(KeyError, match=r"'rates' must be one of system\.modes\[0\]\.rate"):
        fit.estimates["rates"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(time=[1.0, np.nan]), r"time\[1\] = nan must be a number, infinite where the event did not happen"),
        (dict(time=[5.0]), r"time = 5.0 must be less than 3.0 \(t1\)"),
        (dict(time=[-1.0]), "time = -1.0 must be greater than 0.0$"),
        (dict(time=1.0), "time must be a non-empty list of times"),
        (dict(time=[np.inf], until=4.0), "until = 4.0 must be at most 3.0"),
        (dict(time=[(2.0, 1.0)]), "a time, or two in order"),
        (dict(time=[1.0, 2.0], error=[0.1] * 3), "error must be one number or one for each of the 2 times"),
    ],
)
def test_wrong_times_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        nonholonomic.EventTimes([1.0], **(dict(error=0.1, t1=3.0) | arguments))


def test_the_picture_of_a_fit_has_the_units_of_the_quantities():
    scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6), friction=tippe.Viscous(0.3))
    launch, times = tippe.Launch.degrees(6.0, 1500.0), jnp.linspace(0.02, 0.2, 10)
    run = tippe.simulate(scene, launch, 0.2, times=times, tolerance=1e-7)
    value = np.stack([run.theta, run.spin, run.position[:, 2]], axis=-1)
    names = ("theta", "spin", "position.z")
    data = nonholonomic.Recording(launch, times, value, [1e-3, 0.1, 1e-5], names)
    assert "theta" in run
    assert "tetha" not in run
    fit = nonholonomic.identify(scene, data, {"launch.spin": 157.0}, starts=2, progress=False)
    assert fit.density.series_units == ("rad", "rad/s", "m")
    # By default in the units of the launch; the numbers stay in SI units.
    spin, rpm = fit.estimates["launch.spin"], 30.0 / np.pi
    estimate, low, high = fit.rounded("launch.spin", rpm)
    assert (abs(spin - 50.0 * np.pi) < 0.1, abs(float(estimate) - rpm * spin) < 0.5) == (True, True)
    assert f"launch.spin  {estimate} rpm  (95 %: {low} to {high}" in str(fit)
    assert f"launch.spin  {rpm * spin:.6g} +- {rpm * fit.standard_errors['launch.spin']:.2g}" in fit.details
    assert f"{np.degrees(fit.residuals[0].prediction):.6g} deg" in fit.details
    axes = fit.plot().axes
    assert [panel.get_ylabel() for panel in axes[:3]] == ["theta [deg]", "spin [rpm]", "position.z [m]"]
    assert axes[4].get_xlabel() == "spin [rpm]"
    figure = fit.plot(unit=("deg", "rpm", "mm"))
    assert isinstance(figure, matplotlib.figure.Figure)
    labels = ["theta [deg]", "spin [rpm]", "position.z [mm]", "residual\n[standard errors]"]
    assert [axes.get_ylabel() for axes in figure.axes[:4]] == labels
    (error_bars,) = figure.axes[0].containers
    assert_close(error_bars.lines[0].get_ydata(), np.degrees(value[:, 0]))


def test_samples_over_time_and_times_of_events_are_drawn_side_by_side():
    times = np.linspace(0.1, 1.0, 10)
    film = nonholonomic.Recording([1.0], times, np.exp(-2.0 * times), 0.01)
    ends = nonholonomic.EventTimes([1.0], SEEN, ERROR, t1=3.0)
    fit = nonholonomic.identify(decay(2.0), [film, ends], {"rate": 2.0}, starts=2, progress=False)
    level, residuals, time, later_residuals, _ = fit.plot(unit="ms").axes
    assert [axes.get_ylabel() for axes in (level, time)] == ["y0", "time [ms]"]
    moments, curve = level.lines[-1].get_data()
    assert_close(curve, np.exp(-fit.most_likely["rate"] * (moments + 0.1)), rtol=1e-6)
    assert residuals.lines[0].get_ydata().size == 10
    (error_bars,) = time.containers
    assert_close(error_bars.lines[0].get_ydata(), 1e3 * SEEN)
    assert_close(error_bars.lines[0].get_xdata(), np.arange(3))
    assert [tick.get_text() for tick in later_residuals.get_xticklabels()] == ["2: time 1", "2: time 2", "2: time 3"]
