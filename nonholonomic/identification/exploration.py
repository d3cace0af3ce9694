"""Explore a posterior by adaptive importance sampling, with a batch of runs in every round.

All points keep their predictions, so the weights of all of them are computed again, at no cost, whenever the proposals
change (Cornuet, Marin, Mira and Robert, "Adaptive multiple importance sampling", Scand. J. Stat. 39 (2012) 798). Until
the proposals cover the posterior, the likelihood is tempered: the powers of early measurements grow first, because late
samples of a recording can be wrong by whole turns.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..progress import Progress
from .marginal import log_likelihoods
from .mixture import Mixture, fitted
from .posterior import LogDensity
from .region import Region, region_of
from .unknown import Free

#: Number of points in a round; all rounds use one program. With a single unknown, half as many are enough. A round of the
#: search by slopes uses fewer.
ROWS = 512

#: An exploration ends with at least this many effective draws and a shape k of the weights below `MOST_K`, or after
#: `ROUNDS` rounds.
ENOUGH, MOST_K, ROUNDS = 400.0, 0.7, 40

#: Effective number of points to which the likelihood is tempered, for each unknown, and at least.
TEMPERED, LEAST_TEMPERED = 20.0, 80.0

#: Number of groups of measurements, in the order of their times, and the number of groups whose powers grow together.
GROUPS, FRONT = 32, 8

#: Components of the proposals, and the share of the draws that the ends of the search by slopes keep.
COMPONENTS, KEPT = 16, 0.15

#: An unknown does not act if it changes predictions by less than this part of their errors.
NO_CHANGE = 1e-3

#: Powers of the density to which the two halves of the proposals are fitted. The flatter half reaches beyond the posterior, to
#: other minima and into the tails.
POWERS = (1.0, 0.4)


class Pool(NamedTuple):
    """All points so far.

    - `points`: (n, unknowns), coordinates; `predictions`: (n, measurements).
    - `groups`: (n, groups), log likelihoods of groups of measurements; `log_prior`, `log_density`: (n,), of the posterior,
      averaged over unknown errors.
    - `log_region`: (n,), 0 in the region of the search, and less outside of it.
    - `log_proposal`: (n,), log of the density from which all points together were drawn, times n.
    - `proposals`: pairs of a number of points and the distribution from which they were drawn.
    """

    points: Float[np.ndarray, "n unknowns"]
    predictions: Float[np.ndarray, "n measurements"]
    groups: Float[np.ndarray, "n groups"]
    log_prior: Float[np.ndarray, " n"]
    log_density: Float[np.ndarray, " n"]
    log_region: Float[np.ndarray, " n"]
    log_proposal: Float[np.ndarray, " n"]
    proposals: tuple[tuple[int, Any], ...]

    def candidates(self, count: int) -> Float[np.ndarray, "count unknowns"]:
        """Points from which to refine: the first; then, in turn, the best for all measurements and for the early ones."""
        totals = np.cumsum(self.groups, axis=1) + self.log_prior[:, None]
        columns = sorted({totals.shape[1] - 1, *(totals.shape[1] * part // 8 for part in (0, 1, 2, 4))}, reverse=True)
        ranked = np.stack([np.argsort(-totals[:, column]) for column in columns], axis=1).reshape(-1)
        return self.points[list(dict.fromkeys([0, *ranked.tolist()]))[:count]]

    def most_probable(self, count: int) -> Int[np.ndarray, " count"]:
        """The numbers of the points with the greatest density, the best first."""
        return np.argsort(-self.log_density)[:count]

    def log_weights(self, progress: float) -> Float[np.ndarray, " n"]:
        """Log weights of the points. With `progress` from 0 to 1, the powers of the measurements grow from 0 to 1, and the
        region of the search loses its weight; from 1 to 2, guessed errors become unknown errors."""
        if progress >= 2.0:
            return self.log_density - self.log_proposal
        count = self.groups.shape[1]
        front = min(FRONT, count)
        place = min(progress, 1.0) * (count + front - 1)
        powers = np.clip((place - np.arange(count)) / front, 0.0, 1.0)
        tempered = self.groups @ powers + self.log_prior + max(0.0, 1.0 - progress) * self.log_region
        if progress > 1.0:
            tempered = (2.0 - progress) * tempered + (progress - 1.0) * self.log_density
        return tempered - self.log_proposal


class Explorer(NamedTuple):
    """What is explored, and where: a density, the region of the search, and the group of every measurement."""

    density: LogDensity
    region: Region
    group: np.ndarray
    random: np.random.Generator

    @classmethod
    def of(cls, density: LogDensity, free: dict[str, Free], spread: float, seed: int) -> "Explorer":
        """An explorer of the region around start values, as for `region_of`, with measurements grouped by their times."""
        times = np.asarray(density.measurements.time)
        distinct = np.unique(times)
        count = min(GROUPS, len(distinct))
        group = (np.searchsorted(distinct, times) * count) // len(distinct)
        region = region_of(free, spread, float(np.max(times)))
        return cls(density, region, group, np.random.default_rng(seed))

    @property
    def rows(self) -> int:
        """Number of points in a round."""
        return ROWS if len(self.region.middle) > 1 else ROWS // 2

    def begin(self, seed: int) -> Pool:
        """A pool of quasi-random points in the region."""
        values, groups = self.density.measurements.value.size, int(np.max(self.group)) + 1
        size = len(self.region.middle)
        shapes = ((0, size), (0, values), (0, groups), (0,), (0,), (0,), (0,))
        empty = Pool(*(np.zeros(shape) for shape in shapes), proposals=())
        return self.extended(empty, self.region.points(ROWS if size > 2 else self.rows // 2, seed), self.region)

    def acting(self, pool: Pool) -> Bool[np.ndarray, " unknowns"]:
        """Which unknowns act: moved from one of the two best points to the farther end of its range, such an unknown changes a
        prediction. Unknowns with a prior or between two bounds need not act: their posterior has an end."""
        middle, half_width = self.region.middle, self.region.half_width
        points = pool.points[pool.most_probable(2)]
        moved = np.repeat(points[:, None], len(middle), axis=1)
        ends = middle + np.where(points > middle, -half_width, half_width)
        np.einsum("bkk->bk", moved)[:] = ends
        predictions = self.density.predictions(np.concatenate([points, moved.reshape(-1, len(middle))]))
        base, others = predictions[: len(points), None], predictions[len(points) :].reshape(*ends.shape, -1)
        with np.errstate(invalid="ignore"):
            change = np.abs(others - base) / np.asarray(self.density.measurements.error)
        is_same = np.all((others == base) | (change < NO_CHANGE), axis=(0, 2))
        return ~is_same | self.density.proper

    def extended(self, pool: Pool, points: Float[np.ndarray, "rows unknowns"], proposal: Any) -> Pool:
        """The pool with points that were drawn from a proposal."""
        predictions, each, prior, log_density = self.evaluated(points)
        groups = np.stack([np.sum(each[:, self.group == k], axis=1) for k in range(pool.groups.shape[1])], axis=1)
        proposals = (*pool.proposals, (len(points), proposal))
        old = np.logaddexp(pool.log_proposal, math.log(len(points)) + proposal.log_density(pool.points))
        new = np.logaddexp.reduce([math.log(n) + other.log_density(points) for n, other in proposals], axis=0)
        parts = (points, predictions, groups, prior, log_density, self.region.log_weight(points))
        grown = (np.concatenate(pair) for pair in zip(pool, parts, strict=False))
        return Pool(*grown, log_proposal=np.concatenate([old, new]), proposals=proposals)

    def explore(self, pool: Pool, minima: Mixture | None, progress: bool) -> "Weighted":
        """Adapt proposals to the posterior, round by round.

        **Arguments:** `pool`: from `begin`; `minima`: a component around each minimum that is known, or `None`;
        `progress`: whether to show progress.
        """
        with Progress(ROUNDS, "round", shown=progress) as display:
            display.begin()
            current = Weighted.of(pool)
            for _ in range(ROUNDS):
                pool = self.extended(pool, *self._proposed(current, minima))
                display.advance(1)
                current = Weighted.of(pool)
                if current.enough:
                    break
        return current

    def _proposed(self, current: "Weighted", minima: Mixture | None) -> tuple[np.ndarray, Mixture]:
        """The points of the next round, and the mixture they are drawn from."""
        pool = current.pool
        share = 0.6 if len(pool.proposals) == 1 else KEPT
        mixture = self.proposal(pool, minima, share)
        # The last round draws what is missing, with some to spare.
        rate = current.effective / max(len(current.weights) - pool.proposals[0][0], 1)
        missing = 1.25 * (ENOUGH - current.effective) / max(rate, 1e-3) if len(pool.proposals) > 1 else np.inf
        count = self.rows if current.k >= MOST_K else int(np.clip(missing, self.rows // 8, self.rows))
        return mixture.draw(count, self.random), mixture

    def proposal(self, pool: Pool, minima: Mixture | None, share: float = KEPT) -> Mixture:
        """The mixture that fits the points so far best; the components around known minima get a share of it."""
        least = max(LEAST_TEMPERED, TEMPERED * pool.points.shape[1])
        halves = [
            fitted(pool.points, tempered_weights(pool, least, power), COMPONENTS, self.random) for power in POWERS
        ]
        mixture = halves[0].joined(halves[1], 0.5)
        return mixture if minima is None else mixture.joined(minima, share)

    def evaluated(
        self, points: Float[np.ndarray, "rows unknowns"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Predictions, log likelihoods of all measurements, log priors and log densities of at most `ROWS` points."""
        inside = self.region.contains(points)
        # Rows of NaN take no time. The program of the priors is compiled for `ROWS` rows.
        batch = np.full((ROWS, points.shape[1]), np.nan)
        batch[: len(points)][inside] = points[inside]
        predictions = self.density.predictions(batch[: len(points)])
        each, likelihood = log_likelihoods(self.density.measurements, predictions)
        prior = np.where(inside, self.density.log_priors(batch)[: len(points)], -np.inf)
        return predictions, each, prior, likelihood + prior


class Weighted(NamedTuple):
    """A weighted sample of a posterior.

    - `pool`: the points; `weights`: (n,), Pareto-smoothed, with the sum 1.
    - `k`: shape of the weights' tail; `effective`: the effective number of draws.
    """

    pool: Pool
    weights: Float[np.ndarray, " n"]
    k: float
    effective: float

    @classmethod
    def of(cls, pool: Pool) -> "Weighted":
        logs = pool.log_weights(2.0)
        weights, k = smoothed_weights(np.where(np.isfinite(logs), logs, -np.inf))
        return cls(pool, weights, k, effective_number(weights))

    @property
    def enough(self) -> bool:
        """Whether means and quantiles over the weights can be trusted."""
        return self.effective >= ENOUGH and self.k < MOST_K

    @property
    def runs(self) -> int:
        """Number of parameter sets for which the model ran."""
        return len(self.weights)


def effective_number(weights: Float[np.ndarray, " n"]) -> float:
    """Number of independent draws that are worth as much as weighted ones (Kish)."""
    return float(1.0 / np.sum(weights**2))


def tempered_weights(pool: Pool, least: float, power: float) -> Float[np.ndarray, " n"]:
    """Weights of a power of the density, as close to the posterior as at least so many effective draws allow."""

    def weights_at(progress: float) -> Float[np.ndarray, " n"]:
        # The density is flatter, the distribution of the points is what it is.
        logs = power * (pool.log_weights(progress) + pool.log_proposal) - pool.log_proposal
        logs = np.where(np.isfinite(logs), logs, -np.inf)
        weights = np.exp(logs - np.max(logs))
        return weights / np.sum(weights)

    weights, low, high = weights_at(2.0), 0.0, 2.0
    if effective_number(weights) >= least:
        return weights
    for _ in range(30):
        middle = 0.5 * (low + high)
        if effective_number(weights_at(middle)) >= least:
            low = middle
        else:
            high = middle
    return weights_at(low)


# Pareto-smoothed importance weights (Vehtari, Simpson, Gelman, Yao and Gabry, J. Mach. Learn. Res. 25 (2024) 72).


def smoothed_weights(log_weights: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], float]:
    """Normalised weights whose largest values are replaced by quantiles of a generalised Pareto distribution.

    **Arguments:** `log_weights`: (n,), -inf for weights that are 0.

    **Returns:** the weights, with the sum 1; and the shape k of the distribution. Above 0.7, means over the weights
    cannot be trusted; -inf if too few weights differ for a tail.
    """
    weights = np.exp(log_weights - np.max(log_weights))
    count = int(min(0.2 * len(weights), 3.0 * np.sqrt(len(weights))))
    order = np.argsort(weights)
    tail, cutoff = order[len(weights) - count :], weights[order[len(weights) - count - 1]] if count else 0.0
    excess = weights[tail] - cutoff
    shape = -np.inf
    if count >= 5 and excess[0] >= 0.0 and excess[-1] > 1e-9 * weights[order[-1]] and excess[count // 4] > 0.0:
        shape, scale = _generalised_pareto(excess)
        if np.isfinite(shape):
            logs = np.log1p(-(np.arange(count) + 0.5) / count)
            smooth = scale * np.expm1(np.minimum(-shape * logs, 700.0)) / shape if shape else -scale * logs
            # No weight is larger than the largest of the weights.
            weights[tail] = np.minimum(cutoff + smooth, 1.0)
    return weights / np.sum(weights), float(shape)


def _generalised_pareto(excess: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto distribution of increasing numbers (Zhang and Stephens, Technometrics 51
    (2009) 316), with the shape drawn to 0.5 like 10 of the numbers."""
    count = len(excess)
    grid = 30 + int(np.sqrt(count))
    # Of a very heavy tail, most numbers are negligible.
    quartile = max(excess[max(int(count / 4 + 0.5) - 1, 0)], 1e-9 * excess[-1])
    inverse = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shapes = np.mean(np.log1p(-inverse[:, None] * excess), axis=1)
    logs = count * (np.log(-inverse / shapes) - shapes - 1.0)
    share = np.exp(logs - np.max(logs))
    mean = np.sum(inverse * share) / np.sum(share)
    shape = np.mean(np.log1p(-mean * excess))
    return float((count * shape + 5.0) / (count + 10.0)), float(-shape / mean)
