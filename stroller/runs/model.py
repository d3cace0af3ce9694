"""The stroller as a model for the functions of `nonholonomic.runs`, and its own functions: rides, tables, fits."""

import dataclasses
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from nonholonomic import identification
from nonholonomic.compilation.components import Held
from nonholonomic.compilation.tracing import dependent_outputs
from nonholonomic.geometry import Cylinder, Plane
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import AbstractProblem, Outcome
from nonholonomic.integration.problem import DEFAULT_MAX_STEPS, Status, require_run
from nonholonomic.parameters import description, meant, numbers
from nonholonomic.runs.event import EventFunction, with_clock, with_event
from nonholonomic.runs.identify import Data, FreeNumbers, Priors, fit_runs, posterior_of_runs
from nonholonomic.runs.model import AbstractModel, AbstractSceneModel, Names, Number, model_of, run_of, statuses
from nonholonomic.runs.table import Options, TableForm, table_of
from nonholonomic.sweeps import Table, Variable
from nonholonomic.terminal import status_line
from nonholonomic.text import is_array, is_users, name_of, parted, shown
from nonholonomic.validation import all_bounds, explaining, legal, require_kind, require_outside, require_scalars

from ..model import input as inputs
from ..model.input import Formula, Input, PerRide, Steady
from ..model.scene import USUAL, Launch, RideProblem, Scene, Stroller
from .trajectory import QUANTITIES, TIMED, VECTORS, RideState, Trajectory, ride

#: Names of the coordinates of a place in the fixed frame.
FIXED = (("x", "m"), ("y", "m"), ("z", "m"))

UNITS = Stroller.units | Scene.units | Steady.units | Launch.units

# The launch has a number of the same short name.
UNITS |= {"scene.friction.steering": "N m s"}

#: The numbers of a launch apart from the place.
OF_A_LAUNCH = ("heading", "speed", "steering", "steering_rate")

#: Descriptions of the axes.
LONG_NAMES = {"scene.friction.steering": "damping of the steering", "steering_inertia": "inertia of the fork"}
LONG_NAMES |= {"steering_spring": "spring of the fork", "steering": "steering angle φ(0)", "speed": "speed v(0)"}
LONG_NAMES |= {"heading": "heading ψ(0)", "steering_rate": "steering rate φ'(0)", "mass": "mass m", "x0": "x(0)"}
LONG_NAMES |= {"y0": "y(0)", "z0": "z(0)", "mu0": "μ(0)", "eta0": "η(0)", "force": "drive force"}
LONG_NAMES |= {"torque": "steering torque"}

#: The numbers of a ride's end.
ENDS = {
    "x": Variable("m", np.float64, long_name="x"),
    "y": Variable("m", np.float64, long_name="y"),
    "z": Variable("m", np.float64, long_name="height z"),
    "heading": Variable("rad", np.float64, long_name="heading ψ"),
    "end_steering": Variable("rad", np.float64, long_name="steering angle φ at the end"),
    "end_speed": Variable("m s-1", np.float64, long_name="speed at the end"),
    "energy": Variable("J", np.float64, long_name="energy at the end"),
    "residual": Variable("J", np.float64, long_name="energy less work"),
}

#: The variables of a table in their order, whose names no axis may have.
TAKEN = (*ENDS, "contact_time", "end_time", "status", "steps", "rejected")


class RideModel(AbstractSceneModel):
    """A ride, or the rides of many cells: scene, launch and input, and the event. Without another event, the event is
    that the ground would have to pull; a ride continues through this event.

    `jumps`: times at which the input jumps, apart from those found in it.
    """

    scene: Scene
    launch: Launch
    input: Any
    event: EventFunction | None = None
    jumps: tuple[Array, ...] = ()

    smooth, continues = True, True
    # Nothing is watched.
    comparable = ("speed",)
    quantities, ends = QUANTITIES, ENDS

    @classmethod
    def of(cls, scene: Scene, launch: Launch, controls: Any, event: Any = None, jumps: object = None) -> AbstractModel:
        """The model of a ride, with a user's event if there is one.

        The input becomes a module whose numbers are leaves, evaluated for single rides. A function, or a module with many
        numbers, is traced once.
        """
        is_module = isinstance(controls, eqx.Module)
        if is_module:
            # Another number compiles nothing again.
            controls = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, controls)
        is_own = is_module and not (is_users(type(controls)) or inputs.has_arrays(controls))
        if not (controls is None or is_own or isinstance(controls, Held | Formula)):
            sizes = [np.size(leaf) for leaf in jax.tree.leaves(controls) if is_array(leaf)]
            if is_module and sum(sizes) <= inputs.MOST_ELEMENTS:
                controls = Held(parted(controls))
            else:
                controls = Formula.of(controls, *inputs.example_arguments(scene, launch))
        ride = cls(scene=scene, launch=launch, input=controls, jumps=inputs.as_jumps(jumps))
        return with_event(ride, event)

    def __reduce__(self) -> tuple[object, ...]:
        # A traced function cannot be pickled, so each process traces it.
        controls = inputs.users_input(self.input)
        event = None if self.event is None else self.event.function
        return RideModel.of, (self.scene, self.launch, controls, event, self.jumps)

    @property
    def roots(self) -> dict[str, PyTree]:
        """The trees whose numbers are parameters."""
        module = {} if self.input is None or isinstance(self.input, Formula) else {"input": self.input}
        return {"scene": self.scene, "launch": self.launch} | module

    @property
    def fixed(self) -> tuple[str, ...]:
        return () if isinstance(self.scene.surface, Plane) else ("scene.body.centre",)

    def full_name(self, argument: str, name: str) -> str:
        controls, field = inputs.users_input(self.input), name.removeprefix("input.").partition("[")[0]
        is_of_input = name.startswith("input.") or hasattr(controls, field)
        if isinstance(self.input, Formula) and is_of_input and not meant(name, self.known):
            raise ValueError(
                f"{argument}: {name!r}: input = {name_of(controls)} is a function, or has more than {inputs.MOST_ELEMENTS} "
                "numbers, so that they have no names: write an equinox.Module that holds only the numbers to vary, and reads "
                "large arrays from outside, as constants; or map stroller.simulate over inputs by jax.vmap"
            )
        return super().full_name(argument, name)

    def label(self, names: list[str]) -> dict[str, tuple[str, str, str]]:
        """The name of an axis is the last part of its full name, or the last two parts if one is ambiguous. Numbers of a
        place have the surface's names, followed by a zero: `x0`."""
        surface, place = self.scene.surface, self.launch.place
        units = self.scene.friction.units | surface.units | UNITS
        last_names = [name.rsplit(".", 1)[-1] for name in names]
        coordinates = surface.coordinates if len(place) == len(surface.coordinates) else FIXED
        places = dict(zip([f"launch.place[{k}]" for k in range(len(place))], coordinates, strict=True))
        labels = {}
        for full, last in zip(names, last_names, strict=True):
            name, unit = last, units.get(full, units.get(last, "1"))
            if full in places:
                name, unit = places[full][0] + "0", places[full][1]
            elif last_names.count(last) > 1 or last in TAKEN:
                name = "_".join(full.split(".")[-2:])
            labels[full] = (name, unit, LONG_NAMES.get(full, LONG_NAMES.get(name, name.replace("_", " "))))
        return labels

    def description(self) -> dict[str, Any]:
        controls = inputs.users_input(self.input)
        if isinstance(controls, eqx.Module):
            controls = description("input", controls)
        else:
            controls = "none" if controls is None else name_of(controls)
        request = description("scene", self.scene) | description("launch", self.launch) | {"input": controls}
        request |= {"jumps": [float(time) for time in self.jumps]} if self.jumps else {}
        return request if self.event is None else request | {"event": name_of(self.event.function)}

    def check(self) -> None:
        self.scene.check(self.launch)

    def legal(self) -> Bool[Array, "..."]:
        scene, launch = self.scene, self.launch
        bounds = [bound for module in (scene, launch, self.input) for bound in all_bounds(module)]
        bounds += scene.surface.place_bounds(launch.place, scene.body.wheelbase)
        sideways, on_equator = scene.stuck(launch)
        return legal(bounds) & ~jnp.asarray(sideways | on_equator)

    def for_lanes(self) -> tuple["RideModel", bool]:
        if not isinstance(self.input, Formula | Held) or inputs.has_arrays((self.scene, self.launch)):
            return self, isinstance(self.input, PerRide)
        controls = self.input.whole if isinstance(self.input, Held) else self.input
        controls = PerRide.of(controls, *inputs.example_arguments(self.scene, self.launch))
        return dataclasses.replace(self, input=controls), True

    @property
    def has_event(self) -> bool:
        return self.event is not None or not isinstance(self.scene.surface, Plane)

    def problem(self, cells: int | None, names: Names) -> AbstractProblem:
        scene, launch, controls, times = self.scene, self.launch, self.input, None
        if controls is not None:
            arguments = inputs.example_arguments(scene, launch)
            if cells is not None and isinstance(controls, Formula) and inputs.has_arrays(controls):
                controls = controls.of_cells(cells, *arguments)
            times = inputs.jump_times(controls, self.jumps, *arguments, cells)
        parts = [scene.state(launch, controls is not None), scene.scales(launch, controls is not None)]
        if cells is not None:
            parts = [jnp.broadcast_to(part.reshape(len(part), -1), (len(part), cells)) for part in parts]
        press = scene.body.mass * (scene.gravity + launch.speed**2 / scene.body.wheelbase + 1e-3)
        # Loss of contact is the event of tables without another one. Single rides and samples do not look for it.
        watched = cells is not None and names == () and self.event is None and not isinstance(scene.surface, Plane)
        guarded = cells is not None and scene.heading == "projected"
        ride = RideProblem(scene.dynamics, controls, parts[0], parts[1], press, watched, guarded, times)
        # The state ends with the time if a quantity depends on the input.
        return ride if self.input is None or names is None or TIMED.isdisjoint(names) else with_clock(ride)

    @property
    def depends_on_time(self) -> bool:
        return super().depends_on_time or self._reads("t")

    def _reads(self, *names: str) -> bool:
        """Whether the input depends on some of its arguments, the time `t` and the parts of the motion."""
        if self.input is None:
            return False
        t, motion = inputs.example_arguments(self.scene, self.launch)
        values = {"t": t, **motion._asdict()}

        def returned(moved: dict[str, PyTree]) -> PyTree:
            t, *parts = (values | moved).values()
            return self.input(t, type(motion)(*parts))

        return any(dependent_outputs(returned, {name: values[name] for name in names}))

    @property
    def reduced_names(self) -> tuple[str, ...]:
        surface, names = self.scene.surface, [name for name, _ in self.scene.surface.coordinates]
        # The ground is the same further along a plane or a cylinder, and around a surface of revolution.
        shifts = names if isinstance(surface, Plane) else ["y"] if isinstance(surface, Cylinder) else ["mu"]
        shifts = [] if self._reads("position", "heading") else shifts
        turns = isinstance(surface, Plane) and surface.tilt is None and bool(shifts)
        return (*(name for name in names if name not in shifts), *OF_A_LAUNCH[turns:])

    @property
    def reduced_start(self) -> list[Array]:
        launch, names = self.launch, [name for name, _ in self.scene.surface.coordinates]
        values = dict(zip(names, launch.place, strict=True)) | {name: getattr(launch, name) for name in OF_A_LAUNCH}
        return [values[name] for name in self.reduced_names]

    def normalised(self) -> "RideModel":
        surface, coordinates = self.scene.surface, self.scene.surface.coordinates
        if len(coordinates) == 3:
            raise ValueError(f"system: periodic motions need a surface with coordinates, not {shown(surface)}")
        state = self.reduced(self.scene.state(self.launch, self.input is not None)[:, None], None)[:, 0]
        values = dict.fromkeys(["heading"], 0.0) | dict(zip(self.reduced_names, state, strict=True))
        place = tuple(values.get(name, 0.0) for name, _ in coordinates)
        launch = Launch(place, *(values[name] for name in OF_A_LAUNCH))
        return dataclasses.replace(self, launch=launch)

    def reduced(self, rows: Float[Array, "rows cells"], mode: object) -> Float[Array, "components cells"]:
        coordinates = self.scene.surface.coordinates
        values = self.read(("place", *OF_A_LAUNCH), jnp.asarray(jnp.nan), rows, None)
        values |= zip((name for name, _ in coordinates), jnp.moveaxis(values.pop("place"), -1, 0), strict=True)
        if self.scene.heading == "projected" and "mu" in values and "mu" not in self.reduced_names:
            # This angle is that from the fixed x axis, which does not turn with the place.
            values["heading"] = values["heading"] - values["mu"]
        return jnp.stack([values[name] for name in self.reduced_names])

    def without_event(self) -> "RideModel":
        return dataclasses.replace(self, event=None)

    @property
    def components(self) -> dict[str, tuple[str, ...]]:
        return VECTORS | {"coordinate": tuple(name for name, _ in self.scene.surface.coordinates)}

    def read(
        self, names: tuple[str, ...], time: Array, rows: Float[Array, "rows *cells"], mode: Int[ArrayLike, "..."] | None
    ) -> dict[str, Array]:
        size = len(jax.eval_shape(lambda: self.scene.state(self.launch, self.input is not None)))
        time = rows[size] if len(rows) > size else time
        state = RideState(self.scene, self.input, time, rows[:size])
        return {name: QUANTITIES[name].of(name, state) for name in names}

    def ended(self, outcome: Outcome | HybridOutcome, tolerance: Number) -> Int[Array, " cells"]:
        status = statuses(outcome.status, Status.RANK_LOST)
        if self.event is not None:
            return status
        lost = jnp.isfinite(outcome.crossing_time) & (status == int(Status.COMPLETED))
        return jnp.where(lost, int(Status.EVENT), status)

    def at_end(self, outcome: Outcome | HybridOutcome, start: Float[Array, "components cells"]) -> dict[str, Array]:
        scene, size = self.scene, len(jax.eval_shape(lambda: self.scene.state(self.launch, self.input is not None)))
        end = RideState(scene, self.input, outcome.end_time, outcome.state[:size])
        energy = scene.energy(end.states)
        return dict(zip("xyz", end.position, strict=True)) | {
            "heading": scene.dynamics.angle(*end.motion[:2]),
            "end_steering": end.motion.steering,
            "end_speed": end.motion.speed,
            "energy": energy,
            "residual": energy - scene.energy(start[:size]) - scene.work(end.states),
        }


run_of.register(RideModel, ride)


#: What takes lists in place of single numbers, for messages.
LISTS = "axes of sweep take lists, and jax.vmap maps over them"


@model_of.register(Scene)
def _(system: Scene, start: Any, event: Any = None, input: Input | None = None, jumps: object = None) -> AbstractModel:
    require_kind(start, "start", Launch)
    require_scalars(numbers("scene", system, functions=False) | numbers("launch", start), LISTS)
    system.check(start)
    inputs.check_input(input, system, start, jumps)
    return RideModel.of(system, start, input, event, jumps)


def checked_model(
    scene: Any, launch: Any, t1: ArrayLike, input: Any, tolerance: ArrayLike, jumps: object = None
) -> AbstractModel:
    """The model of a ride; raises `ValueError` unless scene, launch, horizon, input and tolerance are legal and the scene can
    start with the launch."""
    require_run(scene, launch, t1, tolerance, (Scene, Launch), LISTS)
    return model_of(scene, launch, None, input, jumps)


# The functions of the stroller, on those of `nonholonomic.runs`.

#: The names in a table of rides. A ride continues if contact is lost, as if the ground could pull.
FORM = TableForm(
    named={Status.EVENT: Status.CONTACT_LOST},
    event="loss of contact",
    nan_if_failed=False,
    time="contact_time",
    of_time="loss of contact",
    run="ride",
    order=TAKEN,
)


@explaining
@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: Float[ArrayLike, ""],
    input: Input | None = None,
    times: Float[ArrayLike, " times"] | Sequence[float] | None = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 65536,
    adjoint: diffrax.AbstractAdjoint | None = None,
    jumps: Sequence[ArrayLike] | Array | None = None,
) -> Trajectory:
    """Simulate a ride from a launch until `t1`.

    **Arguments:**

    - `scene`: a `Scene`.
    - `launch`: a `Launch`.
    - `t1`: end of the run [s], positive.
    - `input`: a function `(t, motion) -> (drive force [N], steering torque [N m])` (see `input.py`), or `None`.
    - `times`: times [s] to report, increasing, within [0, t1]; by default 201 equally spaced ones.
    - `tolerance`: relative tolerance of an adaptive solver, in [1e-14, 1e-2]; the absolute tolerance is a tenth of it,
      in units of the scene's magnitudes.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations, or an `ImplicitMidpoint`; by default
      `diffrax.Dopri8()`; inside transformations without `adjoint`, if all numbers of scene and launch are scalars,
      `nonholonomic.integration.Oscillatory8()`.
    - `max_steps`: a run that needs more steps fails; at least 1.
    - `adjoint`: `RecursiveCheckpointAdjoint()` or `ForwardMode()` of Diffrax, with which Diffrax
      differentiates. By default, this package computes forward and reverse derivatives; the gradient of a loss function
      costs about five runs, whatever the number of parameters, which may be arrays, such as the weights of an input.
    - `jumps`: times [s] at which the input jumps or has a kink, so that steps end there. The times of comparisons of the time
      with numbers, such as `t > 1.0`, and the knots of `jnp.interp` are found without being named here.

    **Returns:** a `Trajectory`; its `status` states how the run ended.

    **Raises:** `ValueError` for arguments out of range, lists in place of numbers, an illegal launch, times that do not
    increase, a solver without an error estimate, and an input that is not a function, cannot be traced, or is not
    finite at the start.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, stroller.Steady(1.0, 0.1), times=[0.5, 1.0], tolerance=1e-6)
    >>> print(f"{run.speed[-1]:.3f} m/s, {run.heading[-1]:.3f} rad, {run.status}")
    1.472 m/s, 0.980 rad, completed

    ```
    """
    model = checked_model(scene, launch, t1, input, tolerance, jumps)
    return ride(model, t1, times, tolerance, solver, adjoint, max_steps)


@explaining
def sweep(
    scene: Scene,
    launch: Launch,
    t1: float,
    *,
    axes: dict[str, ArrayLike | Sequence[float]],
    input: Input | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    device: str | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
    jumps: Sequence[ArrayLike] | Array | None = None,
) -> Table:
    """The ends of all rides over a grid of parameters, in one batched call on all cores.

    **Arguments:**

    - `scene`, `launch`, `input`: as for `simulate`; all numbers must be scalars.
    - `t1`: end of every ride [s].
    - `axes`: name of a parameter -> values, such as `{"launch.speed": [1.0, 2.0], "polar": [0.8, 0.9]}`; the end of a
      full name is enough if it is unique. The parts of the place are `"launch.place[0]"` and `"launch.place[1]"`; the
      names of parameters of an input that is a module begin with `"input."`. The first axis varies slowest. With `{}`,
      the table has a single ride.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `progress`: whether to show progress, on a terminal or in a notebook.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes` or of a Dask client;
      by default, a thread for each core. On the same kind of processor, all executors give bitwise equal results.
    - `device`: "cpu" or "gpu"; by default, large tables run on a GPU if there is one.
    - `max_steps`: a ride that needs more steps, including rejected ones, fails; at least 1.
    - `jumps`: times [s] at which the input jumps, as for `simulate`.

    **Returns:** a `Table` of the rides' ends: position `x`, `y`, `z` [m] in the fixed frame, `heading`, `end_steering`
    [rad], `end_speed` [m/s], `energy` [J], `residual` [J] of energy against work, `contact_time` [s] at which the
    ground first had to pull (infinite if never; the ride continues), `end_time` [s], `status` ("completed",
    "contact_lost", "rank_lost" if a projected heading ended the ride, "failed"), `steps` and `rejected`.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> axes = {"launch.speed": [1.0, 2.0], "scene.body.wheelbase": [0.6, 0.7]}
    >>> table = stroller.sweep(scene, launch, 1.0, axes=axes, tolerance=1e-6)
    >>> print(table.end_speed.round(3))
    [[0.779 0.779]
     [1.558 1.558]]

    ```
    """
    require_outside((scene, launch, t1, axes, input, jumps), "sweep", "simulate")
    model = checked_model(scene, launch, t1, input, tolerance, jumps)
    options = Options(tolerance, solver, max_steps, path=path, progress=progress, executor=executor, device=device)
    return table_of(model, axes, t1, options, form=FORM)


# Estimate parameters of a stroller, its ground and its launch from recorded rides, and their posterior.

#: The words for data that can be fitted.
EXPECTED = "a Recording or a nonholonomic.EventTimes"


@explaining
def identify(
    scene: Scene,
    data: Data,
    free: FreeNumbers,
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> identification.Identification:
    """Estimate parameters of a scene and its launch from measurements, with errors and undetermined combinations.

    **Arguments:**

    - `scene`: a `Scene`, with the values of the parameters that are not free.
    - `data`: a `Recording`, or a list of several, which are fitted together; `nonholonomic.Recording` and `EventTimes`, too.
    - `free`: full name of a parameter -> a `Free` or only the start value: `"scene.friction.rolling"`, or `"rolling"`
      if no other name ends so; `"launch.place[0]"` and `"launch.place[1]"` are parts of the place. A parameter of the
      launch, and `"t0"`, the reading of a recording's clock at the launch, are the same in all recordings;
      `"data[1].launch.heading"` belongs to the second recording, and `"data[*].t0"` is a separate parameter for each.
      Parameters that cannot be negative are fitted by their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.result`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> fit = stroller.identify(scene, data, {"rolling": 1.5}, progress=False)
    >>> print(f"{fit.estimates['scene.friction.rolling']:.2f} N s/m, {fit.status}")
    2.00 N s/m, converged

    ```
    """
    search = {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}
    require_kind(scene, "scene", Scene)
    return fit_runs(scene, data, free, EXPECTED, tolerance, search)


@explaining
def log_density(
    scene: Scene, data: Data, free: FreeNumbers, priors: Priors = None, *, tolerance: float = 1e-8
) -> identification.LogDensity:
    """The log of the posterior density of the parameters of a scene and its launch, as a function of unbounded coordinates.

    **Arguments:** `scene`, `data`, `free`, `tolerance`: as for `identify`; `priors`: as for `tippe.log_density`.

    **Returns:** a `LogDensity`, for `nonholonomic.identification.sample` and any other sampler.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:** rolling friction from two speeds, with a prior of 10 %.

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> density = stroller.log_density(scene, data, {"rolling": 2.0}, priors={"rolling": (2.0, 0.2)})
    >>> density.names, density.start.shape
    (('scene.friction.rolling',), (1,))

    ```
    """
    require_kind(scene, "scene", Scene)
    return posterior_of_runs(scene, data, free, priors, EXPECTED, tolerance)


# Recorded rides of strollers, from arrays and from files.

#: The quantities of a ride that can be recorded, with the names of a `Trajectory`'s properties.
RECORDED = identification.Quantities(
    columns={"position": ("x", "y", "z")},
    units=dict.fromkeys(("x", "y", "z"), "m")
    | {"heading": "rad", "steering": "rad", "speed": "m/s", "yaw_rate": "rad/s", "steering_rate": "rad/s"},
    angles=frozenset({"heading"}),
    usual=USUAL,
)


class Recording(identification.AbstractRecording):
    """A recorded ride: quantities sampled at the times of a clock.

    **Arguments:**

    - `launch`: a `Launch`; all its numbers must be scalars.
    - `times`: (times,) [s], increasing.
    - `value`: (times,) for a single column, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: "position" ("x", "y", "z") [m] of the rear axle in the fixed frame, "heading", "steering" [rad],
      "speed" [m/s], "yaw_rate" or "steering_rate" [rad/s], all as in `Trajectory`; or a tuple of some of these words. A
      heading may differ by whole turns.
    - `t0`: the clock's reading [s] at the launch. Before this time, the stroller is at its launch position.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for data with outliers;
      `None` for Gaussian errors.
    - `side`: as for `nonholonomic.Recording`; a ride has no resets.
    - `input`, `jumps`: the input of the ride and the times at which it jumps, as for `simulate`.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:** two positions in the plane, seen from above.

    >>> import stroller
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.0)
    >>> track = stroller.Recording(launch, [0.5, 1.0], [[0.5, 0.0], [1.0, 0.02]], 0.01, ("x", "y"))
    >>> track.labels
    ('x(0.5 s)', 'y(0.5 s)', 'x(1 s)', 'y(1 s)')
    """

    launch: Launch
    quantity: str | tuple[str, ...] = eqx.field(static=True, default="position", converter=identification.as_quantity)
    input: Input | None = None
    jumps: Sequence[float] | Array | None = None
    quantities: ClassVar[identification.Quantities] = RECORDED

    def model(self, scene: object) -> AbstractModel:
        """The model of the recorded ride, checked."""
        known = require_kind(scene, "data: the scene of a stroller.Recording", Scene)
        known.check(self.launch)
        return RideModel.of(known, self.launch, self.input, None, self.jumps)

    def __check_init__(self):
        require_kind(self.launch, "launch", Launch, several="identify takes a list of recordings")


@explaining
def read_recording(
    path: str | PathLike[str],
    columns: Mapping[str, object] | None = None,
    fps: float | None = None,
    *,
    launch: Launch,
    error: Mapping[str, object] | None = None,
    input: Input | None = None,
    t0: float = 0.0,
    student: float | None = None,
    decimal: str = ".",
    jumps: Sequence[float] | Array | None = None,
) -> Recording:
    """A recording of a ride from a text file of columns with a header line (CSV).

    **Arguments:**

    - `path`: path of the file. Columns are separated by commas, semicolons, tabs or blanks; empty cells, `nan`, `n/a` and
      `-` are missing samples; lines that begin with # are ignored.
    - `columns`: quantity -> (header of its column, unit): `"time"`, or `"frame"`, and any of `"x"`, `"y"`, `"z"`,
      `"heading"`, `"steering"`, `"speed"`, `"yaw_rate"`, `"steering_rate"`. Units are s, ms, min; rad, deg, rev; rad/s,
      deg/s, rpm, rev/s; m, cm, mm; m/s, cm/s, mm/s, km/h; or a factor that converts the file's numbers to SI units,
      such as metres per pixel. If the header has the unit, as "speed [km/h]", the header is enough. By default, the
      columns whose headers are quantities with units, such as "time [s]" and "speed [km/h]".
    - `fps`: frames per second, if there is no `"time"`. If there is no `"frame"` either, every line is a frame.
    - `launch`: a `Launch`, with guesses for unknown numbers; `input`, `jumps`, `t0`, `student`: as for `Recording`.
    - `error`: quantity -> (standard error or the header of its column, unit); with `None`, errors are estimated from
      the residuals.
    - `decimal`: "," if the file has decimal commas.

    **Returns:** a `Recording`.

    **Raises:** `ValueError` that names the column and the problem.

    **Example:** a speedometer, read every second.

    >>> import pathlib, tempfile, stroller
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "ride.csv"
    >>> _ = path.write_text("speed\\n5.4\\n5.0\\n4.7\\n")
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.0, speed=1.5)
    >>> ride = stroller.read_recording(path, {"speed": ("speed", "km/h")}, fps=1, launch=launch)
    >>> print(ride.times, ride.value.round(2))
    [0. 1. 2.] [1.5  1.39 1.31]
    """
    table = identification.read_columns(path, columns, fps, error, RECORDED, decimal)
    recording = Recording(launch, *table[:-1], input=input, t0=t0, student=student, jumps=jumps)
    return recording.stated_in(table.unit)
