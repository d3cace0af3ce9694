"""Refine candidates to minima by least squares, all together, and find the combinations that the data determine.

Each row is a fit. All rows advance together, and the model is evaluated for all of them, with its slopes, in one call,
so a model that computes its cases as lanes computes the cases of all rows together. Optimistix under `vmap` compiles
the model twice, with slopes and without, and continues to evaluate finished rows.

Source: Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems", 2nd edition (2004), section 3.2; the
scaling is More's (Lecture Notes in Mathematics 630 (1978) 105).
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..terminal import Progress
from .exploration import Mixture
from .likelihood import Measurements, down_weighted, estimated_errors
from .posterior import Linearised, Problem, linearise

#: Damping of the first step, as a fraction of the squared slope with respect to each coordinate.
FIRST_DAMPING = 1e-2

#: After a step that gains more than this fraction of the predicted gain, damping decreases by the factor `EASED`; a
#: step that gains nothing is undone and repeated with damping increased by the factor `HARDENED`.
GOOD, EASED, HARDENED = 0.5, 0.1, 4.0

#: A fit has converged if an undamped step would lower -2 log likelihood by no more than this.
CONVERGED = 1e-16

#: A fit has also converged if a step gains nothing and an undamped step would lower -2 log likelihood by no more than
#: this: it is as close as the integration errors allow, within a thirtieth of a standard error of the minimum.
NEGLIGIBLE = 1e-3

#: Where the predictions jump like a staircase, every step gains very little. A fit has also converged if `PATIENCE`
#: steps together lower -2 log likelihood by less than `STALLED`, or, for a bad fit, by less than this fraction of its
#: excess over `BAD` per degree of freedom.
PATIENCE, STALLED, BAD = 8, 1e-2, 3.0

#: No step changes a parameter with a bound by more than a factor of e: slopes are not valid farther away, where runs
#: may also take thousands of times as long.
FARTHEST = 1.0

#: Singular values of a row's slopes below this fraction of the largest are round-off.
ROUND_OFF = 1e-7


class Ends(NamedTuple):
    """The ends of the rows: coordinates (rows, unknowns), whether each converged, and its number of steps."""

    coordinates: Float[np.ndarray, "rows unknowns"]
    converged: Bool[np.ndarray, " rows"]
    steps: Int[np.ndarray, " rows"]


def minimise(
    problem: Problem,
    starts: Any,
    measurements: Measurements,
    *,
    fixed: int | None = None,
    rows: Any = None,
    max_steps: int = 60,
    progress: bool = False,
) -> Ends:
    """Fit every row.

    **Arguments:**

    - `problem`: the `Problem`.
    - `starts`: coordinates, (rows, unknowns).
    - `measurements`: (n,), the same for all rows, or (rows, n).
    - `fixed`: index of an unknown that keeps its start value, or `None`.
    - `rows`: (rows,), which of the rows to fit, by default all; the others stay at their starts.
    - `max_steps`: a row that needs more steps has not converged.
    - `progress`: whether to show, on a terminal or in a notebook, how many rows are done.

    **Returns:** the `Ends`.
    """
    coordinates = np.array(starts, float)
    count, unknowns = coordinates.shape
    measurements = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, leaf.shape[-1])), measurements)
    moving = np.array([k for k in range(unknowns) if k != fixed], int)
    bounded = [unknown.has_lower or unknown.has_upper for unknown in problem.unknowns]
    reach = np.where(bounded, FARTHEST, np.inf)[moving]
    done = np.zeros(count, bool) if rows is None else ~np.asarray(rows)
    has_converged, steps = np.zeros(count, bool), np.zeros(count, int)
    with Progress(int(np.sum(~done)), "fit", shown=progress) as display:
        current = _Fit.of(linearise(problem, coordinates, measurements), moving)
        display.begin()
        scale, damping = np.zeros((count, len(moving))), np.full(count, FIRST_DAMPING)
        free = max(current.residual.shape[1] - len(moving), 1)
        history = [current.deviance]
        has_converged |= ~done & (_promise(current) < CONVERGED)
        done |= has_converged
        for step in range(1, max_steps + 1):
            if done.all():
                break
            scale = np.maximum(scale, np.sum(current.jacobian**2, axis=1))
            move, predicted_gain = _step(current, scale, damping, reach)
            trial_coordinates = coordinates.copy()
            trial_coordinates[:, moving] += move
            trial = _Fit.of(linearise(problem, trial_coordinates, measurements, ~done), moving)
            gain = current.deviance - trial.deviance
            improves = ~done & (gain > 0.0)
            damping = np.where(improves, np.where(gain > GOOD * predicted_gain, EASED, 1.0), HARDENED) * damping
            coordinates[improves] = trial_coordinates[improves]
            current = _Fit(*(chosen(improves, new, old) for new, old in zip(trial, current, strict=True)))
            history.append(current.deviance)
            steps[~done] = step
            remaining_gain = _promise(current)
            ended = (remaining_gain < CONVERGED) | (~improves & (remaining_gain < NEGLIGIBLE))
            if step >= PATIENCE:
                excess = np.maximum(current.deviance - BAD * free, 1.0)
                ended |= history[-1 - PATIENCE] - current.deviance < STALLED * excess
            display.advance(int(np.sum(ended & ~done)), steps=step)
            has_converged |= ~done & ended
            done |= ended
    return Ends(coordinates, has_converged, steps)


class _Fit(NamedTuple):
    """The state of every row: -2 log posterior, the residuals, and their slopes with respect to the moving
    coordinates."""

    deviance: Float[np.ndarray, " rows"]
    residual: Float[np.ndarray, "rows residuals"]
    jacobian: Float[np.ndarray, "rows residuals moving"]

    @classmethod
    def of(cls, linearised: Linearised, moving: Int[np.ndarray, " moving"]) -> "_Fit":
        deviance = np.where(np.isfinite(linearised.deviance), linearised.deviance, np.inf)
        return cls(deviance, linearised.whole_residual, linearised.whole_jacobian[..., moving])


def chosen(improves: Bool[np.ndarray, " rows"], new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """The new rows where they are better, the old ones elsewhere."""
    return np.where(improves.reshape(-1, *(1,) * (new.ndim - 1)), new, old)


def _step(
    current: _Fit,
    scale: Float[np.ndarray, "rows moving"],
    damping: Float[np.ndarray, " rows"],
    reach: Float[np.ndarray, " moving"],
) -> tuple[Float[np.ndarray, "rows moving"], Float[np.ndarray, " rows"]]:
    """The damped step of every row, limited in length, and the decrease of -2 log posterior that a linear model
    predicts."""
    unit = np.where(scale > 0.0, scale, 1.0)
    squares = np.einsum("rni,rnj->rij", current.jacobian, current.jacobian)
    slope = np.einsum("rni,rn->ri", current.jacobian, current.residual)
    damped = squares + (damping[:, None] * unit)[..., None] * np.eye(unit.shape[1])
    move = -np.linalg.solve(damped, slope[..., None])[..., 0]
    move = move / np.maximum(1.0, np.max(np.abs(move) / reach, axis=1, keepdims=True))
    return move, -np.einsum("ri,rij,rj->r", move, squares, move) - 2.0 * np.sum(move * slope, axis=1)


def _promise(current: _Fit) -> Float[np.ndarray, " rows"]:
    """Decrease of -2 log posterior by an undamped step, to first order in the model."""
    norms = np.linalg.norm(current.jacobian, axis=1, keepdims=True)
    sides, values, _ = np.linalg.svd(current.jacobian / np.where(norms > 0.0, norms, 1.0), full_matrices=False)
    is_significant = values > ROUND_OFF * np.max(values, axis=1, keepdims=True, initial=0.0)
    return np.sum(np.where(is_significant, np.einsum("rni,rn->ri", sides, current.residual), 0.0) ** 2, axis=1)


# Which combinations of parameters the data determine, to first order.

#: Singular values below this fraction of the largest belong to directions that the data do not determine at all.
NO_SLOPE = 1e-7

#: A combination of parameters counts as undetermined if its relative error exceeds this.
UNSEEN = 1.0

#: Least share of a parameter that a combination lists.
LEAST_SHARE = 0.02


class Identifiability(NamedTuple):
    """The combinations of parameters that the data determine, and those that they do not determine, to first order and
    without priors.

    They come from the singular values of the slopes of the residuals with respect to relative changes: changes of the
    logarithm for a parameter that cannot be negative, otherwise changes in units of `Free.unit`.

    - `singular_values`: (unknowns,), decreasing; the inverse of a value is the relative error of its combination of
      parameters.
    - `directions`: (unknowns, unknowns), the combinations, one per row.
    - `words`: the combinations as text: which parameters change together, and by how much.
    """

    singular_values: Float[np.ndarray, " unknowns"]
    directions: Float[np.ndarray, "unknowns unknowns"]
    words: tuple[str, ...]

    @property
    def unseen(self) -> tuple[str, ...]:
        """The combinations whose errors exceed their own size."""
        least = max(1.0 / UNSEEN, NO_SLOPE * self.singular_values[0])
        return tuple(word for value, word in zip(self.singular_values, self.words, strict=True) if value < least)


def coordinate_covariance(jacobian: Float[np.ndarray, "residuals unknowns"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """The inverse of the Gauss-Newton matrix J^T J; infinite for unknowns that take part in an undetermined direction.

    To find these directions, every unknown is measured in units of its own error with the other unknowns held fixed.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    values, directions = _singular(jacobian / norms)
    seen = values > NO_SLOPE * max(values[0], 1e-300)
    covariance = (directions[seen].T / values[seen] ** 2) @ directions[seen] / np.outer(norms, norms)
    is_undetermined = np.any(np.abs(directions[~seen]) > 1e-6, axis=0)
    covariance[is_undetermined, :] = covariance[:, is_undetermined] = 0.0
    covariance[is_undetermined, is_undetermined] = np.inf
    return covariance


def _singular(slopes: Float[np.ndarray, "n unknowns"]) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and right singular vectors (one per row), as many as there are unknowns."""
    unknowns = slopes.shape[1]
    _, values, directions = np.linalg.svd(slopes, full_matrices=len(slopes) < unknowns)
    return np.concatenate([values, np.zeros(unknowns - len(values))]), directions


def identifiability(problem: Problem, estimates: Any, slopes: Any, jacobian: Any) -> Identifiability:
    """Singular values of the slopes of the residuals with respect to relative changes of the parameters, with their
    directions as text.

    **Arguments:** `estimates`: (unknowns,); `slopes`: (unknowns,), of the parameters with respect to their coordinates;
    `jacobian`: (n, unknowns), of the residuals with respect to the coordinates.
    """
    units = np.array(
        [abs(x) if unknown.positive else unknown.unit for x, unknown in zip(estimates, problem.unknowns, strict=True)]
    )
    relative = np.asarray(jacobian) * units / np.where(slopes == 0.0, 1.0, slopes)
    values, directions = _singular(relative)
    words = tuple(_in_words(problem, direction) for direction in directions)
    return Identifiability(values, directions, words)


def _in_words(problem: Problem, direction: Float[np.ndarray, " unknowns"]) -> str:
    """The parameters that change together: in per cent if a parameter cannot be negative, otherwise in hundredths of
    its unit."""
    largest = np.argmax(np.abs(direction))
    parts = []
    for share, (name, free) in zip(direction / direction[largest], problem.free, strict=True):
        if abs(share) >= LEAST_SHARE:
            parts.append(f"{name} {share:+.2g} %" if free.positive else f"{name} {0.01 * share * free.unit:+.2g}")
    return ", ".join(parts)


# Refine candidates to minima by least squares, all together.

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
