"""The planning problem as residuals of neighbouring knots, for a Gauss-Newton method with a banded matrix.

The unknowns of a knot are the pose (position and heading, in the ground's axes) and a coefficient of the B-splines of
the steering angle and of the front wheel's speed. An interval between two knots depends on four neighbouring rows of
unknowns, the *window*. Poses are unknowns of their own, tied together by the condition that the stroller drives from
each to the next (multiple shooting; Bock and Plitt, IFAC Proceedings 17 (1984) 1603), so a start may pass through poses
that no motion connects yet.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.geometry import cross, scale

from ..model.dynamics import Dynamics, padded
from .inverse import Rates, actuation, pose_rate
from .obstacles import Footprint, Obstacles
from .spline import ORDER, basis, weighted

#: Number of steps of the Runge-Kutta method in an interval; constraints hold at the start of each step, and at the end of the
#: drive.
STEPS = 3

#: Smallest normal force, in units of the weight.
LEAST_CONTACT = 0.02

#: Weight of the smoothness of the splines in the objective.
SMOOTHNESS = 0.02


class Scales(NamedTuple):
    """Units of the residuals: length [m], speed [m/s] and force [N]."""

    length: Any
    speed: Any
    force: Any


class Task(eqx.Module):
    """What all candidates of a plan have in common.

    - `start`: pose, steering angle, steering rate and front speed of the launch; `goal`: pose and speed.
    - `has_heading`: 1 if the goal has a heading, else 0.
    - `low`, `high`: limits of steering, speed, force, torque and grip.
    - `clearance`: the distance [m] to keep from obstacles.
    """

    dynamics: Dynamics
    footprint: Footprint
    obstacles: Obstacles
    start: tuple[Any, Any, Any, Any]
    goal: tuple[Any, Any]
    has_heading: Any
    low: Float[Array, " limits"]
    high: Float[Array, " limits"]
    clearance: Any
    scales: Scales
    with_grip: bool = eqx.field(static=True)


class Residuals(NamedTuple):
    """Residuals of an interval: equalities, inequalities (at least 0) and the objective, in units of the scales."""

    equalities: Any
    inequalities: Any
    objective: Any


def seen_from_above(dynamics: Dynamics, pose: Any) -> tuple[Any, Any, Any]:
    """The components x and y of the place, of the heading and of the direction to the left, each (2,)."""
    axes = dynamics.surface.axes
    place, heading = padded(pose[:axes]), padded(pose[axes:])
    left = scale(dynamics.side, cross(dynamics.surface.normal(place), heading))
    return jnp.stack(place[:2]), jnp.stack(heading[:2]), jnp.stack(left[:2])


def drive_from(dynamics: Dynamics, pose: Any, window: Any, part: Any, step: Any, duration: Any) -> Any:
    """The pose a step later, by the classical Runge-Kutta method; `part` and `step` in units of the interval."""
    steering, speed = window

    def rate(u, pose):
        weights = basis(u)[0]
        return duration * pose_rate(dynamics, pose, weighted(weights, steering), weighted(weights, speed))

    k1 = rate(part, pose)
    k2 = rate(part + step / 2.0, pose + step / 2.0 * k1)
    k3 = rate(part + step / 2.0, pose + step / 2.0 * k2)
    k4 = rate(part + step, pose + step * k3)
    return pose + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def motion_at(window: Any, part: Any, duration: Any) -> Rates:
    """The steering and the speed at a part of an interval that takes `duration` [s]."""
    (steering, speed), (value, slope, bend) = window, basis(part)
    return Rates(
        weighted(value, steering),
        weighted(slope, steering) / duration,
        weighted(bend, steering) / duration**2,
        weighted(value, speed),
        weighted(slope, speed) / duration,
    )


def point_residuals(task: Task, pose: Any, motion: Rates) -> tuple[Any, Any]:
    """Inequalities and objective at one point."""
    needed = actuation(task.dynamics, pose, motion, task.with_grip)
    scales = task.scales
    values = jnp.stack([motion.steering, needed.speed, needed.force, needed.torque])
    units = jnp.stack([1.0, scales.speed, scales.force, scales.force * scales.length])
    within = [(values - task.low[:4]) / units, (task.high[:4] - values) / units, task.high[4] - needed.grip]
    corners = task.footprint.corners(*seen_from_above(task.dynamics, pose))
    gaps = (task.obstacles.gaps(corners) - task.clearance) / scales.length
    weight = task.dynamics.body.mass * task.dynamics.gravity
    contact = needed.normal_force / jnp.maximum(weight, scales.force) - LEAST_CONTACT * (weight > 0.0)
    effort = jnp.stack([needed.force, needed.torque / task.dynamics.body.wheelbase]) / scales.force
    return jnp.concatenate([*within, gaps, contact[None]]), effort


def interval_residuals(window: Any, task: Task, index: Any, intervals: int, duration: Any) -> Residuals:
    """All residuals of the interval `index` of `intervals`, from its window (4, unknowns)."""
    poses, splines = window[:, :-2], (window[:, -2], window[:, -1])
    is_last = index == intervals - 1

    def step(pose, k):
        part = k / STEPS
        terms = point_residuals(task, pose, motion_at(splines, part, duration))
        return drive_from(task.dynamics, pose, splines, part, 1.0 / STEPS, duration), terms

    end, (inequalities, effort) = jax.lax.scan(step, poses[0], jnp.arange(STEPS))
    # No interval follows the last one.
    first, last = motion_at(splines, 0.0, duration), motion_at(splines, 1.0, duration)
    at_end, _ = point_residuals(task, end, last)
    inequalities = jnp.concatenate([inequalities.ravel(), jnp.where(is_last, at_end, 1.0)])
    axes, length = task.dynamics.surface.axes, task.scales.length
    units = jnp.concatenate([jnp.full(axes, length), jnp.ones(len(end) - axes)])
    at_start, at_goal = jnp.where(index == 0, 1.0, 0.0), jnp.where(is_last, 1.0, 0.0)
    (pose, steering, steering_rate, front_speed), (goal, goal_speed) = task.start, task.goal
    starts = [first.steering - steering, (first.steering_rate - steering_rate) * duration]
    starts += [(first.front_speed - front_speed) / task.scales.speed]
    away = (poses[1] - goal) / units * jnp.concatenate([jnp.ones(axes), jnp.full(axes, task.has_heading)])
    ends = [last.steering_rate * duration]
    ends += [(last.front_speed * jnp.cos(last.steering) - goal_speed) / task.scales.speed]
    equalities = [(poses[1] - end) / units, at_start * (poses[0] - pose) / units, at_start * jnp.stack(starts)]
    equalities += [at_goal * away, at_goal * jnp.stack(ends)]
    bends = splines[0][2] - 2.0 * splines[0][1] + splines[0][0], splines[1][2] - 2.0 * splines[1][1] + splines[1][0]
    smooth = SMOOTHNESS * jnp.stack([bends[0], bends[1] / task.scales.speed])
    objective = jnp.concatenate([effort.ravel() / jnp.sqrt(STEPS * intervals), smooth])
    return Residuals(jnp.concatenate(equalities), inequalities, objective)


def windows(unknowns: Any) -> Any:
    """The windows (intervals, 4, unknowns) of all intervals of the unknowns (rows, unknowns)."""
    intervals = len(unknowns) - ORDER + 1
    return jnp.stack([unknowns[k : k + intervals] for k in range(ORDER)], axis=1)


def residuals(unknowns: Any, task: Task, t1: Any) -> Residuals:
    """The residuals of all intervals of a candidate."""
    intervals = len(unknowns) - ORDER + 1

    def of_one(window, index):
        return interval_residuals(window, task, index, intervals, t1 / intervals)

    return jax.vmap(of_one)(windows(unknowns), jnp.arange(intervals))
