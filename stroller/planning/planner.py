"""A network that proposes drives, step by step: it sees the goal and the obstacles from where the stroller is."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.geometry import Plane, cross, dot, scale

from ..model.dynamics import padded
from .drive import poses_along
from .obstacles import FAR
from .spline import ORDER
from .transcription import Task, drive_from, motion_at, point_residuals, seen_from_above, windows

#: Proposals for a problem, and decisions in each of them.
PROPOSALS, DECISIONS = 4, 32

#: Steps of the Runge-Kutta method between two decisions.
PARTS = 2

#: Greatest speed of a proposal, in units of that of the straight way.
FASTEST = 4.0

#: Relative difference of wheelbases from which on a planner is for another stroller.
OTHER_WHEELBASE = 0.1

#: Neurons of the layers that see an obstacle and of those that decide.
SEEING, DECIDING = 32, 128

#: Numbers that are seen of an obstacle: its four corners.
CORNERS = 8

#: Weights of a missed goal, of broken constraints and of the effort.
MISSED, BROKEN, SPENT = 10.0, 10.0, 0.1


class Proposal(NamedTuple):
    """A drive: coefficients (rows,) of the steering angle [rad] and of the front wheel's speed [m/s], the poses
    (decisions, parts, components) before each step of the integration, and the pose at the end."""

    steering: Any
    front_speed: Any
    poses: Any
    end: Any


def squeezed(lengths: Any) -> Any:
    """Lengths in wheelbases on a scale that is logarithmic for great ones."""
    return jnp.arcsinh(lengths)


def goal_seen(task: Task, pose: Any) -> Any:
    """The goal as it is seen from a pose, six numbers: ahead and to the left, on two scales, and its heading."""
    dynamics, axes = task.dynamics, task.dynamics.surface.axes
    place, heading = padded(pose[:axes]), padded(pose[axes:])
    left = scale(dynamics.side, cross(dynamics.surface.normal(place), heading))
    away, goal_heading = padded((task.goal[0] - pose)[:axes] / task.scales.length), padded(task.goal[0][axes:])
    ahead, aside = dot(away, heading), dot(away, left)
    turned = [task.has_heading * dot(goal_heading, heading), task.has_heading * dot(goal_heading, left)]
    return jnp.stack([squeezed(ahead), squeezed(aside), squeezed(4.0 * ahead), squeezed(4.0 * aside), *turned])


def obstacles_seen(task: Task, pose: Any) -> tuple[Any, Any]:
    """The corners of all obstacles as they are seen from a pose, (obstacles, 8), a disc as a square; and whether a row is an
    obstacle or only pads the list."""
    square = jnp.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    discs = task.obstacles.centres[:, None] + square * task.obstacles.radii[:, None, None]
    corners = jnp.concatenate([task.obstacles.boxes, discs])
    place, *directions = seen_from_above(task.dynamics, pose)
    seen = squeezed((corners - place) @ jnp.stack(directions, axis=1) / task.scales.length)
    return seen.reshape(len(seen), CORNERS), jnp.abs(corners[:, 0, 0]) < 0.1 * FAR


def numbers_seen(task: Task) -> int:
    """How many numbers a decision depends on: the goal, the time left and four constants, the latest coefficients, the
    number of the proposal, the pose where places differ from each other, and what is seen of all obstacles."""
    pose = 0 if isinstance(task.dynamics.surface, Plane) else len(task.start[0])
    return 6 + 1 + 4 + 2 * (ORDER - 1) + PROPOSALS + pose + 2 * SEEING


class Planner(eqx.Module):
    """A network that proposes drives for problems like those on which it was trained. `learn_planner` returns it, and `plan`
    tries its best proposal first.

    - `of_obstacle`: the layers that see an obstacle; `of_step`: those that decide about steering and speed;
    - `ground`, `wheelbase` [m]: the kind of ground and the wheelbase for which it has learned.

    **Example:**

    ```
    >>> import io
    >>> import equinox as eqx
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> def problems(random):
    ...     goal = stroller.Goal(random.uniform(1.0, 3.0, 2), heading=random.uniform(-1.0, 1.0))
    ...     return {"launch": stroller.Launch((0.0, 0.0), 0.0, 0.0), "goal": goal, "t1": 10.0}
    ...
    >>> planner = stroller.learn_planner(stroller.Scene(body), problems, seconds=0)
    >>> with io.BytesIO() as file:
    ...     eqx.tree_serialise_leaves(file, planner)
    ...     _ = file.seek(0)
    ...     again = eqx.tree_deserialise_leaves(file, planner)
    >>> bool(eqx.tree_equal(planner, again))
    True

    ```
    """

    of_obstacle: eqx.nn.MLP
    of_step: eqx.nn.MLP
    wheelbase: float
    ground: str = eqx.field(static=True)

    @classmethod
    def untrained(cls, task: Task, key: Any) -> "Planner":
        """A planner with random weights for problems such as one."""
        first, second = jax.random.split(key)
        # Single precision is enough for a proposal, and faster.
        options = {"activation": jax.nn.silu, "dtype": jnp.float32}
        return cls(
            eqx.nn.MLP(CORNERS, SEEING, SEEING, 2, key=first, **options),
            eqx.nn.MLP(numbers_seen(task), 2, DECIDING, 2, key=second, **options),
            float(task.dynamics.body.wheelbase),
            type(task.dynamics.surface).__name__,
        )

    def misfit(self, task: Task) -> str | None:
        """Why the planner is not for a task, in words; `None` if it has learned for its kind of ground and its wheelbase."""
        ground, wheelbase = type(task.dynamics.surface).__name__, float(task.dynamics.body.wheelbase)
        if ground != self.ground:
            return f"it has learned on a {self.ground}, and the ground of this scene is a {ground}"
        if abs(wheelbase - self.wheelbase) > OTHER_WHEELBASE * self.wheelbase:
            return f"it has learned with a wheelbase of {self.wheelbase:g} m, and that of this scene is {wheelbase:g} m"
        return None

    def decide(self, task: Task, pose: Any, known: Any) -> Any:
        """Two numbers, from a pose and what else is known."""
        corners, is_there = obstacles_seen(task, pose)
        each = jnp.where(is_there[:, None], jax.vmap(self.of_obstacle)(corners.astype(jnp.float32)), 0.0)
        place = [] if isinstance(task.dynamics.surface, Plane) else [pose]
        seen = jnp.concatenate([goal_seen(task, pose), known, *place, each.sum(axis=0), each.max(axis=0, initial=0.0)])
        return self.of_step(seen.astype(jnp.float32)).astype(float)

    def propose(self, task: Task, t1: Any, number: Any) -> Proposal:
        """One of the proposals for a problem."""
        pose, steering, steering_rate, front_speed = task.start
        duration, change = t1 / DECISIONS, jnp.array([-1.0, 0.0, 1.0])
        low, high, speed = task.low[0], task.high[0], task.scales.speed
        which = jax.nn.one_hot(number, PROPOSALS)
        fixed = jnp.stack([jnp.log(t1), jnp.log(speed), task.has_heading, task.goal[1] / speed])

        def decision(carry, k):
            pose, angles, speeds = carry
            left = (1.0 - k / DECISIONS)[None]
            known = jnp.concatenate([left, fixed, angles, speeds / speed, which])
            turn, ahead = self.decide(task, pose, known)
            angle = (low + high) / 2.0 + (high - low) / 2.0 * jnp.tanh(turn)
            is_last = k >= DECISIONS - ORDER + 1
            angle = jnp.where(k > DECISIONS - ORDER + 1, angles[-1], angle)
            next_speed = jnp.where(is_last, task.goal[1] / jnp.cos(angle), FASTEST * speed * jnp.tanh(ahead / FASTEST))
            window = jnp.append(angles, angle), jnp.append(speeds, next_speed)
            poses = []
            for part in range(PARTS):
                poses.append(pose)
                pose = drive_from(task.dynamics, pose, window, part / PARTS, 1.0 / PARTS, duration)
            return (pose, window[0][1:], window[1][1:]), (angle, next_speed, jnp.stack(poses))

        first = steering + steering_rate * duration * change, front_speed + 0.0 * change
        (end, _, _), (angles, speeds, poses) = jax.lax.scan(
            jax.checkpoint(decision), (pose, *first), jnp.arange(DECISIONS)
        )
        return Proposal(jnp.concatenate([first[0], angles]), jnp.concatenate([first[1], speeds]), poses, end)


def merit(task: Task, proposal: Proposal, t1: Any) -> Any:
    """How far a proposal is from solving a problem: the weighted squares of what it misses, breaks and spends."""
    rows = [windows(part[:, None])[..., 0] for part in (proposal.steering, proposal.front_speed)]

    def of_decision(poses, *window):
        def at(pose, part):
            return point_residuals(task, pose, motion_at(window, part / PARTS, t1 / DECISIONS))

        return jax.vmap(at)(poses, jnp.arange(PARTS))

    inequalities, effort = jax.vmap(of_decision)(proposal.poses, *rows)
    axes, away = task.dynamics.surface.axes, proposal.end - task.goal[0]
    missed = jnp.sum(away[:axes] ** 2) / task.scales.length**2 + task.has_heading * jnp.sum(away[axes:] ** 2)
    broken = jnp.sum(jnp.minimum(inequalities, 0.0) ** 2)
    return MISSED * missed + BROKEN * broken + SPENT * jnp.sum(effort**2) / DECISIONS


def refined(coefficients: np.ndarray) -> np.ndarray:
    """The same spline with twice as many intervals."""
    finer = np.empty(2 * len(coefficients) - ORDER + 1)
    finer[::2] = (coefficients[:-1] + coefficients[1:]) / 2.0
    finer[1::2] = (coefficients[:-2] + 6.0 * coefficients[1:-1] + coefficients[2:]) / 8.0
    return finer


@eqx.filter_jit
def _best(planner: Planner, task: Task, t1: Any) -> tuple[Any, Any, Any]:
    """The merit and the splines of the best proposal."""

    def of_one(number):
        proposal = planner.propose(task, t1, number)
        return merit(task, proposal, t1), proposal.steering, proposal.front_speed

    merits, *splines = jax.vmap(of_one)(jnp.arange(PROPOSALS))
    best = jnp.argmin(jnp.where(jnp.isfinite(merits), merits, jnp.inf))
    return merits[best], splines[0][best], splines[1][best]


def proposed(planner: Planner, task: Task, t1: float) -> np.ndarray | None:
    """The best proposal as unknowns of the optimiser (see `transcription.py`); `None` if no proposal is finite."""
    least, *splines = _best(planner, task, jnp.asarray(t1))
    if not np.isfinite(least):
        return None
    steering, front_speed = (refined(np.asarray(part)) for part in splines)
    poses = poses_along(task.dynamics, task.start[0], steering, front_speed, t1)
    poses = np.concatenate([poses, poses[-1:], poses[-1:]])
    return np.concatenate([poses, np.stack([steering, front_speed], axis=1)], axis=1)
