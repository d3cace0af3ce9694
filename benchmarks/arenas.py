"""Cost of a step on every arena relative to the plane, and drift of the foot off general arenas.

    python benchmarks/arenas.py [--drift]

Rutstam's top with viscous friction in a table of 512 launches, theta(0) from 0.05 to 0.3 and spins from 80 to 120
rad/s, 8 s, tolerance 1e-9, one core. Plane, cylinder and sphere have their own frames; "carried" is the general frame
of the other arenas. The compile time is that of a first call less that of a later one. The error is the greatest
relative change of an inversion time at a hundredth of the tolerance. `--drift` adds runs of 1000 s: the greatest
distance of the foot from the arena, in units of R, at two tolerances. Run the script alone: other work on the machine
changes every number.
"""

import argparse

import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed
from scenes import TOP

import tippe
from nonholonomic.sweeps import grid


def bowl(x, y):
    return (x * x + y * y) / 0.6


ARENAS = {
    "plane": tippe.Plane(),
    "tilted plane": tippe.Plane(0.05),
    "cylinder": tippe.Cylinder(0.3),
    "sphere": tippe.Sphere(0.3),
    "spheroid": tippe.Spheroid(0.3, 0.25),
    "torus": tippe.Torus(0.5, 0.3),
    "paraboloid": tippe.Paraboloid(0.3),
    "graph": tippe.Graph(bowl),
    "implicit": tippe.Implicit(lambda x, y, z: z - bowl(x, y)),
}


#: Number of runs, of which the fastest counts.
RUNS = 9


def rows() -> list[dict[str, str]]:
    """Steps per second on every arena, and the cost of a step relative to the plane."""
    grid.workers = lambda: 1
    entries, plane = [], None
    for name, surface in ARENAS.items():
        scene = tippe.Scene(tippe.Top(*TOP), surface, tippe.Viscous(0.3))
        arguments = {"theta": np.linspace(0.05, 0.3, 64), "spin": np.linspace(80.0, 120.0, 8), "t1": 8.0}
        axes = {f"launch.place[{k}]": 0.0 for k in range(3)} if name == "implicit" else None

        def run(tolerance=1e-9, scene=scene, axes=axes, arguments=arguments):
            return tippe.inversion_table(scene, axes=axes, progress=False, tolerance=tolerance, **arguments)

        measured = timed(run, RUNS)
        times, exact = measured.result.time, run(1e-11).time
        finite = np.isfinite(times) & np.isfinite(exact)
        rate = measured.result.steps.sum() / measured.cpu
        plane = rate if plane is None else plane
        columns = {
            "arena": name,
            "frame": type(scene.frame).__name__.removesuffix("Frame").lower(),
            "compile [s]": f"{measured.first - measured.wall:.1f}",
            "10^6 steps/s": f"{rate / 1e6:.2f}",
            "cost": f"{plane / rate:.2f}",
            "inverted": str(int(finite.sum())),
            "error": f"{np.max(np.abs(times / np.where(finite, exact, 1.0) - 1.0)[finite]):.0e}"
            if finite.any()
            else "",
        }
        entries.append(columns)
        print(*columns.values(), flush=True)
    return entries


def drifts() -> list[dict[str, str]]:
    """Greatest distance of the foot from the arena in 1000 s."""
    times, entries = np.linspace(0.0, 1000.0, 501), []
    for name in ("paraboloid", "torus", "graph"):
        scene = tippe.Scene(tippe.Top(*TOP), ARENAS[name], tippe.Viscous(0.02))
        launch = tippe.Launch(0.3, 20.0, place=(0.1, 0.05) if name != "torus" else (0.0, 0.3), velocity=(0.2, 0.1))
        for tolerance in (1e-6, 1e-9):
            run = tippe.simulate(scene, launch, 1000.0, times, tolerance)
            foot = tuple(jnp.asarray(run.states[8:11]))
            offset = float(jnp.max(jnp.abs(scene.surface.offset(foot))) / scene.body.radius)
            entries.append(
                {"arena": name, "tolerance": f"{tolerance:g}", "status": run.status, "drift / R": f"{offset:.1e}"}
            )
    return entries


if __name__ == "__main__":
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--drift", action="store_true", help="add the drift over 1000 s")
    options = command.parse_args()
    one_core()
    print(machine())
    print(table(rows()))
    if options.drift:
        print(table(drifts()))
