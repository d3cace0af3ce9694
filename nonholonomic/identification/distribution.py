"""What a fit concludes about its parameters: estimate, errors and intervals, from the likelihood itself."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from .exploration import Weighted
from .mixture import weighted_covariance
from .problem import Problem

#: A likelihood counts as that of a linear model if its logarithm differs from it by less than this standard deviation over
#: the posterior; the errors by slopes then hold.
LINEAR = 0.1

#: The most likely point is the estimate if it lies within this many standard errors of the mean. A staircase has many
#: points of nearly the same likelihood; then the estimate is a likely point near the mean, with this weight of the distance.
NEAR, CENTRAL = 0.5, 4.0


class Distribution(NamedTuple):
    """The distribution of the coordinates.

    - `kind`: "linear" if the likelihood is that of a linear model, whose errors are exact; "weights" if errors come from the
      weights; "slopes" if the slopes leave a direction undetermined, so that there are no weights; "none" if the weights
      cannot be trusted.
    - `estimate`: (unknowns,); `covariance`: (unknowns, unknowns), NaN for the kind "none".
    - `points`, `weights`: (n, unknowns), (n,), the weighted sample.
    """

    kind: str
    estimate: Float[np.ndarray, " unknowns"]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    points: Float[np.ndarray, "n unknowns"]
    weights: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls, best: Float[np.ndarray, " unknowns"], by_slopes: Float[np.ndarray, "unknowns unknowns"], sample: Weighted
    ) -> "Distribution":
        """The distribution for the most likely coordinates, their covariance by slopes, and a weighted sample."""
        points, weights = sample.pool.points, sample.weights
        if not np.all(np.isfinite(by_slopes)):
            return cls("slopes", best, by_slopes, points, weights)
        if not sample.enough:
            return cls("none", best, np.full_like(by_slopes, np.nan), points, weights)
        squares = np.sum(np.linalg.solve(np.linalg.cholesky(by_slopes), (points - best).T) ** 2, axis=0)
        used = weights > 0.0
        excess = sample.pool.log_density[used] + 0.5 * squares[used]
        mean_excess = weights[used] @ excess
        if math.sqrt(weights[used] @ (excess - mean_excess) ** 2) < LINEAR:
            return cls("linear", best, by_slopes, points, weights)
        mean, covariance = weighted_covariance(points, weights)
        root = np.linalg.cholesky(covariance)

        def squares_from_mean(coordinates: Float[np.ndarray, "n unknowns"]) -> Float[np.ndarray, " n"]:
            return np.sum(np.linalg.solve(root, (coordinates - mean).T) ** 2, axis=0)

        if squares_from_mean(best[None])[0] > NEAR**2:
            scores = -2.0 * sample.pool.log_density[used] + CENTRAL * squares_from_mean(points[used])
            best = points[used][np.argmin(scores)]
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

    def covariance_of_values(
        self, problem: Problem, slopes: Float[np.ndarray, " unknowns"]
    ) -> Float[np.ndarray, "unknowns unknowns"]:
        """The covariance of the parameters themselves, whose slopes with respect to the coordinates are given.

        The standard error of a parameter is half the width of its 68 % interval, which is the standard deviation of a normal
        distribution, and hardly depends on the distance of improbable minima.
        """
        if self.kind == "weights":
            # Draws without weight may be infinite.
            used = self.weights > 0.0
            covariance = weighted_covariance(np.asarray(problem.values(self.points[used])), self.weights[used])[1]
            ends = np.array([self.interval(k, 1.0) for k in range(len(self.estimate))])
            low, high = np.asarray(problem.values(ends.T))
            scale = 0.5 * (high - low) / np.sqrt(np.diag(covariance))
            return covariance * np.outer(scale, scale)
        with np.errstate(invalid="ignore"):
            return np.where(self.covariance == 0.0, 0.0, self.covariance * np.outer(slopes, slopes))


def quantiles(
    values: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"], shares: Float[np.ndarray, " shares"]
) -> Float[np.ndarray, " shares"]:
    """Quantiles of weighted values."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return np.interp(shares, cumulative - 0.5 * weights[order], values[order])
