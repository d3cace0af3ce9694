"""The resets of one hybrid run: the states before and after each of them."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..integration import Settings, solve_ensemble
from .ensemble import (
    Carry,
    HybridOutcome,
    after_reset,
    after_solve,
    at_start,
    host_rounds,
    problem_of_cells,
    reset_of_cells,
)
from .mode import AbstractBatchedMode


def hybrid_resets(
    modes: tuple[AbstractBatchedMode, ...],
    number: int,
    state: Float[np.ndarray, " components"],
    t1: float,
    settings: Settings,
    *,
    counters: int,
) -> list[tuple[HybridOutcome[np.ndarray], HybridOutcome[np.ndarray]]]:
    """The run of one cell before and after each of its resets.

    **Arguments:** as for `solve_hybrid`, for one cell; `number`, `state`: initial mode and state.

    **Returns:** for each reset, the run before and after it, as a `HybridOutcome` of one cell, whose `end_time` is the time
    of the reset [s].

    **Example:** the first ball of the subpackage's example: its velocity before and after its first impact.

    >>> from nonholonomic.hybrid import hybrid_resets
    >>> ball = (Bounce(jnp.array([0.6])),)
    >>> ((before, after),) = hybrid_resets(ball, 0, start[:, 0], 0.8, settings, counters=1)
    >>> print(after.end_time.round(6), before.state[1].round(6), after.state[1].round(6))
    [0.451524] [-4.429447] [2.657668]
    """
    horizon, cell = np.full(1, float(t1)), np.zeros(1, int)

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[np.ndarray, "1"]) -> Carry:
        if not active[0]:
            return carry
        runs, resets = carry
        problem, left = problem_of_cells(modes[numbers[0]], cell, runs.state), np.maximum(horizon - runs.end_time, 0.0)
        outcome = jax.tree.map(np.asarray, solve_ensemble(problem, left, np.asarray(1), settings)[0])
        return after_solve(np, runs, outcome, horizon), resets

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[np.ndarray, "1"]) -> Carry:
        if not lost[0]:
            return carry
        runs, resets = carry
        left = np.maximum(horizon - runs.end_time, 0.0)
        transition = reset_of_cells(modes[numbers[0]], cell, runs.state, left)
        runs_after = after_reset(np, runs, jax.tree.map(np.asarray, transition), horizon)
        return runs_after, [*resets, (runs, runs_after)]

    start = at_start(np, np.full(1, number), np.asarray(state)[:, None], 1, counters)
    return host_rounds((start, []), [(mode,) for mode in range(len(modes))], solve, reset)[1]
