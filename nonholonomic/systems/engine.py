"""A user's hybrid system as problems and batched modes of the engine.

Users write functions of one state. Here they are mapped over lanes, component by component, so that they have the same
layout as equations written for the engine: components along the first axis, lanes last. If a function depends on time,
time is an additional component of the state.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from ..hybrid import AbstractBatchedMode, Transition
from ..integration import AbstractProblem, Jumps, Lanes, States
from ..integration.status import CROSSED, FAILED, LEFT_DOMAIN, RUNNING
from ..lanes.components import over_lanes
from ..runs import UNMEASURED
from .form import Form, OfRun
from .mode import State

#: A function counts as zero if changing every component of the state by this fraction of its size could make it zero.
#: The first fraction is for the end of a mode, which is located only to 1e-10 of a step, so that a long step leaves an
#: error; the second is for round-off.
AT_END, ROUND_OFF = 1e-6, 1e-14


class ModeProblem(AbstractProblem):
    """The motion in one mode, up to the event or the end of the mode.

    `numbers`: the system's numbers; `states`, `scales`: as `start` returns them; `jump_times`: the readings of the clock in
    the state at which a function of the mode may jump.
    """

    numbers: tuple[Float[Array, "..."], ...]
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]
    form: Form = eqx.field(static=True)
    mode: int = eqx.field(static=True)
    jump_times: Float[Array, "jumps *cells"] | None = None

    @classmethod
    def of(
        cls, numbers: tuple[Float[Array, "..."], ...], states: States, scales: States, form: Form, mode: int
    ) -> "ModeProblem":
        """The problem of a mode, with the jumps of its functions."""
        times = None
        if form.traits.depends_on_time:
            axes = tuple(0 if jnp.ndim(number) else None for number in numbers)
            found = functools.partial(form.jump_times, mode)
            is_single = all(axis is None for axis in axes)
            times = found(numbers) if is_single else jax.vmap(found, in_axes=(axes,), out_axes=-1)(numbers)
            times = times if times.ndim == states.ndim else times.reshape(len(times), *[1] * (states.ndim - 1))
            times = jnp.broadcast_to(times, (len(times), *states.shape[1:])) if len(times) else None
        return cls(numbers, states, scales, form, mode, times)

    @property
    def direction_decides(self) -> bool:
        return True

    @property
    def fits_one_kernel(self) -> bool:
        return self.form.traits.elementary

    @property
    def fast(self) -> tuple[bool, bool]:
        return True, True

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Lanes, state: States) -> States:
        rates = self._over_lanes(lambda *run: tuple(self.form.function("field", self.mode)(*run)), state)
        clock = (jnp.ones_like(state[0]),) if self.form.traits.depends_on_time else ()
        return jnp.stack((*rates, *clock))

    def event_function(self, state: States) -> Lanes | None:
        return self._over_lanes(self.form.function("event"), state) if self.form.has_event else None

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        if self.form.traits.ends[self.mode]:
            return self._over_lanes(self.form.function("margin", self.mode), state)
        # If some modes have a domain margin, all modes need one.
        return None if self.form.traits.smooth else jnp.ones_like(state[0])

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return None if self.jump_times is None else Jumps.at(self.jump_times, state[-1] - time)

    def _over_lanes(self, function: OfRun, state: States) -> Any:
        """A user's function, evaluated in every lane."""

        def of_run(numbers: Sequence[Array], parts: tuple[Array, ...]) -> Any:
            return function(numbers, *time_and_state(self.form, parts))

        return over_lanes(of_run, self.numbers, tuple(state))


def time_and_state(form: Form, parts: tuple[Array, ...]) -> tuple[Array, State]:
    """Time and state of a run, from its components; the time is a placeholder if nothing depends on it."""
    if form.traits.depends_on_time:
        return parts[-1], jnp.stack(parts[:-1])
    return jnp.asarray(jnp.nan), jnp.stack(parts)


class BatchedMode(AbstractBatchedMode):
    """A user's mode as a mode of the engine, for cells with `numbers` and `scales` as in `ModeProblem`.

    `continues`: whether a run continues through its event.
    """

    numbers: tuple[Float[Array, "..."], ...]
    scales: Float[Array, "components cells"]
    form: Form = eqx.field(static=True)
    mode: int = eqx.field(static=True)
    continues: bool = eqx.field(static=True, default=False)

    def problem(self, state: Float[Array, "components cells"]) -> ModeProblem:
        return ModeProblem.of(self.numbers, state, self.scales, self.form, self.mode)

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        """The reset, or the end of the run if the mode has no reset.

        An event at the end of the mode comes before the reset. If the reset jumps over the zero of the event function,
        the event happens at the reset, and the run ends between two modes.
        """
        axes = tuple(0 if jnp.ndim(number) else None for number in self.numbers)
        reset = jax.vmap(self._reset_one, in_axes=(axes, 1, 1), out_axes=_TRANSITION_AXES)
        return reset(self.numbers, state, self.scales)

    def _reset_one(
        self, numbers: Sequence[Array], state: Float[Array, " components"], scales: Float[Array, " components"]
    ) -> Transition:
        form = self.form
        function = (
            form.function("margin", self.mode)
            if form.traits.ends[self.mode]
            else lambda numbers, t, y: 1.0 + 0.0 * y[0]
        )
        margin = _Watched(form, self.mode, function, numbers, scales)
        value, slope = margin.along(state)
        # The end was located to a fraction of a step and may lie after the zero; the way back is known.
        close = margin.is_near_zero(state, AT_END) & (slope < 0.0) & (value < 0.0)
        delay = jnp.where(close, -value / jnp.where(close, slope, 1.0), 0.0)
        state = state + delay * margin.rate(state)
        zero = jnp.zeros((), int)
        if not form.traits.resets[self.mode]:
            no_time = jnp.full_like(delay, jnp.inf)
            return Transition(zero + self.mode, state, delay, zero + LEFT_DOMAIN, no_time, zero[None])
        t, y = time_and_state(form, tuple(state))
        state_after, number = form.function("reset", self.mode)(numbers, t, y)
        number = jnp.asarray(number).astype(int)
        for mode, is_projected in enumerate(form.traits.projected):
            if is_projected:
                projected = form.function("entered", mode)(numbers, t, state_after)
                state_after = jnp.where(number == mode, projected, state_after)
        state_after = jnp.concatenate([state_after, state[form.size :]])
        status = jnp.where((number >= 0) & (number < form.modes), RUNNING, FAILED)
        if not form.has_event:
            return Transition(number, state_after, delay, status, jnp.full_like(delay, jnp.inf), zero[None] + 1)
        event = _Watched(form, self.mode, form.function("event"), numbers, scales)
        value_before, slope_before = event.along(state)
        ends = event.is_near_zero(state, ROUND_OFF) & (slope_before < 0.0)
        jumps = ~ends & (value_before > 0.0) & (event.value(state_after) <= 0.0)
        crossed = ends | jumps
        if self.continues:
            crossing_time = jnp.where(crossed, delay, jnp.inf)
            return Transition(number, state_after, delay, status, crossing_time, zero[None] + 1)
        return Transition(
            mode=jnp.where(ends, self.mode, jnp.where(jumps, form.modes, number)),
            state=jnp.where(ends, state, state_after),
            elapsed=delay,
            status=jnp.where(crossed, CROSSED, status),
            crossing_time=jnp.where(crossed, delay, jnp.inf),
            counts=jnp.where(ends, 0, 1)[None],
        )


#: The axis of cells in a `Transition`, for `vmap`.
_AXES: Any = (0, 1, 0, 0, 0, 1, None, None)
_TRANSITION_AXES = Transition(*_AXES)


class _Watched(eqx.Module):
    """A function that ends a mode or defines the event, for a single run: its value for a state with its time."""

    form: Form = eqx.field(static=True)
    mode: int = eqx.field(static=True)
    function: OfRun = eqx.field(static=True)
    numbers: Sequence[Array]
    scales: Float[Array, " components"]

    def value(self, state: Float[Array, " components"]) -> Float[Array, ""]:
        return self.function(self.numbers, *time_and_state(self.form, tuple(state)))

    def rate(self, state: Float[Array, " components"]) -> Float[Array, " components"]:
        """Rate of the state in the mode."""
        rate = self.form.function("field", self.mode)(self.numbers, *time_and_state(self.form, tuple(state)))
        return jnp.concatenate([rate, jnp.ones(len(state) - self.form.size)])

    def along(self, state: Float[Array, " components"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The value and its rate along the motion."""
        return jax.jvp(self.value, (state,), (self.rate(state),))

    def is_near_zero(self, state: Float[Array, " components"], fraction: float) -> Bool[Array, ""]:
        """Whether changing each component by a fraction of its size could make the function zero."""
        slopes = jax.jacfwd(self.value)(state)
        sizes = jnp.abs(state) + jnp.where(self.scales < UNMEASURED, self.scales, 0.0)
        return jnp.abs(self.value(state)) <= fraction * jnp.sum(jnp.abs(slopes) * sizes)


class Cells(eqx.Module):
    """Runs of a system: its numbers and the components of the starts, each a scalar or an array with one number per
    cell."""

    numbers: tuple[Float[Array, "..."], ...]
    start: tuple[Float[Array, "..."], ...]
    form: Form = eqx.field(static=True)

    def states(self, cells: int | None) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        """States at the start, including the time if a function depends on it, and the magnitudes that scale their
        errors: the largest component of a start, but at most 1.
        """
        shape = () if cells is None else (cells,)
        states = jnp.stack([jnp.broadcast_to(part, shape) for part in self.start])
        magnitude = jnp.max(jnp.abs(stop_gradient(states)), axis=0)
        scales = jnp.broadcast_to(jnp.where(magnitude > 0.0, jnp.minimum(magnitude, 1.0), 1.0), states.shape)
        if not self.form.traits.depends_on_time:
            return states, scales
        clock = jnp.zeros((1, *shape))
        return jnp.concatenate([states, clock]), jnp.concatenate([scales, clock + UNMEASURED])

    def within_constraints(self, changes: Float[Array, "components cells"]) -> Float[Array, "components cells"]:
        """Changes of the states at the start, projected onto those that the constraints of the first mode allow."""
        form = self.form
        if not form.traits.projected[form.first]:
            return changes
        entered = form.function("entered", form.first)

        def of_one(numbers: Sequence[Array], state: Array, change: Array) -> Array:
            t, y = time_and_state(form, tuple(state))
            _, allowed = jax.jvp(lambda y: entered(numbers, t, y), (y,), (change[: form.size],))
            return jnp.concatenate([allowed, change[form.size :]])

        axes = tuple(0 if jnp.ndim(number) else None for number in self.numbers)
        states, _ = self.states(changes.shape[1])
        return jax.vmap(of_one, in_axes=(axes, 1, 1), out_axes=1)(self.numbers, states, changes)

    def problem(self, cells: int | None) -> ModeProblem:
        """The problem of a system whose runs are smooth."""
        return ModeProblem.of(self.numbers, *self.states(cells), self.form, self.form.first)

    def modes(
        self, cells: int, continues: bool = False
    ) -> tuple[tuple[BatchedMode, ...], Int[Array, " cells"], Float[Array, "components cells"]]:
        """The modes of a system with resets, the index of the first mode, and the initial states in it."""
        states, scales = self.states(cells)
        phases = tuple(BatchedMode(self.numbers, scales, self.form, mode, continues) for mode in range(self.form.modes))
        return phases, jnp.full(cells, self.form.first), states
