"""Numbers of evaluations of the field and the domain margin in runs of several modes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.hybrid import AbstractBatchedMode, Transition, hybrid_samples, solve_hybrid_dense
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import REACHED_END, RUNNING

#: Turning rate [rad/s], how long a clock runs [s], and how long the other clock would run.
RATE, OWN, OTHER = 100.0, 0.05, 10.0

EVALUATIONS = {"field": 0, "guard": 0}


@pytest.fixture(autouse=True)
def _count_from_zero():
    EVALUATIONS.update(field=0, guard=0)


def counted(name, values):
    """The values themselves, counted each time that a compiled program comes by."""

    def count(values):
        EVALUATIONS[name] += values.size
        return values

    shape = jax.ShapeDtypeStruct(values.shape, values.dtype)
    called = jax.pure_callback(count, shape, jax.lax.stop_gradient(values), vmap_method="expand_dims")
    return values + 0.0 * called


class Turns(AbstractProblem):
    """A rotation (two components) while one of two clocks runs down (two components)."""

    state: jnp.ndarray
    clock: int
    # A callback is no part of a single kernel.
    fits_one_kernel = False

    def start(self):
        return self.state, jnp.ones_like(self.state)

    def field(self, time, state):
        zero = 0.0 * counted("field", state[0])
        passes = [zero - 1.0 * (self.clock == k) for k in range(2)]
        return jnp.stack([*passes, RATE * state[3], -RATE * state[2]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return counted("guard", state[self.clock])


class Turn(AbstractBatchedMode):
    """A rotation until the clock of the mode runs down; then the other mode begins."""

    clock: int = eqx.field(static=True)

    def problem(self, state):
        return Turns(state, self.clock)

    def reset_map(self, state, left):
        zero = jnp.zeros_like(state[0])
        next_mode = zero.astype(int) + 1 - self.clock
        clocks = [jnp.where(next_mode == k, OWN, OTHER) for k in range(2)]
        counts = jnp.ones((1, *zero.shape), int)
        return Transition(
            next_mode, jnp.stack([*clocks, *state[2:]]), zero, zero.astype(int) + RUNNING, zero + jnp.inf, counts
        )


def turning(first, tolerance, cells):
    """From the number of the first clock to the modes, the first of them, and the state."""
    first = jnp.broadcast_to(first, cells)
    clocks = jnp.where(jnp.arange(2)[:, None] == first, OWN, OTHER)
    start = jnp.concatenate([clocks, jnp.ones((1, cells)), jnp.zeros((1, cells))])
    return (Turn(0), Turn(1)), first.astype(int), start


@pytest.mark.slow
def test_a_single_run_is_watched_little_further_than_its_steps():
    """Room for 128 steps is reserved in a mode, each watched at eight places; with room for 2048, tops whose flights are
    short crawled."""
    modes, _, state = turning(jnp.asarray(0.0), 1e-6, 1)
    path = solve_hybrid_dense(modes, 0, state[:, 0], 0.32, Settings(1e-6), counters=1)
    assert path.status == REACHED_END
    assert path.counts.tolist() == [6]
    assert 8 * path.accepted < EVALUATIONS["guard"] < 7 * 2000


def test_no_run_of_a_batch_is_continued_in_a_mode_that_it_is_not_in():
    """Two runs that are never in the same mode; continued to the horizon in the other one, they would evaluate the field
    three times as often."""

    @jax.jit
    @jax.vmap
    def run(first):
        return hybrid_samples(turning, first, jnp.array([1.0]), jnp.asarray(1.0), Settings(1e-6), 1)

    samples = run(jnp.array([0.0, 1.0]))
    assert_close(samples.states[:, 0, 2:], [[np.cos(RATE), -np.sin(RATE)]] * 2, atol=1e-4)
    assert_close(samples.counts[:, 0], [19, 19])
    # Twelve stages for each run in each step.
    assert EVALUATIONS["field"] < 3 * 12 * float(jnp.sum(samples.steps))
