"""The length of a plane vector and its derivatives, at the origin and off it."""

import jax
import jax.numpy as jnp
import numpy as np
from close import assert_close

from nonholonomic.geometry.vector import planar_length


def along(t, scale=1.0):
    return planar_length(3.0 * scale * t, 4.0 * scale * t)


def test_off_the_origin_the_derivatives_are_those_of_the_root():
    x, y = jnp.array([3.0, -1e-200]), jnp.array([4.0, 0.0])
    assert_close(planar_length(x, y), [5.0, 1e-200], rtol=1e-15)
    assert_close(jax.vmap(jax.grad(planar_length, (0, 1)))(x, y), [[0.6, -1.0], [0.8, 0.0]], rtol=1e-15)
    assert_close(jax.hessian(planar_length)(3.0, 4.0), 16.0 / 125.0, rtol=1e-14)


def test_at_the_origin_the_forward_derivative_is_one_sided():
    """|t v| has the derivative |v| by t, and |v|' by what v depends on; under `jit` and `vmap` too."""
    assert jax.jacfwd(along)(0.0) == 5.0
    assert_close(jax.jit(jax.vmap(jax.jacfwd(along), (None, 0)))(0.0, jnp.array([0.0, 2.0])), [0.0, 10.0])
    assert jax.grad(lambda scale: jax.jvp(lambda t: along(t, scale), (0.0,), (1.0,))[1])(2.0) == 5.0


def test_at_the_origin_there_is_no_gradient():
    """NaN for every cotangent but 0; beside samples off the origin, which keep theirs."""
    assert np.isnan(jax.grad(along)(0.0))
    x = jnp.array([0.0, 3.0])
    assert_close(jax.grad(lambda x: planar_length(x, x + 1.0 * (x > 0.0))[1])(x), [0.0, 7.0 / 5.0], rtol=1e-15)
    assert jax.grad(lambda x: 0.0 * jnp.sum(planar_length(x, x)))(x)[0] == 0.0
