"""Plans of random problems: `stroller.plan` beside CasADi with IPOPT and a kinodynamic planner of OMPL.

    pip install casadi ompl
    python benchmarks/planning.py [--problems 200] [--ipopt 40] [--ompl 12] [--curved 100] [--learn 600]
    python benchmarks/planning.py --empty 200

Problems on the plane have 3 to 8 boxes in a square of 6 m and a vehicle of 0.5 m by 0.25 m, with a steering angle of at most
60 degrees and a speed between -0.5 and 0.8 m/s; the drive takes 25 s. Those on curved ground have no obstacles. Every
answer drives the stroller in `simulate` at a tolerance of 1e-9, by an input that `stroller.plan` makes of a steering angle and
a speed, and the same check judges its run: its end, its limits and the distance between the whole footprint and the boxes.
In a row of its own, a planner that has learned for `--learn` seconds, from other problems of the same kind, makes the first
proposal.

Time is CPU time of a problem, without compilation, which the wall time of a first call contains. CasADi solves a direct
collocation of the same dynamics from the straight line, and from the path that our search finds, whose time is included.
OMPL's planner decides the duration itself. Effort is that of the run, relative to the effort of `stroller.plan` for the same
problem (median). Ctrl-C ends a group of problems early, with a table of those that are solved.

With `--empty`, the time is minimised on the empty plane, from rest to rest, to random goals in a square of 10 m, with a least
turning radius of 1 m, a speed of at most 1 m/s, wheelbases of 0.25 to 1 m, and 1.2 to 4 times the time of the shortest path as
the longest duration. The excess is that over the shortest path of a point that needs no time to turn its wheel or to brake.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from measure import machine, table, write_csv
from shortest_paths import dubins, reeds_shepp

import stroller
from stroller.planning.plan import TIGHT, checked_drive
from stroller.planning.problem import Problem
from stroller.planning.search import paths_of, prices
from stroller.planning.transcription import drive_along, interpolate

BODY = stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005)
FRICTION = stroller.Damping(2.0, 0.5, 0.1, 0.05)
LIMITS = stroller.Limits(steering=np.pi / 3.0, speed=(-0.5, 0.8))
FOOTPRINT = stroller.Footprint(length=0.5, width=0.25, rear=0.1)
T1 = 25.0

#: Side of the square [m], number of boxes, their sides [m], least distance of the ends [m] and least clearance there [m].
SIDE, BOXES, SIDES, APART, FREE = 6.0, (3, 8), (0.3, 1.5), 2.0, 0.05

GROUNDS = {
    "inside a spheroid": stroller.Scene(BODY, stroller.Spheroid(6.0, 3.0), FRICTION, side="inside"),
    "hills": stroller.Scene(BODY, stroller.Graph(lambda x, y: 0.2 * jnp.cos(x) * jnp.sin(y)), FRICTION),
}


class Outcome(NamedTuple):
    """What a planner achieves: whether its run reaches the goal, its CPU time and wall time [s], its effort, and how many
    candidates were optimised."""

    reached: bool
    cpu: float
    wall: float
    effort: float
    candidates: int = 1


def pose(random: np.random.Generator, low: Any, high: Any) -> tuple[tuple[float, float], float]:
    """A random place and heading."""
    x, y = random.uniform(low, high)
    return (float(x), float(y)), float(random.uniform(-np.pi, np.pi))


def on_plane(seed: int) -> Iterator[Problem]:
    """Random problems on the plane."""
    random, scene = np.random.default_rng(seed), stroller.Scene(BODY, friction=FRICTION)
    while True:
        boxes = [
            stroller.Box(random.uniform(0.0, SIDE, 2), random.uniform(*SIDES, 2), random.uniform(0.0, np.pi))
            for _ in range(random.integers(BOXES[0], BOXES[1] + 1))
        ]
        start, goal = (pose(random, (0.0, 0.0), (SIDE, SIDE)) for _ in range(2))
        if np.hypot(*np.subtract(start[0], goal[0])) < APART:
            continue
        launch, target = stroller.Launch(*start, 0.0), stroller.Goal(*goal)
        problem = Problem(scene, launch, target, T1, tuple(boxes), LIMITS, FOOTPRINT)
        if min(map(np.min, problem.gaps_at_ends.values())) > FREE:
            yield problem


def on_ground(name: str, seed: int) -> Iterator[Problem]:
    """Random problems without obstacles, on one of the `GROUNDS`."""
    random, scene = np.random.default_rng(seed), GROUNDS[name]
    low, high = ((-1.0, -1.3), (1.0, -0.7)) if name == "inside a spheroid" else ((-2.5, -2.5), (2.5, 2.5))
    while True:
        start, goal = (pose(random, low, high) for _ in range(2))
        problem = Problem(scene, stroller.Launch(*start, 0.0), stroller.Goal(*goal), T1, (), LIMITS, FOOTPRINT)
        axes = scene.surface.axes
        if np.linalg.norm(np.asarray(problem.start_pose - problem.goal_pose)[:axes]) > APART / 2.0:
            yield problem


def measured(solve: Callable[[], Any]) -> tuple[Any, float, float]:
    """A result, its CPU time and its wall time [s]."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = solve()
    return result, time.process_time() - cpu, time.perf_counter() - wall


def arguments(problem: Problem) -> dict[str, Any]:
    """The arguments of `stroller.plan` for a problem, beside the scene."""
    return {name: getattr(problem, name) for name in ("launch", "goal", "t1", "obstacles", "limits", "footprint")}


def by_us(problem: Problem, planner: stroller.Planner | None = None) -> Outcome:
    """The outcome of `stroller.plan`."""
    plan, cpu, wall = measured(
        lambda: stroller.plan(problem.scene, **arguments(problem), planner=planner, progress=False)
    )
    return Outcome(plan.reached, cpu, wall, plan.effort, len(plan.candidates))


def learned(problems: Callable[[int], Iterator[Problem]], seconds: float, seed: int) -> stroller.Planner:
    """A planner for problems of one kind, which are drawn with other seeds than those to be solved."""
    scene = next(problems(seed)).scene

    def drawn(random: np.random.Generator) -> dict[str, Any]:
        return arguments(next(problems(int(random.integers(2**40, 2**41)))))

    return stroller.learn_planner(scene, drawn, seconds=seconds, seed=seed)


def judged(problem: Problem, answer: Any, cpu: float, wall: float) -> Outcome:
    """The outcome of an answer of another planner, or of `None`."""
    if answer is None:
        return Outcome(False, cpu, wall, np.nan)
    splines = interpolate(np.stack([answer.steering, answer.front_speed], axis=1))
    drive = drive_along(problem.scene.dynamics, problem.start_pose, splines, answer.t1)
    plan = checked_drive(dataclasses.replace(problem, t1=answer.t1), drive, TIGHT)
    return Outcome(plan.reached, cpu, wall, plan.effort)


def by_casadi(problem: Problem, with_path: bool, seconds: float) -> Outcome:
    """The outcome of CasADi with IPOPT; building its program is compilation and is not counted."""
    from planning_peers import casadi_program

    path, searched = None, (0.0, 0.0)
    if with_path:
        (paths, _), *searched = measured(lambda: paths_of(problem, prices(problem, 1, 0, np.random.default_rng(0))))
        path = paths[0]
    solve = casadi_program(problem, T1, path, problem.clearance, seconds)
    answer, cpu, wall = measured(solve)
    return judged(problem, answer, cpu + searched[0], wall + searched[1])


def by_ompl(problem: Problem, seconds: float) -> Outcome:
    """The outcome of OMPL's kinodynamic planner."""
    from planning_peers import by_ompl

    return judged(problem, *measured(lambda: by_ompl(problem, seconds)))


def row_of(problems: str, planner: str, outcomes: list[Outcome], ours: list[Outcome], first: float) -> dict[str, str]:
    """A row of the table."""
    cpu, wall = (np.array([getattr(outcome, name) for outcome in outcomes]) for name in ("cpu", "wall"))
    both = [
        (own.effort, other.effort) for own, other in zip(ours, outcomes, strict=False) if own.reached and other.reached
    ]
    ratio = np.median([other / own for own, other in both]) if both else np.nan
    return {
        "problems": f"{len(outcomes)} {problems}",
        "planner": planner,
        "reached": f"{100.0 * np.mean([outcome.reached for outcome in outcomes]):.1f} %",
        "CPU s: median": f"{np.median(cpu):.2f}",
        "90 %": f"{np.percentile(cpu, 90):.1f}",
        "wall s: median": f"{np.median(wall):.2f}",
        "candidates: median": f"{np.median([outcome.candidates for outcome in outcomes]):g}",
        "effort": f"{ratio:.2f} of {len(both)}",
        "first call, wall s": f"{first:.1f}",
    }


def compared(
    name: str, problems: Iterator[Problem], planners: dict[str, tuple[Callable[[Problem], Outcome], int]]
) -> list[dict[str, str]]:
    """A row for each planner, which solves the first problem once more before the others."""
    outcomes: dict[str, list[Outcome]] = {planner: [] for planner, (_, count) in planners.items() if count}
    first: dict[str, float] = {}
    try:
        for number in range(max(count for _, count in planners.values())):
            problem = next(problems)
            for planner in outcomes:
                solve, count = planners[planner]
                if planner not in first:
                    first[planner] = measured(partial(solve, problem))[2]
                if number < count:
                    outcomes[planner].append(solve(problem))
                    print(name, number, planner, outcomes[planner][-1], flush=True)
    except KeyboardInterrupt:
        pass
    (ours, *_) = outcomes.values()
    return [row_of(name, planner, solved, ours, first[planner]) for planner, solved in outcomes.items() if solved]


def on_empty_plane(count: int, seed: int) -> list[dict[str, str]]:
    """Rows for the least time without obstacles, forwards only and with reverse."""
    rows = []
    for name, shortest, slowest in (("Dubins", dubins, 0.0), ("Reeds and Shepp", reeds_shepp, -1.0)):
        random, excess, cpu = np.random.default_rng(seed), [], []
        for number in range(count):
            wheelbase, longest = float(random.choice([0.25, 0.5, 1.0])), random.uniform(1.2, 4.0)
            (x, y), heading = pose(random, (-5.0, -5.0), (5.0, 5.0))
            way = shortest(x, y, heading)
            body = stroller.Stroller(mass=5.0, wheelbase=wheelbase, inertia=0.1, steering_inertia=0.005)
            limits = stroller.Limits(steering=np.arctan(wheelbase), speed=(slowest, 1.0))
            start, goal = stroller.Launch((0.0, 0.0), 0.0, 0.0), stroller.Goal((x, y), heading)
            scene, options = (
                stroller.Scene(body, friction=FRICTION),
                {"limits": limits, "minimise": "time", "progress": False},
            )
            plan, seconds, _ = measured(partial(stroller.plan, scene, start, goal, longest * way, **options))
            excess.append(plan.t1 / way - 1.0 if plan.reached else np.nan)
            cpu.append(seconds)
            print(name, number, f"{way:.2f} m, excess {excess[-1]:.3f}, {seconds:.1f} s", flush=True)
        rows.append(
            {
                "goals": f"{count}",
                "shortest paths of": name,
                "reached": f"{np.isfinite(excess).sum()}",
                "excess: median": f"{100.0 * np.nanmedian(excess):.1f} %",
                "greatest": f"{100.0 * np.nanmax(excess):.1f} %",
                "CPU s: median": f"{np.median(cpu):.1f}",
            }
        )
    return rows


def main() -> None:
    """Measure, print and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--problems", type=int, default=200)
    command.add_argument("--ipopt", type=int, default=40, help="problems that CasADi with IPOPT solves")
    command.add_argument("--ompl", type=int, default=12, help="problems that OMPL solves")
    command.add_argument("--curved", type=int, default=100)
    command.add_argument("--empty", type=int, default=0, help="goals on the empty plane, instead of all others")
    command.add_argument("--learn", type=float, default=600.0, help="time for which a planner learns [s]; 0 for none")
    command.add_argument(
        "--seconds", type=float, default=20.0, help="most CPU time of another planner for a problem [s]"
    )
    command.add_argument("--seed", type=int, default=0)
    command.add_argument("--out", type=Path, default=Path("planning.csv"))
    options = command.parse_args()
    print(machine())
    rows = on_empty_plane(options.empty, options.seed) if options.empty else []
    counts = {} if options.empty else {"plane": options.problems} | dict.fromkeys(GROUNDS, options.curved)
    for name, count in counts.items():
        if not count:
            continue
        kind = on_plane if name == "plane" else partial(on_ground, name)
        planners: dict[str, Any] = {"stroller.plan": (by_us, count)}
        if options.learn:
            planner = learned(kind, options.learn, options.seed)
            planners["stroller.plan, learned"] = (partial(by_us, planner=planner), count)
        if name == "plane" and find_spec("casadi") and find_spec("ompl"):
            planners |= {
                "IPOPT from our path": (lambda problem: by_casadi(problem, True, options.seconds), options.ipopt),
                "IPOPT from a line": (lambda problem: by_casadi(problem, False, options.seconds), options.ipopt),
                "OMPL's RRT": (lambda problem: by_ompl(problem, options.seconds), options.ompl),
            }
        rows += compared(name, kind(options.seed), planners)
    print(table(rows))
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
