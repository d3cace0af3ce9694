"""The pair of `Oscillatory8`: its orders, tree by tree, its weights, and what it gains and refuses."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning.family import pair_of, unknowns_of
from tuning.trees import error_coefficients, trees

import tippe
from nonholonomic.integration import Oscillatory8, Settings, compiled_march
from tippe.inversion import InversionProblem

PAIR = pair_of(unknowns_of(Oscillatory8().tableau))
PLAIN = pair_of(unknowns_of(diffrax.Dopri8().tableau))
TOP = tippe.Top(0.02, 0.02, 0.006, 131.0 / 350.0 * 8e-6, 0.4 * 8e-6)


def test_there_are_as_many_trees_as_the_literature_counts():
    """Hairer, Norsett and Wanner, Solving ODEs I, Table II.2.3."""
    assert [len(some) for some in trees(9)] == [1, 1, 2, 4, 9, 20, 48, 115, 286]


@pytest.mark.parametrize("order", range(1, 9))
def test_every_condition_of_order_holds(order):
    """To round-off: all of the step up to eighth order, all of its companion up to seventh."""
    assert jnp.abs(error_coefficients(PAIR.stages, PAIR.eighth, order)).max() < 1e-15
    seventh = jnp.abs(error_coefficients(PAIR.stages, PAIR.seventh, order)).max()
    assert seventh < 1e-15 if order < 8 else seventh > 1e-7


def test_it_is_no_more_than_of_eighth_order_and_no_worse_in_ninth_than_the_pair_it_replaces():
    ninth, plain = (jnp.linalg.norm(error_coefficients(one.stages, one.eighth, 9)) for one in (PAIR, PLAIN))
    assert 1e-7 < ninth < plain
    np.testing.assert_allclose(plain, 4.51e-6, rtol=1e-2)  # Prince and Dormand's own figure


def test_its_weights_magnify_round_off_less():
    """What a unit of round-off in every rate can become: the sums of the weights' magnitudes."""
    for own, plain in zip(PAIR[:2], PLAIN[:2], strict=True):
        assert np.abs(own).sum(axis=-1).max() < np.abs(plain).sum(axis=-1).max()


def test_in_a_cylinder_it_reaches_the_same_error_in_three_quarters_of_the_steps():
    """A tenth of the error of `Dopri8` for the same steps: with an error of eighth order that is three quarters of them."""
    scene = tippe.Scene(TOP, tippe.Cylinder(0.3), tippe.Viscous(0.3))
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, 8), 100.0, eta=0.3), 3.0, 8)

    def run(solver, tolerance):
        found, _ = compiled_march(problem, jnp.asarray(1.5), jnp.asarray(8), Settings(tolerance, solver))
        return np.asarray(found.state[2:5]), float(np.mean(found.steps))

    reference, _ = run(None, 1e-12)
    (own, steps), (plain, more) = run(None, 1e-9), run(diffrax.Dopri8(), 1e-9)
    assert steps < 1.05 * more
    assert np.abs(own - reference).max() < 0.1 * np.abs(plain - reference).max()


def test_a_single_run_with_it_is_refused_as_its_dense_output_is_a_cubic():
    with pytest.raises(ValueError, match="solver = Oscillatory8"):
        tippe.simulate(tippe.Scene(TOP), tippe.Launch(0.1, 100.0), t1=0.1, tolerance=1e-6, solver=Oscillatory8())
