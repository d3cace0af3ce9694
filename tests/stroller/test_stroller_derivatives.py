"""Derivatives through `stroller.simulate` where steering or its rate is at rest, as at the default launch."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stroller
from stroller import Damping, Launch, Scene, Steady, Stroller

DAMPED = Scene(Stroller(12.0, 0.7, 1.5, 0.05), friction=Damping(2.0, 1.0, 0.2, 0.2))


def sideways(torque, scene=DAMPED, steering=0.0, t1=10.0, **options):
    launch = Launch((0.0, 0.0), 0.3, 2.0, steering)
    ride = stroller.simulate(scene, launch, t1, input=Steady(1.0, torque), times=[t1], **options)
    return ride.position[-1, 1]


def extrapolated(function, value, step):
    """A central difference, extrapolated from two steps."""
    fine_slope, coarse = ((function(value + h) - function(value - h)) / (2.0 * h) for h in (step, 2.0 * step))
    return (4.0 * fine_slope - coarse) / 3.0


def test_a_torque_on_a_steering_at_rest():
    expected = extrapolated(sideways, 0.0, 1e-4)
    assert abs(expected - 599.1) < 0.1
    for transform in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(transform(sideways))(0.0), expected, rtol=1e-6)


@pytest.mark.parametrize("steering", [0.0, 0.3])
def test_a_strongly_damped_steering(steering):
    scene = Scene(DAMPED.body, friction=Damping(2.0, 1.0, 0.2, 0.5))

    def end(torque):
        return sideways(torque, scene, steering, 5.0)

    np.testing.assert_allclose(jax.grad(end)(0.0), extrapolated(end, 0.0, 1e-4), rtol=1e-6)


@pytest.mark.slow
def test_a_sprung_steering_in_the_middle():
    scene = Scene(Stroller(10.0, 0.7, 1.0, 0.01, steering_spring=20.0), friction=Damping(0.5, 0.0, 0.0, 0.01))

    def angle(steering):
        return stroller.simulate(scene, Launch((0.0, 0.0), 0.0, 1.0, steering), 3.0, times=[3.0]).steering[-1]

    np.testing.assert_allclose(jax.grad(angle)(0.0), extrapolated(angle, 0.0, 1e-3), rtol=1e-5)


@pytest.mark.slow
def test_diffrax_differentiates_with_a_probe():
    adjoint = diffrax.RecursiveCheckpointAdjoint()
    gradient = jax.grad(lambda torque: sideways(torque, adjoint=adjoint))(0.0)
    np.testing.assert_allclose(gradient, jax.grad(sideways)(0.0), rtol=1e-6)


@pytest.mark.slow
def test_a_function_that_holds_the_number():
    def end(torque):
        launch = Launch((0.0, 0.0), 0.3, 2.0)
        ride = stroller.simulate(DAMPED, launch, 10.0, input=lambda t, motion: (1.0, torque), times=[10.0])
        return ride.position[-1, 1]

    np.testing.assert_allclose(jax.grad(end)(0.0), jax.grad(sideways)(0.0), rtol=1e-8)


class Steps(eqx.Module):
    """Steering torques of an array, smoothly one after the other."""

    torques: jax.Array

    def __call__(self, t, motion):
        moments = jnp.linspace(0.0, 10.0, self.torques.size)
        weights = jnp.exp(-((jnp.asarray(t)[..., None] - moments) ** 2))
        return 1.0, jnp.sum(weights * self.torques, axis=-1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "as_input",
    [lambda steps: steps, lambda steps: lambda t, motion: steps(t, motion)],
    ids=["module", "function"],
)
def test_arrays_in_the_inputs_of_a_batch_have_the_slopes_of_their_own_rides(as_input):
    """A module with an array, and a function that holds one: as a batch like ride by ride, and as differences."""

    def end(torques, speed):
        launch = Launch((0.0, 0.0), 0.3, speed)
        ride = stroller.simulate(DAMPED, launch, 2.0, input=as_input(Steps(torques)), times=[1.0, 2.0], tolerance=1e-10)
        return jnp.sum(ride.position[:, 1]) + ride.steering[-1]

    torques, speeds = jnp.linspace(-0.1, 0.1, 12).reshape(3, 4), jnp.array([1.0, 2.0, 3.0])
    ends = jax.jit(jax.vmap(end))
    gradients = jax.jit(jax.vmap(jax.grad(end)))(torques, speeds)
    for k in range(4):
        expected = extrapolated(lambda value, k=k: ends(torques.at[:, k].add(value), speeds), 0.0, 1e-3)
        np.testing.assert_allclose(gradients[:, k], expected, rtol=1e-7, atol=1e-10)


class Network(eqx.Module):
    """A network with 303 weights, too many to be written out number by number."""

    layers: tuple[jax.Array, ...]

    def __call__(self, t, motion):
        inner, outer = self.layers
        force, torque = outer @ jnp.tanh(inner @ jnp.stack([jnp.sin(t), motion.speed, motion.steering]))[:2]
        return 1.0 + force, torque


def test_the_weights_of_a_network_have_slopes():
    """Of a batch, through a function that holds them."""
    random = np.random.default_rng(0)
    weights = tuple(jnp.asarray(random.normal(size=(2, *shape))) for shape in ((99, 3), (2, 2)))

    def end(weights):
        launch = Launch((0.0, 0.0), 0.3, 1.0)
        drive = Network(weights)
        options = {"input": lambda t, motion: drive(t, motion), "times": [0.5, 1.0], "tolerance": 1e-10}
        ride = stroller.simulate(DAMPED, launch, 1.0, **options)
        return jnp.sum(ride.position[:, 1])

    ends, gradients = jax.jit(jax.vmap(end)), jax.jit(jax.vmap(jax.grad(end)))(weights)
    for layer, entry in ((0, (1, 2)), (1, (1, 0))):

        def moved(value, layer=layer, entry=entry):
            return ends(tuple(w.at[:, *entry].add(value) if k == layer else w for k, w in enumerate(weights)))

        np.testing.assert_allclose(gradients[layer][:, *entry], extrapolated(moved, 0.0, 1e-3), rtol=1e-7)


@pytest.mark.slow
def test_an_array_in_the_input_has_a_slope_for_each_entry():
    def end(torques):
        ride = stroller.simulate(DAMPED, Launch((0.0, 0.0), 0.3, 2.0), 10.0, input=Steps(torques), times=[5.0, 10.0])
        return jnp.sum(ride.steering)

    gradient = jax.jit(jax.grad(end))(jnp.zeros(6))
    end = jax.jit(end)
    for k in (0, 4):
        expected = extrapolated(lambda value, k=k: float(end(jnp.zeros(6).at[k].set(value))), 0.0, 1e-4)
        np.testing.assert_allclose(gradient[k], expected, rtol=1e-6)


@pytest.mark.slow
def test_random_rides_with_components_at_rest():
    """Steering, its rate, both or neither at rest, stiff and soft forks: gradients by every number against differences."""
    random = np.random.default_rng(3)
    count = 8
    low = np.array([5.0, 0.5, 0.5, 0.01, 0.5, 0.0, 0.1, 0.02])
    high = np.array([15.0, 1.0, 2.0, 0.1, 2.0, 1.0, 0.5, 0.5])
    numbers = random.uniform(low, high, (count, 8))
    steering = np.where(np.arange(count) % 2, random.uniform(-0.4, 0.4, count), 0.0)
    rate = np.where(np.arange(count) % 4 > 1, random.uniform(-0.3, 0.3, count), 0.0)
    points = jnp.asarray(np.column_stack([numbers, steering, rate, np.zeros(count)]))

    def end(point):
        mass, length, inertia, fork, *damping = point[:8]
        scene = Scene(Stroller(mass, length, inertia, fork), friction=Damping(*damping))
        launch = Launch((0.0, 0.0), 0.3, 2.0, point[8], point[9])
        ride = stroller.simulate(scene, launch, 4.0, input=Steady(1.0, point[10]), times=[4.0], tolerance=1e-11)
        return ride.position[-1, 1]

    gradients = jax.jit(jax.vmap(jax.grad(end)))(points)
    ends = jax.jit(jax.vmap(end))
    sizes = np.where(points == 0.0, 1.0, np.abs(points))
    for k in (0, 3, 7, 8, 9, 10):
        step = 1e-4 * sizes[:, k]
        fine_slope, coarse = (
            (ends(points.at[:, k].add(h)) - ends(points.at[:, k].add(-h))) / (2.0 * h) for h in (step, 2.0 * step)
        )
        scale = np.max(np.abs(gradients), axis=1)
        error = np.abs(gradients[:, k] - (4.0 * fine_slope - coarse) / 3.0)
        assert np.all(error < 1e-6 * scale / sizes[:, k].clip(max=1.0)), (k, error / scale)


@pytest.mark.parametrize(
    ("transform", "options"),
    [(jax.grad, {}), (jax.jacfwd, {"adjoint": diffrax.ForwardMode()})],
)
@pytest.mark.slow
def test_the_midpoint_rule_is_differentiated_by_either_way(transform, options):
    """Its steps have a given length, whoever differentiates them."""

    def end(torque, **extra_options):
        return sideways(torque, t1=1.0, solver=stroller.ImplicitMidpoint(0.1), **extra_options)

    derivative = transform(lambda torque: end(torque, **options))(0.1)
    np.testing.assert_allclose(derivative, extrapolated(end, 0.1, 1e-4), rtol=1e-7)
    # How many steps there are is known while JAX traces.
    assert jax.eval_shape(jax.jit(end), 0.1).shape == derivative.shape
