"""Shared parts of the benchmarks: the machine, versions, clocks, and rows for the screen, a CSV file and the README."""

import csv
import os
import platform
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import jax

PACKAGES = ("nonholonomic", "jax", "diffrax", "numpy", "scipy", "numba", "heyoka", "CyRK", "scikit-sundae")


class Timed(NamedTuple):
    """A result, with the least wall time and the least CPU time of the process [s] over the runs, without
    compilation."""

    result: Any
    wall: float
    cpu: float
    first: float


def timed(run: Callable[[], Any], runs: int = 3) -> Timed:
    """Call once to compile, then `runs` times."""
    start_time = time.perf_counter()
    result = jax.block_until_ready(run())
    first = time.perf_counter() - start_time
    walls, cpus = [], []
    for _ in range(runs):
        start_time, cpu_start = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(run())
        walls.append(time.perf_counter() - start_time)
        cpus.append(time.process_time() - cpu_start)
    return Timed(result, min(walls), min(cpus), first)


def machine() -> str:
    """The processor, its cores and the versions, in two lines."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        model = next(
            (line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line), model
        )
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            versions.append(f"{name} missing")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"{model}, {cores} cores{load}, {platform.system()}, Python {platform.python_version()}\n{', '.join(versions)}"
    )


def one_core() -> None:
    """Keep this process on one core, so that CPU time and wall time agree."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def table(rows: list[dict[str, str]]) -> str:
    """Rows as a Markdown table."""
    names = list(rows[0])
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in names}
    lines = ["| " + " | ".join(name.ljust(widths[name]) for name in names) + " |"]
    lines.append("| " + " | ".join("-" * widths[name] for name in names) + " |")
    lines += ["| " + " | ".join(row[name].ljust(widths[name]) for name in names) + " |" for row in rows]
    return "\n".join(lines)


def write_csv(path: Path, rows: list[dict[str, str]]) -> None:
    """Rows as a CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
