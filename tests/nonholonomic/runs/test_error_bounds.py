"""Error bounds of tables of random systems, against runs at a tolerance of 1e-13."""

import jax.numpy as jnp
import numpy as np
import pytest

import nonholonomic

#: Relative errors of the reference.
OF_REFERENCE = 1e-10


class Roll(nonholonomic.AbstractMode):
    """A ball that rolls through troughs against the drag of the air."""

    drag: float
    wave: float

    def field(self, t, y):
        return jnp.array([y[1], -self.drag * y[1] * jnp.abs(y[1]) - jnp.sin(self.wave * y[0])])


class Impact(nonholonomic.AbstractMode):
    """An oscillator with an input, a stop and a count of its impacts."""

    drag: float
    size: float
    pulse: float
    restitution: float

    def field(self, t, y):
        return jnp.array([y[1], -self.drag * y[1] - y[0] + self.size * jnp.cos(self.pulse * t), 0.0])

    def margin(self, t, y):
        return 0.4 - y[0]

    def reset(self, t, y):
        return jnp.array([y[0], -self.restitution * y[1], y[2] + 1.0]), 0


class Table(nonholonomic.AbstractMode):
    """A ball on a table that vibrates, with a count of its impacts."""

    size: float
    pulse: float
    restitution: float

    def field(self, t, y):
        return jnp.array([y[1], -9.81, 0.0])

    def margin(self, t, y):
        return y[0] - self.size * jnp.sin(self.pulse * t)

    def reset(self, t, y):
        speed = self.size * self.pulse * jnp.cos(self.pulse * t)
        return jnp.array([y[0], speed - self.restitution * (y[1] - speed), y[2] + 1.0]), 0


def before_impact(number):
    """The event of an impact."""
    return lambda t, y: number - 0.5 - y[2]


#: System, start, horizon [s], event, and the ranges of the numbers.
KINDS = {
    "roll": (
        nonholonomic.Hybrid([Roll(0.1, 1.0)]),
        [0.0, 1.0],
        10.0,
        lambda t, y: y[1] + 0.2,
        {"drag": (0.0, 0.4), "wave": (0.4, 2.0), "start[0]": (-1.0, 1.0), "start[1]": (0.5, 2.0)},
    ),
    "impact": (
        nonholonomic.Hybrid([Impact(0.1, 0.5, 1.0, 0.7)]),
        [0.0, 0.0, 0.0],
        15.0,
        before_impact(12),
        {
            "drag": (0.0, 0.4),
            "size": (0.2, 1.5),
            "pulse": (0.4, 3.0),
            "restitution": (0.3, 1.0),
            "start[0]": (-1.5, 0.3),
            "start[1]": (-1.0, 1.0),
        },
    ),
    "table": (
        nonholonomic.Hybrid([Table(0.02, 20.0, 0.8)]),
        [0.5, 0.0, 0.0],
        2.5,
        before_impact(10),
        {
            "size": (0.01, 0.05),
            "pulse": (15.0, 40.0),
            "restitution": (0.6, 0.95),
            "start[0]": (0.1, 0.8),
            "start[1]": (-1.0, 1.0),
        },
    ),
}


def exceedances(kind, tolerance, cells):
    """How many bounds there are, how many errors exceed theirs, and the ratios of bounds to errors, which are at least those
    of the reference."""
    system, start, t1, event, ranges = KINDS[kind]
    rng = np.random.default_rng(61)
    axes = {name: rng.uniform(*limits, cells) for name, limits in ranges.items()}
    options = {"event": event, "axes": axes, "scattered": True, "progress": False}
    table = nonholonomic.sweep(system, start, t1, tolerance=tolerance, errors=True, **options)
    true = nonholonomic.sweep(system, start, t1, tolerance=1e-13, **options)
    names = [
        name for name in true.variables if f"{name}_error" in table.variables and name not in ("status", "switches")
    ]
    largest = np.max([np.abs(true[name]) for name in names if name not in ("time", "end_time")], axis=0)
    number, below, ratios = 0, 0, []
    for name in names:
        bound = np.asarray(table[f"{name}_error"])
        known = np.isfinite(bound) & np.isfinite(table[name])
        error = np.abs(np.where(known, table[name], 0.0) - np.where(known, true[name], 0.0))
        size = np.abs(true[name]) if name in ("time", "end_time") else largest
        least = OF_REFERENCE * np.where(np.isfinite(size), size, 0.0)
        number, below = number + known.sum(), below + (known & (error - least > bound)).sum()
        known &= (np.isfinite(error)) & (error + least > 0.0)
        ratios.append(bound[known] / (error + least)[known])
    return number, below, np.concatenate(ratios)


def test_bounds_bound_the_errors_of_a_table():
    """Where the tolerance does not limit the steps, a second run errs like the first, and some bounds from two runs fail."""
    number, below, ratios = exceedances("roll", 1e-5, 200)
    assert number > 700
    assert below == 0
    assert np.median(ratios) < 15.0


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-4, 1e-5, 1e-6, 1e-8])
@pytest.mark.parametrize("kind", KINDS)
def test_bounds_bound_the_errors_of_many_systems(kind, tolerance):
    number, below, ratios = exceedances(kind, tolerance, 3000)
    print(
        f"{kind} at {tolerance:.0e}: {below} of {number} errors above their bounds, median ratio {np.median(ratios):.1f}"
    )
    assert number > 8000
    assert below == 0
    assert np.median(ratios) < 15.0
