"""A top on any arena: a reference in plain NumPy and SciPy, SI units. Nothing here is shared with the simulator.

The body is a rigid body in space: centre O of its sphere, velocity u of the centre of mass s = O - a e, axis e, angular
velocity w, all in the fixed frame, with Euler's equations J w' = M - w x J w, J = I1 + (I3 - I1) e e^T, and e' = w x e. The
arena is the zero set of a function F, the room where F is positive. The foot q of the centre and its multiplier solve
q + k grad F = O, F(q) = 0 anew in every evaluation, by Newton's method, so nothing is integrated but the body; the rate of the
normal follows from the derivative of that system. The normal force is the one that keeps n.O'' + n'.O' = 0: O'' is affine in
it, so one evaluation without it and one with a newton give it.

Run: python arena_reference.py   writes arena_reference.csv (some minutes).
"""

import csv
from dataclasses import asdict, dataclass, fields
from math import cos, sin, sqrt
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

UP = np.array((0.0, 0.0, 1.0))
SAMPLES = 6


def cross(a, b):
    """Vector product; NumPy's own takes twenty times as long on single vectors."""
    return np.array((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


@dataclass(frozen=True)
class Case:
    """Arena with its numbers, friction, launch; `slip_speed` 0 is viscous friction. (x, y, z) is next to the foot."""

    arena: str
    p1: float
    p2: float
    mu: float
    slip_speed: float
    theta: float
    azimuth: float
    spin: float
    x: float
    y: float
    z: float
    v1: float
    v2: float
    w1: float
    w2: float
    w3: float
    t1: float
    mass: float = 0.02
    radius: float = 0.02
    offset: float = 0.006
    I1: float = 131.0 / 350.0 * 8e-6
    I3: float = 0.4 * 8e-6
    gravity: float = 9.81


def level(case, q):
    """F, its gradient and its Hessian at a point."""
    x, y, z = q
    p1, p2 = case.p1, case.p2
    if case.arena == "tilted plane":
        return z * cos(p1) - x * sin(p1), np.array((-sin(p1), 0.0, cos(p1))), np.zeros((3, 3))
    if case.arena == "cylinder":
        return p1 * p1 - x * x - z * z, np.array((-2 * x, 0.0, -2 * z)), np.diag((-2.0, 0.0, -2.0))
    if case.arena == "paraboloid":
        return z - (x * x + y * y) / (2 * p1), np.array((-x / p1, -y / p1, 1.0)), np.diag((-1 / p1, -1 / p1, 0.0))
    if case.arena == "graph":
        # z = p1 sin(p2 x) cos(p2 y)
        s, c, sy, cy = sin(p2 * x), cos(p2 * x), sin(p2 * y), cos(p2 * y)
        hessian = p1 * p2 * p2 * np.array(((s * cy, c * sy, 0.0), (c * sy, s * cy, 0.0), (0.0, 0.0, 0.0)))
        return z - p1 * s * cy, np.array((-p1 * p2 * c * cy, p1 * p2 * s * sy, 1.0)), hessian
    if case.arena in ("spheroid", "outside of a sphere", "outside of a spheroid"):
        weights = np.array((1 / p1**2, 1 / p1**2, 1 / p2**2)) * (1.0 if case.arena.startswith("outside") else -1.0)
        return q @ (weights * q) - np.sign(weights[0]), 2 * weights * q, np.diag(2 * weights)
    if case.arena == "torus":
        rho = sqrt(x * x + y * y)
        distance_from_circle = rho - p1
        gradient = -2 * np.array((distance_from_circle * x / rho, distance_from_circle * y / rho, z))
        xx, yy, xy = 1 - p1 * y * y / rho**3, 1 - p1 * x * x / rho**3, p1 * x * y / rho**3
        return (
            p2 * p2 - distance_from_circle * distance_from_circle - z * z,
            gradient,
            -2 * np.array(((xx, xy, 0), (xy, yy, 0), (0, 0, 1.0))),
        )
    raise ValueError(case.arena)


def bordered(matrix, row):
    """A matrix (3, 3) with a row below and the same column to the right of it."""
    system = np.zeros((4, 4))
    system[:3, :3], system[:3, 3], system[3, :3] = matrix, row, row
    return system


def foot(case, centre, guess, distance):
    """The foot of a centre, from a guess."""
    q, (_, g, _) = np.array(guess), level(case, guess)
    k = distance / np.linalg.norm(g)
    for _ in range(50):
        F, g, H = level(case, q)
        system = bordered(np.eye(3) + k * H, g)
        step = np.linalg.solve(system, -np.append(q + k * g - centre, F))
        q, k = q + step[:3], k + step[3]
        if np.linalg.norm(step[:3]) < 1e-15:
            break
    return q, k


class Top:
    """The equations of motion of a case."""

    def __init__(self, case):
        self.case, self.near = case, None

    def contact(self, centre, V):
        """Normal n and its rate."""
        c = self.case
        q, k = foot(c, centre, self.near, c.radius)
        self.near = q
        _, g, H = level(c, q)
        size = np.linalg.norm(g)
        n = g / size
        system = bordered(np.eye(3) + k * H, g)
        q_dot = np.linalg.solve(system, np.append(V, 0.0))[:3]
        turning = H @ q_dot / size
        return n, turning - n * (n @ turning)

    def motion(self, y):
        """Rates, and the normal force."""
        c = self.case
        centre, u, e, w = y.reshape(4, 3)
        e_dot = cross(w, e)
        V = u + c.offset * e_dot
        n, n_dot = self.contact(centre, V)
        r = c.offset * e - c.radius * n
        slip = V - c.radius * cross(w, n)
        slip = slip - n * (n @ slip)
        f = -c.mu * slip / (sqrt(slip @ slip + c.slip_speed**2) if c.slip_speed else 1.0)
        inertia = c.I1 * np.eye(3) + (c.I3 - c.I1) * np.outer(e, e)
        inverse = np.eye(3) / c.I1 + (1 / c.I3 - 1 / c.I1) * np.outer(e, e)

        def accelerations(N):
            force = N * (n + f)
            w_dot = inverse @ (cross(r, force) - cross(w, inertia @ w))
            u_dot = force / c.mass - c.gravity * UP
            O_dot2 = u_dot + c.offset * (cross(w_dot, e) + cross(w, e_dot))
            return u_dot, w_dot, n @ O_dot2 + n_dot @ V

        rates_without_force, unit = accelerations(0.0)[2], accelerations(1.0)[2]
        N = -rates_without_force / (unit - rates_without_force)
        u_dot, w_dot, _ = accelerations(N)
        return np.concatenate([V, u_dot, e_dot, w_dot]), N

    def start(self):
        c = self.case
        self.near = np.array((c.x, c.y, c.z))
        for _ in range(20):
            F, g, _ = level(c, self.near)
            self.near = self.near - F * g / (g @ g)
        _, g, _ = level(c, self.near)
        n = g / np.linalg.norm(g)
        t1 = np.array((1.0, 0.0, 0.0)) - n[0] * n
        t1 /= np.linalg.norm(t1)
        t2 = cross(n, t1)
        e = cos(c.theta) * n + sin(c.theta) * (cos(c.azimuth) * t1 + sin(c.azimuth) * t2)
        w = c.spin * e + c.w1 * t1 + c.w2 * t2 + c.w3 * n
        V = c.v1 * t1 + c.v2 * t2
        return np.concatenate([self.near + c.radius * n, V - c.offset * cross(w, e), e, w])


def row(case):
    """The foot at the start; how the run ends; centre, axis and normal force at some times until then."""
    top = Top(case)
    start = top.start()
    place = top.near.copy()

    def lost(_, y):
        return top.motion(y)[1]

    lost.terminal, lost.direction = True, -1
    run = solve_ivp(
        lambda _, y: top.motion(y)[0],
        (0.0, case.t1),
        start,
        "DOP853",
        rtol=2e-13,
        atol=1e-14,
        events=lost,
        dense_output=True,
    )
    end = run.t[-1]
    entry = {"status": "contact_lost" if run.t_events[0].size else "completed", "end_time": end}
    entry |= dict(zip(("q1", "q2", "q3"), place, strict=True))
    for k in range(1, SAMPLES + 1):
        y = run.sol(min(k * case.t1 / SAMPLES, end) if case.t1 / SAMPLES * k <= end else end)
        top.near = y[:3]
        N = top.motion(y)[1]
        entry |= {f"O{i}_{k}": y[i] for i in range(3)} | {f"e{i}_{k}": y[6 + i] for i in range(3)} | {f"N_{k}": N}
    return {name: value if isinstance(value, str) else repr(float(value)) for name, value in entry.items()}


def recorded():
    """The rows of the file, in the order of `cases`, numbers as numbers."""
    rows = csv.DictReader(Path(__file__).with_name("arena_reference.csv").read_text().splitlines())
    return [{k: v if k in ("arena", "status") else float(v) for k, v in row.items()} for row in rows]


ARENAS = {
    "tilted plane": (0.35, 0.0, (0.1, 0.05, 0.0365)),
    "paraboloid": (0.3, 0.0, (0.1, -0.06, 0.023)),
    "graph": (0.03, 7.0, (0.05, 0.08, 0.01)),
    "spheroid": (0.4, 0.25, (0.15, 0.1, -0.22)),
    "outside of a sphere": (0.5, 0.5, (0.05, 0.08, 0.49)),
    "torus": (0.4, 0.15, (0.35, 0.2, -0.14)),
}


def cases():
    """Both laws on every arena, from launches with nothing special about them."""
    random, rows = np.random.default_rng(20260), []
    for arena, (p1, p2, near) in ARENAS.items():
        for slip_speed in (0.0, 0.02):
            theta, azimuth, spin = random.uniform(0.1, 2.5), random.uniform(-3.0, 3.0), random.uniform(60.0, 120.0)
            v, w = random.uniform(-0.2, 0.2, 2), random.uniform(-10.0, 10.0, 3)
            mu = random.uniform(0.1, 0.3)
            rows.append(Case(arena, p1, p2, mu, slip_speed, theta, azimuth, spin, *near, *v, *w, 0.6))
    # Two that lose their contact: over the crest of a wave, and down the side of an egg.
    turning = (3.0, -5.0, 2.0)
    rows.append(Case("graph", 0.04, 12.0, 0.2, 0.02, 0.8, 0.5, 90.0, -0.07, 0.05, -0.03, 2.1, -0.2, *turning, 0.15))
    rows.append(
        Case("outside of a spheroid", 0.3, 0.5, 0.2, 0.02, 0.8, 0.5, 90.0, 0.05, 0.08, 0.48, 0.9, -0.2, *turning, 0.15)
    )
    return rows


if __name__ == "__main__":
    rows = [asdict(case) | row(case) for case in cases()]
    with Path(__file__).with_name("arena_reference.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    assert {field.name for field in fields(Case)} <= set(rows[0])
