"""Count the events that are missed or invented in families of random runs whose motion is known in closed form.

    python benchmarks/events.py [family ...] [--starts 10000] [--tolerances 1e-6 1e-9 1e-11]

Each family has an event function that changes faster than the motion. The right time is the first zero of this function
along the closed form, found by a dense scan and bisection. Runs in which a minimum comes within 1e-6 of the function's size of
zero count as grazing and are left out; the table shows how many.
"""

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from measure import machine
from measure import table as rows_as_table

import nonholonomic

G = 9.81

#: Points of the scan of a run; and the error of a time [s] from which it counts as that of another event.
POINTS, LARGEST_ERROR = 20_000, 1e-4


class Ballistic(nonholonomic.AbstractMode):
    names = ("x", "y", "vx", "vy")

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, -G])


class Straight(nonholonomic.AbstractMode):
    names = ("x", "y", "vx", "vy")

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, 0.0])


class Oscillator(nonholonomic.AbstractMode):
    names = ("x", "y", "vx", "vy")

    def field(self, t, s):
        return jnp.array([s[2], s[3], -s[0], -4.0 * s[1]])


class Spiral(nonholonomic.AbstractMode):
    """A stiff-free decay with rotation, which the method does not integrate exactly."""

    names = ("x", "y", "vx", "vy")

    def field(self, t, s):
        return jnp.array([-0.1 * s[0] - s[1], s[0] - 0.1 * s[1], -0.3 * s[2], -0.05 * s[3]])


def ballistic(t: Any, s: Any) -> Any:
    return s[0] + s[2] * t, s[1] + s[3] * t - 0.5 * G * t * t, s[2] + 0 * t, s[3] - G * t


def straight(t: Any, s: Any) -> Any:
    return s[0] + s[2] * t, s[1] + s[3] * t, s[2] + 0 * t, s[3] + 0 * t


def oscillating(t: Any, s: Any) -> Any:
    c, n, c2, n2 = jnp.cos(t), jnp.sin(t), jnp.cos(2 * t), jnp.sin(2 * t)
    return s[0] * c + s[2] * n, s[1] * c2 + 0.5 * s[3] * n2, s[2] * c - s[0] * n, s[3] * c2 - 2 * s[1] * n2


def spiralling(t: Any, s: Any) -> Any:
    c, n, d = jnp.cos(t), jnp.sin(t), jnp.exp(-0.1 * t)
    return d * (s[0] * c - s[1] * n), d * (s[0] * n + s[1] * c), s[2] * jnp.exp(-0.3 * t), s[3] * jnp.exp(-0.05 * t)


@dataclasses.dataclass(frozen=True)
class Family:
    """A family of runs: its motion as a mode and in closed form, its event function, its starts and their horizon [s]."""

    mode: nonholonomic.AbstractMode
    motion: Callable[[Any, Any], Any]
    event: Callable[[Any, Any], Any]
    starts: Callable[[np.random.Generator, int], list[np.ndarray]]
    t1: float


def over_ramp(wave: Callable[[Any], Any]) -> Callable[[np.random.Generator, int], list[np.ndarray]]:
    """Starts above a ground of the given height."""

    def starts(rng: np.random.Generator, n: int) -> list[np.ndarray]:
        x, vx, vy = rng.uniform(0, 0.3, n), rng.uniform(0.5, 8, n), rng.uniform(-2, 2, n)
        return [x, np.asarray(wave(x)) + rng.uniform(0.02, 0.5, n), vx, vy]

    return starts


def in_box(size: float, low: float, high: float) -> Callable[[np.random.Generator, int], list[np.ndarray]]:
    """Starts in a square, in any direction with a speed in a range."""

    def starts(rng: np.random.Generator, n: int) -> list[np.ndarray]:
        x, y, angle, v = *rng.uniform(-size, size, (2, n)), rng.uniform(0, 6.3, n), rng.uniform(low, high, n)
        return [x, y, v * np.cos(angle), v * np.sin(angle)]

    return starts


def ramp(x: Any) -> Any:
    return 1 - x + 0.05 * jnp.cos(11 * jnp.pi * x)


def hills(x: Any) -> Any:
    return 0.1 * jnp.sin(9.0 * x) + 0.03 * jnp.sin(41.0 * x + 1.0)


def star(t: Any, s: Any) -> Any:
    r2, angle = s[0] ** 2 + s[1] ** 2, jnp.arctan2(s[1], s[0])
    return (1.0 + 0.3 * jnp.cos(5.0 * angle)) ** 2 - r2


def posts(t: Any, s: Any) -> Any:
    """Round posts on a lattice."""
    return jnp.sin(jnp.pi * s[0]) ** 2 + jnp.sin(jnp.pi * s[1]) ** 2 - 0.02


FAMILIES = {
    "wavy ramp": Family(Ballistic(), ballistic, lambda t, s: s[1] - ramp(s[0]), over_ramp(ramp), 6.0),
    "two waves": Family(Ballistic(), ballistic, lambda t, s: s[1] - hills(s[0]), over_ramp(hills), 3.0),
    "vibrating table": Family(
        Ballistic(),
        ballistic,
        lambda t, s: s[1] - 0.02 * jnp.sin(170.0 * t),
        lambda rng, n: [
            0 * rng.uniform(size=n),
            rng.uniform(0.03, 1.5, n),
            0 * rng.uniform(size=n),
            rng.uniform(-1, 3, n),
        ],
        4.0,
    ),
    "star-shaped room": Family(Straight(), straight, star, in_box(0.4, 0.2, 3.0), 12.0),
    "square room": Family(
        Straight(), straight, lambda t, s: (1 - s[0] ** 2) * (1 - s[1] ** 2), in_box(0.9, 0.5, 2.0), 7.0
    ),
    "lattice of posts": Family(
        Straight(),
        straight,
        posts,
        lambda rng, n: [
            *rng.uniform(0.3, 0.7, (2, n)),
            *(rng.uniform(0.3, 3.0, n) * np.stack([np.cos(a := rng.uniform(0, 6.3, n)), np.sin(a)])),
        ],
        8.0,
    ),
    "narrow dip": Family(
        Straight(),
        straight,
        lambda t, s: 1.0 - 1.2 * jnp.exp(-((s[0] - 2.0) ** 2 + s[1] ** 2) / 0.05**2),
        lambda rng, n: [
            rng.uniform(-1, 1, n),
            rng.uniform(-0.08, 0.08, n),
            rng.uniform(0.5, 4.0, n),
            0 * rng.uniform(size=n),
        ],
        5.0,
    ),
    "pulse in time": Family(
        Oscillator(),
        oscillating,
        lambda t, s: 1.5 - s[0] - 2.0 * jnp.exp(-(((t - 4.3) / 0.04) ** 2)),
        in_box(0.7, 0.1, 0.7),
        9.0,
    ),
    "fast ripples": Family(
        Oscillator(),
        oscillating,
        lambda t, s: 1.2 + s[0] + 0.3 * jnp.sin(40.0 * s[1]) * jnp.cos(3.0 * s[0]),
        in_box(0.7, 0.1, 0.9),
        9.0,
    ),
    "toothed rack": Family(
        Oscillator(),
        oscillating,
        lambda t, s: jnp.abs(jnp.mod(6.0 * s[0] + 1.3 * s[1], 1.0) - 0.5) - 0.02,
        in_box(0.7, 0.1, 0.7),
        9.0,
    ),
    "spiral over a grid": Family(
        Spiral(),
        spiralling,
        lambda t, s: s[2] + s[3] - 0.25 * jnp.sin(25.0 * s[0]) - 0.25 * jnp.sin(31.0 * s[1]),
        lambda rng, n: [*rng.uniform(-1.5, 1.5, (2, n)), *rng.uniform(0.5, 0.9, (2, n))],
        9.0,
    ),
}


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def first_zeros(motion: Any, event: Any, t1: float, start: Any) -> Any:
    """The first zero of each run, and whether a minimum before it, or the depth behind it, is too small to count."""

    def function(t: Any, s: Any) -> Any:
        return event(t, motion(t, s))

    def of_one(s: Any) -> Any:
        times = jnp.linspace(0.0, t1, POINTS)
        values = jax.vmap(lambda t: function(t, s))(times)
        slopes = jax.vmap(lambda t: jax.jvp(lambda t: function(t, s), (t,), (1.0,))[1])(times)
        size = jnp.max(jnp.abs(values))
        # The least of each gap, where the cubic through values and slopes at its ends has its minimum.
        h = times[1] - times[0]
        fall, rise, climb = h * slopes[:-1], h * slopes[1:], values[1:] - values[:-1]
        cubic, square = 3.0 * (fall + rise - 2.0 * climb), 3.0 * climb - 2.0 * fall - rise
        root = square + jnp.sqrt(jnp.maximum(square * square - cubic * fall, 0.0))
        place = -fall / jnp.where(root == 0.0, 1.0, root)
        has_inner = (fall < 0.0) & (rise > 0.0) & (place > 0.0) & (place < 1.0)
        inner = jax.vmap(lambda t: function(t, s))(times[:-1] + h * jnp.where(has_inner, place, 0.0))
        least = jnp.where(has_inner, inner, jnp.minimum(values[:-1], values[1:]))
        gap = jnp.argmax(least < 0.0)
        crosses = jnp.any(least < 0.0)
        low = times[gap]
        high = jnp.where(has_inner[gap] & (inner[gap] < 0.0), low + h * place[gap], times[gap + 1])

        def halve(_: Any, bracket: Any) -> Any:
            low, high = bracket
            middle = 0.5 * (low + high)
            inside = function(middle, s) > 0.0
            return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

        low, high = jax.lax.fori_loop(0, 60, halve, (low, high))
        # The dip behind the zero lasts until the function is positive again.
        index = jnp.arange(POINTS - 1)
        is_local = has_inner & (jnp.abs(inner) < 1e-6 * size)
        grazes = jnp.any(is_local & (~crosses | (index <= gap)))
        return jnp.where(crosses, 0.5 * (low + high), jnp.inf), grazes, values[0] <= 0.0

    return jax.lax.map(of_one, start, batch_size=25)


class Findings(NamedTuple):
    """What a family showed at a tolerance: the runs that count, and of these the numbers of wrong, late and failed ones;
    the runs that graze; the largest error [s] of the right ones; the mean number of steps; and the time [s] with compilation.
    """

    name: str
    tolerance: float
    counted: int
    wrong: int
    late: int
    failed: int
    graze: int
    error: float
    steps: float
    seconds: float


def compared(name: str, starts: int, tolerances: list[float]) -> list[Findings]:
    """The findings of a family at several tolerances."""
    family, findings = FAMILIES[name], []
    start = np.stack(family.starts(np.random.default_rng(sum(map(ord, name))), starts))
    right, grazes, beyond = (np.asarray(x) for x in first_zeros(family.motion, family.event, family.t1, start.T))
    counts, system = ~grazes & ~beyond, nonholonomic.Hybrid([family.mode])
    axes = {f"start[{k}]": part for k, part in enumerate(start)}
    for tolerance in tolerances:
        began = time.perf_counter()
        table = nonholonomic.sweep(
            system, [0.0] * 4, family.t1, event=family.event, scattered=True, tolerance=tolerance, axes=axes
        )
        seconds, status = time.perf_counter() - began, np.asarray(table["status"])
        times = np.where(status == "completed", np.inf, np.where(status == "event", np.asarray(table["time"]), np.nan))
        with np.errstate(invalid="ignore"):
            error = np.where(times == right, 0.0, np.abs(times - right))
        wrong = counts & ~(error < LARGEST_ERROR)
        rows = (counts, wrong, wrong & (times > right), counts & np.isnan(times), grazes)
        worst, steps = np.max(error, initial=0.0, where=counts & ~wrong), np.mean(np.asarray(table["steps"]))
        findings.append(
            Findings(name, tolerance, *(int(row.sum()) for row in rows), float(worst), float(steps), seconds)
        )
    return findings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--starts", type=int, default=10_000)
    parser.add_argument("--tolerances", type=float, nargs="*", default=[1e-6, 1e-9, 1e-11])
    options = parser.parse_args()
    print(machine())
    rows = [found for name in options.families for found in compared(name, options.starts, options.tolerances)]
    print(
        rows_as_table(
            [
                {
                    key: f"{value:.3g}" if isinstance(value, float) else str(value)
                    for key, value in row._asdict().items()
                }
                for row in rows
            ]
        )
    )
