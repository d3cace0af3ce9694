"""A spheroid that slides on a level plane: a reference in plain NumPy and SciPy, SI units, with nothing of the simulator.

A rigid body in space: centre of mass x, its velocity, the rotation matrix Q from the body's axes to the fixed ones, angular
velocity w, with Euler's equations J w' = M - w x J w. With the shape matrix S = Q diag(b^2, b^2, p^2) Q^T the lowest point of
the spheroid is at -S z / sqrt(z.S z) from its centre, so the gap to the plane is O_z - sqrt(z.S z). N is the multiplier that
keeps the gap's second rate zero; it is affine in N, so one evaluation without it and one with a newton give it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

UP = np.array((0.0, 0.0, 1.0))


def cross(a, b):
    """Vector product; NumPy's own takes twenty times as long on single vectors."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def skew(w):
    return np.array(((0.0, -w[2], w[1]), (w[2], 0.0, -w[0]), (-w[1], w[0], 0.0)))


@dataclass(frozen=True)
class Egg:
    """Half axes b and p, offset a of the centre of mass against the axis, friction; `slip_speed` 0 is viscous friction."""

    mass: float
    b: float
    p: float
    a: float
    I1: float
    I3: float
    mu: float
    slip_speed: float
    gravity: float = 9.81

    def friction(self, v):
        """Force along the plane for each newton of N."""
        return -self.mu * v / (np.sqrt(v @ v + self.slip_speed**2) if self.slip_speed else 1.0)

    def motion(self, y):
        """Rates, the normal force, and the lowest point from the centre of mass."""
        u, Q, w = y[3:6], y[6:15].reshape(3, 3), y[15:18]
        e, W = Q[:, 2], skew(w)
        S = Q @ np.diag((self.b**2, self.b**2, self.p**2)) @ Q.T
        reach = np.sqrt(UP @ S @ UP)
        r = self.a * e - S @ UP / reach
        slip = u + W @ r
        f = self.friction(slip * (1.0 - UP))
        J = Q @ np.diag((self.I1, self.I1, self.I3)) @ Q.T
        S_dot = W @ S - S @ W

        def accelerations(N):
            force = N * (UP + f)
            u_dot = force / self.mass - self.gravity * UP
            w_dot = np.linalg.solve(J, cross(r, force) - cross(w, J @ w))
            A = skew(w_dot)
            S_second = A @ S - S @ A + W @ S_dot - S_dot @ W
            rate = UP @ S_dot @ UP / (2.0 * reach)
            reach_second = UP @ S_second @ UP / (2.0 * reach) - rate**2 / reach
            O_second = u_dot + self.a * (A @ e + W @ W @ e)
            return u_dot, w_dot, O_second[2] - reach_second

        rates_without_force, with_one = accelerations(0.0)[2], accelerations(1.0)[2]
        N = -rates_without_force / (with_one - rates_without_force)
        u_dot, w_dot, _ = accelerations(N)
        return np.concatenate((u, u_dot, (W @ Q).ravel(), w_dot)), N, r

    def start(self, theta, azimuth, spin, turning, velocity):
        """The launch of `tippe.Launch` with the contact at the origin."""
        c, s = np.cos(theta), np.sin(theta)
        e = np.array((s * np.cos(azimuth), s * np.sin(azimuth), c))
        first = np.array((c * np.cos(azimuth), c * np.sin(azimuth), -s))
        Q = np.stack((first, cross(e, first), e), axis=1)
        w = spin * e + turning
        y = np.concatenate((np.zeros(3), np.zeros(3), Q.ravel(), w))
        r = self.motion(y)[2]
        u = np.array((*velocity, -cross(w, r)[2]))
        return np.concatenate((-r, u, Q.ravel(), w))

    def run(self, y, times):
        """The states at the times, (times, 18)."""
        return solve_ivp(
            lambda t, y: self.motion(y)[0], (0.0, times[-1]), y, "DOP853", times, rtol=1e-12, atol=1e-13
        ).y.T
