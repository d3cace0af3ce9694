"""Optimisation of all candidates together: an augmented Lagrangian, minimised by damped Gauss-Newton steps.

Method: Nocedal and Wright, Numerical Optimization (2006), chapters 10 and 17. JAX evaluates the residuals and their
slopes in lanes; SciPy solves the banded equations of all lanes as one system.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from .spline import ORDER
from .transcription import Residuals, Task, interval_residuals, residuals, windows

#: Penalties of the constraints, in turn, and the number of Gauss-Newton steps with each.
PENALTIES = (100.0, 300.0, *(1e3,) * 6)
STEPS_EACH = 8

#: Violation of the constraints of a solution, and relative change of the objective at which the optimiser stops.
FEASIBLE, SETTLED = 2e-4, 0.02

#: The damping: least, first and greatest value.
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-6, 1.0, 1e6


class Candidates(NamedTuple):
    """Candidates in lanes: unknowns (lanes, rows, unknowns) and durations (lanes,) [s]."""

    unknowns: Any
    durations: Any


class Multipliers(NamedTuple):
    """Multipliers in units of the penalty, shaped as the constraints."""

    equalities: Any
    inequalities: Any


def _penalised(evaluation: Residuals, multipliers: Multipliers, penalty: Any) -> Any:
    """The residuals of the augmented Lagrangian, as one list per interval."""
    root = jnp.sqrt(penalty)
    shifted = evaluation.inequalities + multipliers.inequalities
    broken = jnp.where(shifted < 0.0, shifted, 0.0)
    return jnp.concatenate(
        [root * (evaluation.equalities + multipliers.equalities), root * broken, evaluation.objective], -1
    )


@eqx.filter_jit
def _normal_equations(candidates: Candidates, task: Task, multipliers: Multipliers, penalty: Any) -> Any:
    """Merit (lanes,), gradient (lanes, rows, unknowns), and lower band of the Gauss-Newton matrix of every lane."""

    def of_lane(unknowns, t1, multipliers):
        rows, width = unknowns.shape
        intervals = rows - ORDER + 1

        # The poses of the third and the fourth row of a window have no influence.
        used = np.array([k for k in range(ORDER * width) if k < 2 * width or k % width >= width - 2])

        def of_interval(window, multipliers, index):
            def terms(numbers):
                changed = window.ravel().at[used].set(numbers).reshape(window.shape)
                evaluation = interval_residuals(changed, task, index, intervals, t1 / intervals)
                value = _penalised(evaluation, multipliers, penalty)
                return value, value

            slope, value = jax.jacfwd(terms, has_aux=True)(window.ravel()[used])
            return value @ value, slope.T @ value, slope.T @ slope

        merit, gradient, matrix = jax.vmap(of_interval)(windows(unknowns), multipliers, jnp.arange(intervals))
        number = np.arange(intervals)[:, None] * width + used
        total = jnp.zeros(rows * width).at[number].add(gradient)
        row, column = np.tril_indices(len(used))
        band = jnp.zeros((ORDER * width, rows * width))
        band = band.at[(used[row] - used[column])[None], number[:, column]].add(matrix[:, row, column])
        return merit.sum(), total, band

    return jax.vmap(of_lane)(*candidates, multipliers)


@eqx.filter_jit
def constraints(candidates: Candidates, task: Task) -> Residuals:
    """The residuals of every lane."""
    return jax.vmap(lambda unknowns, t1: residuals(unknowns, task, t1))(*candidates)


def _step(band: np.ndarray, gradient: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Damped Gauss-Newton steps of all lanes, solved as one banded system; none in a lane that is not finite."""
    lanes, width, count = band.shape
    usable = np.all(np.isfinite(band), axis=(1, 2), keepdims=True)
    matrix = np.where(usable, band, 0.0)
    # Rounding must not make the matrix indefinite where an unknown far from the others has a very steep residual.
    matrix[:, 0] += damping[:, None] + 1e-12 + 1e-13 * matrix[:, 0].max(axis=1, keepdims=True)
    joined, slopes = matrix.transpose(1, 0, 2).reshape(width, lanes * count), np.where(usable[..., 0], gradient, 0.0)
    return -scipy.linalg.solveh_banded(joined, slopes.reshape(-1), lower=True).reshape(lanes, count)


def _minimise(
    candidates: Candidates, task: Task, multipliers: Multipliers, penalty: float, damping: np.ndarray
) -> tuple[Candidates, np.ndarray]:
    """Gauss-Newton steps for a given penalty, and the damping after them.

    The damping follows the ratio of the gain to the one that the linear model promised (Nielsen, "Damping parameter in
    Marquardt's method", Technical University of Denmark, 1999); a step that does not lower the merit is repeated.
    """
    # A Python number would be a constant of the program.
    weight = jnp.asarray(penalty)
    merit, gradient, band = (np.array(part) for part in _normal_equations(candidates, task, multipliers, weight))
    unknowns, growth = np.array(candidates.unknowns), np.full(len(merit), 2.0)
    for _ in range(STEPS_EACH):
        step = _step(band, gradient, damping)
        promised = np.sum(step * (damping[:, None] * step - gradient), axis=1)
        trial = candidates._replace(unknowns=unknowns + step.reshape(unknowns.shape))
        new = tuple(map(np.asarray, _normal_equations(trial, task, multipliers, weight)))
        gain = np.where(np.isfinite(new[2]).all((1, 2)), (merit - new[0]) / promised, -1.0).clip(-1.0, 2.0)
        better = gain > 0.0
        for old, part in zip((merit, gradient, band, unknowns), (*new, trial.unknowns), strict=True):
            old[better] = part[better]
        damping = damping * np.where(better, np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), growth)
        damping = np.clip(damping, LEAST_DAMPING, MOST_DAMPING)
        growth = np.where(better, 2.0, 2.0 * growth)
    return candidates._replace(unknowns=unknowns), damping


def violation(evaluation: Residuals) -> np.ndarray:
    """The greatest violation of a constraint in every lane, in the units of the residuals."""
    equalities, inequalities = np.asarray(evaluation.equalities), np.asarray(evaluation.inequalities)
    return np.maximum(np.abs(equalities).max((1, 2)), -inequalities.min((1, 2)).clip(max=0.0))


def objective(evaluation: Residuals) -> np.ndarray:
    """The objective of every lane."""
    return np.sum(np.asarray(evaluation.objective) ** 2, axis=(1, 2))


def optimise(candidates: Candidates, task: Task) -> tuple[Candidates, np.ndarray, np.ndarray]:
    """Minimise the effort of all candidates under the constraints, until that of a feasible one changes by less than
    2 %, or the penalties are used up.

    **Returns:** the candidates, and the violation and the objective of each.
    """
    # Where the weight makes the effort large, the penalties would be too weak beside it.
    least = float(objective(constraints(candidates, task)).min())
    task = eqx.tree_at(lambda task: task.scales.force, task, task.scales.force * np.sqrt(max(1.0, least)))
    evaluation = constraints(candidates, task)
    multipliers = Multipliers(jnp.zeros_like(evaluation.equalities), jnp.zeros_like(evaluation.inequalities))
    values = np.full(len(candidates.durations), np.inf)
    damping = np.full(len(candidates.durations), FIRST_DAMPING)
    for last, penalty in zip((PENALTIES[0], *PENALTIES), PENALTIES, strict=False):
        multipliers = Multipliers(*(part * (last / penalty) for part in multipliers))
        candidates, damping = _minimise(candidates, task, multipliers, penalty, damping)
        evaluation, before = constraints(candidates, task), values
        values = objective(evaluation)
        if np.any((violation(evaluation) < FEASIBLE) & (np.abs(values - before) < SETTLED * values)):
            break
        multipliers = Multipliers(
            multipliers.equalities + evaluation.equalities,
            jnp.minimum(multipliers.inequalities + evaluation.inequalities, 0.0),
        )
    return candidates, violation(evaluation), values
