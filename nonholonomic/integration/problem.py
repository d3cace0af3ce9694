"""An initial value problem with an event and a domain: its interface, its settings, and how a run ends.

The codes of an end are `RUNNING`, `REACHED_END` (at the horizon), `CROSSED` (on the event), `LEFT_DOMAIN`, `FAILED` and
`UNRESOLVED`. `DEFAULT_MAX_STEPS` limits the steps of a run, `MOST_STEPS` those of a short run, and `TIGHTEST` is the smallest
relative tolerance.
"""

import abc
import enum
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar, Generic, NamedTuple, Self, TypeVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..compilation.xla_cpu import current_platform, traced_once
from ..parameters import numbers
from ..text import shown
from ..validation import (
    Bound,
    as_number,
    is_traced,
    legal,
    require_all,
    require_increasing,
    require_kind,
    require_scalars,
    warn,
)
from .runge_kutta import AbstractTunedPair, Components, Lanes, Mask, Oscillatory8, States, lesser

# Times at which a field jumps or has a kink: a step ends just before such a time, and the next begins just after it.
#
# No stage of a step is ever evaluated at the time itself, so it does not matter on which side a comparison such as `t > 1`
# is false there. The gap between the two sides is a few units of round-off wide, and the state moves across it along the
# field of either side. If the time of the jump moves, so does the state after it: by the difference of the fields.

#: Distance of a step's end from a jump, relative to the time of the jump: more than the round-off of a sum of stages.
#: Jumps that are at most `CLUSTER` distances apart count as one.
GAP, CLUSTER = 64.0, 4.0

#: The least such distance [s], of a jump at time 0.
LEAST = 1e-30


class Jumps(NamedTuple):
    """Times [s] at which a field may jump, and distances [s] from them at which steps end, (jumps, *cells).

    **Example:** the field of a problem that jumps at 0.5 s, for all of its three cells.

    >>> from nonholonomic.integration import Jumps
    >>> class Halved(Decays):
    ...     def field(self, time, state):
    ...         return super().field(time, state) * jnp.where(time < 0.5, 1.0, 0.5)
    ...     def jumps(self, time, state):
    ...         return Jumps.at(jnp.full((1, *self.rate.shape), 0.5))
    >>> halved, _ = solve_ensemble(Halved(problem.rate), jnp.asarray(1.0), jnp.asarray(3), settings)
    >>> print(halved.crossing_time.round(6))  # (ln(2) / rate - 0.5) / 0.5 + 0.5, and before the jump ln(2) / rate
    [0.886294 0.346574 0.173287]
    """

    times: Float[Array, "jumps *cells"]
    gaps: Float[Array, "jumps *cells"]

    @classmethod
    def at(cls, times: Float[Array, "jumps *cells"], clock: Lanes | float = 0.0) -> "Jumps":
        """The jumps at these times, of which those that are not finite never come.

        **Arguments:** `clock`: the reading of the clock of `times` where the run begins.
        """
        is_finite = jnp.isfinite(times)
        size = jnp.where(is_finite, jnp.abs(stop_gradient(times)) * (GAP * jnp.finfo(times.dtype).eps), 0.0)
        return cls(jnp.where(is_finite, times - clock, jnp.inf), jnp.maximum(size, LEAST))

    @property
    def ahead(self) -> Float[Array, "jumps *cells"]:
        """The near sides of the jumps."""
        return stop_gradient(self.times) - self.gaps

    @property
    def past(self) -> Float[Array, "jumps *cells"]:
        """The far sides of the jumps."""
        return stop_gradient(self.times) + self.gaps

    def next(self, time: Lanes) -> Lanes:
        """The near side of the next jump after a time; infinite if there is none."""
        return jnp.min(jnp.where(self.ahead > time, self.ahead, jnp.inf), axis=0)

    def begin(self, time: Lanes) -> Lanes:
        """The time itself, or the far side of a jump that is there."""
        is_there = jnp.abs(stop_gradient(self.times) - time) <= 2.0 * self.gaps
        return jnp.maximum(time, jnp.max(jnp.where(is_there, self.past, -jnp.inf), axis=0))

    def before(self, time: Lanes) -> Lanes:
        """The near side of the jump whose far side is this time; NaN if there is none."""
        least, most = time - (CLUSTER + 2.5) * self.gaps, time - 1.5 * self.gaps
        near = jnp.min(jnp.where((self.ahead > least) & (self.ahead < most), self.ahead, jnp.inf), axis=0)
        return jnp.where(jnp.isfinite(near), near, jnp.nan)

    def sides(self, time: Lanes) -> tuple[Mask, Lanes, Lanes]:
        """The jump whose near side is this time: a mask of the lanes that have one, its time, which is differentiable, and its
        far side; both are the time itself where there is none."""
        distance = self.ahead - time
        is_near = jnp.abs(distance) <= 0.25 * self.gaps
        is_jump = jnp.any(is_near, axis=0)
        jump = jnp.sum(jnp.where(is_near, self.times, 0.0), axis=0) / jnp.maximum(jnp.sum(is_near, axis=0), 1)
        past = jnp.max(jnp.where(jnp.abs(distance) <= CLUSTER * self.gaps, self.past, -jnp.inf), axis=0)
        return is_jump, jnp.where(is_jump, jump, time), jnp.where(is_jump, past, time)


# The interface of an initial value problem with an event and a domain.


class AbstractProblem(eqx.Module):
    """An initial value problem: a field, an event function, and a domain margin that ends the run where it vanishes.

    The leaves of a problem are scalars, or hold one number per cell in their last axis. Its functions receive one
    number per lane, or scalars for a single run.

    **Example:** the problem of the subpackage's example, at its start.

    >>> start, scales = problem.start()
    >>> print(problem.event_function(start), problem.field(0.0, start)[0])
    [0.5 0.5 0.5] [-1. -2. -4.]
    """

    #: Number of leading components (the core state) that evolve independently of the rest; the event function and the
    #: domain margin depend only on these. `None` if all components are coupled.
    leading: ClassVar[int | None] = None

    #: Whether a run may start at a zero of the event function or of the domain margin, so that the direction of motion
    #: decides on which side the run is. If true, a run that starts beyond the event continues until the event function
    #: next falls through zero; otherwise the run ends at once.
    direction_decides: ClassVar[bool] = False

    #: Whether XLA can compile a loop over the field into a single kernel on a CPU (`xla_cpu.in_one_kernel`).
    fits_one_kernel: ClassVar[bool] = True

    #: Whether the margins, and whether the event function, may change faster than the state, as a user's functions may:
    #: steps then resolve them where they are near zero (`events.py`).
    fast: ClassVar[tuple[bool, bool]] = False, False

    @abc.abstractmethod
    def start(self) -> tuple[States, States]:
        """The initial state of every cell, and the magnitudes that scale its absolute errors."""

    @abc.abstractmethod
    def field(self, time: Lanes, state: Components) -> States:
        """Rate of change of the state, lane by lane; the state may come as a tuple of its components."""

    def event_function(self, state: States) -> Lanes | None:
        """A smooth function of order 1, positive before the event, negative after it; `None`, the default, if there is no
        event."""
        return None

    def crossing_along(self, state: States, rate: States) -> Lanes | None:
        """The event function of a state whose rate is known: equal to `event_function`, for problems where the rate
        saves work.
        """
        return self.event_function(state)

    @abc.abstractmethod
    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        """A function of order 1 that is positive while the model holds; `None` if the model always holds."""

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        """A mask of the lanes whose model ceases to hold at the start, though their domain margin is positive by an
        allowance for round-off; `None` if the margin alone decides.
        """
        return None

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        """The domain margin without allowances. Runs that leave the domain go back to its zero; `None`, the default, if they
        end where the zero of the domain margin was located, up to a fraction of a step.
        """
        return None

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        """The smooth functions of which `domain_margin` is the least; a step searches each of them for a missed double root."""
        domain_margin = self.domain_margin(time, state)
        return () if domain_margin is None else (domain_margin,)

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        """The times at which the field or a margin may jump, for a run that is in this state now; `None` if there are none.
        Steps end on them."""
        return None

    def across_jump(self, time: Lanes, state: States) -> States:
        """The state just after the jump whose near side is this time; unchanged in lanes that have none.

        The state follows the field before the jump up to the jump, and then the field after it, each by a midpoint step.
        Therefore the result has first and second derivatives with respect to the time of the jump.
        """
        jumps = self.jumps(time, state)
        if jumps is None:
            return state
        near = stop_gradient(time)
        _, jump, far = jumps.sides(near)
        first, second, none = jump - near, far - jump, jnp.zeros_like(near)
        # After the jump, every time is that of a point beyond it, because the state may contain a clock.
        times = jnp.stack([near, near + 0.5 * first, far, far - 0.5 * second])
        moves, looks = jnp.stack([none, none, first, none]), jnp.stack([none, 0.5 * first, second, 0.5 * second])

        def stage(carry: tuple[States, States], row: tuple[Lanes, Lanes, Lanes]) -> tuple[tuple[States, States], None]:
            (base, rate), (stage_time, move, look) = carry, row
            base = base + move * rate
            return (base, self.field(stage_time, base + look * rate)), None

        # A loop, so that the field is compiled once.
        (base, rate), _ = jax.lax.scan(stage, (state, jnp.zeros_like(state)), (times, moves, looks))
        return base + second * rate

    def margin_or_one(self, time: Lanes, state: States) -> Lanes:
        """The domain margin; 1 if the model always holds."""
        return lesser(self.domain_margin(time, state), None, time)

    def margin_at_start(self, time: Lanes, state: States) -> Lanes | None:
        """The domain margin at the start, at most 0 where the model ceases to hold at once."""
        margin, lost = self.domain_margin(time, state), self.lost_at_start(state)
        return margin if margin is None or lost is None else jnp.where(lost, jnp.minimum(margin, 0.0), margin)

    def crossing_on(self, side: Lanes, state: States, rate: States) -> Lanes | None:
        """`crossing_along` with the sign that makes it positive on the lane's side of the event, 1 or -1."""
        value = self.crossing_along(state, rate)
        return None if value is None else on_side(side, value)

    def least_margin(self, side: Lanes, time: Lanes, state: States, rate: States) -> Lanes:
        """The lesser of the domain margin and the event function on the lane's side of the event."""
        return lesser(self.domain_margin(time, state), self.crossing_on(side, state, rate), side)


def on_side(side: Lanes, value: Lanes) -> Lanes:
    """An event function with the sign that makes it positive on a side of the event, 1 or -1. Zero itself is beyond the event:
    a function that stays zero does not fall through it again and again."""
    return side * value - 1e-300 * jnp.minimum(side, 0.0)


class AbstractDerivedProblem(AbstractProblem):
    """A problem with other components than another one, often with more behind those, which decides where its runs end and
    jump."""

    #: Whether runs end on the event of the other problem.
    ends_on_event = True

    problem: eqx.AbstractVar[AbstractProblem]

    def inner(self, state: States) -> Float[Array, "inner *lanes"]:
        """The state of the other problem, which is the leading part by default."""
        return state[: len(self.problem.start()[0])]

    def clock(self, time: Lanes) -> Lanes:
        """The time of the other problem."""
        return time

    @property
    def direction_decides(self) -> bool:
        return self.problem.direction_decides

    @property
    def fits_one_kernel(self) -> bool:
        return self.problem.fits_one_kernel

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.problem.fast

    def event_function(self, state: States) -> Lanes | None:
        return self.problem.event_function(self.inner(state)) if self.ends_on_event else None

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.problem.domain_margin(self.clock(time), self.inner(state))

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        return self.problem.lost_at_start(self.inner(state))

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.problem.exact_margin(self.clock(time), self.inner(state))

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.problem.margins(self.clock(time), self.inner(state))

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.problem.jumps(self.clock(time), self.inner(state))


class CoreProblem(AbstractDerivedProblem):
    """The core state of a problem: the leading components, on which the others do not act.

    **Arguments:**

    - `problem`: the problem.
    - `size`: number of leading components.

    **Example:**

    >>> from nonholonomic.integration import CoreProblem
    >>> CoreProblem(problem, size=1).start()[0].shape
    (1, 3)
    """

    problem: AbstractProblem
    size: int = eqx.field(static=True)

    def start(self) -> tuple[States, States]:
        state, scales = self.problem.start()
        return state[: self.size], scales[: self.size]

    def field(self, time: Lanes, state: Components) -> States:
        # The compiler drops the omitted components and everything that only they depend on.
        return self.problem.field(time, self.inner(state))[: self.size]

    def inner(self, state: Components) -> Float[Array, "inner *lanes"]:
        state = jnp.stack(state) if isinstance(state, tuple) else state
        missing = len(self.problem.start()[0]) - self.size
        return jnp.concatenate([state, jnp.zeros((missing, *state.shape[1:]))])


def crossing_time(problem: AbstractProblem, time: Lanes, state: States) -> Lanes:
    """Time [s] at which the event function vanishes, for a state close to the event.

    The time is differentiable with respect to the numbers of the problem and the state (implicit function theorem).

    **Arguments:**

    - `problem`: a problem with an event.
    - `time`, `state`: time and state close to the event, (cells,) and (components, cells).

    **Returns:** the times, (cells,), to third order in the distance.

    **Example:** a state that is 1e-4 s before the event.

    >>> from nonholonomic.integration import crossing_time
    >>> print(f"{crossing_time(Decays(jnp.asarray(2.0)), 0.3465, jnp.exp(jnp.array([-0.693]))):.8f}")
    0.34657359
    """
    return event_time(problem, problem.event_function, time, state)


#: A located event this near to a zero, as a fraction of the time so far, is on it.
NEAR = 1e-9


def event_time(problem: AbstractProblem, function: Callable[[States], PyTree], time: Lanes, state: States) -> Lanes:
    """Time at which a function of the state vanishes along a motion, for a state close to the zero, to third order in
    the distance.

    This gives the time of a located event its derivatives: `time` is held fixed, the state varies with the parameters,
    and the series t - g/g' - g'' g^2 / (2 g'^3) turns its variation into that of the time (implicit function theorem).
    """

    field = traced_once(lambda point: problem.field(time, point), state)
    rate = field(state)
    first, second = jax.jvp(lambda point: jax.jvp(function, (point,), (field(point),))[1], (state,), (rate,))
    value, slope = function(state), jnp.where(first == 0.0, 1.0, first)
    shift = value / slope
    # A function that jumps through zero has no zero there, and does not say how the time of its jump varies.
    left = function(state - shift * rate)
    is_zero = (jnp.abs(shift) <= NEAR * time) | ((slope < 0.0) & (jnp.abs(left) <= 0.5 * jnp.abs(value)))
    moved = time - jnp.where(is_zero, shift + 0.5 * second / slope * shift * shift, 0.0)
    moved = moved + _of_slope(value, stop_gradient(jnp.where(is_zero, 0.0, jnp.nan)))
    return time_at_jump(problem, time, state, moved)


@jax.custom_jvp
def _of_slope(value: Lanes, slope: Lanes) -> Lanes:
    """Zero, which varies with a value by the given slope."""
    return jnp.zeros_like(value)


@_of_slope.defjvp
def _slope_of_zero(values: tuple[Lanes, Lanes], rates: tuple[Lanes, Lanes]) -> tuple[Lanes, Lanes]:
    return jnp.zeros_like(values[0]), values[1] * rates[0]


def time_at_jump(problem: AbstractProblem, time: Lanes, state: States, otherwise: Lanes) -> Lanes:
    """The time of the jump whose far side is this time, which is that of an event whose function jumps through zero; elsewhere
    the other time."""
    jumps = problem.jumps(time, state)
    if jumps is None:
        return otherwise
    near = jumps.before(time)
    is_jump, jump, _ = jumps.sides(jnp.where(jnp.isfinite(near), near, time))
    return jnp.where(is_jump, jump, otherwise)


# How a run ended: codes of the integration, and words for users.
#
# The codes are `RUNNING`, `REACHED_END` (at the horizon), `CROSSED` (on the event), `LEFT_DOMAIN`, `FAILED` and
# `UNRESOLVED`. `tippe.Status` has the words.

#: In this order: not ended; ended at the horizon; ended on its event; ended where the model ceases to hold; stopped by
#: step-size control; stopped because the mode changed too often or the forces are not determined.
RUNNING, REACHED_END, CROSSED, LEFT_DOMAIN, FAILED, UNRESOLVED = range(6)

#: Words of earlier versions that may be in files and scripts.
FORMER_WORDS = {"reached t1": "completed", "reached_end": "completed"}


class Status(enum.IntEnum):
    """How a run ended: the words that all functions use, and the integers for transformations.

    Runs and tables contain the word, such as "contact_lost"; runs inside `jit` and `vmap` contain the integer, and so
    do files, whose attribute `flag_meanings` lists the words.

    - `COMPLETED`: the run reached its horizon `t1`. `INVERTED` and `NOT_INVERTED`: whether the top had turned over by then, in
      tables of inversion times, whose runs end at the inversion.
    - `CONTACT_LOST`: the ground would have to pull. `JAMMED`: the equation for the normal force has no solution.
      `DOES_NOT_FIT`: the arena is as strongly curved as the top. `RANK_LOST`: the projected heading of a stroller is
      undetermined.
    - `UNRESOLVED`: the model determines no motion, or the run changed its mode too often. `FAILED`: the integration
      failed. `ILLEGAL`: a number inside a transformation is out of range, and all results are NaN.
    - `EVENT`: the run reached the event of a table, and ended there. `STOPPED`: a mode without a reset ended.
    - `PENDING`: a cell of a table that has not been computed.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Status(1).word, int(tippe.Status.of("contact_lost"))
    ('contact_lost', 1)
    >>> tippe.Status.of("reached t1").word  # the word of an earlier version
    'completed'

    ```
    """

    PENDING = -1
    COMPLETED = 0
    CONTACT_LOST = 1
    FAILED = 2
    JAMMED = 3
    ILLEGAL = 4
    DOES_NOT_FIT = 5
    UNRESOLVED = 6
    INVERTED = 7
    NOT_INVERTED = 8
    RANK_LOST = 9
    REVERSED = 10
    NOT_REVERSED = 11
    EVENT = 12
    STOPPED = 13

    @property
    def word(self) -> str:
        """The word for the status in results and files."""
        return self.name.lower()

    @classmethod
    def of(cls, word: str) -> Self:
        """The status for a word of this version or an earlier version.

        **Raises:** `ValueError` for an unknown word.
        """
        known = {status.word: status for status in cls}
        current = FORMER_WORDS.get(word, word)
        if current not in known:
            raise ValueError(f"word = {word!r} must be one of {', '.join(known)}")
        return known[current]


# Settings of the integration; `DEFAULT_MAX_STEPS` limits the steps of a run, and `MOST_STEPS` those of a short run.

#: The absolute tolerance as a fraction of the relative one, in units of a problem's own magnitudes.
ABSOLUTE = 0.1

#: Default limit of the steps of a run.
DEFAULT_MAX_STEPS = 2_000_000

#: Greatest number of steps of runs that should be short: an impact, parameters tried by a fit, a run of the slow
#: reference. A run that needs more steps fails.
MOST_STEPS = 100_000


#: Least tolerance in single precision: below it, round-off would control the steps, and derivatives are often NaN.
TIGHTEST_IN_SINGLE = 1e-5


def as_tolerance(value: object) -> Float[Array, ""]:
    """Convert a tolerance to a number; in single precision to one of at least `TIGHTEST_IN_SINGLE`, with a warning."""
    tolerance = as_number(value)
    if not isinstance(tolerance, jax.Array) or tolerance.dtype != jnp.float32:
        return tolerance
    is_finer = (tolerance > 0.0) & (tolerance < 0.99 * TIGHTEST_IN_SINGLE)
    if not is_traced(is_finer) and is_finer.any():
        warn(
            f"tolerance = {float(jnp.min(tolerance)):.3g} is finer than single precision resolves, and "
            f"{TIGHTEST_IN_SINGLE:g} takes its place; leave out JAX_ENABLE_X64=0 for double precision"
        )
    return jnp.where(is_finer, TIGHTEST_IN_SINGLE, tolerance)


class Settings(eqx.Module):
    """Settings of the integration, for every kind of result.

    **Arguments:**

    - `tolerance`: relative tolerance; in single precision at least 1e-5.
    - `solver`: a solver of Diffrax, which must be an explicit Runge-Kutta solver for ensembles; `None` for
      `Oscillatory8` in ensembles and `Dopri8` in single runs, which need its dense output.
    - `absolute`: absolute tolerance as a fraction of the relative one, in units of the problem's magnitudes.
    - `max_steps`: a run that needs more steps fails.
    - `lanes`: number of cells that advance together; by default as many as suit the machine (`lanes_for`).
    - `device`: where tables run, "cpu" or "gpu"; by default on a GPU if there is one and they are large.

    **Example:**

    >>> from nonholonomic.integration import Settings
    >>> type(Settings(1e-9).for_lanes).__name__, type(Settings(1e-9).for_single_runs).__name__
    ('Oscillatory8', 'Dopri8')
    """

    tolerance: Float[Array, ""] = eqx.field(converter=as_tolerance)
    solver: diffrax.AbstractSolver | None = None
    absolute: float = eqx.field(static=True, default=ABSOLUTE)
    max_steps: int = eqx.field(static=True, default=DEFAULT_MAX_STEPS)
    lanes: int | None = eqx.field(static=True, default=None)
    device: str | None = eqx.field(static=True, default=None)

    @property
    def for_lanes(self) -> diffrax.AbstractSolver:
        """The solver of ensembles."""
        return Oscillatory8() if self.solver is None else self.solver

    @property
    def for_single_runs(self) -> diffrax.AbstractSolver:
        """The solver for integration by Diffrax that locates events, and interpolates states, within steps.

        **Raises:** `ValueError` for a solver whose dense output is less accurate than its steps.
        """
        if isinstance(self.solver, AbstractTunedPair):
            raise ValueError(
                f"solver = {shown(self.solver)} is for tables and batches, and a single run must have a dense output as "
                "accurate as its steps: leave solver out, or pass diffrax.Dopri8()"
            )
        return self.for_steps_alone

    @property
    def for_steps_alone(self) -> diffrax.AbstractSolver:
        """The solver for integration by Diffrax with steps that end on all requested times."""
        return diffrax.Dopri8() if self.solver is None else self.solver

    def with_tolerance(self, tolerance: Float[Array, ""] | None) -> Self:
        """The same settings with another tolerance, or without a tolerance if the caller stores it."""
        return eqx.tree_at(lambda settings: settings.tolerance, self, tolerance, is_leaf=lambda leaf: leaf is None)


def lanes_for(cells: int) -> int:
    """Number of lanes for a number of cells.

    On a CPU, compilers write 64 lanes out as eight vectors; more lanes become loops, and fewer, or a number that is not a
    power of 2, are partly computed one by one. This matters more than the caches: also with variations, 64 lanes are
    the fastest. An accelerator needs tens of thousands of lanes.
    """
    max_lanes = 64 if current_platform() == "cpu" else 32768
    return min(max_lanes, 1 << (cells - 1).bit_length())


# Checks of the arguments of a run: horizon, tolerance, times of output, solver and adjoint.
#
# The `require_` functions check concrete arguments before anything compiles; `legal_run` checks traced ones. `TIGHTEST` is
# the smallest relative tolerance.

#: The least and the greatest relative tolerance: below this range, round-off would control the steps; above it, the
#: steps are hardly controlled.
TIGHTEST, LOOSEST = 1e-14, 1e-2


def tolerance_bound(tolerance: object) -> Bound:
    """The legal range of the relative tolerance.

    **Example:**

    >>> from nonholonomic.integration.problem import tolerance_bound
    >>> tolerance_bound(1.0).require()
    Traceback (most recent call last):
    ValueError: tolerance = 1.0 must be at most 0.01
    """
    return Bound(tolerance, "tolerance", at_least=TIGHTEST, at_most=LOOSEST)


def run_bounds(t1: object, tolerance: object) -> Iterator[Bound]:
    """The ranges of the horizon [s] and of the tolerance.

    **Example:**

    >>> from nonholonomic.integration.problem import run_bounds
    >>> [bound.name for bound in run_bounds(t1=5.0, tolerance=1e-9)]
    ['t1', 'tolerance']
    """
    if isinstance(t1, list | tuple | np.ndarray) and not is_traced(t1) and np.shape(t1) == (2,) and t1[0] == 0.0:
        end = f"the end of the run [s], which starts at t = 0: did you mean t1={shown(t1[1])}?"
        raise ValueError(f"t1 = {shown(t1)} must be one number, {end}")
    yield Bound(t1, "t1", above=0.0)
    yield tolerance_bound(tolerance)


def legal_run(
    others: Bool[Array, "..."] | bool,
    t1: Float[ArrayLike, "..."],
    tolerance: Float[ArrayLike, "..."],
    times: Float[ArrayLike, " times"] | None = None,
) -> tuple[Bool[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Whether the traced numbers of a run are legal, and its horizon and tolerance. A run with illegal numbers might
    never end, so it gets the horizon 0, and the largest tolerance, which does not affect its batch.

    **Arguments:** `others`: whether all other numbers are legal. This function checks `t1`, `tolerance`, and the output
    `times` (times,), which must increase.

    **Returns:** whether the run is legal, its horizon and its tolerance.

    **Example:**

    >>> from nonholonomic.integration.problem import legal_run
    >>> legal, t1, tolerance = legal_run(True, t1=-1.0, tolerance=1e-9)
    >>> print(legal, t1, tolerance)
    False 0.0 0.01
    """
    is_legal = jnp.asarray(others) & legal(run_bounds(t1, tolerance))
    if times is not None:
        within = jnp.all(legal([Bound(times, "times", at_least=0.0, at_most=t1)]))
        is_legal = jnp.all(is_legal & within) & jnp.all(jnp.diff(times) > 0.0)
    return is_legal, jnp.where(is_legal, t1, 0.0), jnp.where(is_legal, tolerance, LOOSEST)


def require_run(
    scene: object, launch: object, t1: object, tolerance: object, kinds: tuple[type, type], lists: str
) -> None:
    """Raise `ValueError` unless scene and launch are of these kinds and have scalars only, the horizon is positive, and
    the tolerance is legal.

    **Arguments:** `lists`: the functions that accept lists instead of single numbers, for the message. The parameters
    of a function, such as that of a `Graph`, may be lists.

    **Example:**

    >>> from nonholonomic.integration import Settings
    >>> from nonholonomic.integration.problem import require_run
    >>> require_run(Settings(1e-9), Settings(1e-6), -1.0, 1e-9, (Settings, Settings), "jax.vmap takes lists")
    Traceback (most recent call last):
    ValueError: t1 = -1.0 ...
    """
    require_kind(scene, "scene", kinds[0])
    require_kind(launch, "launch", kinds[1], several=lists)
    require_all(run_bounds(t1, tolerance))
    values = numbers("scene", scene, functions=False) | numbers("launch", launch) | {"t1": t1, "tolerance": tolerance}
    require_scalars(values, lists)


def require_times(times: ArrayLike | Sequence[float] | None, t1: object) -> None:
    """Raise `ValueError` unless the times of output are an increasing list within [0, t1].

    **Example:**

    >>> from nonholonomic.integration.problem import require_times
    >>> require_times(jnp.array([1.0, 6.0]), t1=5.0)
    Traceback (most recent call last):
    ValueError: times ...
    """
    if times is not None and not isinstance(times, str) and np.ndim(times) == 0:
        raise ValueError(
            f"times = {shown(times)} must be a list of at least one number; np.linspace makes evenly spaced ones"
        )
    Bound(times, "times", at_least=0.0, at_most=t1, why="the run is from 0 to t1").require()
    require_increasing(times, "times")


def require_adaptive(solver: object, others: str = "") -> None:
    """Raise `ValueError` unless the solver is `None` or a solver of Diffrax that estimates its errors and integrates a
    single field (others add a stiff part or noise). **Arguments:** `others`: further allowed solvers, for the message.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration.problem import require_adaptive
    >>> require_adaptive(diffrax.Tsit5())
    """
    structure = getattr(solver, "term_structure", None)
    adaptive = isinstance(solver, diffrax.AbstractAdaptiveSolver) and isinstance(structure, type)
    if solver is not None and not adaptive:
        raise ValueError(
            f"solver = {shown(solver)} must be an adaptive solver of Diffrax for ordinary differential equations, such as "
            f"Dopri8(){others}"
        )


def require_adjoint(adjoint: object) -> None:
    """Raise `ValueError` unless this is `None` or an adjoint method of Diffrax whose derivatives are those of the run.

    On its way back, `DirectAdjoint` repeats blocks of steps, which at tight tolerances get other lengths by rounding: at 1e-10,
    gradients of rides were wrong by 5e-4. `ImplicitAdjoint` is for steady states.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration.problem import require_adjoint
    >>> require_adjoint(diffrax.RecursiveCheckpointAdjoint())
    """
    if not isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint | diffrax.ForwardMode | None):
        raise ValueError(
            f"adjoint = {shown(adjoint)} must be RecursiveCheckpointAdjoint() or ForwardMode() of Diffrax, or None, which "
            "works forward and backward; gradients by others can be wrong by more than the tolerance"
        )


# Passive components: quantities that are integrated with a problem's state but do not act on it, such as a path, work
# or a clock.

#: The kind of problem whose state is extended.
Core = TypeVar("Core", bound=AbstractProblem)


class AbstractPassive(eqx.Module):
    """Rates of passive components.

    **Example:** as for `ExtendedProblem`.

    >>> from nonholonomic.integration import AbstractPassive
    >>> class Area(AbstractPassive):
    ...     def rates(self, problem, time, state, passive):
    ...         return jnp.concatenate([problem.field(time, state), state])
    >>> print(Area().rates(problem, 0.0, jnp.ones((1, 3)), jnp.zeros((1, 3)))[1])
    [1. 1. 1.]
    """

    @abc.abstractmethod
    def rates(self, problem: AbstractProblem, time: Lanes, state: States, passive: Array) -> Array:
        """Rates of change of the problem's state, followed by those of the passive components. Both are computed
        together because they share work."""


class ExtendedProblem(AbstractDerivedProblem, Generic[Core]):
    """A problem with passive components after its state; event function and domain margin are those of the problem.

    - `passive`: the rates; `values`, `scales`: initial values, and the magnitudes that scale absolute errors.
    - `ends_on_event`: whether the problem's event is kept.

    **Example:** a decay and the area under it.

    >>> from nonholonomic.integration import AbstractPassive, ExtendedProblem
    >>> class Area(AbstractPassive):
    ...     def rates(self, problem, time, state, passive):
    ...         return jnp.concatenate([problem.field(time, state), state])
    >>> extended = ExtendedProblem(problem, Area(), jnp.zeros((1, 3)), jnp.ones((1, 3)))
    >>> print(extended.field(0.0, extended.start()[0]))
    [[-1. -2. -4.]
     [ 1.  1.  1.]]
    """

    problem: Core
    passive: AbstractPassive
    values: Float[Array, "passive *cells"]
    scales: Float[Array, "passive *cells"]
    ends_on_event: bool = eqx.field(static=True, default=True)

    @property
    def leading(self) -> int:
        return len(self.problem.start()[0])

    def start(self) -> tuple[States, States]:
        states, scales = self.problem.start()
        return jnp.concatenate([states, self.values]), jnp.concatenate([scales, self.scales])

    def field(self, time: Lanes, state: States) -> States:
        core = self.inner(state)
        return self.passive.rates(self.problem, time, core, state[len(core) :])
