"""The candidates of a plan: paths from the search, driven within the given time, as unknowns of the optimiser."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..model.dynamics import padded
from .obstacles import Obstacles
from .problem import Chart, Limits, Problem
from .search import MOST_NODES, Costs, Ground, Path, Steps, driven, search
from .transcription import ORDER, Scales, Task

#: Number of intervals of a plan.
INTERVALS = 64

#: Distance to keep from obstacles while planning, in units of the footprint's length, and the share of every limit's
#: range to keep in reserve at first: the check examines the ride between the points at which the optimiser looks.
RESERVE, LIMIT_RESERVE = 0.04, 0.003

#: Curvature of the arcs of the searches for neighbouring lanes, in units of the greatest one: less, because the fork takes time
#: to turn, and nearly all, because a somewhat wider turn may need a detour.
SEARCH_CURVATURES = (0.98, 0.85)

#: Length of the shortest drive that is expected, in units of the path of a search, which consists of arcs.
OPTIMISTIC = 0.8

#: Neighbouring knots over which the steering angle and the speed of a path are averaged.
SMOOTHING = (2, 1)


class Outline(NamedTuple):
    """A problem as the search and the optimiser need it: the poses of start and goal in the ground's axes, the map of the
    ground, the obstacles as arrays, and the clearance [m] to keep."""

    problem: Problem
    start: Any
    goal: Any
    chart: Chart
    obstacles: Obstacles
    clearance: float

    @classmethod
    def of(cls, problem: Problem) -> "Outline":
        """The outline of a problem."""
        start, end = problem.start_pose, problem.goal_pose
        surface, axes = problem.scene.surface, problem.scene.surface.axes
        chart = Chart.between(surface, problem.scene.dynamics.side, start[:axes], end[:axes])
        keep = min(RESERVE * float(problem.footprint.length), 0.5 * problem.clearance_at_ends)
        return cls(problem, start, end, chart, Obstacles.of(problem.obstacles), keep)

    @property
    def distance(self) -> float:
        """The straight distance [m] from the start to the goal."""
        return float(np.linalg.norm(np.asarray(self.goal - self.start)[: self.problem.scene.surface.axes]))

    def task(
        self, way: float, t1: float, clearance: float, reserve: float = LIMIT_RESERVE, in_haste: bool = False
    ) -> Task:
        """The task of the optimiser for drives of the length `way` [m] and a duration of about `t1` [s], which is minimised
        in haste."""
        problem, body = self.problem, self.problem.scene.body
        speed = max(way, float(body.wheelbase)) / t1
        launch, goal = problem.launch, problem.goal
        ends = np.array([[launch.steering, launch.speed], [launch.steering, goal.speed]])
        low, high = problem.limits.arrays(reserve)
        # No drive keeps a reserve that its start or its goal does not have.
        low[:2], high[:2] = np.minimum(low[:2], ends.min(axis=0)), np.maximum(high[:2], ends.max(axis=0))
        front_speed = launch.speed / jnp.cos(launch.steering)
        force = float(body.mass) * speed / min(1.0, 0.1 * t1)
        return Task(
            dynamics=problem.scene.dynamics,
            footprint=problem.footprint,
            obstacles=self.obstacles,
            start=(self.start, launch.steering, launch.steering_rate, front_speed),
            goal=(self.goal, goal.speed),
            has_heading=jnp.asarray(0.0 if goal.heading is None else 1.0),
            low=jnp.asarray(low),
            high=jnp.asarray(high),
            clearance=jnp.asarray(clearance),
            scales=Scales(body.wheelbase, jnp.asarray(speed), jnp.asarray(force)),
            haste=jnp.asarray(1.0 / t1 if in_haste else 0.0),
            with_grip=problem.limits.grip is not None,
        )

    def paths(self, costs: list[Costs], t1: float) -> tuple[list[Path], str | None]:
        """A path for each of several prices, straight to the goal where the search finds none; and a reason, in words, why
        none can be driven within `t1`, if there is one."""
        start, goal = self.chart.point(self.start), self.chart.point(self.goal)
        radius = 1.0 / steps_of(self.problem, min(SEARCH_CURVATURES)).sharpest
        ground = Ground.of(np.stack([start, goal]), self.obstacles, self.problem.footprint, radius)
        has_heading = self.problem.goal.heading is not None
        results = [
            search(ground, start, goal, has_heading, steps_of(self.problem, SEARCH_CURVATURES[lane % 2]), prices)
            for lane, prices in enumerate(costs)
        ]
        paths = [path for path, _, _ in results if path is not None]
        if not paths:
            nearest, was_all = min(result[1] for result in results), all(result[2] for result in results)
            what = (
                "no path to the goal was found"
                if was_all
                else f"the search ended after {MOST_NODES} poses without a path"
            )
            reason = f"{what}; the nearest ended {nearest:.2g} m from the goal"
            return [straight(start, goal)] * len(costs), reason
        low, high = self.problem.limits.ranges().get("speed", (-np.inf, np.inf))
        way, fastest = min(float(path.length.sum()) for path in paths), max(-low, high)
        reason = None
        if OPTIMISTIC * way > fastest * t1:
            reason = (
                f"the shortest path that was found, {way:.3g} m, takes {way / fastest:.3g} s at the limit of the speed"
            )
        return [path or paths[0] for path, _, _ in results], reason

    def soonest(self, path: Path) -> float:
        """A time [s] that a path takes at least, by the limits of speed, force, grip and torque."""
        scene, body = self.problem.scene, self.problem.scene.body
        way = max(float(path.length.sum()), float(body.wheelbase))
        most = {name: max(-low, high) for name, (low, high) in self.problem.limits.ranges().items()}
        # The way from rest to rest with the greatest acceleration, and a turn of the wheel by 1 rad in the same manner.
        accelerations = [most.get("force", np.inf) / body.mass, most.get("grip", np.inf) * scene.gravity]
        slowest = [way / accelerations[0], way / accelerations[1], body.steering_inertia / most.get("torque", np.inf)]
        return max(way / most.get("speed", np.inf), 2.0 * float(np.sqrt(max(slowest))))

    def unknowns(self, path: Path, t1: float) -> Float[np.ndarray, "rows unknowns"]:
        """A path, driven within `t1`, as unknowns of the optimiser (see `transcription.py`)."""
        wheelbase = float(self.problem.scene.body.wheelbase)
        points, speed, curvature = timed(path, INTERVALS + 1, t1, wheelbase)
        steering = smoothed(np.arctan(wheelbase * curvature), SMOOTHING[0])
        front_speed = smoothed(speed, SMOOTHING[1]) / np.cos(steering)
        poses = np.asarray(self.chart.poses(jnp.asarray(points)))
        poses = np.concatenate([poses, poses[-1:], poses[-1:]])
        splines = np.pad(np.stack([steering, front_speed], axis=1), ((1, ORDER - 3), (0, 0)), mode="edge")
        return np.concatenate([poses, splines], axis=1)

    def lines(self, unknowns: Float[np.ndarray, "candidates rows unknowns"]) -> Float[np.ndarray, "candidates knots 3"]:
        """The positions [m] of candidates at their knots, in the fixed frame."""
        surface = self.problem.scene.surface
        components = jnp.moveaxis(jnp.asarray(unknowns[:, : INTERVALS + 1, : surface.axes]), -1, 0)
        return np.stack([np.asarray(part) for part in surface.in_fixed_frame(padded(components))], axis=-1)


def steps_of(problem: Problem, share: float) -> Steps:
    """What the limits of speed and steering angle, of whose curvature only a share is used, allow a search."""
    angles = Limits(steering=problem.limits.steering).arrays(LIMIT_RESERVE)
    low, high = (float(np.tan(angle[0])) / float(problem.scene.body.wheelbase) for angle in angles)
    slowest, fastest = problem.limits.ranges().get("speed", (-np.inf, np.inf))
    directions = tuple(sign for sign, speed in ((1.0, fastest), (-1.0, -slowest)) if speed > 0.0)
    return Steps(max(low, share * low), min(high, share * high), directions)


def straight(start: Any, goal: Any) -> Path:
    """The straight line between two points, whatever is in between."""
    away = goal[:2] - start[:2]
    heading = float(np.arctan2(away[1], away[0]))
    poses = np.array([[*start[:2], heading], [*goal[:2], heading]])
    return Path(poses, np.ones(1), np.zeros(1), np.array([max(float(np.hypot(*away)), 1e-3)]))


def prices(outline: Outline, count: int, batch: int, rng: np.random.Generator, in_haste: bool = False) -> list[Costs]:
    """What the searches of a batch minimise: ordinary prices first, or mostly the time at the limits of the speed in haste,
    then random ones."""
    length, keep = float(outline.problem.footprint.length), outline.clearance
    low, high = outline.problem.limits.ranges().get("speed", (-1.0, 1.0))
    backwards = high / -low if low < 0.0 < high else 1.0
    if batch == 0:
        usual = [Costs(1.5 * length, 0.1, 1.0, 0.9 * keep), Costs(0.5 * length, 0.3, 1.5, 1.8 * keep)]
        if in_haste:
            usual = [Costs(0.1 * length, 0.0, backwards, 0.9 * keep), Costs(0.5 * length, 0.1, backwards, 1.8 * keep)]
        return [usual[k % 2] for k in range(count)]
    spread = np.exp(rng.normal(size=(count, 4)) * np.array([1.0, 0.7, 0.5, 0.5]))
    middle = np.array([length, 0.2, 1.2 * backwards if in_haste else 1.2, 0.7 * keep])
    return [Costs(*map(float, row)) for row in middle * spread]


# First guesses for the optimiser: a path, driven within the given time.

#: Share of a section's time in which the stroller speeds up, and again slows down.
RAMP = 0.2

#: Time that a change of direction takes, in units of the time for one wheelbase.
CHANGE = 1.5


def progress(part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of a section's length, and its rate, at a share of its time: smooth ramps and constant speed between."""
    top = 1.0 / (1.0 - RAMP)
    ramp = lambda u: u**3 - 0.5 * u**4  # noqa: E731
    slope = lambda u: 3.0 * u**2 - 2.0 * u**3  # noqa: E731
    u, v = np.clip(part / RAMP, 0.0, 1.0), np.clip((1.0 - part) / RAMP, 0.0, 1.0)
    middle = np.clip(part, RAMP, 1.0 - RAMP) - RAMP
    way = top * (RAMP * ramp(u) + middle + RAMP * (0.5 - ramp(v)))
    return way, top * np.minimum(slope(u), slope(v))


def sections(path: Path) -> list[slice]:
    """The pieces between changes of direction."""
    cuts = [0, *(np.flatnonzero(np.diff(path.direction)) + 1), len(path.direction)]
    return [slice(a, b) for a, b in zip(cuts, cuts[1:], strict=False)]


def timed(path: Path, knots: int, t1: float, wheelbase: float) -> tuple[Float[np.ndarray, "knots 3"], Any, Any]:
    """Poses, speeds of the rear axle [m/s] and curvatures [1/m] at evenly spaced times from 0 to `t1`."""
    parts = sections(path)
    lengths = np.array([path.length[part].sum() for part in parts])
    shares = (lengths + CHANGE * wheelbase) / (lengths + CHANGE * wheelbase).sum()
    ends = np.concatenate([[0.0], np.cumsum(shares)])
    time = np.linspace(0.0, 1.0, knots)
    section = np.clip(np.searchsorted(ends, time, side="right") - 1, 0, len(parts) - 1)
    way, rate = progress((time - ends[section]) / shares[section])
    speed = rate * lengths[section] / (shares[section] * t1)
    start = np.array([path.length[: part.start].sum() for part in parts])
    along = start[section] + way * lengths[section]
    piece_ends = np.cumsum(path.length)
    piece = np.clip(np.searchsorted(piece_ends, along), 0, len(piece_ends) - 1)
    into = along - (piece_ends - path.length)[piece]
    poses = driven(path.poses[piece], path.direction[piece], path.curvature[piece], into)
    return poses, speed * path.direction[piece], path.curvature[piece]


def smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """A running mean over 2 `width` + 1 values."""
    padded = np.pad(values, width, mode="edge")
    return np.convolve(padded, np.full(2 * width + 1, 1.0 / (2 * width + 1)), mode="valid")
