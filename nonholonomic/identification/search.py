"""The search for all minima of a likelihood, and the exploration of its surroundings."""

from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import numpy as np

from .exploration import Explorer, Weighted
from .problem import Problem, compile_slopes, deviances
from .refinement import BETWEEN, Minima, Refinement, refine

#: Greatest number of steps by slopes before an exploration, where predictions may be a staircase.
FEW_STEPS = 6

#: Number of minima that are refined to the end after an exploration.
LAST = 4

#: Points of the exploration that are better than all minima by more than this in -2 log likelihood are refined, too.
IMPROVED = 0.1


def search(
    explorer: Explorer, starts: int, max_steps: int, seed: int, progress: bool
) -> tuple[Explorer, Minima, Weighted]:
    """Compare candidates, refine the best, and explore the likelihood around all minima; or explore first, where steps by
    differences cost more. **Arguments:** as for `identify`.

    **Returns:** the explorer, which knows the unknowns that do not act; the minima; and the explored sample.

    **Raises:** `ValueError` if no candidate has a finite prediction.
    """
    problem, measurements = explorer.density.problem, explorer.density.measurements
    with ThreadPoolExecutor(1) as thread:
        # Compile the slopes while this thread compiles and computes the predictions.
        thread.submit(compile_slopes, problem)
        pool = explorer.begin(seed)
    if not np.any(np.isfinite(pool.predictions)):
        raise ValueError(
            "no start led to finite predictions: simulate a run with the start values of `free` to see whether it fails; an "
            "event must happen before t1, and its function falls through zero"
        )
    problem = eqx.tree_at(lambda problem: problem.acts, problem, explorer.acting(pool))
    explorer = explorer._replace(density=eqx.tree_at(lambda density: density.problem, explorer.density, problem))
    recorded = bool(np.any(np.asarray(measurements.time) > 0.0))
    if recorded and problem.step is not None:
        # A step by differences takes as long as a round of the exploration, which also finds the minima.
        sample = explorer.explore(pool, None, progress)
        best = sample.pool.points[sample.pool.most_probable(starts)]
        last = np.arange(starts) < LAST
        return explorer, refine(problem, best, measurements, Refinement(max_steps, progress, rows=last)), sample
    steps = max_steps if recorded else min(max_steps, FEW_STEPS)
    minima = refine(problem, pool.candidates(starts), measurements, Refinement(steps, progress, in_parts=recorded))
    if recorded:
        between = Refinement(min(max_steps, BETWEEN), progress)
        around = refine(problem, minima.between(), minima.measurements, between)
        minima = minima.joined(around)
    # Along a direction without any slope, the likelihood has no end that an exploration could find.
    has_end = bool(np.all(np.isfinite(minima.covariance(minima.best))))
    sample = explorer.explore(pool, minima.components, progress) if has_end else Weighted.of(pool)
    return explorer, _improved(problem, minima, sample, max_steps, progress), sample


def _improved(problem: Problem, minima: Minima, sample: Weighted, max_steps: int, progress: bool) -> Minima:
    """The minima, the best of them refined to the end; from the best points of the exploration if these are better."""
    rows, pool = len(minima.starts), sample.pool
    order = pool.most_probable(rows)
    best = pool.points[order]
    deviance = deviances(problem, best, pool.predictions[order], minima.measurements)
    if np.min(deviance) < np.min(minima.deviance) - IMPROVED:
        few = Refinement(min(max_steps, FEW_STEPS), progress, rows=np.arange(rows) < LAST)
        later = refine(problem, best, minima.measurements, few)
        return later if np.min(later.deviance) < np.min(minima.deviance) else minima
    if minima.converged[minima.best]:
        return minima
    last = np.isin(np.arange(rows), np.argsort(minima.deviance)[:LAST])
    later = refine(problem, minima.coordinates, minima.measurements, Refinement(max_steps, progress, rows=last))
    return later._replace(starts=minima.starts, converged=minima.converged | later.converged)
