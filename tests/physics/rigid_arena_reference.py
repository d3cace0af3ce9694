"""An ellipsoid of any inertia that slides or rolls on any arena: a reference in plain NumPy and SciPy, SI units.

A rigid body in space, as in `rigid_reference.py`, and an arena F = 0 with the room where F is positive (`arena_reference.py`).
The contact is solved anew for every pose by Newton's method: a point q of the arena and a distance k for which the body's
farthest point against the normal n(q) is at q + k n. The constraint is linear in the velocities (u, w), with coefficients that
depend on the pose alone; their rate comes from central differences along the motion, with the contact solved at each pose. So
no curvature of the contact enters, and no rate of the contact point.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from arena_reference import level
from rigid_reference import UP, Rattleback, rotation, skew

#: Step of the differences [s], and their weights.
STEP = 2e-5
WEIGHTS = {-2: 1.0 / 12.0, -1: -8.0 / 12.0, 1: 8.0 / 12.0, 2: -1.0 / 12.0}


@dataclass(frozen=True)
class OnArena(Rattleback):
    """An ellipsoid on an arena that `arena_reference.level` knows by its name and two numbers."""

    arena: str = "spheroid"
    p1: float = 0.5
    p2: float = 0.3

    def contact(self, x, Q, near):
        """The contact point, its normal, and the vector from the centre of mass to the body's farthest point."""
        case = SimpleNamespace(arena=self.arena, p1=self.p1, p2=self.p2)
        S = Q @ np.diag(np.square(self.semi_axes)) @ Q.T
        q, k = np.array(near, dtype=float), 0.0
        for _ in range(50):
            F, g, hessian = level(case, q)
            size = np.linalg.norm(g)
            n = g / size
            reach = np.sqrt(n @ S @ n)
            r = -Q @ np.array(self.centre_of_mass) - S @ n / reach
            bend = (np.eye(3) - np.outer(n, n)) @ hessian / size
            slope = -S / reach + np.outer(S @ n, S @ n) / reach**3
            system = np.zeros((4, 4))
            system[:3, :3], system[:3, 3], system[3, :3] = (slope - k * np.eye(3)) @ bend - np.eye(3), -n, g
            step = np.linalg.solve(system, -np.append(x + r - q - k * n, F))
            q, k = q + step[:3], k + step[3]
            if np.linalg.norm(step) < 1e-15:
                break
        return q, n, r

    def constraint(self, x, Q, near):
        """The matrix C of the constraint C (u, w) = 0."""
        _, n, r = self.contact(x, Q, near)
        rolling = np.hstack((np.eye(3), -skew(r)))
        return rolling if self.friction is None else n[None] @ rolling

    def motion(self, y, near=None):
        """Rates, and the force of the arena."""
        x, u, q, w = y[:3], y[3:6], y[6:10], y[10:13]
        Q = rotation(q)
        J = Q @ np.array(self.inertia) @ Q.T
        foot, n, r = self.contact(x, Q, x if near is None else near)
        changes = sum(
            weight * self.constraint(x + k * STEP * u, turn(k * STEP * w) @ Q, foot) for k, weight in WEIGHTS.items()
        )
        system, right = np.zeros((9, 9)), np.zeros(9)
        system[:3, :3], system[:3, 6:], right[:3] = self.mass * np.eye(3), -np.eye(3), -self.mass * self.gravity * UP
        system[3:6, 3:6], system[3:6, 6:], right[3:6] = J, -skew(r), -np.cross(w, J @ w)
        C, right_side = self.constraint(x, Q, foot), changes @ np.concatenate((u, w)) / STEP
        if self.friction is None:
            system[6:, :6], right[6:] = C, -right_side
        else:
            slip = u + np.cross(w, r)
            tangent_axes = np.linalg.svd(n[None])[2][1:]
            push = self.friction(slip - n * (n @ slip))
            system[6, :6], right[6] = C[0], -right_side[0]
            system[7:, 6:] = tangent_axes - np.outer(tangent_axes @ push, n)
        solution = np.linalg.solve(system, right)
        q_dot = 0.5 * np.concatenate(([-w @ q[1:]], q[0] * w + np.cross(w, q[1:])))
        return np.concatenate((u, solution[:3], q_dot, solution[3:6])), solution[6:]


def turn(angle):
    """The rotation matrix of a rotation vector."""
    size = np.linalg.norm(angle)
    return rotation(np.concatenate(([np.cos(0.5 * size)], 0.5 * angle * np.sinc(0.5 * size / np.pi))))
