"""A user's hybrid system as a model for the functions of `nonholonomic.runs`, and its page."""

import dataclasses
import functools
import itertools
import operator
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..compilation.tracing import dependent_outputs, named_errors, with_own_numbers
from ..compilation.xla_cpu import Function
from ..hybrid import HybridOutcome
from ..integration import AbstractProblem, Outcome
from ..integration.problem import Status
from ..parameters import Parameters, checks_of, require_apart, short_names
from ..runs.event import UNMEASURED
from ..runs.model import AbstractModel, Names, Start, model_of, run_of, statuses
from ..runs.simulate import simulate_model
from ..runs.trajectory import Trajectory, drawn_stage, frame_of, live_run, page_of, runs_at_ends, sliders_of
from ..sweeps import Axis, Quantity, Variable
from ..text import counted, name_of, shown
from ..validation import as_number, is_traced
from ..views.pages import Frame, LiveRun
from ..views.stage import Draw, Stage
from . import mechanics
from .engine import ROUND_OFF, BatchedMode, time_and_state
from .form import Event, Form, Hybrid, arguments_in_words, check_start, is_pair, require_event
from .mechanics import AbstractSystem, Lagrange, components_of, formulation_of, parts_of_system

# A user's own system as a model: its numbers by name, its modes, and its components.

#: The further quantities of a mechanical system with an input, a drift or functions of time, and their descriptions.
BALANCE = {"energy": "energy", "support_power": "power of moving supports", "input_power": "power of the input"}


class OwnModel(AbstractModel):
    """A `Hybrid` or an `AbstractSystem`, its start and its event, which is a part of `parameters`.

    `form`: the form of the hybrid system; `names`: those of the components of a state; `draw`: as for
    `Trajectory.view`; `has_balance`: whether the quantities include those of `BALANCE`.
    """

    parameters: Parameters
    form: Form = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    event: None = None
    draw: Draw = eqx.field(static=True, default=None)
    has_balance: bool = eqx.field(static=True, default=False)
    smooth: bool = eqx.field(static=True, kw_only=True)
    has_event: bool = eqx.field(static=True, kw_only=True)
    depends_on_time: bool = eqx.field(static=True, kw_only=True)
    compiles_slowly: bool = eqx.field(static=True, kw_only=True)

    @classmethod
    def of(cls, tree: dict[str, Any], draw: Draw = None) -> "OwnModel":
        """The model of a system, its start, its event and its drawing."""
        hybrid, state = assembled(tree)
        form = Form.of(hybrid, state.size)[0]
        # Traced here, so that what is wrong with a user's function is said before anything compiles.
        traits, system = form.traits, tree["system"]
        has_balance = mechanics.is_driven(system) or tree["input"] is not None
        return cls(
            parameters=Parameters.of(tree),
            form=form,
            names=names_of(system, form.size, has_balance),
            draw=draw,
            has_balance=has_balance,
            smooth=traits.smooth,
            has_event=form.has_event,
            depends_on_time=traits.depends_on_time,
            compiles_slowly=any(traits.large),
        )

    def __reduce__(self) -> tuple[Function, tuple[dict[str, Any], Draw]]:
        # The structure of a tree with a user's classes cannot be pickled, but the tree can.
        return OwnModel.of, (self.parameters.tree, self.draw)

    def full_name(self, argument: str, name: str) -> str:
        return self.parameters.full_name(argument, name)

    @property
    def known(self) -> list[str]:
        return self.parameters.known

    def value(self, name: str) -> Array:
        return self.parameters.value(name)

    def replaced(self, values: Mapping[str, ArrayLike]) -> "OwnModel":
        new_values = {name: jnp.asarray(value, float) for name, value in values.items()}
        return dataclasses.replace(self, parameters=self.parameters.replaced(new_values))

    def label(self, names: list[str]) -> dict[str, tuple[str, str, str]]:
        require_apart("axes and sensitivities", names)
        starts = (name for name in self.parameters.names if name.startswith("start"))
        texts = {name: f"{component} at the start" for name, component in zip(starts, self.names, strict=False)}
        return {name: (short, "1", texts.get(name, "")) for name, short in short_names(names).items()}

    def description(self) -> dict[str, Any]:
        tree = self.parameters.tree
        system, event = tree["system"], tree["event"]
        event = system.event if isinstance(system, Hybrid) else event
        name = None if event is None else name_of(event)
        values = zip(self.parameters.names, self.parameters.values, strict=True)
        return {"system": type(system).__name__, "event": name} | {name: float(value) for name, value in values}

    @property
    def title(self) -> str:
        """The names of the classes of the system."""
        system = self.parameters.tree["system"]
        modes = system.modes if isinstance(system, Hybrid) else (system,)
        return ", ".join(dict.fromkeys(type(mode).__name__ for mode in modes))

    def check(self) -> None:
        if is_traced(self):
            return
        parts = jax.tree.map(np.asarray, _compiled_parts(self))
        left = mechanics.rooms(parts, np)
        system, prefix = self.parameters.tree["system"], ""
        if isinstance(system, Hybrid):
            system, prefix = system.modes[system.first], f"modes[{system.first}]."
        for rule in mechanics.RULES:
            if rule in left and not left[rule] >= 0.0:
                raise ValueError(
                    mechanics.problem_of_start(parts, rule, lambda name: prefix + mechanics.written(system, name))
                )

    def require_values(self, values: dict[str, ArrayLike]) -> None:
        for module, kind in checks_of(self.replaced(values).parameters.tree):
            vars(kind)["__check_init__"](module)

    def check_axes(self, grid: list[Axis], cells: object) -> None:
        tree = self.parameters.tree
        kinds = [kind for _, kind in (*checks_of(tree["system"]), *checks_of(tree["event"]))]
        # If a user's module checks its numbers, every value of an axis must be checked.
        has_checks = any(not kind.__module__.startswith("nonholonomic.") for kind in kinds)
        for axis in grid if has_checks else ():
            for value in axis.values:
                self.require_values({axis.number: value})

    def legal(self) -> Bool[Array, "..."]:
        return _all_left(mechanics.rooms(_parts_of_cells(self), jnp))

    def legal_cells(self, columns: dict[str, Array | np.ndarray]) -> Bool[Array, " cells"]:
        return _all_left(mechanics.rooms(jax.tree.map(np.asarray, _compiled_parts(self.replaced(columns))), np))

    def reduced(self, rows: Float[Array, "rows cells"], mode: object) -> Float[Array, "components cells"]:
        # Runs keep by how much they violate constraints, so that orbits that violate them would be a family with others.
        return jnp.asarray(self.components_of(self.on_constraints(rows)))

    @property
    def reduced_start(self) -> list[Array]:
        pairs = zip(self.parameters.names, self.parameters.values, strict=True)
        return [value for name, value in pairs if name.startswith("start") and value is not None]

    @property
    def counters(self) -> dict[str, str]:
        return {} if self.smooth else {"switches": "resets"}

    def problem(self, cells: int | None, names: Names) -> AbstractProblem:
        # A smooth run starts without an error.
        modes, _, states = self.modes(cells, ROUND_OFF, names, False)
        return modes[self.form.first].problem(states)

    def modes(self, cells: int | None, tolerance: ArrayLike, names: Names, continues: bool) -> Start:
        numbers, start = self._runs(cells)
        shape = () if cells is None else (cells,)
        states = jnp.stack([jnp.broadcast_to(part, shape) for part in start])
        # The errors scale with the largest component of a start, but at most 1.
        magnitude = jnp.max(jnp.abs(jax.lax.stop_gradient(states)), axis=0)
        scales = jnp.broadcast_to(jnp.where(magnitude > 0.0, jnp.minimum(magnitude, 1.0), 1.0), states.shape)
        if self.form.traits.depends_on_time:
            clock = jnp.zeros((1, *shape))
            states, scales = jnp.concatenate([states, clock]), jnp.concatenate([scales, clock + UNMEASURED])
        shared = (numbers, scales, jax.lax.stop_gradient(jnp.asarray(tolerance, float)), self.form)
        modes = tuple(BatchedMode(*shared, mode, continues) for mode in range(self.form.modes))
        return modes, jnp.full(shape, self.form.first), states

    def _runs(self, cells: int | None) -> tuple[tuple[Array, ...], list[Array]]:
        """The numbers of the hybrid system and the components of the starts, with an axis of cells where they differ."""
        values = self.parameters.values
        moving = [k for k, value in enumerate(values) if jnp.ndim(value)]

        def of_one(*numbers: Array) -> tuple[tuple[Array, ...], list[Array]]:
            all_values = list(values)
            for k, number in zip(moving, numbers, strict=True):
                all_values[k] = number
            hybrid, state = assembled(self.parameters.form.tree(all_values))
            return Form.of(hybrid, state.size)[1], list(jnp.unstack(state))

        if not moving:
            return of_one()
        point = [values[k] for k in moving]
        first = [number[0] for number in point]
        single, batch = of_one(*first), jax.vmap(of_one, axis_size=cells)(*point)
        depends = dependent_outputs(of_one, *first)
        leaves = zip(jax.tree.leaves(batch), jax.tree.leaves(single), depends, strict=True)
        return jax.tree.unflatten(jax.tree.structure(single), [a if d else b for a, b, d in leaves])

    def without_event(self) -> "OwnModel":
        """The same model without an event."""
        tree = self.parameters.tree
        system = tree["system"]
        system = dataclasses.replace(system, event=None) if isinstance(system, Hybrid) else system
        return OwnModel.of(tree | {"system": system, "event": None})

    def direction(self, cells: int, number: int = 0) -> Float[Array, "components cells"]:
        states = self.modes(cells, ROUND_OFF, self.comparable, False)[2]
        return jax.jvp(self.on_constraints, (states,), (super().direction(cells, number),))[1]

    def on_constraints(self, states: Float[Array, "rows cells"]) -> Float[Array, "rows cells"]:
        """States of the engine in the first mode, with rates that obey its constraints."""
        form = self.form
        if not form.traits.projected[form.first]:
            return states
        entered, numbers = form.function("entered", form.first), self._runs(states.shape[1])[0]
        axes = tuple(0 if jnp.ndim(number) else None for number in numbers)
        of_one = jax.vmap(lambda numbers, state: entered(numbers, *time_and_state(form, tuple(state))), (axes, 1), 1)
        return jnp.concatenate([of_one(numbers, states), states[form.size :]])

    @property
    def quantities(self) -> dict[str, Quantity]:
        reads = [lambda run, k=k: run.state[..., k] for k in range(len(self.names))]
        quantities = {name: Quantity("1", name, read=read) for name, read in zip(self.names, reads, strict=True)}
        for k, (name, text) in enumerate(BALANCE.items() if self.has_balance else ()):
            quantities[name] = Quantity(
                "1", text, read=lambda run, k=k: _compiled_balance(run.model, run.t, run.state)[k]
            )
        return quantities

    def read(
        self, names: tuple[str, ...], time: Array, rows: Float[Array, "rows *cells"], mode: object
    ) -> dict[str, Array]:
        parts = dict(zip(self.names, self.components_of(rows), strict=True))
        if not BALANCE.keys().isdisjoint(names) and self.has_balance:
            times = jnp.broadcast_to(rows[-1] if self.form.traits.depends_on_time else jnp.nan, rows.shape[1:])
            states = jnp.moveaxis(rows[: self.form.size], 0, -1)
            parts |= dict(zip(BALANCE, _balance_of(self, times, states), strict=True))
        return {name: part for name, part in parts.items() if name in names}

    def components_of(self, rows: Float[Array, "rows *cells"]) -> Float[Array, "components *cells"]:
        """States of the engine in the user's components."""

        def of_one(tree: dict[str, Any], state: Array) -> Array:
            return components_of(assembled(tree)[0].modes[0], state[: self.form.size])

        return jnp.moveaxis(self.over_cells(of_one, rows.ndim - 1, jnp.moveaxis(rows, 0, -1)), -1, 0)

    def over_cells(self, function: Callable[..., PyTree], axes: int, *arguments: Array) -> PyTree:
        """Map a function of the trees of one run and of further arguments over cells. **Arguments:** `axes`: number of axes
        of cells, which are the first axes of the arguments, and of the numbers that differ from cell to cell."""
        values = self.parameters.values

        def mapped(numbers: tuple[Array, ...], *arguments: Array) -> PyTree:
            return function(self.parameters.form.tree(numbers), *arguments)

        for axis in reversed(range(axes)):
            of_numbers = tuple(0 if jnp.ndim(value) > axis else None for value in values)
            mapped = jax.vmap(mapped, (of_numbers, *[0] * len(arguments)))
        return mapped(values, *arguments)

    def ended(self, outcome: Outcome | HybridOutcome, tolerance: object) -> Int[Array, " cells"]:
        return statuses(outcome.status, Status.STOPPED)

    @property
    def ends(self) -> dict[str, Variable]:
        return {name: Variable("1", np.float64, long_name=f"{name} at the end") for name in self.names}

    def at_end(self, outcome: Outcome | HybridOutcome, start: Array) -> dict[str, Array]:
        return dict(zip(self.names, self.components_of(jnp.asarray(outcome.state)), strict=True))


run_of.register(OwnModel, simulate_model)


def state_of(start: Array | dict[str, Array]) -> Array:
    """The state at a start, which may be {"q": coordinates, "rate": rates}."""
    return jnp.concatenate([start["q"], start["rate"]]) if isinstance(start, dict) else start


def assembled(tree: dict[str, Any]) -> tuple[Hybrid, Array]:
    """A system as a `Hybrid` of equations of motion, and the state at its start."""
    system, start, event = tree["system"], tree["start"], tree["event"]
    if isinstance(system, Hybrid):
        # The states of mechanical systems in it are (q, rate).
        modes = tuple(Lagrange(mode) if isinstance(mode, AbstractSystem) else mode for mode in system.modes)
        return dataclasses.replace(system, modes=modes), state_of(start)
    formulation = formulation_of(system, tree["input"])
    return Hybrid([formulation], event), formulation.state(start["q"], start["rate"])


def _balance_of(
    model: OwnModel, times: Float[Array, "*cells"], states: Float[Array, "*cells components"]
) -> tuple[Float[Array, "*cells"], ...]:
    """The quantities of `BALANCE` at some states. **Arguments:** `model`: with numbers that have the first axes of the times,
    or none."""

    def of_one(tree: dict[str, Any], t: Array, state: Array) -> tuple[Array, ...]:
        return mechanics.energy_balance(tree["system"], tree["input"], t, *jnp.split(state, 2))

    return model.over_cells(of_one, times.ndim, times, states)


_compiled_balance = eqx.filter_jit(_balance_of)


def _all_left(left: mechanics.Parts) -> Any:
    """Whether no rule of a start is broken."""
    return functools.reduce(operator.and_, (room >= 0.0 for room in left.values()))


def _parts_of_cells(model: OwnModel) -> mechanics.Parts:
    """What the rules compare: the start, the functions of a mechanical first mode, and the least of its margins; for all
    cells."""

    def of_one(tree: dict[str, Any]) -> mechanics.Parts:
        system = tree["system"]
        first = system.modes[system.first] if isinstance(system, Hybrid) else system
        y = state_of(tree["start"])
        arguments = jnp.split(y, 2) if isinstance(first, AbstractSystem) else [y]
        parts = parts_of_system(first, *arguments) if isinstance(first, AbstractSystem) else {}
        margins = jax.tree.leaves(first.margin(jnp.zeros((), y.dtype), *arguments))
        least = {"margin": functools.reduce(jnp.minimum, map(jnp.min, margins))} if margins else {}
        if isinstance(system, Hybrid):
            parts.pop("frame", None)  # Modes of a `Hybrid` use Lagrange multipliers.
        return {"y": y} | parts | least

    return jax.lax.stop_gradient(model).over_cells(of_one, max(map(jnp.ndim, model.parameters.values)))


_compiled_parts = eqx.filter_jit(_parts_of_cells)


@model_of.register(AbstractSystem)
@model_of.register(Hybrid)
def _(
    system: Hybrid | AbstractSystem, start: Any, event: Event | None = None, input: object = None, jumps: object = None
) -> OwnModel:
    if input is not None and not (isinstance(system, AbstractSystem) and mechanics.is_own(system, "input")):
        raise ValueError(
            f"input = {shown(input)} must be None for a Hybrid or a system without ports: write input(self, q) of an "
            "AbstractSystem, whose columns are the forces of a unit of each input; or write the input into force(t, q, rate), "
            "or into field(t, y) of a mode"
        )
    if jumps is not None:
        raise ValueError(
            f"jumps = {shown(jumps)} must be None for your own system: compare t itself with numbers in its functions, such as "
            "t > self.switch, and the times are found"
        )
    check_start(system, start)
    # With a mechanical system among the modes, a state is (q, rate).
    modes = system.modes if isinstance(system, Hybrid) else (system,)
    is_mechanical = any(isinstance(mode, AbstractSystem) for mode in modes)
    has_pair = is_mechanical and is_pair(start)
    numbers: Array | dict[str, Array] = (
        dict(zip(("q", "rate"), map(as_number, start), strict=True)) if has_pair else as_number(start)
    )
    if event is None and isinstance(system, Hybrid):
        event = system.event
    if event is not None:
        require_event(event)
        state = state_of(numbers)
        with named_errors("event(t, y)", arguments_in_words(state.size)):
            event = with_own_numbers(event, jnp.zeros(()), state)
        if isinstance(system, Hybrid):
            system, event = dataclasses.replace(system, event=event), None
    if input is not None and isinstance(system, AbstractSystem):
        input = checked_input(input, system)
    return OwnModel.of({"system": system, "start": numbers, "event": event, "input": input})


def checked_input(input: Any, system: AbstractSystem) -> Any:
    """An input with its own numbers; raises `ValueError` unless it is a function that returns a number for each port."""
    q = jnp.zeros(system.dimension)
    ports = jax.eval_shape(system.input, q).shape[1:]
    wanted = f"a function u(t, q, rate) that returns {counted(ports[0], 'number')}, one for each column of input(q)"
    if not callable(input):
        raise ValueError(f"input = {shown(input)} must be {wanted}, or None")
    arguments = (jnp.zeros(()), q, q)
    with named_errors("u(t, q, rate)", f"the time t, and the coordinates and rates, arrays of shape {q.shape}"):
        input = with_own_numbers(input, *arguments)
        shape = jax.eval_shape(lambda *parts: jnp.atleast_1d(jnp.asarray(input(*parts), float)), *arguments).shape
    if shape != ports:
        raise ValueError(f"input = {shown(input)} must be {wanted}, not an array of shape {shape}")
    return input


#: Names of other columns of tables, and of the attributes of a run.
TAKEN = {"time", "grazes", *dir(Trajectory), *(field.name for field in dataclasses.fields(Trajectory))}


def names_of(system: Hybrid | AbstractSystem, size: int, has_balance: bool) -> tuple[str, ...]:
    """The names of the components of a state: those of the system or of its first mode that has some, or `y0` and so on, or
    `q0` and `rate0` and so on for a mechanical system.

    **Raises:** `ValueError` for a wrong number of names, names that are not different words, and names of other columns
    and of attributes of a run.
    """
    modes = system.modes if isinstance(system, Hybrid) else (system,)
    mechanical = next((mode for mode in modes if isinstance(mode, AbstractSystem)), None)
    owner = next((mode for mode in modes if mode.names is not None), mechanical)
    if owner is None:
        return tuple(f"y{k}" for k in range(size))
    has_rates = isinstance(owner, AbstractSystem)
    size = owner.dimension if has_rates else size
    if (names := owner.names) is None:
        return tuple(f"{name}{k}" for name in ("q", "rate") for k in range(size))
    words, taken = (), TAKEN.union(BALANCE if has_balance else ())
    if isinstance(names, tuple | list) and all(isinstance(name, str) and name.isidentifier() for name in names):
        words = (*names, *(f"{name}_rate" for name in names if has_rates))
        if len(names) == size and len(set(words)) == len(words) and taken.isdisjoint(words):
            return words
    kind = "coordinate" if has_rates else "component of the state"
    raise ValueError(
        f"{type(owner).__name__}.names = {shown(names)} must be {size} different words, one for each {kind}, and none that "
        f"names anything else in a run or a table, such as {', '.join(sorted(taken.intersection(words))) or 'time'}"
    )


# The page of a user's own system: the equations for the browser, and the point that shows the state.

#: Number of parameters with a slider by default, and rotations of the drawn point per run, which set the number of frames.
DEFAULT_SLIDERS, TURNS = 3, 40.0


@page_of.register(OwnModel)
def page_of_system(model: OwnModel, ranges: dict[str, Any] | None, t1: float) -> tuple[LiveRun, Stage]:
    """The page of a model: its run, and the plane on which it is drawn. By default, the first parameters that are not zero
    have sliders, from half to twice their values, and then components of the start, if the ends of their sliders allow runs."""
    if ranges is None:
        values = {name: float(model.value(name)) for name in model.known if "[*]" not in name}
        ends = {name: tuple(sorted((0.5 * value, 2.0 * value))) for name, value in values.items() if value}
        ends |= {name: (-1.0, 1.0) for name in values if name.startswith("start") and name not in ends}
        names = sorted(ends, key=lambda name: name.startswith("start"))
        legal = (name for name in names if all(np.all(model.replaced({name: end}).legal()) for end in ends[name]))
        ranges = {name: ends[name] for name in [*itertools.islice(legal, DEFAULT_SLIDERS)] or names[:DEFAULT_SLIDERS]}
    sliders = sliders_of(model, ranges)
    names, (draw, stage) = model.names, drawn_stage(runs_at_ends(model, sliders, t1), [0], [""])

    def first_component(model: OwnModel, ended: HybridOutcome, status: Array) -> Array:
        failed = (status == int(Status.FAILED)) | (status == int(Status.UNRESOLVED))
        return jnp.where(failed, jnp.inf, model.components_of(ended.state[:, 0])[0])

    def frame(model: OwnModel, time: Array, rows: Array, mode: object) -> Frame:
        components = model.components_of(rows[:, 0])
        rate = jnp.asarray(2.0 * np.pi * TURNS / t1) + 0.0 * components[0]
        # The time has an axis of one run.
        return frame_of(draw, model.parameters.tree["system"], jnp.reshape(time, ()), components, rate)[-1]

    live = live_run(
        model,
        model.without_event(),
        sliders,
        t1,
        frame,
        title=model.title,
        answer=("time of the event", "s") if model.has_event else (f"{names[0]} at the end", ""),
        summaries=tuple(range(len(names[:2]))),
        result=None if model.has_event else first_component,
    )
    return live, stage
