"""Derivatives of sampled runs by one backward pass, against a closed form, in every composition of transformations."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

import nonholonomic.derivatives.adjoint as adjoint
from nonholonomic.derivatives import sampled_run
from nonholonomic.integration import AbstractProblem, Settings

TIMES = jnp.array([0.0, 0.4, 1.0, 1.7])
#: Rate, height, growth and patience of five runs; the guard ends the last two before the last sample.
POINTS = jnp.array(
    [[1.0, 2.0, 0.7, 9.0], [0.3, 1.5, -0.2, 9.0], [2.0, 0.5, 0.1, 9.0], [0.8, 1.0, 0.4, 1.3], [1.5, 3.0, 0.0, 0.7]]
)


class Decays(AbstractProblem):
    """y' = -rate (1 + growth t) y from y = height, a clock, and the area under y, which is passive; the guard is up at
    the time `patience`."""

    numbers: tuple[jax.Array, ...]

    @property
    def leading(self):
        return 2

    def start(self):
        zero = jnp.zeros_like(self.numbers[1])
        return jnp.stack([self.numbers[1], zero, zero]), jnp.stack([zero + 1.0] * 3)

    def field(self, time, state):
        rate, _, growth, _ = self.numbers
        return jnp.stack([-rate * (1.0 + growth * time) * state[0], jnp.ones_like(state[0]), state[0]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return self.numbers[3] - state[1]


def build(numbers, cells):
    shape = () if cells is None else (cells,)
    return Decays(tuple(jnp.broadcast_to(number, shape) for number in numbers))


def loss(numbers, times=TIMES):
    """A sum over the samples, the areas and the end of a run, whose samples after its end are missing."""
    run = sampled_run(build, numbers, times, jnp.asarray(2.0), Settings(1e-11))
    heights, areas = (jnp.where(jnp.isnan(part), 0.0, part) for part in (run.states[:, 0], run.quadratures[:, 0]))
    return jnp.sum(jnp.arange(1.0, 5.0) * heights**2) + jnp.sum(areas**3) + run.end_time**2


def exact(numbers):
    """The same from the closed form; areas by a quadrature of high order."""
    rate, height, growth, patience = numbers
    nodes, weights = np.polynomial.legendre.leggauss(30)
    moments = 0.5 * TIMES[:, None] * (1.0 + nodes)
    heights, inside = (height * jnp.exp(-rate * (t + 0.5 * growth * t**2)) for t in (TIMES, moments))
    areas = 0.5 * TIMES * (inside @ weights)
    reached = patience >= TIMES
    terms = jnp.where(reached, jnp.arange(1.0, 5.0) * heights**2 + areas**3, 0.0)
    return jnp.sum(terms) + jnp.minimum(patience, 2.0) ** 2


def of_points(function):
    return lambda points: jax.vmap(lambda point: function(tuple(point)))(points)


EXPECTED = jax.jit(jax.vmap(jax.grad(lambda point: exact(tuple(point)))))(POINTS)


def batch_of_gradients(points):
    return jax.vmap(jax.grad(lambda point: loss(tuple(point))))(points)


def gradient_of_a_batch(points):
    return jax.grad(lambda points: jnp.sum(of_points(loss)(points)))(points)


def forward(points):
    return jax.vmap(jax.jacfwd(lambda point: loss(tuple(point))))(points)


def of_all_outputs(points):
    return jax.vmap(jax.jacrev(lambda point: loss(tuple(point))[None]))(points)[:, 0]


@pytest.mark.parametrize(
    "transformed",
    [
        batch_of_gradients,
        forward,
        *(pytest.param(by, marks=pytest.mark.slow) for by in (gradient_of_a_batch, of_all_outputs)),
    ],
)
def test_every_composition_gives_the_derivatives_of_the_closed_form(transformed):
    assert_close(jax.jit(transformed)(POINTS), EXPECTED, rtol=1e-8, atol=1e-9)


def test_numbers_shared_by_all_runs_have_the_sum_of_their_derivatives():
    def total(shared, heights):
        return jnp.sum(jax.vmap(lambda height: loss((shared[0], height, *shared[1:])))(heights))

    shared, heights = jnp.array([0.8, 0.4, 1.3]), jnp.array([1.0, 2.5, 0.6])
    points = jnp.stack([jnp.full(3, 0.8), heights, jnp.full(3, 0.4), jnp.full(3, 1.3)], axis=1)
    expected = jax.vmap(jax.grad(lambda point: exact(tuple(point))))(points)
    by_shared, by_height = jax.jit(jax.grad(total, (0, 1)))(shared, heights)
    assert_close(by_shared, expected.sum(axis=0)[jnp.array([0, 2, 3])], rtol=1e-8)
    assert_close(by_height, expected[:, 1], rtol=1e-8)


@pytest.mark.slow
def test_a_direction_costs_one_variation_and_a_second_derivative_is_taken_forward():
    point, direction = tuple(POINTS[0]), (0.3, -1.0, 0.5, 0.0)
    slope = jax.jit(lambda point: jax.jvp(loss, (point,), (direction,))[1])(point)
    assert_close(slope, jnp.dot(EXPECTED[0], jnp.array(direction)), rtol=1e-8)
    curvature = jax.jit(jax.jacfwd(jax.grad(lambda point: loss(tuple(point)))))(POINTS[0])
    assert_close(curvature, jax.hessian(lambda point: exact(tuple(point)))(POINTS[0]), rtol=1e-7, atol=1e-7)


def test_what_is_no_longer_kept_is_computed_again(monkeypatch):
    """Periods of two iterations, of which the starts of two are kept, and the steps of the latest one."""
    monkeypatch.setattr(adjoint.StepRecorder, "period", 2)
    monkeypatch.setattr(adjoint, "SLOTS", 2)
    monkeypatch.setattr(adjoint, "STEPS_KEPT", 1)
    assert_close(jax.jit(lambda points: batch_of_gradients(points))(POINTS), EXPECTED, rtol=1e-8, atol=1e-9)


def test_an_infinite_cotangent_of_a_number_at_rest_has_no_effect():
    def root(point):
        rate, growth, patience = point
        run = sampled_run(build, (rate, 0.0, growth, patience), TIMES, jnp.asarray(2.0), Settings(1e-9))
        return jnp.sum(jnp.sqrt(run.states[:, 0])) + run.end_time

    gradients = jax.jit(jax.vmap(jax.grad(root)))(jnp.array([[1.0, 0.5, 9.0], [1.0, 0.5, 1.9]]))
    assert_close(gradients, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


class SummedRate(Decays):
    """The rate is added up in a loop that has no backward pass."""

    def field(self, time, state):
        def added(carry):
            return carry[0] + 0.5 * self.numbers[0], carry[1] + 1

        rate, _ = jax.lax.while_loop(lambda carry: carry[1] < 2, added, (jnp.zeros_like(state[0]), 0))
        growth = self.numbers[2]
        return jnp.stack([-rate * (1.0 + growth * time) * state[0], jnp.ones_like(state[0]), state[0]])


def test_a_loop_without_a_backward_pass_is_differentiated_forward():
    def build_summed(numbers, cells):
        return SummedRate(build(numbers, cells).numbers)

    def height(rate, start, growth):
        run = sampled_run(build_summed, (rate, start, growth, 9.0), TIMES, jnp.asarray(2.0), Settings(1e-9))
        return run.states[2, 0]

    rate, start, growth = points = jnp.array([[1.0, 0.3], [2.0, 1.5], [0.7, -0.2]])
    slopes = jax.jit(jax.vmap(jax.grad(height, (0, 1, 2))))(*points)
    end = start * jnp.exp(-rate * (1.0 + 0.5 * growth))
    assert_close(slopes, [-(1.0 + 0.5 * growth) * end, end / start, -0.5 * rate * end], rtol=1e-7)


class DampedOscillator(AbstractProblem):
    """y'' = -damping y' - 25 y from y = height, at rest for height 0."""

    height: jax.Array
    damping: float

    def start(self):
        return jnp.stack([self.height, 0.0 * self.height]), jnp.ones(2)

    def field(self, time, state):
        return jnp.stack([state[1], -self.damping * state[1] - 25.0 * state[0]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return None


def build_oscillator(numbers, cells):
    return DampedOscillator(*numbers)


@pytest.mark.parametrize(("damping", "end"), [(1.0, 40.0), (-0.5, 20.0)])
def test_diffrax_differentiates_a_motion_at_rest_however_much_its_tangent_decays_or_grows(damping, end):
    """A generic tangent of constant length keeps the steps short: the derivative of the height at the end is 1e-9, or 122."""

    def height_at_end(height):
        times, backward = jnp.array([0.5 * end, end]), diffrax.RecursiveCheckpointAdjoint()
        options = (times, jnp.asarray(end), Settings(1e-6))
        return sampled_run(build_oscillator, (height, damping), *options, adjoint=backward).states[-1, 0]

    frequency = np.sqrt(25.0 - 0.25 * damping**2)
    phase = frequency * end
    exact = np.exp(-0.5 * damping * end) * (np.cos(phase) + 0.5 * damping / frequency * np.sin(phase))
    assert_close(jax.grad(height_at_end)(0.0), exact, rtol=1e-7)
