"""Many rides in one batched call, for every combination of some parameters of scene, launch and input."""

import dataclasses
from concurrent.futures import Executor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface, Plane
from nonholonomic.integration import Settings, explicit_tableau, solve_ensemble
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.integration.status import FAILED, LEFT_DOMAIN
from nonholonomic.parameters import description, full_axes, numbers, with_numbers
from nonholonomic.sweeps import Axis, Table, Variable, axis, cells_to_check
from nonholonomic.sweeps import sweep as computed
from nonholonomic.validation import as_number, require_outside, require_whole, shown

from ..model.dynamics import State
from ..model.friction import Damping, RollingResistance
from ..model.input import Input, Steady
from ..model.launch import Launch
from ..model.scene import Scene
from ..model.stroller import Stroller
from .checks import check_run
from .ride import RideProblem, as_module

#: Names of the coordinates of a place in the fixed frame.
FIXED = (("x", "m"), ("y", "m"), ("z", "m"))

WORDS = ("completed", "contact_lost", "rank_lost", "failed")

VARIABLES = {
    "x": Variable("m", np.float64, long_name="x"),
    "y": Variable("m", np.float64, long_name="y"),
    "z": Variable("m", np.float64, long_name="height z"),
    "heading": Variable("rad", np.float64, long_name="heading ψ"),
    "end_steering": Variable("rad", np.float64, long_name="steering angle φ at the end"),
    "end_speed": Variable("m s-1", np.float64, long_name="speed at the end"),
    "energy": Variable("J", np.float64, long_name="energy at the end"),
    "residual": Variable("J", np.float64, long_name="energy less work"),
    "contact_time": Variable("s", np.float64, long_name="loss of contact"),
    "end_time": Variable("s", np.float64, long_name="end of the ride"),
    "status": Variable("1", np.int8, WORDS, long_name="how the ride ended"),
    "steps": Variable("1", np.int64, long_name="steps"),
    "rejected": Variable("1", np.int64, long_name="rejected steps"),
}

UNITS = Stroller.units | Scene.units | Damping.units | RollingResistance.units | Steady.units | Launch.units
UNITS |= {"tilt": "rad", "radius": "m", "equatorial": "m", "polar": "m", "ring": "m", "tube": "m", "p": "m"}

#: Descriptions of the axes.
LONG_NAMES = {"steering_inertia": "inertia of the fork", "steering_spring": "spring of the fork"}
LONG_NAMES |= {
    "steering": "steering angle φ(0)",
    "speed": "speed v(0)",
    "heading": "heading ψ(0)",
    "steering_rate": "steering rate φ'(0)",
    "mass": "mass m",
}
LONG_NAMES |= {
    "x0": "x(0)",
    "y0": "y(0)",
    "z0": "z(0)",
    "mu0": "μ(0)",
    "eta0": "η(0)",
    "force": "drive force",
    "torque": "steering torque",
}


def sweep(
    scene: Scene,
    launch: Launch,
    t1: float,
    *,
    axes: dict[str, Any],
    input: Input | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    path: Any = None,
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
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
    - `max_steps`: a ride that needs more steps, including rejected ones, fails; at least 1.

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
    require_outside((scene, launch, t1, axes, input), "sweep", "simulate")
    check_run(scene, launch, t1, input, tolerance)
    if not isinstance(axes, dict) or not all(isinstance(number, str) for number in axes):
        raise ValueError(f"axes = {shown(axes)} must be a dictionary, full name of a parameter -> values")
    require_whole(max_steps, "max_steps", 1)
    settings = Settings(tolerance, solver, max_steps=int(max_steps))
    explicit_tableau(settings.for_lanes)
    roots = {"scene": scene, "launch": launch} | ({"input": input} if isinstance(input, eqx.Module) else {})
    grid = named_axes(full_axes(axes, variable_numbers(roots)), scene.surface, launch)
    # The modules check every value of every axis here, before anything compiles.
    for cells in cells_to_check(grid):
        new_roots = with_numbers(roots, cells)
        new_roots["scene"].check(new_roots["launch"])

    request = description("scene", scene) | description("launch", dataclasses.replace(launch, place=(0.0, 0.0)))
    request |= {"launch.place": [float(part) for part in launch.place], "t1": float(t1), "tolerance": float(tolerance)}
    request |= {"solver": type(settings.for_lanes).__name__, "input": "none" if input is None else described(input)}
    request |= {grid_axis.number: "an axis" for grid_axis in grid}
    if max_steps != DEFAULT_MAX_STEPS:
        request |= {"max_steps": int(max_steps)}
    job = RideJob.of(roots, input, float(t1), settings)
    return computed(job, grid, VARIABLES, request, path=path, progress=progress, executor=executor)


def variable_numbers(roots: dict[str, Any]) -> list[str]:
    """The full names of the parameters that can be varied: single numbers, including omitted ones, which are 0."""
    values_by_name = {name: value for root, tree in roots.items() for name, value in numbers(root, tree).items()}
    level = isinstance(roots["scene"].surface, Plane)
    return [
        name for name, value in values_by_name.items() if np.ndim(value) == 0 and (level or name != "scene.body.centre")
    ]


class RideJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process; see `sweep`.

    `controls`: the input as a module, which each process creates.
    """

    roots: dict[str, Any]
    input: Input | None
    t1: float
    settings: Settings
    controls: Input | None

    @classmethod
    def of(cls, roots: dict[str, Any], input: Any, t1: float, settings: Settings) -> "RideJob":
        """The job for a scene, launch and input."""
        return cls(roots, input, t1, settings, as_module(input, roots["scene"], roots["launch"]))

    def __reduce__(self) -> Any:
        return RideJob.of, tuple(self[:-1])

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which only the first `count` are run."""
        cells = with_numbers(self.roots, columns)
        size = next((len(values) for values in columns.values()), 1)
        controls = cells.get("input", self.controls)
        problem = RideProblem.of(cells["scene"], cells["launch"], controls, size, watched=True)
        # A ride continues if contact is lost, as if the ground could pull.
        outcome, _ = solve_ensemble(
            problem, as_number(self.t1), jnp.asarray(count), self.settings, nonterminal=problem.watched
        )
        contact_time = np.asarray(outcome.first_crossing)
        is_lost = np.isfinite(contact_time)
        words = np.select([outcome.status == FAILED, outcome.status == LEFT_DOMAIN, is_lost], [3, 2, 1], 0)
        ends = read_ends(cells["scene"], outcome.state, problem.states)
        return {name: np.asarray(values) for name, values in ends.items()} | {
            "contact_time": contact_time,
            "end_time": np.asarray(outcome.end_time),
            "status": words.astype(np.int8),
            "steps": np.asarray(outcome.steps),
            "rejected": np.asarray(outcome.rejected),
        }


@eqx.filter_jit
def read_ends(scene: Scene, states: State, starts: State) -> dict[str, Float[Array, " cells"]]:
    """The variables of the table from the states at the ends of the rides and at their starts."""
    dynamics, surface = scene.dynamics, scene.surface
    states = dynamics.righted(states)
    motion = dynamics.geometry(states).motion
    _, east, north = surface.chart(surface.place_at(motion.position))
    energy = scene.energy(states)
    position = surface.in_fixed_frame(motion.position)
    return dict(zip("xyz", position, strict=True)) | {
        "heading": dynamics.heading.angle(motion.heading, east, north),
        "end_steering": motion.steering,
        "end_speed": motion.speed,
        "energy": energy,
        "residual": energy - scene.energy(starts) - scene.work(states),
    }


def place_numbers(launch: Launch) -> list[str]:
    """The full names of the coordinates of a launch's place."""
    return [f"launch.place[{k}]" for k in range(len(launch.place))]


def named_axes(axes: dict[str, Any], surface: AbstractSurface, launch: Launch) -> list[Axis]:
    """The axes of the table. The name of an axis is the last part of its full name, or the last two parts if one is
    ambiguous. Numbers of a place have the surface's names, followed by a zero: `x0`.
    """
    last_names = [number.rsplit(".", 1)[-1] for number in axes]
    coordinates = surface.coordinates if len(launch.place) == len(surface.coordinates) else FIXED
    places = dict(zip(place_numbers(launch), coordinates, strict=True))
    grid = []
    for number, last in zip(axes, last_names, strict=True):
        name, unit = last, UNITS.get(last, "1")
        if number in places:
            name, unit = places[number][0] + "0", places[number][1]
        elif last_names.count(last) > 1 or last in VARIABLES:
            name = "_".join(number.split(".")[-2:])
        if number.endswith("steering"):
            unit = "N m s" if "friction" in number else "rad"
        grid.append(axis(name, number, unit, axes[number], LONG_NAMES.get(name, name.replace("_", " "))))
    return grid


def described(controls: Any) -> Any:
    """An input as plain data; a function is described by its name alone."""
    if isinstance(controls, eqx.Module):
        return description("input", controls)
    return getattr(controls, "__qualname__", repr(controls))
