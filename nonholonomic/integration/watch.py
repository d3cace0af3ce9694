"""Functions that may change faster than the state: where a step must end so that none of their zeros is missed.

A step is as long as the motion of the state allows. A user's margin or event function may change faster: waves that a body
flies over, an explicit time, a product of distances, a narrow dip. The motion inside a step is a polynomial, whose error
is known. Interval arithmetic bounds the function and its slope along parts of it (`bounds.py`), which are halved until each
part is known to have no zero, or one. A function for which there are no bounds, such as one with a loop, is looked at in
many places; between them it is a cubic whose error is estimated, and the step is cut where this error could hide a zero.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from .bounds import Bounds, UnboundedError, enclosing
from .double_roots import cubic_minimum
from .problem import AbstractProblem
from .runge_kutta import Lanes, States, inverse_root

Functions = Float[Array, "functions lanes"]

#: The error of a state inside a step, as a fraction of the change of its interpolant by the state in the middle.
STATE_SHARE = 0.25

#: A function that is smaller than this fraction of its change at the start of a step is zero there: a mode begins on its
#: margin, or a run has just passed its event.
AT_ZERO = 1e-9

#: The shortest parts that are bounded, as a fraction of the step: where the step begins on a zero, and elsewhere.
SHORTEST_FIRST, SHORTEST = 2.0**-12, 2.0**-30

#: Number of intervals between looks at a function without bounds, and of the intervals on either side whose mismatch counts.
INTERVALS, NEIGHBOURS = 32, 7

#: The error of a cubic between neighbouring looks, as a fraction of the mismatch of the cubic twice as long, which is 16
#: times as large where the function is smooth; and the mismatch up to which the first intervals are resolved, as a fraction
#: of the function, in a step that begins on a zero.
SHARE, RESOLVED = 0.25, 0.1


class Path(NamedTuple):
    """The motion inside a step as a polynomial of the place, from 0 to 1.

    - `start`, `slope`, `square`, `cube`, `bulge`: state + place (slope + place (square + place cube)) + hump bulge, where
      the hump is 16 place^2 (1 - place)^2; the bulge is what the state in the middle adds to the cubic through the ends.
    """

    start: States
    slope: States
    square: States
    cube: States
    bulge: States

    @classmethod
    def of(cls, start: tuple[States, States], middle: States, end: tuple[States, States], length: Lanes) -> "Path":
        """The motion with given states and rates at the ends, and a state in the middle."""
        (state, rate), (end_state, end_rate) = start, end
        step, slope, end_slope = end_state - state, length * rate, length * end_rate
        square, cube = 3.0 * step - 2.0 * slope - end_slope, slope + end_slope - 2.0 * step
        return cls(state, slope, square, cube, middle - 0.5 * (state + end_state) - 0.125 * (slope - end_slope))

    def error(self, place: Any) -> Lanes:
        """How many times the bulge the error of the state at a place is."""
        return STATE_SHARE * 16.0 * (place * (1.0 - place)) ** 2

    def derivatives(self, place: Any) -> list[States]:
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


def watched(
    problem: AbstractProblem,
    side: Lanes,
    path: Path,
    time: Lanes,
    length: Lanes,
    free: Bool[Array, " lanes"],
    may_cut: Bool[Array, " lanes"],
) -> tuple[Lanes, Lanes]:
    """Where a step must end so that no zero of a fast function is missed.

    **Arguments:**

    - `problem`: the problem, with functions that are `fast`; `side`: of the event.
    - `path`: the motion inside the step, which begins at `time` [s] and has a `length` [s].
    - `free`: the lanes to check; `may_cut`: those whose step may be cut where an error could hide a zero.

    **Returns:** the place at which to end the step instead, as a fraction of the step, 2 where the step may stand as it is;
    and the length of the next step [s] that keeps the functions resolved, infinite where any length does. There is at most
    one zero before the place, or before the end of a step that may stand.
    """
    numbers, static = eqx.partition(problem, eqx.is_array)
    problem = eqx.combine(stop_gradient(numbers), static)
    side, path, time, length = stop_gradient((side, path, time, length))
    any_length = jnp.full_like(length, jnp.inf)

    def functions(time: Lanes, state: States) -> Functions:
        margins = problem.margins(time, state) if problem.fast[0] else ()
        event = problem.event_function(state) if problem.fast[1] else None
        values = [*margins, *([] if event is None else [side * event])]
        return jnp.stack(values) if values else jnp.zeros((0, *time.shape))

    if not len(jax.eval_shape(functions, time, path.start)):
        return jnp.full_like(length, 2.0), any_length
    try:
        return _bounded(functions, path, time, length, free, may_cut), any_length
    except UnboundedError:
        place, room = _looked(functions, path, time, length, may_cut)
        return jnp.where(free, place, 2.0), length * 0.9 * inverse_root(1.0 / jnp.clip(room, 1.0, 1e5), 4)


def _bounded(
    functions: Callable[[Lanes, States], Functions],
    path: Path,
    time: Lanes,
    length: Lanes,
    free: Bool[Array, " lanes"],
    may_cut: Bool[Array, " lanes"],
) -> Lanes:
    """The place as in `watched`, by bounds of the functions and their slopes along parts of the step."""
    point = (time, path.start)
    enclosed = enclosing(lambda *point: jax.jvp(functions, point[:2], point[2:]), *point, *point)

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
        values, rises = enclosed(times, states, Bounds(length, length), slopes)
        value, along = jax.linearize(functions, time + middle * length, state)
        doubt = path.error(middle) * jnp.abs(along(jnp.zeros_like(time), path.bulge))
        steepest = jnp.maximum(jnp.abs(rises.low), jnp.abs(rises.high)) * half
        at_end = functions(time + end * length, path.derivatives(end)[0])
        is_short = end - begin <= jnp.where(begin > 0.0, SHORTEST, SHORTEST_FIRST)
        # Too short to bound: the function may be zero, which counts as its sign at the end.
        positive = (values.low > 0.0) | (value - steepest - doubt > 0.0) | (rises.low > 0.0)
        positive |= ((rises.high < 0.0) | is_short) & (at_end > 0.0)
        falls = ((rises.high < 0.0) | is_short) & ~(at_end > 0.0)
        clear, decided = jnp.all(positive, axis=0), jnp.all(positive | falls, axis=0)
        # The state's error, not the length of the part, may hide a zero.
        hides = jnp.any(~positive & ~falls & (steepest <= doubt), axis=0) & may_cut
        running = begin < 1.0
        is_fall, is_cut = running & decided & ~clear, running & ~decided & hides
        place = jnp.where(is_fall & (end < 1.0), end, jnp.where(is_cut, jnp.maximum(begin, 0.25), place))
        begin = jnp.where(is_fall | is_cut, 1.0, jnp.where(running & clear, end, begin))
        return begin, jnp.where(clear, 2.0, 0.5) * width, place

    start = (jnp.where(free, 0.0, 1.0), jnp.ones_like(length), jnp.full_like(length, 2.0))
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0] < 1.0), part, start)[2]


class Look(NamedTuple):
    """The functions at a place of the step: value, slope along the step, and the error that the state's error causes."""

    value: Functions
    slope: Functions
    error: Functions


def _looked(
    functions: Callable[[Lanes, States], Functions],
    path: Path,
    time: Lanes,
    length: Lanes,
    may_cut: Bool[Array, " lanes"],
) -> tuple[Lanes, Lanes]:
    """The place as in `watched`, by looks at the functions; and the least ratio of a value to its error."""

    def look(place: Any) -> Look:
        state, slope, *_ = path.derivatives(place)
        value, along = jax.linearize(functions, time + place * length, state)
        return Look(value, along(length, slope), path.error(place) * jnp.abs(along(jnp.zeros_like(time), path.bulge)))

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
    at_fall = jnp.where(value[1:] <= 0.0, jnp.where(end < 1.0, end, 2.0), begin + inner * width)
    place = jnp.where(falls, at_fall, jnp.where(hides, jnp.maximum(begin, 0.25), jnp.inf))
    place, problems = jnp.min(place, axis=1), jnp.any(falls | hides, axis=1)
    first = jnp.argmax(problems, axis=0)
    place = jnp.where(jnp.any(problems, axis=0), jnp.take_along_axis(place, first[None], axis=0)[0], 2.0)
    room = jnp.where(begins | falls | hides, jnp.inf, least / jnp.maximum(total, 1e-300))
    return place, jnp.min(room, axis=(0, 1))
