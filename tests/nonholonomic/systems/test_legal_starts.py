"""Starts and systems that are refused alone, and NaN and "illegal" among others; and parts without mass."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import Ball, Sleigh

from nonholonomic import AbstractSystem, Hybrid, event_time, explore, simulate, sweep
from nonholonomic.runs.model import model_of

HEADING, TURN, TIME = 0.3, 1.1, 2.0
START = ([0.0, 0.0, HEADING], [0.0, 0.0, TURN])


class Skate(AbstractSystem):
    """A blade at (x, y) and a mass ahead of it: without inertia, the metric is singular."""

    mass: float = 2.0
    inertia: float = 0.0
    ahead: float = 1.3
    dimension = 3

    def metric(self, q):
        across = self.mass * self.ahead * jnp.array([-jnp.sin(q[2]), jnp.cos(q[2])])
        G = self.mass * jnp.eye(3).at[2, 2].set(0.0)
        G = G.at[:2, 2].set(across).at[2, :2].set(across)
        return G.at[2, 2].set(self.inertia + self.mass * self.ahead**2)

    def constraints(self, q):
        return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])


def pace(inertia, mass=2.0, ahead=1.3):
    """From v' = a w^2 and (I + m a^2) w' = -m a v w, the turn rate falls as 1 / cosh(pace * time) from rest."""
    return ahead * TURN * np.sqrt(mass / (inertia + mass * ahead**2))


def turn(inertia, time):
    return TURN / np.cosh(pace(inertia) * time)


class Redundant(Skate):
    def constraints(self, q):
        (row,) = Skate.constraints(self, q)
        other = jnp.array([0.0, 0.0, 1.0])
        return jnp.stack([row, other, row - 2.0 * other])


class Asymmetric(Skate):
    def metric(self, q):
        return Skate.metric(self, q).at[0, 2].set(0.0)


@pytest.mark.parametrize("inertia", [0.0, 0.2, -1.0], ids=["massless", "massive", "positive for allowed rates alone"])
def test_a_metric_need_be_positive_only_for_the_allowed_rates(inertia):
    run = simulate(Skate(inertia=inertia), START, TIME, times=[1.0, TIME])
    assert_close(run["rate2"], turn(inertia, np.array([1.0, TIME])), 1e-8)


ILLEGAL = {
    "a constraint is violated": (
        Skate(),
        (START[0], [0.5, 0.0, TURN]),
        r"start: rate = .* violates the constraints by",
    ),
    "a mass is negative": (Skate(mass=-1.0), START, r"metric\(q\) must be positive .* eigenvalue for them is -1\.69"),
    "no mass at all": (
        Skate(mass=0.0),
        START,
        r"metric\(q\) must be positive for all rates that the constraints allow",
    ),
    "an allowed inertia is negative": (
        Skate(inertia=-3.5),
        START,
        r"metric\(q\) must be positive .* is -0\.12 at the start",
    ),
    "a metric is not finite": (Skate(mass=np.nan), START, r"metric\(q\) = .* at the start must be finite"),
    "a metric is not symmetric": (Asymmetric(), START, r"metric\(q\) = .* at the start must be symmetric"),
    "constraints are redundant": (
        Redundant(),
        (START[0], [0.0] * 3),
        r"constraints\(q\) has 3 rows of rank 2 at the start",
    ),
    "the margin is negative": (
        Hybrid([Ball()]),
        [-1.0, 0.0, 0.0],
        r"start: the margin of the first mode is -1, below zero",
    ),
    "a mode is illegal": (Hybrid([Skate(mass=-1.0)]), START, r"modes\[0\]\.metric\(q\) must be positive"),
}


@pytest.mark.parametrize("name", ILLEGAL)
def test_an_illegal_start_is_refused(name):
    system, start, message = ILLEGAL[name]
    with pytest.raises(ValueError, match=message):
        simulate(system, start, TIME)
    with pytest.raises(ValueError, match=message):
        event_time(system, start, TIME, event=lambda t, y: y[0] - 1.0)


def test_the_rules_do_not_depend_on_units():
    """In nanograms and kilometres, and with a gear of little mass beside a heavy one."""
    model_of(Skate(mass=2e-12, inertia=2e-13), START).check()
    model_of(Sleigh(1e9, 1e-9, 0.0), ([0.0] * 3, [1.0, 0.0, 0.5])).check()


def test_illegal_starts_in_a_batch_are_nan_and_illegal():
    """Also their derivatives; the others are as alone."""

    def end(mass, sideways):
        start = (jnp.array(START[0]), jnp.array([0.0, 1.0, 0.0]) * sideways + jnp.array(START[1]))
        run = simulate(Skate(mass, 0.2), start, TIME, times=[0.0, TIME])
        return run["rate2"][-1], run

    columns = jnp.array([2.0, -2.0, 2.0]), jnp.array([0.0, 0.0, 1.0])
    (ends, runs), slopes = jax.jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))(*columns)
    assert runs.status.tolist() == ["completed", "illegal", "illegal"]
    assert_close(ends[0], turn(0.2, TIME), 1e-8)
    assert np.isfinite(slopes[0])
    for part in (ends, slopes, runs.state):
        assert np.isnan(part[1:]).all()
    assert runs.mode.tolist() == [[0, 0], [-1, -1], [-1, -1]]


def test_a_table_computes_its_legal_cells_and_warns_once_of_the_others():
    axes = {"inertia": [0.0, -4.0, 0.2], "mass": [2.0, -1.0]}
    options = {"sensitivities": ["mass"], "event": lambda t, y: y[5] - 0.5, "progress": False}
    message = r"^4 of 6 cells are illegal: .* the first is at system.inertia = 0, system.mass = -1: metric\(q\) must be"
    with pytest.warns(UserWarning, match=message) as warnings:
        table = sweep(Skate(), START, 4.0, axes=axes, **options)
    assert len(warnings) == 1
    is_legal = np.array([[True, False], [False, False], [True, False]])
    assert np.array_equal(table["status"] != "illegal", is_legal)
    for name in table.variables:
        if table[name].dtype.kind == "f":
            assert np.array_equal(np.isfinite(table[name]), is_legal), name
    for row, inertia in ((0, 0.0), (2, 0.2)):
        assert_close(table["time"][row, 0], np.arccosh(TURN / 0.5) / pace(inertia), 1e-7)


def test_a_page_may_have_sliders_whose_ends_are_illegal():
    """Its rules are JavaScript; it draws only the legal runs."""
    assert "Skate" in explore(Skate(inertia=0.2), START, None, {"mass": (-1.0, 3.0)}, 0.5).html
