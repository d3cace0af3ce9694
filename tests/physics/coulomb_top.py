"""The top under exact Coulomb friction, event by event: a reference in plain NumPy and SciPy, SI units.

State: axis e, velocity u of the centre of mass, angular velocity w, place O of the sphere's centre, in the fixed frame (12
numbers). The arena is the plane, the inside of a cylinder along y or of a sphere; n is its normal. The three components of
the contact force F are unknowns of one linear system, which says what the contact point's acceleration shall be:

    W F = q,  W = 1/m - [r]x J^-1 [r]x,  r = a e - R n,  q = wanted acceleration + g z - w x r' - (J^-1 (J w x w)) x r.

Slipping: F = N (n - mu v / |v|), N from v'.n = -v.n'. Rolling: all three equations, the contact point at rest.
A slip begins with next to no speed, where its direction is stiff, so it is followed by an implicit method at first.
"""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

UP = np.array([0.0, 0.0, 1.0])


class Body(NamedTuple):
    """Mass [kg], radius and offset [m], moments of inertia [kg m^2], coefficient of friction, gravity [m/s^2], the arena's
    radius [m] and along which axes it is curved: (1, 0, 1) for the cylinder, (1, 1, 1) for the sphere."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    mu: float
    gravity: float = 9.81
    arena: float | None = None
    curved: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Mode(NamedTuple):
    """A stretch of the run: "slipping" or "rolling", its steps' times [s] and states (12, times)."""

    kind: str
    times: np.ndarray
    states: np.ndarray


def start(body: Body, theta: float, spin: float) -> np.ndarray:
    """The launch of `tippe.Launch`: angular velocity along the axis, sphere's centre at rest at the lowest place."""
    e = np.array([np.sin(theta), 0.0, np.cos(theta)])
    depth = 0.0 if body.arena is None else body.radius - body.arena
    return np.concatenate([e, np.zeros(3), spin * e, depth * UP])


def cross(a, b):
    """Vector product; NumPy's own is slow on single vectors."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def skew(r):
    """The matrix of r x."""
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])


class Contact:
    """Quantities at a state that both kinds of motion need."""

    def __init__(self, body: Body, state: np.ndarray):
        e, u, w, centre = state[:3], state[3:6], state[6:9], state[9:]
        self.body, self.e, self.w = body, e, w
        self.e_dot = cross(w, e)
        self.V = u + body.offset * self.e_dot
        self.n, self.n_dot = UP, np.zeros(3)
        if body.arena is not None:
            inward = -np.array(body.curved) / (body.arena - body.radius)
            self.n, self.n_dot = inward * centre, inward * self.V
        self.r = body.offset * e - body.radius * self.n
        outer = np.outer(e, e)
        J = body.I1 * np.eye(3) + (body.I3 - body.I1) * outer
        self.J_inverse = np.eye(3) / body.I1 + (1.0 / body.I3 - 1.0 / body.I1) * outer
        self.free = self.J_inverse @ cross(J @ w, w)
        self.W = np.eye(3) / body.mass - skew(self.r) @ self.J_inverse @ skew(self.r)
        self.v = u + cross(w, self.r)
        # The acceleration of the contact point that no force at the contact makes.
        self.drift = (
            -body.gravity * UP
            + cross(self.free, self.r)
            + cross(w, body.offset * self.e_dot - body.radius * self.n_dot)
        )

    def rolling_force(self) -> np.ndarray:
        """Force that keeps the contact point from accelerating."""
        return np.linalg.solve(self.W, -self.drift)

    def slipping_force(self) -> np.ndarray:
        """Coulomb's force, and the normal force with which the contact persists."""
        direction = self.n - self.body.mu * self.v / np.linalg.norm(self.v)
        load = -self.v @ self.n_dot - self.n @ self.drift
        return load / (self.n @ self.W @ direction) * direction

    def rate(self, force: np.ndarray) -> np.ndarray:
        """Rate of the state under a force at the contact."""
        u_dot = force / self.body.mass - self.body.gravity * UP
        return np.concatenate([self.e_dot, u_dot, self.free + self.J_inverse @ cross(self.r, force), self.V])

    def reserve(self) -> float:
        """mu N - |F_t| of the rolling top [N]."""
        force = self.rolling_force()
        return self.body.mu * (force @ self.n) - np.linalg.norm(self.along(force))

    def along(self, vector: np.ndarray) -> np.ndarray:
        """The part of a vector along the arena."""
        return vector - (vector @ self.n) * self.n


def slip_to(body: Body, state: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The state after the blow that gives the contact point the velocity v along the arena."""
    contact = Contact(body, state)
    blow = np.linalg.solve(contact.W, v - contact.v)
    return state + np.concatenate(
        [np.zeros(3), blow / body.mass, contact.J_inverse @ cross(contact.r, blow), np.zeros(3)]
    )


def rate_of(body: Body, kind: str):
    """The field of a mode."""

    def rate(_, state):
        contact = Contact(body, state)
        return contact.rate(contact.slipping_force() if kind == "slipping" else contact.rolling_force())

    return rate


def begun(body: Body, state: np.ndarray, speed: float) -> np.ndarray:
    """The state of a top that begins to slip against the force that friction cannot give."""
    contact = Contact(body, state)
    force = contact.along(contact.rolling_force())
    return slip_to(body, state, -speed * force / np.linalg.norm(force))


def follow(
    body: Body,
    state: np.ndarray,
    t1: float,
    floor: float = 1e-8,
    onset: float = 1e-10,
    rtol: float = 1e-11,
    stiff: float = 2e-3,
) -> list[Mode]:
    """Run to `t1` [s], mode by mode; a slip ends where its speed has fallen to `floor` and begins with `onset` [m/s]. For
    the time `stiff` [s] after that the method is implicit."""
    atol = 0.1 * rtol * np.repeat([1.0, np.sqrt(body.gravity * body.radius), 100.0, body.radius], 3)

    def stops(_, x):
        return np.linalg.norm(Contact(body, x).v) - floor

    def leaves(_, x):
        return Contact(body, x).reserve()

    stops.terminal = leaves.terminal = True
    stops.direction = leaves.direction = -1.0
    slips, t, modes, slip_start = stops(0.0, state) > 0.0, 0.0, [], -stiff
    while t < t1:
        kind, event = ("slipping", stops) if slips else ("rolling", leaves)
        is_early = slips and t < slip_start + stiff
        method, end = ("Radau", min(slip_start + stiff, t1)) if is_early else ("DOP853", t1)
        solution = solve_ivp(rate_of(body, kind), (t, end), state, method, rtol=rtol, atol=atol, events=event)
        assert solution.success, solution.message
        if slips and not is_early and slip_start >= 0.0 and modes and modes[-1].kind == "slipping":
            last_mode = modes.pop()
            modes.append(
                Mode(kind, np.append(last_mode.times, solution.t[1:]), np.hstack([last_mode.states, solution.y[:, 1:]]))
            )
        else:
            modes.append(Mode(kind, solution.t, solution.y))
        t, state = solution.t[-1], solution.y[:, -1]
        if solution.status == 0:
            continue
        if slips:
            state = slip_to(body, state, np.zeros(3))
        slips = leaves(t, state) <= 0.0 if slips else True
        if slips:
            state, slip_start = begun(body, state, onset), t
    return modes


def theta(states: np.ndarray) -> np.ndarray:
    """Angle from the vertical to the axis [rad]."""
    return np.arctan2(np.hypot(states[0], states[1]), states[2])


def energy(body: Body, states: np.ndarray) -> np.ndarray:
    """Kinetic and potential energy [J]."""
    e, u, w = states[:3], states[3:6], states[6:9]
    axial = np.sum(w * e, axis=0)
    rotation = body.I1 * np.sum(w * w, axis=0) + (body.I3 - body.I1) * axial**2
    height = body.radius - body.offset * e[2]
    return 0.5 * (body.mass * np.sum(u * u, axis=0) + rotation) + body.mass * body.gravity * height
