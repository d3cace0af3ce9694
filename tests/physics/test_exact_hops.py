"""Flights under exact Coulomb friction: impacts that stick or slip on, and motions that slip, roll and fly."""

import dataclasses

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from coulomb_top import Body, start
from exact_hop_reference import follow
from hypothesis import given, settings
from hypothesis import strategies as st
from impact_reference import Body as Solid
from impact_reference import Law
from impact_reference import resolve_impact as reference_impact
from test_strong_friction import random_falls
from tops import homogeneous_ball

import tippe
from tippe.model.dynamics import angular_velocity
from tippe.modes.airborne import FLYING
from tippe.modes.impact import approach, balls, resolve_impact
from tippe.modes.sticking import TOUCH_ROLLING, TOUCH_SLIPPING

NUMBERS, MU, THETA, SPIN, T1 = (0.02, 0.02, 0.016, 1.6e-6, 1.9e-6), 0.5, 1.5, 350.0, 0.276

impact_of = eqx.filter_jit(
    lambda impacts: resolve_impact(
        impacts.body,
        tippe.SetValuedCoulomb(impacts.friction.mu),
        balls(impacts.body)[0],
        impacts.free,
        impacts.restitution,
    )
)


@pytest.mark.slow
def test_impacts_that_stick_or_slip_on():
    """Of 1000 a third sticks; against an independent program with next to no slip speed, also where the slip turns round."""
    impacts = random_falls(0.0, 1.0)
    free_after, has_failed = impact_of(impacts)
    assert not np.asarray(has_failed).any()
    ball, free = balls(impacts.body)[0], impacts.free
    gain = np.asarray(free_after.energy(impacts.body, 9.81)) / np.asarray(free.energy(impacts.body, 9.81))
    assert np.max(gain) < 1.0 + 1e-13
    slip = np.hypot(*np.asarray(approach(impacts.body, ball, free_after).velocity)[:2])
    # What sticks has no slip but for round-off.
    assert not np.any((slip > 1e-12) & (slip < 1e-6))
    assert 0.2 < np.mean(slip < 1e-12) < 0.5
    rebound, arrival = (
        np.asarray(free_after.gap_rate(impacts.body, ball)),
        -np.asarray(free.gap_rate(impacts.body, ball)),
    )
    indices = np.flatnonzero(arrival > 1e-3)
    assert np.all((rebound > -1e-13)[indices])
    assert np.all((rebound <= impacts.restitution * arrival + 1e-13)[indices])
    velocity, turning = (
        np.stack(free_after.velocity),
        np.stack(angular_velocity(impacts.body, free_after.axis, free_after.momentum)),
    )
    for i in indices[:15]:
        body = Solid(*(float(getattr(impacts.body, name)[i]) for name in Solid._fields))
        motion = impacts.axis[:, i], impacts.velocity[:, i], impacts.turning[:, i]
        speed = np.linalg.norm(motion[1]) + body.radius * np.linalg.norm(motion[2])
        expected = reference_impact(
            body, *motion, Law(float(impacts.friction.mu[i]), 1e-9 * speed), impacts.restitution[i]
        )
        # In proportion to the slip speed of the reference; the greatest difference seen is 5e-10.
        assert_close(velocity[:, i], expected.velocity, atol=3e-9 * speed)
        assert_close(turning[:, i], expected.turning, atol=3e-9 * speed / body.radius)


def test_derivatives_of_impacts_that_stick_or_slip_on():
    """The changes of the velocities after an impact with those before it and with the friction, against differences."""
    impacts = random_falls(0.0, 1.0)
    ball, mu = balls(impacts.body)[0], impacts.friction.mu

    def after(change):
        falls = dataclasses.replace(
            impacts,
            friction=tippe.Coulomb(mu * (1.0 + 0.3 * change), 1.0),
            velocity=impacts.velocity * (1.0 + change * np.array([[0.3], [-0.2], [0.5]])),
            turning=impacts.turning * (1.0 - 0.4 * change),
        )
        free_after, _ = impact_of(falls)
        contact = approach(impacts.body, ball, free_after)
        return jnp.stack(free_after.velocity), jnp.stack(contact.velocity[:2])

    (velocity, slip), (slopes, slip_slopes) = jax.jit(lambda at: jax.jvp(after, (at,), (1.0,)))(0.0)
    (above, _), (below, _) = (jax.jit(after)(step) for step in (1e-6, -1e-6))
    errors = np.max(np.abs((above - below) / 2e-6 - slopes), axis=0)
    errors /= np.linalg.norm(velocity, axis=0) + np.linalg.norm(slopes, axis=0)
    sticks = np.hypot(*np.asarray(slip)) < 1e-12
    assert 200 < np.sum(sticks) < 500
    # A difference across the border between sticking and slipping is no derivative.
    assert np.sum(errors > 1e-7) <= 1
    assert_close(slip_slopes[:, sticks], 0.0, atol=1e-12)


def scene_of(arena: float | None, mu: float = MU, restitution: float = 0.0) -> tippe.Scene:
    surface = tippe.Plane() if arena is None else tippe.Sphere(arena)
    law = tippe.SetValuedCoulomb(mu)
    return tippe.Scene(tippe.Top(*NUMBERS), surface, law, contact="hybrid", restitution=restitution)


def check_against_reference(run: tippe.HybridTrajectory, arena: float | None) -> list[int]:
    """Mode by mode, and at the end; returns the numbers of the modes."""
    scene, curved = run.scene, (0.0, 0.0, 0.0) if arena is None else (1.0, 1.0, 1.0)
    body = Body(*NUMBERS, float(scene.friction.mu), 9.81, arena, curved)
    restitution = 0.0 if scene.restitution is None else float(scene.restitution)
    expected = follow(body, start(body, THETA, SPIN), T1, restitution)
    kinds = {"slipping": TOUCH_SLIPPING, "rolling": TOUCH_ROLLING, "flying": FLYING}
    # The reference follows the beginning of a slip by another method, and has no bounces that are too short to see.
    events = [event for k, event in enumerate(expected[1:]) if event.kind != expected[k].kind]
    mode_segments = run.dense.mode_segments
    numbers = [piece.number for piece in mode_segments]
    assert numbers == [kinds[event.kind] for event in (expected[0], *events)]
    start_times = {piece.begin if piece.number != TOUCH_SLIPPING else None for piece in mode_segments[1:]} - {None}
    for previous, event in zip(expected, expected[1:], strict=False):
        if event.kind not in ("slipping", previous.kind):
            # A slip is stopped where the way that is left is within the tolerance, earlier by its speed over its deceleration.
            tolerance = 1e-6 if (previous.kind, event.kind) == ("slipping", "rolling") else 2e-9
            assert min(abs(event.begin - time) for time in start_times) < tolerance
    assert_close(run.axis[-1], expected[-1].state[:3], atol=2e-8)
    assert_close(run.position[-1] - run.position[0], expected[-1].state[9:] - start(body, THETA, SPIN)[9:], atol=1e-9)
    assert_close(run.spin[-1], expected[-1].state[6:9] @ expected[-1].state[:3], rtol=1e-8)
    return numbers


@pytest.mark.parametrize("arena", [pytest.param(0.2, marks=pytest.mark.slow), None], ids=["sphere", "plane"])
def test_a_top_that_slips_flies_sticks_and_rolls(arena):
    """In a sphere it slips, flies, lands slipping, flies, and sticks as it lands, rolls and slips again; on the plane too."""
    run = tippe.simulate(scene_of(arena), tippe.Launch(THETA, SPIN), T1, tolerance=1e-9, solver=diffrax.Tsit5())
    assert run.status == "completed"
    numbers = check_against_reference(run, arena)
    assert numbers[:4] == [TOUCH_SLIPPING, FLYING, TOUCH_SLIPPING, FLYING]
    assert numbers[-2:] == [TOUCH_ROLLING, TOUCH_SLIPPING] if arena else [TOUCH_SLIPPING, TOUCH_ROLLING]
    assert len(run.hops) == 2
    # A stop takes what is left of a slip, within the tolerance.
    assert np.max(np.diff(run.energy)) < 1e-10 * run.energy[0]
    assert run.stats["energy_residual"] < 1e-9 * run.energy[0]
    assert 0.05 < run.stats["impact_loss"] / run.energy[0] < 0.2
    flight_state = run.contact < 0
    assert_close(run.normal_force[flight_state], 0.0)
    middles = np.array([0.5 * (piece.begin + piece.end) for piece in run.dense.mode_segments])
    before, after = run.at(middles - 1e-6).theta, run.at(middles + 1e-6).theta
    assert_close(run.at(middles).theta_rate, (after - before) / 2e-6, rtol=1e-5, atol=1e-3)
    assert_close(run.distance[0][~flight_state], 0.0, atol=1e-12)
    is_rolling = (run.t > run.dense.mode_segments[-2].begin) & (run.t < run.dense.mode_segments[-2].end)
    if arena:
        assert is_rolling.any()
        assert_close(run.slip[is_rolling], 0.0, atol=1e-12)


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    theta=st.floats(0.2, 2.9),
    spin=st.floats(-400.0, 400.0),
    mu=st.floats(0.05, 1.0),
    restitution=st.floats(0.1, 1.0),
)
def test_any_motion_is_finite_or_flagged(theta, spin, mu, restitution):
    """Energy never grows, nothing enters the arena and nothing pulls."""
    scene = scene_of(0.2, mu, restitution)
    run = tippe.simulate(scene, tippe.Launch(theta, spin), 0.2, tolerance=1e-8, solver=diffrax.Tsit5())
    assert run.status in ("completed", "failed", "jammed", "unresolved")
    assert np.isfinite(run.states).all()
    assert np.max(np.diff(run.energy)) < 1e-8 * run.energy[0]
    assert np.min(run.distance[0]) > -1e-9
    assert np.min(run.normal_force) > -1e-6 * 0.02 * 9.81


@pytest.mark.slow
@pytest.mark.parametrize(("speed", "word"), [(1.0, "completed"), (3.0, "contact_lost")])
def test_a_contact_at_rest_that_need_not_push_parts_at_once(speed, word):
    """A ball that rolls over the top of a sphere: it parts where V^2 / (rho + R) is more than g, at 1.77 m/s."""
    ball = homogeneous_ball()
    scene = tippe.Scene(ball, tippe.Sphere(0.3), tippe.SetValuedCoulomb(0.3), side="outside")
    launch = tippe.Launch(
        0.0, 0.0, place=(0.0, 0.0, 0.3), velocity=(speed, 0.0), angular_velocity=(0.0, speed / 0.02, 0.0)
    )
    run = tippe.simulate(scene, launch, 0.01, tolerance=1e-9, solver=diffrax.Tsit5())
    assert run.status == word
    assert run.end_time == (0.01 if speed == 1.0 else 0.0)


def test_what_has_no_single_answer_is_refused():
    stem = tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))
    with pytest.raises(ValueError, match="must be a law with a single mode for a top with a stem, such as Coulomb"):
        tippe.Scene(stem, friction=tippe.SetValuedCoulomb(0.3), contact="hybrid")


@pytest.mark.slow
def test_tables_go_through_flights_and_sticking():
    """The times at which single runs are, and an error beside them."""
    scene, options = scene_of(0.2), {"t1": 0.28, "tolerance": 1e-9, "solver": diffrax.Tsit5()}
    table = tippe.inversion_table(scene, theta=THETA, spin=[300.0, SPIN], angle=2.05, **options)
    assert list(table.status) == ["inverted", "inverted"]
    assert (table.hops > 0).all()
    for spin, time in zip((300.0, SPIN), table.time, strict=True):
        run = tippe.simulate(scene, tippe.Launch(THETA, spin), times=[time], **options)
        assert_close(run.theta, 2.05, atol=1e-7)


@pytest.mark.slow
def test_slopes_go_through_flights_and_sticking():
    """The time by the spin, after two flights and a contact that sticks as it lands, against differences of runs."""
    scene, options = scene_of(0.2), {"t1": 0.28, "tolerance": 1e-10}
    table = tippe.inversion_table(scene, theta=THETA, spin=SPIN, angle=3.02, sensitivities=["spin"], **options)
    (before, run, after) = (
        tippe.simulate(scene, tippe.Launch(THETA, SPIN + step), times=[float(table.time)], **options)
        for step in (-3e-3, 0.0, 3e-3)
    )
    assert float(table.time) > 0.26
    slope = (before.theta[0] - after.theta[0]) / 6e-3 / run.theta_rate[0]
    assert_close(table.time_by_spin, slope, rtol=1e-5)
