"""Derivatives through flights, impacts, stick and slip, against central differences whose step was scanned."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from test_hops import CASES, scene_of
from tops import rutstam_top

import tippe


def test_a_table_through_flights_and_impacts():
    """By spin and restitution, after some dozen flights: a difference in one is taken on both sides of the other.

    The steps are from the middle of a range over which the differences agree.
    """
    scene, arguments = scene_of(CASES[0], 0.1), {"theta": 0.1, "t1": 20.0, "angle": 1.9, "progress": False}
    step, mu_step, bounces = 1e-3, 1e-5, np.array([0.2, 0.3])
    # As many cells and the same axes as in `test_hops`: the programs are those.
    spins, axes = (
        [200.0 - step, 200.0 + step],
        {"scene.restitution": [b + d for b in bounces for d in (-mu_step, mu_step)]},
    )
    table_around = tippe.inversion_table(scene, spin=spins, axes=axes, tolerance=1e-11, **arguments)
    time = table_around.time.reshape(2, 2, 2)
    arguments |= {"spin": [200.0], "axes": {"scene.restitution": list(bounces)}, "solver": diffrax.Tsit5()}
    table = tippe.inversion_table(scene, tolerance=1e-9, sensitivities=["spin", "restitution"], **arguments)
    assert (table.status == "inverted").all()
    assert (table.hops > 20).all()
    assert (table.grazes == 0).all()
    assert_close(table.time_by_spin[0], (np.diff(time, axis=0) / (2.0 * step)).mean(axis=(0, 2)), rtol=1e-5)
    assert_close(table.time_by_restitution[0], (np.diff(time, axis=2) / (2.0 * mu_step)).mean(axis=(0, 2)), rtol=1e-4)


def scanned(function, value, steps):
    """Central differences, each extrapolated from two steps: the one that differs least from that of the next step."""
    estimates = []
    for step in steps:
        ends = [np.asarray(function(value + k * step)) for k in (-2, -1, 1, 2)]
        estimates.append((8.0 * (ends[2] - ends[1]) - (ends[3] - ends[0])) / (12.0 * step))
    estimates = np.array(estimates)
    index = np.argmin(np.abs(np.diff(estimates, axis=0)), axis=0)
    return np.take_along_axis(estimates, index[None], axis=0)[0]


def differences(scene, variable, value, step, **arguments):
    """Central differences of an inversion time by one number, for that step and four more, each a tenth of the last."""
    steps = step * 0.1 ** np.arange(5)
    points = value + np.outer(steps, (-2, -1, 1, 2)).ravel()
    arguments |= {"axes": {"scene.friction.mu": points}} if variable == "mu" else {variable: points}
    t = tippe.inversion_table(scene, tolerance=1e-12, progress=False, **arguments).time.reshape(-1, 4).T
    return (8.0 * (t[2] - t[1]) - (t[3] - t[0])) / (12.0 * steps)


@pytest.mark.slow
@pytest.mark.parametrize(("theta", "spin", "sticks"), [(0.35, 100.0, 1), (0.3, 126.0, 7), (0.3, 109.5, 28)])
def test_a_time_through_sticks_and_slips(theta, spin, sticks):
    """Tops in a cylinder that stick and slip until they reach 0.4 rad: the slopes by friction and by the launch."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.2), tippe.SetValuedCoulomb(0.1))
    arguments = {"theta": theta, "spin": [spin], "t1": 8.0, "angle": 0.4}
    names = ["spin", "friction.mu", "theta"]
    table = tippe.inversion_table(scene, sensitivities=names, tolerance=1e-10, progress=False, **arguments)
    assert table.sticks[0] >= sticks
    assert table.grazes[0] == 0
    slopes = {"spin": table.time_by_spin, "mu": table.time_by_mu, "theta": table.time_by_theta}
    at = {"spin": (spin, 1e-2), "mu": (0.1, 1e-4), "theta": (theta, 1e-4)}
    for name, slope in slopes.items():
        estimates = differences(scene, name, *at[name], **arguments)
        index = estimates[np.argmin(np.abs(np.diff(estimates)))]
        assert_close(np.ravel(slope)[0], index, rtol=2e-6)


@pytest.mark.slow
def test_samples_through_flights_and_impacts():
    """In contact, in the air and between impacts: what `simulate` gives inside a transformation, and how it varies."""
    scene, times = scene_of(CASES[0], 0.3), np.array([0.05, 4.0, 4.9, 4.95, 5.0, 5.05, 5.1, 5.2, 5.3])

    def observe(run):
        return jnp.stack([run.theta, run.distance[0], run.position[:, 0], run.spin_angle])

    def traced(spin):
        run = tippe.simulate(scene, tippe.Launch(0.1, spin), 5.3, times=times, tolerance=1e-10, solver=diffrax.Tsit5())
        return observe(run), (run.contact, run.status, run.stats["hops"])

    def simulate_spin(spin):
        return tippe.simulate(scene, tippe.Launch(0.1, spin), 5.3, times=times, tolerance=1e-12)

    samples, slopes, (contact, status, hops) = jax.jit(lambda spin: jax.jvp(traced, (spin,), (1.0,), has_aux=True))(
        200.0
    )
    reference_run = simulate_spin(200.0)
    np.testing.assert_array_equal(contact, reference_run.contact)
    assert set(reference_run.contact) == {-1, 0}
    assert status == 0
    assert hops == len(reference_run.hops)
    assert_close(samples, observe(reference_run), rtol=1e-6, atol=1e-8)
    expected = scanned(lambda spin: observe(simulate_spin(spin)), 200.0, [1e-2, 1e-3, 1e-4, 1e-5])
    sizes = np.max(np.abs(expected), axis=1, keepdims=True)
    assert np.max(np.abs(slopes - expected) / sizes) < 1e-4


@pytest.mark.slow
def test_a_time_inside_a_transformation():
    """`inversion_time` finds what a table finds, and the same derivative; second derivatives are refused."""

    def time(spin, restitution):
        scene, launch = scene_of(CASES[0], restitution), tippe.Launch(0.1, spin)
        return tippe.inversion_time(scene, launch, 20.0, 1.9, 1e-10, solver=diffrax.Tsit5())

    inversion_time, slopes = jax.jit(jax.value_and_grad(time, (0, 1)))(200.0, 0.3)
    table = tippe.inversion_table(
        scene_of(CASES[0], 0.3),
        theta=0.1,
        spin=200.0,
        t1=20.0,
        angle=1.9,
        tolerance=1e-10,
        solver=diffrax.Tsit5(),
        sensitivities=["spin", "restitution"],
    )
    assert_close(inversion_time, table.time, rtol=1e-8)
    assert_close(slopes, (table.time_by_spin, table.time_by_restitution), rtol=1e-5)
    with pytest.raises(ValueError, match="second derivatives do not exist through changes of mode"):
        jax.hessian(time)(200.0, 0.3)
