"""Flights over any arena: comparison with an independent program, the plane as a graph, energy, and illegal scenes."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest
from arena_hop_reference import CASES, RESTITUTION, SAMPLES, recorded
from arena_reference import Case
from close import assert_close
from tops import rutstam_top

import tippe
from nonholonomic.hybrid import solve_hybrid_dense
from nonholonomic.integration import Settings
from tippe.modes.airborne import FLYING, SLIDING
from tippe.runs.model import TopModel

REFERENCE = recorded()


def hop_scene(case: Case, surface: tippe.Paraboloid | tippe.Graph) -> tippe.Scene:
    """The scene of a case of `arena_hop_reference.py`."""
    friction = tippe.Viscous(case.mu)
    return tippe.Scene(rutstam_top(), surface, friction, contact="hybrid", restitution=RESTITUTION)


def bounced(number: int, surface: tippe.Paraboloid | tippe.Graph, tolerance: float) -> tippe.HybridTrajectory:
    """A case of `arena_hop_reference.py` on its arena."""
    row, case = REFERENCE[number], CASES[number]
    launch = tippe.Launch(
        case.theta,
        case.spin,
        place=(row["q1"], row["q2"]),
        velocity=(case.v1, case.v2),
        angular_velocity=(case.w1, case.w2, case.w3),
    )
    return tippe.simulate(hop_scene(case, surface), launch, case.t1, tolerance=tolerance)


def greatest_error(number: int, run: tippe.HybridTrajectory) -> float:
    """Of the places [R] and the axes at the samples."""
    row, radius = REFERENCE[number], CASES[number].radius
    run = run.at(CASES[number].t1 * np.array(SAMPLES))
    errors = [
        (np.asarray(values) - [[row[f"{name}{i}_{k}"] for i in range(3)] for k in range(1, len(SAMPLES) + 1)]) / size
        for name, values, size in (("O", run.position, radius), ("e", run.axis, 1.0))
    ]
    return float(np.max(np.abs(errors)))


def check_flights(number: int, run: tippe.HybridTrajectory) -> None:
    """The first flight to 1e-11 s; the bounces that are not followed take e / (1 - e) of the last one's time."""
    row = REFERENCE[number]
    assert_close(run.hops[0], [row["first"], row["landing"]], atol=1e-11)
    start, end = run.hops[-1]
    assert end - start < 1e-5
    assert_close(end + (end - start) * RESTITUTION / (1.0 - RESTITUTION), row["rest"], atol=2e-9)


@pytest.mark.slow
def test_bounces_in_a_bowl():
    """To rest, then sliding, against NumPy and SciPy: the error goes with the tolerance, to 2e-10, and no constant stops it."""
    loose_run, tight_run = (bounced(0, tippe.Paraboloid(CASES[0].p1), tolerance) for tolerance in (1e-8, 1e-12))
    assert (loose_run.status, tight_run.status) == ("completed", "completed")
    assert tight_run.contact[-1] == 0
    assert greatest_error(0, tight_run) < 2e-10
    assert 2e-8 < greatest_error(0, loose_run) < 2e-7
    check_flights(0, tight_run)
    # The foot of the loose run has left the bowl by 1e-11 R where it parts: its flight begins at the bowl, and is one.
    assert loose_run.dense.counts[0] == len(loose_run.hops) == len(tight_run.hops)


def test_a_ball_comes_to_rest():
    """Dropped at the lowest point of a bowl: all bounces together take sqrt(2 h / g) (1 + e) / (1 - e), to 1e-11 s."""
    scene, h, e = hop_scene(CASES[0], tippe.Paraboloid(CASES[0].p1)), 0.01, RESTITUTION
    batched_modes, *_ = TopModel(scene=scene, launch=tippe.Launch(0.0, 0.0)).modes(1, 1e-12, None, False)
    upright = (0.0, 0.0, 1.0)
    centre = (0.0, 0.0, h + CASES[0].radius - CASES[0].offset)
    state = jnp.array([*centre, *np.zeros(3), *upright, *np.zeros(5), 1.0, *np.zeros(4)])
    path = solve_hybrid_dense(batched_modes, FLYING, state, 0.16, Settings(1e-12, diffrax.Dopri8()), counters=1)
    *_, last, rest = path.mode_segments
    assert (last.number, rest.number) == (FLYING, SLIDING)
    rest_time = last.end + (last.end - last.begin) * e / (1.0 - e)
    assert_close(rest_time, np.sqrt(2.0 * h / 9.81) * (1.0 + e) / (1.0 - e), atol=1e-11)


@pytest.mark.slow
def test_a_flat_graph_is_the_plane():
    """Rutstam's top at spins at which it hops: times and flights are those of the plane's closed forms."""
    motions = []
    for surface in (tippe.Plane(), tippe.Graph(lambda x, y: 0.0 * x)):
        scene = tippe.Scene(rutstam_top(), surface, tippe.Viscous(0.3), contact="hybrid")
        motions.append(tippe.inversion_table(scene, theta=0.1, spin=[180.0, 200.0], t1=8.0, tolerance=1e-10))
    plane, graph = motions
    assert plane.hops.min() > 0
    np.testing.assert_array_equal(graph.hops, plane.hops)
    np.testing.assert_array_equal(graph.status, plane.status)
    assert_close(graph.time, plane.time, rtol=1e-8)
    assert_close(graph.end_theta, plane.end_theta, atol=1e-8)


@pytest.mark.slow
def test_a_top_jumps_over_a_hill():
    """It leaves the ground before the crest and slides on in the next valley: the same program, and energy at every time."""
    case = CASES[1]
    ground = tippe.Graph(lambda x, y: case.p1 * jnp.sin(case.p2 * x) * jnp.cos(case.p2 * y))
    run = bounced(1, ground, 1e-11)
    assert run.status == "completed"
    assert greatest_error(1, run) < 1e-8
    check_flights(1, run)
    flight_state = run.contact < 0
    assert flight_state.any()
    assert run.stats["energy_residual"] < 1e-9 * float(run.energy[0])
    assert_close(run.distance[0][~flight_state], 0.0, atol=1e-12)
    assert_close(run.normal_force[flight_state], 0.0)
