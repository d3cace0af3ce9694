"""How often the posterior of the film of `coverage.py` contains the truth, without fits: shared runs, weighted for each film.

    python benchmarks/film_posterior.py [--films 600]

A fit simulates the runs that it needs; here 10 240 runs around the truth, and then 20 480 around the three minima, serve all
films. The script prints the fractions of films whose central 95 and 68 % intervals contain the truth: for the noise of the
first 40 films of `coverage.py`, and for other noise.
"""

import argparse

import numpy as np
from coverage import MU, OFFSET, SPIN, scene_of
from scipy.stats import multivariate_t

import tippe

CLOCK, ERROR, TRUTH = np.arange(360) / 120.0, 0.02, np.array([MU, SPIN, 0.0])

#: Half the distance of the minima of the clock [s], and degrees of freedom of the proposals.
HALF, FREEDOM = 0.019, 6.0

#: Rows that one program simulates.
ROWS = 512


def simulated(points: np.ndarray) -> np.ndarray:
    """theta at the times of the film for rows of friction, spin and clock."""
    unknowns = {"friction.mu": MU, "launch.spin": SPIN, "t0": 0.0}
    launch = tippe.Launch(0.1, SPIN, azimuth=0.3)
    film = tippe.Recording(launch, CLOCK, np.zeros(CLOCK.size), ERROR)
    density = tippe.log_density(scene_of(MU, OFFSET), film, unknowns)
    free = density.problem.unknowns
    coordinates = np.stack([np.asarray(unknown.coordinate(points[:, k])) for k, unknown in enumerate(free)], axis=1)
    return np.concatenate([density.predictions(coordinates[i : i + ROWS]) for i in range(0, len(points), ROWS)])


def log_likelihoods(runs: np.ndarray, films: np.ndarray) -> np.ndarray:
    """(runs, films), up to a constant of each film."""
    return runs @ films.T / ERROR**2 - 0.5 * np.sum((runs / ERROR) ** 2, axis=1)[:, None]


def minima(points: np.ndarray, weights: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The mean and the covariance of the points in each minimum of the clock."""
    groups = np.digitize(points[:, 2], [-HALF, HALF])
    moments = []
    for group in range(3):
        members = groups == group
        share = weights[members] / np.sum(weights[members])
        off = points[members] - share @ points[members]
        moments.append((share @ points[members], (off * share[:, None]).T @ off))
    return moments


def drawn(
    moments: list[tuple[np.ndarray, np.ndarray]], wider: float, count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points around the minima with positive friction, and the log density from which they come."""
    parts = [multivariate_t(mean, wider * covariance, FREEDOM) for mean, covariance in moments]
    which = random.integers(0, len(parts), count)
    each = np.stack([part.rvs(count, random_state=random) for part in parts])
    points = each[which, np.arange(count)]
    points[:, 0] = np.abs(points[:, 0])
    return points, np.logaddexp.reduce([part.logpdf(points) for part in parts], axis=0)


def weights_of(points: np.ndarray, log_proposal: np.ndarray, runs: np.ndarray, films: np.ndarray) -> np.ndarray:
    """Weights of the points for each film, with a flat prior of the logarithm of the friction."""
    logs = log_likelihoods(runs, films) - (log_proposal + np.log(points[:, 0]))[:, None]
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    weights = np.exp(logs - np.max(logs, axis=0))
    return weights / np.sum(weights, axis=0)


def report(name: str, points: np.ndarray, weights: np.ndarray) -> None:
    shares = np.empty((3, 2))
    for k, truth in enumerate(TRUTH):
        order = np.argsort(points[:, k])
        below = np.cumsum(weights[order], axis=0) - 0.5 * weights[order]
        rank = np.array([np.interp(truth, points[order, k], column) for column in below.T])
        shares[k] = [np.mean(np.abs(rank - 0.5) < half) for half in (0.475, 0.34)]
    words = ", ".join(
        f"{unknown} {100.0 * wide:.1f} and {100.0 * narrow:.1f} %"
        for unknown, (wide, narrow) in zip(("friction", "spin", "t0"), shares, strict=True)
    )
    print(f"{name}: {words}; {np.median(1.0 / np.sum(weights**2, axis=0)):.0f} effective runs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--films", type=int, default=600)
    options = parser.parse_args()
    random = np.random.default_rng(12345)
    exact = simulated(TRUTH[None])[0]
    spread = np.diag(np.array([0.004, 0.25, 0.004]) ** 2)
    centres = [TRUTH + side * np.array([0.0034, 0.0, 2.0 * HALF]) for side in (-1.0, 0.0, 1.0)]
    points, log_proposal = drawn([(centre, spread) for centre in centres], 1.0, 20 * ROWS, random)
    weights = weights_of(points, log_proposal, simulated(points), exact[None])[:, 0]
    points, log_proposal = drawn(minima(points, weights), 5.0, 40 * ROWS, random)
    runs = simulated(points)
    good = np.all(np.isfinite(runs), axis=1)
    points, log_proposal, runs = points[good], log_proposal[good], runs[good]
    noise = np.stack([np.random.default_rng(k).normal(size=CLOCK.size) for k in range(40)])
    report("40 films of coverage.py", points, weights_of(points, log_proposal, runs, exact + ERROR * noise))
    noise = random.normal(size=(options.films, CLOCK.size))
    report(f"{options.films} other films", points, weights_of(points, log_proposal, runs, exact + ERROR * noise))


if __name__ == "__main__":
    main()
