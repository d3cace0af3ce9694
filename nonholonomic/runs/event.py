"""A user's event as part of the motion: a function of time and of the quantities of one state.

The function is written for one run and mapped over lanes. Its own numbers are leaves, so that they can be swept and
differentiated. If the function depends on time, a clock is added to the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..hybrid import AbstractBatchedMode, Transition
from ..hybrid.saltation import UNMEASURED
from ..integration import AbstractProblem, Jumps, Lanes, States
from ..integration.status import CROSSED, RUNNING
from ..lanes.components import over_lanes
from ..lanes.tracing import depends_on_first, is_elementary, spelled_out, with_own_numbers
from ..parameters import Parameters
from ..per_run import gathered
from ..text import described, likely, name_of
from ..validation import UNTRACEABLE, shown
from .model import AbstractModel, Names, Start


class Motion:
    """The quantities of one state as attributes, computed when they are read: `motion.speed`."""

    def __init__(self, read: Callable[[str], Array], names: Any):
        self._read, self._names = read, names

    def __getattr__(self, name: str) -> Array:
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._names:
            known = ", ".join(self._names)
            raise ValueError(f"event: motion.{name} must be one of {known}{likely(name, self._names)}")
        return self._read(name)

    def __getitem__(self, name: str) -> Array:
        if not isinstance(name, str):
            raise ValueError(
                f"event: motion[{shown(name)}]: the quantities of a motion have names, such as motion.{next(iter(self._names))}"
            )
        return getattr(self, name)


class OfValues(eqx.Module):
    """An event as a function of time and of the values of the quantities that it reads."""

    event: Any

    def __call__(self, t: Float[Array, ""], values: dict[str, Array]) -> Float[Array, ""]:
        return jnp.asarray(self.event(t, Motion(values.__getitem__, values)))


class EventFunction(eqx.Module):
    """An event for the engine.

    - `parameters`: the function with its own numbers, under the names "event.level" and so on.
    - `names`: the quantities that it reads; `depends_on_time`, `elementary`: traits found by tracing.
    """

    parameters: Parameters
    names: tuple[str, ...] = eqx.field(static=True)
    depends_on_time: bool = eqx.field(static=True)
    elementary: bool = eqx.field(static=True)

    def __call__(self, t: Float[Array, ""], values: dict[str, Array]) -> Float[Array, ""]:
        return self.parameters.tree["event"](t, values)

    @property
    def function(self) -> Any:
        """The user's function, with its present numbers."""
        return self.parameters.tree["event"].event

    @property
    def name(self) -> str:
        """The name of the function, for the request of a table."""
        return name_of(self.function)

    def replaced(self, values: dict[str, Any]) -> "EventFunction":
        """The event with other values of its numbers."""
        return dataclasses.replace(self, parameters=self.parameters.replaced(values))


def rows_of(model: AbstractModel, names: Names) -> jax.ShapeDtypeStruct:
    """The type of the rows of one state, as `AbstractModel.read` receives them."""

    def start() -> Array:
        if model.smooth:
            return model.problem(None, names).start()[0]
        modes, _, states = model.modes(1, jnp.asarray(1e-9), names, False)
        return modes[0].shown(states)[:, 0]

    return jax.eval_shape(start)


def with_event(model: AbstractModel, event: Any) -> AbstractModel:
    """The model with a user's event, in place of its own; without an event, the model itself.

    **Raises:** `ValueError` unless the event is a function `event(t, motion)` that JAX can trace and that returns a float.
    """
    if event is None:
        return model
    if not callable(event):
        raise ValueError(f"event = {shown(event)} must be a function event(t, motion) of time and motion, or None")
    t, index = jax.ShapeDtypeStruct((), jnp.result_type(float)), None if model.smooth else 0
    used: dict[str, None] = {}

    def first_call(t: Array, rows: Array) -> Any:
        def read(name: str) -> Array:
            used[name] = None
            return model.read((name,), t, rows, index)[name]

        return event(t, Motion(read, model.quantities))

    try:
        result = jax.eval_shape(first_call, t, rows_of(model, None))
    except jax.errors.JAXTypeError as error:
        raise ValueError(f"event(t, motion) {UNTRACEABLE}") from error
    if getattr(result, "shape", None) != () or not jnp.issubdtype(result.dtype, jnp.floating):
        raise ValueError(f"event(t, motion) must return one float, not {described(result)}")
    names = tuple(used)
    values = jax.eval_shape(lambda t, rows: model.read(names, t, rows, index), t, rows_of(model, names))
    example = (jnp.zeros(()), jax.tree.map(lambda value: jnp.zeros(value.shape, value.dtype), values))
    function = with_own_numbers(OfValues(event), *example)
    parameters = Parameters.of({"event": function})
    depends_on_time = depends_on_first(function, *example)
    model = dataclasses.replace(model, event=EventFunction(parameters, names, depends_on_time, False))
    leaves, structure = jax.tree.flatten(model)
    rows = rows_of(model, names)
    types = (t, rows, *(jax.ShapeDtypeStruct((), jnp.asarray(leaf).dtype) for leaf in leaves))
    elementary = model.smooth and is_elementary(
        spelled_out(lambda t, rows, *leaves: _value(jax.tree.unflatten(structure, leaves), index, t, rows)), *types
    )
    return dataclasses.replace(model, event=dataclasses.replace(model.event, elementary=elementary))


def _value(model: AbstractModel, mode: Any, t: Array, rows: Array) -> Float[Array, ""]:
    """The event function of one state."""
    return model.event(t, model.read(model.event.names, t, rows, mode))


class EventProblem(AbstractProblem):
    """A problem with a user's event in place of its own.

    - `model`: the model with the event; `mode`, `index`: the mode of the problem and its index, or `None`.
    - `clock`: the time [s] at the start, (1, cells), if the event depends on time; otherwise (0, cells).
    """

    motion: AbstractProblem
    model: AbstractModel
    clock: Float[Array, "clocks *cells"]
    mode: AbstractBatchedMode | None = None
    index: int | None = eqx.field(static=True, default=None)

    @property
    def direction_decides(self) -> bool:
        return True

    @property
    def fits_one_kernel(self) -> bool:
        return self.motion.fits_one_kernel and self.model.event.elementary

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.motion.fast[0], True

    def start(self) -> tuple[Float[Array, "components *cells"], Float[Array, "components *cells"]]:
        states, scales = self.motion.start()
        return jnp.concatenate([states, self.clock]), jnp.concatenate([scales, jnp.full_like(self.clock, UNMEASURED)])

    def field(self, time: Lanes, state: States) -> States:
        core = self._core(state)
        rates = self.motion.field(time, core)
        return jnp.concatenate([rates, jnp.ones_like(state[len(core) :])]) if len(self.clock) else rates

    def event_function(self, state: States) -> Lanes:
        return value_in_lanes(self.model, self.mode, self.index, state)

    def domain_margin(self, time: Lanes, state: States) -> Lanes | None:
        return self.motion.domain_margin(time, self._core(state))

    def lost_at_start(self, state: States) -> Bool[Array, "..."] | None:
        return self.motion.lost_at_start(self._core(state))

    def margins(self, time: Lanes, state: States) -> tuple[Lanes, ...]:
        return self.motion.margins(time, self._core(state))

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.motion.jumps(time, self._core(state))

    def _core(self, state: Any) -> Any:
        return state[:-1] if len(self.clock) else state


def value_in_lanes(model: AbstractModel, mode: AbstractBatchedMode | None, index: int | None, state: States) -> Lanes:
    """The event function of states, which end with the time if the function depends on it."""
    event: Any = model.event
    rows, time = (state[:-1], state[-1]) if event.depends_on_time else (state, jnp.full_like(state[0], jnp.nan))
    rows = jnp.stack(tuple(rows))
    if mode is not None:
        rows = mode.shown(rows) if rows.ndim == 2 else mode.shown(rows[:, None])[:, 0]
    values = model.read(event.names, time, rows, index)
    leaves, structure = jax.tree.flatten(event)
    # The components of every value, lane by lane.
    shapes = [value.shape[time.ndim :] for value in values.values()]
    parts = [
        value[(..., *component)]
        for value, shape in zip(values.values(), shapes, strict=True)
        for component in np.ndindex(shape)
    ]

    def of_run(leaves: Any, parts: tuple[Array, ...]) -> Float[Array, ""]:
        time, *components = parts
        of_one_run = dict(zip(values, gathered(components, shapes), strict=True))
        return jax.tree.unflatten(structure, leaves)(time, of_one_run)

    return over_lanes(of_run, tuple(leaves), (time, *parts))


class EventMode(AbstractBatchedMode):
    """A mode with a user's event. The event also happens at a reset that lets its function jump through zero.

    `modes`: all modes of the model, by their index; `continues`: whether a run continues through its event.
    """

    modes: tuple[AbstractBatchedMode, ...]
    model: AbstractModel
    index: int = eqx.field(static=True)
    continues: bool = eqx.field(static=True)

    def problem(self, state: Float[Array, "components cells"]) -> EventProblem:
        core, clock = self._parts(state)
        mode = self.modes[self.index]
        return EventProblem(mode.problem(core), self.model, clock, mode, self.index)

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        core, clock = self._parts(state)
        transition = self.modes[self.index].reset_map(core, left)
        new_state = jnp.concatenate([transition.state, clock + transition.elapsed])
        before = value_in_lanes(self.model, self.modes[self.index], self.index, state)
        after = before
        for number, mode in enumerate(self.modes):
            value = value_in_lanes(self.model, mode, number, new_state)
            after = jnp.where(transition.mode == number, value, after)
        jumps = (before > 0.0) & (after <= 0.0) & (transition.status == RUNNING)
        # A run that ends between two modes is in neither.
        return transition._replace(
            mode=jnp.where(jumps & (not self.continues), len(self.modes), transition.mode),
            state=new_state,
            status=jnp.where(jumps & (not self.continues), CROSSED, transition.status),
            crossing_time=jnp.where(jumps, transition.elapsed, jnp.inf),
        )

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        return self.modes[self.index].shown(self._parts(state)[0])

    def between(self, motion: Any, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        return self.modes[self.index].between(motion, passed)

    def _parts(self, state: Array) -> tuple[Array, Array]:
        """The state of the mode, and the clock if there is one."""
        return (state[:-1], state[-1:]) if self.model.event.depends_on_time else (state, state[:0])


def problem_of(model: AbstractModel, cells: int | None, names: Names) -> AbstractProblem:
    """The motion of a smooth model with its event."""
    if model.event is None:
        return model.problem(cells, names)
    names = None if names is None else (*names, *(name for name in model.event.names if name not in names))
    problem = model.problem(cells, names)
    states = problem.start()[0]
    clock = jnp.zeros((int(model.event.depends_on_time), *states.shape[1:]))
    return EventProblem(problem, model, clock)


def modes_of(model: AbstractModel, cells: int, tolerance: Any, names: Names, continues: bool = False) -> Start:
    """The modes of a model with its event, and the start in them."""
    if model.event is None:
        return model.modes(cells, tolerance, names, continues)
    names = None if names is None else (*names, *(name for name in model.event.names if name not in names))
    modes, first, states = model.modes(cells, tolerance, names, continues)
    clock = jnp.zeros((int(model.event.depends_on_time), states.shape[1]))
    with_events = tuple(EventMode(modes, model, index, continues) for index in range(len(modes)))
    return with_events, first, jnp.concatenate([states, clock])
