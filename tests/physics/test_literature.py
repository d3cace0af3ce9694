"""Numbers that others have published."""

import math

import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe


@pytest.mark.parametrize(
    ("I1_factor", "right_angle", "three"),
    [(235.0 / 625.0, 5.0114, 5.9434), (131.0 / 350.0, 5.0715, 5.9904)],
)
def test_rutstams_top_reaches_the_horizontal_and_three_radians(I1_factor, right_angle, three):
    """Rutstam's data, mu = 0.3 s/m, 155 rad/s, theta(0) = 0.1, centre of mass at rest, to the printed digits."""
    scene = tippe.Scene(rutstam_top(I1_factor), tippe.Plane(), tippe.Viscous(0.3))
    launch = tippe.Launch(0.1, 155.0)
    times = [float(tippe.inversion_time(scene, launch, 10.0, angle)) for angle in (math.pi / 2.0, 3.0)]
    assert_close(times, [right_angle, three], atol=6e-5)


def test_rutstams_thresholds():
    """lambda_thres = sqrt(m g R^3 I3 alpha) (1 + alpha)^2 / sqrt(1 + alpha - gamma) = 3.4575e-6 kg m^3/s, 77.18 rad/s.

    A launch just above it inverts completely in the end, one just below stays short of pi.
    """
    scene = tippe.Scene(rutstam_top(235.0 / 625.0), tippe.Plane(), tippe.Viscous(0.3))
    body, alpha, gamma = scene.body, 0.3, 235.0 / 625.0 / 0.4
    threshold = math.sqrt(body.mass * 9.81 * body.radius**3 * body.I3 * alpha) * (1 + alpha) ** 2
    threshold /= math.sqrt(1 + alpha - gamma)
    assert_close(threshold, 3.4575e-6, rtol=1.5e-5)
    spin = threshold / float(body.radius * (1 - alpha) * body.I3)
    assert_close(spin, 77.18, atol=5e-3)
    launch = tippe.Launch(theta=1e-3, spin=spin)
    assert_close(scene.jellett(scene.state(launch)), threshold, rtol=1e-6)
    table = tippe.inversion_table(scene, theta=1e-3, spin=[0.99 * spin, 1.01 * spin], t1=200.0, angle=math.pi - 1e-3)
    assert table.status.tolist() == ["not_inverted", "inverted"]


def test_final_spin_is_that_of_jelletts_constant(rutstam_scene):
    """Inverted, the top spins at w3 = -lambda / (R (1 + alpha) I3) = -82.866 rad/s."""
    run = tippe.simulate(rutstam_scene, tippe.Launch(0.1, 155.0), 40.0, times=[40.0])
    body = rutstam_scene.body
    expected = -float(run.jellett[0]) / float(body.radius * 1.3 * body.I3)
    assert_close(run.spin[0], expected, rtol=1e-6)
    assert_close(expected, -82.8659, atol=5e-5)


def cohen_top(I3_factor: float = 1.0) -> tippe.Top:
    """Cohen's top, Am. J. Phys. 45 (1977) 12."""
    mass, radius = 0.015, 0.025
    inertia = 0.4 * mass * radius**2
    return tippe.Top(mass, radius, 0.005, inertia, I3_factor * inertia)


@pytest.mark.parametrize(
    ("slip_speed", "theta"), [(0.11, (0.413, 1.636, 2.743, 3.078)), (0.01, (0.156, 1.164, 2.368, 2.516))]
)
def test_cohens_figure_5_depends_on_the_slip_speed(slip_speed, theta):
    """theta at 0.5, 1, 1.5 and 2 s: 0.11 m/s gives Cohen's curve (0.40, 1.66, 2.74, 3.04, read off to 3 %)."""
    scene = tippe.Scene(cohen_top(), tippe.Plane(), tippe.Coulomb(0.3, slip_speed))
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0), 2.0, times=[0.5, 1.0, 1.5, 2.0])
    assert_close(run.theta, theta, atol=6e-4)


def test_cohens_flat_top_stops_at_an_intermediate_angle():
    """I3 = 0.8 I1: theta = 2.07687 rad with phi' = 55.784, psi' = -11.157 rad/s, whatever the friction law."""
    scene = tippe.Scene(cohen_top(0.8), tippe.Plane(), tippe.Viscous(0.3))
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0), 60.0, times=np.linspace(59.0, 60.0, 201))
    assert_close(np.mean(run.theta), 2.07687, atol=5e-5)
    angles = np.unwrap(np.asarray(run.azimuth))
    precession = (angles[-1] - angles[0]) / 1.0
    assert_close(precession, 55.784, rtol=1e-4)
    # psi' = w3 - phi' cos(theta)
    assert_close(np.mean(run.spin) - precession * math.cos(2.07687), -11.157, rtol=1e-4)
