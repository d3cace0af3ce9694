"""Nonlinear least squares, from many starts or for many sets of data at once.

Each row is a fit. All rows advance together, and the model is evaluated for all of them, with its slopes, in one call,
so a model that computes its cases as lanes computes the cases of all rows together. Optimistix under `vmap` compiles
the model twice, with slopes and without, and continues to evaluate finished rows.

Source: Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems", 2nd edition (2004), section 3.2; the
scaling is More's (Lecture Notes in Mathematics 630 (1978) 105).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from ..progress import Progress
from .likelihood import Measurements
from .problem import Linearised, Problem, linearise

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
