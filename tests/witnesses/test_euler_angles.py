"""The chart of Euler angles: what it reads off a launch, and where it does not apply."""

import euler_angles
import numpy as np
import pytest

import tippe

TOP = tippe.Top(0.02, 0.02, 0.006, 131 / 350 * 8e-6, 3.2e-6)


@pytest.mark.parametrize("surface", [tippe.Plane(), tippe.Cylinder(0.3)], ids=["plane", "cylinder"])
def test_a_launch_has_its_own_angles_and_turns_about_its_axis_only(surface):
    """w = spin e with the centre at rest: psi' is the spin, and every other rate is 0."""
    scene = tippe.Scene(TOP, surface)
    state = scene.state(tippe.Launch(0.7, 90.0, eta=0.4, azimuth=-1.1))
    eta = 0.0 if isinstance(surface, tippe.Plane) else 0.4
    expected = [eta, 0.7, -1.1, 0.0, 0.0, 0.0, 0.0, 90.0]
    np.testing.assert_allclose(euler_angles.from_vector_state(scene, state), expected, atol=1e-12)


def test_the_chart_refuses_an_arena_that_is_curved_both_ways():
    """Its coordinates run along straight lines of the arena."""
    with pytest.raises(ValueError, match="must be a Plane or a Cylinder"):
        euler_angles.across(tippe.Scene(TOP, tippe.Sphere(0.3)))
