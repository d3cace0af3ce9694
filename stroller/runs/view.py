"""The quantities of a ride, with units and names, and its drawing."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface, Component, Plane, dot, multiply, scale, sum_vectors
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.text import distinguishing_labels
from nonholonomic.validation import require_one_run
from nonholonomic.views import (
    COLOURS,
    DARK,
    PALE,
    Arrow,
    Body,
    Curve,
    Mesh,
    Show,
    Stage,
    Trace,
    arena,
    bar,
    box,
    distinguished_by_colour,
    turned,
    wheel,
)

from ..model.dynamics import Geometry, Power, State, padded
from ..model.input import Input
from ..model.scene import DRIVES, Scene

# The quantities of a ride, with units and names, as functions of one state, and the table of a run.

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


# The drawing of a ride: the vehicle, the traces of its wheels, forces, and curves over time.

#: Drawn lengths in units of the wheelbase, the only length of the model: radius and width of the wheels, and the track.
RADIUS, WIDTH, TRACK = 0.2, 0.07, 0.8

#: Size of the vehicle for the camera, in units of the wheelbase.
SIZE = 0.65

#: Greatest angle [rad] by which a wheel rolls from frame to frame.
ROLL_PER_FRAME = 0.5

#: Length of the arrow of a force equal to the weight, in units of the wheelbase.
WEIGHT = 1.0

#: Upper limit for drawing the coefficient of friction that the tyres need, which is infinite where the load vanishes.
DRAWN_GRIP = 3.0

GREEN, BLUE, VIOLET, GOLD = 0x1F8A4C, 0x1B6CA8, 0x7B4FA3, 0xE0A100


def as_stages(runs: list[Any], overlaid: bool, unit: Any = None) -> list[Stage]:
    """Rides as stages: one stage for each, or a common one for overlaid rides. **Arguments:** `unit`: as for `plot`."""
    names = names_of(runs, unit)
    return grouped([list(enumerate(runs))] if overlaid else [[numbered_run] for numbered_run in enumerate(runs)], names)


def names_of(runs: list[Any], unit: Any = None) -> list[str]:
    """Names of rides, by what differs in their durations, scenes and launches. **Arguments:** `unit`: as for `plot`."""
    for run in runs:
        require_one_run(run, "a picture", ", and pass the others as others=")
    rides = [run.spec for run in runs]
    starts = [(f"ride of {float(run.t[-1]):.3g} s",) for run in runs]
    scenes, launches = ([getattr(ride, name) for ride in rides] for name in ("scene", "launch"))
    return distinguishing_labels(starts, scenes, launches, unit=unit)


def grouped(groups: list[list[tuple[int, Any]]], names: list[str]) -> list[Stage]:
    """A stage for each group of numbered rides on a common ground; `names` are the names of the rides."""
    stages = []
    for group in groups:
        scene = group[0][1].spec.scene
        length = float(scene.body.wheelbase)
        shows = distinguished_by_colour(tuple(show(run, k, names[k]) for k, run in group))
        points = np.concatenate([np.asarray(run.position) for _, run in group])
        normal = normals(np, scene.surface, scene.side, np.asarray(group[0][1].position)[:1])[0]
        ground = arena(scene.surface, points, normal, 3.0 * length, length)
        stages.append(Stage("; ".join(body.name for body in shows), ground, shows))
    return stages


def normals(xp: Any, surface: AbstractSurface, side: str | None, position: Any) -> Any:
    """Unit normals at positions (*times, 3), towards the side on which the stroller is. **Arguments:** `xp`: NumPy, or
    `jax.numpy` for a page."""
    components = surface.normal(surface.in_own_axes(tuple(position.T)))
    zero = xp.zeros(position.shape[:-1])
    filled = tuple(zero if part is None else xp.asarray(part) + zero for part in components)
    return surface.sign(side, DRIVES) * xp.stack([xp.asarray(part) for part in surface.in_fixed_frame(filled)], axis=-1)


class Posture(NamedTuple):
    """The drawn parts of a vehicle.

    - `places`, `rotations`: where frame, left, right and front wheel are, and how they are rotated.
    - `contacts`: the points above the ground at the rear axle and the front wheel; `up`, `left`: the axes along which
      the ground's forces act there.
    """

    places: tuple[Any, ...]
    rotations: tuple[Any, ...]
    contacts: tuple[Any, Any]
    up: Any
    left: tuple[Any, Any]

    @classmethod
    def of(
        cls, xp: Any, length: Any, position: Any, direction: Any, normal: Any, steering: Any, angles: Any
    ) -> "Posture":
        """The parts of a vehicle with a wheelbase [m], for its quantities (*times, ...), the ground's normal, and the
        angles [rad] by which left, right and front wheel have rolled. **Arguments:** `xp`: as for `normals`."""
        x = direction / xp.linalg.norm(direction, axis=-1, keepdims=True)
        y = xp.cross(normal, x)
        y = y / xp.linalg.norm(y, axis=-1, keepdims=True)
        z = xp.cross(x, y)
        cosine, sine = xp.cos(steering)[..., None], xp.sin(steering)[..., None]
        forward, left = cosine * x + sine * y, cosine * y - sine * x
        radius, half = RADIUS * length, 0.5 * TRACK * length
        axle, front = position + radius * z, position + length * x + radius * z

        def rolled(ahead: Any, axis: Any, angle: Any) -> Any:
            cosine, sine = xp.cos(angle)[..., None], xp.sin(angle)[..., None]
            return xp.stack([cosine * ahead - sine * z, axis, sine * ahead + cosine * z], axis=-1)

        wheels = (rolled(x, y, angles[0]), rolled(x, y, angles[1]), rolled(forward, left, angles[2]))
        return cls(
            (axle, axle + half * y, axle - half * y, front),
            (xp.stack([x, y, z], axis=-1), *wheels),
            (position + 0.02 * radius * z, position + length * x + 0.02 * radius * z),
            z,
            (y, left),
        )


def show(run: Any, number: int, name: str) -> Show:
    """The drawing of one ride, the `number`-th of all."""
    scene = run.spec.scene
    length, colour = float(scene.body.wheelbase), COLOURS[number % len(COLOURS)]
    radius, half = RADIUS * length, TRACK * length / 2.0
    times, reader = refined(run, radius)
    normal = reader(normals(np, scene.surface, scene.side, np.asarray(run.position)))
    yaw = half * np.asarray(run.yaw_rate)
    speeds = (np.asarray(run.speed) - yaw, np.asarray(run.speed) + yaw, np.asarray(run.front_speed))
    angles = [reader(_integral(np.asarray(run.t), speed / radius)) for speed in speeds]
    drawn = (reader(run.position), reader(run.direction), normal, reader(run.steering))
    posture = Posture.of(np, length, *drawn, angles)
    wheel_mesh = wheel(radius, WIDTH * length, (DARK, PALE))
    names = ("frame", "left wheel", "right wheel", "front wheel")
    meshes = (frame(length, colour), wheel_mesh, wheel_mesh, wheel_mesh)
    parts = zip(names, posture.places, posture.rotations, meshes, strict=True)
    (rear, front), (rear_left, front_left), up = posture.contacts, posture.left, posture.up
    loads, forces = reader(run.load), reader(run.side_force)
    scale, width = WEIGHT * length / float(scene.body.mass * scene.gravity), 0.035 * length
    grip = np.asarray(run.grip())[:, : len(run.loaded_axles)]
    warning = f"needs friction {np.max(grip):.2g}, more than any tyre provides: a real stroller would slip"
    return Show(
        name,
        colour,
        times,
        normal,
        SIZE * length,
        tuple(Body(part, place, turned(rotation), mesh) for part, place, rotation, mesh in parts),
        (
            Trace("path of the rear axle", rear, GREEN, 0.05 * length),
            Trace("path of the front wheel", front, BLUE, 0.025 * length),
        ),
        (
            Arrow("normal force, rear", rear, loads[:, :1] * up, "N", scale, VIOLET, width, through=True),
            Arrow("normal force, front", front, loads[:, 1:] * up, "N", scale, VIOLET, width, through=True),
            Arrow("side force, rear", rear, forces[:, :1] * rear_left, "N", scale, GOLD, width, 2.0 * length),
            Arrow("side force, front", front, forces[:, 1:] * front_left, "N", scale, GOLD, width, 2.0 * length),
        ),
        (
            Curve("speed [m/s]", reader(run.speed)),
            Curve("steering angle [rad]", reader(run.steering)),
            Curve("energy [J]", reader(run.energy)),
            Curve("normal force [N]", reader(run.normal_force)),
            Curve("friction that the tyres need [1]", reader(np.minimum(grip, DRAWN_GRIP).max(axis=-1))),
        ),
        warning if np.max(grip) > MOST_GRIP else "",
    )


def refined(run: Any, radius: float) -> tuple[np.ndarray, Any]:
    """Times so close that the wheels roll little between them, including the times of the ride, and a function that
    returns the ride's numbers at these times."""
    times = np.asarray(run.t)
    if len(times) < 4:
        return times, np.asarray
    from scipy.interpolate import CubicSpline

    gaps = np.diff(times)
    roll_angles = np.maximum(np.abs(run.speed), np.abs(run.front_speed)).max() * gaps / radius
    parts = np.clip(np.ceil(roll_angles / ROLL_PER_FRAME), 1, 20).astype(int)
    refined_times = np.concatenate(
        [a + (b - a) * np.arange(n) / n for a, b, n in zip(times, times[1:], parts, strict=False)]
    )
    refined_times = np.append(refined_times, times[-1])
    return refined_times, lambda values: CubicSpline(times, np.asarray(values))(refined_times)


def frame(length: float, colour: int) -> tuple[Mesh, ...]:
    """Axle, chassis, basket, handle and fork, as seen from the middle of the rear axle."""
    half, thickness = TRACK * length / 2.0, 0.025 * length
    low, high = 0.12 * length, 0.62 * length
    handle = [(-0.55 * length, sign * 0.3 * half, 0.95 * length) for sign in (1.0, -1.0)]
    posts = [bar((0.0, 0.3 * half * sign, low), handle[k], thickness, DARK) for k, sign in enumerate((1.0, -1.0))]
    return (
        bar((0.0, -half, 0.0), (0.0, half, 0.0), thickness, DARK),
        bar((0.0, 0.0, 0.0), (0.92 * length, 0.0, 0.30 * length), thickness, DARK),
        bar((length, 0.0, 0.22 * length), (length, 0.0, 0.34 * length), 1.4 * thickness, DARK),
        bar((0.92 * length, 0.0, 0.30 * length), (length, 0.0, 0.30 * length), thickness, DARK),
        box((0.62 * length, 1.1 * half, high - low), (0.22 * length, 0.0, (low + high) / 2.0 + 0.06 * length), colour),
        box((0.5 * length, 0.9 * half, 0.02 * length), (0.22 * length, 0.0, high + 0.07 * length), PALE),
        *posts,
        bar(handle[0], handle[1], 1.3 * thickness, DARK),
    )


def _integral(times: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Integral over time, by the trapezoidal rule."""
    return np.concatenate([[0.0], np.cumsum(np.diff(times) * (rate[1:] + rate[:-1]) / 2.0)])
