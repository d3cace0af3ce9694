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
