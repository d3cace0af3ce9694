"""The stroller as a model for the functions of `nonholonomic.runs`."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from nonholonomic.compilation.components import Held
from nonholonomic.geometry import Plane
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import AbstractProblem, Outcome
from nonholonomic.integration.problem import Status, require_run
from nonholonomic.parameters import description, numbers, numbers_of
from nonholonomic.runs.event import EventFunction, with_clock, with_event
from nonholonomic.runs.model import AbstractModel, AbstractSceneModel, Names, Number, model_of, run_of, statuses
from nonholonomic.sweeps import Variable
from nonholonomic.text import name_of
from nonholonomic.validation import all_bounds, legal, require_kind, require_scalars

from ..model.input import Formula, Input, PerRide, Steady, as_jumps, at_start, check_input
from ..model.scene import RideProblem, Scene, as_module, has_arrays
from ..model.vehicle import Damping, Launch, RollingResistance, Stroller
from .trajectory import QUANTITIES, TIMED, VECTORS, RideState, heading, ride

#: Names of the coordinates of a place in the fixed frame.
FIXED = (("x", "m"), ("y", "m"), ("z", "m"))

UNITS = Stroller.units | Scene.units | Damping.units | RollingResistance.units | Steady.units | Launch.units
UNITS |= {"tilt": "rad", "radius": "m", "equatorial": "m", "polar": "m", "ring": "m", "tube": "m", "p": "m"}

# The launch has a number of the same short name.
UNITS |= {"scene.friction.steering": "N m s"}

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


class Original:
    """A user's input before it was traced, for files and for other processes. All are equal: the traced input decides
    whether a program is compiled again."""

    def __init__(self, controls: Input):
        self.input = controls

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Original)

    def __hash__(self) -> int:
        return 0


class RideModel(AbstractSceneModel):
    """A ride, or the rides of many cells: scene, launch and input, and the event. Without another event, the event is
    that the ground would have to pull; a ride continues through this event.

    `original`: the user's input, if it was traced; `jumps`: times at which it jumps, apart from those found in it.
    """

    scene: Scene
    launch: Launch
    input: Any
    event: EventFunction | None = None
    original: "Original | None" = eqx.field(static=True, default=None)
    jumps: tuple[Array, ...] = ()

    smooth, continues = True, True
    # Nothing is watched.
    comparable = ("speed",)
    quantities, ends = QUANTITIES, ENDS

    @classmethod
    def of(cls, scene: Scene, launch: Launch, controls: Any, event: Any = None, jumps: object = None) -> AbstractModel:
        """The model of a ride, with a user's event if there is one."""
        module = as_module(controls, scene, launch)
        original = None if isinstance(module, Held) or module is controls else Original(controls)
        ride = cls(scene=scene, launch=launch, input=module, original=original, jumps=as_jumps(jumps))
        return with_event(ride, event)

    def __reduce__(self) -> Any:
        # A traced function cannot be pickled, so each process traces it.
        controls = self.input if self.original is None else self.original.input
        event = None if self.event is None else self.event.function
        return RideModel.of, (self.scene, self.launch, controls, event, self.jumps)

    @property
    def roots(self) -> dict[str, PyTree]:
        """The trees whose numbers are parameters."""
        module = {} if self.input is None or self.original is not None else {"input": self.input}
        return {"scene": self.scene, "launch": self.launch} | module

    @property
    def known(self) -> list[str]:
        """The full names of the parameters that can be varied: single numbers, including omitted ones, which are 0."""
        values, level = numbers_of(self.roots), isinstance(self.scene.surface, Plane)
        return [
            name for name, value in values.items() if np.ndim(value) == 0 and (level or name != "scene.body.centre")
        ]

    def label(self, names: list[str]) -> dict[str, tuple[str, str, str]]:
        """The name of an axis is the last part of its full name, or the last two parts if one is ambiguous. Numbers of a
        place have the surface's names, followed by a zero: `x0`."""
        surface, place = self.scene.surface, self.launch.place
        last_names = [name.rsplit(".", 1)[-1] for name in names]
        coordinates = surface.coordinates if len(place) == len(surface.coordinates) else FIXED
        places = dict(zip([f"launch.place[{k}]" for k in range(len(place))], coordinates, strict=True))
        labels = {}
        for full, last in zip(names, last_names, strict=True):
            name, unit = last, UNITS.get(full, UNITS.get(last, "1"))
            if full in places:
                name, unit = places[full][0] + "0", places[full][1]
            elif last_names.count(last) > 1 or last in TAKEN:
                name = "_".join(full.split(".")[-2:])
            labels[full] = (name, unit, LONG_NAMES.get(full, LONG_NAMES.get(name, name.replace("_", " "))))
        return labels

    def description(self) -> dict[str, Any]:
        controls: Any = self.input if self.original is None else self.original.input
        if isinstance(controls, eqx.Module):
            controls = description("input", controls)
        else:
            controls = "none" if controls is None else name_of(controls)
        request = description("scene", self.scene) | description("launch", self.launch) | {"input": controls}
        request |= {"jumps": [float(time) for time in self.jumps]} if self.jumps else {}
        return request if self.event is None else request | {"event": self.event.name}

    def check(self) -> None:
        self.scene.check(self.launch)

    def legal(self) -> Bool[Array, "..."]:
        scene, launch = self.scene, self.launch
        bounds = [bound for module in (scene, launch, self.input) for bound in all_bounds(module)]
        is_stuck = jnp.asarray(scene.sideways(launch) | scene.level(launch))
        return legal([*bounds, *scene.surface.place_bounds(launch.place, scene.body.wheelbase)]) & ~is_stuck

    def for_lanes(self) -> tuple["RideModel", bool]:
        if not isinstance(self.input, Formula | Held) or has_arrays((self.scene, self.launch)):
            return self, isinstance(self.input, PerRide)
        t, motion = eqx.filter_eval_shape(at_start, self.scene, self.launch)
        controls = self.input.whole if isinstance(self.input, Held) else self.input
        return dataclasses.replace(self, input=PerRide.of(controls, t, motion)), True

    @property
    def has_event(self) -> bool:
        return self.event is not None or not isinstance(self.scene.surface, Plane)

    def problem(self, cells: int | None, names: Names) -> AbstractProblem:
        if cells is None:
            ride = RideProblem.of(self.scene, self.launch, self.input, jumps=self.jumps)
        else:
            watched = self.event is None and names is not None and not names
            ride = RideProblem.of(self.scene, self.launch, self.input, cells, watched, self.jumps)
        # The state ends with the time if a quantity depends on the input.
        return ride if self.input is None or names is None or TIMED.isdisjoint(names) else with_clock(ride)

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
        scene, surface = self.scene, self.scene.surface
        size = len(jax.eval_shape(lambda: scene.state(self.launch, self.input is not None)))
        states = scene.dynamics.righted(outcome.state[:size])
        motion = scene.dynamics.geometry(states).motion
        energy = scene.energy(states)
        position = surface.in_fixed_frame(motion.position)
        return dict(zip("xyz", position, strict=True)) | {
            "heading": heading(scene, motion),
            "end_steering": motion.steering,
            "end_speed": motion.speed,
            "energy": energy,
            "residual": energy - scene.energy(start[:size]) - scene.work(states),
        }


run_of.register(RideModel, ride)


@model_of.register(Scene)
def _(system: Scene, start: Any, event: Any = None, input: Input | None = None, jumps: object = None) -> AbstractModel:
    require_kind(start, "start", Launch)
    lists = "axes of sweep take lists, and jax.vmap maps over them"
    require_scalars(numbers("scene", system, functions=False) | numbers("launch", start), lists)
    system.check(start)
    check_input(input, system, start, jumps)
    return RideModel.of(system, start, input, event, jumps)


def check_run(scene: Any, launch: Any, t1: ArrayLike, input: Any, tolerance: ArrayLike, jumps: object = None) -> None:
    """Raise `ValueError` unless scene, launch, horizon, input and tolerance are legal and the scene can start with the
    launch."""
    lists = "axes of sweep take lists, and jax.vmap maps over them"
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check(launch)
    check_input(input, scene, launch, jumps)
