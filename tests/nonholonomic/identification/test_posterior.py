"""Posteriors whose mean and covariance are known: the density, its gradient, and draws."""

import itertools
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from close import assert_close

from nonholonomic.identification import Draws, FitWarning, Free, LogDensity, Measurements, identify, sample

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from plain_nuts import plain

X = np.linspace(0.0, 1.0, 12)
ERROR, PRIOR = 0.2, (1.0, 0.3)


def line(p):
    return p["height"][:, None] + p["slope"][:, None] * X


def measured(height=2.0, slope=-3.0, seed=0):
    return Measurements(height + slope * X + ERROR * np.random.default_rng(seed).normal(size=X.size), ERROR)


def test_the_density_is_that_of_bayes_in_the_coordinates():
    data = measured()
    density = LogDensity.of(line, data, {"height": Free(1.5, 0.0), "slope": -2.0}, {"height": PRIOR})
    point = np.array([np.log(1.8), 0.3])

    def expected(point):
        height, slope = np.exp(point[0]), -2.0 + 2.0 * point[1]
        likelihood = scipy.stats.norm.logpdf(np.asarray(data.value), height + slope * X, ERROR).sum()
        # The height is uniform in no coordinate: its prior is of the height, and d height = height d coordinate.
        return likelihood + scipy.stats.norm.logpdf(height, *PRIOR) + point[0]

    constant = float(density(jnp.asarray(density.start))) - expected(np.asarray(density.start))
    value, gradient = density.value_and_gradient(point)
    assert_close(value, expected(point) + constant, rtol=1e-10)
    steps = 1e-5 * np.eye(2)
    assert_close(gradient, [(expected(point + s) - expected(point - s)) / 2e-5 for s in steps], rtol=1e-6)
    assert_close(density.values(jnp.asarray(point))["height"], 1.8)
    gradients = density.value_and_gradient(np.stack([point, point]))[1]
    assert_close(gradients, [gradient, gradient], rtol=1e-12)


#: Unknowns with a prior, with two bounds, and with a function as prior.
KINDS = {
    "rate": Free(0.3, 0.0, prior=(0.3, 0.1)),
    "b": Free(0.5, 0.2, 0.9),
    "offset": Free(0.006, 0.0),
}


def expected_log_prior(name, coordinate):
    """The log density of a coordinate by SciPy, from that of the parameter."""
    if name == "rate":
        return scipy.stats.norm.logpdf(np.exp(coordinate), 0.3, 0.1) + coordinate
    if name == "b":
        return np.log(0.7) + scipy.stats.logistic.logpdf(coordinate)
    return scipy.stats.expon.logpdf(np.exp(coordinate), scale=0.01) + coordinate


@pytest.mark.parametrize("names", list(itertools.permutations(KINDS)), ids="-".join)
def test_priors_and_bounds_stay_with_their_unknowns(names):
    """In rows and at single points, for every order of the names, and as SciPy has them."""
    data = Measurements([1.0, 2.0, 3.0], 0.1, estimated=True)

    def model(p):
        assert tuple(p) == names
        return jnp.stack([p["rate"], p["b"], p["offset"]], axis=1)

    function = {"offset": lambda offset: jnp.log(100.0) - 100.0 * offset}
    density = LogDensity.of(model, data, {name: KINDS[name] for name in names}, function)
    points = np.asarray(density.start) + 0.3 * np.random.default_rng(0).normal(size=(4, 4))
    expected = sum(expected_log_prior(name, points[:, k]) for k, name in enumerate(names))
    assert_close(density.log_priors(points), expected, rtol=1e-10)

    def single(point, prediction):
        """The density less the likelihood with the errors of the point."""
        return density.of_prediction(point, prediction) - density._with_errors(point).log_likelihood(prediction)

    assert_close(jax.jit(jax.vmap(single))(points, density.predict(points)), expected, rtol=1e-9)


def test_densities_that_differ_in_numbers_share_a_program(caplog):
    """With other starts, bounds and priors, the density has other values and compiles nothing."""

    def density(start, lower, slope, prior, data):
        free = {"height": Free(start, lower), "slope": Free(0.0, prior=slope)}
        return LogDensity.of(line, data, free, {"height": prior})

    point, first = np.zeros(2), density(1.5, 0.0, (-2.0, 1.0), PRIOR, measured())
    first.value_and_gradient(point)
    shifted = density(1.7, 0.1, (-3.0, 2.0), (1.1, 0.2), measured(seed=1))
    with jax.log_compiles():
        value, gradient = shifted.value_and_gradient(point)
    assert not [text for text in caplog.messages if "Finished XLA compilation" in text]
    # At the coordinate 0 the height is 1 above its bound, the slope is where it started.
    residuals = (1.1 + 0.0 * X - np.asarray(measured(seed=1).value)) / ERROR
    expected = -0.5 * np.sum(residuals**2) - X.size * np.log(ERROR)
    expected += scipy.stats.norm.logpdf(1.1, 1.1, 0.2) + scipy.stats.norm.logpdf(0.0, -3.0, 2.0) + np.log(2.0)
    assert_close(value, expected, rtol=1e-12)
    assert_close(gradient[0], -np.sum(residuals) / ERROR + 1.0, rtol=1e-12)


@pytest.fixture(scope="module")
def draws():
    data, free = measured(), {"height": 0.5, "slope": -2.0}
    fit = identify(line, data, free)
    density = LogDensity.of(line, data, free)
    return fit, density, sample(density, fit.coordinates, fit.coordinate_covariance, draws=400, progress=False)


@pytest.mark.slow
def test_draws_have_the_mean_and_the_covariance_of_the_regression(draws):
    fit, density, posterior = draws
    assert all(value < 1.02 for value in posterior.r_hat.values())
    assert all(value > 400.0 for value in posterior.ess.values())
    # Proposals are heavy-tailed, and half of them come from a flatter density.
    assert posterior.accepted > 0.4
    for name, value in posterior.values.items():
        error = fit.standard_errors[name]
        assert abs(value.mean() - fit.estimates[name]) < 4.0 * error / np.sqrt(posterior.ess[name])
        assert_close(value.std(), error, rtol=0.1)
    flat = posterior.coordinates.reshape(-1, 2)
    replicas = density.replicate(flat, seed=1)
    deviations = np.sqrt(ERROR**2 + np.var(np.asarray(density.predict(jnp.asarray(flat))), axis=0))
    assert_close(replicas.std(axis=0), deviations, rtol=0.1)


def test_a_single_unknown_is_drawn_profiled_and_shown_like_several():
    """The mean of 12 numbers, whose draws are normal with a standard deviation of the error / sqrt(12)."""
    data, error = measured(slope=0.0), ERROR / np.sqrt(X.size)

    def level(p):
        return jnp.repeat(p["height"][:, None], X.size, axis=1)

    # As many starts as the profile has points, so that they share a program.
    fit = identify(level, data, {"height": 0.5}, starts=13)
    density = LogDensity.of(level, data, {"height": 0.5})
    posterior = sample(
        density, fit.coordinates, fit.coordinate_covariance, chains=2, draws=100, warmup=5, progress=False
    )
    assert posterior.values["height"].shape == (2, 100)
    assert abs(posterior.values["height"].mean() - np.mean(data.value)) < 4.0 * error / np.sqrt(posterior.ess["height"])
    assert f"R-hat {posterior.r_hat['height']:.4f}, ESS {posterior.ess['height']:.0f}" in str(posterior)
    profile = fit.profile("height")
    assert_close(profile.deviance, ((profile.values - np.mean(data.value)) / error) ** 2, atol=1e-9)
    assert profile.estimates == {}
    assert [axes.get_xlabel() for axes in fit.plot().axes].count("height") == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chains": 1}, "chains = 1 must be a whole number of at least 2"),
        ({"draws": 1}, "draws = 1 must be"),
        ({"warmup": -1}, "warmup = -1 must be"),
        ({"seed": 0.5}, "seed = 0.5 must be"),
        ({"progress": "no"}, "progress = 'no' must be True or False"),
        ({"centre": [0.0]}, r"centre = \[0.0\] must be of shape \(2,\)"),
        ({"covariance": np.diag([1.0, np.inf])}, "covariance must be finite"),
    ],
)
def test_draws_that_could_not_be_judged_are_refused_at_once(change, message):
    density = LogDensity.of(line, measured(), {"height": 0.5, "slope": -2.0})
    with pytest.raises(ValueError, match=message):
        sample(**({"density": density, "centre": np.zeros(2), "covariance": np.eye(2)} | change))


def test_draws_that_are_no_posterior_say_so():
    """Too few draws, chains that stay where they are, and a start in a pit that the search cannot find."""
    data = Measurements([0.0], 0.05)

    def pit(p):
        return jnp.where(jnp.abs(p["x"] - 1.0) < 1e-6, 0.0, 1.0)[:, None]

    density = LogDensity.of(pit, data, {"x": Free(1.0, prior=(1.5, 0.3))})
    with pytest.warns(
        FitWarning, match="no draws from the posterior: the ESS of x is .*the start is more probable"
    ) as record:
        draws = sample(density, chains=2, draws=20, progress=False)
    assert "exp(19" in str(record[0].message) or "exp(20" in str(record[0].message)
    assert not draws.good
    assert draws.values["x"].shape == (2, 20)
    assert "x  no interval  R-hat" in str(draws)
    assert "NO POSTERIOR: the ESS" in str(draws)
    with pytest.warns(FitWarning, match="^the start is more probable"):
        assert sample(density, chains=2, draws=200, progress=False).good
    stuck = Draws.of(density, np.zeros((2, 200, 1)), 0.001, 400)
    assert [flaw.split(":")[0] for flaw in stuck.flaws] == [
        "only 0.1 % of the proposals were accepted",
        f"the ESS of x is {stuck.ess['x']:.0f}, below 50 for each of 2 chains",
    ]


def test_chains_visit_all_minima_without_a_fit():
    """The square of a number leaves its sign open; a fit knows only one of the signs."""
    data, free = Measurements(np.full(5, 4.0), 0.5), {"x": Free(1.0, prior=(0.5, 2.0))}
    density = LogDensity.of(lambda p: jnp.repeat(p["x"][:, None] ** 2, 5, axis=1), data, free)
    grid = np.linspace(-4.0, 4.0, 4001)
    logs = -0.5 * 5.0 * ((grid**2 - 4.0) / 0.5) ** 2 - 0.5 * ((grid - 0.5) / 2.0) ** 2
    expected = np.sum(np.exp(logs)[grid > 0.0]) / np.sum(np.exp(logs))
    for options in ({}, {"centre": [0.5], "covariance": [[0.01]], "seed": 1}):
        posterior = sample(density, **options, progress=False)
        assert posterior.r_hat["x"] < 1.02
        assert posterior.ess["x"] > 200.0
        assert abs(np.mean(posterior.values["x"] > 0.0) - expected) < 4.0 * 0.5 / np.sqrt(posterior.ess["x"])


def test_draws_of_unknown_errors_have_their_distribution():
    """Student's t for the mean of ten values, and the root of an inverse chi squared for their error."""
    value = 1.0 + 0.3 * np.random.default_rng(4).normal(size=10)
    data = Measurements(value, 1.0, estimated=True)
    density = LogDensity.of(lambda p: jnp.repeat(p["mean"][:, None], 10, axis=1), data, {"mean": 0.5})
    posterior = sample(density, progress=False)
    scale = np.std(value, ddof=1)
    deviation = scale / np.sqrt(10.0) * np.sqrt(9.0 / 7.0)
    assert_close(np.std(posterior.values["mean"]), deviation, rtol=0.15)
    shares = np.quantile(posterior.values["error[0]"], [0.1, 0.5, 0.9])
    assert_close(shares, scale * np.sqrt(9.0 / scipy.stats.chi2.ppf([0.9, 0.5, 0.1], 9)), rtol=0.08)


def test_unknown_errors_are_drawn_too():
    value = 1.0 + 0.3 * np.random.default_rng(4).normal(size=60)
    data = Measurements(value, 1.0, estimated=True)
    density = LogDensity.of(lambda p: jnp.repeat(p["mean"][:, None], 60, axis=1), data, {"mean": 0.0})
    assert density.names == ("mean", "error[0]")
    point = np.array([value.mean(), np.log(np.std(value))])
    # At the mean and the standard deviation of the values the density has its maximum.
    assert_close(density.value_and_gradient(point)[1], [0.0, 0.0], atol=1e-9)


AT = np.linspace(0.0, 2.0, 5)


def decay(p):
    return p["height"][:, None] * jnp.exp(-p["rate"][:, None] * AT)


def rough(p):
    """Predictions that no polynomial follows, as times over a nutation period are rough."""
    smooth = decay(p)
    return smooth + 0.1 * jnp.sin(40.0 * p["rate"])[:, None]


@pytest.mark.slow
def test_draws_are_from_a_rough_density():
    """Against quadrature, without a fit, where the roughness is half an error, and priors are of the parameters."""
    error, free = 0.2, {"height": Free(1.0, 0.0, prior=(1.0, 0.3)), "rate": Free(1.0, 0.0, prior=(1.0, 0.4))}
    exact = np.asarray(decay({"height": jnp.array([1.2]), "rate": jnp.array([0.7])}))[0]
    density = LogDensity.of(rough, Measurements(exact, error), free)
    posterior = sample(density, progress=False)
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 101), np.linspace(-3.0, 2.0, 401), indexing="ij"), axis=-1)
    flat = jnp.asarray(grid.reshape(-1, 2))
    logs = np.asarray(
        jax.jit(jax.vmap(lambda point: density.of_prediction(point, density.predict(point[None])[0])))(flat)
    )
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    values = {name: np.asarray(value) for name, value in density.values(flat).items()}
    # The contribution of the roughness to the density; a smooth surrogate would give 0.
    for name, of in (
        *((name, lambda v, n=name: v[n]) for name in values),
        ("wave", lambda v: np.sin(40.0 * v["rate"])),
    ):
        mean = np.sum(weights * of(values))
        deviations = np.sqrt(np.sum(weights * (of(values) - mean) ** 2))
        ess = min(posterior.ess.values())
        assert abs(np.mean(of(posterior.values)) - mean) < 4.0 * deviations / np.sqrt(ess), name
        assert_close(np.std(of(posterior.values)), deviations, rtol=0.1)
    assert all(value < 1.02 for value in posterior.r_hat.values())
    assert abs(np.sum(weights * np.sin(40.0 * values["rate"]))) > 0.2


@pytest.mark.slow
def test_numpyro_draws_the_same(draws):
    """The other library, whose figures stand beside in `benchmarks/posterior.py`, on the same density in the same points."""
    fit, density, posterior = draws
    shifted, leaps = plain("numpyro", density, fit, 50, 250)
    assert leaps > 1000
    for name, value in posterior.values.items():
        error = fit.standard_errors[name]
        assert abs(shifted.values[name].mean() - value.mean()) < 5.0 * error / np.sqrt(shifted.ess[name])
        assert_close(shifted.values[name].std(), error, rtol=0.15)


def test_one_program_predicts_any_number_of_rows_and_skips_rows_of_nan():
    traced = []

    def model(parameters):
        traced.append(parameters["rate"].shape)
        return parameters["rate"][:, None] * np.array([1.0, 2.0])

    density = LogDensity.of(model, Measurements([1.0, 2.0], 0.1), {"rate": 1.0})
    for count in (1, 3, 200):
        rows = np.linspace(0.5, 1.5, count)[:, None]
        # One of four calls has rows of NaN only.
        rows[count // 4 : count // 4 + 90] = np.nan
        np.testing.assert_array_equal(density.predict(rows), (1.0 + rows) * np.array([1.0, 2.0]))
    assert len(traced) == 1
