"""Cost per launch for 1 to 10^5 launches, the memory, one core and all of them.

    python benchmarks/scaling.py [--most 100000]

The reference problem: Rutstam's top on the plane, viscous friction, 100 rad/s, theta(0) from 0.05 to 0.15, tolerance 1e-9. Then
the 64 x 64 grid of theta x spin whose cells differ in cost by a factor of ten: how many of the steps that the lockstep
took were useful. Compilation is given apart. Run it alone: other work on the machine shows in every number.
"""

import argparse
import resource
import time
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from measure import machine, table, timed
from scenes import TOP

import tippe
from nonholonomic import sweep
from nonholonomic.ensemble import compiled_march, lanes_for
from tippe.inversion import ABSOLUTE, InversionProblem

TOLERANCE = 1e-9


def with_workers(count: int) -> None:
    """Let sweeps use this many threads."""
    sweep.workers = lambda: count


def launches_row(scene: tippe.Scene, launches: int, cores: int) -> dict[str, str]:
    """Cost of one table of inversion times."""
    theta = np.linspace(0.05, 0.15, launches)
    times = {}
    for workers in sorted({1, cores}):
        with_workers(workers)
        times[workers] = timed(
            lambda: tippe.inversion_table(scene, theta=theta, spin=100.0, t1=30.0, tolerance=TOLERANCE).time, 2
        )
    one, all_ = times[1], times[cores]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "launches": str(launches),
        "cpu ms per launch, one core": f"{one.cpu / launches * 1e3:.3f}",
        "wall s, one core": f"{one.wall:.2f}",
        f"wall s, {cores} cores": f"{all_.wall:.2f}",
        "ratio": f"{one.wall / all_.wall:.2f}",
        "first call s": f"{one.first:.1f}",
        "peak memory GiB": f"{peak:.2f}",
    }


def useful_share(scene: tippe.Scene) -> float:
    """The part of all lane-steps on a 64 x 64 grid of theta x spin that advanced a lane that was still running."""
    theta, spin = np.meshgrid(np.linspace(0.05, 1.5, 64), np.linspace(20.0, 200.0, 64), indexing="ij")
    problem = InversionProblem.of(scene, tippe.Launch(theta.ravel(), spin.ravel()), 0.95 * np.pi, 4096)
    outcome, iterations = compiled_march(
        problem,
        jnp.asarray(30.0),
        jnp.asarray(4096),
        jnp.asarray(TOLERANCE),
        jnp.asarray(ABSOLUTE * TOLERANCE),
        solver=diffrax.Dopri8(),
        lanes=lanes_for(4096),
    )
    return float(outcome.steps.sum()) / (float(iterations) * lanes_for(4096))


def lanes_table(scene: tippe.Scene) -> list[dict[str, str]]:
    """What the number of lanes in a block does to the cost: it decides which cache the stages fit."""
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, 4096), 100.0), 0.95 * np.pi, 4096)
    rows = []
    for lanes in (8, 16, 32, 64, 128, 256):

        def run(lanes: int = lanes) -> Any:
            return compiled_march(
                problem,
                jnp.asarray(30.0),
                jnp.asarray(4096),
                jnp.asarray(TOLERANCE),
                jnp.asarray(ABSOLUTE * TOLERANCE),
                solver=diffrax.Dopri8(),
                lanes=lanes,
            )

        measured = timed(run, 1)
        steps = float(measured.result[1]) * lanes
        rows.append(
            {
                "lanes": str(lanes),
                "cpu ms per launch": f"{measured.cpu / 4096 * 1e3:.3f}",
                "ns per lane-step": f"{measured.cpu / steps * 1e9:.0f}",
            }
        )
    return rows


def main() -> None:
    """Measure and print."""
    told = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    told.add_argument("--most", type=int, default=100_000, help="largest number of launches")
    options = told.parse_args()
    print(machine())
    scene = tippe.Scene(tippe.Top(*TOP), tippe.Plane(), tippe.Viscous(0.3))
    cores = sweep.workers()
    started = time.perf_counter()
    counts = [count for count in (1, 10, 100, 1000, 10_000, 100_000, 1_000_000) if count <= options.most]
    print(table([launches_row(scene, count, cores) for count in counts]))
    print(f"\nuseful lane-steps on the 64 x 64 grid of theta x spin: {100.0 * useful_share(scene):.0f} %\n")
    print(table(lanes_table(scene)))
    print(f"\n{time.perf_counter() - started:.0f} s in all")


if __name__ == "__main__":
    main()
