"""Cost per launch for 1 to 10^5 launches and more, memory, and the fraction of the machine's peak performance.

    python benchmarks/scaling.py [--most 100000]
    JAX_ENABLE_X64=0 python benchmarks/scaling.py        the same in single precision, at tolerance 1e-5

The reference problem: Rutstam's top on the plane, viscous friction, 100 rad/s, theta(0) from 0.05 to 0.15, tolerance
1e-9. It runs on one core and on all cores of a CPU, and on an accelerator if there is one (`--most 10000000` goes up to
10^7 launches). Two more measurements do not depend on `--most`: on a 64 x 64 grid of theta x spin, whose cells differ
in cost by a factor of ten, the fraction of lane-steps that were useful; and the cost for six numbers of lanes in a
block. Run the script alone: other work on the machine changes every number.

The first call, which compiles, has a column of its own. "ratio" is the wall time with one core over that with all
cores. Peak memory is the greatest memory of the process so far, including the compiler's.

Operations are counted in the program of a step; a multiply-add counts as two. The peak is that of multiply-adds on
registers, measured in the same run. Steps of idle lanes count as wasted.
"""

import argparse
import resource
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, table, timed
from operations import operations_per_step
from peak import peak
from scenes import TOP

import tippe
from nonholonomic.integration import Settings, solve_ensemble
from nonholonomic.integration.problem import lanes_for
from nonholonomic.sweeps import running
from tippe.modes.problems import InversionProblem

ON_CPU = jax.default_backend() == "cpu"
DOUBLE = jnp.result_type(float) == jnp.float64
TOLERANCE = 1e-9 if DOUBLE else 1e-5


def with_workers(count: int) -> None:
    """Let sweeps use this many threads."""
    running.workers = lambda: count


def times_of(scene: tippe.Scene, launches: int) -> tippe.Table:
    """The table of inversion times."""
    theta = np.linspace(0.05, 0.15, launches)
    return tippe.inversion_table(scene, theta=theta, spin=100.0, t1=30.0, tolerance=TOLERANCE)


def cpu_row(scene: tippe.Scene, launches: int, cores: int, operations: float, max_seconds: float) -> dict[str, str]:
    """Cost of one table on a CPU, for the given operations per step and the peak performance of a core."""
    times = {}
    for workers in sorted({1, cores}):
        with_workers(workers)
        times[workers] = timed(lambda: times_of(scene, launches), 2 if launches <= 100_000 else 1)
    single_core, all_cores = times[1], times[cores]
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {
        "launches": str(launches),
        "cpu ms per launch, one core": f"{single_core.cpu / launches * 1e3:.3f}",
        "of peak": f"{100.0 * operations * single_core.result.steps.sum() / single_core.cpu / max_seconds:.0f} %",
        "wall s, one core": f"{single_core.wall:.2f}",
        f"wall s, {cores} cores": f"{all_cores.wall:.2f}",
        "ratio": f"{single_core.wall / all_cores.wall:.2f}",
        "first call s": f"{single_core.first:.1f}",
        "peak memory GiB": f"{memory:.2f}",
    }


def device_row(scene: tippe.Scene, launches: int, operations: float, max_seconds: float) -> dict[str, str]:
    """Cost of one table on an accelerator with the given peak performance."""
    run = timed(lambda: times_of(scene, launches), 2)
    memory = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0) / 2**30
    return {
        "launches": str(launches),
        "us per launch": f"{run.wall / launches * 1e6:.2f}",
        "of peak": f"{100.0 * operations * run.result.steps.sum() / run.wall / max_seconds:.1f} %",
        "wall s": f"{run.wall:.2f}",
        "first call s": f"{run.first:.1f}",
        "device memory GiB": f"{memory:.2f}",
    }


def useful_share(scene: tippe.Scene) -> float:
    """The fraction of lane-steps on a 64 x 64 grid of theta x spin that advanced a running lane."""
    theta, spin = np.meshgrid(np.linspace(0.05, 1.5, 64), np.linspace(20.0, 200.0, 64), indexing="ij")
    problem = InversionProblem.of(scene, tippe.Launch(theta.ravel(), spin.ravel()), 0.95 * np.pi, 4096)
    outcome, iterations = solve_ensemble(
        problem,
        jnp.asarray(30.0),
        jnp.asarray(4096),
        Settings(TOLERANCE),
    )
    return float(outcome.steps.sum()) / (float(iterations) * lanes_for(4096))


def lanes_table(scene: tippe.Scene) -> list[dict[str, str]]:
    """Cost for several numbers of lanes in a block, which determine the cache into which the stages fit."""
    cells = 4096 if ON_CPU else 262144
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, cells), 100.0), 0.95 * np.pi, cells)
    rows = []
    for lanes in (8, 16, 32, 64, 128, 256) if ON_CPU else (256, 1024, 4096, 16384, 65536):

        def run(lanes: int = lanes) -> Any:
            return solve_ensemble(
                problem,
                jnp.asarray(30.0),
                jnp.asarray(cells),
                Settings(TOLERANCE, lanes=lanes),
            )

        measured = timed(run, 1)
        seconds = measured.cpu if ON_CPU else measured.wall
        steps = float(measured.result[1]) * lanes
        rows.append(
            {
                "lanes": str(lanes),
                "ms per launch": f"{seconds / cells * 1e3:.3f}",
                "ns per lane-step": f"{seconds / steps * 1e9:.3g}",
            }
        )
    return rows


def main() -> None:
    """Measure and print."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--most", type=int, default=100_000, help="largest number of launches")
    options = command.parse_args()
    print(machine())
    scene = tippe.Scene(tippe.Top(*TOP), tippe.Plane(), tippe.Viscous(0.3))
    start_time = time.perf_counter()
    problem = InversionProblem.of(scene, tippe.Launch(np.linspace(0.05, 0.15, 64), 100.0), 0.95 * np.pi, 64)
    operations, max_seconds = operations_per_step(problem).arithmetic, peak()
    device = f"{jax.devices()[0].device_kind}, {'double' if DOUBLE else 'single'} precision"
    print(
        f"{device}: {operations:.0f} operations a step, at most {max_seconds:.3g} a second{' on one core' if ON_CPU else ''}"
    )
    cores = running.workers()
    counts = [10**power for power in range(8) if 10**power <= options.most]
    rows = [
        cpu_row(scene, count, cores, operations, max_seconds)
        if ON_CPU
        else device_row(scene, count, operations, max_seconds)
        for count in counts
    ]
    print(table(rows))
    print(f"\nuseful lane-steps on the 64 x 64 grid of theta x spin: {100.0 * useful_share(scene):.0f} %\n")
    print(table(lanes_table(scene)))
    print(f"\n{time.perf_counter() - start_time:.0f} s in all")


if __name__ == "__main__":
    main()
