"""Mixtures of multivariate Student's t distributions: heavy-tailed proposals for importance sampling."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

#: Degrees of freedom of the components: tails heavier than those of a posterior, and a finite covariance.
FREEDOM = 5.0

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
        """Independent draws; each component gets its share of them, rounded at random."""
        steps = (np.arange(count) + random.uniform()) / count
        which = np.minimum(np.searchsorted(np.cumsum(self.shares), steps), len(self.shares) - 1)
        normal = random.normal(size=(count, self.centres.shape[1]))
        stretch = np.sqrt(FREEDOM / random.chisquare(FREEDOM, count))
        return self.centres[which] + np.einsum("nij,nj->ni", self.roots[which], normal) * stretch[:, None]

    def log_density(self, points: Float[np.ndarray, "n unknowns"]) -> Float[np.ndarray, " n"]:
        """The log density of the mixture."""
        size = points.shape[1]
        constant = (
            math.lgamma(0.5 * (FREEDOM + size)) - math.lgamma(0.5 * FREEDOM) - 0.5 * size * math.log(FREEDOM * math.pi)
        )
        squares, log_volumes = _squared_distances(points, self.centres, self.roots)
        constants = np.log(self.shares) + constant - log_volumes
        logs = constants[:, None] - 0.5 * (FREEDOM + size) * np.log1p(squares / FREEDOM)
        return np.logaddexp.reduce(logs, axis=0)

    def joined(self, other: "Mixture", share: float) -> "Mixture":
        """This mixture, and another one that gets a share of the draws."""
        shares = np.concatenate([(1.0 - share) * self.shares, share * other.shares])
        return Mixture(shares, np.concatenate([self.centres, other.centres]), np.concatenate([self.roots, other.roots]))


def weighted_covariance(
    points: Float[np.ndarray, "n unknowns"], weights: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, "unknowns unknowns"]]:
    """The mean and the covariance of weighted points."""
    mean = weights @ points
    off = points - mean
    return mean, (off * weights[:, None]).T @ off


def fitted(
    points: Float[np.ndarray, "n unknowns"],
    weights: Float[np.ndarray, " n"],
    components: int,
    random: np.random.Generator,
) -> Mixture:
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
    centres = _spread_centres(points, weights, components, random)
    shares, covariances = np.full(len(centres), 1.0 / len(centres)), np.tile(whole / len(centres), (len(centres), 1, 1))
    effective = 1.0 / np.sum(weights**2)
    for _ in range(ITERATIONS):
        squares, log_volumes = _squared_distances(points, centres, np.linalg.cholesky(covariances))
        logs = (np.log(shares) - log_volumes)[:, None] - 0.5 * squares
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


def _spread_centres(
    points: np.ndarray, weights: np.ndarray, count: int, random: np.random.Generator
) -> Float[np.ndarray, "components unknowns"]:
    """First centres, drawn far from each other (k-means++)."""
    chosen = [int(random.choice(len(points), p=weights))]
    for _ in range(min(count, len(points)) - 1):
        squares = np.min([np.sum((points - points[k]) ** 2, axis=1) for k in chosen], axis=0) * weights
        if not np.sum(squares) > 0.0:
            break
        chosen.append(int(random.choice(len(points), p=squares / np.sum(squares))))
    return points[chosen]


def _squared_distances(
    points: Float[np.ndarray, "n unknowns"],
    centres: Float[np.ndarray, "components unknowns"],
    roots: Float[np.ndarray, "components unknowns unknowns"],
) -> tuple[Float[np.ndarray, "components n"], Float[np.ndarray, " components"]]:
    """Squared distances of points from centres in units of the covariances, and logarithms of the roots' determinants."""
    off = np.linalg.inv(roots) @ (points.T - centres[:, :, None])
    return np.sum(off**2, axis=1), np.sum(np.log(np.abs(np.diagonal(roots, axis1=1, axis2=2))), axis=1)
