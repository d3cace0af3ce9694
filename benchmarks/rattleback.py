"""A rattleback: error against time in this package, SciPy and MuJoCo, and the cost of a step compared with that of a
top.

    python benchmarks/rattleback.py

Kane and Levinson's rattleback, tilted by 0.02 rad about its y axis and spun at -5 and 5 rad/s, rolls without slip. The script
prints the time at which the spin about the vertical first vanishes, its error, and the CPU time on one core. MuJoCo gets a
coefficient of friction of 3, above what rolling needs; its contact is compliant, and gets stiffer as the step shrinks.
Programs that are not installed are named and skipped. The last table has the CPU time per step of a table of 1024 runs.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from measure import machine, one_core, table, timed
from peers import available
from scenes import TOP

import tippe
from nonholonomic.sweeps import Table

SHAPE, CENTRE = (0.2, 0.03, 0.02), (0.0, 0.0, -0.01)
INERTIA = ((2e-4, -2e-5, 0.0), (-2e-5, 1.6e-3, 0.0), (0.0, 0.0, 1.7e-3))
THETA, SPINS, HORIZON = 0.02, (-5.0, 5.0), 12.0


def rattleback(law: tippe.AbstractFriction) -> tippe.Scene:
    """The scene, with a friction law."""
    return tippe.Scene(tippe.Ellipsoid(1.0, SHAPE, CENTRE, INERTIA), friction=law)


def ours(spin: float, tolerance: float) -> float:
    """The time of reversal by `reversal_time` [s]."""
    launch = tippe.Launch(THETA, spin)
    return float(tippe.reversal_time(rattleback(tippe.NoSlip()), launch, HORIZON, tolerance=tolerance))


def scipy(spin: float, tolerance: float) -> float:
    """The time of reversal by the reference of the tests, in NumPy and SciPy's DOP853 [s]."""
    sys.path.append(str(Path(__file__).parents[1] / "tests" / "physics"))
    from rigid_reference import Rattleback  # pyright: ignore[reportMissingImports]

    reference = Rattleback(1.0, SHAPE, CENTRE, INERTIA)
    return reference.reversal(reference.start(THETA, 0.0, spin), HORIZON, rtol=tolerance)


def mujoco(spin: float, step: float) -> float:
    """The time of reversal by MuJoCo with RK4, elliptic cones and impratio 100 [s]; infinite if the body does not
    reverse."""
    import mujoco

    (xx, xy, xz), (_, yy, yz), (_, _, zz) = INERTIA
    normal = np.array([-np.sin(THETA), 0.0, np.cos(THETA)])
    squares = np.square(SHAPE)
    height = np.sqrt(squares @ normal**2) + normal @ CENTRE
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" gravity="0 0 -9.81" integrator="RK4" cone="elliptic" impratio="100"
              tolerance="1e-14" iterations="200"/>
            <default><geom friction="3 0 0" condim="3" solref="{2.0 * step} 1" solimp="0.99 0.999 1e-6"/></default>
            <worldbody><geom type="plane" size="10 10 1"/>
              <body pos="0 0 {height}" quat="{np.cos(THETA / 2)} 0 {np.sin(THETA / 2)} 0"><freejoint/>
                <inertial pos="0 0 0" mass="1" fullinertia="{xx} {yy} {zz} {xy} {xz} {yz}"/>
                <geom type="ellipsoid" size="{SHAPE[0]} {SHAPE[1]} {SHAPE[2]}" pos="0 0 {-CENTRE[2]}"/>
              </body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    # A free joint's angular velocity is in the frame of the body, its velocity in that of the world: rolling at the start.
    turn = np.array([[np.cos(THETA), 0.0, np.sin(THETA)], [0.0, 1.0, 0.0], [-np.sin(THETA), 0.0, np.cos(THETA)]])
    lever = turn @ (-squares * normal / np.sqrt(squares @ normal**2) - CENTRE)
    data.qvel[:3], data.qvel[3:] = -np.cross(turn @ [0.0, 0.0, spin], lever), [0.0, 0.0, spin]
    spin_before = spin
    for count in range(round(HORIZON / step)):
        mujoco.mj_step(model, data)
        normal_spin = float(data.xmat[1].reshape(3, 3)[2] @ data.qvel[3:])
        if normal_spin * spin <= 0.0:
            return (count + spin_before / (spin_before - normal_spin)) * step
        spin_before = normal_spin
    return np.inf


def times_and_errors() -> list[dict[str, str]]:
    """A row for each program and each tolerance or step."""
    exact = [ours(spin, 1e-13) for spin in SPINS]
    programs: list[tuple[str, str, Callable[[float, float], float], tuple[float, ...], int]] = [
        ("reversal_time", "jax", ours, (1e-6, 1e-8, 1e-10, 1e-12), 3),
        ("SciPy, DOP853", "scipy", scipy, (1e-8,), 1),
        ("MuJoCo", "mujoco", mujoco, (1e-3, 1e-4, 2.5e-5), 1),
    ]
    rows = []
    for name, package, run, settings, repeats in programs:
        if not available(package):
            print(f"{name}: {package} not installed, skipped")
            continue
        for setting in settings:
            runs = [timed(lambda run=run, spin=spin, by=setting: run(spin, by), repeats) for spin in SPINS]
            row = {"program": name, "tolerance or step [s]": f"{setting:g}"}
            for spin, measured, time in zip(SPINS, runs, exact, strict=True):
                row[f"{spin:+g} rad/s [s]"] = f"{measured.result:.6f}"
                row[f"error {spin:+g}"] = f"{abs(measured.result - time):.1e}"
            rows.append(row | {"CPU [s]": f"{sum(measured.cpu for measured in runs):.2g}"})
    return rows


def costs_of_steps() -> list[dict[str, str]]:
    """CPU time per step of tables of 1024 runs at a tolerance of 1e-9, and steps per run."""
    mass, radius, offset, I1, I3 = TOP
    ball = tippe.Ellipsoid(mass, (radius,) * 3, (0.0, 0.0, -offset), np.diag([I1, I1, I3]))
    theta, spin = np.linspace(0.1, 0.3, 32), np.linspace(120.0, 160.0, 32)
    tilt, slow_spin = np.linspace(0.01, 0.03, 32), np.linspace(-6.0, -3.0, 32)

    def inversions(body: Any) -> Callable[[], Table]:
        scene = tippe.Scene(body, friction=tippe.Viscous(0.3))
        return lambda: tippe.inversion_table(scene, theta=theta, spin=spin, t1=8.0, progress=False)

    def reversals(law: tippe.AbstractFriction) -> Callable[[], Table]:
        return lambda: tippe.reversal_table(rattleback(law), theta=tilt, spin=slow_spin, t1=5.0, progress=False)

    cases = {
        "top, viscous": inversions(tippe.Top(*TOP)),
        "the same top as an Ellipsoid": inversions(ball),
        "rattleback, viscous": reversals(tippe.Viscous(1.0)),
        "rattleback, rolling": reversals(tippe.NoSlip()),
    }
    rows, first = [], None
    for name, run in cases.items():
        measured = timed(run, 5)
        steps = int(np.sum(measured.result.steps) + np.sum(measured.result.rejected))
        cost = measured.cpu / steps
        first = first or cost
        rows.append(
            {
                "table": name,
                "CPU per step [ns]": f"{1e9 * cost:.0f}",
                "beside the top's": f"{cost / first:.2f}",
                "steps per run": f"{steps / measured.result.time.size:.0f}",
            }
        )
    return rows


def main() -> None:
    """Run and print."""
    one_core()
    print(machine())
    print(table(times_and_errors()))
    print(table(costs_of_steps()))


if __name__ == "__main__":
    main()
