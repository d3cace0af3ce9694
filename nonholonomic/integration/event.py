"""The search for an event within a step: by trying the step again, from its start, with other lengths.

So the event has the accuracy of the method, and not that of an interpolation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .runge_kutta import Lanes, States, Step

#: An event is located once the next trial would differ by less than this fraction of the step in which it lies. The end of
#: contact errs by 2e-13 of its time from it, and by 2e-12 with ten times the value; `crossing_time` takes it out of a
#: crossing.
LOCATED = 1e-10

#: A dip of the event function within a step is looked at if its estimate is below this fraction of the values at both ends.
#: With a tenth of it one first crossing of 1279 in a cylinder is missed at a tolerance of 1e-7 and none at 1e-9; with ten
#: times as much none is found that was not, for a quarter more steps.
DIP = 0.2

#: Trials after which the far end of what is left of the step is taken for the event. It is a safety net: ten times as many
#: change no bit of a result, six would let the end of contact err by 1e-8.
MOST_TRIALS = 64


class Bracket(NamedTuple):
    """Where a lane looks for its event: between the step lengths `low` and `high` [s], with the margins found there.

    `stride` is the length of the step in which the search began, `trials` counts the steps tried since.
    """

    low: Lanes
    high: Lanes
    margin_low: Lanes
    margin_high: Lanes
    stride: Lanes
    trials: Int[Array, " lanes"]


def refine(
    bracketing: Bool[Array, " lanes"], was: Bracket, before: Lanes, margin: Lanes, length: Lanes
) -> tuple[Bracket, Lanes, Bool[Array, " lanes"]]:
    """Narrow the bracket by what an attempt found (Anderson and Bjorck, BIT 13 (1973) 253).

    **Arguments:**

    - `bracketing`: which lanes search already; any other opens its bracket with the step it just took.
    - `was`: the bracket.
    - `before`, `margin`: the margin at the start of the attempt and at its end.
    - `length`: of the attempt [s].

    **Returns:** the bracket, the length to try next, and whether the attempt ended on the event.
    """
    opens = ~bracketing
    replaces_high = margin <= 0.0
    # Just past a crossing the margin is round-off, or 0, and would send the search back to that crossing.
    start = jnp.maximum(before, -1e-3 * margin)
    # The end that stays is given less weight, so that it moves too in the next trial.
    weighted_low = was.margin_low * _fade(margin, was.margin_high)
    weighted_high = was.margin_high * _fade(margin, was.margin_low)
    bracket = Bracket(
        low=jnp.where(opens, 0.0, jnp.where(replaces_high, was.low, length)),
        high=jnp.where(opens | replaces_high, length, was.high),
        margin_low=jnp.where(opens, start, jnp.where(replaces_high, weighted_low, margin)),
        margin_high=jnp.where(opens | replaces_high, margin, weighted_high),
        stride=jnp.where(opens, length, was.stride),
        trials=jnp.where(opens, 0, was.trials + 1),
    )
    rise = bracket.margin_high - bracket.margin_low
    guess = bracket.low - bracket.margin_low * (bracket.high - bracket.low) / jnp.where(rise == 0.0, 1.0, rise)
    guess = jnp.where(jnp.isfinite(guess), jnp.clip(guess, bracket.low, bracket.high), bracket.high)
    located = max(LOCATED, 8.0 * float(jnp.finfo(margin.dtype).eps)) * bracket.stride
    tired = bracket.trials >= MOST_TRIALS
    close = bracketing & ((jnp.abs(guess - length) <= 2.0 * located) | tired)
    # A run that goes on must start beyond the event, or it would find the same one again.
    found = close & replaces_high
    beyond = jnp.where(tired, bracket.high, jnp.minimum(length + located, bracket.high))
    return bracket, jnp.where(close & ~found, beyond, guess), found


def _fade(margin: Lanes, replaced: Lanes) -> Lanes:
    factor = 1.0 - margin / jnp.where(replaced == 0.0, 1.0, replaced)
    return jnp.where(factor > 0.0, factor, 0.5)


def dip(
    function: Callable[[States], Lanes | None], side: Lanes, before: tuple[States, States], tried: Step, length: Lanes
) -> Lanes:
    """Where in a step a function may dip below zero and come back, as a fraction of the step; 2 if nowhere.

    It is where the cubic through its values and slopes at both ends is least, if that is low against both ends.

    **Arguments:**

    - `function`: of the state, counted positive where `side` is 1 and negative where it is -1.
    - `before`: state and rate at the start of the step; `tried`: the step, of some `length` [s].
    """
    state, rate = before
    if function(state) is None:
        return jnp.full_like(length, 2.0)
    low, fall = jax.jvp(function, (state,), (rate,))
    high, rise = jax.jvp(function, (tried.state,), (tried.rate,))
    low, high = side * low, side * high
    fall, rise = side * fall * length, side * rise * length
    cubic = 3.0 * (fall + rise - 2.0 * (high - low))
    square = 3.0 * (high - low) - 2.0 * fall - rise
    root = square + jnp.sqrt(jnp.maximum(square * square - cubic * fall, 0.0))
    at = -fall / jnp.where(root == 0.0, 1.0, root)
    least = low + at * (fall + at * (square + at * cubic / 3.0))
    dips = (fall < 0.0) & (rise > 0.0) & (least < DIP * jnp.minimum(low, high)) & (at > 0.02) & (at < 0.98)
    return jnp.where(dips, at, 2.0)
