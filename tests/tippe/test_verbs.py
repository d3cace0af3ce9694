"""Events of one's own, batches and exponents of tops whose runs have several modes."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import nonholonomic
import tippe

HOPPING = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.4)
STICKING = tippe.Scene(rutstam_top(), friction=tippe.SetValuedCoulomb(0.3))


@pytest.mark.slow
def test_an_angle_as_an_event_of_ones_own():
    """A top with integrated flights reaches an angle when a top with flights in closed form does."""
    launch = tippe.Launch(0.1, 280.0)
    own = nonholonomic.event_time(HOPPING, launch, 6.0, event=lambda t, motion: 1.2 - motion.theta, tolerance=1e-8)
    assert_close(own, tippe.inversion_time(HOPPING, launch, 6.0, angle=1.2, tolerance=1e-8), rtol=1e-6)


TIMES = np.array([0.1, 0.3])


def theta_of_sticking_top(spin, **options):
    run = tippe.simulate(STICKING, tippe.Launch(0.35, spin), 0.3, times=TIMES, tolerance=1e-9, **options)
    return run.theta


@pytest.mark.slow
def test_a_batch_of_tops_that_stick():
    """It is that of single runs."""
    thetas = jax.jit(jax.vmap(theta_of_sticking_top))(jnp.array([100.0, 101.0]))
    assert_close(thetas[0], theta_of_sticking_top(100.0), atol=1e-8)
    with pytest.raises(ValueError, match=r"adjoint = .* must be omitted for SetValuedCoulomb"):
        jax.eval_shape(lambda spin: theta_of_sticking_top(spin, adjoint=diffrax.ForwardMode()), 100.0)


@pytest.mark.slow
def test_the_slope_of_a_run_that_sticks():
    """It is that of a difference, through every change between slip and rolling."""
    thetas = jax.jit(jax.vmap(theta_of_sticking_top))(jnp.array([100.0 - 1e-3, 100.0 + 1e-3]))
    slope = jax.jit(lambda spin: jax.jvp(theta_of_sticking_top, (spin,), (1.0,))[1])(100.0)
    assert_close(slope, (thetas[1] - thetas[0]) / 2e-3, rtol=1e-4)


def test_tangents_pass_through_changes_of_mode():
    """Where no contact ends, the exponent with `contact="hybrid"` is that with `contact="stop"`: the rate of the rise."""
    launch = tippe.Launch(1e-3, 120.0)
    smooth = tippe.Scene(HOPPING.body, friction=HOPPING.friction)
    expected, exponent = (tippe.lyapunov_exponent(scene, launch, 4.0, tolerance=1e-7) for scene in (smooth, HOPPING))
    assert exponent.status == "completed"
    assert_close(exponent.exponent, expected.exponent, rtol=0.05)


def test_the_drift_of_jelletts_quantity_has_one_home():
    """In a run, at other times of it, and in a table; it is the error of the integration, and zero at the launch."""
    scene, times = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3)), np.array([0.0, 0.5, 1.0])
    run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), 1.0, times, tolerance=1e-8)
    assert_close(run.jellett_drift, run.jellett / run.jellett[0] - 1.0, atol=1e-15)
    assert_close(run.at([0.5]).jellett_drift, run.jellett_drift[1:2], atol=1e-16)
    names = ["jellett_drift", "jellett"]
    table = tippe.trajectory_table(scene, theta=0.1, spin=[155.0, 200.0], times=times, quantities=names, tolerance=1e-8)
    assert_close(table.jellett_drift, table.jellett / table.jellett[:, :1] - 1.0, atol=1e-15)
    assert 0.0 < np.max(np.abs(table.jellett_drift)) < 1e-9
