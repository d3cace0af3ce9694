"""Simulation-based calibration of a top's posterior (Talts et al., arXiv:1804.06788): do credible intervals have their
stated probability?

    nice python benchmarks/calibration.py [--tables 200] [--draws 64]

The script draws friction, offset and I1 of a top from their prior, adds noise to ten inversion times, and computes the
posterior from the times: a fit of all tables in one program, and draws around each fit from Student's t distribution
with its covariance, weighted by the posterior's density (importance sampling, one run each). The fraction of the
posterior below the true number must be uniform over the tables. This checks density, prior, fit and covariance;
`tests/nonholonomic/identification/test_posterior.py` checks that the no-U-turn sampler draws from such a density. The
script prints the p-values of the Kolmogorov-Smirnov test and of chi squared in ten bins, the fractions of tables whose
central 50 and 90 % contain the truth, and the effective number of draws, which widens the ranks by 2 / draws.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

import tippe
from nonholonomic.identification import Free, LogDensity, Measurements
from nonholonomic.identification.levenberg_marquardt import minimise
from nonholonomic.identification.problem import Problem, linearise
from nonholonomic.identification.result import coordinate_covariance

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from posterior import ANGLE, ERROR, I1, SPIN, THETA, scene

from tippe.fit.identify import SceneModel

#: Mean and standard deviation of the priors, which are of the numbers themselves. Times fix one combination to 5e-5, and offset
#: and friction only together: without a balance for the offset the posterior is a bent ridge, which no ellipse covers.
PRIORS = {"scene.friction.mu": (0.3, 0.06), "scene.body.offset": (0.0035, 1.75e-5), "scene.body.I1": (I1, 0.01 * I1)}
#: Degrees of freedom of the draws around a fit, by how much they are wider than its error ellipse, and rows in one call.
FREEDOM, WIDER, ROWS = 6.0, 1.2, 1400
#: Relative tolerance of the runs, and the steps of the differences by which the tables are fitted.
TOLERANCE, STEP = 1e-7, 0.01

_predicted = eqx.filter_jit(LogDensity.predict)


def predictions(density: LogDensity, coordinates: np.ndarray) -> np.ndarray:
    """The model's predictions in every row, in calls of equal size."""
    padded = np.pad(coordinates, ((0, -len(coordinates) % ROWS), (0, 0)), mode="edge")
    parts = [np.asarray(_predicted(density, padded[i : i + ROWS])) for i in range(0, len(padded), ROWS)]
    return np.concatenate(parts)[: len(coordinates)]


def log_posterior(density: LogDensity, tables: Measurements, coordinates: Any, predicted: Any) -> np.ndarray:
    """The log density of every draw from the posterior of its table."""

    def of_table(
        table: Measurements, draws_of_table: Float[Array, "draws k"], predictions: Float[Array, "draws n"]
    ) -> Any:
        density_of_table = eqx.tree_at(lambda node: node.measurements, density, table)
        return jax.vmap(density_of_table.of_prediction)(draws_of_table, predictions)

    return np.asarray(jax.jit(jax.vmap(of_table))(tables, jnp.asarray(coordinates), jnp.asarray(predicted)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tables", type=int, default=200)
    parser.add_argument("--draws", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    start_time, random = time.process_time(), np.random.default_rng(options.seed)
    free = {name: Free(prior[0], 0.0, prior=prior) for name, prior in PRIORS.items()}
    launches = tippe.Launch(THETA, SPIN)
    data = tippe.InversionTimes(launches, np.full(len(THETA), 10.0), ERROR, t1=60.0, angle=ANGLE)
    model = SceneModel(scene(0.3, 0.0035), (data,), data.seen, TOLERANCE)
    density = LogDensity.of(model, data.measurements, free)
    mean, deviation = np.array(list(PRIORS.values())).T
    truth = np.log(mean + deviation * random.normal(size=(options.tables, len(mean))))
    exact = predictions(density, truth)
    noisy = exact + ERROR * random.normal(size=exact.shape)
    # Beyond the horizon, a time is only known to be later.
    tables = Measurements(np.minimum(noisy, 60.0), ERROR, noisy > 60.0)
    print(
        f"{np.sum(noisy > 60.0)} of {noisy.size} tops did not invert; {time.process_time() - start_time:.0f} s of CPU",
        flush=True,
    )
    problem = Problem(model, tuple(free.items()), STEP)
    ends = minimise(problem, np.tile(np.log(mean), (options.tables, 1)), tables)
    linearised = linearise(problem, ends.coordinates, tables)
    print(
        f"fitted: {np.mean(ends.converged):.3f} converged; {time.process_time() - start_time:.0f} s of CPU", flush=True
    )
    roots = np.stack(
        [np.linalg.cholesky(coordinate_covariance(information)) for information in linearised.whole_information]
    )
    shape = (options.tables, options.draws, len(mean))
    points = random.normal(size=shape) / np.sqrt(random.chisquare(FREEDOM, (*shape[:2], 1)) / FREEDOM)
    proposals = ends.coordinates[:, None] + WIDER * np.einsum("tij,tdj->tdi", roots, points)
    predicted = predictions(density, proposals.reshape(-1, len(mean))).reshape(*shape[:2], -1)
    log_proposal = -0.5 * (FREEDOM + len(mean)) * np.log1p(np.sum(points**2, axis=-1) / FREEDOM)
    weights = log_posterior(density, tables, proposals, predicted) - log_proposal
    weights = np.exp(weights - np.max(weights, axis=1, keepdims=True))
    weights /= np.sum(weights, axis=1, keepdims=True)
    effective_size = 1.0 / np.sum(weights**2, axis=1)
    print(
        f"weights are worth {np.percentile(effective_size, [0, 10, 50])} draws (least, 10 %, median); "
        f"{time.process_time() - start_time:.0f} s of CPU"
    )
    rank = np.sum(weights[..., None] * (proposals < truth[:, None]), axis=1)
    for name, share in zip(PRIORS, rank.T, strict=True):
        bins = scipy.stats.chisquare(np.histogram(share, bins=10, range=(0.0, 1.0))[0]).pvalue
        coverage = [np.mean(np.abs(share - 0.5) < 0.5 * part) for part in (0.5, 0.9)]
        print(
            f"{name}: uniform with p = {scipy.stats.kstest(share, 'uniform').pvalue:.2f} and {bins:.2f}; "
            f"central 50 and 90 % hold the truth in {coverage[0]:.3f} and {coverage[1]:.3f}"
        )


if __name__ == "__main__":
    main()
