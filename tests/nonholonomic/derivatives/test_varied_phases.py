"""Derivatives through changes of mode, on problems with closed forms: a bouncing ball, and a ball that grazes a slope."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.derivatives import tangents_of
from nonholonomic.hybrid import (
    AbstractBatchedMode,
    Transition,
    solve_hybrid_with_tangents,
)
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import CROSSED, REACHED_END, RUNNING

CELLS = 8


class Fall(AbstractProblem):
    """Height [m], velocity [m/s] and number of bounces; the event is a level on the way down after some bounces."""

    states: jax.Array
    gravity: jax.Array
    level: jax.Array
    bounces: jax.Array

    def start(self):
        return self.states, jnp.ones_like(self.states)

    def field(self, time, state):
        return jnp.stack([state[1], -self.gravity + 0.0 * state[1], 0.0 * state[2]])

    def event_function(self, state):
        return jnp.where(state[2] >= self.bounces, state[0] - self.level, 1.0)

    def domain_margin(self, time, state):
        return state[0]


class Falls(AbstractBatchedMode):
    """Down to the ground, and up again in closed form to where the ball turns back."""

    gravity: jax.Array
    restitution: jax.Array
    level: jax.Array
    bounces: jax.Array

    def problem(self, state):
        return Fall(state, self.gravity, self.level, self.bounces)

    def reset_map(self, state, left):
        rebound = -self.restitution * state[1]
        rise = jnp.minimum(rebound / self.gravity, left)
        ends = rise < rebound / self.gravity
        height = rebound * rise - 0.5 * self.gravity * rise**2
        return Transition(
            mode=jnp.zeros(rise.shape, int),
            state=jnp.stack([height, rebound - self.gravity * rise, state[2] + 1.0]),
            elapsed=rise,
            status=jnp.where(ends, REACHED_END, RUNNING),
            crossing_time=jnp.full_like(rise, jnp.inf),
            counts=jnp.ones((1, *rise.shape), int),
            log_rates=jnp.zeros_like(rise),
        )


def time_of_level(height, gravity, restitution, level, bounces):
    """When the ball, dropped from a height [m], falls through the level for the first time after some bounces."""
    speed = jnp.sqrt(2.0 * gravity * height)
    bounced = speed / gravity * (1.0 + 2.0 * sum(restitution**k for k in range(1, bounces)))
    apex_heights = restitution**bounces * speed / gravity
    return bounced + apex_heights + jnp.sqrt(2.0 * (0.5 * gravity * apex_heights**2 - level) / gravity)


def settings_of(tolerance):
    """Derivatives that compile fast."""
    return Settings(tolerance, diffrax.Tsit5())


HEIGHTS, RESTITUTIONS = np.linspace(0.5, 2.0, CELLS), np.linspace(0.9, 0.6, CELLS)


@pytest.fixture(scope="module")
def balls():
    """Modes, directions, first modes and states of balls, and their slopes: by height, gravity, restitution and level."""
    numbers, bounces = (jnp.asarray(HEIGHTS), jnp.asarray(9.81), jnp.asarray(RESTITUTIONS), jnp.asarray(0.01)), 5

    def build(height, gravity, restitution, level):
        states = jnp.stack([height, 0.0 * height, 0.0 * height])
        return (Falls(gravity, restitution, level, jnp.asarray(float(bounces))),), states

    tangents = [tuple(jnp.full_like(number, j == k) for j, number in enumerate(numbers)) for k in range(len(numbers))]
    modes, states = build(*numbers)
    expected = jax.vmap(jax.grad(time_of_level, (0, 1, 2, 3)), (0, None, 0, None, None))(*numbers, bounces)
    arguments = (modes, tangents_of(build, numbers, tangents), np.zeros(CELLS, int), np.asarray(states))
    return (
        arguments,
        time_of_level(*numbers, bounces),
        np.stack([np.broadcast_to(number, CELLS) for number in expected]),
    )


@pytest.mark.slow
def test_a_bouncing_ball(balls):
    """Derivatives with respect to height, gravity, restitution and level, through five impacts and the flights between them."""
    arguments, times, expected = balls
    hybrid_outcome, sensitivities = solve_hybrid_with_tangents(*arguments, 50.0, CELLS, settings_of(1e-10), counters=1)
    assert (hybrid_outcome.status == CROSSED).all()
    assert (hybrid_outcome.counts == 5).all()
    assert not sensitivities.grazing.any()
    assert_close(hybrid_outcome.crossing_time, times, rtol=1e-9)
    assert_close(sensitivities.slopes, expected, rtol=1e-9)


def test_a_bouncing_ball_inside_a_transformation(balls):
    """At the horizon, without an event there, the variations say the same; some of the balls rise then, in closed form."""
    arguments, times, expected = balls

    @eqx.filter_jit
    def run(modes, directions, first, states, times):
        settings = settings_of(1e-10)
        first = jnp.asarray(first)
        return solve_hybrid_with_tangents(
            modes, directions, first, states, times, CELLS, settings, counters=1, ends_on_event=False, traced=True
        )

    hybrid_outcome, sensitivities = run(*arguments, times)
    assert (hybrid_outcome.status == REACHED_END).all()
    assert (hybrid_outcome.counts == 5).all()
    assert not sensitivities.grazing.any()
    assert_close(sensitivities.slopes, expected, rtol=1e-8)


class Over(AbstractProblem):
    """Place and height of a ball that flies level, until it has lived; the ground rises as a cube, and is level at (1, 1)."""

    states: jax.Array
    lives: jax.Array

    def start(self):
        return self.states, jnp.ones_like(self.states)

    def field(self, time, state):
        return jnp.stack([jnp.ones_like(state[0]), 0.0 * state[1]])

    def event_function(self, state):
        return self.lives - state[0]

    def domain_margin(self, time, state):
        return state[1] - 1.0 - (state[0] - 1.0) ** 3


class Flies(AbstractBatchedMode):
    """Until it strikes the ground, where the ball begins anew, high up."""

    lives: jax.Array

    def problem(self, state):
        return Over(state, self.lives)

    def reset_map(self, state, left):
        zero = jnp.zeros_like(left)
        counts = jnp.ones((1, *left.shape), int)
        running = jnp.full(left.shape, RUNNING)
        return Transition(zero.astype(int), jnp.stack([zero, zero + 20.0]), zero, running, zero + jnp.inf, counts)


def test_a_grazing_event_is_seen():
    """The time is 1 + cbrt(y - 1) + 2 for a ball at the height y: its derivative is right, or it is marked, when traced too."""
    heights, tolerance = 10.0 ** -np.arange(1.0, 13.0), 1e-9

    def build(height):
        return (Flies(jnp.asarray(2.0)),), jnp.stack([0.0 * height, height])

    point = (jnp.asarray(1.0 + heights),)
    modes, states = build(*point)
    directions = tangents_of(build, point, [(jnp.ones_like(heights),)])
    first = jnp.zeros(len(heights), int)

    @eqx.filter_jit
    def run(modes, directions, first, states):
        return solve_hybrid_with_tangents(
            modes,
            directions,
            first,
            states,
            jnp.asarray(9.0),
            len(heights),
            settings_of(tolerance),
            counters=1,
            traced=True,
        )

    hybrid_outcome, sensitivities = jax.tree.map(np.asarray, run(modes, directions, first, states))
    assert (hybrid_outcome.status == CROSSED).all()
    assert (hybrid_outcome.counts == 1).all()
    assert sensitivities.grazing[heights < 1e-8].all()
    assert not sensitivities.grazing[heights > 1e-7].any()
    is_regular = ~sensitivities.grazing
    assert_close(hybrid_outcome.crossing_time[is_regular], 3.0 + np.cbrt(heights[is_regular]), rtol=1e-9)
    assert_close(
        sensitivities.slopes[0][is_regular], np.cbrt(heights[is_regular]) / heights[is_regular] / 3.0, rtol=1e-2
    )
