"""Mechanical systems that strike something: impacts within constraints, alone and as modes of a `Hybrid`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import Bumper, Sleigh, after_impact

from nonholonomic import AbstractSystem, Hybrid, simulate
from nonholonomic.systems.form import check_start

HEADING, SPEED, TIME = 0.4, 1.5, 2.0
POINT = jnp.array([1.7, 0.4, 0.3, 1.0, 0.2, 0.7, HEADING, SPEED])


def sleigh_and_start(numbers):
    *fields, heading, speed = numbers
    rate = speed * jnp.stack([jnp.cos(heading), jnp.sin(heading), 0.0 * heading])
    return Bumper(*fields), (jnp.stack([0.0 * heading, 0.0 * heading, heading]), rate)


def end(numbers, tolerance=1e-10):
    """The state some time after the impact."""
    sleigh, start = sleigh_and_start(numbers)
    return simulate(sleigh, start, TIME, times=jnp.array([TIME]), tolerance=tolerance).state[-1]


def reduced(state):
    """Heading, forward velocity and turn rate."""
    return jnp.stack([state[2], jnp.cos(state[2]) * state[3] + jnp.sin(state[2]) * state[4], state[5]])


def exact(numbers):
    *fields, heading, speed = numbers
    return after_impact(Bumper(*fields), heading, speed, TIME)


def test_a_sleigh_strikes_a_wall_and_so_do_its_derivatives():
    """State and derivative some time after the impact against the closed form, along a change of all parameters."""
    direction = jnp.cos(1.0 + jnp.arange(POINT.size))
    state, slope = jax.jit(lambda numbers: jax.jvp(end, (numbers,), (direction,)))(POINT)
    expected, expected_slope = jax.jvp(exact, (POINT,), (direction,))
    assert_close(reduced(state), expected, rtol=1e-9)
    assert_close(jax.jvp(reduced, (state,), (slope,))[1], expected_slope, rtol=1e-7, atol=1e-7)


@pytest.mark.slow
def test_the_derivatives_of_the_whole_state_are_those_of_differences():
    """In reverse mode; of the steps of the central difference, the best one counts for each number."""
    slopes = jax.jit(jax.jacrev(end))(POINT)
    best = np.full(slopes.shape, np.inf)
    run = jax.jit(jax.vmap(lambda numbers: end(numbers, 1e-13)))
    for step in (1e-3, 1e-4, 1e-5):
        change = step * jnp.eye(POINT.size)
        states = run(jnp.concatenate([POINT + change, POINT - change]))
        differences = (states[: POINT.size] - states[POINT.size :]).T / (2.0 * step)
        best = np.minimum(best, np.abs(differences - slopes))
    assert np.max(best) < 1e-6


def energy_and_constraint(run, word):
    """Energy, and violation of the constraint, before or after the first reset."""
    names = ("x", "y", "heading", "x_rate", "y_rate", "heading_rate")
    state = jnp.array([run.resets[f"{name}_{word}"][0] for name in names])
    return run.model.parameters.tree["system"].energy(*jnp.split(state, 2)), Sleigh().constraints(state[:3]) @ state[3:]


@pytest.mark.slow
def test_an_impact_keeps_the_constraint_and_with_restitution_one_the_energy():
    sleigh, start = sleigh_and_start(POINT)
    bounced = simulate(Bumper(restitution=1.0), start, TIME, times=[TIME])
    assert list(bounced.names)[:4] == ["x", "y", "heading", "x_rate"]
    (before, _), (after, violation) = (energy_and_constraint(bounced, word) for word in ("before", "after"))
    assert_close(after, before, rtol=1e-14)
    assert abs(violation) < 1e-14
    damped = simulate(sleigh, start, TIME, times=[TIME])
    before, after = (energy_and_constraint(damped, word)[0] for word in ("before", "after"))
    c, s, b, turning = np.cos(HEADING), np.sin(HEADING), 0.2, 0.4 + 1.7 * 0.3**2
    lost = 0.5 * (1.0 - 0.7**2) * (SPEED * c) ** 2 / (c**2 / 1.7 + (b * s) ** 2 / turning)
    assert_close(before - after, lost, rtol=1e-9)


class Mirrored(Bumper):
    """A reset that turns the velocity back, whatever the blade allows."""

    def reset(self, t, q, rate):
        return q, rate.at[0].multiply(-1.0)


def test_a_reset_that_violates_a_constraint_is_followed_by_the_impulse_of_the_constraint():
    """The velocity (-v c, v s) of the blade, without turning, is projected onto the constraint in the metric.

    The impulse that is needed is one of the constraint: a multiple of its one-form.
    """
    _, start = sleigh_and_start(POINT)
    run = simulate(Mirrored(), start, TIME, times=[TIME])
    q = jnp.array([run.resets[f"{name}_after"][0] for name in ("x", "y", "heading")])
    rate = jnp.array([run.resets[f"{name}_rate_after"][0] for name in ("x", "y", "heading")])
    assert abs(Sleigh().constraints(q) @ rate) < 1e-14
    wanted = SPEED * jnp.array([-jnp.cos(HEADING), jnp.sin(HEADING), 0.0])
    normal, metric = Sleigh().constraints(q)[0], Sleigh().metric(q)
    impulse = metric @ (rate - wanted)
    assert_close(jnp.cross(impulse, normal), jnp.zeros(3), atol=1e-9)


class TableBall(AbstractSystem):
    """A ball on a table: its place and its turn, in units of its radius and mass; its slip is x' - angle'."""

    restitution: float = 0.8
    wall: float = 2.0
    grip: float = 3.0
    names = ("x", "angle")
    dimension = 2

    def metric(self, q):
        return jnp.diag(jnp.array([1.0, 0.4]))


class Sliding(TableBall):
    """Friction of one sign, until the slip ends; the wall is out of reach."""

    sign: float = 1.0

    def force(self, t, q, rate):
        return self.sign * self.grip * jnp.array([-1.0, 1.0])

    def margin(self, t, q, rate):
        return self.sign * (rate[0] - rate[1])

    def reset(self, t, q, rate):
        return q, rate, 1


class Rolling(TableBall):
    """Without slip, up to the wall, which changes the velocity and not the spin."""

    def constraints(self, q):
        return jnp.array([[1.0, -1.0]])

    def margin(self, t, q, rate):
        return self.wall - q[0]

    def reset(self, t, q, rate):
        return q, rate.at[0].multiply(-self.restitution), 2


BALL = Hybrid([Sliding(), Rolling(), Sliding(sign=-1.0)])


def test_a_ball_slides_rolls_and_strikes_a_wall_as_modes_of_a_hybrid():
    """Sliding takes 2/7 of the velocity; after the wall (5 x' + 2 angle') / 7 is conserved while the ball slides."""
    start = ([0.0, 0.0], [3.5, 0.0])
    run = simulate(BALL, start, 3.0, times=[3.0])
    assert run.resets["mode_before"].tolist() == [0, 1, 2]
    assert run.resets["mode_after"].tolist() == [1, 2, 1]
    assert_close(run.resets["time"][0], 2.0 * 3.5 / (7.0 * 3.0), rtol=1e-9)
    assert_close(run.resets["x_rate_after"], [2.5, -0.8 * 2.5, 2.5 * (2.0 - 5.0 * 0.8) / 7.0], rtol=1e-9)
    assert_close(run["x_rate"], run["angle_rate"], rtol=1e-12)


def broken(kind, **functions):
    return type("Broken", (kind,), functions)()


WRONG = {
    "a margin that is a matrix": (
        lambda: broken(Bumper, margin=lambda self, t, q, rate: jnp.outer(q, q)),
        r"margin\(t, q, rate\) must be one number, an array of shape \(k,\), a dict of numbers by name, or None, not \(3, 3\)",
    ),
    "a reset that does not expect several margins": (
        lambda: broken(Bumper, margin=lambda self, t, q, rate: 1.0 - q),
        r"reset\(t, q, rate\) raised TypeError.*and exit, which of them fell, if the mode has several margins",
    ),
    "a reset without rates": (
        lambda: broken(Bumper, reset=lambda self, t, q, rate: q),
        r"reset\(t, q, rate\) must be \(q, rate\), both of shape \(3,\), or None",
    ),
    "a branch in the reset of a mode": (
        lambda: Hybrid([Sleigh(), broken(Bumper, reset=lambda self, t, q, rate: (q, -rate if rate[0] > 0 else rate))]),
        r"modes\[1\]\.reset\(t, q, rate\) cannot be traced by JAX",
    ),
    "systems of two sizes": (lambda: Hybrid([Sleigh(), TableBall()]), r"one number of coordinates, not 2, 3"),
    "a Lagrangian that is a vector": (
        lambda: Hybrid([broken(Sleigh, lagrangian=lambda self, q, rate: rate)]),
        r"modes\[0\]\.lagrangian\(q, rate\) must be one number, not \(3,\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_functions_are_named(name):
    build, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        simulate(build(), (np.zeros(3), np.zeros(3)), 1.0)


def test_the_start_of_a_hybrid_obeys_the_constraints_of_its_first_mode():
    with pytest.raises(ValueError, match=r"start: rate = .* violates the constraints by 1"):
        simulate(Hybrid([Rolling(), Sliding(), Rolling()]), ([0.0, 0.0], [1.0, 0.0]), 1.0)


def test_a_reset_without_a_margin_is_reported():
    with pytest.warns(UserWarning, match=r"Broken\.reset is never called: write margin too"):
        check_start(broken(Sleigh, reset=Bumper.reset), (np.zeros(3), np.zeros(3)))
