"""Refine candidates to minima by least squares, all together."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from .identifiability import coordinate_covariance
from .levenberg_marquardt import Ends, chosen, minimise
from .likelihood import Measurements, down_weighted, estimated_errors
from .mixture import Mixture
from .problem import Linearised, Problem, linearise

#: Unknown errors and parameters are estimated in turns, until no error changes by more than this fraction.
ROUNDS, SETTLED = 10, 0.01

#: The fractions of a recording that are fitted before the whole.
PARTS = (0.1, 0.25, 0.5)


#: The greatest numbers of steps in the fit of a recording: for each part, for the whole at once, and between its minima.
OF_PART, AT_ONCE, BETWEEN = 8, 15, 20

#: Greatest number of minima around which an exploration begins; how much worse than the best they may be, in -2 log
#: likelihood; and their least distance, in standard errors.
MOST_COMPONENTS, WORSE, APART = 8, 30.0, 1.0

#: By how much the proposals around a minimum are wider than its slopes suggest.
WIDER = 1.2


class Minima(NamedTuple):
    """The ends of least-squares fits, a row each.

    - `starts`, `coordinates`: (rows, unknowns), where each began and ended; `converged`: (rows,).
    - `linearised`: model and likelihood at the ends; `measurements`: with the errors that were estimated at the best end.
    """

    starts: Float[np.ndarray, "rows unknowns"]
    coordinates: Float[np.ndarray, "rows unknowns"]
    converged: Bool[np.ndarray, " rows"]
    linearised: Linearised
    measurements: Measurements

    @property
    def deviance(self) -> Float[np.ndarray, " rows"]:
        """-2 log likelihood at every end, infinite where the fit failed."""
        valid = np.any(np.isfinite(self.linearised.prediction), axis=1) & np.all(np.isfinite(self.coordinates), axis=1)
        deviance = self.linearised.deviance
        return np.where(valid & np.isfinite(deviance), deviance, np.inf)

    @property
    def best(self) -> int:
        """The row of the best end."""
        return int(np.argmin(self.deviance))

    def joined(self, other: "Minima") -> "Minima":
        """The best of the ends of two searches, as many as this one has."""
        rows = len(self.starts)
        order = np.argsort(np.concatenate([self.deviance, other.deviance]), kind="stable")[:rows]

        def in_order(mine: np.ndarray, others: np.ndarray) -> np.ndarray:
            return np.concatenate([mine, others])[order]

        mine, others = ((m.starts, m.coordinates, m.converged, m.linearised) for m in (self, other))
        starts, coordinates, converged, linearised = jax.tree.map(in_order, mine, others)
        return Minima(starts, coordinates, converged, linearised, self.measurements)

    def between(self) -> Float[np.ndarray, "rows unknowns"]:
        """Points between the best end and the others, and beyond it, the nearest first.

        Minima of periodic motions lie at equal distances: where two are known, there may be one in the middle, or at the
        same distance on the other side.
        """
        best = self.coordinates[self.best]
        likely = self.coordinates[
            self.deviance < np.min(self.deviance) + WORSE * self.linearised.residual.shape[1] / 10.0
        ]
        steps = likely - best
        covariance = self.covariance(self.best)
        errors = np.sqrt(np.where(np.isfinite(np.diag(covariance)), np.diag(covariance), 1.0))
        far = np.max(np.abs(steps) / errors, axis=1)
        steps = steps[np.argsort(far)][np.sort(far) > APART]
        points = [best + factor * step for step in steps for factor in (-1.0, 0.5, 2.0)]
        return np.stack([*points, *self.coordinates])[: len(self.starts)]

    def covariance(self, row: int) -> Float[np.ndarray, "unknowns unknowns"]:
        """The covariance of the coordinates by the slopes at an end."""
        return coordinate_covariance(self.linearised.whole_information[row])

    @property
    def components(self) -> Mixture | None:
        """A component of a proposal around every distinct end that is not much worse than the best; `None` if slopes
        determine no covariance."""
        deviance, centres, roots = self.deviance, [], []
        for row in np.argsort(deviance):
            if deviance[row] > np.min(deviance) + WORSE or len(centres) == MOST_COMPONENTS:
                break
            covariance = self.covariance(row)
            if not np.all(np.isfinite(covariance)):
                continue
            root, centre = np.linalg.cholesky(covariance), self.coordinates[row]
            distances = [np.linalg.norm(np.linalg.solve(root, centre - other)) for other in centres]
            if min(distances, default=np.inf) > APART:
                centres.append(centre)
                roots.append(WIDER * root)
        if not centres:
            return None
        return Mixture(np.full(len(centres), 1.0 / len(centres)), np.stack(centres), np.stack(roots))


class Refinement(NamedTuple):
    """How to refine.

    - `max_steps`, `progress`, `rows`: as for `minimise`.
    - `in_parts`: whether recordings are also fitted in stages, all rows of them.
    """

    max_steps: int
    progress: bool
    in_parts: bool = False
    rows: Any = None


def refine(problem: Problem, starts: Any, measurements: Measurements, options: Refinement) -> Minima:
    """Fit every row, and estimate unknown errors from the residuals of the best.

    **Arguments:** `starts`: coordinates, (rows, unknowns); the others as for `minimise`.
    """
    max_steps, progress, _, rows = options
    ends, at_ends = _fitted(problem, starts, measurements, options)
    for _ in range(ROUNDS if np.any(np.asarray(measurements.estimated)) else 0):
        best = int(np.argmin(at_ends.deviance))
        errors = estimated_errors(measurements, at_ends.prediction[best], len(problem.names))
        change = np.max(np.abs(np.log(errors / np.asarray(measurements.error))))
        measurements = measurements.with_errors(errors)
        if change > SETTLED:
            ends = minimise(problem, ends.coordinates, measurements, rows=rows, max_steps=max_steps, progress=progress)
        at_ends = linearise(problem, ends.coordinates, measurements)
        if change <= SETTLED:
            break
    return Minima(np.asarray(starts), ends.coordinates, ends.converged, at_ends, measurements)


def _fitted(problem: Problem, starts: Any, measurements: Measurements, options: Refinement) -> tuple[Ends, Linearised]:
    """The ends of the fits. Recordings are also fitted in stages, to longer and longer parts; the better of the two
    ends counts.

    Predicted late samples can be wrong by whole turns, and would then lead to another minimum.
    """
    max_steps, progress, in_parts, rows = options
    steps = min(max_steps, AT_ONCE) if in_parts else max_steps
    ends = minimise(problem, starts, measurements, rows=rows, max_steps=steps, progress=progress)
    at_ends = linearise(problem, ends.coordinates, measurements)
    duration = float(np.max(np.asarray(measurements.time)))
    if not (in_parts and duration > 0.0):
        return ends, at_ends
    coordinates = starts
    for part in PARTS:
        early_measurements = down_weighted(measurements, part * duration)
        coordinates = minimise(
            problem, coordinates, early_measurements, max_steps=min(max_steps, OF_PART), progress=progress
        ).coordinates
    ends_by_parts = minimise(problem, coordinates, measurements, max_steps=2 * steps, progress=progress)
    by_parts = linearise(problem, ends_by_parts.coordinates, measurements)
    improves = by_parts.deviance < at_ends.deviance
    better = functools.partial(chosen, improves)
    return jax.tree.map(better, ends_by_parts, ends), jax.tree.map(better, by_parts, at_ends)
