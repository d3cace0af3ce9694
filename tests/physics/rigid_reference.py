"""An ellipsoid of any inertia that slides or rolls on a level plane: a reference in plain NumPy and SciPy, SI units.

A rigid body in space, with nothing of the simulator: centre of mass x, its velocity u, a unit quaternion from the body's axes
to the fixed ones, and the angular velocity w in the fixed axes. Accelerations and contact force come from one linear system:
m u' = F - m g z, J w' + w x J w = r x F, and as many conditions on the contact as there are unknown forces. Rolling, the
velocity of the contact point stays zero as a vector; sliding, its normal component does, and F = N (z + f(slip)).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

UP = np.array((0.0, 0.0, 1.0))


def skew(w):
    return np.array(((0.0, -w[2], w[1]), (w[2], 0.0, -w[0]), (-w[1], w[0], 0.0)))


def rotation(q):
    """The rotation matrix of a quaternion (scalar first) of any length."""
    s, v = q[0], q[1:]
    return np.eye(3) + 2.0 * (s * skew(v) + skew(v) @ skew(v)) / (q @ q)


def quaternion(Q):
    """A unit quaternion, scalar first, of a rotation matrix."""
    return np.roll(Rotation.from_matrix(Q).as_quat(), 1)


@dataclass(frozen=True)
class Rattleback:
    """An ellipsoid; `friction` gives the force per newton of N for a slip velocity, `None` for pure rolling."""

    mass: float
    semi_axes: tuple
    centre_of_mass: tuple
    inertia: tuple
    friction: object = None
    gravity: float = 9.81

    def lever(self, Q):
        """The lowest point from the centre of mass, in the fixed axes, and its rate as a function of the angular velocity."""
        S = Q @ np.diag(np.square(self.semi_axes)) @ Q.T
        reach = np.sqrt(UP @ S @ UP)
        centre = -Q @ np.array(self.centre_of_mass)
        r = centre - S @ UP / reach

        def rate(w):
            W = skew(w)
            S_dot = W @ S - S @ W
            return W @ centre - S_dot @ UP / reach + S @ UP * (UP @ S_dot @ UP) / (2.0 * reach**3)

        return r, rate

    def motion(self, y):
        """Rates, and the force of the plane."""
        u, q, w = y[3:6], y[6:10], y[10:13]
        Q = rotation(q)
        J = Q @ np.array(self.inertia) @ Q.T
        r, rate = self.lever(Q)
        system, right = np.zeros((9, 9)), np.zeros(9)
        system[:3, :3], system[:3, 6:], right[:3] = self.mass * np.eye(3), -np.eye(3), -self.mass * self.gravity * UP
        system[3:6, 3:6], system[3:6, 6:], right[3:6] = J, -skew(r), -np.cross(w, J @ w)
        # The contact point's velocity u + w x r changes at the rate u' + w' x r + w x r'.
        acceleration, right_side = np.hstack((np.eye(3), -skew(r))), np.cross(w, rate(w))
        if self.friction is None:
            system[6:, :6], right[6:] = acceleration, -right_side
        else:
            slip = u + np.cross(w, r)
            friction_force = self.friction(slip * (1.0 - UP))
            system[8, :6], right[8] = acceleration[2], -right_side[2]
            for k in range(2):
                system[6 + k, 6 + k], system[6 + k, 8] = 1.0, -friction_force[k]
        solution = np.linalg.solve(system, right)
        q_dot = 0.5 * np.concatenate(([-w @ q[1:]], q[0] * w + np.cross(w, q[1:])))
        return np.concatenate((u, solution[:3], q_dot, solution[3:6])), solution[6:]

    def start(self, theta, azimuth, spin, turning=(0.0, 0.0, 0.0), velocity=(0.0, 0.0)):
        """The launch of `tippe.Launch` with the contact at the origin: the body is turned by theta about a horizontal axis."""
        q = np.array(
            (np.cos(theta / 2), -np.sin(azimuth) * np.sin(theta / 2), np.cos(azimuth) * np.sin(theta / 2), 0.0)
        )
        Q = rotation(q)
        w = spin * Q[:, 2] + turning
        r, _ = self.lever(Q)
        u = -np.cross(w, r)
        if self.friction is not None:
            u[:2] = velocity
        return np.concatenate((-r, u, q, w))

    def run(self, y, times, rtol=1e-12):
        """The states at the times, (times, 13)."""
        return self._solve(y, times[-1], rtol=rtol, t_eval=times).y.T

    def reversal(self, y, t1, rtol=1e-12):
        """The first time at which the spin about the vertical vanishes."""

        def spin(t, y):
            return y[12]

        spin.terminal = True
        return self._solve(y, t1, rtol=rtol, events=spin).t_events[0][0]

    def _solve(self, y, t1, rtol=1e-12, **options):
        return solve_ivp(lambda t, y: self.motion(y)[0], (0.0, t1), y, "DOP853", rtol=rtol, atol=1e-2 * rtol, **options)


class Mode(NamedTuple):
    """A stretch of a run: whether the body rolls, its steps' times [s] and states (13, times)."""

    rolls: bool
    times: np.ndarray
    states: np.ndarray


def follow(body: Rattleback, mu: float, y, t1: float, floor=1e-8, onset=1e-9, rtol=1e-10, stiff=5e-4) -> list[Mode]:
    """Stick and slip of a body on the level plane, mode by mode; `body` has no friction of its own.

    A slip ends where its speed has fallen to `floor`, and begins with `onset` [m/s] against the force of rolling; for the time
    `stiff` [s] after that, where its direction is stiff, the method is implicit.
    """
    slipping = replace(body, friction=lambda v: -mu * v / np.linalg.norm(v))

    def slip(y):
        return (y[3:6] + np.cross(y[10:13], body.lever(rotation(y[6:10]))[0]))[:2]

    def struck(y, v):
        """The state after the blow that gives the contact point the velocity v along the plane."""
        Q = rotation(y[6:10])
        r = skew(body.lever(Q)[0])
        inverse = np.linalg.inv(Q @ np.array(body.inertia) @ Q.T)
        blow = np.linalg.solve(np.eye(3) / body.mass - r @ inverse @ r, np.append(v - slip(y), 0.0))
        return y + np.concatenate((np.zeros(3), blow / body.mass, np.zeros(4), inverse @ r @ blow))

    def leaves(_, y):
        force = body.motion(y)[1]
        return mu * force[2] - np.hypot(*force[:2])

    def stops(_, y):
        return np.linalg.norm(slip(y)) - floor

    stops.terminal = leaves.terminal = True
    stops.direction = leaves.direction = -1.0
    is_rolling, t, modes, slip_start = stops(0.0, y) <= 0.0, 0.0, [], -stiff
    while t < t1:
        is_early = not is_rolling and t < slip_start + stiff
        equations, method = (body if is_rolling else slipping), "Radau" if is_early else "DOP853"
        options = {"rtol": rtol, "atol": 1e-2 * rtol, "events": leaves if is_rolling else stops}
        end = min(slip_start + stiff, t1) if is_early else t1
        solution = solve_ivp(
            lambda t, y, kind_of_motion=equations: kind_of_motion.motion(y)[0], (t, end), y, method, **options
        )
        if modes and not is_rolling and not modes[-1].rolls:
            last_mode = modes.pop()
            modes.append(
                Mode(
                    is_rolling,
                    np.append(last_mode.times, solution.t[1:]),
                    np.hstack((last_mode.states, solution.y[:, 1:])),
                )
            )
        else:
            modes.append(Mode(is_rolling, solution.t, solution.y))
        t, y = solution.t[-1], solution.y[:, -1]
        if solution.status == 0:
            continue
        if not is_rolling:
            y = struck(y, np.zeros(2))
        is_rolling = not is_rolling and leaves(t, y) > 0.0
        if not is_rolling:
            force, slip_start = body.motion(y)[1], t
            y = struck(y, -onset * force[:2] / np.hypot(*force[:2]))
    return modes
