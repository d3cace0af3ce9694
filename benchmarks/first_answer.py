"""Time to the first answer: fresh processes, with nothing compiled (cold) or everything kept on disk (warm).

    python benchmarks/first_answer.py [--launches 1 100 10000 1000000] [--out FILE.csv]

The reference problem is that of `work_precision.py`: Rutstam's top on the plane, to the inversion, at a tolerance of 1e-9.
Each process imports one program, computes all launches once and reports the time for importing, tracing (for heyoka:
writing down the equations), compiling (or loading compiled programs) and running. Diffrax's first answers are those of
`jax.vmap(diffrax.diffeqsolve)` with an event, with JAX's own cache. The CPU time is that of the whole process. A
program that is not installed is named and skipped; `MOST` limits the launches of a program that would take hours.
"""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

PROGRAMS = ("inversion_table", "heyoka, batches", "Diffrax")

#: Greatest number of launches for each program.
MOST = {"inversion_table": 10**7, "heyoka, batches": 10**6, "Diffrax": 10**4}

TOLERANCE = 1e-9
PHASES = ("import", "trace", "compile", "run")


def phases_of_jax(start_time: float, imported: float, durations: dict[str, float]) -> dict[str, float]:
    """Times of the phases of a JAX program [s], from the durations that JAX reports."""
    trace = sum(
        durations.get(f"/jax/core/compile/{name}_duration", 0.0) for name in ("jaxpr_trace", "jaxpr_to_mlir_module")
    )
    compiled = durations.get("/jax/core/compile/backend_compile_duration", 0.0)
    run = time.perf_counter() - imported - trace - compiled
    return {"import": imported - start_time, "trace": trace, "compile": compiled, "run": run}


def listen() -> dict[str, float]:
    """The durations that JAX reports, summed by name."""
    import jax

    durations: dict[str, float] = {}
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, seconds, **_: durations.__setitem__(name, durations.get(name, 0.0) + seconds)
    )
    return durations


def ours(launches: int, folder: Path) -> dict[str, float]:
    """`inversion_table`."""
    start_time = time.perf_counter()
    import nonholonomic
    import tippe

    imported, durations = time.perf_counter(), listen()
    nonholonomic.enable_compilation_cache(folder / "ours")
    inertia = 0.02 * 0.02**2
    top = tippe.Top(0.02, 0.02, 0.006, 131.0 / 350.0 * inertia, 0.4 * inertia)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    theta = np.linspace(0.05, 0.15, launches)
    table = tippe.inversion_table(scene, theta=theta, spin=100.0, t1=30.0, tolerance=TOLERANCE)
    return phases_of_jax(start_time, imported, durations) | {"answer": float(table.time[-1])}


def heyoka(launches: int, folder: Path) -> dict[str, float]:
    """heyoka's batches, with its own cache on disk."""
    from peers import heyoka_batch

    start_time = time.perf_counter()
    import heyoka as _  # noqa: F401

    imported = time.perf_counter()
    task = task_of(launches, folder)
    run = heyoka_batch(task)
    write_time = time.perf_counter()
    # A single launch compiles everything, in a hundredth of the time.
    heyoka_first = heyoka_batch(task.of(slice(0, 1)))
    heyoka_first(TOLERANCE)
    compiled = time.perf_counter()
    ends = run(TOLERANCE)
    finish_time = time.perf_counter()
    phases = {"import": imported - start_time, "trace": write_time - imported, "compile": compiled - write_time}
    return phases | {"run": finish_time - compiled, "answer": float(ends.time[-1])}


def diffrax(launches: int, folder: Path) -> dict[str, float]:
    """`jax.vmap(diffrax.diffeqsolve)` with an event that Newton's method locates, with JAX's own cache."""
    start_time = time.perf_counter()
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix
    from fields import Functions

    imported, durations = time.perf_counter(), listen()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    task = task_of(launches, folder)
    functions, cosine = Functions(jnp.sqrt), math.cos(task.angle)

    @jax.jit
    @jax.vmap
    def times(start: Any) -> Any:
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: jnp.stack(task.field(y, task.numbers, functions))),
            diffrax.Dopri8(),
            0.0,
            task.t1,
            None,
            start,
            stepsize_controller=diffrax.PIDController(TOLERANCE, 0.1 * TOLERANCE),
            event=diffrax.Event(lambda t, y, args, **_: y[4] - cosine, optimistix.Newton(1e-12, 1e-12)),
            max_steps=100_000,
        )
        return solution.ts[0]

    answer = float(times(jnp.asarray(task.starts.T))[-1])
    return phases_of_jax(start_time, imported, durations) | {"answer": answer}


def task_of(launches: int, folder: Path) -> Any:
    """The task that the parent has written, so that other programs need not import this package."""
    import fields
    from peers import Task

    reference = np.load(folder / f"{launches}.npz")
    numbers = fields.Top(*(float(number) for number in reference["numbers"]))
    return Task(fields.plane, numbers, reference["starts"], reference["scales"], 30.0, 0.95 * math.pi, slice(2, 5))


def write_task(launches: int, folder: Path) -> None:
    """Write the launches for other programs."""
    from scenes import scenes

    task = scenes(launches)["plane, viscous"].task
    np.savez(folder / f"{launches}.npz", numbers=np.array(task.numbers, float), starts=task.starts, scales=task.scales)


RUNS = dict(zip(PROGRAMS, (ours, heyoka, diffrax), strict=True))


def measured(program: str, launches: int, state: str, folder: Path) -> dict[str, str] | None:
    """Measure one process of a program; `None` if it cannot run."""
    command = [sys.executable, __file__, "--child", program, "--launches", str(launches), "--folder", str(folder)]
    # heyoka stores compiled code here, JAX and this package in the given folders.
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / "home")}
    usage_before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start_time = time.perf_counter()
    process = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    duration = time.perf_counter() - start_time
    usage_after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode != 0:
        print(f"{program} skipped: {process.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return None
    answer = json.loads(process.stdout.splitlines()[-1])
    cpu = usage_after.ru_utime + usage_after.ru_stime - usage_before.ru_utime - usage_before.ru_stime
    row = {"launches": str(launches), "program": program, "state": state, "whole [s]": f"{duration:.2f}"}
    row |= {"CPU [s]": f"{cpu:.2f}"} | {f"{name} [s]": f"{answer[name]:.2f}" for name in PHASES}
    return row | {"last time [s]": f"{answer['answer']:.7f}"}


def main() -> int:
    """Run every program cold and warm, and print the table."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--launches", type=int, nargs="+", default=[1, 100, 10_000, 1_000_000])
    command.add_argument("--out", type=Path, help="CSV to write")
    command.add_argument("--child", choices=PROGRAMS, help=argparse.SUPPRESS)
    command.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    options = command.parse_args()
    if options.child is not None:
        print(json.dumps(RUNS[options.child](options.launches[0], options.folder)))
        return 0
    from measure import machine, table, write_csv

    print(machine())
    rows = []
    for launches in options.launches:
        for program in PROGRAMS:
            if launches > MOST[program]:
                continue
            with tempfile.TemporaryDirectory() as name:
                write_task(launches, Path(name))
                rows += [measured(program, launches, state, Path(name)) for state in ("cold", "warm")]
    rows = [row for row in rows if row is not None]
    print(table(rows))
    if options.out is not None:
        write_csv(options.out, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
