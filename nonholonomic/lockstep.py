"""One attempted step of a block of lanes: step control, events, and what becomes of each lane.

A lane is free until an accepted step ends beyond an event; then it searches for the event by trying that step again with
other lengths, its start kept, until the step ends on the event. So the event has the accuracy of the method.
"""

import abc
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from .runge_kutta import Lanes, States, explicit_step, inverse_root, scaled_error

RUNNING, REACHED_END, CROSSED, GUARD_LOST, FAILED = range(5)

#: Step control as in Diffrax's I controller with its defaults.
SAFETY, SHRINK, GROW = 0.9, 0.2, 10.0

#: An event is located once the next trial would differ by less than this part of the step.
LOCATED = 1e-10


class AbstractProblem(eqx.Module):
    """What is integrated: a field, a function whose zero is the event, and a guard that ends the run.

    The leaves of a problem are scalars, or hold one number per cell in their last axis.
    """

    @abc.abstractmethod
    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        """State at the start of every cell, and the magnitudes by which its absolute errors are measured."""

    @abc.abstractmethod
    def field(self, time: Lanes, state: States) -> States:
        """Rate of change of the state."""

    @abc.abstractmethod
    def crossing(self, state: States) -> Lanes | None:
        """A smooth function of order 1, positive before the event, negative after it; `None` if there is no event."""

    @abc.abstractmethod
    def guard(self, time: Lanes, state: States) -> Lanes | None:
        """A function of order 1 that is positive while the model holds; `None` if it always does."""


class Control(NamedTuple):
    """How steps are taken: the method, its tolerances, and whether a run goes on through its event."""

    tableau: diffrax.ButcherTableau
    order: int
    rtol: Float[Array, ""]
    t1: Float[Array, ""]
    max_steps: int
    passes: bool


class Block(NamedTuple):
    """The lanes of a block. `margin` is the least of crossing and guard; it is positive until an event.

    While a lane is `searching`, its event lies between the step lengths `low` and `high`.
    """

    cell: Int[Array, " lanes"]
    status: Int[Array, " lanes"]
    time: Lanes
    state: States
    rate: States
    margin: Lanes
    length: Lanes
    side: Lanes
    crossing_time: Lanes
    searching: Bool[Array, " lanes"]
    low: Lanes
    high: Lanes
    margin_low: Lanes
    margin_high: Lanes
    steps: Int[Array, " lanes"]
    rejected: Int[Array, " lanes"]


def least_margin(problem: AbstractProblem, side: Lanes, time: Lanes, state: States) -> Lanes | None:
    """The least of the problem's crossing function, counted positive on the lane's side of the event, and its guard."""
    crossing, guard = problem.crossing(state), problem.guard(time, state)
    if crossing is None:
        return guard
    return side * crossing if guard is None else jnp.minimum(side * crossing, guard)


def attempt(problem: AbstractProblem, control: Control, atol: States, block: Block) -> Block:
    """Try a step in every lane of a block and decide what becomes of it.

    **Arguments:**

    - `problem`: the problem with one number per lane (or a scalar) in every leaf.
    - `control`: the method and its tolerances.
    - `atol`: absolute tolerances, (components, lanes).
    - `block`: the lanes; those that have ended stay as they are.

    **Returns:** the block after the attempt.
    """
    watched = least_margin(problem, block.side, block.time, block.state) is not None

    def watch(time: Lanes, state: States) -> Lanes:
        return least_margin(problem, block.side, time, state)

    tried = explicit_step(
        control.tableau,
        problem.field,
        watch if watched else None,
        block.time,
        block.state,
        block.rate,
        block.length,
    )
    running = block.status == RUNNING
    error = scaled_error(*stop_gradient((tried.error, block.state, tried.state)), control.rtol, atol)
    # A step into nonsense counts as one with a huge error.
    error = jnp.where(jnp.isfinite(error), error, jnp.inf)
    good = error <= 1.0
    ends_beyond = beyond_between = hit = jnp.zeros_like(running)
    if watched:
        margin = stop_gradient(tried.watched)
        ends_beyond = good & (margin <= 0.0)
        # Positive at both ends but negative at a stage between: end the step at that stage and look again.
        beyond_between = good & ~ends_beyond & (tried.first_negative < 1.0)
        low, high, margin_low, margin_high, guess = _narrow(block, margin)
        close = block.searching & (jnp.abs(guess - block.length) <= 4.0 * LOCATED * high)
        # A run that goes on must start beyond the event, or it would find the same one again.
        hit = running & close & (margin <= 0.0)
        guess = jnp.where(close & ~hit, block.length + 2.0 * LOCATED * high, guess)
    free = running & ~block.searching
    forward = free & good & ~ends_beyond & ~beyond_between

    factor = SAFETY * inverse_root(jnp.maximum(error, 1e-30), control.order)
    factor = jnp.where(good, jnp.clip(factor, 1.0, GROW), jnp.clip(factor, SHRINK, SAFETY))
    length = block.length * factor
    if watched:
        length = jnp.where(beyond_between, block.length * tried.first_negative, length)

    moved = forward
    status, side, latest = block.status, block.side, block.crossing_time
    time = jnp.where(forward, block.time + block.length, block.time)
    searching = block.searching
    if watched:
        starts_search = free & ends_beyond
        searching = (searching | starts_search) & ~hit
        length = jnp.where(searching, guess, length)
        moved = forward | hit
        by_guard = hit & _is_guard(problem, block.time + block.length, tried.state)
        time = jnp.where(hit, block.time + block.length, time)
        ends_run = by_guard if control.passes else hit
        status = jnp.where(ends_run, jnp.where(by_guard, GUARD_LOST, CROSSED), status)
        crossed = hit & ~by_guard
        if control.passes:
            # Only the way from positive to negative is the event; the way back is passed in silence.
            counts = crossed & (side > 0.0)
            latest = jnp.where(counts, crossing_time(problem, time, tried.state), latest)
            side = jnp.where(crossed, -side, side)
        # Just past a crossing the margin is round-off of either sign.
        margin = jnp.where(crossed, jnp.abs(margin), margin)
    state = jnp.where(moved, tried.state, block.state)
    rate = jnp.where(moved, tried.rate, block.rate)

    steps = block.steps + running
    at_end = running & (status == RUNNING) & moved & (time >= control.t1)
    status = jnp.where(at_end, REACHED_END, status)
    tiny = 8.0 * jnp.finfo(time.dtype).eps * jnp.maximum(time, 1e-3)
    stuck = free & ~forward & ~searching & (length <= tiny) | (steps >= control.max_steps)
    status = jnp.where(running & (status == RUNNING) & stuck, FAILED, status)
    # The last step ends on the horizon exactly: what is left of it may differ from the length by round-off.
    left = control.t1 - time
    length = jnp.where(~searching & (length >= left * (1.0 - 1e-12)), left, length)
    length = jnp.where(status == RUNNING, length, 0.0)
    return Block(
        cell=block.cell,
        status=status,
        time=jnp.where(at_end, control.t1, time),
        state=state,
        rate=rate,
        margin=jnp.where(moved, margin, block.margin) if watched else block.margin,
        length=length,
        side=side,
        crossing_time=latest,
        searching=searching,
        low=low if watched else block.low,
        high=high if watched else block.high,
        margin_low=margin_low if watched else block.margin_low,
        margin_high=margin_high if watched else block.margin_high,
        steps=steps,
        rejected=block.rejected + (free & ~forward & ~ends_beyond),
    )


def _is_guard(problem: AbstractProblem, time: Lanes, state: States) -> Bool[Array, " lanes"]:
    """Whether a located event is that of the guard: the function that is closer to zero made it."""
    crossing, guard = problem.crossing(state), problem.guard(time, state)
    if crossing is None or guard is None:
        return jnp.full(time.shape, crossing is None)
    return jnp.abs(guard) < jnp.abs(crossing)


def _narrow(block: Block, margin: Lanes) -> tuple[Lanes, ...]:
    """Narrow the bracket by what the attempt found and propose the next length (Anderson and Bjorck, BIT 13 (1973) 253).

    A lane that is not searching yet opens its bracket with the step it just took.
    """
    opens = ~block.searching
    old_low = jnp.where(opens, 0.0, block.low)
    old_high = jnp.where(opens, block.length, block.high)
    old_margin_low = jnp.where(opens, block.margin, block.margin_low)
    old_margin_high = jnp.where(opens, margin, block.margin_high)
    replaces_high = margin <= 0.0
    # The end that stays is given less weight, so that it moves too in the next trial.
    fade_low = _fade(margin, old_margin_high)
    fade_high = _fade(margin, old_margin_low)
    low = jnp.where(opens | replaces_high, old_low, block.length)
    high = jnp.where(opens | ~replaces_high, old_high, block.length)
    margin_low = jnp.where(opens, old_margin_low, jnp.where(replaces_high, old_margin_low * fade_low, margin))
    margin_high = jnp.where(opens, old_margin_high, jnp.where(replaces_high, margin, old_margin_high * fade_high))
    slope = margin_high - margin_low
    guess = low - margin_low * (high - low) / jnp.where(slope == 0.0, 1.0, slope)
    middle = 0.5 * (low + high)
    guess = jnp.where((guess > low) & (guess < high), guess, middle)
    return low, high, margin_low, margin_high, guess


def _fade(margin: Lanes, replaced: Lanes) -> Lanes:
    factor = 1.0 - margin / jnp.where(replaced == 0.0, 1.0, replaced)
    return jnp.where(factor > 0.0, factor, 0.5)


def crossing_time(problem: AbstractProblem, time: Lanes, state: States) -> Lanes:
    """When the crossing function vanishes, for a state close to that, to third order in the distance.

    It gives the time of a located event its derivatives: `time` is held fixed, the state varies with the parameters, and
    the series t - g/g' - g'' g^2 / (2 g'^3) turns its variation into that of the time (implicit function theorem).
    """

    def slope(at: States) -> Lanes:
        return jax.jvp(problem.crossing, (at,), (problem.field(time, at),))[1]

    first, second = jax.jvp(slope, (state,), (problem.field(time, state),))
    first = jnp.where(first == 0.0, 1.0, first)
    shift = problem.crossing(state) / first
    return time - shift - 0.5 * second / first * shift * shift
