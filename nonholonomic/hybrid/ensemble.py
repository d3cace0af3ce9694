"""Hybrid motion of many cells at once: smooth modes with resets between them.

A mode has its own equations of motion and ends where they cease to hold: a contact opens or closes, slipping ends. The
mode's `reset_map` gives the transition to the next mode: an impact, a flight in closed form, other equations. All modes
share one layout of the state. The cells advance in rounds: each round gathers the cells of each mode, solves them as
one ensemble (`integration/ensemble.py`) to the event, the horizon or the end of the mode, and applies the reset map to
those at its end.
"""

import abc
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..integration.ensemble import solve_ensemble
from ..integration.problem import AbstractProblem
from ..integration.scheduler import Numbers, Outcome
from ..integration.settings import Settings
from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from ..xla_cpu import compiled_quickly

#: Most rounds, and so most modes of a single run, before unfinished cells end as `UNRESOLVED`.
MOST_ROUNDS = 2000


class TransitionPath(NamedTuple):
    """Path of a single run from one mode to the next, as successive stretches of motion in closed form.

    - `ends`: when each stretch ends [s], counted from the end of the mode; infinite for unused entries.
    - `motions`: for each stretch the argument of `AbstractBatchedMode.between`; the first axis of every leaf counts the
      stretches.
    - `shown`: number of default output times of each stretch.

    **Example:** a hop of 0.4 s in closed form, drawn with three points.

    >>> from nonholonomic.hybrid import TransitionPath
    >>> record = TransitionPath(jnp.array([[0.4]]), {"speed": jnp.array([[1.962]])}, jnp.array([[3]]))
    """

    ends: Float[Array, " stretches 1"]
    motions: Any
    shown: Int[Array, " stretches 1"]


class Transition(NamedTuple, Generic[Numbers]):
    """The result of a reset map, one number per cell.

    `status` is `RUNNING` where the motion continues in the mode numbered `mode`, otherwise the code for how it ended;
    `state` is the new state, `elapsed` [s] the duration of the transition, and `crossing_time` [s] the last time of the
    event during the transition, infinite if there was none. `counts` contains the counters, one per row. `record` is
    the path of a single run (`path.py`); `None` for instantaneous transitions, or where no path is kept. `log_rates` is
    the sum of the logarithms of the rates at which events on the way are met; `None` if there are none.

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

    **Example:** the mode of the room's example, at its start.

    >>> print(modes[0].problem(start).field(0.0, start)[1])
    [-9.81 -9.81]
    """

    @abc.abstractmethod
    def problem(self, state: Float[Array, "components cells"]) -> AbstractProblem:
        """The motion in this mode from the given states; the mode ends where the problem's domain margin vanishes."""

    @abc.abstractmethod
    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """Map the states at the end of the mode, where the domain margin vanishes, to the start of the next mode.

        **Arguments:**

        - `state`: the states at the end of the mode.
        - `left`: time [s] to the horizon.

        **Returns:** a `Transition`, which ends with `REACHED_END` where it would take longer than `left`.
        """

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        """Map mode states to output rows; every mode must return the same number of rows."""
        return state

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        """The output rows of one stretch in `Transition.record`, at times [s] counted from its start."""
        raise NotImplementedError(f"{type(self).__name__} records stretches but does not say what they show")


class AbstractHoppingMode(AbstractBatchedMode):
    """A mode whose reset map is a succession of stretches of motion in closed form, each with a jump at its end.

    The reset map goes on while a stretch's `open` holds, for at most `most_hops` stretches; its `elapsed` [s] counts from the
    end of the mode.

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

    @abc.abstractmethod
    def lost(self, state: Float[Array, "components cells"]) -> Any:
        """The first stretch of motion after the mode, which starts from the states at its end."""

    @abc.abstractmethod
    def hop(self, stretch: Any, left: Float[Array, " cells"]) -> tuple[Any, Any]:
        """Follow one stretch of motion; `left` [s] is the time from the end of the mode to the horizon.

        **Returns:** the stretch at its end, before the jump; and the next stretch, after the jump.
        """

    @abc.abstractmethod
    def closed(self, stretch: Any) -> Transition:
        """The transition that the last stretch leads to, without a record."""

    @abc.abstractmethod
    def motion_in(self, stretch: Any) -> Any:
        """The argument of `between` for a stretch that begins."""


class HybridOutcome(NamedTuple, Generic[Numbers]):
    """How every cell ended, as in `integration.Outcome`, with the mode in which it ended, and the counters.

    **Example:** as for `solve_hybrid`.

    >>> from nonholonomic.integration import CROSSED
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


@eqx.filter_jit
def _problem(
    mode: AbstractBatchedMode, cell: Int[Numbers, " cells"], state: Float[Numbers, "components cells"]
) -> AbstractProblem:
    return mode_of_cells(mode, cell).problem(jnp.asarray(state))


@compiled_quickly
def _reset_map(
    mode: AbstractBatchedMode,
    cell: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
) -> Transition:
    return mode_of_cells(mode, cell).reset_map(state, left)


def mode_of_cells(mode: AbstractBatchedMode, cell: Int[Numbers, " selected"]) -> AbstractBatchedMode:
    """The mode of the cells with these numbers."""
    numbers, static = eqx.partition(mode, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[..., cell], numbers), static)


def runs_of_cells(runs: HybridOutcome[Numbers], cell: Int[Numbers, " selected"]) -> HybridOutcome[Numbers]:
    """The runs of the cells with these numbers."""
    return HybridOutcome(*(values[..., cell] for values in runs))


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
    - `cells`: number of cells to run; the rest is padding. With 0, the programs are only compiled.
    - `settings`: their solver must be an explicit Runge-Kutta solver of Diffrax.
    - `counters`: number of counters, the rows of `Transition.counts`.
    - `nonterminal`, `n_blocks`: as for `solve_ensemble`.
    - `most_rounds`: a cell that needs more ends as `UNRESOLVED`.

    **Returns:** a `HybridOutcome`.

    **Example:** the balls of the room's example, through their highest points up to 1 s.

    >>> last = solve_hybrid(modes, first, start, 1.0, 2, settings, counters=1, nonterminal=True)
    >>> print(last.crossing_time.round(6), last.end_time)
    [0.722438 0.812743] [1. 1.]
    """
    size, options = len(mode), {"nonterminal": nonterminal, "n_blocks": n_blocks}
    t1 = np.broadcast_to(np.asarray(t1, float), size)
    runs = HybridOutcome(
        status=np.full(size, RUNNING),
        crossing_time=np.full(size, np.inf),
        end_time=np.zeros(size),
        state=np.array(state),
        steps=np.zeros(size, int),
        rejected=np.zeros(size, int),
        mode=np.array(mode),
        counts=np.zeros((counters, size), int),
    )
    runs.status[cells:] = REACHED_END
    if cells == 0:
        _compile(modes, runs, t1, settings, options)
    for _ in range(most_rounds):
        # Selected before the round: a cell that changes its mode during the round waits for the next round.
        by_mode = [np.flatnonzero((runs.status == RUNNING) & (runs.mode == number)) for number in range(len(modes))]
        for batched_mode, selected in zip(modes, by_mode, strict=True):
            if selected.size:
                _solve_mode(batched_mode, runs, selected, t1, settings, options)
                lost = selected[runs.status[selected] == LEFT_DOMAIN]
                if lost.size:
                    _apply_reset(batched_mode, runs, lost, t1)
        if not (runs.status == RUNNING).any():
            break
    runs.status[runs.status == RUNNING] = UNRESOLVED
    return runs


def _compile(
    modes: tuple[AbstractBatchedMode, ...],
    runs: HybridOutcome[np.ndarray],
    t1: Float[np.ndarray, " cells"],
    settings: Settings,
    options: dict[str, Any],
) -> None:
    """Compile all programs by running no cells: two at once, because the compiler uses little more than one core."""
    no_cells = np.arange(0)
    with ThreadPoolExecutor(2) as threads:
        solves = [
            threads.submit(_solve_mode, batched_mode, runs, no_cells, t1, settings, options) for batched_mode in modes
        ]
        resets = [threads.submit(_apply_reset, batched_mode, runs, no_cells, t1) for batched_mode in modes]
        for program in (*solves, *resets):
            program.result()


def _gather(
    runs: HybridOutcome[np.ndarray], selected: Int[np.ndarray, " selected"], t1: Float[np.ndarray, " cells"]
) -> tuple[Int[np.ndarray, " cells"], Float[np.ndarray, "components cells"], Float[np.ndarray, " cells"]]:
    """The numbers, the states and the remaining times of some cells, padded to the full number of cells."""
    size = len(runs.status)
    cell = np.concatenate([selected, np.full(size - selected.size, selected[-1] if selected.size else 0)])
    return cell, runs.state[:, cell], np.maximum(t1[cell] - runs.end_time[cell], 0.0)


def _solve_mode(
    mode: AbstractBatchedMode,
    runs: HybridOutcome[np.ndarray],
    selected: Int[np.ndarray, " selected"],
    t1: Float[np.ndarray, " cells"],
    settings: Settings,
    options: dict[str, Any],
) -> None:
    """Solve some cells to the end of their mode and store the outcome."""
    cell, state, left = _gather(runs, selected, t1)
    problem = _problem(mode, cell, state)
    outcome, _ = solve_ensemble(problem, left, np.asarray(selected.size), settings, **options)
    outcome = jax.tree.map(lambda values: np.asarray(values)[..., : selected.size], outcome)
    _store(runs, selected, after_solve(np, runs_of_cells(runs, selected), outcome, t1[selected]))


def _apply_reset(
    mode: AbstractBatchedMode,
    runs: HybridOutcome[np.ndarray],
    selected: Int[np.ndarray, " selected"],
    t1: Float[np.ndarray, " cells"],
) -> None:
    """Apply the reset map to some cells and store the transition."""
    transition = _reset_map(mode, *_gather(runs, selected, t1))
    transition = jax.tree.map(lambda values: np.asarray(values)[..., : selected.size], transition)
    _store(runs, selected, after_reset(np, runs_of_cells(runs, selected), transition, t1[selected]))


def _store(
    runs: HybridOutcome[np.ndarray], selected: Int[np.ndarray, " selected"], new: HybridOutcome[np.ndarray]
) -> None:
    for values, of_selected in zip(runs, new, strict=True):
        values[..., selected] = of_selected


def after_solve(
    xp: Any, runs: HybridOutcome[Numbers], outcome: Outcome[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after an ensemble solve that ended as in `outcome`. **Arguments:** `xp`: `numpy` or `jax.numpy`."""
    began = runs.end_time
    # A cell that enters a mode beyond the event passed the event earlier, unless it started there.
    passed = xp.isfinite(outcome.crossing_time) & ((outcome.crossing_time > 0.0) | xp.isinf(runs.crossing_time))
    return HybridOutcome(
        status=outcome.status,
        crossing_time=xp.where(passed, began + outcome.crossing_time, runs.crossing_time),
        end_time=xp.where(outcome.status == REACHED_END, t1, began + outcome.end_time),
        state=outcome.state,
        steps=runs.steps + outcome.steps,
        rejected=runs.rejected + outcome.rejected,
        mode=runs.mode,
        counts=runs.counts,
    )


def after_reset(
    xp: Any, runs: HybridOutcome[Numbers], transition: Transition[Numbers], t1: Float[Numbers, " cells"]
) -> HybridOutcome[Numbers]:
    """Update the cells after the transition to the next mode. **Arguments:** as for `after_solve`."""
    passed = xp.isfinite(transition.crossing_time)
    # Non-finite states would never finish.
    sound = xp.isfinite(transition.state).all(axis=0) & xp.isfinite(transition.elapsed)
    return HybridOutcome(
        status=xp.where(sound, transition.status, FAILED),
        crossing_time=xp.where(passed, runs.end_time + transition.crossing_time, runs.crossing_time),
        end_time=xp.where(transition.status == REACHED_END, t1, runs.end_time + transition.elapsed),
        state=transition.state,
        steps=runs.steps,
        rejected=runs.rejected,
        mode=transition.mode,
        counts=runs.counts + transition.counts,
    )
