"""A page with sliders that simulates a ride in the browser."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.integration import AbstractPassive, ExtendedProblem
from nonholonomic.integration.status import Status
from nonholonomic.parameters import numbers
from nonholonomic.runs import TOLERANCE, live_run, page_of, runs_at_ends, sliders_of
from nonholonomic.views import Stage, arena
from nonholonomic.views.explore import Frame, LiveRun, Summary, quaternion

from ..model.dynamics import State
from ..model.input import Input
from ..model.launch import Launch
from ..model.ride import RideProblem
from ..model.scene import Scene
from .model import RideModel
from .quantities import RideState
from .trajectory import Trajectory
from .view import RADIUS, TRACK, Posture, normals

#: Number of curves of `view.show` that the page computes.
CURVES = 4

#: The quantities of a ride that the page draws.
SHOWN = ("position", "direction", "steering", "speed", "front_speed", "energy", "normal_force", "load", "side_force")


@page_of.register(RideModel)
def page_of_ride(model: RideModel, sliders: Any, t1: float) -> tuple[LiveRun, Stage]:
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
        "launch.heading": (heading - math.pi, heading + math.pi),
    }
    friction = numbers("scene.friction", scene.friction).items()
    damping = {path: float(value) for path, value in friction if value is not None and path.endswith("ing")}
    return ranges | {path: (0.0, 3.0 * value) for path, value in damping.items() if value > 0.0}


class WheelAngles(AbstractPassive):
    """The rolling angles of the left, the right and the front wheel of a ride."""

    def rates(self, problem: Any, time: Float[Array, "..."], state: State, passive: State) -> State:
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


def outcome(model: RideModel, problem: Any, lane: Any) -> tuple[Int[Array, ""], Float[Array, ""]]:
    """The `Status` of a ride and the distance of its end from its start [m], infinite if the ride is not completed."""
    first, last = problem.dynamics.unpack(problem.states)[0], problem.dynamics.unpack(lane.state)[0]
    squares = [(a - b) ** 2 for a, b in zip(first, last, strict=True) if a is not None and b is not None]
    status = model.ended(lane._replace(crossing_time=lane.first_crossing), TOLERANCE)[0]
    status = jnp.where(status == int(Status.EVENT), int(Status.CONTACT_LOST), status)
    return status, jnp.where(status == int(Status.COMPLETED), jnp.sqrt(sum(squares))[0], jnp.inf)


def stage(rides: list[Trajectory]) -> Stage:
    """The stage of the first ride, on a part of the ground that contains all rides."""
    (first,), scene = rides[0].stages(), rides[0].spec.scene
    length = float(scene.body.wheelbase)
    points = np.concatenate([np.asarray(ride.position) for ride in rides])
    # The page would not update the curve of the friction that the tyres need, which `frame` does not compute.
    shows = tuple(show._replace(curves=show.curves[:CURVES]) for show in first.shows)
    ground = arena(scene.surface, points, first.arena.normal, 3.0 * length, length)
    return first._replace(shows=shows, arena=ground)


def frame(scene: Scene, controls: Input | None, time: Any, rows: Float[Array, "rows 1"]) -> Frame:
    """The drawn quantities of a stroller at one time, in the order of `view.show`. The rows end with the rolling angles of
    the wheels."""
    state = RideState(scene, controls, time, rows[:-3])
    outputs = {name: getattr(state, name)[0] for name in SHOWN}
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
