"""Samples of many runs against closed forms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.integration import AbstractProblem, Settings, solve_with_samples
from nonholonomic.integration.problem import LEFT_DOMAIN, REACHED_END

CELLS = 40


class Oscillators(AbstractProblem):
    """x'' = -rate^2 x from x = 1 at rest; the guard is lost where x falls below `least`."""

    rate: jnp.ndarray
    least: jnp.ndarray

    def start(self):
        one = jnp.ones_like(self.rate)
        return jnp.stack([one, 0.0 * one]), jnp.stack([one, self.rate])

    def field(self, time, state):
        return jnp.stack([state[1], -(self.rate**2) * state[0]])

    def event_function(self, state):
        return None

    def domain_margin(self, time, state):
        return state[0] - self.least


RATES = jnp.linspace(1.0, 9.0, CELLS)


def run(times, least=-2.0, tolerance=1e-10, **options):
    problem = Oscillators(RATES, jnp.full(CELLS, least))
    arguments = (jnp.asarray(10.0), jnp.asarray(CELLS), Settings(tolerance, lanes=16))
    return eqx.filter_jit(solve_with_samples)(problem, jnp.asarray(times), *arguments, **options)


@pytest.mark.parametrize("count", [3, 701])
def test_samples_are_as_good_as_the_end(count):
    """More runs than lanes; the samples lie wider than the steps, and closer."""
    times = np.linspace(0.0, 9.5, count)
    outcome, samples = run(times)
    assert np.all(outcome.status == REACHED_END)
    errors = np.abs(samples[..., 0] - np.cos(np.outer(RATES, times)))
    at_end = np.abs(outcome.state[0] - np.cos(10.0 * RATES))
    assert np.max(errors) < 10.0 * np.max(at_end)
    assert np.max(errors) < 1e-7


def test_each_run_has_its_own_times():
    times = np.linspace(0.3, 5.0, 7)[:, None] + np.linspace(0.0, 4.0, CELLS)
    _, samples = run(times)
    assert_close(samples[..., 0].T, np.cos(np.asarray(RATES) * times), atol=1e-7)


def test_a_run_whose_times_are_unknown_ends_at_once():
    """As in fits with an illegal clock; such a run must not hold up the others."""
    times = np.linspace(0.3, 5.0, 7)[:, None] + np.zeros(CELLS)
    times[:, 3] = np.nan
    outcome, samples = run(times)
    assert outcome.steps[3] <= 1
    assert np.all(np.isnan(samples[3]))
    assert np.all(np.isfinite(np.delete(np.asarray(samples), 3, axis=0)))


def test_after_the_end_there_are_no_numbers():
    times = np.linspace(0.0, 10.0, 201)
    outcome, samples = run(times, least=0.5)
    assert np.all(outcome.status == LEFT_DOMAIN)
    ends = np.pi / 3.0 / np.asarray(RATES)
    assert_close(outcome.end_time, ends, rtol=1e-8)
    assert np.array_equal(np.isfinite(samples[..., 0]), times <= ends[:, None])


def test_only_what_is_read_is_kept():
    """Phases and scaled vectors of runs that end between samples, more of them than lanes, read with each cell's own rate."""
    times = np.linspace(0.0, 10.0, 201)

    def read(cells, states):
        x, speed = states[:, 0], states[:, 1] / RATES[cells]
        return {"phase": jnp.arctan2(-speed, x), "circle": jnp.stack([x, speed], axis=-1)}

    _, samples = run(times, least=0.5, read=read)
    phases = np.outer(RATES, times)
    phases = np.where(phases <= np.pi / 3.0, phases, np.nan)
    assert_close(samples["phase"], phases, atol=1e-8)
    assert_close(samples["circle"], np.stack([np.cos(phases), -np.sin(phases)], axis=-1), atol=1e-8)


def test_the_error_falls_with_the_tolerance():
    times = np.linspace(0.0, 10.0, 31)
    errors = [
        float(np.max(np.abs(run(times, tolerance=tolerance)[1][..., 0] - np.cos(np.outer(RATES, times)))))
        for tolerance in (1e-6, 1e-8, 1e-10)
    ]
    assert errors[1] < 0.05 * errors[0]
    assert errors[2] < 0.05 * errors[1]
