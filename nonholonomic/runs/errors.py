"""Error bounds for a table, from a second run of each cell at another tolerance."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Num

from ..integration.checks import TIGHTEST
from ..integration.settings import TIGHTEST_IN_SINGLE

#: Ratio of the tolerance of the first run to that of the second. With a pair of eighth order, the second run costs 1.8
#: times as much as the first. The error of the second run is a hundredth of that of the first, so the difference of the
#: runs is the error of the first. With a ratio of 10, three to five times as many errors exceed the bound. A second run
#: at ten times the tolerance, with a bound of twice the difference, is worse: at 1e-8, twenty times as many errors
#: exceed the bound, and a third of the bounds are more than 30 times the error.
FINER = 100.0

#: Ratio of the bound to the difference of the two runs. With a ratio of 3, twice as many errors exceed the bound.
SAFETY = 5.0

#: The ratio if the two runs differ in the number of flights or sticks. Such a run is chaotic: the difference is that of
#: two random histories, and up to 90 times smaller than the error.
SAFETY_OF_HISTORIES = 100.0

#: Least relative error of values that accumulate round-off over thousands of steps.
ROUND_OFF = 1e-14


def second_tolerance(tolerance: float) -> float:
    """Tolerance of the second run: a hundredth of that of the first run. If the integration allows no smaller
    tolerance, it is a hundred times that of the first run, and the bound is up to a hundred times wider."""
    fine_tolerance = tolerance / FINER
    tightest = TIGHTEST if jnp.result_type(float) == jnp.float64 else TIGHTEST_IN_SINGLE
    # Because of rounding, the quotient of 1e-12 may be below the least tolerance.
    return max(fine_tolerance, tightest) if fine_tolerance > 0.99 * tightest else tolerance * FINER


def error_bound(
    value: Float[np.ndarray, " cells"],
    second: Float[np.ndarray, " cells"],
    agree: Bool[np.ndarray, " cells"],
    same_history: Bool[np.ndarray, " cells"],
) -> Float[np.ndarray, " cells"]:
    """A bound of the error of a number. `docs/validation.md` lists how often the bound fails and how wide it is.

    **Arguments:**

    - `value`: times [s], infinite if there is no event, or other numbers.
    - `second`: the numbers from the second run.
    - `agree`: mask of the cells in which the two runs have the same status.
    - `same_history`: mask of the cells in which the numbers of all kinds of events agree.

    **Returns:** the bound, in units of the value: infinite if the runs disagree, 0 if both find no time.
    """
    agree = agree & (np.isfinite(value) == np.isfinite(second))
    is_finite = np.isfinite(value) & np.isfinite(second)
    finite_value = np.where(is_finite, value, 0.0)
    difference = np.abs(finite_value - np.where(is_finite, second, 0.0))
    bound = np.where(same_history, SAFETY, SAFETY_OF_HISTORIES) * difference
    return np.where(agree, np.maximum(bound, ROUND_OFF * np.abs(finite_value)), np.inf)


def errors_of(
    first: dict[str, Num[np.ndarray, " cells"]],
    second: dict[str, Num[np.ndarray, " cells"]],
    bounded: tuple[str, ...],
    counts: tuple[str, ...],
    silent: tuple[int, ...],
) -> dict[str, Num[np.ndarray, " cells"]]:
    """The additional variables of a table with errors; their names have the suffix "_error".

    **Arguments:**

    - `first`, `second`: the variables of the two runs of every cell.
    - `bounded`, `counts`: names of the variables that get bounds, and of those that count events.
    - `silent`: status codes of runs without a result; two such runs count as disagreeing.

    **Returns:** bounds; for each count the difference of the runs; and 1 as
    `status_error` if the runs disagree on the status or one is silent.
    """
    agree = (first["status"] == second["status"]) & ~np.isin(first["status"], silent)
    differences = {name: np.abs(first[name] - second[name]) for name in counts}
    is_same = np.all([np.ones_like(agree), *(difference == 0 for difference in differences.values())], axis=0)
    bounds = {name: error_bound(first[name], second[name], agree, is_same) for name in bounded}
    errors = bounds | {"status": (~agree).astype(np.int8)} | differences
    return {f"{name}_error": np.asarray(error) for name, error in errors.items()}
