"""Rides: integrators, balance of energy, reports, gradients."""

import dataclasses
import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations

import stroller
from nonholonomic.integration import Settings, sample
from stroller import (
    Damping,
    ImplicitMidpoint,
    Launch,
    Plane,
    RollingResistance,
    Scene,
    Sphere,
    Spheroid,
    Stroller,
)
from stroller.runs.model import RideModel

BODY = Stroller(mass=1.7, wheelbase=0.7, inertia=0.4, steering_inertia=0.05)
FULL = Scene(BODY, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side="inside", fork="absolute")
LAUNCH = Launch((0.3, -0.6), 0.5, 1.5, 0.2, 0.1)


def push(t, motion):
    return 2.0 * jnp.cos(t) + 0.5 * motion.speed, 0.1 * jnp.sin(2.0 * t) - 0.2 * motion.steering


class Push(eqx.Module):
    """A constant force, a plain number."""

    force: float

    def __call__(self, t, motion):
        return self.force, 0.0 * t


def test_another_number_of_an_input_compiles_nothing_again():
    scene, launch = Scene(BODY), Launch((0.0, 0.0), 0.3, 2.0)
    first = stroller.simulate(scene, launch, 1.0, Push(1.7))
    np.testing.assert_allclose(first.speed[-1], 3.0, rtol=1e-9)
    assert compilations(lambda: stroller.simulate(scene, launch, 1.0, Push(3.4))) == 0


@pytest.fixture(scope="module")
def reference():
    return stroller.simulate(FULL, LAUNCH, 10.0, push, times=jnp.linspace(0.0, 10.0, 11), tolerance=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("side", "fork"), [("inside", "absolute"), ("outside", "relative")])
def test_midpoint_rule_balances_energy_to_round_off(side, fork):
    """In 20 000 steps with friction and drive, energy errs by less than 1e-11 J and constraints by 1e-12 m/s (10b)."""
    scene = Scene(BODY, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side=side, fork=fork)
    run = stroller.simulate(scene, LAUNCH, 200.0, push, solver=ImplicitMidpoint(0.01))
    assert int(run.stats.steps) == 20_000
    assert_exact_balance(run)


def assert_exact_balance(run):
    assert bool(run.stats.finished)
    assert float(jnp.max(jnp.abs(run.work))) > 1.0
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-11)
    np.testing.assert_allclose(run.constraint, 0.0, atol=1e-12)
    np.testing.assert_allclose(run.departure, 0.0, atol=2e-13)


def midpoint_ride(times, step):
    """A ride of 500 steps with 11 times, so that one program serves all."""
    run = stroller.simulate(FULL, LAUNCH, times[-1], push, times=times, solver=ImplicitMidpoint(step))
    assert int(run.stats.steps) == 500
    return run


def test_midpoint_rule_is_of_second_order_and_balances_energy(reference):
    """Halving the step divides the error by four; after 500 steps, energy and constraints hold up to round-off."""
    errors = []
    for step, end in ((0.02, 10.0), (0.01, 5.0)):
        run = midpoint_ride(np.linspace(0.0, end, 11), step)
        index = int(jnp.searchsorted(run.t, 3.0 - 1e-9))
        errors.append(float(jnp.linalg.norm(run.position[index] - reference.position[3])))
        assert_exact_balance(run)
    np.testing.assert_allclose(errors[0] / errors[1], 4.0, rtol=0.03)


def test_midpoint_steps_end_on_the_times_asked_for():
    times = [0.0, 0.333, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.98]
    assert [np.ceil(gap / 0.02 - 1e-9) for gap in np.diff(times)] == [17, 34, *[50] * 7, 99]
    run = midpoint_ride(times, 0.02)
    np.testing.assert_allclose(run.t, times, rtol=1e-15)
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-12)


@pytest.mark.slow
def test_a_batch_of_implicit_rides_compiles_without_a_complaint(capfd):
    """XLA's simplifier once reported an endless loop about `x | true` in a batch."""
    setting = jax.config.jax_enable_compilation_cache
    jax.config.update("jax_enable_compilation_cache", False)

    @jax.jit
    @jax.vmap
    def speed(speed):
        launch = dataclasses.replace(LAUNCH, speed=speed)
        return stroller.simulate(FULL, launch, 0.2, times=[0.2], solver=ImplicitMidpoint(0.1)).speed

    try:
        speeds = speed(jnp.array([1.0, 2.0]))
    finally:
        jax.config.update("jax_enable_compilation_cache", setting)
    assert capfd.readouterr().err == ""
    assert jnp.isfinite(speeds).all()


def test_a_ride_by_the_midpoint_rule_can_be_kept_on_disk():
    """JAX does not cache a program that calls back into Python, as Diffrax's checks of given steps do."""
    problem, grid = RideModel.of(FULL, LAUNCH, None).problem(None, None), jnp.linspace(0.0, 0.1, 3)
    settings = Settings(1e-9, ImplicitMidpoint(0.05))
    program = jax.make_jaxpr(lambda t1: sample(problem, None, t1, settings, grid=grid)[1])(0.1)
    program_of_times = jax.make_jaxpr(lambda t1: sample(problem, grid, t1, settings, grid=grid)[1])(0.1)
    assert "callback" not in str(program)
    assert "callback" in str(program_of_times)


def test_adaptive_energy_error_follows_the_tolerance():
    """Dopri8: the difference between energy and work decreases about as fast as the tolerance."""
    tolerances = np.array([1e-5, 1e-7, 1e-9, 1e-11])
    residuals = [energy_residual(tolerance) for tolerance in tolerances]
    order = np.polyfit(np.log(tolerances), np.log(residuals), 1)[0]
    assert 0.8 < order < 1.3
    assert residuals[-1] < 1e-9


def energy_residual(tolerance):
    """Largest difference [J] between energy and start plus work, after five and ten seconds."""
    run = stroller.simulate(FULL, LAUNCH, 10.0, push, times=[0.0, 5.0, 10.0], tolerance=tolerance)
    return float(jnp.max(jnp.abs(run.energy_residual)))


def test_energy_is_balanced_from_the_first_time_that_is_reported():
    """The balance excludes the work before the first reported time."""
    run = stroller.simulate(FULL, LAUNCH, 10.0, push, times=jnp.linspace(1.0, 10.0, 11), tolerance=1e-12)
    assert abs(float(run.work[0])) > 0.1
    np.testing.assert_allclose(run.energy_residual, 0.0, atol=1e-8)


def test_the_steering_angle_counts_on_beyond_a_turn_and_its_sine_and_cosine_follow():
    """A fork that spins freely, phi = phi0 + rate t: after 70 turns, errors are of the order of the tolerance."""
    scene = Scene(BODY, Spheroid(6.0, 3.0), side="inside")
    run = stroller.simulate(scene, Launch((0.0, -0.8), 0.3, 1.0, 0.2, 3.0), 150.0, times=[75.0, 150.0], tolerance=1e-10)
    np.testing.assert_allclose(run.steering, 0.2 + 3.0 * run.t, rtol=1e-12)
    sine, cosine = run.state[:, 9:11].T
    np.testing.assert_allclose(sine, np.sin(run.steering), atol=1e-8)
    np.testing.assert_allclose(cosine, np.cos(run.steering), atol=1e-8)
    # The observables use sine and cosine with their squares adding up to 1.
    np.testing.assert_allclose(run.speed, run.front_speed * np.cos(run.steering), atol=1e-8)


def test_any_diffrax_solver_will_do(reference):
    """Tsit5, with its own tolerance, ends at the same positions as Dopri8."""
    run = stroller.simulate(
        FULL, LAUNCH, 10.0, push, times=jnp.linspace(0.0, 10.0, 11), tolerance=1e-10, solver=diffrax.Tsit5()
    )
    np.testing.assert_allclose(run.position, reference.position, atol=1e-7)


def test_ports_and_power(reference):
    """Force times speed, and torque times steering rate, are the power."""
    force, torque = push(reference.t, reference)
    np.testing.assert_allclose(reference.power.drive, force * reference.speed, rtol=1e-14)
    np.testing.assert_allclose(reference.power.steering, torque * reference.steering_rate, rtol=1e-13)
    np.testing.assert_allclose(reference.power.rear, -0.3 * reference.speed**2, rtol=1e-14)
    np.testing.assert_allclose(reference.power.fork, -0.15 * reference.steering_rate**2, rtol=1e-14)
    assert reference.stats.finished


def test_runs_are_vmapped_and_scene_numbers_too():
    """`simulate` under `vmap` over speeds agrees with single runs."""
    speeds = jnp.array([0.5, 1.0, 1.5])

    def end(speed):
        launch = Launch((0.3, -0.6), 0.5, speed, 0.2, 0.1)
        return stroller.simulate(FULL, launch, 2.0, push, times=[2.0], tolerance=1e-10).position[0]

    batch = jax.jit(jax.vmap(end))(speeds)
    np.testing.assert_allclose(batch[1], end(1.0), atol=1e-9)


def central_difference(function, tree, leaf_of, scale):
    """Central difference of a function with respect to a number of a tree, at the step where it changes least."""
    steps = scale * np.array([3e-3, 1e-3, 3e-4, 1e-4])
    value = leaf_of(tree)
    slopes = []
    for h in steps:
        ends = [function(eqx.tree_at(leaf_of, tree, value + offset)) for offset in (-2 * h, -h, h, 2 * h)]
        slopes.append((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h))
    changes = [np.max(np.abs(a - b)) for a, b in itertools.pairwise(slopes)]
    return slopes[int(np.argmin(changes)) + 1]


NUMBERS = {
    "mass": lambda scene: scene.body.mass,
    "wheelbase": lambda scene: scene.body.wheelbase,
    "inertia": lambda scene: scene.body.inertia,
    "steering inertia": lambda scene: scene.body.steering_inertia,
    "steering spring": lambda scene: scene.body.steering_spring,
    "equatorial": lambda scene: scene.surface.equatorial,
    "polar": lambda scene: scene.surface.polar,
    "rolling": lambda scene: scene.friction.rolling,
    "front": lambda scene: scene.friction.front,
    "scrub": lambda scene: scene.friction.scrub,
    "steering": lambda scene: scene.friction.steering,
    "gravity": lambda scene: scene.gravity,
}


@pytest.fixture(scope="module")
def sensitivities():
    """A scene; the final position as a function of the scene; and the reverse-mode derivatives of this function."""
    body = Stroller(1.7, 0.7, 0.4, 0.05, steering_spring=0.3)
    scene = Scene(body, Spheroid(2.0, 1.1), Damping(0.3, 0.2, 0.1, 0.15), side="inside", fork="absolute")

    @jax.jit
    def end(scene):
        return stroller.simulate(scene, LAUNCH, 2.0, push, times=[2.0], tolerance=1e-13).position[0]

    return scene, end, jax.jit(jax.jacrev(end))(scene)


@pytest.mark.parametrize("name", NUMBERS)
def test_gradient_of_the_final_position(sensitivities, name):
    """Reverse mode agrees with central differences of fourth order for every number of the scene."""
    scene, end, gradient = sensitivities
    where = NUMBERS[name]
    expected = central_difference(end, scene, where, float(where(scene)))
    np.testing.assert_allclose(where(gradient), expected, rtol=1e-7, atol=1e-7 * np.max(np.abs(expected)))


def test_every_number_of_the_scene_has_its_gradient_tested(sensitivities):
    scene, _, _ = sensitivities
    assert len(jax.tree.leaves(scene)) == len(NUMBERS)


@pytest.mark.slow
def test_gradients_of_tilt_and_rolling_resistance_and_centre():
    """Forward mode agrees with central differences for the parameters that `FULL` does not have."""
    body = Stroller(1.7, 0.7, 0.9, 0.05, centre=0.3)
    scene = Scene(body, Plane(0.3), RollingResistance(0.05, 0.1))

    @jax.jit
    def end(scene):
        launch = Launch((0.3, -0.6), 0.5, 1.5, 0.2, 0.1)
        adjoint = diffrax.ForwardMode()
        return stroller.simulate(scene, launch, 1.0, times=[1.0], tolerance=1e-13, adjoint=adjoint).position[0]

    gradient = jax.jit(jax.jacfwd(end))(scene)
    for where in (
        lambda scene: scene.surface.tilt,
        lambda scene: scene.friction.coefficient,
        lambda scene: scene.friction.speed,
        lambda scene: scene.body.centre,
    ):
        expected = central_difference(end, scene, where, float(where(scene)))
        np.testing.assert_allclose(where(gradient), expected, rtol=1e-7, atol=1e-7 * np.max(np.abs(expected)))


def test_a_run_that_cannot_finish_says_so():
    run = stroller.simulate(FULL, LAUNCH, 10.0, push, max_steps=5)
    assert run.status == "failed"
    assert "failed" in str(run)


def test_a_function_that_is_defined_again_does_not_compile_again(reference, caplog):
    """An equal function with other numbers uses the same program."""

    def ride(strength):
        def push(t, motion):
            return strength * jnp.cos(t), -0.2 * motion.steering

        return stroller.simulate(FULL, LAUNCH, 1.0, push, times=[0.0, 1.0], tolerance=1e-6)

    first = ride(jnp.array(2.0))
    with jax.log_compiles():
        second_ride, third_ride = ride(jnp.array(2.0)), ride(jnp.array(3.0))
    assert not [text for text in caplog.messages if "Finished XLA compilation" in text]
    np.testing.assert_array_equal(second_ride.position, first.position)
    assert abs(float(third_ride.speed[1] - first.speed[1])) > 0.1


def test_what_happened_in_a_traced_ride_is_found_by_riding_again():
    """Traced and single rides over the top of a sphere lose contact at the same time."""
    scene, launch = Scene(BODY, Sphere(3.0)), Launch((0.0, 1.2), 0.5, 2.0)
    times = jnp.array([0.0, 1.0, 2.0])
    traced = jax.jit(lambda speed: stroller.simulate(scene, Launch(launch.place, 0.5, speed), 2.0, times=times))(2.0)
    single_run = stroller.simulate(scene, launch, 2.0, times=times)
    assert single_run.status == traced.status == "contact_lost"
    np.testing.assert_allclose(traced.contact_lost_at, single_run.contact_lost_at, rtol=1e-12)
    np.testing.assert_allclose(traced.position, single_run.position, atol=1e-8)


def test_trajectory_reads_well(reference):
    text = str(reference)
    for words in (
        "11 times, 0 s to 10 s: completed",
        "Launch(place=(",
        "energy",
        "residual",
        "normal force",
        "side forces",
        "no-slip",
    ):
        assert words in text
