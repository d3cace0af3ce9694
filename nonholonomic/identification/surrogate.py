"""A posterior whose predictions are polynomials: cheap to evaluate, and close enough to the true posterior to propose
draws."""

import itertools
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..validation import shown
from .posterior import LogDensity

#: Highest degree of the polynomials, and their greatest number of terms. To respect this number, the degree is lowered,
#: but not below 2.
HIGHEST, MOST_TERMS = 4, 90

#: The highest power in the bends of points.
BENT = 3

#: Number of runs per term of the polynomials, in each round of learning.
RUNS_PER_TERM = 2


class Surrogate(eqx.Module):
    """A log density whose predictions are polynomials of the coordinates; priors and likelihood are those of the density.

    It is a function of points: the coordinates of the density are `centre` + the sum of `bends[k]` point^(k + 1). If
    the data determine one combination far better than another, the posterior is a thin, bent ridge as a function of the
    coordinates, but nearly round as a function of the points. Along the axes of `among` the bends are triangular, so
    volumes change only by a factor. Unknown errors, on which no prediction depends, are also coordinates.

    - `power`: the power of the density; less than 1 makes it wider.
    - `origin`, `scale`: (numbers,), (numbers, numbers): the polynomials are in `scale` (coordinates - `origin`).
    - `coefficients`: (terms, n).
    """

    density: LogDensity
    centre: Float[Array, " unknowns"]
    bends: Float[Array, "powers unknowns unknowns"]
    power: Float[Array, ""]
    origin: Float[Array, " numbers"]
    scale: Float[Array, "numbers numbers"]
    coefficients: Float[Array, "terms n"]

    @classmethod
    def around(cls, density: LogDensity, centre: Any, covariance: Any) -> "Surrogate":
        """A surrogate before learning, whose points are in units of a fit's errors, along the principal directions of
        the fit.

        An unknown error of n values has the variance 1 / 2n.
        """
        covariance = np.asarray(covariance, float)
        numbers = len(density.problem.names)
        if covariance.shape != (numbers, numbers) or not np.all(np.isfinite(covariance)):
            raise ValueError(
                f"covariance must be finite and of shape {(numbers, numbers)}: the data do not determine all numbers"
            )
        if np.shape(centre) != (numbers,):
            raise ValueError(f"centre = {shown(centre)} must be of shape {(numbers,)}")
        series, estimated = np.asarray(density.measurements.series), np.asarray(density.measurements.estimated)
        sizes = [math.sqrt(0.5 / np.sum(estimated & (series == number))) for number in density.open_series]
        root = np.zeros((numbers + len(sizes),) * 2)
        root[:numbers, :numbers] = np.linalg.cholesky(covariance)
        root[numbers:, numbers:] = np.diag(sizes)
        mean = np.concatenate([np.asarray(centre, float), np.zeros(len(sizes))])
        coefficients = jnp.zeros((len(_factors(numbers)), density.measurements.value.size))
        scale = np.linalg.inv(root[:numbers, :numbers])
        bends = np.concatenate([root[None], np.zeros((BENT - 1, *root.shape))])
        arrays = map(jnp.asarray, (mean, bends, 1.0, mean[:numbers], scale))
        middle, bends, power, origin, scale = arrays
        return cls(density, middle, bends, power, origin, scale, coefficients)

    @property
    def runs_a_round(self) -> int:
        """Number of runs in a round of learning."""
        return RUNS_PER_TERM * len(self.coefficients)

    def at(self, point: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        """The coordinates of a point."""
        return self.centre + sum(point ** (k + 1) @ self.bends[k].T for k in range(BENT))

    def predict(self, coordinates: Float[Array, "... unknowns"]) -> Float[Array, "... n"]:
        """The predictions of the polynomials."""
        return self._terms(jnp, coordinates) @ self.coefficients

    def __call__(self, point: Float[Array, " unknowns"]) -> Float[Array, ""]:
        coordinates = self.at(point)
        return self.power * self.density.of_prediction(coordinates, self.predict(coordinates))

    def learned(
        self,
        coordinates: Float[np.ndarray, "runs unknowns"],
        predictions: Float[np.ndarray, "runs n"],
        log_densities: Float[np.ndarray, " runs"],
    ) -> "Surrogate":
        """The surrogate with the polynomials that best fit the predictions of the given runs, with more weight for
        likely runs."""
        valid = np.all(np.isfinite(predictions), axis=1)
        if not np.any(valid):
            raise ValueError("density: the model has no predictions within the covariance around the centre")
        # An angle that jumps by a whole turn is not a polynomial.
        middle = predictions[np.argmax(np.where(valid, log_densities, -np.inf))]
        predictions = predictions - np.asarray(self.density.measurements.whole_periods(predictions - middle))
        deficit = np.max(log_densities[valid]) - log_densities[valid]
        weights = 1.0 / np.sqrt(1.0 + deficit / len(self.centre))
        # Use NumPy, because the number of runs grows from round to round.
        terms = self._terms(np, coordinates[valid])
        coefficients, *_ = np.linalg.lstsq(terms * weights[:, None], predictions[valid] * weights[:, None])
        return eqx.tree_at(lambda surrogate: surrogate.coefficients, self, jnp.asarray(coefficients))

    def recentred(
        self, coordinates: Float[np.ndarray, "draws unknowns"]
    ) -> tuple["Surrogate", Float[np.ndarray, "draws unknowns"]]:
        """A surrogate whose points are adapted to the given draws: in the new points, the distribution of the draws is
        nearly round. Also returns the new points of the draws.

        Along each principal axis of the draws, the widest first, the part that powers of the earlier points predict is
        subtracted.
        """
        centre = coordinates.mean(axis=0)
        axes = np.linalg.eigh(np.atleast_2d(np.cov(coordinates.T)))[1][:, ::-1]
        count, unknowns = coordinates.shape
        projection, points = (coordinates - centre) @ axes, np.zeros((count, unknowns))
        bends, shift = np.zeros((BENT, unknowns, unknowns)), np.zeros(unknowns)
        for k in range(unknowns):
            powers = np.concatenate([points[:, :k] ** (p + 1) for p in range(BENT)], axis=1)
            terms = np.concatenate([np.ones((count, 1)), powers], axis=1)
            coefficients, *_ = np.linalg.lstsq(terms, projection[:, k])
            remainder = projection[:, k] - terms @ coefficients
            bends[0, k, k], shift[k] = np.std(remainder), coefficients[0]
            points[:, k] = remainder / bends[0, k, k]
            bends[:, k, :k] = coefficients[1:].reshape(BENT, k)
        new = (centre + axes @ shift, axes @ bends)
        return eqx.tree_at(
            lambda surrogate: (surrogate.centre, surrogate.bends), self, tuple(map(jnp.asarray, new))
        ), points

    def to_power(self, power: float) -> "Surrogate":
        """The surrogate with another power of the density."""
        return eqx.tree_at(lambda surrogate: surrogate.power, self, jnp.asarray(power))

    def _terms(self, xp: Any, coordinates: Float[Any, "... unknowns"]) -> Float[Any, "... terms"]:
        """The terms of the polynomials. **Arguments:** `xp`: `numpy` or `jax.numpy`."""
        x = (coordinates[..., : len(self.origin)] - xp.asarray(self.origin)) @ xp.asarray(self.scale).T
        unit_column = xp.ones_like(x[..., :1])
        return xp.prod(xp.concatenate([unit_column, x], axis=-1)[..., _factors(len(self.origin))], axis=-1)


def _factors(numbers: int) -> np.ndarray:
    """The factors of each term of a polynomial as indices of numbers, (terms, degree); 0 stands for a factor of 1."""
    degree = next((d for d in range(HIGHEST, 2, -1) if math.comb(numbers + d, d) <= MOST_TERMS), 2)
    return np.array(list(itertools.combinations_with_replacement(range(numbers + 1), degree)))
