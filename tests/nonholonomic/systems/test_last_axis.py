"""Functions mapped over the last axis, against `jax.vmap`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.compilation.components import over_last_axis

RANDOM = np.random.default_rng(0)
WEIGHTS, INPUTS = jnp.asarray(RANDOM.normal(size=(4, 3, 5))), jnp.asarray(RANDOM.normal(size=(3, 5)))


def shapes(*arguments):
    return [jax.ShapeDtypeStruct(argument.shape[:-1], argument.dtype) for argument in arguments]


@pytest.mark.parametrize(
    "function",
    [
        lambda w, x: jnp.tanh(w @ x + 0.1 * jnp.arange(4.0)),
        lambda w, x: (jnp.max(w @ jnp.outer(x, x), axis=1)[::-1], jnp.sum(w * x) / jnp.linalg.norm(x)),
        lambda w, x: jnp.concatenate([w.T.reshape(-1)[2:9], jnp.tile(x[::2], 2), jnp.ones(2)]),
        lambda w, x: jnp.where(x[0] > 0.0, jnp.einsum("ij,kj->ik", w, w), jax.nn.softmax(w, axis=0)[:, :1]),
        lambda w, x: (jnp.sort(w @ x), jnp.linalg.solve(w.T @ w, x), jnp.pad(jax.nn.relu(w), 1)),
        lambda w, x: jnp.ones(2),
    ],
)
def test_the_last_axis_is_mapped_like_any_other(function):
    mapped = over_last_axis(function, *shapes(WEIGHTS, INPUTS))
    expected = jax.vmap(function, in_axes=-1, out_axes=-1)
    results = (mapped(WEIGHTS, INPUTS), expected(WEIGHTS, INPUTS))
    jax.tree.map(functools.partial(assert_close, rtol=1e-14), *results)


def test_an_argument_may_be_the_same_for_all_members():
    mapped = over_last_axis(lambda w, x: w @ x, *shapes(WEIGHTS, INPUTS))
    assert_close(mapped(WEIGHTS[..., 0], INPUTS), WEIGHTS[..., 0] @ INPUTS, rtol=1e-14)
