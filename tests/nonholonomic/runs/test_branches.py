"""Branches of periodic orbits against closed forms and published values."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nonholonomic import AbstractMode, Hybrid, Table, periodic_orbit
from nonholonomic.runs.continuation import is_rotating


class Iterated(AbstractMode):
    """A map, once a second: x -> shift + growth x (1 - (1 - delayed) x - delayed y), y -> x."""

    growth: float
    delayed: float = 0.0
    shift: float = 0.0

    def field(self, t, y):
        return jnp.array([0.0, 0.0, 1.0])

    def margin(self, t, y):
        return 1.0 - y[2]

    def reset(self, t, y):
        crowd = (1.0 - self.delayed) * y[0] + self.delayed * y[1]
        return jnp.array([self.shift + self.growth * y[0] * (1.0 - crowd), y[0], 0.0]), 0


def clock(t, y):
    return 1.0 - y[2]


def fixed(growth, x, **numbers):
    return periodic_orbit(Hybrid([Iterated(growth, **numbers)]), [x, x, 0.0], clock)


def test_the_logistic_map_doubles_its_period(tmp_path):
    """At 3, 1 + sqrt(6), 3.5440903596 (OEIS A086181) and so on: a switch leads to an orbit beside the doubling, not to
    one farther away on the same branch."""
    branch = fixed(2.9, 0.6).branch("growth", 3.2)
    np.testing.assert_allclose(branch.states[:, 0], 1.0 - 1.0 / branch.values, atol=1e-11)
    np.testing.assert_allclose(branch.multipliers[:, 0].real, 2.0 - branch.values, atol=1e-9)
    np.testing.assert_array_equal(branch.stable, branch.values < 3.0 - 1e-8)
    assert [point.kind for point in branch.special] == ["period doubling"]
    np.testing.assert_allclose(branch.special[0].value, 3.0, atol=1e-10)
    np.testing.assert_allclose(branch.values[-1], 3.2, rtol=1e-12)
    # The other way, too, the orbit changes its stability at the special point.
    backward = repr(fixed(3.1, 1.0 - 1.0 / 3.1).branch("growth", 2.9))
    assert "  unstable from 3.1 to 3\n  stable from 3 to 2.9\n" in backward

    doubled = branch.switched().branch("growth", 3.6)
    assert doubled.orbit(0).returns == 2
    np.testing.assert_allclose(doubled.periods, 2.0, rtol=1e-12)
    # The two values of x are those of the quadratic equation r^2 x^2 - r (r + 1) x + r + 1 = 0.
    r, x = np.asarray(doubled.values), np.asarray(doubled.states[:, 0])
    np.testing.assert_allclose(r**2 * x**2 - r * (r + 1.0) * x + r + 1.0, 0.0, atol=1e-9)
    np.testing.assert_allclose(doubled.special[0].value, 1.0 + np.sqrt(6.0), atol=1e-9)
    again = doubled.switched().branch("growth", 3.55)
    np.testing.assert_allclose(again.special[0].value, 3.5440903595519, atol=1e-8)
    third = again.switched().branch("growth", 3.566)
    np.testing.assert_allclose(third.values[0], 3.5440903595519, atol=2e-3)
    np.testing.assert_allclose(third.special[0].value, 3.5644072660954, atol=1e-8)
    assert third.switched().returns == 16

    kept = pickle.loads(pickle.dumps(branch))
    np.testing.assert_array_equal(kept.states, branch.states)
    with pytest.raises(ValueError, match="an orbit that periodic_orbit has found in this process"):
        kept.switched()

    lines = repr(again).splitlines()
    assert lines[0].startswith("branch of periodic orbits over growth, ")
    assert "  period doubling at growth = 3.544090359, period 4 s" in lines
    assert lines[-1] == "  ended because the number reaches the end of the range"
    branch.save(tmp_path / "branch.h5")
    table = Table.load(tmp_path / "branch.h5")
    np.testing.assert_array_equal(table["value"], branch.values)
    assert [word.replace("_", " ") for word in table["kind"].tolist()] == list(branch.kinds)
    assert branch.to_xarray()["multipliers_real"].dims == ("point", "multiplier")
    (panel,) = branch.plot("y0").axes
    assert [text.get_text() for text in panel.texts] == ["period doubling"]
    solid, dashed, _ = panel.lines
    assert [solid.get_linestyle(), dashed.get_linestyle()] == ["-", "--"]
    # Each in one piece, so that dashes show.
    np.testing.assert_allclose([solid.get_xdata()[0], solid.get_xdata()[-1]], [2.9, 3.0], atol=1e-8)
    np.testing.assert_allclose([dashed.get_xdata()[0], dashed.get_xdata()[-1]], [3.0, 3.2], atol=1e-8)


def test_a_fold_a_torus_and_a_branch_point():
    """x = shift + growth x (1 - x) has two solutions beyond (growth - 1)^2 = -4 growth shift. The multipliers of the delayed
    logistic map have the product growth - 1. Without a shift, x = 0 and x = 1 - 1 / growth meet at 1."""
    folded = fixed(3.0, 0.6, shift=-0.125).branch("growth", 1.0)
    torus = fixed(1.8, 0.4, delayed=1.0).branch("growth", 2.1)
    crossed = fixed(2.0, 0.5).branch("growth", 0.5)
    for branch, kind, value in ((folded, "fold", 2.0), (torus, "Neimark-Sacker", 2.0), (crossed, "branch point", 1.0)):
        assert [point.kind for point in branch.special] == [kind]
        np.testing.assert_allclose(branch.special[0].value, value, atol=1e-9)
    # Real multipliers whose product is 1 are no torus.
    assert [is_rotating(np.array(pair)) for pair in ([0.6 + 0.8j, 0.6 - 0.8j], [2.0, 0.5 + 0.0j])] == [True, False]
    # Around the fold, back to the first value.
    np.testing.assert_allclose(folded.values[-1], 3.0, rtol=1e-12)
    np.testing.assert_allclose(folded.states[-1, 0], (2.0 - np.sqrt(2.5)) / 6.0, atol=1e-10)
    assert folded.end == "the number reaches its first value again"
    np.testing.assert_allclose(crossed.states[-1, 0], -1.0, atol=1e-10)
    other = crossed.switched().branch("growth", 1.5)
    np.testing.assert_allclose(other.states[:, 0], 0.0, atol=1e-12)


class Apart(AbstractMode):
    """A driven oscillator beside a soft stop."""

    frequency: float
    stop: float = 1.0
    stiffness: float = 5.0

    def field(self, t, y):
        return jnp.array([y[1], jnp.cos(self.frequency * t) - y[0] - 0.4 * y[1]])

    def margin(self, t, y):
        return self.stop - y[0]

    def reset(self, t, y):
        return y, 1


class Pressed(Apart):
    def field(self, t, y):
        return super().field(t, y) - jnp.array([0.0, self.stiffness * (y[0] - self.stop)])

    def margin(self, t, y):
        return y[0] - self.stop

    def reset(self, t, y):
        return y, 0


def period_of_drive(frequency):
    return 2.0 * jnp.pi / frequency


def test_a_driven_branch_ends_where_it_grazes():
    """The amplitude 1 / |1 - w^2 + 0.4 i w| is 1 at w^2 = 1.84."""
    orbit = periodic_orbit(Hybrid([Apart(1.6), Pressed(1.6)]), [0.0, 0.0], period=period_of_drive(1.6))
    branch = orbit.branch("frequency", 1.2, period=period_of_drive)
    frequencies = np.asarray(branch.values)
    amplitude = 1.0 / (1.0 - frequencies**2 + 0.4j * frequencies)
    np.testing.assert_allclose(branch.states[:, 0], amplitude.real, atol=1e-10)
    np.testing.assert_allclose(branch.periods, 2.0 * np.pi / frequencies, rtol=1e-10)
    assert [point.kind for point in branch.special] == ["grazing"]
    np.testing.assert_allclose(branch.special[0].value, np.sqrt(1.84), atol=1e-8)
    for change, message in (
        (
            {"period": lambda frequency: 6.0 + 0.0 * frequency},
            r"period\(1.6\) = 6 s must be that of the drive, 3.92699",
        ),
        ({"name": "speed"}, "name: 'speed' must be one of "),
        ({"name": "start[0]"}, "is a part of the start; pass a number of the system"),
        ({"until": 1.6}, "until = 1.6 is the value of frequency at the orbit"),
        ({"until": np.nan}, "until = nan must be finite"),
        ({"points": 1}, "points = 1 must be a whole number of at least 2"),
        ({"step": 0.0}, "step = 0.0 must be greater than 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            orbit.branch(**{"name": "frequency", "until": 1.2, **change})
    with pytest.raises(ValueError, match="one orbit, not a batch"):
        branch.orbits.branch("frequency", 1.2)
    with pytest.raises(ValueError, match=r"k = 0 must be the place of .* among special: grazing"):
        branch.switched(0)
    with pytest.raises(ValueError, match="quantity = 'speed' must be one of period, y0, y1"):
        branch.plot("speed")
    with pytest.raises(ValueError, match="branch cannot be called inside jit"):
        jax.jit(lambda until: orbit.branch("frequency", until).values)(1.2)
