"""Uniform cubic B-splines: a function of time with two continuous derivatives, from a row of coefficients.

A spline with n coefficients has n - 3 intervals; between two knots it depends on four coefficients (de Boor, A Practical
Guide to Splines (2001), chapter X).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

#: Number of coefficients on which an interval depends.
ORDER = 4


def basis(u: Any) -> tuple[Any, Any, Any]:
    """The weights of an interval's four coefficients at a part `u` of it, in [0, 1], and their first and second
    derivatives: each a list of four."""
    v = 1.0 - u
    value = [v**3 / 6.0, (3.0 * u**3 - 6.0 * u**2 + 4.0) / 6.0, (3.0 * v**3 - 6.0 * v**2 + 4.0) / 6.0, u**3 / 6.0]
    slope = [-(v**2) / 2.0, (3.0 * u**2 - 4.0 * u) / 2.0, -(3.0 * v**2 - 4.0 * v) / 2.0, u**2 / 2.0]
    bend = [v, 3.0 * u - 2.0, 3.0 * v - 2.0, u]
    return value, slope, bend


def weighted(weights: list[Any], coefficients: Any) -> Any:
    """The sum of four coefficients, along axis 0, with weights."""
    return sum(weight * coefficients[k] for k, weight in enumerate(weights))


# Every run of a plan traces its input several times; `jit` keeps the trace.
@partial(jax.jit, static_argnames="derivative", inline=True)
def evaluate(coefficients: Any, part: Any, derivative: int = 0) -> Any:
    """The value of a spline, or of its derivative, at parts of its whole length, held constant beyond its ends.

    Derivatives are with respect to the number of intervals passed.
    """
    intervals = len(coefficients) - ORDER + 1
    position = jnp.clip(part, 0.0, 1.0) * intervals
    first = jnp.clip(jnp.floor(position), 0, intervals - 1).astype(int)
    return weighted(basis(position - first)[derivative], [coefficients[first + k] for k in range(ORDER)])


def interpolate(values: np.ndarray) -> np.ndarray:
    """Coefficients of the spline through values (knots, ...) at its knots, without curvature at the ends."""
    count = len(values) + 2
    # The diagonals of the matrix, from the second above to the second below.
    diagonals = np.zeros((5, count))
    diagonals[1:4, :] = np.array([[1.0], [4.0], [1.0]]) / 6.0
    diagonals[2, 0], diagonals[1, 1], diagonals[0, 2] = 1.0, -2.0, 1.0
    diagonals[2, -1], diagonals[3, -2], diagonals[4, -3] = 1.0, -2.0, 1.0
    ends = np.zeros_like(values[:1])
    return scipy.linalg.solve_banded((2, 2), diagonals, np.concatenate([ends, values, ends]))
