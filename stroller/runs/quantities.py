"""The quantities of a ride, with units and names, as functions of one state, and the table of a run."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Component, Plane, dot, multiply, scale, sum_vectors
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.validation import require_one_run

from ..model.dynamics import Geometry, Power, State, padded
from ..model.input import Input
from ..model.scene import Scene

QUANTITIES = {
    "place": Quantity("m or rad", "place", "coordinate"),
    "position": Quantity("m", "position of the rear axle", "component"),
    "direction": Quantity("1", "direction of the heading", "component"),
    "heading": Quantity("rad", "heading ψ"),
    "steering": Quantity("rad", "steering angle φ"),
    "steering_rate": Quantity("rad s-1", "φ'"),
    "speed": Quantity("m s-1", "speed v"),
    "front_speed": Quantity("m s-1", "speed of the front wheel"),
    "yaw_rate": Quantity("rad s-1", "yaw rate"),
    "energy": Quantity("J", "energy"),
    "work": Quantity("J", "work of inputs and friction"),
    "drive_power": Quantity("W", "power of the drive", read=lambda run: run.power.drive),
    "steering_power": Quantity("W", "power of the steering", read=lambda run: run.power.steering),
    "friction_power": Quantity("W", "power of friction", read=lambda run: sum(run.power[2:])),
    "side_force": Quantity("N", "side force", "axle"),
    "grip": Quantity("1", "friction that the tyres need", "axle", read=lambda run: grip(run.side_force, run.load)),
    "load": Quantity("N", "load", "axle"),
    "normal_force": Quantity("N", "normal force"),
}

#: Names of the components of vectors, by dimension.
VECTORS = {"component": ("x", "y", "z"), "axle": ("rear", "front")}


#: The coefficient of friction [1] that no tyre exceeds on a dry road: 0.7 to 1.0 is usual, and 1.8 is that of racing slicks
#: (Milliken and Milliken, Race Car Vehicle Dynamics (1995), chapter 2).
MOST_GRIP = 1.8


def table_of(runs: list[Any], names: list[str], request: dict[str, Any], only: Sequence[str] = ()) -> Table:
    """All quantities of several runs with the same times, over these times.

    **Arguments:**

    - `runs`: the trajectories.
    - `names`: names of the runs, without spaces, for the axis "ride"; empty for a single run.
    - `request`: plain data that describes the computation.
    - `only`: names of quantities, as for `chosen`.
    """
    flat = {isinstance(run.spec.scene.surface, Plane) for run in runs}
    # On grounds of different kinds, a place has no common unit.
    places, unit = {True: (("x", "y"), "m"), False: (("mu", "eta"), "rad")}[flat.pop()]
    places, unit = (("first", "second"), "m or rad") if flat else (places, unit)
    coords = {"ride": np.array(names)} if names else {}
    coords |= {"time": np.asarray(runs[0].t), "coordinate": np.array(places)}
    coords |= {dim: np.array(names) for dim, names in VECTORS.items()}
    quantities = chosen(QUANTITIES | {"place": QUANTITIES["place"]._replace(unit=unit)}, only)
    of_runs = {name: [np.asarray(quantity.of(name, run)) for run in runs] for name, quantity in quantities.items()}
    values = {name: np.stack(of_each) if names else of_each[0] for name, of_each in of_runs.items()}
    return run_table(quantities, coords, values, [*(["ride"] if names else []), "time"], request)


def table_of_one(run: Any, only: Sequence[str] = ()) -> Table:
    """Quantities of a run, over its times. **Arguments:** `only`: names of quantities, as for `chosen`.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; stroller.sweep makes a table of many")
    request = run.spec.model.description() | {"status": run.status}
    return table_of([run], [], request, only)


#: The quantities that depend on the input, and so on the time.
TIMED = {"power", "drive_power", "steering_power", "friction_power", "side_force", "grip", "constraint"}


class RideState:
    """The quantities of states at times `t` [s], as properties; the states may have an axis of times or of cells, which
    is the first axis of every quantity."""

    def __init__(self, scene: Scene, controls: Input | None, t: Float[Array, "..."], states: State):
        self.scene, self.controls, self.t = scene, controls, t
        self.integrated, self.states = states, scene.dynamics.righted(states)

    @functools.cached_property
    def geometry(self) -> Geometry:
        return self.scene.dynamics.geometry(self.states)

    def _number(self, component: Component) -> Float[Array, "..."]:
        return spread(component, self.states[0])

    def _vector(self, components: Any) -> Float[Array, "... components"]:
        return jnp.stack([self._number(component) for component in components], axis=-1)

    @property
    def place(self) -> Float[Array, "... numbers"]:
        return self._vector(self.scene.surface.place_at(self.geometry.motion.position))

    @property
    def position(self) -> Float[Array, "... 3"]:
        return self._vector(self.scene.surface.in_fixed_frame(self.geometry.motion.position))

    @property
    def heading(self) -> Float[Array, "..."]:
        surface, motion = self.scene.surface, self.geometry.motion
        _, east, north = surface.chart(surface.place_at(motion.position))
        return self.scene.dynamics.heading.angle(motion.heading, east, north)

    @property
    def direction(self) -> Float[Array, "... 3"]:
        return self._vector(self.scene.surface.in_fixed_frame(self.geometry.motion.heading))

    @property
    def steering(self) -> Float[Array, "..."]:
        return self.geometry.motion.steering

    @property
    def speed(self) -> Float[Array, "..."]:
        return self.geometry.motion.speed

    @property
    def front_speed(self) -> Float[Array, "..."]:
        return self.geometry.motion.front_speed

    @property
    def steering_rate(self) -> Float[Array, "..."]:
        return self._number(self.geometry.motion.steering_rate)

    @property
    def yaw_rate(self) -> Float[Array, "..."]:
        return self.geometry.motion.yaw_rate

    @property
    def energy(self) -> Float[Array, "..."]:
        return self.scene.energy(self.states)

    @property
    def work(self) -> Float[Array, "..."]:
        return self.scene.work(self.states)

    @functools.cached_property
    def power(self) -> Power:
        dynamics, geometry = self.scene.dynamics, self.geometry
        power = dynamics.power(geometry, dynamics.forces(self.t, geometry, self.controls))
        return Power(*(self._number(part) for part in power))

    @property
    def side_force(self) -> Float[Array, "... 2"]:
        return self._vector(side_force(self.scene, self.t, self.states, self.controls))

    @property
    def normal_force(self) -> Float[Array, "..."]:
        return self._number(self.geometry.normal_force)

    @property
    def load(self) -> Float[Array, "... 2"]:
        front_load = self._number(self.geometry.front_load)
        return self._vector((self.normal_force - front_load, front_load))

    @property
    def constraint(self) -> Float[Array, "... 2"]:
        rates = self.scene.dynamics.field(self.t, self.states, self.controls)
        return self._vector(side_slip(self.scene, rates, self.states))

    @property
    def departure(self) -> Float[Array, "..."]:
        return self._number(self.scene.surface.offset(self.geometry.motion.position))

    @property
    def state(self) -> Float[Array, "... components"]:
        return jnp.moveaxis(self.integrated, 0, -1)


def grip(side_force: Float[Array, "... 2"], load: Float[Array, "... 2"]) -> Float[Array, "... 2"]:
    """Coefficient of friction that each axle needs to avoid slip; infinite for a force without a load."""
    force = jnp.abs(side_force)
    return jnp.where(force == 0.0, 0.0, force / jnp.maximum(load, 0.0))


def side_slip(scene: Scene, rate: State, state: State) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Speeds [m/s] at which the rear axle and the front wheel slip sideways when the state changes at `rate`.

    They come from the rates of the position r and of the heading, with the front wheel l ahead of the rear axle.
    """
    dynamics, body = scene.dynamics, scene.body

    def heading_components(state):
        return [component for component in dynamics.geometry(state).motion.heading if component is not None]

    g = dynamics.geometry(state)
    velocity = dynamics.unpack(rate)[0]
    heading_rate = padded(jax.jvp(heading_components, (state,), (rate,))[1])
    if scene.heading == "projected":
        heading, left = g.motion.heading, (-g.motion.heading[1], g.motion.heading[0], None)
    else:
        heading, left = g.direction, g.left
    sideways = sum_vectors(scale(-g.sine, heading), scale(g.cosine, left))
    front = sum_vectors(velocity, scale(multiply(body.wheelbase, dot(heading_rate, left)), left))
    return dot(velocity, left), dot(front, sideways)


def spread(component: Component, example: Float[Array, "..."]) -> Float[Array, "..."]:
    """A component as an array, with zeros if it vanishes identically."""
    return jnp.zeros_like(example) if component is None else jnp.broadcast_to(component, example.shape)


def side_force(
    scene: Scene, t: Float[Array, " times"], states: Float[Array, "components times"], controls: Input | None
) -> tuple[Float[Array, " times"], Float[Array, " times"]]:
    """Side forces [N] on the rear axle and the front wheel, to the left of each."""
    if scene.heading == "intrinsic" or isinstance(scene.surface, Plane):
        return scene.dynamics.side_force(t, states, controls)
    return scene.dynamics.projected_side_force(t, states, controls)
