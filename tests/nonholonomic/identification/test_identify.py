"""Identification without a simulation: textbook estimates, one-sided likelihoods, bounds, undetermined parameters."""

import sys
import threading
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from close import assert_close
from terminal import Terminal

from nonholonomic.identification import FitWarning, Free, LogDensity, Measurements, identify, search
from nonholonomic.identification.exploration import region_of
from nonholonomic.identification.posterior import MISSING, Unknowns, one_sided
from nonholonomic.identification.search import coordinate_covariance
from nonholonomic.parameters import full_name

X = np.linspace(0.0, 1.0, 12)
ERROR = 0.1 + 0.05 * X


def line(numbers):
    """Straight lines, a row each."""
    return numbers["height"][:, None] + numbers["slope"][:, None] * X


@pytest.fixture(scope="module")
def regression():
    value = 2.0 - 3.0 * X + ERROR * np.random.default_rng(0).normal(size=X.size)
    return value, identify(line, Measurements(value, ERROR), {"height": 0.5, "slope": 0.0}, starts=3)


def test_linear_regression_is_that_of_the_textbook(regression):
    """Weighted least squares: (A^T W A)^-1 A^T W y and (A^T W A)^-1."""
    value, fit = regression
    A, W = np.stack([np.ones_like(X), X], axis=1), np.diag(ERROR**-2)
    covariance = np.linalg.inv(A.T @ W @ A)
    assert_close(list(fit.estimates.values()), covariance @ A.T @ W @ value, rtol=1e-7)
    assert_close(fit.covariance, covariance, rtol=1e-9)
    assert_close(list(fit.standard_errors.values()), np.sqrt(np.diag(covariance)), rtol=1e-9)
    assert fit.statuses == ("converged",) * 3
    assert fit.degrees == 10
    assert "slope" in str(fit)
    low, high = fit.interval("slope")
    assert_close(high - low, 2.0 * 1.96 * fit.standard_errors["slope"], rtol=1e-9)


def test_it_says_on_a_terminal_what_it_does(regression, monkeypatch):
    value, fit = regression
    monkeypatch.setattr("nonholonomic.terminal.INTERVAL", 0.01)
    # All is compiled by now; the first thing that a fit does is made to take its time.
    compiled = search.linearise

    def slow(*arguments):
        # Another thread compiles the slopes while the candidates are compared.
        if threading.current_thread() is threading.main_thread():
            time.sleep(0.6)
        return compiled(*arguments)

    monkeypatch.setattr(search, "linearise", slow)
    for progress in (True, False):
        stream = Terminal()
        monkeypatch.setattr(sys, "stderr", stream)
        second_fit = identify(
            line, Measurements(value, ERROR), {"height": 0.5, "slope": 0.0}, starts=3, progress=progress
        )
        assert second_fit.estimates == fit.estimates
        # The first look may come before the first program is compiled.
        words = {text.split()[0] for _, text in stream.lines}
        assert ("compiling" in words, bool(words)) == (progress, progress)


def test_a_model_without_derivatives_is_fitted_by_differences(regression):
    """In NumPy, with a step in it that is far below the errors and far above round-off."""
    value, fit = regression

    class Model:
        on_host = True

        def __call__(self, numbers):
            return np.round(line({name: np.asarray(number) for name, number in numbers.items()}), 4)

    free = {"height": 0.5, "slope": -1.0}
    difference_fit = identify(Model(), Measurements(value, ERROR), free, slopes="differences")
    for name, expected in fit.estimates.items():
        assert abs(difference_fit.estimates[name] - expected) < 0.05 * fit.standard_errors[name]
    assert_close(list(difference_fit.standard_errors.values()), list(fit.standard_errors.values()), rtol=0.05)
    with pytest.raises(ValueError, match="slopes = 'none' must be one of 'exact', 'differences'"):
        identify(line, Measurements(value, ERROR), free, slopes="none")


def test_profile_of_a_linear_model_is_a_parabola(regression):
    _, fit = regression
    profile = fit.profile("slope")
    deviations = (profile.values - fit.estimates["slope"]) / fit.standard_errors["slope"]
    assert_close(profile.deviance, deviations**2, atol=1e-7)
    assert profile.converged.all()
    # The other number follows along the regression line.
    line = fit.covariance[0, 1] / fit.covariance[1, 1] * (profile.values - fit.estimates["slope"])
    assert_close(profile.estimates["height"], fit.estimates["height"] + line, rtol=1e-6)


def test_a_lower_limit_has_the_one_sided_likelihood():
    z = np.linspace(-30.0, 7.0, 75)
    # log1p of the small tail: the plain logarithm loses it where it is close to 0.
    right = np.log1p(-scipy.stats.norm.sf(np.maximum(z, 0.0)))
    expected = -2.0 * np.where(z < 0.0, scipy.stats.norm.logcdf(z), right)
    assert_close(np.asarray(jax.jit(one_sided)(z)) ** 2, expected, rtol=1e-9, atol=1e-15)
    value_and_slope = jax.jit(jax.value_and_grad(one_sided))
    for distance in (8.0, 9.0, 40.0, 1e10):
        value, slope = value_and_slope(distance)
        assert abs(value) < 1e-7
        assert np.isfinite(slope)


def test_censored_mean_is_that_of_scipy():
    """The mean of normal numbers of which those above 1 were only seen to exceed 1 (a Tobit model)."""
    value = np.random.default_rng(2).normal(0.7, 0.5, 60)
    is_censored = value > 1.0
    data = Measurements(np.minimum(value, 1.0), 0.5, is_censored)
    fit = identify(lambda p: jnp.repeat(p["mean"][:, None], 60, axis=1), data, {"mean": 0.0})

    def deviance(mean):
        log_density = scipy.stats.norm.logpdf(value[~is_censored], mean, 0.5).sum()
        return -2.0 * (log_density + is_censored.sum() * scipy.stats.norm.logsf(1.0, mean, 0.5))

    optimum = scipy.optimize.minimize_scalar(deviance, (0.0, 1.0), tol=1e-12)
    assert_close(fit.estimates["mean"], optimum.x, atol=1e-5)
    assert fit.residuals[int(np.argmax(is_censored))].censored


def test_missing_predictions_are_a_penalty_without_slope():
    data = Measurements(np.zeros(4), 1.0, np.array([False, True, True, False]))
    prediction = jnp.array([jnp.nan, jnp.nan, jnp.inf, 2.0])
    value, slope = jax.jit(lambda prediction: jax.jvp(data.residuals, (prediction,), (jnp.ones(4),)))(prediction)
    assert_close(value, [MISSING, MISSING, 0.0, 2.0])
    assert_close(slope, [0.0, 0.0, 0.0, 1.0])


def test_bounds_are_kept_and_positive_numbers_are_fitted_in_logarithms():
    data = Measurements(np.array([4.0, 4.1]), 0.1)
    with pytest.warns(FitWarning, match="residuals are too large"):
        fit = identify(lambda p: jnp.repeat(p["x"][:, None], 2, axis=1), data, {"x": Free(1.0, 0.0, 3.0)})
    assert 2.99 < fit.estimates["x"] < 3.0
    free = {"a": Free(2.0), "b": Free(2.0, 0.0), "c": Free(2.0, -1.0, 3.0), "d": Free(2.0, upper=5.0)}
    unknowns = Unknowns(free, {})
    coordinates = unknowns.coordinates(np.full(4, 2.5))
    for place in (coordinates, jnp.asarray(coordinates)):
        assert_close(unknowns.values(place), np.full(4, 2.5), rtol=1e-12)
    slopes = np.diag(jax.jacfwd(unknowns.values)(jnp.asarray(coordinates)))
    expected = np.diag(
        [(unknowns.values(coordinates + h) - unknowns.values(coordinates - h)) / 2e-6 for h in 1e-6 * np.eye(4)]
    )
    assert_close(slopes, expected, rtol=1e-8)
    with pytest.raises(ValueError, match="coordinates must have 4 numbers, not 1"):
        unknowns.values(coordinates[:1])
    fit = identify(lambda p: jnp.repeat(p["x"][:, None], 2, axis=1), data, {"x": Free(1.0, 0.0)})
    assert_close(np.sqrt(fit.coordinate_covariance[0, 0]), 0.1 / np.sqrt(2.0) / 4.05, rtol=1e-4)


def test_a_prior_is_one_more_measurement():
    data = Measurements(np.array([4.0]), 0.3)
    fit = identify(lambda p: p["x"][:, None], data, {"x": Free(1.0, prior=(3.0, 0.6))})
    assert_close(fit.estimates["x"], (4.0 / 0.09 + 3.0 / 0.36) / (1.0 / 0.09 + 1.0 / 0.36), rtol=1e-8)
    assert_close(fit.standard_errors["x"], (1.0 / 0.09 + 1.0 / 0.36) ** -0.5, rtol=1e-9)
    # The estimates that the data determine do not change.
    assert_close(fit.identifiability.singular_values, 1.0 / 0.3, rtol=1e-9)


def test_a_direction_that_the_data_cannot_see_is_named():
    """Only the product a b and c enter: a and b cannot be message apart, c can."""
    t = np.linspace(0.5, 2.0, 9)

    def model(p):
        return (p["a"] * p["b"])[:, None] * jnp.exp(-p["c"][:, None] * t)

    data = Measurements(6.0 * np.exp(-0.5 * t), 0.01)
    with pytest.warns(FitWarning, match="the data do not determine a and b: fix one, or give a prior"):
        fit = identify(model, data, {"a": Free(1.0, 0.0), "b": Free(2.0, 0.0), "c": 0.4})
    assert fit.identifiability.singular_values[2] < 1e-6 * fit.identifiability.singular_values[0]
    assert_close(np.abs(fit.identifiability.directions[2]), [0.5**0.5, 0.5**0.5, 0.0], atol=1e-6)
    assert len(fit.identifiability.unseen) == 1
    assert fit.identifiability.unseen[0] in ("a +1 %, b -1 %", "a -1 %, b +1 %")
    assert np.isinf(fit.standard_errors["a"])
    assert np.isinf(fit.standard_errors["b"])
    assert fit.standard_errors["c"] < 0.01
    assert_close(fit.estimates["a"] * fit.estimates["b"], 6.0, rtol=1e-6)
    assert "UNDETERMINED" in fit.details
    with pytest.raises(ValueError, match="'a', whose standard error is infinite"):
        fit.profile("a")
    assert_close(coordinate_covariance(np.array([[2.0, 0.0]])), [[0.25, 0.0], [0.0, np.inf]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"free": {}}, "free = {} must be a non-empty"),
        ({"free": {"x": np.nan}}, "start of x"),
        ({"free": {"x": [1.0, 2.0]}}, "must be one number"),
        ({"free": {"x": Free(-1.0, lower=0.0)}}, "start of x = -1.0 must be greater than 0.0"),
        ({"free": {"x": Free(1.0, prior=(0.0, 0.0))}}, "standard deviation of the prior of x"),
        ({"free": {"x": Free(1.0, prior=(1.0, 2.0, 3.0))}}, "must be a mean and a standard deviation"),
        ({"starts": 0}, "starts = 0"),
        ({"spread": 1.0}, "spread = 1.0"),
        ({"seed": -1}, "seed = -1"),
        ({"progress": "no"}, "progress = 'no' must be True or False"),
        ({"max_steps": 2.5}, "max_steps = 2.5"),
        ({"labels": ("a",)}, "labels must be 2"),
        ({"measurements": 3.0}, "must be Measurements"),
        ({"model": lambda p: p["x"][:, None]}, "model must predict"),
    ],
)
def test_bad_arguments_are_named(change, message):
    arguments = {"model": lambda p: jnp.repeat(p["x"][:, None], 2, axis=1), "free": {"x": 1.0}}
    arguments |= {"measurements": Measurements(np.zeros(2), 1.0)}
    with pytest.raises(ValueError, match=message):
        identify(**(arguments | change))


@pytest.mark.parametrize("measurements", [(1.0, 1.0), ([1.0], 0.0), ([np.nan], 1.0), ([1.0, 2.0], [1.0, 2.0, 3.0])])
def test_bad_measurements_are_refused(measurements):
    with pytest.raises(ValueError, match=r"value|error"):
        Measurements(*measurements)


def test_names_are_paths_or_their_ends():
    names = ["scene.body.offset", "scene.friction.mu", "launch.spin", "launch.mu"]
    assert full_name("free", "offset", names) == "scene.body.offset"
    assert full_name("free", "friction.mu", names) == "scene.friction.mu"
    with pytest.raises(ValueError, match=r"scene.friction.mu or launch.mu"):
        full_name("free", "mu", names)
    with pytest.raises(ValueError, match="must be one of"):
        full_name("free", "fset", names)


@pytest.mark.parametrize(("name", "half_width"), [("start[0].x", 0.1), ("modes[0].start", 2.0)])
def test_the_range_of_a_number_is_the_same_for_one_of_several_data(name, half_width):
    for full in (name, f"data[0].{name}"):
        region = region_of(LogDensity.of(line, Measurements([1.0], 0.1), {full: 2.0}), 3.0)
        assert_close(region.half_width, [half_width], rtol=1e-12)


def test_the_verdict_tells_that_an_estimate_is_outside_of_the_searched_range():
    """The truth is 1; a friction-like number is searched within a factor of two of its start."""
    times = np.arange(1.0, 9.0)
    measurements = Measurements(0.5**times + 0.02 * np.cos(7.0 * times), 0.02)

    def fit(start):
        free = {"half_life": Free(start, lower=0.0)}
        return identify(lambda p: 0.5 ** (times / p["half_life"][:, None]), measurements, free, progress=False)

    far, near = fit(2.5), fit(1.5)
    assert abs(far.estimates["half_life"] - near.estimates["half_life"]) < 0.3 * near.standard_errors["half_life"]
    assert [note for note in far.verdict.notes if note.startswith("half_life: outside of the range")]
    assert not [note for note in near.verdict.notes if "outside" in note]


def test_a_model_without_predictions_is_reported():
    with pytest.raises(ValueError, match=r"no start led to finite predictions: simulate .* falls through zero"):
        identify(lambda numbers: jnp.nan * line(numbers), Measurements(X, ERROR), {"height": 0.5, "slope": 0.0})


def test_a_fit_between_bounds_is_no_worse_than_its_start():
    """A valley so narrow that none of the candidates between the bounds lies in it."""

    def valley(p):
        off = jnp.stack([(p["a"] - 63.21) / 0.01, (p["b"] - 0.37) / 1e-4], axis=1)
        return 20.0 * jnp.tanh(off)

    free = {"a": Free(63.215, 0.0, 100.0), "b": Free(0.37, 0.0, 1.0)}
    fit = identify(valley, Measurements([0.0, 0.0], 1.0), free, progress=False)
    assert_close([fit.estimates["a"], fit.estimates["b"]], [63.21, 0.37], rtol=1e-6)
    assert fit.deviance < 1e-6
