"""The result of a plan, and its pictures."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import AbstractSurface
from nonholonomic.terminal import status_line
from nonholonomic.text import in_unit, readable_unit, require_unit
from nonholonomic.validation import require_file, require_package
from nonholonomic.views import DARK, Body, Mesh, Page, Stage, arena, bar, page
from nonholonomic.views.plot import new_figure
from nonholonomic.views.stage import curves_in, of_grid

from ..runs.trajectory import Trajectory
from .obstacles import Box, Disc
from .problem import Problem, Verdict, corners_of
from .transcription import Drive

# Pictures of a plan: from above, and as a page.

#: Heights of drawn obstacles, and radii of drawn lines, in units of the wheelbase.
HEIGHT, THIN, RAISED = 0.5, 0.008, 0.03

#: Reach of the cross at a goal without a heading, along x and y, in units of the wheelbase.
CROSS = 0.1

#: Height of the camera in units of its distance along the ground, from which obstacles do not hide the stroller.
RISE = 1.2

#: Sides of a drawn disc, and outlines of the footprint in a plot.
SIDES, OUTLINES = 48, 13

#: Colours of obstacles, of candidates, and of the goal.
STONE, FAINT, GREEN = 0x8A8F98, 0x5B8DB8, 0x1F8A4C

#: The identity as a quaternion (x, y, z, w).
UNTURNED = (0.0, 0.0, 0.0, 1.0)


def outline(obstacle: Box | Disc) -> Float[np.ndarray, "corners 2"]:
    """The outline of an obstacle [m]."""
    if isinstance(obstacle, Box):
        return obstacle.corners
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.array(obstacle.centre, dtype=float) + float(obstacle.radius) * unit


def draw_plan(plan: Any, unit: Any = None) -> Any:
    """The plan from above, and its speed and steering angle over time in a unit as for `in_unit`, as a matplotlib figure."""
    figure = new_figure(9.0, 4.5)
    above, curves = figure.subplots(1, 2, width_ratios=(3, 2))
    for obstacle in plan.problem.obstacles:
        above.fill(*outline(obstacle).T, color="0.6")
    for line in plan.candidates:
        above.plot(line[:, 0], line[:, 1], color="0.75", linewidth=0.7)
    corners = corners_of(plan.run, plan.problem)
    flat = plan.problem.is_flat
    if flat:
        for number in np.linspace(0, len(corners) - 1, OUTLINES).astype(int):
            above.plot(*np.concatenate([corners[number], corners[number][:1]]).T, color="C0", linewidth=0.6)
    path = np.asarray(plan.run.place if flat else plan.run.position)
    above.plot(path[:, 0], path[:, 1], color="C0", label="rear axle")
    if flat and plan.problem.goal.heading is None:
        above.plot(*np.asarray(plan.problem.goal_pose[:2])[:, None], "x", color="C2", label="goal")
    elif flat:
        target = plan.problem.goal_corners
        above.plot(*np.concatenate([target, target[:1]]).T, color="C2", linewidth=1.2, label="goal")
    above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    above.set_title("reaches the goal" if plan.reached else "; ".join(plan.hindrances), fontsize="small")
    above.legend(fontsize="small")
    for name, values, si in (("speed", plan.run.speed, "m/s"), ("steering angle", plan.run.steering, "rad")):
        text, factor = in_unit(si, unit)
        curves.plot(plan.run.t, factor * values, label=f"{name} [{text}]")
    curves.set_xlabel("time [s]")
    curves.legend(fontsize="small")
    return figure


def planned_stage(plan: Any) -> Stage:
    """The run of a plan on its stage, with obstacles, candidates, footprint and goal."""
    (stage,) = plan.run.stages()
    scene, (show, *_) = plan.problem.scene, stage.shows
    length, count = float(scene.body.wheelbase), len(show.times)
    surface, outlines = scene.surface, [outline(part) for part in plan.problem.obstacles]
    feet = [on_ground(surface, corners) for corners in outlines]
    points = np.concatenate([np.asarray(plan.run.position), *feet])
    ground = arena(surface, points, stage.arena.normal, 3.0 * length, length)
    still = [("candidates", [ribbon(line, RAISED, THIN, FAINT, length) for line in plan.candidates])]
    if feet:
        still.append(("obstacles", [prism(foot, HEIGHT * length) for foot in feet]))
    if plan.problem.is_flat:
        still.append(("goal", [goal_mark(plan.problem, 2.0 * RAISED * length, 2.0 * THIN * length)]))
    place, turn = np.zeros((count, 3)), np.tile(UNTURNED, (count, 1))
    bodies = tuple(Body(name, place, turn, tuple(meshes)) for name, meshes in still)
    vehicle = show.bodies[0]
    own = plan.problem.footprint.corners(np.zeros(2), np.array([1.0, 0.0]), np.array([0.0, 1.0]))
    # The frame's origin is the middle of the rear axle, above the ground.
    low = np.concatenate([np.asarray(own), np.full((4, 1), -0.17 * length)], axis=1)
    edge = Body("footprint", vehicle.position, vehicle.orientation, (frame_of(low, 0.0, 1.5 * THIN * length, DARK),))
    title = f"plan of {plan.t1:.3g} s: {'reaches the goal' if plan.reached else 'does not reach the goal'}"
    shows = (show._replace(bodies=(*show.bodies, edge, *bodies)),)
    return stage._replace(title=title, arena=ground, shows=shows, rise=RISE)


def goal_mark(problem: Problem, raised: float, radius: float) -> Mesh:
    """The outline of the footprint at the goal, or a cross at a goal without a heading."""
    if problem.goal.heading is not None:
        return frame_of(on_ground(problem.scene.surface, problem.goal_corners), raised, radius, GREEN)
    arm = CROSS * float(problem.scene.body.wheelbase)
    ends = np.asarray(problem.goal_pose[:2]) + arm * np.array([[1.0, 1.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0]])
    points = on_ground(problem.scene.surface, ends) + np.array([0.0, 0.0, raised])
    return joined([bar(tuple(points[k]), tuple(points[k + 1]), radius, GREEN) for k in (0, 2)])


def on_ground(surface: AbstractSurface, points: np.ndarray) -> Float[np.ndarray, "points 3"]:
    """Points (points, 2) of x and y on the ground, in the fixed frame."""
    position = surface.chart((points[:, 0], points[:, 1]))[0]
    return np.stack([np.broadcast_to(part, len(points)) for part in surface.in_fixed_frame(position)], axis=-1)


def prism(foot: Float[np.ndarray, "corners 3"], height: float) -> Mesh:
    """An upright prism on its corners on the ground."""
    top = np.array(foot)
    top[:, 2] = foot[:, 2].max() + height
    count = len(foot)
    ring = np.arange(count)
    following = np.roll(ring, -1)
    sides = np.concatenate(
        [np.stack([ring, following, ring + count], -1), np.stack([following, following + count, ring + count], -1)]
    )
    lid = np.stack([np.full(count - 2, count), count + ring[1:-1], count + ring[2:]], -1)
    return Mesh(np.concatenate([foot, top]), np.concatenate([sides, lid]), STONE)


def frame_of(corners: np.ndarray, raised: float, radius: float, colour: int) -> Mesh:
    """The outline of a quadrilateral, as bars."""
    points = corners + np.array([0.0, 0.0, raised])
    return joined(
        [bar(tuple(a), tuple(b), radius, colour) for a, b in zip(points, np.roll(points, -1, axis=0), strict=True)]
    )


def ribbon(line: np.ndarray, raised: float, half: float, colour: int, length: float) -> Mesh:
    """A thin band along a line, above the ground."""
    along = np.gradient(line, axis=0)
    across = np.stack([-along[:, 1], along[:, 0], np.zeros(len(line))], axis=-1)
    across *= half * length / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
    above = line + np.array([0.0, 0.0, raised * length])
    vertices = np.stack([above - across, above + across], axis=1).reshape(-1, 3)
    return Mesh(vertices, of_grid(len(line), 2), colour)


def joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes of one colour as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles), meshes[0].colour)


# The result of a plan.


class Plan(eqx.Module):
    """A planned drive, its run at a tolerance of 1e-9, and what the check of this run says.

    - `input`: the input of the drive, an `equinox.Module` that `simulate`, `sweep` and `identify` accept;
    - `t1`: its duration [s]; `run`: its `Trajectory`;
    - `reached`: whether the run ends at the goal, keeps all limits, up to 0.001 of their ranges, and touches no obstacle;
    - `clearance`: least distance [m] of the footprint from an obstacle, negative for an overlap, infinite without
      obstacles;
    - `margins`: the distance of the run from each limit, by name, negative where the limit is exceeded;
    - `effort`: integral over time of F^2 + (torque / wheelbase)^2 [N^2 s];
    - `errors`: errors of place [m], heading [rad] and speed [m/s] at the end;
    - `hindrances`: what is wrong with the run, in words; empty if the goal is reached;
    - `candidates`: the paths [m] of all optimised candidates, (candidates, knots, 3), in the fixed frame.

    `print` shows the result, `plot` draws it, and `view` writes a page on which it is played.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> gap = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25))]
    >>> start, goal = stroller.Launch((0.7, 0.8), 0.0, 0.0), stroller.Goal((1.8, 0.3), heading=0.0)
    >>> plan = stroller.plan(scene, start, goal, 12.0, obstacles=gap, limits=stroller.Limits(steering=1.0))
    >>> print(f"{plan.run.place[-1, 0]:.1f} m, {plan.run.place[-1, 1]:.1f} m")
    1.8 m, 0.3 m

    ```
    """

    input: Drive
    t1: float
    run: Trajectory
    verdict: Verdict
    problem: Problem
    candidates: Float[Array, "candidates knots 3"]

    @property
    def reached(self) -> bool:
        return not self.verdict.hindrances

    @property
    def clearance(self) -> float:
        return self.verdict.clearance

    @property
    def margins(self) -> dict[str, float]:
        return self.verdict.margins

    @property
    def effort(self) -> float:
        return self.verdict.effort

    @property
    def errors(self) -> tuple[float, float, float]:
        return self.verdict.errors

    @property
    def hindrances(self) -> tuple[str, ...]:
        return self.verdict.hindrances

    def __str__(self) -> str:
        units = {name: readable_unit(unit) for name, unit in self.problem.limits.units.items()}
        goal, count = self.problem.goal, len(self.problem.obstacles)
        obstacles = "1 obstacle" if count == 1 else f"{count} obstacles"
        place, heading, speed = self.errors
        turn = "" if goal.heading is None else f"heading {heading:.2g} rad, "
        lines = [
            f"Plan of {self.t1:.4g} s: {'reaches the goal' if self.reached else 'does not reach the goal'}",
            f"  end        place off by {place:.2g} m, {turn}speed {speed:.2g} m/s; allowed {float(goal.within):g}",
            *([f"  clearance  {self.clearance:.3g} m from {obstacles}"] if count else []),
            *(f"  {name:9s}  margin {margin:.3g} {units[name]}".rstrip() for name, margin in self.margins.items()),
            f"  effort     {self.effort:.4g} N² s",
            f"  tried      {len(self.candidates)} candidates",
            *(f"  hindrance  {words}" for words in self.hindrances),
        ]
        return "\n".join(lines)

    def __repr__(self) -> str:
        return str(self)

    def plot(self, unit: str | Sequence[str] | None = None) -> Any:
        """Draw the plan from above, with its obstacles, footprint and candidates, and its speed and steering over time
        (needs matplotlib).

        **Arguments:** `unit`: unit of speed and steering, such as "deg", "km/h", or both.

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for an unknown unit.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        return draw_plan(self, unit)

    @status_line("drawing")
    def view(self, path: Any = None, unit: str | Sequence[str] | None = None) -> Page:
        """An animated page of the drive, with its obstacles, the footprint, and the candidates as thin lines (needs
        jupyter-threejs-sage).

        **Arguments:** `path`: file for the page, with a name that ends in .html, or `None`; `unit`: unit of the curves.

        **Returns:** a `Page`, which a notebook shows.

        **Raises:** `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError` if the file cannot be
        written, `ValueError` for another file type.
        """
        require_package("jupyter_threejs_sage", "view", "view")
        if path is not None:
            require_file(path, "path", ".html", ".htm")
        require_unit(unit)
        (stage,) = curves_in([planned_stage(self)], unit)
        html_page = page([stage], stage.title, speed=1.0)
        if path is not None:
            html_page.save(path)
        return html_page
