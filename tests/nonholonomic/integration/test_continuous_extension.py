"""States inside steps: order conditions, the polynomial, convergence, and fields that cannot be differentiated."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tune_middle import errors, middle_weights

from nonholonomic.integration import AbstractProblem, Oscillatory8, Settings, Stabilized8, follow, solve_with_samples
from nonholonomic.integration.runge_kutta import explicit_step, memory_for_stages
from nonholonomic.integration.samples import StepEnd, continuous_extension, hermite_factors, second_derivative


class Growth(AbstractProblem):
    """y' = y cos(t) from y = 1, so y = exp(sin(t)): the field depends on the time."""

    cells: int = eqx.field(static=True, default=1)

    def start(self):
        return jnp.ones((1, self.cells)), jnp.ones((1, self.cells))

    def field(self, time, state):
        return state * jnp.cos(time)

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return None


class Falls(Growth):
    """A fall from rest with drag proportional to the square of the speed; its derivative at rest is NaN."""

    def start(self):
        return jnp.zeros((2, self.cells)), jnp.ones((2, self.cells))

    def field(self, time, state):
        downward, sideways = state
        speed = jnp.sqrt(downward**2 + sideways**2)
        return jnp.stack([1.0 - speed * downward, -speed * sideways])


PAIRS = pytest.mark.parametrize("pair", [Oscillatory8, Stabilized8])


@PAIRS
def test_the_weights_are_computed_from_the_order_conditions(pair):
    assert_close(pair.middle, middle_weights(pair).astype(float), atol=1e-13)


@pytest.mark.parametrize(("pair", "round_off"), [(Oscillatory8, 1e-15), (Stabilized8, 3e-15)])
@pytest.mark.parametrize("order", range(1, 9))
def test_every_condition_of_order_holds(order, pair, round_off):
    """To round-off up to seventh order; not in eighth."""
    largest = np.max(np.abs(errors(pair, np.array(pair.middle), order)))
    assert largest < round_off if order < 8 else 1e-7 < largest < 1e-5


def test_the_polynomial_has_degree_seven():
    """Any polynomial of degree 7 is reproduced from its values and derivatives, but none of degree 8."""
    places, length = jnp.linspace(0.0, 1.0, 11), jnp.full(11, 0.3)
    for degree in range(9):
        whole = np.polynomial.Polynomial.basis(degree, domain=[0.1, 0.4])
        times = np.array([0.1, 0.4, 0.25])
        values = [*[f(time) for time in times[:2] for f in (whole, whole.deriv(), whole.deriv(2))]]
        values += [whole(times[2]), whole.deriv()(times[2])]
        result = sum(factor * value for factor, value in zip(hermite_factors(places, length), values, strict=True))
        difference = np.max(np.abs(np.asarray(result) - whole(0.1 + 0.3 * np.asarray(places))))
        assert difference < 1e-14 if degree < 8 else difference > 1e-3


def worst_inside(pair, length):
    """The largest error inside one step from t = 0.2."""
    problem, time, size = Growth(), jnp.full(1, 0.2), jnp.full(1, length)
    state = jnp.exp(jnp.sin(time))[None]
    rate = problem.field(time, state)
    start = (time, state, rate, size, None, memory_for_stages(pair.tableau, state))
    step = explicit_step(pair.tableau, problem.field, lambda *_: (), lambda *_: None, *start, [])
    start = StepEnd(time, state, rate, second_derivative(problem, size, time, state, rate))
    end_time = time + size
    end = StepEnd(end_time, step.state, step.rate, second_derivative(problem, size, end_time, step.state, step.rate))
    inside = continuous_extension(pair.middle, problem, start, end, size, step.rates)
    places = np.linspace(0.0, 1.0, 21)
    states = np.array([inside(jnp.full(1, place))[0, 0] for place in places])
    return np.max(np.abs(states - np.exp(np.sin(0.2 + places * length))))


@PAIRS
def test_halving_a_step_divides_the_error_by_two_to_the_eighth(pair):
    long, short = worst_inside(pair, 1.0), worst_inside(pair, 0.5)
    assert 1e-12 < short < long < 1e-5
    assert 150.0 < long / short < 1000.0


def sampled(problem, times, tolerance=1e-9, solver=None, horizon=3.0, lanes=None):
    settings = Settings(tolerance, solver, lanes=lanes or problem.cells)
    arguments = (jnp.asarray(times), jnp.asarray(horizon), jnp.asarray(problem.cells), settings)
    return eqx.filter_jit(solve_with_samples)(problem, *arguments, dense=True)


def test_a_field_without_a_derivative_at_the_start_is_sampled():
    """Also in the first step, which begins there."""
    times = np.concatenate([[1e-9, 1e-7, 1e-5], np.linspace(1e-3, 3.0, 1001)])
    assert np.isnan(jax.jvp(Falls().field, (0.0, jnp.zeros((2, 1))), (1.0, jnp.ones((2, 1))))[1]).any()
    _, samples = sampled(Falls(), times)
    assert_close(samples[0, :, 0], np.tanh(times), atol=1e-8)
    assert_close(samples[0, :, 1], 0.0 * times, atol=0.0)


@PAIRS
def test_steps_do_not_depend_on_the_number_of_samples(pair):
    times = np.linspace(0.0, 3.0, 51)
    few, many = (sampled(Growth(), part, solver=pair()) for part in (times[::50], times))
    assert few[0].steps == many[0].steps
    assert few[0].state == many[0].state
    assert_close(many[1][0, :, 0], np.exp(np.sin(times)), atol=1e-8)


@pytest.mark.parametrize("count", [7, 20001])
@pytest.mark.parametrize("solver", [None, diffrax.Dopri8(), diffrax.Tsit5()], ids=["default", "dopri8", "tsit5"])
def test_samples_are_as_good_as_steps(count, solver):
    """Many more samples than rows of a record, and few; inside steps or, for other methods, at their ends."""
    times = np.linspace(0.0, 3.0, count)
    _, samples = sampled(Growth(2), times, solver=solver)
    assert_close(samples[..., 0], np.broadcast_to(np.exp(np.sin(times)), (2, count)), atol=3e-9)


def test_every_cell_is_sampled_at_its_own_times():
    """Five cells take turns in two lanes."""
    times = np.linspace(0.01, 0.6, 40)[:, None] * np.arange(1.0, 6.0)
    _, samples = sampled(Growth(5), times, lanes=2)
    assert_close(samples[..., 0], np.exp(np.sin(times)).T, atol=3e-9)


def test_samples_have_derivatives_where_states_have():
    """By forward mode through the loop: y(0) = p, so dy/dp = exp(sin(t))."""

    class Scaled(Growth):
        scale: jnp.ndarray = eqx.field(default_factory=lambda: jnp.ones(()))

        def start(self):
            return jnp.full((1, 1), self.scale), jnp.ones((1, 1))

    times = np.linspace(0.1, 3.0, 30)
    slopes = jax.jvp(lambda scale: sampled(Scaled(scale=scale), times)[1], (jnp.asarray(2.0),), (jnp.ones(()),))[1]
    assert_close(slopes[0, :, 0], np.exp(np.sin(times)), atol=1e-8)


class Limited(AbstractProblem):
    """y' = y cos(t) from y = 1, up to a level."""

    level: jnp.ndarray

    def start(self):
        return jnp.ones(1) + 0.0 * self.level, jnp.ones(1)

    def field(self, time, state):
        return state * jnp.cos(time)

    def domain_margin(self, time, state):
        return self.level - state[0]


def test_the_end_of_a_run_is_found_in_its_last_step_whatever_the_round_off():
    """The parts of a step need not add up to the step: beyond it, there is no state."""
    settings = Settings(1e-7, solver=diffrax.Tsit5())
    for level in np.random.default_rng(3).uniform(2.0, 2.6, 200):
        path = follow(Limited(jnp.asarray(level)), 2.0, settings)
        assert path.left_domain
        np.testing.assert_allclose(path.times[-1], np.arcsin(np.log(level)), rtol=1e-4)
