"""Hybrid runs inside other transformed functions: `solve_hybrid` as one traced loop."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..integration.ensemble import traced_solve_ensemble
from ..integration.settings import Settings
from ..integration.status import LEFT_DOMAIN, RUNNING, UNRESOLVED
from ..xla_cpu import greatest
from .ensemble import MOST_ROUNDS, AbstractBatchedMode, HybridOutcome, after_reset, after_solve


def traced_solve_hybrid(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    t1: Float[Array, "..."],
    settings: Settings,
    *,
    kinds: int,
    passes: bool = False,
    parts: int = 1,
) -> HybridOutcome[Array]:
    """Run every cell through its modes to its event, to `t1`, or to where the model ends.

    Cells are not gathered: in each round every mode runs all cells, those in another mode for no time.

    **Arguments:** as for `solve_hybrid`.

    **Returns:** a `HybridOutcome`, of traced numbers.
    """
    size = state.shape[1]
    t1 = jnp.broadcast_to(t1, (size,))
    zero, none = jnp.zeros(size), jnp.zeros(size, int)
    start = HybridOutcome(
        status=jnp.full(size, RUNNING),
        crossing_time=jnp.full(size, jnp.inf),
        end_time=zero,
        state=state,
        steps=none,
        rejected=none,
        mode=mode,
        counts=jnp.zeros((kinds, size), int),
    )

    def through(
        one: AbstractBatchedMode, found: HybridOutcome[Array], here: Bool[Array, " cells"]
    ) -> HybridOutcome[Array]:
        def ensemble_solve() -> HybridOutcome[Array]:
            there, now = of_cells(one, here), in_place_of(found, here)
            left = jnp.where(here, greatest(t1 - found.end_time, 0.0), 0.0)
            problem = there.problem(now.state)
            outcome, _ = traced_solve_ensemble(problem, left, jnp.asarray(size), settings, passes=passes, parts=parts)
            return chosen(here, after_solve(jnp, found, outcome, t1), found)

        found = jax.lax.cond(jnp.any(here), ensemble_solve, lambda: found)
        return passing(one, found, here & (found.status == LEFT_DOMAIN), t1)

    def one_round(carry: tuple[HybridOutcome[Array], Int[Array, ""]]) -> tuple[HybridOutcome[Array], Int[Array, ""]]:
        found, rounds = carry
        # Selected before the round: a cell that changes its mode during the round waits for the next round.
        here = [(found.status == RUNNING) & (found.mode == number) for number in range(len(modes))]
        for one, some in zip(modes, here, strict=True):
            found = through(one, found, some)
        return found, rounds + 1

    return in_rounds(one_round, start)


def in_rounds(one_round: Callable[[Any], Any], start: HybridOutcome[Array], *more: Any) -> Any:
    """Loop over rounds while a cell is running. The carry is the `HybridOutcome`, any further values, and the round."""

    def under_way(carry: Any) -> Bool[Array, ""]:
        return jnp.any(carry[0].status == RUNNING) & (carry[-1] < MOST_ROUNDS)

    outcome, *values, _ = jax.lax.while_loop(under_way, one_round, (start, *more, jnp.zeros((), int)))
    outcome = outcome._replace(status=jnp.where(outcome.status == RUNNING, UNRESOLVED, outcome.status))
    return (outcome, *values) if values else outcome


def passing(
    one: AbstractBatchedMode, found: HybridOutcome[Array], lost: Bool[Array, " cells"], t1: Float[Array, " cells"]
) -> HybridOutcome[Array]:
    """Apply the reset map to the cells at the end of a mode."""

    def passed() -> HybridOutcome[Array]:
        there, now = of_cells(one, lost), in_place_of(found, lost)
        transition = there.reset_map(now.state, greatest(t1 - now.end_time, 0.0))
        return chosen(lost, after_reset(jnp, found, transition, t1), found)

    return jax.lax.cond(jnp.any(lost), passed, lambda: found)


def of_cells(mode: AbstractBatchedMode, some: Bool[Array, " cells"]) -> AbstractBatchedMode:
    """A mode of some cells; the numbers of the first of them replace those of the others."""
    numbers, rest = eqx.partition(mode, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[..., _cell(some)], numbers), rest)


def in_place_of(found: HybridOutcome[Array], some: Bool[Array, " cells"]) -> HybridOutcome[Array]:
    """The state of some cells, with the first of them in place of the others, whose states have another meaning."""
    return jax.tree.map(lambda values: values[..., _cell(some)], found)


def _cell(some: Bool[Array, " cells"]) -> Int[Array, " cells"]:
    return jnp.where(some, jnp.arange(some.size), jnp.argmax(some))


def chosen(some: Bool[Array, " cells"], new: HybridOutcome[Array], old: HybridOutcome[Array]) -> HybridOutcome[Array]:
    """The new outcome of some cells and the old one of the others."""
    return jax.tree.map(lambda a, b: jnp.where(some, a, b), new, old)
