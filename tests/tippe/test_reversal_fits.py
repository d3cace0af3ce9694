"""The product of inertia of a rattleback from the times at which its spin reverses."""

import numpy as np
import pytest

import tippe

INERTIA = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]


def stone() -> tippe.Scene:
    body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), INERTIA)
    return tippe.Scene(body, friction=tippe.NoSlip())


def test_only_bodies_that_can_reverse_and_spin_have_reversal_times(rutstam_scene):
    data = tippe.ReversalTimes(tippe.Launch(0.02, [-5.0, 0.0]), [2.6, 3.0], 0.02, t1=8.0)
    with pytest.raises(ValueError, match="must be an Ellipsoid or a RigidBody for times of reversal"):
        tippe.identify(rutstam_scene, data, {"mu": 0.3})
    with pytest.raises(ValueError, match="a spin of zero cannot reverse"):
        tippe.identify(stone(), data, {"inertia.xy": -2e-5})


@pytest.mark.slow
def test_the_product_of_inertia_from_reversal_times():
    """Of four launches, of which one was only watched for 6 s, from a start that is a fifth off."""
    launch = tippe.Launch(0.02, np.array([-4.0, -5.0, -6.0, 5.0]))
    table = tippe.reversal_table(stone(), theta=0.02, spin=launch.spin, t1=9.0)
    assert table.time[3] > 6.0
    noise = 0.02 * np.random.default_rng(0).normal(size=4)
    measured = np.where(table.time > 6.0, np.inf, table.time + noise)
    data = tippe.ReversalTimes(launch, measured, 0.02, t1=8.0, until=6.0)
    fit = tippe.identify(stone(), data, {"inertia.xy": -1.6e-5}, tolerance=1e-6)
    low, high = fit.interval("inertia.xy")
    assert low < INERTIA[0][1] < high
    assert high - low < 1e-6
    assert fit.verdict.good, str(fit)
