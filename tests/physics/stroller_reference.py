"""A stroller on a surface as a rigid body with multipliers, in the fixed frame: NumPy and SciPy only.

Unknown at every instant are the acceleration of the rear axle, of yaw and of the fork, the normal force and the side forces
of both axles; the equations are Newton's for the axle, Euler's for the yaw about the normal and for the fork, and the second
derivatives of the constraints: the axle stays on the surface and does not slip sideways, nor does the front wheel. There is no
quasi-momentum, no reduced mass and no chart. A surface is a function of three coordinates, by its gradient and Hessian.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])


def cross(a, b):
    """Vector product; NumPy's own takes twenty times as long on single vectors."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


class Level(NamedTuple):
    """A function whose zeros are the surface: r [m] -> gradient (3,) and Hessian (3, 3), and the Gaussian curvature [1/m^2]."""

    slopes: Callable[[Array], tuple[Array, Array]]

    def normal(self, r: Array) -> tuple[Array, Array]:
        """Unit normal, and its derivative (3, 3) along any direction [1/m]."""
        gradient, hessian = self.slopes(r)
        length = np.linalg.norm(gradient)
        n = gradient / length
        return n, (np.eye(3) - np.outer(n, n)) @ hessian / length

    def curvature(self, r: Array) -> float:
        """Gaussian curvature [1/m^2]: the product of the eigenvalues of the derivative but for that along n, which is 0."""
        n, turning = self.normal(r)
        return float(np.linalg.det(turning + np.outer(n, n)))


def torus(ring: float, tube: float) -> Level:
    """(rho - ring)^2 + z^2 - tube^2, outward."""

    def slopes(r: Array) -> tuple[Array, Array]:
        rho = np.hypot(r[0], r[1])
        transverse = np.array([r[0], r[1], 0.0]) / rho
        bend = (np.diag([1.0, 1.0, 0.0]) - np.outer(transverse, transverse)) / rho
        gradient = 2.0 * (rho - ring) * transverse + 2.0 * r[2] * UP
        return gradient, 2.0 * (np.outer(transverse, transverse) + (rho - ring) * bend + np.outer(UP, UP))

    return Level(slopes)


def graph(height: Callable[[float, float], tuple[Array, Array]]) -> Level:
    """z - h(x, y), upward, from the gradient (2,) and the Hessian (2, 2) of h."""

    def slopes(r: Array) -> tuple[Array, Array]:
        first, second = height(r[0], r[1])
        hessian = np.zeros((3, 3))
        hessian[:2, :2] = -second
        return np.array([-first[0], -first[1], 1.0]), hessian

    return Level(slopes)


class Vehicle(NamedTuple):
    """Parameters of the stroller and of the forces on it, in SI units; `damping`: rolling, front, scrub, steering."""

    mass: float
    wheelbase: float
    inertia: float
    steering_inertia: float
    spring: float
    damping: tuple[float, float, float, float]
    gravity: float
    #: (drive force [N], steering torque [N m]) at a time [s].
    push: Callable[[float], tuple[float, float]]
    absolute: bool
    side: float


class Instant(NamedTuple):
    """What is known at an instant: the rates of (r, r', e, yaw rate, phi, phi'), and forces [N]."""

    rate: Array
    normal_force: float
    rear: float
    front: float


def instant(level: Level, vehicle: Vehicle, t: float, y: Array) -> Instant:
    """Solve for the accelerations and the forces of the constraints."""
    r, velocity, e, (yaw, phi, steering) = y[:3], y[3:6], y[6:9], y[9:]
    m, length, J, Jf = vehicle[:4]
    n, turning = level.normal(r)
    n_rate = turning @ velocity
    up, up_rate = vehicle.side * n, vehicle.side * n_rate
    e_rate = cross(yaw * up + cross(n, n_rate), e)
    left = cross(up, e)
    left_rate = cross(up_rate, e) + cross(up, e_rate)
    sine, cosine = np.sin(phi), np.cos(phi)
    wheel_direction, transverse = cosine * e + sine * left, cosine * left - sine * e
    v, lateral = e @ velocity, left @ velocity
    w = cosine * v + sine * lateral + length * sine * yaw
    drive, torque = vehicle.push(t)
    c_v, c_w, c_yaw, c_s = vehicle.damping
    fork = torque - vehicle.spring * phi - c_s * steering
    # Columns: r'' (3), yaw acceleration, phi'', normal force, rear and front side force.
    A, b = np.zeros((8, 8)), np.zeros(8)
    A[:3, :3] = m * np.eye(3)
    A[:3, 5], A[:3, 6], A[:3, 7] = -up, -left, -transverse
    b[:3] = -m * vehicle.gravity * UP + (drive - c_v * v) * e - c_w * w * wheel_direction
    A[3, 3], A[3, 7] = J, -length * cosine
    b[3] = -c_yaw * yaw - c_w * w * length * sine - (fork if vehicle.absolute else 0.0)
    A[4, 3], A[4, 4], b[4] = (Jf if vehicle.absolute else 0.0), Jf, fork
    A[5, :3], b[5] = up, -up_rate @ velocity
    A[6, :3], b[6] = left, -left_rate @ velocity
    A[7, :3], A[7, 3] = transverse, length * cosine
    b[7] = steering * w - cosine * (left_rate @ velocity) + sine * (e_rate @ velocity)
    x = np.linalg.solve(A, b)
    # The spin about the normal reacts on a frame that the curvature turns (`stroller.md`, section 4).
    spin = J * yaw + (Jf * (steering + yaw) if vehicle.absolute else 0.0)
    rear = x[6] - level.curvature(r) * spin * v
    return Instant(np.concatenate([velocity, x[:3], e_rate, [x[3], steering, x[4]]]), x[5], rear, x[7])


def ride(level: Level, vehicle: Vehicle, start: Array, times: Array) -> tuple[Array, list[Instant]]:
    """States (times, 12) of a ride from (r, r', e, yaw rate, phi, phi') at time 0, and what is known at each."""
    solution = solve_ivp(
        lambda t, y: instant(level, vehicle, t, y).rate,
        (0.0, times[-1]),
        start,
        method="DOP853",
        t_eval=times,
        rtol=1e-12,
        atol=1e-12,
    )
    return solution.y.T, [instant(level, vehicle, t, y) for t, y in zip(times, solution.y.T, strict=True)]


def started(
    level: Level, r: Array, e: Array, side: float, wheelbase: float, speed: float, phi: float, rate: float
) -> Array:
    """The state of a start that satisfies the constraints."""
    n, _ = level.normal(r)
    assert abs(n @ e) < 1e-12
    return np.concatenate([r, speed * e, e, [speed * np.tan(phi) / wheelbase, phi, rate]])
