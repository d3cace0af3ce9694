"""Hybrid motion: smooth modes with resets between them, which may take time, for many cells at once and for one run with
its path.

A mode has its own equations of motion and ends where they cease to hold: a contact opens or closes, slipping ends. The
mode's `reset_map` gives the transition to the next mode: an impact, a flight in closed form, other equations. The states of
all modes have the same number of components. The cells advance in rounds: each round solves the cells of each mode as one
ensemble (`integration/scheduler.py`) to the event, the horizon or the end of the mode, and applies the reset map to those
at its end. The loop over rounds runs on the host, with concrete numbers, or inside other transformed functions.
"""

import abc
import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.cache import padded
from ..compilation.xla_cpu import compiled_quickly
from ..integration import AbstractProblem, CoreProblem, Lanes, Outcome, Settings, States, follow, solve_ensemble
from ..integration.dense import PIECE_OF_MODE
from ..integration.problem import FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from ..integration.scheduler import NO_EXTREMES, Numbers, of_cells

#: A kind of mode.
Mode = TypeVar("Mode", bound="AbstractBatchedMode")


class TransitionPath(NamedTuple):
    """Path from one mode to the next, with the cells last, as successive stretches of motion in closed form.

    - `ends`: when each stretch ends [s], counted from the end of the mode; infinite for unused entries.
    - `motions`: for each stretch the argument of `AbstractBatchedMode.between`; the first axis of every leaf counts the
      stretches.
    - `shown`: number of default output times of each stretch.

    **Example:** a hop of 0.4 s in closed form, drawn with three points.

    >>> from nonholonomic.hybrid import TransitionPath
    >>> record = TransitionPath(jnp.array([[0.4]]), {"speed": jnp.array([[1.962]])}, jnp.array([[3]]))
    """

    ends: Float[Array, " stretches 1"]
    motions: PyTree
    shown: Int[Array, " stretches 1"]


class Transition(NamedTuple, Generic[Numbers]):
    """The result of a reset map, one number per cell.

    `status` is `RUNNING` where the motion continues in the mode numbered `mode`, otherwise the code for how it ended;
    `state` is the new state, `elapsed` [s] the duration of the transition, and `crossing_time` [s] the last time of the
    event during the transition, infinite if there was none. `counts` contains the counters, one per row. `record` is
    the path, for the output rows on the way; `None` for instantaneous transitions, or where no path is kept. `log_rates` is
    the sum of the logarithms of the rates of the event functions at the events during the transition; `None` if there
    are none.

    **Example:** the bounce of both balls at 5 m/s.

    >>> transition = modes[0].reset_map(jnp.array([[0.0, 0.0], [-5.0, -5.0]]), jnp.ones(2))
    >>> print(transition.state[1], transition.mode)
    [3. 4.] [0 0]
    """

    mode: Int[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    elapsed: Float[Numbers, " cells"]
    status: Int[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    counts: Int[Numbers, "counters cells"]
    record: TransitionPath | None = None
    log_rates: Float[Numbers, " cells"] | None = None


class AbstractBatchedMode(eqx.Module):
    """One mode of a hybrid system. Its leaves are scalars, or hold one number per cell in their last axis.

    **Example:** the mode of the subpackage's example, at its start.

    >>> print(modes[0].problem(start).field(0.0, start)[1])
    [-9.81 -9.81]
    """

    #: Whether few runs enter the mode: its programs are compiled when a run enters it, not beforehand.
    rare: ClassVar[bool] = False

    @abc.abstractmethod
    def problem(self, state: States) -> AbstractProblem:
        """The motion in this mode from the given states; the mode ends where the problem's domain margin vanishes."""

    @abc.abstractmethod
    def reset_map(self, state: States, left: Lanes) -> Transition:
        """Map the states at the end of the mode, where the domain margin vanishes, to the start of the next mode.

        **Arguments:**

        - `state`: the states at the end of the mode.
        - `left`: time [s] to the horizon.

        **Returns:** a `Transition`, which ends with `REACHED_END` where it would take longer than `left`.
        """

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        """Map mode states to output rows; every mode must return the same number of rows."""
        return state

    def between(self, motion: PyTree, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        """The output rows of one stretch in `Transition.record`, at times [s] counted from its start."""
        raise NotImplementedError(f"{type(self).__name__} records stretches but does not say what they show")


#: The modes of a system, by their index; and the state of one run.
Modes = tuple[AbstractBatchedMode, ...]
OneState = Float[Array | np.ndarray, " components"]


class StartedProblem(CoreProblem):
    """The leading components of a problem, which may be all, from other states."""

    states: States

    def start(self) -> tuple[States, States]:
        return self.states, super().start()[1]


class OnlyMode(AbstractBatchedMode):
    """The only mode of a smooth motion: a run ends where the motion leaves its domain."""

    motion: AbstractProblem

    def problem(self, state: States) -> StartedProblem:
        return StartedProblem(self.motion, len(state), state)

    def reset_map(self, state: States, left: Lanes) -> Transition:
        none = jnp.zeros(state.shape[1:], int)
        return Transition(none, state, none + 0.0, none + LEFT_DOMAIN, none + jnp.inf, none[None])


class AbstractHoppingMode(AbstractBatchedMode):
    """A mode whose reset map is a succession of stretches of motion in closed form, each with a jump at its end.

    The reset map continues while `open` is true for the current stretch, for at most `most_hops` stretches; `elapsed`
    [s] of a stretch is the time since the end of the mode.

    **Example:** small hops of a ball, and the first of them.

    >>> from typing import NamedTuple
    >>> from nonholonomic.hybrid import AbstractHoppingMode
    >>> class Hop(NamedTuple):
    ...     speed: jax.Array
    ...     elapsed: jax.Array
    ...     open: jax.Array
    >>> class Hops(Bounce, AbstractHoppingMode):
    ...     most_hops = 100
    ...     def lost(self, state):
    ...         return Hop(-self.restitution * state[1], 0.0 * state[1], state[1] < -0.1)
    ...     def hop(self, stretch, left):
    ...         end = stretch._replace(elapsed=stretch.elapsed + 2.0 * stretch.speed / 9.81)
    ...         return end, Hop(self.restitution * stretch.speed, end.elapsed, stretch.speed > 0.1)
    ...     def closed(self, stretch):
    ...         return self.reset_map(jnp.stack([0.0 * stretch.speed, -stretch.speed]), stretch.elapsed)
    ...     def motion_in(self, stretch):
    ...         return stretch.speed
    >>> hops = Hops(jnp.array([0.6, 0.8]))
    >>> end, following = hops.hop(hops.lost(jnp.array([[0.0, 0.0], [-9.81, -9.81]])), jnp.ones(2))
    >>> print(end.elapsed, (following.speed / 9.81).round(2))
    [1.2 1.6] [0.36 0.64]
    """

    most_hops: ClassVar[int]

    def all_hops(
        self, first: PyTree, left: Lanes, kept: PyTree, keep: Callable[[PyTree, PyTree, PyTree, PyTree], PyTree]
    ) -> tuple[PyTree, PyTree]:
        """Follow the stretches from the first one on.

        **Arguments:** `left`: as for `hop`; `kept`: what is kept of the stretches; `keep`: function of what is kept, of a
            stretch at its begin and at its end, and of the next one, that returns what is kept then.

        **Returns:** the stretch after the last one, and what is kept.
        """

        def hop(carry: tuple[PyTree, Array, PyTree]) -> tuple[PyTree, Array, PyTree]:
            stretch, count, kept = carry
            end, following = self.hop(stretch, left)
            return following, count + 1, keep(kept, stretch, end, following)

        def goes_on(carry: tuple[PyTree, Array, PyTree]) -> Bool[Array, ""]:
            return jnp.any(carry[0].open) & (carry[1] < self.most_hops)

        stretch, _, kept = jax.lax.while_loop(goes_on, hop, (first, jnp.zeros((), int), kept))
        return stretch, kept

    @abc.abstractmethod
    def lost(self, state: States) -> PyTree:
        """The first stretch of motion after the mode, which starts from the states at its end."""

    @abc.abstractmethod
    def hop(self, stretch: PyTree, left: Lanes) -> tuple[PyTree, PyTree]:
        """Follow one stretch of motion; `left` [s] is the time from the end of the mode to the horizon.

        **Returns:** the stretch at its end, before the jump; and the next stretch, after the jump.
        """

    @abc.abstractmethod
    def closed(self, stretch: PyTree) -> Transition:
        """The transition that the last stretch leads to, without a record."""

    @abc.abstractmethod
    def motion_in(self, stretch: PyTree) -> PyTree:
        """The argument of `between` for a stretch that begins."""


def program_groups(modes: Sequence[AbstractBatchedMode]) -> list[tuple[int, ...]]:
    """The indices of the modes, in groups. The modes of a group differ only in the values of their arrays, so they
    share a program."""
    # The modes with the shapes of their arrays in place of their values.
    shapes = [
        jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)) if eqx.is_array(leaf) else leaf, mode) for mode in modes
    ]
    firsts = [next(k for k, other in enumerate(shapes) if eqx.tree_equal(other, shape)) for shape in shapes]
    return [tuple(k for k, other in enumerate(firsts) if other == first) for first in dict.fromkeys(firsts)]


def mode_numbered(modes: Sequence[Mode], numbers: Sequence[int], selected: Int[Array, "..."]) -> Mode:
    """The mode numbered `selected` in one of the `program_groups`."""
    mode = modes[numbers[0]]
    for number in numbers[1:]:

        def leaf(old: PyTree, new: PyTree, number: int = number) -> PyTree:
            return old if old is new or not eqx.is_array(old) else jnp.where(selected == number, new, old)

        mode = jax.tree.map(leaf, mode, modes[number])
    return mode


# The rounds.

#: Largest number of rounds, and so of modes in a run; then unfinished cells end as `UNRESOLVED`. So do cells with this many
#: modes in a row that last no longer than this fraction of the time so far: where a ball comes to rest in infinitely many
#: bounces, the round-off of its height leaves bounces of 1e-8 s.
MOST_ROUNDS, MOST_STALLED, STALLED = 2000, 100, 1e-7


class HybridOutcome(NamedTuple, Generic[Numbers]):
    """How every cell ended, as in `integration.Outcome`, with the mode in which it ended, the number of modes just before the
    end that took hardly any time, and the counters.

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
    stalled: Int[Numbers, " cells"]
    counts: Int[Numbers, "counters cells"]


#: A number of runs or of rounds; and the indices of the modes, in groups, each with a program of its own.
Count = Int[Array, ""] | int
Groups = Sequence[Sequence[int]]

#: The `HybridOutcome` of some runs, and further data that is kept of them.
Carry = tuple[PyTree, ...]

#: (the indices of some modes, the indices of cells in these modes, how many of them are not padding, carry of these cells)
#: -> the carry after these cells have advanced.
Advance = Callable[[Sequence[int], Int[Numbers, " cells"], Int[Numbers, ""], Carry], Carry]


def at_start(
    mode: Int[Numbers, " cells"], state: Float[Numbers, "components cells"], cells: Count, counters: int
) -> HybridOutcome[Numbers]:
    """All cells at their start, the first `cells` of them running."""
    xp = mode.__array_namespace__()
    zeros, shape = xp.zeros(mode.shape, int), mode.shape
    return HybridOutcome(
        status=zeros + xp.where(xp.arange(len(mode)) < cells, RUNNING, REACHED_END),
        crossing_time=xp.full(shape, xp.inf),
        end_time=xp.zeros(shape),
        state=state,
        steps=zeros,
        rejected=zeros,
        extremes=xp.tile(xp.asarray(NO_EXTREMES)[:, None], len(mode)),
        mode=mode,
        stalled=zeros,
        counts=xp.zeros((counters, len(mode)), int),
    )


def advanced(advance: Advance, numbers: Sequence[int], carry: Carry, mask: Bool[Numbers, " cells"]) -> Carry:
    """The carry, whose arrays have the cells last, after the masked cells have advanced, if there are any."""
    if isinstance(mask, np.ndarray):
        selected = np.flatnonzero(mask)
        if not selected.size:
            return carry
        # The first of them is the padding: in other modes, the components of the state may mean something else.
        cell = np.full(mask.size, selected[0])
        cell[: selected.size] = selected
        new = advance(numbers, cell, np.asarray(selected.size), of_cells(carry, cell))

        def placed(old: np.ndarray, new: np.ndarray) -> np.ndarray:
            values = old.copy()
            values[..., selected] = new[..., : selected.size]
            return values

        return jax.tree.map(placed, carry, new)

    def of_masked() -> Carry:
        if mask.size == 1:
            return advance(numbers, jnp.zeros(1, int), jnp.ones((), int), carry)
        count, place = jnp.sum(mask), jnp.maximum(jnp.cumsum(mask) - 1, 0)
        cell = jnp.argsort(~mask, stable=True)
        cell = jnp.where(jnp.arange(mask.size) < count, cell, cell[0])
        new = advance(numbers, cell, count, of_cells(carry, cell))
        return jax.tree.map(lambda old, new: jnp.where(mask, new[..., place], old), carry, new)

    return jax.lax.cond(jnp.any(mask), of_masked, lambda: carry)


def one_round(carry: Carry, groups: Groups, solve: Advance, reset: Advance) -> tuple[Carry, Carry]:
    """Advance every running cell through its mode, and through the reset map if it is at the end of the mode.

    **Arguments:**

    - `groups`: the indices of the modes, in groups; one program serves the modes of a group.
    - `solve`, `reset`: advance the cells to the end of their mode, and through the reset map.

    **Returns:** the carry at the ends of the modes, and after the resets.
    """
    runs, ended = carry[0], carry
    masks = [functools.reduce(operator.or_, (runs.mode == number for number in numbers)) for numbers in groups]
    for numbers, mask in zip(groups, masks, strict=True):
        ended = advanced(solve, numbers, ended, mask & (runs.status == RUNNING))
    # A cell that changes its mode during the round waits for the next round.
    after, is_lost = ended, (runs.status == RUNNING) & (ended[0].status == LEFT_DOMAIN)
    for numbers, mask in zip(groups, masks, strict=True):
        after = advanced(reset, numbers, after, mask & is_lost)
    return ended, after


def all_rounds(carry: Carry, groups: Groups, solve: Advance, reset: Advance, most_rounds: Count = MOST_ROUNDS) -> Carry:
    """Loop over rounds while a cell is running, on the host if the runs are NumPy arrays. **Arguments:** as for `one_round`."""
    xp = carry[0].status.__array_namespace__()
    if xp is np:
        for _ in range(most_rounds):
            _, carry = one_round(carry, groups, solve, reset)
            if not (carry[0].status == RUNNING).any():
                break
    else:
        carry, _ = jax.lax.while_loop(
            lambda loop: jnp.any(loop[0][0].status == RUNNING) & (loop[1] < most_rounds),
            lambda loop: (one_round(loop[0], groups, solve, reset)[1], loop[1] + 1),
            (carry, jnp.zeros((), int)),
        )
    runs, *records = carry
    return (runs._replace(status=xp.where(runs.status == RUNNING, UNRESOLVED, runs.status)), *records)


def time_left(runs: HybridOutcome[Numbers], t1: Float[Numbers, " cells"]) -> Float[Numbers, " cells"]:
    """The time [s] to the horizon."""
    left = t1 - runs.end_time
    return left.__array_namespace__().where(left < 0.0, 0.0, left)


def after_solve(
    runs: HybridOutcome[Numbers], outcome: Outcome[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after an ensemble solve that ended as in `outcome`."""
    xp, start_time = runs.status.__array_namespace__(), runs.end_time
    least, place, longest = outcome.extremes
    is_least = least < runs.extremes[0]
    shortest = (xp.where(is_least, *pair) for pair in zip((least, start_time + place), runs.extremes[:2], strict=True))
    # A cell that enters a mode beyond the event passed the event earlier, unless it started there.
    has_event = xp.isfinite(outcome.crossing_time) & ((outcome.crossing_time > 0.0) | xp.isinf(runs.crossing_time))
    stalled = xp.where(outcome.end_time <= STALLED * start_time, runs.stalled + 1, 0)
    is_stuck = (outcome.status == LEFT_DOMAIN) & (stalled >= MOST_STALLED)
    return HybridOutcome(
        status=xp.where(is_stuck, UNRESOLVED, outcome.status),
        crossing_time=xp.where(has_event, start_time + outcome.crossing_time, runs.crossing_time),
        end_time=xp.where(outcome.status == REACHED_END, t1, start_time + outcome.end_time),
        state=outcome.state,
        steps=runs.steps + outcome.steps,
        rejected=runs.rejected + outcome.rejected,
        extremes=xp.stack([*shortest, xp.maximum(longest, runs.extremes[2])]),
        mode=runs.mode,
        stalled=stalled,
        counts=runs.counts,
    )


def resolution(start: Float[Numbers, "*runs"], end: Float[Numbers, "*runs"]) -> Float[Numbers, "*runs"]:
    """How accurately the end of a mode is known [s], which lasts from `start` to `end` [s]: events are located to 1e-10 of a
    step, and times are rounded."""
    return 1e-10 * (end - start) + 16.0 * np.finfo(float).eps * end


def after_reset(
    runs: HybridOutcome[Numbers], transition: Transition[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after the transition to the next mode."""
    xp = runs.status.__array_namespace__()
    has_event = xp.isfinite(transition.crossing_time)
    # Non-finite states would never finish.
    sound = xp.isfinite(transition.state).all(axis=0) & xp.isfinite(transition.elapsed)
    return runs._replace(
        status=xp.where(sound, transition.status, FAILED),
        crossing_time=xp.where(has_event, runs.end_time + transition.crossing_time, runs.crossing_time),
        end_time=xp.where(transition.status == REACHED_END, t1, runs.end_time + transition.elapsed),
        state=transition.state,
        mode=transition.mode,
        counts=runs.counts + transition.counts,
    )


@eqx.filter_jit
def problem_of_cells(
    mode: AbstractBatchedMode, cell: Int[Numbers, " cells"] | int, state: Float[Numbers, "components *cells"]
) -> AbstractProblem:
    """The motion of some cells in a mode; of a single cell as a problem without an axis of cells."""
    return of_cells(mode, cell).problem(jnp.asarray(state))


def reset_of_cells(mode: AbstractBatchedMode, cell: Int[Array, " cells"], state: States, left: Lanes) -> Transition:
    """The transition of some cells at the end of a mode."""
    return of_cells(mode, cell).reset_map(state, left)


_reset_alone = compiled_quickly(reset_of_cells)


def solve_hybrid(
    modes: Modes,
    mode: Int[Numbers, " cells"],
    state: Float[Numbers, "components cells"],
    t1: float | Float[Numbers, "*cells"],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    nonterminal: bool = False,
    n_blocks: int = 1,
    most_rounds: int = MOST_ROUNDS,
    traced: bool = False,
) -> HybridOutcome[Numbers]:
    """Run every cell through its modes to its event, to `t1`, or to where the model ends.

    The loop runs on the host, round by round, with concrete numbers. All calls with the same number of cells, padding
    included, share their compiled programs. If `traced`, the loop is one program, for use inside other transformed functions;
    in each round, every mode with a running cell then runs all cells, but the horizon is 0 for cells in another mode.

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
    - `traced`: whether numbers may be traced.

    **Returns:** a `HybridOutcome`, of NumPy arrays, or of JAX's if `traced`.

    **Example:** the balls of the subpackage's example, through their highest points up to 1 s.

    >>> last = solve_hybrid(modes, first, start, 1.0, 2, settings, counters=1, nonterminal=True)
    >>> print(last.crossing_time.round(6), last.end_time)
    [0.722438 0.812743] [1. 1.]

    Inside `jit`:

    >>> solve = lambda t1: solve_hybrid(
    ...     modes, jnp.asarray(first), jnp.asarray(start), t1, 2, settings, counters=1, traced=True
    ... )
    >>> print(jax.jit(solve)(5.0).crossing_time.round(6))
    [0.722438 0.812743]
    """
    xp: Any = jnp if traced else np
    horizon, groups = xp.broadcast_to(xp.asarray(t1, float), len(mode)), [(number,) for number in range(len(modes))]
    runs = at_start(xp.asarray(mode), xp.asarray(state), cells, counters)
    advances = _advances(modes, horizon, settings, nonterminal=nonterminal, n_blocks=n_blocks, traced=traced)
    if not traced and cells == 0:
        # Compile the programs by running no cells: two at once, because the compiler uses little more than one core.
        common = [numbers for numbers, of_number in zip(groups, modes, strict=True) if not of_number.rare]
        padding = np.zeros(len(mode), int)
        with ThreadPoolExecutor(2) as threads:
            calls = itertools.product(advances, common)
            list(threads.map(lambda call: call[0](call[1], padding, np.asarray(0), (runs,)), calls))
    return all_rounds((runs,), groups, *advances, most_rounds)[0]


def _advances(
    modes: Modes, t1: Float[Numbers, " cells"], settings: Settings, *, traced: bool = False, **options: Any
) -> tuple[Advance, Advance]:
    """Advance cells through a mode, and through its reset map. **Arguments:** as for `solve_hybrid`; `options`: of
    `solve_ensemble`."""
    xp = t1.__array_namespace__()
    reset_map: Callable[..., Transition] = reset_of_cells if traced else _reset_alone

    def solve(numbers: Sequence[int], cell: Int[Numbers, " cells"], count: Int[Numbers, ""], carry: Carry) -> Carry:
        (runs,), horizon = carry, t1[cell]
        problem = problem_of_cells(modes[numbers[0]], cell, runs.state)
        left = time_left(runs, horizon)
        outcome, _ = solve_ensemble(problem, left, count, settings, traced=traced, **options)
        return (after_solve(runs, jax.tree.map(xp.asarray, outcome), horizon),)

    def reset(numbers: Sequence[int], cell: Int[Numbers, " cells"], _: Int[Numbers, ""], carry: Carry) -> Carry:
        (runs,), horizon = carry, t1[cell]
        transition = reset_map(modes[numbers[0]], cell, runs.state, time_left(runs, horizon))
        return (after_reset(runs, jax.tree.map(xp.asarray, transition), horizon),)

    return solve, reset


def hybrid_resets(
    modes: Modes, number: int, state: OneState, t1: float, settings: Settings, *, counters: int
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
    horizon, resets = np.full(1, float(t1)), []
    solve, leave = _advances(modes, horizon, settings)

    def reset(numbers: Sequence[int], cell: Int[np.ndarray, "1"], count: np.ndarray, carry: Carry) -> Carry:
        after = leave(numbers, cell, count, carry)
        resets.append((*carry, *after))
        return after

    runs = at_start(np.full(1, number), np.asarray(state)[:, None], 1, counters)
    all_rounds((runs,), [(mode,) for mode in range(len(modes))], solve, reset)
    return resets


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
    motion: PyTree
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


_shown = eqx.filter_jit(lambda mode, states: mode.shown(states))
_between = eqx.filter_jit(lambda mode, motion, elapsed: mode.between(motion, elapsed))


def solve_hybrid_dense(
    modes: Modes, number: int, state: OneState, t1: float, settings: Settings, *, counters: int
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

    horizon, segments = np.full(1, float(t1)), []

    def solve(numbers: Sequence[int], cell: Int[np.ndarray, "1"], _: np.ndarray, carry: Carry) -> Carry:
        (runs,), number = carry, numbers[0]
        begin, steps = runs.end_time[0].item(), runs.steps[0].item()
        problem = problem_of_cells(modes[number], 0, runs.state[:, 0])
        rest = dataclasses.replace(settings, max_steps=settings.max_steps - steps)
        path = follow(problem, t1 - begin, rest, piece=PIECE_OF_MODE)
        end = begin + float(path.times[-1])
        segments.append(Segment(begin, end, number, modes[number], path, begin + path.times[1:]))
        # As for an ensemble of one cell.
        none, ending = np.full(1, np.inf), (np.asarray(path.times[-1:]), np.asarray(path.states[:, -1:]))
        counts = (np.full(1, path.accepted + path.rejected), np.full(1, path.rejected), np.array([NO_EXTREMES]).T)
        return (after_solve(runs, Outcome(np.full(1, path.status), none, none, *ending, *counts), horizon),)

    def reset(numbers: Sequence[int], cell: Int[np.ndarray, "1"], _: np.ndarray, carry: Carry) -> Carry:
        (runs,), mode = carry, modes[numbers[0]]
        transition = jax.tree.map(np.asarray, _reset_alone(mode, cell, runs.state, time_left(runs, horizon)))
        if transition.record is not None:
            # NumPy slices these arrays, because JAX would compile every slice.
            ends, motions, parts = transition.record
            begin = runs.end_time[0].item()
            ends = begin + ends[np.isfinite(ends[:, 0]), 0]
            for index, (end, count) in enumerate(zip(ends.tolist(), parts[:, 0].tolist(), strict=False)):
                motion = jax.tree.map(lambda leaf, index=index: leaf[index].copy(), motions)
                times = begin + (end - begin) * np.linspace(0.0, 1.0, count + 1)[1:]
                segments.append(Segment(begin, end, BETWEEN, mode, motion, times))
                begin = end
        return (after_reset(runs, transition, horizon),)

    start = at_start(np.full(1, number), np.asarray(state)[:, None], 1, counters)
    (runs,) = all_rounds((start,), [(mode,) for mode in range(len(modes))], solve, reset)
    end_time, status, steps, rejected = (
        values[0].item() for values in (runs.end_time, runs.status, runs.steps, runs.rejected)
    )
    if not (np.isfinite(runs.state).all() and np.isfinite(end_time)):
        end_time = segments[-1].end
    ending = (runs.state[:, 0], runs.counts[:, 0], steps - rejected, rejected, runs.mode[0].item())
    return HybridPath(segments, status, end_time, *ending)
