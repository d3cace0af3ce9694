"""Other planners for the problems of `planning.py`: CasADi with IPOPT, and a kinodynamic planner of OMPL.

    pip install casadi ompl

Both answer with the steering angle and the speed of the front wheel over time, because the path, the force and the torque of
a stroller follow from these two. `planning.py` turns them into an input, as `stroller.plan` does with its own.
"""

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi
import numpy as np
from ompl import base, control, util

import stroller
from stroller.planning.problem import Problem, separation
from stroller.planning.search import Path, timed
from stroller.planning.transcription import LIMIT_RESERVE

#: Intervals of the collocation, Radau points in each, and discs that cover the footprint.
INTERVALS, DEGREE, DISCS = 64, 3, 4

#: Bounds of OMPL's inputs: acceleration of the front wheel [m/s^2] and steering rate [rad/s]; step [s], and most steps.
RATES, STEP, MOST_STEPS = (1.0, 1.5), 0.1, 20

#: Greatest sum of the errors of place [m], heading [rad] and front speed [m/s] at the goal of OMPL.
NEAR = 0.045

#: Pieces of an answer in each interval of the collocation.
FINE = 8

util.setLogLevel(util.LOG_WARN)
util.RNG.setSeed(1)


class Answer(NamedTuple):
    """Steering angle [rad] and front speed [m/s] at even times, and the duration [s]."""

    steering: np.ndarray
    front_speed: np.ndarray
    t1: float


def rate_of(body: stroller.Stroller, friction: stroller.Damping, state: Any, force: Any, torque: Any) -> Any:
    """Rate of x, y, heading, steering angle, front speed and steering rate, on the plane, with a relative fork."""
    _, _, heading, angle, front_speed, steering_rate = casadi.vertsplit(state)
    mass, length = float(body.mass), float(body.wheelbase)
    spin = float(body.inertia) / length**2
    sine, cosine = casadi.sin(angle), casadi.cos(angle)
    speed, yaw = front_speed * cosine, front_speed * sine / length
    pushing = cosine * (force - float(friction.rolling) * speed) - float(friction.front) * front_speed
    pushing -= sine / length * float(friction.scrub) * yaw
    reduced = mass * cosine**2 + spin * sine**2
    acceleration = (pushing - (spin - mass) * sine * cosine * steering_rate * front_speed) / reduced
    turning = (torque - float(friction.steering) * steering_rate) / float(body.steering_inertia)
    along = (speed * casadi.cos(heading), speed * casadi.sin(heading))
    return casadi.vertcat(*along, yaw, steering_rate, acceleration, turning)


def gaps(problem: Problem, state: Any) -> list[Any]:
    """Distance [m] of every disc of the footprint from every box."""
    footprint = problem.footprint
    length, width, rear = (float(getattr(footprint, name)) for name in ("length", "width", "rear"))
    radius, distances = math.hypot(length / DISCS, width) / 2.0, []
    for ahead in -rear + length * (np.arange(DISCS) + 0.5) / DISCS:
        x, y = state[0] + ahead * casadi.cos(state[2]), state[1] + ahead * casadi.sin(state[2])
        for box in problem.obstacles:
            cosine, sine = math.cos(float(box.angle)), math.sin(float(box.angle))
            east, north = x - float(box.centre[0]), y - float(box.centre[1])
            across = casadi.fabs(cosine * east + sine * north) - float(box.size[0]) / 2.0
            along = casadi.fabs(cosine * north - sine * east) - float(box.size[1]) / 2.0
            outside = casadi.sqrt(casadi.fmax(across, 0.0) ** 2 + casadi.fmax(along, 0.0) ** 2 + 1e-10)
            distances.append(outside + casadi.fmin(casadi.fmax(across, along), 0.0) - radius)
    return distances


def straight_guess(problem: Problem, times: np.ndarray) -> np.ndarray:
    """States on the straight line from the start to the goal, (6, times)."""
    start, goal = np.array(problem.launch.place, dtype=float), np.array(problem.goal.place, dtype=float)
    heading, part = float(problem.launch.heading), times / times[-1]
    turn = (float(problem.goal.heading) - heading + np.pi) % (2.0 * np.pi) - np.pi
    x, y = start[:, None] + np.outer(goal - start, part)
    still, speed = np.zeros_like(part), np.full_like(part, np.linalg.norm(goal - start) / times[-1])
    return np.stack([x, y, heading + turn * part, still, speed, still])


def path_guess(problem: Problem, path: Path, times: np.ndarray) -> np.ndarray:
    """States on a path of our search, (6, times)."""
    wheelbase, even = float(problem.scene.body.wheelbase), np.linspace(0.0, times[-1], INTERVALS + 1)
    points, splines = timed(path, INTERVALS + 1, float(times[-1]), wheelbase)
    rows = [*points.T, *splines.T, np.gradient(splines[:, 0], even)]
    return np.stack([np.interp(times, even, row) for row in rows])


def _polynomials(nodes: np.ndarray) -> list[np.poly1d]:
    """The polynomials that are 1 at one node and 0 at the others."""
    others = [np.delete(nodes, k) for k in range(len(nodes))]
    return [np.poly1d(np.poly(rest) / np.prod(node - rest)) for node, rest in zip(nodes, others, strict=True)]


def casadi_program(problem: Problem, t1: float, path: Path | None, keep: float, seconds: float) -> Callable[[], Answer]:
    """Direct collocation of the least effort, ready to be solved by IPOPT from a path or from the straight line.

    IPOPT ends after `seconds` of CPU; its last iterate is the answer, also where it has not converged.
    """
    nodes = np.array([0.0, *casadi.collocation_points(DEGREE, "radau")])
    step, count = t1 / INTERVALS, INTERVALS * DEGREE
    times = step * np.append(0.0, (np.arange(INTERVALS)[:, None] + nodes[1:]).ravel())
    states, inputs = casadi.MX.sym("states", 6, count + 1), casadi.MX.sym("inputs", 2, INTERVALS)
    state, pushed = casadi.SX.sym("state", 6), casadi.SX.sym("pushed", 2)
    rate = rate_of(problem.scene.body, problem.scene.friction, state, pushed[0], pushed[1])
    field = casadi.Function("field", [state, pushed], [rate])
    speed = state[4] * casadi.cos(state[3])
    limited = casadi.Function("limited", [state], [casadi.vertcat(speed, *gaps(problem, state))])
    polynomials = _polynomials(nodes)
    equations, slopes = [], casadi.DM(np.array([np.polyder(part)(nodes) for part in polynomials]))
    for k in range(INTERVALS):
        window = states[:, k * DEGREE : (k + 1) * DEGREE + 1]
        rates = field.map(DEGREE)(window[:, 1:], casadi.repmat(inputs[:, k], 1, DEGREE))
        equations.append(casadi.vec(window @ slopes[:, 1:] - step * rates))
    wheelbase = float(problem.scene.body.wheelbase)
    effort = step * (casadi.sumsqr(inputs[0, :]) + casadi.sumsqr(inputs[1, :]) / wheelbase**2)
    program = {
        "x": casadi.vertcat(casadi.vec(states), casadi.vec(inputs)),
        "f": effort,
        "g": casadi.vertcat(*equations, casadi.vec(limited.map(count)(states[:, 1:]))),
    }
    options = {"ipopt.max_cpu_time": seconds, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
    solver = casadi.nlpsol("solver", "ipopt", program, options)
    guess = straight_guess(problem, times) if path is None else path_guess(problem, path, times)
    low, high = problem.limits.arrays(LIMIT_RESERVE)
    most = np.full((6, count + 1), np.inf)
    most[3] = high[0]
    least, launch, goal = -most, problem.launch, problem.goal
    least[:, 0] = most[:, 0] = [*map(float, (*launch.place, launch.heading)), 0.0, float(launch.speed), 0.0]
    turns = np.round((guess[2, -1] - float(goal.heading)) / (2.0 * np.pi))
    least[:3, -1] = most[:3, -1] = [*map(float, goal.place), float(goal.heading) + 2.0 * np.pi * turns]
    least[4:, -1] = most[4:, -1] = 0.0
    free, still = np.full(2 * INTERVALS, np.inf), np.zeros(6 * count)
    apart = DISCS * len(problem.obstacles)
    arguments = {
        "x0": np.append(guess.ravel(order="F"), np.zeros(2 * INTERVALS)),
        "lbx": np.append(least.ravel(order="F"), -free),
        "ubx": np.append(most.ravel(order="F"), free),
        "lbg": np.append(still, np.tile([low[1], *[keep] * apart], count)),
        "ubg": np.append(still, np.tile([high[1], *[np.inf] * apart], count)),
    }

    def solve() -> Answer:
        values = np.asarray(solver(**arguments)["x"])[: 6 * (count + 1), 0]
        angle_and_speed = values.reshape(6, -1, order="F")[3:5]
        windows = np.stack([angle_and_speed[:, k : k + count : DEGREE] for k in range(DEGREE + 1)], axis=-1)
        parts = windows @ np.array([part(np.arange(FINE) / FINE) for part in polynomials])
        return Answer(*np.append(parts.reshape(2, -1), angle_and_speed[:, -1:], axis=1), t1)

    return solve


def _bounds(ranges: Sequence[tuple[float, float]]) -> base.RealVectorBounds:
    bounds = base.RealVectorBounds(len(ranges))
    for axis, (low, high) in enumerate(ranges):
        bounds.setLow(axis, float(low))
        bounds.setHigh(axis, float(high))
    return bounds


def _space(problem: Problem) -> base.CompoundStateSpace:
    """Places, headings, front speeds and steering angles; distances add the errors of the first three."""
    low, high = problem.limits.ranges()["speed"]
    ranges = ([(-1.0, 7.0)] * 2, None, [(2.0 * low, 2.0 * high)], [problem.limits.ranges()["steering"]])
    space = base.CompoundStateSpace()
    for part, weight in zip(ranges, (1.0, 1.0, 1.0, 1e-3), strict=True):
        subspace = base.SO2StateSpace() if part is None else base.RealVectorStateSpace(len(part))
        if part is not None:
            subspace.setBounds(_bounds(part))
        space.addSubspace(subspace, weight)
    return space


def _filled(state: Any, numbers: Sequence[float]) -> Any:
    """A state with these numbers: x, y, heading, front speed and steering angle."""
    state[0][0], state[0][1], state[1].value, state[2][0], state[3][0] = numbers
    return state


def _numbers(state: Any) -> tuple[float, ...]:
    return state[0][0], state[0][1], state[1].value, state[2][0], state[3][0]


def is_free(problem: Problem) -> Callable[[Any], bool]:
    """A function that looks whether a state keeps the limits and touches no box."""
    footprint, limits = problem.footprint, problem.limits.ranges()
    length, width, rear = (float(getattr(footprint, name)) for name in ("length", "width", "rear"))
    reach, (slowest, fastest), most = math.hypot(length, width) / 2.0, limits["speed"], limits["steering"][1]
    boxes = [
        (*map(float, (*box.centre, *box.size)), math.cos(float(box.angle)), math.sin(float(box.angle)), box.corners)
        for box in problem.obstacles
    ]

    def free(state: Any) -> bool:
        x, y, heading, front_speed, angle = _numbers(state)
        if not (slowest < front_speed * math.cos(angle) < fastest and abs(angle) < most):
            return False
        cosine, sine = math.cos(heading), math.sin(heading)
        middle_x, middle_y = x + (length / 2.0 - rear) * cosine, y + (length / 2.0 - rear) * sine
        for centre_x, centre_y, size_x, size_y, c, s, corners in boxes:
            east, north = middle_x - centre_x, middle_y - centre_y
            across, along = abs(c * east + s * north) - size_x / 2.0, abs(c * north - s * east) - size_y / 2.0
            if max(across, along) < reach:
                forward, left = np.array([cosine, sine]), np.array([-sine, cosine])
                own = footprint.corners(np.array([x, y]), forward, left)
                if separation(np.asarray(own), corners) <= 0.0:
                    return False
        return True

    return free


def by_ompl(problem: Problem, seconds: float) -> Answer | None:
    """The first solution of OMPL's kinodynamic RRT, or `None`; its inputs are the rates of front speed and steering angle.

    It ends after `seconds` of CPU.
    """
    wheelbase, space = float(problem.scene.body.wheelbase), _space(problem)
    inputs = control.RealVectorControlSpace(space, 2)
    inputs.setBounds(_bounds([(-rate, rate) for rate in RATES]))
    setup = control.SimpleSetup(inputs)
    information = setup.getSpaceInformation()

    def propagate(state: Any, rates: Any, duration: float, result: Any) -> None:
        x, y, heading, front_speed, angle = _numbers(state)
        steps = max(1, round(duration / 0.05))
        h = duration / steps
        for _ in range(steps):
            # The midpoint rule; both inputs are constant.
            v, bend = front_speed + rates[0] * h / 2.0, angle + rates[1] * h / 2.0
            turn = h * v * math.sin(bend) / wheelbase
            way = h * v * math.cos(bend)
            x, y = x + way * math.cos(heading + turn / 2.0), y + way * math.sin(heading + turn / 2.0)
            heading, front_speed, angle = heading + turn, front_speed + rates[0] * h, angle + rates[1] * h
        heading = (heading + math.pi) % (2.0 * math.pi) - math.pi
        _filled(result, (x, y, heading, front_speed, angle))

    setup.setStatePropagator(propagate)
    setup.setStateValidityChecker(is_free(problem))
    information.setPropagationStepSize(STEP)
    information.setMinMaxControlDuration(1, MOST_STEPS)
    launch, goal = problem.launch, problem.goal
    ends = [(*map(float, (*end.place, end.heading, end.speed)), 0.0) for end in (launch, goal)]
    setup.setStartAndGoalStates(*(_filled(space.allocState(), numbers) for numbers in ends), NEAR)
    planner = control.RRT(information)
    planner.setIntermediateStates(True)
    setup.setPlanner(planner)
    end = time.process_time() + seconds
    setup.solve(base.PlannerTerminationCondition(lambda: time.process_time() > end))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    path.interpolate()
    rows = np.array([_numbers(state) for state in path.getStates()])
    times = np.append(0.0, np.cumsum(path.getControlDurations()))
    even = np.linspace(0.0, times[-1], INTERVALS * FINE + 1)
    return Answer(np.interp(even, times, rows[:, 4]), np.interp(even, times, rows[:, 3]), float(times[-1]))
