"""The interface between a model and the questions about its runs."""

import abc
import dataclasses
import functools
from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Self, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..hybrid.ensemble import AbstractBatchedMode, HybridOutcome, OnlyMode
from ..integration import AbstractProblem, Outcome, Settings, explicit_tableau
from ..integration.problem import CROSSED, DEFAULT_MAX_STEPS, FAILED, LEFT_DOMAIN, UNRESOLVED, Status, run_bounds
from ..parameters import Parameters, full_name, numbers, numbers_of, with_numbers
from ..sweeps import Axis, Quantity, Variable
from ..text import likely_fix, shown
from ..validation import ArrayOrList, require_all

#: A single number, or one for each cell.
Number: TypeAlias = Array | np.ndarray | float

#: The values of parameters: full name -> a number, or one for each cell.
Columns: TypeAlias = Mapping[str, ArrayLike]

#: The ranges of sliders: name of a parameter -> (lowest, highest) value.
Sliders: TypeAlias = dict[str, tuple[float, float]]

#: The names of the quantities that will be read, which choose the layout of the state; `None` for all quantities, with
#: the path of the run.
Names = tuple[str, ...] | None

#: The modes of a run, the index of the first mode of each cell, and the initial states.
Start = tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"], Float[Array, "components cells"]]


class AbstractModel(eqx.Module):
    """A system, its start, its input and its event. A model knows its modes and quantities, and no solver, table, file or
    page.

    The leaves are numbers: scalars, or arrays with one number per cell. States have the shape (components, cells). A subclass
    defines the attributes that have no value here, for the class or as properties.
    """

    #: A `runs.event.EventFunction`, or `None` for the event of the model itself.
    event: eqx.AbstractVar[Any]

    #: Names of the components of vectors, by dimension, such as {"component": ("x", "y", "z")}.
    components: ClassVar[dict[str, tuple[str, ...]]] = {}

    #: Whether a run continues through the event of the model itself.
    continues: ClassVar[bool] = False

    #: The names that choose a layout in which states of nearby runs can be compared.
    comparable: ClassVar[Names] = ()

    # The parameters by name.

    #: The full names of the parameters; those of the start begin with "start" or "launch".
    known: ClassVar[list[str]]

    @abc.abstractmethod
    def full_name(self, argument: str, name: str) -> str:
        """The full name of a parameter for its name or its unambiguous end; raises `ValueError` that names the
        argument."""

    @abc.abstractmethod
    def value(self, name: str) -> Array:
        """The value of a parameter by its full name."""

    @abc.abstractmethod
    def replaced(self, values: Columns) -> Self:
        """The model with other values, scalars or one per cell, of some parameters; the modules check concrete values."""

    @abc.abstractmethod
    def label(self, names: list[str]) -> dict[str, tuple[str, str, str]]:
        """For each full name the name of an axis, its unit, and a description."""

    @abc.abstractmethod
    def description(self) -> dict[str, object]:
        """The model as plain data, for the request of a table."""

    # Whether a run may begin.

    @abc.abstractmethod
    def check(self) -> None:
        """Raise `ValueError` unless the concrete numbers allow a run."""

    def require_values(self, values: Columns) -> None:
        """Raise `ValueError` unless the modules allow these values of parameters."""
        self.replaced(values)

    def check_axes(self, grid: list[Axis], cells: Iterable[Columns]) -> None:
        """Raise `ValueError` unless the model may run for the cells of a grid; `cells`: columns of their parameters."""
        for columns in cells:
            self.replaced(columns).check()

    @abc.abstractmethod
    def legal(self) -> Bool[Array, "..."]:
        """Whether the numbers, which may be traced, allow a run."""

    def legal_cells(self, columns: Columns) -> Bool[np.ndarray, "*cells"] | None:
        """Whether each cell of a table is legal, `None` if `check_axes` has raised an error for those that are not."""
        return None

    # The motion.

    #: Whether a run is a single mode without a reset map, and whether there is an event.
    smooth: ClassVar[bool]
    has_event: ClassVar[bool]

    #: Further variables of a table that are times: name -> (description, the model with its event).
    further_times: ClassVar[dict[str, tuple[str, "AbstractModel"]]] = {}

    #: Name and description of each row of `Transition.counts`.
    counters: ClassVar[dict[str, str]] = {}

    #: The slopes that guide a fit: "exact", or "differences" if derivatives do not show the trend of times.
    fit_slopes: ClassVar[str] = "exact"

    #: Whether programs take much longer to compile than to run, above all those with derivatives.
    compiles_slowly: ClassVar[bool] = False

    def require_differentiable(self, nested: bool, continues: bool = False) -> None:
        """Raise `ValueError` unless runs have derivatives; `nested`: second derivatives; `continues`: whether runs
        continue through the event."""
        if nested and not self.smooth:
            raise ValueError("second derivatives do not exist through resets; take differences of a gradient instead")

    def for_lanes(self) -> tuple["AbstractModel", bool]:
        """The model in a form that is fastest where runs in transformations share lanes, and whether arrays among its leaves
        have the lanes in their last axis."""
        return self, False

    @abc.abstractmethod
    def problem(self, cells: int | None, names: Names) -> AbstractProblem:
        """The motion of a smooth model, with the event of the model itself unless it has another."""

    def modes(self, cells: int, tolerance: Number, names: Names, continues: bool) -> Start:
        """The modes of a model, and the start in them; `continues`: whether a run continues through its event. A smooth
        model has one mode."""
        motion = self.problem(cells, names)
        return (OnlyMode(motion),), jnp.zeros(cells, int), motion.start()[0]

    @abc.abstractmethod
    def without_event(self) -> "AbstractModel":
        """The same model without an event that ends a run."""

    def direction(self, cells: int, number: int = 0) -> Float[Array, "components cells"]:
        """A generic change of the initial states, tangent to the set of possible states: that when the parameters of the
        start move in a generic direction, another one for each `number`."""
        names = [name for name in self.known if name.startswith(("start", "launch"))]

        def states(*moving: Array) -> Array:
            moved = self.replaced(dict(zip(names, moving, strict=True)))
            return moved.modes(cells, jnp.asarray(1e-9), self.comparable, False)[2]

        point = tuple(jnp.asarray(self.value(name), float) for name in names)
        sizes = [jnp.maximum(jnp.abs(value), 1.0) for value in point]
        rates = tuple(jnp.cos(1.0 + k + number * (1.0 + k) ** 2) * size for k, size in enumerate(sizes))
        return jax.jvp(states, point, rates)[1]

    # Periodic motions: the reduced state, which does not tell apart motions that a symmetry of the system shifts.

    #: Where motions are found whose reduced state is at rest, as the end of a message.
    at_rest: ClassVar[str] = ""

    #: A user's symmetry of the reduced state, as `Parameters`; or `None`.
    symmetry: Parameters | None = eqx.field(default=None, kw_only=True)

    #: Whether the motion or the event depends on time.
    depends_on_time: ClassVar[bool]

    #: The numbers of the start that are components of the reduced state, in the order of leaves.
    reduced_start: ClassVar[list[Array]]

    #: The names of those that are angles, to which whole turns may be added.
    angles: ClassVar[tuple[str, ...]] = ()

    @property
    def reduced_names(self) -> tuple[str, ...]:
        """The names of the components of the reduced state; by default those of the state of your own system."""
        return self.names

    @abc.abstractmethod
    def reduced(self, rows: Float[Array, "rows cells"], mode: Int[Array, " cells"]) -> Float[Array, "components cells"]:
        """The reduced states of runs, from the states of their modes."""

    def normalised(self) -> Self:
        """The model with a start that has all numbers of the reduced state; raises `ValueError` for a system without one."""
        return self

    # What a state means.

    #: The quantities of a state, by name; and the names of those that are the components of the state of your own system.
    quantities: ClassVar[dict[str, Quantity]]
    names: ClassVar[tuple[str, ...]] = ()

    #: The variables of a table that describe the end of a run.
    ends: ClassVar[dict[str, Variable]]

    @abc.abstractmethod
    def read(
        self, names: tuple[str, ...], time: Array, rows: Float[Array, "rows *cells"], mode: Int[ArrayLike, "..."] | None
    ) -> dict[str, Array]:
        """The named quantities of states, (*cells, ...).

        **Arguments:** `time`: times [s]; `rows`: the states of the problem or, if the model is not smooth, the output
        rows of its modes; `mode`: the indices of these modes, or `None`.
        """

    @abc.abstractmethod
    def ended(self, outcome: Outcome | HybridOutcome, tolerance: Number) -> Int[Array, " cells"]:
        """How each run has ended, as an integer of `Status`."""

    @abc.abstractmethod
    def at_end(self, outcome: Outcome | HybridOutcome, start: Float[Array, "components cells"]) -> dict[str, Array]:
        """The values of `ends`, for the outcome and the initial states of some cells."""


def statuses(codes: Int[Array, " cells"], left_domain: Status | Int[Array, " cells"]) -> Int[Array, " cells"]:
    """How runs have ended, as integers of `Status`, by the codes of the integration. **Arguments:** `left_domain`: the
    `Status` of a run that left its domain, or that of each run."""
    status = jnp.full(jnp.shape(codes), int(Status.COMPLETED))
    ends = {CROSSED: Status.EVENT, LEFT_DOMAIN: left_domain, FAILED: Status.FAILED, UNRESOLVED: Status.UNRESOLVED}
    for code, ended in ends.items():
        status = jnp.where(codes == code, jnp.asarray(ended, int), status)
    return status


class AbstractSceneModel(AbstractModel):
    """A model whose parameters are those of a few named trees, such as a scene and a launch, and of a user's event."""

    #: The trees whose numbers are parameters, which are fields of the model.
    roots: ClassVar[dict[str, PyTree]]

    angles = ("azimuth", "eta", "mu", "heading")
    at_rest = "; a steady motion is no orbit, and tippe.steady has those of tops"

    #: The full names of numbers of these trees that cannot be varied.
    fixed: ClassVar[tuple[str, ...]] = ()

    @property
    def known(self) -> list[str]:
        """The full names of the numbers that can be varied: single ones, including omitted ones, which are 0."""
        values = numbers_of(self.roots)
        names = [name for name, value in values.items() if np.ndim(value) == 0 and name not in self.fixed]
        return names if self.event is None else [*names, *self.event.parameters.known]

    @property
    def depends_on_time(self) -> bool:
        return self.event is not None and self.event.depends_on_time

    def full_name(self, argument: str, name: str) -> str:
        return full_name(argument, name, self.known)

    def value(self, name: str) -> Array:
        if name.startswith("event.") and self.event is not None:
            return self.event.parameters.value(name)
        root = name.partition(".")[0]
        value = numbers(root, self.roots[root])[name]
        return jnp.zeros(()) if value is None else value

    def replaced(self, values: Columns) -> Self:
        own = {name: value for name, value in values.items() if not name.startswith("event.")}
        event = self.event
        if event is not None:
            event = dataclasses.replace(event, parameters=event.parameters.replaced(values))
        return dataclasses.replace(self, **with_numbers(self.roots, own), event=event)


@functools.singledispatch
def model_of(
    system: object, start: object, event: object = None, input: object = None, jumps: object = None
) -> AbstractModel:
    """The model of a system, for the functions of this room.

    Each kind of system registers its own function.

    **Arguments:**

    - `system`, `start`: a scene and a launch, or your own system and its initial state.
    - `event`: a function of time and motion, or `None` for the event of the system itself.
    - `input`: the input of a driven system, or `None`; `jumps`: times at which it jumps, or `None`.

    **Raises:** `ValueError` for another kind of system, or an illegal start.

    **Example:**

    >>> from nonholonomic.runs import model_of
    >>> model_of(3.0, [1.0])
    Traceback (most recent call last):
    ValueError: system = 3.0 must be a tippe.Scene, a stroller.Scene, a nonholonomic.Hybrid or an AbstractSystem; wrap ...
    """
    raise ValueError(
        f"system = {shown(system)} must be a tippe.Scene, a stroller.Scene, a nonholonomic.Hybrid or an AbstractSystem; wrap "
        f"modes in nonholonomic.Hybrid([...]), and a function in a mode, as its field{likely_fix(system)}"
    )


@functools.singledispatch
def run_of(
    model: AbstractModel,
    t1: ArrayLike,
    times: ArrayOrList | None,
    tolerance: ArrayLike,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Any:
    """The run of a model at given times, or by default at those of its kind.

    Each kind of model registers its own function. **Arguments:** as for `nonholonomic.simulate`; this function checks
    `times`, `solver` and `adjoint` only.
    """
    raise NotImplementedError(f"{type(model).__name__} has no runs")


def check_run(model: AbstractModel, t1: ArrayLike, tolerance: ArrayLike) -> None:
    """Raise `ValueError` unless the model may run, and horizon and tolerance are single legal numbers."""
    model.check()
    check_horizon(t1, tolerance)


def check_horizon(t1: ArrayLike, tolerance: ArrayLike) -> None:
    """Raise `ValueError` unless horizon and tolerance are single legal numbers."""
    require_all(run_bounds(t1, tolerance))
    for name, number in {"t1": t1, "tolerance": tolerance}.items():
        if np.ndim(number) != 0:
            raise ValueError(f"{name} must be one number, not of shape {np.shape(number)}; jax.vmap or sweep runs many")


def settings_for_lanes(
    tolerance: Float[ArrayLike, ""],
    solver: diffrax.AbstractSolver | None,
    max_steps: int = DEFAULT_MAX_STEPS,
    device: str | None = None,
) -> Settings:
    """The settings of runs in lanes; raises `ValueError` unless the solver is an explicit Runge-Kutta method."""
    settings = Settings(tolerance, solver, max_steps=max_steps, device=device)
    explicit_tableau(settings.for_lanes)
    return settings


def require_event(model: AbstractModel, purpose: str = "") -> None:
    """Raise `ValueError` unless the model has an event."""
    if not model.has_event:
        raise ValueError(
            f"{purpose}event = None: the system has no event of its own; pass event=, a function of time and state"
        )
