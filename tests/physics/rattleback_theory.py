"""The linear theory of a rattleback's pitch and roll about a steady spin, in plain NumPy, SI units.

Sources: of the problem and of the amplitude equations Garcia and Hubbard, Proc. R. Soc. A 418 (1988) 165; of the linear
problem Bondi, Proc. R. Soc. A 405 (1986) 265; of the reversal by one oscillation Moffatt and Tokieda, Proc. R. Soc.
Edinburgh A 138 (2008) 361. The formulas are derived here from the equations of rolling, not copied. With q the components
of the vertical across the body's z axis, seen by the body, which spins at n about the vertical,

    (adj J + m h^2) q'' + n [(J33 - tr J - 2 m h^2) E + m h E H] q' + [m g (H - h) + n^2 (J33 - J - m h (h - H))] q = 0,

J the inertia across z (z is a principal axis), E the quarter turn ((0, 1), (-1, 0)), H the radii of curvature at the lowest
point, h the height of the centre of mass. This follows from w = E q' + n q, r = -H q, F / m = g q - h q'' +
n E (2 h - H) q' + n^2 (h - H) q across z, and J w' + n (J33 E - E J) w = -m g E H q + h E F. Unless H is a multiple of 1,
E H has a symmetric part: a resistance of both signs, which makes one oscillation grow and the other decay, and changes its
sign with n.
"""

from dataclasses import dataclass

import numpy as np

QUARTER = np.array(((0.0, 1.0), (-1.0, 0.0)))


@dataclass(frozen=True)
class Oscillations:
    """A rattleback by its mass, inertia (3, 3), radii of curvature H (2, 2) and height h of the centre of mass."""

    mass: float
    inertia: np.ndarray
    radii: np.ndarray
    height: float
    gravity: float = 9.81

    @classmethod
    def of_ellipsoid(cls, mass, semi_axes, depth, inertia):
        """An ellipsoid whose centre of mass is `depth` below its centre, on the z axis."""
        a, b, c = semi_axes
        return cls(mass, np.array(inertia), np.diag((a * a / c, b * b / c)), c - depth)

    @property
    def inertia_matrix(self):
        (a, b), (_, d) = self.inertia[:2, :2]
        return np.array(((d, -b), (-b, a))) + self.mass * self.height**2 * np.eye(2)

    @property
    def stiffness(self):
        return self.mass * self.gravity * (self.radii - self.height * np.eye(2))

    def matrix(self, n):
        """The matrix A of (q, q')' = A (q, q') at a spin n."""
        m, h, H, J = self.mass, self.height, self.radii, self.inertia[:2, :2]
        J33, unit = self.inertia[2, 2], np.eye(2)
        resistance = n * ((J33 - np.trace(J) - 2.0 * m * h * h) * QUARTER + m * h * QUARTER @ H)
        stiffness = self.stiffness + n * n * (J33 * unit - J - m * h * (h * unit - H))
        inverse = np.linalg.inv(self.inertia_matrix)
        return np.block([[np.zeros((2, 2)), unit], [-inverse @ stiffness, -inverse @ resistance]])

    def slow_growth(self):
        """Growth rate over spin of both oscillations for a slow spin, and their frequencies [rad/s], the faster one last.

        By perturbation theory: minus half the symmetric part of the resistance over the inertia, in each mode of n = 0.
        """
        squares, modes = np.linalg.eig(np.linalg.solve(self.inertia_matrix, self.stiffness))
        order = np.argsort(squares)
        stiffness = self.mass * self.height * QUARTER @ self.radii
        rates = [-0.5 * (v @ stiffness @ v) / (v @ self.inertia_matrix @ v) for v in modes[:, order].T]
        return np.array(rates), np.sqrt(squares[order])

    def small_angle_growth(self):
        """The same to first order in the product of inertia, in closed form; H is diagonal."""
        M1, M2 = np.diag(self.inertia_matrix)
        K1, K2 = np.diag(self.stiffness)
        squares, product = np.array((K1 / M1, K2 / M2)), self.inertia[0, 1]
        difference = 0.5 * self.mass * self.height * (self.radii[0, 0] - self.radii[1, 1])
        rates = difference * product * squares / (M1 * M2 * (squares - squares[::-1]))
        order = np.argsort(squares)
        return rates[order], np.sqrt(squares[order])

    def reversal(self, spin, tilt):
        """The time at which a slow spin has vanished, for a tilt [rad] about the y axis, by the faster oscillation alone.

        Energy goes from one to the other: with the growth rate s n, E' = 2 s n E and J33 n^2 / 2 + E = J33 N^2 / 2, so
        n' = -s (N^2 - n^2), and n = -N tanh(s N (t - t0)).
        """
        M, K = self.inertia_matrix, self.stiffness
        squares, modes = np.linalg.eig(np.linalg.solve(M, K))
        mode = modes[:, np.argmax(squares)]
        amplitude = tilt * (mode @ M)[0] / (mode @ M @ mode)
        energy = 0.5 * amplitude**2 * (mode @ K @ mode)
        rate = self.slow_growth()[0][1]
        max_rate = np.sqrt(spin**2 + 2.0 * energy / self.inertia[2, 2])
        return np.arctanh(spin / max_rate) / (rate * max_rate)
