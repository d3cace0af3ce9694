"""What a fit concludes: a verdict, intervals, profile likelihoods, and the shape of the posterior in words."""

import math
import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from ..text import counted
from .exploration import FARTHEST, ROWS, Explorer, Pool, fitted, squared_distances, weighted_covariance
from .posterior import Coordinates, Matrix, Measurements, PerPoint, Points, Problem, predictions, weighed
from .search import Minima, minimise

# Only for type checkers: results stand above conclusions.
if TYPE_CHECKING:
    from .result import Identification

# Judge a fit: the size and order of its residuals, the minima that the data allow, and the undetermined combinations.

#: A p-value below this is a poor fit.
POOR = 0.01

#: A measurement with a larger residual cannot be explained.
FAR = 4.0

#: A measurement farther than so many errors is an outlier, if at most this share of all are. So many are named.
OUTLYING, MOST_OUTLYING, MOST_NAMED = 5.0, 0.05, 3

#: Residuals that are all smaller than this are not noise but round-off and integration errors, which may keep their
#: sign.
NEGLIGIBLE = 1e-3


class Series(NamedTuple):
    """The order of the residuals of one series: the number of residuals, the number of runs of one sign, and the
    probability of at most so many runs if the signs were random."""

    count: int
    runs: int
    p_value: float


class Verdict(NamedTuple):
    """Whether a fit can be believed.

    - `p_value`: probability of residuals this large or larger if the model and the errors are right (chi squared of the
      measurements that are not limits); NaN if errors were estimated or no degree of freedom is left.
    - `series`: a `Series` for each series of measurements.
    - `agree`, `starts`: number of refined candidates that reached the best minimum, and number of all.
    - `undetermined`: the parameters that the data do not determine, in words.
    - `concerns`: the concerns, in words; empty for a flawless fit.
    - `caveats`: what the fit takes for granted, in words, and why `p_value` is NaN.
    - `notes`: what is special about the likelihood, in words; errors and intervals take account of it.
    - `effective`, `k`: effective number of draws behind errors and intervals, and the shape of the tail of their weights
      (Pareto k-hat): below 0.7, they can be trusted.
    - `minima`: the minima that the data allow, as `Minimum`, the most probable first.
    """

    p_value: float
    series: tuple[Series, ...]
    agree: int
    starts: int
    undetermined: tuple[str, ...]
    concerns: tuple[str, ...]
    caveats: tuple[str, ...]
    notes: tuple[str, ...]
    effective: float
    k: float
    minima: tuple["Minimum", ...]

    @property
    def good(self) -> bool:
        """Whether there are no concerns about the fit."""
        return not self.concerns

    def __str__(self) -> str:
        """Whether to believe the fit, and what to do; `Identification.details` has the statistics."""
        if self.concerns:
            return "\n  ".join(["do not rely on this fit yet:", *self.concerns, *self.caveats])
        if self.caveats:
            return f"no concerns, but {'; '.join(self.caveats)}"
        return "no concerns about this fit" + bool(self.notes) * f", {counted(len(self.notes), 'note')} in its details"


def judge(
    labels: tuple[str, ...],
    ends: Minima,
    explorer: Explorer,
    sample: Pool,
    distribution: "Distribution",
    unseen: tuple[str, ...],
    status: str,
) -> Verdict:
    """Judge a fit.

    **Arguments:** `labels`: the names of the measurements; `ends`: those of the search; `distribution`: that of the
    coordinates; `unseen`: the combinations that the data do not determine; `status`: that of the fit.

    **Returns:** a `Verdict`.
    """
    from scipy.special import chdtrc

    measurements, by_slopes = ends.density.measurements, ends.covariance(ends.best)
    prediction, residual = ends.linearised.prediction[ends.best], ends.linearised.residual[ends.best]
    exact = ~measurements.censored
    missing = int(np.sum(~np.isfinite(prediction[exact])))
    violated = int(np.sum(np.abs(residual[: len(exact)][~exact]) > FAR))
    degrees = len(residual) - len(by_slopes) - int(np.sum(~exact))
    scores = normal_scores(measurements, prediction)
    chi_squared, p_value = float(np.sum(scores[exact] ** 2)), math.nan
    is_estimated = bool(np.any(measurements.estimated))
    if degrees > 0 and not is_estimated:
        p_value = float(chdtrc(degrees, chi_squared)) if math.isfinite(chi_squared) else 0.0
    parts = [scores[exact & (measurements.series == number)] for number in np.unique(measurements.series)]
    orders = [runs_of_signs(part) for part in parts]
    p_values = [order.p_value for order, part in zip(orders, parts, strict=True) if np.any(np.abs(part) > NEGLIGIBLE)]
    p_trend = min(p_values, default=1.0) * max(len(p_values), 1)
    region = explorer.region
    is_outside = np.abs(distribution.estimate - region.middle) > region.half_width
    outside = ", ".join(np.array(explorer.density.problem.names)[is_outside])
    fixed = " and ".join(getattr(explorer.density.problem.model, "fixed", ()))
    outliers = [f"{labels[k]} ({abs(scores[k]):.0f} errors)" for k in np.flatnonzero(np.abs(scores) > OUTLYING)]
    # A wrong model, or too small an error, puts many measurements far away.
    outlying = ", ".join(outliers[:MOST_NAMED]) if len(outliers) <= MOST_OUTLYING * len(scores) else ""
    impossible, share = without_prediction(explorer, sample, distribution)
    minima, concerns, notes = (), (), ()
    if distribution.kind == "weights":
        minima, (concerns, notes) = minima_of(explorer, sample), remarks(explorer, sample, distribution, by_slopes)
    # The most important first; the details have the statistics.
    concerns = (
        *sentences(
            (status != "converged", "the fit has not converged: start closer, or allow more steps (max_steps)"),
            (missing, f"the model has no prediction for {missing} measurements: its run ends earlier, or fails"),
            (
                distribution.kind == "none",
                "there are no errors and intervals: start closer, give bounds or priors, or fix numbers",
            ),
        ),
        *(
            f"the data do not determine {' and '.join(names)}: fix {'one' if len(names) > 1 else 'it'}, or give a prior"
            # From words such as "mass +1 %, length -1 %".
            for names in ([re.split(r" [+-]", part)[0] for part in words.split(", ")] for words in unseen)
        ),
        *sentences(
            (len(minima) > 1, f"the data allow {len(minima)} minima, which the details list: state a prior or bounds"),
            (
                p_value < POOR,
                "the residuals are too large for the intervals to be valid: check the model and the errors",
            ),
            (outlying, f"far from the fit: {outlying}: leave mistakes out, or pass student=4"),
            (violated, f"{violated} limits are violated by more than {FAR:.0f} errors"),
            (
                p_trend < POOR,
                "the residuals keep their sign for too long: the model misses a trend, or errors are correlated",
            ),
            (
                share > CUT,
                f"{100.0 * share:.0f} % of the candidates beside the estimate count as impossible: simulate a run there",
            ),
        ),
        *concerns,
    )
    notes = (
        *sentences(
            (
                outside,
                f"{outside}: outside of the range in which minima were searched, so better ones may be missing; start closer, "
                "or state a prior",
            ),
            (impossible, impossible),
        ),
        *(f"minimum: {minimum}" for minimum in minima if len(minima) > 1),
        *notes,
    )
    return Verdict(
        p_value=p_value,
        series=tuple(order for order in orders if order.count > 1),
        agree=ends.agree,
        starts=len(ends.starts),
        undetermined=unseen,
        concerns=concerns,
        caveats=sentences(
            (is_estimated, "nothing tests this fit, as its errors come from its own residuals: pass `error`"),
            (degrees <= 0 and not is_estimated, "no measurement is left to test this fit"),
            (fixed, f"held fixed as if exact: {fixed}; if these were measured, free them with priors"),
        ),
        notes=notes,
        effective=sample.effective,
        k=sample.k,
        minima=minima,
    )


def sentences(*table: tuple[object, str]) -> tuple[str, ...]:
    """The sentences whose conditions hold."""
    return tuple(sentence for condition, sentence in table if condition)


def normal_scores(measurements: Measurements, prediction: PerPoint) -> PerPoint:
    """Residuals converted to numbers that are normal if the stated errors are right; 0 for limits."""
    from scipy.special import ndtri, stdtr

    z, heavy = measurements.standardised(prediction), np.isfinite(measurements.student)
    return np.where(heavy, -np.sign(z) * ndtri(stdtr(np.where(heavy, measurements.student, 1.0), -np.abs(z))), z)


def runs_of_signs(values: PerPoint) -> Series:
    """The number of runs of one sign in a series, and the probability of at most so many runs (Wald and Wolfowitz, Ann.
    Math. Stat. 11 (1940) 147).

    If the numbers of positive and negative values are given, the number of runs of one sign has a hypergeometric
    distribution; the probability is summed exactly.
    """
    from scipy.special import betaln

    signs = np.sign(values[np.isfinite(values) & (values != 0.0)])
    positive, negative = int(np.sum(signs > 0.0)), int(np.sum(signs < 0.0))
    runs = 1 + int(np.sum(signs[1:] != signs[:-1])) if len(signs) else 0
    if not positive or not negative:
        # All of one sign: as improbable as a coin that always shows the same side.
        return Series(len(signs), runs, min(1.0, 2.0 ** (1 - len(signs))) if len(signs) else 1.0)

    # For r runs, the positive signs are cut into r // 2 runs and the negative ones into r - r // 2, or the other way
    # round.
    counts = np.arange(2, runs + 1)
    cuts, logs = (counts // 2 - 1, counts - counts // 2 - 1), []
    for few, many in (cuts, cuts[::-1]):
        # The logarithms of numbers of combinations, but for factors that cancel.
        logs.append(-betaln(positive - few, few + 1.0) - betaln(negative - many, many + 1.0))
    total = np.log(positive * negative / (positive + negative + 1.0)) - betaln(positive + 1.0, negative + 1.0)
    return Series(len(signs), runs, min(1.0, float(np.sum(np.exp(np.array(logs) - total)))))


# Profile likelihoods, by batches of runs and by least squares.

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


def profiled(fit: "Identification", k: int, values: Float[np.ndarray, " points"]) -> Profile:
    """The profile likelihood of the unknown with index `k`.

    For every held value, the other coordinates are drawn around their regression on the held one, then around the best of
    the points so far, in batches of runs without slopes; least squares refine the best ones.
    """
    problem, estimate = fit.density.problem, fit.coordinates
    held = problem.unknowns.coordinates(
        np.where(np.arange(len(estimate)) == k, values[:, None], problem.unknowns.start)
    )[:, k]
    covariance = np.where(np.isfinite(fit.coordinate_covariance), fit.coordinate_covariance, 0.0)
    random, size, points = np.random.default_rng(0), len(estimate), len(held)
    others = np.arange(size) != k
    slope = covariance[others, k] / covariance[k, k] if covariance[k, k] > 0.0 else np.zeros(size - 1)
    conditional = covariance[np.ix_(others, others)] - np.outer(slope, covariance[k, others])
    variances, vectors = np.linalg.eigh(conditional) if size > 1 else (np.zeros(0), np.zeros((0, 0)))
    root = vectors * np.sqrt(np.maximum(variances, 0.0))
    best = np.tile(estimate, (points, 1))
    best[:, k] = held
    best[:, others] += (held - estimate[k])[:, None] * slope
    # A single unknown leaves nothing to search.
    batches, each = (BATCHES, max(ROWS // points, 1)) if size > 1 else (1, 1)
    least = np.full(points, np.inf)
    for batch in range(batches):
        trial = np.repeat(best[:, None], each, axis=1)
        trial[..., others] += NARROWER**batch * random.normal(size=(points, each, size - 1)) @ root.T
        trial[:, 0] = best
        rows = trial.reshape(-1, size)
        deviance = weighed(fit.density, rows, predictions(problem, rows)).deviance
        deviance = np.where(np.isfinite(deviance), deviance, np.inf).reshape(points, each)
        place = np.argmin(deviance, axis=1)
        improved = deviance[np.arange(points), place]
        best = np.where((improved < least)[:, None], trial[np.arange(points), place], best)
        least = np.minimum(least, improved)
    converged = np.isfinite(least)
    if size > 1:
        ends = minimise(fit.density, best, fixed=k)
        at_ends, converged = ends.linearised, ends.converged
        improves = np.isfinite(at_ends.deviance) & (at_ends.deviance <= least)
        best = np.where(improves[:, None], at_ends.coordinates, best)
        least = np.where(improves, at_ends.deviance, least)
    optima = problem.unknowns.values(best)
    estimates = {other: optima[:, i] for i, other in enumerate(problem.names) if i != k}
    return Profile(values, least - fit.deviance, estimates, converged)


# What a fit concludes about its parameters: estimate, errors and intervals, from the likelihood itself.

#: A likelihood counts as that of a linear model if its logarithm differs from it by less than this standard deviation over
#: the posterior; the errors by slopes then hold.
LINEAR = 0.1

#: The most likely point is the estimate if it lies within this many standard errors of the mean. A staircase has many
#: points of nearly the same likelihood; then the estimate is a likely point near the mean, with this weight of the distance.
AT_MEAN, CENTRAL = 0.5, 4.0


class Distribution(NamedTuple):
    """The distribution of the coordinates.

    - `kind`: "linear" if the likelihood is that of a linear model, whose errors are exact; "weights" if errors come from the
      weights; "slopes" if the slopes leave a direction undetermined, so that there are no weights; "none" if the weights
      cannot be trusted.
    - `estimate`: (unknowns,); `covariance`: (unknowns, unknowns), NaN for the kind "none".
    - `points`, `weights`: (n, unknowns), (n,), the weighted sample.
    """

    kind: str
    estimate: Coordinates
    covariance: Matrix
    points: Points
    weights: PerPoint

    @classmethod
    def of(cls, best: Coordinates, by_slopes: Matrix, sample: Pool) -> "Distribution":
        """The distribution for the most likely coordinates, their covariance by slopes, and a weighted sample."""
        points, weights = sample.points, sample.weights
        if not np.all(np.isfinite(by_slopes)):
            return cls("slopes", best, by_slopes, points, weights)
        if not sample.enough:
            return cls("none", best, np.full_like(by_slopes, np.nan), points, weights)
        used = weights > 0.0
        squares, _ = squared_distances(points[used], best, np.linalg.cholesky(by_slopes))
        excess = sample.log_density[used] + 0.5 * squares
        mean_excess = weights[used] @ excess
        if math.sqrt(weights[used] @ (excess - mean_excess) ** 2) < LINEAR:
            return cls("linear", best, by_slopes, points, weights)
        mean, covariance = weighted_covariance(points, weights)
        # The first point is the best.
        squares, _ = squared_distances(np.vstack([best, points[used]]), mean, np.linalg.cholesky(covariance))
        if squares[0] > AT_MEAN**2:
            best = points[used][np.argmin(CENTRAL * squares[1:] - 2.0 * sample.log_density[used])]
        return cls("weights", best, covariance, points, weights)

    def interval(self, k: int, deviations: float) -> tuple[float, float]:
        """The interval of a coordinate with the probability of so many deviations of a normal distribution, and equal
        probabilities below and above."""
        if self.kind != "weights":
            reach = deviations * math.sqrt(self.covariance[k, k])
            return float(self.estimate[k] - reach), float(self.estimate[k] + reach)
        outside = math.erfc(deviations / math.sqrt(2.0))
        low, high = quantiles(self.points[:, k], self.weights, np.array([0.5 * outside, 1.0 - 0.5 * outside]))
        return float(low), float(high)

    def covariance_of_values(self, problem: Problem, slopes: Coordinates) -> Matrix:
        """The covariance of the parameters themselves, whose slopes with respect to the coordinates are given.

        The standard error of a parameter is half the width of its 68 % interval, which is the standard deviation of a normal
        distribution, and hardly depends on the distance of improbable minima.
        """
        if self.kind == "weights":
            # Draws without weight may be infinite.
            used = self.weights > 0.0
            _, covariance = weighted_covariance(problem.unknowns.values(self.points[used]), self.weights[used])
            ends = np.array([self.interval(k, 1.0) for k in range(len(self.estimate))])
            low, high = problem.unknowns.values(ends.T)
            scale = 0.5 * (high - low) / np.sqrt(np.diag(covariance))
            return covariance * np.outer(scale, scale)
        with np.errstate(invalid="ignore"):
            return np.where(self.covariance == 0.0, 0.0, self.covariance * np.outer(slopes, slopes))


def quantiles(
    values: PerPoint, weights: PerPoint, shares: Float[np.ndarray, " shares"]
) -> Float[np.ndarray, " shares"]:
    """Quantiles of weighted values."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return np.interp(shares, cumulative - 0.5 * weights[order], values[order])


# The shape of a posterior in words: several minima, staircases, bounds that cut, directions without information.

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

    - `estimates`: name -> value at its most likely point; `weight`: its probability; `deviance`: -2 log likelihood; `text`: the
      values in the units that are shown.
    """

    estimates: dict[str, float]
    weight: float
    deviance: float
    text: str

    def __str__(self) -> str:
        return f"{self.text} (weight {self.weight:.2f})"


def minima_of(explorer: Explorer, sample: Pool) -> tuple[Minimum, ...]:
    """The minima that the data allow, the most probable first.

    Components of a mixture are merged where the ridge between them has no deep saddle (Ray and Lindsay, Ann. Stat. 33
    (2005) 2042).
    """
    problem, used = explorer.density.problem, sample.weights > 0.0
    points, weights = sample.points[used], sample.weights[used]
    mixture = fitted(points, weights, COMPONENTS, np.random.default_rng(0))
    inverse = [np.linalg.inv(root @ root.T) for root in mixture.roots]
    parent = list(range(len(mixture.shares)))
    for a in range(len(parent)):
        for b in range(a):
            # The curve on which the density of the two components has its ridge.
            ridge = []
            for share in np.linspace(0.0, 1.0, 33):
                first, second = (1.0 - share) * inverse[a], share * inverse[b]
                ridge.append(np.linalg.solve(first + second, first @ mixture.centres[a] + second @ mixture.centres[b]))
            density = np.logaddexp.reduce(mixture.log_normals(np.stack(ridge)), axis=0)
            if np.min(density) > min(density[0], density[-1]) + math.log(SADDLE):
                parent = [parent[b] if group == parent[a] else group for group in parent]
    groups = np.array(parent)[np.argmax(mixture.log_normals(points), axis=0)]
    minima = []
    for group in np.unique(groups):
        best = np.flatnonzero(groups == group)[np.argmax(sample.log_density[used][groups == group])]
        values = dict(zip(problem.names, problem.unknowns.values(points[best]).tolist(), strict=True))
        deviance = float(-2.0 * np.sum(sample.groups[used][best]))
        text = ", ".join(f"{name} {explorer.density.written(name, value)}" for name, value in values.items())
        minima.append(Minimum(values, float(np.sum(weights[groups == group])), deviance, text))
    return tuple(sorted((minimum for minimum in minima if minimum.weight > LEAST_WEIGHT), key=lambda m: -m.weight))


def roughness(explorer: Explorer, sample: Pool) -> float:
    """Root mean square of the distances of predictions from a smooth trend, in units of their errors."""
    weights, points = sample.weights, sample.points
    used = (weights > 1e-4 * np.max(weights)) & np.all(np.isfinite(sample.predictions), axis=1)
    root = np.sqrt(weights[used] / np.sum(weights[used]))[:, None]
    centred = points[used] - weights[used] @ points[used] / np.sum(weights[used])
    centred = centred / (np.std(centred, axis=0) + 1e-300)
    size = centred.shape[1]
    columns = [np.ones(len(centred)), *centred.T]
    columns += [centred[:, i] * centred[:, j] for i in range(size) for j in range(i + 1)]
    terms = np.stack(columns, axis=1)
    predictions = sample.predictions[used]
    measurements = explorer.density.measurements
    predictions = predictions - measurements.whole_periods(predictions - predictions[0])
    coefficients, *_ = np.linalg.lstsq(root * terms, root * predictions)
    off = (predictions - terms @ coefficients) / measurements.error
    return float(np.sqrt(np.mean(np.sum(root**2 * off**2, axis=0))))


def without_prediction(explorer: Explorer, sample: Pool, distribution: Distribution) -> tuple[str, float]:
    """The candidates whose runs have no prediction, in words, empty if there are none; and their share of the candidates
    beside the estimate."""
    problem, points = explorer.density.problem, sample.points
    evaluated = explorer.region.contains(points)
    points, failed = points[evaluated], np.any(np.isnan(sample.predictions[evaluated]), axis=1)
    if not np.any(failed):
        return "", 0.0
    values = problem.unknowns.values(points[failed])
    ends = zip(problem.names, np.min(values, axis=0), np.max(values, axis=0), strict=True)
    places = ", ".join(f"{name} {explorer.density.written(name, low, high)}" for name, low, high in ends)
    words = (
        f"{np.sum(failed)} of {len(failed)} candidates count as impossible, because a run failed, was unresolved, ended too "
        f"early or was illegal: at {places}"
    )
    if not np.all(np.isfinite(distribution.covariance)):
        return words, 0.0
    squares, _ = squared_distances(points, distribution.estimate, np.linalg.cholesky(distribution.covariance))
    near = squares < BESIDE**2
    return words, float(np.mean(failed[near])) if np.any(near) else 0.0


def remarks(
    explorer: Explorer, sample: Pool, distribution: Distribution, by_slopes: Matrix
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What is special about the shape of a posterior: concerns and notes, in words."""
    problem, region, weights = explorer.density.problem, explorer.region, sample.weights
    concerns, notes, skewed = [], [], []
    values = problem.unknowns.values(sample.points)
    for k, name in enumerate(problem.names):
        # A bound, or the edge of the searched region, that cuts the interval of the unknown.
        coordinate, middle, reach = sample.points[:, k], region.middle[k], FARTHEST * region.half_width[k]
        for side, edge in (("below", middle - reach), ("above", middle + reach)):
            if np.sum(weights[np.abs(coordinate - edge) < NEAR * 2.0 * reach]) > CUT:
                concerns.append(f"the data do not bound {name} from {side}: its interval ends where the search ended")
        low, high = quantiles(values[:, k], weights, np.array([0.025, 0.975]))
        for bound in (problem.unknowns.lower[k], problem.unknowns.upper[k]):
            if np.isfinite(bound) and np.sum(weights[np.abs(values[:, k] - bound) < NEAR * (high - low)]) > CUT:
                concerns.append(
                    f"the bound {explorer.density.written(name, float(bound))} cuts the interval of {name}: if it is "
                    "yours, widen it; if less is impossible, fix another number, or state a prior"
                )
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
            notes.append(f"slopes {verb} the errors {factors[worst]:.2g} times ({problem.names[worst]}): {reason}")
    return tuple(concerns), tuple(notes)
