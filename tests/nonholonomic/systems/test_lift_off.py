"""Modes that begin where their margin, its slope and its curvature along the motion vanish, against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from browser import needs_browser, open_browser
from close import assert_close
from scipy.integrate import quad
from scipy.optimize import brentq

from nonholonomic import AbstractMode, Hybrid, event_time, simulate, sweep
from nonholonomic.runs.model import model_of
from nonholonomic.runs.trajectory import page_of
from nonholonomic.views.pages import programs

G = 9.8


class Rest(AbstractMode):
    """A unit mass on a table, pulled upwards by a force k t."""

    pull: float

    def field(self, t, y):
        return 0.0 * y

    def margin(self, t, y):
        return G - self.pull * t

    def reset(self, t, y):
        return y, 1


class Free(Rest):
    """The same mass above the table."""

    def field(self, t, y):
        return jnp.array([y[1], self.pull * t - G])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.zeros(2), 0


PULLS = np.linspace(3.0, 9.0, 25)


def lifted(pull):
    return Hybrid([Rest(pull), Free(pull)], event=lambda t, y: 1.0 - y[0])


def test_a_mass_is_lifted_off_a_table_in_a_table_and_in_a_batch():
    """It rises by k (t - G / k)^3 / 6."""
    table = sweep(lifted(3.0), [0.0, 0.0], 5.0, axes={"modes[*].pull": PULLS})
    expected = G / PULLS + np.cbrt(6.0 / PULLS)
    assert_close(np.asarray(table["time"]), expected, atol=1e-8)
    differentiated = jax.value_and_grad(lambda pull: event_time(lifted(pull), [0.0, 0.0], 5.0))
    slopes = jax.jit(jax.vmap(differentiated))(PULLS[::6])
    assert_close(slopes[0], expected[::6], atol=1e-8)
    assert_close(slopes[1], -G / PULLS[::6] ** 2 - np.cbrt(6.0 / PULLS[::6]) / (3.0 * PULLS[::6]), atol=1e-6)
    ends = jax.vmap(lambda pull: simulate(lifted(pull), [0.0, 0.0], 4.0, times=[4.0]).state[0, 0])(PULLS)
    assert_close(ends, PULLS * (4.0 - G / PULLS) ** 3 / 6.0, atol=1e-7)


class On(AbstractMode):
    """A particle on a smooth circle."""

    def load(self, y):
        return G * y[1] - (y[2] ** 2 + y[3] ** 2)

    def field(self, t, y):
        return jnp.array([y[2], y[3], self.load(y) * y[0], self.load(y) * y[1] - G])

    def margin(self, t, y):
        return self.load(y)

    def reset(self, t, y):
        return y, 1


class Off(AbstractMode):
    def field(self, t, y):
        return jnp.array([y[2], y[3], 0.0, -G])

    def margin(self, t, y):
        return y[0] ** 2 + y[1] ** 2 - 1.0

    def reset(self, t, y):
        return y, 0


def fallen(angle, time):
    """The place of a particle that slid off the circle from rest at an angle."""
    cosine = 2.0 / 3.0 * np.cos(angle)
    sine, speed = np.sqrt(1.0 - cosine**2), np.sqrt(G * cosine)

    def slowness(u):
        return 2.0 * u / np.sqrt(4.0 * G * np.sin(angle + 0.5 * u * u) * np.sin(0.5 * u * u))

    end = np.sqrt(np.arccos(cosine) - angle)
    left = time - quad(slowness, 1e-12, end, epsabs=1e-13, epsrel=1e-13, limit=200)[0]
    return [sine + speed * cosine * left, cosine - speed * sine * left - 0.5 * G * left**2]


@pytest.mark.parametrize("tolerance", [1e-6, 1e-9])
def test_a_particle_slides_off_a_circle_whatever_the_times(tolerance):
    """The margin of the flight begins with the error of the slide, and so do its slope and its curvature."""
    angles = np.linspace(0.1, 0.6, 6)
    starts = np.stack([np.sin(angles), np.cos(angles), 0.0 * angles, 0.0 * angles], axis=1)

    def ends(times):
        def end(start):
            run = simulate(Hybrid([On(), Off()]), start, 3.0, times=times, tolerance=tolerance)
            return run.state[-1, :2], run.switches

        return jax.vmap(end)(starts)

    for times in (jnp.linspace(2.999, 3.0, 41), jnp.linspace(0.0, 3.0, 41)):
        places, switches = ends(times)
        assert_close(places, [fallen(angle, 3.0) for angle in angles], atol=20.0 * tolerance)
        assert switches.tolist() == [1] * 6


DRIVE, LIFT, FRICTION = 0.4, 2.0, 0.5


class Shaken(AbstractMode):
    """A block on a shaken table: its height, and its vertical and horizontal speeds."""

    slip: int = 0  # the sign of the horizontal speed, or 0 if the block sticks

    def load(self, t):
        return 1.0 + LIFT * jnp.cos(t)

    def force(self, t):
        return DRIVE * jnp.cos(1.7 * t + 0.3)

    def hold(self, t):
        return FRICTION * self.load(t) - jnp.abs(self.force(t))

    def field(self, t, y):
        rate = self.force(t) - self.slip * FRICTION * self.load(t)
        return jnp.stack([0.0 * t, 0.0 * t, rate if self.slip else 0.0 * t])

    def margin(self, t, y):
        return jnp.minimum(self.slip * y[2], self.load(t)) if self.slip else self.hold(t)

    def reset(self, t, y):
        direction = jnp.where(self.force(t) > 0.0, 1, -1)
        if not self.slip:
            return y, 1 + direction
        stops = self.slip * y[2] <= self.load(t)
        number = jnp.where(stops, 1 + jnp.where(self.hold(t) > 0.0, 0, direction), 3)
        return jnp.where(stops, 0.0 * y, y), number


class Aloft(Shaken):
    def field(self, t, y):
        return jnp.stack([y[1], -self.load(t), self.force(t)])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, 0.0, y[2]]), 1 + jnp.sign(y[2]).astype(int)


def test_a_block_on_a_shaken_table_sticks_slips_flies_and_lands():
    """All margins begin at 0. The block leaves the table where the load vanishes; its flight has a closed form."""
    shaken = Hybrid([Shaken(-1), Shaken(0), Shaken(1), Aloft()], first=1)
    off = np.arccos(-1.0 / LIFT)

    def height(t):
        drop, late = np.sqrt(LIFT**2 - 1.0), t - off
        return LIFT * (np.cos(t) - np.cos(off)) - 0.5 * late**2 + drop * late

    landing = brentq(height, off + 1.0, off + 6.0)
    ends = []
    for tolerance in (1e-6, 1e-9):
        run = simulate(shaken, [0.0, 0.0, 0.0], 25.0, tolerance=tolerance)
        assert run.status == "completed"
        time, before, after = (np.asarray(run.resets[name]) for name in ("time", "mode_before", "mode_after"))
        assert np.all(np.diff(time) >= 0.0)
        assert set(before) == {0, 1, 2, 3}
        assert_close(time[after == 3][0], off, atol=10.0 * tolerance)
        assert_close(time[before == 3][0], landing, atol=100.0 * tolerance)
        speed, mode = np.asarray(run.state)[:, 2], np.asarray(run.mode)
        assert np.all(speed[mode == 1] == 0.0)
        assert np.all(speed[mode == 2] >= 0.0)
        assert np.all(speed[mode == 0] <= 0.0)
        ends.append(speed[-1])
    assert_close(ends[0], ends[1], atol=1e-4)


class Stuck(AbstractMode):
    """A mass on a belt at 0.38 m/s, against a spring, until the grip fails; the floor shakes."""

    def grip(self, t):
        return 0.4944 * (9.81 - 14.1 * jnp.sin(33.24 * t + 86.88))

    def field(self, t, y):
        return jnp.array([0.3815, 0.0])

    def margin(self, t, y):
        return self.grip(t) ** 2 - (33.86 * y[0]) ** 2

    def reset(self, t, y):
        return y, 1


class Sliding(Stuck):
    """Until it sticks again, or strikes a wall that is near."""

    def field(self, t, y):
        return jnp.array([y[1], self.grip(t) - 33.86 * y[0]])

    def margin(self, t, y):
        return {"sticks": 0.3815 - y[1], "wall": 0.1085 - y[0]}

    def reset(self, t, y, exit):
        return y, 2


class Waiting(AbstractMode):
    def field(self, t, y):
        return jnp.zeros(2)


def test_a_wall_soon_after_the_grip_fails_is_found_in_few_trials():
    """The margin for sticking begins with slope 0. The step before the wall was once cut by a few thousandths, thousands of
    times, or for ever."""
    run = simulate(Hybrid([Stuck(), Sliding(), Waiting()]), [0.093448, 0.3815], 0.05, times=[0.05], tolerance=1e-10)
    assert list(run.resets["margin"]) == ["0", "wall"]
    assert_close(run.state[-1, 0], 0.1085, rtol=1e-12)
    assert int(run.rejected) < 20


@needs_browser
def test_the_browser_lifts_the_mass_as_the_closed_form_does():
    live = page_of(model_of(lifted(3.0), [0.0, 0.0]), {"modes[*].pull": (3.0, 9.0)}, 5.0)[0]
    with open_browser() as driver:
        times = driver.execute_script(
            f"""{programs(live)}
            const asks = integrator(live.answer);
            return {PULLS.tolist()}.map((pull) => {{
              asks.run([pull]);
              return asks.read("outcome", [pull])[1];
            }})"""
        )
    assert_close(np.array(times, float), G / PULLS + np.cbrt(6.0 / PULLS), atol=1e-8)
