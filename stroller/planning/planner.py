"""A network that proposes drives, and its training."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from nonholonomic.geometry import Plane, cross, dot, scale
from nonholonomic.terminal import Progress, status_line
from nonholonomic.text import likely, shown
from nonholonomic.validation import require, require_flag, require_kind, require_package, require_whole

from ..model.dynamics import Dynamics, padded
from ..model.scene import Scene
from .problem import FAR, Pose, checked_problem, seen_from_above
from .transcription import ORDER, Numbers, Task, drive_from, motion_at, point_residuals, windows

# A network that proposes drives, step by step: it sees the goal and the obstacles from where the stroller is.

#: Proposals for a problem, and decisions in each of them.
PROPOSALS, DECISIONS = 4, 32

#: Steps of the Runge-Kutta method between two decisions, each of which is an interval of the plan.
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
    """A drive: coefficients of the steering angle [rad] and of the front wheel's speed [m/s], the poses before each step of
    the integration, and the pose at the end."""

    steering: Float[Array, " rows"]
    front_speed: Float[Array, " rows"]
    poses: Float[Array, "decisions parts components"]
    end: Pose


def goal_seen(task: Task, pose: Pose) -> Float[Array, " 6"]:
    """The goal as it is seen from a pose, six numbers: ahead and to the left, on two scales, and its heading."""
    dynamics, axes = task.dynamics, task.dynamics.surface.axes
    place, heading = padded(pose[:axes]), padded(pose[axes:])
    left = scale(dynamics.side, cross(dynamics.surface.normal(place), heading))
    away, goal_heading = padded((task.goal[0] - pose)[:axes] / task.length), padded(task.goal[0][axes:])
    ahead, aside = dot(away, heading), dot(away, left)
    turned = [task.has_heading * dot(goal_heading, heading), task.has_heading * dot(goal_heading, left)]
    # Lengths are on a scale that is logarithmic for great ones.
    return jnp.stack([*(jnp.arcsinh(length) for length in (ahead, aside, 4.0 * ahead, 4.0 * aside)), *turned])


def obstacles_seen(task: Task, pose: Pose) -> tuple[Float[Array, "obstacles 8"], Bool[Array, " obstacles"]]:
    """The corners of all obstacles as they are seen from a pose, a disc as a square; and whether a row is an obstacle or only
    pads the list."""
    square = jnp.array([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    discs = task.obstacles.centres[:, None] + square * task.obstacles.radii[:, None, None]
    corners = jnp.concatenate([task.obstacles.boxes, discs])
    place, *directions = seen_from_above(task.dynamics, pose)
    seen = jnp.arcsinh((corners - place) @ jnp.stack(directions, axis=1) / task.length)
    return seen.reshape(len(seen), CORNERS), jnp.abs(corners[:, 0, 0]) < 0.1 * FAR


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
    def untrained(cls, task: Task, key: Key[Array, ""]) -> "Planner":
        """A planner with random weights for problems such as one."""
        # A decision depends on the goal, the time left and four constants, the latest coefficients, the number of the
        # proposal, the pose where places differ from each other, and what is seen of all obstacles.
        pose = 0 if isinstance(task.dynamics.surface, Plane) else len(task.start[0])
        seen = 6 + 1 + 4 + 2 * (ORDER - 1) + PROPOSALS + pose + 2 * SEEING
        first, second = jax.random.split(key)
        # Single precision is enough for a proposal, and faster.
        options = {"activation": jax.nn.silu, "dtype": jnp.float32}
        return cls(
            eqx.nn.MLP(CORNERS, SEEING, SEEING, 2, key=first, **options),
            eqx.nn.MLP(seen, 2, DECIDING, 2, key=second, **options),
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

    def decide(self, task: Task, pose: Pose, known: Float[Array, " known"]) -> Float[Array, " 2"]:
        """Two numbers, from a pose and what else is known."""
        corners, is_there = obstacles_seen(task, pose)
        each = jnp.where(is_there[:, None], jax.vmap(self.of_obstacle)(corners.astype(jnp.float32)), 0.0)
        place = [] if isinstance(task.dynamics.surface, Plane) else [pose]
        seen = jnp.concatenate([goal_seen(task, pose), known, *place, each.sum(axis=0), each.max(axis=0, initial=0.0)])
        return self.of_step(seen.astype(jnp.float32)).astype(float)

    def propose(self, task: Task, t1: Numbers, number: Int[Array, ""]) -> Proposal:
        """One of the proposals for a problem."""
        pose, steering, steering_rate, front_speed = task.start
        duration, change = t1 / DECISIONS, jnp.array([-1.0, 0.0, 1.0])
        low, high, speed = task.low[0], task.high[0], task.speed
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


def merit(task: Task, proposal: Proposal, t1: Numbers) -> Numbers:
    """How far a proposal is from solving a problem: the weighted squares of what it misses, breaks and spends."""
    rows = windows(proposal.steering), windows(proposal.front_speed)

    def of_decision(poses, *window):
        def at(pose, part):
            return point_residuals(task, pose, motion_at(window, part / PARTS, t1 / DECISIONS))

        return jax.vmap(at)(poses, jnp.arange(PARTS))

    inequalities, effort = jax.vmap(of_decision)(proposal.poses, *rows)
    axes, away = task.dynamics.surface.axes, proposal.end - task.goal[0]
    missed = jnp.sum(away[:axes] ** 2) / task.length**2 + task.has_heading * jnp.sum(away[axes:] ** 2)
    broken = jnp.sum(jnp.minimum(inequalities, 0.0) ** 2)
    return MISSED * missed + BROKEN * broken + SPENT * jnp.sum(effort**2) / DECISIONS


@eqx.filter_jit
def _best(planner: Planner, task: Task, t1: Numbers) -> tuple[Numbers, Proposal]:
    """The merit and the drive of the best proposal."""

    def of_one(number: Int[Array, ""]) -> tuple[Numbers, Proposal]:
        proposal = planner.propose(task, t1, number)
        return merit(task, proposal, t1), proposal

    merits, proposals = jax.vmap(of_one)(jnp.arange(PROPOSALS))
    best = jnp.argmin(jnp.where(jnp.isfinite(merits), merits, jnp.inf))
    return jax.tree.map(lambda part: part[best], (merits, proposals))


def proposed(planner: Planner, task: Task, t1: float) -> Float[np.ndarray, "rows unknowns"] | None:
    """The best proposal as unknowns of the optimiser (see `transcription.py`); `None` if no proposal is finite."""
    least, proposal = jax.tree.map(np.asarray, _best(planner, task, jnp.asarray(t1)))
    if not np.isfinite(least):
        return None
    # The same splines with an interval for each step of the integration.
    coarse = np.stack([proposal.steering, proposal.front_speed], axis=1)
    splines = np.empty((PARTS * (len(coarse) - ORDER + 1) + ORDER - 1, 2))
    splines[::2] = (coarse[:-1] + coarse[1:]) / 2.0
    splines[1::2] = (coarse[:-2] + 6.0 * coarse[1:-1] + coarse[2:]) / 8.0
    poses = np.concatenate([proposal.poses.reshape(-1, len(proposal.end)), np.tile(proposal.end, (ORDER - 1, 1))])
    return np.concatenate([poses, splines], axis=1)


# Train a planner: a network that proposes drives.

#: Problems in a step, share of `seconds` in which problems are drawn, steps in which the learning rate rises, and that rate.
BATCH, DRAWING, RISE, RATE = 64, 0.2, 50, 1e-3

#: Weight of the mean of all proposals beside the best one, without which some of them would never learn.
SHARE = 0.05

#: The arguments of `plan` that a problem consists of.
TASK_PARTS = ("launch", "goal", "t1", "obstacles", "limits", "footprint")

#: Those that a problem needs.
NEEDED = ("launch", "goal", "t1")


def learn_planner(
    scene: Scene,
    problems: Callable[[np.random.Generator], dict[str, Any]],
    *,
    seconds: float = 600.0,
    seed: int = 0,
    progress: bool = True,
) -> Planner:
    """Train a network to propose drives, on random problems and through the simulation itself (needs optax).

    The network decides 32 times during a drive how the stroller steers and how fast it goes, from where the stroller then
    is: it sees the goal and the obstacles from there (compare Johnson et al., "Dynamically constrained motion planning
    networks for non-holonomic robots", arXiv 2008.05112, 2020). It makes four proposals. Its loss is that of the best one: by
    how much the drive misses the goal and breaks the constraints, and its effort. The gradient goes through the
    equations of motion. No plans are needed to learn from.

    The network sees the pose, the place, the heading and the speed of the goal, the time left, the limits of the steering
    angle through the angles that it may choose, and the corners of all obstacles, those of a square for a disc. It does not
    see the footprint and the other limits: these should be the same in all problems.

    **Arguments:**

    - `scene`: the `Scene` that is driven.
    - `problems`: a function of a `numpy.random.Generator` that returns a random problem: a `dict` with the arguments of `plan`
      by name, `launch`, `goal` and `t1`, and if needed `obstacles`, `limits` and `footprint`.
    - `seconds`: how long to learn [s], without the time to compile, at least 0; a fifth of it is spent on drawing problems.
    - `seed`: seed of the problems and of the first weights. The result also depends on the speed of the machine.
    - `progress`: whether to show a status line, with the number of steps and the loss.

    **Returns:** a `Planner`, for `plan(..., planner=planner)`. `equinox.tree_serialise_leaves` saves it, and
    `equinox.tree_deserialise_leaves` loads it into another one, such as `learn_planner(scene, problems, seconds=0)`.

    **Raises:** `ValueError` if an argument is of the wrong kind or a problem is not legal; `ModuleNotFoundError` without optax.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 0.5, 0.1, 0.05))
    >>> def problems(random):
    ...     goal = stroller.Goal(random.uniform(1.0, 3.0, 2), heading=random.uniform(-1.0, 1.0))
    ...     return {"launch": stroller.Launch((0.0, 0.0), 0.0, 0.0), "goal": goal, "t1": 10.0}
    ...
    >>> planner = stroller.learn_planner(scene, problems, seconds=0)
    >>> isinstance(planner, stroller.Planner)
    True

    ```
    """
    require_package("optax", "learn", "learn_planner")
    require_kind(scene, "scene", Scene)
    require(seconds, "seconds", at_least=0.0)
    require_whole(seed, "seed", 0)
    require_flag(progress, "progress")
    if not callable(problems):
        raise ValueError(f"problems = {shown(problems)} must be a function of a numpy.random.Generator")
    random = np.random.default_rng(seed)
    with status_line("learning", progress):
        tasks = [drawn_task(scene, problems, random, 0)]
        planner = Planner.untrained(tasks[0][0], jax.random.key(seed))
        begin = time.perf_counter()
        while time.perf_counter() - begin < DRAWING * seconds or len(tasks) < BATCH * (seconds > 0.0):
            tasks.append(drawn_task(scene, problems, random, len(tasks)))
        return trained(planner, scene.dynamics, tasks, random, (1.0 - DRAWING) * seconds, progress)


def drawn_task(
    scene: Scene, problems: Callable[[np.random.Generator], dict[str, Any]], random: np.random.Generator, number: int
) -> tuple[Task, float]:
    """A random problem as the optimiser needs it, and its duration [s]; `number` names the draw in messages."""
    parts: object = problems(random)
    try:
        if not isinstance(parts, dict):
            needed, optional = ", ".join(NEEDED), ", ".join(name for name in TASK_PARTS if name not in NEEDED)
            raise ValueError(f"{shown(parts)} must be a dict with {needed}, and if needed {optional}")
        for name in parts:
            if name not in TASK_PARTS:
                raise ValueError(f"{name!r} must be one of {', '.join(TASK_PARTS)}{likely(name, TASK_PARTS)}")
        for name in NEEDED:
            if name not in parts:
                raise ValueError(f"{name!r} is missing: a problem needs {', '.join(NEEDED)}")
        problem = checked_problem(scene, **parts)
    except ValueError as error:
        raise ValueError(f"problems: draw {number}: {error}") from None
    return Task.of(problem, problem.distance, problem.t1, problem.clearance), problem.t1


def stacked(tasks: list[tuple[Task, float]]) -> tuple[Task, Float[np.ndarray, " tasks"]]:
    """Tasks with as many obstacles each, as arrays with one row for each of them, without their common dynamics."""
    most = [max(len(getattr(task.obstacles, name)) for task, _ in tasks) for name in ("boxes", "radii")]
    # A task without a limit of the grip has a limit that nothing reaches.
    common = {"dynamics": None, "with_grip": any(task.with_grip for task, _ in tasks)}
    padded = [dataclasses.replace(task, obstacles=task.obstacles.padded(*most), **common) for task, _ in tasks]
    return jax.tree.map(lambda *parts: np.stack(parts), *padded), np.array([t1 for _, t1 in tasks])


def loss(planner: Planner, dynamics: Dynamics, tasks: Task, t1: Float[Array, " tasks"]) -> Float[Array, ""]:
    """What learning minimises: the mean over all problems of the merit of the best proposal, on a logarithmic scale."""

    def of_one(task: Task, t1: Numbers) -> Numbers:
        task = eqx.tree_at(lambda task: task.dynamics, task, dynamics, is_leaf=lambda part: part is None)
        merits = jax.vmap(lambda number: merit(task, planner.propose(task, t1, number), t1))(jnp.arange(PROPOSALS))
        values = jnp.log1p(merits)
        return values.min() + SHARE * values.mean()

    return jnp.mean(jax.vmap(of_one)(tasks, t1))


def trained(
    planner: Planner,
    dynamics: Dynamics,
    tasks: list[tuple[Task, float]],
    random: np.random.Generator,
    seconds: float,
    progress: bool,
) -> Planner:
    """A planner after steps of Adam, for `seconds` after the first step, which compiles."""
    import optax

    if seconds == 0.0:
        return planner
    pool, times = stacked(tasks)
    # A drive that went astray has no useful slope.
    optimiser = optax.apply_if_finite(optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam()), 2**31 - 1)

    @eqx.filter_jit
    def step(planner: Planner, state: Any, tasks: Task, t1: Float[Array, " tasks"], rate: Float[Array, ""]) -> Any:
        value, slopes = eqx.filter_value_and_grad(loss)(planner, dynamics, tasks, t1)
        change, state = optimiser.update(slopes, state)
        change = jax.tree.map(lambda part: (-rate * part).astype(part.dtype), change)
        return eqx.apply_updates(planner, change), state, value

    state, number = optimiser.init(eqx.filter(planner, eqx.is_inexact_array)), 0
    begin = spent = 0.0
    with Progress(math.ceil(seconds), "s", "learning", shown=progress) as display:
        while spent < 1.0:
            chosen = random.choice(len(tasks), BATCH, replace=False)
            rate = RATE * min(1.0, (number + 1) / RISE) * (0.5 + 0.5 * np.cos(np.pi * spent))
            batch = jax.tree.map(lambda part, chosen=chosen: part[chosen], pool)
            planner, state, value = step(planner, state, batch, jnp.asarray(times[chosen]), jnp.asarray(rate))
            value, now = float(value), time.perf_counter()
            if number == 0:
                begin = now
                display.begin()
            before, spent, number = spent, (now - begin) / seconds, number + 1
            display.advance(int(spent * seconds) - int(before * seconds), steps=number, loss=f"{value:.3g}")
    return planner
