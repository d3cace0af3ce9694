"""The drawing of a ride, and its page with sliders."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic import views
from nonholonomic.geometry import AbstractQuadric, AbstractSurface
from nonholonomic.integration import AbstractPassive, ExtendedProblem
from nonholonomic.integration.problem import Status
from nonholonomic.parameters import numbers
from nonholonomic.runs.model import Sliders
from nonholonomic.runs.trajectory import (
    TOLERANCE,
    explore_model,
    live_run,
    page_of,
    runs_at_ends,
    sliders_of,
    stages_of,
)
from nonholonomic.terminal import status_line
from nonholonomic.text import Unit
from nonholonomic.views.explore import Frame, LiveRun, Summary, quaternion

from ..model.dynamics import State
from ..model.input import Input
from ..model.scene import DRIVES, Launch, RideProblem, Scene
from .model import RideModel, check_run
from .trajectory import MOST_GRIP, QUANTITIES, RideState, Trajectory, names_of

#: JAX's arrays for a page, or NumPy's for a picture.
Values: TypeAlias = Array | np.ndarray

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


@stages_of.register(Trajectory)
def _(run: Trajectory, runs: list[Trajectory], overlaid: bool, unit: Unit) -> list[views.Stage]:
    numbered = list(enumerate(runs))
    return grouped([numbered] if overlaid else [[ride] for ride in numbered], names_of(runs, unit))


def grouped(groups: list[list[tuple[int, Trajectory]]], names: list[str]) -> list[views.Stage]:
    """A stage for each group of numbered rides on a common ground; `names` are the names of the rides."""
    stages = []
    for group in groups:
        scene = group[0][1].model.scene
        length = float(scene.body.wheelbase)
        shows = views.distinguished_by_colour(tuple(show(run, k, names[k]) for k, run in group))
        points = np.concatenate([np.asarray(run.position) for _, run in group])
        normal = normals(np, scene.surface, scene.side, np.asarray(group[0][1].position)[:1])[0]
        ground = views.arena(scene.surface, points, normal, 3.0 * length, length)
        stages.append(views.Stage("; ".join(body.name for body in shows), ground, shows))
    return stages


def normals(xp: ModuleType, surface: AbstractSurface, side: str | None, position: Values) -> Any:
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
        cls,
        xp: ModuleType,
        length: Values | float,
        position: Values,
        direction: Values,
        normal: Values,
        steering: Values,
        angles: Sequence[Values] | Values,
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

        def rolled(ahead: Values, axis: Values, angle: Values) -> Values:
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


def show(run: Trajectory, number: int, name: str) -> views.Show:
    """The drawing of one ride, the `number`-th of all."""
    from scipy.integrate import cumulative_trapezoid

    scene = run.model.scene
    length, colour = float(scene.body.wheelbase), views.COLOURS[number % len(views.COLOURS)]
    radius, half = RADIUS * length, TRACK * length / 2.0
    times, reader = refined(run, radius)
    normal = reader(normals(np, scene.surface, scene.side, np.asarray(run.position)))
    yaw = half * np.asarray(run.yaw_rate)
    speeds = (np.asarray(run.speed) - yaw, np.asarray(run.speed) + yaw, np.asarray(run.front_speed))
    angles = [reader(cumulative_trapezoid(speed / radius, np.asarray(run.t), initial=0.0)) for speed in speeds]
    drawn = (reader(run.position), reader(run.direction), normal, reader(run.steering))
    posture = Posture.of(np, length, *drawn, angles)
    wheel_mesh = views.wheel(radius, WIDTH * length, (views.DARK, views.PALE))
    names = ("frame", "left wheel", "right wheel", "front wheel")
    meshes = (vehicle(length, colour), wheel_mesh, wheel_mesh, wheel_mesh)
    parts = zip(names, posture.places, posture.rotations, meshes, strict=True)
    (rear, front), (rear_left, front_left), up = posture.contacts, posture.left, posture.up
    loads, forces = reader(run.load), reader(run.side_force)
    scale, width = WEIGHT * length / float(scene.body.mass * scene.gravity), 0.035 * length
    grip = np.asarray(run["grip"])[:, : len(run.loaded_axles)]
    warning = f"needs friction {np.max(grip):.2g}, more than any tyre provides: a real stroller would slip"
    return views.Show(
        name,
        colour,
        times,
        normal,
        SIZE * length,
        tuple(views.Body(part, place, views.turned(rotation), mesh) for part, place, rotation, mesh in parts),
        (
            views.Trace("path of the rear axle", rear, GREEN, 0.05 * length),
            views.Trace("path of the front wheel", front, BLUE, 0.025 * length),
        ),
        (
            views.Arrow("normal force, rear", rear, loads[:, :1] * up, "N", scale, VIOLET, width, through=True),
            views.Arrow("normal force, front", front, loads[:, 1:] * up, "N", scale, VIOLET, width, through=True),
            views.Arrow("side force, rear", rear, forces[:, :1] * rear_left, "N", scale, GOLD, width, 2.0 * length),
            views.Arrow("side force, front", front, forces[:, 1:] * front_left, "N", scale, GOLD, width, 2.0 * length),
        ),
        (
            views.Curve("speed [m/s]", reader(run.speed)),
            views.Curve("steering angle [rad]", reader(run.steering)),
            views.Curve("energy [J]", reader(run.energy)),
            views.Curve("normal force [N]", reader(run.normal_force)),
            views.Curve("friction that the tyres need [1]", reader(np.minimum(grip, DRAWN_GRIP).max(axis=-1))),
        ),
        warning if np.max(grip) > MOST_GRIP else "",
    )


def refined(run: Trajectory, radius: float) -> tuple[np.ndarray, Callable[[Values], np.ndarray]]:
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


def vehicle(length: float, colour: int) -> tuple[views.Mesh, ...]:
    """Axle, chassis, basket, handle and fork, as seen from the middle of the rear axle."""
    half, thickness = TRACK * length / 2.0, 0.025 * length
    low, high = 0.12 * length, 0.62 * length
    handle = [(-0.55 * length, sign * 0.3 * half, 0.95 * length) for sign in (1.0, -1.0)]
    posts = [
        views.bar((0.0, 0.3 * half * sign, low), handle[k], thickness, views.DARK) for k, sign in enumerate((1.0, -1.0))
    ]
    return (
        views.bar((0.0, -half, 0.0), (0.0, half, 0.0), thickness, views.DARK),
        views.bar((0.0, 0.0, 0.0), (0.92 * length, 0.0, 0.30 * length), thickness, views.DARK),
        views.bar((length, 0.0, 0.22 * length), (length, 0.0, 0.34 * length), 1.4 * thickness, views.DARK),
        views.bar((0.92 * length, 0.0, 0.30 * length), (length, 0.0, 0.30 * length), thickness, views.DARK),
        views.box(
            (0.62 * length, 1.1 * half, high - low), (0.22 * length, 0.0, (low + high) / 2.0 + 0.06 * length), colour
        ),
        views.box((0.5 * length, 0.9 * half, 0.02 * length), (0.22 * length, 0.0, high + 0.07 * length), views.PALE),
        *posts,
        views.bar(handle[0], handle[1], 1.3 * thickness, views.DARK),
    )


# A page with sliders that simulates a ride in the browser.

#: Number of curves of `show` that the page computes.
CURVES = 4

#: The quantities of a ride that the page draws.
SHOWN = ("position", "direction", "steering", "speed", "front_speed", "energy", "normal_force", "load", "side_force")


@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: str | Path | None = None,
    sliders: Sliders | None = None,
    t1: float = 8.0,
    input: Input | None = None,
    unit: Unit = None,
    jumps: Sequence[Any] | Array | None = None,
) -> views.Page:
    """Make a page with sliders that simulates the ride in the browser while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the
    Runge-Kutta pair and the step-size control are generated from those of `simulate` and of tables, at a tolerance of
    1e-7. The page also computes a map, over two of the sliders, of the distance between the ends of the ride; click on
    the map to set both sliders. The address of the page contains the slider values, so that you can copy a link to a
    ride. Press space to play or pause, and r to reset the sliders.

    **Arguments:**

    - `scene`, `launch`, `input`: the ride at the start, as for `simulate`.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value. The end of a name is enough if only one parameter
      matches, such as "launch.speed", "launch.steering" or "inertia". By default speed, steering angle, heading and
      friction.
    - `t1`: horizon [s].
    - `unit`: unit of the curves, such as "deg" for all angles.
    - `jumps`: times [s] at which the input jumps, as for `simulate`.

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with two sliders.

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> page = stroller.explore(scene, launch, sliders={"speed": (0.5, 3.0), "launch.steering": (-0.5, 0.5)}, t1=2.0)
    >>> len(page.html) < 2.5e6
    True

    ```
    """
    check_run(scene, launch, t1, input, TOLERANCE, jumps)
    return explore_model(RideModel.of(scene, launch, input, None, jumps), path, sliders, float(t1), unit)


@page_of.register(RideModel)
def page_of_ride(model: RideModel, sliders: Sliders | None, t1: float) -> tuple[LiveRun, views.Stage]:
    """The contents of the page, and the stage."""
    knobs = sliders_of(model, default_ranges(model.scene, model.launch) if sliders is None else sliders)
    live = live_run(
        model,
        model,
        knobs,
        t1,
        outcome,
        lambda drawn, time, rows, mode: frame(drawn.scene, drawn.input, time, rows),
        title=f"Stroller on a {type(model.scene.surface).__name__.lower()}",
        answer=("distance from the start", "m"),
        summaries=(Summary("speed", "m/s", 0), Summary("energy", "J", 2)),
        motion=rolling_ride,
    )
    return live, stage(runs_at_ends(model, knobs, t1))


def default_ranges(scene: Scene, launch: Launch) -> dict[str, tuple[float, float]]:
    """The default sliders: speed, steering angle, heading, and the parameters of friction."""
    speed, steering, heading = float(launch.speed), abs(float(launch.steering)), float(launch.heading)
    ranges = {
        "launch.speed": (min(0.0, 2.0 * speed), max(3.0, 2.0 * speed)),
        "launch.steering": (-max(0.9, steering), max(0.9, steering)),
        "launch.heading": (max(heading - math.pi, -2.0 * math.pi), min(heading + math.pi, 2.0 * math.pi)),
    }
    friction = numbers("scene.friction", scene.friction).items()
    damping = {path: float(value) for path, value in friction if value is not None and path.endswith("ing")}
    return ranges | {path: (0.0, 3.0 * value) for path, value in damping.items() if value > 0.0}


class WheelAngles(AbstractPassive):
    """The rolling angles of the left, the right and the front wheel of a ride."""

    def rates(self, problem: RideProblem, time: Float[Array, "..."], state: State, passive: State) -> State:
        """Each rear wheel, half a track from the middle, rolls as fast as the ground passes below it."""
        length = problem.dynamics.body.wheelbase
        motion = problem.dynamics.geometry(state).motion
        side_offset = 0.5 * TRACK * length * motion.yaw_rate
        speeds = jnp.stack([motion.speed - side_offset, motion.speed + side_offset, motion.front_speed])
        return jnp.concatenate([problem.field(time, state), speeds / (RADIUS * length)])


def rolling_ride(model: RideModel) -> ExtendedProblem[RideProblem]:
    """A ride of one cell with the rolling angles of its wheels."""
    ride = RideProblem.of(model.scene, model.launch, model.input, 1, False, model.jumps)
    return ExtendedProblem(ride, WheelAngles(), jnp.zeros((3, 1)), jnp.ones((3, 1)))


def outcome(model: RideModel, problem: RideProblem, lane: Any) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The `Status` of a ride and the distance of its end from its start [m], infinite if the ride is not completed."""
    first, last = problem.dynamics.unpack(problem.states)[0], problem.dynamics.unpack(lane.state)[0]
    squares = [(a - b) ** 2 for a, b in zip(first, last, strict=True) if a is not None and b is not None]
    status = model.ended(lane._replace(crossing_time=lane.first_crossing), TOLERANCE)[0]
    status = jnp.where(status == int(Status.EVENT), int(Status.CONTACT_LOST), status)
    return status, jnp.where(status == int(Status.COMPLETED), jnp.sqrt(sum(squares))[0], jnp.inf)


def stage(rides: list[Trajectory]) -> views.Stage:
    """The stage of the first ride, on a part of the ground that contains all rides."""
    (first,), scene = rides[0].stages(), rides[0].model.scene
    length = float(scene.body.wheelbase)
    points = np.concatenate([np.asarray(ride.position) for ride in rides])
    # The page would not update the curve of the friction that the tyres need, which `frame` does not compute.
    shows = tuple(show._replace(curves=show.curves[:CURVES]) for show in first.shows)
    ground = views.arena(scene.surface, points, first.arena.normal, 3.0 * length, length)
    return first._replace(shows=shows, arena=ground)


def frame(scene: Scene, controls: Input | None, time: Array, rows: Float[Array, "rows 1"]) -> Frame:
    """The drawn quantities of a stroller at one time, in the order of `show`. The rows end with the rolling angles of
    the wheels."""
    state = RideState(scene, controls, time, rows[:-3])
    outputs = {name: QUANTITIES[name].of(name, state)[0] for name in SHOWN}
    length, position = scene.body.wheelbase, outputs["position"]
    normal = normals(jnp, scene.surface, scene.side, position)
    posture = Posture.of(jnp, length, position, outputs["direction"], normal, outputs["steering"], rows[-3:, 0])
    rotations = [quaternion(rotation) for rotation in posture.rotations]
    (rear, front), load, side_force = posture.contacts, outputs["load"], outputs["side_force"]
    return Frame(
        normal=normal,
        bodies=tuple(zip(posture.places, rotations, strict=True)),
        traces=((rear, None), (front, None)),
        arrows=(
            (rear, load[0] * posture.up),
            (front, load[1] * posture.up),
            (rear, side_force[0] * posture.left[0]),
            (front, side_force[1] * posture.left[1]),
        ),
        curves=(outputs["speed"], outputs["steering"], outputs["energy"], outputs["normal_force"]),
        turning_rate=jnp.maximum(jnp.abs(outputs["speed"]), jnp.abs(outputs["front_speed"])) / (RADIUS * length),
    )


# The plot of the main job (needs matplotlib): paths on the ground, speed, energy and side forces.


def draw_rides(grounds: dict[str, AbstractSurface], rides: dict[tuple[str, str], Trajectory]) -> Any:
    """Draw rides, one row of plots per ground.

    **Arguments:**

    - `grounds`: name of a ground -> the ground.
    - `rides`: (name of a ground, name of a ride) -> its trajectory.

    **Returns:** a matplotlib figure.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(18.0, 4.2 * len(grounds)), layout="constrained")
    layout = figure.add_gridspec(len(grounds), 4, width_ratios=(1.5, 1.0, 1.0, 1.0))
    # As on the page, whose curves are those of all grounds, after that of a plan.
    colours = {name: views.css(views.COLOURS[number % len(views.COLOURS)]) for number, name in enumerate(rides, 1)}
    for row, (name, ground) in enumerate(grounds.items()):
        on_ground = {ride: run for (place_name, ride), run in rides.items() if place_name == name}
        space = figure.add_subplot(layout[row, 0], projection="3d")
        _draw_ground(space, ground, on_ground)
        panels = [figure.add_subplot(layout[row, column]) for column in (1, 2, 3)]
        for name_of_ride, run in on_ground.items():
            colour = colours[name, name_of_ride]
            space.plot(*np.asarray(run.position).T, color=colour, linewidth=1.4, label=name_of_ride)
            panels[0].plot(run.t, run.speed, color=colour)
            panels[1].plot(run.t, run.energy, color=colour)
            panels[1].plot(run.t, run.energy[0] + run.work, color="black", linewidth=0.8, linestyle=":")
            panels[2].plot(run.t, run.side_force[:, 0], color=colour)
            panels[2].plot(run.t, run.side_force[:, 1], color=colour, linestyle="--")
        space.set_title(name)
        space.legend(fontsize="small")
        for panel, label in zip(panels, ("speed [m/s]", "energy [J]", "side force [N]"), strict=True):
            panel.set_xlabel("time [s]")
            panel.set_ylabel(label)
        # The legend beside the path explains the colours; this one explains the line styles, above, where it hides
        # nothing.
        panels[1].set_title("dotted: start plus work", fontsize="small")
        panels[2].set_title("full: rear axle, dashed: front wheel", fontsize="small")
    return figure


def _draw_ground(space: Any, ground: AbstractSurface, rides: dict[str, Trajectory]) -> None:
    """A wire frame of the ground as far as the rides go."""
    from matplotlib.ticker import MaxNLocator

    places = np.concatenate([np.asarray(run.place) for run in rides.values()])
    first, second = (
        np.linspace(part.min() - 0.3, part.max() + 0.3, 13) if unit == "m" else np.linspace(-np.pi, np.pi, 49)
        for part, (_, unit) in zip(places.T, ground.coordinates, strict=True)
    )
    if isinstance(ground, AbstractQuadric):
        second = np.linspace(-np.pi / 2, min(places[:, 1].max() + 0.1, np.pi / 2), 13)
    grid = tuple(np.meshgrid(first, second, indexing="ij"))
    x, y, z = (np.asarray(part) for part in ground.in_fixed_frame(ground.chart(grid)[0]))
    space.plot_wireframe(x, y, z, color="0.75", linewidth=0.4)
    space.set_xlabel("x [m]", labelpad=8)
    space.set_ylabel("y [m]", labelpad=8)
    space.set_zlabel("z [m]")
    # As many ticks along each axis as there is room for.
    spans = [np.ptp(part) for part in (x, y, z)]
    for axis, span in zip((space.xaxis, space.yaxis, space.zaxis), spans, strict=True):
        axis.set_major_locator(MaxNLocator(max(round(4.0 * span / max(spans)), 1)))
    # A plane has nearly no height to show.
    if spans[2] < 0.1 * max(spans):
        space.set_zticks([])
        space.set_zlabel("")
    space.set_aspect("equal")
