"""Likelihoods of measurements, limits and angles, against SciPy's distributions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from close import assert_close

from nonholonomic.identification import Measurements, identify
from nonholonomic.identification.posterior import between

phi = scipy.stats.norm

# As whole programs: single operations compile for longer.
compiled_between, compiled_slope = jax.jit(between), jax.jit(jax.grad(between))
residuals = eqx.filter_jit(Measurements.residuals)


@pytest.mark.parametrize("half", [1e-3, 0.5, 3.0, 20.0])
def test_between_two_limits_it_is_the_probability_of_lying_there(half):
    z = np.linspace(-half - 6.0, half + 6.0, 41)
    lower = phi.logcdf(half - np.abs(z)) + np.log(
        -np.expm1(phi.logcdf(-half - np.abs(z)) - phi.logcdf(half - np.abs(z)))
    )
    peak = np.log(phi.cdf(half) - phi.cdf(-half))
    probability = np.asarray(compiled_between(z, half))
    assert_close(probability**2, -2.0 * (lower - peak), rtol=1e-5, atol=1e-8)
    assert np.all(np.diff(probability) >= 0.0)
    # A narrow interval is a measurement; and in its middle the slope is finite.
    slope = compiled_slope(0.0, half)
    assert np.isfinite(slope)
    if half < 0.01:
        assert_close(probability, z, rtol=1e-4, atol=1e-6)
        assert_close(slope, 1.0, rtol=1e-4)


def test_limits_of_all_kinds_have_their_likelihoods():
    data = Measurements([-np.inf, 2.0, 1.0, 4.0], 0.5, upper=[1.0, np.inf, 1.8, 4.0])
    abscissas = np.array([1.3, 1.9, 1.5, 3.6])
    probabilities = [phi.cdf((1.0 - 1.3) / 0.5), phi.cdf((1.9 - 2.0) / 0.5), phi.cdf(0.6) - phi.cdf(-1.0)]
    middle = phi.cdf(0.8) - phi.cdf(-0.8)
    expected = [
        -2.0 * np.log(probabilities[0]),
        -2.0 * np.log(probabilities[1]),
        -2.0 * np.log(probabilities[2] / middle),
        0.64,
    ]
    residual = np.asarray(residuals(data, abscissas))
    assert_close(residual**2, expected, rtol=1e-9)
    assert data.censored.tolist() == [True, True, True, False]
    assert_close(np.sign(residual), [1.0, -1.0, 1.0, -1.0])


def test_angles_come_back_after_a_turn():
    data = Measurements([3.1, -3.1, 0.2, 0.3], 0.1, period=2.0 * np.pi)
    predictions = np.array([-3.1, 3.1, 0.2 + 6.0 * np.pi, 0.3])
    expected = [(2 * np.pi - 6.2) / 0.1, (6.2 - 2 * np.pi) / 0.1, 0.0, 0.0]
    assert_close(residuals(data, predictions), expected, atol=1e-9)


def test_heavy_tails_are_those_of_student():
    z = np.array([0.0, 0.3, -2.0, 15.0])
    data = Measurements(np.zeros(4), 2.0, student=4.0)
    expected = -2.0 * (scipy.stats.t.logpdf(z, 4.0) - scipy.stats.t.logpdf(0.0, 4.0))
    assert_close(np.asarray(residuals(data, 2.0 * z)) ** 2, expected, rtol=1e-9, atol=1e-15)
    # Fisher's information of the location is (nu + 1) / (nu + 3) / scale^2.
    points, weights = np.polynomial.legendre.leggauss(400)
    abscissas, width = 60.0 * points, 60.0 * weights
    slope = 5.0 * abscissas / (4.0 + abscissas**2)
    information = np.sum(width * scipy.stats.t.pdf(abscissas, 4.0) * slope**2) / 4.0
    roots = data.roots_of_information(jnp.zeros(4), jnp.ones(4))
    assert_close(np.asarray(roots)[0] ** 2, information, rtol=1e-3)


def test_an_outlier_does_not_spoil_a_fit_with_heavy_tails():
    value = np.array([1.02, 0.97, 1.05, 0.99, 1.01, 0.95, 1.5])
    fit = identify(
        lambda p: jnp.repeat(p["mean"][:, None], 7, axis=1), Measurements(value, 0.05, student=4.0), {"mean": 0.5}
    )

    def deviance(mean):
        return -2.0 * scipy.stats.t.logpdf((value - mean) / 0.05, 4.0).sum()

    optimum = scipy.optimize.minimize_scalar(deviance, (0.9, 1.1), tol=1e-12)
    assert_close(fit.estimates["mean"], optimum.x, atol=1e-6)
    assert abs(fit.estimates["mean"] - 1.0) < 0.05
