"""A user's hybrid system as problems and batched modes of the engine.

Users write functions of one state. Here they are mapped over lanes, component by component, so that they have the same
layout as equations written for the engine: components along the first axis, lanes last. If a function depends on time,
time is an additional component of the state.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..compilation.components import over_cells, over_lanes
from ..compilation.tracing import in_cells
from ..compilation.xla_cpu import compiled_setup, least
from ..hybrid import AbstractBatchedMode, Transition
from ..integration import AbstractProblem, Components, Jumps, Lanes, States
from ..integration.problem import CROSSED, FAILED, LEFT_DOMAIN, RUNNING
from ..runs.event import ROUND_OFF, UNMEASURED, near_zero
from .form import Form, State

#: The margins of a mode.
Margins = Float[Array, "margins *cells"]

#: A state at the start of a mode may be wrong by this many times the tolerance, because the mode before ended with an
#: error. Slower changes of a margin than such errors allow say nothing of its direction.
ACCUMULATED = 100.0

#: When a margin whose slope at the start of the mode is an error is looked at for its direction, increasing, in units of the
#: time in which an error of its slope becomes one of its value.
SOON = 4.0 ** -np.arange(10.0, 0.0, -1.0)


class ModeProblem(AbstractProblem):
    """The motion in one mode, up to the event or the end of the mode.

    `mode`: the mode; `states`: at the start; `jump_times`: the readings of the clock in the state at which a function of the
    mode may jump; `allowances`: for each margin an allowance for errors of the start, zero where the mode does not begin on
    the margin.
    """

    direction_decides: ClassVar[bool] = True
    fast: ClassVar[tuple[bool, bool]] = True, True

    mode: "BatchedMode"
    states: Float[Array, "components *cells"]
    jump_times: Float[Array, "jumps *cells"] | None = None
    allowances: Margins | None = None

    @property
    def fits_one_kernel(self) -> bool:
        return self.mode.form.traits.elementary

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.mode.scales

    def field(self, time: Lanes, state: Components) -> States:
        rates = self.mode.in_lanes("field", state)
        clock = (jnp.ones_like(state[0]),) if self.mode.form.traits.depends_on_time else ()
        return jnp.stack((*rates, *clock))

    def event_function(self, state: States) -> Lanes | None:
        return self.mode.in_lanes("event", state) if self.mode.form.has_event else None

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        margins = self.margins(time, state)
        return least(*margins) if margins else None

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        if self.allowances is None:
            # If some modes have a domain margin, all modes need one.
            return () if self.mode.form.traits.smooth else (jnp.ones_like(state[0]),)
        return tuple(
            margin + extra for margin, extra in zip(self.mode.in_lanes("margins", state), self.allowances, strict=True)
        )

    def exact_margin(self, time: Lanes, state: States) -> Lanes | None:
        return least(*self.mode.in_lanes("margins", state)) if self.mode.margins else None

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        if self.allowances is None:
            return None
        value, slope, error, slope_error, is_tangential = self.at_start()
        falls = jax.lax.cond(
            jnp.any(is_tangential),
            lambda: self._falls_soon(value, error + 2.0 * jnp.abs(value), error / slope_error),
            lambda: jnp.zeros(value.shape, bool),
        )
        is_near = jnp.abs(value) <= ACCUMULATED * error
        falls = jnp.where(is_tangential, falls, slope < 0.0) & (value <= ROUND_OFF / self.mode.tolerance * error)
        return jnp.any(jnp.where(is_near, falls, value <= 0.0), axis=0)

    @compiled_setup
    def at_start(self) -> tuple[Array, ...]:
        """The margins at the start; their slopes along the motion; the errors of both if the error of every component is the
        tolerance, and whether value and slope are such errors."""

        def value_and_slope(state: States) -> tuple[Array, Array]:
            rates = self.field(jnp.zeros_like(state[0]), state)
            return jax.jvp(lambda point: jnp.stack(self.mode.in_lanes("margins", point)), (state,), (rates,))

        state = self.states
        # The states at the samples of one cell have the scales of the cell.
        scales = self.mode.scales.reshape(*self.mode.scales.shape, *[1] * (state.ndim - self.mode.scales.ndim))
        sizes = jnp.abs(state) + jnp.where(scales < UNMEASURED, 0.1 * scales, 0.0)
        directions = jnp.eye(len(state)).reshape(*2 * state.shape[:1], *[1] * (state.ndim - 1)) * sizes
        (value, slope), pushed = jax.linearize(value_and_slope, state)
        error, slope_error = (
            self.mode.tolerance * jnp.sum(jnp.abs(part), axis=0) for part in jax.vmap(pushed)(directions)
        )
        is_near = jnp.abs(value) <= ACCUMULATED * error
        return value, slope, error, slope_error, is_near & (jnp.abs(slope) <= ACCUMULATED * slope_error)

    def _falls_soon(self, value: Margins, error: Margins, unit: Array) -> Bool[Array, "margins *cells"]:
        """Whether each margin falls where it first changes by more than an error: the sign of its first derivative along the
        motion that is not zero. **Arguments:** `unit`: that of `SOON` [s]."""
        state, zero = self.states, jnp.zeros_like(self.states[0])
        rates, length = self.field(zero, state), jnp.min(jnp.where(jnp.isfinite(unit), unit, 1.0), axis=0)

        def change(share: Float[Array, ""]) -> Margins:
            def stage(carry: tuple[Array, Array], weights: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
                rate, total = carry
                rate = self.field(zero, state + share * length * weights[0] * rate)
                return (rate, total + weights[1] * rate), None

            # The classical method of Runge and Kutta.
            weights = (jnp.array([0.0, 0.5, 0.5, 1.0]), jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0)
            (_, mean), _ = jax.lax.scan(stage, (rates, jnp.zeros_like(rates)), weights)
            return jnp.stack(self.mode.in_lanes("margins", state + share * length * mean)) - value

        changes = jax.vmap(change)(jnp.asarray(SOON))
        first = jnp.argmax(jnp.abs(changes) > error, axis=0)
        chosen = jnp.take_along_axis(changes, first[None], axis=0)[0]
        return chosen < -error

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return None if self.jump_times is None else Jumps.at(self.jump_times, state[-1] - time)


def time_and_state(form: Form, parts: tuple[Array, ...]) -> tuple[Array, State]:
    """Time and state of a run, from its components; the time is a placeholder if nothing depends on it."""
    if form.traits.depends_on_time:
        return parts[-1], jnp.stack(parts[:-1])
    return jnp.asarray(jnp.nan), jnp.stack(parts)


def _in_lanes(form: Form, name: str, mode: int, numbers: Sequence[Array], parts: tuple[Array, ...]) -> PyTree:
    """A user's function (`Form.function`) in every lane, from the components of the states; rates are returned as components,
    too."""

    def of_run(numbers: Sequence[Array], parts: tuple[Array, ...]) -> PyTree:
        values = form.function(name, mode)(numbers, *time_and_state(form, parts))
        return tuple(values) if name == "field" else values

    return over_lanes(of_run, tuple(numbers), parts)


#: A large field is a function of its own in every program, which JAX traces, differentiates and lowers once.
_in_lanes_out_of_line = jax.jit(_in_lanes, static_argnums=(0, 1, 2))

#: A small one is traced once, too, but becomes part of the program.
_in_lanes_inline = jax.jit(_in_lanes, static_argnums=(0, 1, 2), inline=True)


class BatchedMode(AbstractBatchedMode):
    """A user's mode as a mode of the engine.

    `numbers`: the system's numbers; `scales`: the magnitudes of the states, which scale their errors; `tolerance`: of the
    integration of the modes before; `continues`: whether a run continues through its event.
    """

    numbers: tuple[Float[Array, "..."], ...]
    scales: Float[Array, "components *cells"]
    tolerance: Float[Array, ""]
    form: Form = eqx.field(static=True)
    index: int = eqx.field(static=True)
    continues: bool = eqx.field(static=True, default=False)

    @property
    def margins(self) -> int:
        """The number of margins."""
        return self.form.traits.ends[self.index]

    def in_lanes(self, name: str, state: Components) -> PyTree:
        """A function of the mode (`Form.function`) in every lane."""
        is_large = name == "field" and self.form.traits.large[self.index]
        evaluate = _in_lanes_out_of_line if is_large else _in_lanes_inline
        return evaluate(self.form, name, self.index, self.numbers, tuple(state))

    def problem(self, state: Float[Array, "components *cells"]) -> ModeProblem:
        """The problem of the mode, with the jumps of its functions and its allowances."""
        times_of, depends = functools.partial(self.form.jump_times, self.index), self.form.traits.depends_on_time
        times = in_cells(times_of, self.numbers, state.shape[1:]) if depends else None
        problem = ModeProblem(self, state, times)
        if not self.margins:
            return problem
        value, _, error, _, is_tangential = jax.tree.map(stop_gradient, problem).at_start()
        # Where the margin rises with slope 0, errors of the start may let it fall at first.
        dip = jnp.where(is_tangential, error, ROUND_OFF / self.tolerance * error)
        allowances = jnp.where(
            jnp.abs(value) <= ACCUMULATED * error, dip + 2.0 * jnp.maximum(-value, 0.0) + 1e-200, 0.0
        )
        return dataclasses.replace(problem, allowances=stop_gradient(allowances))

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """The reset, or the end of the run if the mode has no reset.

        An event at the end of the mode comes before the reset. If the reset jumps over the zero of the event function,
        the event happens at the reset, and the run ends between two modes.
        """
        zeros = jnp.zeros(state.shape[1:])
        event = near_zero(ModeProblem(self, state), zeros, state) if self.form.has_event else (zeros,) * 3
        return over_cells(_after_reset, self)(state, self._exit(stop_gradient(state)), event)

    def fallen(self, state: Float[Array, " components"]) -> str:
        """The name of the margin that ended the mode, or its index."""
        # Not traced, as JAX would sort the names.
        margin = self.form.function("margin", self.index)(self.numbers, *time_and_state(self.form, tuple(state)))
        names = list(margin) if isinstance(margin, dict) else range(self.margins)
        return str(names[int(eqx.filter_jit(BatchedMode._exit)(self, state[:, None])[0])])

    def _exit(self, state: Float[Array, "components cells"]) -> Int[Array, " cells"]:
        """The index of the margin that ended the mode: the first of those that are least up to round-off and fall."""
        if self.margins < 2:
            return jnp.zeros(state.shape[1], int)
        value, slope, error, slope_error, _ = jax.tree.map(stop_gradient, ModeProblem(self, state)).at_start()
        is_least = value <= jnp.min(value, axis=0) + ROUND_OFF / self.tolerance * error
        falls = is_least & (slope < -ACCUMULATED * slope_error)
        steepest = jnp.argmin(jnp.where(is_least, slope, jnp.inf), axis=0)
        return jnp.where(jnp.any(falls, axis=0), jnp.argmax(falls, axis=0), steepest)


def _after_reset(
    mode: BatchedMode, state: Float[Array, " components"], exit: Int[Array, ""], event: tuple[Array, Array, Array]
) -> Transition:
    """The transition of one run at the end of its mode, whose margin of index `exit` fell. **Arguments:** `event`: as from
    `near_zero`."""
    numbers, form, zero, now, never = mode.numbers, mode.form, jnp.zeros((), int), jnp.zeros(()), jnp.asarray(jnp.inf)
    before, slope, error = event
    ends = (jnp.abs(before) <= error) & (slope < 0.0)
    if not form.traits.resets[mode.index]:
        status = jnp.where(ends & (not mode.continues), CROSSED, LEFT_DOMAIN)
        return Transition(zero + mode.index, state, now, status, jnp.where(ends, now, never), zero[None])
    t, y = time_and_state(form, tuple(state))
    state_after, number = form.function("reset", mode.index)(numbers, t, y, exit)
    number = jnp.asarray(number).astype(int)
    for k, is_projected in enumerate(form.traits.projected):
        if is_projected:
            projected = form.function("entered", k)(numbers, t, state_after)
            state_after = jnp.where(number == k, projected, state_after)
    state_after = jnp.concatenate([state_after, state[form.size :]])
    status = jnp.where((number >= 0) & (number < form.modes), RUNNING, FAILED)
    if not form.has_event:
        return Transition(number, state_after, now, status, never, zero[None] + 1)
    after = form.function("event")(numbers, *time_and_state(form, tuple(state_after)))
    jumps = (before > error) & (after <= 0.0) & (status == RUNNING)
    crossed = ends | jumps
    if mode.continues:
        return Transition(number, state_after, now, status, jnp.where(crossed, now, never), zero[None] + 1)
    return Transition(
        mode=jnp.where(ends, mode.index, jnp.where(jumps, form.modes + number, number)),
        state=jnp.where(ends, state, state_after),
        elapsed=now,
        status=jnp.where(crossed, CROSSED, status),
        crossing_time=jnp.where(crossed, now, never),
        counts=jnp.where(ends, 0, 1)[None],
    )
