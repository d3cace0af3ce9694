"""Hybrid runs whose motions are polynomials: a method without truncation error ends steps within round-off of an event."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from scipy.special import factorial

from nonholonomic import AbstractMode, Hybrid, event_time, sweep

AREA, T1, KEPT, KICK = 0.7, 6.0, 0.8, 0.6


class Piece(AbstractMode):
    """One derivative of the height y[0] is constant; at 0 the height is reflected or, where its rate is constant, set to 1.
    The last component is the area under it."""

    links: jax.Array  # which of the four components move with the next one
    pull: jax.Array
    other: int

    def field(self, t, y):
        return jnp.append(self.links * jnp.append(y[1:4], 0.0) - self.pull, y[0])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        height, rate = 1.0 - self.links[0], self.links[0] * (KICK - KEPT * y[1])
        return jnp.stack([height, rate, 0.5 * self.links[1], 0.25 * self.links[2], y[4]]), self.other


def system(degree):
    """Two modes, of different pull, in which the derivative of this order is constant."""
    links, pull = (jnp.arange(4) < degree - 1).astype(float), 9.81 * (jnp.arange(4) == degree - 1)
    return Hybrid([Piece(links, pull, 1), Piece(links, 1.3 * pull, 0)], event=lambda t, y: AREA - y[4])


def time(hybrid, height):
    return event_time(hybrid, jnp.stack([height, *4 * [0.0 * height]]), T1)


def exact(degree, height):
    """The time from the roots of the polynomials (NumPy)."""
    mode, elapsed, area, after = 0, 0.0, 0.0, [height, 0.0, 0.0, 0.0]
    while True:
        pull = 9.81 * (1.0, 1.3)[mode]
        motion = np.polynomial.Polynomial([*after[:degree], -pull] / factorial(np.arange(degree + 1)))

        def first(polynomial):
            roots = polynomial.roots()
            return min(roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-9)], default=np.inf)

        end, event = first(motion), first(motion.integ() + (area - AREA))
        if event < end:
            return elapsed + event
        after = [float(degree == 1), KICK - KEPT * motion.deriv()(end), 0.5, 0.25]
        mode, elapsed, area = 1 - mode, elapsed + end, area + motion.integ()(end)


@pytest.mark.parametrize("degree", [*(pytest.param(degree, marks=pytest.mark.slow) for degree in (1, 2, 3)), 4])
def test_runs_whose_steps_end_within_round_off_of_a_margin(degree):
    """Times and slopes of 128 heights, half of them of two digits, in one batch."""
    heights = np.concatenate([np.linspace(0.31, 1.9, 64), np.round(np.linspace(0.3, 2.0, 64), 2)])
    hybrid = system(degree)
    differentiated = jax.value_and_grad(lambda height: time(hybrid, height))
    times, slopes = jax.jit(jax.vmap(differentiated))(jnp.asarray(heights))
    assert_close(times, [exact(degree, height) for height in heights], rtol=1e-11)
    differences = [(exact(degree, height + 1e-6) - exact(degree, height - 1e-6)) / 2e-6 for height in heights[::16]]
    assert_close(slopes[::16], differences, rtol=1e-6)
    assert np.isfinite(slopes).all()


@pytest.mark.slow
def test_a_table_of_such_runs_has_all_its_times():
    heights = np.linspace(0.3, 2.0, 64)
    table = sweep(system(2), [1.0, 0.0, 0.0, 0.0, 0.0], T1, axes={"start[0]": heights}, progress=False)
    assert set(table.status) == {"event"}
    assert_close(table.time, [exact(2, height) for height in heights], rtol=1e-11)
