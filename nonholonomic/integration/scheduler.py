"""The cells of a problem, and the lanes that run them.

A lane whose run has ended takes the next cell of the queue, so cheap and expensive cells share the lanes without
waiting for one another. All ensemble solves share this loop; a recorder stores what they keep of the steps.
"""

from collections.abc import Callable
from typing import ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..compilation.xla_cpu import compiled_alone, in_one_kernel, traced_once
from ..text import shown
from .events import Bracket
from .problem import CROSSED, LEFT_DOMAIN, REACHED_END, RUNNING, AbstractProblem, Settings, crossing_time, lanes_for
from .runge_kutta import Integers, Lanes, States, explicit_tableau, first_rate_and_length, memory_for_stages
from .step import Control, LaneState, try_step

#: JAX's arrays, or NumPy's on the host.
Numbers = TypeVar("Numbers", Array, np.ndarray)

#: A tree of arrays.
Tree = TypeVar("Tree")
Result = TypeVar("Result")

#: Cost of refilling the lanes, in steps of all lanes, measured on a CPU. The lanes are refilled when idle lanes have
#: missed as many steps, so the loss is at most twice the loss of the best choice.
REFILL = 0.25

#: Time at which the direction of motion is evaluated, in units of the first step; and the fraction of a function's
#: change until then below which the function counts as zero at the start.
SOON, AT_ZERO = 1e-2, 1e-6

#: The extremes of a run whose steps are not known.
NO_EXTREMES = (np.inf, 0.0, 0.0)


class Outcome(NamedTuple, Generic[Numbers]):
    """How every cell ended.

    `status` is one of the codes of `problem.py`; `first_crossing` and `crossing_time` [s] are the times of the first and
    the last event, which are equal if runs end on the event, and infinite if there was none; `end_time` [s] and `state`
    are time and state at the end of the run; `steps` counts accepted and rejected steps, `rejected` only rejected ones;
    `extremes` are the length of the shortest step after a rejection, infinite without one, its time, and the length of the
    longest step, all [s].

    **Example:** the outcome of the subpackage's example, whose runs end on the event.

    >>> from nonholonomic.integration.problem import CROSSED
    >>> print(outcome.status == CROSSED, outcome.state.shape)
    [ True  True  True] (1, 3)
    """

    status: Int[Numbers, " cells"]
    first_crossing: Float[Numbers, " cells"]
    crossing_time: Float[Numbers, " cells"]
    end_time: Float[Numbers, " cells"]
    state: Float[Numbers, "components cells"]
    steps: Int[Numbers, " cells"]
    rejected: Int[Numbers, " cells"]
    extremes: Float[Numbers, "3 cells"]


class SchedulerState(NamedTuple):
    """The lanes, the number of cells that have left the queue, and the number of iterations so far."""

    lane_state: LaneState
    loaded: Int[Array, ""]
    iterations: Int[Array, ""]


#: Problem, control and absolute tolerances of the cells in the lanes.
InLanes = tuple[AbstractProblem, Control, States]

#: The lanes after a step, and the record of it.
Tried = tuple[LaneState, PyTree]


#: What a period carries from step to step: the lanes, the record, the number of steps that idle lanes have missed since the
#: last refill, and the number of steps.
Period = tuple[LaneState, PyTree, Int[Array, ""], Int[Array, ""]]


class Recorder(eqx.Module):
    """The part of a solve that records steps, in addition to the `Outcome`; this one records nothing. A period ends when
    enough lanes have ended to refill them, or when the record is full.

    `refill_cost`: cost of a refill, in steps of all lanes; `period`: the most iterations of a period, `None` for any number.
    """

    refill_cost: ClassVar[float] = REFILL
    period: ClassVar[int | None] = None

    def begin(self, in_lanes: InLanes, lane_state: LaneState, collected: PyTree) -> PyTree:
        """The record at the start of a period, from what earlier periods have collected."""
        return None

    def has_room(self, record: PyTree, iteration: Int[Array, ""]) -> Bool[Array, ""] | bool:
        """Whether the record has room for another iteration of the period; otherwise the period ends."""
        return True if self.period is None else iteration < self.period

    def step(self, in_lanes: InLanes, lane_state: LaneState, record: PyTree, iteration: Int[Array, ""]) -> Tried:
        """Try a step in every lane, and record it."""
        return try_step(*in_lanes, lane_state), None

    def collect(self, collected: PyTree, record: PyTree, ended: LaneState, refilled: LaneState) -> PyTree:
        """What has been collected, with the record of a period added.

        **Arguments:** `ended`, `refilled`: the lanes at the end of the period and after the refill.
        """
        return collected


class LaneScheduler(eqx.Module):
    """Runs the cells of a problem in lanes; holds their initial states and the settings.

    Leaves of `problem`, `control.t1`, `atols` and `fresh` are scalars or hold one number per cell in their last axis.
    """

    problem: AbstractProblem
    control: Control
    atols: Float[Array, "components cells"]
    fresh: LaneState
    cells: Int[Array, ""]
    lanes: int = eqx.field(static=True)
    one_kernel: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        problem: AbstractProblem,
        t1: Float[Array, "..."],
        cells: Int[Array, ""],
        settings: Settings,
        *,
        nonterminal: bool = False,
        one_kernel: bool = False,
        n_blocks: int = 1,
    ) -> "LaneScheduler":
        """The scheduler of a problem.

        **Arguments:** as for `solve_ensemble`, and `n_blocks`: the number of equal blocks of the state, as for `Control`.
        """
        solver, rtol = settings.for_lanes, settings.tolerance
        tableau, order = explicit_tableau(solver), solver.order(None)
        if order is None:
            raise ValueError(f"solver = {shown(solver)} must have an order, as Dopri8() has")
        control = Control(tableau, order, rtol, t1, settings.max_steps, nonterminal, n_blocks)
        states, scales = problem.start()
        begin = jnp.zeros_like(states[0])
        field = traced_once(problem.field, begin, states)
        if (jumps := problem.jumps(begin, states)) is not None:
            # Beyond a jump at the start, also by a clock in the state.
            states = states + jumps.begin(begin) * field(begin, states)
            begin = jumps.begin(begin)
        atols = settings.absolute * rtol * scales
        rates, lengths = first_rate_and_length(field, begin, states, control.order, rtol, atols, n_blocks)
        fresh = _fresh_lanes(problem, control, states, rates, jnp.minimum(stop_gradient(lengths), t1))
        fresh = fresh._replace(time=begin)
        lanes = lanes_for(states.shape[1]) if settings.lanes is None else settings.lanes
        return cls(problem, control, atols, fresh, cells, lanes, one_kernel)

    @property
    def capacity(self) -> int:
        """Number of cells of the problem, padding included."""
        return self.fresh.cell.shape[0]

    def pick(self, tree: Tree, cell: Integers) -> Tree:
        """The numbers of the given cells, as `of_cells`; of the last cell for greater indices."""
        return of_cells(tree, jnp.minimum(cell, self.capacity - 1))

    def in_lanes(self, lane_state: LaneState) -> InLanes:
        """Problem, control and absolute tolerances of the cells in the lanes."""
        control = self.control._replace(t1=self.pick(self.control.t1, lane_state.cell))
        return self.pick(self.problem, lane_state.cell), control, self.pick(self.atols, lane_state.cell)

    def solve(
        self, recorder: Recorder | None = None, collected: PyTree = None
    ) -> tuple[Outcome, Int[Array, ""], PyTree]:
        """Run every cell.

        **Arguments:** `recorder`; `collected`: what the recorder has collected before the first step.

        **Returns:** the `Outcome`, whose crossing times are those of nonterminal events; the number of iterations; and what
        the recorder has collected.
        """
        recorder = Recorder() if recorder is None else recorder

        def period(carry: tuple[SchedulerState, Outcome, PyTree]) -> tuple[SchedulerState, Outcome, PyTree]:
            progress, outcome, collected = carry
            progress, record = self.run(progress, recorder, collected)
            refilled = self.refill(progress)
            collected = recorder.collect(collected, record, progress.lane_state, refilled.lane_state)
            return refilled, self.store(outcome, progress.lane_state), collected

        carry = (self.start(), outcome_of(self.fresh), collected)
        progress, outcome, collected = jax.lax.while_loop(lambda carry: self.unfinished(carry[0]), period, carry)
        outcome = back_to_margin(self.problem, self.store(outcome, progress.lane_state))
        return outcome, progress.iterations, collected

    def start(self) -> SchedulerState:
        """The first cells, one in each lane."""
        lane_state = self._load(jnp.arange(self.lanes))
        return SchedulerState(lane_state, jnp.minimum(self.lanes, self.cells), jnp.zeros((), int))

    def unfinished(self, progress: SchedulerState) -> Bool[Array, ""]:
        """Whether a lane is running or a cell waiting."""
        return jnp.any(progress.lane_state.status == RUNNING) | (progress.loaded < self.cells)

    def run(
        self, progress: SchedulerState, recorder: Recorder, collected: PyTree = None
    ) -> tuple[SchedulerState, PyTree]:
        """Advance the lanes by a period: until all have ended, the record is full, or a refill pays off while cells
        wait.

        **Returns:** the `SchedulerState`, and the record of the period.
        """
        in_lanes = self.in_lanes(progress.lane_state)

        def goes_on(carry: Period) -> Bool[Array, ""]:
            lane_state, record, missed, count = carry
            refill = (progress.loaded < self.cells) & (missed >= recorder.refill_cost * self.lanes)
            return jnp.any(lane_state.status == RUNNING) & ~refill & recorder.has_room(record, count)

        def step(carry: Period) -> Period:
            lane_state, record, missed, count = carry
            new_state, record = recorder.step(in_lanes, lane_state, record, count)
            return new_state, record, missed + jnp.sum(lane_state.status != RUNNING), count + 1

        def loop(lane_state: LaneState) -> tuple[LaneState, PyTree, Int[Array, ""]]:
            zero, record = jnp.zeros((), int), recorder.begin(in_lanes, lane_state, collected)
            lane_state = lane_state._replace(stages=memory_for_stages(self.control.tableau, lane_state.state))
            lane_state, record, _, count = jax.lax.while_loop(goes_on, step, (lane_state, record, zero, zero))
            return lane_state._replace(stages=None), record, count

        lane_state, record, count = self.in_kernel(loop)(progress.lane_state)
        return SchedulerState(lane_state, progress.loaded, progress.iterations + count), record

    def in_kernel(self, loop: Callable[[Tree], Result]) -> Callable[[Tree], Result]:
        """A loop over steps, compiled into a single kernel if `one_kernel` is set."""
        return in_one_kernel(loop) if self.one_kernel and self.problem.fits_one_kernel else loop

    def refill(self, progress: SchedulerState) -> SchedulerState:
        """Give every idle lane the next waiting cell."""
        lane_state, loaded, iterations = progress
        idle = lane_state.status != RUNNING
        fresh = self._load(jnp.where(idle, jnp.minimum(loaded + jnp.cumsum(idle) - 1, self.capacity), lane_state.cell))
        lane_state = jax.tree.map(lambda new, old: jnp.where(idle, new, old), fresh, lane_state)
        return SchedulerState(lane_state, jnp.minimum(loaded + jnp.sum(idle), self.cells), iterations)

    def store(self, outcome: Outcome, lane_state: LaneState) -> Outcome:
        """Store the cells whose lanes have ended in the outcome."""
        # A run that ends on a jump may be on its far side.
        time = jnp.minimum(lane_state.time, self.pick(self.control.t1, lane_state.cell))
        in_lanes = outcome_of(lane_state._replace(time=time))
        targets = jnp.where(
            (lane_state.status != RUNNING) & (lane_state.cell < self.cells), lane_state.cell, self.capacity
        )
        return jax.tree.map(lambda cells, lanes: cells.at[..., targets].set(lanes, mode="drop"), outcome, in_lanes)

    def _load(self, cell: Integers) -> LaneState:
        lane_state = self.pick(self.fresh, cell)
        # There may be fewer cells than lanes: the other lanes stay idle.
        return lane_state._replace(cell=cell, status=jnp.where(cell < self.cells, lane_state.status, REACHED_END))


def of_cells(tree: Tree, cell: Int[Numbers, "..."] | int) -> Tree:
    """A tree with the numbers of the cells with these indices; scalars stay unchanged."""
    return jax.tree.map(lambda leaf: leaf[..., cell] if eqx.is_array_like(leaf) and np.ndim(leaf) else leaf, tree)


def outcome_of(lane_state: LaneState) -> Outcome:
    """How the cells in the lanes have ended."""
    times = (lane_state.first_crossing, lane_state.crossing_time, lane_state.time)
    counts = (lane_state.steps, lane_state.rejected, lane_state.extremes)
    return Outcome(lane_state.status, *times, lane_state.state, *counts)


def back_to_margin(problem: AbstractProblem, outcome: Outcome) -> Outcome:
    """The outcome in which the cells that left the domain have gone back to the zero of the exact margin, but not to before
    their start. The end was located to a fraction of a step, and where an allowance was used up."""
    time, state = outcome.end_time, outcome.state
    margin = problem.exact_margin(time, state)
    if margin is None:
        return outcome
    rates = problem.field(time, state)
    slope = jax.jvp(lambda point: problem.exact_margin(time, point), (state,), (rates,))[1]
    beyond = (outcome.status == LEFT_DOMAIN) & (margin < 0.0) & (slope < 0.0)
    shift = jnp.where(beyond, jnp.maximum(-margin / jnp.where(beyond, slope, 1.0), -time), 0.0)
    new_state = state + shift * problem.field(time + 0.5 * shift, state + 0.5 * shift * rates)
    # Where the slope is an error, its tangent leads elsewhere.
    new_margin = problem.exact_margin(time + shift, new_state)
    assert new_margin is not None
    nearer = beyond & (jnp.abs(new_margin) <= 0.5 * jnp.abs(margin))
    return outcome._replace(end_time=jnp.where(nearer, time + shift, time), state=jnp.where(nearer, new_state, state))


def _fresh_lanes(
    problem: AbstractProblem, control: Control, states: States, rates: States, lengths: Lanes
) -> LaneState:
    """Every cell at its start; a cell that starts beyond the event or outside the domain has ended."""
    zero, zeros, false = jnp.zeros_like(lengths), jnp.zeros(lengths.shape, int), jnp.zeros(lengths.shape, bool)
    if problem.direction_decides:
        before_event = _holds(problem, problem.event_function, states, rates, lengths)
        lost, margin = problem.lost_at_start(states), problem.domain_margin(zero, states)
        if lost is None or margin is None:
            valid = _holds(problem, lambda point: problem.domain_margin(zero, point), states, rates, lengths)
        else:
            valid = ~lost & (margin > 0.0)
        side = jnp.ones_like(zero) if before_event is None else jnp.where(before_event, 1.0, -1.0).astype(zero.dtype)
        status = jnp.full(zero.shape, RUNNING) if valid is None else jnp.where(valid, RUNNING, LEFT_DOMAIN)
        crossing_time = jnp.full_like(zero, jnp.inf)
    else:
        crossing, domain_margin = problem.event_function(states), problem.margin_at_start(zero, states)
        is_beyond = false
        if crossing is not None:
            # Exactly on the event, the direction of the motion decides.
            is_falling = jax.jvp(problem.event_function, (states,), (rates,))[1] <= 0.0
            is_beyond = (crossing < 0.0) | ((crossing == 0.0) & (is_falling | (not control.nonterminal)))
        side = jnp.where(is_beyond & control.nonterminal, -1.0, 1.0).astype(lengths.dtype)
        status = jnp.where(is_beyond & (not control.nonterminal), CROSSED, RUNNING)
        if domain_margin is not None:
            status = jnp.where(domain_margin <= 0.0, LEFT_DOMAIN, status)
        crossing_time = jnp.where(is_beyond, zero, jnp.inf)
    return LaneState(
        cell=jnp.arange(lengths.shape[0]),
        status=status,
        time=zero,
        state=states,
        rate=rates,
        length=lengths,
        side=side,
        margin=stop_gradient(problem.least_margin(side, zero, states, rates)),
        margins=stop_gradient(jnp.stack(margins)) if (margins := problem.margins(zero, states)) else None,
        first_crossing=crossing_time,
        crossing_time=crossing_time,
        bracketing=false,
        bracket=Bracket(zero, zero, zero, zero, zero, zeros),
        steps=zeros,
        rejected=zeros,
        extremes=jnp.stack([jnp.full_like(zero, jnp.inf), zero, zero]),
    )


def _holds(
    problem: AbstractProblem, function: Callable[[States], Lanes | None], states: States, rates: States, lengths: Lanes
) -> Bool[Array, " cells"] | None:
    """A mask of the cells in which a function of the state is positive at the start or, if it is zero up to round-off,
    is about to become positive.
    """
    value, zero = function(states), jnp.zeros_like(lengths)
    if value is None:
        return None

    def slope(point: States) -> Lanes:
        return jax.jvp(function, (point,), (problem.field(zero, point),))[1]

    first, second = jax.jvp(slope, (states,), (rates,))
    lead = SOON * lengths
    change = lead * (first + 0.5 * lead * second)
    return jnp.where(jnp.abs(value) <= AT_ZERO * jnp.abs(change), change > 0.0, value > 0.0)


# Solve an ensemble in lanes: event times and end states of a whole grid.
#
# All lanes step together, every lane with its own step length; cells wait in a queue for a lane. The
# state is one array (components, lanes); the parameters of the problem are scalars or one per cell.
#
# Forward-mode derivatives flow through the states alone; step lengths are held fixed. `derivatives/adjoint.py` computes
# first derivatives faster.


def solve_ensemble(
    problem: AbstractProblem,
    t1: Float[Array, "..."],
    cells: Int[ArrayLike, ""],
    settings: Settings,
    *,
    nonterminal: bool = False,
    one_kernel: bool | None = None,
    n_blocks: int = 1,
    traced: bool = False,
) -> tuple[Outcome, Int[Array, ""]]:
    """Run every cell of a problem from t = 0 to its event, to the end of the model's validity, or to `t1`.

    **Arguments:**

    - `problem`: the problem; the last axis of its `start()` counts the cells.
    - `t1`: horizon [s], one number for all cells or one per cell.
    - `cells`: number of cells to run; the other cells of the problem are padding, so that one compiled program serves
      grids of different sizes.
    - `settings`: settings with an explicit Runge-Kutta solver of Diffrax.
    - `nonterminal`: whether the event is nonterminal: a run continues through it, in either direction.
    - `one_kernel`: whether to compile the loop into a single kernel on a CPU, which halves its cost; not for programs
      that are differentiated again. By default unless `traced`.
    - `n_blocks`: number of equal blocks of the state, as for `LaneScheduler.of`.
    - `traced`: whether this is a part of another transformed function; otherwise it is compiled on its own.

    **Returns:** the `Outcome`, and the number of iterations, each of which advanced all lanes.

    **Example:** inside `jit`. With `nonterminal`, the runs continue to `t1`.

    >>> def solve(problem, t1):
    ...     return solve_ensemble(problem, t1, jnp.asarray(3), settings, nonterminal=True, traced=True)[0]
    >>> continued = jax.jit(solve)(problem, jnp.asarray(2.0))
    >>> print(continued.crossing_time.round(6), continued.end_time)
    [0.693147 0.346574 0.173287] [2. 2. 2.]
    """
    one_kernel = not traced if one_kernel is None else one_kernel
    options = {"nonterminal": nonterminal, "one_kernel": one_kernel, "n_blocks": n_blocks}
    return (_ensemble_in_program if traced else _ensemble_alone)(problem, t1, cells, settings, options)


def ensemble_solve(
    problem: AbstractProblem, t1: Float[Array, "..."], cells: Int[ArrayLike, ""], settings: Settings, options: PyTree
) -> tuple[Outcome, Int[Array, ""]]:
    """`solve_ensemble`, not compiled. **Arguments:** `options`: of `LaneScheduler.of`, by name."""
    scheduler = LaneScheduler.of(problem, t1, jnp.asarray(cells), settings, **options)
    outcome, iterations, _ = scheduler.solve()
    return (outcome if scheduler.control.nonterminal else with_crossing_times(problem, outcome)), iterations


_ensemble_alone, _ensemble_in_program = compiled_alone(ensemble_solve), eqx.filter_jit(ensemble_solve)


def with_crossing_times(problem: AbstractProblem, outcome: Outcome) -> Outcome:
    """The outcome with the event time of the cells that ended on the event, and infinite times for the others."""
    if problem.event_function(outcome.state) is None:
        return outcome
    time = crossing_time(problem, outcome.end_time, outcome.state)
    # A cell that starts beyond the event has its event at 0.
    time = jnp.where(outcome.end_time > 0.0, time, 0.0)
    time = jnp.where(outcome.status == CROSSED, time, jnp.inf)
    return outcome._replace(first_crossing=time, crossing_time=time)
