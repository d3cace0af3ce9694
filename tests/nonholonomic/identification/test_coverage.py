"""Intervals contain the truth as often as they say, from starts elsewhere, where slopes mislead and minima are many."""

import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from nonholonomic.identification import FitWarning, Free, LogDensity, Measurements, identify, sample
from nonholonomic.identification.conclusions import Distribution
from nonholonomic.identification.exploration import (
    COMPONENTS,
    EVEN,
    FREEDOM,
    Mixture,
    fitted,
    independent_number,
    smoothed_weights,
)

X = np.linspace(0.5, 1.5, 8)
TRUTH, ERROR, TOOTH = 2.0, 0.05, 0.1


def teeth(p):
    """Lines whose slope at every place is four times the trend, like inversion times over a nutation period."""
    trend = p["rate"][:, None] * X
    phase = 37.0 * trend + np.arange(8.0)
    return trend + TOOTH * (phase - jnp.floor(phase) - 0.5)


def fits(count, model=teeth, **options):
    """Random truths, and fits of noisy data from random starts within a factor of 1.3 of them. On a staircase, intervals
    contain the truth as often as they say in the mean over its place on a stair."""
    random = np.random.default_rng(5)
    truths = TRUTH * random.uniform(0.9, 1.1, count)
    predicted = np.asarray(model({"rate": jnp.asarray(truths)}))
    for truth, exact in zip(truths, predicted, strict=True):
        data = Measurements(exact + ERROR * random.normal(size=8), ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            start = truth * 1.3 ** random.uniform(-1.0, 1.0)
            yield truth, identify(model, data, {"rate": start}, progress=False, **options)


@pytest.mark.parametrize("slopes", ["exact", pytest.param("differences", marks=pytest.mark.slow)])
def test_intervals_cover_the_truth_on_a_staircase(slopes):
    """Of 24 intervals of 95 %, 20 or more contain it with a probability of 0.994; by exact slopes, 12 do."""
    results = list(fits(24, slopes=slopes))

    def share(deviations):
        ends = [(truth, fit.interval("rate", deviations)) for truth, fit in results]
        return sum(low <= truth <= high for truth, (low, high) in ends)

    assert share(1.96) >= 20
    assert 10 <= share(1.0) <= 22
    near = sum(abs(fit.estimates["rate"] - truth) < fit.standard_errors["rate"] for truth, fit in results)
    assert 10 <= near <= 22
    by_slopes = sum(abs(fit.most_likely["rate"] - truth) < 1.96 * fit.slope_errors["rate"] for truth, fit in results)
    if slopes == "exact":
        assert by_slopes < 18
    assert sum("slopes understate the errors" in fit.details for _, fit in results) >= 12
    assert all(fit.verdict.effective >= 400.0 and fit.verdict.k < 0.7 for _, fit in results)


@pytest.mark.filterwarnings("ignore:these are no draws.*ESS:nonholonomic.identification.FitWarning")
def test_the_rank_of_the_truth_among_draws_is_uniform():
    """Simulation-based calibration of `sample` on the staircase. Of 16 ranks, more than 3 are in the outer 5 % with a
    probability of 0.007; of draws around a fit by its slopes, 6 are."""
    random, ranks = np.random.default_rng(8), []
    for seed in range(16):
        truth = TRUTH + 0.1 * random.normal()
        exact = np.asarray(teeth({"rate": jnp.array([truth])}))[0]
        data = Measurements(exact + ERROR * random.normal(size=8), ERROR)
        density = LogDensity.of(teeth, data, {"rate": Free(TRUTH, prior=(TRUTH, 0.1))})
        draws = sample(density, chains=2, warmup=5, draws=50, seed=seed, progress=False)
        ranks.append(np.mean(draws.values["rate"] < truth))
    assert scipy.stats.kstest(ranks, "uniform").pvalue > 0.01
    assert np.sum(np.abs(np.array(ranks) - 0.5) > 0.475) <= 3


def test_two_starts_give_the_same_posterior():
    exact = np.asarray(teeth({"rate": jnp.array([TRUTH])}))[0]
    data = Measurements(exact + ERROR * np.random.default_rng(0).normal(size=8), ERROR)
    first, second = (identify(teeth, data, {"rate": start}) for start in (1.5, 2.6))
    grid = np.linspace(1.5, 2.5, 20001)
    logs = -0.5 * np.sum(
        ((np.asarray(teeth({"rate": jnp.asarray(grid)})) - np.asarray(data.value)) / ERROR) ** 2, axis=1
    )
    weights = np.exp(logs - np.max(logs)) / grid
    cumulative = np.cumsum(weights) / np.sum(weights)
    for fit in (first, second):
        # An end on the edge of a stair may jump to the next one, with hardly any probability between them.
        assert np.all(np.abs(np.interp(fit.interval("rate"), grid, cumulative) - [0.025, 0.975]) < 0.025)
        assert np.all(np.abs(np.interp(fit.interval("rate", 1.0), grid, cumulative) - [0.159, 0.841]) < 0.05)


def test_several_minima_are_told_with_their_weights():
    """The sign of a number that enters by its square is not determined."""
    data = Measurements(np.full(5, 4.0), 0.5)
    with pytest.warns(FitWarning, match="the data allow 2 minima, which the details list"):
        fit = identify(lambda p: jnp.repeat(p["x"][:, None] ** 2, 5, axis=1), data, {"x": 1.0}, spread=5.0)
    assert re.search(r"note: minimum: x -?\S+ \(weight 0\.\d+\)", fit.details)
    values = sorted(minimum.estimates["x"] for minimum in fit.verdict.minima)
    np.testing.assert_allclose(values, [-2.0, 2.0], atol=0.05)
    np.testing.assert_allclose([minimum.weight for minimum in fit.verdict.minima], 0.5, atol=0.1)


def test_a_number_that_only_a_limit_bounds_is_told():
    data = Measurements([1.0], 0.1, censored=True)
    with pytest.warns(FitWarning, match="do not (bound|determine) x"):
        identify(lambda p: p["x"][:, None], data, {"x": 2.0})


def test_infinite_draws_without_weight_do_not_spoil_the_standard_error():
    problem = LogDensity.of(lambda p: p["x"][:, None], Measurements([1.0], 0.1), {"x": Free(1.0, 0.0)}).problem
    points, weights = np.append(np.linspace(-1.0, 1.0, 201), 1000.0)[:, None], np.append(np.full(201, 1.0 / 201.0), 0.0)
    distribution = Distribution("weights", np.zeros(1), np.eye(1), points, weights)
    low, high = np.exp(distribution.interval(0, 1.0))
    variance = distribution.covariance_of_values(problem, np.ones(1))[0, 0]
    assert variance == pytest.approx((0.5 * (high - low)) ** 2)


def test_smoothed_weights_know_a_heavy_tail():
    """Weights of a Pareto distribution with the shape 0.5 are fine, with the shape 1 they are not."""
    uniform = np.random.default_rng(0).uniform(size=4000)
    for shape in (0.3, 1.0):
        weights, k = smoothed_weights(-shape * np.log(uniform))
        assert abs(k - shape) < 0.15
        assert abs(np.sum(weights) - 1.0) < 1e-12
    # Three weights outweigh all others by 300 orders of magnitude.
    logs = np.concatenate([[0.0, -1.0, -2.0], np.linspace(-700.0, -300.0, 397), np.full(1600, -800.0)])
    assert np.isfinite(smoothed_weights(logs)[1])


def test_draws_of_a_single_unknown_are_spread_evenly():
    """One from each of 100 intervals of nearly equal probability."""
    mixture = Mixture(np.array([0.3, 0.7]), np.array([[0.0], [2.0]]), np.array([[[0.5]], [[1.0]]]))
    draws = mixture.draw(100, np.random.default_rng(0))[:, 0]
    places = 0.3 * scipy.stats.t.cdf(draws / 0.5, FREEDOM) + 0.7 * scipy.stats.t.cdf(draws - 2.0, FREEDOM)
    np.testing.assert_allclose(100.0 * places, np.arange(100) + 0.5, atol=2.0)
    assert np.std(100.0 * np.diff(places)) < 0.3


def test_proposals_of_a_single_unknown_keep_narrow_minima_apart():
    """A component over both of two minima, which few points resolve, would draw hardly any points in them."""
    points = np.concatenate([place + np.linspace(-0.1, 0.1, 24) for place in (-1.0, 1.0)])[:, None]
    weights = np.exp(-0.5 * ((np.abs(points[:, 0]) - 1.0) / 0.03) ** 2)
    mixture = fitted(points, weights / np.sum(weights), COMPONENTS, np.random.default_rng(0))
    assert np.max(mixture.roots) < 0.1
    assert np.sum(mixture.shares[mixture.centres[:, 0] > 0.0]) == pytest.approx(0.5, abs=0.05)


def test_points_of_a_single_unknown_are_worth_more_than_independent_ones_where_the_density_is_smooth():
    """The rougher the density, the less; never less than independent draws."""
    points = np.linspace(-1.0, 2.0, 4000)[:, None]
    smooth = np.full(4000, 1.0 / 4000.0)
    assert independent_number(points, smooth) == pytest.approx(EVEN * 4000.0)
    assert independent_number(np.tile(points, 2), smooth) == pytest.approx(4000.0)
    normal = np.random.default_rng(1).normal(size=4000)
    for sigma in (0.5, 1.0):
        weights = np.exp(sigma * normal) / np.sum(np.exp(sigma * normal))
        variance = np.exp(sigma**2) - 1.0
        expected = max(1.5 * 4000.0 / variance, 1.0 / np.sum(weights**2))
        assert independent_number(points, weights) == pytest.approx(expected, rel=0.2)
    # A density that is 1 in one half and 0 in the other is known up to the place of the jump.
    step = np.where(points[:, 0] < 0.5, 1.0 / 2000.0, 0.0)
    assert independent_number(points, step) == pytest.approx(EVEN * 2000.0)


class Counted:
    """The model above with teeth of some height; it counts its runs."""

    on_host = True

    def __init__(self, tooth):
        self.tooth, self.runs = tooth, 0

    def __call__(self, p):
        trend = np.asarray(p["rate"])[:, None] * X
        self.runs += int(np.sum(np.isfinite(trend[:, 0])))
        phase = 37.0 * trend + np.arange(8.0)
        return trend + self.tooth * (phase - np.floor(phase) - 0.5)


@pytest.mark.filterwarnings("ignore:the data allow:nonholonomic.identification.FitWarning")
@pytest.mark.parametrize(("tooth", "least", "most"), [(0.0, 100, 180), (TOOTH, 150, 1000)])
def test_a_smooth_likelihood_of_one_unknown_takes_few_runs(tooth, least, most):
    """By differences, as for tops that hop, of which every run takes long."""
    model = Counted(tooth)
    data = Measurements(TRUTH * X + ERROR * np.random.default_rng(0).normal(size=8), ERROR)
    fit = identify(model, data, {"rate": 1.7}, slopes="differences", progress=False)
    assert fit.verdict.effective >= 400.0
    assert least < model.runs < most
    low, high = fit.interval("rate")
    assert low < TRUTH < high
    if tooth == 0.0:
        # Least squares of a line through zero.
        values = np.asarray(data.value)
        assert fit.slope_errors["rate"] == pytest.approx(ERROR / np.linalg.norm(X), rel=0.01)
        assert fit.most_likely["rate"] == pytest.approx(values @ X / (X @ X), abs=0.1 * fit.slope_errors["rate"])
        assert fit.standard_errors["rate"] == pytest.approx(fit.slope_errors["rate"], rel=0.05)
