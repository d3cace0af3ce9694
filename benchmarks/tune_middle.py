"""Compute `MIDDLE` of both pairs in `runge_kutta.py`: weights of the state in the middle of a step.

    python benchmarks/tune_middle.py

The state in the middle of a step is y + h (weighted sum of the stages and of the field at the end) + h^2 (weighted sum of
the second derivatives at the start and at the end). The order conditions up to order 7 determine all weights but one; the
remaining weight minimises the squares of the errors in eighth order. Samples inside steps need these weights. The script
prints them and the largest errors.
"""

from typing import Any

import numpy as np
import scipy.linalg
from tuning.trees import error_coefficients

from nonholonomic.integration import Oscillatory8, Stabilized8

#: The stages with a weight: those whose errors are small, and the field at the end of the step.
WEIGHTED = np.array([0, *range(5, 14)])


def stages(pair: Any) -> np.ndarray:
    """The weights of the earlier stages in each stage of a pair; the last stage is the end of the step."""
    rows = pair.tableau.a_lower
    padded = [np.zeros(len(rows) + 1), *(np.pad(row, (0, len(rows) + 1 - len(row))) for row in rows)]
    return np.array(padded, dtype=np.longdouble)


def errors(pair: Any, weights: np.ndarray, order: int) -> np.ndarray:
    """The error coefficients of the state in the middle, whose exact coefficients are 2^-order times those at the end."""
    weights = weights.astype(np.longdouble)
    of_stages = error_coefficients(stages(pair), weights[:14], order)
    of_solution = -error_coefficients(stages(pair), np.zeros_like(weights[:14]), order)
    second_at_start = 2.0 * weights[14] if order == 2 else 0.0
    second_at_end = order * (order - 1) * weights[15]
    return of_stages + of_solution * (1.0 - 0.5**order + second_at_start + second_at_end)


def middle_weights(pair: Any) -> np.ndarray:
    """The weights, 0 for the stages that are not used."""
    used = [*WEIGHTED, 14, 15]

    def conditions(orders: range) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and right side of the conditions, which are linear in the weights."""

        def of_all(weights: np.ndarray) -> np.ndarray:
            return np.concatenate([errors(pair, weights, order) for order in orders])

        rest = of_all(np.zeros(16))
        return np.stack([of_all(np.eye(16)[k]) - rest for k in used], axis=1), -rest

    matrix, right = conditions(range(1, 8))
    next_matrix, next_right = conditions(range(8, 9))

    def solution(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(matrix.astype(float), right.astype(float), rcond=1e-12)[0]

    # The conditions magnify round-off: in extended precision, each solution is corrected by that for what it leaves.
    free = scipy.linalg.null_space(matrix.astype(float), rcond=1e-12).astype(np.longdouble)
    weights = np.zeros(len(used), dtype=np.longdouble)
    for _ in range(3):
        free -= solution(matrix, matrix @ free)
        weights += solution(matrix, right - matrix @ weights)
        weights += free @ solution(next_matrix @ free, next_right - next_matrix @ weights)
    middle = np.zeros(16)
    middle[used] = weights
    return middle


def main() -> None:
    """Compute and print."""
    for pair in (Oscillatory8, Stabilized8):
        weights = middle_weights(pair)
        print(pair.__name__, *(f"{weight:.18g}," for weight in weights), sep="\n")
        for order in range(1, 9):
            print(f"order {order}: largest error coefficient {np.max(np.abs(errors(pair, weights, order))):.1e}")


if __name__ == "__main__":
    main()
