"""Speed against error: this package and other programs on the same launches, on one core each.

    python benchmarks/work_precision.py [--out FOLDER] [--quick] [--scenes NAME ...]

For each scene and tolerance, the error is the greatest difference from heyoka at 1e-16 over the launches (from SciPy's
DOP853 at 1e-13 if heyoka is missing): in the inversion time [s] if the scene has one, otherwise in the end state (a
top's axis, a stroller's position [m]), which also has a column of its own. The time is the least CPU time per launch of
nine runs after a warm-up (of one run for slow programs), without compilation, which is listed separately. Programs that
are not installed are named and skipped. The script writes a CSV, a picture and the README's table.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed, write_csv
from peers import PEERS, Ends, Task, available, heyoka_scalar, scipy_with
from scenes import Case, misprint, scenes

from nonholonomic.integration import Oscillatory8, Settings, Stabilized8, solve_ensemble
from nonholonomic.integration.problem import CROSSED

TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)

#: How often a fast program is timed.
RUNS = 9

SOLVERS = {
    "Oscillatory8": Oscillatory8(),
    "Stabilized8": Stabilized8(),
    "Dopri8": diffrax.Dopri8(),
    "Tsit5": diffrax.Tsit5(),
}


def ours(case: Case, solver: Any) -> Any:
    """This package's ensemble solver, with results in the form of the other programs."""
    task, cells = case.task, case.task.launches

    def run(tolerance: float) -> Ends:
        # Relative and absolute tolerance as `inversion_table` and `stroller.sweep` have them.
        settings = Settings(tolerance, solver)
        outcome, _ = solve_ensemble(case.problem, jnp.asarray(task.t1), jnp.asarray(cells), settings)
        ends = jax.tree.map(np.asarray, outcome)
        time = np.where(ends.status == CROSSED, ends.crossing_time, ends.end_time)
        return Ends(time, ends.state[task.compared].T)

    return run


def obvious_diffrax(task: Task, launches: int) -> Any:
    """The most obvious program: vectors of three, `jnp.cross`, lanes first, `vmap(diffeqsolve)` with an event."""
    p = task.numbers
    normal, cosine = jnp.array([0.0, 0.0, 1.0]), math.cos(task.angle)

    def field(t, y, args):
        u, e, L = y
        w = L / p.I1 + (1.0 / p.I3 - 1.0 / p.I1) * jnp.dot(L, e) * e
        e_dot = jnp.cross(w, e)
        r = p.offset * e - p.radius * normal
        slip = u + p.offset * e_dot - p.radius * jnp.cross(w, normal)
        f = -p.mu * slip * jnp.array([1.0, 1.0, 0.0])
        moment = jnp.cross(r, normal + f)
        k = p.mass * p.offset / p.I1
        N = (p.mass * p.gravity - k * jnp.dot(normal, jnp.cross(L, e_dot))) / (
            1.0 + k * jnp.dot(normal, jnp.cross(moment, e))
        )
        return N * f / p.mass, e_dot, N * moment

    def solve_single(y0):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            task.t1,
            None,
            y0,
            stepsize_controller=diffrax.PIDController(1e-9, 1e-11),
            event=diffrax.Event(lambda t, y, args, **_: y[1][2] - cosine < 0.0),
            max_steps=100_000,
        )
        return solution.ts[0]

    starts = task.starts[:, np.arange(launches) % task.launches]
    y0 = (
        jnp.asarray(np.vstack([starts[:2], 0.0 * starts[:1]]).T),
        jnp.asarray(starts[2:5].T),
        jnp.asarray(starts[5:8].T),
    )
    batched = jax.jit(jax.vmap(solve_single))
    return lambda: batched(y0)


def spread(launches: int, max_launches: int) -> Any:
    """The launches for a program that is too slow for all of them: a sample with the same range of cost."""
    count = min(launches, max_launches)
    return ((np.arange(count) + 0.5) * launches / count).astype(int)


def errors(task: Task, ends: Ends, reference: Ends) -> tuple[float, float]:
    """The greatest errors over the launches: of the time [s] (of the end state if the horizon ends a run), and of the
    end state."""
    time, end = (
        float(np.max(np.abs(value - reference_value))) for value, reference_value in zip(ends, reference, strict=True)
    )
    return (end if task.angle is None else time), end


def row(scene: str, program: str, tolerance: float, task: Task, measured: Any, reference: Ends) -> dict[str, str]:
    """One row of the CSV."""
    error, end_error = errors(task, measured.result, reference)
    return {
        "scene": scene,
        "program": program,
        "tolerance": f"{tolerance:.0e}",
        "error": f"{error:.1e}",
        "end error": f"{end_error:.1e}",
        "cpu ms per launch": f"{measured.cpu / task.launches * 1e3:.4f}",
        "first call [s]": f"{measured.first:.1f}",
    }


def measure(name: str, case: Case, quick: bool) -> list[dict[str, str]]:
    """Measure all programs on one scene."""
    task, difference = case.task, misprint(case)
    if not difference < 1e-12:
        raise RuntimeError(f"{name}: the peers' field differs from the scene's own by {difference:.1e}")
    by_scipy = scipy_with("DOP853", compiled=available("numba"))
    reference = heyoka_scalar(task)(1e-16) if available("heyoka") else by_scipy(task)(1e-13)
    rows = []
    tolerances = TOLERANCES[2::2] if quick else TOLERANCES
    for solver_name, solver in SOLVERS.items():
        if solver_name == "Stabilized8" and "Coulomb" not in name:
            continue
        run = ours(case, solver)
        for tolerance in tolerances:
            if solver_name == "Tsit5" and tolerance < 1e-10:
                continue
            measured = timed(lambda run=run, tolerance=tolerance: run(tolerance), RUNS)
            rows.append(row(name, f"nonholonomic {solver_name}", tolerance, task, measured, reference))
            print(rows[-1], flush=True)
    for peer, (packages, make, bears) in PEERS.items():
        missing = [package for package in packages if not available(package)]
        if missing:
            print(f"{peer}: {' and '.join(missing)} not installed, skipped")
            continue
        indices = spread(task.launches, bears)
        subset, right = task.of(indices), reference.of(indices)
        try:
            run = make(subset)
        except NotImplementedError as reason:
            print(f"{peer}: {reason}, skipped")
            continue
        for tolerance in tolerances if "heyoka" in peer else tolerances[::2]:
            measured = timed(lambda run=run, tolerance=tolerance: run(tolerance), RUNS if "heyoka" in peer else 1)
            rows.append(row(name, peer, tolerance, subset, measured, right))
            print(rows[-1], flush=True)
    return rows


def cost_at(rows: list[dict[str, str]], scene: str, program: str, error: float) -> float:
    """CPU time per launch [ms] at a given error, interpolated in logarithms; infinite outside the measured errors."""
    points = [
        (math.log(float(row["error"]) + 1e-300), math.log(float(row["cpu ms per launch"])))
        for row in rows
        if row["scene"] == scene and row["program"] == program and math.isfinite(float(row["error"]))
    ]
    points = sorted(points)
    if not points or math.log(error) < points[0][0]:
        return math.inf
    return math.exp(np.interp(math.log(error), *zip(*points, strict=True)))


def summary(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The README's table: CPU time per launch at two errors, for every scene and program."""
    entries = []
    for scene in dict.fromkeys(row["scene"] for row in rows):
        for program in dict.fromkeys(row["program"] for row in rows if row["scene"] == scene):
            costs = [cost_at(rows, scene, program, error) for error in (1e-6, 1e-8)]
            texts = [f"{cost:.3g}" if math.isfinite(cost) else "-" for cost in costs]
            entries.append(
                {"scene": scene, "program": program, "ms at error 1e-6": texts[0], "ms at error 1e-8": texts[1]}
            )
    return entries


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """CPU time against error: a panel for each scene, and a panel for the names of the programs."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row["scene"] for row in rows))
    programs = list(dict.fromkeys(row["program"] for row in rows))
    columns = min(len(names) + 1, 3)
    lines = -(-(len(names) + 1) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.9 * lines), layout="constrained")
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    drawings, legend = panels[: len(names)], panels[len(names)]
    for drawing, name in zip(drawings, names, strict=True):
        for number, program in enumerate(programs):
            points = [
                (float(row["error"]), float(row["cpu ms per launch"]))
                for row in rows
                if row["scene"] == name and row["program"] == program and math.isfinite(float(row["error"]))
            ]
            style = "-" if program.startswith("nonholonomic") else "--"
            drawing.loglog(
                *(zip(*points, strict=True) if points else ([], [])),
                "o" + style,
                color=colormaps["tab20"](number),
                markersize=3,
                label=program,
            )
        drawing.set_title(name)
        drawing.set_xlabel("error [s], of the axis, or [m]")
        drawing.set_ylabel("CPU ms per launch, one core")
        drawing.grid(alpha=0.3)
    for panel in panels[len(names) :]:
        panel.axis("off")
    legend.legend(*drawings[0].get_legend_handles_labels(), loc="center", frameon=False)
    figure.savefig(path, dpi=90)


def main() -> None:
    """Measure, print, write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--out", type=Path, default=Path("benchmark-out"))
    command.add_argument("--launches", type=int, default=512)
    command.add_argument("--quick", action="store_true", help="four tolerances, no vmapped Diffrax in large batches")
    command.add_argument("--scenes", nargs="+", choices=list(scenes(1)), help="these scenes only")
    options = command.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    one_core()
    print(machine())
    rows = []
    scenes_by_name = scenes(options.launches)
    for name in options.scenes or scenes_by_name:
        rows += measure(name, scenes_by_name[name], options.quick)
    write_csv(options.out / "work_precision.csv", rows)
    print(table(summary(rows)))
    if not options.quick and "plane, viscous" in (options.scenes or scenes_by_name):
        task = scenes_by_name["plane, viscous"].task
        row = next(
            float(row["cpu ms per launch"])
            for row in rows
            if row["program"] == "nonholonomic Oscillatory8"
            and row["tolerance"] == "1e-09"
            and row["scene"] == "plane, viscous"
        )
        for launches in (1024, 4096):
            measured = timed(obvious_diffrax(task, launches), 1)
            cost = measured.cpu / launches * 1e3
            label = f"vmapped Diffrax Dopri8 as one writes it first, {launches} lanes, rtol 1e-9"
            print(f"{label}: {cost:.2f} ms a launch, {cost / row:.1f} times ours")
    if available("matplotlib"):
        draw(rows, options.out / "work_precision.png")


if __name__ == "__main__":
    main()
