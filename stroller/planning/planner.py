"""A network that proposes drives, and its training."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from nonholonomic.geometry import Plane, dot
from nonholonomic.terminal import Progress, status_line
from nonholonomic.text import likely, shown
from nonholonomic.validation import explaining, require, require_flag, require_kind, require_package, require_whole

from ..model.scene import Dynamics, Number, Scene, padded
from .problem import FAR, FROM_ABOVE, SQUARE, Pose, checked_problem, frame_of
from .transcription import ORDER, Task, drive_from, motion_at, point_residuals, windows

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

#: Number that are seen of an obstacle: its four corners.
CORNERS = 8

#: Weights of a missed goal, of broken constraints and of the effort.
MISSED, BROKEN, SPENT = 10.0, 10.0, 0.1


class Proposal(NamedTuple):
    """A drive: coefficients of the steering angle [rad] and of the front wheel's speed [m/s], the poses before each step of
    the integration, and the pose at the end."""

    splines: Float[Array, "rows 2"]
    poses: Float[Array, "decisions parts components"]
    end: Pose


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

    def decide(self, task: Task, pose: Pose, known: Float[Array, " known"]) -> Float[Array, " 2"]:
        """Two numbers, from what is seen from a pose and what else is known."""
        dynamics, axes, obstacles = task.dynamics, task.dynamics.surface.axes, task.obstacles
        place, heading, left = frame_of(dynamics, pose)
        # Of the goal: ahead and to the left, on two scales that are logarithmic for great lengths, and its heading.
        away, goal_heading = padded((task.goal[0] - pose)[:axes] / task.length), padded(task.goal[0][axes:])
        ahead, aside = dot(away, heading), dot(away, left)
        lengths = [jnp.arcsinh(length) for length in (ahead, aside, 4.0 * ahead, 4.0 * aside)]
        turned = [task.has_heading * dot(goal_heading, heading), task.has_heading * dot(goal_heading, left)]
        # Of the obstacles: their corners, a disc as a square. Those that pad the list are far away.
        squares = obstacles.centres[:, None] + SQUARE * obstacles.radii[:, None, None]
        corners = jnp.concatenate([obstacles.boxes, squares])
        if tuple(dynamics.surface.coordinates) != FROM_ABOVE:
            frames = jnp.concatenate([obstacles.box_frames, obstacles.disc_frames])
            corners = frames[:, :1] + corners @ frames[:, 1:3]
        origin, *directions = (jnp.stack(part[: corners.shape[-1]]) for part in (place, heading, left))
        seen = jnp.arcsinh((corners - origin) @ jnp.stack(directions, axis=1) / task.length)
        each = jax.vmap(self.of_obstacle)(seen.reshape(-1, CORNERS).astype(jnp.float32))
        each = jnp.where(jnp.abs(corners[:, :1, 0]) < 0.1 * FAR, each, 0.0)
        own = [] if isinstance(dynamics.surface, Plane) else [pose]
        parts = [jnp.stack([*lengths, *turned]), known, *own, each.sum(axis=0), each.max(axis=0, initial=0.0)]
        return self.of_step(jnp.concatenate(parts).astype(jnp.float32)).astype(float)

    def propose(self, task: Task, number: Int[Array, ""]) -> tuple[Number, Proposal]:
        """One of the proposals for a problem, and its merit before it."""
        pose, steering, steering_rate, front_speed = task.start
        duration, change = task.t1 / DECISIONS, jnp.array([-1.0, 0.0, 1.0])
        low, high, speed = task.low[0], task.high[0], task.speed
        which = jax.nn.one_hot(number, PROPOSALS)
        fixed = jnp.stack([jnp.log(task.t1), jnp.log(speed), task.has_heading, task.goal[1] / speed])

        def decision(carry, k):
            pose, latest = carry
            angles, speeds = latest.T
            left = (1.0 - k / DECISIONS)[None]
            known = jnp.concatenate([left, fixed, angles, speeds / speed, which])
            turn, ahead = self.decide(task, pose, known)
            angle = (low + high) / 2.0 + (high - low) / 2.0 * jnp.tanh(turn)
            is_last = k >= DECISIONS - ORDER + 1
            angle = jnp.where(k > DECISIONS - ORDER + 1, angles[-1], angle)
            next_speed = jnp.where(is_last, task.goal[1] / jnp.cos(angle), FASTEST * speed * jnp.tanh(ahead / FASTEST))
            window = jnp.concatenate([latest, jnp.stack([angle, next_speed])[None]])
            poses = []
            for part in range(PARTS):
                poses.append(pose)
                pose = drive_from(task.dynamics, pose, window, part / PARTS, 1.0 / PARTS, duration)
            return (pose, window[1:]), (window[-1], jnp.stack(poses))

        first = jnp.stack([steering + steering_rate * duration * change, front_speed + 0.0 * change], axis=1)
        (end, _), (rows, poses) = jax.lax.scan(jax.checkpoint(decision), (pose, first), jnp.arange(DECISIONS))
        proposal = Proposal(jnp.concatenate([first, rows]), poses, end)
        return merit(task, proposal), proposal

    @eqx.filter_jit
    def proposals(self, task: Task) -> tuple[Float[Array, " proposals"], Proposal]:
        """The merits of all proposals for a problem, and the proposals."""
        return jax.vmap(functools.partial(self.propose, task))(jnp.arange(PROPOSALS))


def merit(task: Task, proposal: Proposal) -> Number:
    """How far a proposal is from solving a problem: the weighted squares of what it misses, breaks and spends."""

    def at(pose, window, part):
        return point_residuals(task, pose, motion_at(window, part / PARTS, task.t1 / DECISIONS))

    of_decision = jax.vmap(at, (0, None, 0))
    of_all = jax.vmap(of_decision, (0, 0, None))
    inequalities, effort = of_all(proposal.poses, windows(proposal.splines), jnp.arange(PARTS))
    axes, away = task.dynamics.surface.axes, proposal.end - task.goal[0]
    missed = jnp.sum(away[:axes] ** 2) / task.length**2 + task.has_heading * jnp.sum(away[axes:] ** 2)
    broken = jnp.sum(jnp.minimum(inequalities, 0.0) ** 2)
    return MISSED * missed + BROKEN * broken + SPENT * jnp.sum(effort**2) / DECISIONS


def proposed(planner: Planner, task: Task) -> Float[np.ndarray, "rows unknowns"] | None:
    """The best proposal as unknowns of the optimiser (see `transcription.py`); `None` if no proposal is finite. Raises
    `ValueError` if the planner has learned on another kind of ground or with another wheelbase."""
    ground, wheelbase = type(task.dynamics.surface).__name__, float(task.dynamics.body.wheelbase)
    misfit = None
    if ground != planner.ground:
        misfit = f"learned on a {planner.ground}, and the ground of this scene is a {ground}"
    elif abs(wheelbase - planner.wheelbase) > OTHER_WHEELBASE * planner.wheelbase:
        misfit = f"learned with a wheelbase of {planner.wheelbase:g} m, and that of this scene is {wheelbase:g} m"
    if misfit is not None:
        raise ValueError(f"planner: it has {misfit}; learn in this scene")
    merits, proposals = jax.tree.map(np.asarray, planner.proposals(task))
    best = np.argmin(np.where(np.isfinite(merits), merits, np.inf))
    if not np.isfinite(merits[best]):
        return None
    coarse, poses, end = (part[best] for part in proposals)
    # The same splines with an interval for each step of the integration.
    splines = np.empty((PARTS * (len(coarse) - ORDER + 1) + ORDER - 1, 2))
    splines[::2] = (coarse[:-1] + coarse[1:]) / 2.0
    splines[1::2] = (coarse[:-2] + 6.0 * coarse[1:-1] + coarse[2:]) / 8.0
    poses = np.concatenate([poses.reshape(-1, len(end)), np.tile(end, (ORDER - 1, 1))])
    return np.concatenate([poses, splines], axis=1)


# Train a planner: a network that proposes drives.

#: Problems in a step, share of `seconds` in which problems are drawn, steps in which the learning rate rises, and that rate.
BATCH, DRAWING, RISE, RATE = 64, 0.2, 50, 1e-3

#: Weight of the mean of all proposals beside the best one, without which some of them would never learn.
SHARE = 0.05

#: A random problem: the arguments of `plan` by their names.
Problems = Callable[[np.random.Generator], dict[str, Any]]

#: The arguments of `plan` that a problem consists of.
TASK_PARTS = ("launch", "goal", "t1", "obstacles", "limits", "footprint")

#: Those that a problem needs.
NEEDED = ("launch", "goal", "t1")


@explaining
def learn_planner(
    scene: Scene, problems: Problems, *, seconds: float = 600.0, seed: int = 0, progress: bool = True
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
        planner = Planner.untrained(tasks[0], jax.random.key(seed))
        begin = time.perf_counter()
        while time.perf_counter() - begin < DRAWING * seconds or len(tasks) < BATCH * (seconds > 0.0):
            tasks.append(drawn_task(scene, problems, random, len(tasks)))
        return trained(planner, tasks, random, (1.0 - DRAWING) * seconds, progress)


def drawn_task(scene: Scene, problems: Problems, random: np.random.Generator, number: int) -> Task:
    """A random problem as the optimiser needs it; `number` names the draw in messages."""
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
    return Task.of(problem, problem.distance, problem.t1, problem.clearance)


def loss(planner: Planner, dynamics: Dynamics, tasks: Task) -> Float[Array, ""]:
    """What learning minimises: the mean over all problems of the merit of the best proposal, on a logarithmic scale."""

    def of_one(task: Task) -> Number:
        values = jnp.log1p(planner.proposals(dataclasses.replace(task, dynamics=dynamics))[0])
        return values.min() + SHARE * values.mean()

    return jnp.mean(jax.vmap(of_one)(tasks))


def trained(
    planner: Planner, tasks: list[Task], random: np.random.Generator, seconds: float, progress: bool
) -> Planner:
    """A planner after steps of Adam, for `seconds` after the first step, which compiles."""
    import optax

    if seconds == 0.0:
        return planner
    # As many obstacles in each task, no limit of the grip as one that nothing reaches, and the common dynamics left out.
    most = [max(len(getattr(task.obstacles, name)) for task in tasks) for name in ("boxes", "radii")]
    dynamics, common = tasks[0].dynamics, {"dynamics": None, "with_grip": any(task.with_grip for task in tasks)}
    padded = [dataclasses.replace(task, obstacles=task.obstacles.padded(*most), **common) for task in tasks]
    pool = jax.tree.map(lambda *parts: np.stack(parts), *padded)
    # A drive that went astray has no useful slope.
    optimiser = optax.apply_if_finite(optax.chain(optax.clip_by_global_norm(1.0), optax.scale_by_adam()), 2**31 - 1)

    @eqx.filter_jit
    def step(planner: Planner, state: Any, tasks: Task, rate: Float[Array, ""]) -> Any:
        value, slopes = eqx.filter_value_and_grad(loss)(planner, dynamics, tasks)
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
            planner, state, value = step(planner, state, batch, jnp.asarray(rate))
            value, now = float(value), time.perf_counter()
            if number == 0:
                begin = now
                display.begin()
            before, spent, number = spent, (now - begin) / seconds, number + 1
            display.advance(int(spent * seconds) - int(before * seconds), steps=number, loss=f"{value:.3g}")
    return planner
