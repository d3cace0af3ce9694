"""The shape of a posterior in words: several minima, staircases, bounds that cut, directions without information."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from .distribution import Distribution, quantiles
from .exploration import Explorer, Weighted
from .likelihood import whole_periods
from .mixture import Mixture, fitted
from .region import FARTHEST
from .unknown import Unknown

#: Two components of the posterior are one minimum if the density on the ridge between them stays above this fraction of the
#: lower peak; and the least weight of a minimum that is named.
SADDLE, LEAST_WEIGHT = 0.1, 0.03

#: The number of components into which a posterior is divided to find its minima.
COMPONENTS = 6

#: Slopes that are wrong by less than this factor go without a remark.
FACTOR = 1.3

#: Predictions that scatter about a smooth trend by more than this fraction of their errors are a staircase.
ROUGH = 0.25

#: A profile is no parabola if the two sides of a 95 % interval differ by more than this factor.
SKEWED = 1.4

#: Weight near a bound, or near the edge of the searched region, that is worth a warning; and how near, as a fraction of
#: the interval or the region.
CUT, NEAR = 0.02, 0.05

#: Candidates within this many standard errors of the estimate are beside it.
BESIDE = 3.0


class Minimum(NamedTuple):
    """A minimum that the data allow.

    - `estimates`: name -> value at its most likely point; `weight`: its probability; `deviance`: -2 log likelihood.
    """

    estimates: dict[str, float]
    weight: float
    deviance: float

    def __str__(self) -> str:
        values = ", ".join(f"{name} {value:.4g}" for name, value in self.estimates.items())
        return f"{values} (weight {self.weight:.2f})"


def divided(
    points: Float[np.ndarray, "n unknowns"], weights: Float[np.ndarray, " n"], random: np.random.Generator
) -> Int[np.ndarray, " n"]:
    """The index of the minimum to which each point belongs.

    Components of a mixture are merged where the ridge between them has no deep saddle (Ray and Lindsay, Ann. Stat. 33
    (2005) 2042).
    """
    mixture = fitted(points, weights, COMPONENTS, random)
    parent = list(range(len(mixture.shares)))
    for a in range(len(parent)):
        for b in range(a):
            ridge = _ridge(mixture, a, b)
            density = np.logaddexp.reduce(_log_normals(mixture, ridge), axis=0)
            if np.min(density) > min(density[0], density[-1]) + math.log(SADDLE):
                parent = [parent[b] if group == parent[a] else group for group in parent]
    return np.array(parent)[np.argmax(_log_normals(mixture, points), axis=0)]


def _ridge(mixture: Mixture, a: int, b: int) -> Float[np.ndarray, "points unknowns"]:
    """The curve on which the density of two components has its ridge."""
    inverse = [np.linalg.inv(mixture.roots[k] @ mixture.roots[k].T) for k in (a, b)]
    curve = []
    for share in np.linspace(0.0, 1.0, 33):
        sides = ((1.0 - share) * inverse[0], share * inverse[1])
        curve.append(
            np.linalg.solve(sides[0] + sides[1], sides[0] @ mixture.centres[a] + sides[1] @ mixture.centres[b])
        )
    return np.stack(curve)


def _log_normals(mixture: Mixture, points: np.ndarray) -> np.ndarray:
    logs = []
    for share, centre, root in zip(*mixture, strict=True):
        squares = np.sum(np.linalg.solve(root, (points - centre).T) ** 2, axis=0)
        logs.append(math.log(share) - 0.5 * squares - np.sum(np.log(np.diag(root))))
    return np.stack(logs)


def minima_of(explorer: Explorer, sample: Weighted) -> tuple[Minimum, ...]:
    """The minima that the data allow, the most probable first."""
    points, weights, problem = sample.pool.points, sample.weights, explorer.density.problem
    used = weights > 0.0
    groups = np.full(len(points), -1)
    groups[used] = divided(points[used], weights[used], np.random.default_rng(0))
    minima = []
    for group in np.unique(groups[used]):
        members = np.flatnonzero(groups == group)
        best = members[np.argmax(sample.pool.log_density[members])]
        values = np.asarray(problem.values(points[best])).tolist()
        deviance = float(-2.0 * np.sum(sample.pool.groups[best]))
        minima.append(Minimum(dict(zip(problem.names, values, strict=True)), float(np.sum(weights[members])), deviance))
    return tuple(sorted((minimum for minimum in minima if minimum.weight > LEAST_WEIGHT), key=lambda m: -m.weight))


def roughness(explorer: Explorer, sample: Weighted) -> float:
    """Root mean square of the distances of predictions from a smooth trend, in units of their errors."""
    weights, points = sample.weights, sample.pool.points
    used = (weights > 1e-4 * np.max(weights)) & np.all(np.isfinite(sample.pool.predictions), axis=1)
    root = np.sqrt(weights[used] / np.sum(weights[used]))[:, None]
    centred = points[used] - weights[used] @ points[used] / np.sum(weights[used])
    centred = centred / (np.std(centred, axis=0) + 1e-300)
    size = centred.shape[1]
    columns = [np.ones(len(centred)), *centred.T]
    columns += [centred[:, i] * centred[:, j] for i in range(size) for j in range(i + 1)]
    terms = np.stack(columns, axis=1)
    predictions = sample.pool.predictions[used]
    measurements = explorer.density.measurements
    predictions = predictions - whole_periods(np, predictions - predictions[0], np.asarray(measurements.period))
    coefficients, *_ = np.linalg.lstsq(root * terms, root * predictions)
    off = (predictions - terms @ coefficients) / np.asarray(measurements.error)
    return float(np.sqrt(np.mean(np.sum(root**2 * off**2, axis=0))))


def unsearched(explorer: Explorer, estimate: Float[np.ndarray, " unknowns"]) -> tuple[str, ...]:
    """A note of estimates that are outside of the searched range, if there are any."""
    is_inside = explorer.region.searched(estimate)
    names = [name for name, inside in zip(explorer.density.problem.names, is_inside, strict=True) if not inside]
    if not names:
        return ()
    return (
        f"{', '.join(names)}: outside of the range in which minima were searched, so better ones may be missing; start "
        "closer, or state a prior",
    )


def without_prediction(
    explorer: Explorer, sample: Weighted, distribution: Distribution
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """A concern or a note of candidates whose runs have no prediction, if there are any: a concern if they lie where the
    posterior does."""
    problem, points = explorer.density.problem, sample.pool.points
    evaluated = explorer.region.contains(points)
    points, failed = points[evaluated], np.any(np.isnan(sample.pool.predictions[evaluated]), axis=1)
    if not np.any(failed):
        return (), ()
    off = points - distribution.estimate
    values = np.asarray(problem.values(points[failed]))
    ends = zip(problem.names, np.min(values, axis=0), np.max(values, axis=0), strict=True)
    places = ", ".join(f"{name} {low:.4g}" + (f" to {high:.4g}" if high > low else "") for name, low, high in ends)
    words = (
        f"{np.sum(failed)} of {len(failed)} candidates count as impossible, because a run failed, was unresolved, ended too "
        f"early or was illegal: at {places}"
    )
    if not np.all(np.isfinite(distribution.covariance)):
        return (), (words,)
    near = np.sum(np.linalg.solve(np.linalg.cholesky(distribution.covariance), off.T) ** 2, axis=0) < BESIDE**2
    share = np.mean(failed[near]) if np.any(near) else 0.0
    if share > CUT:
        return (f"{words}; of those beside the estimate, {100.0 * share:.0f} %: simulate a run there to see why",), ()
    return (), (words,)


def remarks(
    explorer: Explorer, sample: Weighted, distribution: Distribution, by_slopes: Float[np.ndarray, "unknowns unknowns"]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is special about the shape of a posterior: concerns and notes, in words."""
    problem = explorer.density.problem
    concerns, notes, skewed = [], [], []
    for k, (name, unknown) in enumerate(problem.free):
        concerns += _cut(name, unknown, sample, explorer, k)
        low, high = distribution.interval(k, 1.96)
        sides = high - distribution.estimate[k], distribution.estimate[k] - low
        if max(sides) > SKEWED * max(min(sides), 1e-300):
            skewed.append(name)
    if skewed:
        notes.append(
            f"the likelihood profile of {', '.join(skewed)} is no parabola: use the interval, not the standard error"
        )
    ratios = np.sqrt(np.diag(distribution.covariance) / np.diag(by_slopes))
    reason = "the predictions are a staircase" if roughness(explorer, sample) > ROUGH else "the predictions bend"
    for verb, factors in (("understate", ratios), ("overstate", 1.0 / ratios)):
        worst = int(np.argmax(factors))
        if factors[worst] > FACTOR:
            notes.append(f"slopes {verb} the errors {factors[worst]:.1f} times ({problem.names[worst]}): {reason}")
    return tuple(concerns), tuple(notes)


def _cut(name: str, unknown: Unknown, sample: Weighted, explorer: Explorer, k: int) -> list[str]:
    """Warnings of a bound, or of the edge of the searched region, that cuts the interval of an unknown."""
    coordinate, weights = sample.pool.points[:, k], sample.weights
    middle, reach = explorer.region.middle[k], FARTHEST * explorer.region.half_width[k]
    words = []
    for side, edge in (("below", middle - reach), ("above", middle + reach)):
        if np.sum(weights[np.abs(coordinate - edge) < NEAR * 2.0 * reach]) > CUT:
            words.append(f"the data do not bound {name} from {side}: its interval ends where the search ended")
    values = np.asarray(unknown.value(coordinate))
    low, high = quantiles(values, weights, np.array([0.025, 0.975]))
    for bound, exists in ((unknown.lower, unknown.has_lower), (unknown.upper, unknown.has_upper)):
        if exists and np.sum(weights[np.abs(values - bound) < NEAR * (high - low)]) > CUT:
            words.append(f"the bound {float(bound):g} cuts the interval of {name}")
    return words
