"""Bounds of functions over boxes: they hold for every point inside, and are exact where a variable occurs once."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.compilation.tracing import (
    MONOTONE,
    RULES,
    RULES_WITH_PARAMETERS,
    Bounds,
    UnboundedError,
    enclosing,
)

FUNCTIONS = {
    "abs": jnp.abs,
    "acos": lambda x, y: jnp.arccos(x / 9.0),
    "asin": lambda x, y: jnp.arcsin(x / 9.0),
    "atan2": lambda x, y: jnp.arctan2(x, y),
    "cos": lambda x, y: jnp.cos(3.0 * x) * y,
    "cosh": lambda x, y: jnp.cosh(x) - jnp.cosh(y),
    "div": lambda x, y: x / (y + 2.0),
    "eq": lambda x, y: jnp.where(jnp.round(x) == jnp.round(y), 1.0, x),
    "ge": lambda x, y: jnp.where(x >= y, x, -y),
    "gt": lambda x, y: jnp.where(x > y, x * y, y),
    "one_minus_square": lambda x, y: jax.jvp(jnp.tanh, (x,), (y,))[1],
    "le": lambda x, y: jnp.where(x <= y, x, y),
    "lt": lambda x, y: jnp.where(x < y, x, 2.0 * y),
    "mul": lambda x, y: x * y - x * x,
    "ne": lambda x, y: jnp.where(jnp.round(x) != jnp.round(y), 1.0, x),
    "neg": lambda x, y: -x,
    "not": lambda x, y: jnp.where(~(x < y), x, y),
    "pow": lambda x, y: (x + 5.0) ** y,
    "rsqrt": lambda x, y: jax.lax.rsqrt(x + 4.0),
    "select_n": lambda x, y: jnp.where((x > 0.0) & (y > 0.0), x, y),
    "sin": lambda x, y: jnp.sin(5.0 * x + y),
    "sqrt": lambda x, y: jnp.sqrt(x + 4.0),
    "square": lambda x, y: jnp.square(x - y),
    "sub": lambda x, y: x - y,
    "tan": lambda x, y: jnp.tan(x),
    "integer_pow": lambda x, y: x**3 - y**4 + (x + 6.0) ** -3 + (x + 6.0) ** -2,
    "growing": lambda x, y: (
        jnp.tanh(x) + jnp.exp(y) + jnp.clip(x, -1.0, 1.0) + jnp.maximum(x, y) + jnp.sum(jnp.stack([x, y]), axis=0)
    ),
    "dot_general": lambda x, y: jnp.tensordot(jnp.array([0.5, -2.0]), jnp.stack([jnp.sin(x), y]), axes=1),
    "erfc": lambda x, y: jax.scipy.special.erfc(x - y),
    "is_finite": lambda x, y: jnp.where(jnp.isfinite(1.0 / x), y, 100.0),
    "polynomial": lambda x, y: jnp.polyval(jnp.array([1.0, -0.5, 2.0]), x) - y,
    "reduce_prod": lambda x, y: jnp.prod(jnp.stack([x, y, x - y]), axis=0),
    "rem": lambda x, y: jnp.mod(2.0 * x, 1.5) + jax.lax.rem(y, 4.0 + 0.0 * x),
    "scan": lambda x, y: jax.lax.fori_loop(0, 3, lambda k, sum: jnp.cos(sum) * x + k, y),
    "sort": lambda x, y: jnp.sort(jnp.stack([x, y, 0.5 * x]), axis=0)[1],
    "switch": lambda x, y: jax.lax.select_n(
        jnp.int32(x > 0.0) + jnp.int32(y > 0.0), jnp.sin(x), jnp.cos(x), jnp.exp(x)
    ),
    "called": lambda x, y: jax.jit(jnp.sin)(x) + jax.nn.softplus(y),
    "whole": lambda x, y: jnp.where((jnp.abs(jnp.arange(4) - 1) < 2)[3], x, y),
}


def test_every_rule_is_tested():
    assert {*RULES, *MONOTONE, *RULES_WITH_PARAMETERS} <= set(FUNCTIONS)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_bounds_hold_inside_a_box(name):
    function = FUNCTIONS[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    ends = np.sort(rng.uniform(-3.0, 3.0, (2, 200)) + rng.uniform(-0.3, 0.3, (2, 2, 200)), axis=0)
    x, y = (Bounds(jnp.asarray(ends[0, k]), jnp.asarray(ends[1, k])) for k in range(2))
    if name == "abs":
        function = lambda x, y: jnp.abs(x)  # noqa: E731
    low, high = enclosing(function, x.low, y.low)(x, y).results
    parts = rng.uniform(size=(2, 50, 1))
    values = function(*(box.low + part * (box.high - box.low) for box, part in zip((x, y), parts, strict=True)))
    round_off = 1e-13 * (1.0 + np.abs(values))
    assert np.all((low <= values + round_off) & (values <= high + round_off))
    # Bounds of a box that is a point are the value there.
    at, point = (
        enclosing(function, x.low, y.low)(Bounds(x.low, x.low), Bounds(y.low, y.low)).results,
        function(x.low, y.low),
    )
    np.testing.assert_allclose(at, [point, point], rtol=1e-9, atol=1e-9)


def test_bounds_of_single_operations_are_exact():
    box = Bounds(jnp.asarray([-1.0, 0.5, 1.0]), jnp.asarray([2.0, 7.0, 1.5]))
    low, high = enclosing(jnp.cos, box.low)(box).results
    np.testing.assert_allclose(low, [np.cos(2.0), -1.0, np.cos(1.5)])
    np.testing.assert_allclose(high, [1.0, 1.0, np.cos(1.0)])
    low, high = enclosing(lambda x: 1.0 / x, box.low)(box).results
    assert np.isneginf(low[0])
    np.testing.assert_allclose([low[1:], high[1:]], [[1 / 7, 1 / 1.5], [2.0, 1.0]])


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.where(x > 1.0, 1.0, -1.0),
        lambda x: jnp.floor(x),
        lambda x: jnp.round(0.5 * x),
        lambda x: jnp.mod(x, 1.0),
        lambda x: jnp.arctan2(x - 1.0, -1.0 + 0.0 * x),
        lambda x: jnp.sign(x - 1.0),
        lambda x: jax.lax.fori_loop(0, 2, lambda k, sum: sum + (x > 1.0), jnp.zeros(3)),
    ],
)
def test_a_function_that_may_jump_says_so(function):
    """At 1; the other boxes end before it."""
    box = Bounds(jnp.array([0.9, 0.2, 0.5]), jnp.array([1.1, 0.3, 0.7]))
    leaps = [jnp.broadcast_to(leap, (3,)) for leap in enclosing(function, box.low)(box).leaps]
    np.testing.assert_array_equal(np.any(leaps, axis=0), [True, False, False])


def test_a_function_that_bends_does_not_jump():
    box = Bounds(jnp.array([0.9]), jnp.array([1.1]))
    function = lambda x: jnp.abs(x - 1.0) + jnp.maximum(x, 1.0) + jnp.clip(x, 0.0, 1.0)  # noqa: E731
    assert not np.any(enclosing(function, box.low)(box).leaps)


def test_a_function_with_a_loop_has_no_bounds():
    one = jnp.ones(())
    bounds = enclosing(lambda x: jax.lax.while_loop(lambda y: y < 1.0, lambda y: 2.0 * y, x), one)
    with pytest.raises(UnboundedError, match="while"):
        bounds(Bounds(one, one))
