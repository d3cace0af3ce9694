"""Many rides in one batched call: every combination of some parameters of scene, launch and input."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface
from nonholonomic.integration import (
    FAILED,
    GUARD_LOST,
    Settings,
    compiled_march,
    explicit_tableau,
)
from nonholonomic.parameters import description, with_numbers
from nonholonomic.sweeps import Axis, Table, Variable, axis
from nonholonomic.sweeps import grid as grids
from nonholonomic.validation import as_number, require

from .dynamics import State
from .input import Input
from .launch import Launch
from .ride import RideProblem, as_module
from .scene import Scene

#: What the numbers of a place in the fixed frame are called.
FIXED = (("x", "m"), ("y", "m"), ("z", "m"))

WORDS = ("completed", "contact_lost", "rank_lost", "failed")

VARIABLES = {
    "x": Variable("m", np.float64),
    "y": Variable("m", np.float64),
    "z": Variable("m", np.float64),
    "heading": Variable("rad", np.float64),
    "end_steering": Variable("rad", np.float64),
    "end_speed": Variable("m s-1", np.float64),
    "energy": Variable("J", np.float64),
    "residual": Variable("J", np.float64),
    "contact_time": Variable("s", np.float64),
    "end_time": Variable("s", np.float64),
    "status": Variable("1", np.int8, WORDS),
    "steps": Variable("1", np.int64),
    "rejected": Variable("1", np.int64),
}

UNITS = {"mass": "kg", "wheelbase": "m", "inertia": "kg m2", "steering_inertia": "kg m2", "centre": "m"}
UNITS |= {"steering_spring": "N m rad-1", "gravity": "m s-2", "tilt": "rad", "radius": "m", "equatorial": "m"}
UNITS |= {"polar": "m", "rolling": "N s m-1", "front": "N s m-1", "scrub": "N m s", "coefficient": "1"}
UNITS |= {"ring": "m", "tube": "m", "p": "m"}
UNITS |= {"speed": "m s-1", "steering_rate": "rad s-1", "force": "N", "torque": "N m", "heading": "rad"}


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
) -> Table:
    """The ends of all rides over a grid of parameters, in one batched call on all cores.

    **Arguments:**

    - `scene`, `launch`, `input`: as for `simulate`, every number a scalar.
    - `t1`: end of every ride [s].
    - `axes`: full name of a parameter -> values, such as `{"launch.speed": [1.0, 2.0], "scene.surface.polar": [0.8, 0.9]}`; the
      parts of the place are `"launch.place[0]"` and `"launch.place[1]"`, the parameters of an input that is a module are
      under `"input."`. The first axis varies slowest.
    - `tolerance`: relative tolerance of the integration.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, `Dopri8()` by default.
    - `path`: HDF5 file to write, block by block. A run that was interrupted resumes from it.

    **Returns:** a `Table` of the rides' ends: position `x`, `y`, `z` [m] in the fixed frame, `heading`, `end_steering`
    [rad], `end_speed` [m/s], `energy` [J], `residual` [J] of energy against work, `contact_time` [s] at which the ground
    first had to pull (infinite if never; the ride goes on), `end_time` [s], `status` ("completed", "contact_lost",
    "rank_lost" where a projected heading ended the ride, "failed"), `steps` and `rejected`.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used.
    """
    solver = diffrax.Dopri8() if solver is None else solver
    explicit_tableau(solver)
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    scene.check(launch)
    require(t1, "t1", above=0.0)
    require(tolerance, "tolerance", at_least=1e-14, at_most=1e-2)
    controls = as_module(input, scene, launch)
    roots = {"scene": scene, "launch": launch} | ({"input": input} if isinstance(input, eqx.Module) else {})
    grid = named_axes(axes, scene.surface, launch)
    # The modules check every value of every axis here, before anything compiles.
    for one in grid:
        changed = replaced(roots, {one.number: one.values})
        changed["scene"].check(changed["launch"])

    def run(columns: dict[str, Any], count: int) -> dict[str, Any]:
        cells = replaced(roots, columns)
        size = next((len(values) for values in columns.values()), 1)
        problem = RideProblem.of(cells["scene"], cells["launch"], cells.get("input", controls), size, watched=True)
        horizon, settings = as_number(t1), Settings(tolerance, solver)
        # A ride goes on where contact is lost, as if the ground could pull.
        outcome, _ = compiled_march(problem, horizon, jnp.asarray(count), settings, passes=problem.watched)
        contact_time = np.asarray(outcome.first_crossing)
        lost = np.isfinite(contact_time)
        words = np.select([outcome.status == FAILED, outcome.status == GUARD_LOST, lost], [3, 2, 1], 0)
        ends = read_ends(cells["scene"], outcome.state, problem.states)
        return {name: np.asarray(values) for name, values in ends.items()} | {
            "contact_time": contact_time,
            "end_time": np.asarray(outcome.end_time),
            "status": words.astype(np.int8),
            "steps": np.asarray(outcome.steps),
            "rejected": np.asarray(outcome.rejected),
        }

    request = description("scene", scene) | description("launch", dataclasses.replace(launch, place=(0.0, 0.0)))
    request |= {"launch.place": [float(part) for part in launch.place], "t1": float(t1), "tolerance": float(tolerance)}
    request |= {"solver": type(solver).__name__, "input": "none" if input is None else described(input)}
    request |= {one.number: "an axis" for one in grid}
    return grids.sweep(run, grid, VARIABLES, request, path=path)


@eqx.filter_jit
def read_ends(scene: Scene, states: State, starts: State) -> dict[str, Float[Array, " cells"]]:
    """What the table shows of the states at the ends of the rides, given those at their starts."""
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
    """The full names of the numbers of a launch's place."""
    return [f"launch.place[{k}]" for k in range(len(launch.place))]


def named_axes(axes: dict[str, Any], surface: AbstractSurface, launch: Launch) -> list[Axis]:
    """The axes of the table, each under the last part of its full name, or the last two where that is not enough.

    The numbers of a place are named as the surface names them, with a zero: `x0`.
    """
    lasts = [number.rsplit(".", 1)[-1] for number in axes]
    named = surface.coordinates if len(launch.place) == len(surface.coordinates) else FIXED
    places = dict(zip(place_numbers(launch), named, strict=True))
    grid = []
    for number, last in zip(axes, lasts, strict=True):
        name, unit = last, UNITS.get(last, "1")
        if number in places:
            name, unit = places[number][0] + "0", places[number][1]
        elif lasts.count(last) > 1 or last in VARIABLES:
            name = "_".join(number.split(".")[-2:])
        if number.endswith("steering"):
            unit = "N m s" if "friction" in number else "rad"
        grid.append(axis(name, number, unit, axes[number]))
    return grid


def replaced(roots: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Scene, launch and input with some of their parameters replaced."""
    launch = roots["launch"]
    places = dict(zip(place_numbers(launch), launch.place, strict=True))
    place = tuple(values.get(number, part) for number, part in places.items())
    roots = roots | {"launch": dataclasses.replace(launch, place=place)}
    return with_numbers(roots, {number: one for number, one in values.items() if number not in places})


def described(controls: Any) -> Any:
    """An input as plain data; a function has nothing but its name to show."""
    if isinstance(controls, eqx.Module):
        return description("input", controls)
    return getattr(controls, "__qualname__", repr(controls))
