"""Where a step must end: at an event, and before a function that changes faster than the state may vanish.

The event therefore has the accuracy of the method, not that of an interpolant.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from ..compilation.tracing import Bounds, UnboundedError, enclosing
from .problem import AbstractProblem, on_side
from .runge_kutta import Integers, Lanes, Mask, States, Step, inverse_root

#: An event is located once the next trial would differ by less than this fraction of the step that contains it. The
#: time at which contact ends then has a relative error of 2e-13, or of 2e-12 with ten times this value; `crossing_time`
#: removes this error from the times of events.
LOCATED = 1e-10

#: After this number of trials, the far end of the bracket counts as the event. Zeros of smooth functions take up to eight.
#: Those that take more than the second number jump or have kinks: every other trial then halves the bracket.
MOST_TRIALS, HALVED_AFTER = 100, 12


#: Places in a step, as fractions of it; margins there, of one event or of several.
Places = Float[np.ndarray, " places"]
Margins = Float[Array, "margins *lanes"]

#: The states and their rates at one end of a step.
End = tuple[States, States]


class Bracket(NamedTuple):
    """Bracket of the event in each lane: the step lengths `low` and `high` [s], with the margins there.

    `stride` is the length of the step that opened the bracket, `trials` counts the steps tried since.
    """

    low: Lanes
    high: Lanes
    margin_low: Lanes
    margin_high: Lanes
    stride: Lanes
    trials: Integers


def refine(
    bracketing: Mask, old_bracket: Bracket, old_margin: Lanes, margin: Lanes, length: Lanes
) -> tuple[Bracket, Lanes, Mask]:
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
    is_halved = (bracket.trials > HALVED_AFTER) & (bracket.trials % 2 == 0)
    guess = jnp.where(is_halved, 0.5 * (bracket.low + bracket.high), guess)
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


# Functions that fall below zero and return within a step, so that the signs at the ends of the step do not show the
# two zeros.
#
# Where a double root may have been missed, the step is tried again with an end near the minimum. If the function is
# negative there, its zero is located like any other. Otherwise the shorter step is accepted, and the next step checks the
# rest.

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
    function: Callable[[States], Lanes | None], side: Lanes, start: End, trial: Step, length: Lanes
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


def missed_loss(places: Places, margins: Float[Array, "places margins *lanes"] | None, free: Mask) -> Lanes:
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


def cubic_minimum(low: Lanes, fall: Lanes, high: Lanes, rise: Lanes) -> tuple[Lanes, Lanes]:
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


def _least_minimum(places: Places, values: list[Margins], least_value: Margins) -> tuple[Margins, Margins]:
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

    def about(k: int) -> tuple[Array | float, ...]:
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


# Functions that may change faster than the state: where a step must end so that none of their zeros is missed.
#
# A step is as long as the motion of the state allows. A user's margin or event function may change faster: waves that a body
# flies over, an explicit time, a product of distances, a narrow dip. The motion inside a step is a polynomial, whose error
# is estimated. Interval arithmetic bounds the function and its slope along parts of it, which are halved until each
# part is known to have no zero, or one. A function for which there are no bounds, such as one with a loop of unknown length,
# is looked at in many places; between them it is a cubic whose error is estimated, and the step is cut where this error
# could hide a zero.

Functions = Float[Array, "functions *lanes"]

#: The error of a state inside a step, as a fraction of the change of its interpolant by the state in the middle.
STATE_SHARE = 0.25

#: A function that is smaller than this fraction of its change at the start of a step is zero there: a mode begins on its
#: margin, or a run has just passed its event.
AT_ZERO = 1e-9

#: A step in which a function falls ends past the zero on a chord by this share of the rest of the part. To end with the part
#: would cut a millionth of the step again and again, if the part that follows is that short.
PAST = 0.125

#: The shortest parts that are bounded, as a fraction of the step: at its start, which may be on a zero, and elsewhere.
SHORTEST_FIRST, SHORTEST = 2.0**-12, 2.0**-30

#: Number of intervals between looks at a function without bounds, and of the intervals on either side whose mismatch counts.
INTERVALS, NEIGHBOURS = 32, 7

#: The error of a cubic between neighbouring looks, as a fraction of the mismatch of the cubic twice as long, which is 16
#: times as large where the function is smooth; and the mismatch up to which the first intervals are resolved, as a fraction
#: of the function, in a step that begins on a zero.
SHARE, RESOLVED = 0.25, 0.1


class Path(NamedTuple):
    """The motion inside a step as a polynomial of the place, from 0 to 1.

    - `time`, `length`: when the step begins, and how long it is [s].
    - `start`, `slope`, `square`, `cube`, `bulge`: state + place (slope + place (square + place cube)) + hump bulge, where
      the hump is 16 place^2 (1 - place)^2; the bulge is what the state in the middle adds to the cubic through the ends.
    """

    time: Lanes
    length: Lanes
    start: States
    slope: States
    square: States
    cube: States
    bulge: States

    @classmethod
    def of(cls, time: Lanes, length: Lanes, start: End, middle: States, end: End) -> "Path":
        """The motion with given states and rates at the ends, and a state in the middle."""
        (state, rate), (end_state, end_rate) = start, end
        step, slope, end_slope = end_state - state, length * rate, length * end_rate
        square, cube = 3.0 * step - 2.0 * slope - end_slope, slope + end_slope - 2.0 * step
        bulge = middle - 0.5 * (state + end_state) - 0.125 * (slope - end_slope)
        return cls(time, length, state, slope, square, cube, bulge)

    def error(self, place: Lanes) -> Lanes:
        """The error of the state at a place, as a multiple of the bulge."""
        return STATE_SHARE * 16.0 * (place * (1.0 - place)) ** 2

    def derivatives(self, place: Lanes) -> list[States]:
        """The state at a place, and its four derivatives by the place, each divided by the factorial of its order."""
        left, sides = 1.0 - place, 1.0 - 2.0 * place
        state = self.start + place * (self.slope + place * (self.square + place * self.cube))
        slope = self.slope + place * (2.0 * self.square + 3.0 * place * self.cube)
        square = self.square + 3.0 * place * self.cube
        humps = (
            16.0 * (place * left) ** 2,
            32.0 * place * left * sides,
            16.0 * (sides**2 - 2.0 * place * left),
            -32.0 * sides,
            16.0 + 0.0 * place,
        )
        cubics = (state, slope, square, self.cube, 0.0)
        return [cubic + hump * self.bulge for cubic, hump in zip(cubics, humps, strict=True)]


def watched(problem: AbstractProblem, side: Lanes, path: Path, free: Mask, may_cut: Mask) -> tuple[Lanes, Lanes]:
    """Where a step must end so that no zero of a fast function is missed.

    **Arguments:**

    - `problem`: the problem, with functions that are `fast`; `side`: of the event.
    - `path`: the motion inside the step.
    - `free`: the lanes to check; `may_cut`: those whose step may be cut where an error could hide a zero.

    **Returns:** the place at which to end the step instead, as a fraction of the step, 2 where the step may stand as it is;
    and the length of the next step [s] that keeps the functions resolved, infinite where any length does. There is at most
    one zero before the place, or before the end of a step that may stand.
    """
    numbers, static = eqx.partition(problem, eqx.is_array)
    problem = eqx.combine(stop_gradient(numbers), static)
    side, path = stop_gradient((side, path))
    length = path.length
    any_length = jnp.full_like(length, jnp.inf)

    def functions(time: Lanes, state: States) -> Functions:
        margins = problem.margins(time, state) if problem.fast[0] else ()
        event = problem.event_function(state) if problem.fast[1] else None
        values = [*margins, *([] if event is None else [on_side(side, event)])]
        return jnp.stack(values) if values else jnp.zeros((0, *time.shape))

    if not len(jax.eval_shape(functions, path.time, path.start)):
        return jnp.full_like(length, 2.0), any_length
    try:
        return _bounded(functions, path, free, may_cut), any_length
    except UnboundedError:
        place, room = _looked(functions, path, may_cut)
        return jnp.where(free, place, 2.0), length * 0.9 * inverse_root(1.0 / jnp.clip(room, 1.0, 1e5), 4)


def _bounded(functions: Callable[[Lanes, States], Functions], path: Path, free: Mask, may_cut: Mask) -> Lanes:
    """The place as in `watched`, by bounds of the functions and their slopes along parts of the step."""
    time, length, point = path.time, path.length, (path.time, path.start)
    enclosed = enclosing(functions, *point)
    # Where the slope has no bounds, those of the values decide alone.
    sloping = enclosing(lambda *point: jax.jvp(functions, point[:2], point[2:])[1], *point, *point, loose=True)

    def part(carry: tuple[Lanes, Lanes, Lanes]) -> tuple[Lanes, Lanes, Lanes]:
        # All before `begin` is known to be positive.
        begin, width, place = carry
        end = jnp.minimum(begin + width, 1.0)
        middle, half = 0.5 * (begin + end), 0.5 * (end - begin)
        state, slope, square, cube, fourth = path.derivatives(middle)
        error = STATE_SHARE * jnp.abs(path.bulge)
        reach = half * (jnp.abs(slope) + half * (jnp.abs(square) + half * (jnp.abs(cube) + half * jnp.abs(fourth))))
        change = half * (2.0 * jnp.abs(square) + half * (3.0 * jnp.abs(cube) + 4.0 * half * jnp.abs(fourth)))
        # The hump's value and slope are at most 1 and 3.1.
        states = Bounds(state - reach - error, state + reach + error)
        slopes = Bounds(slope - change - 3.1 * error, slope + change + 3.1 * error)
        times = Bounds(time + begin * length, time + end * length)
        (values, leaps), (rises, _) = enclosed(times, states), sloping(times, states, Bounds(length, length), slopes)
        # In all lanes where the axes of the truth values are not those of lanes.
        leaps = [leap if leap.shape == time.shape else jnp.broadcast_to(jnp.any(leap), time.shape) for leap in leaps]
        may_leap = functools.reduce(jnp.logical_or, leaps, jnp.zeros_like(free))
        value, along = jax.linearize(functions, time + middle * length, state)
        doubt = path.error(middle) * jnp.abs(along(jnp.zeros_like(time), path.bulge))
        steepest = jnp.maximum(jnp.abs(rises.low), jnp.abs(rises.high)) * half
        at_end = functions(time + end * length, path.derivatives(end)[0])
        # The error of the state, not the length of the part, makes the bounds wide.
        is_doubtful = jnp.all(reach <= error, axis=0) & jnp.any(error > 0.0, axis=0)
        is_short = end - begin <= jnp.where(begin > 0.0, SHORTEST, SHORTEST_FIRST)
        is_short |= may_leap & is_doubtful & ~may_cut
        # Too short to bound: the function may be zero, which counts as its sign at the end.
        decides = (rises.high < 0.0) & ~may_leap | is_short
        positive = (values.low > 0.0) | ((value - steepest - doubt > 0.0) | (rises.low > 0.0)) & ~may_leap
        positive |= decides & (at_end > 0.0)
        falls = decides & ~(at_end > 0.0)
        clear, decided = jnp.all(positive, axis=0), jnp.all(positive | falls, axis=0)
        hidden = jnp.where(may_leap, is_doubtful, steepest <= doubt)
        hides = jnp.any(~positive & ~falls & hidden, axis=0) & may_cut
        running = begin < 1.0
        is_fall, is_cut = running & decided & ~clear, running & ~decided & hides
        # Past the zero: the middle, or a little more than the zero of the chord from there to the end.
        beyond = jnp.where(value > 0.0, end - (1.0 - PAST) * half * at_end / (at_end - value), middle)
        just_past = jnp.min(jnp.where(positive, jnp.inf, jnp.where(is_short, end, beyond)), axis=0)
        place = jnp.where(is_fall & (end < 1.0), just_past, jnp.where(is_cut, jnp.maximum(begin, 0.25), place))
        begin = jnp.where(is_fall | is_cut, 1.0, jnp.where(running & clear, end, begin))
        return begin, jnp.where(clear, 2.0, 0.5) * width, place

    start = (jnp.where(free, 0.0, 1.0), jnp.ones_like(length), jnp.full_like(length, 2.0))
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0] < 1.0), part, start)[2]


def _looked(functions: Callable[[Lanes, States], Functions], path: Path, may_cut: Mask) -> tuple[Lanes, Lanes]:
    """The place as in `watched`, by looks at the functions; and the least ratio of a value to its error."""
    time, length = path.time, path.length

    def look(place: Float[Array, ""]) -> tuple[Functions, Functions, Functions]:
        # The functions, their slopes along the step, and the errors that the state's error causes.
        state, slope, *_ = path.derivatives(place)
        value, along = jax.linearize(functions, time + place * length, state)
        return value, along(length, slope), path.error(place) * jnp.abs(along(jnp.zeros_like(time), path.bulge))

    places, width = jnp.linspace(0.0, 1.0, 1 + INTERVALS), 1.0 / INTERVALS
    value, slope, error = jax.lax.map(look, places)
    slope = width * slope
    # The cubic through every second look, at the look between.
    guess = 0.5 * (value[:-2] + value[2:]) + 0.25 * (slope[:-2] - slope[2:])
    guessed_slope = 0.75 * (value[2:] - value[:-2]) - 0.25 * (slope[:-2] + slope[2:])
    mismatch = SHARE * (jnp.abs(value[1:-1] - guess) + jnp.abs(slope[1:-1] - guessed_slope))
    size = jnp.maximum(jnp.maximum(jnp.abs(value[:-2]), jnp.abs(value[2:])), jnp.abs(value[1:-1]))
    at_zero = value[0] <= AT_ZERO * jnp.maximum(jnp.abs(slope[0]) * INTERVALS, jnp.abs(value[-1]))
    begins = at_zero & (jnp.arange(INTERVALS) < 2)[:, None, None]
    unresolved = jnp.concatenate([mismatch[:2] > RESOLVED * size[:2], jnp.zeros_like(mismatch[1:], bool)])[:INTERVALS]
    window = jnp.pad(mismatch, ((NEIGHBOURS, NEIGHBOURS + 1), (0, 0), (0, 0)))
    near = [window[k : k + INTERVALS] for k in range(2 * NEIGHBOURS + 1)]
    total = jnp.max(jnp.stack(near), axis=0) + jnp.maximum(error[1:], error[:-1])
    inner, least = cubic_minimum(value[:-1], slope[:-1], value[1:], slope[1:])
    least = jnp.where(inner <= 1.0, least, jnp.minimum(value[:-1], value[1:]))
    falls = (value[1:] <= 0.0) | (least < -total) & (least < -AT_ZERO * jnp.maximum(value[1:], value[:-1]))
    hides = jnp.where(begins, unresolved, least < total) & ~falls & may_cut
    begin, end = places[:-1, None, None], places[1:, None, None]
    zero = begin + width * value[:-1] / (value[:-1] - value[1:])
    just_past = jnp.where(value[:-1] > 0.0, zero + PAST * (end - zero), end)
    at_fall = jnp.where(value[1:] <= 0.0, jnp.where(end < 1.0, just_past, 2.0), begin + inner * width)
    place = jnp.where(falls, at_fall, jnp.where(hides, jnp.maximum(begin, 0.25), jnp.inf))
    place, problems = jnp.min(place, axis=1), jnp.any(falls | hides, axis=1)
    first = jnp.argmax(problems, axis=0)
    place = jnp.where(jnp.any(problems, axis=0), jnp.take_along_axis(place, first[None], axis=0)[0], 2.0)
    room = jnp.where(begins | falls | hides, jnp.inf, least / jnp.maximum(total, 1e-300))
    return place, jnp.min(room, axis=(0, 1))
