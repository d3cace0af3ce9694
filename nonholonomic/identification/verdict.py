"""Judge a fit: the size and order of its residuals, the minima that the data allow, and the undetermined combinations."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .likelihood import Measurements

#: A p-value below this is a poor fit.
POOR = 0.01

#: A measurement with a larger residual cannot be explained.
FAR = 4.0

#: Residuals that are all smaller than this are not noise but round-off and integration errors, which may keep their
#: sign.
NEGLIGIBLE = 1e-3

#: Ends whose -2 log likelihoods differ by less than this are the same minimum.
SAME = 0.1

#: Ends agree on a minimum if all their parameters agree to this many standard errors.
CLOSE = 0.5


class FitWarning(UserWarning):
    """A fit that should not be believed without further checks.

    **Example:** make doubtful fits fail.

    ```
    >>> import warnings
    >>> import tippe
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", tippe.FitWarning)

    ```
    """


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
    notes: tuple[str, ...]
    effective: float
    k: float
    minima: tuple[Any, ...]

    @property
    def good(self) -> bool:
        """Whether there are no concerns about the fit."""
        return not self.concerns

    def __str__(self) -> str:
        scatter = (
            "the size of the residuals cannot test the fit: the errors were estimated from it, or no degree of freedom is left"
            if math.isnan(self.p_value)
            else f"residuals this large have a probability of {self.p_value:.2g}"
        )
        signs = ", ".join(
            f"{series.runs} runs of {series.count} signs (p = {series.p_value:.2g})" for series in self.series
        )
        ended = f"{self.agree} of {self.starts} refined candidates ended at the best minimum"
        others = ", the others fit worse or were stopped early" if self.agree < self.starts else ""
        lines = [f"  {scatter}", f"  {signs}" if signs else "", f"  {ended}{others}"]
        lines.append(f"  errors from {self.effective:.0f} effective draws (k-hat {self.k:.2f})")
        lines += [f"  note: {note}" for note in self.notes]
        return "\n".join([*filter(None, lines), *(f"  BUT {concern}" for concern in self.concerns)])


def judge(
    measurements: Measurements,
    prediction: Float[np.ndarray, " n"],
    residual: Float[np.ndarray, " n"],
    degrees: int,
    status: str,
    trusted: bool,
    explored: Verdict,
) -> Verdict:
    """Judge a fit.

    **Arguments:**

    - `measurements`, `prediction`, `residual`: (n,).
    - `degrees`: measurements and priors less unknowns, without limits.
    - `status`: status of the fit; `trusted`: whether the weights can be trusted.
    - `explored`: the `Verdict` by the exploration alone, whose concerns are about the shape of the likelihood.

    **Returns:** a `Verdict`.
    """
    scores = normal_scores(measurements, prediction)
    exact = ~np.asarray(measurements.censored)
    estimated = bool(np.any(np.asarray(measurements.estimated)))
    p_value = math.nan if estimated or degrees < 1 else chi_squared_tail(float(np.sum(scores[exact] ** 2)), degrees)
    numbers = np.asarray(measurements.series)
    parts = [scores[exact & (numbers == number)] for number in np.unique(numbers)]
    series = tuple(runs for runs in map(runs_of_signs, parts) if runs.count > 1)
    p_values = [runs_of_signs(part).p_value for part in parts if np.any(np.abs(part) > NEGLIGIBLE)]
    limits = np.abs(residual[~exact])
    concerns = _concerns_of_search(status, trusted, explored)
    if not np.all(np.isfinite(prediction[exact])):
        missing = int(np.sum(~np.isfinite(prediction[exact])))
        concerns.append(f"the model has no prediction for {missing} measurements: its run ends earlier, or fails")
    if p_value < POOR:
        concerns.append(
            f"the residuals are too large (p = {p_value:.2g}): the model is wrong, the errors are too small, "
            "or this is not the best minimum"
        )
    if np.any(limits > FAR):
        concerns.append(f"{int(np.sum(limits > FAR))} limits are violated by more than {FAR:.0f} errors")
    p_trend = min(p_values, default=1.0) * max(len(p_values), 1)
    if p_trend < POOR:
        concerns.append(
            f"the residuals keep their sign for too long (p = {p_trend:.2g}): the model misses a trend, or "
            "errors are correlated"
        )
    concerns += [*explored.concerns, *(f"the data do not determine {words}" for words in explored.undetermined)]
    return explored._replace(p_value=p_value, series=series, concerns=tuple(concerns))


def _concerns_of_search(status: str, trusted: bool, explored: Verdict) -> list[str]:
    """The concerns about the search and the weights."""
    concerns = []
    if status != "converged":
        concerns.append("the fit has not converged: allow more steps (max_steps), or start closer")
    if not trusted:
        concerns.append(
            f"there are no errors and intervals: the exploration ended with {explored.effective:.0f} effective draws "
            f"(k-hat {explored.k:.2f}); start closer, give bounds or priors, or fix numbers"
        )
    if len(explored.minima) > 1:
        concerns.append(f"the data allow {len(explored.minima)} minima: " + "; ".join(map(str, explored.minima)))
    return concerns


def normal_scores(measurements: Measurements, prediction: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Residuals converted to numbers that are normal if the stated errors are right; 0 for limits."""
    from scipy.stats import norm, t

    z = np.asarray(measurements.standardised(np.asarray(prediction)))
    freedom = np.asarray(measurements.student)
    heavy = np.isfinite(freedom)
    return np.where(heavy, np.sign(z) * norm.isf(t.sf(np.abs(z), np.where(heavy, freedom, 1.0))), z)


def chi_squared_tail(value: float, degrees: int) -> float:
    """The probability that chi squared exceeds a value."""
    from scipy.stats import chi2

    return float(chi2.sf(value, degrees)) if math.isfinite(value) else 0.0


def runs_of_signs(values: Float[np.ndarray, " n"]) -> Series:
    """The number of runs of one sign in a series, and the probability of at most so many runs (Wald and Wolfowitz, Ann.
    Math. Stat. 11 (1940) 147).

    If the numbers of positive and negative values are given, the number of runs of one sign has a hypergeometric
    distribution; the probability is summed exactly.
    """
    from scipy.special import gammaln

    signs = np.sign(values[np.isfinite(values) & (values != 0.0)])
    positive, negative = int(np.sum(signs > 0.0)), int(np.sum(signs < 0.0))
    runs = 1 + int(np.sum(signs[1:] != signs[:-1])) if len(signs) else 0
    if not positive or not negative:
        # All of one sign: as improbable as a coin that always shows the same side.
        return Series(len(signs), runs, min(1.0, 2.0 ** (1 - len(signs))) if len(signs) else 1.0)

    def log_choose(n: int, k: np.ndarray) -> np.ndarray:
        is_valid = (k >= 0) & (k <= n)
        k_valid = np.where(is_valid, k, 0)
        return np.where(is_valid, gammaln(n + 1.0) - gammaln(k_valid + 1.0) - gammaln(n - k_valid + 1.0), -np.inf)

    # For r runs, the positive signs are cut into r // 2 runs and the negative ones into r - r // 2, or the other way
    # round.
    counts = np.arange(2, runs + 1)
    few_cuts, many_cuts = counts // 2 - 1, counts - counts // 2 - 1
    total = log_choose(positive + negative, np.array(positive))
    ways = [
        log_choose(a - 1, few_cuts) + log_choose(b - 1, many_cuts)
        for a, b in ((positive, negative), (negative, positive))
    ]
    return Series(len(signs), runs, min(1.0, float(np.sum(np.exp(np.array(ways) - total)))))
