"""Functions written in JavaScript have the same values in a real browser."""

import ctypes
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import needs_browser, open_browser
from host_kernels import compiled, needs_compiler

from nonholonomic.kernels import javascript
from nonholonomic.kernels.device_code import LOOPS
from nonholonomic.kernels.scalar_code import CUDA, scalar_code

X = np.array([0.3, -1.2, 2.5])


def loop(x):
    """The two numbers change places, forty times."""
    return jax.lax.fori_loop(0, 40, lambda k, pair: (pair[1], 0.9 * pair[0] + x[2]), (x[0], x[1]))


def until(x):
    return jax.lax.while_loop(lambda pair: pair[1] < 5, lambda pair: (jnp.sin(pair[0]), pair[1] + 1), (x[0], 0))


def newton(x):
    """The cube root of 2.5, by a loop that ends when it is found."""
    return jax.lax.while_loop(
        lambda y: abs(y**3 - x[2]) > 1e-12, lambda y: y - (y**3 - x[2]) / (3.0 * y**2), x[0] + 1.0
    )


def of_two(x):
    return jax.lax.cond(x[0] > 0.0, lambda: (2.0 * x, x[0]), lambda: (3.0 * x, x[1]))


def of_three(x):
    return jax.lax.switch((x[2] > 0.0).astype(int) + 1, [lambda: x, lambda: x + 1.0, lambda: 5.0 * x])


def everything(x):
    """Functions of one number, where they are defined."""
    a, b = jnp.abs(x) + 1.0, jnp.tanh(x)
    results = (
        jnp.exp(x),
        jnp.expm1(x),
        jnp.log(a),
        jnp.log1p(a),
        jnp.sqrt(a),
        jnp.cbrt(a),
        jnp.sin(x),
        jnp.cos(x),
        jnp.tan(x),
    )
    results += (jnp.arcsin(b), jnp.arccos(b), jnp.arctan(x), jnp.arctan2(x, a), jnp.sinh(x), jnp.cosh(x), jnp.tanh(x))
    results += (jnp.arcsinh(x), jnp.arccosh(a), jnp.arctanh(b), a**x, a**-3, jnp.exp2(x), jax.lax.rsqrt(a), jnp.sign(x))
    return (
        *results,
        jnp.floor(x),
        jnp.ceil(x),
        jnp.mod(x, 0.7),
        jnp.maximum(x, 0.0),
        jnp.clip(x, -1.0, 1.0),
        jax.nn.sigmoid(x),
    )


def array_work(x):
    """Sums, products, extremes and indices that are known only at run time."""
    indices = (x[2] > 0.0).astype(int)
    matrix = jnp.outer(x, x) + jnp.eye(3)
    selections = (
        x[indices],
        x[indices + jnp.arange(2)],
        x.at[indices].set(7.0),
        x.at[jnp.array([0, 2, 0])].add(2.0 * x),
        x.at[indices + jnp.array([0, 1, 2])].add(2.0 * x),
        jax.lax.dynamic_slice(x, (indices,), (2,)),
        jnp.take_along_axis(matrix, jnp.argmin(matrix, axis=0)[None], axis=0),
        matrix[indices + jnp.arange(2), indices],
        matrix.at[indices, indices + jnp.arange(2)].set(x[:2]),
    )
    outputs = (matrix @ x, matrix.T.ravel(), x @ x, jnp.prod(x), jnp.max(x), jnp.min(x), jnp.argmin(x), jnp.argmax(x))
    return (
        *selections,
        *outputs,
        jnp.any(x > 2.0),
        jnp.all(x > 2.0),
        x[::-1],
        jnp.linalg.norm(x),
        jnp.einsum("ij,j->i", matrix, x),
        jnp.polyval(jnp.array([0.5, -1.0, 2.0, 3.0]), x),
        jnp.log2(jnp.abs(x) + 1.0),
        jnp.hypot(x[0], x[1]),
    )


def looked_up(x):
    """In a table with equal and unequal steps, within it and beyond its ends, and where a number lies in a list."""
    places, values = jnp.array([-0.5, 0.0, 0.1, 0.3, 1.0]), jnp.array([0.0, 1.0, -2.0, 4.0, 3.0])
    return jax.vmap(lambda place: jnp.interp(place, places, values))(x), jnp.searchsorted(places, x, side="right")


def slopes(x):
    """The derivative of a function by automatic differentiation."""
    b = jnp.tanh(x)
    of_inverses = jax.vmap(jax.grad(lambda b: jnp.arcsin(b) + jnp.arctanh(b) ** 2 + jnp.tanh(b)))(b)
    return jax.grad(lambda y: jnp.sin(y[0]) * y[1] ** 3 / jnp.sqrt(1.0 + y[2] ** 2))(x), of_inverses


FUNCTIONS = [loop, until, newton, of_two, of_three, everything, array_work, looked_up, slopes]


@pytest.fixture(scope="module")
def browser():
    with open_browser() as driver:
        yield driver


@needs_browser
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_the_browser_computes_what_jax_computes(browser, function):
    text = javascript("", function, jnp.asarray(X))
    numbers = browser.execute_script(f"return ({text})({json.dumps(X.tolist())}, []).map(Number)")
    expected = np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(function(jnp.asarray(X)))])
    np.testing.assert_allclose(np.array(numbers, float), expected, rtol=1e-14, atol=1e-15)


@needs_compiler
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_the_host_computes_what_jax_computes(function):
    expected = np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(function(jnp.asarray(X)))])
    np.testing.assert_allclose(on_host(function, X, expected.size), expected, rtol=1e-14, atol=1e-15)


def on_host(function, numbers, results):
    """The results of a function of a list of numbers, written in CUDA C and compiled for the host."""
    entry = 'extern "C" void called(const double* numbers, double* results) { written(numbers, results); }'
    library = compiled(
        "\n".join([LOOPS.read_text(), scalar_code(CUDA, "written", function, jnp.asarray(numbers)), entry])
    )
    out = np.zeros(results)
    library.called(*(ctypes.c_void_p(array.ctypes.data) for array in (numbers, out)))
    return out


@needs_compiler
def test_no_number_is_lost_on_the_host_that_is_not_finite():
    def function(x):
        return x / 0.0, 0.0 * x / 0.0, jnp.inf * x, jnp.where(x > 1.0, x, -jnp.inf), jnp.maximum(x / 0.0, 0.0 * x / 0.0)

    results = on_host(function, np.array(-2.0), 5)
    np.testing.assert_array_equal(results, [-np.inf, np.nan, -np.inf, -np.inf, np.nan])


@needs_browser
def test_no_number_is_lost_that_is_not_finite(browser):
    text = javascript(
        "", lambda x: (x / 0.0, 0.0 * x / 0.0, jnp.inf * x, jnp.where(x > 1.0, x, -jnp.inf)), jnp.ones(())
    )
    assert browser.execute_script(f"return ({text})([-2], []).map(String)") == [
        "-Infinity",
        "NaN",
        "-Infinity",
        "-Infinity",
    ]


def test_what_no_result_needs_is_left_out():
    text = javascript("f", lambda x: jnp.stack([jnp.sin(x[0]), jnp.cos(x[1])])[0], jnp.asarray(X))
    assert "Math.sin" in text
    assert "Math.cos" not in text


def test_what_is_computed_twice_is_written_once():
    text = javascript("f", lambda x: jnp.exp(x[0]) + jnp.exp(x[0]) * x[1], jnp.asarray(X))
    assert text.count("Math.exp") == 1


def test_the_choices_of_places_that_are_read_apart_do_not_multiply():
    """Four of ten rows: 40 choices, and not 10 to the power of four."""
    text = javascript("f", lambda x: jnp.take_along_axis(x, jnp.argmin(x, axis=0)[None], axis=0), jnp.zeros((10, 4)))
    assert text.count("\n") < 1000


def test_an_unknown_primitive_is_named():
    with pytest.raises(ValueError, match="primitive 'lgamma' of JAX"):
        javascript("f", jax.lax.lgamma, jnp.asarray(X))
