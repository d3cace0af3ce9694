"""The lockstep driver on problems with closed forms: events, guards, refilled lanes, order of the method."""

import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from jax.extend.core import ClosedJaxpr
from scipy.optimize import brentq

from nonholonomic.integration import (
    AbstractPassive,
    AbstractProblem,
    ExtendedProblem,
    Oscillatory8,
    Settings,
    explicit_tableau,
    solve_by_diffrax,
    solve_ensemble,
)
from nonholonomic.integration.problem import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END
from nonholonomic.integration.scheduler import LaneScheduler, Recorder
from nonholonomic.integration.step import try_step

pytestmark = pytest.mark.oldest


class Oscillators(AbstractProblem):
    """x = cos(w t), y = -sin(w t); the event is x = `level`, the guard y + `floor` > 0."""

    frequency: jax.Array
    level: jax.Array
    floor: jax.Array

    def start(self):
        one = jnp.ones_like(self.frequency)
        return jnp.stack([one, 0.0 * one]), jnp.stack([one, one])

    def field(self, time, state):
        return jnp.stack([self.frequency * state[1], -self.frequency * state[0]])

    def event_function(self, state):
        return state[0] - self.level

    def domain_margin(self, time, state):
        return state[1] + self.floor


SOLVER = Oscillatory8()


#: As many cells, padding included, so that one program serves most tests.
CELLS = 40


def run(frequency, level=0.5, floor=2.0, t1=10.0, lanes=8, tolerance=1e-10, solver=SOLVER, max_steps=10_000, **options):
    cells = len(frequency)
    frequency = jnp.asarray(np.pad(np.asarray(frequency, float), (0, max(CELLS - cells, 0)), mode="edge"))
    problem = Oscillators(frequency, jnp.asarray(level), jnp.asarray(floor))
    settings = Settings(tolerance, solver, lanes=lanes, max_steps=max_steps)
    outcome, iterations = solve_ensemble(problem, jnp.asarray(t1), jnp.asarray(cells), settings, **options)
    return jax.tree.map(lambda values: np.asarray(values)[..., :cells], outcome), iterations


def test_the_first_crossing_is_located():
    """cos(w t) = 1/2 at pi/(3 w), for more cells than lanes and very different costs."""
    frequency = np.geomspace(0.2, 50.0, 37)
    outcome, iterations = run(frequency)
    assert (np.asarray(outcome.status) == CROSSED).all()
    assert_close(outcome.crossing_time, math.pi / 3.0 / frequency, rtol=1e-9)
    assert int(outcome.steps.sum()) <= int(iterations) * 8


class Area(AbstractPassive):
    """The integral of x^2."""

    def rates(self, problem, time, state, passive):
        return jnp.concatenate([problem.field(time, state), state[:1] ** 2])


@pytest.mark.parametrize("ends_on_event", [True, False])
def test_a_passive_integral_is_kept_behind_the_state(ends_on_event):
    """The integral of cos^2(w t) is t/2 + sin(2 w t)/(4 w); event and margin are those of the state alone."""
    frequency = jnp.asarray([0.5, 2.0, 3.0])
    problem = Oscillators(frequency, jnp.asarray(0.5), jnp.asarray(2.0 if ends_on_event else 0.5))
    extended = ExtendedProblem(problem, Area(), jnp.ones((1, 3)), jnp.ones((1, 3)), ends_on_event)
    outcome, _ = solve_ensemble(extended, jnp.asarray(10.0), jnp.asarray(3), Settings(1e-10, SOLVER))
    assert (np.asarray(outcome.status) == (CROSSED if ends_on_event else LEFT_DOMAIN)).all()
    assert_close(outcome.end_time, (math.pi / 3.0 if ends_on_event else math.pi / 6.0) / frequency, rtol=1e-6)
    time = outcome.end_time
    assert_close(outcome.state[2], 1.0 + time / 2.0 + jnp.sin(2.0 * frequency * time) / (4.0 * frequency), rtol=1e-9)


def test_cells_of_like_cost_leave_no_lane_idle():
    """Two rounds of a block are two rounds, although its lanes do not end at the same step."""
    outcome, iterations = run(np.linspace(9.0, 10.0, 128), level=-2.0, lanes=64)
    assert (np.asarray(outcome.status) == REACHED_END).all()
    steps = np.asarray(outcome.steps)
    assert steps.min() < steps.max()
    assert int(iterations) * 64 < 1.1 * steps.sum()


def cleared(program):
    """The sizes of the arrays that a program fills with one number."""
    for equation in program.eqns:
        if equation.primitive.name == "broadcast_in_dim":
            yield equation.outvars[0].aval.size
        for parameter in jax.tree.leaves(equation.params, is_leaf=lambda leaf: isinstance(leaf, ClosedJaxpr)):
            yield from cleared(parameter.jaxpr) if isinstance(parameter, ClosedJaxpr) else ()


def test_steps_reuse_the_memory_of_their_stages():
    """Filling 50 KB with zeros in every step took a tenth of the time of a table."""
    sizes = []

    class Watching(Recorder):
        def begin(self, in_lanes, lane_state, collected):
            return None

        def step(self, in_lanes, lane_state, record, iteration):
            program = jax.make_jaxpr(lambda lane_state: try_step(*in_lanes, lane_state))(lane_state)
            sizes.append((lane_state.stages.size, max(cleared(program.jaxpr))))
            return try_step(*in_lanes, lane_state), record

    problem = Oscillators(jnp.ones(8), jnp.asarray(0.5), jnp.asarray(2.0))
    scheduler = LaneScheduler.of(problem, jnp.asarray(1.0), jnp.asarray(8), Settings(1e-6, SOLVER))
    jax.eval_shape(lambda: scheduler.run(scheduler.start(), Watching())[0].iterations)
    (of_stages, largest), *_ = sizes
    assert of_stages == 13 * 2 * 8
    assert largest < of_stages / 2


def test_the_guard_ends_a_run_where_it_vanishes():
    """y = -sin(w t) falls to -0.3 before x falls to 1/2."""
    outcome, _ = run([1.0, 3.0], floor=0.3)
    assert (np.asarray(outcome.status) == LEFT_DOMAIN).all()
    assert_close(outcome.end_time, math.asin(0.3) / np.array([1.0, 3.0]), rtol=1e-9)


def test_the_horizon_is_met_exactly():
    outcome, _ = run([1.0, 2.0], level=-2.0, t1=7.5)
    assert (np.asarray(outcome.status) == REACHED_END).all()
    assert_close(outcome.end_time, 7.5)
    assert_close(outcome.state[0], np.cos(7.5 * np.array([1.0, 2.0])), atol=1e-8)
    assert np.isinf(outcome.crossing_time).all()


def test_the_last_crossing_of_many():
    """Passing through: x falls below 1/2 at (2 pi k + pi/3)/w; the last time before t1 counts."""
    frequency = np.array([0.7, 1.3, 5.0])
    outcome, _ = run(frequency, nonterminal=True, t1=20.0)
    turn_count = np.floor((20.0 * frequency - math.pi / 3.0) / (2.0 * math.pi))
    assert_close(outcome.crossing_time, (2.0 * math.pi * turn_count + math.pi / 3.0) / frequency, rtol=1e-9)
    assert_close(outcome.state[0], np.cos(20.0 * frequency), atol=1e-7)


def test_a_dip_between_the_ends_of_a_step_is_found():
    """The domain margin is negative for a third of a period; with a loose tolerance, steps are half a period long."""
    outcome, _ = run([1.0], level=-2.0, floor=0.5, tolerance=1e-2)
    assert outcome.status[0] == LEFT_DOMAIN
    assert_close(outcome.end_time, math.asin(0.5), atol=2e-2)


def test_padding_is_not_run():
    frequency = jnp.array([1.0, 2.0, 3.0, 4.0])
    problem = Oscillators(frequency, jnp.asarray(0.5), jnp.asarray(2.0))
    settings = Settings(1e-9, absolute=1.0, lanes=4)
    outcome, iterations = solve_ensemble(problem, jnp.asarray(9.0), jnp.asarray(2), settings)
    assert_close(outcome.crossing_time[:2], math.pi / 3.0 / frequency[:2], rtol=1e-8)
    assert outcome.steps[2:].tolist() == [0, 0]
    _, empty = solve_ensemble(problem, jnp.asarray(9.0), jnp.asarray(0), settings)
    assert empty == 0
    assert iterations > 0


def test_a_dip_between_the_stages_of_a_step_is_found():
    """x = cos t is below -0.9999 for 0.028 s, inside a step twenty times as long whose stages all miss this interval."""
    level = -0.9999
    outcome, _ = run([1.0], level=level, t1=8.0, tolerance=1e-6)
    assert int(outcome.status[0]) == CROSSED
    assert int(outcome.steps[0]) < 60
    assert_close(outcome.crossing_time, [math.acos(level)], atol=1e-3)


@pytest.mark.parametrize("solver", [Oscillatory8(), diffrax.Dopri8(), diffrax.Dopri5(), diffrax.Bosh3()])
@pytest.mark.parametrize("depth", [1e-2, 1e-4, 1e-7])
def test_a_short_loss_between_the_stages_of_a_step_is_found(solver, depth):
    """The margin 1 - depth - sin(w t) is negative for sqrt(8 depth) / w; it ends the run at asin(1 - depth) / w."""
    frequency = np.geomspace(0.3, 4.0, 8)
    outcome, _ = run(frequency, level=-2.0, floor=1.0 - depth, tolerance=1e-8, solver=solver, t1=4.0 * math.pi / 0.3)
    assert (np.asarray(outcome.status) == LEFT_DOMAIN).all()
    assert_close(outcome.end_time, math.asin(1.0 - depth) / frequency, rtol=1e-3)


def test_what_comes_close_to_a_loss_goes_on_and_costs_little():
    """The margin 1 + height - sin(w t) has a least value of `height` in every period."""
    frequency = np.geomspace(0.3, 4.0, 8)
    outcome, _ = run(frequency, level=-2.0, floor=2.0, tolerance=1e-8, t1=40.0)
    for height in (1e-2, 1e-4, 1e-6):
        close, _ = run(frequency, level=-2.0, floor=1.0 + height, tolerance=1e-8, t1=40.0)
        assert (np.asarray(close.status) == REACHED_END).all()
        assert int(close.steps.sum()) < 1.6 * int(outcome.steps.sum())


def test_too_many_steps_and_nonsense_are_failures():
    outcome, _ = run([1.0], level=-2.0, t1=1e3, max_steps=20)
    assert outcome.status[0] == FAILED
    outcome, _ = run([math.nan], level=-2.0)
    assert outcome.status[0] == FAILED


def time_of(numbers):
    """The time at which an oscillator of rate w reaches a level; exactly acos(level) / w."""
    problem = Oscillators(numbers[:1], numbers[1:], jnp.asarray(2.0))
    settings = Settings(1e-12, absolute=1.0, lanes=1)
    outcome, _ = solve_ensemble(problem, jnp.asarray(9.0), jnp.asarray(1), settings, traced=True)
    return outcome.crossing_time[0]


def exact_time_of(numbers):
    return jnp.arccos(numbers[1]) / numbers[0]


POINT = jnp.array([1.7, 0.4])


def test_the_derivative_is_that_of_the_implicit_function_theorem():
    """dt/dw = -t/w, dt/dlevel = -1/(w sqrt(1 - level^2))."""
    assert_close(jax.jit(jax.jacfwd(time_of))(POINT), jax.jit(jax.jacfwd(exact_time_of))(POINT), rtol=1e-10)


@pytest.mark.slow
def test_so_is_the_second_derivative():
    """`tippe.inversion_time` has its own in the ordinary run."""
    assert_close(jax.jacfwd(jax.jacfwd(time_of))(POINT), jax.hessian(exact_time_of)(POINT), rtol=1e-8, atol=1e-9)


class Growing(AbstractProblem):
    """x = exp(t/20) cos(t); the event, x = -2, comes in the third period."""

    def start(self):
        return jnp.array([[1.0], [0.0]]), jnp.ones((2, 1))

    def field(self, time, state):
        return jnp.stack([0.05 * state[0] + state[1], 0.05 * state[1] - state[0]])

    def event_function(self, state):
        return state[0] + 2.0

    def domain_margin(self, time, state):
        return None


@pytest.mark.parametrize(
    "solver",
    [
        *(
            pytest.param(solver, marks=pytest.mark.slow)
            for solver in (diffrax.Bosh3(), diffrax.Dopri5(), diffrax.Dopri8())
        ),
        diffrax.Tsit5(),
        Oscillatory8(),
    ],
)
def test_locating_an_event_adds_no_error_of_its_own(solver):
    """The crossing time is as good as the solution: its error is that of x at the event, divided by x'."""
    exact = brentq(lambda t: math.exp(t / 20.0) * math.cos(t) + 2.0, 15.0, 15.7, xtol=1e-15)
    slope = math.exp(exact / 20.0) * (math.cos(exact) / 20.0 - math.sin(exact))
    for tolerance in (1e-6, 1e-8, 1e-10):
        settings = Settings(tolerance, solver, absolute=1.0, lanes=1)
        outcome_at_event, _ = solve_ensemble(Growing(), jnp.asarray(20.0), jnp.asarray(1), settings)
        outcome_at_horizon, _ = solve_ensemble(
            Growing(), jnp.asarray(exact), jnp.asarray(1), settings, nonterminal=True
        )
        error, state_error = (
            float(outcome_at_event.crossing_time[0]) - exact,
            float(outcome_at_horizon.state[0, 0]) + 2.0,
        )
        assert_close(error, -state_error / slope, rtol=0.2, atol=1e-11)


def test_an_interpolated_event_would_be_a_hundred_times_worse():
    """Dopri8 at 1e-10: Diffrax's dense output locates the same event with an error of 1e-8, this driver with 1e-11."""
    exact = brentq(lambda t: math.exp(t / 20.0) * math.cos(t) + 2.0, 15.0, 15.7, xtol=1e-15)
    settings = Settings(1e-10, diffrax.Dopri8(), absolute=1.0, lanes=1)
    dense = solve_by_diffrax(Growing(), jnp.asarray(20.0), settings)
    outcome_at_event, _ = solve_ensemble(Growing(), jnp.asarray(20.0), jnp.asarray(1), settings)
    assert abs(float(outcome_at_event.crossing_time[0]) - exact) < 0.01 * abs(float(dense.crossing_time[0]) - exact)


def test_implicit_solvers_are_refused():
    with pytest.raises(ValueError, match="must be an explicit Runge-Kutta solver of Diffrax"):
        explicit_tableau(diffrax.Kvaerno5())
