"""How far an inversion time can be trusted, from two runs of its cell at different tolerances."""

import numpy as np
from jaxtyping import Bool, Float

#: Ratio of the second run's tolerance to the first one's. With a pair of eighth order it costs three quarters of the first.
COARSER = 10.0

#: Ratio of the estimate to the difference of the two runs. The error grows as the tolerance, so the difference is nine times
#: the first run's error; the rest is a margin for cells where the errors of the two runs happen to be close.
SAFETY = 2.0


def time_error(
    time: Float[np.ndarray, " cells"], coarse_time: Float[np.ndarray, " cells"], agreed: Bool[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """An estimate of the error of `time`, mostly twenty times the error itself (`tests/tippe/test_time_error.py`).

    **Arguments:**

    - `time`: times [s], infinite where there is none.
    - `coarse_time`: the same from a run whose tolerance is `COARSER` times as large.
    - `agreed`: where the two runs agree on what happened.

    **Returns:** the estimate [s]: infinite where the runs disagree, 0 where they agree that there is no time.
    """
    both = np.isfinite(time) & np.isfinite(coarse_time)
    known = np.where(both, time, 0.0)
    difference = np.abs(known - np.where(both, coarse_time, 0.0))
    # No time is known better than to its rounding.
    error = np.maximum(SAFETY * difference, np.finfo(time.dtype).eps * known)
    return np.where(agreed, error, np.inf)
