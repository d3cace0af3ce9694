"""Estimate parameters by maximum likelihood, with errors and undetermined combinations."""

from collections.abc import Callable
from typing import Any

from ..progress import status_line
from ..validation import require, require_flag, require_scalars, require_whole, shown
from ..warning import warn
from .exploration import ROWS, Explorer
from .likelihood import Measurements
from .posterior import LogDensity
from .result import Identification, summarise
from .search import search
from .unknown import as_free
from .verdict import FitWarning


def identify(
    model: Callable[[dict[str, Any]], Any],
    measurements: Measurements,
    free: dict[str, Any],
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    max_steps: int = 60,
    slopes: str = "exact",
    labels: tuple[str, ...] | None = None,
    progress: bool = True,
) -> Identification:
    """Find the parameters of a model that make measurements most likely, and how far the measurements determine them.

    The search has three steps, all in batches. It compares hundreds of quasi-random candidates in a region around the start
    values (`region.py`), refines the best by Levenberg-Marquardt (`refinement.py`), and explores the likelihood around all
    minima by adaptive importance sampling (`exploration.py`), until errors and intervals rest on at least 400 effective
    draws. Slopes make the search fast; they do not enter errors and intervals unless the likelihood is that of a linear
    model.

    **Arguments:**

    - `model`: function from parameters, name -> (rows,), to predictions (rows, n); `jax.vmap` converts a function of
      one set of parameters. With exact `slopes`, JAX differentiates the model in forward mode. A row of NaN may give NaN.
    - `measurements`: `Measurements` of shape (n,).
    - `free`: name -> a `Free`, or only the start value.
    - `starts`: number of candidates that are refined.
    - `spread`: how far from its start value an unknown with one bound is searched, as a factor greater than 1 in either
      direction. Priors and two bounds take precedence. A number of a launch is searched within 10 %, and `t0` within 2 % of
      the duration of the recording. Refinement and exploration may leave this region.
    - `seed`: seed of candidates and draws.
    - `max_steps`: a refinement that needs more steps has not converged.
    - `slopes`: "exact", by automatic differentiation; or "differences", central differences in every parameter (of 1 %,
      for recordings of 0.03 %), for a model whose derivative does not exist or is not smooth. Errors and intervals are the
      same.
    - `labels`: (n,), names of the measurements in the result.
    - `progress`: whether to show progress, on a terminal or in a notebook.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range.

    **Example:** the half-life of a decay.

    >>> import numpy as np
    >>> from nonholonomic.identification import Measurements, identify
    >>> times = np.array([1.0, 2.0, 3.0, 4.0])
    >>> counts = Measurements([505.0, 248.0, 127.0, 61.0], [22.0, 16.0, 11.0, 8.0])
    >>> def model(p):
    ...     return p["start"][:, None] * 0.5 ** (times / p["half_life"][:, None])
    >>> fit = identify(model, counts, {"start": 800.0, "half_life": 1.5}, progress=False)
    >>> print(f"{fit.estimates['half_life']:.2f} +- {fit.standard_errors['half_life']:.2f}, good: {fit.verdict.good}")
    0.99 +- 0.05, good: True
    """
    check_search(starts, spread, seed, max_steps, progress)
    unknowns = as_free(free)
    if not isinstance(measurements, Measurements) or measurements.value.ndim != 1:
        raise ValueError(f"measurements = {shown(measurements)} must be Measurements of shape (n,)")
    count = measurements.value.size
    labels = tuple(f"#{i + 1}" for i in range(count)) if labels is None else tuple(labels)
    if len(labels) != count:
        raise ValueError(f"labels must be {count}, one for each measurement, not {len(labels)}")
    with status_line("fitting", progress):
        density = LogDensity.of(model, measurements, unknowns, slopes=slopes)
        explorer = Explorer.of(density, unknowns, spread, seed)
        explorer, minima, sample = search(explorer, starts, max_steps, seed, progress)
        result = summarise(explorer.density.problem, labels, minima, explorer, sample)
    if not result.verdict.good:
        warn("; ".join(result.verdict.concerns), FitWarning)
    return result


def check_search(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> None:
    """Raise `ValueError` unless the arguments are legal for `identify`; a model checks them before it prepares its
    data."""
    for name, value, lower in (("starts", starts, 1), ("seed", seed, 0), ("max_steps", max_steps, 1)):
        require_whole(value, name, lower)
    if starts > ROWS:
        raise ValueError(f"starts = {starts} must be at most {ROWS}, the number of candidates")
    require(spread, "spread", above=1.0)
    require_scalars({"spread": spread}, "it spreads the starts of all parameters")
    require_flag(progress, "progress")
