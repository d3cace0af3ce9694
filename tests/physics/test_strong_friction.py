"""Friction so strong that rigid bodies jam: impacts always end, and sliding ends where Coulomb's law has no answer."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from hop_reference import Case, contact, launch, rate, row
from impact_reference import Body, Law
from impact_reference import resolve_impact as reference_impact
from scipy.integrate import solve_ivp
from stems import jellett

import tippe
from tippe.model.dynamics import JAMMED, angular_velocity
from tippe.modes.impact import FreeBody, balls, resolve_impact

# Impacts

COUNT = 1000


class Falls(eqx.Module):
    """Random tops, every number an array (COUNT,), about to strike the plane."""

    body: tippe.Top
    friction: tippe.AbstractFriction
    axis: np.ndarray
    velocity: np.ndarray
    turning: np.ndarray
    restitution: np.ndarray

    @property
    def free(self) -> FreeBody:
        """The bodies before the impact."""
        axial = np.sum(self.turning * self.axis, axis=0)
        momentum = self.body.I1 * self.turning + (self.body.I3 - self.body.I1) * axial * self.axis
        vectors = (tuple(jnp.asarray(vector)) for vector in (self.velocity, self.axis, momentum))
        velocity, axis, momentum = vectors
        return FreeBody(velocity, self.body.radius - self.body.offset * axis[2], axis, momentum)


def random_falls(least_mu: float, most_mu: float) -> Falls:
    """Offsets to 0.9 R, any axis, slow and fast falls, spins of 100 rad/s, restitutions from 0 to 1."""
    random = np.random.default_rng(1)

    def between(low, high, log=False):
        return np.exp(random.uniform(np.log(low), np.log(high), COUNT)) if log else random.uniform(low, high, COUNT)

    mass, radius = between(1e-3, 1.0, log=True), between(5e-3, 0.1, log=True)
    I1 = mass * radius**2 * between(0.15, 0.6)
    body = tippe.Top(mass, radius, radius * between(0.0, 0.9), I1, I1 * between(0.5, 1.8))
    axis = random.normal(size=(3, COUNT))
    axis /= np.linalg.norm(axis, axis=0)
    horizontal = random.normal(scale=0.3, size=(2, COUNT))
    turning = random.normal(scale=30.0, size=(3, COUNT)) + random.normal(scale=100.0, size=COUNT) * axis
    friction = tippe.Coulomb(between(least_mu, most_mu), between(0.005, 0.1, log=True))
    velocity = np.stack([*horizontal, -between(0.05, 3.0, log=True)])
    return Falls(body, friction, axis, velocity, turning, random.choice([0.0, 0.3, 0.7, 1.0], COUNT))


impact_of = eqx.filter_jit(
    lambda impacts: resolve_impact(
        impacts.body, impacts.friction, balls(impacts.body)[0], impacts.free, impacts.restitution
    )
)


@pytest.mark.parametrize("mus", [(0.0, 1.0), (1.0, 5.0)])
def test_every_impact_ends(mus):
    """1000 at a time: none is given up; energy never grows, Jellett's quantity stays, nothing sinks into the plane."""
    impacts = random_falls(*mus)
    free_after, has_failed = impact_of(impacts)
    assert not np.asarray(has_failed).any()
    free, ball = impacts.free, balls(impacts.body)[0]
    energy_before = np.asarray(free.energy(impacts.body, 9.81))
    assert np.max(np.asarray(free_after.energy(impacts.body, 9.81)) / energy_before) < 1.0 + 1e-13
    size = np.asarray(impacts.body.radius) * np.linalg.norm(np.stack(free.momentum), axis=0)
    assert np.max(np.abs(np.asarray(jellett(ball, free_after) - jellett(ball, free))) / size) < 1e-13
    rebound, approach = (
        np.asarray(free_after.gap_rate(impacts.body, ball)),
        -np.asarray(free.gap_rate(impacts.body, ball)),
    )
    indices = approach > 0.0
    assert np.sum(indices) > 800
    assert np.all((rebound > -1e-13)[indices])
    assert np.all((rebound <= impacts.restitution * approach + 1e-13)[indices])
    assert_close(rebound[~indices], -approach[~indices], atol=1e-13)


def test_impacts_in_which_friction_pulls_down_first():
    """Against an independent program: also where the sphere is driven into the plane faster before it is pushed out."""
    impacts = random_falls(1.0, 5.0)
    free_after, _ = impact_of(impacts)
    velocity = np.stack(free_after.velocity)
    turning = np.stack(angular_velocity(impacts.body, free_after.axis, free_after.momentum))
    indices = np.flatnonzero(-np.asarray(impacts.free.gap_rate(impacts.body, balls(impacts.body)[0])) > 1e-3)
    count = 0
    for i in indices[:40]:
        body = Body(*(float(getattr(impacts.body, name)[i]) for name in Body._fields))
        law = float(impacts.friction.mu[i]), float(impacts.friction.slip_speed[i])
        motion = impacts.axis[:, i], impacts.velocity[:, i], impacts.turning[:, i]
        expected = reference_impact(body, *motion, Law(*law), impacts.restitution[i])
        speed = np.linalg.norm(motion[1]) + body.radius * np.linalg.norm(motion[2])
        # The greatest difference seen is 1e-11, of the reference's tolerance.
        assert_close(velocity[:, i], expected.velocity, atol=1e-9 * speed)
        assert_close(turning[:, i], expected.turning, atol=1e-9 * speed / body.radius)
        count += expected.least_painleve_factor < 0.0
    assert count >= 5


@pytest.mark.slow
def test_tables_go_through_such_impacts():
    """Inversion times behind them, mu = 0.8, against the reference of whole runs."""
    case = Case(0.02, 0.02, 0.016, 1.6e-6, 1.9e-6, 0.8, 1.5, 0.0, slip_speed=0.02, t1=0.4)
    scene = tippe.Scene(
        tippe.Top(0.02, 0.02, 0.016, 1.6e-6, 1.9e-6), friction=tippe.Coulomb(0.8, 0.02), contact="hybrid"
    )
    table = tippe.inversion_table(scene, theta=1.5, spin=[325.0, 350.0, 375.0], t1=0.4, tolerance=1e-11)
    assert list(table.status) == ["not_inverted", "inverted", "inverted"]
    for spin, time, hops in zip((350.0, 375.0), table.time[1:], table.hops[1:], strict=True):
        expected = row(Case(**{**case.__dict__, "spin": spin}))
        assert_close(time, float(expected["time"]), rtol=1e-10)
        assert hops == expected["flights"]


# Sliding

NUMBERS = (0.02, 0.02, 0.012858357968757133, 1.5903702885037918e-06, 2.4e-06)
MU, SLIP_SPEED, THETA, SPIN = 2.1886000603993936, 0.005, 1.144778063767833, 90.49142009506902


def jamming_scene(**options) -> tippe.Scene:
    """A top of great offset under strong friction."""
    return tippe.Scene(tippe.Top(*NUMBERS), friction=tippe.Coulomb(MU, SLIP_SPEED), **options)


def reference_jam(spin: float, slip_speed: float = SLIP_SPEED) -> tuple[float, float]:
    """When and at what theta 1/N vanishes: by Newton's and Euler's equations, with the normal impulse as the clock.

    In that clock nothing is singular: the time grows by 1/N, which passes through zero.
    """
    case = Case(*NUMBERS, MU, THETA, spin, slip_speed=slip_speed)
    start, number = launch(case)
    standing = [case.balls[number]]

    def softness(_, y):
        return 1.0 / contact(case, y[:-1], standing)[0][0]

    def rates(_, y):
        forces = softness(0.0, y)
        return np.append(rate(case, y[:-1], standing) * forces, forces)

    softness.terminal, softness.direction = True, -1.0
    y0 = np.append(start, 0.0)
    run = solve_ivp(rates, (0.0, 1.0), y0, method="DOP853", rtol=1e-12, atol=1e-14, events=softness)
    end = run.y_events[0][0]
    return end[-1], np.arccos(end[8])


def test_a_jam_is_where_the_normal_force_is_infinite():
    """The table ends at once with its own word, where an independent program sees 1/N vanish."""
    spins = [SPIN, 100.0]
    table = tippe.inversion_table(jamming_scene(), theta=THETA, spin=spins, t1=0.1, tolerance=1e-11)
    assert list(table.status) == ["jammed", "jammed"]
    assert np.isinf(table.time).all()
    assert (table.steps < 500).all()
    for spin, time, theta in zip(spins, table.end_time, table.end_theta, strict=True):
        exact = reference_jam(spin)
        # Located at a stiffness of `JAMMED`, which is early by the square of it, in units of 1e-4 s.
        assert_close(time, exact[0], rtol=1e-9)
        assert_close(theta, exact[1], rtol=1e-9)
        assert -1e-14 < exact[0] - time < 1e-3 * JAMMED**2


@pytest.mark.slow
def test_a_run_and_its_derivative_tell_of_the_jam():
    scene, exact = jamming_scene(), reference_jam(SPIN)
    run = tippe.simulate(scene, tippe.Launch(THETA, SPIN), t1=0.1)
    assert run.status == "jammed"
    assert "jammed at 0.019781 s" in str(run)
    assert_close(float(run.end_time), exact[0], rtol=1e-8)
    assert_close(float(run.theta[-1]), exact[1], rtol=1e-8)
    assert run.stats["energy_residual"] < 1e-9 * run.energy[0]
    time, slope = jax.value_and_grad(lambda spin: tippe.inversion_time(scene, tippe.Launch(THETA, spin), 0.1))(SPIN)
    assert time == np.inf
    assert slope == 0.0


@pytest.mark.slow
def test_every_road_tells_of_the_jam():
    """Hybrid runs and tables, Lyapunov exponents, and runs inside transformations."""
    scene, launch_ = jamming_scene(), tippe.Launch(THETA, SPIN)
    exact = reference_jam(SPIN)
    hybrid = jamming_scene(contact="hybrid")
    run = tippe.simulate(hybrid, launch_, t1=0.1)
    assert run.status == "jammed"
    assert_close(run.end_time, exact[0], rtol=1e-8)
    table = tippe.inversion_table(hybrid, theta=THETA, spin=[SPIN, 95.0, 100.0], t1=0.1)
    assert list(table.status) == 3 * ["jammed"]
    assert_close(table.end_time[0], exact[0], rtol=1e-8)

    exponents = tippe.lyapunov_exponent(scene, launch_, 0.1)
    assert exponents.status == "jammed"
    assert_close(float(exponents.end_time), exact[0], rtol=1e-8)

    def traced(spin):
        run = tippe.simulate(scene, tippe.Launch(THETA, spin), 0.1, times=[0.0, 0.01, 0.05])
        return run.status, run.theta

    status, theta = jax.jit(traced)(SPIN)
    assert status == 3
    np.testing.assert_array_equal(np.isfinite(theta), [True, True, False])


@pytest.mark.slow
def test_exact_coulomb_friction_jams_too():
    """While the top slips, as a slip speed of next to nothing has it."""
    scene = tippe.Scene(tippe.Top(*NUMBERS), friction=tippe.SetValuedCoulomb(MU))
    table = tippe.inversion_table(scene, theta=THETA, spin=SPIN, t1=0.1)
    assert table.status == "jammed"
    assert_close(float(table.end_time), reference_jam(SPIN, 1e-9)[0], rtol=1e-8)
