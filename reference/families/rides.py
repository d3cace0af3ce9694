"""Driven and steered rides of the stroller."""

from collections.abc import Callable, Iterator, Sequence
from math import cos, pi, sin, sqrt
from typing import Any

import numpy as np
import stroller_reference

from .solutions import COARSE, FINE, Array, Scene, bounded, states_at

Level = stroller_reference.Level


def waves(numbers: list[list[float]]) -> Level:
    """z = sum of h sin(kx x + ky y + phase)."""
    height, kx, ky, phase = np.array(numbers).T

    def slopes(x: float, y: float) -> tuple[Array, Array]:
        angle, k = kx * x + ky * y + phase, np.stack([kx, ky])
        return k @ (height * np.cos(angle)), -(k * height * np.sin(angle)) @ k.T

    return stroller_reference.graph(slopes)


def height_of(numbers: list[list[float]], x: float, y: float) -> float:
    return float(sum(h * np.sin(kx * x + ky * y + phase) for h, kx, ky, phase in numbers))


def ground(random: np.random.Generator, shape: str) -> tuple[dict[str, Any], Level, Array, float]:
    """A ground as the files have it, its level function, a point of it and the side on which the stroller is."""
    x, y = random.uniform(-0.5, 0.5, 2)
    if shape == "plane":
        tilt = float(f"{random.uniform(0.0, 0.3):.4g}")
        level = stroller_reference.graph(lambda x, y: (np.array([np.tan(tilt), 0.0]), np.zeros((2, 2))))
        return {"shape": "plane", "tilt": tilt}, level, np.array((x, y, x * np.tan(tilt))), 1.0
    if shape == "paraboloid":
        radius = float(f"{random.uniform(0.8, 3.0):.4g}")
        level = stroller_reference.graph(lambda x, y: (np.array([x, y]) / radius, np.eye(2) / radius))
        return {"shape": "paraboloid", "radius": radius}, level, np.array((x, y, (x * x + y * y) / (2.0 * radius))), 1.0
    if shape == "waves":
        numbers = [
            [float(f"{value:.4g}") for value in random.uniform((0.05, -1.5, -1.5, 0.0), (0.2, 1.5, 1.5, 6.0))]
            for _ in range(3)
        ]
        return {"shape": "waves", "waves": numbers}, waves(numbers), np.array((x, y, height_of(numbers, x, y))), 1.0
    if shape == "torus":
        ring, tube = (float(f"{value:.4g}") for value in random.uniform((2.5, 0.8), (4.0, 1.5)))
        angle, lift = random.uniform(-3.0, 3.0), random.uniform(-2.0, -1.0)
        rho = ring + tube * cos(lift)
        place = np.array((rho * cos(angle), rho * sin(angle), tube * sin(lift)))
        return {"shape": "torus", "ring": ring, "tube": tube}, stroller_reference.torus(ring, tube), place, -1.0
    radius = float(f"{random.uniform(2.0, 4.0):.4g}")
    place = np.array((x, y, -sqrt(radius**2 - x * x - y * y)))
    return (
        {"shape": "sphere", "radius": radius, "side": "inside"},
        Level(lambda r: (2.0 * r, 2.0 * np.eye(3))),
        place,
        -1.0,
    )


RIDES = (
    "plane",
    "plane",
    "plane",
    "paraboloid",
    "paraboloid",
    "paraboloid",
    *["waves"] * 4,
    *["torus"] * 3,
    *["sphere"] * 3,
)


def strollers() -> Iterator[Scene]:
    """Driven and steered rides for three seconds, by multipliers in the fixed frame."""
    random = np.random.default_rng(20261123)
    for number, shape in enumerate(RIDES):
        described, level, place, side = ground(random, shape)
        mass, wheelbase, inertia, fork, spring, *damping = (
            float(f"{value:.4g}")
            for value in random.uniform(
                (1.0, 0.2, 0.2, 0.02, 0.1, 0.1, 0.1, 0.05, 0.02), (3.0, 0.5, 0.6, 0.08, 0.3, 0.5, 0.4, 0.2, 0.1)
            )
        )
        force = {"mean": 1.0, "amplitude": 1.0, "frequency": 2.0, "phase": 0.0}
        torque = {"mean": 0.0, "amplitude": 0.2, "frequency": 3.0, "phase": 0.5 * pi}
        push = pushed(force, torque)
        vehicle = stroller_reference.Vehicle(
            mass, wheelbase, inertia, fork, spring, tuple(damping), 9.81, push, True, side
        )
        n, _ = level.normal(place)
        e = random.normal(size=3)
        e -= (e @ n) * n
        e /= np.linalg.norm(e)
        speed, phi, rate = (float(f"{value:.4g}") for value in random.uniform((0.3, -0.4, -0.3), (1.2, 0.4, 0.3)))
        y = stroller_reference.started(level, place, e, side, wheelbase, speed, phi, rate)
        times = [0.5, 1.0, 2.0, 3.0]
        runs = [exported_ride(level, vehicle, y, times, rtol) for rtol in (FINE, COARSE)]
        assert np.min(runs[0]["normal_force"]) > 0.0
        yield {
            "name": f"stroller-{shape}-{number + 1:02d}",
            "vehicle": "stroller",
            "body": {
                "mass": mass,
                "wheelbase": wheelbase,
                "inertia": inertia,
                "steering_inertia": fork,
                "steering_spring": spring,
            },
            "arena": described,
            "damping": dict(zip(("rolling", "front", "scrub", "steering"), damping, strict=True)),
            "input": {"force": force, "torque": torque},
            "gravity": 9.81,
            "start": {
                "position": place.tolist(),
                "normal": (side * n).tolist(),
                "direction": e.tolist(),
                "speed": speed,
                "steering": phi,
                "steering_rate": rate,
            },
            "outcome": "completed",
            "states": {"times": times} | {name: bounded(values, runs[1][name]) for name, values in runs[0].items()},
            "events": [],
            "source": {
                "values": "Newton's and Euler's equations with multipliers, tests/physics/stroller_reference.py, rtol 1e-13",
                "bounds": "the same program, rtol 1e-12",
            },
        }


def pushed(force: dict[str, float], torque: dict[str, float]) -> Callable[[float], tuple[float, float]]:
    def at(t: float) -> tuple[float, float]:
        return tuple(
            wave["mean"] + wave["amplitude"] * sin(wave["frequency"] * t + wave["phase"]) for wave in (force, torque)
        )

    return at


def exported_ride(level: Level, vehicle: Any, y: Array, times: Sequence[float], rtol: float) -> dict[str, Array]:
    """The states of a ride, and the forces on its wheels."""
    states = states_at(lambda t, y: stroller_reference.instant(level, vehicle, t, y).rate, y, times, rtol, 0.1 * rtol)
    known = [stroller_reference.instant(level, vehicle, t, moment) for t, moment in zip(times, states, strict=True)]
    return {
        "position": states[:, :3],
        "direction": states[:, 6:9],
        "speed": np.sum(states[:, 3:6] * states[:, 6:9], axis=1),
        "yaw_rate": states[:, 9],
        "steering": states[:, 10],
        "steering_rate": states[:, 11],
        "normal_force": np.array([moment.normal_force for moment in known]),
        "side_force": np.array([(moment.rear, moment.front) for moment in known]),
    }
