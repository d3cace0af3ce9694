"""Posteriors whose mean and covariance are known: the density, its gradient, draws, and ranks of the truth among them."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from close import assert_close

from nonholonomic.identification import Free, LogDensity, Measurements, identify, sample

X = np.linspace(0.0, 1.0, 12)
ERROR, PRIOR = 0.2, (1.0, 0.3)


def line(p):
    return p["height"][:, None] + p["slope"][:, None] * X


def measured(height=2.0, slope=-3.0, seed=0):
    return Measurements(height + slope * X + ERROR * np.random.default_rng(seed).normal(size=X.size), ERROR)


def test_the_density_is_that_of_bayes_in_the_coordinates():
    data = measured()
    density = LogDensity.of(line, data, {"height": Free(1.5, 0.0), "slope": -2.0}, {"height": PRIOR})
    at = np.array([np.log(1.8), 0.3])

    def expected(at):
        height, slope = np.exp(at[0]), -2.0 + 2.0 * at[1]
        likelihood = scipy.stats.norm.logpdf(np.asarray(data.value), height + slope * X, ERROR).sum()
        # The height is uniform in no coordinate: its prior is of the height, and d height = height d coordinate.
        return likelihood + scipy.stats.norm.logpdf(height, *PRIOR) + at[0]

    constant = float(density(jnp.asarray(density.start))) - expected(np.asarray(density.start))
    value, gradient = density.value_and_gradient(at)
    assert_close(value, expected(at) + constant, rtol=1e-10)
    steps = 1e-5 * np.eye(2)
    assert_close(gradient, [(expected(at + s) - expected(at - s)) / 2e-5 for s in steps], rtol=1e-6)
    assert_close(density.values(jnp.asarray(at))["height"], 1.8)
    several = density.value_and_gradient(np.stack([at, at]))[1]
    assert_close(several, [gradient, gradient], rtol=1e-12)


@pytest.fixture(scope="module")
def draws():
    data, free = measured(), {"height": 0.5, "slope": -2.0}
    fit = identify(line, data, free)
    density = LogDensity.of(line, data, free)
    return fit, density, sample(density, fit.coordinates, fit.coordinate_covariance, draws=400, progress=False)


def test_draws_have_the_mean_and_the_covariance_of_the_regression(draws):
    fit, density, found = draws
    assert all(value < 1.02 for value in found.r_hat.values())
    assert all(value > 400.0 for value in found.ess.values())
    assert found.divergences == 0
    for name, value in found.values.items():
        error = fit.standard_errors[name]
        assert abs(value.mean() - fit.estimates[name]) < 4.0 * error / np.sqrt(found.ess[name])
        assert_close(value.std(), error, rtol=0.1)
    flat = found.coordinates.reshape(-1, 2)
    replicas = density.replicate(flat, seed=1)
    spread = np.sqrt(ERROR**2 + np.var(np.asarray(density.predict(jnp.asarray(flat))), axis=0))
    assert_close(replicas.std(axis=0), spread, rtol=0.1)


def test_unknown_errors_are_drawn_too():
    value = 1.0 + 0.3 * np.random.default_rng(4).normal(size=60)
    data = Measurements(value, 1.0, estimated=True)
    density = LogDensity.of(lambda p: jnp.repeat(p["mean"][:, None], 60, axis=1), data, {"mean": 0.0})
    assert density.names == ("mean", "error[0]")
    at = np.array([value.mean(), np.log(np.std(value))])
    # At the mean and the standard deviation of the values the density has its maximum.
    assert_close(density.value_and_gradient(at)[1], [0.0, 0.0], atol=1e-9)


AT = np.linspace(0.0, 2.0, 5)


def decay(p):
    return p["height"][:, None] * jnp.exp(-p["rate"][:, None] * AT)


def test_the_truth_has_uniform_ranks_among_draws():
    """Simulation-based calibration (Talts et al., arXiv:1804.06788), in short for `benchmarks/calibration.py`.

    Predictions are curved, so that the slopes that the leaps follow are wrong off the middle; and priors are of the
    parameters, not of their logarithms.
    """
    random, ranks, error = np.random.default_rng(5), [], 0.25
    free = {"height": Free(1.0, 0.0, prior=(1.0, 0.3)), "rate": Free(1.0, 0.0, prior=(1.0, 0.4))}
    covariance = np.diag([0.1, 0.2])
    for _ in range(40):
        truth = {name: abs(random.normal(*one.prior)) for name, one in free.items()}
        exact = np.asarray(decay({name: jnp.array([value]) for name, value in truth.items()}))[0]
        density = LogDensity.of(decay, Measurements(exact + error * random.normal(size=5), error), free)
        found = sample(density, density.start, covariance, warmup=40, draws=25, progress=False)
        ranks.append([np.mean(found.values[name] < value) for name, value in truth.items()])
    for some in np.transpose(ranks):
        assert scipy.stats.kstest(some, "uniform").pvalue > 0.01
