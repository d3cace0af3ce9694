"""The check of a drive: a run at a tight tolerance, the exact clearance of the whole footprint, and every limit."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from nonholonomic.text import readable_unit

from ..runs.trajectory import Trajectory
from ..runs.verbs import simulate
from .goal import Limits
from .obstacles import Footprint
from .problem import Problem
from .transcription import seen_from_above

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
    force, torque = _inputs(run.spec, run.t, run.state)
    return np.asarray(force), np.asarray(torque)


@eqx.filter_jit
def _inputs(spec: Any, times: Any, states: Any) -> Any:
    def at(t, state):
        return spec.input(t, spec.scene.dynamics.geometry(state).motion)

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
    squares = force**2 + (torque / float(run.spec.scene.body.wheelbase)) ** 2
    return float(np.trapezoid(squares, np.asarray(run.t)))


def checked_run(problem: Problem, drive: Any, t1: float, tolerance: float, times: int) -> tuple[Trajectory, Verdict]:
    """A run of an input, and what it achieves at a number of times."""
    run = simulate(problem.scene, problem.launch, t1, drive, times=np.linspace(0.0, t1, times), tolerance=tolerance)
    return run, judge(run, problem)
