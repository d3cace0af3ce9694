"""Explore a posterior by adaptive importance sampling, with a batch of runs in every round.

All points keep their predictions, so the weights of all of them are computed again, at no cost, whenever the proposals
change (Cornuet, Marin, Mira and Robert, "Adaptive multiple importance sampling", Scand. J. Stat. 39 (2012) 798). Until
the proposals cover the posterior, the likelihood is tempered: the powers of early measurements grow first, because late
samples of a recording can be wrong by whole turns.

The density of a single unknown is known everywhere between its points, up to jumps: the weights of the points are the density
times their spacing, and proposals are fitted to the density of interpolated predictions, which finds the posterior in fewer
rounds.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..terminal import Progress
from .posterior import Coordinates, LogDensity, Matrix, Measurements, PerPoint, Points, compared, own_name, scale_of

# The likelihood of measurements whose errors are unknown: the mean over the errors, with a flat prior of their
# logarithms.

#: Number of values of the logarithm of an error, and their range in units of 1 / sqrt(2 n) for n values.
GRID, RANGE = 33, 6.0


def draw_errors(
    measurements: Measurements, prediction: Float[np.ndarray, "rows n"], random: np.random.Generator
) -> Float[np.ndarray, "rows series"]:
    """Logarithms of the unknown errors in units of their guesses, drawn from their distribution for given predictions."""
    columns = [np.zeros((len(prediction), 0))]
    for scales, logs in _by_error(measurements, prediction, compared(measurements, prediction)[0]):
        cumulative = np.cumsum(np.exp(logs - np.max(logs, axis=1, keepdims=True)), axis=1)
        share = random.uniform(size=len(scales)) * cumulative[:, -1]
        column = [np.interp(s, c, scale) for s, c, scale in zip(share, cumulative, scales, strict=True)]
        columns.append(np.array(column)[:, None])
    return np.concatenate(columns, axis=1)


def _by_error(measurements: Measurements, prediction: np.ndarray, residual: np.ndarray):
    """For each series of unknown error: logarithms of the error in units of its guess (rows, grid), and the log likelihood
    there."""
    estimated, series = measurements.estimated & ~measurements.censored, measurements.series
    standardised = measurements.standardised(prediction)
    for number in np.unique(series[estimated]):
        members = (series == number) & estimated
        z = standardised[:, members]
        z = np.where(np.isfinite(z), z, residual[:, members])
        count, nu = z.shape[1], float(measurements.student[members][0])
        reach = RANGE / np.sqrt(2.0 * count)
        scales = np.log(scale_of(z, nu))[:, None] + np.linspace(-reach, 2.0 * reach, GRID)
        logs = np.empty(scales.shape)
        for k in range(GRID):
            squares = (z / np.exp(scales[:, k : k + 1])) ** 2
            terms = (nu + 1.0) * np.log1p(squares / nu) if np.isfinite(nu) else squares
            logs[:, k] = -0.5 * np.sum(terms, axis=1) - count * scales[:, k]
        yield scales, logs


# Mixtures of multivariate Student's t distributions: heavy-tailed proposals for importance sampling.

#: Degrees of freedom of the components: tails heavier than those of a posterior, and a finite covariance.
FREEDOM = 5.0

#: Of so many draws of a single unknown, in order, the middle one is kept.
THINNED = 64

#: Iterations of expectation maximisation, and the fraction of the whole covariance that is added to each component's.
ITERATIONS, SHRINKAGE = 15, 1e-3


class Mixture(NamedTuple):
    """A mixture of multivariate t distributions.

    - `shares`: (components,), positive, with the sum 1.
    - `centres`: (components, unknowns).
    - `roots`: (components, unknowns, unknowns), Cholesky factors of the scale matrices.
    """

    shares: Float[np.ndarray, " components"]
    centres: Float[np.ndarray, "components unknowns"]
    roots: Float[np.ndarray, "components unknowns unknowns"]

    def draw(self, count: int, random: np.random.Generator) -> Float[np.ndarray, "count unknowns"]:
        """Draws, of which each component gets its share, rounded at random; with a single unknown, one from each of `count`
        intervals of nearly equal probability."""
        every = THINNED if self.centres.shape[1] == 1 else 1
        steps = (np.arange(every * count) + random.uniform()) / (every * count)
        which = np.minimum(np.searchsorted(np.cumsum(self.shares), steps), len(self.shares) - 1)
        normal = random.normal(size=(every * count, self.centres.shape[1]))
        stretch = np.sqrt(FREEDOM / random.chisquare(FREEDOM, every * count))
        draws = self.centres[which] + np.einsum("nij,nj->ni", self.roots[which], normal) * stretch[:, None]
        return draws if every == 1 else np.sort(draws, axis=0)[every // 2 :: every]

    def log_density(self, points: Points) -> PerPoint:
        """The log density of the mixture."""
        size = points.shape[1]
        constant = (
            math.lgamma(0.5 * (FREEDOM + size)) - math.lgamma(0.5 * FREEDOM) - 0.5 * size * math.log(FREEDOM * math.pi)
        )
        squares, log_volumes = squared_distances(points, self.centres, self.roots)
        constants = np.log(self.shares) + constant - log_volumes
        logs = constants[:, None] - 0.5 * (FREEDOM + size) * np.log1p(squares / FREEDOM)
        return np.logaddexp.reduce(logs, axis=0)

    def log_normals(self, points: Points) -> Float[np.ndarray, "components n"]:
        """The log densities of Gaussian components, weighted by their shares, up to a constant."""
        squares, log_volumes = squared_distances(points, self.centres, self.roots)
        return (np.log(self.shares) - log_volumes)[:, None] - 0.5 * squares

    def joined(self, other: "Mixture", share: float) -> "Mixture":
        """This mixture, and another one that gets a share of the draws."""
        shares = np.concatenate([(1.0 - share) * self.shares, share * other.shares])
        return Mixture(shares, np.concatenate([self.centres, other.centres]), np.concatenate([self.roots, other.roots]))


def weighted_covariance(points: Points, weights: PerPoint) -> tuple[Coordinates, Matrix]:
    """The mean and the covariance of weighted points."""
    mean = weights @ points
    off = points - mean
    return mean, (off * weights[:, None]).T @ off


def fitted(points: Points, weights: PerPoint, components: int, random: np.random.Generator) -> Mixture:
    """The mixture that best fits weighted points: expectation maximisation of a Gaussian mixture, whose covariances
    become scale matrices.

    Components with too few points for a covariance are dropped.

    Source: Cappe, Douc, Guillin, Marin and Robert, "Adaptive importance sampling in general mixture classes", Stat.
    Comput. 18 (2008) 447.
    """
    used = weights > 1e-6 * np.max(weights)
    points, weights = points[used], weights[used] / np.sum(weights[used])
    size = points.shape[1]
    mean, whole = weighted_covariance(points, weights)
    spread = np.sqrt(np.diag(whole)) + 1e-12 * (1.0 + np.abs(mean))
    points = (points - mean) / spread
    whole = whole / np.outer(spread, spread) + 1e-9 * np.eye(size)
    # First centres far from each other (k-means++).
    chosen = [int(random.choice(len(points), p=weights))]
    for _ in range(min(components, len(points)) - 1):
        squares = np.min([np.sum((points - points[k]) ** 2, axis=1) for k in chosen], axis=0) * weights
        if not np.sum(squares) > 0.0:
            break
        chosen.append(int(random.choice(len(points), p=squares / np.sum(squares))))
    centres = points[chosen]
    shares, covariances = np.full(len(centres), 1.0 / len(centres)), np.tile(whole / len(centres), (len(centres), 1, 1))
    # The points of a single unknown are a grid, on which few resolve a component.
    effective = 1.0 / np.sum(weights**2) if size > 1 else len(points)
    for _ in range(ITERATIONS):
        logs = Mixture(shares, centres, np.linalg.cholesky(covariances)).log_normals(points)
        parts = np.exp(logs - np.logaddexp.reduce(logs, axis=0)) * weights
        shares = np.sum(parts, axis=1)
        # A covariance needs more points than it has dimensions.
        kept = shares * effective > size + 2.0
        kept[np.argmax(shares)] = True
        parts, shares = parts[kept], shares[kept] / np.sum(shares[kept])
        moments = [weighted_covariance(points, part / np.sum(part)) for part in parts]
        centres = np.stack([moment[0] for moment in moments])
        covariances = np.stack([moment[1] + SHRINKAGE * whole for moment in moments])
    roots = np.linalg.cholesky(covariances)
    return Mixture(shares, mean + spread * centres, spread[:, None] * roots)


def squared_distances(
    points: Points, centres: Float[np.ndarray, "*parts unknowns"], roots: Float[np.ndarray, "*parts unknowns unknowns"]
) -> tuple[Float[np.ndarray, "*parts n"], Float[np.ndarray, "*parts"]]:
    """Squared distances of points from centres in units of the covariances, and logarithms of the roots' determinants."""
    off = np.linalg.inv(roots) @ (points.T - centres[..., None])
    return np.sum(off**2, axis=-2), np.sum(np.log(np.abs(np.diagonal(roots, axis1=-2, axis2=-1))), axis=-1)


# The region in which a fit looks for minima: a box in the coordinates of the unknowns.

#: Half width of the searched range of a number of a launch or a start, as a fraction of its start value: such numbers
#: were measured or set.
OF_LAUNCH = 0.1

#: Half width of the searched range of `t0`, as a fraction of the duration of the recordings.
OF_DURATION = 0.02

#: A prior is searched to this many standard deviations.
DEVIATIONS = 3.0

#: Width of the soft edge of the box, in half widths.
EDGE = 0.25

#: Weights are 0 farther from the start than this many half widths: a factor of 2^10 for a positive number.
FARTHEST = 10.0


class Region(NamedTuple):
    """A box in the coordinates: the middle and the half widths of the search, and the start values, each (unknowns,)."""

    middle: Coordinates
    half_width: Coordinates
    start: Coordinates

    def points(self, count: int, seed: int) -> Float[np.ndarray, "count unknowns"]:
        """Quasi-random points that fill the box; the first is the start, and the second the middle, if that is another point.

        Source: Roberts, "The unreasonable effectiveness of quasirandom sequences" (2018): multiples of powers of the root of
        x^(d + 1) = x + 1 for d unknowns, here with a random shift. Importing SciPy's Sobol points takes seconds.
        """
        size = len(self.middle)
        root = np.roots([1.0, *np.zeros(size - 1), -1.0, -1.0]).real.max()
        shift, steps = np.random.default_rng(seed).uniform(size=size), root ** -np.arange(1.0, size + 1.0)
        unit = (shift + np.outer(np.arange(count), steps)) % 1.0
        points = self.middle + (2.0 * unit - 1.0) * self.half_width
        points[0] = np.clip(self.start, self.middle - self.half_width, self.middle + self.half_width)
        if count > 1 and not np.allclose(points[0], self.middle):
            points[1] = self.middle
        return points

    def log_density(self, points: Points) -> PerPoint:
        """The log density of points that are uniform in the box."""
        inside = np.all(np.abs(points - self.middle) <= self.half_width, axis=1)
        return np.where(inside, -np.sum(np.log(2.0 * self.half_width)), -np.inf)

    def contains(self, points: Points) -> np.ndarray:
        """Which points are near enough for a weight."""
        return np.all(np.abs(points - self.middle) <= FARTHEST * self.half_width, axis=1)


def region_of(density: LogDensity, spread: float) -> Region:
    """The region in which the unknowns of a density are searched.

    The range of an unknown is, by the first of these rules that applies:

    - with a Gaussian prior: `DEVIATIONS` standard deviations around its mean, within the bounds;
    - between two bounds: the whole range;
    - `t0`: `OF_DURATION` of the longest recording around the start value, in both directions;
    - a number of a launch or a start: `OF_LAUNCH` of the start value (0.1 where it is 0) in both directions, within the
      bounds;
    - with one bound: a factor `spread` of the distance from the bound in both directions;
    - any other number: `spread` - 1 times the start value (or 1 where it is 0) in both directions.

    Except for the first two rules, its middle is the start value.

    **Arguments:** `spread`: greater than 1.
    """
    # 0 without recordings.
    duration = float(np.max(density.measurements.time))
    unknowns, names = density.problem.unknowns, map(own_name, density.problem.names)
    start, lower, upper = map(np.asarray, (unknowns.start, unknowns.lower, unknowns.upper))
    has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
    middle, reach = start.copy(), np.full(len(start), np.nan)
    for k, (name, prior) in enumerate(zip(names, unknowns.priors, strict=True)):
        if prior is not None and not callable(prior):
            middle[k], reach[k] = prior[0], DEVIATIONS * prior[1]
        elif has_lower[k] and has_upper[k]:
            continue
        elif name == "t0" and duration > 0.0:
            reach[k] = OF_DURATION * duration
        elif name.startswith(("launch", "start")):
            reach[k] = OF_LAUNCH * (abs(middle[k]) or 1.0)
    # Stay away from the bounds, where coordinates are infinite.
    margin = 0.05 * reach
    low = np.maximum(middle - reach, lower + margin)
    high = np.maximum(np.minimum(middle + reach, upper - margin), low + margin)
    by_factor = np.where(has_lower | has_upper, math.log(spread), spread - 1.0) * np.array([[-1.0], [1.0]])
    ends = np.select(
        [np.isfinite(reach), has_lower & has_upper],
        [unknowns.coordinates(np.stack([low, high])), np.array([[-5.0], [5.0]])],
        unknowns.coordinates(start) + by_factor,
    )
    return Region(np.mean(ends, axis=0), 0.5 * np.ptp(ends, axis=0), np.asarray(unknowns.coordinates(start)))


#: Greatest number of points that are evaluated together, and of points in a round; the program of the priors has as many rows.
ROWS = 512

#: An exploration ends with at least this many effective draws and a shape k of the weights below `MOST_K`, or after
#: `ROUNDS` rounds.
ENOUGH, MOST_K, ROUNDS = 400.0, 0.7, 40

#: The likelihood is tempered to this effective number of points for each unknown, and to at least the second number in all;
#: with a single unknown, to half of the first number.
TEMPERED, LEAST_TEMPERED = 20.0, 80.0

#: A point of a single unknown is worth at most so many independent draws: the ends of intervals are then as accurate or better.
EVEN = 10.0

#: Number of groups of measurements, in the order of their times, and the number of groups whose powers grow together.
GROUPS, FRONT = 32, 8

#: Components of the proposals, and the share of the draws that the ends of the search by slopes keep.
COMPONENTS, KEPT = 16, 0.15

#: The density falls towards an end of the range if its logarithm is there less than its maximum by more than this.
FALL = 2.0

#: An unknown does not act if it changes predictions by less than this part of their errors.
NO_CHANGE = 1e-3

#: Powers of the density to which the two halves of the proposals are fitted. The flatter half reaches beyond the posterior, to
#: other minima and into the tails.
POWERS = (1.0, 0.4)


class Pool(NamedTuple):
    """All points so far, a weighted sample of the posterior.

    - `points`: (n, unknowns), coordinates, in order if there is a single unknown; `predictions`: (n, measurements).
    - `groups`: (n, groups), log likelihoods of groups of measurements; `log_prior`, `log_density`: (n,), of the posterior,
      averaged over unknown errors.
    - `log_region`: (n,), 0 in the region of the search, and less outside of it.
    - `log_proposal`: (n,), log of the density of the points: of that from which all were drawn, times n; with a single
      unknown, of the inverse of their spacing.
    - `proposals`: pairs of a number of points and the distribution from which they were drawn.
    - `weights`: (n,), Pareto-smoothed, with the sum 1; `k`: shape of the weights' tail; `effective`: the effective number of
      draws.
    """

    points: Points
    predictions: Float[np.ndarray, "n measurements"]
    groups: Float[np.ndarray, "n groups"]
    log_prior: PerPoint
    log_density: PerPoint
    log_region: PerPoint
    log_proposal: PerPoint
    proposals: tuple[tuple[int, Region | Mixture], ...]
    weights: PerPoint = np.zeros(0)
    k: float = -math.inf
    effective: float = 0.0

    @property
    def enough(self) -> bool:
        """Whether means and quantiles over the weights can be trusted."""
        return self.effective >= ENOUGH and self.k < MOST_K

    def most_probable(self, count: int) -> Int[np.ndarray, " count"]:
        """The numbers of the points with the greatest density, the best first."""
        return np.argsort(-self.log_density)[:count]

    def log_weights(self, progress: float) -> PerPoint:
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
    """What is explored, and where: a density, the region of the search, and the group of every measurement.

    `rows`: number of points in a round: with a single unknown, whose points fill the posterior evenly, few are enough.
    """

    density: LogDensity
    region: Region
    group: np.ndarray
    rows: int
    seed: int
    random: np.random.Generator

    @classmethod
    def of(cls, density: LogDensity, spread: float, seed: int) -> "Explorer":
        """An explorer of the region around start values, as for `region_of`, with measurements grouped by their times."""
        times, region = density.measurements.time, region_of(density, spread)
        distinct = np.unique(times)
        count = min(GROUPS, len(distinct))
        group = (np.searchsorted(distinct, times) * count) // len(distinct)
        rows = ROWS if len(region.middle) > 1 else ROWS // 8
        return cls(density, region, group, rows, seed, np.random.default_rng(seed))

    def begin(self) -> Pool:
        """A pool of quasi-random points in the region."""
        values, groups = self.density.measurements.value.size, int(np.max(self.group)) + 1
        size = len(self.region.middle)
        shapes = ((0, size), (0, values), (0, groups), (0,), (0,), (0,), (0,))
        empty = Pool(*(np.zeros(shape) for shape in shapes), proposals=())
        # The valleys of recordings are narrow.
        count = ROWS if size > 2 else ROWS // 2 if size == 2 else ROWS // 4 if groups > 1 else self.rows
        return self.extended(empty, self.region.points(count, self.seed), self.region)

    def acting(self, pool: Pool) -> Bool[np.ndarray, " unknowns"]:
        """Which unknowns act: moved from one of the two best points to the farther end of its range, such an unknown changes a
        prediction; a single unknown changes it from the best point to another one of the pool. Unknowns with a prior or
        between two bounds need not act: their posterior has an end."""
        middle, half_width = self.region.middle, self.region.half_width
        if len(middle) == 1:
            base, others = pool.predictions[pool.most_probable(1), None], pool.predictions[:, None]
        else:
            points = pool.points[pool.most_probable(2)]
            moved = np.repeat(points[:, None], len(middle), axis=1)
            ends = middle + np.where(points > middle, -half_width, half_width)
            np.einsum("bkk->bk", moved)[:] = ends
            predictions = self.density.predict(np.concatenate([points, moved.reshape(-1, len(middle))]))
            base, others = predictions[: len(points), None], predictions[len(points) :].reshape(*ends.shape, -1)
        with np.errstate(invalid="ignore"):
            change = np.abs(others - base) / self.density.measurements.error
        is_same = np.all((others == base) | (change < NO_CHANGE), axis=(0, 2))
        unknowns = self.density.problem.unknowns
        has_prior = np.array([prior is not None for prior in unknowns.priors])
        return ~is_same | has_prior | np.isfinite(unknowns.upper - unknowns.lower)

    def extended(self, pool: Pool, points: Points, proposal: Region | Mixture) -> Pool:
        """The pool with points that were drawn from a proposal."""
        proposals = (*pool.proposals, (len(points), proposal))
        grown = [np.concatenate(pair) for pair in zip(pool[:6], self.compared(points), strict=True)]
        old = np.logaddexp(pool.log_proposal, math.log(len(points)) + proposal.log_density(pool.points))
        new = np.logaddexp.reduce([math.log(n) + other.log_density(points) for n, other in proposals], axis=0)
        log_proposal = np.concatenate([old, new])
        if points.shape[1] == 1:
            grown = [part[np.argsort(grown[0][:, 0])] for part in grown]
            log_proposal = -np.log(np.gradient(grown[0][:, 0]))
        pool = Pool(*grown, log_proposal=log_proposal, proposals=proposals)
        logs = pool.log_weights(2.0)
        weights, k = smoothed_weights(np.where(np.isfinite(logs), logs, -np.inf))
        return pool._replace(weights=weights, k=k, effective=independent_number(pool.points, weights))

    def explore(self, pool: Pool, minima: Mixture | None) -> Pool:
        """Adapt proposals to the posterior, round by round.

        **Arguments:** `pool`: from `begin`; `minima`: a component around each minimum that is known, or `None`.
        """
        with Progress(ROUNDS, "round") as display:
            display.begin()
            for _ in range(ROUNDS):
                mixture = self.proposal(pool, minima, 0.6 if len(pool.proposals) == 1 else KEPT)
                # The last round draws what is missing, with some to spare.
                rate = pool.effective / max(len(pool.weights) - pool.proposals[0][0], 1)
                missing = 1.25 * (ENOUGH - pool.effective) / max(rate, 1e-3) if len(pool.proposals) > 1 else np.inf
                count = self.rows if pool.k >= MOST_K else int(np.clip(missing, self.rows // 8, self.rows))
                pool = self.extended(pool, mixture.draw(count, self.random), mixture)
                display.advance(1)
                if pool.enough:
                    break
        return pool

    def proposal(self, pool: Pool, minima: Mixture | None, share: float = KEPT) -> Mixture:
        """The mixture that fits the points so far best; the components around known minima get a share of it."""
        size = pool.points.shape[1]
        least = max(LEAST_TEMPERED, TEMPERED * size) if size > 1 else 0.5 * TEMPERED
        if size == 1:
            # The points, and more between them, with interpolated predictions.
            place, known = np.linspace(0.0, len(pool.points) - 1.0, ROWS), np.concatenate(pool[:2], axis=1)
            between = np.stack([np.interp(place, np.arange(len(known)), column) for column in known.T], axis=1)
            parts = self.compared(between[:, :1], between[:, 1:])
            pool = Pool(*parts, log_proposal=-np.log(np.gradient(between[:, 0])), proposals=())
        halves = [
            fitted(pool.points, tempered_weights(pool, least, power), COMPONENTS, self.random) for power in POWERS
        ]
        mixture = halves[0].joined(halves[1], 0.5)
        return mixture if minima is None else mixture.joined(minima, share)

    def compared(self, points: Points, known: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """The first fields of a pool, for at most `ROWS` points, whose predictions may be known.

        The likelihood of a measurement is that with its stated or guessed error; the density is averaged over unknown errors.
        """
        inside = self.region.contains(points)
        # Rows of NaN take no time. The program of the priors is compiled for `ROWS` rows.
        batch = np.pad(np.where(inside[:, None], points, np.nan), ((0, ROWS - len(points)), (0, 0)))
        measurements = self.density.measurements
        predictions = np.asarray(self.density.predict(batch[: len(points)])) if known is None else known
        residual = compared(measurements, predictions)[0]
        each, estimated = -0.5 * residual**2, measurements.estimated & ~measurements.censored
        likelihood = np.sum(each[:, ~estimated], axis=1)
        for scales, logs in _by_error(measurements, predictions, residual):
            likelihood = likelihood + np.logaddexp.reduce(logs, axis=1) + np.log(scales[:, 1] - scales[:, 0])
        prior = np.asarray(self.density.log_priors(batch))
        prior = np.where(inside, prior[: len(points)], -np.inf)
        groups = np.stack([np.sum(each[:, self.group == k], axis=1) for k in np.unique(self.group)], axis=1)
        # 0 in the region; outside, less with the square of the distance.
        beyond = (np.abs(points - self.region.middle) / self.region.half_width - 1.0).clip(0.0)
        log_region = -0.5 * np.sum((beyond / EDGE) ** 2, axis=1)
        return points, predictions, groups, prior, likelihood + prior, log_region


def independent_number(points: Points, weights: PerPoint) -> float:
    """Number of independent draws that are worth as much as weighted points (Kish).

    The weights of a single unknown, whose points are in order, are the density times the spacing, so only the course of the
    density between neighbours is unknown. A jump anywhere between them leaves an error of their masses whose standard deviation
    is the jump times their distance / sqrt(12); the probability of an interval in n independent draws has one of at most
    1 / sqrt(4 n).
    """
    number = float(1.0 / np.sum(weights**2))
    if points.shape[1] > 1:
        return number
    jumps = np.diff(weights / np.gradient(points[:, 0])) * np.diff(points[:, 0])
    return max(number, min(EVEN * number, 3.0 / max(float(np.sum(jumps**2)), 1e-300)))


def tempered_weights(pool: Pool, least: float, power: float) -> PerPoint:
    """Weights of a power of the density, as close to the posterior as at least so many effective draws allow."""

    def weights_at(progress: float) -> tuple[PerPoint, bool]:
        """The weights, and whether they have enough effective draws."""
        # The density is flatter, the distribution of the points is what it is.
        logs = power * (pool.log_weights(progress) + pool.log_proposal) - pool.log_proposal
        logs = np.where(np.isfinite(logs), logs, -np.inf)
        weights = np.exp(logs - np.max(logs))
        weights = weights / np.sum(weights)
        return weights, bool(1.0 / np.sum(weights**2) >= least)

    # At first at the end of the way, 2; beyond, nothing changes.
    low, high = 0.0, 4.0
    for _ in range(31):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if weights_at(middle)[1] else (low, middle)
    return weights_at(low)[0]


# Pareto-smoothed importance weights (Vehtari, Simpson, Gelman, Yao and Gabry, J. Mach. Learn. Res. 25 (2024) 72).


def smoothed_weights(log_weights: PerPoint) -> tuple[PerPoint, float]:
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
    if not (count >= 5 and excess[0] >= 0.0 and excess[-1] > 1e-9 * weights[order[-1]] and excess[count // 4] > 0.0):
        return weights / np.sum(weights), -math.inf
    # Shape and scale of the distribution (Zhang and Stephens, Technometrics 51 (2009) 316), with the shape drawn to 0.5 like
    # 10 of the numbers. Of a very heavy tail, most numbers are negligible.
    grid = 30 + int(np.sqrt(count))
    quartile = max(excess[max(int(count / 4 + 0.5) - 1, 0)], 1e-9 * excess[-1])
    inverse = 1.0 / excess[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shapes = np.mean(np.log1p(-inverse[:, None] * excess), axis=1)
    logs = count * (np.log(-inverse / shapes) - shapes - 1.0)
    share = np.exp(logs - np.max(logs))
    mean = np.sum(inverse * share) / np.sum(share)
    shape = np.mean(np.log1p(-mean * excess))
    scale, shape = float(-shape / mean), float((count * shape + 5.0) / (count + 10.0))
    if np.isfinite(shape):
        logs = np.log1p(-(np.arange(count) + 0.5) / count)
        smooth = scale * np.expm1(np.minimum(-shape * logs, 700.0)) / shape if shape else -scale * logs
        # No weight is larger than the largest of the weights.
        weights[tail] = np.minimum(cutoff + smooth, 1.0)
    return weights / np.sum(weights), shape
