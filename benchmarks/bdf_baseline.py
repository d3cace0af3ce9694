"""Cost of the paper's method: differentiation formulas of second order at a relative tolerance of 1e-9.

The paper integrates with "an adaptive method based on second-order numerical differential formulae" at 1e-9. SciPy's
`BDF` has these formulas (Shampine and Reichelt's NDF) with orders 1 to 5; here it runs as it is, and limited to order
2. Both get the compiled vector field and its exact Jacobian, so only the method differs. For comparison, the script
also runs `tippe.inversion_time`.

The quantity is the time at which Rutstam's top reaches 0.95 pi on the plane; its error is against DOP853 at 3e-14. The
wall time of the SciPy rows is mostly Python's; the evaluations of the field are the fair measure of the method.

    python benchmarks/bdf_baseline.py
"""

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from scipy.integrate import BDF, DOP853, OdeSolver
from scipy.integrate._ivp import bdf
from scipy.optimize import brentq

import tippe

ANGLE = 0.95 * np.pi


class Measured(NamedTuple):
    """One row: name, tolerance, time of inversion [s], evaluations of the field, steps, wall time [s]."""

    name: str
    rtol: float
    time: float
    evaluations: int
    steps: int
    wall: float


def inversion_with(make: Callable[[], OdeSolver], highest_order: int | None, t1: float) -> tuple[float, int, int]:
    """Time of inversion, evaluations and steps of a SciPy solver, the event found on its dense output."""
    solver, steps = make(), 0
    usual_order = bdf.MAX_ORDER
    # A solver reads the highest order at each step; its tables are created with the usual order.
    bdf.MAX_ORDER = highest_order or usual_order
    try:
        while solver.status == "running" and solver.t < t1:
            solver.step()
            steps += 1
            if solver.y[4] < np.cos(ANGLE):
                return crossing(solver), solver.nfev, steps
    finally:
        bdf.MAX_ORDER = usual_order
    return np.inf, solver.nfev, steps


def crossing(solver: OdeSolver) -> float:
    """Time within the last step at which theta reaches the angle."""
    dense = solver.dense_output()
    return brentq(lambda t: dense(t)[4] - np.cos(ANGLE), solver.t_old, solver.t, xtol=1e-15, rtol=1e-15)


def measure(options: argparse.Namespace) -> tuple[float, list[Measured]]:
    """The reference time and the rows."""
    body = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=131 / 350 * 8e-6, I3=3.2e-6)
    scene = tippe.Scene(body, friction=tippe.Viscous(0.3))
    launch = tippe.Launch(options.theta, options.spin)
    start, scales = np.asarray(scene.state(launch)), np.asarray(scene.scales(launch))
    field, jacobian = jax.jit(lambda y: scene.field(y)), jax.jit(jax.jacfwd(lambda y: scene.field(y)))
    field(start), jacobian(start)

    def rate(_, y):
        return np.asarray(field(y))

    def run(name, kind, rtol, highest_order=None, **extra_options):
        def make():
            return kind(rate, 0.0, start, options.t1, rtol=rtol, atol=0.1 * rtol * scales, **extra_options)

        start_time = time.perf_counter()
        inversion_time, evaluations, steps = inversion_with(make, highest_order, options.t1)
        return Measured(name, rtol, inversion_time, evaluations, steps, time.perf_counter() - start_time)

    # The smallest tolerance that SciPy accepts is a hundred rounding units.
    reference = run("DOP853", DOP853, 3e-14).time
    rows = []
    for rtol in options.tolerances:
        extra_options = {"jac": lambda _, y: np.asarray(jacobian(y))}
        rows.append(run("NDF, order 2 (the paper's)", BDF, rtol, 2, **extra_options))
        rows.append(run("NDF, orders 1-5", BDF, rtol, **extra_options))
        rows.append(run("DOP853", DOP853, rtol))
        rows.append(ours(scene, launch, rtol, options.t1))
    return reference, rows


def ours(scene: tippe.Scene, launch: tippe.Launch, rtol: float, t1: float) -> Measured:
    """`tippe.inversion_time` for one launch, compiled before the clock starts; it counts no evaluations."""

    def call():
        return float(tippe.inversion_time(scene, launch, t1, angle=ANGLE, tolerance=rtol))

    call()
    start_time = time.perf_counter()
    inversion_time = call()
    return Measured("tippe.inversion_time", rtol, inversion_time, 0, 0, time.perf_counter() - start_time)


def draw(reference: float, rows: list[Measured], path: str) -> None:
    """Error against wall time, a line for each method."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    for name in dict.fromkeys(row.name for row in rows):
        method_rows = [row for row in rows if row.name == name]
        axes.loglog(
            [abs(row.time - reference) for row in method_rows], [row.wall for row in method_rows], "o-", label=name
        )
    axes.set_xlabel("error of the inversion time [s]")
    axes.set_ylabel("wall time [s]")
    axes.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--theta", type=float, default=0.1, help="inclination at the start [rad]")
    parser.add_argument("--spin", type=float, default=100.0, help="spin at the start [rad/s]")
    parser.add_argument("--t1", type=float, default=20.0, help="horizon [s]")
    parser.add_argument("--tolerances", type=float, nargs="+", default=[1e-6, 1e-9])
    parser.add_argument("--picture", default="bdf_baseline.png")
    options = parser.parse_args()
    reference, rows = measure(options)
    print(f"theta0 = {options.theta} rad, spin = {options.spin} rad/s: theta = 0.95 pi at {reference:.12f} s")
    print(f"{'method':28s} {'rtol':>8s} {'error [s]':>11s} {'evaluations':>12s} {'steps':>9s} {'wall [s]':>10s}")
    for row in rows:
        counts = f"{row.evaluations or '':>12} {row.steps or '':>9}"
        print(f"{row.name:28s} {row.rtol:8.0e} {abs(row.time - reference):11.2e} {counts} {row.wall:10.3f}")
    draw(reference, rows, options.picture)


if __name__ == "__main__":
    main()
