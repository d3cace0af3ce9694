"""A planning problem, checked before anything compiles."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from nonholonomic.geometry import Plane
from nonholonomic.integration.checks import require_run
from nonholonomic.validation import require, require_all, require_kind, require_scalars

from ..model.launch import Launch
from ..model.scene import Scene
from .chart import is_flat
from .goal import Goal, Limits
from .obstacles import Box, Disc, Footprint, require_obstacles
from .transcription import seen_from_above

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
