"""The region in which a fit looks for minima: a box in the coordinates of the unknowns."""

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .data import own_name
from .unknown import Free

#: Half width of the searched range of a number of a launch or a start, as a fraction of its start value: such numbers
#: were measured or set.
OF_LAUNCH = 0.1

#: Half width of the searched range of `t0`, as a fraction of the duration of the recordings.
OF_DURATION = 0.02

#: A prior is searched to this many standard deviations.
DEVIATIONS = 3.0

#: Width of the soft edge of the box, in half widths.
EDGE = 0.25

#: Weights are 0 farther from the start than this many half widths: a factor of 2^10 for a positive number.
FARTHEST = 10.0


class Region(NamedTuple):
    """A box in the coordinates: the middle and the half widths of the search, each (unknowns,)."""

    middle: Float[np.ndarray, " unknowns"]
    half_width: Float[np.ndarray, " unknowns"]

    def points(self, count: int, seed: int) -> Float[np.ndarray, "count unknowns"]:
        """Quasi-random points that fill the box, `count` a power of two; the first is the middle."""
        from scipy.stats import qmc

        # SciPy 1.15 renamed the argument, and accepts both names.
        options: dict[str, Any] = {"seed": seed}
        unit = qmc.Sobol(len(self.middle), **options).random(count)
        unit[0] = 0.5
        return self.middle + (2.0 * unit - 1.0) * self.half_width

    def log_density(self, points: Float[np.ndarray, "n unknowns"]) -> Float[np.ndarray, " n"]:
        """The log density of points that are uniform in the box."""
        inside = np.all(np.abs(points - self.middle) <= self.half_width, axis=1)
        return np.where(inside, -np.sum(np.log(2.0 * self.half_width)), -np.inf)

    def log_weight(self, points: Float[np.ndarray, "n unknowns"]) -> Float[np.ndarray, " n"]:
        """0 in the box; outside, less with the square of the distance."""
        beyond = (np.abs(points - self.middle) / self.half_width - 1.0).clip(0.0)
        return -0.5 * np.sum((beyond / EDGE) ** 2, axis=1)

    def searched(self, points: Float[np.ndarray, "*n unknowns"]) -> Bool[np.ndarray, "*n unknowns"]:
        """Which coordinates are within the box."""
        return np.abs(points - self.middle) <= self.half_width

    def contains(self, points: Float[np.ndarray, "n unknowns"]) -> np.ndarray:
        """Which points are near enough for a weight."""
        return np.all(np.abs(points - self.middle) <= FARTHEST * self.half_width, axis=1)


def region_of(free: dict[str, Free], spread: float, duration: float) -> Region:
    """The region of the search.

    The range of an unknown is, by the first of these rules that applies:

    - between two bounds: the whole range;
    - with a prior: `DEVIATIONS` standard deviations around its mean, within the bounds;
    - `t0`: `OF_DURATION` of the longest recording around the start value, in both directions;
    - a number of a launch or a start: `OF_LAUNCH` of the start value (0.1 where it is 0) in both directions, within the
      bounds;
    - with one bound: a factor `spread` of the distance from the bound in both directions;
    - any other number: `spread` - 1 times the start value (or 1 where it is 0) in both directions.

    **Arguments:** `free`: name -> a `Free`; `spread`: greater than 1; `duration`: of the longest recording [s], 0 if there is
    none.

    **Returns:** a `Region`, centred on the start values except for the first two rules.
    """
    ends = np.array([_ends(name, unknown, spread, duration) for name, unknown in free.items()])
    return Region(np.mean(ends, axis=1), 0.5 * np.ptp(ends, axis=1))


def _ends(name: str, unknown: Free, spread: float, duration: float) -> tuple[float, float]:
    """The ends of the range of one coordinate."""
    bounded = math.isfinite(unknown.lower), math.isfinite(unknown.upper)
    start = float(unknown.coordinate(unknown.start))
    if all(bounded) and unknown.prior is None:
        return -5.0, 5.0
    kind = own_name(name)
    if unknown.gaussian is not None:
        middle, reach = unknown.gaussian[0], DEVIATIONS * unknown.gaussian[1]
    elif kind == "t0" and duration > 0.0:
        middle, reach = unknown.start, OF_DURATION * duration
    elif kind.startswith(("launch", "start")):
        middle, reach = unknown.start, OF_LAUNCH * (abs(unknown.start) or 1.0)
    elif any(bounded):
        return start - math.log(spread), start + math.log(spread)
    else:
        return start - (spread - 1.0), start + (spread - 1.0)
    # Stay away from the bounds, where coordinates are infinite.
    margin = 0.05 * reach
    low, high = max(middle - reach, unknown.lower + margin), min(middle + reach, unknown.upper - margin)
    return float(unknown.coordinate(low)), float(unknown.coordinate(max(high, low + margin)))
