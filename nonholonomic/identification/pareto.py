"""Pareto-smoothed importance weights (Vehtari, Simpson, Gelman, Yao and Gabry, J. Mach. Learn. Res. 25 (2024) 72)."""

import numpy as np
from jaxtyping import Float


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
