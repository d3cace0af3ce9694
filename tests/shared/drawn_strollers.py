"""Strollers, grounds and launches drawn from their whole legal range."""

import math

import numpy as np

from stroller import Damping, Launch, Plane, RollingResistance, Scene, Sphere, Spheroid, Stroller

#: As many at a time, so that one compiled program runs them all.
LANES = 16

#: Ground, side, fork, heading, friction: what a scene is made of, apart from its numbers.
KINDS = [
    ("plane", "outside", "absolute", "intrinsic", "damping"),
    ("spheroid", "inside", "relative", "intrinsic", "resistance"),
]
MORE_KINDS = [
    *KINDS,
    ("spheroid", "outside", "relative", "projected", "damping"),
    ("plane", "outside", "relative", "intrinsic", "resistance"),
    ("centre", "outside", "absolute", "intrinsic", "resistance"),
    ("centre", "outside", "relative", "intrinsic", "damping"),
    ("sphere", "inside", "absolute", "intrinsic", "damping"),
    ("sphere", "outside", "relative", "intrinsic", "resistance"),
    ("spheroid", "inside", "absolute", "intrinsic", "damping"),
    ("spheroid", "outside", "absolute", "intrinsic", "resistance"),
    ("spheroid", "inside", "absolute", "projected", "resistance"),
    ("sphere", "inside", "relative", "projected", "damping"),
]


def batch_of(kind, seed: int):
    """A scene and a launch with `LANES` numbers in every place; every eighth lane at a pole, every eighth nearly across."""
    ground, side, fork, heading, friction = kind
    random = np.random.default_rng(seed)

    def between(low, high, log=False):
        return np.exp(random.uniform(np.log(low), np.log(high), LANES)) if log else random.uniform(low, high, LANES)

    def at_times(often, otherwise, every=8):
        return np.where(random.integers(every, size=LANES) == 0, otherwise, often)

    mass, length = between(1e-2, 1e3, log=True), between(0.05, 10.0, log=True)
    centre = length * between(0.0, 1.0) if ground == "centre" else 0.0
    inertia = mass * (centre**2 + length**2 * between(0.01, 3.0, log=True))
    body = Stroller(
        mass,
        length,
        inertia,
        steering_inertia=inertia * between(1e-3, 1.0, log=True),
        steering_spring=mass * length**2 * at_times(between(0.1, 10.0, log=True), 0.0, every=2),
        centre=centre,
    )
    size = length * between(0.5, 1e3, log=True)
    surface = {
        "plane": lambda: Plane(between(-1.5, 1.5)),
        "centre": lambda: Plane(between(-1.5, 1.5)),
        "sphere": lambda: Sphere(size),
        "spheroid": lambda: Spheroid(size, size * between(0.2, 5.0, log=True)),
    }[ground]()
    if friction == "damping":
        units = (mass, mass, mass * length**2, body.steering_inertia)
        law = Damping(*(unit * at_times(between(1e-2, 10.0, log=True), 0.0, every=4) for unit in units))
    else:
        law = RollingResistance(between(0.0, 0.5), between(0.05, 1.0, log=True))
    scene = Scene(body, surface, law, at_times(between(0.1, 30.0), 0.0), side, fork, heading)
    steering = at_times(between(-math.pi, math.pi), 0.5 * math.pi + random.choice([-1e-6, 1e-6, 1e-3], LANES))
    # The front wheel's speed, which stays moderate where the rear axle is slow because the wheel stands across.
    speed = between(0.01, 30.0, log=True) * random.choice([-1.0, 1.0], LANES) * np.cos(steering)
    place = (between(-math.pi, math.pi), between(-1.5, 1.5))
    if ground in ("sphere", "spheroid") and heading == "intrinsic":
        poles = random.choice([-1.0, 1.0], LANES) * (0.5 * math.pi - random.choice([0.0, 1e-12, 1e-3], LANES))
        place = (place[0], at_times(at_times(place[1], poles), 0.0))
    if heading == "projected":
        # Level ground is where that heading loses its meaning.
        place = (place[0], np.where(place[1] < 0.0, -1.0, 1.0) * between(0.3, 1.5))
        speed = speed * np.abs(np.sin(place[1]))
    rate = at_times(between(-10.0, 10.0), 0.0)
    launch = Launch(place, between(-math.pi, math.pi), speed, steering, rate)
    scene.check(launch)
    return scene, launch
