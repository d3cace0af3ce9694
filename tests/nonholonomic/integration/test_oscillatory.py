"""The pairs `Oscillatory8` and `Stabilized8`: order conditions, weights, accuracy, stability and errors raised."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scenes
from tune_pair import Aim, descended
from tune_stability import FACTORIALS, INTERVAL, ORDER, goal, interval, polynomial
from tuning.family import equations, free_directions, pair_of, unknowns_of
from tuning.trees import error_coefficients, trees

import tippe
from nonholonomic.integration import Oscillatory8, Settings, Stabilized8, solve_ensemble
from nonholonomic.integration.runge_kutta import CAUTION
from tippe.modes.problems import InversionProblem

OWN = unknowns_of(Oscillatory8().tableau, CAUTION)
STABLE = unknowns_of(Stabilized8().tableau, CAUTION)
PAIR, STABLE_PAIR, PLAIN = pair_of(OWN), pair_of(STABLE), pair_of(unknowns_of(diffrax.Dopri8().tableau))
TOP = tippe.Top(0.02, 0.02, 0.006, 131.0 / 350.0 * 8e-6, 0.4 * 8e-6)


def test_there_are_as_many_trees_as_the_literature_counts():
    """Hairer, Norsett and Wanner, Solving ODEs I, Table II.2.3."""
    assert [len(group) for group in trees(9)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]


@pytest.mark.parametrize(
    ("pair", "round_off"), [(PAIR, 1e-15), (STABLE_PAIR, 2e-15)], ids=["Oscillatory8", "Stabilized8"]
)
@pytest.mark.parametrize("order", range(1, 9))
def test_every_condition_of_order_holds(order, pair, round_off):
    """To round-off: all of the step up to eighth order, all of its companion up to seventh."""
    assert jnp.abs(error_coefficients(pair.stages, pair.eighth, order)).max() < round_off
    seventh = jnp.abs(error_coefficients(pair.stages, pair.seventh, order)).max()
    assert seventh < round_off if order < 8 else seventh > 1e-7


def test_they_belong_to_the_family_which_leaves_ten_weights_free():
    assert np.abs(equations(OWN)).max() < 1e-14
    assert np.abs(equations(STABLE)).max() < 5e-14
    assert free_directions(OWN).shape[1] == free_directions(unknowns_of(diffrax.Dopri8().tableau)).shape[1] == 10


def test_a_decay_is_stable_in_steps_three_times_as_long():
    """Of `Stabilized8`, whose stability polynomial is that of the linear program."""
    stable, oscillatory, dopri8 = (interval(polynomial(pair)) for pair in (STABLE_PAIR, PAIR, PLAIN))
    assert stable > INTERVAL > 16.0
    assert 5.1 < dopri8 < oscillatory < 5.6
    places = -np.linspace(3.0, INTERVAL, 500)
    assert np.abs(np.polyval(np.asarray(polynomial(STABLE_PAIR))[::-1], places)).max() < 0.901
    assert np.abs(np.asarray(polynomial(STABLE_PAIR)[ORDER + 1 :]) * FACTORIALS - goal()).max() < 1e-5


def test_a_table_with_stiff_friction_takes_fewer_steps():
    """Rutstam's top in a cylinder at a slip speed of 1e-3 m/s, where stability limits the steps of `Oscillatory8`."""
    scene = tippe.Scene(TOP, tippe.Cylinder(0.3), tippe.Coulomb(0.3, 1e-3))
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, 4), 100.0, eta=0.3), 3.0, 4)

    def run(solver, tolerance):
        outcome, _ = solve_ensemble(problem, jnp.asarray(0.1), jnp.asarray(4), Settings(tolerance, solver))
        return np.asarray(outcome.state[2:5]), float(np.mean(outcome.steps))

    (reference, _), (state, steps) = run(None, 1e-11), run(None, 1e-6)
    stable_state, stable_steps = run(Stabilized8(), 1e-6)
    assert stable_steps < 0.8 * steps
    assert np.abs(state - reference).max() < 1e-6
    assert np.abs(stable_state - reference).max() < 1e-6


@pytest.mark.slow
def test_its_errors_along_a_motion_are_small_and_could_not_be_found_by_chance():
    """Steps of Rutstam's top, as the weights were tuned; descending from Prince and Dormand's lowers the errors too."""
    aim = Aim({"plane, viscous": scenes(4)["plane, viscous"]}, seed=0)
    dopri8 = unknowns_of(diffrax.Dopri8().tableau)
    assert max(aim.sizes(OWN)) < 0.6
    assert min(aim.sizes(dopri8)) > 0.8
    coefficients, height = descended(aim, dopri8, passes=2)
    assert height < aim(dopri8) - 0.1
    assert np.abs(equations(coefficients)).max() < 1e-10


def test_it_is_no_more_than_of_eighth_order_and_no_worse_in_ninth_than_the_pair_it_replaces():
    ninth, dopri8 = (jnp.linalg.norm(error_coefficients(pair.stages, pair.eighth, 9)) for pair in (PAIR, PLAIN))
    assert 1e-7 < ninth < dopri8
    np.testing.assert_allclose(dopri8, 4.51e-6, rtol=1e-2)  # Prince and Dormand's own figure


def test_its_weights_magnify_round_off_less():
    """The greatest effect of a unit of round-off in every rate: the sums of the weights' magnitudes."""
    for oscillatory8, dopri8 in zip(PAIR[:2], PLAIN[:2], strict=True):
        assert np.abs(oscillatory8).sum(axis=-1).max() < np.abs(dopri8).sum(axis=-1).max()


@pytest.mark.slow
@pytest.mark.parametrize("arena", [tippe.Cylinder(0.3), tippe.Torus(0.3, 0.2)], ids=["cylinder", "torus"])
def test_off_the_plane_it_reaches_the_same_error_in_fewer_steps(arena):
    """A third of the error of `Dopri8` for the same steps, or less, in an arena and for a top that it was not tuned to too."""
    top = tippe.Top(0.05, 0.03, 0.008, 0.38 * 4.5e-5, 0.4 * 4.5e-5) if isinstance(arena, tippe.Torus) else TOP
    scene = tippe.Scene(top, arena, tippe.Viscous(0.3))
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, 8), 100.0, eta=0.3), 3.0, 8)

    def run(solver, tolerance):
        outcome, _ = solve_ensemble(problem, jnp.asarray(1.5), jnp.asarray(8), Settings(tolerance, solver))
        return np.asarray(outcome.state[2:5]), float(np.mean(outcome.steps))

    reference, _ = run(None, 1e-12)
    (oscillatory8, steps), (dopri8, steps_of_dopri8) = run(None, 1e-9), run(diffrax.Dopri8(), 1e-9)
    assert steps < 1.05 * steps_of_dopri8
    assert np.abs(oscillatory8 - reference).max() < 0.3 * np.abs(dopri8 - reference).max()


@pytest.mark.parametrize("solver", [Oscillatory8(), Stabilized8()], ids=["Oscillatory8", "Stabilized8"])
def test_a_single_run_with_it_is_refused_as_its_dense_output_is_a_cubic(solver):
    with pytest.raises(ValueError, match=f"solver = {type(solver).__name__}.* is for tables and batches"):
        tippe.simulate(tippe.Scene(TOP), tippe.Launch(0.1, 100.0), t1=0.1, tolerance=1e-6, solver=solver)


def test_a_rotation_keeps_its_amplitude_and_its_phase():
    """The error of a step of y' = i y at z = 1 is a tenth of that of `Dopri8`."""

    def left(pair):
        first = np.linalg.solve(np.eye(13) - 1j * np.asarray(pair.stages), np.ones(13))
        return abs((1.0 + 1j * np.asarray(pair.eighth) @ first) * np.exp(-1j) - 1.0)

    assert left(PAIR) < 1e-9
    assert left(PAIR) < 0.1 * left(PLAIN)


def test_a_table_by_diffrax_refuses_it_before_anything_is_written(tmp_path):
    arguments = {"theta": [0.1], "spin": 155.0, "t1": 1.0, "method": "diffrax", "path": tmp_path / "table.h5"}
    with pytest.raises(ValueError, match="solver = Oscillatory8"):
        tippe.inversion_table(tippe.Scene(TOP), solver=Oscillatory8(), **arguments)
    assert not list(tmp_path.iterdir())
