"""Own systems whose functions compare the time, against closed forms."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import needs_browser, open_browser
from close import assert_close

import nonholonomic
from nonholonomic import AbstractMode, Hybrid, event_time, simulate, sweep
from nonholonomic.runs.model import model_of
from nonholonomic.runs.trajectory import page_of
from nonholonomic.views.pages import programs


class Pulse(AbstractMode):
    """A mass of 1 kg that a force pushes for a while."""

    start: float
    width: float
    force: float
    names = ("place", "speed")

    def field(self, t, y):
        return jnp.stack([y[1], jnp.where((t > self.start) & (t < self.start + self.width), self.force, 0.0)])


def place(start, width, force):
    """The place after 2 s."""
    return force * width * (2.0 - start - 0.5 * width)


def final(start, width, force):
    return simulate(Hybrid([Pulse(start, width, force)]), [0.0, 0.0], 2.0, times=[2.0]).state[0, 0]


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
@pytest.mark.parametrize("width", [1e-2, 1e-3])
def test_no_pulse_is_missed_in_a_table(width, tolerance):
    starts = np.array([0.3, 0.5, 1.1])
    system = Hybrid([Pulse(1.0, width, 1.0 / width)])
    table = sweep(system, [0.0, 0.0], 2.0, axes={"start": starts}, tolerance=tolerance, progress=False)
    assert_close(table["place"], place(starts, width, 1.0 / width), atol=1e-12)
    assert np.all(np.asarray(table["steps"]) < 20)


def test_samples_around_a_pulse():
    """A sample can be at the time of a jump; the pulse may begin at the start, and end at the end."""
    times = np.array([0.0, 0.5, 1.0, 2.0])
    run = simulate(Hybrid([Pulse(0.5, 0.5, 2.0)]), [0.0, 0.0], 2.0, times=times)
    assert_close(run.state, [[0.0, 0.0], [0.0, 0.0], [0.25, 1.0], [1.25, 1.0]], atol=1e-12)
    run = simulate(Hybrid([Pulse(0.0, 2.0, 2.0)]), [0.0, 0.0], 2.0, times=times)
    assert run.status == "completed"
    assert_close(run.state[:, 0], times**2, atol=1e-12)


def test_derivatives_by_the_times_of_jumps():
    starts, width, force = jnp.array([0.5, 0.3, 1.1]), 0.1, 3.0
    slopes = jax.jit(jax.vmap(jax.grad(final, (0, 1, 2)), (0, None, None)))(starts, width, force)
    expected = [-force * width * np.ones(3), force * (2.0 - starts - width), place(starts, width, 1.0)]
    assert_close(jnp.stack(slopes), np.stack(expected), atol=1e-10)
    hessian = jax.jit(jax.hessian(lambda p: final(p[0], p[1], force)))(jnp.array([0.5, width]))
    assert_close(hessian, [[0.0, -force], [-force, -force]], atol=1e-8)


def test_the_time_of_an_event_after_a_pulse():
    def time(start, width, force):
        return event_time(Hybrid([Pulse(start, width, force)]), [0.0, 0.0], 5.0, event=lambda t, y: 0.2 - y[0])

    def expected(start, width, force):
        return 0.2 / (force * width) + start + 0.5 * width

    (value, slopes), (right, expected_slopes) = (
        jax.jit(jax.value_and_grad(function, (0, 1, 2)))(0.5, 0.1, 3.0) for function in (time, expected)
    )
    assert_close(value, right, atol=1e-10)
    assert_close(jnp.stack(slopes), jnp.stack(expected_slopes), atol=1e-9)


class Push(AbstractMode):
    """A ball in a box without gravity; a force acts for a while, whatever the number of bounces."""

    start: float

    def field(self, t, y):
        return jnp.stack([y[1], jnp.heaviside(t - self.start, 0.0) - jnp.heaviside(t - self.start - 0.1, 0.0)])

    def margin(self, t, y):
        return 1.0 - y[0]

    def reset(self, t, y):
        return jnp.stack([jnp.ones_like(y[0]), -y[1]]), 0


def test_jumps_in_a_run_with_resets():
    """The times are those of the run, not of the mode. After a bounce at 1 s, the push turns the ball's speed from -1 to
    -0.9, and its derivative passes through resets."""

    def end(start):
        return simulate(Hybrid([Push(start)]), [0.0, 1.0], 2.0, times=[2.0]).state[0, 0]

    place, slope = jax.jit(jax.value_and_grad(end))(1.5)
    assert_close(place, 0.1 * 0.45, atol=1e-10)
    assert_close(slope, -0.1, atol=1e-9)


class Switched(AbstractMode):
    """A mode that ends at a time, by a margin that jumps."""

    end: float

    def field(self, t, y):
        return jnp.ones_like(y)

    def margin(self, t, y):
        return jnp.where(t < self.end, 1.0, -1.0)

    def reset(self, t, y):
        return 10.0 + y, 1


class After(AbstractMode):
    def field(self, t, y):
        return 2.0 * jnp.ones_like(y)


def test_a_margin_that_jumps_ends_its_mode_there():
    run = simulate(Hybrid([Switched(0.7), After()]), [0.0], 2.0, times=[0.5, 2.0])
    assert run.status == "completed"
    assert_close(run.resets["time"], [0.7], atol=1e-12)
    assert_close(run.state[:, 0], [0.5, 10.7 + 2.6], atol=1e-10)


def test_a_comparison_of_something_else_warns():
    class Square(AbstractMode):
        def field(self, t, y):
            return jnp.where(jnp.sin(t) > 0.0, 1.0, -1.0) + 0.0 * y

    with pytest.warns(UserWarning, match=r"modes\[0\].field\(t, y\) compares"):
        simulate(Hybrid([Square()]), [0.0], 1.0, times=[1.0])
    with pytest.raises(ValueError, match="jumps"):
        nonholonomic.simulate(Hybrid([After()]), [0.0], 1.0, jumps=[1.0])


def test_an_event_that_jumps_through_zero():
    def time(end):
        return event_time(Hybrid([After()]), [0.0], 2.0, event=lambda t, y: jnp.where(t < end, 1.0, -1.0))

    assert_close(jax.jit(jax.value_and_grad(time))(0.7), (0.7, 1.0), atol=1e-12)


@needs_browser
def test_a_page_does_not_miss_a_pulse():
    model = model_of(Hybrid([Pulse(0.5, 0.01, 100.0)]), [0.0, 0.0])
    live, _ = page_of(model, {"system.modes[0].start": (0.3, 1.2), "width": (1e-3, 0.1)}, 2.0)
    runs = [[0.5, 0.01], [1.1, 0.001], [0.3, 0.1]]
    script = f"""{programs(live)}
        const asks = integrator(live.answer);
        return {json.dumps(runs)}.map((values) => (asks.run(values), asks.read("outcome", values)[1]))"""
    with open_browser("300,200") as browser:
        browser.get("about:blank")
        places = browser.execute_script(script)
    assert_close(places, [place(*run, 100.0) for run in runs], atol=1e-9)
