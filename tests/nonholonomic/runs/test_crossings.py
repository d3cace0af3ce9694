"""Crossings of a section against closed forms, and against the first event of a table."""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import GRAVITY, Ball, bounce

import nonholonomic
import stroller
import tippe
from nonholonomic import AbstractMode, Hybrid, crossings, event_time, sweep
from nonholonomic.hybrid.ensemble import MOST_STALLED, STALLED


class Spring(AbstractMode):
    damping: float

    def field(self, t, y):
        return jnp.array([y[1], -y[0] - self.damping * y[1]])


def middle(t, y):
    return y[0]


def middle_or_later(t, y):
    return jnp.where(t < 0.0, 1.0, y[0])


def test_returns_of_a_damped_spring():
    damping = np.array([0.0, 0.1, 0.4])
    options = {"axes": {"damping": damping}, "progress": False, "tolerance": 1e-11}
    spring = Hybrid([Spring(0.1)])
    table = crossings(spring, [1.0, 0.0], 40.0, middle, count=4, skip=1, **options)
    rate = np.sqrt(1.0 - 0.25 * damping**2)
    first = np.arccos(-0.5 * damping)
    turns = np.arange(2, 6)
    times = ((np.pi - np.arccos(0.5 * damping))[:, None] + 2.0 * np.pi * (turns - 1)) / rate[:, None]
    np.testing.assert_allclose(times[:, 0], (first + 2.0 * np.pi) / rate)
    np.testing.assert_allclose(table.time, times, atol=1e-9)
    np.testing.assert_allclose(table.y0, 0.0, atol=1e-14)
    np.testing.assert_allclose(table.y1, -np.exp(-0.5 * damping[:, None] * times), rtol=1e-9)
    np.testing.assert_array_equal(table.crossing, turns)
    assert table.dims("y1") == ("damping", "crossing")
    assert set(table.status.ravel()) == {"event"}
    np.testing.assert_allclose(table.end_time, table.time[:, -1], atol=1e-9)
    # With a clock in the state, and for rises.
    rises = crossings(spring, [1.0, 0.0], 12.0, middle_or_later, count=3, direction="rise", **options)
    np.testing.assert_allclose(rises.time[:, :2], times[:, :2] - (np.pi / rate)[:, None], atol=1e-9)
    assert np.isnan(rises.time[:, 2]).all()
    assert np.isnan(rises.y1[:, 2]).all()
    assert set(rises.status.ravel()) == {"completed"}
    # The steps of runs through the event to the same horizon.
    last = sweep(spring, [1.0, 0.0], 12.0, event=lambda t, y: -middle_or_later(t, y), crossing="last", **options)
    np.testing.assert_array_equal(rises.steps, last.steps)


def ground(t, y):
    return y[0]


def highest(t, y):
    return y[1]


@pytest.mark.parametrize("side", ["before", "after"])
def test_crossings_at_resets(side):
    table = crossings(Hybrid([Ball()]), [1.0, 0.0, 0.0], 9.0, ground, count=4, skip=1, side=side, progress=False)
    np.testing.assert_allclose(table.time, [bounce(1.0, 0.8, GRAVITY, k) for k in range(2, 6)], atol=1e-12)
    speed = np.sqrt(2.0 * GRAVITY) * 0.8 ** np.arange(1, 5)
    np.testing.assert_allclose(table.y1, -speed if side == "before" else 0.8 * speed, rtol=1e-11)
    np.testing.assert_array_equal(table.y2, np.arange(1, 5) + (side == "after"))


class Bouncing(Ball):
    """The height keeps its round-off at a bounce. From the bounce of some number on, the next mode is another one."""

    bounces: float = np.inf
    then: int = 0

    def reset(self, t, y):
        mode = jnp.where(y[2] + 1.5 > self.bounces, self.then, 0)
        return jnp.array([y[0], -self.restitution * y[1], y[2] + 1.0]), mode


class Falling(AbstractMode):
    """The ball stops on the ground."""

    def field(self, t, y):
        return jnp.array([y[1], -GRAVITY, 0.0])

    def margin(self, t, y):
        return y[0]


@pytest.mark.parametrize("ball", [Ball, Bouncing])
def test_a_height_that_touches_zero_at_a_reset_does_not_rise(ball):
    """Towards the end of the endless bounces, the height on the ground is round-off of either sign."""
    axes = {"restitution": np.array([0.5, 0.6])}
    options = {"count": 2, "direction": "rise", "axes": axes, "progress": False}
    table = crossings(Hybrid([ball()]), [1.0, 0.0, 0.0], 2.5, ground, **options)
    assert np.isnan(table.time).all()
    # Without crossings, the bounces end as without a section: after a hundred of them in a row that take hardly any time.
    assert table.status.tolist() == ["unresolved", "unresolved"]
    fall = np.sqrt(2.0 / GRAVITY)
    rest = fall * (1.0 + axes["restitution"]) / (1.0 - axes["restitution"])
    instant = np.log(STALLED * rest / (2.0 * fall)) / np.log(axes["restitution"])
    assert_close(table.switches, instant + MOST_STALLED, atol=2.0)


@pytest.mark.parametrize("first", [(), (Bouncing(bounces=1, then=1),)])
def test_a_section_at_the_end_of_a_mode_without_a_reset(first):
    table = crossings(Hybrid([*first, Falling()]), [1.0, 0.0, 0.0], 9.0, ground, count=3, progress=False)
    times = [bounce(1.0, 0.8, GRAVITY, k) if k <= len(first) + 1 else np.nan for k in range(1, 4)]
    np.testing.assert_allclose(table.time, times, atol=1e-12)
    assert table.status == "stopped"


def test_no_crossing_at_a_reset_into_a_mode_that_does_not_exist():
    """The reset also lets the number of bounces jump over the section."""
    ball = Hybrid([Bouncing(bounces=2, then=-1)], lambda t, y: 1.5 - y[2])
    table = crossings(ball, [1.0, 0.0, 0.0], 9.0, count=1, progress=False)
    assert np.isnan(table.time[0])
    assert table.status == "failed"
    with pytest.warns(UserWarning, match="the run ended as 'failed'"):
        assert np.isnan(event_time(ball, [1.0, 0.0, 0.0], 9.0))


class Stuck(AbstractMode):
    """Two of these lead to each other at height zero, and neither moves on from there."""

    following: int

    def field(self, t, y):
        return -jnp.ones(1)

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return y, self.following


@pytest.mark.parametrize("side", ["before", "after"])
def test_resets_that_repeat_at_one_instant_are_one_crossing(side):
    """A run that is stuck there does not return, however many of its modes end."""
    options = {"side": side, "progress": False}
    table = crossings(Hybrid([Stuck(1), Stuck(0)]), [0.5], 4.0, ground, count=2, **options)
    assert table.status == "unresolved"
    assert table.time[0] == pytest.approx(0.5)
    assert np.isnan(table.time[1])


def test_crossings_between_resets_in_a_table():
    """The start at the apex does not count."""
    restitution = [0.5, 0.8]
    table = crossings(
        Hybrid([Ball()]), [1.0, 0.0, 0.0], 3.0, highest, count=5, axes={"restitution": restitution}, progress=False
    )
    for row, e in enumerate(restitution):
        bounces = np.array([bounce(1.0, e, GRAVITY, k) for k in range(1, 6)])
        times = bounces + np.sqrt(2.0 / GRAVITY) * e ** np.arange(1, 6)
        times[times > 3.0] = np.nan
        np.testing.assert_allclose(table.time[row], times, atol=1e-11)
        np.testing.assert_allclose(
            table.y0[row], np.where(np.isnan(times), np.nan, e ** (2 * np.arange(1.0, 6.0))), rtol=1e-11
        )
        assert table.status[row] == ("completed" if np.isnan(times).any() else "event")


def tilted(t, motion):
    return 0.3 - motion.theta


def slowed(t, motion):
    return motion.speed - 1.5


def test_crossings_of_scenes():
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene, launch = tippe.Scene(top, friction=tippe.Viscous(0.3)), tippe.Launch(0.1, 155.0)
    table = crossings(scene, launch, 4.0, tilted, count=2, quantities=["theta", "axis"], progress=False)
    np.testing.assert_allclose(table.time[0], event_time(scene, launch, 4.0, tilted), rtol=1e-8)
    np.testing.assert_allclose(table.theta[0], 0.3, rtol=1e-10)
    assert table.axis.shape == (2, 3)
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    ride = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    start = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    table = crossings(ride, start, 4.0, slowed, count=2, quantities=["speed"], progress=False)
    np.testing.assert_allclose(table.time[0], event_time(ride, start, 4.0, slowed), rtol=1e-8)
    np.testing.assert_allclose(table.speed, [1.5, np.nan], rtol=1e-10)
    assert table.status == "completed"
    with pytest.raises(ValueError, match="the section of a scene needs event="):
        crossings(scene, launch, 4.0)


def test_a_file_of_crossings_and_what_is_refused(tmp_path):
    spring, path = Hybrid([Spring(0.1)]), tmp_path / "crossings.h5"
    arguments = (spring, [1.0, 0.0], 40.0, middle, 4, 1)
    options = {"axes": {"damping": [0.0, 0.1, 0.4]}, "progress": False, "tolerance": 1e-11}
    table = crossings(*arguments, path=path, **options)
    for again in (crossings(*arguments, path=path, **options), nonholonomic.Table.load(path)):
        np.testing.assert_array_equal(again.time, table.time)
    with pytest.raises(ValueError, match="direction = 'up' must be 'fall' or 'rise'"):
        crossings(*arguments, direction="up")
    with pytest.raises(ValueError, match="side = 'both' must be 'before' or 'after'"):
        crossings(*arguments, side="both")
    with pytest.raises(ValueError, match="count"):
        crossings(spring, [1.0, 0.0], 40.0, middle, 0)
    with pytest.raises(ValueError, match="quantities: 'y5'"):
        crossings(*arguments, quantities=["y5"])
