"""Lyapunov exponents of users' own mechanical systems with constraints."""

import jax
import jax.numpy as jnp
from close import assert_close
from own_modes import Sleigh

from nonholonomic import AbstractSystem, lyapunov_exponent
from nonholonomic.runs.model import model_of


class Rail(AbstractSystem):
    """A bead on one of many parallel rails, under the spring x'' = -x."""

    dimension = 2

    def metric(self, q):
        return jnp.eye(2)

    def potential(self, q):
        return 0.5 * q[0] ** 2

    def constraints(self, q):
        return jnp.array([[0.0, 1.0]])


def test_nearby_runs_stay_within_the_constraints():
    """The distance of two beads on neighbouring rails is constant; a bead that left its rail would move away."""
    result = lyapunov_exponent(Rail(), ([1.0, 0.3], [0.0, 0.0]), t1=6.0, tolerance=1e-8)
    assert_close(result.exponent, 0.0, atol=1e-6)
    assert str(result).startswith("largest Lyapunov exponent ")
    assert str(result).endswith(" 1/s, completed at 6 s")
    assert repr(result) == str(result)


def test_a_change_of_the_start_obeys_the_constraints():
    """Rates and heading of a sleigh change so that the rate across its blade remains zero."""
    sleigh, q, rate = Sleigh(), jnp.array([0.1, 0.2, 0.7]), jnp.array([jnp.cos(0.7), jnp.sin(0.7), 2.0])
    (change,) = model_of(sleigh, (q, rate)).without_event().direction(1).T

    def across(state):
        return sleigh.constraints(state[:3]) @ state[3:]

    assert_close(jax.jvp(across, (jnp.concatenate([q, rate]),), (change,))[1], 0.0, atol=1e-14)
    assert jnp.all(jnp.abs(change) > 1e-3)
