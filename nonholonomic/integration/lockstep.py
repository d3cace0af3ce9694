"""One attempted step of a block of lanes: step control, events, and what becomes of each lane.

A lane is free until an accepted step ends beyond an event; then it searches for the event by trying that step again with
other lengths from the same start, until the step ends on the event. So the event has the accuracy of the method.
"""

import abc
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from .runge_kutta import Lanes, States, Step, explicit_step, inverse_root, scaled_error

RUNNING, REACHED_END, CROSSED, GUARD_LOST, FAILED = range(5)

#: Step control as in Diffrax's I controller with its defaults.
SAFETY, SHRINK, GROW = 0.9, 0.2, 10.0

#: An event is located once the next trial would differ by less than this fraction of the step in which it lies. It causes an
#: error of 2e-13 of the time at which contact ends, 2e-12 with ten times the value; `crossing_time` removes it from a crossing.
LOCATED = 1e-10

#: A dip of the crossing function within a step is looked at if its estimate is below this fraction of the values at both ends.
#: With a tenth of it, one of 1279 first crossings in a cylinder is missed at a tolerance of 1e-7 and none at 1e-9; with ten
#: times as much, no further crossing is found, at the cost of a quarter more steps.
DIP = 0.2

#: After this many trials the far end of the bracket is taken for the event. It is a safety net: ten times as many change no
#: bit of a result; with six, the time at which contact ends would be wrong by 1e-8.
MOST_TRIALS = 64


class AbstractProblem(eqx.Module):
    """What is integrated: a field, a function whose zero is the event, and a guard that ends the run.

    The leaves of a problem are scalars, or hold one number per cell in their last axis.
    """

    @abc.abstractmethod
    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        """State at the start of every cell, and the magnitudes by which its absolute errors are measured."""

    @abc.abstractmethod
    def field(self, time: Lanes, state: States) -> States:
        """Rate of change of the state, lane by lane; the state may come as a tuple of its components."""

    @abc.abstractmethod
    def crossing(self, state: States) -> Lanes | None:
        """A smooth function of order 1, positive before the event, negative after it; `None` if there is no event."""

    @abc.abstractmethod
    def guard(self, time: Lanes, state: States) -> Lanes | None:
        """A function of order 1 that is positive while the model holds; `None` if it always does."""


class Control(NamedTuple):
    """How steps are taken.

    `tableau` and `order` are the method's; `rtol` the relative tolerance; `t1` the horizon [s], one for all or one per lane;
    a lane that needs more than `max_steps` has failed; `passes` says whether a run goes on through its event; `parts` is the
    number of equal parts of the state, such as a state and its variations: the part with the largest error decides.
    """

    tableau: diffrax.ButcherTableau
    order: int
    rtol: Float[Array, ""]
    t1: Float[Array, "..."]
    max_steps: int
    passes: bool
    parts: int


class Search(NamedTuple):
    """Where a lane looks for its event: between the step lengths `low` and `high` [s], with the margins found there.

    `stride` is the length of the step in which the search began, `trials` counts the steps tried since.
    """

    low: Lanes
    high: Lanes
    margin_low: Lanes
    margin_high: Lanes
    stride: Lanes
    trials: Int[Array, " lanes"]


class Block(NamedTuple):
    """The lanes of a block.

    - `cell`: which cell of the problem a lane runs; `status`: one of the codes above.
    - `time` [s], `state`, `rate`: where the lane is, and the field there.
    - `length`: of the step to be tried [s], if the horizon is not nearer.
    - `side`: 1 before the event, -1 beyond it; `margin`: the least of `side` times the crossing function and the guard.
    - `crossing_time`: of the last event that was passed [s], infinite if there was none.
    - `searching`: whether the lane looks for an event, `search`: where.
    - `steps`: tried so far, `rejected`: by step control.
    """

    cell: Int[Array, " lanes"]
    status: Int[Array, " lanes"]
    time: Lanes
    state: States
    rate: States
    length: Lanes
    side: Lanes
    margin: Lanes
    crossing_time: Lanes
    searching: Bool[Array, " lanes"]
    search: Search
    steps: Int[Array, " lanes"]
    rejected: Int[Array, " lanes"]


def least_margin(problem: AbstractProblem, side: Lanes, time: Lanes, state: States) -> Lanes:
    """The least of the problem's crossing function, counted positive on the lane's side of the event, and its guard."""
    crossing, guard = problem.crossing(state), problem.guard(time, state)
    if crossing is None:
        return jnp.ones_like(side) if guard is None else guard
    return side * crossing if guard is None else jnp.minimum(side * crossing, guard)


def length_to_try(control: Control, block: Block) -> Lanes:
    """Length of each lane's next step [s]: the last one ends on the horizon exactly, even where round-off would miss it."""
    left = control.t1 - block.time
    return jnp.where(~block.searching & (block.length >= left * (1.0 - 1e-12)), left, block.length)


def attempt(problem: AbstractProblem, control: Control, atol: States, block: Block) -> Block:
    """Try a step in every lane of a block and decide what becomes of it.

    **Arguments:**

    - `problem`: the problem with one number per lane (or a scalar) in every leaf.
    - `control`: the method and its tolerances.
    - `atol`: absolute tolerances, (components, lanes).
    - `block`: the lanes; those that have ended stay as they are.

    **Returns:** the block after the attempt.
    """

    def watch(time: Lanes, state: States) -> Lanes:
        return least_margin(problem, block.side, time, state)

    tried_length = length_to_try(control, block)
    tried = explicit_step(control.tableau, problem.field, watch, block.time, block.state, block.rate, tried_length)
    running = block.status == RUNNING
    free = running & ~block.searching
    error = scaled_error(*stop_gradient((tried.error, block.state, tried.state)), control.rtol, atol, control.parts)
    # An event is located where the margin is round-off. Joined and behind a barrier it is computed once; otherwise
    # the compiler fuses it into several kernels with different round-off, and the event is found in one but not in another.
    error, margin = jax.lax.optimization_barrier(jnp.stack([error, stop_gradient(tried.watched)]))
    # A step to a non-finite state counts as one with a huge error.
    error = jnp.where(jnp.isfinite(error) & ~jnp.isnan(margin), error, jnp.inf)
    good = error <= 1.0
    # Negative in between: end the step there and look again, so that the first event of several is found.
    negative = jnp.minimum(tried.first_negative, stop_gradient(_dip(problem, block, tried, tried_length)))
    between = good & (negative < 1.0)
    beyond = good & ~between & (margin <= 0.0)
    forward = free & good & ~between & ~beyond

    search, guess, found = _narrow(block, margin, tried_length)
    hit = running & found
    searching = (block.searching | (free & beyond)) & ~hit
    moved = forward | hit
    time = jnp.where(moved, block.time + tried_length, block.time)

    length = tried_length * _factor(error, good, control.order)
    length = jnp.where(between, tried_length * negative, length)
    length = jnp.where(searching, guess, jnp.where(hit, search.stride, length))
    status, side, latest = _fate(problem, control, block, tried, time, hit)
    ended = running & (status == RUNNING) & moved & (time >= control.t1)
    steps = block.steps + running
    # Written so that a length of NaN counts as stuck.
    tiny = 8.0 * jnp.finfo(time.dtype).eps * jnp.maximum(time, 1e-3)
    stuck = free & ~forward & ~searching & ~(length > tiny)
    stuck |= forward & (time == block.time) & (tried_length > 0.0)
    failed = running & (status == RUNNING) & ~ended & (stuck | (steps >= control.max_steps))
    status = jnp.where(failed, FAILED, jnp.where(ended, REACHED_END, status))
    return Block(
        cell=block.cell,
        status=status,
        time=jnp.where(ended, control.t1, time),
        state=jnp.where(moved, tried.state, block.state),
        rate=jnp.where(moved, tried.rate, block.rate),
        length=length,
        side=side,
        # Just past a crossing the margin is round-off of either sign.
        margin=jnp.where(hit, jnp.abs(margin), jnp.where(forward, margin, block.margin)),
        crossing_time=latest,
        searching=searching,
        search=search,
        steps=steps,
        rejected=block.rejected + (free & ~forward & ~beyond),
    )


def _dip(problem: AbstractProblem, block: Block, tried: Step, length: Lanes) -> Lanes:
    """Where in the step the crossing function may dip below zero and come back, as a fraction of the step; 2 if nowhere.

    That is the minimum of the cubic through its values and slopes at both ends, if it is low compared to both ends.
    """
    if problem.crossing(block.state) is None:
        return jnp.full_like(length, 2.0)
    low, fall = jax.jvp(problem.crossing, (block.state,), (block.rate,))
    high, rise = jax.jvp(problem.crossing, (tried.state,), (tried.rate,))
    low, high = block.side * low, block.side * high
    fall, rise = block.side * fall * length, block.side * rise * length
    cubic = 3.0 * (fall + rise - 2.0 * (high - low))
    square = 3.0 * (high - low) - 2.0 * fall - rise
    root = square + jnp.sqrt(jnp.maximum(square * square - cubic * fall, 0.0))
    at = -fall / jnp.where(root == 0.0, 1.0, root)
    least = low + at * (fall + at * (square + at * cubic / 3.0))
    dips = (fall < 0.0) & (rise > 0.0) & (least < DIP * jnp.minimum(low, high)) & (at > 0.02) & (at < 0.98)
    return jnp.where(dips, at, 2.0)


def _factor(error: Lanes, good: Bool[Array, " lanes"], order: int) -> Lanes:
    """The factor from this step's length to the next one's, as in Diffrax's I controller."""
    factor = SAFETY * inverse_root(jnp.maximum(error, 1e-30), order)
    return jnp.where(good, jnp.clip(factor, 1.0, GROW), jnp.clip(factor, SHRINK, SAFETY))


def _fate(
    problem: AbstractProblem, control: Control, block: Block, tried: Step, time: Lanes, hit: Bool[Array, " lanes"]
) -> tuple[Int[Array, " lanes"], Lanes, Lanes]:
    """Status, side and latest crossing time of the lanes, where `hit` says that an event was located."""
    crossing, guard = problem.crossing(tried.state), problem.guard(time, tried.state)
    # The lesser of the two was located; its sign may be round-off.
    by_guard = hit if crossing is None else hit & (False if guard is None else guard <= block.side * crossing)
    crossed = hit & ~by_guard
    if not control.passes:
        status = jnp.where(hit, jnp.where(by_guard, GUARD_LOST, CROSSED), block.status)
        return status, block.side, block.crossing_time
    # Only the way from positive to negative is the event; the way back goes unnoticed.
    counts = crossed & (block.side > 0.0)
    latest = jnp.where(counts, crossing_time(problem, time, tried.state), block.crossing_time)
    return jnp.where(by_guard, GUARD_LOST, block.status), jnp.where(crossed, -block.side, block.side), latest


def _narrow(block: Block, margin: Lanes, length: Lanes) -> tuple[Search, Lanes, Bool[Array, " lanes"]]:
    """Narrow the bracket by what the attempt found (Anderson and Bjorck, BIT 13 (1973) 253).

    A lane that is not searching yet opens its bracket with the step it just took.

    **Returns:** the bracket, the length to try next, and whether the attempt ended on the event.
    """
    opens, was = ~block.searching, block.search
    replaces_high = margin <= 0.0
    # Just past a crossing the margin is round-off, or 0, and would send the search back to that crossing.
    start = jnp.maximum(block.margin, -1e-3 * margin)
    # The end that stays is given less weight, so that it moves too in the next trial.
    weighted_low = was.margin_low * _fade(margin, was.margin_high)
    weighted_high = was.margin_high * _fade(margin, was.margin_low)
    search = Search(
        low=jnp.where(opens, 0.0, jnp.where(replaces_high, was.low, length)),
        high=jnp.where(opens | replaces_high, length, was.high),
        margin_low=jnp.where(opens, start, jnp.where(replaces_high, weighted_low, margin)),
        margin_high=jnp.where(opens | replaces_high, margin, weighted_high),
        stride=jnp.where(opens, length, was.stride),
        trials=jnp.where(opens, 0, was.trials + 1),
    )
    rise = search.margin_high - search.margin_low
    guess = search.low - search.margin_low * (search.high - search.low) / jnp.where(rise == 0.0, 1.0, rise)
    guess = jnp.where(jnp.isfinite(guess), jnp.clip(guess, search.low, search.high), search.high)
    located = max(LOCATED, 8.0 * float(jnp.finfo(margin.dtype).eps)) * search.stride
    tired = search.trials >= MOST_TRIALS
    close = block.searching & ((jnp.abs(guess - length) <= 2.0 * located) | tired)
    # A run that goes on must start beyond the event, or it would find the same one again.
    found = close & replaces_high
    beyond = jnp.where(tired, search.high, jnp.minimum(length + located, search.high))
    return search, jnp.where(close & ~found, beyond, guess), found


def _fade(margin: Lanes, replaced: Lanes) -> Lanes:
    factor = 1.0 - margin / jnp.where(replaced == 0.0, 1.0, replaced)
    return jnp.where(factor > 0.0, factor, 0.5)


def crossing_time(problem: AbstractProblem, time: Lanes, state: States) -> Lanes:
    """When the crossing function vanishes, for a state close to that (`event_time`)."""
    return event_time(problem, problem.crossing, time, state)


def event_time(problem: AbstractProblem, function: Callable[[States], Lanes], time: Lanes, state: States) -> Lanes:
    """When a function of the state vanishes along a motion, for a state close to that, to third order in the distance.

    It gives the time of a located event its derivatives: `time` is held fixed, the state varies with the parameters, and
    the series t - g/g' - g'' g^2 / (2 g'^3) turns its variation into that of the time (implicit function theorem).
    """

    def slope(at: States) -> Lanes:
        return jax.jvp(function, (at,), (problem.field(time, at),))[1]

    first, second = jax.jvp(slope, (state,), (problem.field(time, state),))
    first = jnp.where(first == 0.0, 1.0, first)
    shift = function(state) / first
    return time - shift - 0.5 * second / first * shift * shift
