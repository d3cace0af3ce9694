"""One step of a Runge-Kutta method."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from scipy.integrate import solve_ivp

from nonholonomic.integration import Oscillatory8, Stabilized8
from nonholonomic.integration.runge_kutta import (
    explicit_step,
    explicit_tableau,
    inverse_root,
    memory_for_stages,
    middle_weights,
    stages_to_look,
    watched_places,
)


def field(time, state):
    """An oscillator whose frequency grows with time."""
    return jnp.stack([state[1], -(1.0 + time) * state[0]])


@pytest.mark.parametrize(
    "solver",
    [Oscillatory8(), Stabilized8(), diffrax.Dopri8(), diffrax.Tsit5(), diffrax.Bosh3(), diffrax.Heun()],
    ids=lambda value: type(value).__name__,
)
def test_a_step_is_that_of_diffrax(solver):
    """In three lanes: the state after a step, its error estimate, and the margins at its stages."""
    time, length = np.array([0.0, 0.5, 2.0]), np.array([0.1, 0.4, 1.5])
    state = jnp.array([[1.0, 0.3, -0.2], [0.0, 0.4, 0.01]])
    step = explicit_step(
        explicit_tableau(solver),
        field,
        lambda time, point: (10.0 + point[1], 20.0 + point[0]),
        lambda point, rate: point[0],
        jnp.asarray(time),
        state,
        field(time, state),
        jnp.asarray(length),
        jnp.stack([10.0 + state[1], 20.0 + state[0]]),
        # What the memory held before does not matter.
        jnp.full_like(memory_for_stages(explicit_tableau(solver), state), jnp.nan),
        looks := stages_to_look(explicit_tableau(solver).c),
    )
    term = diffrax.ODETerm(lambda t, y, _: field(t, y))
    for lane in range(3):
        t0, t1, y0 = time[lane], time[lane] + length[lane], state[:, lane]
        solver_state = solver.init(term, t0, t1, y0, None)
        y1, error, *_ = solver.step(term, t0, t1, y0, None, solver_state, made_jump=False)
        np.testing.assert_allclose(step.state[:, lane], y1, rtol=1e-13, atol=1e-15)
        np.testing.assert_allclose(np.abs(step.error[:, lane]), np.abs(error), rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(step.rate[:, lane], field(t1, y1), rtol=1e-12, atol=1e-14)
        assert step.margin[lane] == step.state[0, lane]
        assert step.margins[-1, :, lane].tolist() == [10.0 + step.state[1, lane], 20.0 + step.state[0, lane]]
    # As far from the start as the state moves in the part of the step that the places say.
    places = watched_places(explicit_tableau(solver), looks)
    assert len(places) == len(step.margins)
    excess = step.margins[:, 0, 0] - 10.0 - state[1, 0]
    # The second component falls at the rate 1 + t at first; the first stages of Bosh3 are of first order.
    np.testing.assert_allclose(excess, -(0.1 * places) - 0.5 * (0.1 * places) ** 2, atol=1.5e-3)
    # The first lane stays on its side; the last one is beyond it all along, where there are stages between start and end.
    assert step.first_negative[0] == 2.0
    interior = [fraction for fraction in explicit_tableau(solver).c if fraction < 1.0]
    assert step.first_negative[2] in interior or (not interior and step.first_negative[2] == 2.0)


def test_an_accelerator_gets_the_stages_written_out(monkeypatch):
    """The same step, and no loop in it, in which it would wait for the host at every branch."""
    tableau, time, length = explicit_tableau(diffrax.Bosh3()), jnp.array([0.0, 0.5]), jnp.array([0.1, 0.4])
    state = jnp.array([[1.0, 0.3], [0.0, 0.4]])

    def compiled():
        def step(state):
            start = (time, state, field(time, state), length, state[:1], memory_for_stages(tableau, state))
            looks = stages_to_look(tableau.c)
            return explicit_step(
                tableau, field, lambda time, point: (point[0],), lambda point, rate: None, *start, looks
            )

        return jax.jit(step)

    outcome = compiled()(state)
    assert "while" in compiled().lower(state).as_text()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert "while" not in compiled().lower(state).as_text()
    for name, value in compiled()(state)._asdict().items():
        np.testing.assert_allclose(getattr(outcome, name), value, rtol=1e-13, atol=1e-15, err_msg=name)


@pytest.mark.parametrize(
    ("solver", "order"),
    [(Oscillatory8(), 5), (Stabilized8(), 5), (diffrax.Dopri8(), 5), (diffrax.Tsit5(), 4), (diffrax.Bosh3(), 3)],
    ids=lambda value: type(value).__name__,
)
def test_the_state_in_the_middle_of_a_step_has_its_order(solver, order):
    """Halving the step divides its error by 2^(order + 1): on a nonlinear oscillator that depends on time."""
    tableau = explicit_tableau(solver)

    def rate(t, y):
        return np.array([y[1], -np.sin(y[0]) * (1.0 + t)])

    def middle(length):
        rates = [rate(0.0, start)]
        rows = [*tableau.a_lower[: len(middle_weights(tableau)) - 2], tableau.b_sol[: len(middle_weights(tableau)) - 1]]
        for row in rows:
            c = float(np.sum(row))
            rates.append(rate(c * length, start + length * np.tensordot(row, np.array(rates), 1)))
        return start + length * np.tensordot(middle_weights(tableau), np.array(rates), 1)

    start = np.array([0.7, 0.4])
    exact = {
        h: solve_ivp(rate, (0, h / 2), start, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1] for h in (0.4, 0.2)
    }
    errors = [np.abs(middle(h) - exact[h]).max() for h in (0.4, 0.2)]
    assert errors[0] > 1e-11
    assert np.log2(errors[0] / errors[1]) > order + 0.5


@pytest.mark.parametrize("order", [2, 3, 4, 5, 8])
def test_inverse_root(order):
    values = jnp.array([1e-12, 0.3, 1.0, 1e9])
    assert_close(inverse_root(values, order), np.asarray(values) ** (-1.0 / order), rtol=1e-14)
