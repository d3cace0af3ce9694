"""A random search for roads that lead to different answers: `python roads.py KIND ...` prints what differs, scene by scene.

The scenes of a kind (`random_scenes.py`) differ in numbers only, so that each road has one program for all of them. The roads
are a table, a batch of inversion times under `jit`, a batch of runs under `jit`, and for some scenes a time and a run by
themselves; where flights are possible, also the table of the same scenes with `contact="stop"`.
"""

import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from random_scenes import Batch, batch

import tippe
from nonholonomic.compilation.xla_cpu import compile_quickly
from nonholonomic.integration import Settings
from nonholonomic.parameters import with_numbers
from nonholonomic.runs.table import WORDS, TableJob
from nonholonomic.sweeps.table import errors_of, other_tolerances
from tippe.runs.model import INVERSIONS, TopModel

ANGLE, TOLERANCE = 0.95 * np.pi, 1e-9

#: How long runs take [s], those with flights less: a batch advances from flight to flight of the slowest.
HORIZON, HORIZON_OF_FLIGHTS = 8.0, 3.0

#: Of runs with their path, whose frame does not turn with the top, so that they err more at the same tolerance.
OF_PATHS = other_tolerances(TOLERANCE)[0]

#: Error bounds of a table by which another road may differ, which has an error of its own.
APART = 2.0

#: What theta may change by within a fraction of 1e-6 of the horizon [rad], and its greatest rate [rad/s].
FASTEST = 400.0

#: Of a batch of runs.
CODES = {
    word: int(tippe.Status.of(word)) for word in ("contact_lost", "jammed", "does_not_fit", "unresolved", "failed")
}


def table_of(scenes: Batch, count: int, t1: float) -> dict[str, np.ndarray]:
    """The table of these scenes, with errors, and the status as words."""
    model = TopModel.timed(scenes.scene, scenes.launch, ANGLE)
    first, *others = (
        TableJob(model, INVERSIONS, t1, "first", Settings(tolerance))(scenes.columns, count)
        for tolerance in (TOLERANCE, *other_tolerances(TOLERANCE))
    )
    silent = tuple(int(tippe.Status.of(word)) for word in ("failed", "unresolved"))
    words = np.array(WORDS)[first["status"]]
    bounds = errors_of(
        [first, *others], dict.fromkeys(("time", "end_time", "end_theta"), 0.0), tuple(model.counters), silent
    )
    return first | bounds | {"word": words}


def scene_and_launch(scenes: Batch, cell: int) -> tuple[tippe.Scene, tippe.Launch]:
    """One of the scenes."""
    numbers = {name: jnp.asarray(values[cell]) for name, values in scenes.columns.items()}
    roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, numbers)
    return roots["scene"], roots["launch"]


def apart(times: np.ndarray, other_times: np.ndarray) -> np.ndarray:
    """Differences of times, 0 where both are infinite."""
    return np.abs(np.subtract(times, other_times, where=times != other_times, out=np.zeros(times.shape)))


def batch_of_times(scenes: Batch, t1: float) -> np.ndarray:
    """The times of all scenes by `jit` of `vmap`."""

    @jax.jit
    @jax.vmap
    def times(columns):
        roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, columns)
        return tippe.inversion_time(roots["scene"], roots["launch"], t1, ANGLE, TOLERANCE)

    return np.asarray(times({name: jnp.asarray(values) for name, values in scenes.columns.items()}))


def batch_of_runs(scenes: Batch, ends: np.ndarray, t1: float) -> tuple[np.ndarray, ...]:
    """Angle at a time of its own in each scene, end and code of the status of the runs, by `jit` of `vmap` of `simulate`."""

    @jax.jit
    @jax.vmap
    def runs(columns, end):
        roots = with_numbers({"scene": scenes.scene, "launch": scenes.launch}, columns)
        run = tippe.simulate(roots["scene"], roots["launch"], t1, end[None], OF_PATHS)
        return run.theta[0], run.end_time, run.status

    columns = {name: jnp.asarray(values) for name, values in scenes.columns.items()}
    return tuple(np.asarray(part) for part in runs(columns, jnp.asarray(ends)))


class Findings:
    """Descriptions of all differences, and the number of comparisons."""

    def __init__(self, kind: str):
        self.kind, self.lines, self.compared = kind, [], 0

    def check(self, label: str, cells: Any, is_true: Any, *columns: Any) -> None:
        """Note each of some cells of which something does not hold."""
        for cell in np.atleast_1d(cells):
            values_of_cell = [float(np.atleast_1d(values)[cell if np.size(values) > 1 else 0]) for values in columns]
            self.compared += 1
            if not np.atleast_1d(is_true)[cell if np.size(is_true) > 1 else 0]:
                self.lines.append(
                    f"{self.kind}, scene {cell}: {label}: {', '.join(f'{value:.12g}' for value in values_of_cell)}"
                )


def compare_roads(kind: str, count: int, singles: int, seed: int = 5) -> tuple[Findings, int]:
    """Compare the roads through random scenes of a kind.

    **Returns:** what differs, and of how many scenes a table has an answer with an error.
    """
    findings, scenes = Findings(kind), batch(kind, count, seed=seed)
    hybrid = scenes.scene.contact == "hybrid"
    t1 = HORIZON_OF_FLIGHTS if hybrid else HORIZON
    table = table_of(scenes, count, t1)
    time_error, end_error, end = table["time_error"], table["end_time_error"], table["end_time"]
    comparable = (table["status_error"] == 0) & (time_error < 1e-3) & (end_error < 1e-3)
    inverted, word = table["word"] == "inverted", table["word"]
    is_stopped = comparable & np.isin(word, list(CODES))

    times = batch_of_times(scenes, t1)
    findings.check(
        "a batch of times inverts, or not", np.flatnonzero(comparable), np.isfinite(times) == inverted, times
    )
    is_close = apart(times, table["time"]) <= APART * time_error
    findings.check(
        "time in a batch, in a table", np.flatnonzero(comparable & inverted), is_close, times, table["time"], time_error
    )

    flat = FASTEST * (1e-6 * t1 + APART * end_error) + APART * table["end_theta_error"]
    if not scenes.scene.friction.set_valued:
        # Just before the run's end in the table, where each run still is.
        theta, ended, status = batch_of_runs(scenes, end * (1.0 - 1e-6), t1)
        codes = np.array([CODES.get(name, -1) for name in word])
        findings.check(
            "status of a batch of runs, of a table", np.flatnonzero(is_stopped), status == codes, status, codes
        )
        is_close = np.abs(ended - end) <= APART * end_error
        findings.check(
            "end in a batch of runs, in a table", np.flatnonzero(is_stopped), is_close, ended, end, end_error
        )
        is_close = np.abs(theta - table["end_theta"]) <= flat
        findings.check(
            "theta in a batch, in a table", np.flatnonzero(comparable), is_close, theta, table["end_theta"], flat
        )

    for cell in np.flatnonzero(comparable)[:singles]:
        scene, launch = scene_and_launch(scenes, cell)
        single_time = float(tippe.inversion_time(scene, launch, t1, ANGLE, TOLERANCE))
        is_same = (
            single_time == table["time"][cell] or abs(single_time - table["time"][cell]) <= APART * time_error[cell]
        )
        findings.check("time alone, in a table", cell, is_same, np.full(count, single_time), table["time"], time_error)
        run = tippe.simulate(scene, launch, min(t1, 1.001 * float(end[cell]) + 1e-3), tolerance=OF_PATHS)
        state = run.at([min(float(end[cell]) * (1.0 - 1e-6), float(run.end_time))])
        is_same = abs(float(state.theta[0]) - table["end_theta"][cell]) <= flat[cell]
        theta = np.full(count, state.theta[0])
        findings.check("theta of a run alone, in a table", cell, is_same, theta, table["end_theta"], flat)
        ends = is_stopped[cell] == (run.status != "completed") and (not is_stopped[cell] or run.status == word[cell])
        findings.check(f"{run.status} alone, {word[cell]} in a table", cell, ends, np.full(count, run.end_time), end)

    if hybrid:
        compare_with_stops(findings, scenes, table, count, t1)
    return findings, int(comparable.sum())


def compare_with_stops(findings: Findings, scenes: Batch, hybrid: dict[str, np.ndarray], count: int, t1: float) -> None:
    """A top that keeps its contact does the same whether or not it may fly; one that loses it in one flies in the other."""
    scene, columns = (
        scenes.scene,
        {name: values for name, values in scenes.columns.items() if "restitution" not in name},
    )
    stop_scene = tippe.Scene(scene.body, scene.surface, scene.friction)
    is_stopped = table_of(scenes._replace(scene=stop_scene, columns=columns), count, t1)
    is_certain = (is_stopped["status_error"] == 0) & (hybrid["status_error"] == 0)
    indices = np.flatnonzero(is_certain & (is_stopped["word"] != "contact_lost") & (hybrid["hops"] == 0))
    is_same = (is_stopped["word"] == hybrid["word"]) & (np.isfinite(is_stopped["time"]) == np.isfinite(hybrid["time"]))
    findings.check("status with stop and hybrid", indices, is_same, is_stopped["end_time"], hybrid["end_time"])
    error = APART * (is_stopped["time_error"] + hybrid["time_error"])
    is_close = apart(is_stopped["time"], hybrid["time"]) <= error
    findings.check("time with stop and hybrid", indices, is_close, is_stopped["time"], hybrid["time"], error)
    cells_lost = np.flatnonzero(
        is_certain & (is_stopped["word"] == "contact_lost") & (hybrid["end_time"] > is_stopped["end_time"])
    )
    findings.check("flights of a top that loses its contact", cells_lost, hybrid["hops"] > 0, hybrid["hops"])


def main(kinds: list[str]) -> int:
    """Search some kinds of scenes and print the differences."""
    differing_batches = 0
    for kind in kinds:
        count, singles = (45, 3) if kind.endswith("stop") else (16, 1) if kind.startswith("plane") else (4, 1)
        start_time = time.process_time()
        findings, comparable = compare_roads(kind, count, singles)
        differing_batches += len(findings.lines)
        print(
            f"{kind}: {findings.compared} comparisons, {comparable} of {count} scenes, {time.process_time() - start_time:.0f} s"
        )
        print("".join(f"  {line}\n" for line in findings.lines), end="", flush=True)
    return differing_batches


if __name__ == "__main__":
    compile_quickly()
    sys.exit(main(sys.argv[1:]) > 0)
