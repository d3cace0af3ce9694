"""The crossings of a section by many runs: the times at which an event function falls through zero, and the states there.

A run continues through its crossings and through its resets; nothing starts again. The steps that cross are recorded in the
lanes, and the resets that cross in the rounds of the modes.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.components import over_cells
from ..compilation.xla_cpu import compiled_alone, greatest, written_in_place
from ..hybrid.ensemble import MOST_ROUNDS, after_reset, after_solve, all_rounds, at_start, time_left
from ..integration import AbstractProblem, Lanes, LaneState, Outcome, Settings, States
from ..integration.problem import CROSSED, DEFAULT_MAX_STEPS, FAILED, LEFT_DOMAIN, RUNNING, UNRESOLVED, Status
from ..integration.scheduler import InLanes, LaneScheduler, Recorder, Tried, of_cells
from ..integration.step import try_step
from ..sweeps import Table, Variable
from ..text import shown
from ..validation import explaining, require_outside, require_whole
from .event import Event, counted, modes_of, near_zero, problem_of
from .model import AbstractModel, AbstractSceneModel, check_horizon, model_of, require_event
from .simulate import Samples, Solved, mode_at, nan_where, own_axis, require_names
from .table import Options, table_of

#: A crossing within this fraction of the time in a mode before the end of the mode is at its end: the event function vanishes
#: with the margin of the mode.
SAME = 1e-9

#: A crossing within this fraction of the time after another one is the same: without a time between them, a function cannot
#: rise and fall again, and a run that only changes its mode does not go on.
AT_ONCE = 1e-12


class Kept(NamedTuple):
    """What is kept of the crossings of every cell: the number so far, whether the last one is at the end of a mode whose reset
    comes next, whether the last mode ended on the section or beyond, the number of resets since the last crossing, the time of
    that [s], and of those that are asked for the times [s], the states and the modes, with the cells last."""

    counted: Int[Array, " cells"]
    at_end: Bool[Array, " cells"]
    beyond: Bool[Array, " cells"]
    resets: Int[Array, " cells"]
    last: Float[Array, " cells"]
    time: Float[Array, "count cells"]
    state: Float[Array, "components count cells"]
    mode: Int[Array, "count cells"]


class CrossingRecorder(Recorder):
    """Keeps the crossings inside the steps of every cell, and ends a run at the last one that is asked for.

    `skip`, `count`: as for `crossings`; `begin_time`: when each cell began [s]; `leaves`: up to when [s] a cell only leaves
    the section, on which it began; `number`: the index of its mode.
    """

    skip: Int[Array, ""]
    count: int = eqx.field(static=True)
    begin_time: Float[Array, " cells"]
    leaves: Float[Array, " cells"]
    number: int = eqx.field(static=True)

    period: ClassVar[int] = 64

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: Kept) -> PyTree:
        state = lane_state.state
        rows = jnp.zeros((self.period, len(state) + 1, *state.shape[1:]))
        return collected.counted[lane_state.cell], rows, jnp.full((self.period, *state.shape[1:]), self.count)

    def step(self, in_lanes: InLanes, lane_state: LaneState, record: PyTree, iteration: Int[Array, ""]) -> Tried:
        (counted, rows, places), new = record, try_step(*in_lanes, lane_state)
        crosses = jnp.isfinite(new.crossing_time) & (new.crossing_time != lane_state.crossing_time)
        crosses &= new.crossing_time > self.leaves[lane_state.cell]
        counted = counted + crosses
        # The step has ended just beyond the section.
        state = new.state + (new.crossing_time - new.time) * new.rate
        row = jnp.concatenate([state, new.crossing_time[None]])
        place = jnp.where(crosses, place_of(counted, self.skip, self.count), self.count)
        rows, places = written_in_place((rows, places), (row, place), at=iteration)
        is_last = crosses & (counted >= self.skip + self.count) & (new.status == RUNNING)
        return new._replace(status=jnp.where(is_last, CROSSED, new.status)), (counted, rows, places)

    def collect(self, collected: Kept, record: PyTree, ended: LaneState, refilled: LaneState) -> Kept:
        (counted, rows, places), cell = record, ended.cell
        begin, cells = self.begin_time[cell], jnp.broadcast_to(cell, places.shape)
        return collected._replace(
            counted=collected.counted.at[cell].set(counted, mode="drop"),
            time=collected.time.at[places, cells].set(begin + rows[:, -1], mode="drop"),
            state=collected.state.at[:, places, cells].set(jnp.moveaxis(rows[:, :-1], 1, 0), mode="drop"),
            mode=collected.mode.at[places, cells].set(self.number, mode="drop"),
        )


def place_of(counted: Int[Array, "..."], skip: Array, count: int) -> Int[Array, "..."]:
    """Where to keep the crossing of this number, counted from 1; `count` if it is not kept."""
    return jnp.where((counted > skip) & (counted <= skip + count), counted - skip - 1, count)


def on_margin(problem: AbstractProblem, time: Lanes, state: States) -> Bool[Array, " cells"]:
    """Whether runs that have spent some time [s] in a mode are at its end, up to `SAME`."""
    rates = problem.field(time, state)
    value, slope = jax.jvp(functools.partial(problem.margin_or_one, time), (state,), (rates,))
    return (slope < 0.0) & (value <= -slope * SAME * time)


def crossed_at_end(outcome: Outcome) -> Bool[Array, " cells"]:
    """Whether the last crossing of each run in a mode is where it ended, up to `SAME`."""
    return jnp.isfinite(outcome.crossing_time) & (outcome.end_time - outcome.crossing_time <= SAME * outcome.end_time)


@compiled_alone
def crossings_in_cells(
    model: AbstractModel,
    names: tuple[str, ...],
    t1: Float[Array, ""],
    cells: Int[Array, ""],
    skip: Int[Array, ""],
    settings: Settings,
    size: int,
    count: int,
    after: bool,
) -> Solved:
    """The `Status` of all cells, of which only the first `cells` are run, and the variables of the table."""

    def start(components: int) -> Kept:
        never, none = jnp.full((count, size), jnp.nan), jnp.zeros((count, size), int)
        state = jnp.full((components, count, size), jnp.nan)
        zeros, false = jnp.zeros(size, int), jnp.zeros(size, bool)
        return Kept(zeros, false, false, zeros, jnp.full(size, -jnp.inf), never, state, none)

    def with_row(kept: Kept, is_new: Array, is_shown: Array, time: Array, state: Array, mode: Array | int) -> Kept:
        counted, cell = kept.counted + is_new, jnp.arange(size)
        place = jnp.where(is_shown, place_of(counted, skip, count), count)
        return kept._replace(
            counted=counted,
            time=kept.time.at[place, cell].set(time, mode="drop"),
            state=kept.state.at[:, place, cell].set(state, mode="drop"),
            mode=kept.mode.at[place, cell].set(mode, mode="drop"),
        )

    if model.smooth:
        problem, begin = problem_of(model, size, names), jnp.zeros(size)
        scheduler = LaneScheduler.of(problem, t1, cells, settings, nonterminal=True, one_kernel=True)
        outcome, _, kept = scheduler.solve(
            CrossingRecorder(skip, count, begin, begin, 0), start(len(problem.start()[0]))
        )
        value, slope, error = near_zero(problem, outcome.end_time, outcome.state)
        is_new = (outcome.status == LEFT_DOMAIN) & (jnp.abs(value) <= error) & (slope < 0.0) & ~crossed_at_end(outcome)
        kept = with_row(kept, is_new, is_new, outcome.end_time, outcome.state, 0)
        rows, ended = kept.state, outcome
    else:
        modes, first, states = modes_of(model, size, settings.tolerance, names, True)
        horizons = jnp.broadcast_to(t1, (size,))

        def solve(numbers: Sequence[int], cell: Array, running: Array, carry: PyTree) -> PyTree:
            (runs, kept), horizon = carry, horizons[cell]
            problem = of_cells(modes[numbers[0]], cell).problem(runs.state)
            value, slope, error = near_zero(problem, jnp.zeros(size), problem.start()[0])
            is_on = kept.beyond & (jnp.abs(value) <= error) & (slope < 0.0)
            leaves = jnp.where(is_on, -2.0 * error / jnp.where(is_on, slope, 1.0), -jnp.inf)
            leaves = greatest(leaves, kept.last + AT_ONCE * runs.end_time - runs.end_time)
            options = {"nonterminal": True, "one_kernel": True}
            scheduler = LaneScheduler.of(problem, time_left(runs, horizon), running, settings, **options)
            outcome, _, new = scheduler.solve(CrossingRecorder(skip, count, runs.end_time, leaves, numbers[0]), kept)
            if after:
                is_reset = (outcome.status == CROSSED) & on_margin(problem, outcome.end_time, outcome.state)
                shift = jnp.where(is_reset, outcome.crossing_time - outcome.end_time, 0.0)
                moved = outcome.state + shift * problem.field(outcome.end_time, outcome.state)
                status = jnp.where(is_reset, LEFT_DOMAIN, outcome.status)
                outcome = outcome._replace(status=status, end_time=outcome.end_time + shift, state=moved)
            value, _, error = near_zero(problem, outcome.end_time, outcome.state)
            at_end = crossed_at_end(outcome) & (outcome.crossing_time > leaves) & (outcome.status == LEFT_DOMAIN)
            crosses, time = new.counted > kept.counted, runs.end_time + outcome.crossing_time
            resets, last = jnp.where(crosses, 0, kept.resets), jnp.where(crosses, time, kept.last)
            new = new._replace(at_end=at_end, beyond=value <= error, resets=resets, last=last)
            return after_solve(runs, outcome, horizon), new

        def reset(numbers: Sequence[int], cell: Array, _: Array, carry: PyTree) -> PyTree:
            (runs, kept), horizon = carry, horizons[cell]
            transition = of_cells(modes[numbers[0]], cell).reset_map(runs.state, time_left(runs, horizon))
            new = after_reset(runs, transition, horizon)
            jumps = jnp.isfinite(transition.crossing_time) & (runs.end_time > kept.last * (1.0 + AT_ONCE))
            crosses = (jumps | kept.at_end) & (new.status != FAILED)
            is_new = crosses & ~kept.at_end
            shown = new if after else runs
            kept = with_row(kept, is_new, crosses if after else is_new, shown.end_time, shown.state, shown.mode)
            resets, last = jnp.where(is_new, 0, kept.resets + 1), jnp.where(is_new, runs.end_time, kept.last)
            kept = kept._replace(at_end=jnp.zeros(size, bool), resets=resets, last=last)
            is_last = kept.counted >= skip + count
            status = jnp.where(is_last, CROSSED, jnp.where(kept.resets >= MOST_ROUNDS, UNRESOLVED, new.status))
            return new._replace(status=jnp.where(new.status == RUNNING, status, new.status)), kept

        groups, runs = [(number,) for number in range(len(modes))], at_start(first, states, cells, len(model.counters))
        # As many resets between two crossings as in a run.
        ended, kept = all_rounds((runs, start(len(states))), groups, solve, reset, MOST_ROUNDS * (count + skip))
        rows = [over_cells(lambda mode, state: mode.shown(state), mode)(kept.state) for mode in modes]
        rows = jnp.select([kept.mode == number for number in range(len(modes))], rows, jnp.nan)
    status = jnp.where(kept.counted >= skip + count, int(Status.EVENT), model.ended(ended, settings.tolerance))

    def read(model: AbstractModel, time: Array, rows: Array, mode: Array) -> dict[str, Array]:
        return nan_where(~jnp.isfinite(time), model.read(names, time, rows, None if model.smooth else mode_at(mode)))

    values = eqx.filter_vmap(read, in_axes=(own_axis, -1, -1, -1))(model, kept.time, rows, kept.mode)
    return status, {"time": kept.time.T} | values | counted(model, ended)


@dataclasses.dataclass(frozen=True)
class Crossings(Samples):
    """The crossings in a table: their numbers, counted from 1, in place of times; the names of the quantities; and whether the
    states are those after the resets at the section."""

    along, has_kernel = ("crossing", "1"), False

    after: bool = False

    def variables(self, model: AbstractModel) -> dict[str, Variable]:
        """The variables of the table with the times and the quantities."""
        time = Variable("s", np.float64, inner=("crossing",), long_name="time of the crossing")
        return {"time": time} | super().variables(model)

    def solve(self, cells: AbstractModel, t1: float, size: int, count: int, settings: Settings) -> Solved:
        """The `Status` of all cells, of which only the first `count` are run, and the variables of the table."""
        numbers = (jnp.asarray(t1, float), jnp.asarray(count), jnp.asarray(int(self.times[0]) - 1))
        status, values = crossings_in_cells(cells, self.names, *numbers, settings, size, len(self.times), self.after)
        return status, jax.tree.map(np.asarray, values)


class Rise(eqx.Module):
    """An event that happens where another function rises through zero."""

    event: Callable[..., Any]

    def __call__(self, t: Array, y: object) -> Array:
        return -self.event(t, y)


def section_of(event: Any, direction: str, side: str) -> Callable[..., Any] | None:
    """The event of a section, checked."""
    if direction not in ("fall", "rise"):
        raise ValueError(f"direction = {shown(direction)} must be 'fall' or 'rise'")
    if side not in ("before", "after"):
        raise ValueError(f"side = {shown(side)} must be 'before' or 'after' a reset")
    if direction == "rise" and not callable(event):
        raise ValueError(f"direction = 'rise' needs event=, a function of time and state, not {shown(event)}")
    return Rise(event) if direction == "rise" else event


def require_section(model: AbstractModel, event: object) -> None:
    """Raise `ValueError` unless the model has a section."""
    require_event(model)
    if isinstance(model, AbstractSceneModel) and event is None:
        raise ValueError("event = None: the section of a scene needs event=, a function of time and motion")


@explaining
def crossings(
    system: object,
    start: object,
    t1: float,
    event: Event = None,
    count: int = 10,
    skip: int = 0,
    *,
    direction: str = "fall",
    side: str = "before",
    axes: dict[str, object] | None = None,
    quantities: Sequence[str] | None = None,
    scattered: bool = False,
    max_steps: int = DEFAULT_MAX_STEPS,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    input: object = None,
    jumps: object = None,
) -> Table:
    """Times and states at which runs cross a section: the returns of a Poincaré map, over a grid of parameters.

    A crossing is a fall of the event function through zero, along the motion or by a reset. A start on the section does not
    count. Runs continue through their crossings and resets, and end at the last crossing that is asked for.

    **Arguments:**

    - `system`, `start`, `event`, `input`, `jumps`: as for `event_time`; a scene needs an `event`.
    - `t1`: horizon [s]; a run that has fewer crossings until then has fewer in the table.
    - `count`, `skip`: number of crossings in the table, and of those before them that are left out.
    - `direction`: "fall", or "rise" for the rises of the event function through zero.
    - `side`: whether the state at a crossing that coincides with a reset is that "before" or "after" the reset.
    - `axes`, `scattered`, `max_steps`, `tolerance`, `solver`, `path`, `progress`, `executor`: as for `sweep`; without axes
      there is one run.
    - `quantities`: names of quantities at the crossings; by default all components of your own system, and none of a scene.

    **Returns:** a `Table` with the axis `crossing`, whose values count the crossings from 1: the `time` [s] of each crossing,
    and the quantities, NaN for missing crossings; and for each run its `status`: "event" if all crossings were found,
    otherwise how the run ended, such as "completed" at `t1`; `end_time` [s], `steps`, `rejected`, and the number of resets.

    **Raises:** as `sweep`.

    **Example:** the velocity at the lowest point of a swing, in its second and third period.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Spring(nonholonomic.AbstractMode):
    ...     damping: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -y[0] - self.damping * y[1]])
    >>> def middle(t, y):
    ...     return y[0]
    >>> spring = nonholonomic.Hybrid([Spring(damping=0.1)])
    >>> table = nonholonomic.crossings(spring, [1.0, 0.0], 50.0, middle, count=2, skip=1, progress=False)
    >>> print(table.crossing, table.time.round(6), table.y1.round(6), table.status)
    [2 3] [ 7.913901 14.204955] [-0.673212 -0.491522] event

    ```
    """
    require_outside((system, start, t1, axes, input), "crossings", "event_time")
    for name, number, least in (("count", count, 1), ("skip", skip, 0)):
        require_whole(number, name, least)
    model = model_of(system, start, section_of(event, direction, side), input, jumps)
    require_section(model, event)
    check_horizon(t1, tolerance)
    names = model.names if quantities is None else quantities
    require_names(model.quantities, names)
    options = Options(tolerance, solver, max_steps, scattered, False, (), path, progress, executor)
    samples = Crossings(np.arange(skip + 1, skip + count + 1), tuple(names), side == "after")
    crossing = "after" if side == "after" else "first"
    return table_of(model, {} if axes is None else axes, t1, options, crossing, samples=samples, timed=False)
