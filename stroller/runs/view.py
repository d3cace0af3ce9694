"""The drawing of a ride, and its page with sliders."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic import views
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration.problem import AbstractPassive, AbstractProblem, ExtendedProblem, Status
from nonholonomic.parameters import numbers
from nonholonomic.runs.model import Sliders
from nonholonomic.runs.trajectory import TOLERANCE, explore_model, live_run, page_of, runs_at_ends, sliders_of
from nonholonomic.terminal import status_line
from nonholonomic.text import Unit
from nonholonomic.validation import explaining
from nonholonomic.views.pages import Frame, LiveRun
from nonholonomic.views.stage import Kind, fixed

from ..model.input import Input
from ..model.scene import DRIVES, Launch, RideProblem, Scene, State
from .model import FORM, RideModel, checked_model
from .trajectory import MOST_GRIP, QUANTITIES, RideState, Trajectory

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


#: The traces of a vehicle with their colours and widths [wheelbases], and the forces with their colours and longest arrows
#: [wheelbases].
TRACES = (("path of the rear axle", GREEN, 0.05), ("path of the front wheel", BLUE, 0.025))
FORCES = (("normal force, rear", VIOLET, None), ("normal force, front", VIOLET, None))
FORCES += (("side force, rear", GOLD, 2.0), ("side force, front", GOLD, 2.0))

#: The quantities of a ride that are drawn.
SHOWN = ("position", "direction", "steering", "speed", "front_speed", "energy", "normal_force", "load", "side_force")

#: The curves that a page computes.
CURVES = {"speed": ("speed", "m/s"), "steering": ("steering angle", "rad"), "energy": ("energy", "J")}
CURVES |= {"normal_force": ("normal force", "N")}


@views.stage_of.register(Trajectory)
def stage_of_rides(
    run: Trajectory, rides: list[Trajectory], numbers: Sequence[int], names: Sequence[str]
) -> views.Stage:
    """The stage of rides on a common ground."""
    shows = tuple(show(ride, number, name) for ride, number, name in zip(rides, numbers, names, strict=True))
    return views.Stage("; ".join(names), ground_of(rides, shows[0].normal[0]), shows)


def ground_of(rides: list[Trajectory], normal: np.ndarray, *more: np.ndarray) -> views.Arena:
    """The part of the ground on which rides take place, with more points [m]."""
    scene, points = rides[0].model.scene, np.concatenate([*(np.asarray(ride.position) for ride in rides), *more])
    length = float(scene.body.wheelbase)
    return views.stage.arena(scene.surface, points, normal, 3.0 * length, length)


def normals(scene: Scene, position: Kind) -> Kind:
    """Unit normals of the ground at positions (*times, 3), towards the stroller."""
    xp, surface = position.__array_namespace__(), scene.surface
    outward: Any = fixed(surface, surface.normal(surface.in_own_axes(tuple(position.T))), xp)
    return surface.sign(scene.side, DRIVES) * xp.broadcast_to(outward, position.shape)


def frame_of(scene: Scene, normal: Kind, values: dict[str, Kind], angles: Sequence[Kind] | Kind) -> Frame[Kind]:
    """What is drawn of a ride: frame, left, right and front wheel; `TRACES`, `FORCES` and `CURVES`.

    **Arguments:** `normal`: that of the ground; `values`: the quantities `SHOWN` (*times, ...); `angles` [rad] by which left,
    right and front wheel have rolled.
    """
    xp, position = normal.__array_namespace__(), values["position"]
    length = xp.asarray(scene.body.wheelbase)
    x = values["direction"] / xp.linalg.norm(values["direction"], axis=-1, keepdims=True)
    y = xp.cross(normal, x)
    y = y / xp.linalg.norm(y, axis=-1, keepdims=True)
    z = xp.cross(x, y)
    cosine, sine = xp.cos(values["steering"])[..., None], xp.sin(values["steering"])[..., None]
    forward, left = cosine * x + sine * y, cosine * y - sine * x
    radius, half = RADIUS * length, 0.5 * TRACK * length
    axle, front = position + radius * z, position + length * x + radius * z
    bodies = [(axle, views.stage.quaternion(xp.stack([x, y, z], axis=-1)))]
    ends = ((axle + half * y, x, y), (axle - half * y, x, y), (front, forward, left))
    for (place, ahead, axis), angle in zip(ends, angles, strict=True):
        cosine, sine = xp.cos(angle)[..., None], xp.sin(angle)[..., None]
        rotation = xp.stack([cosine * ahead - sine * z, axis, sine * ahead + cosine * z], axis=-1)
        bodies.append((place, views.stage.quaternion(rotation)))
    # Above the ground, where lines are visible.
    contacts = [position + 0.02 * radius * z, position + length * x + 0.02 * radius * z]
    forces = [(contact, values["load"][..., k, None] * z) for k, contact in enumerate(contacts)]
    lefts = zip(contacts, (y, left), strict=True)
    forces += [(contact, values["side_force"][..., k, None] * axis) for k, (contact, axis) in enumerate(lefts)]
    return Frame(
        normal=normal,
        bodies=tuple(bodies),
        traces=tuple((contact, None) for contact in contacts),
        arrows=tuple(forces),
        curves=tuple(values[name] for name in CURVES),
        turning_rate=xp.maximum(xp.abs(values["speed"]), xp.abs(values["front_speed"])) / radius,
    )


def show(run: Trajectory, number: int, name: str) -> views.Show:
    """The drawing of one ride, the `number`-th of a page."""
    from scipy.integrate import cumulative_trapezoid

    scene = run.model.scene
    length, colour = float(scene.body.wheelbase), views.COLOURS[number % len(views.COLOURS)]
    radius, yaw = RADIUS * length, 0.5 * TRACK * length * np.asarray(run.yaw_rate)
    times, reader = refined(run, radius)
    speeds = (np.asarray(run.speed) - yaw, np.asarray(run.speed) + yaw, np.asarray(run.front_speed))
    angles = [reader(cumulative_trapezoid(speed / radius, np.asarray(run.t), initial=0.0)) for speed in speeds]
    values, normal = {name: reader(run[name]) for name in SHOWN}, reader(normals(scene, np.asarray(run.position)))
    frame = frame_of(scene, normal, values, angles)
    wheel_mesh = views.stage.wheel(radius, WIDTH * length, (views.DARK, views.PALE))
    meshes = (vehicle(length, colour), wheel_mesh, wheel_mesh, wheel_mesh)
    scale, width = WEIGHT * length / float(scene.body.mass * scene.gravity), 0.035 * length
    grip = np.asarray(run["grip"])[:, : len(run.loaded_axles)]
    needed = reader(np.minimum(np.round(grip, 12), DRAWN_GRIP)).max(axis=-1)
    warning = f"needs friction {np.max(grip):.2g}, more than any tyre provides: a real stroller would slip"
    return views.Show(
        name,
        colour,
        times,
        normal,
        SIZE * length,
        tuple(views.Body(*pose, mesh) for pose, mesh in zip(frame.bodies, meshes, strict=True)),
        tuple(
            views.Trace(label, points, colour, share * length)
            for (label, colour, share), (points, _) in zip(TRACES, frame.traces, strict=True)
        ),
        tuple(
            views.Arrow(
                label, start, vector, "N", scale, colour, width, limit and limit * length, through=limit is None
            )
            for (label, colour, limit), (start, vector) in zip(FORCES, frame.arrows, strict=True)
        ),
        (
            *(views.Curve(*curve, values) for curve, values in zip(CURVES.values(), frame.curves, strict=True)),
            views.Curve("friction that the tyres need", "1", needed),
        ),
        warning if np.max(grip) > MOST_GRIP else "",
    )


def refined(run: Trajectory, radius: float) -> tuple[np.ndarray, Callable[[Array | np.ndarray], np.ndarray]]:
    """Times so close that the wheels roll little between them, including the times of the ride, and a function that
    returns the ride's numbers at these times."""
    times = np.asarray(run.t)
    if len(times) < 4:
        return times, np.asarray
    from scipy.interpolate import CubicSpline

    gaps = np.diff(times)
    roll_angles = np.maximum(np.abs(run.speed), np.abs(run.front_speed)).max() * gaps / radius
    parts = np.clip(np.ceil(roll_angles / ROLL_PER_FRAME), 1, 20).astype(int)
    pieces = [a + (b - a) * np.arange(n) / n for a, b, n in zip(times, times[1:], parts, strict=False)]
    refined_times = np.concatenate([*pieces, times[-1:]])
    return refined_times, lambda values: CubicSpline(times, np.asarray(values))(refined_times)


def vehicle(length: float, colour: int) -> tuple[views.Mesh, ...]:
    """Axle, chassis, basket, handle and fork, as seen from the middle of the rear axle."""
    half, thickness = TRACK * length / 2.0, 0.025 * length
    low, high = 0.12 * length, 0.62 * length
    handle = [(-0.55 * length, sign * 0.3 * half, 0.95 * length) for sign in (1.0, -1.0)]
    posts = [views.stage.bar((0.0, end[1], low), end, thickness, views.DARK) for end in handle]
    return (
        views.stage.bar((0.0, -half, 0.0), (0.0, half, 0.0), thickness, views.DARK),
        views.stage.bar((0.0, 0.0, 0.0), (0.92 * length, 0.0, 0.30 * length), thickness, views.DARK),
        views.stage.bar((length, 0.0, 0.22 * length), (length, 0.0, 0.34 * length), 1.4 * thickness, views.DARK),
        views.stage.bar((0.92 * length, 0.0, 0.30 * length), (length, 0.0, 0.30 * length), thickness, views.DARK),
        views.stage.box(
            (0.62 * length, 1.1 * half, high - low), (0.22 * length, 0.0, (low + high) / 2.0 + 0.06 * length), colour
        ),
        views.stage.box(
            (0.5 * length, 0.9 * half, 0.02 * length), (0.22 * length, 0.0, high + 0.07 * length), views.PALE
        ),
        *posts,
        views.stage.bar(handle[0], handle[1], 1.3 * thickness, views.DARK),
    )


# A page with sliders that simulates a ride in the browser.


@explaining
@status_line("writing a page")
def explore(
    scene: Scene,
    launch: Launch,
    path: str | Path | None = None,
    sliders: Sliders | None = None,
    t1: float = 8.0,
    input: Input | None = None,
    unit: Unit = None,
    jumps: Sequence[ArrayLike] | Array | None = None,
    label: str | None = None,
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
    - `label`: title of the page.

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
    model = checked_model(scene, launch, t1, input, TOLERANCE, jumps)
    return explore_model(model, path, sliders, float(t1), unit, label)


@page_of.register(RideModel)
def page_of_ride(model: RideModel, sliders: Sliders | None, t1: float) -> tuple[LiveRun, views.Stage]:
    """The contents of the page, and the stage."""

    def rolling(model: RideModel) -> AbstractProblem:
        """A ride of one cell with the rolling angles of its wheels."""
        return ExtendedProblem(model.problem(1, None), WheelAngles(), jnp.zeros((3, 1)), jnp.ones((3, 1)))

    def frame(drawn: RideModel, time: Array, rows: Float[Array, "rows 1"], mode: object) -> Frame[Array]:
        # The rows end with the rolling angles of the wheels.
        state = RideState(drawn.scene, drawn.input, time, rows[:-3])
        values = {name: QUANTITIES[name].of(name, state)[0] for name in SHOWN}
        return frame_of(drawn.scene, normals(drawn.scene, values["position"]), values, rows[-3:, 0])

    def distance(model: RideModel, ended: HybridOutcome, status: Array) -> Array:
        """From the start of a ride to its end [m], infinite if the ride is not completed."""
        problem: Any = model.problem(1, ())
        first, last = problem.dynamics.unpack(problem.states)[0], problem.dynamics.unpack(ended.state)[0]
        squares = [(a - b) ** 2 for a, b in zip(first, last, strict=True) if a is not None and b is not None]
        return jnp.where(status == int(Status.COMPLETED), jnp.sqrt(sum(squares))[0], jnp.inf)

    knobs = sliders_of(model, default_ranges(model.scene, model.launch) if sliders is None else sliders)
    live = live_run(
        model,
        model,
        knobs,
        t1,
        frame,
        title=f"Stroller on a {type(model.scene.surface).__name__.lower()}",
        answer=("distance from the start", "m"),
        summaries=(0, 2),
        named=FORM.named,
        result=distance,
        motion=rolling,
    )
    rides = runs_at_ends(model, knobs, t1)
    (stage,) = rides[0].stages()
    # The page would not update the curve of the friction that the tyres need, which `frame` does not compute.
    shows = tuple(show._replace(curves=show.curves[: len(CURVES)]) for show in stage.shows)
    # On a part of the ground that contains all rides.
    return live, stage._replace(shows=shows, arena=ground_of(rides, stage.arena.normal))


def default_ranges(scene: Scene, launch: Launch) -> dict[str, tuple[float, float]]:
    """The default sliders: speed, steering angle, heading, and the parameters of friction."""
    speed, steering, heading = float(launch.speed), abs(float(launch.steering)), float(launch.heading)
    ranges = {
        "launch.speed": (min(0.0, 2.0 * speed), max(3.0, 2.0 * speed)),
        "launch.steering": (-max(0.9, steering), max(0.9, steering)),
        "launch.heading": (max(heading - np.pi, -2.0 * np.pi), min(heading + np.pi, 2.0 * np.pi)),
    }
    friction = numbers("scene.friction", scene.friction).items()
    damping = {path: float(value) for path, value in friction if value is not None and path.endswith("ing")}
    return ranges | {path: (0.0, 3.0 * value) for path, value in damping.items() if value > 0.0}


class WheelAngles(AbstractPassive):
    """The rolling angles of the left, the right and the front wheel of a ride."""

    def rates(self, problem: RideProblem, time: Float[Array, "..."], state: State, passive: Array) -> Array:
        """Each rear wheel, half a track from the middle, rolls as fast as the ground passes below it."""
        length = problem.dynamics.body.wheelbase
        motion = problem.dynamics.geometry(state).motion
        side_offset = 0.5 * TRACK * length * motion.yaw_rate
        speeds = jnp.stack([motion.speed - side_offset, motion.speed + side_offset, motion.front_speed])
        return jnp.concatenate([problem.field(time, state), speeds / (RADIUS * length)])
