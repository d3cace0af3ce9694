"""Which combinations of parameters the data determine, to first order."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .problem import Problem

#: Singular values below this fraction of the largest belong to directions that the data do not determine at all.
NO_SLOPE = 1e-7

#: A combination of parameters counts as undetermined if its relative error exceeds this.
UNSEEN = 1.0

#: Least share of a parameter that a combination lists.
LEAST_SHARE = 0.02


class Identifiability(NamedTuple):
    """The combinations of parameters that the data determine, and those that they do not determine, to first order and
    without priors.

    They come from the singular values of the slopes of the residuals with respect to relative changes: changes of the
    logarithm for a parameter that cannot be negative, otherwise changes in units of `Free.unit`.

    - `singular_values`: (unknowns,), decreasing; the inverse of a value is the relative error of its combination of
      parameters.
    - `directions`: (unknowns, unknowns), the combinations, one per row.
    - `words`: the combinations as text: which parameters change together, and by how much.
    """

    singular_values: Float[np.ndarray, " unknowns"]
    directions: Float[np.ndarray, "unknowns unknowns"]
    words: tuple[str, ...]

    @property
    def unseen(self) -> tuple[str, ...]:
        """The combinations whose errors exceed their own size."""
        least = max(1.0 / UNSEEN, NO_SLOPE * self.singular_values[0])
        return tuple(word for value, word in zip(self.singular_values, self.words, strict=True) if value < least)


def coordinate_covariance(jacobian: Float[np.ndarray, "residuals unknowns"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """The inverse of the Gauss-Newton matrix J^T J; infinite for unknowns that take part in an undetermined direction.

    To find these directions, every unknown is measured in units of its own error with the other unknowns held fixed.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    values, directions = _singular(jacobian / norms)
    seen = values > NO_SLOPE * max(values[0], 1e-300)
    covariance = (directions[seen].T / values[seen] ** 2) @ directions[seen] / np.outer(norms, norms)
    is_undetermined = np.any(np.abs(directions[~seen]) > 1e-6, axis=0)
    covariance[is_undetermined, :] = covariance[:, is_undetermined] = 0.0
    covariance[is_undetermined, is_undetermined] = np.inf
    return covariance


def _singular(slopes: Float[np.ndarray, "n unknowns"]) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and right singular vectors (one per row), as many as there are unknowns."""
    unknowns = slopes.shape[1]
    _, values, directions = np.linalg.svd(slopes, full_matrices=len(slopes) < unknowns)
    return np.concatenate([values, np.zeros(unknowns - len(values))]), directions


def identifiability(problem: Problem, estimates: Any, slopes: Any, jacobian: Any) -> Identifiability:
    """Singular values of the slopes of the residuals with respect to relative changes of the parameters, with their
    directions as text.

    **Arguments:** `estimates`: (unknowns,); `slopes`: (unknowns,), of the parameters with respect to their coordinates;
    `jacobian`: (n, unknowns), of the residuals with respect to the coordinates.
    """
    units = np.array(
        [abs(x) if unknown.positive else unknown.unit for x, unknown in zip(estimates, problem.unknowns, strict=True)]
    )
    relative = np.asarray(jacobian) * units / np.where(slopes == 0.0, 1.0, slopes)
    values, directions = _singular(relative)
    words = tuple(_in_words(problem, direction) for direction in directions)
    return Identifiability(values, directions, words)


def _in_words(problem: Problem, direction: Float[np.ndarray, " unknowns"]) -> str:
    """The parameters that change together: in per cent if a parameter cannot be negative, otherwise in hundredths of
    its unit."""
    largest = np.argmax(np.abs(direction))
    parts = []
    for share, (name, free) in zip(direction / direction[largest], problem.free, strict=True):
        if abs(share) >= LEAST_SHARE:
            parts.append(f"{name} {share:+.2g} %" if free.positive else f"{name} {0.01 * share * free.unit:+.2g}")
    return ", ".join(parts)
