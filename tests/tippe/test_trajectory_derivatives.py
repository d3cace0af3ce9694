"""Derivatives through `simulate`, and its end inside transformations: what a fit of a recording rests on."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe

TIMES = jnp.linspace(0.0, 0.5, 6)


def axis_x(theta, solver=None, adjoint=None):
    """A component of the axis that is at rest where theta = 0, half a second later."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
    run = tippe.simulate(scene, tippe.Launch(theta, 155.0), 0.5, times=TIMES, solver=solver, adjoint=adjoint)
    return run.axis[-1, 0]


def extrapolated(function, point, step):
    """A central difference, extrapolated from two steps."""
    fine_slope, coarse = ((function(point + h) - function(point - h)) / (2.0 * h) for h in (step, 2.0 * step))
    return (4.0 * fine_slope - coarse) / 3.0


@pytest.mark.slow
def test_an_upright_start_has_its_tangent_integrated_too():
    """At theta = 0 the state is a steady one, and steps judged by it alone outgrow what the tangent can bear."""

    def outside(theta):
        # Negative angles are the same axis on the other side.
        return np.sign(theta) * float(axis_x(abs(theta), adjoint=None))

    expected = extrapolated(outside, 0.0, 1e-3)
    for transform in (jax.grad, jax.jacfwd):
        assert_close(transform(axis_x)(0.0), expected, rtol=1e-6)


@pytest.mark.parametrize(
    "adjoint",
    [diffrax.RecursiveCheckpointAdjoint(), diffrax.ForwardMode()],
)
@pytest.mark.slow
def test_an_upright_start_by_diffrax(adjoint):
    transform = jax.jacfwd if isinstance(adjoint, diffrax.ForwardMode) else jax.grad
    assert_close(transform(lambda theta: axis_x(theta, adjoint=adjoint))(0.0), jax.grad(axis_x)(0.0), rtol=1e-6)


@pytest.mark.slow
def test_an_upright_start_by_another_solver():
    assert_close(jax.grad(lambda theta: axis_x(theta, solver=diffrax.Tsit5()))(0.0), jax.grad(axis_x)(0.0), rtol=1e-6)


def lost(spin, **options):
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
    times = jnp.linspace(0.0, 6.0, 301)
    return tippe.simulate(scene, tippe.Launch(0.1, spin), 6.0, times=times, **options)


def test_a_transformed_run_ends_where_the_contact_is_lost():
    run, reference_run = jax.jit(lambda spin: lost(spin, tolerance=1e-11))(200.0), lost(200.0, tolerance=1e-11)
    assert reference_run.status == "contact_lost"
    with pytest.raises(ValueError, match=r"times = \[6\] are all after the end of the run at .* \(contact_lost\)"):
        tippe.simulate(reference_run.scene, tippe.Launch(0.1, 200.0), 6.0, times=[6.0], tolerance=1e-11)
    assert run.status == 1
    assert_close(run.end_time, reference_run.end_time, rtol=5e-8)
    in_contact = np.isfinite(run.normal_force)
    assert in_contact.sum() == len(reference_run.t)
    assert np.all(run.normal_force[in_contact] > 0.0)
    assert_close(run.theta[in_contact], reference_run.theta, rtol=1e-6)


def test_the_loss_of_contact_moves_with_the_launch():
    """By the implicit function theorem at the guard, against a difference of runs outside of transformations."""
    expected = extrapolated(lambda spin: float(lost(spin).end_time), 200.0, 0.02)
    assert_close(jax.grad(lambda spin: lost(spin).end_time)(200.0), expected, rtol=1e-5)


def test_a_loss_that_leaves_out_what_is_not_a_number_has_a_gradient():
    """Samples after the end are not numbers; a loss that passes them over must not meet them on the way back."""

    def loss(spin):
        theta = lost(spin).theta
        return jnp.sum(jnp.where(jnp.isnan(theta), 0.0, (theta - 1.0) ** 2))

    assert jnp.isfinite(jax.grad(loss)(200.0))


def test_diffrax_ends_the_run_there_too():
    run = jax.jit(lambda spin: lost(spin, solver=diffrax.Tsit5(), tolerance=1e-8))(200.0)
    assert_close(run.end_time, lost(200.0).end_time, rtol=1e-6)


@pytest.mark.slow
def test_every_number_of_the_launch_and_some_of_the_scene():
    """Reverse mode by many numbers at once, in groups, against differences."""
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))

    @jax.jit
    def end(numbers):
        theta, spin, eta, mu, offset = numbers
        body = tippe.Top(scene.body.mass, scene.body.radius, offset, scene.body.I1, scene.body.I3)
        changed_scene = tippe.Scene(body, scene.surface, tippe.Viscous(mu))
        launch = tippe.Launch(theta, spin, eta)
        run = tippe.simulate(changed_scene, launch, 0.5, times=TIMES, tolerance=1e-11)
        return run.theta[3] + 10.0 * run.position[-1, 1] + run.spin_angle[2]

    point = jnp.array([0.2, 110.0, 0.3, 0.25, 0.005])
    gradient = jax.grad(end)(point)
    for k, size in enumerate(np.asarray(point)):
        expected = extrapolated(lambda value, k=k: float(end(point.at[k].set(value))), size, 3e-4 * size)
        assert_close(gradient[k], expected, rtol=2e-6)


@pytest.mark.slow
def test_later_samples_are_further_along():
    def angle(stretch):
        scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
        return tippe.simulate(scene, tippe.Launch(0.1, 155.0), 0.6, times=TIMES * stretch).theta[-1]

    assert_close(jax.grad(angle)(1.0), extrapolated(lambda s: float(angle(jnp.asarray(s))), 1.0, 1e-3), rtol=1e-5)


def thetas_of_a_top_that_starts_along_the_normal(theta=0.0, azimuth=0.0, mu=0.3, surface=None, eta=0.0):
    scene = tippe.Scene(rutstam_top(), surface or tippe.Plane(), tippe.Viscous(mu))
    times = jnp.array([0.0, 0.1, 0.5, 1.0, 2.0])
    return tippe.simulate(scene, tippe.Launch(theta, 155.0, eta, azimuth), 2.0, times=times).theta


@pytest.mark.slow
def test_theta_by_theta_at_the_pole_is_the_one_sided_derivative():
    """In all azimuths alike.

    The numbers are theta(t) / theta(0) of launches at 1e-4 to 1e-6 rad by SciPy's DOP853 at 1e-13, from Newton's and Euler's
    equations in the fixed frame.
    """
    by_theta = jax.jit(jax.vmap(jax.jacfwd(thetas_of_a_top_that_starts_along_the_normal), (None, 0)))
    slopes = by_theta(0.0, jnp.array([0.0, 1.0]))
    assert_close(slopes[0], slopes[1], rtol=1e-7)
    assert_close(slopes[0], [1.0, 0.6063867, 0.3341863, 0.3490659, 0.2998009], atol=1e-7)


@pytest.mark.slow
def test_theta_by_theta_at_the_pole_is_that_of_launches_beside_it_and_unknown_backward():
    """By mu, which does not move the axis, the derivative is 0."""
    slopes = jax.jit(jax.jacfwd(thetas_of_a_top_that_starts_along_the_normal))(0.0, 1.0)
    beside = thetas_of_a_top_that_starts_along_the_normal(1e-5, 1.0) / 1e-5
    assert_close(slopes, beside, rtol=3e-6)
    backward = jax.grad(
        lambda *numbers: thetas_of_a_top_that_starts_along_the_normal(numbers[0], 1.0, numbers[1])[-1], (0, 1)
    )
    by_theta, by_mu = backward(0.0, 0.3)
    assert np.isnan(by_theta)
    assert by_mu == 0.0


@pytest.mark.slow
def test_a_first_sample_at_the_pole_leaves_the_derivatives_of_the_others():
    """On a slope the axis leaves the normal: d theta / d mu of all samples together, backward, against a difference."""

    def total(mu):
        return jnp.sum(thetas_of_a_top_that_starts_along_the_normal(0.0, mu=mu, surface=tippe.Sphere(0.3), eta=0.5))

    expected = extrapolated(lambda mu: float(total(jnp.asarray(mu))), 0.3, 1e-3)
    assert_close(jax.grad(total)(0.3), expected, rtol=1e-6)
