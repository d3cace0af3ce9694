"""Bodies of any shape and inertia under exact Coulomb friction: limits, an independent program, balances, derivatives."""

import numpy as np
import pytest
from close import assert_close
from rigid import CENTRE, INERTIA, SHAPE, as_ellipsoid, turned_anyhow
from rigid_reference import Rattleback, follow
from tops import random_states, rutstam_top

import tippe
from tippe.friction import Slip
from tippe.model.dynamics import from_frame
from tippe.modes.sticking import ROLLING


def rattleback(mu) -> tippe.Scene:
    return tippe.Scene(tippe.Ellipsoid(1.0, SHAPE, CENTRE, INERTIA), friction=tippe.SetValuedCoulomb(mu))


@pytest.mark.parametrize("arena", [tippe.Plane(), tippe.Cylinder(0.3)], ids=["plane", "cylinder"])
def test_a_top_sticks_and_slips_as_by_its_own_equations(arena):
    """Rates of both motions, reaction, grip, slip speed and the states after a blow, at 30 states."""
    law = tippe.SetValuedCoulomb(0.3)
    top, rigid = (tippe.Scene(body, arena, law).dynamics for body in (rutstam_top(), as_ellipsoid(rutstam_top())))
    states = random_states(tippe.Scene(rutstam_top(), arena), 30)
    state = turned_anyhow(states)

    def quantities(stick_slip, states):
        return [
            stick_slip.slipping.field(states),
            stick_slip.slip_speed(states),
            stick_slip.rolling.field(states),
            stick_slip.stopped(states),
            stick_slip.grip_left(states),
            np.stack(stick_slip.rolling.evaluate(states)[1]),
            np.stack(stick_slip.rolling.unit_impulse(states, 0)),
            np.stack(stick_slip.rolling.unit_impulse(states, 1)),
            stick_slip.rolling.with_slip(states, Slip(states[0], states[1])),
        ]

    for expected, value in zip(quantities(top, states), quantities(rigid, state), strict=True):
        expected = np.atleast_2d(expected)
        size = np.abs(expected).max(axis=1, keepdims=True)
        assert_close(np.atleast_2d(value)[: len(size)] / size, expected / size, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arena", "eta"), [(tippe.Plane(), 0.0), (tippe.Cylinder(0.3), 0.3)], ids=["plane", "cylinder"]
)
def test_runs_of_a_top_change_between_stick_and_slip_at_the_same_times(arena, eta):
    """Within a nanosecond, and at most 1e-8 in the axis, at a tolerance of 1e-12."""
    law, launch = tippe.SetValuedCoulomb(0.2), tippe.Launch(1.5, 30.0, eta=eta)
    top, rigid = (
        tippe.simulate(tippe.Scene(body, arena, law), launch, 0.9, tolerance=1e-12)
        for body in (rutstam_top(), as_ellipsoid(rutstam_top()))
    )
    pieces, expected = rigid.dense.mode_segments, top.dense.mode_segments
    assert [piece.number for piece in pieces] == [piece.number for piece in expected]
    assert len(pieces) > 2
    assert_close([piece.end for piece in pieces], [piece.end for piece in expected], atol=1e-9)
    assert_close(rigid.axis[-1], top.axis[-1], atol=1e-8)
    assert rigid.stats["energy_residual"] < 1e-10 * float(rigid.energy[0])


def test_a_blow_that_stops_the_slip_takes_energy():
    """At 30 states; the contact point is at rest after it, and only the contact acts: L - r x m u does not change."""
    scene = rattleback(0.3)
    stick_slip = scene.dynamics
    states = stick_slip.rolling.with_unit_axes(turned_anyhow(random_states(tippe.Scene(rutstam_top()), 30)))
    stopped_states = stick_slip.stopped(states)
    assert_close(stick_slip.slip_speed(stopped_states) / stick_slip.slip_speed(states), 0.0, atol=1e-13)
    assert np.all(np.asarray(scene.energy(stopped_states) <= scene.energy(states)))

    def about_contact(state):
        attitude = stick_slip.rolling.attitude(state)
        r, w = (np.stack(from_frame(vector, attitude.axes)) for vector in (attitude.lever, attitude.angular_velocity))
        u = np.stack([*np.asarray(state[:2]), -np.cross(w, r, axis=0)[2]])
        return np.asarray(state[5:8]) - np.cross(r, u, axis=0)

    size = np.abs(about_contact(states)).max()
    assert_close(about_contact(stopped_states) / size, about_contact(states) / size, atol=1e-13)


@pytest.mark.slow
def test_a_rattleback_that_rolls_and_slips_again():
    """At mu = 0.2 it slips, rolls, slips and rolls within 0.56 s; against SciPy, event by event."""
    run = tippe.simulate(rattleback(0.2), tippe.Launch(0.02, -5.0), 0.56, tolerance=1e-10)
    body = Rattleback(1.0, SHAPE, CENTRE, INERTIA)
    start = body.start(0.02, 0.0, -5.0)
    start[3:5] = 0.0
    expected = follow(body, 0.2, start, 0.56)
    pieces = run.dense.mode_segments
    assert [piece.number == ROLLING for piece in pieces] == [mode.rolls for mode in expected] == [False, True] * 2
    stop_time, onset, second_stop, _ = (
        float(mode.times[-1] - piece.end) for piece, mode in zip(pieces, expected, strict=True)
    )
    # The blow that stops a slip comes early, by the speed over the deceleration.
    assert 0.0 < stop_time < second_stop < 2e-5
    assert_close(onset, 0.0, atol=1e-9)
    assert_close(run.position[-1], expected[-1].states[:3, -1], atol=1e-8)
    assert_close(run.angular_velocity[-1], expected[-1].states[10:, -1], atol=1e-6)
    assert run.stats["sticks"] == 2
    assert run.stats["energy_residual"] < 1e-8 * float(run.energy[0])
    assert np.all(np.diff(np.asarray(run.energy)) < 1e-12 * float(run.energy[0]))
    is_rolling = (run.t > pieces[0].end + 1e-9) & (run.t < pieces[1].end - 1e-9)
    assert_close(run.slip[is_rolling], 0.0, atol=1e-15)
    assert np.all(np.asarray(run.grip)[is_rolling] < 0.2)
    assert_close(run.grip[run.t < pieces[0].end], 0.2, rtol=1e-9)


@pytest.mark.slow
def test_reversals_of_a_rattleback_that_sticks_and_slips():
    """The time of a table is that of a single run; its derivatives are central differences, the better of two steps."""
    axes, start = {"theta": 0.02, "spin": -5.0, "t1": 3.0}, tippe.Launch(0.02, -5.0)
    errors = []
    for step in (1e-4, 1e-5):
        table = tippe.reversal_table(
            rattleback(0.3),
            **axes,
            mu=[0.3 - step, 0.3, 0.3 + step],
            tolerance=1e-11,
            sensitivities=["mu"],
            progress=False,
        )
        assert table.status.tolist() == 3 * ["reversed"]
        difference = (table.time[2] - table.time[0]) / (2.0 * step)
        errors.append(abs(float(table.time_by_mu[1] / difference) - 1.0))
    assert min(errors) < 1e-6
    time, run = float(table.time[1]), tippe.simulate(rattleback(0.3), start, 3.0, tolerance=1e-11)
    assert_close(run.at([time]).normal_spin, 0.0, atol=1e-6)
