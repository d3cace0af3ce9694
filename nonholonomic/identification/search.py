"""Search for all minima of a likelihood: refine candidates by least squares, all together, and explore around the ends.

Each row is a fit. All rows advance together, and the model is evaluated for all of them, with its slopes, in one call,
so a model that computes its cases as lanes computes the cases of all rows together. Optimistix under `vmap` compiles
the model twice, with slopes and without, and continues to evaluate finished rows.

Source: Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems", 2nd edition (2004), section 3.2; the
scaling is More's (Lecture Notes in Mathematics 630 (1978) 105).
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PyTree

from ..terminal import Progress
from ..validation import warn
from .exploration import FALL, Explorer, Mixture, Pool
from .posterior import Coordinates, Linearised, LogDensity, Rows, estimated_errors, linearise, predictions, weighed
from .recording import AbstractRecording

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


def minimise(density: LogDensity, starts: Rows, *, fixed: int | None = None, max_steps: int = 60) -> "Minima":
    """Fit every row.

    **Arguments:**

    - `density`: its measurements are of shape (n,), the same for all rows, or (rows, n).
    - `starts`: coordinates, (rows, unknowns).
    - `fixed`: index of an unknown that keeps its start value, or `None`.
    - `max_steps`: a row that needs more steps has not converged.

    **Returns:** the `Minima`.
    """
    starts = np.asarray(starts, float)
    count, unknowns = starts.shape
    moving = np.array([k for k in range(unknowns) if k != fixed], int)
    of_unknowns = density.problem.unknowns
    is_bounded = np.isfinite(of_unknowns.lower) | np.isfinite(of_unknowns.upper)
    reach = np.where(is_bounded, FARTHEST, np.inf)[moving]
    with Progress(count, "fit") as display:
        current = linearise(density, starts)
        display.begin()
        scale, damping = np.zeros((count, len(moving))), np.full(count, FIRST_DAMPING)
        free = max(current.residual.shape[1] - len(moving), 1)
        history = [current.deviance]
        converged = _promise(current, moving) < CONVERGED
        for step in range(1, max_steps + 1):
            if converged.all():
                break
            scale = np.maximum(scale, np.sum(current.jacobian[..., moving] ** 2, axis=1))
            # The damped step of every row, limited in length, and the gain that a linear model predicts.
            jacobian, unit = current.jacobian[..., moving], np.where(scale > 0.0, scale, 1.0)
            squares = np.einsum("rni,rnj->rij", jacobian, jacobian)
            slope = np.einsum("rni,rn->ri", jacobian, current.residual)
            damped = squares + (damping[:, None] * unit)[..., None] * np.eye(len(moving))
            move = -np.linalg.solve(damped, slope[..., None])[..., 0]
            move = move / np.maximum(1.0, np.max(np.abs(move) / reach, axis=1, keepdims=True))
            predicted_gain = -np.einsum("ri,rij,rj->r", move, squares, move) - 2.0 * np.sum(move * slope, axis=1)
            coordinates = current.coordinates.copy()
            coordinates[:, moving] += move
            trial = linearise(density, coordinates, ~converged)
            gain = current.deviance - trial.deviance
            improves = ~converged & (gain > 0.0)
            damping = np.where(improves, np.where(gain > GOOD * predicted_gain, EASED, 1.0), HARDENED) * damping
            current = chosen(improves, trial, current)
            history.append(current.deviance)
            remaining_gain = _promise(current, moving)
            ended = (remaining_gain < CONVERGED) | (~improves & (remaining_gain < NEGLIGIBLE))
            if step >= PATIENCE:
                excess = np.maximum(current.deviance - BAD * free, 1.0)
                ended |= history[-1 - PATIENCE] - current.deviance < STALLED * excess
            display.advance(int(np.sum(ended & ~converged)), steps=step)
            converged |= ended
    return Minima(starts, converged, current, density)


def chosen(improves: Bool[np.ndarray, " rows"], new: PyTree, old: PyTree) -> PyTree:
    """The new rows of all arrays where they are better, the old ones elsewhere."""
    return jax.tree.map(lambda new, old: np.where(improves.reshape(-1, *(1,) * (new.ndim - 1)), new, old), new, old)


def _promise(current: Linearised, moving: Int[np.ndarray, " moving"]) -> Float[np.ndarray, " rows"]:
    """Decrease of -2 log posterior by an undamped step, to first order in the model."""
    jacobian = current.jacobian[..., moving]
    norms = np.linalg.norm(jacobian, axis=1, keepdims=True)
    sides, values, _ = np.linalg.svd(jacobian / np.where(norms > 0.0, norms, 1.0), full_matrices=False)
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


def identifiability(
    density: LogDensity, estimates: Coordinates, slopes: Coordinates, jacobian: Float[np.ndarray, "n unknowns"]
) -> Identifiability:
    """Singular values of the slopes of the residuals with respect to relative changes of the parameters, with their
    directions as text.

    **Arguments:** `estimates`: (unknowns,); `slopes`: (unknowns,), of the parameters with respect to their coordinates;
    `jacobian`: (n, unknowns), of the residuals with respect to the coordinates.
    """
    # Changes of a parameter that cannot be negative are relative, in per cent; others in hundredths of its unit.
    problem = density.problem
    positive, units = np.asarray(problem.unknowns.lower >= 0.0), np.asarray(problem.unknowns.unit)
    values, directions = _singular(
        jacobian * np.where(positive, np.abs(estimates), units) / np.where(slopes == 0.0, 1.0, slopes)
    )
    words = []
    for direction in directions:
        shares = direction / direction[np.argmax(np.abs(direction))]
        parts = [
            f"{name} " + (f"{share:+.2g} %" if is_positive else density.written(name, 0.01 * share * unit, form="+.2g"))
            for name, share, is_positive, unit in zip(problem.names, shares, positive, units, strict=True)
            if abs(share) >= LEAST_SHARE
        ]
        words.append(", ".join(parts))
    return Identifiability(values, directions, tuple(words))


# Refine candidates to minima by least squares, all together.

#: Unknown errors and parameters are estimated in turns, until no error changes by more than this fraction.
ROUNDS, SETTLED = 10, 0.01

#: The fractions of a recording that are fitted before the whole, and the factor on the errors of later measurements.
PARTS, DOWN_WEIGHTED = (0.1, 0.25, 0.5), 1e6

#: The greatest numbers of steps in the fit of a recording: for each part, for the whole at once, and between its minima.
OF_PART, AT_ONCE, BETWEEN = 8, 15, 20

#: Greatest number of minima around which an exploration begins; how much worse than the best they may be, in -2 log
#: likelihood; and their least distance, in standard errors.
MOST_COMPONENTS, WORSE, APART = 8, 30.0, 1.0

#: By how much the proposals around a minimum are wider than its slopes suggest.
WIDER = 1.2

#: Ends are the same minimum if their -2 log likelihoods differ by less than `SAME`, or if all their parameters agree to `CLOSE`
#: standard errors.
SAME, CLOSE = 0.1, 0.5


class Minima(NamedTuple):
    """The ends of least-squares fits, a row each.

    - `starts`: (rows, unknowns), where each began; `converged`: (rows,).
    - `linearised`: model and likelihood at the ends; `density`: with the errors that were estimated at the best end.
    """

    starts: Rows
    converged: Bool[np.ndarray, " rows"]
    linearised: Linearised
    density: LogDensity

    @property
    def coordinates(self) -> Rows:
        """Where each fit ended, (rows, unknowns)."""
        return self.linearised.coordinates

    @property
    def deviance(self) -> Float[np.ndarray, " rows"]:
        """-2 log likelihood at every end, infinite where the fit failed."""
        valid = np.any(np.isfinite(self.linearised.prediction), axis=1) & np.all(np.isfinite(self.coordinates), axis=1)
        return np.where(valid, self.linearised.deviance, np.inf)

    @property
    def best(self) -> int:
        """The row of the best end."""
        return int(np.argmin(self.deviance))

    @property
    def agree(self) -> int:
        """The number of ends that are at the best minimum."""
        errors = np.sqrt(np.diag(self.covariance(self.best)))
        # Failed ends are infinite.
        with np.errstate(invalid="ignore"):
            distances = np.abs(self.coordinates - self.coordinates[self.best]) / errors
            excess = self.deviance - np.min(self.deviance)
        # Parameters of infinite error are ignored: their value does not matter.
        is_close = np.all(np.where(np.isfinite(errors), distances, 0.0) < CLOSE, axis=1)
        return int(np.sum((is_close | (excess < SAME)) & (excess < 1.0)))

    def joined(self, other: "Minima") -> "Minima":
        """The best of the ends of two searches, as many as this one has.

        Each search has estimated unknown errors for itself, and -2 log likelihoods with different errors cannot be compared:
        both are compared with the errors of the search that is the better one with the errors of this one.
        """
        is_better = np.min(other.weighed(self.density).deviance) < np.min(self.deviance)
        density = other.density if is_better else self.density
        pair = self.weighed(density), other.weighed(density)
        order = np.argsort(np.concatenate([minima.deviance for minima in pair]), kind="stable")[: len(self.starts)]
        ends = jax.tree.map(lambda *parts: np.concatenate(parts)[order], *(minima[:3] for minima in pair))
        return Minima._make((*ends, density))

    def between(self) -> Rows:
        """Points between the best end and the others, and beyond it, the nearest first.

        Minima of periodic motions lie at equal distances: where two are known, there may be one in the middle, or at the
        same distance on the other side.
        """
        best, bound = self.coordinates[self.best], WORSE * self.linearised.prediction.shape[1] / 10.0
        steps = self.coordinates[self.deviance < np.min(self.deviance) + bound] - best
        covariance = self.covariance(self.best)
        errors = np.sqrt(np.where(np.isfinite(np.diag(covariance)), np.diag(covariance), 1.0))
        far = np.max(np.abs(steps) / errors, axis=1)
        steps = steps[np.argsort(far)][np.sort(far) > APART]
        points = [best + factor * step for step in steps for factor in (-1.0, 0.5, 2.0)]
        return np.stack([*points, *self.coordinates])[: len(self.starts)]

    def covariance(self, row: int | np.integer) -> Float[np.ndarray, "unknowns unknowns"]:
        """The covariance of the coordinates by the slopes at an end."""
        return coordinate_covariance(self.linearised.information[row])

    def weighed(self, density: LogDensity) -> "Minima":
        """The same ends, compared with measurements of other errors."""
        if density is self.density:
            return self
        at_ends = weighed(density, self.coordinates, self.linearised.prediction, self.linearised.slopes)
        return self._replace(linearised=at_ends, density=density)

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


def refine(density: LogDensity, starts: Rows, max_steps: int, in_parts: bool = False) -> Minima:
    """Fit every row, and estimate unknown errors from the residuals of the best.

    **Arguments:** `in_parts`: whether recordings are also fitted in stages, of which the better of the two ends counts;
    predicted late samples can be wrong by whole turns, and would then lead to another minimum; the others as for `minimise`.
    """
    measurements = density.measurements
    if in_parts:
        duration = float(np.max(measurements.time))
        steps, coordinates = min(max_steps, AT_ONCE), starts
        minima = minimise(density, starts, max_steps=steps)
        for part in PARTS:
            # Later measurements have nearly no weight.
            factor = np.where(measurements.time > part * duration, DOWN_WEIGHTED, 1.0)
            early = density.with_errors(measurements.error * factor)
            coordinates = minimise(early, coordinates, max_steps=min(max_steps, OF_PART)).coordinates
        by_parts = minimise(density, coordinates, max_steps=2 * steps)
        improves = by_parts.linearised.deviance < minima.linearised.deviance
        minima = Minima._make((starts, *chosen(improves, by_parts[1:3], minima[1:3]), density))
    else:
        minima = minimise(density, starts, max_steps=max_steps)
    for _ in range(ROUNDS if np.any(measurements.estimated) else 0):
        best = minima.linearised.prediction[np.argmin(minima.linearised.deviance)]
        errors = estimated_errors(density.measurements, best, starts.shape[1])
        change = np.max(np.abs(np.log(errors / density.measurements.error)))
        density = density.with_errors(errors)
        if change <= SETTLED:
            minima = minima.weighed(density)
            break
        minima = minimise(density, minima.coordinates, max_steps=max_steps)
    return minima._replace(starts=np.asarray(starts))


# The search for all minima of a likelihood, and the exploration of its surroundings.


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


#: Greatest number of steps by slopes before an exploration, where predictions may be a staircase.
FEW_STEPS = 6

#: Samples that are farther apart [s] may have times in milliseconds: if the best of this many candidates leaves less than this
#: part of the scatter. Events may be within this factor of a thousandth of their times.
SPARSE, FEW_CANDIDATES, EXPLAINED, UNIT_FACTOR = 1.0, 64, 0.25, 3.0

#: Greatest number of minima that are refined to the end after an exploration.
LAST = 4

#: Points of the exploration that are better than all minima by more than this in -2 log likelihood are refined, too.
IMPROVED = 0.1


def search(explorer: Explorer, starts: int, max_steps: int) -> tuple[Explorer, Minima, Pool]:
    """Compare candidates, refine the best, and explore the likelihood around all minima; or explore first, where steps by
    differences cost more. **Arguments:** as for `identify`.

    **Returns:** the explorer, which knows the unknowns that do not act; the minima; and the explored sample.

    **Raises:** `ValueError` if no candidate has a finite prediction, and for times in milliseconds.
    """
    problem, measurements = explorer.density.problem, explorer.density.measurements
    with ThreadPoolExecutor(1) as thread:
        if problem.step is None:
            # Compile the slopes while this thread compiles and computes the predictions.
            thread.submit(linearise, explorer.density, np.full((1, len(problem.names)), np.nan))
        # A call on the host takes as long for a single candidate as for all.
        pool = explorer.begin() if problem.on_host else None
        _refuse_milliseconds(explorer, pool)
        pool = explorer.begin() if pool is None else pool
    if not np.any(np.isfinite(pool.predictions)):
        raise ValueError(
            "no start led to finite predictions: simulate a run with the start values of `free` to see whether it fails; an "
            "event must happen before t1, and its function falls through zero"
        )
    acts = explorer.acting(pool)
    if not np.all(acts):
        names = ", ".join(name for name, has_effect in zip(problem.names, acts, strict=True) if not has_effect)
        warn(
            f"no prediction depends on {names}, so the data say nothing about it: fix it, or add other data", FitWarning
        )
    density = eqx.tree_at(lambda density: density.problem.acts, explorer.density, acts)
    explorer = explorer._replace(density=density)
    recorded = bool(np.any(measurements.time > 0.0))
    steps = max_steps if recorded else min(max_steps, FEW_STEPS)
    # Whether there is a single unknown, and the density falls towards both ends of its range.
    is_bounded = len(problem.names) == 1 and bool(np.all(pool.log_density[[0, -1]] < np.max(pool.log_density) - FALL))
    if problem.step is not None and (recorded or is_bounded):
        # A step by differences takes as long as a round of the exploration, which also finds the minima.
        sample = explorer.explore(pool, None)
        place = sample.most_probable(min(starts, LAST if recorded else 1))
        best = sample.points[place]
        if recorded or not sample.enough or np.any(measurements.estimated):
            return explorer, refine(density, best, steps), sample
        # Among so many points of a single unknown, the best is close to the minimum, and those around it show the slopes.
        beside = best[0] + problem.step * np.array([-1.0, 1.0])
        moved = [np.interp(beside, sample.points[:, 0], column) for column in sample.predictions.T]
        with np.errstate(invalid="ignore"):
            slopes = np.diff(moved)[None] / (2.0 * problem.step)
        slopes = np.where(np.isfinite(slopes) & acts, slopes, 0.0)
        at_best = weighed(density, best, sample.predictions[place], slopes)
        return explorer, Minima(best, np.array([True]), at_best, density), sample
    # The start; then, in turn, the best for all measurements and for the early ones.
    start = int(np.argmin(np.sum((pool.points - explorer.region.points(1, 0)) ** 2, axis=1)))
    totals = np.cumsum(pool.groups, axis=1) + pool.log_prior[:, None]
    columns = sorted({totals.shape[1] - 1, *(totals.shape[1] * part // 8 for part in (0, 1, 2, 4))}, reverse=True)
    ranked = np.stack([np.argsort(-totals[:, column]) for column in columns], axis=1).reshape(-1)
    candidates = pool.points[list(dict.fromkeys([start, *ranked.tolist()]))[:starts]]
    minima = refine(density, candidates, steps, in_parts=recorded)
    if recorded:
        later = refine(minima.density, minima.between(), min(max_steps, BETWEEN))
        minima = minima.joined(later)
    # Along a direction without any slope, the likelihood has no end that an exploration could find.
    has_end = bool(np.all(np.isfinite(minima.covariance(minima.best))))
    sample = explorer.explore(pool, minima.components) if has_end else pool
    return explorer, _improved(minima, sample, max_steps), sample


def _refuse_milliseconds(explorer: Explorer, pool: Pool | None) -> None:
    """Raise `ValueError` if the times of the data seem to be in milliseconds: if the events happen at a thousandth of their
    times, or if the samples are far apart and some candidate explains them at a thousandth of their times, where the motion
    has hardly begun if they are in seconds.
    """
    problem, measurements = explorer.density.problem, explorer.density.measurements
    data = getattr(problem.model, "recorded", ())
    if not data:
        return
    recorded = [isinstance(source, AbstractRecording) for source in data]
    is_sample = np.repeat(recorded, [np.count_nonzero(source.seen) for source in data])
    value, series = measurements.value, measurements.series
    points = explorer.region.points(FEW_CANDIDATES, 0)
    is_event = ~is_sample & ~measurements.censored
    if np.any(is_event):
        first = predictions(problem, points[:1]) if pool is None else pool.predictions
        ratio = np.median(value[is_event] / first[0, is_event])
        if 1e3 / UNIT_FACTOR < ratio < 1e3 * UNIT_FACTOR:
            raise ValueError(
                f"time: the events are measured {ratio:.0f} times later than at the start values; times are in seconds: did "
                "you mean 1e-3 * time? Otherwise start closer"
            )
    recordings = [source for source in data if isinstance(source, AbstractRecording)]
    if min((np.median(np.diff(source.times)) for source in recordings if len(source.times) > 2), default=0.0) < SPARSE:
        return
    model = problem.model.with_times(lambda source: {"times": 1e-3 * source.times, "t0": 1e-3 * source.t0})
    off = measurements.standardised(predictions(eqx.tree_at(lambda problem: problem.model, problem, model), points))
    # Candidates whose runs fail have no prediction.
    least = np.fmin.reduce(np.sum(off[:, is_sample] ** 2, axis=1))
    parts = [(value / measurements.error)[is_sample & (series == number)] for number in np.unique(series[is_sample])]
    if least < EXPLAINED * sum(part.size * np.var(part) for part in parts):
        raise ValueError(
            "times: the model explains the samples at 1e-3 * times; times are in seconds: did you mean 1e-3 * times? "
            "Otherwise start closer"
        )


def _improved(minima: Minima, sample: Pool, max_steps: int) -> Minima:
    """The minima, the best of them refined to the end; or those of the best points of the exploration, if these are better."""
    density, count = minima.density, min(LAST, len(minima.starts))
    order = sample.most_probable(count)
    deviance = weighed(density, sample.points[order], sample.predictions[order]).deviance
    if np.min(deviance) < np.min(minima.deviance) - IMPROVED:
        later = refine(density, sample.points[order], min(max_steps, FEW_STEPS))
        is_better = np.min(later.weighed(density).deviance) < np.min(minima.deviance)
        return minima.joined(later) if is_better else minima
    if minima.converged[minima.best]:
        return minima
    rows = np.argsort(minima.deviance)[:count]
    later = refine(density, minima.coordinates[rows], max_steps)
    # The rows that were fitted further replace the old ones.
    place = np.arange(len(minima.starts))
    place[rows] = len(place) + np.arange(count)
    pair = minima.weighed(later.density)[1:3], later[1:3]
    ends = jax.tree.map(lambda old, new: np.concatenate([old, new])[place], *pair)
    return Minima._make((minima.starts, *ends, later.density))
