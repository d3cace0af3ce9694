"""Train a planner: a network that proposes drives."""

import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.progress import status_line
from nonholonomic.validation import require, require_kind, require_package, require_whole, shown

from ..model.dynamics import Dynamics
from ..model.scene import Scene
from .candidates import Outline
from .planner import PROPOSALS, Planner, merit
from .problem import checked_problem
from .transcription import Task

#: Problems in a step, share of the time in which problems are drawn, steps in which the learning rate rises, and that rate.
BATCH, DRAWING, RISE, RATE = 64, 0.2, 50, 1e-3

#: Weight of the mean of all proposals beside the best one, without which some of them would never learn.
SHARE = 0.05

#: The arguments of `plan` that a problem consists of.
PARTS = ("launch", "goal", "t1", "obstacles", "limits", "footprint")


def learn_planner(
    scene: Scene, problems: Callable[[np.random.Generator], dict[str, Any]], *, seconds: float = 600.0, seed: int = 0
) -> Planner:
    """Train a planner on problems that it draws, through the simulation of the drives that it proposes (needs optax).

    The network decides 32 times during a drive how the stroller steers and how fast it goes, from where the stroller then
    is: it sees the goal and the obstacles from there (compare Johnson et al., "Dynamically constrained motion planning
    networks for non-holonomic robots", arXiv 2008.05112, 2020). It makes four proposals. Its loss is that of the best one: by
    how much the drive misses the goal and breaks the constraints, and its effort. The gradient goes through the
    equations of motion. No plans are needed to learn from.

    **Arguments:**

    - `scene`: the `Scene` that is driven.
    - `problems`: a function of a `numpy.random.Generator` that returns a random problem: a `dict` with the arguments of `plan`
      by name, `launch`, `goal` and `t1`, and if needed `obstacles`, `limits` and `footprint`.
    - `seconds`: how long to learn [s], at least 0; about a fifth of it is spent on drawing problems.
    - `seed`: seed of the problems and of the first weights. The result also depends on the speed of the machine.

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
    begin, random = time.perf_counter(), np.random.default_rng(seed)
    with status_line("learning"):
        tasks = [drawn_task(scene, problems, random)]
        planner = Planner.untrained(tasks[0][0], jax.random.key(seed))
        while time.perf_counter() - begin < DRAWING * seconds or len(tasks) < BATCH * (seconds > 0.0):
            tasks.append(drawn_task(scene, problems, random))
        return trained(planner, scene.dynamics, tasks, random, begin, seconds) if seconds > 0.0 else planner


def drawn_task(scene: Scene, problems: Any, random: np.random.Generator) -> tuple[Task, float]:
    """A random problem as the optimiser needs it, and its duration [s]."""
    if not callable(problems):
        raise ValueError(f"problems = {shown(problems)} must be a function of a numpy.random.Generator")
    parts = problems(random)
    if not (isinstance(parts, dict) and {"launch", "goal", "t1"} <= set(parts) <= set(PARTS)):
        raise ValueError(
            f"problems returned {shown(parts)} and must return a dict with launch, goal and t1, and if needed obstacles, "
            "limits and footprint"
        )
    given: Any = {name: parts.get(name) for name in PARTS} | {"obstacles": parts.get("obstacles", ())}
    problem = checked_problem(scene, **given, tolerance=1e-6)
    outline = Outline.of(problem)
    return outline.task(outline.distance, float(given["t1"]), outline.clearance), float(given["t1"])


def stacked(tasks: list[tuple[Task, float]]) -> tuple[Task, np.ndarray]:
    """Tasks with as many obstacles each, as arrays with one row for each of them, without their common dynamics."""
    most = [max(len(getattr(task.obstacles, name)) for task, _ in tasks) for name in ("boxes", "radii")]
    padded = [
        eqx.tree_at(lambda task: (task.dynamics, task.obstacles), task, (None, task.obstacles.padded(*most)))
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
    begin: float,
    seconds: float,
) -> Planner:
    """A planner after steps of Adam until `seconds` have passed since `begin`."""
    import optax

    pool, times = stacked(tasks)
    optimiser = optax.scale_by_adam()

    @eqx.filter_jit
    def step(planner, state, tasks, t1, rate):
        slopes = eqx.filter_grad(loss)(planner, dynamics, tasks, t1)
        norm = jnp.sqrt(sum(jnp.sum(part**2) for part in jax.tree.leaves(slopes)))
        # A drive that went astray has no useful slope.
        usable = jnp.where(jnp.isfinite(norm), 1.0 / jnp.maximum(norm, 1.0), 0.0)
        slopes = jax.tree.map(lambda part: jnp.where(usable > 0.0, usable * part, 0.0).astype(part.dtype), slopes)
        change, state = optimiser.update(slopes, state)
        change = jax.tree.map(lambda part: (-rate * part).astype(jnp.float32), change)
        return eqx.apply_updates(planner, change), state

    state, number = optimiser.init(eqx.filter(planner, eqx.is_inexact_array)), 0
    while (spent := (time.perf_counter() - begin) / seconds) < 1.0:
        chosen = random.choice(len(tasks), BATCH, replace=False)
        rate = RATE * min(1.0, number / RISE) * (0.5 + 0.5 * np.cos(np.pi * spent))
        batch = jax.tree.map(lambda part, chosen=chosen: part[chosen], pool)
        planner, state = step(planner, state, batch, times[chosen], jnp.asarray(rate))
        number += 1
    return planner
