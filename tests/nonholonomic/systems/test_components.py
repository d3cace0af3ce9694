"""Functions of small matrices, evaluated number by number, against the same functions in arrays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import Sleigh
from scipy.integrate import solve_ivp

from nonholonomic import AbstractSystem, Recording, log_density, simulate
from nonholonomic.compilation.components import TooLarge, by_components
from nonholonomic.identification.posterior import OF_RECORDING
from nonholonomic.runs.model import model_of
from nonholonomic.systems.mechanics import Lagrange, within_constraints

LANES = tuple(jnp.linspace(0.1, 1.0, 8) * scale for scale in (1.0, -2.0, 0.7, 1.3, 0.4, 3.0))
SCALARS = tuple(jax.ShapeDtypeStruct((), jnp.float64) for _ in LANES)


def motion(*parts):
    """The sleigh's rates: a jvp, a gradient, products and solutions of small matrices, with many zeros."""
    return tuple(Lagrange(Sleigh()).field(0.0, jnp.stack(parts)))


def odds(*parts):
    """Other operations on arrays and numbers."""
    y = jnp.stack(parts)
    table = jnp.pad(y.reshape(2, 3), ((1, 0), (0, 2)))
    ordered = jnp.where(jnp.arange(5) < 3, table[2, ::-1], table.T @ table @ jnp.ones(5))
    flat = jnp.concatenate([ordered, jnp.exp(y[:2]) ** 2, jnp.max(table, axis=0)[None, 1]])
    first, second = jnp.unstack(y[:2])
    return jnp.sum(flat), jnp.min(flat), jnp.sqrt(jnp.abs(flat[1])) + (y[0] > 0.5), jnp.arctan2(first, second)


@pytest.mark.parametrize("function", [motion, odds])
def test_numbers_and_arrays_give_the_same(function):
    expected = jax.jit(jax.vmap(function))(*LANES)
    for result, expected_value in zip(jax.jit(by_components(function, *SCALARS))(*LANES), expected, strict=True):
        assert_close(result, expected_value, rtol=1e-13, atol=1e-14)


def test_zeros_are_not_computed_with():
    """A product with a diagonal matrix takes a multiplication per row."""

    def scaled(*parts):
        return tuple(np.diag(np.arange(6.0)) @ jnp.stack(parts))

    jaxpr = jax.make_jaxpr(by_components(scaled, *SCALARS))(*LANES)
    assert [equation.primitive.name for equation in jaxpr.eqns].count("mul") == 4
    assert "add" not in [equation.primitive.name for equation in jaxpr.eqns]


def test_an_empty_sum_is_zero_and_an_empty_product_is_one():
    def empty(*parts):
        none = jnp.stack(parts)[:0]
        return parts[0] + jnp.sum(none), parts[0] * jnp.prod(none), parts[0] + jnp.all(none > 0.0) - jnp.any(none > 0.0)

    for result, expected in zip(by_components(empty, *SCALARS)(*LANES), (0.0, 0.0, 1.0), strict=True):
        assert_close(result, LANES[0] + expected)


def hidden_in_zeros(*parts):
    """Two roots: one is multiplied only by zeros of a matrix, the other is also a term elsewhere."""
    vector = jnp.stack([jnp.sqrt(parts[0]), jnp.sqrt(parts[3]), parts[2]])
    return tuple(jnp.array([[0.0, 0.0, 1.0], [0.0, 2.0, 3.0]]) @ vector)


def test_a_number_that_is_not_finite_does_not_disappear_with_the_zeros_of_a_matrix():
    """NaN times zero is NaN, as in arrays; where the roots are numbers, the result does not change. Only one root is added."""
    parts = (jnp.array([4.0, -1.0, 4.0]), *LANES[1:3], jnp.array([9.0, 9.0, -1.0]), *LANES[4:])
    parts = tuple(part[:3] for part in parts)
    expected = np.array(jax.vmap(hidden_in_zeros)(*parts))
    assert np.isnan(expected).tolist() == [[False, True, True], [False, True, True]]
    results = np.array(by_components(hidden_in_zeros, *SCALARS)(*parts))
    assert_close(results[:, 0], expected[:, 0], rtol=1e-15)
    assert np.isnan(results).any(axis=0).tolist() == [False, True, True]
    jaxpr = jax.make_jaxpr(by_components(hidden_in_zeros, *SCALARS))(*parts)
    assert [equation.primitive.name for equation in jaxpr.eqns].count("mul") == 3


def test_what_newer_versions_of_jax_trace_as_one_operation_is_evaluated_number_by_number():
    """Products by `einsum`, copies by `tile`, binary logarithms, and the derivatives of inverse functions."""

    def function(*parts):
        vector = jnp.tile(jnp.stack(parts[:2]), 2)[1:3][::-1]
        slope = jax.grad(lambda x: jnp.arctan(x) + jnp.tanh(x) + jnp.log2(x))
        return jnp.einsum("i,ij,j->", vector, jnp.array([[1.0, 2.0], [2.0, 5.0]]), vector), slope(parts[2])

    a, b, c = (np.asarray(part) for part in LANES[:3])
    product, slope = by_components(function, *SCALARS)(*LANES)
    assert_close(product, a * a + 4.0 * a * b + 5.0 * b * b, rtol=1e-14)
    assert_close(slope, 1.0 / (1.0 + c * c) + 1.0 - np.tanh(c) ** 2 + 1.0 / (c * np.log(2.0)), rtol=1e-14)


def test_large_functions_and_loops_are_left_in_arrays():
    def large(*parts):
        matrix = jnp.sin(jnp.outer(jnp.arange(20.0), jnp.stack(parts)))
        return jnp.sum(matrix @ matrix.T @ matrix)

    def loop(*parts):
        return jax.lax.fori_loop(0, 3, lambda _, y: y * y, parts[0])

    for function in (large, loop):
        with pytest.raises(TooLarge):
            jax.eval_shape(by_components(function, *SCALARS), *LANES)


class CarWithTrailer(AbstractSystem):
    """A car that pulls a trailer and turns its front wheels: 5 coordinates and 3 wheels that do not slip."""

    base: float = 2.5
    hitch: float = 0.8
    length: float = 3.0
    dimension = 5

    def metric(self, q):
        heading, trailer = q[2], q[4]
        zero, one = jnp.zeros_like(heading), jnp.ones_like(heading)
        sin, cos = jnp.sin, jnp.cos
        middle = 0.5 * self.base
        car = jnp.array(
            [[one, zero, -middle * sin(heading), zero, zero], [zero, one, middle * cos(heading), zero, zero]]
        )
        behind = jnp.array(
            [
                [one, zero, self.hitch * sin(heading), zero, self.length * sin(trailer)],
                [zero, one, -self.hitch * cos(heading), zero, -self.length * cos(trailer)],
            ]
        )
        return 1000.0 * car.T @ car + 500.0 * behind.T @ behind + jnp.diag(jnp.array([0.0, 0.0, 1500.0, 5.0, 400.0]))

    def constraints(self, q):
        _, _, heading, steering, trailer = q
        sin, cos, zero = jnp.sin, jnp.cos, jnp.zeros_like(heading)
        return jnp.array(
            [
                [sin(heading), -cos(heading), zero, zero, zero],
                [sin(heading + steering), -cos(heading + steering), -self.base * cos(steering), zero, zero],
                [sin(trailer), -cos(trailer), self.hitch * cos(heading - trailer), zero, self.length + zero],
            ]
        )

    def force(self, t, q, rate):
        return jnp.array([0.0, 0.0, 0.0, -50.0 * (q[3] - 0.3 * jnp.sin(t)) - 10.0 * rate[3], 0.0])


def test_a_large_field_stands_once_in_a_program_and_its_motion_is_that_of_scipy():
    car, q = CarWithTrailer(), jnp.array([0.0, 0.0, 0.0, 0.05, 0.1])
    rate = within_constraints(car, q, jnp.array([5.0, 0.0, 0.0, 0.0, 0.0]))
    problem = model_of(car, (q, rate)).problem(None, None)

    def twice(state):
        once = problem.field(state[-1], state)
        return problem.field(state[-1], state + once)

    text = jax.jit(twice).lower(problem.start()[0]).as_text()
    assert text.count("func.func private @_in_lanes") == 1
    assert text.count("call @_in_lanes") == 2
    run = simulate(car, (q, rate), 2.0, times=[2.0])
    field = jax.jit(Lagrange(car).field)
    start = np.concatenate([q, rate])
    expected = solve_ivp(field, (0.0, 2.0), start, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    assert_close(run.state[-1], expected, rtol=1e-7)


def test_a_fit_of_a_system_with_a_large_field_takes_differences():
    """A program with derivatives would take a minute to compile."""
    for system, size, expected in ((CarWithTrailer(), 5, OF_RECORDING), (Sleigh(), 3, None)):
        data = Recording((np.zeros(size), np.zeros(size)), [1.0, 2.0], [0.0, 0.1], 0.01, "q0")
        density = log_density(system, data, {"start.q[0]": 0.0})
        assert density.problem.step == expected
