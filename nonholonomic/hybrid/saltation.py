"""First derivatives of hybrid runs: the variations of the state pass through every change of mode.

At an event, a run has the variations dx of the state and dt of the time. With the event g(x) = 0,
x' = f(x) and the mode entered at t + dt,

    dT = -dg / (Dg f),   dx <- dx + f dT,   dt <- dt + dT,

by the implicit function theorem; then the mode's own `reset_map` is differentiated, an impact or a flight, which may
itself take time. These are the two halves of the saltation matrix (Leine and Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems, 2004, ch. 7). The next mode counts its time from its own beginning, so it does not need
the term -f dt of this matrix; the term is added where a time is held fixed.

The rate of the event function at an event is the denominator of the derivative. Where this rate may be zero within the
tolerance (`GRAZING`), the event is grazing and the derivative has no correct digits; a counter counts such events.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..derivatives.variation import VariationalProblem, delay, in_groups, tangents_of, where_active
from ..integration import AbstractPassive, AbstractProblem, ExtendedProblem, Lanes, Settings, States
from ..integration.problem import CROSSED, REACHED_END
from ..integration.scheduler import Numbers
from .ensemble import AbstractBatchedMode, HybridOutcome, Modes, Transition, solve_hybrid

#: An event is grazing if a relative change of the numbers by the tolerance, or an error of the state that the tolerance
#: allows, changes its rate by more than this fraction. The relative error of the derivative is then about as large.
GRAZING = 1e-2

#: If an event is nearer than this fraction of the time in its mode, the run has ended at this event.
NEARLY = 1e-6

#: Magnitude that scales the error of the clock [s]: the clock has no error, and no share in step-size control.
UNMEASURED = 1e9


#: Pairs of the tangents of the modes and the tangent of the states, with `None` for leaves that do not move.
Tangents = tuple[tuple[tuple[PyTree, ...], PyTree], ...]


class Clock(AbstractPassive):
    """The time since a mode began, as a passive component. The variation of this component is the variation of the time
    at which the mode began."""

    def rates(self, problem: AbstractProblem, time: Lanes, state: States, passive: Array) -> Array:
        return jnp.concatenate([problem.field(time, state), jnp.ones_like(passive)])


def with_row(state: States, row: Lanes) -> Float[Array, "components+1 *lanes"]:
    """A state with one more component."""
    return jnp.concatenate([state, row[None]])


class VariationalMode(AbstractBatchedMode):
    """A mode whose state is followed by its first variations, and by the variation of the time at which the mode began.

    The mode's equations must not depend on time.

    - `tangents`: tangents of the mode, as for `VariationalProblem`.
    - `ends_on_event`: as for `VariationalProblem`; `tolerance`: relative tolerance of the integration.
    """

    mode: AbstractBatchedMode
    tangents: tuple[PyTree, ...]
    tolerance: Float[Array, ""]
    ends_on_event: bool = eqx.field(static=True)

    @property
    def rare(self) -> bool:
        return self.mode.rare

    def problem(self, state: States) -> VariationalProblem:
        primal, *variations = self.parts(state)
        numbers, build = self.active_numbers()

        def clocked(state: States, *numbers: Array) -> ExtendedProblem:
            start_time = state[-1:]
            return ExtendedProblem(
                build(*numbers).problem(state[:-1]), Clock(), start_time, jnp.full_like(start_time, UNMEASURED)
            )

        point = (with_row(primal[:-1], jnp.zeros_like(primal[-1])), *numbers)
        tangents = tangents_of(clocked, point, self.directions(variations))
        return VariationalProblem(clocked(*point), tangents, self.ends_on_event)

    def reset_map(self, state: States, left: Lanes) -> Transition:
        """The reset map of the mode itself, with variations. The last row of the counters counts grazing events."""
        return self.reset_with_path(state, left, lambda mode, state, left: (mode.reset_map(state, left), ()))[0]

    def reset_with_path(
        self, state: States, left: Lanes, reset_with_path: Callable[..., tuple[Transition, PyTree]]
    ) -> tuple[Transition, PyTree, PyTree]:
        """The transition, and numbers that describe its path.

        **Arguments:** `reset_with_path`: function of the mode, the state and `left` that returns the mode's `Transition`
        and a tree of numbers.

        **Returns:** the `Transition`; the numbers; and their variations, with the tangents first.
        """
        primal, *variations = self.parts(state)
        primal, duration, count = primal[:-1], primal[-1], len(variations)
        if not variations:
            # Nothing is differentiated, so no event is grazing.
            transition, path = reset_with_path(self.mode, primal, left)
            no_grazes, clock = jnp.zeros_like(transition.counts[:1]), jnp.zeros_like(duration)
            state, counts = with_row(transition.state, clock), jnp.concatenate([transition.counts, no_grazes])
            transition = transition._replace(state=state, counts=counts, record=None, log_rates=None)
            return transition, path, jax.tree.map(lambda value: jnp.zeros((0, *value.shape)), path)
        numbers, build = self.active_numbers()
        zero, rates = jnp.zeros_like(duration), self.mode.problem(primal).field(duration, primal)

        def reset(primal: States, start_time: Lanes, *numbers: Array) -> tuple[PyTree, Transition]:
            mode = build(*numbers)
            problem = mode.problem(primal)
            state, later = moved_with_event(problem, primal, duration)
            start_time = start_time + later
            rate = jax.jvp(
                functools.partial(problem.margin_or_one, duration), (state,), (problem.field(duration, state),)
            )[1]
            # A mode that ended when it began has not reached its event.
            log_rate = jnp.log(jnp.abs(jnp.where((duration > 0.0) & (rate != 0.0), rate, 1.0)))
            transition, path = reset_with_path(mode, state, left - start_time)
            log_rate = log_rate if transition.log_rates is None else log_rate + transition.log_rates
            changing = (transition.state, start_time + transition.elapsed, log_rate, path)
            return changing, transition._replace(record=None, log_rates=None)

        directions = self.directions([part[:-1] for part in variations], [part[-1] for part in variations])
        # The last tangent is an error of the state.
        directions.append((self._error(primal, duration, rates), zero, *map(jnp.zeros_like, numbers)))
        values, changes, transition = along(reset, (primal, zero, *numbers), directions, has_aux=True)
        states, start_times, log_rates, changes_of_path = changes
        new_variations = jnp.concatenate([states, start_times[:, None]], axis=1)[:count]
        log_rates = jnp.max(jnp.abs(log_rates), axis=0)
        finite = jnp.isfinite(new_variations).all(axis=(0, 1)) & jnp.isfinite(log_rates)
        grazes = ~finite | (self.tolerance * log_rates > GRAZING)
        # The run itself is valid, so variations without correct digits must not end the run.
        new_variations = jnp.where(finite, new_variations, 0.0)
        extended_state = jnp.concatenate([transition.state, zero[None], *new_variations])
        counts = jnp.concatenate([transition.counts, grazes.astype(int)[None]])
        transition = transition._replace(state=extended_state, counts=counts)
        return transition, values[-1], jax.tree.map(lambda change: change[:count], changes_of_path)

    def output_rows(
        self, state: Float[Array, "components times"]
    ) -> tuple[Float[Array, "shown times"], Float[Array, "tangents shown times"]]:
        """The output rows of a single run's states, and their variation at fixed times."""
        primal, *variations = self.parts(state)
        primal, duration = primal[:-1], primal[-1]
        numbers, build = self.active_numbers()

        def output(primal: Float[Array, "components times"], *numbers: Array) -> Float[Array, "shown times"]:
            return build(*numbers).shown(primal)

        if not variations:
            return output(primal), jnp.zeros((0, *output(primal).shape))
        rates = self.mode.problem(primal).field(duration, primal)
        # If the mode begins later, the state has advanced less at the same time.
        directions = self.directions([variation[:-1] - rates * variation[-1] for variation in variations])
        return along(output, (primal, *numbers), directions)

    def slopes(self, state: States, end_time: Lanes) -> Float[Array, "tangents cells"]:
        """The derivative of the time of the event at which runs have ended in this mode at a time [s], or in the transition to
        it."""
        primal, *variations = self.parts(state)
        numbers, build = self.active_numbers()

        def time(primal: States, start_time: Lanes, *numbers: Array) -> Lanes:
            problem = build(*numbers).problem(primal)
            if problem.event_function(primal) is None:
                return start_time
            # The event was located to a small fraction of a step, and the variations also change over the remaining
            # time.
            rates = problem.field(start_time, primal)
            to_event = stop_gradient(_remainder(problem.event_function, primal, rates))
            point = primal + jnp.where(jnp.abs(to_event) < NEARLY * duration, to_event, 0.0) * rates
            at_event = start_time + delay(problem.event_function, point, problem.field(start_time, point))
            if self.ends_on_event:
                return at_event
            # A reset that jumps over the zero of the event is the event: that at the end of this mode, or the one before it.
            margin, near = functools.partial(problem.margin_or_one, duration), NEARLY * end_time
            to_end, at_end = stop_gradient(_remainder(margin, primal, rates)), start_time + delay(margin, primal, rates)
            of_reset, far = jnp.where(jnp.abs(to_end) <= near, at_end, start_time), jnp.abs(to_event) > near
            return jnp.where(far & (jnp.minimum(jnp.abs(to_end), duration) <= near), of_reset, at_event)

        duration, point = primal[-1], (primal[:-1], jnp.zeros_like(primal[-1]), *numbers)
        directions = self.directions([part[:-1] for part in variations], [part[-1] for part in variations])
        return along(time, point, directions)[1]

    def parts(self, state: States) -> list[Float[Array, "inner *lanes"]]:
        """The state with its clock, and the variations of both."""
        return jnp.split(state, 1 + len(self.tangents))

    def _error(self, primal: States, duration: Lanes, rates: States) -> States:
        """The error of the state at the end of the mode, divided by the tolerance, from the change of the state and
        from the magnitudes.
        """
        sizes = jnp.minimum(self.mode.problem(primal).start()[1], jnp.abs(rates) * duration)
        # Shares of both signs that are unlikely to cancel.
        shares = [(-1.0) ** k * (0.5 + math.modf(0.618 * k)[0]) for k in range(len(sizes))]
        return jnp.asarray(shares)[:, None] * sizes

    def active_numbers(self) -> tuple[list[Array], Callable[..., AbstractBatchedMode]]:
        """The mode's active numbers, and the mode as a function of them."""
        if not self.tangents:
            return [], lambda: self.mode
        numbers, structure = jax.tree.flatten(where_active(self.mode, self.tangents[0]))
        return numbers, lambda *numbers: eqx.combine(jax.tree.unflatten(structure, numbers), self.mode)

    def directions(self, *moves: list[Array]) -> list[tuple[Array, ...]]:
        """For each tangent the rates at which some arrays move, followed by those of the active numbers."""
        return [(*arrays, *jax.tree.leaves(tangent)) for *arrays, tangent in zip(*moves, self.tangents, strict=True)]


def _remainder(function: Callable[[States], Lanes | None], state: States, rates: States) -> Lanes:
    """The time after which a function of the state vanishes, to first order; infinite where it rests."""
    value, rate = jax.jvp(function, (state,), (rates,))
    return jnp.where(rate == 0.0, jnp.inf, -value / jnp.where(rate == 0.0, 1.0, rate))


def moved_with_event(problem: AbstractProblem, state: States, duration: Lanes) -> tuple[States, Lanes]:
    """The state at the end of a mode, and zero, with the variations of the state and of the time at which the margin
    vanishes: the first half of the saltation matrix."""
    rates = stop_gradient(problem.field(duration, state))
    later = delay(functools.partial(problem.margin_or_one, duration), state, rates)
    later = jnp.where(duration > 0.0, later, 0.0)
    return state + rates * later, later


def along(
    function: Callable[..., PyTree], point: tuple[Array, ...], tangents: list[tuple[Array, ...]], has_aux: bool = False
) -> PyTree:
    """A function's value, its variations along tangents with these on the first axis, and its auxiliary output if any."""

    def moved(tangent: tuple[Array, ...]) -> PyTree:
        return jax.jvp(function, point, tangent, has_aux=has_aux)

    # The function itself is computed once, whatever the number of tangents.
    stacked = jax.tree.map(lambda *rates: jnp.stack(rates), *tangents)
    return jax.vmap(moved, out_axes=(None, 0, None) if has_aux else (None, 0))(stacked)


def with_variations(
    modes: Modes, state: States, tangents: Tangents, tolerance: Float[Array, ""], ends_on_event: bool
) -> tuple[tuple[VariationalMode, ...], Float[Array, "variational *lanes"]]:
    """The modes with their variations, and the initial states with their clocks, followed by the variations of both.

    **Arguments:** as for `solve_hybrid_with_tangents`.
    """
    zero = jnp.zeros_like(state[0])
    variations = [jnp.zeros_like(state) if direction[1] is None else direction[1] for direction in tangents]
    variational = tuple(
        VariationalMode(mode, tuple(direction[0][k] for direction in tangents), tolerance, ends_on_event)
        for k, mode in enumerate(modes)
    )
    return variational, jnp.concatenate([with_row(part, zero) for part in (state, *variations)])


# Ensembles of hybrid runs with the derivatives of the times of their events.


class Slopes(NamedTuple, Generic[Numbers]):
    """Derivatives of the times of the events at which runs ended, (tangents, cells); and a mask of those that are NaN
    because an earlier event was `grazing`, so that the derivative would have no correct digits.
    """

    slopes: Float[Numbers, "tangents cells"]
    grazing: Bool[Numbers, " cells"]


def solve_hybrid_with_tangents(
    modes: Modes,
    tangents: Tangents,
    mode: Int[Numbers, " cells"],
    state: Float[Numbers, "components cells"],
    t1: float | Float[Numbers, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    ends_on_event: bool = True,
    traced: bool = False,
    solve: Callable[..., HybridOutcome] | None = None,
) -> tuple[HybridOutcome[Numbers], Slopes[Numbers]]:
    """Run every cell through its modes to its event, and differentiate the event's time along tangents.

    **Arguments:** as for `solve_hybrid`, and

    - `tangents`: pairs of the tangents of the modes and the tangent of the states, with `None` for leaves that do not
      move.
    - `ends_on_event`: whether runs end on the event; otherwise they end at `t1`, which then counts as the event's time.
    - `traced`: whether numbers may be traced; then arguments and results are JAX's arrays.
    - `solve`: runs the cells with one tangent at a time, by default `solve_hybrid` with all of them.

    **Returns:** the `HybridOutcome`, and the `Slopes`, 0 where there is no event or the event is at the start.
    Source: implicit function theorem at the event, saltation at every change of mode.

    **Example:** the derivative with respect to the restitution.

    >>> from nonholonomic.hybrid import solve_hybrid_with_tangents
    >>> tangents = (((Bounce(jnp.ones(2)),), None),)
    >>> _, sensitivities = solve_hybrid_with_tangents(modes, tangents, first, start, 5.0, 2, settings, counters=1)
    >>> print(sensitivities.slopes.round(6))  # the time of the fall
    [[0.451524 0.451524]]
    """
    xp: Any = jnp if traced else np
    size, slopes_of = len(state), VariationalMode.slopes if traced else _slopes

    def run(group: Tangents) -> tuple[PyTree, list[Float[Numbers, " cells"]]]:
        variational, start = with_variations(modes, jnp.asarray(state), group, settings.tolerance, ends_on_event)
        arguments = (variational, mode, xp.asarray(start), t1, cells, settings)
        options: dict[str, Any] = {"counters": counters + 1, "n_blocks": 1 + len(group)}
        ended = solve_hybrid(*arguments, **options, traced=traced) if solve is None else solve(*arguments, **options)
        # A run that has ended between two modes is in neither. Its event is the end of the previous mode, whose variation is
        # the last row.
        slopes = xp.reshape(ended.state, (1 + len(group), -1, len(ended.mode)))[1:, -1]
        for number, of_mode in enumerate(variational):
            slopes = xp.where(
                ended.mode == number,
                xp.asarray(slopes_of(of_mode, jnp.asarray(ended.state), jnp.asarray(ended.end_time))),
                slopes,
            )
        event_time = ended.crossing_time if ends_on_event else xp.broadcast_to(t1, ended.mode.shape)
        # An event at the start has a fixed time, whatever the tangent.
        has_event = xp.isfinite(event_time) & (event_time > 0.0)
        # With its variations a run takes other steps: where it does not reach the event, it has no derivative.
        arrived = ended.status == (CROSSED if ends_on_event else REACHED_END)
        grazing = has_event & ((ended.counts[-1] > 0) | ~arrived)
        slopes = xp.where(has_event, xp.where(grazing, xp.nan, slopes), 0.0)
        return (ended._replace(state=ended.state[:size], counts=ended.counts[:-1]), grazing), list(slopes)

    if solve is not None:
        parts = [run((tangent,)) for tangent in tangents]
        (outcome, _), slopes = parts[0][0], [slope for _, (slope,) in parts]
        grazing = np.any([grazing for (_, grazing), _ in parts], axis=0)
    else:
        (outcome, grazing), slopes = in_groups(run, tangents) if traced else run(tangents)
    return outcome, Slopes(xp.stack(slopes), grazing)


_slopes = eqx.filter_jit(VariationalMode.slopes)
