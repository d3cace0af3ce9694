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
    bracketing: Bool[Array, " lanes"], old_bracket: Bracket, old_margin: Lanes, margin: Lanes, length: Lanes
) -> tuple[Bracket, Lanes, Bool[Array, " lanes"]]:
    """Narrow the bracket with the result of a trial step (Anderson and Bjorck, BIT 13 (1973) 253).

    **Arguments:**

    - `bracketing`: which lanes have a bracket; any other lane opens its bracket with the step it just took.
    - `old_bracket`: the bracket.
    - `old_margin`, `margin`: the margin at the start of the trial step and at its end.
    - `length`: length of the trial step [s].

    **Returns:** the bracket, the length to try next, and whether the trial step ended on the event.
    """
    is_new = ~bracketing
    replaces_high = margin <= 0.0
    # Just past an event the margin is round-off, or 0, and would lead back to that event.
    start = jnp.maximum(old_margin, -1e-3 * margin)
    # The retained end is given less weight, so that it moves too in the next trial.
    weighted_low = old_bracket.margin_low * _fade(margin, old_bracket.margin_high)
    weighted_high = old_bracket.margin_high * _fade(margin, old_bracket.margin_low)
    bracket = Bracket(
        low=jnp.where(is_new, 0.0, jnp.where(replaces_high, old_bracket.low, length)),
        high=jnp.where(is_new | replaces_high, length, old_bracket.high),
        margin_low=jnp.where(is_new, start, jnp.where(replaces_high, weighted_low, margin)),
        margin_high=jnp.where(is_new | replaces_high, margin, weighted_high),
        stride=jnp.where(is_new, length, old_bracket.stride),
        trials=jnp.where(is_new, 0, old_bracket.trials + 1),
    )
    rise = bracket.margin_high - bracket.margin_low
    guess = bracket.low - bracket.margin_low * (bracket.high - bracket.low) / jnp.where(rise == 0.0, 1.0, rise)
    guess = jnp.where(jnp.isfinite(guess), jnp.clip(guess, bracket.low, bracket.high), bracket.high)
    resolution = max(LOCATED, 8.0 * float(jnp.finfo(margin.dtype).eps)) * bracket.stride
    is_exhausted = bracket.trials >= MOST_TRIALS
    close = bracketing & ((jnp.abs(guess - length) <= 2.0 * resolution) | is_exhausted)
    # A run through a nonterminal event must restart beyond the event, or it would locate the same event again.
    is_located = close & replaces_high
    length_beyond = jnp.where(is_exhausted, bracket.high, jnp.minimum(length + resolution, bracket.high))
    return bracket, jnp.where(close & ~is_located, length_beyond, guess), is_located


def _fade(margin: Lanes, old_margin: Lanes) -> Lanes:
    factor = 1.0 - margin / jnp.where(old_margin == 0.0, 1.0, old_margin)
    return jnp.where(factor > 0.0, factor, 0.5)
