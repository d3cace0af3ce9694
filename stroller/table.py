"""Many rides in one batched call: every combination of some parameters of scene, launch and input."""

import dataclasses
from concurrent.futures import Executor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Plane
from nonholonomic.integration import (
    CROSSED,
    FAILED,
    GUARD_LOST,
    AbstractProblem,
    Settings,
    compiled_march,
    explicit_tableau,
)
from nonholonomic.parameters import description, with_numbers
from nonholonomic.sweeps import Axis, Table, Variable, axis, cells_to_check
from nonholonomic.sweeps import sweep as computed
from nonholonomic.validation import as_number, require

from .dynamics import Dynamics, State
from .heading import Projected
from .input import Input
from .launch import Launch
from .scene import Scene
from .trajectory import CONTACT_ROUND_OFF, RANK_LOST

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
UNITS |= {"speed": "m s-1", "steering_rate": "rad s-1", "force": "N", "torque": "N m", "heading": "rad"}

#: A place is a pair; its parts are axes under these names, with their units on a plane and elsewhere.
PLACES = {"launch.place[0]": ("x0", "mu0"), "launch.place[1]": ("y0", "eta0")}


class RideProblem(AbstractProblem):
    """Rides of many cells. Where contact is watched, a ride ends where the ground would have to pull."""

    dynamics: Dynamics
    input: Input | None
    states: Float[Array, "components cells"]
    scales: Float[Array, "components cells"]
    press: Float[Array, "..."]
    watched: bool = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene, launch: Launch, controls: Input | None, cells: int, watched: bool) -> "RideProblem":
        """The problem of the given number of cells; every number is a scalar or one per cell."""

        def spread(states):
            return jnp.broadcast_to(states.reshape(states.shape[0], -1), (states.shape[0], cells))

        one = cls.single(scene, launch, controls)
        watched = watched and not isinstance(scene.surface, Plane)
        return dataclasses.replace(one, states=spread(one.states), scales=spread(one.scales), watched=watched)

    @classmethod
    def single(cls, scene: Scene, launch: Launch, controls: Input | None) -> "RideProblem":
        """The problem of one ride, which goes on where contact is lost."""
        driven = controls is not None
        press = scene.body.mass * (scene.gravity + launch.speed**2 / scene.body.wheelbase + 1e-3)
        return cls(scene.dynamics, controls, scene.state(launch, driven), scene.scales(launch, driven), press, False)

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.states, self.scales

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.dynamics.field(time, state, self.input)

    def crossing(self, state: Float[Array, "components lanes"]) -> Any:
        return self.dynamics.contact(state) / self.press + CONTACT_ROUND_OFF if self.watched else None

    def guard(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.dynamics.rank(state) / RANK_LOST - 1.0 if isinstance(self.dynamics.heading, Projected) else None


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
    - `progress`: whether to show it, on a terminal or in a notebook.
    - `executor`: who computes: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes` or of a
      Dask client, to which blocks are handed as its workers become free; by default a thread for each core. The numbers
      are the same, to the bit on the same kind of processor.

    **Returns:** a `Table` of the rides' ends: position `x`, `y`, `z` [m] in the fixed frame, `heading`, `end_steering`
    [rad], `end_speed` [m/s], `energy` [J], `residual` [J] of energy against work, `contact_time` [s] at which the ground
    first had to pull (infinite if never; the ride goes on), `end_time` [s], `status` ("completed", "contact_lost",
    "rank_lost" where a projected heading ended the ride, "failed"), `steps` and `rejected`.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.
    """
    solver = diffrax.Dopri8() if solver is None else solver
    explicit_tableau(solver)
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    scene.check(launch)
    require(t1, "t1", above=0.0)
    require(tolerance, "tolerance", at_least=1e-14, at_most=1e-2)
    roots = {"scene": scene, "launch": launch} | ({"input": input} if isinstance(input, eqx.Module) else {})
    grid = named_axes(axes, isinstance(scene.surface, Plane))
    # The modules check every value of every axis here, before anything compiles.
    for cells in cells_to_check(grid):
        changed = replaced(roots, cells)
        changed["scene"].check(changed["launch"])

    request = description("scene", scene) | description("launch", dataclasses.replace(launch, place=(0.0, 0.0)))
    request |= {"launch.place": [float(part) for part in launch.place], "t1": float(t1), "tolerance": float(tolerance)}
    request |= {"solver": type(solver).__name__, "input": "none" if input is None else described(input)}
    request |= {one.number: "an axis" for one in grid}
    job = RideJob(roots, input, float(t1), float(tolerance), solver)
    return computed(job, grid, VARIABLES, request, path=path, progress=progress, executor=executor)


class RideJob(NamedTuple):
    """What is asked of every cell, as data that can be sent to another process; see `sweep`."""

    roots: dict[str, Any]
    input: Input | None
    t1: float
    tolerance: float
    solver: diffrax.AbstractERK

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which the first `count` are to be run."""
        cells = replaced(self.roots, columns)
        size = next((len(values) for values in columns.values()), 1)
        problem, outcome = self._march(cells, size, count, watched=True)
        lost = np.asarray(outcome.status == CROSSED)
        contact_time = np.where(lost, outcome.end_time, np.inf)
        if lost.any() or (count == 0 and problem.watched):
            problem, outcome = self._march(cells, size, count, watched=False)
        words = np.select([outcome.status == FAILED, outcome.status == GUARD_LOST, lost], [3, 2, 1], 0)
        ends = read_ends(cells["scene"], outcome.state, problem.states)
        return {name: np.asarray(values) for name, values in ends.items()} | {
            "contact_time": contact_time,
            "end_time": np.asarray(outcome.end_time),
            "status": words.astype(np.int8),
            "steps": np.asarray(outcome.steps),
            "rejected": np.asarray(outcome.rejected),
        }

    def _march(self, cells: dict[str, Any], size: int, count: int, watched: bool) -> tuple[RideProblem, Any]:
        problem = RideProblem.of(cells["scene"], cells["launch"], cells.get("input", self.input), size, watched)
        settings = Settings(self.tolerance, self.solver)
        return problem, compiled_march(problem, as_number(self.t1), jnp.asarray(count), settings)[0]


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


def named_axes(axes: dict[str, Any], flat: bool) -> list[Axis]:
    """The axes of the table, each under the last part of its full name, or the last two where that is not enough."""
    lasts = [number.rsplit(".", 1)[-1] for number in axes]
    grid = []
    for number, last in zip(axes, lasts, strict=True):
        name, unit = last, UNITS.get(last, "1")
        if number in PLACES:
            name, unit = PLACES[number][0 if flat else 1], "m" if flat else "rad"
        elif lasts.count(last) > 1 or last in VARIABLES:
            name = "_".join(number.split(".")[-2:])
        if number.endswith("steering"):
            unit = "N m s" if "friction" in number else "rad"
        grid.append(axis(name, number, unit, axes[number]))
    return grid


def replaced(roots: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Scene, launch and input with some of their parameters replaced."""
    place = [values.get(number, part) for number, part in zip(PLACES, roots["launch"].place, strict=True)]
    roots = roots | {"launch": dataclasses.replace(roots["launch"], place=tuple(place))}
    return with_numbers(roots, {number: one for number, one in values.items() if number not in PLACES})


def described(controls: Any) -> Any:
    """An input as plain data; a function has nothing but its name to show."""
    if isinstance(controls, eqx.Module):
        return description("input", controls)
    return getattr(controls, "__qualname__", repr(controls))
