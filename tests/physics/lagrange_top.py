"""Tippe top by Lagrange's equations in Euler angles: a reference in plain NumPy and SciPy, SI units.

Coordinates q = (u, y, d, theta, phi, psi)
  u, y   place of the sphere's centre O across the arena and along y [m]; u is x [m] on the plane z = 0, and
         the angle eta [rad] from the lowest line inside a horizontal cylinder whose axis is y
  d      gap between sphere and arena [m]; released only to find the normal force, then d = d' = d'' = 0
  theta, phi, psi   Euler angles [rad] of the body in the FIXED frame: the axis (stem) is
         e = (sin theta cos phi, sin theta sin phi, cos theta) in the components of the chart; psi turns
         about e. The polar axis of a chart is world "x", "y" or "z"; a run that comes close to the pole
         of its chart goes on in another one (tops do pass within 1e-5 rad of the vertical).

Velocity of O:  O' = rho u' t + y' y + d' n, with rho = 1, t = x, n = z on the plane, and
  rho = surface_radius - radius - d, t = (cos u, 0, sin u), n = (-sin u, 0, cos u) in the cylinder.
Centre of mass  s = O - a e.  Lagrangian  L = T - U,
  T = m |s'|^2 / 2 + I1 (theta'^2 + phi'^2 sin^2 theta) / 2 + I3 (psi' + phi' cos theta)^2 / 2,
  U = m g s_z.
Contact: the constraint d = 0 has the multiplier N (normal force). The friction force N f acts at the
contact point, whose velocity in the arena's tangent plane is v, and the friction torque N tau on the body, whose
angular velocity is w; their generalised force is N (f . dv/dq' + tau . dw/dq').
  viscous f = -mu v (mu in s/m);  Coulomb f = -mu v / sqrt(v^2 + slip_speed^2);  frictionless f = 0.
  On a disc of contact_radius > 0, with b = 3 pi/16 contact_radius and w_n = w.n:
  f = -mu v / Q, tau = -mu b^2 w_n n / Q, Q = sqrt(v^2 + b^2 w_n^2 + slip_speed^2).
  Rolling resistance adds -resistance w_t / sqrt(w_t^2 + turning_speed^2) to tau, w_t = w - w_n n.
Lagrange's equations with d'' = 0 are six linear equations in (u'', y'', theta'', phi'', psi'', N).
u, theta, phi and the five rates are integrated; x, y and psi are cyclic and matter to nothing else.
"""

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, pi, sin, sqrt

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

X, Y, UP = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
TURN = {"z": 0, "x": 1, "y": 2}  # cyclic turn that takes the polar axis to the third place
NEAR = np.array((0.1, 0.5))  # gaps (see `gaps`) below which a step is searched for an event,
SUBDIVISIONS = 8  # at this many places;
TOUCH = 1e-9  # a gap below zero by less than this is no event


@dataclass(frozen=True)
class Scene:
    """Top, arena, friction and start; theta, eta and azimuth as seen from the arena's normal n."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    theta: float
    spin: float
    eta: float = 0.0
    azimuth: float = 0.0
    mu: float = 0.0  # s/m if slip_speed is None, else a pure number
    slip_speed: float | None = None  # m/s; None: viscous
    surface_radius: float | None = None  # m; None: the plane
    gravity: float = 9.81
    contact_radius: float = 0.0  # m
    resistance: float = 0.0  # m
    turning_speed: float = 1.0  # rad/s


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def in_chart(vector, pole):
    """Components of a world vector in the chart with this polar axis."""
    return vector[TURN[pole] :] + vector[: TURN[pole]]


def arena(scene, u, pole):
    """Tangent t and normal n at u, dO/du = rho t, and the turning rate k of t and n with u."""
    if scene.surface_radius is None:
        return in_chart(X, pole), in_chart(UP, pole), 1.0, 0.0
    t, n = (cos(u), 0.0, sin(u)), (-sin(u), 0.0, cos(u))
    return in_chart(t, pole), in_chart(n, pole), scene.surface_radius - scene.radius, 1.0


def axis(theta, phi):
    """e, its derivatives by theta and by phi, and its mixed second derivative."""
    st, ct, sp, cp = sin(theta), cos(theta), sin(phi), cos(phi)
    return (st * cp, st * sp, ct), (ct * cp, ct * sp, -st), (-st * sp, st * cp, 0.0), (-ct * sp, ct * cp, 0.0)


def friction(scene, vt, vy, wt, wy, wn):
    """Force (along t, y) and torque (about t, y, n) per unit normal force."""
    lever, size = 3 * pi / 16 * scene.contact_radius, 1.0
    if scene.slip_speed is not None:
        size = sqrt(vt * vt + vy * vy + (lever * wn) ** 2 + scene.slip_speed**2)
    drag = scene.resistance / sqrt(wt * wt + wy * wy + scene.turning_speed**2)
    return -scene.mu * vt / size, -scene.mu * vy / size, -drag * wt, -drag * wy, -scene.mu * lever**2 * wn / size


def accelerations(scene, state, pole="z"):
    """(u'', y'', theta'', phi'', psi'', N) at state = (u, theta, phi, u', y', theta', phi', psi').
    Rows are Lagrange's equations of u, y, d, theta, phi, psi: (mass matrix) q'' + bias = N (1 for d, friction),
    where bias = d(dT/dq')/dt at q'' = 0, less dT/dq, plus dU/dq."""
    u, th, ph, du, dy, dth, dph, dps = state
    m, a, R, I3 = scene.mass, scene.offset, scene.radius, scene.I3
    t, n, rho, k = arena(scene, u, pole)
    y, up = in_chart(Y, pole), in_chart(UP, pole)
    e, e1, e2, e12 = axis(th, ph)
    st, ct, kth = sin(th), cos(th), (-sin(ph), cos(ph), 0.0)  # kth: axis of theta'
    J, ma, mg, w3 = scene.I1 + m * a * a, m * a, m * scene.gravity, dps + dph * ct
    # e'' at theta'' = phi'' = 0: -e theta'^2 + 2 e12 theta' phi' + e22 phi'^2
    bend = [
        2 * p * dth * dph - q * dth * dth - r * dph * dph for p, q, r in zip(e12, e, (e[0], e[1], 0.0), strict=True)
    ]
    climb = k * rho * du * du  # O''.n at u'' = 0
    te1, te2, ye1, ye2, ne1, ne2 = dot(t, e1), dot(t, e2), dot(y, e1), dot(y, e2), dot(n, e1), dot(n, e2)
    # velocity of the contact point v = O' - R w x n along t and y; its derivatives by the rates
    t3, t4, t5 = -R * dot(kth, y), -R * y[2], -R * dot(e, y)
    y3, y4, y5 = R * dot(kth, t), R * t[2], R * dot(e, t)
    turn = [
        (dot(kth, axis_of_turn), axis_of_turn[2], dot(e, axis_of_turn)) for axis_of_turn in (t, y, n)
    ]  # dw/dq' along t, y and n
    w = [dot(row, (dth, dph, dps)) for row in turn]
    v = rho * du + t3 * dth + t4 * dph + t5 * dps, dy + y3 * dth + y4 * dph + y5 * dps
    ft, fy, *torque = friction(scene, *v, *w)
    tau = [dot(torque, column) for column in zip(*turn, strict=True)]
    matrix = np.array(
        (
            (m * rho * rho, 0.0, -ma * rho * te1, -ma * rho * te2, 0.0, -ft * rho),
            (0.0, m, -ma * ye1, -ma * ye2, 0.0, -fy),
            (0.0, 0.0, -ma * ne1, -ma * ne2, 0.0, -1.0),
            (-ma * rho * te1, -ma * ye1, J, 0.0, 0.0, -ft * t3 - fy * y3 - tau[0]),
            (-ma * rho * te2, -ma * ye2, 0.0, J * st * st + I3 * ct * ct, I3 * ct, -ft * t4 - fy * y4 - tau[1]),
            (0.0, 0.0, 0.0, I3 * ct, I3, -ft * t5 - fy * y5 - tau[2]),
        )
    )
    bias = np.array(
        (
            -ma * rho * dot(t, bend) + mg * rho * dot(t, up),
            -ma * dot(y, bend),
            m * climb - ma * dot(n, bend) + mg * dot(n, up),
            -ma * climb * ne1 - J * dph * dph * st * ct + I3 * w3 * dph * st - mg * a * dot(up, e1),
            -ma * climb * ne2 + 2 * J * st * ct * dth * dph - I3 * st * dth * (w3 + ct * dph) - mg * a * dot(up, e2),
            -I3 * st * dth * dph,
        )
    )
    return np.linalg.solve(matrix, -bias)


def kinetic_potential(scene, q, dq, pole="z"):
    """T and U written out as in the heading, q = (u, y, d, theta, phi, psi); takes complex numbers too."""
    (u, _, d, th, ph, _), (du, dy, dd, dth, dph, dps) = q, dq
    st, ct, sp, cp = np.sin(th), np.cos(th), np.sin(ph), np.cos(ph)
    e, de = (st * cp, st * sp, ct), (ct * cp * dth - st * sp * dph, ct * sp * dth + st * cp * dph, -st * dth)
    e, de = np.roll(e, TURN[pole]), np.roll(de, TURN[pole])  # from the chart to the world
    height, dO = scene.radius + d, np.array((du, dy, dd))
    if scene.surface_radius is not None:
        rho, s, c = scene.surface_radius - scene.radius - d, np.sin(u), np.cos(u)
        height, dO = -rho * c, np.array((rho * du * c - dd * s, dy, rho * du * s + dd * c))
    ds = dO - scene.offset * de
    T = (scene.mass * (ds @ ds) + scene.I1 * (dth**2 + dph**2 * st**2) + scene.I3 * (dps + dph * ct) ** 2) / 2
    return T, scene.mass * scene.gravity * (height - scene.offset * e[2])


def lagrange_forces(scene, q, dq, ddq, pole="z"):
    """d(dL/dq')/dt - dL/dq straight from T and U, by complex steps: a check on `accelerations`."""

    def L(q, dq):
        return np.subtract(*kinetic_potential(scene, q, dq, pole))

    h, units, q, dq, ddq = 1e-30, np.eye(6), np.array(q), np.array(dq), np.array(ddq)
    q_ahead, rate = q + 1j * h * dq, dq + 1j * h * ddq
    momenta = [(L(q_ahead, rate + unit) - L(q_ahead, rate - unit)) / 2 for unit in units]  # exact: L is quadratic in q'
    return np.array([p.imag - L(q + 1j * h * unit, dq).imag for p, unit in zip(momenta, units, strict=True)]) / h


def energy(scene, state, pole="z"):
    """T + U [J] at an eight-number state (height zero: plane, or axis of the cylinder)."""
    q, dq = (state[0], 0.0, 0.0, *state[1:3], 0.0), (*state[3:5], 0.0, *state[5:])
    return sum(kinetic_potential(scene, q, dq, pole))


def in_angles(e, de, w3):
    """theta, phi and theta', phi', psi' from e, e' in the chart and the spin w3 about e."""
    th, ph = atan2(hypot(e[0], e[1]), e[2]), atan2(e[1], e[0])
    _, e1, e2, _ = axis(th, ph)
    dph = dot(de, e2) / sin(th) ** 2
    return (th, ph), (dot(de, e1), dph, w3 - dph * cos(th))


def start(scene, pole="z"):
    """State at launch: centre at rest, angular velocity = spin times e."""
    t, n, _, _ = arena(scene, scene.eta, pole)
    p, q = cos(scene.azimuth), sin(scene.azimuth)
    e = [
        cos(scene.theta) * c + sin(scene.theta) * (p * a + q * b)
        for a, b, c in zip(t, in_chart(Y, pole), n, strict=True)
    ]
    place, rate = in_angles(e, (0.0, 0.0, 0.0), scene.spin)
    return np.array((0.0 if scene.surface_radius is None else scene.eta, *place, 0.0, 0.0, *rate))


def best_chart(state, pole):
    """The same state in the chart whose pole is farthest from e: (state, pole)."""
    u, th, ph, du, dy, dth, dph, dps = state
    e, e1, e2, _ = axis(th, ph)
    inverse_chart = {"z": "z", "x": "y", "y": "x"}[pole]  # undoes the turn to this chart
    e, de = (
        in_chart(e, inverse_chart),
        in_chart(tuple(dth * p + dph * q for p, q in zip(e1, e2, strict=True)), inverse_chart),
    )
    pole = min("xyz", key=lambda new: abs(in_chart(e, new)[2]))
    place, rate = in_angles(in_chart(e, pole), in_chart(de, pole), dps + dph * cos(th))
    return np.array((u, *place, du, dy, *rate)), pole


def tilt(scene, state, pole="z"):
    """Angle [rad] from the local normal n to the stem."""
    t, n, _, _ = arena(scene, state[0], pole)
    e = axis(state[1], state[2])[0]
    return atan2(hypot(dot(t, e), dot(in_chart(Y, pole), e)), dot(n, e))


def gaps(scene, angle, state, pole):
    """What is left before theta = angle (as a difference of cosines) and before N = 0 (in weights)."""
    N = accelerations(scene, state.tolist(), pole)[5]
    return np.array((cos(tilt(scene, state, pole)) - cos(angle), N / (scene.mass * scene.gravity)))


def solver(scene, t0, state, t1, rtol, pole, first=None):
    """DOP853 with absolute tolerance rtol on the angles (phi may wind up) and rtol of sqrt(g/R) on the rates."""

    def rate(_, x):
        return np.concatenate((x[[3, 5, 6]], accelerations(scene, x.tolist(), pole)[:5]))

    swing = sqrt(max(scene.gravity, 1.0) / scene.radius)
    length = scene.radius if scene.surface_radius is None else 1.0  # u is a length or an angle
    absolute = rtol * np.array((length, 1.0, 1.0, swing * length, swing * scene.radius, swing, swing, swing))
    return DOP853(rate, t0, state, t1, rtol=np.array((3e-14,) * 3 + (rtol,) * 5), atol=absolute, first_step=first)


def crossing(gap, ends, run, state_at):
    """First fall of `gap` through zero in the last step of `run`, or inf. Bracketed on the dense output, then
    polished with `state_at`, which integrates anew from the start of the step: as accurate as the steps themselves."""
    dense, (times, piece) = run.dense_output(), np.linspace(run.t_old, run.t, SUBDIVISIONS + 1, retstep=True)
    values = [ends[0], *(gap(dense(t)) for t in times[1:-1]), ends[1]]
    k = next((k for k in range(1, SUBDIVISIONS + 1) if values[k] < -TOUCH), 0)
    if k == 0:
        return inf
    low, high = max(run.t_old, times[k - 1] - piece), min(run.t, times[k] + piece)
    if gap(state_at(low)) <= 0.0 or gap(state_at(high)) >= 0.0:  # no more than a touch away from here
        return float(times[k])
    return brentq(lambda t: gap(state_at(t)), low, high, xtol=1e-15, rtol=1e-15)


def follow(scene, t1, angle=0.95 * pi, rtol=1e-12, pole="x", closest=0.3):
    """Run from launch until theta reaches `angle`, N falls to zero, or t1 [s]. Returns (status, time [s], theta
    [rad], least gaps at the ends of the steps before that); the time is inf if there was no event by t1.
    The chart is changed when sin theta of the chart falls below `closest`."""
    state, names = start(scene, pole), ("inverted", "contact_lost")
    old = gaps_before = gaps(scene, angle, state, pole)
    if min(old) < -TOUCH:
        return names[int(old[0] >= -TOUCH)], 0.0, scene.theta, gaps_before

    def state_at(t):
        part = solver(scene, run.t_old, state, t, rtol, pole)
        while part.status == "running" and t > run.t_old:
            part.step()
        return part.y

    run = solver(scene, 0.0, state, t1, rtol, pole)
    while run.status == "running":
        run.step()
        if run.status == "failed" or not np.all(np.isfinite(run.y)):
            return "failed", run.t, tilt(scene, state, pole), gaps_before
        new = gaps(scene, angle, run.y, pole)
        times = [
            crossing(lambda x, k=k, pole=pole: gaps(scene, angle, x, pole)[k], (old[k], new[k]), run, state_at)
            if min(old[k], new[k]) < NEAR[k]
            else inf
            for k in (0, 1)
        ]
        time = min(times)
        if time < inf:
            return names[times.index(time)], time, tilt(scene, state_at(time), pole), gaps_before
        state, old, gaps_before = run.y, new, np.minimum(gaps_before, new)
        if sin(state[1]) < closest and run.status == "running":
            state, pole = best_chart(state, pole)
            run = solver(scene, run.t, state, t1, rtol, pole, min(run.step_size, t1 - run.t))
    return "not_inverted", inf, tilt(scene, state, pole), gaps_before


def inversion(scene, t1, angle=0.95 * pi, rtol=1e-12):
    """(status, time [s], theta [rad]); status: inverted, contact_lost, not_inverted or failed; time: inf if
    there was no event by t1; theta: angle from n to the stem at the end. scene: a Scene, or a dict of its fields."""
    return follow(Scene(**scene) if isinstance(scene, dict) else scene, t1, angle, rtol)[:3]
