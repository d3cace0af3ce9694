"""Profile likelihoods, by batches of runs and by least squares."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .exploration import ROWS
from .levenberg_marquardt import minimise
from .problem import deviances, linearise, predictions
from .verdict import SAME

#: Number of batches in which the other parameters are searched, and by how much the search narrows in each.
BATCHES, NARROWER = 3, 0.4


class Profile(NamedTuple):
    """The profile likelihood of one parameter.

    - `values`: (points,), the values at which the parameter was held.
    - `deviance`: (points,), -2 log likelihood above its minimum, with all other parameters fitted again.
    - `estimates`: name -> (points,), estimates of the other parameters.
    - `converged`: (points,), whether these fits converged.
    """

    values: Float[np.ndarray, " points"]
    deviance: Float[np.ndarray, " points"]
    estimates: dict[str, Float[np.ndarray, " points"]]
    converged: np.ndarray

    def concern(self, name: str) -> str:
        """Where to start again, if the profile falls below the best fit; otherwise empty. **Arguments:** `name`: name of the
        parameter."""
        best = int(np.argmin(self.deviance))
        if self.deviance[best] >= -SAME:
            return ""
        return f"the fit is better with {name} = {self.values[best]:.6g}: start there"


def profiled(fit: Any, k: int, values: Float[np.ndarray, " points"]) -> Profile:
    """The profile likelihood of the unknown with index `k`."""
    problem = fit.problem
    held = np.asarray(problem.unknowns[k].coordinate(values))
    coordinates, deviance = _searched(fit, k, held)
    ends = minimise(problem, coordinates, fit.measurements, fixed=k)
    at_ends = linearise(problem, ends.coordinates, fit.measurements).deviance
    improves = np.isfinite(at_ends) & (at_ends <= deviance)
    coordinates = np.where(improves[:, None], ends.coordinates, coordinates)
    deviance = np.where(improves, at_ends, deviance)
    optima = problem.values(coordinates)
    others = {other: optima[:, i] for i, other in enumerate(problem.names) if i != k}
    return Profile(values, deviance - fit.deviance, others, ends.converged)


def _searched(
    fit: Any, k: int, held: Float[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, "points unknowns"], Float[np.ndarray, " points"]]:
    """The best coordinates for every held value, and -2 log likelihood there, by batches of runs without slopes.

    The other coordinates are drawn around their regression on the held one, then around the best of the points so far.
    """
    estimate = fit.coordinates
    covariance = np.where(np.isfinite(fit.coordinate_covariance), fit.coordinate_covariance, 0.0)
    random, size, points = np.random.default_rng(0), len(estimate), len(held)
    others = np.arange(size) != k
    slope = covariance[others, k] / covariance[k, k] if covariance[k, k] > 0.0 else np.zeros(size - 1)
    conditional = covariance[np.ix_(others, others)] - np.outer(slope, covariance[k, others])
    values, vectors = np.linalg.eigh(conditional) if size > 1 else (np.zeros(0), np.zeros((0, 0)))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    best = np.tile(estimate, (points, 1))
    best[:, k] = held
    best[:, others] += (held - estimate[k])[:, None] * slope
    least, each = np.full(points, np.inf), max(ROWS // points, 1)
    for batch in range(BATCHES):
        trial = np.repeat(best[:, None], each, axis=1)
        noise = NARROWER**batch * random.normal(size=(points, each, size - 1)) @ root.T
        trial[..., others] += noise
        trial[:, 0] = best
        rows = trial.reshape(-1, size)
        deviance = deviances(fit.problem, rows, predictions(fit.problem, rows), fit.measurements)
        deviance = np.where(np.isfinite(deviance), deviance, np.inf).reshape(points, each)
        place = np.argmin(deviance, axis=1)
        improved = deviance[np.arange(points), place]
        best = np.where((improved < least)[:, None], trial[np.arange(points), place], best)
        least = np.minimum(least, improved)
    return best, least
