"""Locate an event within a step: retry the step from its start with other lengths.

The event therefore has the accuracy of the method, not that of an interpolant.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .runge_kutta import Lanes

#: An event is located once the next trial would differ by less than this fraction of the step that contains it. The
#: time at which contact ends then has a relative error of 2e-13, or of 2e-12 with ten times this value; `crossing_time`
#: removes this error from the times of events.
LOCATED = 1e-10

#: After this number of trials, the far end of the bracket counts as the event. This is a safety net: ten times as many
#: trials change no bit of a result; with only six, the end of contact would err by 1e-8.
MOST_TRIALS = 64


class Bracket(NamedTuple):
    """Bracket of the event in each lane: the step lengths `low` and `high` [s], with the margins there.

    `stride` is the length of the step that opened the bracket, `trials` counts the steps tried since.
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
    """Narrow the bracket with the result of a trial step (Anderson and Bjorck, BIT 13 (1973) 253).

    **Arguments:**

    - `bracketing`: which lanes have a bracket; any other lane opens its bracket with the step it just took.
    - `was`: the bracket.
    - `before`, `margin`: the margin at the start of the trial step and at its end.
    - `length`: length of the trial step [s].

    **Returns:** the bracket, the length to try next, and whether the trial step ended on the event.
    """
    opens = ~bracketing
    replaces_high = margin <= 0.0
    # Just past an event the margin is round-off, or 0, and would lead back to that event.
    start = jnp.maximum(before, -1e-3 * margin)
    # The retained end is given less weight, so that it moves too in the next trial.
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
    # A run through a nonterminal event must restart beyond the event, or it would locate the same event again.
    is_located = close & replaces_high
    beyond = jnp.where(tired, bracket.high, jnp.minimum(length + located, bracket.high))
    return bracket, jnp.where(close & ~is_located, beyond, guess), is_located


def _fade(margin: Lanes, replaced: Lanes) -> Lanes:
    factor = 1.0 - margin / jnp.where(replaced == 0.0, 1.0, replaced)
    return jnp.where(factor > 0.0, factor, 0.5)
