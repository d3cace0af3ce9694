"""Tippe top by Lagrange's equations in Euler angles: a reference in plain NumPy and SciPy.

Units are SI throughout: kg, m, s, rad, N. Nothing is scaled.

Coordinates q = (u, y, d, theta, phi, psi)
  u      place of the sphere's centre O across the arena: x [m] on the plane z = 0; the angle eta [rad]
         from the lowest line inside a horizontal cylinder whose axis is y
  y      place of O along y [m]
  d      gap between sphere and arena [m]; released only to find the normal force, then d = d' = d'' = 0
  theta, phi, psi   Euler angles [rad] of the body in the FIXED frame: the axis (stem) is
         e = (sin theta cos phi, sin theta sin phi, cos theta) in the components of the chart, and psi
         turns about e. The polar axis of a chart is world "x", "y" or "z"; two charts have their
         poles at different places, so that running both guards against a passage close to one.

Velocity of O:  O' = rho u' t + y' y + d' n, with rho = 1, t = x, n = z on the plane, and
  rho = surface_radius - radius - d, t = (cos u, 0, sin u), n = (-sin u, 0, cos u) in the cylinder.
Centre of mass  s = O - a e.  Lagrangian  L = T - U,
  T = m |s'|^2 / 2 + I1 (theta'^2 + phi'^2 sin^2 theta) / 2 + I3 (psi' + phi' cos theta)^2 / 2,
  U = m g s_z.
Contact: the constraint d = 0 has the multiplier N (normal force). The friction force N f acts at the
contact point, whose velocity in the arena's tangent plane is v; its generalised force is N f . dv/dq'.
  viscous f = -mu v (mu in s/m);  Coulomb f = -mu v / sqrt(v^2 + slip_speed^2);  frictionless f = 0.
Lagrange's equations with d'' = 0 are six linear equations in (u'', y'', theta'', phi'', psi'', N).

u, theta, phi and the five rates are integrated; x, y and psi are cyclic (or absent) and are left out.
"""
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin, sqrt

import numpy as np
from scipy.integrate import DOP853
from scipy.optimize import brentq

Y = (0.0, 1.0, 0.0)
UP = (0.0, 0.0, 1.0)
TURN = {"z": 0, "x": 1, "y": 2}          # cyclic turn that takes the polar axis to the third place
NEAR_ANGLE, NEAR_LOSS = 0.1, 0.5         # closeness (in cos theta, in weights) at which a step is searched
SUBDIVISIONS = 8


@dataclass(frozen=True)
class Scene:
    """Top, arena, friction and start, in SI units; theta, eta and azimuth as seen from the normal n."""
    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    theta: float
    spin: float
    eta: float = 0.0
    azimuth: float = 0.0
    mu: float = 0.0                      # s/m if slip_speed is None, else a pure number
    slip_speed: float | None = None      # m/s; None: viscous
    surface_radius: float | None = None  # m; None: the plane
    gravity: float = 9.81


@dataclass(frozen=True)
class Outcome:
    """How a run ended, with the highest theta [rad] and lowest N [weights] met on the way."""
    status: str                          # inverted, contact_lost, not_inverted or failed
    time: float                          # s; inf if not inverted by t1
    theta: float                         # rad, angle from n to the stem at the end
    highest: float
    lowest: float


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def in_chart(vector, pole):
    """Components of a world vector in the chart with this polar axis."""
    k = TURN[pole]
    return vector[k:] + vector[:k]


def arena(scene, u, pole):
    """Tangent t and normal n at u, dO/du = rho t, and the turning rate k of t and n with u."""
    if scene.surface_radius is None:
        return in_chart((1.0, 0.0, 0.0), pole), in_chart(UP, pole), 1.0, 0.0
    c, s = cos(u), sin(u)
    return (in_chart((c, 0.0, s), pole), in_chart((-s, 0.0, c), pole),
            scene.surface_radius - scene.radius, 1.0)


def axis(theta, phi):
    """e, its derivatives by theta and phi, and its second derivative by theta and phi."""
    st, ct, sp, cp = sin(theta), cos(theta), sin(phi), cos(phi)
    return (st * cp, st * sp, ct), (ct * cp, ct * sp, -st), (-st * sp, st * cp, 0.0), (-ct * sp, ct * cp, 0.0)


def friction(scene, vt, vy):
    """Tangential force per unit normal force."""
    if scene.slip_speed is None:
        return -scene.mu * vt, -scene.mu * vy
    size = sqrt(vt * vt + vy * vy + scene.slip_speed ** 2)
    return -scene.mu * vt / size, -scene.mu * vy / size


def accelerations(scene, state, pole="z"):
    """(u'', y'', theta'', phi'', psi'', N) at state = (u, theta, phi, u', y', theta', phi', psi').

    Rows are Lagrange's equations of u, y, d, theta, phi, psi: (mass matrix) q'' + bias = N (1 for d, friction),
    where bias = d(dT/dq')/dt at q'' = 0, less dT/dq, plus dU/dq.
    """
    u, th, ph, du, dy, dth, dph, dps = state
    m, a, R, I3 = scene.mass, scene.offset, scene.radius, scene.I3
    t, n, rho, k = arena(scene, u, pole)
    y, up = in_chart(Y, pole), in_chart(UP, pole)
    e, e1, e2, e12 = axis(th, ph)
    st, ct = sin(th), cos(th)
    kth = (-sin(ph), cos(ph), 0.0)                                     # axis of theta'
    J = scene.I1 + m * a * a
    w3, ma, mg = dps + dph * ct, m * a, m * scene.gravity
    # e'' at theta'' = phi'' = 0: -e theta'^2 + 2 e12 theta' phi' + e22 phi'^2
    bend = (-e[0] * dth * dth + 2 * e12[0] * dth * dph - e[0] * dph * dph,
            -e[1] * dth * dth + 2 * e12[1] * dth * dph - e[1] * dph * dph, -e[2] * dth * dth)
    climb = k * rho * du * du                                          # O''.n at u'' = 0
    te1, te2, ye1, ye2 = dot(t, e1), dot(t, e2), dot(y, e1), dot(y, e2)
    ne1, ne2 = dot(n, e1), dot(n, e2)
    # velocity of the contact point v = O' - R w x n along t and y; its derivatives by the rates
    t3, t4, t5 = -R * dot(kth, y), -R * y[2], -R * dot(e, y)
    y3, y4, y5 = R * dot(kth, t), R * t[2], R * dot(e, t)
    ft, fy = friction(scene, rho * du + t3 * dth + t4 * dph + t5 * dps, dy + y3 * dth + y4 * dph + y5 * dps)
    matrix = np.array((
        (m * rho * rho, 0.0, -ma * rho * te1, -ma * rho * te2, 0.0, -ft * rho),
        (0.0, m, -ma * ye1, -ma * ye2, 0.0, -fy),
        (0.0, 0.0, -ma * ne1, -ma * ne2, 0.0, -1.0),
        (-ma * rho * te1, -ma * ye1, J, 0.0, 0.0, -ft * t3 - fy * y3),
        (-ma * rho * te2, -ma * ye2, 0.0, J * st * st + I3 * ct * ct, I3 * ct, -ft * t4 - fy * y4),
        (0.0, 0.0, 0.0, I3 * ct, I3, -ft * t5 - fy * y5)))
    bias = np.array((
        -ma * rho * dot(t, bend) + mg * rho * dot(t, up),
        -ma * dot(y, bend),
        m * climb - ma * dot(n, bend) + mg * dot(n, up),
        -ma * climb * ne1 - J * dph * dph * st * ct + I3 * w3 * dph * st - mg * a * dot(up, e1),
        -ma * climb * ne2 + 2 * J * st * ct * dth * dph - I3 * st * dth * (w3 + ct * dph) - mg * a * dot(up, e2),
        -I3 * st * dth * dph))
    return np.linalg.solve(matrix, -bias)


def kinetic_potential(scene, q, dq, pole="z"):
    """T and U written out as in the heading, q = (u, y, d, theta, phi, psi); takes complex numbers too."""
    u, _, d, th, ph, _ = q
    du, dy, dd, dth, dph, dps = dq
    st, ct, sp, cp = np.sin(th), np.cos(th), np.sin(ph), np.cos(ph)
    e = np.array((st * cp, st * sp, ct))
    de = np.array((ct * cp * dth - st * sp * dph, ct * sp * dth + st * cp * dph, -st * dth))
    back = 3 - TURN[pole]                                              # chart to world components
    e, de = np.roll(e, -back), np.roll(de, -back)
    if scene.surface_radius is None:
        height, dO = scene.radius + d, np.array((du, dy, dd))
    else:
        rho, s, c = scene.surface_radius - scene.radius - d, np.sin(u), np.cos(u)
        height, dO = -rho * c, np.array((rho * du * c - dd * s, dy, rho * du * s + dd * c))
    ds = dO - scene.offset * de
    T = (scene.mass * (ds @ ds) + scene.I1 * (dth ** 2 + dph ** 2 * st ** 2) + scene.I3 * (dps + dph * ct) ** 2) / 2
    return T, scene.mass * scene.gravity * (height - scene.offset * e[2])


def lagrange_forces(scene, q, dq, ddq, pole="z"):
    """d(dL/dq')/dt - dL/dq straight from T and U, by complex steps: a check on `accelerations`."""
    tiny, unit, q, dq, ddq = 1e-30, np.eye(6), np.array(q), np.array(dq), np.array(ddq)
    ahead, speed = q + 1j * tiny * dq, dq + 1j * tiny * ddq

    def along(k):
        # T is quadratic in q', so half the difference over +-unit is dT/dq' exactly
        return [kinetic_potential(scene, ahead, speed + sign * unit[k], pole)[0] for sign in (1, -1)]

    def slope(k):
        T, U = kinetic_potential(scene, q + 1j * tiny * unit[k], dq, pole)
        return (T - U).imag / tiny

    return np.array([(along(k)[0] - along(k)[1]).imag / (2 * tiny) - slope(k) for k in range(6)])


def energy(scene, state, pole="z"):
    """T + U [J] at an eight-number state (height zero: plane, or axis of the cylinder)."""
    u, th, ph, du, dy, dth, dph, dps = state
    return sum(kinetic_potential(scene, (u, 0.0, 0.0, th, ph, 0.0), (du, dy, 0.0, dth, dph, dps), pole))


def start(scene, pole="z"):
    """State at launch: centre at rest, angular velocity = spin times e."""
    t, n, _, _ = arena(scene, scene.eta, pole)
    y, c, s = in_chart(Y, pole), cos(scene.theta), sin(scene.theta)
    e = [c * n[i] + s * (cos(scene.azimuth) * t[i] + sin(scene.azimuth) * y[i]) for i in range(3)]
    place = 0.0 if scene.surface_radius is None else scene.eta
    return np.array((place, atan2(hypot(e[0], e[1]), e[2]), atan2(e[1], e[0]), 0.0, 0.0, 0.0, 0.0, scene.spin))


def tilt(scene, state, pole="z"):
    """Angle [rad] from the local normal n to the stem."""
    t, n, _, _ = arena(scene, state[0], pole)
    e = axis(state[1], state[2])[0]
    return atan2(hypot(dot(t, e), dot(in_chart(Y, pole), e)), dot(n, e))


def solver(scene, t0, state, t1, rtol, pole):
    """DOP853 with absolute tolerance rtol on the angles (phi may wind up) and rtol of sqrt(g/R) on the rates."""
    def rate(_, state):
        now = state.tolist()
        forward = accelerations(scene, now, pole)
        return np.array((now[3], now[5], now[6], *forward[:5]))

    swing = sqrt(max(scene.gravity, 1.0) / scene.radius)
    absolute = rtol * np.array((1.0, 1.0, 1.0, swing, swing * scene.radius, swing, swing, swing))
    if scene.surface_radius is None:
        absolute[[0, 3]] *= scene.radius
    relative = np.array((3e-14,) * 3 + (rtol,) * 5)
    return DOP853(rate, t0, state, t1, rtol=relative, atol=absolute)


def advance(scene, t0, state, t1, rtol, pole):
    """State at t1, by steps of the solver that end there exactly."""
    run = solver(scene, t0, state, t1, rtol, pole)
    while run.status == "running" and t1 > t0:
        run.step()
    return run.y


def events(scene, angle, pole):
    """The two functions that cross zero downwards: tilt still to go (as cosines), and N in weights."""
    weight, target = scene.mass * scene.gravity, cos(angle)
    return {"inverted": (lambda state: cos(tilt(scene, state, pole)) - target, NEAR_ANGLE),
            "contact_lost": (lambda state: accelerations(scene, state.tolist(), pole)[5] / weight, NEAR_LOSS)}


def crossing(gap, near, t0, state, ends, t1, dense, repeat):
    """First fall of `gap` through zero in the step (t0, t1]: bracket on the dense output, then polish by
    integrating afresh from the step's start, so that the time is as accurate as the steps themselves."""
    if min(ends) > near:
        return None
    times = np.linspace(t0, t1, SUBDIVISIONS + 1)
    values = [ends[0], *(gap(dense(t)) for t in times[1:-1]), ends[1]]
    for k in range(SUBDIVISIONS):
        if values[k + 1] < 0.0:
            low, high = max(t0, times[k] - 0.1 * (t1 - t0)), min(t1, times[k + 1] + 0.1 * (t1 - t0))
            if gap(repeat(low)) <= 0.0 or gap(repeat(high)) >= 0.0:    # a touch, or a start at zero
                return times[k] if values[k] <= 0.0 else times[k + 1]
            return brentq(lambda t: gap(repeat(t)), low, high, xtol=1e-15, rtol=1e-15)
    return None


def follow(scene, t1, angle=0.95 * pi, rtol=1e-12, pole="z"):
    """Run from launch until theta reaches `angle`, N falls to zero, or t1 [s]; returns an Outcome."""
    state, watch = start(scene, pole), events(scene, angle, pole)
    old = {name: gap(state) for name, (gap, _) in watch.items()}
    highest, lowest = scene.theta, old["contact_lost"]
    if scene.theta >= angle or lowest < -1e-9:
        return Outcome("inverted" if scene.theta >= angle else "contact_lost", 0.0, scene.theta, highest, lowest)
    run = solver(scene, 0.0, state, t1, rtol, pole)
    while run.status == "running":
        run.step()
        if run.status == "failed" or not np.all(np.isfinite(run.y)):
            return Outcome("failed", run.t, tilt(scene, state, pole), highest, lowest)
        new, dense, found = {name: gap(run.y) for name, (gap, _) in watch.items()}, None, []
        repeat = lambda t: advance(scene, run.t_old, state, t, rtol, pole)
        for name, (gap, near) in watch.items():
            if min(old[name], new[name]) <= near:
                dense = dense or run.dense_output()
                time = crossing(gap, near, run.t_old, state, (old[name], new[name]), run.t, dense, repeat)
                found += [] if time is None else [(time, name)]
        if found:
            time, name = min(found)
            return Outcome(name, float(time), tilt(scene, repeat(time), pole), highest, lowest)
        state, old = run.y, new
        highest, lowest = max(highest, tilt(scene, state, pole)), min(lowest, new["contact_lost"])
    return Outcome("not_inverted", float("inf"), tilt(scene, state, pole), highest, lowest)


def inversion(scene, t1, angle=0.95 * pi, rtol=1e-12, pole="z"):
    """(status, time [s], theta [rad]); scene: a Scene, or a dict of its fields."""
    outcome = follow(Scene(**scene) if isinstance(scene, dict) else scene, t1, angle, rtol, pole)
    return outcome.status, outcome.time, outcome.theta
