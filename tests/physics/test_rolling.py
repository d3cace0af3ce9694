"""The rolling top: other formulations, constants of motion, closed forms, and the limit of ever greater friction."""

import euler_angles
import jax
import jax.numpy as jnp
import numpy as np
import poincare
import pytest
import quadrature
from close import assert_close
from other_formulations import Multipliers
from scipy.integrate import solve_ivp
from scipy.special import ellipk
from tops import homogeneous_ball, random_states, rutstam_top

import tippe
from tippe.friction import AbstractFriction, ContactLoad, Slip
from tippe.model.dynamics import RollingDynamics

ARENAS = [tippe.Plane(), tippe.Cylinder(0.1), tippe.Sphere(0.1)]


def rolling_top(arena, body=None) -> tuple[tippe.Scene, RollingDynamics]:
    """A scene and its rolling motion."""
    scene = tippe.Scene(rutstam_top() if body is None else body, arena)
    return scene, RollingDynamics(scene.frame, scene.body, scene.gravity)


def rolling_states(scene: tippe.Scene, rolling: RollingDynamics, count: int):
    """Random states whose slip a blow has stopped."""
    states = random_states(scene, count)
    return rolling.with_slip(states, Slip(jnp.zeros(count), jnp.zeros(count)))


def roll(rolling: RollingDynamics, start, t1: float, times):
    """States (components, times) of a rolling run, by SciPy."""
    field = jax.jit(lambda y: rolling.field(y))
    solution = solve_ivp(
        lambda _, y: np.asarray(field(y)), (0.0, t1), np.asarray(start), "DOP853", times, rtol=1e-12, atol=1e-15
    )
    assert solution.success
    return jnp.asarray(solution.y)


class Prescribed(AbstractFriction):
    """A force that does not depend on the slip."""

    force: tuple

    def per_normal_force(self, slip: Slip) -> ContactLoad:
        return ContactLoad(force=self.force)


@pytest.mark.parametrize("arena", ARENAS, ids=lambda arena: type(arena).__name__)
def test_the_reaction_is_the_force_that_keeps_the_contact_at_rest(arena):
    """The sliding equations under that force, found by the rolling ones, give the same rates and do not begin to slip."""
    scene, rolling = rolling_top(arena)
    states = rolling_states(scene, rolling, 20)
    assert jnp.max(jnp.abs(scene.slip_velocity(states))) < 1e-14
    motion = rolling.motion(states)
    forced = tippe.Scene(scene.body, arena, Prescribed(motion.friction.force))
    assert_close(forced.normal_force(states), motion.normal_force, rtol=1e-12)
    rates = rolling.field(states)
    assert_close(forced.field(states), rates, atol=1e-13 * float(jnp.max(jnp.abs(rates))))
    _, accelerations = jax.jvp(scene.slip_velocity, (states,), (rates,))
    assert jnp.max(jnp.abs(accelerations)) < 1e-12
    _, power = jax.jvp(scene.energy, (states,), (rates,))
    assert jnp.max(jnp.abs(power)) < 1e-14


def test_multipliers_give_the_same_accelerations():
    """Slip forbidden by multipliers in the papers' coordinates, in the cylinder; for the plane, see `quadrature` below."""
    scene, rolling = rolling_top(tippe.Cylinder(0.1))
    states = rolling_states(scene, rolling, 20).T

    @jax.jit
    @jax.vmap
    def accelerations_of(state):
        def chart(values):
            return euler_angles.from_vector_state(scene, values)

        angles, rates = jax.jvp(chart, (state,), (rolling.field(state),))
        system = poincare.TopSystem(scene, rolling=True)
        return rates[3:], Multipliers(system).acceleration(0.0, *poincare.from_angles(angles))

    rates_of_rolling, reference = accelerations_of(states)
    size = jnp.max(jnp.abs(reference), axis=1, keepdims=True)
    assert_close(rates_of_rolling / size, reference / size, atol=1e-11)


def test_a_blow_changes_the_slip_and_neither_jellett_nor_the_momentum_about_the_contact():
    scene, rolling = rolling_top(tippe.Plane())
    states = random_states(scene, 20)
    slipping_states = rolling.with_slip(states, Slip(jnp.full(20, 0.3), jnp.full(20, -0.2)))
    assert_close(scene.slip_velocity(slipping_states), np.repeat([[0.3], [-0.2]], 20, axis=1), atol=1e-14)
    assert_close(scene.jellett(slipping_states), scene.jellett(states), rtol=1e-12, atol=1e-20)
    slipping_state = rolling.with_slip(slipping_states, Slip(*scene.slip_velocity(states)))
    assert_close(slipping_state, states, atol=1e-14)
    resting_states = rolling.with_slip(states, Slip(jnp.zeros(20), jnp.zeros(20)))
    assert jnp.all(scene.energy(resting_states) < scene.energy(states))


def test_three_constants_and_the_quadrature_on_the_plane():
    """E, Jellett's lambda and Routh's D over 3 s, and theta(t) from them alone (tippe.md, section 5 d)."""
    scene, rolling = rolling_top(tippe.Plane())
    start = rolling.with_slip(scene.state(tippe.Launch(0.6, 60.0)), Slip(jnp.zeros(()), jnp.zeros(())))
    times = np.linspace(0.0, 3.0, 31)
    states = roll(rolling, start, 3.0, times)
    assert_close(scene.energy(states), scene.energy(start), rtol=1e-10)
    assert_close(scene.jellett(states), scene.jellett(start), rtol=1e-10)
    routh = scene.spin(states) * jnp.sqrt(quadrature.routh_factor(scene, states[4]))
    assert_close(routh, routh[0], rtol=1e-9)

    angular_velocity = (
        start[5:8] / scene.body.I1 + (1 / scene.body.I3 - 1 / scene.body.I1) * (start[2:5] @ start[5:8]) * (start[2:5])
    )
    nutation = quadrature.RollingNutation.of(scene, start[2:5], angular_velocity)
    swing = quadrature.swing(nutation, start[4], rolling.field(start)[4])
    assert np.ptp(np.asarray(scene.theta(states))) > 0.05
    assert_close(scene.theta(states), swing.theta(jnp.asarray(times)), atol=1e-9)


@pytest.mark.slow
def test_viscous_friction_without_bound_is_rolling():
    """The difference falls as 1 / mu (tippe.md, section 5 d)."""
    scene, rolling = rolling_top(tippe.Plane())
    start = rolling.with_slip(scene.state(tippe.Launch(0.6, 60.0)), Slip(jnp.zeros(()), jnp.zeros(())))
    end = roll(rolling, start, 0.3, [0.3])[:, 0]

    def distance(mu):
        viscous = tippe.Scene(scene.body, tippe.Plane(), tippe.Viscous(mu))
        field = jax.jit(lambda y: viscous.field(y))
        jacobian = jax.jit(jax.jacfwd(lambda y: viscous.field(y)))
        solution = solve_ivp(
            lambda _, y: np.asarray(field(y)),
            (0.0, 0.3),
            np.asarray(start),
            "Radau",
            rtol=1e-9,
            atol=1e-14,
            jac=lambda _, y: np.asarray(jacobian(y)),
        )
        return np.linalg.norm(solution.y[2:5, -1] - np.asarray(end[2:5]))

    errors = [distance(mu) for mu in (30.0, 300.0, 3000.0)]
    assert errors[2] < 1e-3
    assert 5.0 < errors[0] / errors[1] < 20.0
    assert 8.0 < errors[1] / errors[2] < 12.0


def test_a_ball_that_rolls_in_the_cylinder():
    """Period sqrt(7/5) of the sliding pendulum's; V_y = V_y0 cos(q D) - q R w_n0 sin(q D) (tippe.md, section 7, 4b)."""
    scene, rolling = rolling_top(tippe.Cylinder(0.2), homogeneous_ball())
    body, rho, amplitude, drilling, speed_along = scene.body, 0.18, 1.2, 7.0, 0.4
    R, inertia = body.radius, body.I1
    # At rest across, with V_y = R w1 along the axis and an angular velocity w_n about the normal.
    momentum = inertia * jnp.array([-speed_along / R, 0.0, drilling])
    place = (jnp.sin(amplitude), jnp.cos(amplitude))
    start = jnp.concatenate([jnp.array([0.0, speed_along, 0.0, 0.0, 1.0]), momentum, jnp.stack(place)])
    period = 4.0 * np.sqrt(1.4 * rho / 9.81) * ellipk(np.sin(amplitude / 2.0) ** 2)
    times = np.linspace(0.0, 1.0, 9) * period
    states = roll(rolling, start, period, times)
    assert_close(states[8, -1], start[8], atol=1e-9)
    angle = np.arctan2(np.asarray(states[8]), np.asarray(states[9])) - amplitude
    q = np.sqrt(2.0 / 7.0)
    expected = speed_along * np.cos(q * angle) - q * R * drilling * np.sin(q * angle)
    assert_close(states[1], expected, atol=1e-9)
