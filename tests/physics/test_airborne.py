"""Flights over any arena: the plane as a graph, energy, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from tops import rutstam_top

import tippe


@pytest.mark.slow
def test_a_flat_graph_is_the_plane():
    """Rutstam's top at spins at which it hops: times and flights are those of the plane's closed forms."""
    found = []
    for surface in (tippe.Plane(), tippe.Graph(lambda x, y: 0.0 * x)):
        scene = tippe.Scene(rutstam_top(), surface, tippe.Viscous(0.3), contact="hybrid")
        found.append(tippe.inversion_table(scene, theta=0.1, spin=[180.0, 200.0], t1=8.0, tolerance=1e-10))
    plane, graph = found
    assert plane.hops.min() > 0
    np.testing.assert_array_equal(graph.hops, plane.hops)
    np.testing.assert_array_equal(graph.status, plane.status)
    assert_close(graph.time, plane.time, rtol=1e-8)
    assert_close(graph.end_theta, plane.end_theta, atol=1e-8)


def test_a_top_jumps_over_a_hill():
    """Fast enough it leaves the ground before the crest and strikes it behind; all the energy is accounted for."""
    hills = tippe.Graph(lambda x, y: 0.03 * jnp.cos(20.0 * x))
    scene = tippe.Scene(rutstam_top(), hills, tippe.Viscous(0.02), contact="hybrid", restitution=0.4)
    run = tippe.simulate(scene, tippe.Launch(1.2, 150.0, place=(-0.157, 0.0), velocity=(1.6, 0.2)), 0.5)
    assert run.status == "reached t1"
    # The last of the bounces takes a microsecond.
    assert len(run.hops) > 10
    aloft = run.contact < 0
    assert aloft.any()
    assert run.stats["energy_residual"] < 1e-9 * float(run.energy[0])
    assert_close(run.distance[0][~aloft], 0.0, atol=1e-12)
    assert_close(run.normal_force[aloft], 0.0)


def test_what_a_flight_does_not_know_is_refused():
    stem = tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))
    for make, message in (
        (lambda: tippe.Scene(stem, tippe.Sphere(0.3), contact="hybrid"), "must be on a level Plane"),
        (lambda: tippe.Scene(stem, tippe.Plane(0.1), contact="hybrid"), "must be on a level Plane"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
