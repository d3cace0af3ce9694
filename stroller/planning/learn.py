"""Train a planner: a network that proposes drives."""

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.progress import Progress, status_line
from nonholonomic.text import likely
from nonholonomic.validation import require, require_flag, require_kind, require_package, require_whole, shown

from ..model.dynamics import Dynamics
from ..model.scene import Scene
from .candidates import Outline
from .planner import PROPOSALS, Planner, merit
from .problem import checked_problem
from .transcription import Task

#: Problems in a step, share of `seconds` in which problems are drawn, steps in which the learning rate rises, and that rate.
BATCH, DRAWING, RISE, RATE = 64, 0.2, 50, 1e-3

#: Weight of the mean of all proposals beside the best one, without which some of them would never learn.
SHARE = 0.05

#: The arguments of `plan` that a problem consists of.
PARTS = ("launch", "goal", "t1", "obstacles", "limits", "footprint")

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
        if seconds == 0.0:
            return planner
        return trained(planner, scene.dynamics, tasks, random, (1.0 - DRAWING) * seconds, progress)


def drawn_task(scene: Scene, problems: Any, random: np.random.Generator, number: int) -> tuple[Task, float]:
    """A random problem as the optimiser needs it, and its duration [s]; `number` names the draw in messages."""
    parts = problems(random)
    try:
        arguments = arguments_of(parts)
        problem = checked_problem(scene, **arguments, tolerance=1e-6)
    except ValueError as error:
        raise ValueError(f"problems: draw {number}: {error}") from None
    outline, t1 = Outline.of(problem), float(arguments["t1"])
    return outline.task(outline.distance, t1, outline.clearance), t1


def arguments_of(parts: Any) -> dict[str, Any]:
    """The arguments of `plan` of which a problem consists; raises `ValueError` for anything else."""
    if not isinstance(parts, dict):
        needed, optional = ", ".join(NEEDED), ", ".join(name for name in PARTS if name not in NEEDED)
        raise ValueError(f"{shown(parts)} must be a dict with {needed}, and if needed {optional}")
    for name in parts:
        if name not in PARTS:
            raise ValueError(f"{name!r} must be one of {', '.join(PARTS)}{likely(name, PARTS)}")
    for name in NEEDED:
        if name not in parts:
            raise ValueError(f"{name!r} is missing: a problem needs {', '.join(NEEDED)}")
    return dict.fromkeys(PARTS) | {"obstacles": ()} | parts


def stacked(tasks: list[tuple[Task, float]]) -> tuple[Task, np.ndarray]:
    """Tasks with as many obstacles each, as arrays with one row for each of them, without their common dynamics."""
    most = [max(len(getattr(task.obstacles, name)) for task, _ in tasks) for name in ("boxes", "radii")]
    # A task without a limit of the grip has a limit that nothing reaches.
    with_grip = any(task.with_grip for task, _ in tasks)
    padded = [
        dataclasses.replace(task, dynamics=None, obstacles=task.obstacles.padded(*most), with_grip=with_grip)
        for task, _ in tasks
    ]
    return jax.tree.map(lambda *parts: np.stack(parts), *padded), np.array([t1 for _, t1 in tasks])


def loss(planner: Planner, dynamics: Dynamics, tasks: Task, t1: Any) -> Any:
    """What learning minimises: the mean over all problems of the merit of the best proposal, on a logarithmic scale."""

    def of_one(task, t1):
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

    pool, times = stacked(tasks)
    optimiser = optax.scale_by_adam()

    @eqx.filter_jit
    def step(planner, state, tasks, t1, rate):
        value, slopes = eqx.filter_value_and_grad(loss)(planner, dynamics, tasks, t1)
        norm = jnp.sqrt(sum(jnp.sum(part**2) for part in jax.tree.leaves(slopes)))
        # A drive that went astray has no useful slope.
        usable = jnp.where(jnp.isfinite(norm), 1.0 / jnp.maximum(norm, 1.0), 0.0)
        slopes = jax.tree.map(lambda part: jnp.where(usable > 0.0, usable * part, 0.0).astype(part.dtype), slopes)
        change, state = optimiser.update(slopes, state)
        change = jax.tree.map(lambda part: (-rate * part).astype(jnp.float32), change)
        return eqx.apply_updates(planner, change), state, value

    state, number = optimiser.init(eqx.filter(planner, eqx.is_inexact_array)), 0
    begin = spent = 0.0
    with Progress(math.ceil(seconds), "s", "learning", shown=progress) as display:
        while spent < 1.0:
            chosen = random.choice(len(tasks), BATCH, replace=False)
            rate = RATE * min(1.0, (number + 1) / RISE) * (0.5 + 0.5 * np.cos(np.pi * spent))
            batch = jax.tree.map(lambda part, chosen=chosen: part[chosen], pool)
            planner, state, value = step(planner, state, batch, times[chosen], jnp.asarray(rate))
            value, now = float(value), time.perf_counter()
            if number == 0:
                begin = now
                display.begin()
            before, spent, number = spent, (now - begin) / seconds, number + 1
            display.advance(int(spent * seconds) - int(before * seconds), steps=number, loss=f"{value:.3g}")
    return planner
