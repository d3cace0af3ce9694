"""Plan a drive to a goal, check and show the result, and keep a ride on its plan."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.interpolate import CubicSpline

from nonholonomic.geometry import Plane, scale
from nonholonomic.terminal import status_line
from nonholonomic.text import in_unit, readable_unit, require_unit, shown
from nonholonomic.validation import explaining, require_flag, require_kind, require_package, require_whole
from nonholonomic.views.pages import Page, page, require_page
from nonholonomic.views.plot import draw_title, legend_above, new_figure
from nonholonomic.views.stage import DARK, Body, Mesh, Stage, bar, curves_in, fixed, of_grid, own

from ..model.scene import Dynamics, Launch, Number, Scene, padded
from ..runs.model import simulate
from ..runs.trajectory import Trajectory
from ..runs.view import ground_of, normals
from .planner import Planner, proposed
from .problem import Box, Corners, Disc, Footprint, Goal, Limits, Problem, checked_problem, corners_of, frame_of
from .search import INTERVALS, guess_of, paths_of, prices
from .transcription import FINE, LIMIT_RESERVE, Candidates, Drive, Task, Tracker, drive_along, interpolate, optimise

#: Batches of candidates, each with the length [m] of its shortest way.
Guesses = Iterator[tuple[float, Candidates]]

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
    - `excess`: the same as a number, 0 if the goal is reached, by which attempts are compared;
    - `candidates`: the paths [m] of all optimised candidates, (candidates, points, 3), in the fixed frame.

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
    run: Trajectory
    problem: Problem
    clearance: float
    margins: dict[str, float]
    effort: float
    errors: tuple[float, float, float]
    hindrances: tuple[str, ...]
    excess: float
    candidates: Float[Array | np.ndarray, "candidates knots 3"]

    @property
    def t1(self) -> float:
        return float(self.input.duration)

    @property
    def reached(self) -> bool:
        return not self.hindrances

    def __repr__(self) -> str:
        units = {name: readable_unit(unit) for name, unit in self.problem.limits.units.items()}
        goal, count = self.problem.goal, len(self.problem.obstacles)
        obstacles = "1 obstacle" if count == 1 else f"{count} obstacles"
        place, heading, speed = self.errors
        turn = "" if goal.heading is None else f"heading {heading:.2g} rad, "
        end = f"place off by {place:.2g} m, {turn}speed {speed:.2g} m/s; allowed {float(goal.within):g}"
        measured = [
            (f"end        {end}", sum(self.errors)),
            *([(f"clearance  {self.clearance:.3g} m from {obstacles}", self.clearance)] if count else []),
            *(
                (f"{name:9s}  margin {margin:.3g} {units[name]}".rstrip(), margin)
                for name, margin in self.margins.items()
            ),
            (f"effort     {self.effort:.4g} N² s", self.effort),
            (f"grip       {self.run.grip_in_words}", float(np.max(self.run.grip()))),
            (f"tried      {len(self.candidates)} candidates", 0.0),
            *((f"hindrance  {words}", 0.0) for words in self.hindrances),
        ]
        verdict = "reaches the goal" if self.reached else "does not reach the goal"
        # A run that failed has no end, and no value of what depends on it.
        lines = [text for text, number in measured if not np.isnan(number)]
        return "\n  ".join([f"Plan of {self.t1:.4g} s: {verdict}", *lines])

    def plot(self, unit: str | Sequence[str] | None = None) -> Any:
        """Draw the plan from above, or in space on a curved ground: its goal, obstacles, footprint and candidates; and its
        speed and steering over time (needs matplotlib).

        **Arguments:** `unit`: unit of speed and steering, such as "deg", "km/h", or both.

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for an unknown unit.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        problem, surface, figure = self.problem, self.problem.scene.surface, new_figure(9.0, 4.5)
        grid, axes = figure.add_gridspec(2, 2, width_ratios=(3, 2)), 2 if isinstance(surface, Plane) else 3
        above = figure.add_subplot(grid[:, 0], **({"projection": "3d", "elev": 60.0} if axes == 3 else {}))

        def draw(points: Corners, colour: str, width: float, label: str | None = None, marker: str = "") -> None:
            above.plot(*np.asarray(points).T[:axes], marker, color=colour, linewidth=width, label=label)

        is_cross, target = problem.goal.heading is None, goal_corners(problem)
        path = np.concatenate([self.run.position, target])
        middle, reach = path.mean(axis=0), 0.6 * np.ptp(path, axis=0).max() + problem.scene.body.wheelbase
        for line in planned_stage(self).arena.lines if axes == 3 else ():
            draw(np.where(np.abs(line - middle).max(axis=-1, keepdims=True) < reach, line, np.nan), "0.7", 0.4)
        for foot in (fixed(surface, line) for line in problem.outlines):
            draw(foot[[*range(len(foot)), 0]], "0.4", 1.5, "obstacles")
            if axes == 2:
                above.fill(*foot.T[:2], color="0.6")
        for line in self.candidates:
            draw(line, "0.55", 0.7, "candidates")
        drawn = np.linspace(0, len(self.run.t) - 1, OUTLINES).astype(int)
        for corners in outlines(problem, problem.footprint, self.run.state[drawn, : 2 * surface.axes]):
            draw(corners[CLOSED], "C0", 0.6, "footprint")
        draw(self.run.position, "C0", 1.5, "rear axle")
        draw(target.mean(axis=0)[None] if is_cross else target[CLOSED], "C2", 1.2, "goal", "x" if is_cross else "")
        if not is_cross:
            # An arrow from the rear to the front.
            tip, (right, left) = target[:2].mean(axis=0), 0.5 * (target[:2] + target.mean(axis=0))
            draw(np.stack([target[2:].mean(axis=0), tip, right, tip, left]), "C2", 1.2)
        above.grid(False)
        above.locator_params(nbins=5 if axes == 3 else "auto")
        above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", **({"zticks": []} if axes == 3 else {}))
        legend_above(above)
        curves = ("speed", self.run.speed, "m/s"), ("steering", self.run.steering, "rad")
        for k, (name, values, si) in enumerate(curves):
            text, factor = in_unit(si, unit)
            panel = figure.add_subplot(grid[k, 1], xlabel="time [s]" if k else "", ylabel=f"{name} [{text}]")
            panel.plot(self.run.t, factor * values, color="C0")
        draw_title(figure, "reaches the goal" if self.reached else "; ".join(self.hindrances))
        return figure

    @status_line("drawing")
    def view(self, path: str | Path | None = None, unit: str | Sequence[str] | None = None) -> Page:
        """An animated page of the drive, with its obstacles, the footprint, and the candidates as thin lines (needs
        jupyter-threejs-sage).

        **Arguments:** `path`: file for the page, with a name that ends in .html, or `None`; `unit`: unit of the curves.

        **Returns:** a `Page`, which a notebook shows.

        **Raises:** `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError` if the file cannot be
        written, `ValueError` for another file type.
        """
        require_page(path, "view")
        require_unit(unit)
        (stage,) = curves_in([planned_stage(self)], unit)
        return page([stage], stage.title, speed=1.0).written(path)


# The check of a drive: a run at a tight tolerance, the exact clearance of the whole footprint, and every limit.

#: Times of the run, the same for all drives, so that they share their programs.
TIMES = 2001

#: How many times finer the closest approaches are examined.
FINER = 10

#: By how much a limit may be exceeded, in units of its range: a drive keeps the speed and the angle of a plan up to small
#: errors, and a limit may be the very value at its start or goal.
ALLOWED = 1e-3

#: The same for the duration, which single precision rounds.
ROUND_OFF = 1e-6


def checked_drive(problem: Problem, drive: Drive, tolerance: float) -> Plan:
    """The drive as a plan: its run, what this run achieves, and what stands in the way."""
    t1, scene, goal, axes = float(drive.duration), problem.scene, problem.goal, problem.scene.surface.axes
    run = simulate(scene, problem.launch, t1, drive, times=np.linspace(0.0, t1, TIMES), tolerance=tolerance)
    along = seen_along(scene.dynamics, problem.footprint, drive, run.t, run.state)
    corners, force, torque = map(np.asarray, along)
    values = {"steering": run.steering, "speed": run.speed, "force": force, "torque": torque}
    values["grip"] = run.grip()[:, : len(run.loaded_axles)]
    ranges, units = problem.limits.ranges(), {name: readable_unit(unit) for name, unit in Limits.units.items()}
    margins = {
        name: float(min(np.min(values[name]) - low, high - np.max(values[name])))
        for name, (low, high) in ranges.items()
    }
    clearance, nearest = np.inf, -1
    if problem.obstacles:
        gaps, times = problem.gaps(corners), np.asarray(run.t)
        # Between two times, no corner moves further than this.
        moved = np.linalg.norm(np.diff(corners, axis=0), axis=-1).max(axis=-1)
        step = np.flatnonzero(np.minimum(gaps[:-1], gaps[1:]).min(axis=-1) - moved < gaps.min())
        inner = times[step][:, None] + np.diff(times)[step][:, None] * np.arange(1, FINER) / FINER
        least = np.concatenate([gaps, problem.gaps(CubicSpline(times, corners)(inner.ravel()))]).min(axis=0)
        clearance, nearest = float(least.min()), int(np.argmin(least))
    away = np.asarray(run.state)[-1, : 2 * axes] - np.asarray(problem.goal_pose)
    turn = 0.0 if goal.heading is None else 2.0 * np.arcsin(np.minimum(1.0, 0.5 * np.linalg.norm(away[axes:])))
    errors = float(np.linalg.norm(away[:axes])), float(turn), abs(float(run.speed[-1]) - float(goal.speed))
    within, length = float(problem.goal.within), float(problem.footprint.length)
    # What is wrong, each relative to what is allowed, and the words for it.
    wrong = [
        (error / within - 1.0, f"the {name} at the end is off by {error:.3g} {unit}")
        for name, unit, error in zip(("place", "heading", "speed"), ("m", "rad", "m/s"), errors, strict=True)
    ]
    wrong.append((-clearance / length, f"the footprint overlaps obstacles[{nearest}] by {-clearance:.3g} m"))
    for name, (low, high) in ranges.items():
        excess = -margins[name] / (high - low) - ALLOWED
        wrong.append((excess, f"the {name} exceeds its limit by {-margins[name]:.3g} {units[name]}".rstrip()))
    if run.status != "completed":
        # Where the run has no end, what is unknown there is no reason.
        last = np.asarray(run.t)[np.isfinite(run.speed)].max(initial=0.0)
        ended = f"the run ends with the status {run.status!r}, after {last:.4g} s of {float(run.t[-1]):.4g} s"
        wrong = [(1.0, ended), *(pair for pair in wrong if not np.isnan(pair[0]))]
    longer = t1 / problem.t1 - 1.0 - ROUND_OFF
    wrong.append((longer, f"the drive takes {t1:.4g} s, longer than t1 = {problem.t1:.4g} s"))
    hindrances = tuple(words for excess, words in wrong if not excess <= 0.0)
    excess = float(np.nan_to_num(sum(max(excess, 0.0) for excess, _ in wrong), nan=np.inf))
    squares = force**2 + (torque / float(problem.scene.body.wheelbase)) ** 2
    effort = float(np.trapezoid(squares, np.asarray(run.t)))
    return Plan(drive, run, problem, clearance, margins, effort, errors, hindrances, excess, np.zeros((0, 0, 3)))


@eqx.filter_jit
def seen_along(
    dynamics: Dynamics, footprint: Footprint, drive: Drive, times: Number, states: Float[Array, "times n"]
) -> tuple[Corners, Number, Number]:
    """The corners [m] of the footprint, the force [N] and the torque [N m] of a drive along a run."""
    corners = corners_of(dynamics, footprint, states.T[: 2 * dynamics.surface.axes])
    return corners, *drive(times, dynamics.geometry(states.T).motion)


# Planning.

#: Candidates that are optimised together.
LANES = 2

#: Tolerance of the run that confirms a plan.
TIGHT = 1e-9

#: A candidate with a greater violation of the constraints (see `transcription.py`) is not worth a run if there is a better one.
HOPELESS = 0.05

#: How often the clearance, or the reserve of the limits, is increased for a candidate that touches an obstacle, or exceeds a
#: limit, between the optimiser's points, and the greatest share of its range by which it may exceed a limit then.
STRICTER, CORRIGIBLE = 2, 0.05

#: Factor of the penalties for later candidates in haste: the first ones may lose a turn of their path to the weight of time.
FIRMER = 10.0

#: Batches without a path that can be driven in time after which the search goes on; one more ends it.
PATIENCE = 1

MINIMISED = ("effort", "time")


@explaining
def plan(
    scene: Scene,
    launch: Launch,
    goal: Goal,
    t1: Float[ArrayLike, ""],
    *,
    obstacles: Iterable[Box | Disc] = (),
    limits: Limits | None = None,
    footprint: Footprint | None = None,
    minimise: str = "effort",
    starts: int = 64,
    planner: Planner | None = None,
    seed: int = 0,
    tolerance: float = 1e-6,
    progress: bool = True,
) -> Plan:
    """Plan a drive from a launch to a goal, around obstacles and within limits.

    A search over arcs that the stroller can drive, forwards and in reverse, finds paths around the obstacles; an
    optimiser turns them into drives of the full dynamics that meet all constraints; and a run at a tolerance of 1e-9
    with an exact collision check of the whole footprint confirms the result.

    **Arguments:**

    - `scene`: a `Scene` on any ground, with an intrinsic heading.
    - `launch`: the `Launch` at which the drive begins.
    - `goal`: a `Goal`.
    - `t1`: duration of the drive [s], positive.
    - `obstacles`: a list of `Box` and `Disc`.
    - `limits`: `Limits` of steering angle, speed, force, torque and grip.
    - `footprint`: the `Footprint` that must not touch an obstacle; by default that of the drawn vehicle, 1.4 wheelbases
      long and 0.87 wide.
    - `minimise`: "effort", the integral of the squared force and of the squared torque divided by the wheelbase; or
      "time", for which `t1` is the longest duration, and which needs a limit of speed, force, torque or grip.
    - `starts`: greatest number of candidates, rounded up to an even number; the search ends with the first solution.
    - `planner`: a `Planner` from `learn_planner`, whose best proposal is tried before the search begins.
    - `seed`: seed of the random choices among paths.
    - `tolerance`: relative tolerance of the runs that compare candidates, in [1e-14, 1e-2].
    - `progress`: whether to show a status line.

    **Returns:** a `Plan`. If no candidate solves the problem, `reached` is false, and the plan is the best attempt, which may
    take longer than `t1` if the time is minimised.

    **Raises:** `ValueError` for arguments out of range, a start or a goal that touches an obstacle or breaks a limit, and a
    goal outside the ground.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> gap = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25))]
    >>> start, goal = stroller.Launch((0.7, 0.8), 0.0, 0.0), stroller.Goal((1.8, 0.3), heading=0.0)
    >>> plan = stroller.plan(scene, start, goal, 12.0, obstacles=gap, limits=stroller.Limits(steering=1.0))
    >>> plan.reached, bool(plan.clearance > 0.0)
    (True, True)

    ```
    """
    if minimise not in MINIMISED:
        raise ValueError(f"minimise = {shown(minimise)} must be one of {', '.join(map(repr, MINIMISED))}")
    require_whole(starts, "starts", 1)
    require_whole(seed, "seed", 0)
    require_flag(progress, "progress")
    if planner is not None:
        require_kind(planner, "planner", Planner, ", as stroller.learn_planner returns it")
    attempts, tried, reasons = [], [], []
    with status_line("planning", progress):
        in_haste = minimise == "time"
        problem = checked_problem(
            scene, launch, goal, t1, obstacles, limits, footprint, tolerance=tolerance, in_haste=in_haste
        )
        if in_haste and not problem.limits.ranges().keys() - {"steering"}:
            raise ValueError("minimise = 'time' needs a limit of speed, force, torque or grip, as in Limits(speed=1.0)")
        guesses = _guesses(problem, starts, planner, seed, reasons)
        for attempt in _attempts(problem, guesses, tolerance, tried):
            attempts.append(attempt)
            if attempt.reached:
                break
        best = min(attempts, key=lambda attempt: (attempt.excess, attempt.effort))
        if not best.reached:
            best = checked_drive(problem, best.input, TIGHT)
            best = dataclasses.replace(best, hindrances=(*best.hindrances, *reasons[:1]))
    knots = np.nan_to_num(np.concatenate(tried)[:, : INTERVALS + 1, : scene.surface.axes])
    fine = np.linspace(0.0, INTERVALS, FINE * INTERVALS + 1)
    positions = np.moveaxis(CubicSpline(np.arange(INTERVALS + 1), knots, axis=1)(fine), -1, 0)
    return dataclasses.replace(best, candidates=jnp.asarray(fixed(scene.surface, padded(jnp.asarray(positions)))))


def _guesses(problem: Problem, starts: int, planner: Planner | None, seed: int, reasons: list[str]) -> Guesses:
    """Batches of candidates, each with the length [m] of its shortest way: the proposal of a planner, then what searches
    find. Candidates that are in haste begin with the duration that their path allows, whatever the longest one is.
    `reasons` collects why batches cannot succeed."""
    rng = np.random.default_rng(seed)
    if planner is not None:
        task = Task.of(problem, problem.distance, problem.t1, problem.clearance)
        proposal = proposed(planner, task)
        if proposal is not None:
            yield problem.distance, Candidates(proposal[None], np.full(1, problem.t1))
            starts -= 1
    for batch in range(-(-starts // LANES)):
        paths, reason = paths_of(problem, prices(problem, LANES, batch, rng))
        reasons.extend([reason] if reason else [])
        if len(reasons) > PATIENCE:
            return
        unknowns, durations = zip(*(guess_of(problem, path) for path in paths), strict=True)
        yield min(float(path.length.sum()) for path in paths), Candidates(np.stack(unknowns), np.array(durations))


def _attempts(problem: Problem, guesses: Guesses, tolerance: float, tried: list[np.ndarray]) -> Iterator[Plan]:
    """Optimised candidates that were driven, best first in each batch; `tried` collects the unknowns of all of them."""
    widths = [(name, high - low) for name, (low, high) in problem.limits.ranges().items()]
    for batch, (way, candidates) in enumerate(guesses):
        clearance, reserve = problem.clearance, LIMIT_RESERVE
        for _ in range(STRICTER + 1):
            task = Task.of(problem, way, float(candidates.durations.mean()), clearance, reserve)
            candidates, violation, values = optimise(candidates, task, FIRMER if problem.in_haste and batch else 1.0)
            tried.append(np.asarray(candidates.unknowns))
            attempts = []
            for lane in np.lexsort((values, violation > HOPELESS)):
                if attempts and violation[lane] > HOPELESS:
                    break
                splines, t1 = candidates.unknowns[lane][:, -2:], float(candidates.durations[lane])
                drive = drive_along(problem.scene.dynamics, problem.start_pose, splines, t1)
                attempt = checked_drive(problem, drive, tolerance)
                # A solution is driven again at a tight tolerance, and this run counts.
                attempts.append(checked_drive(problem, drive, TIGHT) if attempt.reached else attempt)
                yield attempts[-1]
            overlap = -max(attempt.clearance for attempt in attempts)
            shares = [[-attempt.margins[name] / width for name, width in widths] for attempt in attempts]
            excess = min(max(share, default=0.0) for share in shares)
            ends = any(max(attempt.errors) < float(problem.goal.within) for attempt in attempts)
            if not ends or not (overlap > 0.0 or ALLOWED < excess < CORRIGIBLE):
                break
            clearance += (overlap + 0.5 * problem.clearance) * (overlap > 0.0)
            reserve += 2.0 * excess * (excess > ALLOWED)


# Feedback that keeps a ride on its plan.

#: Length [wheelbases] over which an error across the way decays, and the rate [1/s] at which an error along it does.
REACH, CATCHING_UP = 2.0, 0.8

#: Speed [wheelbases/s] below which the correction of the heading fades out: it changes its sign in reverse.
SLOW = 0.1


@explaining
def track(scene: Scene, plan: Plan) -> Tracker:
    """Feedback that keeps a ride on its plan under disturbances.

    The errors x (ahead), y (to the left) and theta (heading) of the planned stroller, as seen from this one, are a
    port-Hamiltonian system with the shaped energy H = (x^2 + y^2) / 2 + (1 - cos theta) / k. With the speed
    v = v_d cos theta + c x and the yaw rate Omega = Omega_d + v_d k y + d |v_d| sin theta, it has the power balance
    dH/dt = -c x^2 - (d / k) |v_d| sin^2 theta: the springs store energy, and the injected damping takes it out (Kanayama et
    al., IEEE Int. Conf. Robotics and Automation (1990) 384; van der Schaft, L2-Gain and Passivity Techniques in Nonlinear
    Control (2017), chapter 7). The drive force and the steering torque hold that speed and the steering angle
    arctan(l Omega / v), by springs and dampers of their own. On curved ground, the errors are those in the tangent plane.

    **Arguments:**

    - `scene`: the `Scene` that is driven, with the ground of the plan; its tilt and its weight may be others.
    - `plan`: a `Plan`. After its end, the stroller stays where it is then.

    **Returns:** an input for `simulate`: an `equinox.Module` with the gains as numbers, and with `storage(t, motion)`, the
    shaped energy.

    **Raises:** `ValueError` if an argument is of the wrong kind, or the scene has another kind of ground.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> gap = [stroller.Box((1.1, 0.3), (0.5, 0.25)), stroller.Box((2.7, 0.3), (0.5, 0.25))]
    >>> start, goal = stroller.Launch((0.0, 1.0), 0.0, 0.0), stroller.Goal((3.0, 1.2), heading=0.0)
    >>> plan = stroller.plan(scene, start, goal, 12.0, obstacles=gap, limits=stroller.Limits(steering=1.0))
    >>> elsewhere = stroller.Launch((0.05, 0.92), 0.1, 0.0)
    >>> run = stroller.simulate(scene, elsewhere, 12.0, stroller.track(scene, plan), times=[6.0, 12.0], tolerance=1e-6)
    >>> print(f"{run.place[-1, 0]:.1f} m, {run.place[-1, 1]:.1f} m")
    3.0 m, 1.2 m

    ```
    """
    require_kind(scene, "scene", Scene)
    require_kind(plan, "plan", Plan, ", as stroller.plan returns it")
    planned_on = type(plan.problem.scene.surface)
    if not isinstance(scene.surface, planned_on):
        raise ValueError(
            f"scene: its ground is a {type(scene.surface).__name__} and must be a {planned_on.__name__}, as in the plan"
        )
    run, axes = plan.run, scene.surface.axes
    nodes = np.linspace(0.0, plan.t1, FINE * INTERVALS + 1)
    poses = CubicSpline(np.asarray(run.t), np.asarray(run.state[:, : 2 * axes]))(nodes)
    length = scene.body.wheelbase
    lowest, highest = plan.problem.limits.arrays(0.0)
    return Tracker(
        drive=dataclasses.replace(plan.input, weight=scale(scene.body.mass * scene.gravity, scene.dynamics.up)),
        pose=jnp.asarray(interpolate(poses)),
        surface=scene.surface,
        wheelbase=length,
        across=1.0 / (REACH * length) ** 2,
        turning=2.0 / (REACH * length),
        along=jnp.asarray(CATCHING_UP),
        least_steering=jnp.asarray(lowest[0]),
        most_steering=jnp.asarray(highest[0]),
        slow=SLOW * length,
        side=scene.dynamics.side,
    )


# The parts of the pictures of a plan.

#: Heights of drawn obstacles, and radii of drawn lines, in units of the wheelbase.
HEIGHT, THIN, RAISED = 0.5, 0.008, 0.03

#: Reach of the cross at a goal without a heading, along x and y, in units of the wheelbase.
CROSS = 0.1

#: Height of the camera in units of its distance along the ground, from which obstacles do not hide the stroller.
RISE = 1.2

#: Outlines of the footprint in a plot.
OUTLINES = 13

#: Colours of obstacles, of candidates, and of the goal.
STONE, FAINT, GREEN = 0x8A8F98, 0x5B8DB8, 0x1F8A4C

#: The corners of a footprint, and the first one again.
CLOSED = [0, 1, 2, 3, 0]

#: The identity as a quaternion (x, y, z, w).
UNTURNED = (0.0, 0.0, 0.0, 1.0)


def planned_stage(plan: Plan) -> Stage:
    """The run of a plan on its stage, with obstacles, candidates, footprint and goal."""
    (stage,) = plan.run.stages()
    problem, (show, *_) = plan.problem, stage.shows
    length, count = float(problem.scene.body.wheelbase), len(show.times)
    feet = [fixed(problem.scene.surface, line) for line in problem.outlines]
    ground, lines = ground_of([plan.run], stage.arena.normal, *feet), list(plan.candidates)
    # Thin bands along the candidates, and upright prisms on the outlines, each with a lid of triangles about its middle.
    ribbons, blocks = [], []
    for line in lines:
        normal = normals(problem.scene, line)
        across = np.cross(normal, np.gradient(line, axis=0))
        across *= THIN * length / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-9)
        above = line + RAISED * length * normal
        sides = np.stack([above - across, above + across], axis=1)
        ribbons.append(Mesh(sides.reshape(-1, 3), of_grid(len(line), 2), FAINT))
    for foot, (_, frame) in zip(feet, problem.standing, strict=True):
        up = fixed(problem.scene.surface, tuple(frame[3]))
        level = foot @ up
        top = foot + (level.max() + HEIGHT * length - level)[:, None] * up
        columns = np.stack([np.broadcast_to(top.mean(axis=0), top.shape), top, foot], axis=1)
        closed = np.concatenate([columns, columns[:1]])
        blocks.append(Mesh(closed.reshape(-1, 3), of_grid(len(closed), 3), STONE))
    still = [ribbons, *([blocks] if blocks else [])]
    ends = goal_corners(problem, 2.0 * RAISED * length)
    pairs = (ends[:2], ends[2:]) if problem.goal.heading is None else (ends, np.roll(ends, -1, axis=0))
    arms = [bar(tuple(a), tuple(b), 2.0 * THIN * length, GREEN) for a, b in zip(*pairs, strict=True)]
    still.append(arms)
    place, turn = np.zeros((count, 3)), np.tile(UNTURNED, (count, 1))
    bodies = tuple(Body(place, turn, tuple(meshes)) for meshes in still)
    vehicle = show.bodies[0]
    # The frame's origin is the middle of the rear axle, above the ground.
    low = np.asarray(problem.footprint.corners(np.array([0.0, 0.0, -0.17 * length]), *np.eye(3)[:2]))
    edges = zip(map(tuple, low), map(tuple, np.roll(low, -1, axis=0)), strict=True)
    frame = tuple(bar(a, b, 1.5 * THIN * length, DARK) for a, b in edges)
    footprint = Body(vehicle.position, vehicle.orientation, frame)
    name = f"plan of {plan.t1:.3g} s"
    title = f"{name}: {'reaches the goal' if plan.reached else 'does not reach the goal'}"
    shows = (show._replace(name=name, bodies=(*show.bodies, footprint, *bodies)),)
    return stage._replace(title=title, arena=ground, shows=shows, rise=RISE)


def goal_corners(problem: Problem, raised: float = 0.0) -> Float[np.ndarray, "4 3"]:
    """The corners [m] of the footprint at the goal, or the ends of a cross at a goal without a heading."""
    arm = CROSS * problem.scene.body.wheelbase
    footprint = Footprint(2.0 * arm, 2.0 * arm, arm) if problem.goal.heading is None else problem.footprint
    return outlines(problem, footprint, problem.goal_pose[None], raised)[0]


def outlines(
    problem: Problem, footprint: Footprint, poses: Float[Array, "poses components"], raised: float = 0.0
) -> Float[np.ndarray, "poses 4 3"]:
    """The corners [m] of a footprint on the ground, or above it, in the fixed frame."""
    dynamics, surface = problem.scene.dynamics, problem.scene.surface
    flat = footprint.corners(*(fixed(surface, part) for part in frame_of(dynamics, poses.T)))
    ground = surface.nearest(own(surface, np.moveaxis(np.asarray(flat), -1, 0)))
    return fixed(surface, ground) + raised * dynamics.side * fixed(surface, surface.normal(ground))
