"""The likelihood of measurements whose errors are unknown: the mean over the errors, with a flat prior of their
logarithms."""

import numpy as np
from jaxtyping import Float

from .likelihood import Measurements, whole_periods
from .problem import compared

#: Number of values of the logarithm of an error, and their range in units of 1 / sqrt(2 n) for n values.
GRID, RANGE = 33, 6.0


def log_likelihoods(
    measurements: Measurements, prediction: Float[np.ndarray, "rows n"]
) -> tuple[Float[np.ndarray, "rows n"], Float[np.ndarray, " rows"]]:
    """Two log likelihoods of every row, up to constants.

    **Returns:** the contribution of every measurement with its stated or guessed error; and the log likelihood of all
    measurements, averaged over the errors that are unknown.
    """
    residual = compared(measurements, prediction)[0]
    each = -0.5 * residual**2
    estimated = np.asarray(measurements.estimated) & ~np.asarray(measurements.censored)
    total = np.sum(each[:, ~estimated], axis=1)
    for scales, logs in _by_error(measurements, prediction, residual, estimated):
        total = total + np.logaddexp.reduce(logs, axis=1) + np.log(scales[:, 1] - scales[:, 0])
    return each, total


def draw_errors(
    measurements: Measurements, prediction: Float[np.ndarray, "rows n"], random: np.random.Generator
) -> Float[np.ndarray, "rows series"]:
    """Logarithms of the unknown errors in units of their guesses, drawn from their distribution for given predictions."""
    residual = compared(measurements, prediction)[0]
    estimated = np.asarray(measurements.estimated) & ~np.asarray(measurements.censored)
    columns = [np.zeros((len(prediction), 0))]
    for scales, logs in _by_error(measurements, prediction, residual, estimated):
        cumulative = np.cumsum(np.exp(logs - np.max(logs, axis=1, keepdims=True)), axis=1)
        share = random.uniform(size=len(scales)) * cumulative[:, -1]
        column = [np.interp(s, c, scale) for s, c, scale in zip(share, cumulative, scales, strict=True)]
        columns.append(np.array(column)[:, None])
    return np.concatenate(columns, axis=1)


def _by_error(measurements: Measurements, prediction: np.ndarray, residual: np.ndarray, estimated: np.ndarray):
    """For each series of unknown error: logarithms of the error in units of its guess (rows, grid), and the log likelihood
    there."""
    if not np.any(estimated):
        return
    series, freedom = np.asarray(measurements.series), np.asarray(measurements.student)
    difference = np.where(estimated, prediction - np.where(estimated, measurements.value, 0.0), 0.0)
    period = np.asarray(measurements.period)
    difference = (difference - whole_periods(np, difference, period)) / np.asarray(measurements.error)
    for number in np.unique(series[estimated]):
        members = (series == number) & estimated
        z = np.where(np.isfinite(difference[:, members]), difference[:, members], residual[:, members])
        count, nu = z.shape[1], freedom[members][0]
        scale = np.sqrt(np.mean(z**2, axis=1)) + 1e-150
        if np.isfinite(nu):
            for _ in range(20):
                weight = (nu + 1.0) / (nu + (z / scale[:, None]) ** 2)
                scale = np.sqrt(np.mean(weight * z**2, axis=1)) + 1e-150
        reach = RANGE / np.sqrt(2.0 * count)
        scales = np.log(scale)[:, None] + np.linspace(-reach, 2.0 * reach, GRID)
        logs = np.empty(scales.shape)
        for k in range(GRID):
            squares = (z / np.exp(scales[:, k : k + 1])) ** 2
            terms = (nu + 1.0) * np.log1p(squares / nu) if np.isfinite(nu) else squares
            logs[:, k] = -0.5 * np.sum(terms, axis=1) - count * scales[:, k]
        yield scales, logs
