"""Launches at the ends of their range: statuses and derivatives, never a number that is not one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tops import rutstam_top

import tippe

#: Words that say why a run has no time.
NO_TIME = ("not_inverted", "contact_lost")

# These numbers are asked for on purpose.
pytestmark = [
    pytest.mark.filterwarnings("ignore:spin = .* was it in rpm"),
    pytest.mark.filterwarnings("ignore:theta = 0.0 is exactly upright"),
]


def test_a_top_that_stands_exactly_never_inverts_and_its_time_has_no_slope():
    """theta(0) = 0: infinite, and the derivatives by theta, spin and mu are 0, not NaN."""

    def time(theta, spin, mu):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu))
        return tippe.inversion_time(scene, tippe.Launch(theta, spin), 5.0)

    value, slopes = jax.value_and_grad(time, argnums=(0, 1, 2))(0.0, 155.0, 0.3)
    assert value == jnp.inf
    assert slopes == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("arena", [tippe.Plane(), tippe.Cylinder(0.3)])
def test_every_spin_and_inclination_has_a_status_and_finite_numbers(arena):
    """Spins from 0 to 1e4 rad/s of either sign, theta from 0 over 1e-300 to pi: a word, and an end that is a number."""
    theta, spin = [0.0, 1e-300, 1e-12, 0.1, np.pi / 2.0, 3.0, np.pi], [-1e4, -100.0, 0.0, 1e-3, 1.0, 100.0, 1e3, 1e4]
    table = tippe.inversion_table(tippe.Scene(rutstam_top(), arena, tippe.Viscous(0.3)), theta=theta, spin=spin, t1=1.0)
    assert set(np.unique(table.status)) <= {"inverted", *NO_TIME}
    assert np.isfinite(table.end_time).all()
    assert np.isfinite(table.end_theta).all()
    np.testing.assert_array_equal(np.isfinite(table.time), table.status == "inverted")
    # Beyond the angle from the start, and never reached without a spin.
    assert (table.time[-2:] == 0.0).all()
    assert np.isin(table.status[:5, 2], NO_TIME).all()
    if isinstance(arena, tippe.Plane):
        assert (table.end_theta[0] == 0.0).all()


def test_a_launch_that_is_not_nearly_upright_keeps_its_tolerances():
    """Errors across the normal count in proportion to the tilt below 0.01 rad only, and nothing else does."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    scales_inclined, scales_near, standing = (scene.scales(tippe.Launch(theta, 100.0)) for theta in (0.3, 1e-5, 0.0))
    np.testing.assert_array_equal(scales_inclined, standing)
    np.testing.assert_allclose((scales_near / scales_inclined)[np.array([0, 1, 2, 3, 5, 6])], 1e-3, rtol=1e-9)
    np.testing.assert_array_equal((scales_near / scales_inclined)[np.array([4, 7, 8, 9])], 1.0)
