"""A planning problem, checked before anything compiles, and the check of a drive."""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import CubicSpline

from nonholonomic.geometry import AbstractSurface, Plane, cross, scale
from nonholonomic.integration.problem import require_run
from nonholonomic.text import readable_unit, shown
from nonholonomic.validation import (
    Bound,
    Bounded,
    as_number,
    as_number_or_none,
    require,
    require_all,
    require_kind,
    require_scalars,
)

from ..model.dynamics import padded
from ..model.scene import Scene
from ..model.vehicle import Launch, as_place, suspected_degrees
from ..runs.trajectory import Trajectory
from ..runs.verbs import simulate
from .obstacles import Box, Disc, Footprint, require_obstacles
from .transcription import seen_from_above

# Flat maps of the ground, on which paths are searched: x and y where the ground names its places so, and otherwise the
# tangent plane between start and goal, whose points the nearest points of the ground represent.


def is_flat(surface: AbstractSurface) -> bool:
    """Whether the ground names its places by two lengths, x and y."""
    return tuple(surface.coordinates) == (("x", "m"), ("y", "m"))


class Chart(eqx.Module):
    """A map of the ground. On a curved one, `origin` and the unit vectors `east` and `north` span the tangent plane."""

    surface: AbstractSurface
    origin: Float[Array, " 3"] | None = None
    east: Float[Array, " 3"] | None = None
    north: Float[Array, " 3"] | None = None

    @classmethod
    def between(cls, surface: AbstractSurface, side: float, start: Any, goal: Any) -> "Chart":
        """A map for a start and a goal, whose positions are in the ground's axes."""
        if is_flat(surface):
            return cls(surface)
        middle = surface.nearest(padded((jnp.asarray(start) + jnp.asarray(goal)) / 2.0))
        position, east, _ = surface.chart(surface.place_at(middle))
        north = scale(side, cross(surface.normal(position), east))
        zero = jnp.zeros(())
        columns = [jnp.stack([zero if part is None else zero + part for part in v]) for v in (position, east, north)]
        return cls(surface, *columns)

    def position(self, point: Float[Array, " 2"]) -> Float[Array, " axes"]:
        """The position [m] of a point of the map, in the ground's axes."""
        if self.origin is None or self.east is None or self.north is None:
            place = self.surface.charted((point[0], point[1]))[0]
        else:
            place = self.surface.nearest(padded(self.origin + point[0] * self.east + point[1] * self.north))
        return jnp.stack(place[: self.surface.axes])

    def point(self, pose: Any) -> np.ndarray:
        """The point and the heading (x, y, angle) on the map of a pose."""
        axes = self.surface.axes
        place, heading = np.asarray(pose[:axes]), np.asarray(pose[axes:])
        if self.origin is not None:
            plane = np.stack([np.asarray(self.east), np.asarray(self.north)])
            place, heading = plane @ (place - np.asarray(self.origin)), plane @ heading
        return np.array([place[0], place[1], np.arctan2(heading[1], heading[0])])

    @eqx.filter_jit
    def poses(self, points: Float[Array, "n 3"]) -> Float[Array, "n components"]:
        """The poses of points and headings on the map."""

        def pose(point):
            place, along = jax.jvp(self.position, (point[:2],), (jnp.stack([jnp.cos(point[2]), jnp.sin(point[2])]),))
            return jnp.concatenate([place, along / jnp.sqrt(jnp.sum(along**2))])

        return jax.vmap(pose)(points)


# What a plan must achieve, and what it must not exceed.

#: A bound [any unit] that nothing reaches.
UNLIMITED = 1e9

#: The greatest steering angle [rad] of plans without a limit of their own.
MOST_STEERING = 1.2


class Goal(Bounded):
    """Where a plan ends, and how fast.

    **Arguments:**

    - `place`: position of the rear axle, in the surface's coordinates, as in `Launch`.
    - `heading`: angle [rad] of the heading, as in `Launch`; `None` for any heading.
    - `speed`: speed [m/s] of the rear axle, negative in reverse.
    - `within`: greatest error at the end: of the place [m], of the heading [rad] and of the speed [m/s]; positive.

    **Raises:** `ValueError` for numbers out of range.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Goal(place=(1.9, 0.3), heading=0.0)
    Goal(place=(1.9, 0.3) m or rad, heading=0 rad, speed=0 m/s, within=0.05)

    ```
    """

    units: ClassVar[dict[str, str]] = {"place": "m or rad", "heading": "rad", "speed": "m s-1", "within": "1"}

    place: tuple[Float[Array, ""], ...] = eqx.field(converter=as_place)
    heading: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    speed: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    within: Float[Array, ""] = eqx.field(converter=as_number, default=0.05)

    def __check_init__(self):
        if not (isinstance(self.place, tuple) and len(self.place) in (2, 3)):
            raise ValueError(f"place = {shown(self.place)} must be a pair of numbers, or (x, y, z) [m]")

    def suspicion(self) -> str | None:
        return suspected_degrees(self)

    def bounds(self) -> Iterator[Bound]:
        for k, number in enumerate(self.place if isinstance(self.place, tuple) else ()):
            yield Bound(number, f"place[{k}]")
        if self.heading is not None:
            yield Bound(self.heading, "heading")
        yield Bound(self.speed, "speed")
        yield Bound(self.within, "within", above=0.0)


def as_range(value: Any) -> Any:
    """A bound as the pair (-bound, bound); a pair and `None` stay as they are."""
    if value is None:
        return None
    try:
        return tuple(as_number(number) for number in tuple(value))
    except TypeError:
        bound = as_number(value)
        return (-bound, bound) if isinstance(bound, Array) else value


class Limits(Bounded):
    """The ranges that a plan must not leave, each a pair (low, high) or one number b for (-b, b); `None` for no limit.
    A plan may exceed a limit by 0.001 of its range, so that a limit can be the very value at the start or at the goal, as
    in `speed=(0.0, 0.8)` for a plan that never reverses.

    **Arguments:**

    - `steering`: steering angle [rad]; by default, plans steer by at most 1.2 rad.
    - `speed`: speed [m/s] of the rear axle.
    - `force`: drive force [N].
    - `torque`: steering torque [N m].
    - `grip`: coefficient of friction that the tyres need.

    **Raises:** `ValueError` if a range is empty or not made of numbers.

    **Example:**

    ```
    >>> import stroller
    >>> stroller.Limits(steering=1.0, speed=(-0.5, 0.8))
    Limits(steering=(-1, 1) rad, speed=(-0.5, 0.8) m/s)

    ```
    """

    units: ClassVar[dict[str, str]] = {"steering": "rad", "speed": "m s-1", "force": "N", "torque": "N m", "grip": "1"}

    steering: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    speed: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    force: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    torque: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)
    grip: tuple[Float[Array, ""], ...] | None = eqx.field(converter=as_range, default=None)

    def __check_init__(self):
        for name in self.units:
            value = getattr(self, name)
            if value is not None and not (isinstance(value, tuple) and len(value) == 2):
                raise ValueError(f"{name} = {shown(value)} must be a bound, such as 1.0, or a pair (low, high)")

    def suspicion(self) -> str | None:
        return suspected_degrees(self)

    def bounds(self) -> Iterator[Bound]:
        for name in self.units:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) == 2:
                yield Bound(value[0], f"{name}[0]")
                yield Bound(value[1], f"{name}[1]", above=value[0], why="the lower bound")

    def ranges(self) -> dict[str, tuple[float, float]]:
        """The limits by name; those that are `None` are left out."""
        pairs = {name: getattr(self, name) for name in self.units}
        return {name: (float(pair[0]), float(pair[1])) for name, pair in pairs.items() if pair is not None}

    def arrays(self, reserve: float) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of all quantities, narrowed by a share of each range.

        **Arguments:** `reserve`: the share.
        """
        free = {"steering": (-MOST_STEERING, MOST_STEERING)}
        ranges = {name: (-UNLIMITED, UNLIMITED) for name in self.units} | free | self.ranges()
        low, high = np.array([ranges[name] for name in self.units]).T
        narrowed = reserve * (high - low) / 2.0
        return low + narrowed, high - narrowed


# A planning problem, checked before anything compiles.

#: Headings at which a goal without a heading is examined.
HEADINGS = 72


class Problem(NamedTuple):
    """A planning problem, as the user states it."""

    scene: Scene
    launch: Launch
    goal: Goal
    obstacles: tuple[Box | Disc, ...]
    limits: Limits
    footprint: Footprint

    def pose(self, place: Any, heading: Any) -> Any:
        """Position and heading, in the ground's axes, as one array."""
        surface = self.scene.surface
        position, east, north = surface.chart(place)
        direction = self.scene.dynamics.heading.at_angle(heading, east, north)
        return jnp.stack([*position[: surface.axes], *direction[: surface.axes]])

    @property
    def start_pose(self) -> Any:
        """The pose of the launch."""
        return self.pose(self.launch.place, self.launch.heading)

    @property
    def goal_pose(self) -> Any:
        """The pose of the goal; its heading is 0 if the goal has none."""
        return self.pose(self.goal.place, 0.0 if self.goal.heading is None else self.goal.heading)

    @property
    def is_flat(self) -> bool:
        """Whether the ground names its places by x and y."""
        return is_flat(self.scene.surface)

    @property
    def goal_corners(self) -> np.ndarray:
        """The corners (4, 2) [m] of the footprint at the goal, seen from above."""
        return np.asarray(self.footprint.corners(*seen_from_above(self.scene.dynamics, self.goal_pose)))

    def gaps(self, pose: Any) -> np.ndarray:
        """The distance [m] of the footprint at a pose from every obstacle, negative for an overlap."""
        corners = self.footprint.corners(*seen_from_above(self.scene.dynamics, pose))
        return np.array([obstacle.distance(np.asarray(corners)) for obstacle in self.obstacles])

    @property
    def clearance_at_ends(self) -> float:
        """The distance [m] of the footprint from the obstacles at the start and at the goal; infinite without obstacles."""
        if not self.obstacles:
            return np.inf
        return float(min(self.gaps(self.start_pose).min(), self._gaps_at_goal().min()))

    def _gaps_at_goal(self) -> np.ndarray:
        """The distance [m] from every obstacle at the goal; at the best of all headings if the goal has none."""
        if self.goal.heading is not None:
            return self.gaps(self.goal_pose)
        headings = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
        return max((self.gaps(self.pose(self.goal.place, heading)) for heading in headings), key=np.min)


def checked_problem(
    scene: Any, launch: Any, goal: Any, t1: Any, obstacles: Any, limits: Any, footprint: Any, tolerance: Any
) -> Problem:
    """A planning problem; raises `ValueError` unless its parts are legal and its start and goal are free."""
    require_run(scene, launch, t1, tolerance, (Scene, Launch), "plan each problem by a call of its own")
    scene.check(launch)
    if scene.heading == "projected" and not isinstance(scene.surface, Plane):
        raise ValueError("heading = 'projected' must be 'intrinsic' for a plan on a curved ground")
    require_kind(goal, "goal", Goal)
    require_scalars(
        {f"goal.{name}": getattr(goal, name) for name in ("heading", "speed", "within")}, "plan one goal at a time"
    )
    limits = Limits() if limits is None else limits
    require_kind(limits, "limits", Limits)
    footprint = Footprint.of(scene.body) if footprint is None else footprint
    require_kind(footprint, "footprint", Footprint)
    problem = Problem(scene, launch, goal, require_obstacles(obstacles), limits, footprint)
    _require_goal_on_ground(problem)
    _require_limits(problem)
    _require_free(problem)
    return problem


def _require_goal_on_ground(problem: Problem) -> None:
    scene, goal = problem.scene, problem.goal
    try:
        require_all(scene.surface.place_bounds(goal.place, scene.body.wheelbase))
    except ValueError as error:
        raise ValueError(f"goal: {error}") from None
    if not np.all(np.isfinite(problem.goal_pose)):
        raise ValueError(f"goal: place = {goal.place} must be on the ground, where it has no finite position")


def _require_limits(problem: Problem) -> None:
    """Raise `ValueError` if the start or the goal is out of the limits."""
    launch, goal = problem.launch, problem.goal
    values = [("launch.steering", launch.steering), ("launch.speed", launch.speed), ("goal.speed", goal.speed)]
    ranges = problem.limits.ranges()
    for name, value in values:
        low, high = ranges.get(name.partition(".")[2], (None, None))
        require(
            value, name, at_least=low, at_most=high, why="limits; no plan can keep a limit that is broken at its ends"
        )


def _require_free(problem: Problem) -> None:
    """Raise `ValueError` for obstacles on a ground without x and y, and for a start or a goal that touches an obstacle."""
    surface = problem.scene.surface
    if not problem.obstacles:
        return
    if not problem.is_flat:
        names = ", ".join(f"{name} [{unit}]" for name, unit in surface.coordinates)
        raise ValueError(
            f"obstacles: a {type(surface).__name__} names its places ({names}); obstacles need a ground with places "
            "(x [m], y [m]), such as a Plane or a Graph"
        )
    for name, gaps in (("launch", problem.gaps(problem.start_pose)), ("goal", problem._gaps_at_goal())):
        if gaps.min() <= 0.0:
            nearest = int(np.argmin(gaps))
            place = ", ".join(f"{float(number):g}" for number in getattr(problem, name).place)
            raise ValueError(
                f"{name}: at place = ({place}) the footprint overlaps obstacles[{nearest}] by {abs(gaps[nearest]):.3g} m: "
                f"move the {name} or the obstacle, or pass a smaller footprint"
            )


# The check of a drive: a run at a tight tolerance, the exact clearance of the whole footprint, and every limit.

#: Times of a run that is compared with others and of one that is confirmed, and how many times finer the closest approaches
#: are examined.
COMPARED, CONFIRMED, FINER = 501, 2001, 10

#: By how much a limit may be exceeded, in units of its range: a drive keeps the speed and the angle of a plan up to small
#: errors, and a limit may be the very value at its start or goal.
ALLOWED = 1e-3


class Verdict(NamedTuple):
    """What a run achieves: its errors at the end (place [m], heading [rad], speed [m/s]), the clearance [m], the margin of
    every limit, the effort [N^2 s], and what is wrong: a number, 0 for a solution, and the reasons in words."""

    errors: tuple[float, float, float]
    clearance: float
    margins: dict[str, float]
    effort: float
    excess: float
    hindrances: tuple[str, ...]


def clearance_of(run: Trajectory, problem: Problem) -> tuple[float, int]:
    """The least distance [m] between the footprint and an obstacle, negative for an overlap, and the obstacle's number;
    infinite without obstacles."""
    if not problem.obstacles:
        return np.inf, -1
    corners = corners_of(run, problem)
    coarse = np.stack([obstacle.distance(corners) for obstacle in problem.obstacles], axis=-1)
    times = np.asarray(run.t)
    # Between two times, no corner moves further than this.
    moved = np.linalg.norm(np.diff(corners, axis=0), axis=-1).max(axis=-1)
    lower = np.minimum(coarse[:-1], coarse[1:]) - moved[:, None]
    path = CubicSpline(times, corners)
    least, nearest = coarse.min(), int(np.argmin(coarse.min(axis=0)))
    for number, obstacle in enumerate(problem.obstacles):
        step = np.flatnonzero(lower[:, number] < least)
        inner = times[step][:, None] + np.diff(times)[step][:, None] * np.arange(1, FINER) / FINER
        fine = obstacle.distance(path(inner.ravel())).min(initial=np.inf)
        if fine < least:
            least, nearest = fine, number
    return float(least), nearest


def corners_of(run: Trajectory, problem: Problem) -> np.ndarray:
    """The corners [m] of the footprint at the times of a run, seen from above: (times, 4, 2)."""
    return np.asarray(_corners(problem.scene.dynamics, problem.footprint, jnp.asarray(run.state)))


@eqx.filter_jit
def _corners(dynamics: Any, footprint: Footprint, states: Any) -> Any:
    axes = dynamics.surface.axes
    return jax.vmap(lambda state: footprint.corners(*seen_from_above(dynamics, state[: 2 * axes])))(states)


def inputs_of(run: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """The force [N] and the torque [N m] of a run at its times."""
    force, torque = _inputs(run.model, run.t, run.state)
    return np.asarray(force), np.asarray(torque)


@eqx.filter_jit
def _inputs(model: Any, times: Any, states: Any) -> Any:
    def at(t, state):
        return model.input(t, model.scene.dynamics.geometry(state).motion)

    return jax.vmap(at)(times, states)


def margins_of(run: Trajectory, limits: Limits) -> dict[str, float]:
    """The distance of a run from every limit, negative where it is exceeded."""
    force, torque = inputs_of(run)
    values = {"steering": run.steering, "speed": run.speed, "force": force, "torque": torque}
    values["grip"] = run.grip()[:, : len(run.loaded_axles)]
    return {
        name: float(min(np.min(values[name]) - low, high - np.max(values[name])))
        for name, (low, high) in limits.ranges().items()
    }


def errors_of(run: Trajectory, problem: Problem) -> tuple[float, float, float]:
    """The errors at the end: of the place [m], of the heading [rad] and of the speed [m/s]."""
    goal, axes = problem.goal, problem.scene.surface.axes
    target = np.asarray(problem.goal_pose)
    end = np.asarray(run.state[-1, : 2 * axes])
    turn = 0.0
    if goal.heading is not None:
        turn = 2.0 * np.arcsin(min(1.0, 0.5 * np.linalg.norm(end[axes:] - target[axes:])))
    place = float(np.linalg.norm(end[:axes] - target[:axes]))
    return place, float(turn), abs(float(run.speed[-1]) - float(goal.speed))


def judge(run: Trajectory, problem: Problem) -> Verdict:
    """What a run achieves, and what stands in the way."""
    errors, margins = errors_of(run, problem), margins_of(run, problem.limits)
    clearance, nearest = clearance_of(run, problem)
    within, length = float(problem.goal.within), float(problem.footprint.length)
    units = {name: readable_unit(unit) for name, unit in Limits.units.items()}
    # What is wrong, each relative to what is allowed, and the words for it.
    wrong = [
        (error / within - 1.0, f"the {name} at the end is off by {error:.3g} {unit}")
        for name, unit, error in zip(("place", "heading", "speed"), ("m", "rad", "m/s"), errors, strict=True)
    ]
    wrong.append((-clearance / length, f"the footprint overlaps obstacles[{nearest}] by {-clearance:.3g} m"))
    for name, (low, high) in problem.limits.ranges().items():
        excess = -margins[name] / (high - low) - ALLOWED
        wrong.append((excess, f"the {name} exceeds its limit by {-margins[name]:.3g} {units[name]}".rstrip()))
    if run.status != "completed":
        # Where the run has no end, what is unknown there is no reason.
        last = np.asarray(run.t)[np.isfinite(run.speed)].max(initial=0.0)
        ended = f"the run ends with the status {run.status!r}, after {last:.4g} s of {float(run.t[-1]):.4g} s"
        wrong = [(1.0, ended), *(pair for pair in wrong if not np.isnan(pair[0]))]
    hindrances = tuple(words for excess, words in wrong if not excess <= 0.0)
    total = sum(max(excess, 0.0) for excess, _ in wrong)
    return Verdict(errors, clearance, margins, effort_of(run), float(np.nan_to_num(total, nan=np.inf)), hindrances)


def effort_of(run: Trajectory) -> float:
    """The effort [N^2 s]: the integral over time of F^2 + (torque / l)^2, with the force F and the wheelbase l."""
    force, torque = inputs_of(run)
    squares = force**2 + (torque / float(run.model.scene.body.wheelbase)) ** 2
    return float(np.trapezoid(squares, np.asarray(run.t)))


def checked_run(problem: Problem, drive: Any, t1: float, tolerance: float, times: int) -> tuple[Trajectory, Verdict]:
    """A run of an input, and what it achieves at a number of times."""
    run = simulate(problem.scene, problem.launch, t1, drive, times=np.linspace(0.0, t1, times), tolerance=tolerance)
    return run, judge(run, problem)
