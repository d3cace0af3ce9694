"""One step of a Runge-Kutta method, written out and in a loop."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic.integration.runge_kutta import explicit_step, explicit_tableau, looped_step


def field(time, state):
    """An oscillator whose frequency grows with time."""
    return jnp.stack([state[1], -(1.0 + time) * state[0]])


@pytest.mark.parametrize(
    "solver", [diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Bosh3()], ids=lambda one: type(one).__name__
)
def test_a_loop_over_stages_makes_the_step_that_is_written_out(solver):
    time, length = jnp.array([0.0, 0.5, 2.0]), jnp.array([0.1, 0.4, 1.5])
    state = jnp.array([[1.0, 0.3, -0.2], [0.0, 0.4, 0.01]])
    given = (explicit_tableau(solver), field, lambda time, at: at[0], time, state, field(time, state), length)
    one, other = explicit_step(*given), looped_step(*given)
    for name, value in one._asdict().items():
        np.testing.assert_allclose(getattr(other, name), value, rtol=1e-13, atol=1e-15, err_msg=name)
    # The last lane crosses zero on its way.
    assert one.first_negative[0] == 2.0
    assert one.first_negative[2] < 1.0
