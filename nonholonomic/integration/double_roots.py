"""Functions that fall below zero and return within a step, so that the signs at the ends of the step do not show the
two zeros.

Where a double root may have been missed, the step is tried again with an end near the minimum. If the function is
negative there, its zero is located like any other. Otherwise the shorter step is accepted, and the next step checks the
rest.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .runge_kutta import Lanes, States, Step, weighted_sum

#: A minimum of the event function within a step is checked if its estimate is below this fraction of the values at both
#: ends. With a tenth of this value, one of 1279 first crossings in a cylinder is missed at a tolerance of 1e-7, and
#: none at 1e-9. Ten times this value takes a quarter more steps and locates no further crossing.
DIP = 0.2

#: A margin can fall below zero between the places at which it is known only if its least known value is below this
#: fraction of its range in the step. The first fraction holds if the least value lies inside the step, the second if it
#: lies at an end. For a parabola whose minimum is midway between two places, the fractions are 0.1 and 0.014.
SUSPECT_INSIDE, SUSPECT_AT_END = 0.15, 0.05

#: The error of the polynomial through the known values of a margin, midway in the step, as a fraction of the margin's range.
SCATTER = 0.05

#: A margin that changes by less in a step is round-off and has no minimum.
FLAT = 1e-10


def missed_double_root(
    function: Callable[[States], Lanes | None], side: Lanes, before: tuple[States, States], tried: Step, length: Lanes
) -> Lanes:
    """Fraction of a step at which a function may fall below zero and return; 2 if nowhere. This is the minimum of the
    cubic through values and derivatives at both ends, if the minimum is far below both values.

    **Arguments:**

    - `function`: function of the state; where `side` is -1, its negative is used.
    - `before`: state and rate at the start of the step; `tried`: the step, of the given `length` [s].
    """
    state, rate = before
    if function(state) is None:
        return jnp.full_like(length, 2.0)
    low, fall = jax.jvp(function, (state,), (rate,))
    high, rise = jax.jvp(function, (tried.state,), (tried.rate,))
    low, high = side * low, side * high
    at, least = _minimum(low, side * fall * length, high, side * rise * length)
    dips = (least < DIP * jnp.minimum(low, high)) & (at > 0.02) & (at < 0.98)
    return jnp.where(dips, at, 2.0)


def missed_loss(
    places: Float[np.ndarray, " places"],
    margins: Float[Array, "places margins lanes"] | None,
    free: Bool[Array, " lanes"],
) -> Lanes:
    """Fraction of a step at which a margin may first fall below zero and return; 2 if nowhere.

    This is the minimum of the polynomial through the known values, if its error may hide a zero.

    **Arguments:**

    - `places`: the fractions of the step, from 0 to 1, at which the `margins` are known; `margins` is `None` if there
      are none.
    - `free`: the lanes to check.
    """
    if margins is None or len(places) < 3:
        return jnp.full(free.shape, 2.0)
    inside, at_end = jnp.min(margins[1:-1], axis=0), jnp.minimum(margins[0], margins[-1])
    lowest = jnp.minimum(inside, at_end)
    spread = jnp.max(margins, axis=0) - lowest
    suspect = (lowest < jnp.where(inside < at_end, SUSPECT_INSIDE, SUSPECT_AT_END) * spread) & (spread > FLAT) & free
    # Where a mode begins with a margin of 0, this zero does not end the mode. If the margin rises from there with slope
    # 0, the polynomial may fall at first.
    suspect &= margins[0] > FLAT

    def first_minimum() -> Lanes:
        # Only the least of several margins is searched. The step then ends at its minimum, and the others are checked
        # again.
        known, width = _least_of(suspect, lowest, margins, spread)
        low, fall, high, rise, begin, end = _first_valley(places, list(known))
        part, least = _minimum(low, fall * (end - begin), high, rise * (end - begin))
        place = begin + part * (end - begin)
        error = SCATTER * width * 4.0 * place * (1.0 - place)
        return jnp.where(jnp.any(suspect, axis=0) & (part < 1.0) & (least < error), place, 2.0)

    # A branch, because few steps come near a zero.
    return jax.lax.cond(jnp.any(suspect), first_minimum, lambda: jnp.full(free.shape, 2.0))


def _minimum(
    low: Float[Array, "..."], fall: Float[Array, "..."], high: Float[Array, "..."], rise: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Position between 0 and 1 of the minimum of the cubic with given values and derivatives at both ends, and its
    value there.

    The position is 2 where the cubic does not fall at 0 and rise at 1.
    """
    cubic = 3.0 * (fall + rise - 2.0 * (high - low))
    square = 3.0 * (high - low) - 2.0 * fall - rise
    root = square + jnp.sqrt(jnp.maximum(square * square - cubic * fall, 0.0))
    at = -fall / jnp.where(root == 0.0, 1.0, root)
    least = low + at * (fall + at * (square + at * cubic / 3.0))
    return jnp.where((fall < 0.0) & (rise > 0.0), at, 2.0), least


def _least_of(
    suspect: Bool[Array, "margins lanes"],
    lowest: Float[Array, "margins lanes"],
    margins: Float[Array, "places margins lanes"],
    spread: Float[Array, "margins lanes"],
) -> tuple[Float[Array, "places lanes"], Lanes]:
    """The values, and their range, of the suspect margin with the least known value in each lane."""
    rank, known, width = jnp.where(suspect[0], lowest[0], jnp.inf), margins[:, 0], spread[0]
    for k in range(1, len(lowest)):
        lower = suspect[k] & (lowest[k] < rank)
        rank, known = jnp.where(lower, lowest[k], rank), jnp.where(lower, margins[:, k], known)
        width = jnp.where(lower, spread[k], width)
    return known, width


def _first_valley(places: Float[np.ndarray, " places"], values: list[Lanes]) -> tuple[Lanes, ...]:
    """The first two neighbouring places between which the polynomial through all values has a minimum.

    **Returns:** value and slope at the first place, value and slope at the second, and the two places. If there is no
    minimum, these are the first two places, between which the slope does not change from falling to rising.
    """
    powers = np.arange(len(places))
    weights = (powers * places[:, None] ** np.maximum(powers - 1, 0)) @ np.linalg.inv(places[:, None] ** powers)
    slopes = [weighted_sum(row, values) for row in weights]
    valley: Any = (values[0], slopes[0], values[1], slopes[1], places[0], places[1])
    earlier = (slopes[0] < 0.0) & (slopes[1] > 0.0)
    for k in range(1, len(places) - 1):
        turns = (slopes[k] < 0.0) & (slopes[k + 1] > 0.0) & ~earlier
        later = (values[k], slopes[k], values[k + 1], slopes[k + 1], places[k], places[k + 1])
        valley = tuple(jnp.where(turns, new, old) for new, old in zip(later, valley, strict=True))
        earlier |= turns
    return valley
