"""A friction law with arrays in tables, times, gradients, batches, hybrid runs and pages.

The curve is a straight line, on which the law is viscous: its results are those of `Viscous`.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe
from tippe.friction import AbstractFriction, ContactLoad

SPEEDS, MU = np.array([0.0, 0.3, 20.0]), 0.3
VISCOUS = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(MU))


class Curve(AbstractFriction):
    """Force over normal force, by slip speed [m/s], as measured."""

    speeds: jax.Array
    values: jax.Array

    @property
    def isotropic(self):
        return True

    def per_normal_force(self, slip):
        speed = jnp.sqrt(slip.x**2 + slip.y**2 + 1e-16)
        factor = -jnp.interp(speed, self.speeds, self.values) / speed
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


def scene_of(mu, **options):
    return tippe.Scene(rutstam_top(), tippe.Plane(), Curve(SPEEDS, mu * SPEEDS), **options)


def test_a_table_and_its_derivatives():
    """The derivative with respect to mu is that along all values of the curve, each in proportion to its speed."""
    options = {"theta": [0.1, 0.2], "spin": 155.0, "t1": 8.0, "progress": False}
    names = [f"friction.values[{k}]" for k in (1, 2)]
    table = tippe.inversion_table(scene_of(MU), **options, sensitivities=names)
    expected = tippe.inversion_table(VISCOUS, **options, sensitivities=["mu"])
    assert_close(table.time, expected.time, rtol=1e-7)
    slope = sum(speed * table[f"time_by_values[{k}]"] for k, speed in enumerate(SPEEDS[1:], 1))
    assert_close(slope, expected.time_by_mu, rtol=1e-5)


@pytest.mark.slow
def test_a_time_and_its_gradient():
    def time(values):
        scene = tippe.Scene(rutstam_top(), tippe.Plane(), Curve(jnp.asarray(SPEEDS), values))
        return tippe.inversion_time(scene, tippe.Launch(0.1, 155.0), 8.0)

    value, slope = jax.value_and_grad(time)(jnp.asarray(MU * SPEEDS))
    expected, expected_slope = jax.value_and_grad(
        lambda mu: tippe.inversion_time(
            tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(mu)), tippe.Launch(0.1, 155.0), 8.0
        )
    )(MU)
    assert_close(value, expected, rtol=1e-7)
    assert_close(slope @ SPEEDS, expected_slope, rtol=1e-5)


@pytest.mark.slow
def test_hybrid_runs_and_pages():
    launch = tippe.Launch(0.1, 280.0)
    scenes = (
        scene_of(MU, contact="hybrid", restitution=0.4),
        tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(MU), contact="hybrid", restitution=0.4),
    )
    run, expected = (tippe.simulate(scene, launch, 1.0) for scene in scenes)
    assert_close(run.theta[-1], expected.theta[-1], rtol=1e-6)
    page = tippe.explore(scene_of(MU), tippe.Launch(0.1, 155.0), sliders={"theta": (0.01, 0.5)})
    assert "NaN" not in page.html[:1000]
