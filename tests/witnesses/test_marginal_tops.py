"""Marginal standing tops on a cylinder: continuation against the eigenvalues, and known critical spins."""

import jax
import jax.numpy as jnp
import marginal_tops
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import tippe
from nonholonomic.integration.dense import sign_changes
from tippe import steady

SCENE = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 0.94 * 3.2e-6, 3.2e-6), friction=tippe.Viscous(0.3))
GRID = jnp.linspace(15.0, 75.0, 301)


@pytest.fixture(scope="module")
def critical_spins():
    """Spins at which the growth rate changes sign, by scanning and halving."""

    @jax.jit
    def growth(radius, sign, spins):
        scene = tippe.Scene(SCENE.body, tippe.Cylinder(radius), SCENE.friction)
        upright = jax.vmap(lambda spin: steady.growth_rate(steady.standing_matrix(scene, spin, False)))
        inverted = jax.vmap(lambda spin: steady.growth_rate(steady.standing_matrix(scene, spin, True)))
        return jnp.where(sign > 0.0, upright(spins), inverted(spins))

    def find(ratio, inverted=False):
        return sign_changes(lambda s: growth(0.02 * ratio, -1.0 if inverted else 1.0, s), GRID)

    return find


@pytest.fixture(scope="module")
def curves():
    return {inverted: marginal_tops.marginal_curve(SCENE, inverted) for inverted in (False, True)}


@pytest.mark.parametrize(
    ("ratio", "upright", "inverted"),
    [
        (5, 24.196, [38.8, 39.5, 44.1]),
        pytest.param(20, 26.739, [41.025], marks=pytest.mark.slow),
        pytest.param(1000, 27.393, [41.547], marks=pytest.mark.slow),
    ],
)
def test_critical_spins_of_a_standing_top_in_a_cylinder(critical_spins, ratio, upright, inverted):
    """rc / R = 5, 20, 1000, viscous 0.3 s/m, Rutstam's top (`tippe.md`, section 6)."""
    np.testing.assert_allclose(critical_spins(ratio), [upright], rtol=3e-5)
    np.testing.assert_allclose(critical_spins(ratio, inverted=True), inverted, rtol=2e-3)


@pytest.mark.parametrize("inverted", [False, True], ids=["upright", "inverted"])
def test_growth_vanishes_all_along_the_marginal_curve(curves, inverted):
    """From the plane's critical spin on, a pair of eigenvalues of the standing top is imaginary to 1e-6 of the spin."""
    curve = curves[inverted]
    plane = (steady.inverted_critical_spin if inverted else steady.upright_critical_spin)(SCENE)
    np.testing.assert_allclose(curve.spin[0], plane, rtol=1e-7)
    assert curve.ratio[-1] > 0.2
    for ratio, spin, frequency in zip(*curve, strict=True):
        scene = tippe.Scene(SCENE.body, tippe.Cylinder(0.02 / ratio), SCENE.friction)
        values = np.linalg.eigvals(np.asarray(steady.standing_matrix(scene, spin, inverted)))
        assert np.min(np.abs(values - 1j * frequency)) < 1e-6 * spin


def test_the_marginal_curve_meets_the_critical_spins_found_by_scanning(curves, critical_spins):
    """The curve, interpolated at rc / R = 10, is the sign change of the growth rate there."""
    for inverted in (False, True):
        curve = curves[inverted]
        on_curve = np.interp(0.1, curve.ratio, curve.spin)
        np.testing.assert_allclose(critical_spins(10, inverted), [on_curve], rtol=1e-5)


def test_an_inverted_top_in_a_narrow_cylinder_has_a_band_of_unstable_spins_that_begins_at_a_fold():
    """The two further critical spins at rc / R = 5 lie on one curve, which turns round at rc = 5.10 R."""
    curve = marginal_tops.marginal_curve(SCENE, True, start=(0.2, 39.49), largest_ratio=0.21, backwards=True, step=0.02)
    np.testing.assert_allclose(np.min(curve.ratio), 0.19596, rtol=3e-4)
    turn = np.argmin(curve.ratio)
    assert 0 < turn < len(curve.ratio) - 1
    assert curve.spin[0] < 39.5 < 44.1 < curve.spin[-1]
    np.testing.assert_allclose(np.interp(0.2, curve.ratio[turn:], curve.spin[turn:]), 44.102, rtol=1e-3)


def test_a_top_that_tumbles_steadily_on_the_plane_runs_down_in_a_cylinder():
    """Two seconds at theta = 1.2: its energy stays on the plane and falls in a cylinder of 20 R, where it must slip."""
    decreases = []
    for surface in (tippe.Plane(), tippe.Cylinder(0.4)):
        scene = tippe.Scene(SCENE.body, surface, SCENE.friction)
        state = steady.tumbling_state(SCENE, steady.tumbling(SCENE, 1.2))
        start = np.concatenate([np.asarray(state), np.asarray(scene.start(tippe.Launch(0.0, 0.0))[0])])
        rate = jax.jit(lambda y, scene=scene: scene.field(y))
        np.testing.assert_allclose(scene.slip_velocity(jnp.asarray(start)), 0.0, atol=1e-12)
        run = solve_ivp(
            lambda _, y, rate=rate: np.asarray(rate(y)), (0.0, 2.0), start, "DOP853", rtol=1e-10, atol=1e-13
        )
        energy = scene.energy(jnp.asarray(run.y))
        decreases.append((energy[0] - energy[-1]) / (SCENE.body.mass * SCENE.gravity * SCENE.body.offset))
    np.testing.assert_allclose(decreases[0], 0.0, atol=1e-8)
    assert decreases[1] > 1e-3


def test_a_top_without_a_critical_spin_has_no_marginal_curve_from_the_plane():
    """Group III never stands inverted."""
    scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 1.35 * 3.2e-6, 3.2e-6), friction=tippe.Viscous(0.3))
    with pytest.raises(ValueError, match="no critical spin"):
        marginal_tops.marginal_curve(scene, inverted=True)
