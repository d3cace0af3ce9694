"""Events of functions that change faster than the motion, against the zeros along motions in closed form."""

import dataclasses

import events
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nonholonomic


def require_none_missed(name: str, starts: int, tolerance: float) -> None:
    findings = events.compared(name, starts, [tolerance])[0]
    assert findings.counted > 0.9 * starts
    assert findings.wrong == 0, findings


@pytest.mark.parametrize("name", ["wavy ramp", "narrow dip", "toothed rack"])
def test_no_event_of_a_fast_function_is_missed(name):
    require_none_missed(name, 300, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-6, 1e-9, 1e-11])
@pytest.mark.parametrize("name", events.FAMILIES)
def test_no_event_is_missed_in_any_family(name, tolerance):
    require_none_missed(name, 10_000, tolerance)


class Looping(events.Ballistic):
    """A flight over the ramp whose margin has a loop, for which there are no bounds."""

    def margin(self, t, s):
        wave = jax.lax.while_loop(
            lambda carry: carry[1] < 1, lambda carry: (events.ramp(s[0]), carry[1] + 1), (0.0 * s[0], 0)
        )
        return s[1] - wave[0]


def test_a_margin_without_bounds_is_looked_at():
    starts = 300
    family = dataclasses.replace(events.FAMILIES["wavy ramp"], mode=Looping())
    start = np.stack(family.starts(np.random.default_rng(4), starts))
    right, grazes, beyond = (np.asarray(x) for x in events.first_zeros(family.motion, family.event, family.t1, start.T))
    axes = {f"start[{k}]": part for k, part in enumerate(start)}
    system = nonholonomic.Hybrid([family.mode])
    table = nonholonomic.sweep(system, [0.0] * 4, family.t1, scattered=True, tolerance=1e-6, axes=axes)
    wrong = ~np.isclose(np.asarray(table["end_time"]), right, rtol=0, atol=1e-6) & ~grazes & ~beyond
    assert wrong.sum() == 0


class Post(nonholonomic.AbstractMode):
    """A ball that slides past a thin post at x = 2, until it hits it."""

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, 0.0])

    def margin(self, t, s):
        return 1.0 - 1.2 * jnp.exp(-((s[0] - 2.0) ** 2 + s[1] ** 2) / 0.05**2)


@pytest.mark.parametrize("y", [0.0, 0.0213, 0.0215])
def test_a_single_run_sees_a_thin_post(y):
    """The post has the radius 0.05 sqrt(ln 1.2) = 0.02135."""
    run = nonholonomic.simulate(nonholonomic.Hybrid([Post()]), [0.0, y, 1.0, 0.0], 5.0)
    radius2 = 0.05**2 * np.log(1.2)
    hits = y * y < radius2
    assert run.status == ("stopped" if hits else "completed")
    assert run.end_time == pytest.approx(2.0 - np.sqrt(radius2 - y * y) if hits else 5.0, abs=1e-8)


class Straight(nonholonomic.AbstractMode):
    """A point on a straight line."""

    def field(self, t, s):
        return jnp.array([1.0, -0.25])


#: Functions that jump through zero, and the places x of their jumps.
JUMPING = {
    "a choice": (lambda t, s: jnp.where(s[0] > 0.37, -1.0, 1.0) + 0.5 * s[1], 0.37),
    "stairs": (lambda t, s: s[1] + 0.6 - 0.1 * jnp.floor(6.0 * s[0] + 1e-9), 2.0 / 3.0),
    "an angle": (lambda t, s: jnp.arctan2(jnp.sin(3.0 * s[0]), jnp.cos(3.0 * s[0])) + 1.0, np.pi / 3.0),
}


@pytest.mark.parametrize("name", JUMPING)
def test_the_time_of_a_function_that_jumps_through_zero_is_that_of_the_jump(name):
    """Its derivative is not that of the function beyond the jump, which is known: it is NaN."""
    event, place = JUMPING[name]
    start = jnp.array([0.0, 0.0 if name != "stairs" else -0.05])
    time, slope = jax.value_and_grad(
        lambda start: nonholonomic.event_time(nonholonomic.Hybrid([Straight()]), start, 2.0, event)
    )(start)
    np.testing.assert_allclose(time, place, atol=1e-9)
    assert np.isnan(slope[0])
    table = nonholonomic.sweep(
        nonholonomic.Hybrid([Straight()]), start, 2.0, event=event, axes={"start[0]": [0.0, 0.01]}
    )
    np.testing.assert_allclose(table["time"], [place, place - 0.01], atol=1e-9)


class Oscillators(nonholonomic.AbstractMode):
    """Two oscillators."""

    def field(self, t, s):
        return jnp.array([s[2], s[3], -s[0], -4.0 * s[1]])


def ends_of(event, starts, t1):
    axes = {f"start[{k}]": part for k, part in enumerate(starts)}
    options = {"axes": axes, "scattered": True, "tolerance": 1e-6, "max_steps": 300, "progress": False}
    return nonholonomic.sweep(nonholonomic.Hybrid([Oscillators()]), [0.0] * 4, t1, event=event, **options)


#: The starts of the oscillators.
STARTS = np.random.default_rng(5).uniform(-1.0, 1.0, (4, 1024))


def test_an_event_with_kinks_is_where_its_function_vanishes():
    def event(t, s):
        return jnp.maximum(10.0 * jnp.sin(40.0 * s[0]), -0.3) + 0.5 * s[1] + 0.2

    table = ends_of(event, STARTS, 6.0)
    assert (np.asarray(table["status"]) == "event").mean() > 0.9
    states = np.stack([np.asarray(table[f"y{k}"]) for k in range(4)])
    states = states[:, np.asarray(table["status"]) == "event"]
    np.testing.assert_allclose(event(0.0, states), 0.0, atol=1e-6)
    np.testing.assert_allclose(
        *(np.asarray(table[name])[np.isfinite(table["time"])] for name in ("time", "end_time")), rtol=1e-8
    )


def test_an_event_without_bounds_is_not_missed_in_a_long_run():
    def event(t, s):
        depth = jnp.sin(63.0 * s[0]) ** 2 + jnp.sin(21.0 * s[1] + 1.0) ** 2 - 0.02
        return jnp.linalg.solve(jnp.array([[2.0, 0.3], [0.1, 1.0]]), jnp.stack([depth, 0.05 * depth]))[0]

    short = np.asarray(ends_of(event, STARTS[:, :64], 6.0)["time"])
    happens = np.isfinite(short)
    assert happens.sum() > 32
    long = ends_of(event, STARTS[:, :64][:, happens], 6e10)["time"]
    np.testing.assert_allclose(long, short[happens], rtol=1e-9)
