"""Integrate with any solver of Diffrax to the end of the model's validity: one trajectory with dense output or at given
times, and, as a reference, an ensemble."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float, PyTree

from ..compilation.cache import padded
from ..compilation.components import over_cells
from ..geometry import inverse
from ..text import one_line
from ..validation import as_known, require
from .events import Path, watched
from .problem import CROSSED, FAILED, LEFT_DOMAIN, MOST_STEPS, REACHED_END, AbstractProblem, Settings
from .runge_kutta import Lanes
from .scheduler import NO_EXTREMES, Outcome

# Find many zeros of functions of one variable at once. (Events within a step are located in `events.py`.)

Brackets = Float[np.ndarray, " zeros"]

#: A time or a length of time [s]; and other numbers, one or several.
Time = Float[Array, ""]
Number = Float[Array, "..."]

#: Halvings that reduce any bracket to round-off.
HALVINGS = 60

#: `few_trials` stops once a bracket, or the change from one trial to the next, is shorter than this fraction of the value.
LOCATED = 1e-14

#: After this number of trials, `few_trials` returns the last trial.
MOST_TRIALS = 60

#: Number of parts into which `all_crossings` divides a step, to check the sign at their ends, if there may be a crossing.
PARTS_OF_STEP = 8

#: Number of rounds in which checks are added where the quantity is nearest to zero, to detect two crossings close
#: together.
CLOSER_LOOKS = 3

#: Checks closer together than this [s] give no new information.
CLOSEST = 1e-14


def halved(holds: Callable[[Number], Bool[Array, "..."]], low: Number, high: Number) -> tuple[Number, Number]:
    """Find where a condition ceases to hold, by halving brackets; also inside transformations.

    **Arguments:**

    - `holds`: the condition, true at `low` and false at `high`.
    - `low`, `high`: the brackets, of any shape.

    **Returns:** the last value at which the condition holds, and the next value, at which it does not.

    **Example:**

    >>> from nonholonomic.integration.dense import halved
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

    >>> from nonholonomic.integration.dense import sign_changes
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
    function: Callable[[Brackets], Brackets], low: Brackets, high: Brackets, at_low: Brackets, at_high: Brackets
) -> Brackets:
    """Zeros of a function that is expensive to evaluate, one in each bracket (Anderson and Bjorck, BIT 13 (1973) 253).

    **Arguments:**

    - `function`: function of NumPy arrays, element by element; JAX does not trace it.
    - `low`, `high`: the brackets; `at_low`, `at_high`: the function there, of opposite signs.

    **Example:**

    >>> import numpy as np
    >>> from nonholonomic.integration.dense import few_trials
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
    quantity: Callable[[Brackets], Brackets], time: Float[np.ndarray, " steps"], value: Float[np.ndarray, " steps"]
) -> Float[np.ndarray, " crossings"]:
    """The times at which a quantity of a run passes zero, in either direction, in increasing order, with pairs of crossings
    inside a step.

    **Arguments:** `quantity`: function of times [s] in NumPy, not traced by JAX; NaN counts as beyond zero; `time`, `value`:
    the ends of the steps [s], and the quantity there.

    **Example:** the tip of a parabola between two steps is below zero.

    >>> import numpy as np
    >>> from nonholonomic.integration.dense import all_crossings
    >>> steps = np.arange(4.0)
    >>> dip = lambda time: (time - 1.51) ** 2 - 1e-4
    >>> all_crossings(dip, steps, dip(steps)).round(6)
    array([1.5 , 1.52])
    """
    with np.errstate(invalid="ignore"):
        change = np.abs(np.diff(value))
        max_change = np.max([change, np.append(change[1:], 0.0), np.insert(change[:-1], 0, 0.0)], axis=0)
        is_small = np.minimum(np.abs(value[:-1]), np.abs(value[1:])) < max_change
    # The steps in which the quantity changes its sign, or changes by more than its size, there or in a neighbour.
    indices = np.flatnonzero(is_small | ((value[:-1] > 0.0) != (value[1:] > 0.0)))
    if indices.size == 0:
        return np.zeros(0)

    def signed(times: Brackets) -> Brackets:
        values = quantity(times)
        return np.where(np.isfinite(values), values, -np.inf)

    parts = np.arange(1, PARTS_OF_STEP) / PARTS_OF_STEP
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


#: Steps that are integrated and stored at once; a longer run consists of several such segments.
PIECE = 2048

#: The same for a run of several modes, each of which may last only a few steps: memory is allocated, and the domain
#: margin checked, for all steps of a segment. With 2048 a short flight of a top takes 37 ms and 5 MB, with 128 it takes
#: 7 ms and 0.4 MB.
PIECE_OF_MODE = 128

#: Length [s] of the first step that is tried, and shortened where it is too long; Diffrax 0.7 begins with the same.
FIRST_STEP = 0.01

#: Number of parts of every step at whose ends the domain margin is checked.
PARTS = 8


class DenseSolution(NamedTuple):
    """A run: its times and states, the segments of its dense output, how it ended and how many steps it took.

    **Example:** as for `follow`.

    >>> from nonholonomic.integration import follow
    >>> path = follow(Decays(jnp.asarray(2.0)), 1.0, settings)
    >>> path.left_domain, path.failed, path.accepted == len(path.times) - 1
    (False, False, True)
    """

    times: Float[np.ndarray, " times"]
    states: Float[np.ndarray, "components times"]
    segments: list[diffrax.Solution]
    left_domain: bool
    failed: bool
    accepted: int
    rejected: int

    @property
    def status(self) -> int:
        """How the run ended, as a code of the integration."""
        return FAILED if self.failed else LEFT_DOMAIN if self.left_domain else REACHED_END

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "components times"]:
        """States at the given times, by the dense output; times must lie within the run."""
        states = np.repeat(self.states[:, :1], len(times), axis=1)
        for segment in self.segments:
            mask = (times > float(segment.t0)) & (times <= float(segment.t1))
            if mask.any():
                states[:, mask] = np.asarray(_evaluate(segment, padded(times[mask], len(times)))).T[:, : mask.sum()]
        return states


@eqx.filter_jit
def _evaluate(
    segment: diffrax.Solution, times: Float[Array | np.ndarray, " times"]
) -> Float[Array, "times components"]:
    return jax.vmap(segment.evaluate)(times)


def saved(solution: diffrax.Solution) -> tuple[PyTree, PyTree]:
    """Times and states of a solution, which Diffrax's types declare as optional."""
    return solution.ts, solution.ys


#: The start, the end and the length of the first step [s]; a state, and the magnitudes that scale its errors.
Span = tuple[Array, Array, Array | None]
Start = tuple[Float[Array, " components"], Float[Array, " components"]]


@eqx.filter_jit
def _start(problem: AbstractProblem, time: Time) -> tuple[Start, Time | None]:
    """State, scales and domain margin at the start: one program, where JAX would compile each of their operations."""
    state, scales = problem.start()
    return (jnp.asarray(state), jnp.asarray(scales)), problem.margin_at_start(time, state)


def _control(
    problem: AbstractProblem, settings: Settings, start: Start, times: Float[Array, " times"] | None = None
) -> diffrax.AbstractStepSizeController:
    """Step-size control whose steps end on given times and on both sides of each jump."""
    state, scales = start
    # The largest error counts, not the mean: passive cyclic coordinates must not dilute the errors of the others.
    atol = settings.absolute * settings.tolerance * jax.lax.stop_gradient(scales)
    controller = diffrax.PIDController(settings.tolerance, atol, norm=optimistix.max_norm)
    jumps = problem.jumps(jnp.zeros_like(state[0]), state)
    ends = [] if times is None else [times]
    ends += [] if jumps is None else [jumps.ahead, jumps.past]
    if not ends:
        return controller
    ends = jnp.concatenate(ends)
    return diffrax.ClipStepSizeController(controller, step_ts=jnp.where(jnp.isnan(ends), jnp.inf, ends))


def _solved(
    problem: AbstractProblem,
    solver: diffrax.AbstractSolver,
    times: Span,
    state: Float[Array, " components"],
    control: diffrax.AbstractStepSizeController,
    **options: PyTree,
) -> diffrax.Solution:
    """Integrate a problem by Diffrax.

    **Arguments:** `times`: start, end and length of the first step [s]; `options`: of `diffrax.diffeqsolve`.
    """
    # Traced once, where Diffrax would trace the field several times.
    begin = jnp.asarray(times[0], state.dtype)
    field = eqx.filter_closure_convert(lambda time, state, _: problem.field(time, state), begin, state, problem)
    options = {"args": problem, "stepsize_controller": control, "throw": False, **options}
    return diffrax.diffeqsolve(diffrax.ODETerm(field), solver, *times, state, **options)


@eqx.filter_jit
def _piece(
    problem: AbstractProblem, times: Span, start: Start, settings: Settings, dense: bool, is_watched: bool
) -> tuple[diffrax.Solution, Float[Array, "steps 2"] | None]:
    """Integrate as many steps as the settings allow; also bracket the first zero of the domain margin in each step.

    **Arguments:** `times`: as for `_solved`.
    """
    (begin, *_), (state, _) = times, start
    margin = eqx.filter_closure_convert(problem.margin_or_one, begin, state) if is_watched else None
    solver = settings.for_single_runs if dense or is_watched else settings.for_steps_alone
    event = None if margin is None else diffrax.Event(lambda t, y, args, **_: margin(t, y) < 0.0)
    options = {"saveat": diffrax.SaveAt(t0=True, steps=True, dense=dense or is_watched), "event": event}
    control = _control(problem, settings, start)
    solution = _solved(problem, solver, times, state, control, max_steps=settings.max_steps, **options)
    return solution, _first_losses(problem, solution, begin) if is_watched else None


def _first_losses(problem: AbstractProblem, solution: diffrax.Solution, t0: Time) -> Float[Array, "steps 2"]:
    """Brackets [s] of the first zero of the domain margin in every step, infinite where there is none."""
    ends, _ = saved(solution)
    lengths = jnp.where(jnp.isfinite(ends[1:]), ends[1:] - ends[:-1], 0.0)
    starts = jnp.where(jnp.isfinite(ends[:-1]), ends[:-1], t0)
    lasts = jnp.repeat(jnp.where(jnp.isfinite(ends[1:]), ends[1:], starts), PARTS)
    # The parts of all steps are the lanes of one problem.
    length = jnp.repeat(lengths / PARTS, PARTS)
    time = jnp.repeat(starts, PARTS) + length * jnp.tile(jnp.arange(PARTS), len(starts))

    def states(place: float) -> Float[Array, "components parts"]:
        # Beyond the last step, by round-off, there is nothing.
        return jax.vmap(solution.evaluate)(jnp.minimum(time + place * length, lasts)).T

    end = states(1.0)
    margins = jax.vmap(problem.margin_or_one, (0, 1))(time + length, end)
    place = jnp.where((margins < 0.0) & (length > 0.0), 1.0, jnp.inf)
    if problem.fast[0]:
        start, side = states(0.0), jnp.ones_like(time)
        rate, end_rate = problem.field(time, start), problem.field(time + length, end)
        path = Path.of(time, length, (start, rate), states(0.5), (end, end_rate))
        inside, _ = watched(problem, side, path, length > 0.0, length < 0.0)
        place = jnp.minimum(place, jnp.where(inside < 1.0, inside, jnp.inf))
    brackets = jnp.stack([jnp.where(place < jnp.inf, time, jnp.inf), time + place * length], axis=1)
    first = jnp.argmin(brackets[:, 1].reshape(-1, PARTS), axis=1)
    return brackets.reshape(-1, PARTS, 2)[jnp.arange(len(starts)), first]


def follow(
    problem: AbstractProblem, t1: float, settings: Settings, *, dense: bool = True, piece: int = PIECE
) -> DenseSolution:
    """Integrate one run step by step until `t1` or until the model ceases to hold.

    **Arguments:**

    - `problem`: a problem with a `start()` of shape (components,).
    - `t1`: horizon [s].
    - `settings`: their solver can be any solver of Diffrax. A run that needs more than `max_steps` steps, including
      rejected ones, fails.
    - `dense`: whether to keep dense output for states within the steps (`DenseSolution.at`).
    - `piece`: number of steps that are integrated at once.

    **Returns:** a `DenseSolution` with the accepted steps; it ends where the domain margin reaches zero, located on the
    dense output.

    **Example:**

    >>> import numpy as np
    >>> from nonholonomic.integration import follow
    >>> path = follow(Decays(jnp.asarray(2.0)), 1.0, settings)
    >>> print(path.at(np.array([0.5, 1.0])).round(6))  # exp(-1), exp(-2)
    [[0.367879 0.135335]]
    """
    time, end, length = jnp.asarray(0.0, float), jnp.asarray(t1, float), jnp.asarray(FIRST_STEP, float)
    (state, scales), margin = _start(problem, time)
    is_watched = margin is not None
    times, states, segments = [np.zeros(1)], [np.asarray(state)[:, None]], []
    accepted, rejected, failed = 0, 0, False
    lost = margin is not None and float(margin) <= 0.0
    # The program is compiled for this number of steps, so it must not change with the number that is left.
    piece_settings = dataclasses.replace(settings, max_steps=min(piece, settings.max_steps))
    while float(time) < t1 and not (lost or failed):
        start = state, scales
        solution, brackets = _piece(problem, (time, end, length), start, piece_settings, dense, is_watched)
        steps = int(solution.stats["num_accepted_steps"])
        accepted, rejected = accepted + steps, rejected + int(solution.stats["num_rejected_steps"])
        ts, ys = saved(solution)
        # Cut as NumPy arrays: a slice by JAX would be compiled for every number of steps.
        ts, ys = np.asarray(ts)[1 : steps + 1], np.asarray(ys)[1 : steps + 1].T
        finite = np.isfinite(ts) & np.all(np.isfinite(ys), axis=0)
        brackets = np.full((steps, 2), np.inf) if brackets is None else np.asarray(brackets)[:steps]
        outside = np.flatnonzero(brackets[:, 1] < np.inf)
        if outside.size:
            lost, steps = True, int(outside[0]) + 1
            ts, ys, finite = ts[:steps].copy(), ys[:, :steps].copy(), finite[:steps]
            ts[-1] = float(_loss(problem, solution, *map(jnp.asarray, brackets[outside[0]])))
            ys[:, -1] = np.asarray(_evaluate(solution, ts[-1:]))[0]
        # Round-off differs between programs: a loss that only Diffrax has seen is at the end of its last step.
        lost = lost or bool(solution.result == diffrax.RESULTS.event_occurred)
        valid_steps = int(finite.sum()) if finite.all() else int(np.argmin(finite))
        times.append(ts[:valid_steps])
        states.append(ys[:, :valid_steps])
        segments.append(solution)
        if valid_steps:
            length = jnp.asarray(ts[-1] - (ts[-2] if valid_steps > 1 else float(time)))
            time, state = jnp.asarray(ts[valid_steps - 1]), jnp.asarray(ys[:, valid_steps - 1])
        is_stuck = steps == 0 or bool(solution.result == diffrax.RESULTS.dt_min_reached)
        is_stuck = is_stuck or (float(time) < t1 and accepted + rejected >= settings.max_steps)
        failed = not finite.all() or (is_stuck and not lost)
    return DenseSolution(
        np.concatenate(times), np.concatenate(states, axis=1), segments, lost, failed, accepted, rejected
    )


@eqx.filter_jit
def _loss(problem: AbstractProblem, solution: diffrax.Solution, begin: Time, end: Time) -> Time:
    """The last time in a bracket before the domain margin becomes negative, on the dense output."""
    return halved(lambda time: ~(problem.margin_or_one(time, solution.evaluate(time)) < 0.0), begin, end)[0]


class _GivenSteps(diffrax.StepTo):
    """Steps that end at given, increasing times, without the checks of Diffrax, which call back into Python: such
    programs are not cached on disk.
    """

    def wrap(self, direction):
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        return self.ts[1], 2


@eqx.filter_custom_jvp
def _with_fixed_jumps(state: Float[Array, " components"], times: Float[Array, " jumps"]) -> Float[Array, " components"]:
    """The state, whose derivative is NaN if the times of jumps vary: Diffrax's steps do not move with them."""
    return state


@_with_fixed_jumps.def_jvp
def _nan_if_moved(primals, tangents):
    (state, _), (rates, time_rates) = primals, tangents
    rates = jnp.zeros_like(state) if rates is None else rates
    return state, rates if time_rates is None else rates + jnp.nan * jnp.sum(time_rates)


def sample(
    problem: AbstractProblem,
    times: Float[Array, " times"] | None,
    t1: Time,
    settings: Settings,
    *,
    grid: Float[Array, " steps"] | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    ends_on_event: bool = False,
    start: Start | None = None,
) -> tuple[Outcome, Float[Array, "components times"]]:
    """Integrate one run inside a transformation (`jit`, `vmap`, `grad`) and return its states at the given times.

    The domain margin is checked at the ends of steps, and the run ends where the margin is zero on the dense output.
    Steps end on the requested times, because interpolation would lose a digit or two.

    **Arguments:** as for `follow`; `times`: increasing, in [0, t1], or `None` for the times of the grid; `grid`: the
    ends of the steps [s], from 0 to t1, for a solver without an error estimate; `adjoint`: how Diffrax differentiates,
    by default in forward mode; `ends_on_event`: whether the run also ends on the event of the problem; `start`: the initial
    state and its magnitudes, by default those of the problem.

    **Returns:** the `Outcome`, and the states at the times, NaN after the end of the run.

    **Example:**

    >>> from nonholonomic.integration import sample
    >>> print(sample(Decays(jnp.asarray(2.0)), jnp.array([0.5, 1.0]), jnp.asarray(1.0), settings)[1].round(6))
    [[0.367879 0.135335]]
    """
    state, scales = problem.start() if start is None else start
    if (jumps := problem.jumps(jnp.zeros_like(t1), state)) is not None:
        state = _with_fixed_jumps(state, jumps.times)
    conditions: dict[int, tuple[Callable[..., Lanes], Lanes]] = {}
    if ends_on_event and (value := problem.event_function(state)) is not None:
        conditions[CROSSED] = (lambda t, y, args, **_: args.event_function(y)), value
    if (margin := problem.margin_at_start(jnp.zeros_like(t1), state)) is not None:
        conditions[LEFT_DOMAIN] = (lambda t, y, args, **_: args.domain_margin(t, y)), margin
    # Diffrax detects only changes of a condition's sign, so a run that starts with a negative one must end at once.
    at_once = [value <= 0.0 for _, value in conditions.values()]
    horizon, t1 = t1, jnp.where(functools.reduce(jnp.logical_or, at_once, jnp.asarray(False)), 0.0, t1)
    event = diffrax.Event([condition for condition, _ in conditions.values()], optimistix.Newton(1e-13, 1e-13))
    if times is None:
        assert grid is not None
        times, save_at, max_points = grid, diffrax.SubSaveAt(t0=True, steps=True), grid.size - 1
    else:
        save_at, max_points = diffrax.SubSaveAt(ts=jnp.minimum(times, t1)), settings.max_steps
    start = state, scales
    control = _control(problem, settings, start, jnp.minimum(times, t1)) if grid is None else _GivenSteps(grid)
    solver = settings.for_single_runs if conditions else settings.for_steps_alone
    options = {"max_steps": max_points, "event": event if conditions else None}
    options |= {"saveat": diffrax.SaveAt(subs=[save_at, diffrax.SubSaveAt(t1=True)])}
    options |= {"adjoint": diffrax.ForwardMode() if adjoint is None else adjoint}
    solution = _solved(problem, solver, (jnp.zeros_like(t1), t1, None), state, control, **options)
    (_, ends), (states, ends_at) = saved(solution)
    end = ends[0]
    # NaN rather than infinite: an angle computed from infinite components would look like an angle.
    states = jnp.where(times <= end, states.T, jnp.nan)
    status = jnp.where(end < horizon, FAILED, REACHED_END)
    for code, occurred, at_start in zip(conditions, solution.event_mask or [], at_once, strict=True):
        status = jnp.where(occurred | at_start, code, status)
    time = jnp.where(status == CROSSED, end, jnp.inf)
    accepted, rejected = solution.stats["num_accepted_steps"], solution.stats["num_rejected_steps"]
    return Outcome(status, time, time, end, ends_at[0], accepted + rejected, rejected, jnp.asarray(NO_EXTREMES)), states


# The outcome of every cell by vmapped `diffrax.diffeqsolve`: slow, and independent of the ensemble solver.


@eqx.filter_jit
def solve_by_diffrax(problem: AbstractProblem, t1: Time, settings: Settings) -> Outcome:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`.

    The domain margin is checked at the ends of steps, so a short loss can be missed; events are located on Diffrax's
    dense output.

    **Arguments:** as for `solve_ensemble`, but any solver of Diffrax works.

    **Returns:** the `Outcome`.

    **Example:**

    >>> from nonholonomic.integration import solve_by_diffrax
    >>> print(solve_by_diffrax(problem, jnp.asarray(5.0), settings).crossing_time.round(6))
    [0.693147 0.346574 0.173287]
    """
    settings = dataclasses.replace(settings, max_steps=min(settings.max_steps, MOST_STEPS))

    def solve_cell(problem: AbstractProblem, state: Array, scales: Array) -> Outcome:
        return sample(problem, t1[None], t1, settings, ends_on_event=True, start=(state, scales))[0]

    return over_cells(solve_cell, problem)(*problem.start())


# The implicit midpoint rule, whose energy balance closes to round-off on the P-form.

#: Number of simplified Newton iterations; each reduces the error by a factor of the order of (step times rate of
#: change)^2.
ITERATIONS = 8


class ImplicitMidpoint(diffrax.AbstractSolver):
    """The implicit midpoint rule y1 = y0 + h f((y0 + y1) / 2), second order, with a fixed step.

    It conserves every linear and quadratic invariant, and on the P-form the balance of energy and work, up to rounding
    errors (`stroller.md`, section 5).

    **Arguments:**

    - `step_length`: longest step [s], positive. The steps between two output times are equal, and steps end on the
      output times.

    **Raises:** `ValueError` if the step is not positive.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, solver=stroller.ImplicitMidpoint(0.02), times=[0.5, 1.0])
    >>> bool(abs(run.energy_residual[-1]) < 1e-12)
    True

    ```
    """

    step_length: Time = eqx.field(converter=as_known)

    units: ClassVar[dict[str, str]] = {"step_length": "s"}
    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation

    def __repr__(self) -> str:
        return one_line(self)

    def __check_init__(self):
        require(self.step_length, "step_length", above=0.0)

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        control = terms.contr(t0, t1)
        middle = t0 + 0.5 * (t1 - t0)

        def increment(z: Float[Array, " state"]) -> Float[Array, " state"]:
            return terms.vf_prod(middle, y0 + 0.5 * z, args, control)

        guess = increment(jnp.zeros_like(y0))
        newton = inverse(jnp.eye(y0.size, dtype=y0.dtype) - jax.jacfwd(increment)(guess))

        def improve(z, _):
            correction = newton @ (increment(z) - z)
            return z + correction, jnp.max(jnp.abs(correction) / (jnp.abs(y0) + jnp.abs(z) + 1.0))

        z, corrections = jax.lax.scan(improve, guess, length=ITERATIONS)
        converged = corrections[-1] < 1e3 * jnp.finfo(y0.dtype).eps
        results: Any = diffrax.RESULTS
        result = results.where(converged, results.successful, results.nonlinear_divergence)
        y1 = y0 + z
        return y1, None, dict(y0=y0, y1=y1), None, result

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)
