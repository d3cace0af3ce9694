"""Estimate parameters by maximum likelihood, with errors and undetermined combinations."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..progress import status_line
from ..validation import require, require_flag, require_whole, shown, warn
from .levenberg_marquardt import Ends, minimise
from .likelihood import Measurements, down_weighted, estimated_errors
from .problem import Linearised, Problem, linearise
from .result import Identification, summarise
from .unknown import as_free, draw_starts
from .verdict import FitWarning

#: Unknown errors and parameters are estimated in turns, until no error changes by more than this fraction.
ROUNDS, SETTLED = 10, 0.01

#: The fractions of a recording that are fitted before the whole.
PARTS = (0.1, 0.25, 0.5)

#: Step of differences in the coordinates: 1 % of a positive parameter. Differences smooth over narrower structure.
DIFFERENCE = 0.01


def identify(
    model: Callable[[dict[str, Any]], Any],
    measurements: Measurements,
    free: dict[str, Any],
    *,
    starts: int = 1,
    spread: float = 2.0,
    seed: int = 0,
    max_steps: int = 60,
    slopes: str = "exact",
    labels: tuple[str, ...] | None = None,
    progress: bool = True,
) -> Identification:
    """Find the parameters of a model that make measurements most likely.

    Levenberg-Marquardt runs from every start at once, on the residuals of the data (`likelihood.py`) and of the priors.
    It finds a local minimum near each start; the result is the best minimum and reports where the other starts ended.

    **Arguments:**

    - `model`: function from parameters, name -> (rows,), to predictions (rows, n); `jax.vmap` converts a function of
      one set of parameters. With exact `slopes`, JAX differentiates the model in forward mode.
    - `measurements`: `Measurements` of shape (n,).
    - `free`: name -> a `Free`, or only the start value.
    - `starts`: number of start points: the start values, and others drawn around them.
    - `spread`: range of the drawn points, as a factor greater than 1 in either direction; `seed`: seed of the draw.
    - `max_steps`: a fit that needs more steps has not converged.
    - `slopes`: "exact", by automatic differentiation; or "differences", central differences of 1 % in every parameter,
      for a model whose derivative does not exist or is not smooth. Each step then takes 2 k + 1 runs for k parameters.
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
    step, unknowns = step_of(slopes), as_free(free)
    if not isinstance(measurements, Measurements) or measurements.value.ndim != 1:
        raise ValueError(f"measurements = {shown(measurements)} must be Measurements of shape (n,)")
    count = measurements.value.size
    labels = tuple(f"#{i + 1}" for i in range(count)) if labels is None else tuple(labels)
    if len(labels) != count:
        raise ValueError(f"labels must be {count}, one for each measurement, not {len(labels)}")
    problem = Problem(model, tuple(unknowns.items()), step)
    with status_line("fitting", progress):
        start_points = draw_starts(unknowns, starts, spread, seed)
        ends, at_ends = _fitted(problem, start_points, measurements, max_steps, progress)
        for _ in range(ROUNDS if np.any(np.asarray(measurements.estimated)) else 0):
            best = int(np.argmin(at_ends.deviance))
            errors = estimated_errors(measurements, at_ends.prediction[best], len(unknowns))
            change = np.max(np.abs(np.log(errors / np.asarray(measurements.error))))
            measurements = measurements.with_errors(errors)
            if change > SETTLED:
                ends = minimise(problem, ends.coordinates, measurements, max_steps=max_steps, progress=progress)
            at_ends = linearise(problem, ends.coordinates, measurements)
            if change <= SETTLED:
                break
        if not np.any(np.isfinite(at_ends.prediction)):
            raise ValueError("model: no start led to finite predictions")
        result = summarise(problem, measurements, labels, start_points, ends.coordinates, ends.converged, at_ends)
    if not result.verdict.good:
        warn("; ".join(result.verdict.concerns), FitWarning)
    return result


def _fitted(
    problem: Problem, start_points: Any, measurements: Measurements, max_steps: int, progress: bool
) -> tuple[Ends, Linearised]:
    """The ends of the fits. Recordings are also fitted in stages, to longer and longer parts; the better of the two
    ends counts.

    Predicted late samples can be wrong by whole turns, and would then lead to another minimum.
    """
    ends = minimise(problem, start_points, measurements, max_steps=max_steps, progress=progress)
    at_ends = linearise(problem, ends.coordinates, measurements)
    duration = float(np.max(np.asarray(measurements.time)))
    if not duration > 0.0:
        return ends, at_ends
    coordinates = start_points
    for part in PARTS:
        early_measurements = down_weighted(measurements, part * duration)
        coordinates = minimise(
            problem, coordinates, early_measurements, max_steps=max_steps, progress=progress
        ).coordinates
    ends_by_parts = minimise(problem, coordinates, measurements, max_steps=max_steps, progress=progress)
    by_parts = linearise(problem, ends_by_parts.coordinates, measurements)
    improves = by_parts.deviance < at_ends.deviance

    def chosen(new: Any, old: Any) -> Any:
        return np.where(improves.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(chosen, ends_by_parts, ends), jax.tree.map(chosen, by_parts, at_ends)


def check_search(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> None:
    """Raise `ValueError` unless the arguments are legal for `identify`; a model checks them before it prepares its
    data."""
    for name, value, lower in (("starts", starts, 1), ("seed", seed, 0), ("max_steps", max_steps, 1)):
        require_whole(value, name, lower)
    require(spread, "spread", above=1.0)
    require_flag(progress, "progress")


def step_of(slopes: str) -> float | None:
    """The step of the differences for a kind of slopes; `None` for automatic differentiation.

    **Raises:** `ValueError` for an unknown kind.
    """
    ways = {"exact": None, "differences": DIFFERENCE}
    if slopes not in ways:
        raise ValueError(f"slopes = {shown(slopes)} must be one of {', '.join(map(repr, ways))}")
    return ways[slopes]
