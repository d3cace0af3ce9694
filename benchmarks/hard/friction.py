"""Friction on a contact disc and rolling resistance: closed forms, balances and another formulation."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measure import timed
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import tippe
from hard.lagrange import theta_by_lagrange
from hard.limits import rutstam_top
from hard.row import Row, of_runs
from nonholonomic.integration import DenseSolution, Settings, follow
from tippe.friction import Slip
from tippe.modes.problems import trajectory_problem

GRAVITY = 9.81

#: A soft contact: the disc has a fortieth of the top's radius.
DISC = tippe.Contensou(mu=0.3, contact_radius=5e-4, slip_speed=0.05)
DISC_AND_LEVER = tippe.Rolling(resistance=2e-4, turning_speed=1.0, sliding=DISC)


def homogeneous_ball() -> tippe.Top:
    """A homogeneous ball: no offset, I = 2/5 m R^2."""
    return tippe.Top(0.1, 0.02, 0.0, 0.4 * 0.1 * 4e-4, 0.4 * 0.1 * 4e-4)


def hertz_disc(ratio: float, rings: int = 100, directions: int = 400) -> tuple[float, float]:
    """Force and torque of exact Coulomb friction on a disc under Hertz' pressure, by quadrature.

    **Arguments:** `ratio`: sliding velocity over drilling times the disc's radius.

    **Returns:** the force in units of mu N, and the torque in units of mu N and the radius.
    """
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    # r = sin(angle); the pressure is 3 / (2 pi) sqrt(1 - r^2).
    angle, weight = (nodes + 1.0) * math.pi / 4.0, weights * math.pi / 4.0
    weight = (3.0 * weight * np.cos(angle) ** 2 * np.sin(angle))[:, None] / directions
    angles = (np.arange(directions) + 0.5) * 2.0 * math.pi / directions
    x, y = np.sin(angle)[:, None] * np.cos(angles), np.sin(angle)[:, None] * np.sin(angles)
    speed = np.hypot(ratio - y, x)
    return float(np.sum(weight * (ratio - y) / speed)), float(np.sum(weight * (x * x - y * (ratio - y)) / speed))


def disc_by_quadrature() -> Row:
    """Departure of the ellipsoidal approximation from the exact disc, over four decades of sliding relative to drilling."""
    law, radius = tippe.Contensou(1.0, 0.01, 1e-12), 0.01

    def departure() -> float:
        max_error = 0.0
        for ratio in np.geomspace(1e-2, 1e2, 25):
            load = law.per_normal_force(Slip(jnp.asarray(ratio * radius), jnp.zeros(()), (0.0, 0.0, 1.0)))
            force, torque = hertz_disc(ratio)
            max_error = max(max_error, abs(float(load.force[0]) + force), abs(float(load.torque[2]) / radius + torque))
        return max_error

    run = timed(departure, 1)
    return Row(
        "Contensou's ellipsoid for a disc under Hertz' pressure",
        "departs by a tenth between its limits",
        run.result,
        0.12,
        "quadrature over the disc [mu N, mu N R_k]",
        0,
        run.cpu,
        "",
    )


def set_going(scene: tippe.Scene, launch: tippe.Launch, velocity: float, momentum: float, end: float) -> DenseSolution:
    """A run whose centre starts at a velocity along t1 and that has angular momentum about t2 [kg m^2/s]."""
    run = trajectory_problem((scene, launch))
    state = run.problem.states.at[0].set(velocity).at[6].add(momentum)
    run = eqx.tree_at(lambda run: run.problem.states, run, state)
    return follow(run, end, Settings(1e-12))


def ball_that_drills() -> Row:
    """A ball spinning on the spot: with q = Rb w / slip_speed, sqrt(1 + q^2) - arsinh(1 / q) falls at a constant rate.

    I w' = -mu m g Rb^2 w / sqrt(Rb^2 w^2 + slip_speed^2): far above the slip speed, w falls by mu m g Rb / I.
    """
    ball, law = homogeneous_ball(), tippe.Contensou(0.3, 2e-3, 1e-3)
    scene = tippe.Scene(ball, tippe.Plane(), law)
    lever, inertia = 3.0 * math.pi / 16.0 * 2e-3, float(ball.I3)
    rate = 0.3 * 0.1 * GRAVITY * lever / inertia
    end = 1.001 * 100.0 / rate

    def clock(spin: float) -> float:
        q = lever * spin / 1e-3
        return (math.sqrt(1.0 + q * q) - math.asinh(1.0 / q)) * 1e-3 / lever / rate

    run = timed(lambda: tippe.simulate(scene, tippe.Launch(0.0, 100.0), end, tolerance=1e-12), 1)
    spins = np.asarray(run.result.spin)
    expected = [brentq(lambda w, t=t: clock(w) - clock(100.0) + t, 1e-12, 100.0, xtol=1e-13) for t in run.result.t]
    return of_runs(
        "ball drilling on the spot to rest under Contensou friction",
        f"w falls linearly to {spins[-1]:.2f} rad/s, then fades",
        float(np.max(np.abs(spins - expected))),
        1e-11,
        "closed form [rad/s of 100]",
        run,
    )


def ball_that_rolls() -> Row:
    """A ball rolling against a lever delta: V' = -g delta m R / (I + m R^2), the slip (5/7) (delta / R) / mu after decay.

    V' = g f and I w' = m g (-R f - delta) give the slip v' = g (1 + m R^2 / I) f + g delta m R / I with f = -mu v.
    """
    delta, mu, start = 1e-3, 2.0, 1.0
    scene = tippe.Scene(homogeneous_ball(), tippe.Plane(), tippe.Rolling(delta, 1e-5, tippe.Viscous(mu)))
    momentum, end = float(scene.body.I1) * start / 0.02, 2.0
    run = timed(lambda: set_going(scene, tippe.Launch(0.7, 0.0), start, momentum, end), 1)
    steady, decay = 5.0 / 7.0 * delta / 0.02 / mu, 3.5 * mu * GRAVITY
    times, velocity = run.result.times, run.result.states[0]
    slip = steady * -np.expm1(-decay * times)
    # V = V(0) - mu g int v dt.
    expected = start - mu * GRAVITY * steady * (times + np.expm1(-decay * times) / decay)
    slip_velocity = np.asarray(scene.slip_velocity(jnp.asarray(run.result.states[:8])))[0]
    error = max(float(np.max(np.abs(velocity - expected))), float(np.max(np.abs(slip_velocity - slip))))
    return Row(
        "ball rolling against rolling resistance",
        f"slows by (5/7) g delta / R = {5.0 / 7.0 * GRAVITY * delta / 0.02:.3f} m/s^2",
        error,
        1e-12,
        "closed form, velocity and slip [m/s of 1]",
        run.result.accepted + run.result.rejected,
        run.cpu,
        "completed",
    )


def jellett_under_torque() -> Row:
    """dlambda/dt = N tau.(R n - a e): N tau_n (R - a cos(theta)) for drilling, less a N tau_t.e for rolling resistance."""
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), DISC_AND_LEVER)
    launch, times = tippe.Launch(0.1, 120.0), np.linspace(0.1, 2.0, 20)
    start = scene.state(launch)
    size, body = float(scene.jellett(start)), scene.body

    @jax.jit
    def rate(full_state: Any) -> Any:
        state = full_state[:8]
        e, L = state[2:5], state[5:8]
        w = L / body.I1 + (1.0 / body.I3 - 1.0 / body.I1) * (L @ e) * e
        slip = scene.slip_velocity(state)
        lever = 3.0 * math.pi / 16.0 * DISC.contact_radius
        drilling = -DISC.mu * lever**2 * w[2] / jnp.sqrt(slip @ slip + (lever * w[2]) ** 2 + DISC.slip_speed**2)
        rolling = -DISC_AND_LEVER.resistance * w[:2] / jnp.sqrt(w[:2] @ w[:2] + DISC_AND_LEVER.turning_speed**2)
        change = drilling * (body.radius - body.offset * e[2]) - body.offset * rolling @ e[:2]
        return jnp.append(scene.field(state), scene.normal_force(state) * change / size)

    scales = 1e-14 * np.append(np.asarray(scene.scales(launch)), 1.0)
    audit = solve_ivp(
        lambda _, y: np.asarray(rate(y)), (0.0, 2.0), jnp.append(start, 1.0), "DOP853", times, rtol=1e-13, atol=scales
    )
    run = timed(lambda: tippe.simulate(scene, launch, 2.0, times, tolerance=1e-12), 1)
    share = np.asarray(run.result.jellett) / size
    return of_runs(
        "Jellett's quantity under drilling and rolling resistance, 2 s",
        f"loses {100.0 * (1.0 - share[-1]):.1f} %",
        float(np.max(np.abs(share - audit.y[8]))) if share[-1] < 0.99 else math.nan,
        2e-11,
        "integral of N tau.(R n - a e) [lambda(0)]",
        run,
    )


def energy_under_torque() -> Row:
    """dE = integral of N (f.v_s + tau.w) dt in the cylinder."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), DISC_AND_LEVER)
    run = timed(lambda: tippe.simulate(scene, tippe.Launch(0.3, 100.0, eta=0.4), 2.0, tolerance=1e-12), 1)
    energy = np.asarray(run.result.energy)
    return of_runs(
        "energy in the cylinder under drilling and rolling resistance, 2 s",
        f"loses {100.0 * (1.0 - energy[-1] / energy[0]):.0f} %",
        run.result.stats["energy_residual"] / energy[0] if np.all(np.diff(energy) <= 0.0) else math.nan,
        5e-13,
        "work of force and torque [E(0)]",
        run,
    )


def torques_by_lagrange() -> Row:
    """A top thrown up the wall under both torques, by the vector form and by Lagrange's equations in Euler angles."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.2), DISC_AND_LEVER)
    launch, times = tippe.Launch(0.4, 80.0, eta=0.5, azimuth=1.0), np.linspace(0.1, 2.0, 20)
    run = timed(lambda: tippe.simulate(scene, launch, 2.0, times, tolerance=1e-12), 1)
    return of_runs(
        "theta(t) in the cylinder under drilling and rolling resistance, 2 s",
        f"theta comes to {float(run.result.theta[-1]):.3f} rad",
        float(np.max(np.abs(np.asarray(run.result.theta) - theta_by_lagrange(scene, launch, times)))),
        3e-10,
        "Lagrange in Euler angles [rad]",
        run,
    )


def rows() -> list[Callable[[], Row]]:
    """The rows of this file, in the order of the table."""
    return [
        disc_by_quadrature,
        ball_that_drills,
        ball_that_rolls,
        jellett_under_torque,
        energy_under_torque,
        torques_by_lagrange,
    ]
