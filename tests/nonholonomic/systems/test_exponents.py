"""Lyapunov exponents of users' own systems: through constraints and resets, and whole spectra."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import Sleigh

from nonholonomic import AbstractMode, AbstractSystem, Hybrid, lyapunov_exponent, lyapunov_spectrum
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


class Lorenz(AbstractMode):
    drive: float

    def field(self, t, y):
        return jnp.array([10.0 * (y[1] - y[0]), y[0] * (self.drive - y[2]) - y[1], y[0] * y[1] - 8.0 / 3.0 * y[2]])


def test_the_spectrum_of_lorenz():
    """0.9056, 0 and -14.572, dimension 2.062 (Sprott, Chaos and Time-Series Analysis, 2003); the sum is the divergence."""
    result = lyapunov_spectrum(Hybrid([Lorenz(28.0)]), [1.0, 1.0, 20.0], t1=500.0, tolerance=1e-7)
    assert result.status == "completed"
    assert (np.abs(result.exponents - [0.9056, 0.0, -14.572]) < 3.0 * result.errors).all()
    assert_close(result.sum, -41.0 / 3.0, rtol=1e-7)
    assert_close(result.dimension, 2.062, atol=5e-3)
    assert result.running.shape == (32, 3)
    assert_close(result.running[-1].sum(), -41.0 / 3.0, rtol=1e-7)
    assert "sum -13.67 +- " in str(result)


class Cat(AbstractMode):
    """Arnold's cat map once a second, and a component that decays."""

    decay: float

    def field(self, t, y):
        return jnp.array([0.0, 0.0, 1.0, -self.decay * y[3]])

    def margin(self, t, y):
        return 1.0 - y[2]

    def reset(self, t, y):
        return jnp.array([(2.0 * y[0] + y[1]) % 1.0, (y[0] + y[1]) % 1.0, 0.0, y[3]]), 0


def test_the_spectrum_through_resets_is_that_of_the_map():
    """ln((3 + sqrt 5) / 2) and its negative from the map, 0 along the motion, and the rate of decay."""
    growth = np.log((3.0 + np.sqrt(5.0)) / 2.0)
    result = lyapunov_spectrum(Hybrid([Cat(0.5)]), [0.3, 0.2, 0.5, 1.0], t1=40.0, tolerance=1e-8)
    assert_close(result.exponents, [growth, 0.0, -0.5, -growth], atol=1e-6)
    # The first two alone are the same.
    result = lyapunov_spectrum(Hybrid([Cat(0.5)]), [0.3, 0.2, 0.5, 1.0], t1=40.0, n=2, tolerance=1e-8)
    assert_close(result.exponents, [growth, 0.0], atol=1e-6)
    assert np.isnan(result.dimension)


class Bouncer(AbstractMode):
    """A ball on a table that vibrates."""

    restitution: float
    phase: float
    amplitude: float = 1.3

    def field(self, t, y):
        return jnp.array([y[1], -1.0])

    def margin(self, t, y):
        return y[0] - self.amplitude * jnp.sin(t + self.phase)

    def reset(self, t, y):
        table = self.amplitude * jnp.cos(t + self.phase)
        return jnp.array([y[0], -self.restitution * y[1] + (1.0 + self.restitution) * table]), 0


def test_both_exponents_of_a_driven_ball_are_half_the_loss_of_area():
    """On its stable motion with one impact in a period, a complex pair; each impact shrinks areas by e^2."""
    phase = -np.arccos(np.pi / 3.9)
    start = [1.3 * np.sin(phase) + 1e-9, np.pi]
    result = lyapunov_spectrum(Hybrid([Bouncer(0.5, phase)]), start, t1=1259.0, tolerance=1e-8)
    assert result.exponents.shape == (2,)
    assert_close(result.exponents, np.log(0.5) / (2.0 * np.pi), atol=3e-3)
    # Within one impact in the second half of the run.
    assert_close(result.sum, np.log(0.5) / np.pi, atol=3e-3)


def test_constraints_take_directions_away():
    """A bead on a rail has two coordinates that may change, and one rate: the others part neither from it nor to it."""
    start = ([1.0, 0.3], [0.0, 0.0])
    result = lyapunov_spectrum(Rail(), start, t1=6.0, tolerance=1e-8)
    assert_close(result.exponents, np.zeros(3), atol=1e-6)
    with pytest.raises(ValueError, match="n = 4 must be at most 3, the number of independent changes of the start"):
        lyapunov_spectrum(Rail(), start, t1=6.0, n=4)
    with pytest.raises(ValueError, match="n = 0 must be a whole number of at least 1"):
        lyapunov_spectrum(Rail(), start, t1=6.0, n=0)


def test_directions_shrink_at_their_own_rates_however_fast():
    """In a stretch of 1/32 of the run, one shrinks by exp(-125): more than the digits of a number beside the other."""
    result = lyapunov_spectrum(Hybrid([Decay(40.0)]), [1.0, 1.0], t1=100.0, tolerance=1e-6)
    assert_close(result.exponents, [0.0, -40.0], rtol=1e-6)


class Decay(AbstractMode):
    rate: float

    def field(self, t, y):
        return jnp.array([0.0 * y[0], -self.rate * y[1]])


class Merging(Cat):
    """Once a second, two components become 0.4 x + 0.3 y and twice that, so that a direction is lost but for round-off."""

    def reset(self, t, y):
        merged = 0.4 * y[0] + 0.3 * y[1]
        return jnp.array([merged, 2.0 * merged + 0.0 * y[1], 0.0, y[3]]), 0


def test_a_direction_that_resets_take_away_has_no_finite_exponent():
    """The map has the eigenvalues 1 and 0."""
    result = lyapunov_spectrum(Hybrid([Merging(0.5)]), [0.3, 0.2, 0.5, 1.0], t1=40.0, tolerance=1e-8)
    assert_close(result.exponents, [0.0, 0.0, -0.5, -np.inf], atol=1e-6)
    assert result.sum == -np.inf
