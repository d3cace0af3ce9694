"""Hybrid motion of many cells at once: smooth modes with resets between them.

A mode has its own equations of motion and ends where they cease to hold: a contact opens or closes, slipping ends. The
mode's `reset_map` gives the transition to the next mode: an impact, a flight in closed form, other equations. All modes
share one layout of the state. The cells advance in rounds: each round solves the cells of each mode as one ensemble
(`integration/ensemble.py`) to the event, the horizon or the end of the mode, and applies the reset map to those at its
end. The loop over rounds runs on the host, with concrete numbers, or inside other transformed functions.
"""

import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import compiled_quickly, greatest
from ..integration import AbstractProblem, Outcome, Settings, solve_ensemble, traced_solve_ensemble
from ..integration.scheduler import Numbers
from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from .mode import AbstractBatchedMode, Transition, mode_of_cells

#: Largest number of rounds, and so of modes in a run; then unfinished cells end as `UNRESOLVED`.
MOST_ROUNDS = 2000


class HybridOutcome(NamedTuple, Generic[Numbers]):
    """How every cell ended, as in `integration.Outcome`, with the mode in which it ended, and the counters.

    **Example:** as for `solve_hybrid`.

    >>> from nonholonomic.integration.status import CROSSED
    >>> print(outcome.status == CROSSED, outcome.mode)
    [ True  True] [0 0]
    """

    status: Int[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    end_time: Float[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    steps: Int[Numbers, " cells"]
    rejected: Int[Numbers, " cells"]
    mode: Int[Numbers, " cells"]
    counts: Int[Numbers, "counters cells"]


#: The `HybridOutcome` of some runs, and further data that is kept of them.
Carry = tuple[Any, ...]

#: (the indices of some modes, carry, a mask of cells in these modes) -> the carry after these cells have advanced.
Advance = Callable[[Sequence[int], Carry, Any], Carry]


def at_start(
    xp: Any, mode: Int[Numbers, " cells"], state: Float[Numbers, "components cells"], cells: int, counters: int
) -> HybridOutcome[Numbers]:
    """All cells at their start, the first `cells` of them running. **Arguments:** `xp`: `numpy` or `jax.numpy`."""
    zeros = xp.zeros(mode.shape, int)
    return HybridOutcome(
        status=zeros + xp.where(xp.arange(len(mode)) < cells, RUNNING, REACHED_END),
        crossing_time=xp.full(mode.shape, xp.inf),
        end_time=xp.zeros(mode.shape),
        state=state,
        steps=zeros,
        rejected=zeros,
        mode=mode,
        counts=xp.zeros((counters, len(mode)), int),
    )


def one_round(carry: Carry, groups: Sequence[Sequence[int]], solve: Advance, reset: Advance) -> Carry:
    """Advance every running cell through its mode, and through the reset map if it is at the end of the mode.

    **Arguments:**

    - `groups`: the indices of the modes, in groups; one program serves the modes of a group.
    - `solve`, `reset`: advance the cells to the end of their mode, and through the reset map.
    """
    # A cell that changes its mode during the round waits for the next round.
    mode_before = carry[0].mode
    for numbers in groups:
        active = functools.reduce(operator.or_, (mode_before == number for number in numbers))
        active = active & (carry[0].status == RUNNING)
        carry = solve(numbers, carry, active)
        carry = reset(numbers, carry, active & (carry[0].status == LEFT_DOMAIN))
    return carry


def host_rounds(
    carry: Carry, groups: Sequence[Sequence[int]], solve: Advance, reset: Advance, most_rounds: int = MOST_ROUNDS
) -> Carry:
    """Loop over rounds while a cell is running, on the host. **Arguments:** as for `one_round`."""
    for _ in range(most_rounds):
        carry = one_round(carry, groups, solve, reset)
        if not (carry[0].status == RUNNING).any():
            break
    return (finished(np, carry[0]), *carry[1:])


def traced_rounds(carry: Carry, groups: Sequence[Sequence[int]], solve: Advance, reset: Advance) -> Carry:
    """Loop over rounds while a cell is running. **Arguments:** as for `one_round`, traced."""

    def under_way(carry: tuple[Carry, Int[Array, ""]]) -> Bool[Array, ""]:
        (runs, *_), rounds = carry
        return jnp.any(runs.status == RUNNING) & (rounds < MOST_ROUNDS)

    def advance(carry: tuple[Carry, Int[Array, ""]]) -> tuple[Carry, Int[Array, ""]]:
        return one_round(carry[0], groups, solve, reset), carry[1] + 1

    (runs, *records), _ = jax.lax.while_loop(under_way, advance, (carry, jnp.zeros((), int)))
    return (finished(jnp, runs), *records)


def finished(xp: Any, runs: HybridOutcome[Numbers]) -> HybridOutcome[Numbers]:
    """The runs after the last round."""
    return runs._replace(status=xp.where(runs.status == RUNNING, UNRESOLVED, runs.status))


def after_solve(
    xp: Any, runs: HybridOutcome[Numbers], outcome: Outcome[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after an ensemble solve that ended as in `outcome`. **Arguments:** `xp`: `numpy` or `jax.numpy`."""
    start_time = runs.end_time
    # A cell that enters a mode beyond the event passed the event earlier, unless it started there.
    has_event = xp.isfinite(outcome.crossing_time) & ((outcome.crossing_time > 0.0) | xp.isinf(runs.crossing_time))
    return HybridOutcome(
        status=outcome.status,
        crossing_time=xp.where(has_event, start_time + outcome.crossing_time, runs.crossing_time),
        end_time=xp.where(outcome.status == REACHED_END, t1, start_time + outcome.end_time),
        state=outcome.state,
        steps=runs.steps + outcome.steps,
        rejected=runs.rejected + outcome.rejected,
        mode=runs.mode,
        counts=runs.counts,
    )


def resolution(start: Float[Numbers, "*runs"], end: Float[Numbers, "*runs"]) -> Float[Numbers, "*runs"]:
    """How accurately the end of a mode is known [s], which lasts from `start` to `end` [s]: events are located to 1e-10 of a
    step, and times are rounded."""
    return 1e-10 * (end - start) + 16.0 * np.finfo(float).eps * end


def after_reset(
    xp: Any, runs: HybridOutcome[Numbers], transition: Transition[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after the transition to the next mode. **Arguments:** as for `after_solve`."""
    has_event = xp.isfinite(transition.crossing_time)
    # Non-finite states would never finish.
    sound = xp.isfinite(transition.state).all(axis=0) & xp.isfinite(transition.elapsed)
    return HybridOutcome(
        status=xp.where(sound, transition.status, FAILED),
        crossing_time=xp.where(has_event, runs.end_time + transition.crossing_time, runs.crossing_time),
        end_time=xp.where(transition.status == REACHED_END, t1, runs.end_time + transition.elapsed),
        state=transition.state,
        steps=runs.steps,
        rejected=runs.rejected,
        mode=transition.mode,
        counts=runs.counts + transition.counts,
    )


@eqx.filter_jit
def problem_of_cells(
    mode: AbstractBatchedMode, cell: Int[Numbers, " cells"], state: Float[Numbers, "components cells"]
) -> AbstractProblem:
    return mode_of_cells(mode, cell).problem(jnp.asarray(state))


@compiled_quickly
def reset_of_cells(
    mode: AbstractBatchedMode,
    cell: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
) -> Transition:
    return mode_of_cells(mode, cell).reset_map(state, left)


def solve_hybrid(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[np.ndarray, " cells"],
    state: Float[np.ndarray, "components cells"],
    t1: float | Float[np.ndarray, " cells"],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    nonterminal: bool = False,
    n_blocks: int = 1,
    most_rounds: int = MOST_ROUNDS,
) -> HybridOutcome[np.ndarray]:
    """Run every cell through its modes to its event, to `t1`, or to where the model ends.

    The loop runs on the host, round by round, with concrete numbers. All calls with the same number of cells, padding
    included, share their compiled programs.

    **Arguments:**

    - `modes`: the modes; `mode` and `Transition.mode` are indices into them.
    - `mode`, `state`: initial mode and state of every cell.
    - `t1`: horizon [s], one number for all cells or one per cell.
    - `cells`: number of cells to run; the rest is padding. With 0, programs are only compiled, but not those of rare
      modes.
    - `settings`: their solver must be an explicit Runge-Kutta solver of Diffrax.
    - `counters`: number of counters, the rows of `Transition.counts`.
    - `nonterminal`, `n_blocks`: as for `solve_ensemble`.
    - `most_rounds`: a cell that needs more ends as `UNRESOLVED`.

    **Returns:** a `HybridOutcome`.

    **Example:** the balls of the subpackage's example, through their highest points up to 1 s.

    >>> last = solve_hybrid(modes, first, start, 1.0, 2, settings, counters=1, nonterminal=True)
    >>> print(last.crossing_time.round(6), last.end_time)
    [0.722438 0.812743] [1. 1.]
    """
    t1 = np.broadcast_to(np.asarray(t1, float), len(mode))
    runs = at_start(np, np.asarray(mode), np.asarray(state), cells, counters)

    def solve(mode: AbstractBatchedMode, count: int, cell: Any, state: Any, left: Any) -> Outcome:
        options = {"nonterminal": nonterminal, "n_blocks": n_blocks}
        return solve_ensemble(problem_of_cells(mode, cell, state), left, np.asarray(count), settings, **options)[0]

    def reset(mode: AbstractBatchedMode, count: int, cell: Any, state: Any, left: Any) -> Transition:
        return reset_of_cells(mode, cell, state, left)

    def advanced(
        program: Callable[..., Any], update: Any, numbers: Sequence[int], carry: Carry, mask: Bool[np.ndarray, " cells"]
    ) -> Carry:
        (runs,), selected = carry, np.flatnonzero(mask)
        if not selected.size:
            return carry
        result = program(modes[numbers[0]], selected.size, *_gathered(runs, selected, t1))
        result = jax.tree.map(lambda values: np.asarray(values)[..., : selected.size], result)
        new = update(np, HybridOutcome(*(values[..., selected] for values in runs)), result, t1[selected])
        return (HybridOutcome(*(_with(*values, selected) for values in zip(runs, new, strict=True))),)

    if cells == 0:
        # Compile the programs by running no cells: two at once, because the compiler uses little more than one core.
        inputs, common = _gathered(runs, np.arange(0), t1), [mode for mode in modes if not mode.rare]
        with ThreadPoolExecutor(2) as threads:
            list(threads.map(lambda call: call[0](call[1], 0, *inputs), itertools.product((solve, reset), common)))
    programs = (functools.partial(advanced, solve, after_solve), functools.partial(advanced, reset, after_reset))
    return host_rounds((runs,), [(number,) for number in range(len(modes))], *programs, most_rounds)[0]


def _gathered(
    runs: HybridOutcome[np.ndarray], selected: Int[np.ndarray, " selected"], t1: Float[np.ndarray, " cells"]
) -> tuple[Int[np.ndarray, " cells"], Float[np.ndarray, "components cells"], Float[np.ndarray, " cells"]]:
    """The indices, the states and the remaining times of some cells, padded to the full number of cells."""
    padding = np.full(len(runs.status) - selected.size, selected[-1] if selected.size else 0)
    cell = np.concatenate([selected, padding])
    return cell, runs.state[:, cell], np.maximum(t1[cell] - runs.end_time[cell], 0.0)


def _with(values: np.ndarray, new: np.ndarray, selected: Int[np.ndarray, " selected"]) -> np.ndarray:
    """The values of all cells with the new ones of some."""
    values = values.copy()
    values[..., selected] = new
    return values


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

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[Array, " cells"]) -> Carry:
        def solved() -> Carry:
            (runs,), cell = carry, padded(active)
            left = jnp.where(active, greatest(t1 - runs.end_time, 0.0), 0.0)
            problem = mode_of_cells(modes[numbers[0]], cell).problem(runs.state[:, cell])
            outcome, _ = traced_solve_ensemble(
                problem, left, jnp.asarray(size), settings, nonterminal=nonterminal, n_blocks=n_blocks
            )
            return (chosen(active, after_solve(jnp, runs, outcome, t1), runs),)

        return jax.lax.cond(jnp.any(active), solved, lambda: carry)

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " cells"]) -> Carry:
        def after_transition() -> Carry:
            (runs,), cell = carry, padded(lost)
            left = greatest(t1[cell] - runs.end_time[cell], 0.0)
            transition = mode_of_cells(modes[numbers[0]], cell).reset_map(runs.state[:, cell], left)
            return (chosen(lost, after_reset(jnp, runs, transition, t1), runs),)

        return jax.lax.cond(jnp.any(lost), after_transition, lambda: carry)

    groups = [(number,) for number in range(len(modes))]
    (runs,) = traced_rounds((at_start(jnp, mode, state, cells, counters),), groups, solve, reset)
    return runs


def padded(selected: Bool[Array, " cells"]) -> Int[Array, " cells"]:
    """The indices of the selected cells. The first selected cell replaces all others, because the states of the others
    may have another meaning."""
    return jnp.where(selected, jnp.arange(selected.size), jnp.argmax(selected))


def chosen(
    selected: Bool[Array, " cells"], new: HybridOutcome[Array], old: HybridOutcome[Array]
) -> HybridOutcome[Array]:
    """The new outcome for the selected cells, and the old outcome for the others."""
    return jax.tree.map(lambda a, b: jnp.where(selected, a, b), new, old)
