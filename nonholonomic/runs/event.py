"""A user's event as part of the motion, and the times at which it happens in many runs.

The function is written for one run and mapped over lanes. Its own numbers are leaves, so that they can be swept and
differentiated. If the function depends on time, a clock is added to the state.
"""

import dataclasses
import functools
from collections.abc import Callable, Collection, Sequence
from typing import Any, ClassVar, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from ..compilation.components import over_lanes
from ..compilation.tracing import dependent_outputs, is_elementary, with_own_numbers
from ..derivatives import AbstractDifferentiableSolve, differentiable_solve, solve_ensemble_with_tangents, tangents_by
from ..hybrid.ensemble import AbstractBatchedMode, Count, HybridOutcome, Transition, solve_hybrid
from ..hybrid.saltation import UNMEASURED, Clock, solve_hybrid_with_tangents
from ..integration import AbstractProblem, ExtendedProblem, Lanes, Outcome, Settings, States, solve_ensemble
from ..integration.problem import CROSSED, REACHED_END, RUNNING, Status, legal_run
from ..kernels import by_kernel, solve_in_modes, solve_smooth, solve_smooth_with_tangents
from ..parameters import Parameters
from ..terminal import status_line
from ..text import described, gathered, likely, shown
from ..validation import UNTRACEABLE, as_number, explaining, is_traced, nan_unless, warn
from .model import AbstractModel, Names, Number, Start, check_run, model_of, require_event, settings_for_lanes

#: A user's event, a function of time and motion or of time and state; or `None` for that of the system itself.
Event: TypeAlias = Callable[..., Array] | None


class Motion:
    """The quantities of one state as attributes, computed when they are read: `motion.speed`."""

    def __init__(self, read: Callable[[str], Array], names: Collection[str]):
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
    def function(self) -> Callable[..., Array]:
        """The user's function, with its present numbers."""
        return self.parameters.tree["event"].event


def rows_of(model: AbstractModel, names: Names) -> jax.ShapeDtypeStruct:
    """The type of the rows of one state, as `AbstractModel.read` receives them."""

    def start() -> Array:
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
    depends_on_time = any(dependent_outputs(function, *example, on_first_alone=True))
    model = dataclasses.replace(model, event=EventFunction(parameters, names, depends_on_time, False))
    leaves, structure = jax.tree.flatten(model)
    rows = rows_of(model, names)
    types = (t, rows, *(jax.ShapeDtypeStruct((), jnp.asarray(leaf).dtype) for leaf in leaves))

    def of_leaves(t: Array, rows: Array, *leaves: Array) -> Float[Array, ""]:
        moved = jax.tree.unflatten(structure, leaves)
        return moved.event(t, moved.read(names, t, rows, index))

    elementary = model.smooth and is_elementary(of_leaves, *types)
    return dataclasses.replace(model, event=dataclasses.replace(model.event, elementary=elementary))


def with_clock(problem: AbstractProblem) -> ExtendedProblem:
    """A problem whose state ends with the time."""
    clock = jnp.zeros_like(problem.start()[0][:1])
    return ExtendedProblem(problem, Clock(), clock, clock + UNMEASURED)


class EventProblem(ExtendedProblem):
    """A problem with a user's event in place of its own. The state ends with the time if the event depends on it.

    - `model`: the model with the event; `mode`, `index`: the mode of the problem and its index, or `None`.
    """

    model: AbstractModel = eqx.field(kw_only=True)
    mode: AbstractBatchedMode | None = eqx.field(kw_only=True, default=None)
    index: int | None = eqx.field(kw_only=True, static=True, default=None)

    direction_decides: ClassVar[bool] = True
    leading: ClassVar[None] = None

    @classmethod
    def of(cls, problem: AbstractProblem, clock: Float[Array, "clocks *cells"], **parts: Any) -> "EventProblem":
        """The problem. **Arguments:** `clock`: the time [s] at the start, (1, cells), if the event depends on time; otherwise
        (0, cells); `parts`: the other fields."""
        return cls(problem, Clock(), clock, jnp.full_like(clock, UNMEASURED), **parts)

    @property
    def fits_one_kernel(self) -> bool:
        return self.problem.fits_one_kernel and self.model.event.elementary

    @property
    def fast(self) -> tuple[bool, bool]:
        return self.problem.fast[0], True

    def event_function(self, state: States) -> Lanes:
        return value_in_lanes(self.model, self.mode, self.index, state)


def value_in_lanes(model: AbstractModel, mode: AbstractBatchedMode | None, index: int | None, state: States) -> Lanes:
    """The event function of states, which end with the time if the function depends on it."""
    event: Any = model.event
    rows, time = (state[:-1], state[-1]) if event.depends_on_time else (state, jnp.full_like(state[0], jnp.nan))
    rows = jnp.stack(tuple(rows))
    if mode is not None:
        rows = mode.shown(rows) if rows.ndim == 2 else mode.shown(rows[:, None])[:, 0]
    values = model.read(event.names, time, rows, index)
    leaves, structure = jax.tree.flatten(event)
    # Every component of every value, an array over lanes.
    shapes = [value.shape[time.ndim :] for value in values.values()]
    parts = [
        value[(..., *component)]
        for value, shape in zip(values.values(), shapes, strict=True)
        for component in np.ndindex(shape)
    ]

    def of_run(leaves: Sequence[Array], parts: tuple[Array, ...]) -> Float[Array, ""]:
        time, *components = parts
        of_one_run = dict(zip(values, gathered(components, shapes), strict=True))
        return jax.tree.unflatten(structure, leaves)(time, of_one_run)

    return over_lanes(of_run, tuple(leaves), (time, *parts))


#: A function counts as zero if changing every component of the state by this fraction of its size could make it zero:
#: round-off.
ROUND_OFF = 1e-14


def near_zero(problem: AbstractProblem, time: Lanes, state: States) -> tuple[Lanes, Lanes, Lanes]:
    """The event function of runs that have spent some time [s] in a mode, its slope along the motion, and its round-off."""
    event, scales = problem.event_function, problem.start()[1]
    value, slope = jax.jvp(event, (state,), (problem.field(time, state),))
    sizes = jnp.abs(state) + jnp.where(scales < UNMEASURED, scales, 0.0)
    directions = jnp.eye(len(state)).reshape(*2 * state.shape[:1], *[1] * (state.ndim - 1)) * sizes
    changes = jax.vmap(lambda direction: jax.jvp(event, (state,), (direction,))[1])(directions)
    return value, slope, ROUND_OFF * jnp.sum(jnp.abs(changes), axis=0)


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
        return EventProblem.of(mode.problem(core), clock, model=self.model, mode=mode, index=self.index)

    def reset_map(self, state: Float[Array, "components cells"], left: Float[Array, " cells"]) -> Transition:
        core, clock = self._parts(state)
        transition = self.modes[self.index].reset_map(core, left)
        new_state = jnp.concatenate([transition.state, clock + transition.elapsed])
        before, slope, error = near_zero(self.problem(state), jnp.zeros_like(state[0]), state)
        values = [value_in_lanes(self.model, mode, number, new_state) for number, mode in enumerate(self.modes)]
        after = jnp.select([transition.mode == number for number in range(len(values))], values, before)
        # Where the function is zero up to round-off, the direction of the motion decides.
        falls = jnp.where(jnp.abs(before) <= error, slope < 0.0, before > 0.0)
        jumps = falls & (after <= 0.0) & (transition.status == RUNNING)
        # A run that ends between two modes is in neither.
        return transition._replace(
            mode=jnp.where(jumps & (not self.continues), len(self.modes), transition.mode),
            state=new_state,
            status=jnp.where(jumps & (not self.continues), CROSSED, transition.status),
            crossing_time=jnp.where(jumps, transition.elapsed, jnp.inf),
        )

    def shown(self, state: Float[Array, "components times"]) -> Float[Array, "shown times"]:
        return self.modes[self.index].shown(self._parts(state)[0])

    def between(self, motion: PyTree, passed: Float[Array, " times"]) -> Float[Array, "shown times"]:
        return self.modes[self.index].between(motion, passed)

    def _parts(self, state: Array) -> tuple[Array, Array]:
        """The state of the mode, and the clock if there is one."""
        return (state[:-1], state[-1:]) if self.model.event.depends_on_time else (state, state[:0])


def problem_of(model: AbstractModel, cells: int | None, names: Names) -> AbstractProblem:
    """The motion of a smooth model with its event."""
    if model.event is None:
        return model.problem(cells, names)
    problem = model.problem(cells, None if names is None else (*dict.fromkeys((*names, *model.event.names)),))
    clock = jnp.zeros((int(model.event.depends_on_time), *problem.start()[0].shape[1:]))
    return EventProblem.of(problem, clock, model=model)


def modes_of(model: AbstractModel, cells: int, tolerance: Number, names: Names, continues: bool = False) -> Start:
    """The modes of a model with its event, and the start in them."""
    if model.event is None:
        return model.modes(cells, tolerance, names, continues)
    names = None if names is None else (*dict.fromkeys((*names, *model.event.names)),)
    modes, first, states = model.modes(cells, tolerance, names, continues)
    clock = jnp.zeros((int(model.event.depends_on_time), states.shape[1]))
    with_events = tuple(EventMode(modes, model, index, continues) for index in range(len(modes)))
    return with_events, first, jnp.concatenate([states, clock])


# Many runs of a model at once: how they end, and the derivatives of the times of their events.
#
# Smooth runs are one ensemble; other runs go through the modes of the model. Functions for tables get concrete numbers,
# and run their loops on the host; functions inside transformations get traced numbers.

#: The statuses of runs without a result.
SILENT = (Status.FAILED, Status.UNRESOLVED)


class Ensemble(eqx.Module):
    """The runs of many cells of a model.

    - `problem`: the motion of smooth runs; `None` for other runs.
    - `start`: the modes, the index of each cell's first mode, and the initial states; `None` for smooth runs.
    - `counters`: number of counters; `continues`: whether a run continues through its event.
    """

    problem: AbstractProblem | None
    # A `Start`, or `None`.
    start: Any
    counters: int = eqx.field(static=True)
    continues: bool = eqx.field(static=True)

    @classmethod
    def of(cls, model: AbstractModel, cells: int, tolerance: Number, continues: bool) -> "Ensemble":
        """The runs of some cells of a model, whose numbers are scalars or arrays with one number per cell."""
        if model.smooth:
            return cls(problem_of(model, cells, ()), None, 0, continues)
        return cls(None, modes_of(model, cells, tolerance, (), continues), len(model.counters), continues)

    def nudged(self, share: float) -> "Ensemble":
        """The runs with resets from initial states whose components are larger by a share; smooth runs stay as they are."""
        if self.start is None:
            return self
        *modes, states = self.start
        return dataclasses.replace(self, start=(*modes, states * (1.0 + share)))

    def solve(self, t1: Number, cells: Count, settings: Settings, traced: bool = False) -> Outcome | HybridOutcome:
        """The outcome of the runs.

        **Arguments:** `t1`: horizon [s]; `cells`: number of cells to run, the rest is padding; `traced`: whether numbers
        may be traced.
        """
        device, options = "cpu" if traced else settings.device, {"nonterminal": self.continues}
        if self.problem is not None:
            arguments = (self.problem, jnp.asarray(t1), jnp.asarray(cells), settings)
            outcome = by_kernel(lambda gpu: solve_smooth(*arguments, **options, run=gpu), device, cells)
            solve = functools.partial(solve_ensemble, *arguments, one_kernel=True, traced=traced)
            return solve(**options)[0] if outcome is None else outcome
        solve = functools.partial(solve_hybrid, *self.start, t1, cells, settings, counters=self.counters, **options)
        by_gpu = functools.partial(solve_in_modes, *solve.args, **solve.keywords)
        outcome = by_kernel(lambda gpu: by_gpu(run=gpu), device, cells)
        return solve(traced=traced) if outcome is None else outcome

    def solve_with_tangents(
        self,
        tangents: Sequence["Ensemble"],
        t1: Number,
        cells: Count,
        settings: Settings,
        traced: bool = False,
        one_kernel: bool = True,
    ) -> tuple[Any, Any, Any]:
        """The outcome of the runs, and the derivatives of the times of their events.

        **Arguments:** `tangents`: tangents of the ensemble; `one_kernel`: false for programs that are differentiated
        again; the others as for `solve`.

        **Returns:** the outcome; for each tangent the derivative in every cell, 0 if there is no event or the event is
        at the start; and a mask of the cells whose derivative is NaN because an earlier event was grazing.
        """
        device = "cpu" if traced else settings.device
        if self.problem is not None:
            options = {"nonterminal": self.continues}
            along = tuple(tangent.problem for tangent in tangents)
            arguments = (self.problem, along, jnp.asarray(t1), jnp.asarray(cells), settings)
            solved = by_kernel(lambda gpu: solve_smooth_with_tangents(*arguments, **options, run=gpu), device, cells)
            if solved is None:
                solved = solve_ensemble_with_tangents(*arguments, **options, one_kernel=one_kernel, traced=traced)
            return solved[0], solved[1], False
        outcome, xp = None, jnp if traced else np
        if self.continues:
            # The derivatives need the run only up to the event, whose time is known.
            outcome = self.solve(t1, cells, settings, traced)
            t1 = xp.where(xp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0)
        modes, first, states = self.start
        pairs = tuple((tangent.start[0], tangent.start[2]) for tangent in tangents)
        options = {"counters": self.counters, "ends_on_event": not self.continues, "traced": traced}
        solve = functools.partial(
            solve_hybrid_with_tangents, modes, pairs, first, states, t1, cells, settings, **options
        )
        solved = by_kernel(lambda gpu: solve(solve=functools.partial(solve_in_modes, run=gpu)), device, cells)
        run, sensitivities = solve() if solved is None else solved
        return run if outcome is None else outcome, sensitivities.slopes, sensitivities.grazing

    @property
    def starts(self) -> Float[Array, "components cells"]:
        """The initial states."""
        return self.problem.start()[0] if self.problem is not None else jnp.asarray(self.start[2])


def counted(model: AbstractModel, outcome: Outcome | HybridOutcome) -> dict[str, Any]:
    """When runs have ended, and the numbers of their steps and of what their model counts, by the names in a table."""
    counts = dict(zip(model.counters, outcome.counts, strict=True)) if isinstance(outcome, HybridOutcome) else {}
    return {"end_time": outcome.end_time, "steps": outcome.steps, "rejected": outcome.rejected} | counts


def status_of(model: AbstractModel, ensemble: Ensemble, outcome: Any, tolerance: Number) -> Any:
    """How each run has ended, as an integer of `Status`: `EVENT` for the runs whose event counts, because the run ended on
    the event or, if runs continue, ends beyond the event."""
    status, has_event = model.ended(outcome, tolerance), outcome.status == CROSSED
    if ensemble.continues:
        state = jnp.asarray(outcome.state)
        if ensemble.problem is not None:
            value: Any = ensemble.problem.event_function(state)
        else:
            value = jnp.ones(state.shape[1])
            for number, mode in enumerate(ensemble.start[0]):
                beyond: Any = mode.problem(state).event_function(state)
                value = jnp.where(outcome.mode == number, beyond, value)
        has_event = (outcome.status == REACHED_END) & (value <= 0.0) & jnp.isfinite(outcome.crossing_time)
    is_sound = (status == int(Status.EVENT)) | (status == int(Status.COMPLETED))
    return jnp.where(is_sound & has_event, int(Status.EVENT), status)


# The time of an event of any model, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions.


@explaining
@status_line("simulating")
def event_time(
    system: object,
    start: object,
    t1: Float[ArrayLike, ""],
    event: Event = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    *,
    crossing: str = "first",
    input: object = None,
    jumps: object = None,
) -> Float[Array, ""]:
    """Time of the event of a run; works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and their compositions.

    The event is the first time after the start at which a function falls through zero, along the motion or by a reset.
    For a run that starts at or below zero, the event is the next time at which the function falls through zero: a function
    that stays zero has no event. Under `vmap`, all runs are lanes of one batch.

    Derivatives with respect to the start and every parameter of the system and of the event are exact: they use the
    implicit function theorem at the event and the saltation matrix at every reset (`nonholonomic/hybrid/saltation.py`).
    Derivatives are 0 if the time is infinite. Without resets, there are second derivatives, by `jax.hessian` (forward
    over reverse mode).

    **Arguments:**

    - `system`, `start`: a `tippe.Scene` or a `stroller.Scene` with its `Launch`; or your own system, a `Hybrid` with
      its state at time 0, (components,), or an `AbstractSystem` with its coordinates and their rates, (q, rate).
    - `t1`: horizon [s], positive.
    - `event`: for a scene a function `event(t, motion)` of time [s] and motion, whose attributes are the quantities of a
      trajectory, such as `motion.theta`, `motion.speed` or `motion.normal_force`; for your own system a function
      `event(t, y)`, where y is the state of a trajectory. By default the event of the system itself: that of the
      `Hybrid`, the inversion of a top, or the loss of contact of a stroller.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2]. The absolute tolerance is a tenth of it, in
      units of the magnitudes of the system.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default `nonholonomic.integration.Oscillatory8()`.
    - `crossing`: "first", or "last" for the last fall through zero after which the function stays below zero until `t1`.
    - `input`: the input of a stroller; or, for an `AbstractSystem` with ports, a function u(t, q, rate) that returns a number
      for each of them. `jumps`: times [s] at which the input of a stroller jumps, as for `stroller.simulate`.

    **Returns:** the time [s]; infinite if there is no event by `t1` or if the run ends before the event; NaN if the
    integration failed or if resets follow one another without end (more than 2000), with a warning that says so, or if
    numbers inside a transformation are out of range. If the margin of a mode only touches zero, so that the mode may or
    may not end within the tolerance, derivatives are NaN.

    **Raises:** `ValueError` for arguments out of range, functions that return a wrong type or shape, and second
    derivatives through resets.

    **Example:** the fifth bounce of a ball.

    ```
    >>> import jax
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     restitution: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -9.81, 0.0])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -self.restitution * y[1], y[2] + 1.0]), 0
    >>> def fifth(restitution):
    ...     ball = nonholonomic.Hybrid([Ball(restitution)])
    ...     start = jnp.array([1.0, 0.0, 0.0])
    ...     return nonholonomic.event_time(ball, start, t1=9.0, event=lambda t, y: 4.5 - y[2])
    >>> time, slope = jax.value_and_grad(fifth)(0.8)
    >>> print(f"{time:.6f} s, {slope:.6f} s")
    2.584160 s, 5.931215 s

    ```
    """
    if crossing not in ("first", "last"):
        raise ValueError(f"crossing = {shown(crossing)} must be 'first' or 'last'")
    model = model_of(system, start, event, input, jumps)
    check_run(model, t1, tolerance)
    require_event(model)
    settings = settings_for_lanes(tolerance, solver)
    time = _compiled(model, as_number(t1), settings, crossing == "last", is_traced((model, t1, tolerance)))
    if not is_traced(time) and np.ndim(time) == 0 and np.isnan(time):
        # Repeat the run to find how it ended.
        ensemble = Ensemble.of(model, 1, settings.tolerance, crossing == "last")
        outcome = ensemble.solve(float(np.asarray(t1)), 1, settings)
        word = Status(int(np.ravel(status_of(model, ensemble, outcome, settings.tolerance))[0])).word
        end = np.ravel(outcome.end_time)[0]
        warn(
            f"the time of the event is NaN: the run ended as {word!r} at {end:.6g} s; nonholonomic.simulate returns the run "
            "up to there, and states the reason"
        )
    return time


def time_of_event(
    model: AbstractModel, t1: Number, settings: Settings, last: bool, unchecked: bool | None = None
) -> Float[Array, ""]:
    """The time of the event of a model.

    **Arguments:** as for `event_time`, checked; `last`: whether the last crossing counts; `unchecked`: whether nothing has
    checked the numbers, by default if some are traced.
    """
    return differentiable_solve(*EventTime.of(model, t1, settings, last, unchecked))


# Compile the whole, so that further calls with the same functions need no tracing.
_compiled = eqx.filter_jit(time_of_event)


class EventTime(AbstractDifferentiableSolve):
    """Times of the events of cells. The leaves are the numbers of the model that are floats, the horizon, the other numbers of
    the model, and the tolerance.

    - `movable`: number of floats of the model; `structures`, `rest`: the model without its numbers; `settings`: without the
      tolerance.
    - `last`: whether the last crossing counts; `unchecked`: whether numbers were traced, so that nothing checked them.
    """

    movable: int
    # JAX's PyTreeDefs, which type checkers take for variables.
    structures: tuple[Any, Any] = eqx.field(static=True)
    rest: PyTree
    settings: Settings
    last: bool = eqx.field(static=True)
    unchecked: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls, model: AbstractModel, t1: Number, settings: Settings, last: bool, unchecked: bool | None = None
    ) -> tuple[Any, ...]:
        """The solve and its leaves. **Arguments:** as for `time_of_event`."""
        unchecked = is_traced((model, t1, settings.tolerance)) if unchecked is None else unchecked
        floats, rest = eqx.partition(model, eqx.is_inexact_array)
        others, rest = eqx.partition(rest, eqx.is_array)
        numbers, further = (jax.tree.flatten(part) for part in (floats, others))
        structures = (numbers[1], further[1])
        solve = cls(len(numbers[0]), structures, rest, settings.with_tolerance(None), last, unchecked)
        return (solve, *numbers[0], as_number(t1), *further[0], settings.tolerance)

    @property
    def horizon(self) -> int:
        """The place of the horizon among the leaves."""
        return self.structures[0].num_leaves

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        return self.value_and_tangents((), False, cells, *leaves)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        is_legal, t1, settings = self.permitted(leaves)
        model, slopes = self.model(leaves), []
        if not active:
            ensemble = Ensemble.of(model, cells, settings.tolerance, self.last)
            outcome = ensemble.solve(t1, cells, settings, traced=True)
        else:
            model.require_differentiable(nested, self.last)

            def build(floats: tuple[Array, ...], cells: int | None) -> Ensemble:
                assert cells is not None
                return Ensemble.of(self.model((*floats, *leaves[self.movable :])), cells, settings.tolerance, self.last)

            # Cells are independent, so varying a parameter in all of them at once gives each its own derivative.
            ensemble, tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)
            options = {"traced": True, "one_kernel": not nested}
            outcome, along, _ = ensemble.solve_with_tangents(tangents, t1, cells, settings, **options)
            slopes = gather([*along])
        # Infinite and 0 where there is no event, NaN where the run failed.
        status = status_of(model, ensemble, outcome, settings.tolerance)
        is_good = is_legal & (status != int(SILENT[0])) & (status != int(SILENT[1]))
        has_event = status == int(Status.EVENT)
        time = jnp.where(has_event, outcome.crossing_time, jnp.inf)
        return nan_unless(is_good, (time, [jnp.where(has_event, slope, 0.0) for slope in slopes]))

    def model(self, leaves: Sequence[Array]) -> AbstractModel:
        """The model of the leaves."""
        parts = zip(self.structures, (leaves[: self.horizon], leaves[self.horizon + 1 : -1]), strict=True)
        return eqx.combine(*(jax.tree.unflatten(structure, part) for structure, part in parts), self.rest)

    def permitted(self, leaves: Sequence[Array]) -> tuple[Bool[Array, "..."], Float[Array, "..."], Settings]:
        """A mask of the cells with legal numbers; the horizons, 0 for all other cells; and the settings.

        A batch has one tolerance: the smallest.
        """
        is_legal, t1, tolerance = jnp.asarray(True), leaves[self.horizon], leaves[-1]
        if self.unchecked:
            is_legal, t1, tolerance = legal_run(self.model(leaves).legal(), t1, tolerance)
        return is_legal, t1, self.settings.with_tolerance(jnp.min(tolerance))
