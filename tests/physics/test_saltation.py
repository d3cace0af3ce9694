"""Derivatives through flights, impacts, stick and slip, against central differences whose step was scanned."""

import diffrax
import numpy as np
from conftest import assert_close
from test_hops import CASES, scene_of

import tippe


def test_a_table_through_flights_and_impacts():
    """By spin and restitution, after some dozen flights: a difference in one is taken on both sides of the other.

    The steps are from the middle of a range over which the differences agree.
    """
    scene, given = scene_of(CASES[0], 0.1), {"theta": 0.1, "t1": 20.0, "angle": 1.9, "progress": False}
    step, other, bounces = 1e-3, 1e-5, np.array([0.2, 0.3])
    # As many cells and the same axes as in `test_hops`: the programs are those.
    spins, axes = [200.0 - step, 200.0 + step], {"scene.restitution": [b + d for b in bounces for d in (-other, other)]}
    around = tippe.inversion_table(scene, spin=spins, axes=axes, tolerance=1e-11, **given)
    time = around.time.reshape(2, 2, 2)
    given |= {"spin": [200.0], "axes": {"scene.restitution": list(bounces)}, "solver": diffrax.Tsit5()}
    table = tippe.inversion_table(scene, tolerance=1e-9, sensitivities=["spin", "restitution"], **given)
    assert (table.status == "inverted").all()
    assert (table.hops > 20).all()
    assert (table.grazes == 0).all()
    assert_close(table.time_by_spin[0], (np.diff(time, axis=0) / (2.0 * step)).mean(axis=(0, 2)), rtol=1e-5)
    assert_close(table.time_by_restitution[0], (np.diff(time, axis=2) / (2.0 * other)).mean(axis=(0, 2)), rtol=1e-4)
