"""Functions that fall below zero and return within a step, so that the signs at the ends of the step do not show the
two zeros.

Where a double root may have been missed, the step is tried again with an end near the minimum. If the function is
negative there, its zero is located like any other. Otherwise the shorter step is accepted, and the next step checks the
rest.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .runge_kutta import Lanes, States, Step

#: A minimum of the event function within a step is checked if its estimate is below this fraction of the values at both
#: ends. With a tenth of this value, one of 1279 first crossings in a cylinder is missed at a tolerance of 1e-7, and
#: none at 1e-9. Ten times this value takes a quarter more steps and locates no further crossing.
DIP = 0.2

#: A margin can fall below zero between the places at which it is known only if its least known value is below this
#: fraction of its range in the step. The first fraction holds if the least value lies inside the step, the second if it
#: lies at an end. For a parabola whose minimum is midway between two places, the fractions are 0.1 and 0.014.
SUSPECT_INSIDE, SUSPECT_AT_END = 0.15, 0.05

#: The error of the parabola through known values of a margin, midway in the step, as a fraction of the margin's range.
SCATTER = 0.05

#: A smaller margin at the start of a step is round-off: the mode begins on its margin.
ON_MARGIN = 1e-10


def missed_double_root(
    function: Callable[[States], Lanes | None], side: Lanes, start: tuple[States, States], trial: Step, length: Lanes
) -> Lanes:
    """Fraction of a step at which a function may fall below zero and return; 2 if nowhere. This is the minimum of the
    cubic through values and derivatives at both ends, if the minimum is far below both values.

    **Arguments:**

    - `function`: function of the state; where `side` is -1, its negative is used.
    - `start`: state and rate at the start of the step; `trial`: the step, of the given `length` [s].
    """
    state, rate = start
    if function(state) is None:
        return jnp.full_like(length, 2.0)
    low, fall = jax.jvp(function, (state,), (rate,))
    high, rise = jax.jvp(function, (trial.state,), (trial.rate,))
    low, high = side * low, side * high
    place, minimum = cubic_minimum(low, side * fall * length, high, side * rise * length)
    dips = (minimum < DIP * jnp.minimum(low, high)) & (place > 0.02) & (place < 0.98)
    return jnp.where(dips, place, 2.0)


def missed_loss(
    places: Float[np.ndarray, " places"],
    margins: Float[Array, "places margins lanes"] | None,
    free: Bool[Array, " lanes"],
) -> Lanes:
    """Fraction of a step at which a margin may first fall below zero and return; 2 if nowhere.

    This is the minimum of the parabola through the least known value and its neighbours, if the error may hide a zero.

    **Arguments:**

    - `places`: the fractions of the step, from 0 to 1, at which the `margins` are known; `margins` is `None` if there
      are none.
    - `free`: the lanes to check.
    """
    if margins is None or len(places) < 3:
        return jnp.full(free.shape, 2.0)
    values = list(jnp.unstack(margins))
    inner_least, at_end = functools.reduce(jnp.minimum, values[1:-1]), jnp.minimum(values[0], values[-1])
    least_value = jnp.minimum(inner_least, at_end)
    scale = functools.reduce(jnp.maximum, values) - least_value
    suspect = free & (least_value < jnp.where(inner_least < at_end, SUSPECT_INSIDE, SUSPECT_AT_END) * scale)
    # Where a mode begins with a margin of 0, this zero does not end the mode. If the margin rises from there with slope
    # 0, the parabola may fall at first.
    suspect &= values[0] > ON_MARGIN

    def first_minimum() -> Lanes:
        # Unstacked in here: the operands of a branch are copied in every step.
        place, minimum = _least_minimum(places, list(jnp.unstack(margins)), least_value)
        error = SCATTER * scale * 4.0 * place * (1.0 - place)
        dips = suspect & (place > 0.0) & (place < 1.0) & (minimum < error)
        return jnp.min(jnp.where(dips, place, 2.0), axis=0)

    # A branch, because few steps come near a zero.
    return jax.lax.cond(jnp.any(suspect), first_minimum, lambda: jnp.full(free.shape, 2.0))


def cubic_minimum(
    low: Float[Array, "..."], fall: Float[Array, "..."], high: Float[Array, "..."], rise: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Position between 0 and 1 of the minimum of the cubic with given values and derivatives at both ends, and its
    value there.

    The position is 2 where the cubic does not fall at 0 and rise at 1.
    """
    cubic = 3.0 * (fall + rise - 2.0 * (high - low))
    square = 3.0 * (high - low) - 2.0 * fall - rise
    root = square + jnp.sqrt(jnp.maximum(square * square - cubic * fall, 0.0))
    place = -fall / jnp.where(root == 0.0, 1.0, root)
    minimum = low + place * (fall + place * (square + place * cubic / 3.0))
    return jnp.where((fall < 0.0) & (rise > 0.0), place, 2.0), minimum


def _least_minimum(
    places: Float[np.ndarray, " places"],
    values: list[Float[Array, "margins lanes"]],
    least_value: Float[Array, "margins lanes"],
) -> tuple[Float[Array, "margins lanes"], Float[Array, "margins lanes"]]:
    """Place and value of the minimum of the parabola through three neighbouring places: the place of the least value
    and its neighbours; if the least value is at an end of the step, the three places at that end. The place is 2 if the
    parabola has no minimum.

    Other minima are found later, because the step then ends at this one and is checked again.
    """
    gaps = np.diff(places)
    # Divisions cost as much as everything else here, so they are left to constants.
    slopes = [
        (slope_after - slope_before) * (1.0 / gap)
        for slope_before, slope_after, gap in zip(values[:-1], values[1:], gaps, strict=True)
    ]

    def about(k: int) -> tuple[Any, ...]:
        return slopes[k - 1], slopes[k], values[k], places[k], gaps[k - 1], 1.0 / (gaps[k - 1] + gaps[k])

    parabola = about(len(places) - 2)
    for k in range(len(places) - 3, 0, -1):
        is_earlier = functools.reduce(jnp.minimum, values[: k + 1]) <= least_value
        parabola = tuple(jnp.where(is_earlier, new, old) for new, old in zip(about(k), parabola, strict=True))
    slope_before, slope_after, middle, place, gap, per_length = parabola
    bend = (slope_after - slope_before) * per_length
    slope = slope_before + bend * gap
    shift = 0.5 * slope / jnp.where(bend > 0.0, bend, 1.0)
    return jnp.where(bend > 0.0, place - shift, 2.0), middle - 0.5 * slope * shift
