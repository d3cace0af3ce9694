"""The generic exponent: on linear problems with known rates, and on Lorenz' system."""

import jax
import jax.numpy as jnp
import numpy as np
from close import assert_close

from nonholonomic.derivatives import exponent_of, growth
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import LEFT_DOMAIN, REACHED_END


class Shears(AbstractProblem):
    """x' = a x + y, y' = b y, z' = 1: the rates are a, b and 0; the guard ends a run when z reaches `end`."""

    a: jax.Array
    b: jax.Array
    end: jax.Array

    def start(self):
        one = jnp.ones_like(self.a)
        return jnp.stack([one, one, 0.0 * one]), jnp.stack([one, one, one])

    def field(self, time, state):
        return jnp.stack([self.a * state[0] + state[1], self.b * state[1], jnp.ones_like(state[2])])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return self.end - state[2]


class Lorenz(AbstractProblem):
    """Lorenz' system at 10, 28, 8/3, from points near its attractor."""

    x: jax.Array

    def start(self):
        one = jnp.ones_like(self.x)
        return jnp.stack([self.x, 1.0 + self.x, 20.0 * one]), jnp.stack([10.0 * one] * 3)

    def field(self, time, state):
        x, y, z = state
        return jnp.stack([10.0 * (y - x), x * (28.0 - z) - y, x * y - 8.0 / 3.0 * z])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return None


def follow(problem, t1, cells, stretches=32):
    directions = jnp.stack([jnp.full(cells, value) for value in (0.3, -0.7, 0.5)])
    logarithm, outcome = growth(problem, directions[None], t1, stretches, Settings(1e-9))
    return logarithm[:, 0], outcome


def test_known_rates_and_a_run_that_ends():
    """The exponent is the greatest of a, b and 0; growth counts to the end of the run, and not beyond the domain."""
    a, b, end = np.array([0.5, -0.3, -0.3, 0.5]), np.array([0.2, 0.8, -0.2, 0.2]), np.array([1e3, 1e3, 1e3, 17.0])
    logarithm, outcome = follow(Shears(*map(jnp.asarray, (a, b, end))), 40.0, 4)
    assert outcome.status.tolist() == [REACHED_END] * 3 + [LEFT_DOMAIN]
    assert_close(outcome.end_time, [40.0, 40.0, 40.0, 17.0], rtol=1e-9)
    exponent, error = exponent_of(logarithm, 40.0)
    assert_close(exponent[:3], [0.5, 0.8, 0.0], atol=2e-3)
    assert (np.abs(exponent[:3] - [0.5, 0.8, 0.0]) < error[:3]).all()
    # The closed form of the direction (0.3, -0.7, 0.5) after a time.
    for cell, time in enumerate(outcome.end_time):
        y = -0.7 * np.exp(b[cell] * time)
        x = 0.3 * np.exp(a[cell] * time) - 0.7 * (np.exp(a[cell] * time) - np.exp(b[cell] * time)) / (a[cell] - b[cell])
        expected = np.log(np.linalg.norm([x, y, 0.5]) / np.linalg.norm([0.3, -0.7, 0.5]))
        assert_close(logarithm[:, cell].sum(), expected, atol=1e-6)


def test_lorenz():
    """0.9056 (Sprott, Chaos and Time-Series Analysis, 2003), by the mean of 32 runs, and each within three of its errors."""
    logarithm, _ = follow(Lorenz(jnp.linspace(0.5, 12.0, 32)), 100.0, 32)
    exponent, error = exponent_of(logarithm, 100.0)
    assert_close(exponent.mean(), 0.9056, atol=0.02)
    assert (np.abs(exponent - 0.9056) < 3.0 * error).all()
    assert np.median(error) < 0.2
