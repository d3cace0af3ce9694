"""Plan a drive to a goal, and keep a ride on its plan."""

import dataclasses
from collections.abc import Iterable, Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.interpolate import CubicSpline

from nonholonomic.geometry import AbstractSurface, cross, difference, dot, scale
from nonholonomic.terminal import status_line
from nonholonomic.text import shown
from nonholonomic.validation import require_flag, require_kind, require_whole
from nonholonomic.views.stage import fixed

from ..model.dynamics import padded
from ..model.input import Motion
from ..model.scene import Scene
from ..model.vehicle import Launch
from .planner import Planner, proposed
from .problem import MOST_STEERING, Box, Disc, Footprint, Goal, Limits, Problem, checked_problem
from .result import ALLOWED, Plan, checked_drive
from .search import INTERVALS, guess_of, paths_of, prices
from .transcription import (
    FINE,
    LIMIT_RESERVE,
    ORDER,
    Candidates,
    Drive,
    Numbers,
    Task,
    drive_along,
    evaluate,
    interpolate,
    optimise,
)

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
    in_haste = minimise == "time"
    problem = checked_problem(
        scene, launch, goal, t1, obstacles, limits, footprint, tolerance=tolerance, in_haste=in_haste
    )
    if in_haste and not problem.limits.ranges().keys() - {"steering"}:
        raise ValueError("minimise = 'time' needs a limit of speed, force, torque or grip, such as Limits(speed=1.0)")
    attempts, tried, reasons = [], [], []
    with status_line("planning", progress):
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


def _guesses(
    problem: Problem, starts: int, planner: Planner | None, seed: int, reasons: list[str]
) -> Iterator[tuple[float, Candidates]]:
    """Batches of candidates, each with the length [m] of its shortest way: the proposal of a planner, then what searches
    find. Candidates that are in haste begin with the duration that their path allows, whatever the longest one is.
    `reasons` collects why batches cannot succeed."""
    rng = np.random.default_rng(seed)
    if planner is not None:
        task = Task.of(problem, problem.distance, problem.t1, problem.clearance)
        proposal = proposed(planner, task, problem.t1)
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


def _attempts(
    problem: Problem, guesses: Iterator[tuple[float, Candidates]], tolerance: float, tried: list[np.ndarray]
) -> Iterator[Plan]:
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


class Tracker(eqx.Module):
    """An input that follows a plan and corrects errors of place and heading; `track` returns it.

    - `drive`: the input of the plan; `pose`: splines of the planned position and heading in the ground's axes;
    - `across` [1/m^2], `turning` [1/m], `along` [1/s]: stiffness k and dampings d and c of the shaped energy;
    - `least_steering`, `most_steering` [rad]: bounds of the steering angle;
    - `slow` [m/s]: speed below which the damping d fades out.
    """

    drive: Drive
    pose: Float[Array, "fine components"]
    surface: AbstractSurface
    wheelbase: Float[Array, ""]
    across: Float[Array, ""]
    turning: Float[Array, ""]
    along: Float[Array, ""]
    least_steering: Float[Array, ""]
    most_steering: Float[Array, ""]
    slow: Float[Array, ""]
    side: float = eqx.field(static=True)

    def errors(self, t: Numbers, motion: Motion) -> tuple[Numbers, Numbers, Numbers, Numbers]:
        """The planned stroller as seen from this one: distances [m] ahead and to the left, and the sine and the cosine of
        the angle to the left at which it heads."""
        pose = evaluate(self.pose, jnp.asarray(t) / self.drive.duration)
        components = jnp.moveaxis(pose, -1, 0)
        axes = self.surface.axes
        heading, target = padded(components[axes:]), padded(components[:axes])
        left = scale(self.side, cross(self.surface.normal(motion.position), motion.heading))
        away = difference(target, motion.position)
        return dot(away, motion.heading), dot(away, left), dot(heading, left), dot(heading, motion.heading)

    def storage(self, t: Numbers, motion: Motion) -> Numbers:
        """The shaped energy of the errors of place and heading [m^2]: (x^2 + y^2) / 2 + (1 - cos(angle)) / stiffness."""
        ahead, left, _, cosine = self.errors(t, motion)
        return 0.5 * (ahead**2 + left**2) + (1.0 - cosine) / self.across

    def __call__(self, t: Numbers, motion: Motion) -> tuple[Numbers, Numbers]:
        angle, rate, front_speed, force, torque = self.drive.reference(t)
        ahead, left, sine, cosine = self.errors(t, motion)
        speed = front_speed * jnp.cos(angle)
        turn = self.across * left + self.turning * jnp.tanh(speed / self.slow) * sine
        steering = jnp.arctan(jnp.tan(angle) + self.wheelbase * turn)
        steering = jnp.clip(steering, self.least_steering, self.most_steering)
        wanted = (speed * cosine + self.along * ahead) / jnp.cos(steering)
        return self.drive.held(motion, steering, rate, wanted, force, torque)


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

    - `scene`: the `Scene` that is driven, with the ground of the plan.
    - `plan`: a `Plan`.

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
    nodes = FINE * (len(plan.input.steering) - ORDER + 1) + 1
    poses = CubicSpline(np.asarray(run.t), np.asarray(run.state[:, : 2 * axes]))(np.linspace(0.0, plan.t1, nodes))
    length = scene.body.wheelbase
    low, high = plan.problem.limits.ranges().get("steering", (-MOST_STEERING, MOST_STEERING))
    return Tracker(
        drive=plan.input,
        pose=jnp.asarray(interpolate(poses)),
        surface=scene.surface,
        wheelbase=length,
        across=1.0 / (REACH * length) ** 2,
        turning=2.0 / (REACH * length),
        along=jnp.asarray(CATCHING_UP),
        least_steering=jnp.asarray(low),
        most_steering=jnp.asarray(high),
        slow=SLOW * length,
        side=scene.dynamics.side,
    )
