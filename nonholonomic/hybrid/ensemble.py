"""Hybrid motion: smooth modes with resets between them, for many cells at once and for one run with its path.

A mode has its own equations of motion and ends where they cease to hold: a contact opens or closes, slipping ends. The
mode's `reset_map` gives the transition to the next mode: an impact, a flight in closed form, other equations. All modes
share one layout of the state. The cells advance in rounds: each round solves the cells of each mode as one ensemble
(`integration/scheduler.py`) to the event, the horizon or the end of the mode, and applies the reset map to those at its
end. The loop over rounds runs on the host, with concrete numbers, or inside other transformed functions.
"""

import dataclasses
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

from ..compilation.cache import padded
from ..compilation.xla_cpu import compiled_quickly, greatest
from ..integration import (
    AbstractProblem,
    DenseSolution,
    Outcome,
    Settings,
    follow,
    solve_ensemble,
    traced_solve_ensemble,
)
from ..integration.dense import PIECE_OF_MODE
from ..integration.problem import FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from ..integration.scheduler import NO_EXTREMES, Numbers
from .mode import AbstractBatchedMode, Transition, mode_of_cells

#: Largest number of rounds, and so of modes in a run; then unfinished cells end as `UNRESOLVED`.
MOST_ROUNDS = 2000


class HybridOutcome(NamedTuple, Generic[Numbers]):
    """How every cell ended, as in `integration.Outcome`, with the mode in which it ended, and the counters.

    **Example:** as for `solve_hybrid`.

    >>> from nonholonomic.integration.problem import CROSSED
    >>> print(outcome.status == CROSSED, outcome.mode)
    [ True  True] [0 0]
    """

    status: Int[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    end_time: Float[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    steps: Int[Numbers, " cells"]
    rejected: Int[Numbers, " cells"]
    extremes: Float[Numbers, "3 cells"]
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
        extremes=xp.stack([xp.full(mode.shape, xp.inf), *xp.zeros((2, len(mode)))]),
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
    least, place, longest = outcome.extremes
    is_least = least < runs.extremes[0]
    shortest = (xp.where(is_least, *pair) for pair in zip((least, start_time + place), runs.extremes[:2], strict=True))
    # A cell that enters a mode beyond the event passed the event earlier, unless it started there.
    has_event = xp.isfinite(outcome.crossing_time) & ((outcome.crossing_time > 0.0) | xp.isinf(runs.crossing_time))
    return HybridOutcome(
        status=outcome.status,
        crossing_time=xp.where(has_event, start_time + outcome.crossing_time, runs.crossing_time),
        end_time=xp.where(outcome.status == REACHED_END, t1, start_time + outcome.end_time),
        state=outcome.state,
        steps=runs.steps + outcome.steps,
        rejected=runs.rejected + outcome.rejected,
        extremes=xp.stack([*shortest, xp.maximum(longest, runs.extremes[2])]),
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
        extremes=runs.extremes,
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
            (runs,), cell = carry, selected_cells(active)
            left = jnp.where(active, greatest(t1 - runs.end_time, 0.0), 0.0)
            problem = mode_of_cells(modes[numbers[0]], cell).problem(runs.state[:, cell])
            outcome, _ = traced_solve_ensemble(
                problem, left, jnp.asarray(size), settings, nonterminal=nonterminal, n_blocks=n_blocks
            )
            return (chosen(active, after_solve(jnp, runs, outcome, t1), runs),)

        return jax.lax.cond(jnp.any(active), solved, lambda: carry)

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " cells"]) -> Carry:
        def after_transition() -> Carry:
            (runs,), cell = carry, selected_cells(lost)
            left = greatest(t1[cell] - runs.end_time[cell], 0.0)
            transition = mode_of_cells(modes[numbers[0]], cell).reset_map(runs.state[:, cell], left)
            return (chosen(lost, after_reset(jnp, runs, transition, t1), runs),)

        return jax.lax.cond(jnp.any(lost), after_transition, lambda: carry)

    groups = [(number,) for number in range(len(modes))]
    (runs,) = traced_rounds((at_start(jnp, mode, state, cells, counters),), groups, solve, reset)
    return runs


def selected_cells(selected: Bool[Array, " cells"]) -> Int[Array, " cells"]:
    """The indices of the selected cells. The first selected cell replaces all others, because the states of the others
    may have another meaning."""
    return jnp.where(selected, jnp.arange(selected.size), jnp.argmax(selected))


def chosen(
    selected: Bool[Array, " cells"], new: HybridOutcome[Array], old: HybridOutcome[Array]
) -> HybridOutcome[Array]:
    """The new outcome for the selected cells, and the old outcome for the others."""
    return jax.tree.map(lambda a, b: jnp.where(selected, a, b), new, old)


# The resets of one hybrid run: the states before and after each of them.


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


# One hybrid run with its path: each mode is integrated by any solver of Diffrax.

#: The number of a segment between two modes.
BETWEEN = -1


class Segment(NamedTuple):
    """A segment of a run: from `begin` to `end` [s], in the mode numbered `number`, or `BETWEEN` two modes.

    `motion` is the `DenseSolution` in the mode, its times counted from `begin`, or one stretch of a `TransitionPath`;
    `shown` holds the default output times [s].

    **Example:** as for `solve_hybrid_dense`.

    >>> from nonholonomic.hybrid import solve_hybrid_dense
    >>> path = solve_hybrid_dense((Bounce(jnp.array([0.6])),), 0, start[:, 0], 0.4, settings, counters=1)
    >>> [(segment.begin, segment.end, segment.number) for segment in path.segments]
    [(0.0, 0.4, 0)]
    """

    begin: float
    end: float
    number: int
    mode: AbstractBatchedMode
    motion: Any
    shown: Float[np.ndarray, " times"]

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "shown times"]:
        """The output rows at times within the segment."""
        elapsed = np.maximum(times - self.begin, 0.0)
        if self.number == BETWEEN:
            return np.asarray(_between(self.mode, self.motion, jnp.asarray(np.minimum(elapsed, self.end - self.begin))))
        return np.asarray(_shown(self.mode, jnp.asarray(self.motion.at(np.minimum(elapsed, self.motion.times[-1])))))


class HybridPath(NamedTuple):
    """A hybrid run: its segments in order, how and when [s] it ended, its final state, and its cost.

    `status` is a code as in a `HybridOutcome`, and `mode` the index of the last mode; `counts` holds the counters.

    **Example:** as for `solve_hybrid_dense`.

    >>> from nonholonomic.hybrid import solve_hybrid_dense
    >>> path = solve_hybrid_dense((Bounce(jnp.array([0.6])),), 0, start[:, 0], 0.4, settings, counters=1)
    >>> path.failed, path.end_time, path.counts.tolist()
    (False, 0.4, [0])
    """

    segments: list[Segment]
    status: int
    end_time: float
    state: Float[np.ndarray, " components"]
    counts: Int[np.ndarray, " counters"]
    accepted: int
    rejected: int
    mode: int

    @property
    def left_domain(self) -> bool:
        """Whether the run ended where the model ceases to hold."""
        return self.status == LEFT_DOMAIN

    @property
    def failed(self) -> bool:
        """Whether the integration failed."""
        return self.status in (FAILED, UNRESOLVED)

    @property
    def mode_segments(self) -> list[Segment]:
        """The segments in modes, without those of zero length."""
        return [segment for segment in self.segments if segment.number != BETWEEN and segment.end > segment.begin]

    @property
    def times(self) -> Float[np.ndarray, " times"]:
        """The default output times [s]: the times of all steps."""
        return np.unique(
            np.minimum(np.concatenate([np.zeros(1), *(segment.shown for segment in self.segments)]), self.end_time)
        )

    @property
    def states(self) -> Float[np.ndarray, "shown times"]:
        """The output rows at these times."""
        return self.at(self.times)

    def numbers(self, times: Float[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        """The indices of the modes at given times, or `BETWEEN`."""
        return np.array([segment.number for segment in self.segments])[self._where(times)]

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "shown times"]:
        """The output rows at the given times, which must lie within the run; at the end of a segment, before the reset."""
        if not len(times):
            return self.segments[0].at(np.zeros(1))[:, :0]
        segment_indices, by_segment = self._where(times), []
        for index in np.unique(segment_indices):
            indices = np.flatnonzero(segment_indices == index)
            # Padded to one length, so that one program serves all segments.
            by_segment.append((indices, self.segments[index].at(padded(times[indices], len(times)))[:, : indices.size]))
        output = np.empty((len(by_segment[0][1]), len(times)))
        for indices, values in by_segment:
            output[:, indices] = values
        return output

    def _where(self, times: Float[np.ndarray, " times"]) -> Int[np.ndarray, " times"]:
        begins, ends = np.array([(segment.begin, segment.end) for segment in self.segments]).T
        ends = np.maximum.accumulate(ends + resolution(begins, ends))
        return np.minimum(np.searchsorted(ends, times), len(ends) - 1)


@eqx.filter_jit
def _problem(mode: AbstractBatchedMode, state: Float[Array | np.ndarray, " components"]) -> AbstractProblem:
    """The motion in a mode of one cell, as a problem without an axis of cells."""
    mode_of_cell = jax.tree.map(lambda leaf: leaf[..., 0] if eqx.is_array(leaf) and leaf.ndim else leaf, mode)
    return mode_of_cell.problem(state)


@compiled_quickly
def _leave(mode: AbstractBatchedMode, state: Float[Array, " components"], left: Float[Array, ""]) -> Transition:
    return mode.reset_map(state[:, None], left[None])


@eqx.filter_jit
def _shown(mode: AbstractBatchedMode, states: Float[Array, "components times"]) -> Float[Array, "shown times"]:
    return mode.shown(states)


@eqx.filter_jit
def _between(mode: AbstractBatchedMode, motion: Any, elapsed: Float[Array, " times"]) -> Float[Array, "shown times"]:
    return mode.between(motion, elapsed)


def solve_hybrid_dense(
    modes: tuple[AbstractBatchedMode, ...],
    number: int,
    state: Float[Array | np.ndarray, " components"],
    t1: float,
    settings: Settings,
    *,
    counters: int,
) -> HybridPath:
    """Integrate one run through its modes to `t1`, to an event during a transition, or to where the model ends.

    **Arguments:**

    - `modes`: as for `solve_hybrid`, for one cell; each mode must begin with a positive margin. The path includes the
      transitions that the modes record.
    - `number`, `state`: initial mode and state.
    - `t1`: horizon [s].
    - `settings`: as for `follow`; `max_steps` limits the steps of the whole run.
    - `counters`: number of counters, the rows of `Transition.counts`.

    **Returns:** a `HybridPath`.

    **Example:** a ball that rises in closed form, recorded as a transition, and falls from 0.722438 s on.

    >>> from nonholonomic.hybrid import TransitionPath, solve_hybrid_dense
    >>> class Rise(Bounce):
    ...     def reset_map(self, state, left):
    ...         rise = -self.restitution * state[1] / 9.81
    ...         apex = jnp.stack([0.5 * 9.81 * rise**2, 0.0 * rise])
    ...         record = TransitionPath(rise[None], rise[None], jnp.full((1, 1), 3))
    ...         return super().reset_map(state, left)._replace(state=apex, elapsed=rise, record=record)
    ...     def between(self, rise, passed):
    ...         return 9.81 * jnp.stack([rise * passed - 0.5 * passed**2, rise - passed])
    >>> path = solve_hybrid_dense((Rise(jnp.array([0.6])),), 0, start[:, 0], 1.0, settings, counters=1)
    >>> times = np.array([0.6, 0.8])
    >>> print(path.at(times)[0].round(5), path.numbers(times))
    [0.28647 0.33049] [-1  0]
    """

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[np.ndarray, "1"]) -> Carry:
        if not active[0]:
            return carry
        (runs, segments), (number,), mode, start_time = carry, numbers, modes[numbers[0]], float(carry[0].end_time[0])
        mode_settings = dataclasses.replace(settings, max_steps=settings.max_steps - int(runs.steps[0]))
        problem = _problem(mode, jnp.asarray(runs.state[:, 0]))
        path = follow(problem, t1 - start_time, mode_settings, piece=PIECE_OF_MODE)
        end = start_time + float(path.times[-1])
        segment = Segment(start_time, end, number, mode, path, start_time + path.times[1:])
        return after_solve(np, runs, _outcome(path), np.full(1, t1)), [*segments, segment]

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[np.ndarray, "1"]) -> Carry:
        if not lost[0]:
            return carry
        (runs, segments), mode, start_time = carry, modes[numbers[0]], float(carry[0].end_time[0])
        transition = _leave(mode, jnp.asarray(runs.state[:, 0]), jnp.asarray(t1 - start_time))
        segments = segments + _way(mode, transition, start_time)
        # NumPy slices these arrays, because JAX would compile every slice.
        transition = jax.tree.map(np.asarray, transition._replace(record=None))
        return after_reset(np, runs, transition, np.full(1, t1)), segments

    start = at_start(np, np.full(1, number), np.asarray(state)[:, None], 1, counters)
    runs, segments = host_rounds((start, []), [(mode,) for mode in range(len(modes))], solve, reset)
    end_time, status, steps, rejected = (
        values[0].item() for values in (runs.end_time, runs.status, runs.steps, runs.rejected)
    )
    if not (np.isfinite(runs.state).all() and np.isfinite(end_time)):
        end_time = segments[-1].end
    ending = (runs.state[:, 0], runs.counts[:, 0], steps - rejected, rejected, runs.mode[0].item())
    return HybridPath(segments, status, end_time, *ending)


def _outcome(path: DenseSolution) -> Outcome[np.ndarray]:
    """How the motion in a mode ended, as for an ensemble of one cell."""
    status = FAILED if path.failed else LEFT_DOMAIN if path.left_domain else REACHED_END
    no_crossing, steps = np.full(1, np.inf), path.accepted + path.rejected
    ending = (np.asarray(path.times[-1:]), np.asarray(path.states[:, -1:]))
    counts = (np.full(1, steps), np.full(1, path.rejected), np.array([NO_EXTREMES]).T)
    return Outcome(np.full(1, status), no_crossing, no_crossing, *ending, *counts)


def _way(mode: AbstractBatchedMode, transition: Transition, start: float) -> list[Segment]:
    """The segments of a transition that begins at a time [s]."""
    if transition.record is None:
        return []
    ends = np.asarray(transition.record.ends)[:, 0]
    ends, segments = start + ends[np.isfinite(ends)], []
    motions, parts = jax.tree.map(np.asarray, (transition.record.motions, transition.record.shown))
    for index, end in enumerate(ends):
        start = float(ends[index - 1]) if index else start
        motion = jax.tree.map(lambda leaf, index=index: leaf[index].copy(), motions)
        output_times = start + (end - start) * np.linspace(0.0, 1.0, int(parts[index, 0]) + 1)[1:]
        segments.append(Segment(start, float(end), BETWEEN, mode, motion, output_times))
    return segments
