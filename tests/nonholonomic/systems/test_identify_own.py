"""Numbers of users' own systems from recorded runs."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from own_modes import GRAVITY, Ball, Sleigh, Slip, Stick

from nonholonomic import (
    AbstractMode,
    AbstractSystem,
    EventTimes,
    Free,
    Hybrid,
    Recording,
    identify,
    log_density,
    simulate,
)
from nonholonomic.identification import FitWarning
from nonholonomic.parameters import Parameters


@pytest.mark.slow
def test_the_restitution_of_a_ball_from_its_heights():
    """Heights before and after two bounces, without noise, give back the restitution and the height of the drop."""
    times = np.array([0.2, 0.6, 0.9, 1.3, 1.5])
    heights = simulate(Hybrid([Ball(0.8)]), jnp.array([1.0, 0.0, 0.0]), 1.5, times=times).state[:, 0]
    data = Recording([1.2, 0.0, 0.0], times, heights, 1e-3, "y0")
    fit = identify(Hybrid([Ball(0.7)]), data, {"restitution": 0.75, "start[0]": 1.05}, progress=False)
    assert_close(fit.estimates["system.modes[0].restitution"], 0.8, rtol=1e-6)
    assert_close(fit.estimates["start[0]"], 1.0, rtol=1e-6)


def test_candidates_that_come_to_rest_without_a_mode_for_rest_are_counted_and_placed():
    """A ball rests after sqrt(2 h / g) (1 + e) / (1 - e), which is 2 s for a restitution of 0.632."""
    times = np.array([0.3, 0.7, 1.1, 1.5, 1.9, 2.0])
    heights = simulate(Hybrid([Ball(0.7)]), jnp.array([1.0, 0.0, 0.0]), 2.0, times=times).state[:, 0]
    data = Recording([1.0, 0.0, 0.0], times, heights, 1e-3, "y0")
    fit = identify(Hybrid([Ball(0.7)]), data, {"restitution": Free(0.72, 0.3, 0.95)}, starts=4, progress=False)
    words = re.search(
        r"(\d+) of (\d+) candidates count as impossible.*restitution ([\d.]+) to ([\d.]+)$", *fit.verdict.notes
    )
    fall = np.sqrt(2.0 / GRAVITY)
    assert 0.31 > float(words.group(3)) > 0.3
    assert_close(float(words.group(4)), (2.0 - fall) / (2.0 + fall), atol=1e-2)
    restitution = 0.3 + 0.65 / (1.0 + np.exp(-fit.distribution.points[:, 0]))
    assert abs(int(words.group(1)) - np.sum(restitution < (2.0 - fall) / (2.0 + fall))) <= 2


class Swing(AbstractMode):
    """An oscillator, with a number that does nothing."""

    frequency: float
    idle: float = 1.0

    def field(self, t, y):
        return jnp.stack([y[1], -(self.frequency**2) * y[0]])


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_times_in_milliseconds_and_numbers_that_do_not_act_are_seen_before_the_search(unit):
    """Samples of cos(w t), and the times at which it falls through 0, pi / (2 w)."""
    times = np.linspace(0.05, 1.5, 12)
    swing, free = Hybrid([Swing(3.1)]), {"frequency": 3.1, "idle": 1.0}
    samples = Recording([1.0, 0.0], unit * times, np.cos(3.0 * times), 1e-2, "y0")
    events = EventTimes([1.0, 0.0], [unit * np.pi / 6.0], 1e-3 * unit, t1=unit, event=lambda t, y: y[0])
    if unit > 1.0:
        with pytest.raises(ValueError, match=r"times: .* are in seconds: did you mean 1e-3"):
            identify(swing, samples, free, progress=False)
        with pytest.raises(
            ValueError, match=r"time: the events are measured 1033 times later.*did you mean 1e-3 \* time"
        ):
            identify(swing, events, {"frequency": 3.1}, progress=False)
        return
    with pytest.warns(FitWarning) as caught:
        fit = identify(swing, samples, free, starts=2, progress=False)
    assert "no prediction depends on system.modes[0].idle" in str(caught[0].message)
    assert len(fit.distribution.points) == 256
    assert abs(fit.estimates["frequency"] - 3.0) < 0.01
    fit = identify(swing, events, {"frequency": 3.1}, starts=2, progress=False)
    assert_close(fit.estimates["frequency"], 3.0, rtol=1e-6)


def test_a_quantity_that_the_system_does_not_have_is_named():
    data = Recording((np.zeros(3), np.zeros(3)), [1.0], [0.0], 1.0)
    with pytest.raises(ValueError, match=r"quantity: 'y0' \(the default\) must be one of q0, q1, q2, rate0"):
        identify(Sleigh(), data, {"ahead": 0.3})


def test_one_number_of_all_modes_is_replaced_in_all():
    numbers = Parameters.of({"system": Hybrid([Stick(), Slip()])})
    assert "system.modes[*].belt" in numbers.known
    system = numbers.replaced({"system.modes[*].belt": 0.7}).tree["system"]
    assert [mode.belt for mode in system.modes] == [0.7, 0.7]
    data = Recording([0.0, 0.5], [1.0], [0.0], 1.0)
    with pytest.raises(ValueError, match=r"'system.modes\[0\].belt' is named twice, alone and for all modes"):
        identify(Hybrid([Stick(), Slip()]), data, {"modes[*].belt": 0.5, "modes[0].belt": 0.5})


def test_the_clock_of_a_recording_is_fitted_through_resets():
    """Samples between impacts, read off a clock that was 0.02 s ahead."""
    times = np.array([0.1, 0.2, 0.3, 0.6, 0.75, 0.9, 1.05])
    heights = simulate(Hybrid([Ball(0.8)]), jnp.array([1.0, 0.0, 0.0]), 1.5, times=times).state[:, 0]
    data = Recording([1.0, 0.0, 0.0], times + 0.02, heights, 1e-3, "y0")
    fit = identify(Hybrid([Ball(0.8)]), data, {"t0": 0.0, "restitution": 0.78}, starts=4, progress=False)
    assert abs(fit.estimates["t0"] - 0.02) < fit.standard_errors["t0"] < 1e-3


class Incline(AbstractSystem):
    """A bead on a straight wire, of which the slope is known by its constraint alone."""

    slope: float
    dimension = 2

    def metric(self, q):
        return jnp.eye(2)

    def constraints(self, q):
        return jnp.array([[-self.slope, 1.0]])


def test_a_number_that_the_start_fixes_cannot_be_free():
    """Each other slope makes the start illegal, so nothing could be fitted; from rest it can."""
    times, places = np.array([0.5, 1.0]), np.array([0.5, 1.0])
    data = Recording(([0.0, 0.0], [1.0, 0.3]), times, places, 0.01, "q0")
    with pytest.raises(
        ValueError, match=r"free: system.slope = 0.3 is legal for this start and its neighbours are not: start"
    ):
        identify(Incline(0.3), data, {"slope": 0.3}, progress=False)
    log_density(Incline(0.3), Recording(([0.0, 0.0], [0.0, 0.0]), times, places, 0.01, "q0"), {"slope": 0.3})
