"""Cost of a stroller's step on each surface, relative to the plane: `python benchmarks/grounds.py [--rides N]`.

A table of damped rides over their speed: one thread's CPU time per step of a lane, the least of five calls after a
first call that compiles. The last two surfaces are the paraboloid and the spheroid again, given as functions.
"""

import argparse
import time

import equinox as eqx
import numpy as np

import stroller

BODY = stroller.Stroller(12.0, 0.7, 1.5, 0.05, steering_spring=0.2)
FRICTION = stroller.Damping(0.8, 0.4, 0.1, 0.02)


class Bowl(eqx.Module):
    """A paraboloid."""

    p: float

    def __call__(self, x, y):
        return (x * x + y * y) / (2.0 * self.p)


class Hollow(eqx.Module):
    """The inside of a spheroid."""

    equatorial: float
    polar: float

    def __call__(self, x, y, z):
        return 1.0 - (x * x + y * y) / self.equatorial**2 - (z / self.polar) ** 2


HIGH = -3.0 * np.sin(0.9)
GROUNDS = {
    "plane, tilted": (stroller.Plane(0.05), (0.0, 0.0)),
    "cylinder": (stroller.Cylinder(6.0), (0.0, 0.6)),
    "sphere": (stroller.Sphere(6.0), (0.0, -0.9)),
    "spheroid": (stroller.Spheroid(6.0, 3.0), (0.0, -0.9)),
    "torus": (stroller.Torus(8.0, 3.0), (0.0, -1.2)),
    "paraboloid": (stroller.Paraboloid(4.0), (2.0, 0.0)),
    "paraboloid, Graph": (stroller.Graph(Bowl(4.0)), (2.0, 0.0)),
    "spheroid, Implicit": (stroller.Implicit(Hollow(6.0, 3.0)), (6.0 * np.cos(0.9), 0.0, HIGH)),
}


def cost(surface, place, rides: int) -> tuple[float, int]:
    """CPU time [s] of a step of one lane, and the number of steps of all rides."""
    scene = stroller.Scene(BODY, surface, FRICTION, side="inside" if "inside" in surface.sides else None)
    launch = stroller.Launch(place, 0.3, 1.0, 0.2, 0.5)
    durations = []
    for _ in range(6):
        start = time.process_time()
        table = stroller.sweep(scene, launch, 10.0, axes={"launch.speed": np.linspace(1.0, 3.0, rides)})
        durations.append(time.process_time() - start)
    steps = int(np.sum(table.steps))
    return min(durations[1:]) / steps, steps


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rides", type=int, default=4096)
    rides = options.parse_args().rides
    plane = None
    for name, (surface, place) in GROUNDS.items():
        step, steps = cost(surface, place, rides)
        plane = step if plane is None else plane
        print(f"{name:20s} {1e9 * step:7.0f} ns a step, {step / plane:4.2f} of the plane, {steps:8d} steps", flush=True)


if __name__ == "__main__":
    main()
