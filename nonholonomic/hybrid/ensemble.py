"""Hybrid motion of many cells at once: smooth modes with resets between them.

A mode has its own equations of motion and ends where they cease to hold: a contact opens or closes, slipping ends. The
mode's `reset_map` gives the transition to the next mode: an impact, a flight in closed form, other equations. All modes
share one layout of the state. The cells advance in rounds: each round gathers the cells of each mode, solves them as
one ensemble (`integration/ensemble.py`) to the event, the horizon or the end of the mode, and applies the reset map to
those at its end.
"""

import abc
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from ..integration.ensemble import solve_ensemble
from ..integration.problem import AbstractProblem
from ..integration.scheduler import Outcome
from ..integration.settings import Settings
from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END, RUNNING, UNRESOLVED
from ..xla_cpu import compiled_quickly

#: Most rounds, and so most modes of a single run, before unfinished cells end as `UNRESOLVED`.
MOST_ROUNDS = 2000


class TransitionPath(NamedTuple):
    """Path of a single run from one mode to the next, as successive stretches of motion in closed form.

    - `ends`: when each stretch ends [s], counted from the end of the mode; infinite for unused entries.
    - `motions`: the argument of `AbstractBatchedMode.between` for each, with the stretches on the first axis of every
      leaf.
    - `shown`: number of default output times of each stretch.
    """

    ends: Float[Array, " stretches 1"]
    motions: Any
    shown: Int[Array, " stretches 1"]


class Transition(NamedTuple):
    """The result of a reset map, one number per cell.

    `status` is `RUNNING` where the motion continues in the mode numbered `mode`, else how it ended; `state` is the new
    state, `elapsed` [s] the duration of the transition, `crossing_time` [s] the (last) time of the event during the
    transition, infinite if there was none; `counts` holds the counters, one per row. `record` is the path of a single
    run (`path.py`); `None` for instantaneous transitions, or where no path is kept. `log_rates` is the sum of the
    logarithms of the rates at which events on the way are met; `None` if there are none.
    """

    mode: Int[Array, " cells"]
    state: Float[Array, "components cells"]
    elapsed: Float[Array, " cells"]
    status: Int[Array, " cells"]
    crossing_time: Float[Array, " cells"]
    counts: Int[Array, "kinds cells"]
    record: TransitionPath | None = None
    log_rates: Float[Array, " cells"] | None = None


class AbstractBatchedMode(eqx.Module):
    """One mode of a hybrid system. Its leaves are scalars, or hold one number per cell in their last axis."""

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


class HybridOutcome(NamedTuple):
    """How every cell ended, as in `integration.Outcome`, in which mode, and the counters."""

    status: Int[np.ndarray, " cells"]
    crossing_time: Float[np.ndarray, " cells"]
    end_time: Float[np.ndarray, " cells"]
    state: Float[np.ndarray, "components cells"]
    steps: Int[np.ndarray, " cells"]
    rejected: Int[np.ndarray, " cells"]
    mode: Int[np.ndarray, " cells"]
    counts: Int[np.ndarray, "kinds cells"]


@eqx.filter_jit
def _problem(
    mode: AbstractBatchedMode, cell: Int[Array, " cells"], state: Float[Array, "components cells"]
) -> AbstractProblem:
    return _of_cells(mode, cell).problem(state)


@compiled_quickly
def _leave(
    mode: AbstractBatchedMode,
    cell: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    left: Float[Array, " cells"],
) -> Transition:
    return _of_cells(mode, cell).reset_map(state, left)


def _of_cells(mode: AbstractBatchedMode, cell: Int[Array, " cells"]) -> AbstractBatchedMode:
    """A mode of some cells."""
    numbers, rest = eqx.partition(mode, eqx.is_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf if leaf.ndim == 0 else leaf[..., cell], numbers), rest)


def solve_hybrid(
    modes: tuple[AbstractBatchedMode, ...],
    mode: Int[np.ndarray, " cells"],
    state: Float[np.ndarray, "components cells"],
    t1: float | Float[np.ndarray, " cells"],
    cells: int,
    settings: Settings,
    *,
    kinds: int,
    passes: bool = False,
    parts: int = 1,
    most_rounds: int = MOST_ROUNDS,
) -> HybridOutcome:
    """Run every cell through its modes to its event, to `t1`, or to where the model ends.

    The loop runs on the host, round by round, with concrete numbers. All calls with the same number of cells, padding
    included, share their compiled programs.

    **Arguments:**

    - `modes`: the modes; `mode` and `Transition.mode` are indices into them.
    - `mode`, `state`: initial mode and state of every cell.
    - `t1`: horizon [s], one for all or one per cell.
    - `cells`: how many cells to run; the rest is padding. With 0, the programs are compiled and nothing is run.
    - `settings`: with an explicit Runge-Kutta solver of Diffrax.
    - `kinds`: number of counters, the rows of `Transition.counts`.
    - `passes`, `parts`: as for `ensemble_solve`.
    - `most_rounds`: a cell that needs more ends as `UNRESOLVED`.

    **Returns:** a `HybridOutcome`.
    """
    size, options = len(mode), {"passes": passes, "parts": parts}
    t1 = np.broadcast_to(np.asarray(t1, float), size)
    found = HybridOutcome(
        status=np.full(size, RUNNING),
        crossing_time=np.full(size, np.inf),
        end_time=np.zeros(size),
        state=np.array(state),
        steps=np.zeros(size, int),
        rejected=np.zeros(size, int),
        mode=np.array(mode),
        counts=np.zeros((kinds, size), int),
    )
    found.status[cells:] = REACHED_END
    if cells == 0:
        _compile(modes, found, t1, settings, options)
    for _ in range(most_rounds):
        # Selected before the round: a cell that changes its mode during the round waits for the next round.
        here = [np.flatnonzero((found.status == RUNNING) & (found.mode == number)) for number in range(len(modes))]
        for one, some in zip(modes, here, strict=True):
            if some.size:
                _march(one, found, some, t1, settings, options)
                lost = some[found.status[some] == LEFT_DOMAIN]
                if lost.size:
                    _pass_on(one, found, lost, t1)
        if not (found.status == RUNNING).any():
            break
    found.status[found.status == RUNNING] = UNRESOLVED
    return found


def _compile(
    modes: tuple[AbstractBatchedMode, ...],
    found: HybridOutcome,
    t1: Float[np.ndarray, " cells"],
    settings: Settings,
    options: dict[str, Any],
) -> None:
    """Compile all programs by running no cells: two at once, because the compiler uses little more than one core."""
    none = np.arange(0)
    with ThreadPoolExecutor(2) as threads:
        marches = [threads.submit(_march, one, found, none, t1, settings, options) for one in modes]
        leaving = [threads.submit(_pass_on, one, found, none, t1) for one in modes]
        for program in (*marches, *leaving):
            program.result()


def _gather(
    found: HybridOutcome, some: Int[np.ndarray, " some"], t1: Float[np.ndarray, " cells"]
) -> tuple[Int[np.ndarray, " cells"], Float[np.ndarray, "components cells"], Float[np.ndarray, " cells"]]:
    """The numbers, the states and the remaining times of some cells, padded to the full number of cells."""
    size = len(found.status)
    cell = np.concatenate([some, np.full(size - some.size, some[-1] if some.size else 0)])
    return cell, found.state[:, cell], np.maximum(t1[cell] - found.end_time[cell], 0.0)


def _march(
    mode: AbstractBatchedMode,
    found: HybridOutcome,
    some: Int[np.ndarray, " some"],
    t1: Float[np.ndarray, " cells"],
    settings: Settings,
    options: dict[str, Any],
) -> None:
    """Solve some cells to the end of their mode and store the outcome."""
    cell, state, left = _gather(found, some, t1)
    problem = _problem(mode, cell, state)
    outcome, _ = solve_ensemble(problem, left, np.asarray(some.size), settings, **options)
    outcome = jax.tree.map(lambda values: np.asarray(values)[..., : some.size], outcome)
    _store(found, some, after_solve(np, _some(found, some), outcome, t1[some]))


def _pass_on(
    mode: AbstractBatchedMode, found: HybridOutcome, some: Int[np.ndarray, " some"], t1: Float[np.ndarray, " cells"]
) -> None:
    """Apply the reset map to some cells and store the transition."""
    transition = _leave(mode, *_gather(found, some, t1))
    transition = jax.tree.map(lambda values: np.asarray(values)[..., : some.size], transition)
    _store(found, some, after_reset(np, _some(found, some), transition, t1[some]))


def _some(found: HybridOutcome, some: Int[np.ndarray, " some"]) -> HybridOutcome:
    return HybridOutcome(*(values[..., some] for values in found))


def _store(found: HybridOutcome, some: Int[np.ndarray, " some"], new: HybridOutcome) -> None:
    for values, of_some in zip(found, new, strict=True):
        values[..., some] = of_some


def after_solve(xp: Any, found: HybridOutcome, outcome: Outcome, t1: Float[Array, " cells"]) -> HybridOutcome:
    """Update the cells after an ensemble solve that ended as in `outcome`. **Arguments:** `xp`: `numpy` or `jax.numpy`."""
    began = found.end_time
    # A cell that enters a mode beyond the event passed the event earlier, unless it started there.
    passed = xp.isfinite(outcome.crossing_time) & ((outcome.crossing_time > 0.0) | xp.isinf(found.crossing_time))
    return HybridOutcome(
        status=outcome.status,
        crossing_time=xp.where(passed, began + outcome.crossing_time, found.crossing_time),
        end_time=xp.where(outcome.status == REACHED_END, t1, began + outcome.end_time),
        state=outcome.state,
        steps=found.steps + outcome.steps,
        rejected=found.rejected + outcome.rejected,
        mode=found.mode,
        counts=found.counts,
    )


def after_reset(xp: Any, found: HybridOutcome, transition: Transition, t1: Float[Array, " cells"]) -> HybridOutcome:
    """Update the cells after the transition to the next mode. **Arguments:** as for `after_solve`."""
    passed = xp.isfinite(transition.crossing_time)
    # Non-finite states would never finish.
    sound = xp.isfinite(transition.state).all(axis=0) & xp.isfinite(transition.elapsed)
    return HybridOutcome(
        status=xp.where(sound, transition.status, FAILED),
        crossing_time=xp.where(passed, found.end_time + transition.crossing_time, found.crossing_time),
        end_time=xp.where(transition.status == REACHED_END, t1, found.end_time + transition.elapsed),
        state=transition.state,
        steps=found.steps,
        rejected=found.rejected,
        mode=transition.mode,
        counts=found.counts + transition.counts,
    )
