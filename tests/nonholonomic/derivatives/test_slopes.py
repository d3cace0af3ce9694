"""Derivatives of event times, along with a run and back through it, on a problem with a closed form."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.derivatives import adjoint, tangents_of
from nonholonomic.integration import AbstractProblem, Settings
from nonholonomic.integration.problem import CROSSED, LEFT_DOMAIN

MOVED = ("rate", "height", "growth")
#: So many that the runs are differentiated backward.
MANY = (*MOVED, "height", "rate")
HEIGHTS = np.linspace(0.6, 4.0, 100)
RATES = np.geomspace(3.0, 0.2, 100)


class Decays(AbstractProblem):
    """y' = -rate (1 + growth t) y from y = height, and a clock; the event is y = 1/2, the guard is up when patience is."""

    rate: jax.Array
    height: jax.Array
    growth: jax.Array
    patience: jax.Array

    def start(self):
        zero = jnp.zeros_like(self.height)
        return jnp.stack([self.height, zero]), jnp.stack([zero + 1.0, zero + 1.0])

    def field(self, time, state):
        return jnp.stack([-self.rate * (1.0 + self.growth * time) * state[0], jnp.ones_like(state[0])])

    def event_function(self, state):
        return state[0] - 0.5

    def domain_margin(self, time, state):
        return self.patience - state[1]


def time_of_decay(rate, height, growth):
    return (jnp.sqrt(1.0 + 2.0 * growth * jnp.log(2.0 * height) / rate) - 1.0) / growth


def solve(point, tangents, patience, cells, solver, **options):
    def build(*numbers):
        return Decays(*numbers, patience)

    arguments = (jnp.asarray(50.0), cells, Settings(1e-11, solver))
    directions = tangents_of(build, point, tangents)
    return adjoint.ensemble_solve_with_tangents(
        build(*point), directions, arguments, **({"nonterminal": False, "one_kernel": True} | options)
    )


#: Runs that differ in patience, heights and cells share a program.
compiled_solve = eqx.filter_jit(solve)
gradients = jax.jit(jax.vmap(jax.grad(time_of_decay, (0, 1, 2)), (0, 0, None)))


def found_and_expected(names=MANY, patience=1e3, heights=HEIGHTS, cells=100, run=compiled_solve, **options):
    """Outcome, derivatives with respect to the named numbers, and their exact values; rate and height differ between cells."""
    point = (jnp.asarray(RATES), jnp.asarray(heights), jnp.asarray(0.7))
    tangents = [
        tuple(
            jnp.full_like(component, name == name_of_tangent)
            for component, name_of_tangent in zip(point, MOVED, strict=True)
        )
        for name in names
    ]
    options = {"solver": diffrax.Dopri8()} | options
    outcome, derivatives = run(point, tangents, jnp.asarray(patience), jnp.asarray(cells), **options)
    all_gradients = gradients(*point)
    return outcome, derivatives, [all_gradients[MOVED.index(name)] for name in names]


def compiled_anew():
    """`solve`, traced again so that patched constants take effect."""
    return eqx.filter_jit(lambda *arguments, **options: solve(*arguments, **options))


@pytest.mark.parametrize(
    ("names", "nonterminal", "solver"),
    [
        (MANY, False, diffrax.Dopri8()),
        pytest.param(MANY, True, diffrax.Tsit5(), marks=pytest.mark.slow),
        pytest.param(MOVED, False, diffrax.Dopri8(), marks=pytest.mark.slow),
        (("height", "rate"), True, diffrax.Dopri8()),
        pytest.param(("height", "height"), False, diffrax.Tsit5(), marks=pytest.mark.slow),
        pytest.param(("growth",), False, diffrax.Dopri8(), marks=pytest.mark.slow),
        (("growth",), True, diffrax.Tsit5()),
    ],
)
def test_the_slopes_are_those_of_the_closed_form(names, nonterminal, solver):
    """For a field that depends on time, more cells than lanes, methods whose last stage is and is not their end."""
    outcome, derivatives, expected = found_and_expected(names, solver=solver, nonterminal=nonterminal)
    assert_close(outcome.crossing_time, time_of_decay(RATES, HEIGHTS, 0.7), rtol=1e-9)
    for slope, expected_slope in zip(derivatives, expected, strict=True):
        assert_close(slope, expected_slope, rtol=1e-7)


@pytest.mark.parametrize(("count", "backward"), [(1, False), (2, False), (3, True), (5, True)])
def test_few_directions_are_integrated_forward_and_many_backward(count, backward, monkeypatch):
    """Forward, two numbers cost two thirds of a pass backward, and three a fifth more."""
    passes, backward_pass = [], adjoint.solve_with_adjoint

    def solve_with_adjoint(*arguments, **options):
        passes.append("backward")
        return backward_pass(*arguments, **options)

    monkeypatch.setattr(adjoint, "solve_with_adjoint", solve_with_adjoint)
    jax.eval_shape(lambda: found_and_expected(MANY[:count], run=solve)[1])
    assert bool(passes) is backward


def test_a_cell_that_ends_otherwise_has_no_slope_and_leaves_the_others_theirs():
    outcome, derivatives, expected = found_and_expected(patience=1.0)
    is_late = np.asarray(time_of_decay(RATES, HEIGHTS, 0.7)) > 1.0
    assert 20 < is_late.sum() < 80
    assert (np.asarray(outcome.status) == np.where(is_late, LEFT_DOMAIN, CROSSED)).all()
    for slope, expected_slope in zip(derivatives, expected, strict=True):
        assert_close(slope, np.where(is_late, 0.0, expected_slope), rtol=1e-7)


@pytest.mark.parametrize("cells", [0, pytest.param(1, marks=pytest.mark.slow), 70])
def test_padding_and_cells_beyond_the_event_have_no_slope(cells):
    """Some cells start beyond the event, and of the cells only some are run: fewer than lanes, and none."""
    heights = np.where(np.arange(100) % 3 == 0, 0.4, HEIGHTS)
    outcome, derivatives, expected = found_and_expected(heights=heights, cells=cells)
    run = np.arange(100) < cells
    assert (np.asarray(outcome.status)[run] == CROSSED).all()
    for slope, expected_slope in zip(derivatives, expected, strict=True):
        assert_close(slope, np.where(run & (heights > 0.5), expected_slope, 0.0), rtol=1e-7)


@pytest.mark.parametrize(
    ("kept", "steps"), [(2, 1), pytest.param(5, 4, marks=pytest.mark.slow), pytest.param(64, 4, marks=pytest.mark.slow)]
)
def test_runs_longer_than_what_is_kept_are_repeated(kept, steps, monkeypatch):
    """Periods of two iterations, of which the starts of a few are kept, and the steps of the latest ones: the slopes are
    the same to the last digit."""
    _, single_pass, _ = found_and_expected()
    monkeypatch.setattr(adjoint.StepRecorder, "period", 2)
    monkeypatch.setattr(adjoint, "SLOTS", kept)
    monkeypatch.setattr(adjoint, "STEPS_KEPT", steps)
    _, segments, expected = found_and_expected(run=compiled_anew())
    for whole_slope, segment_slope, expected_slope in zip(single_pass, segments, expected, strict=True):
        assert_close(whole_slope, segment_slope, rtol=1e-12)
        assert_close(segment_slope, expected_slope, rtol=1e-7)


def test_the_starts_that_are_kept_are_spread_out(monkeypatch):
    """Of two hundred checkpoints, eight remain: the first, the last, and others without a gap of more than half the run."""
    monkeypatch.setattr(adjoint, "SLOTS", 8)
    checkpoints = adjoint.Checkpoints.none(jnp.zeros(()))
    for index in range(200):
        checkpoints = checkpoints.added(jnp.asarray(index), jnp.asarray(float(index)))
    numbers = np.sort(checkpoints.numbers)
    assert (numbers[0], numbers[-1]) == (0, 199)
    assert (np.diff(numbers) > 0).all()
    assert np.diff(numbers).max() <= 100
    assert_close(checkpoints.periods, checkpoints.numbers)


class AtRest(AbstractProblem):
    """x' = 1 + y, y' = -500 (y - rest), both from 0; the event is x = 1. With rest = 0, y is at rest, but not its tangent.

    Then dt/drest = -(1 - (1 - exp(-500)) / 500), and dt/dpush = -1 for a push added to x'.
    """

    rest: jnp.ndarray
    push: jnp.ndarray

    def start(self):
        return jnp.zeros((2, 4)), jnp.ones((2, 4))

    def field(self, time, state):
        rate = -500.0 * (state[1] - self.rest)
        return jnp.stack([1.0 + state[1] + self.push, rate])

    def event_function(self, state):
        return 1.0 - state[0]

    def domain_margin(self, time, state):
        return None


@pytest.mark.parametrize("names", [("rest",), ("rest", "push", "push", "push", "push")])
def test_a_component_at_rest_has_its_tangent_integrated(names):
    """Steps judged by the run alone would reach the event in a few strides of which the tangent bears none: along one
    direction, and backward by five."""
    point = (jnp.zeros(4), jnp.zeros(4))
    tangents = [
        tuple(jnp.full(4, name == name_of_tangent) * 1.0 for name_of_tangent in ("rest", "push")) for name in names
    ]

    @eqx.filter_jit
    def run():
        directions = tangents_of(AtRest, point, tangents)
        arguments = (jnp.asarray(5.0), jnp.asarray(4), Settings(1e-10))
        return adjoint.ensemble_solve_with_tangents(
            AtRest(*point), directions, arguments, nonterminal=False, one_kernel=True
        )

    _, derivatives = run()
    expected = {"rest": -(1.0 - 1.0 / 500.0), "push": -1.0}
    for name, slope in zip(names, derivatives, strict=True):
        assert_close(slope, np.full(4, expected[name]), rtol=1e-8)


def test_a_tangent_moves_only_what_depends_on_the_number_also_through_a_compiled_function():
    """Otherwise runs carry variations of numbers that stay, and modes that share a number get different shapes of it."""

    @jax.jit
    def built(rate, start):
        return {"doubled": 2.0 * rate, "kept": start}

    (tangent,) = tangents_of(lambda rate: built(rate, jnp.ones(2)), (jnp.asarray(3.0),), [(jnp.asarray(3.0),)])
    assert tangent == {"doubled": 6.0, "kept": None}
