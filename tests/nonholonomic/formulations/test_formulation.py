"""The generic formulations on systems whose equations of motion are known in closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from other_formulations import ConstrainedConnection, Multipliers, ReducedBracket, Routhian, structure_constants

from nonholonomic.systems.mechanics import AbstractSystem, Hamel, Lagrange

LEVI_CIVITA = np.array([[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for j in range(3)] for i in range(3)])
ORIENTATION = jnp.array([0.4, 1.1, -0.7])


class HeavyTop(AbstractSystem):
    """A rigid body about a fixed point, in Euler angles (phi, theta, psi), z-x-z."""

    moments: jax.Array
    weight_moment: jax.Array
    damping: float = 0.0

    dimension = 3

    def body_rates(self, q):
        """Matrix A with Omega = A q' in the body's axes."""
        _, theta, psi = q
        return jnp.array(
            [
                [jnp.sin(theta) * jnp.sin(psi), jnp.cos(psi), 0.0],
                [jnp.sin(theta) * jnp.cos(psi), -jnp.sin(psi), 0.0],
                [jnp.cos(theta), 0.0, 1.0],
            ]
        )

    def metric(self, q):
        A = self.body_rates(q)
        return A.T @ (self.moments[:, None] * A)

    def potential(self, q):
        return self.weight_moment * jnp.cos(q[1])

    def frame(self, q):
        return jnp.linalg.inv(self.body_rates(q))

    def force(self, t, q, rate):
        return jnp.array([0.0, -self.damping * rate[1], 0.0])


class Sleigh(AbstractSystem):
    """Chaplygin's sleigh: a blade at (x, y) with the centre of mass a distance ahead of it, and a drag on the blade."""

    mass: float
    inertia: float
    ahead: float
    drag: float

    dimension = 3

    def metric(self, q):
        c, s, ma = jnp.cos(q[2]), jnp.sin(q[2]), self.mass * self.ahead
        turning = self.inertia + ma * self.ahead
        return jnp.array([[self.mass, 0.0, -ma * s], [0.0, self.mass, ma * c], [-ma * s, ma * c, turning]])

    def constraints(self, q):
        return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])

    def frame(self, q):
        c, s = jnp.cos(q[2]), jnp.sin(q[2])
        return jnp.array([[c, 0.0, -s], [s, 0.0, c], [0.0, 1.0, 0.0]])

    def force(self, t, q, rate):
        return -self.drag * jnp.array([rate[0], rate[1], 0.0])


TOP = HeavyTop(jnp.array([1.0, 2.3, 2.9]), jnp.array(0.0))
SLEIGH = Sleigh(mass=1.7, inertia=0.4, ahead=0.3, drag=0.2)
ALL = [Multipliers(SLEIGH), Lagrange(SLEIGH), Hamel(SLEIGH), ConstrainedConnection(SLEIGH), ReducedBracket(SLEIGH)]


def sleigh_motion(v=0.8, omega=1.3):
    """A legal state of the sleigh and its acceleration: v' = a omega^2 - c v/m, (I + m a^2) omega' = -m a v omega."""
    q, m, a = np.array([0.3, -0.2, 0.9]), SLEIGH.mass, SLEIGH.ahead
    along, across = np.array([np.cos(q[2]), np.sin(q[2]), 0.0]), np.array([-np.sin(q[2]), np.cos(q[2]), 0.0])
    spin = np.array([0.0, 0.0, 1.0])
    v_dot = a * omega**2 - SLEIGH.drag * v / m
    omega_dot = -m * a * v * omega / (SLEIGH.inertia + m * a**2)
    return q, v * along + omega * spin, v_dot * along + v * omega * across + omega_dot * spin


def test_structure_constants_of_the_body_frame_are_those_of_so3():
    """Left-invariant fields of SO(3): [E_i, E_j] = eps_ijk E_k."""
    constants = jax.jit(lambda q: structure_constants(TOP.frame, q))(ORIENTATION)
    np.testing.assert_allclose(np.moveaxis(constants, 0, 2), LEVI_CIVITA, atol=1e-14)


def test_free_rigid_body_obeys_euler():
    """A rigid body by F2 (`stroller.md`, section 6): Pi' = Pi x Omega."""
    omega = jnp.array([0.7, -1.1, 0.5])
    rate = jax.jit(lambda state: Hamel(TOP).field(0.0, state))(jnp.concatenate([ORIENTATION, omega]))[3:]
    np.testing.assert_allclose(TOP.moments * rate, np.cross(TOP.moments * omega, omega), atol=1e-14)


def test_routhian_of_the_heavy_top_gives_its_precession_and_nutation():
    """Eliminating the spin angle leaves phi'' and theta'' as the whole system has them, with a damping force too."""
    top = HeavyTop(jnp.array([1.2, 1.2, 0.5]), jnp.array(0.9), 0.3)
    rate = jnp.array([0.8, -0.4, 6.0])

    @jax.jit
    def by_both(q, rate):
        reduced = Routhian(top, cyclic=2, momentum=(top.metric(q) @ rate)[2])
        full_result = Hamel(top).acceleration(0.0, q, rate)[:2], rate, top.energy(q, rate)
        q, rate = q[:2], rate[:2]
        return full_result, (
            Hamel(reduced).acceleration(0.0, q, rate),
            reduced.complete(q, rate)[1],
            reduced.energy(q, rate),
        )

    (acceleration, rate, energy), (part, completed, reduced_energy) = by_both(ORIENTATION, rate)
    np.testing.assert_allclose(part, acceleration, rtol=1e-13)
    np.testing.assert_allclose(completed, rate, rtol=1e-14)
    np.testing.assert_allclose(reduced_energy, energy, rtol=1e-14)


@pytest.mark.parametrize("formulation", ALL, ids=lambda f: type(f).__name__)
def test_chaplygin_sleigh(formulation):
    """All formulations give the sleigh's equations, and carry coordinates, velocity and energy back and forth."""
    q, rate, expected = sleigh_motion()

    @jax.jit
    def computed(q, rate):
        state = formulation.state(q, rate)
        acceleration = formulation.acceleration(0.0, q, rate)
        return state, formulation.split(state)[1], acceleration, formulation.system.energy(*formulation.split(state))

    state, velocity, acceleration, energy = computed(q, rate)
    assert state.size == (6 if isinstance(formulation, (Multipliers, Lagrange, ConstrainedConnection)) else 5)
    np.testing.assert_allclose(velocity, rate, rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(acceleration, expected, rtol=1e-13, atol=1e-14)
    a = SLEIGH.ahead
    kinetic = 0.5 * SLEIGH.mass * 0.8**2 + 0.5 * (SLEIGH.inertia + SLEIGH.mass * a**2) * 1.3**2
    np.testing.assert_allclose(energy, kinetic, rtol=1e-14)


def test_multiplier_is_the_blade_force():
    """The side force on the blade is m (v omega + a omega')."""
    q, rate, acceleration = sleigh_motion()
    force = jax.jit(lambda q, rate: Multipliers(SLEIGH).multipliers(0.0, q, rate))(q, rate)
    expected = SLEIGH.mass * (0.8 * 1.3 + SLEIGH.ahead * acceleration[2])
    np.testing.assert_allclose(force, [expected], rtol=1e-13)


def test_constrained_connection_coefficients_of_the_sleigh():
    """nabla_{X2} X2 = -a X1 and nabla_{X2} X1 = m a / (I + m a^2) X2 up to the symmetric part that geodesics see."""
    q, _, _ = sleigh_motion()
    gamma = jax.jit(lambda q: ConstrainedConnection(SLEIGH).coefficients(q))(q)
    np.testing.assert_allclose(gamma[0, 1, 1], -SLEIGH.ahead, rtol=1e-13)
    expected = SLEIGH.mass * SLEIGH.ahead / (SLEIGH.inertia + SLEIGH.mass * SLEIGH.ahead**2)
    np.testing.assert_allclose(gamma[1, 0, 1] + gamma[1, 1, 0], expected, rtol=1e-13)


def test_velocity_that_violates_a_constraint_is_projected_with_a_warning():
    q, rate, _ = sleigh_motion()
    skid = rate + 0.1 * SLEIGH.constraints(q)[0]
    with pytest.warns(UserWarning, match=r"violates the constraints by .* projected"):
        state = Multipliers(SLEIGH).state(q, skid)
    _, velocity = Multipliers(SLEIGH).split(state)
    np.testing.assert_allclose(SLEIGH.constraints(q) @ velocity, 0.0, atol=1e-15)


def test_drift_is_kept_damped_or_ignored():
    """W q' is constant with multipliers alone, decays at Baumgarte's rate, or is removed by projection."""
    q, rate, _ = sleigh_motion()
    skid = rate + 0.1 * SLEIGH.constraints(q)[0]
    state = jnp.concatenate([q, SLEIGH.metric(q) @ skid])

    def violation_rate(formulation):
        def violation(state):
            q, rate = formulation.split(state)
            return SLEIGH.constraints(q) @ rate

        return jax.jvp(violation, (state,), (formulation.field(0.0, state),))

    # A rate of 0 and one of 10 share a program.
    rates = eqx.filter_jit(violation_rate)
    np.testing.assert_allclose(rates(Multipliers(SLEIGH)), [[0.1], [0.0]], atol=1e-14)
    np.testing.assert_allclose(rates(Multipliers(SLEIGH, baumgarte=10.0)), [[0.1], [-1.0]], atol=1e-14)
    np.testing.assert_allclose(rates(Multipliers(SLEIGH, project=True)), [[0.0], [0.0]], atol=1e-14)


def test_negative_baumgarte_rate_is_refused():
    with pytest.raises(ValueError, match=r"baumgarte = -1\.0 must be at least 0\.0"):
        Multipliers(SLEIGH, baumgarte=-1.0)


def test_formulations_serve_many_states():
    """vmap over states, and a gradient through the data: d(v')/d(ahead) = omega^2."""
    q, rate, expected = sleigh_motion()
    batch = jax.jit(jax.vmap(lambda q, rate: Hamel(SLEIGH).acceleration(0.0, q, rate)))(
        np.stack([q, q]), np.stack([rate, rate])
    )
    np.testing.assert_allclose(batch, np.stack([expected, expected]), rtol=1e-13)

    def forward(ahead):
        sleigh = eqx.tree_at(lambda s: s.ahead, SLEIGH, ahead)
        return Multipliers(sleigh).acceleration(0.0, q, rate) @ np.array([np.cos(q[2]), np.sin(q[2]), 0.0])

    np.testing.assert_allclose(jax.jit(jax.grad(forward))(SLEIGH.ahead), 1.3**2, rtol=1e-12)
