"""Coulomb friction as it stands: Cohen's top, stick and slip, the limit of the regularised law (tippe.md, section 7)."""

import coulomb_top
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import assert_close, homogeneous_ball, rutstam_top

import tippe
from tippe.stick_slip.path import follow_stick_slip
from tippe.trajectory import Run


def cohen_top() -> tippe.Top:
    """Cohen's top, Am. J. Phys. 45 (1977) 12."""
    inertia = 0.4 * 0.015 * 0.025**2
    return tippe.Top(0.015, 0.025, 0.005, inertia, inertia)


def scene_of(body: tippe.Top, mu: float) -> tippe.Scene:
    return tippe.Scene(body, tippe.Plane(), tippe.SetValuedCoulomb(mu))


def reference(body: tippe.Top, mu: float, theta: float, spin: float, t1: float) -> list[coulomb_top.Phase]:
    """The phases of the same run in plain NumPy and SciPy."""
    numbers = [float(x) for x in (body.mass, body.radius, body.offset, body.I1, body.I3)]
    plain = coulomb_top.Body(*numbers, mu)
    return coulomb_top.follow(plain, coulomb_top.start(plain, theta, spin), t1)


def test_cohens_top_stops_slipping_and_rolls():
    """The slip ends at t = 0.02879 s, theta = 0.0529, where rolling takes |F_t| = 0.0865 N; it never takes more than 0.0910 N
    and the energy stays at 2.153106e-2 J (row 10)."""
    run = tippe.simulate(scene_of(cohen_top(), 0.3), tippe.Launch(0.1, 100.0), 20.0, tolerance=1e-11)
    expected = reference(cohen_top(), 0.3, 0.1, 100.0, 0.05)
    assert run.stats["sticks"] == 1
    assert [phase.kind for phase in expected] == ["slipping", "rolling"]
    slip, rolling = run.dense.parts
    # The blow comes earlier by STICK_SPEED sqrt(g R) over the slip's deceleration.
    assert_close(slip.times[-1], expected[0].times[-1], atol=1e-8)
    assert_close(slip.times[-1], 0.02879, atol=5e-6)
    at_end = run.at([0.03, 0.05])
    assert_close(at_end.axis[1], expected[1].states[:3, -1], atol=1e-9)
    assert_close(run.scene.theta(jnp.asarray(slip.states[:8, -1])), 0.0529, atol=5e-5)
    rolls = run.t > 0.03
    assert_close(run.energy[rolls], 2.153106e-2, rtol=1e-6)
    assert_close(run.energy[rolls], run.energy[-1], rtol=1e-9)
    assert_close(run.jellett, run.jellett[0], rtol=1e-9)
    assert_close(np.max(run.theta[rolls]), 0.0749, atol=1e-4)
    force = run.scene.dynamics.rolling.reaction(jnp.asarray(rolling.states[:8]))
    needed = np.hypot(force[0], force[1]) / force[2]
    assert_close(needed[0], 0.0865, atol=1e-4)
    assert_close(np.max(needed), 0.0910, atol=1e-4)
    assert_close(run.slip[rolls], 0.0)


def test_a_top_that_sticks_and_slips_again():
    """Rutstam's top at mu = 0.2 slips, rolls, slips, rolls and slips within 0.9 s; against SciPy, event by event."""
    run = tippe.simulate(scene_of(rutstam_top(), 0.2), tippe.Launch(1.5, 30.0), 0.9, tolerance=1e-10)
    expected = reference(rutstam_top(), 0.2, 1.5, 30.0, 0.9)
    assert run.dense.rolls == [phase.kind == "rolling" for phase in expected] == [False, True, False, True, False]
    assert run.stats["sticks"] == 2
    assert_close(run.axis[-1], expected[-1].states[:3, -1], atol=1e-7)
    assert_close(run.jellett, run.jellett[0], rtol=1e-9)
    # Each blow takes or gives what a slip of some 1e-6 m/s holds.
    assert np.all(np.diff(np.asarray(run.energy)) < 1e-12 * float(run.energy[0]))
    assert run.stats["energy_residual"] < 1e-10 * float(run.energy[0])


def test_a_bowling_ball_slides_and_then_rolls():
    """v = v0 - mu g t until t* = 2 v0 / (7 mu g), then 5 v0 / 7 (row 2), with no error of a slip speed."""
    scene, end = scene_of(homogeneous_ball(), 0.3), 2.0 / (7.0 * 0.3 * 9.81)
    run = Run.of(scene, tippe.Launch(theta=0.7, spin=0.0))
    run = Run(run.dynamics, run.axial, run.state.at[0].set(1.0), run.path, run.scales)
    path = follow_stick_slip(run, 3.0 * end, solver=diffrax.Dopri8(), rtol=1e-11, atol=1e-12)
    assert path.rolls == [False, True]
    assert_close(path.parts[0].times[-1], end, atol=1e-7)
    times = np.array([0.3, 0.9, 0.999, 1.5, 3.0]) * end
    expected = np.where(times < end, 1.0 - 0.3 * 9.81 * times, 5.0 / 7.0)
    assert_close(path.at(times)[0], expected, rtol=1e-10)


def test_starts_at_rest():
    """Upright it spins on the spot and rolls; leaning without spin it rolls over its side; without friction it slides."""
    scene = scene_of(cohen_top(), 0.3)
    upright = tippe.simulate(scene, tippe.Launch(0.0, 100.0), 0.2)
    leaning = tippe.simulate(scene, tippe.Launch(1.0, 0.0), 0.2)
    slippery = tippe.simulate(scene_of(cohen_top(), 0.0), tippe.Launch(0.1, 100.0), 0.2)
    assert_close(upright.theta, 0.0)
    assert upright.dense.rolls == leaning.dense.rolls == [True]
    assert slippery.dense.rolls == [False]
    for run in (upright, leaning, slippery):
        assert run.status == "reached t1"
        assert_close(run.energy, run.energy[0], rtol=1e-8)


def test_a_ball_on_a_slope_rolls_where_friction_is_two_sevenths_of_the_slope():
    """At rest at eta in the cylinder, |F_t| / N = (2/7) tan(eta)."""
    eta = np.array([0.2, 0.7, 1.3])
    scene = tippe.Scene(homogeneous_ball(), tippe.Cylinder(0.2), tippe.SetValuedCoulomb(0.3))
    states = scene.state(tippe.Launch(np.full(3, 0.1), np.zeros(3), eta, np.zeros(3)))
    assert_close(scene.dynamics.rolling.grip(states, 2.0 / 7.0 * np.tan(eta)), 0.0, atol=1e-14)
    _, rolls = scene.dynamics.settled(states)
    assert rolls.tolist() == (2.0 / 7.0 * np.tan(eta) < 0.3).tolist()


def test_a_table_is_what_its_runs_are():
    """Also a regression: in this very grid an event at round-off once was found in one kernel and not in another."""
    scene, theta, spin = scene_of(rutstam_top(), 0.2), [0.5, 1.0, 1.5, 2.0], [30.0, 100.0, 200.0, 300.0]
    table = tippe.inversion_table(scene, theta=theta, spin=spin, t1=0.9)
    assert table.sticks.tolist() == [[1, 1, 1, 1], [1, 1, 1, 0], [2, 1, 0, 0], [1, 1, 0, 0]]
    assert table.status[3].tolist() == ["not_inverted", "inverted", "contact_lost", "contact_lost"]
    for place in [(0, 1), (2, 0), (3, 3)]:
        run = tippe.simulate(scene, tippe.Launch(theta[place[0]], spin[place[1]]), 0.9)
        assert_close(table.end_time[place], run.end_time, rtol=1e-8)
        assert_close(table.end_theta[place], run.theta[-1], atol=1e-7)
        assert table.sticks[place] == run.stats["sticks"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: tippe.inversion_time(s, tippe.Launch(0.1, 100.0), 1.0), "friction = SetValuedCoulomb must be a law"),
        (
            lambda s: jax.jit(lambda x: tippe.simulate(s, tippe.Launch(x, 100.0), 1.0, times=[1.0]).theta)(0.1),
            "friction = SetValuedCoulomb must be a law without phases inside jit",
        ),
        (
            lambda s: tippe.inversion_table(s, theta=0.1, spin=100.0, t1=1.0, method="diffrax"),
            "method = 'diffrax' is not for runs of several phases",
        ),
        (
            lambda s: tippe.Scene(s.body, friction=s.friction, contact="hybrid"),
            "contact = 'hybrid' must be with friction at a point, not with SetValuedCoulomb",
        ),
        (lambda s: tippe.SetValuedCoulomb(-0.1), "mu = -0.1 must be at least 0"),
    ],
)
def test_what_is_not_supported_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(scene_of(cohen_top(), 0.3))


@pytest.mark.parametrize(
    ("slip_speed", "theta"),
    [
        (1e-1, 0.449),
        pytest.param(3e-2, 0.496, marks=pytest.mark.slow),
        (1e-2, 0.156),
        pytest.param(3e-3, 0.089, marks=pytest.mark.slow),
        (1e-3, 0.0785),
        pytest.param(1e-4, 0.0744, marks=pytest.mark.slow),
        pytest.param(1e-5, 0.0740, marks=pytest.mark.slow),
    ],
)
def test_the_regularised_law_tends_to_it(slip_speed, theta):
    """theta after 0.5 s (row 10); the limit is 0.0739991, reached in proportion to the slip speed."""
    scene = tippe.Scene(cohen_top(), friction=tippe.Coulomb(0.3, slip_speed))
    run = tippe.simulate(scene, tippe.Launch(0.1, 100.0), 0.5, times=[0.5], tolerance=1e-8)
    assert_close(run.theta[-1], theta, atol=6e-4)
    if slip_speed <= 1e-3:
        assert 3.0 < (float(run.theta[-1]) - 0.0739991) / slip_speed < 6.0


@pytest.mark.slow
def test_the_time_of_inversion_of_the_regularised_law_is_creep():
    """To 0.95 pi: 5.91, 10.8 and 25.5 s at slip speeds of 0.01, 0.005 and 0.002 m/s; 0.05 / slip speed and a constant."""
    scene = tippe.Scene(cohen_top(), friction=tippe.Coulomb(0.3, 0.01))
    speeds = np.array([0.01, 0.005, 0.002])
    table = tippe.inversion_table(scene, theta=0.1, spin=100.0, t1=40.0, axes={"scene.friction.slip_speed": speeds})
    assert_close(table.time, [5.91, 10.8, 25.5], rtol=6e-3)
    assert_close(np.diff(table.time) / np.diff(1.0 / speeds), 0.05, rtol=0.05)
