"""Speed against error: this package beside its peers on the same launches, one core each.

    python benchmarks/work_precision.py [--out FOLDER] [--quick]

For each scene and tolerance: the error is the greatest over the launches, of the inversion time or of the axis at the end,
against heyoka at 1e-16 (SciPy's DOP853 at 1e-13 where heyoka is missing); the time is the least CPU time of three runs
after a warm-up, per launch. Compilation is given apart. Peers that are not installed are named and skipped. It writes a
CSV, a picture and the README's table.
"""

import argparse
import math
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from fields import Numbers
from measure import machine, one_core, table, timed, write_csv
from peers import PEERS, Task, available, heyoka_scalar, scipy_with

import tippe
from nonholonomic.ensemble import compiled_march, lanes_for
from tippe.inversion import ABSOLUTE, InversionProblem

ANGLE = 0.95 * math.pi
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)

#: The reference top of all scenes.
MASS, RADIUS = 0.02, 0.02
INERTIA = MASS * RADIUS**2
TOP = (MASS, RADIUS, 0.006, 131.0 / 350.0 * INERTIA, 0.4 * INERTIA)

SOLVERS = {"Dopri8": diffrax.Dopri8(), "Tsit5": diffrax.Tsit5(), "Dopri5": diffrax.Dopri5()}


def scenes(launches: int) -> dict[str, tuple[tippe.Scene, tippe.Launch, float, float | None]]:
    """Scene, launches, horizon and angle (`None`: the axis at the horizon is compared) of every benchmark."""
    top, theta = tippe.Top(*TOP), np.linspace(0.05, 0.15, launches)
    flat = tippe.Launch(theta, 100.0)
    slope = tippe.Launch(theta, 100.0, eta=0.3)
    drum = tippe.Cylinder(0.3)
    return {
        "plane, viscous": (tippe.Scene(top, tippe.Plane(), tippe.Viscous(0.3)), flat, 30.0, ANGLE),
        # First crossings jump by whole oscillations in a cylinder, so the axis is compared there.
        "cylinder, viscous": (tippe.Scene(top, drum, tippe.Viscous(0.3)), slope, 3.0, None),
        "cylinder, Coulomb 1e-2": (tippe.Scene(top, drum, tippe.Coulomb(0.3, 1e-2)), slope, 0.5, None),
        "cylinder, Coulomb 1e-3": (tippe.Scene(top, drum, tippe.Coulomb(0.3, 1e-3)), slope, 0.5, None),
    }


def task_of(name: str, scene: tippe.Scene, launch: tippe.Launch, t1: float, angle: float | None) -> Task:
    """The same scene as plain numbers, for the peers."""
    body, law = scene.body, scene.friction
    numbers = Numbers(
        *(float(value) for value in (body.mass, body.radius, body.offset, body.I1, body.I3, law.mu, scene.gravity)),
        slip_speed=float(getattr(law, "slip_speed", 0.0)),
        rho=float(scene.surface.radius - body.radius) if isinstance(scene.surface, tippe.Cylinder) else 0.0,
    )
    return Task(name, numbers, np.asarray(scene.state(launch)), t1, angle)


def ours(scene: tippe.Scene, launch: tippe.Launch, t1: float, angle: float | None, solver: Any) -> Any:
    """This package's block driver, with the answer that the peers give."""
    cells = launch.theta.shape[0]
    # No angle has a cosine of 2: every run goes on to the horizon.
    problem = InversionProblem.of(scene, launch, ANGLE if angle is None else angle, cells)
    if angle is None:
        problem = InversionProblem(problem.dynamics, jnp.asarray(-2.0), problem.states, problem.scales)

    def run(tolerance: float) -> Any:
        outcome, _ = compiled_march(
            problem,
            jnp.asarray(t1),
            jnp.asarray(cells),
            jnp.asarray(tolerance),
            jnp.asarray(ABSOLUTE * tolerance),
            solver=solver,
            lanes=lanes_for(cells),
        )
        return outcome.crossing_time if angle is not None else outcome.state[2:5].T

    return run


def obvious_diffrax(task: Task, launches: int) -> Any:
    """What one writes first: vectors of three, `jnp.cross`, lanes first, `vmap(diffeqsolve)` with an event."""
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

    def one(y0):
        found = diffrax.diffeqsolve(
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
        return found.ts[0]

    starts = task.starts[:, np.arange(launches) % task.starts.shape[1]]
    y0 = (
        jnp.asarray(np.vstack([starts[:2], 0.0 * starts[:1]]).T),
        jnp.asarray(starts[2:5].T),
        jnp.asarray(starts[5:8].T),
    )
    batched = jax.jit(jax.vmap(one))
    return lambda: batched(y0)


def row(scene: str, program: str, tolerance: float, error: float, milliseconds: float, first: float) -> dict[str, str]:
    """One row of the CSV."""
    return {
        "scene": scene,
        "program": program,
        "tolerance": f"{tolerance:.0e}",
        "error": f"{error:.1e}",
        "cpu ms per launch": f"{milliseconds:.4f}",
        "first call [s]": f"{first:.1f}",
    }


def measure(name: str, described: Any, quick: bool) -> list[dict[str, str]]:
    """All programs on one scene."""
    scene, launch, t1, angle = described
    task = task_of(name, *described)
    reference = heyoka_scalar(task)(1e-16) if available("heyoka") else scipy_with("DOP853", True)(task)(1e-13)
    rows = []
    tolerances = TOLERANCES[2::3] if quick else TOLERANCES
    for solver_name, solver in SOLVERS.items():
        run, launches = ours(scene, launch, t1, angle, solver), launch.theta.shape[0]
        for tolerance in tolerances:
            if solver_name != "Dopri8" and tolerance < 1e-10:
                continue
            measured = timed(lambda run=run, tolerance=tolerance: run(tolerance), 3)
            error = float(np.max(np.abs(np.asarray(measured.result) - reference)))
            rows.append(
                row(
                    name, f"nonholonomic {solver_name}", tolerance, error, measured.cpu / launches * 1e3, measured.first
                )
            )
            print(rows[-1], flush=True)
    for peer, (package, make, bears) in PEERS.items():
        if not available(package):
            print(f"{peer}: {package} is not installed, skipped")
            continue
        few = task._replace(starts=task.starts[:, :bears])
        try:
            run = make(few)
        except NotImplementedError as reason:
            print(f"{peer}: {reason}, skipped")
            continue
        for tolerance in tolerances if "heyoka" in peer else tolerances[::2]:
            measured = timed(lambda run=run, tolerance=tolerance: run(tolerance), 3 if "heyoka" in peer else 1)
            error = float(np.max(np.abs(measured.result - reference[:bears])))
            rows.append(row(name, peer, tolerance, error, measured.cpu / bears * 1e3, measured.first))
            print(rows[-1], flush=True)
    return rows


def cost_at(rows: list[dict[str, str]], scene: str, program: str, error: float) -> float:
    """CPU time per launch [ms] at a given error, between the measured points (logarithms); infinite if out of reach."""
    points = [
        (math.log(float(one["error"]) + 1e-300), math.log(float(one["cpu ms per launch"])))
        for one in rows
        if one["scene"] == scene and one["program"] == program and math.isfinite(float(one["error"]))
    ]
    points = sorted(points)
    if not points or math.log(error) < points[0][0]:
        return math.inf
    return math.exp(np.interp(math.log(error), *zip(*points, strict=True)))


def summary(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The README's table: CPU time per launch at two errors, for every scene and program."""
    found = []
    for scene in dict.fromkeys(one["scene"] for one in rows):
        for program in dict.fromkeys(one["program"] for one in rows if one["scene"] == scene):
            costs = [cost_at(rows, scene, program, error) for error in (1e-6, 1e-8)]
            shown = [f"{cost:.3g}" if math.isfinite(cost) else "-" for cost in costs]
            found.append(
                {"scene": scene, "program": program, "ms at error 1e-6": shown[0], "ms at error 1e-8": shown[1]}
            )
    return found


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """CPU time against error, a panel for each scene."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(one["scene"] for one in rows))
    figure = Figure(figsize=(5.0 * len(names), 4.6), layout="constrained")
    drawings = figure.subplots(1, len(names), squeeze=False)[0]
    for drawing, name in zip(drawings, names, strict=True):
        for program in dict.fromkeys(one["program"] for one in rows):
            points = [
                (float(one["error"]), float(one["cpu ms per launch"]))
                for one in rows
                if one["scene"] == name and one["program"] == program and math.isfinite(float(one["error"]))
            ]
            if points:
                style = "-" if program.startswith("nonholonomic") else "--"
                drawing.loglog(*zip(*points, strict=True), "o" + style, markersize=3, label=program)
        drawing.set_title(name)
        drawing.set_xlabel("error [s], or of the axis")
        drawing.set_ylabel("CPU ms per launch, one core")
        drawing.grid(alpha=0.3)
    drawings[0].legend(fontsize=7)
    figure.savefig(path, dpi=130)


def main() -> None:
    """Measure, print, write."""
    told = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    told.add_argument("--out", type=Path, default=Path("benchmark-out"))
    told.add_argument("--launches", type=int, default=512)
    told.add_argument("--quick", action="store_true", help="three tolerances, no vmapped Diffrax in large batches")
    options = told.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    one_core()
    print(machine())
    rows = []
    described = scenes(options.launches)
    for name, scene in described.items():
        rows += measure(name, scene, options.quick)
    write_csv(options.out / "work_precision.csv", rows)
    print(table(summary(rows)))
    if not options.quick:
        task = task_of("plane, viscous", *described["plane, viscous"])
        mine = next(
            float(one["cpu ms per launch"])
            for one in rows
            if one["program"] == "nonholonomic Dopri8"
            and one["tolerance"] == "1e-09"
            and one["scene"] == "plane, viscous"
        )
        for launches in (1024, 4096):
            measured = timed(obvious_diffrax(task, launches), 1)
            cost = measured.cpu / launches * 1e3
            told = f"vmapped Diffrax Dopri8 as one writes it first, {launches} lanes, rtol 1e-9"
            print(f"{told}: {cost:.2f} ms a launch, {cost / mine:.1f} times ours")
    if available("matplotlib"):
        draw(rows, options.out / "work_precision.png")


if __name__ == "__main__":
    main()
