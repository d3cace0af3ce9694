"""Plan a drive to a goal."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from nonholonomic.progress import status_line
from nonholonomic.validation import require_flag, require_kind, require_whole, shown

from ..model.launch import Launch
from ..model.scene import Scene
from ..runs.trajectory import Trajectory
from .candidates import UNHURRIED, Outline, prices
from .check import COMPARED, CONFIRMED, Verdict, checked_run
from .drive import Drive, drive_along
from .goal import Goal, Limits
from .obstacles import Footprint
from .optimise import Candidates, optimise
from .planner import Planner, proposed
from .problem import checked_problem
from .result import Plan

#: Candidates that are optimised together.
LANES = 2

#: Tolerance of the run that confirms a plan.
TIGHT = 1e-9

#: A candidate with a greater violation of the constraints (see `optimise.py`) is not worth a run if there is a better one.
HOPELESS = 0.05

#: How often the clearance is increased for a candidate that touches an obstacle between the optimiser's points.
MORE_CLEARANCE = 2

#: Batches without a path that can be driven in time after which the search goes on; one more ends it.
PATIENCE = 1

#: The most rounds in which the duration is shortened, the share of the duration to which the first one shortens it, its
#: exponent after a success, and the difference of the share from 1 at which they end.
ROUNDS, SHORTER, LONGER_STEP, CLOSE = 16, 0.7, 1.5, 0.02

MINIMISED = ("effort", "time")


class Log(NamedTuple):
    """The unknowns of all optimised candidates, batch by batch, and the reasons why batches cannot succeed."""

    tried: list[Any]
    reasons: list[str]


class Attempt(NamedTuple):
    """An optimised candidate that was driven: its input and duration [s], its unknowns, its run and what it achieves."""

    drive: Drive
    t1: float
    unknowns: Any
    run: Trajectory
    verdict: Verdict

    @property
    def rank(self) -> tuple[float, float]:
        """The attempt with the least rank is the best."""
        return self.verdict.excess, self.verdict.effort


def plan(
    scene: Scene,
    launch: Launch,
    goal: Goal,
    t1: Float[ArrayLike, ""],
    *,
    obstacles: Any = (),
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
    - `obstacles`: a list of `Box` and `Disc`, on a ground whose places are (x, y) [m].
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

    **Returns:** a `Plan`. If no candidate solves the problem, `reached` is false, and the plan is the best attempt.

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
    problem = checked_problem(scene, launch, goal, t1, obstacles, limits, footprint, tolerance)
    if minimise == "time" and not problem.limits.ranges().keys() - {"steering"}:
        raise ValueError("minimise = 'time' needs a limit of speed, force, torque or grip, such as Limits(speed=1.0)")
    duration = float(np.asarray(t1))
    with status_line("planning", progress):
        outline = Outline.of(problem)
        attempts, log = [], Log([], [])
        in_haste = minimise == "time"
        guesses = _guesses(outline, duration, in_haste, starts, planner, seed, log)
        for attempt in _attempts(outline, guesses, tolerance, log):
            attempts.append(attempt)
            if not attempt.verdict.hindrances:
                break
        best = min(attempts, key=lambda attempt: attempt.rank)
        if in_haste and not best.verdict.hindrances:
            best = _shortened(outline, best, tolerance)
        run, verdict = best.run, best.verdict
        if verdict.hindrances:
            run, verdict = checked_run(problem, best.drive, best.t1, TIGHT, CONFIRMED)
    if verdict.hindrances:
        verdict = verdict._replace(hindrances=(*verdict.hindrances, *log.reasons[:1]))
    return Plan(best.drive, best.t1, run, verdict, problem, jnp.asarray(outline.lines(np.concatenate(log.tried))))


def _guesses(
    outline: Outline, t1: float, in_haste: bool, starts: int, planner: Planner | None, seed: int, log: Log
) -> Iterator[tuple[float, Candidates]]:
    """Batches of candidates, each with the length [m] of its shortest way: the proposal of a planner, then what searches
    find. Candidates that are in haste begin with the duration that their path allows, whatever the longest one `t1` is."""
    rng = np.random.default_rng(seed)
    if planner is not None:
        task = outline.task(outline.distance, t1, outline.clearance)
        if (misfit := planner.misfit(task)) is not None:
            raise ValueError(f"planner: {misfit}; learn in this scene")
        proposal = proposed(planner, task, t1)
        if proposal is not None:
            yield outline.distance, Candidates(proposal[None], np.full(1, t1))
            starts -= 1
    for batch in range(-(-starts // LANES)):
        paths, reason = outline.paths(prices(outline, LANES, batch, rng, in_haste), t1)
        log.reasons.extend([reason] if reason else [])
        if len(log.reasons) > PATIENCE:
            return
        way = min(float(path.length.sum()) for path in paths)
        longest = [UNHURRIED * 2.0**batch * outline.soonest(path) if in_haste else t1 for path in paths]
        durations = np.minimum(t1, longest)
        yield way, Candidates(np.stack(list(map(outline.unknowns, paths, durations))), durations)


def _attempts(
    outline: Outline, guesses: Iterator[tuple[float, Candidates]], tolerance: float, log: Log
) -> Iterator[Attempt]:
    """Attempts at a problem, best first in each batch of candidates."""
    for way, candidates in guesses:
        clearance = outline.clearance
        for _ in range(MORE_CLEARANCE + 1):
            task = outline.task(way, candidates.durations.mean(), clearance)
            candidates, violation, objective = optimise(candidates, task)
            log.tried.append(candidates.unknowns)
            order = np.lexsort((objective, candidates.durations, violation > HOPELESS))
            attempts = []
            for lane in order:
                if attempts and violation[lane] > HOPELESS:
                    break
                attempts.append(_driven(outline, candidates, lane, tolerance))
                yield attempts[-1]
            overlap = -max(attempt.verdict.clearance for attempt in attempts)
            if overlap <= 0.0 or violation.min() > HOPELESS:
                break
            clearance += overlap + 0.5 * outline.clearance


def _driven(outline: Outline, candidates: Candidates, lane: int, tolerance: float) -> Attempt:
    """An optimised candidate, driven; a solution is driven again at a tight tolerance, and this run counts."""
    dynamics, unknowns, t1 = (
        outline.problem.scene.dynamics,
        candidates.unknowns[lane],
        float(candidates.durations[lane]),
    )
    drive = drive_along(dynamics, outline.start, unknowns[:, -2], unknowns[:, -1], t1)
    run, verdict = checked_run(outline.problem, drive, t1, tolerance, COMPARED)
    if not verdict.hindrances:
        run, verdict = checked_run(outline.problem, drive, t1, TIGHT, CONFIRMED)
    return Attempt(drive, t1, unknowns, run, verdict)


def _shortened(outline: Outline, best: Attempt, tolerance: float) -> Attempt:
    """A solution in less time: the same drive, faster, optimised again for several durations in turn.

    Every duration is a share of that of the best solution yet, and this solution is the first guess. The share is closer to 1
    after a round without a solution, and further from 1 after one with a solution.
    """
    share = SHORTER
    for _ in range(ROUNDS):
        durations = best.t1 * share ** (np.arange(LANES, 0, -1) / LANES)
        faster = np.stack([best.unknowns] * LANES)
        faster[:, :, -1] *= (best.t1 / durations)[:, None]
        way = float(np.trapezoid(np.abs(best.run.speed), best.run.t))
        task = outline.task(way, float(durations.mean()), outline.clearance)
        candidates, violation, _ = optimise(Candidates(faster, durations), task)
        hopeful = np.flatnonzero(violation < HOPELESS).tolist()
        attempts = (_driven(outline, candidates, lane, tolerance) for lane in hopeful)
        shorter = next((attempt for attempt in attempts if not attempt.verdict.hindrances), None)
        best = best if shorter is None else shorter
        share **= 0.5 / LANES if shorter is None else LONGER_STEP
        if share > 1.0 - CLOSE:
            break
    return best
