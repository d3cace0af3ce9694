"""Hybrid runs inside other transformed functions: `solve_hybrid` as one traced loop."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..integration.ensemble import traced_solve_ensemble
from ..integration.settings import Settings
from ..integration.status import LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from ..xla_cpu import greatest
from .ensemble import (
    MOST_ROUNDS,
    AbstractBatchedMode,
    HybridOutcome,
    after_reset,
    after_solve,
    mode_of_cells,
    runs_of_cells,
)


def traced_solve_hybrid(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    t1: Float[Array, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    nonterminal: bool = False,
    n_blocks: int = 1,
) -> HybridOutcome[Array]:
    """Run every cell through its modes to its event, to `t1`, or to where the model ends.

    In each round, every mode runs all cells, but the horizon is 0 for cells in another mode.

    **Arguments:** as for `solve_hybrid`.

    **Returns:** a `HybridOutcome`, of traced numbers.

    **Example:**

    >>> from nonholonomic.hybrid import traced_solve_hybrid
    >>> solve = lambda t1: traced_solve_hybrid(modes, jnp.asarray(first), jnp.asarray(start), t1, 2, settings, counters=1)
    >>> print(jax.jit(solve)(5.0).crossing_time.round(6))
    [0.722438 0.812743]
    """
    size = state.shape[1]
    t1 = jnp.broadcast_to(t1, (size,))
    zero, none = jnp.zeros(size), jnp.zeros(size, int)
    start = HybridOutcome(
        status=jnp.where(jnp.arange(size) < cells, RUNNING, REACHED_END),
        crossing_time=jnp.full(size, jnp.inf),
        end_time=zero,
        state=state,
        steps=none,
        rejected=none,
        mode=mode,
        counts=jnp.zeros((counters, size), int),
    )

    def solve_mode(
        batched_mode: AbstractBatchedMode, runs: HybridOutcome[Array], active: Bool[Array, " cells"]
    ) -> HybridOutcome[Array]:
        def ensemble_solve() -> HybridOutcome[Array]:
            cell = padded(active)
            padded_mode, padded_runs = mode_of_cells(batched_mode, cell), runs_of_cells(runs, cell)
            left = jnp.where(active, greatest(t1 - runs.end_time, 0.0), 0.0)
            problem = padded_mode.problem(padded_runs.state)
            outcome, _ = traced_solve_ensemble(
                problem, left, jnp.asarray(size), settings, nonterminal=nonterminal, n_blocks=n_blocks
            )
            return chosen(active, after_solve(jnp, runs, outcome, t1), runs)

        runs = jax.lax.cond(jnp.any(active), ensemble_solve, lambda: runs)
        return apply_reset(batched_mode, runs, active & (runs.status == LEFT_DOMAIN), t1)

    def one_round(carry: tuple[HybridOutcome[Array], Int[Array, ""]]) -> tuple[HybridOutcome[Array], Int[Array, ""]]:
        runs, rounds = carry
        # Selected before the round: a cell that changes its mode during the round waits for the next round.
        by_mode = [(runs.status == RUNNING) & (runs.mode == number) for number in range(len(modes))]
        for batched_mode, active in zip(modes, by_mode, strict=True):
            runs = solve_mode(batched_mode, runs, active)
        return runs, rounds + 1

    return in_rounds(one_round, start)


def in_rounds(one_round: Callable[[Any], Any], start: HybridOutcome[Array], *more: Any) -> Any:
    """Loop over rounds while a cell is running. The carry is the `HybridOutcome`, any further values, and the round."""

    def under_way(carry: Any) -> Bool[Array, ""]:
        return jnp.any(carry[0].status == RUNNING) & (carry[-1] < MOST_ROUNDS)

    outcome, *values, _ = jax.lax.while_loop(under_way, one_round, (start, *more, jnp.zeros((), int)))
    outcome = outcome._replace(status=jnp.where(outcome.status == RUNNING, UNRESOLVED, outcome.status))
    return (outcome, *values) if values else outcome


def apply_reset(
    batched_mode: AbstractBatchedMode,
    runs: HybridOutcome[Array],
    lost: Bool[Array, " cells"],
    t1: Float[Array, " cells"],
) -> HybridOutcome[Array]:
    """Apply the reset map to the cells at the end of a mode."""

    def passed() -> HybridOutcome[Array]:
        cell = padded(lost)
        padded_mode, padded_runs = mode_of_cells(batched_mode, cell), runs_of_cells(runs, cell)
        transition = padded_mode.reset_map(padded_runs.state, greatest(t1 - padded_runs.end_time, 0.0))
        return chosen(lost, after_reset(jnp, runs, transition, t1), runs)

    return jax.lax.cond(jnp.any(lost), passed, lambda: runs)


def padded(selected: Bool[Array, " cells"]) -> Int[Array, " cells"]:
    """The numbers of the selected cells. The first selected cell replaces all others, because their states may have
    another meaning."""
    return jnp.where(selected, jnp.arange(selected.size), jnp.argmax(selected))


def chosen(
    selected: Bool[Array, " cells"], new: HybridOutcome[Array], old: HybridOutcome[Array]
) -> HybridOutcome[Array]:
    """The new outcome for the selected cells, and the old outcome for the others."""
    return jax.tree.map(lambda a, b: jnp.where(selected, a, b), new, old)
