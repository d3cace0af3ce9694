"""Inputs of a user's mechanical systems, through their ports: closed forms, the balance of energy, derivatives, and fits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic import AbstractSystem, EventTimes, Recording, event_time, identify, simulate, sweep


class Cart(AbstractSystem):
    """A cart of mass 2 with drag, pushed through one port."""

    drag: float = 0.5
    dimension = 1
    names = ("x",)

    def metric(self, q):
        return 2.0 * jnp.eye(1)

    def force(self, t, q, rate):
        return -self.drag * rate

    def input(self, q):
        return jnp.eye(1)


class Cruise(eqx.Module):
    """A feedback law for a speed of 1."""

    gain: float

    def __call__(self, t, q, rate):
        return self.gain * (1.0 - rate[0])


REST = ([0.0], [0.0])


def gone(t, y):
    return 1.0 - y[0]


def speed(t, gain, drag=0.5):
    """2 v' = gain (1 - v) - drag v."""
    return gain / (gain + drag) * (1.0 - np.exp(-0.5 * (gain + drag) * t))


def time_to_the_mark(gain):
    return event_time(Cart(), REST, 20.0, gone, tolerance=1e-11, input=Cruise(gain))


def test_a_feedback_law_drives_a_cart():
    times = np.linspace(0.0, 3.0, 7)
    run = simulate(Cart(), REST, 3.0, times=times, input=Cruise(1.5), tolerance=1e-11)
    np.testing.assert_allclose(run["x_rate"], speed(times, 1.5), atol=1e-10)
    np.testing.assert_allclose(run["energy"], speed(times, 1.5) ** 2, atol=1e-10)
    np.testing.assert_allclose(run["input_power"], 1.5 * (1.0 - speed(times, 1.5)) * speed(times, 1.5), atol=1e-10)
    np.testing.assert_allclose(run["support_power"], 0.0, atol=1e-14)


def test_gains_are_swept_differentiated_and_fitted():
    options = {"event": gone, "input": Cruise(1.5), "progress": False}
    table = sweep(Cart(), REST, 20.0, axes={"input.gain": [1.0, 1.5]}, **options)
    np.testing.assert_allclose(table.time[1], time_to_the_mark(1.5), rtol=1e-6)
    slope = jax.grad(time_to_the_mark)(1.5)
    differences = [(time_to_the_mark(1.5 + h) - time_to_the_mark(1.5 - h)) / (2.0 * h) for h in (1e-2, 1e-3, 1e-4)]
    assert min(abs(slope / difference - 1.0) for difference in differences) < 1e-7
    data = EventTimes(REST, [float(table.time[1])], 1e-3, t1=20.0, event=gone, input=Cruise(1.2))
    fit = identify(Cart(), data, {"input.gain": 1.2}, progress=False)
    assert fit.estimates["input.gain"] == pytest.approx(1.5, abs=0.01)


class Ported(Cart):
    """A cart whose ports are given by the test."""

    ports: object = eqx.field(static=True, default=None)

    def input(self, q):
        return self.ports and jnp.array(self.ports)


def test_ports_and_inputs_of_whole_numbers():
    """As a user writes them: the product of numbers of two types is taken in floats."""
    run = simulate(Ported(ports=((1,),)), REST, 3.0, times=[3.0], input=lambda t, q, rate: (3,))
    np.testing.assert_allclose(run["x_rate"], 6.0 * (1.0 - np.exp(-0.75)), rtol=1e-7)


@pytest.mark.parametrize(("ports", "message"), [(None, "not None"), ((1.0,), r"not \(1,\)")], ids=["none", "vector"])
def test_ports_of_a_wrong_shape(ports, message):
    with pytest.raises(
        ValueError, match=r"input\(q\) must be of shape \(1, ports\), a column for each port, " + message
    ):
        simulate(Ported(ports=ports), REST, 1.0, input=lambda t, q, rate: 1.0)


def test_a_short_pulse_is_not_missed():
    def pulse(t, q, rate):
        return jnp.where((t > 1.0) & (t < 1.01), 100.0, 0.0)

    run = simulate(Cart(0.0), REST, 5.0, times=[0.9, 5.0], input=pulse)
    np.testing.assert_allclose(run["x_rate"], [0.0, 0.5], atol=1e-9)


class Brake(eqx.Module):
    """A push as far as a mark, and then back."""

    mark: float

    def __call__(self, t, q, rate):
        return jnp.where(q[0] > self.mark, -1.0, 1.0)


@pytest.mark.parametrize("transform", [lambda function: function, jax.grad], ids=["value", "derivative"])
def test_an_input_that_jumps_with_the_state_is_warned_of(transform):
    """Also where the run is differentiated, as the derivative lacks the effect of the jump."""
    with pytest.warns(UserWarning, match="derivatives leave out a jump that depends on the state: let it end a mode"):
        transform(lambda mark: simulate(Cart(0.0), REST, 3.0, times=[3.0], input=Brake(mark), tolerance=1e-11)["x"][0])(
            1.0
        )


class Skate(AbstractSystem):
    """A skate of unit mass and inertia, whose blade does not slip sideways, driven along the blade and about the normal."""

    dimension = 3

    def metric(self, q):
        return jnp.eye(3)

    def constraints(self, q):
        return jnp.stack([-jnp.sin(q[2]), jnp.cos(q[2]), 0.0])[None]

    def input(self, q):
        return jnp.stack([jnp.array([jnp.cos(q[2]), jnp.sin(q[2]), 0.0]), jnp.array([0.0, 0.0, 1.0])], axis=1)


def test_the_ports_of_a_constrained_system():
    """Pushed and turned steadily from rest, it has the speed t and the heading t^2 / 4; its energy is what the input did."""
    times = np.linspace(0.0, 2.0, 5)
    run = simulate(Skate(), (np.zeros(3), np.zeros(3)), 2.0, times=times, input=lambda t, q, rate: (1.0, 0.5))
    np.testing.assert_allclose(run["q2"], 0.25 * times**2, atol=1e-7)
    np.testing.assert_allclose(np.hypot(run["rate0"], run["rate1"]), times, atol=1e-7)
    np.testing.assert_allclose(run["energy"], 0.5 * times**2 + 0.125 * times**2, atol=1e-7)
    np.testing.assert_allclose(run["input_power"], times + 0.25 * times, atol=1e-7)


@pytest.mark.parametrize(
    ("input", "message"),
    [
        (
            2.0,
            r"input = 2\.0 must be a function u\(t, q, rate\) that returns 1 number, one for each column of input\(q\)",
        ),
        (
            lambda t, q, rate: jnp.ones(2),
            r"returns 1 number, one for each column of input\(q\), not an array of shape \(2,\)",
        ),
        (lambda t, q: 1.0, r"u\(t, q, rate\) raised TypeError: .*takes 2 positional arguments but 3 were given"),
    ],
    ids=["number", "two", "arguments"],
)
def test_inputs_that_do_not_fit_the_ports(input, message):
    with pytest.raises(ValueError, match=message):
        simulate(Cart(), REST, 1.0, input=input)


def test_recorded_runs_with_an_input_are_fitted():
    times = np.linspace(0.1, 3.0, 30)
    data = Recording(REST, times, speed(times, 1.5, 0.4), 1e-3, "x_rate", input=Cruise(1.5))
    fit = identify(Cart(), data, {"drag": 0.5}, progress=False)
    assert fit.estimates["system.drag"] == pytest.approx(0.4, abs=1e-3)
