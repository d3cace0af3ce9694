"""The planning problem as residuals of neighbouring knots, and its optimisation.

The unknowns of a knot are the pose (position and heading, in the ground's axes) and a coefficient of the B-splines of
the steering angle and of the front wheel's speed. An interval between two knots depends on four neighbouring rows of
unknowns, the *window*. Poses are unknowns of their own, tied together by the condition that the stroller drives from
each to the next (multiple shooting; Bock and Plitt, IFAC Proceedings 17 (1984) 1603), so a start may pass through poses
that no motion connects yet.
"""

from functools import partial
from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int
from scipy.interpolate import make_interp_spline

from nonholonomic.geometry import AbstractSurface, Vector, add, cross, difference, dot, multiply, scale, subtract

from ..model.input import Motion
from ..model.scene import Dynamics, Number, padded
from .problem import LIMIT_RESERVE, Footprint, Obstacles, Pose, Problem, corners_of, frame_of

#: Coefficients of the splines of the steering angle and of the front wheel's speed, all or those of an interval; and the
#: unknowns of every knot.
Splines: TypeAlias = Float[Array, "rows 2"]
Unknowns: TypeAlias = Float[Array, "rows unknowns"]

# Inverse dynamics: the force and the torque that move the stroller with a given speed and steering angle.
#
# Position and heading follow from the speed of the front wheel and the steering angle alone, on every ground; force and
# torque enter the rates of the momentum P and of the fork linearly (`model/scene.py`), which determines them.


class Rates(NamedTuple):
    """Steering angle phi [rad], its two derivatives, and speed of the front wheel [m/s] and its derivative."""

    steering: Number
    steering_rate: Number
    steering_acceleration: Number
    front_speed: Number
    front_acceleration: Number


class Actuation(NamedTuple):
    """What a motion needs: force [N], torque [N m], speed of the rear axle [m/s], normal force [N] and, if asked for,
    the coefficient of friction of each loaded axle."""

    force: Number
    torque: Number
    speed: Number
    normal_force: Number
    grip: Float[Array, " axles"]


def actuation(dynamics: Dynamics, pose: Pose, rates: Rates, with_grip: bool) -> Actuation:
    """Force, torque and contact forces of a motion."""
    components, body = len(pose), dynamics.body
    values = (pose, rates.steering, rates.steering_rate, rates.front_speed)

    def state_of(pose: Pose, steering: Number, steering_rate: Number, front_speed: Number) -> Number:
        return dynamics.state(*frame_of(dynamics, pose)[:2], steering, steering_rate, front_speed)

    state = state_of(*values)
    geometry, coasting = dynamics.geometry(state), dynamics.field(jnp.zeros(()), state)
    changes = (coasting[:components], rates.steering_rate, rates.steering_acceleration, rates.front_acceleration)
    momentum_rate, fork_acceleration = jax.jvp(state_of, values, changes)[1][components + 1 : components + 3]
    torque = body.steering_inertia * (fork_acceleration - coasting[components + 2])
    momentum_change = momentum_rate - coasting[components + 1]
    if dynamics.absolute is not None:
        momentum_change = momentum_change + geometry.gauge * geometry.sine / body.wheelbase * torque
    force = momentum_change / (geometry.gauge * geometry.cosine)
    grip = jnp.zeros(0)
    if with_grip:
        # `side_force` expects the work components.
        whole = jnp.concatenate([state, jnp.zeros(2 + dynamics.friction.dissipates)])
        sides = dynamics.side_force(jnp.zeros(()), whole, lambda t, motion: (force, torque))
        loads = [load for load in geometry.loads if load is not None]
        grip = jnp.stack([jnp.abs(side) / load for side, load in zip(sides, loads, strict=False)])
    normal_force = jnp.broadcast_to(multiply(1.0, geometry.normal_force), jnp.shape(rates.steering))
    return Actuation(force, torque, geometry.motion.speed, normal_force, grip)


# Uniform cubic B-splines: a function of time with two continuous derivatives, from a row of coefficients.
#
# A spline with n coefficients has n - 3 intervals; between two knots it depends on four coefficients (de Boor, A Practical
# Guide to Splines (2001), chapter X).

#: Number of coefficients on which an interval depends.
ORDER = 4


def basis(u: Number | float) -> tuple[list[Number | float], list[Number | float], list[Number | float]]:
    """The weights of an interval's four coefficients at a part `u` of it, in [0, 1], and their first and second
    derivatives."""
    v = 1.0 - u
    value = [v**3 / 6.0, (3.0 * u**3 - 6.0 * u**2 + 4.0) / 6.0, (3.0 * v**3 - 6.0 * v**2 + 4.0) / 6.0, u**3 / 6.0]
    slope = [-(v**2) / 2.0, (3.0 * u**2 - 4.0 * u) / 2.0, -(3.0 * v**2 - 4.0 * v) / 2.0, u**2 / 2.0]
    bend = [v, 3.0 * u - 2.0, 3.0 * v - 2.0, u]
    return value, slope, bend


def weighted(weights: list[Number | float], coefficients: Number | list[Number]) -> Number:
    """The sum of four coefficients, along axis 0, with weights."""
    a, b, c, d = weights
    return a * coefficients[0] + b * coefficients[1] + c * coefficients[2] + d * coefficients[3]


def evaluate_spline(coefficients: Number, part: Number | float, derivative: int = 0) -> Number:
    """The value of a spline, or of its derivative, at parts of its whole length, held constant beyond its ends.

    Derivatives are with respect to the number of intervals passed.
    """
    return spline_of_a_plan(coefficients, jnp.clip(part, 0.0, 1.0), derivative)


# Every run of a plan traces its input several times; `jit` keeps the trace. By its name, the search for jumps knows that it
# is smooth.
@partial(jax.jit, static_argnames="derivative")
def spline_of_a_plan(coefficients: Number, part: Number | float, derivative: int) -> Number:
    """As `evaluate_spline`, for parts between 0 and 1."""
    intervals = len(coefficients) - ORDER + 1
    position = part * intervals
    first = jnp.clip(jnp.floor(position), 0, intervals - 1).astype(int)
    return weighted(basis(position - first)[derivative], [coefficients[first + k] for k in range(ORDER)])


def interpolate(values: Float[np.ndarray, "knots *n"]) -> Float[np.ndarray, "coefficients *n"]:
    """Coefficients of the spline through values at its knots, without curvature at the ends."""
    knots = np.arange(1.0 - ORDER, len(values) + ORDER - 1)
    return make_interp_spline(knots[ORDER - 1 : 1 - ORDER], values, t=knots, bc_type="natural").c


#: Number of steps of the Runge-Kutta method in an interval; constraints hold at the start of each step, and at the end of the
#: drive.
STEPS = 3

#: Smallest normal force, in units of the weight.
LEAST_CONTACT = 0.02

#: Places in an interval at which the speed and the steering angle keep their limits too, close to its ends because a drive may
#: start or stop at a limit.
BETWEEN = np.array([1.0 / 24.0, 1.0 / 6.0, 0.5, 5.0 / 6.0, 23.0 / 24.0])

#: Weight of the smoothness of the splines in the objective, and of all the effort where the time is minimised.
SMOOTHNESS, EASE = 0.02, 0.1


class Task(eqx.Module):
    """What all candidates of a plan have in common.

    - `start`: pose, steering angle, steering rate and front speed of the launch; `goal`: pose and speed.
    - `has_heading`: 1 if the goal has a heading, else 0.
    - `low`, `high`: limits of steering, speed, force, torque and grip.
    - `t1`: about the duration [s] of a drive; `clearance`: the distance [m] to keep from obstacles.
    - `length` [m], `speed` [m/s], `force` [N]: units of the residuals.
    - `haste`: weight [1/s] of the duration in the objective; 0 where the duration is given.
    """

    dynamics: Dynamics
    footprint: Footprint
    obstacles: Obstacles
    start: tuple[Pose, Float[Array, ""], Float[Array, ""], Float[Array, ""]]
    goal: tuple[Pose, Float[Array, ""]]
    has_heading: Float[Array, ""]
    low: Float[Array, " limits"]
    high: Float[Array, " limits"]
    t1: Float[Array, ""]
    clearance: Float[Array, ""]
    length: Float[Array, ""]
    speed: Float[Array, ""]
    force: Float[Array, ""]
    haste: Float[Array, ""]
    with_grip: bool = eqx.field(static=True)

    @classmethod
    def of(cls, problem: Problem, way: float, t1: float, clearance: float, reserve: float = LIMIT_RESERVE) -> "Task":
        """The task of a problem, for drives of the length `way` [m] and a duration of about `t1` [s], with a clearance [m] and
        a share of every limit's range in reserve."""
        launch, goal, body = problem.launch, problem.goal, problem.scene.body
        speed = max(way, float(body.wheelbase)) / t1
        ends = np.array([[launch.steering, launch.speed], [launch.steering, goal.speed]])
        low, high = problem.limits.arrays(reserve)
        # No drive keeps a reserve that its start or its goal does not have.
        low[:2], high[:2] = np.minimum(low[:2], ends.min(axis=0)), np.maximum(high[:2], ends.max(axis=0))
        return cls(
            dynamics=problem.scene.dynamics,
            footprint=problem.footprint,
            obstacles=jax.tree.map(jnp.asarray, Obstacles.of(problem.standing)),
            start=(problem.start_pose, launch.steering, launch.steering_rate, launch.speed / jnp.cos(launch.steering)),
            goal=(problem.goal_pose, goal.speed),
            has_heading=jnp.asarray(0.0 if goal.heading is None else 1.0),
            low=jnp.asarray(low),
            high=jnp.asarray(high),
            t1=jnp.asarray(t1),
            clearance=jnp.asarray(clearance),
            length=body.wheelbase,
            speed=jnp.asarray(speed),
            force=jnp.asarray(float(body.mass) * speed / min(1.0, 0.1 * t1), dtype=float),
            haste=jnp.asarray(1.0 / t1 if problem.in_haste else 0.0),
            with_grip=problem.limits.grip is not None,
        )


class Residuals(NamedTuple):
    """Residuals of an interval: equalities, inequalities (at least 0) and the objective, in the units of the task."""

    equalities: Number
    inequalities: Number
    objective: Number


def drive_from(
    dynamics: Dynamics, pose: Pose, window: Splines, part: Number | float, step: float, duration: Number
) -> Pose:
    """The pose a step later, by the classical Runge-Kutta method; `part` and `step` in units of the interval."""

    def rate(u: Number | float, pose: Pose) -> Pose:
        steering, front_speed = weighted(basis(u)[0], window)
        state = dynamics.state(*frame_of(dynamics, pose)[:2], steering, jnp.zeros(()), front_speed)
        return duration * dynamics.field(jnp.zeros(()), state)[: len(pose)]

    k1 = rate(part, pose)
    k2 = rate(part + step / 2.0, pose + step / 2.0 * k1)
    k3 = rate(part + step / 2.0, pose + step / 2.0 * k2)
    k4 = rate(part + step, pose + step * k3)
    return pose + step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def motion_at(window: Splines, part: Number | float, duration: Number) -> Rates:
    """The steering and the speed at a part of an interval that takes `duration` [s]."""
    value, slope, bend = (weighted(weights, window) for weights in basis(part))
    rate, acceleration = slope / duration, bend[..., 0] / duration**2
    return Rates(value[..., 0], rate[..., 0], acceleration, value[..., 1], rate[..., 1])


def point_residuals(task: Task, pose: Pose, motion: Rates) -> tuple[Float[Array, " inequalities"], Float[Array, " 2"]]:
    """Inequalities and objective at one point."""
    needed = actuation(task.dynamics, pose, motion, task.with_grip)
    values = jnp.stack([motion.steering, needed.speed, needed.force, needed.torque])
    units = jnp.stack([1.0, task.speed, task.force, task.force * task.length])
    within = [(values - task.low[:4]) / units, (task.high[:4] - values) / units, task.high[4] - needed.grip]
    corners = corners_of(task.dynamics, task.footprint, pose)
    gaps = (task.obstacles.gaps(corners) - task.clearance) / task.length
    weight = task.dynamics.body.mass * task.dynamics.gravity
    contact = needed.normal_force / jnp.maximum(weight, task.force) - LEAST_CONTACT * (weight > 0.0)
    effort = jnp.stack([needed.force, needed.torque / task.dynamics.body.wheelbase]) / task.force
    return jnp.concatenate([*within, gaps, contact[None]]), effort


def interval_residuals(
    window: Float[Array, "4 unknowns"], task: Task, index: Int[Array, ""], intervals: int, duration: Number
) -> Residuals:
    """All residuals of the interval `index` of `intervals`."""
    poses, splines = window[:, :-2], window[:, -2:]
    is_last, parts = index == intervals - 1, np.arange(STEPS + 1) / STEPS

    def step(pose, part):
        return drive_from(task.dynamics, pose, splines, part, 1.0 / STEPS, duration), pose

    end, driven = jax.lax.scan(step, poses[0], jnp.asarray(parts[:-1]))
    motions = motion_at(splines, jnp.asarray(parts)[:, None], duration)
    points = jnp.concatenate([driven, end[None]])
    inequalities, effort = jax.vmap(point_residuals, (None, 0, 0))(task, points, motions)
    # No interval follows the last one.
    inequalities = jnp.where(is_last | (parts < 1.0)[:, None], inequalities, 1.0)
    first, last = (jax.tree.map(lambda part, k=k: part[k], motions) for k in (0, STEPS))
    between = motion_at(splines, jnp.asarray(BETWEEN)[:, None], duration)
    values = jnp.stack([between.steering, between.front_speed * jnp.cos(between.steering)], axis=-1)
    within = jnp.concatenate([values - task.low[:2], task.high[:2] - values]) / jnp.stack([1.0, task.speed])
    inequalities = jnp.concatenate([inequalities.ravel(), within.ravel()])
    axes, length = task.dynamics.surface.axes, task.length
    units = jnp.concatenate([jnp.full(axes, length), jnp.ones(len(end) - axes)])
    at_start, at_goal = jnp.where(index == 0, 1.0, 0.0), jnp.where(is_last, 1.0, 0.0)
    (pose, steering, steering_rate, front_speed), (goal, goal_speed) = task.start, task.goal
    starts = [first.steering - steering, (first.steering_rate - steering_rate) * duration]
    starts += [(first.front_speed - front_speed) / task.speed]
    away = (poses[1] - goal) / units * jnp.concatenate([jnp.ones(axes), jnp.full(axes, task.has_heading)])
    ends = [last.steering_rate * duration, (last.front_speed * jnp.cos(last.steering) - goal_speed) / task.speed]
    equalities = [(poses[1] - end) / units, at_start * (poses[0] - pose) / units, at_start * jnp.stack(starts)]
    equalities += [at_goal * away, at_goal * jnp.stack(ends)]
    smooth = SMOOTHNESS * (splines[2] - 2.0 * splines[1] + splines[0]) / jnp.stack([1.0, task.speed])
    objective = jnp.concatenate([effort[:-1].ravel() / jnp.sqrt(STEPS * intervals), smooth])
    objective = jnp.where(task.haste > 0.0, EASE, 1.0) * objective
    return Residuals(jnp.concatenate(equalities), inequalities, objective)


def windows(unknowns: Float[Array, "rows *n"]) -> Float[Array, "intervals 4 *n"]:
    """The windows of all intervals of the unknowns, or of a spline."""
    intervals = len(unknowns) - ORDER + 1
    return jnp.stack([unknowns[k : k + intervals] for k in range(ORDER)], axis=1)


# Optimisation of all candidates together: an augmented Lagrangian, minimised by damped Gauss-Newton steps.
#
# Method: Nocedal and Wright, Numerical Optimization (2006), chapters 10 and 17. JAX evaluates the residuals and their
# slopes in lanes; SciPy solves the banded equations of all lanes as one system.

#: Violation of the constraints of a solution, and gain in a step, relative to the merit, that is not worth another one.
FEASIBLE, TINY_GAIN = 2e-4, 1e-6

#: The damping: least, first and greatest value.
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-6, 1.0, 1e6


class Candidates(NamedTuple):
    """Candidates in lanes: unknowns (lanes, rows, unknowns) and durations (lanes,) [s]."""

    unknowns: Float[Array | np.ndarray, "lanes rows unknowns"]
    durations: Float[Array | np.ndarray, " lanes"]


#: The penalties of the constraints, in turn, the most Gauss-Newton steps with each, and the relative change of the objective
#: at which the optimiser stops: for the least effort in a given time, and for the least time. With small penalties the
#: duration soon falls below the least one, and the multipliers then bring it back. From above, the limits of the speed stop
#: every step.
CALM, HASTY = ((100.0, 300.0, *(1e3,) * 6), 8, 0.02), ((10.0, *(30.0,) * 15), 60, 2e-3)


class Equations(NamedTuple):
    """The equations of a Gauss-Newton step in every lane: the merit, its gradient, the lower band of the matrix without its
    last row, and this row; and the residuals of all intervals."""

    merit: Float[Array | np.ndarray, "*lanes"]
    gradient: Float[Array | np.ndarray, "*lanes unknowns"]
    band: Float[Array | np.ndarray, "*lanes band others"]
    edge: Float[Array | np.ndarray, "*lanes unknowns"]
    residuals: Residuals


#: Multipliers of the equalities and of the inequalities, in units of the penalty, shaped as the residuals.
Multipliers: TypeAlias = tuple[
    Float[Array | np.ndarray, "*lanes intervals equalities"], Float[Array | np.ndarray, "*lanes intervals inequalities"]
]


@eqx.filter_jit
def _of_lane(unknowns: Unknowns, t1: Number, task: Task, multipliers: Multipliers, penalty: Number) -> Equations:
    """The equations of a step from one candidate.

    The last of the unknowns is the logarithm of the factor of the duration; the speeds change inversely to it, so that the
    path stays.
    """
    rows, width = unknowns.shape
    intervals, root = rows - ORDER + 1, jnp.sqrt(penalty)
    # The poses of the third and the fourth row of a window have no influence.
    used = np.array([k for k in range(ORDER * width) if k < 2 * width or k % width >= width - 2])

    def of_interval(window, multipliers, index):
        def terms(numbers):
            duration = t1 * jnp.exp(jnp.where(task.haste > 0.0, numbers[-1], 0.0))
            changed = window.ravel().at[used].set(numbers[:-1]).reshape(window.shape)
            changed = changed.at[:, -1].multiply(t1 / duration)
            residuals = interval_residuals(changed, task, index, intervals, duration / intervals)
            shifted = residuals.inequalities + multipliers[1]
            broken = root * jnp.where(shifted < 0.0, shifted, 0.0)
            missed = root * (residuals.equalities + multipliers[0])
            time = task.haste * duration / jnp.sqrt(intervals)
            value = jnp.concatenate([missed, broken, residuals.objective, time[None]])
            return value, (value, residuals)

        slope, (value, residuals) = jax.jacfwd(terms, has_aux=True)(jnp.append(window.ravel()[used], 0.0))
        return value @ value, slope.T @ value, slope.T @ slope, residuals

    merit, gradient, matrix, residuals = jax.vmap(of_interval)(windows(unknowns), multipliers, jnp.arange(intervals))
    number = np.arange(intervals)[:, None] * width + used
    number = np.append(number, np.full((intervals, 1), rows * width), axis=1)
    total, edge = (jnp.zeros(rows * width + 1).at[number].add(part) for part in (gradient, matrix[:, -1]))
    row, column = np.tril_indices(len(used))
    band = jnp.zeros((ORDER * width, rows * width))
    band = band.at[(used[row] - used[column])[None], number[:, column]].add(matrix[:, row, column])
    return Equations(merit.sum(), total, band, edge, residuals)


# Compiled, it traces the residuals once.
@eqx.filter_jit
def _no_multipliers(candidates: Candidates, task: Task) -> Multipliers:
    """Multipliers of zero for all constraints."""
    lanes, rows, width = candidates.unknowns.shape
    window, intervals = jnp.zeros((ORDER, width)), rows - ORDER + 1
    of_interval = eqx.filter_eval_shape(interval_residuals, window, task, jnp.asarray(0), intervals, task.haste)
    equalities, inequalities, _ = (jnp.zeros((lanes, intervals, *part.shape)) for part in of_interval)
    return equalities, inequalities


def equations_of(candidates: Candidates, task: Task, multipliers: Multipliers, penalty: float) -> Equations:
    """The equations of all lanes, which share the program of one."""
    # A Python number would be a constant of the program, and an array of a weak type would compile a second one.
    weight = jnp.asarray(penalty, dtype=float)
    lanes = [
        _of_lane(jnp.asarray(unknowns), jnp.asarray(t1, dtype=float), task, (equal, unequal), weight)
        for unknowns, t1, equal, unequal in zip(*candidates, *multipliers, strict=True)
    ]
    return jax.tree.map(lambda *parts: np.stack(parts), *lanes)


def _step(equations: Equations, damping: Float[np.ndarray, " lanes"]) -> Float[np.ndarray, "lanes unknowns"]:
    """Damped Gauss-Newton steps of all lanes, solved as one banded system; none in a lane that is not finite."""
    lanes, width, count = equations.band.shape
    usable = np.all(np.isfinite(equations.band), axis=(1, 2), keepdims=True)
    matrix = np.where(usable, equations.band, 0.0)
    # Rounding must not make the matrix indefinite where an unknown far from the others has a very steep residual.
    matrix[:, 0] += damping[:, None] + 1e-12 + 1e-13 * matrix[:, 0].max(axis=1, keepdims=True)
    joined = matrix.transpose(1, 0, 2).reshape(width, lanes * count)
    sides = np.where(usable, np.stack([equations.gradient, equations.edge], axis=-1), 0.0)
    solved = scipy.linalg.solveh_banded(joined, sides[:, :-1].reshape(-1, 2), lower=True).reshape(lanes, count, 2)
    # The last unknown follows from the Schur complement of the others.
    inner = np.sum(sides[:, :-1, 1:] * solved, axis=1)
    last = (inner[:, 0] - sides[:, -1, 0]) / (sides[:, -1, 1] + damping - inner[:, 1])
    return np.concatenate([-solved[..., 0] - last[:, None] * solved[..., 1], last[:, None]], axis=1)


def _minimise(
    candidates: Candidates, task: Task, multipliers: Multipliers, penalty: float, steps: int, damping: np.ndarray
) -> tuple[Candidates, Residuals, np.ndarray]:
    """At most `steps` Gauss-Newton steps for a given penalty, the residuals and the damping after them.

    The damping follows the ratio of the gain to the one that the linear model promised (Nielsen, "Damping parameter in
    Marquardt's method", Technical University of Denmark, 1999); a step that does not lower the merit is repeated.
    """
    best = jax.tree.map(np.array, (candidates, equations_of(candidates, task, multipliers, penalty)))
    (unknowns, durations), equations = best
    growth = np.full(len(durations), 2.0)
    for _ in range(steps):
        step = _step(equations, damping)
        promised = np.sum(step * (damping[:, None] * step - equations.gradient), axis=1)
        if np.all(promised < TINY_GAIN * equations.merit):
            break
        longer, moved = np.exp(step[:, -1]), unknowns + step[:, :-1].reshape(unknowns.shape)
        moved[..., -1] /= longer[:, None]
        trial = Candidates(moved, durations * longer)
        new = trial, equations_of(trial, task, multipliers, penalty)
        gain = (equations.merit - new[1].merit) / promised
        gain = np.where(np.isfinite(new[1].band).all((1, 2)), gain, -1.0).clip(-1.0, 2.0)
        better = gain > 0.0
        for old, part in zip(jax.tree.leaves(best), jax.tree.leaves(new), strict=True):
            old[better] = part[better]
        damping = damping * np.where(better, np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), growth)
        damping = np.clip(damping, LEAST_DAMPING, MOST_DAMPING)
        growth = np.where(better, 2.0, 2.0 * growth)
    return best[0], equations.residuals, damping


def optimise(candidates: Candidates, task: Task, firmness: float) -> tuple[Candidates, np.ndarray, np.ndarray]:
    """Minimise the effort or the duration of all candidates under the constraints, until the effort of one of them, or the
    duration of all, is feasible and settled, or the penalties, times the firmness, are used up.

    **Returns:** the candidates, and the violation of each and its effort or duration.
    """
    in_haste = bool(task.haste > 0.0)
    (penalties, steps, settled), enough = (HASTY, np.all) if in_haste else (CALM, np.any)
    lanes, multipliers = len(candidates.durations), jax.tree.map(np.asarray, _no_multipliers(candidates, task))
    # Where the weight makes the effort large, the penalties would be too weak beside it.
    first = equations_of(candidates, task, multipliers, penalties[0]).residuals
    least = float(np.sum(first.objective**2, axis=(1, 2)).min())
    task = eqx.tree_at(lambda task: task.force, task, task.force * np.sqrt(max(1.0, least)))
    violation = values = np.full(lanes, np.inf)
    damping, last = np.full(lanes, FIRST_DAMPING), firmness * penalties[0]
    for penalty in firmness * np.array(penalties):
        multipliers, last = (multipliers[0] * (last / penalty), multipliers[1] * (last / penalty)), penalty
        candidates, residuals, damping = _minimise(candidates, task, multipliers, penalty, steps, damping)
        equalities, inequalities, objective = map(np.asarray, residuals)
        # The greatest violation of a constraint in every lane, in the units of the residuals.
        violation = np.maximum(np.abs(equalities).max((1, 2)), -inequalities.min((1, 2)).clip(max=0.0))
        before, efforts = values, np.sum(objective**2, axis=(1, 2))
        values = np.asarray(candidates.durations) if in_haste else efforts
        if enough((violation < FEASIBLE) & (np.abs(values - before) < settled * values)):
            break
        multipliers = multipliers[0] + equalities, np.minimum(multipliers[1] + inequalities, 0.0)
    return candidates, violation, values


# The inputs of a plan: a force and a torque over time, with feedback that holds the planned speed and steering angle, and with
# feedback that also corrects the place.

#: How fast feedback removes an error of the steering angle and of the speed [1/s].
STEERING_RATE, SPEED_RATE = 8.0, 4.0

#: Values of force and torque in an interval of the plan.
FINE = 8


class Drive(eqx.Module):
    """An input that follows a planned speed of the front wheel and a planned steering angle.

    Each is a uniform cubic B-spline over `duration` [s]. `force` [N], together with the part of the `weight` [N] (a vector in
    the ground's axes) that acts against the actual heading, and `torque` [N m] move the planned stroller exactly. Without
    that part, an error of the heading on a slope would change the speed, and grow. The gains pull speed [N s/m], angle
    [N m/rad] and rate [N m s/rad] back where rounding or a disturbance changes them, because a fork in reverse is unstable
    by itself. Nothing corrects the place: see `track`.
    """

    duration: Float[Array, ""]
    steering: Float[Array, " coefficients"]
    front_speed: Float[Array, " coefficients"]
    force: Float[Array, " fine"]
    torque: Float[Array, " fine"]
    weight: Vector
    speed_gain: Float[Array, ""]
    angle_gain: Float[Array, ""]
    rate_gain: Float[Array, ""]

    def reference(self, t: Number) -> tuple[Number, Number, Number, Number, Number]:
        """Planned steering angle [rad], its rate [rad/s], speed of the front wheel [m/s], force [N] without the weight's
        part, and torque [N m]."""
        part = jnp.asarray(t) / self.duration
        per_second = (len(self.steering) - ORDER + 1) / self.duration
        angle, rate = evaluate_spline(self.steering, part), evaluate_spline(self.steering, part, 1) * per_second
        speed, force, torque = (evaluate_spline(spline, part) for spline in (self.front_speed, self.force, self.torque))
        # Afterwards the stroller stays as it is at the end, neither braking nor steering.
        is_planned = jnp.where(part <= 1.0, 1.0, 0.0)
        return angle, is_planned * rate, speed, is_planned * force, is_planned * torque

    def held(
        self, motion: Motion, angle: Number, rate: Number, speed: Number, force: Number, torque: Number
    ) -> tuple[Number, Number]:
        """Force and torque that hold a steering angle, its rate and the speed of the front wheel, from the planned force and
        torque."""
        # No weight acts against the heading where the ground is level.
        climbing = dot(self.weight, motion.heading)
        force = add(climbing, force + self.speed_gain * (speed - motion.front_speed))
        torque = torque + self.angle_gain * (angle - motion.steering) + self.rate_gain * (rate - motion.steering_rate)
        return force, torque

    def __call__(self, t: Number, motion: Motion) -> tuple[Number, Number]:
        return self.held(motion, *self.reference(t))


@eqx.filter_jit
def _needed(
    dynamics: Dynamics, pose: Pose, splines: Splines, t1: Number
) -> tuple[Float[Array, " fine"], Float[Array, " fine"], Vector]:
    """Force without the weight's part and torque of a drive from a pose, `FINE` times in every interval and at the end; and
    the weight."""
    intervals = len(splines) - ORDER + 1
    duration, weight = t1 / intervals, scale(dynamics.body.mass * dynamics.gravity, dynamics.up)

    def step(pose: Pose, k: Int[Array, ""]) -> tuple[Pose, tuple[Number, Number]]:
        first = jnp.minimum(k // FINE, intervals - 1)
        window, part = jax.lax.dynamic_slice_in_dim(splines, first, ORDER), k / FINE - first
        needed = actuation(dynamics, pose, motion_at(window, part, duration), False)
        force = subtract(needed.force, dot(weight, padded(pose[dynamics.surface.axes :])))
        return drive_from(dynamics, pose, window, part, 1.0 / FINE, duration), (force, needed.torque)

    return *jax.lax.scan(step, pose, jnp.arange(intervals * FINE + 1))[1], weight


def drive_along(dynamics: Dynamics, pose: Pose, coefficients: Float[Array | np.ndarray, "rows 2"], t1: float) -> Drive:
    """The input that gives a stroller, from a pose, the steering angle and the speed of two splines."""
    duration, splines, body = jnp.asarray(t1, dtype=float), jnp.asarray(coefficients), dynamics.body
    force, torque, weight = _needed(dynamics, pose, splines, duration)
    force, torque = (jnp.asarray(interpolate(np.asarray(values))) for values in (force, torque))
    inertia, (steering, front_speed) = body.steering_inertia, splines.T
    # Of the speed, the steering angle and its rate.
    gains = SPEED_RATE * body.mass, STEERING_RATE**2 * inertia, 2.0 * STEERING_RATE * inertia
    return Drive(duration, steering, front_speed, force, torque, weight, *gains)


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

    def errors(self, t: Number, motion: Motion) -> tuple[Number, Number, Number, Number]:
        """The planned stroller as seen from this one: distances [m] ahead and to the left, and the sine and the cosine of
        the angle to the left at which it heads."""
        pose = evaluate_spline(self.pose, jnp.asarray(t) / self.drive.duration)
        target, heading = map(padded, jnp.split(jnp.moveaxis(pose, -1, 0), [self.surface.axes]))
        left = scale(self.side, cross(self.surface.normal(motion.position), motion.heading))
        away = difference(target, motion.position)
        return dot(away, motion.heading), dot(away, left), dot(heading, left), dot(heading, motion.heading)

    def storage(self, t: Number, motion: Motion) -> Number:
        """The shaped energy of the errors of place and heading [m^2]: (x^2 + y^2) / 2 + (1 - cos(angle)) / stiffness."""
        ahead, left, _, cosine = self.errors(t, motion)
        return 0.5 * (ahead**2 + left**2) + (1.0 - cosine) / self.across

    def __call__(self, t: Number, motion: Motion) -> tuple[Number, Number]:
        angle, rate, front_speed, force, torque = self.drive.reference(t)
        ahead, left, sine, cosine = self.errors(t, motion)
        speed = front_speed * jnp.cos(angle)
        turn = self.across * left + self.turning * jnp.tanh(speed / self.slow) * sine
        steering = jnp.arctan(jnp.tan(angle) + self.wheelbase * turn)
        steering = jnp.clip(steering, self.least_steering, self.most_steering)
        wanted = (speed * cosine + self.along * ahead) / jnp.cos(steering)
        return self.drive.held(motion, steering, rate, wanted, force, torque)
