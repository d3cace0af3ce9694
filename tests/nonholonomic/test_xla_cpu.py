"""The least and the greatest of some numbers, and their derivatives; loops in one kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.compilation.xla_cpu import greatest, in_one_kernel, least


@pytest.mark.parametrize("function", [least, greatest])
def test_the_derivative_survives_what_the_compiler_rounds_differently(function):
    """The derivative of x - 0.37 exp(c), where it is the one chosen of two numbers, is -0.37 exp(c).

    XLA may round the difference in one kernel and not in another; by `jnp.maximum` and `jnp.minimum` some of these are 0 then.
    """
    sign = 1.0 if function is greatest else -1.0
    times = 1.0 + 0.01 * np.arange(24)

    @jax.jit
    def value_and_slope(c):
        return jax.jvp(lambda c: function(sign * (times - 0.37 * jnp.exp(c)), jnp.zeros(24)), (c,), (1.0,))

    for c in np.random.default_rng(0).uniform(-3.0, -2.0, 100):
        np.testing.assert_allclose(value_and_slope(c)[1], -sign * 0.37 * np.exp(c), rtol=1e-12)


def test_what_is_not_a_number_stays_so():
    for function in (least, greatest):
        assert jnp.isnan(function(jnp.nan, 1.0))
        assert jnp.isnan(function(1.0, jnp.nan))


def test_of_several_numbers():
    numbers = jnp.array([[3.0, 1.0], [2.0, 5.0], [4.0, 0.0]])
    np.testing.assert_array_equal(least(*numbers), [2.0, 0.0])
    np.testing.assert_array_equal(greatest(*numbers), [4.0, 5.0])


#: What loops of users' functions may do.
STEPS = {
    "interp": lambda x: jnp.interp(x, jnp.linspace(0.0, 1.0, 5), jnp.linspace(0.0, 1.0, 5) ** 2),
    "einsum": lambda x: jnp.einsum("ij,j->i", jnp.outer(x, x), x),
    "polynomial": lambda x: jnp.polyval(jnp.ones(12) / 12.0, x),
    "large sum": lambda x: jnp.sum(jnp.tanh(jnp.outer(jnp.linspace(0.0, 1.0, 2048), x)), axis=0) / 2048.0,
    "greatest of many": lambda x: jnp.max(jnp.outer(jnp.linspace(0.0, 1.0, 2048), x), axis=0),
    "matrices": lambda x: (jnp.ones((16, 16)) @ jnp.outer(jnp.ones(16), x))[0] / 16.0,
    "sort": lambda x: jnp.sort(1.0 - x),
    "solve": lambda x: jnp.linalg.solve(jnp.eye(4) + jnp.outer(x, x), x),
    "qr": lambda x: jnp.linalg.qr(jnp.eye(4) + jnp.outer(x, x))[1][0],
    "fft": lambda x: jnp.fft.fft(x).imag,
}


@pytest.mark.parametrize("name", STEPS)
def test_a_loop_in_one_kernel_computes_the_same_whatever_it_does(name):
    def loop(x):
        return jax.lax.fori_loop(0, 2, lambda _, x: 0.5 * STEPS[name](x), x)

    x = np.linspace(0.1, 0.9, 4)
    np.testing.assert_allclose(jax.jit(in_one_kernel(loop))(x), loop(x), rtol=1e-12, atol=1e-15)


def test_a_kernel_is_compiled_even_where_compilation_is_disabled():
    with jax.disable_jit():
        assert in_one_kernel(lambda x: x + 1.0)(jnp.ones(2)).tolist() == [2.0, 2.0]
