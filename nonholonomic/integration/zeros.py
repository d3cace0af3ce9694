"""Find many zeros of functions of one variable at once. (Events within a step are located in `event.py`.)"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

Brackets = Float[np.ndarray, " zeros"]

#: Halvings that reduce any bracket to round-off.
HALVINGS = 60

#: `few_trials` stops once a bracket, or the change from one trial to the next, is shorter than this fraction of the value.
LOCATED = 1e-14

#: After this number of trials, `few_trials` returns the last trial.
MOST_TRIALS = 60

#: Number of parts into which `all_crossings` divides a step, to check the sign at their ends, if there may be a crossing.
PARTS = 8

#: Number of rounds in which checks are added where the quantity is nearest to zero, to detect two crossings close
#: together.
CLOSER_LOOKS = 3

#: Checks closer together than this [s] give no new information.
CLOSEST = 1e-14


def halved(
    holds: Callable[[Float[Array, "..."]], Bool[Array, "..."]], low: Float[Array, "..."], high: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Find where a condition ceases to hold, by halving brackets; also inside transformations.

    **Arguments:**

    - `holds`: the condition, true at `low` and false at `high`.
    - `low`, `high`: the brackets, of any shape.

    **Returns:** the last value at which the condition holds, and the next value, at which it does not.

    **Example:**

    >>> from nonholonomic.integration.zeros import halved
    >>> low, high = halved(lambda x: x**2 < 2.0, jnp.asarray(1.0), jnp.asarray(2.0))
    >>> print(f"{low:.6f}")
    1.414214
    """

    def halve(_, bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        is_inside = holds(middle)
        return jnp.where(is_inside, middle, low), jnp.where(is_inside, high, middle)

    return jax.lax.fori_loop(0, HALVINGS, halve, (low, high))


def sign_changes(
    function: Callable[[Float[Array, " n"]], Float[Array, " n"]], grid: Float[Array, " n"]
) -> Float[Array, " zeros"]:
    """Zeros of a function between neighbours of a grid at which it has different signs, to round-off.

    **Arguments:** `function`: function of an array, element by element; `grid`: increasing numbers.

    **Example:**

    >>> from nonholonomic.integration.zeros import sign_changes
    >>> print(sign_changes(jnp.cos, jnp.arange(0.5, 7.0)).round(6))
    [1.570796 4.712389]
    """
    values = function(grid)
    changes = np.flatnonzero(np.sign(values[:-1]) != np.sign(values[1:]))
    if changes.size == 0:
        return jnp.zeros(0)
    sign = jnp.sign(values[changes])
    low, high = halved(lambda middle: jnp.sign(function(middle)) == sign, grid[changes], grid[changes + 1])
    return 0.5 * (low + high)


def few_trials(
    function: Callable[[Brackets], Any], low: Brackets, high: Brackets, at_low: Brackets, at_high: Brackets
) -> Brackets:
    """Zeros of a function that is expensive to evaluate, one in each bracket (Anderson and Bjorck, BIT 13 (1973) 253).

    **Arguments:**

    - `function`: function of NumPy arrays, element by element; JAX does not trace it.
    - `low`, `high`: the brackets; `at_low`, `at_high`: the function there, of opposite signs.

    **Example:**

    >>> import numpy as np
    >>> from nonholonomic.integration.zeros import few_trials
    >>> low, high = np.array([1.0]), np.array([2.0])
    >>> few_trials(lambda x: x**2 - 2.0, low, high, low**2 - 2.0, high**2 - 2.0).round(6)
    array([1.414214])
    """
    guess = low
    for trial in range(MOST_TRIALS if low.size else 0):
        last, rise = guess, at_high - at_low
        with np.errstate(all="ignore"):
            guess = low - at_low * (high - low) / rise
        # Where the function is NaN, and in every fourth trial as a safeguard, the bracket is halved.
        halve = ~np.isfinite(guess) | (trial % 4 == 3)
        guess = np.where(halve, 0.5 * (low + high), np.clip(guess, low, high))
        if np.all(np.minimum(high - low, np.abs(guess - last)) <= LOCATED * np.maximum(high, 1.0)):
            break
        value = function(guess)
        past_root = (value > 0.0) != (at_low > 0.0)
        with np.errstate(all="ignore"):
            fade_low, fade_high = 1.0 - value / at_high, 1.0 - value / at_low
        fade_low, fade_high = (np.where(fade > 0.0, fade, 0.5) for fade in (fade_low, fade_high))
        # The retained end is given less weight, so that it moves too in the next trial.
        at_low, at_high = np.where(past_root, at_low * fade_low, value), np.where(past_root, value, at_high * fade_high)
        low, high = np.where(past_root, low, guess), np.where(past_root, guess, high)
    return guess


def all_crossings(
    quantity: Callable[[Brackets], Any], time: Float[np.ndarray, " steps"], value: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, " crossings"]:
    """The times at which a quantity of a run passes zero, in either direction, in increasing order, with pairs of crossings
    inside a step.

    **Arguments:** `quantity`: function of times [s] in NumPy, not traced by JAX; NaN counts as beyond zero; `time`, `value`:
    the ends of the steps [s], and the quantity there.

    **Example:** the tip of a parabola between two steps is below zero.

    >>> import numpy as np
    >>> from nonholonomic.integration.zeros import all_crossings
    >>> steps = np.arange(4.0)
    >>> dip = lambda time: (time - 1.51) ** 2 - 1e-4
    >>> all_crossings(dip, steps, dip(steps)).round(6)
    array([1.5 , 1.52])
    """
    indices = np.flatnonzero(_may_cross(value))
    if indices.size == 0:
        return np.zeros(0)

    def signed(times: Brackets) -> Brackets:
        values = quantity(times)
        return np.where(np.isfinite(values), values, -np.inf)

    parts = np.arange(1, PARTS) / PARTS
    new = (time[indices] + parts[:, None] * (time[indices + 1] - time[indices])).ravel()
    for _ in range(1 + CLOSER_LOOKS):
        time, value = np.concatenate([time, new]), np.concatenate([value, signed(new)])
        order = np.argsort(time, kind="stable")
        time, value = time[order], value[order]
        new = _nearest(time, value)
        if new.size == 0:
            break
    changes = np.flatnonzero((value[:-1] > 0.0) != (value[1:] > 0.0))
    return few_trials(signed, time[changes], time[changes + 1], value[changes], value[changes + 1])


def _may_cross(value: Float[np.ndarray, " steps"]) -> Bool[np.ndarray, " gaps"]:
    """Steps in which a quantity may be zero: its sign changes, or it changes by more than its size, there or in a
    neighbour."""
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(value))
        max_change = np.max([change, np.append(change[1:], 0.0), np.insert(change[:-1], 0, 0.0)], axis=0)
        is_small = np.minimum(np.abs(value[:-1]), np.abs(value[1:])) < max_change
    return is_small | ((value[:-1] > 0.0) != (value[1:] > 0.0))


def _nearest(time: Float[np.ndarray, " looks"], value: Float[np.ndarray, " looks"]) -> Float[np.ndarray, " new"]:
    """The times at which a quantity is nearest to zero between checks of equal sign: the vertices of parabolas."""
    distance = np.abs(value)
    is_minimum = (distance[1:-1] < distance[:-2]) & (distance[1:-1] <= distance[2:])
    is_minimum &= (value[1:-1] > 0.0) == (value[:-2] > 0.0)
    is_minimum &= (value[1:-1] > 0.0) == (value[2:] > 0.0)
    middle = np.flatnonzero(is_minimum) + 1
    gap_before, gap_after = time[middle] - time[middle - 1], time[middle + 1] - time[middle]
    with np.errstate(all="ignore"):
        fall = (distance[middle - 1] - distance[middle]) / gap_before
        rise = (distance[middle + 1] - distance[middle]) / gap_after
        vertex = time[middle] + 0.5 * (fall * gap_after**2 - rise * gap_before**2) / (
            fall * gap_after + rise * gap_before
        )
    is_inside = (vertex > time[middle - 1]) & (vertex < time[middle + 1]) & (np.abs(vertex - time[middle]) > CLOSEST)
    return vertex[is_inside]
