"""Numbers of users' own systems from recorded runs."""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import Ball

from nonholonomic import Hybrid, Recording, identify, simulate


@pytest.mark.slow
def test_the_restitution_of_a_ball_from_its_heights():
    """Heights before and after two bounces, without noise, give back the restitution and the height of the drop."""
    times = np.array([0.2, 0.6, 0.9, 1.3, 1.5])
    heights = simulate(Hybrid([Ball(0.8)]), jnp.array([1.0, 0.0, 0.0]), 1.5, times=times).state[:, 0]
    data = Recording([1.2, 0.0, 0.0], times, heights, 1e-3, "y0")
    fit = identify(Hybrid([Ball(0.7)]), data, {"restitution": 0.75, "start[0]": 1.05}, progress=False)
    assert_close(fit.estimates["system.modes[0].restitution"], 0.8, rtol=1e-6)
    assert_close(fit.estimates["start[0]"], 1.0, rtol=1e-6)
