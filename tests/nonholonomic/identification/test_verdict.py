"""Verdicts on fits: scatter, runs of signs, agreement of starts, and the plot."""

import dataclasses
import itertools
import math
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from close import assert_close
from matplotlib.figure import Figure

from nonholonomic.identification import FitWarning, Free, LogDensity, Measurements, identify
from nonholonomic.identification.conclusions import normal_scores, runs_of_signs
from nonholonomic.identification.search import refine

T = np.linspace(0.0, 4.0, 115)


def oscillation(p):
    return p["height"][:, None] * jnp.sin(p["rate"][:, None] * T)


def recorded(error=0.5):
    """Measurements of an oscillation of amplitude 1 and rate 6 with noise of 0.5 and a stated error."""
    return Measurements(np.sin(6.0 * T) + 0.5 * np.random.default_rng(3).normal(size=T.size), error)


@pytest.mark.parametrize("positive", [1, 3, 5])
def test_few_runs_are_as_improbable_as_counting_says(positive):
    signs = np.array([1.0] * positive + [-1.0] * (7 - positive))
    orders = [np.array(order) for order in set(itertools.permutations(signs))]
    runs = np.array([1 + np.sum(order[1:] != order[:-1]) for order in orders])
    for order, count in list(zip(orders, runs, strict=True))[:12]:
        outcome = runs_of_signs(order)
        assert outcome.runs == count
        assert_close(outcome.p_value, np.mean(runs <= count), rtol=1e-12)


def test_a_good_fit_has_nothing_against_it_and_its_p_value_is_that_of_chi_squared():
    fit = identify(oscillation, recorded(), {"height": 0.8, "rate": 5.8}, starts=3, spread=1.05)
    assert fit.verdict.good
    assert_close(fit.verdict.p_value, scipy.stats.chi2.sf(fit.deviance, 113), rtol=1e-9)
    assert (fit.verdict.agree, fit.verdict.starts) == (3, 3)
    assert "3 of 3 refined candidates ended at the best minimum" in fit.details


def test_the_search_finds_the_minimum_from_a_start_in_another_one():
    """Least squares from the rate 9 alone end at a -2 log likelihood of 170 for 115 measurements."""
    fit = identify(oscillation, recorded(), {"height": 0.8, "rate": 9.0})
    assert abs(fit.estimates["rate"] - 6.0) < 4.0 * fit.standard_errors["rate"]
    assert fit.verdict.good


def test_a_wrong_model_is_told_although_the_fit_converged():
    with pytest.warns(FitWarning, match="residuals are too large"):
        fit = identify(oscillation, recorded(), {"height": 0.8, "rate": Free(9.0, 8.0, 10.0)})
    assert fit.deviance / fit.degrees > 1.4
    assert fit.verdict.p_value < 0.01
    assert not fit.verdict.good


class Stopping(eqx.Module):
    """Lines whose run fails where the rate exceeds a limit; a level with a tiny effect changes them by round-off."""

    limit: jnp.ndarray
    effect: jnp.ndarray

    def __call__(self, p):
        predicted = p["rate"][:, None] * T[:8] + self.effect * p["level"][:, None]
        return jnp.where(p["rate"][:, None] < self.limit, predicted, jnp.nan)


def fitted_with_limit(limit, effect):
    data = Measurements(2.0 * T[:8] + 0.02 * np.random.default_rng(0).normal(size=8), 0.02)
    model = Stopping(jnp.asarray(limit), jnp.asarray(effect))
    return identify(model, data, {"rate": Free(2.0, 0.0), "level": 0.1}, progress=False)


def test_candidates_whose_runs_fail_are_counted_and_placed():
    """Beside the estimate they cut its interval; far from it, they are a note."""
    with pytest.warns(FitWarning, match=r"^\d+ % of the candidates beside the estimate count as impossible"):
        fit = fitted_with_limit(2.03, 1.0)
    assert fit.interval("rate")[1] < 2.03
    assert re.search(r"note: \d+ of \d+ candidates count as impossible.* at rate 2.0", fit.details)
    fit = fitted_with_limit(3.5, 1.0)
    assert fit.verdict.good
    count, of_all = (int(re.search(r"(\d+) of (\d+) candidates", fit.details).group(k)) for k in (1, 2))
    points = fit.distribution.points
    assert of_all == len(points)
    assert count == np.sum(np.exp(points[:, 0]) >= 3.5) > 0


def test_a_number_that_does_not_act_is_seen_at_once():
    """It would otherwise be explored to the end of the region: 20 000 runs."""
    with pytest.warns(FitWarning) as caught:
        fit = fitted_with_limit(100.0, 1e-13)
    assert [str(warning.message) for warning in caught] == [
        "no prediction depends on level, so the data say nothing about it: fix it, or add other data",
        "the data do not determine level: fix it, or give a prior",
    ]
    assert len(fit.distribution.points) == 256
    assert np.isinf(fit.standard_errors["level"])
    assert_close(fit.standard_errors["rate"], 0.02 / np.sqrt(np.sum(T[:8] ** 2)), rtol=1e-3)


def test_a_trend_that_the_model_misses_shows_in_the_runs_where_the_errors_are_too_large():
    line = Measurements(0.2 * T**2 + 0.01 * np.random.default_rng(0).normal(size=T.size), 0.5)
    with pytest.warns(FitWarning, match="keep their sign for too long"):
        fit = identify(lambda p: p["slope"][:, None] * T, line, {"slope": 1.0})
    assert fit.verdict.p_value > 0.5
    assert fit.verdict.series[0].p_value < 1e-6


def test_residuals_far_below_the_errors_may_keep_their_sign():
    """As those of a recording without noise do, which are the errors of integration."""
    line = Measurements(T + 1e-6 * T**2, 0.5)
    fit = identify(lambda p: p["slope"][:, None] * T, line, {"slope": 1.0})
    assert fit.verdict.series[0].p_value < 1e-6
    assert fit.verdict.good


def test_estimated_errors_are_those_of_the_scatter():
    value = np.concatenate([1.0 + 0.1 * np.random.default_rng(1).normal(size=40), np.full(40, 5.0)])
    value[40:] += 0.7 * np.random.default_rng(2).normal(size=40)
    data = Measurements(value, 1.0, series=np.repeat([0, 1], 40), estimated=True)
    fit = identify(lambda p: jnp.repeat(jnp.stack([p["a"], p["b"]], axis=1), 40, axis=1), data, {"a": 0.0, "b": 0.0})
    assert_close(fit.standard_errors["a"], np.std(value[:40], ddof=1) / math.sqrt(40.0), rtol=0.01)
    assert_close(fit.standard_errors["b"], np.std(value[40:], ddof=1) / math.sqrt(40.0), rtol=0.01)
    assert math.isnan(fit.verdict.p_value)
    assert (
        "verdict: no concerns, but nothing tests this fit, as its errors come from its own residuals: pass `er"
        in str(fit)
    )


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_the_better_of_two_searches_is_that_of_the_smaller_residuals(seed, swapped):
    """Each search estimates the unknown error for itself, so that both end with the same -2 log likelihood."""
    value = np.sin(6.0 * T) + 0.5 * np.random.default_rng(seed).normal(size=T.size)
    data = Measurements(value, 1.0, estimated=True)
    density = LogDensity.of(oscillation, data, {"height": Free(1.0), "rate": Free(6.0)})
    near, far = (refine(density, np.array([[1.0, rate]]), 60) for rate in (0.0, 1.0))
    scatter = [np.std(value - minima.linearised.prediction[0]) for minima in (near, far)]
    assert scatter[0] < 0.8 * scatter[1]
    both = far.joined(near) if swapped else near.joined(far)
    assert_close(both.coordinates[both.best], near.coordinates[0])
    assert_close(both.density.measurements.error, near.density.measurements.error)


def test_as_many_unknowns_as_measurements_leave_nothing_to_judge_by():
    fit = identify(lambda p: p["x"][:, None], Measurements([2.0], 0.2), {"x": 0.5})
    assert math.isnan(fit.verdict.p_value)
    assert "verdict: no concerns, but no measurement is left to test this fit\n" in str(fit)


def test_a_measurement_far_from_the_fit_is_named_whether_errors_are_known_or_not():
    value = 2.0 + 0.1 * np.cos(np.arange(40.0) ** 2)
    value[7] += 5.0
    for estimated in (False, True):
        measurements = Measurements(value, 0.1, estimated=np.full(40, estimated))
        with pytest.warns(
            FitWarning, match=r"far from the fit: #8 \(\d+ errors\): leave mistakes out, or pass student=4"
        ):
            fit = identify(lambda p: p["x"][:, None] * np.ones(40), measurements, {"x": 0.5})
        assert not fit.verdict.good
    fit = identify(lambda p: p["x"][:, None] * np.ones(40), Measurements(value, 0.1, student=4.0), {"x": 0.5})
    assert "far from the fit" not in str(fit)


def test_scores_of_student_errors_are_normal():
    z = np.linspace(-8.0, 8.0, 9)
    scores = normal_scores(Measurements(np.zeros(9), 1.0, student=4.0), z)
    assert_close(scipy.stats.norm.cdf(scores), scipy.stats.t.cdf(z, 4.0), rtol=1e-9)


def test_the_picture_has_data_residuals_distributions_and_correlation():
    fit = identify(oscillation, recorded(), {"height": 0.8, "rate": 5.8})
    figure = fit.plot()
    assert isinstance(figure, Figure)
    data, residuals, *distributions, correlation, _ = figure.axes
    assert_close(data.lines[-1].get_ydata(), [row.prediction for row in fit.residuals])
    assert_close(residuals.lines[0].get_ydata(), [row.residual for row in fit.residuals])
    assert [axes.get_xlabel() for axes in distributions] == ["height", "rate"]
    value, low, high = (f"{number:.3f}" for number in (fit.estimates["rate"], *fit.interval("rate")))
    assert distributions[1].get_title() == f"{value}\n95 %: {low} to {high}"
    assert_close(correlation.images[0].get_array(), fit.correlation)
    assert_close(np.diag(fit.correlation), 1.0)


def test_a_picture_has_limits_at_its_edge_and_other_units():
    """A limit far from the measured values does not squeeze these."""
    seen = Measurements([0.10, 0.12, 0.11, 7.0, -math.inf], 0.01, upper=[0.10, 0.12, 0.11, math.inf, 9.0])
    fit = identify(lambda p: p["x"][:, None] * jnp.array([1.0, 1.0, 1.0, 80.0, 80.0]), seen, {"x": 0.11})
    fit = dataclasses.replace(fit, density=dataclasses.replace(fit.density, series_units=("rad",)), units={"x": "rad"})
    data, residuals, distribution = fit.plot(unit="deg").axes
    low, high = data.get_ylim()
    assert math.degrees(0.05) < low < math.degrees(0.09)
    assert math.degrees(0.13) < high < math.degrees(0.2)
    assert [text.get_text() for text in data.texts] == ["> 401.1", "< 515.7"]
    assert all(low < line.get_ydata()[0] < high for line in data.lines if line.get_marker() in "^v")
    assert data.get_ylabel() == "measured [deg]"
    assert distribution.get_xlabel() == "x [deg]"
    assert_close(distribution.lines[-1].get_xdata()[0], math.degrees(fit.estimates["x"]))
    assert [tick.get_text() for tick in residuals.get_xticklabels()] == ["#1", "#2", "#3", "#4", "#5"]
    with pytest.raises(ValueError, match="unit = 'grade' must be one of"):
        fit.plot(unit="grade")


def test_a_report_states_values_with_intervals_and_what_to_do_before_any_statistics():
    fit = identify(oscillation, recorded(), {"height": 0.8, "rate": 5.8})
    value, low, high = fit.rounded("rate")
    assert f"rate    {value}  (95 %: {low} to {high})\nverdict: no concerns about this fit\n" in str(fit)
    assert all(word not in str(fit) for word in ("k-hat", "effective", "+-", "signs"))
    assert all(word in fit.details for word in ("k-hat", "effective", "+-", "signs", f"{fit.most_likely['rate']:.6g}"))
    assert fit.plot().get_suptitle() == "no concerns about this fit"
    # To two digits of the distance to the farther end.
    distance = max(abs(end - fit.estimates["rate"]) for end in fit.interval("rate"))
    assert abs(float(value) - fit.estimates["rate"]) <= 0.05 * distance
    assert len(value) <= 5
    noted = dataclasses.replace(fit, verdict=fit.verdict._replace(notes=("a staircase",)))
    assert "verdict: no concerns about this fit, 1 note in its details" in str(noted)
    assert "note: a staircase" in noted.details
    moved = fit.estimates["rate"] + 0.5 * fit.standard_errors["rate"]
    apart = dataclasses.replace(fit, most_likely={**fit.most_likely, "rate": moved})
    assert f"; most likely {moved:.4g})" in str(apart)
    doubtful = dataclasses.replace(fit, verdict=fit.verdict._replace(concerns=("start closer", "allow more steps")))
    assert "verdict: do not rely on this fit yet:\n  start closer\n  allow more steps\n" in str(doubtful)
    assert doubtful.plot().get_suptitle().split() == str(doubtful.verdict).split()
    assert len(doubtful.plot().get_suptitle().splitlines()) == 3


@pytest.mark.parametrize(
    ("numbers", "texts"),
    [
        ((5.94, 5.8746, 6.0046), ("5.940", "5.875", "6.005")),
        ((150.0, 60.0, 350.0), ("150", "60", "350")),
        ((8000.0, 7000.0, 9500.0), ("8000", "7000", "9500")),
        ((123456.0, 122400.0, 124500.0), ("123500", "122400", "124500")),
        ((0.0, -0.2, 0.3), ("0.00", "-0.20", "0.30")),
        ((2.994e-6, 2.990e-6, 2.998e-6), ("2.994e-06", "2.99e-06", "2.998e-06")),
        ((155.0, -math.inf, math.inf), ("155", "-inf", "inf")),
        ((1.00312, math.nan, math.nan), ("1.003", "nan", "nan")),
    ],
)
def test_values_are_rounded_to_two_digits_of_their_interval(numbers, texts, monkeypatch):
    fit = identify(lambda p: p["x"][:, None], Measurements([2.0], 0.2), {"x": 0.5})
    fit = dataclasses.replace(fit, estimates={"x": numbers[0]})
    monkeypatch.setattr(type(fit), "interval", lambda self, name: numbers[1:])
    assert fit.rounded("x") == texts


def test_the_picture_of_a_normal_coordinate_peaks_at_the_estimate():
    """The logarithm of a positive number is normal here; the errors are large."""
    fit = identify(lambda p: jnp.log(p["x"])[:, None], Measurements([0.0], 0.3), {"x": Free(1.5, 0.0)})
    assert fit.distribution.kind == "linear"
    curve = fit.plot().axes[-1].lines[0]
    assert_close(curve.get_xdata()[np.argmax(curve.get_ydata())], fit.estimates["x"], rtol=1e-12)
    assert_close(np.diff(curve.get_xdata()) >= 0.0, True)


def test_a_profile_says_where_it_found_a_better_fit():
    fit = identify(oscillation, recorded(), {"height": 0.8, "rate": 5.8})
    worse = dataclasses.replace(fit, deviance=fit.deviance + 3.0)
    with pytest.warns(FitWarning, match="the fit is better with height = .*: start there"):
        worse.profile("height")


def test_the_picture_of_a_staircase_shows_the_weighted_points():
    """The bars have the weight of the points inside them."""
    times = np.linspace(0.5, 4.0, 8)
    steps = identify(
        lambda p: jnp.floor(12.0 * p["x"][:, None] * times) / 12.0,
        Measurements(1.3 * times, 0.1),
        {"x": 1.0},
        slopes="differences",
    )
    assert steps.distribution.kind == "weights"
    bars = [bar.get_height() for bar in steps.plot().axes[-1].patches if bar.get_height() < 1.0]
    assert_close(sum(bars), 0.9995, atol=1e-3)
