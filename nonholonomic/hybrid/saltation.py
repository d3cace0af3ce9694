"""First derivatives of hybrid runs: the variations of the state pass through every change of mode.

At an event, a run has the variations dx of the state and dt of the time. With the event g(x) = 0,
x' = f(x) and the mode entered at t + dt,

    dT = -dg / (Dg f),   dx <- dx + f dT,   dt <- dt + dT,

by the implicit function theorem; then the mode's own `reset_map` is differentiated, an impact or a flight, which may
itself take time. These are the two halves of the saltation matrix (Leine and Nijmeijer, Dynamics and Bifurcations of
Non-Smooth Mechanical Systems, 2004, ch. 7). The next mode counts its time from its own beginning, so it does not need
the term -f dt of this matrix; the term is added where a time is held fixed.

The rate of the event function at an event is the denominator of the derivative. Where this rate may be zero within the
tolerance, the event is grazing and the derivative has no correct digits; `GRAZING` counts such events.
"""

import math
from collections.abc import Callable
from typing import Any, Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from ..derivatives import VariationalProblem, in_groups, tangents_of
from ..derivatives.variation import where_active
from ..integration import (
    CROSSED,
    REACHED_END,
    AbstractPassive,
    AbstractProblem,
    ExtendedProblem,
    Lanes,
    Settings,
    States,
)
from ..integration.scheduler import Numbers
from .ensemble import HybridOutcome, solve_hybrid, traced_solve_hybrid
from .mode import AbstractBatchedMode, Transition

#: An event is grazing if a relative change of the numbers by the tolerance, or an error of the state that the tolerance
#: allows, changes its rate by more than this fraction. The relative error of the derivative is then about as large.
GRAZING = 1e-2

#: If an event is nearer than this fraction of the time in its mode, the run has ended at this event.
NEARLY = 1e-6

#: Magnitude that scales the error of the clock [s]: the clock has no error, and no share in step-size control.
UNMEASURED = 1e9


class Clock(AbstractPassive):
    """The time since a mode began, as a passive component. The variation of this component is the variation of the time
    at which the mode began."""

    def rates(self, problem: AbstractProblem, time: Lanes, state: States, passive: States) -> States:
        return jnp.concatenate([problem.field(time, state), jnp.ones_like(passive)])


def with_row(state: Float[Array, "components cells"], row: Float[Array, " cells"]) -> Float[Array, "more cells"]:
    """A state with one more component."""
    return jnp.concatenate([state, row[None]])


class VariationalMode(AbstractBatchedMode):
    """A mode whose state is followed by its first variations, and by the variation of the time at which the mode began.

    The mode's equations must not depend on time.

    - `tangents`: tangents of the mode, as for `VariationalProblem`.
    - `ends_on_event`: as for `VariationalProblem`; `tolerance`: relative tolerance of the integration.
    """

    mode: AbstractBatchedMode
    tangents: tuple[Any, ...]
    tolerance: Float[Array, ""]
    ends_on_event: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> VariationalProblem:
        at, *variations = self.parts(state)
        numbers, build = self._active_numbers()

        def clocked(state: Float[Array, "components cells"], *numbers: Array) -> ExtendedProblem:
            began = state[-1:]
            return ExtendedProblem(
                build(*numbers).problem(state[:-1]), Clock(), began, jnp.full_like(began, UNMEASURED)
            )

        point = (with_row(at[:-1], jnp.zeros_like(at[-1])), *numbers)
        tangents = [(variation, *rates) for variation, rates in zip(variations, self._rates(), strict=True)]
        return VariationalProblem(clocked(*point), tangents_of(clocked, point, tangents), self.ends_on_event)

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """The reset map of the mode itself, with variations. The last row of the counters counts grazing events."""
        return self.reset_with_path(state, left, lambda mode, record, left: ())[0]

    def reset_with_path(
        self, state: Float[Array, "components cells"], left: Float[Array, " cells"], read_path: Callable[..., Any]
    ) -> tuple[Transition, Any, Any]:
        """The transition by the mode's `reset_map`, and numbers computed from its path.

        **Arguments:** `read_path`: function of the mode, the `TransitionPath` and `left` that returns a tree of numbers.

        **Returns:** the `Transition`; the numbers; and their variations, with the tangents first.
        """
        at, *variations = self.parts(state)
        at, duration, count = at[:-1], at[-1], len(variations)
        numbers, build = self._active_numbers()
        unmoved = [jnp.zeros_like(number) for number in numbers]
        rates = self.mode.problem(at).field(duration, at)

        def margin_and_rate(at: Float[Array, "components cells"], *numbers: Array) -> tuple[Array, Array]:
            problem = build(*numbers).problem(at)
            return jax.jvp(lambda at: problem.domain_margin(duration, at), (at,), (problem.field(duration, at),))

        # The last two tangents are an error of the state, and a tangent along time.
        along = [(variation[:-1], *moved) for variation, moved in zip(variations, self._rates(), strict=True)]
        along += [(self._error(at, duration, rates), *unmoved), (rates, *unmoved)]
        (_, rate), (domain_margins, changes) = _along(margin_and_rate, (at, *numbers), along)
        # A mode that ended when it began has not reached its event.
        happened = (duration > 0.0) & (rate != 0.0)
        safe = jnp.where(happened, rate, 1.0)
        later = jnp.where(happened, -domain_margins[:-1] / safe, 0.0)
        log_rates = jnp.where(happened, (changes[:-1] + changes[-1] * later) / safe, 0.0)

        def reset(at: Float[Array, "components cells"], left: Float[Array, " cells"], *numbers: Array) -> Any:
            mode = build(*numbers)
            transition = mode.reset_map(at, left)
            inside = jnp.zeros_like(left) if transition.log_rates is None else transition.log_rates
            path = read_path(mode, transition.record, left)
            return (transition.state, transition.elapsed, inside, path), transition._replace(
                record=None, log_rates=None
            )

        begins = (
            jnp.concatenate([*[variation[None, -1] for variation in variations], jnp.zeros_like(duration)[None]])
            + later
        )
        after_event = [
            (moved[0] + shift * rates, -begin, *moved[1:])
            for moved, shift, begin in zip(along[:-1], later, begins, strict=True)
        ]
        values, moved, transition = _along(reset, (at, left, *numbers), after_event, has_aux=True)
        states, elapsed, inside, changes = moved
        new_variations = jnp.concatenate([states, (begins + elapsed)[:, None]], axis=1)[:count]
        log_rates = jnp.max(jnp.abs(log_rates + inside), axis=0)
        finite = jnp.isfinite(new_variations).all(axis=(0, 1)) & jnp.isfinite(log_rates)
        grazes = ~finite | (self.tolerance * log_rates > GRAZING)
        # The run itself is valid, so variations without correct digits must not end the run.
        new_variations = jnp.where(finite, new_variations, 0.0)
        whole = jnp.concatenate([transition.state, jnp.zeros_like(duration)[None], *new_variations])
        transition = transition._replace(
            state=whole, counts=jnp.concatenate([transition.counts, grazes.astype(int)[None]])
        )
        return transition, values[-1], jax.tree.map(lambda change: change[:count], changes)

    def output_rows(
        self, state: Float[Array, "components times"]
    ) -> tuple[Float[Array, "shown times"], Float[Array, "tangents shown times"]]:
        """The output rows of a single run's states, and their variation at fixed times."""
        at, *variations = self.parts(state)
        at, duration = at[:-1], at[-1]
        numbers, build = self._active_numbers()

        def shown(at: Float[Array, "components times"], *numbers: Array) -> Float[Array, "shown times"]:
            return build(*numbers).shown(at)

        if not variations:
            return shown(at), jnp.zeros((0, *shown(at).shape))
        rates = self.mode.problem(at).field(duration, at)
        # If the mode begins later, the state has advanced less at the same time.
        along = [
            (variation[:-1] - rates * variation[-1], *moved)
            for variation, moved in zip(variations, self._rates(), strict=True)
        ]
        return _along(shown, (at, *numbers), along)

    def slopes(self, state: Float[Array, "components cells"]) -> Float[Array, "tangents cells"]:
        """The derivative of the time of the event at which runs have ended in this mode, or in the transition to it."""
        at, *variations = self.parts(state)
        numbers, build = self._active_numbers()

        def time(at: Float[Array, "components cells"], began: Float[Array, " cells"], *numbers: Array) -> Any:
            problem = build(*numbers).problem(at)
            if problem.event_function(at) is None:
                return began
            # The event was located to a small fraction of a step, and the variations also change over the remaining
            # time.
            rates = problem.field(began, at)
            value, rate = stop_gradient(jax.jvp(problem.event_function, (at,), (rates,)))
            rest = -value / jnp.where(rate == 0.0, jnp.inf, rate)
            at = at + jnp.where(jnp.abs(rest) < NEARLY * duration, rest, 0.0) * rates
            return began + delay(problem.event_function, at, problem.field(began, at))

        duration, point = at[-1], (at[:-1], jnp.zeros_like(at[-1]), *numbers)
        tangents = [
            (variation[:-1], variation[-1], *rates) for variation, rates in zip(variations, self._rates(), strict=True)
        ]
        return _along(time, point, tangents)[1]

    def parts(self, state: Float[Array, "components cells"]) -> list[Float[Array, "components cells"]]:
        """The state with its clock, and the variations of both."""
        return jnp.split(state, 1 + len(self.tangents))

    def _error(
        self,
        at: Float[Array, "components cells"],
        duration: Float[Array, " cells"],
        rates: Float[Array, "components cells"],
    ) -> Float[Array, "components cells"]:
        """The error of the state at the end of the mode, divided by the tolerance, from the change of the state and
        from the magnitudes.
        """
        sizes = jnp.minimum(self.mode.problem(at).start()[1], jnp.abs(rates) * duration)
        # Shares of both signs that are unlikely to cancel.
        shares = [(-1.0) ** k * (0.5 + math.modf(0.618 * k)[0]) for k in range(len(sizes))]
        return jnp.asarray(shares)[:, None] * sizes

    def _active_numbers(self) -> tuple[list[Array], Any]:
        """The mode's active numbers, and the mode as a function of them."""
        if not self.tangents:
            return [], lambda: self.mode
        numbers, structure = jax.tree.flatten(where_active(self.mode, self.tangents[0]))
        return numbers, lambda *numbers: eqx.combine(jax.tree.unflatten(structure, numbers), self.mode)

    def _rates(self) -> list[list[Array]]:
        """For each tangent the rates at which these numbers move."""
        return [jax.tree.leaves(direction) for direction in self.tangents]


def delay(function: Any, state: Float[Array, "components cells"], rates: Float[Array, "components cells"]) -> Any:
    """A number that is zero, and whose variation is that of the time at which a function of the state vanishes
    (implicit function theorem)."""
    value, rate = jax.jvp(function, (state,), (rates,))
    return -(value - stop_gradient(value)) / stop_gradient(jnp.where(rate == 0.0, jnp.inf, rate))


def _along(function: Any, point: tuple[Array, ...], tangents: list[tuple[Array, ...]], has_aux: bool = False) -> Any:
    """A function's value, its variations along tangents with these on the first axis, and its auxiliary output if any."""

    def along(tangent: tuple[Array, ...]) -> Any:
        return jax.jvp(function, point, tangent, has_aux=has_aux)

    # The function itself is computed once, whatever the number of tangents.
    stacked = jax.tree.map(lambda *moved: jnp.stack(moved), *tangents)
    return jax.vmap(along, out_axes=(None, 0, None) if has_aux else (None, 0))(stacked)


class Slopes(NamedTuple, Generic[Numbers]):
    """Derivatives of the times of the events at which runs ended, (tangents, cells); and a mask of those that are NaN
    because an earlier event was `grazing`, so that the derivative would have no correct digits.
    """

    slopes: Float[Numbers, "tangents cells"]
    grazing: Bool[Numbers, " cells"]


def solve_hybrid_with_tangents(
    modes: tuple[AbstractBatchedMode, ...],
    tangents: tuple[tuple[tuple[Any, ...], Any], ...],
    mode: Int[np.ndarray, " cells"],
    state: Float[np.ndarray, "components cells"],
    t1: float | Float[np.ndarray, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    ends_on_event: bool = True,
) -> tuple[HybridOutcome[np.ndarray], Slopes[np.ndarray]]:
    """Run every cell through its modes to its event, and differentiate the event's time along tangents.

    **Arguments:** as for `solve_hybrid`, and

    - `tangents`: pairs of the tangents of the modes and the tangent of the states, with `None` for leaves that do not
      move.
    - `ends_on_event`: whether runs end on the event; otherwise they end at `t1`, which then counts as the event's time.

    **Returns:** the `HybridOutcome`, and the `Slopes`, 0 where there is no event or the event is at the start.
    Source: implicit function theorem at the event, saltation at every change of mode.

    **Example:** the derivative with respect to the restitution.

    >>> from nonholonomic.hybrid import solve_hybrid_with_tangents
    >>> tangents = (((Bounce(jnp.ones(2)),), None),)
    >>> _, sensitivities = solve_hybrid_with_tangents(modes, tangents, first, start, 5.0, 2, settings, counters=1)
    >>> print(sensitivities.slopes.round(6))  # the time of the fall
    [[0.451524 0.451524]]
    """
    varied = variational_modes(modes, tangents, settings.tolerance, ends_on_event)
    start, n_blocks = np.asarray(variational_start(jnp.asarray(state), tangents)), 1 + len(tangents)
    ended = solve_hybrid(varied, mode, start, t1, cells, settings, counters=counters + 1, n_blocks=n_blocks)
    slopes = [np.asarray(_slopes(varied_mode, jnp.asarray(ended.state))) for varied_mode in varied]
    event_time = ended.crossing_time if ends_on_event else np.broadcast_to(t1, len(mode))
    return _without_variations(ended, len(state)), _where_defined(
        np, ended, _of_mode(np, ended, slopes), event_time, ends_on_event
    )


def traced_solve_hybrid_with_tangents(
    modes: tuple[AbstractBatchedMode, ...],
    tangents: tuple[tuple[tuple[Any, ...], Any], ...],
    mode: Int[Array, " cells"],
    state: Float[Array, "components cells"],
    t1: Float[Array, "..."],
    cells: int,
    settings: Settings,
    *,
    counters: int,
    ends_on_event: bool = True,
) -> tuple[HybridOutcome[Array], Slopes[Array]]:
    """`solve_hybrid_with_tangents` inside other transformed functions; arguments and results are traced.

    **Example:** as for `solve_hybrid_with_tangents`.

    >>> from nonholonomic.hybrid import traced_solve_hybrid_with_tangents
    >>> tangents, options = (((Bounce(jnp.ones(2)),), None),), (jnp.asarray(first), jnp.asarray(start), 5.0, 2, settings)
    >>> _, sensitivities = traced_solve_hybrid_with_tangents(modes, tangents, *options, counters=1)
    >>> print(sensitivities.slopes.round(6))
    [[0.451524 0.451524]]
    """

    def run(group: tuple[Any, ...]) -> tuple[tuple[HybridOutcome[Array], Array], list[Float[Array, " cells"]]]:
        varied = variational_modes(modes, group, settings.tolerance, ends_on_event)
        start, n_blocks = variational_start(state, group), 1 + len(group)
        ended = traced_solve_hybrid(varied, mode, start, t1, cells, settings, counters=counters + 1, n_blocks=n_blocks)
        slopes = _of_mode(jnp, ended, [varied_mode.slopes(ended.state) for varied_mode in varied])
        event_time = ended.crossing_time if ends_on_event else jnp.broadcast_to(t1, mode.shape)
        known = _where_defined(jnp, ended, slopes, event_time, ends_on_event)
        return (_without_variations(ended, len(state)), known.grazing), list(known.slopes)

    (outcome, grazing), slopes = in_groups(run, tangents)
    return outcome, Slopes(jnp.stack(slopes), grazing)


def _where_defined(
    xp: Any,
    ended: HybridOutcome[Numbers],
    slopes: Float[Numbers, "tangents cells"],
    event_time: Float[Numbers, " cells"],
    ends_on_event: bool,
) -> Slopes[Numbers]:
    """The derivatives of the times of events, where these happened and the derivatives have correct digits."""
    # An event at the start has a fixed time, whatever the tangent.
    happened = xp.isfinite(event_time) & (event_time > 0.0)
    # With its variations a run takes other steps: where it does not reach the event, it has no derivative.
    arrived = ended.status == (CROSSED if ends_on_event else REACHED_END)
    grazing = happened & ((ended.counts[-1] > 0) | ~arrived)
    return Slopes(xp.where(happened, xp.where(grazing, xp.nan, slopes), 0.0), grazing)


def _without_variations(ended: HybridOutcome[Numbers], size: int) -> HybridOutcome[Numbers]:
    """A hybrid outcome without its variations."""
    return ended._replace(state=ended.state[:size], counts=ended.counts[:-1])


def _of_mode(xp: Any, ended: HybridOutcome[Numbers], slopes: list[Float[Numbers, "tangents cells"]]) -> Any:
    """Select, for each cell, the derivatives of its mode.

    A run that has ended between two modes is in neither. Its event is the end of the previous mode, whose variation is
    the last row.
    """
    of_cells = xp.reshape(ended.state, (1 + len(slopes[0]), -1, len(ended.mode)))[1:, -1]
    for number, of_mode in enumerate(slopes):
        of_cells = xp.where(ended.mode == number, of_mode, of_cells)
    return of_cells


@eqx.filter_jit
def _slopes(varied: VariationalMode, state: Float[Array, "components cells"]) -> Float[Array, "tangents cells"]:
    return varied.slopes(state)


def variational_modes(
    modes: tuple[AbstractBatchedMode, ...],
    tangents: tuple[tuple[tuple[Any, ...], Any], ...],
    tolerance: Float[Array, ""],
    ends_on_event: bool,
) -> tuple[VariationalMode, ...]:
    """The modes with their variations. **Arguments:** as for `solve_hybrid_with_tangents`."""
    return tuple(
        VariationalMode(mode, tuple(direction[0][k] for direction in tangents), tolerance, ends_on_event)
        for k, mode in enumerate(modes)
    )


def variational_start(
    state: Float[Array, "components cells"], tangents: tuple[tuple[tuple[Any, ...], Any], ...]
) -> Float[Array, "more cells"]:
    """Initial states with their clocks, followed by the variations of both."""
    zero = jnp.zeros_like(state[0])
    moved = [jnp.zeros_like(state) if direction[1] is None else direction[1] for direction in tangents]
    return jnp.concatenate([with_row(part, zero) for part in (state, *moved)])
