"""The times at which a function of time jumps or has a kink, from its operations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.compilation.tracing import jumps_of

KNOTS = jnp.array([0.0, 0.3, 1.0])

FOUND = {
    "where": (lambda t: jnp.where((t > 1.0) & (t <= 2.0), 1.0, 0.0), {1.0, 2.0}),
    "affine": (lambda t: jnp.where((1.0 - 2.0 * t) / 4.0 > 0.5 - t, 1.0, 0.0), {0.5}),
    "vector": (lambda t: jnp.sum(jnp.where(t > KNOTS, 1.0, 0.0)), {0.0, 0.3, 1.0}),
    "piecewise": (lambda t: jnp.piecewise(t, [t < 1.0, t >= 2.0], [0.0, lambda t: 2.0 * t, 1.0]), {1.0, 2.0}),
    "select": (lambda t: jnp.select([t < 1.0, t < 2.0], [1.0, 2.0], 3.0), {1.0, 2.0}),
    "cond": (lambda t: jax.lax.cond(t < 1.0, lambda: 1.0, lambda: jnp.abs(t - 3.0)), {1.0, 3.0}),
    "heaviside": (lambda t: jnp.heaviside(t - 1.0, 0.5), {1.0}),
    "sign": (lambda t: jnp.sign(3.0 - t), {3.0}),
    "clip": (lambda t: jnp.where(jnp.clip(t, 1.0, 3.0) > 2.0, 1.0, 0.0), {1.0, 2.0, 3.0}),
    "interp": (lambda t: jnp.interp(2.0 * t, KNOTS, KNOTS**2), {0.0, 0.15, 0.5}),
    "held": (lambda t: KNOTS[jnp.clip(jnp.searchsorted(KNOTS, t) - 1, 0, 2)], {0.0, 0.3, 1.0}),
    "smooth": (lambda t: jnp.sqrt(1.0 + jnp.sin(t) ** 2), set()),
    "sinc": (jnp.sinc, set()),
}


@pytest.mark.parametrize("name", FOUND)
def test_times_are_found(name):
    function, expected = FOUND[name]
    times, unclear = jumps_of(function, 0.0)
    times = np.asarray(times)[np.isfinite(times)]
    assert {float(time) for time in times.round(12)} == expected
    assert unclear == ()


def test_comparisons_of_anything_else_are_reported():
    for function in (
        lambda t, y: jnp.where(jnp.sin(t) > 0.0, 1.0, -1.0),
        lambda t, y: jnp.where(t > y, 1.0, 0.0),
        lambda t, y: jnp.mod(t, 2.0),
        lambda t, y: KNOTS[(10.0 * t).astype(int)],
        lambda t, y: jnp.where(jnp.clip(t, 0.0, 1.0) + t > 2.5, 1.0, 0.0),
    ):
        assert jumps_of(function, 0.0, 0.0)[1]
    # A comparison of the state is no jump in time.
    assert jumps_of(lambda t, y: jnp.where(y > 0.0, t, 0.0), 0.0, 0.0)[1] == ()


def test_times_of_numbers_that_vary():
    def time(rate):
        return jumps_of(lambda t: jnp.where(rate * t > 3.0, 1.0, 0.0), 0.0)[0][0]

    assert jax.vmap(time)(jnp.array([1.0, 2.0])).tolist() == [3.0, 1.5]
    assert float(jax.grad(time)(2.0)) == -0.75
    assert not np.isfinite(time(0.0))
