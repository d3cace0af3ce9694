"""Derivatives of sampled hybrid runs by one backward pass, against those by tangents, closed forms and differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

import nonholonomic.derivatives.adjoint as adjoint
import nonholonomic.hybrid.samples as samples
from nonholonomic.hybrid import AbstractBatchedMode, Transition, hybrid_samples
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import LEFT_DOMAIN, RUNNING

TIMES = jnp.linspace(0.0, 1.0, 11)
#: Restitution, gravity, drag, height and speed of four balls; the ceiling stops the last one.
POINTS = jnp.array(
    [[0.7, 9.81, 0.2, 0.3, 0.1], [0.9, 9.0, 0.02, 0.5, -0.3], [0.8, 8.0, 0.1, 0.0, 2.0], [0.6, 9.81, 0.3, 0.9, 3.0]]
)
CEILING = 1.2


class Falls(AbstractProblem):
    """A ball in the air, falling or, upside down, rising to the ceiling."""

    state: jax.Array
    numbers: tuple[jax.Array, ...]
    rises: bool = eqx.field(static=True)
    direction_decides = True

    def start(self):
        return self.state, jnp.ones_like(self.state)

    def field(self, time, state):
        _, gravity, drag = self.numbers
        return jnp.stack([state[1], -gravity - drag * state[1]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return jnp.minimum(CEILING - state[0], state[1] + 1e-3) if self.rises else state[0]


class Flight(AbstractBatchedMode):
    """Rising until the ball stops or strikes the ceiling, where the run ends 0.01 s later; or falling to the ground."""

    numbers: tuple[jax.Array, ...]
    rises: bool = eqx.field(static=True)

    def problem(self, state):
        return Falls(state, self.numbers, self.rises)

    def shown(self, state):
        """The height and the time for which the ball has fallen."""
        return jnp.stack([state[0], -state[1] / self.numbers[1]])

    def reset_map(self, state, left):
        zero, never = jnp.zeros(left.shape, int), jnp.full(left.shape, jnp.inf)
        if self.rises:
            strikes = state[1] > 0.0
            status, elapsed = jnp.where(strikes, LEFT_DOMAIN, RUNNING), jnp.where(strikes, 0.01 * state[1], 0.0)
            return Transition(zero + 1, state, elapsed, status, never, zero[None])
        after = jnp.stack([0.0 * state[0], -self.numbers[0] * state[1]])
        return Transition(zero, after, 0.0 * left, zero + RUNNING, never, zero[None] + 1)


def build(point, tolerance, cells):
    restitution, gravity, drag, height, speed = (jnp.broadcast_to(number, (cells,)) for number in point)
    numbers = (restitution, gravity, drag)
    modes = (Flight(numbers, True), Flight(numbers, False))
    return modes, (speed <= 0.0).astype(int), jnp.stack([height, speed])


def loss(point, tolerance=1e-11):
    run = hybrid_samples(build, tuple(point), TIMES, jnp.asarray(1.0), Settings(tolerance), 1)
    heights, speeds = jnp.where(jnp.isnan(run.states), 0.0, run.states).T
    return jnp.sum(heights**2 * jnp.cos(TIMES) + 0.1 * speeds) + run.end_time**2


def gradients(function, points):
    return jax.jit(jax.vmap(jax.grad(lambda point: function(point))))(points)


def bouncing(point, tolerance, cells):
    restitution, gravity, height = (jnp.broadcast_to(number, (cells,)) for number in point)
    mode = Flight((restitution, gravity, jnp.zeros(cells)), False)
    return (mode,), jnp.zeros(cells, int), jnp.stack([height, jnp.zeros(cells)])


def exact_height(restitution, gravity, height, time):
    """The height of a dropped ball after three bounces."""
    fall = jnp.sqrt(2.0 * height / gravity)
    start = fall * (1.0 + 2.0 * (restitution + restitution**2))
    passed = time - start
    return passed * (restitution**3 * gravity * fall - 0.5 * gravity * passed)


def test_a_single_backward_pass_gives_the_derivatives_of_the_closed_form(monkeypatch):
    """Only two of the four rounds are kept, so that the others are computed again."""
    monkeypatch.setattr(samples.HybridSampling, "most_forward", 0)
    monkeypatch.setattr(samples, "MOST_FORWARD_ALONE", 0)
    monkeypatch.setattr(adjoint, "SLOTS", 2)

    def height(restitution, gravity, height):
        point, times = (restitution, gravity, height), jnp.array([0.0, 0.1, 1.2])
        run = hybrid_samples(bouncing, point, times, jnp.asarray(1.2), Settings(1e-6), 1)
        # Infinite at the start, where the speed does not depend on any number.
        return run.states[2, 0] + 0.0 * jnp.sqrt(run.states[0, 1])

    point = (0.8, 9.81, 0.4)
    slopes = jax.jit(jax.grad(height, (0, 1, 2)))(*point)
    assert_close(slopes, jax.grad(exact_height, (0, 1, 2))(*point, 1.2), rtol=1e-8)


@pytest.mark.slow
def test_the_backward_pass_gives_the_derivatives_of_the_forward_mode(monkeypatch):
    """Through changes of mode and bounces, and at the ends of runs that end early."""
    monkeypatch.setattr(samples.HybridSampling, "most_forward", 0)
    backward = gradients(loss, POINTS)
    monkeypatch.setattr(samples.HybridSampling, "most_forward", 5)
    assert_close(backward, gradients(loss, POINTS), rtol=1e-9, atol=1e-9)
    run = jax.jit(jax.vmap(lambda point: loss(point, 1e-13)))
    for point, slopes in zip(POINTS, backward, strict=True):
        best = np.full(5, np.inf)
        for step in 10.0 ** -np.arange(3, 7):
            values = run(jnp.concatenate([point + step * jnp.eye(5), point - step * jnp.eye(5)]))
            best = np.minimum(best, np.abs((values[:5] - values[5:]) / (2.0 * step) - slopes))
        assert np.max(best) < 1e-7 * np.max(np.abs(slopes))


@pytest.mark.slow
def test_derivatives_after_a_grazing_event_are_not_numbers(monkeypatch):
    """Balls that reach the ceiling at 10 % to 1e-9 of the energy of their start, and end there with that speed."""
    monkeypatch.setattr(samples.HybridSampling, "most_forward", 0)
    energies = np.array([1e-1, 1e-3, 1e-5, 1e-7])
    speeds = np.sqrt(2.0 * 9.81 * CEILING * (1.0 + energies))
    points = jnp.stack([jnp.array([0.5, 9.81, 0.0, 0.0, speed]) for speed in speeds])

    def end(point):
        return hybrid_samples(build, tuple(point), TIMES, jnp.asarray(1.0), Settings(1e-6), 1).end_time

    assert jnp.isnan(gradients(end, points)).any(axis=1).tolist() == [False, False, True, True]
