"""Cost and error of tables, derivatives and samples on an accelerator, measured in one go, with a page of the results.

    python benchmarks/accelerator.py [--out PAGE] [--seconds 540] [--launches 1024 131072]

Without an accelerator the script says so and measures nothing. Rutstam's top on the plane, viscous friction, 100 rad/s,
theta(0) from 0.05 to 0.15, float64, to theta = 0.95 pi or to 8 s, at two tolerances and for two numbers of launches:

* `inversion_table`, alone and with derivatives by one, two and six numbers;
* the gradient of a loss by six numbers, `jax.grad` through `vmap(inversion_time)`;
* theta at 201 times, by `jit(vmap(simulate))` and by `trajectory_table`;
* a table of tops that may leave the plane, and one with set-valued friction.

Cost is wall time per launch, the less of two runs; the first call, which compiles, has a separate column. Error is the
greatest difference from the same program at a tolerance of 1e-13, divided by the greatest result. `--launches` states the
sizes in the order in which they are measured. No row begins after `--seconds`; the page names the rows that are left out.
"""

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gradients import SIX, loss_of
from measure import machine, table, timed
from scenes import TOP

import tippe

#: The measured tolerances, and the tolerance of the reference.
TOLERANCES, TIGHT = (1e-6, 1e-9), 1e-13

#: Numbers of launches: one that suits a CPU, and one that fills the device.
LAUNCHES = (1024, 131_072)

SPIN, T1 = 100.0, 8.0

#: (launches, tolerance) -> results, as an array.
Run = Callable[[int, float], Any]


class Row(NamedTuple):
    """The measurements of a program."""

    program: str
    launches: int
    tolerance: float
    microseconds: float
    error: float
    first: float


def scene(law: Any, **options: Any) -> tippe.Scene:
    """Rutstam's top on the plane."""
    return tippe.Scene(tippe.Top(*TOP), tippe.Plane(), law, **options)


def thetas(launches: int) -> np.ndarray:
    return np.linspace(0.05, 0.15, launches)


def times_of(scene: tippe.Scene, names: list[str], result: str = "time") -> Run:
    """A table of times or another result, or of the derivatives of the times by some numbers."""

    def run(launches: int, tolerance: float) -> np.ndarray:
        grid = {"theta": thetas(launches), "spin": SPIN, "t1": T1, "tolerance": tolerance}
        table = tippe.inversion_table(scene, **grid, sensitivities=names, progress=False)
        columns = [name for name in table.variables if name.startswith("time_by_")] or [result]
        return np.stack([np.where(np.isfinite(table[name]), table[name], 0.0) for name in columns])

    return run


def gradient(launches: int, tolerance: float) -> np.ndarray:
    """The gradient of a loss with respect to six numbers, relative to each."""
    loss, values = loss_of(scene(tippe.Viscous(0.3)), thetas(launches), SIX)
    slopes = _gradient_of(launches, loss)(values, jnp.asarray(tolerance))
    return np.stack([np.sum(slope * value) for slope, value in zip(slopes, values, strict=True)])


def samples(launches: int, tolerance: float) -> Any:
    """theta at 201 times by `vmap(simulate)`."""
    return _samples(jnp.asarray(thetas(launches)), jnp.asarray(tolerance))


def sampled_table(launches: int, tolerance: float) -> np.ndarray:
    """theta at 201 times by `trajectory_table`."""
    grid = {"theta": thetas(launches), "spin": SPIN, "times": np.linspace(0.0, T1, 201)}
    table = tippe.trajectory_table(scene(tippe.Viscous(0.3)), **grid, tolerance=tolerance, progress=False)
    return table.theta


@jax.jit
def _samples(angles: Any, tolerance: Any) -> Any:
    top, times = scene(tippe.Viscous(0.3)), jnp.linspace(0.0, T1, 201)
    return jax.vmap(lambda theta: tippe.simulate(top, tippe.Launch(theta, SPIN), T1, times, tolerance).theta)(angles)


_gradients: dict[int, Any] = {}


def _gradient_of(launches: int, loss: Any) -> Any:
    """The gradient; compiled once for each number of launches."""
    return _gradients.setdefault(launches, jax.jit(jax.grad(loss)))


def programs() -> dict[str, Run]:
    """Every program by name, the most important first."""
    viscous = scene(tippe.Viscous(0.3))
    derivatives = {f"table with derivatives by {count}": times_of(viscous, SIX[:count]) for count in (1, 2, 6)}
    return {
        "table": times_of(viscous, []),
        **derivatives,
        "samples by jit(vmap(simulate))": samples,
        "gradient of a loss by 6": gradient,
        "trajectory_table": sampled_table,
        "hybrid table": times_of(scene(tippe.Viscous(0.3), contact="hybrid"), []),
        # It rolls and does not invert.
        "set-valued table": times_of(scene(tippe.SetValuedCoulomb(0.3)), [], "end_theta"),
    }


def measured(
    runs: dict[str, Run], sizes: Sequence[int], tolerances: tuple[float, ...], seconds: float
) -> Iterator[Row | str]:
    """The rows of all programs, one size after the other, and the names of the rows for which no time is left."""
    deadline = time.monotonic() + seconds
    for launches in sizes:
        for program, run in runs.items():
            exact = None
            for tolerance in tolerances:
                if time.monotonic() > deadline:
                    yield f"{program}, {launches} launches, tolerance {tolerance:.0e}"
                    continue
                timing = timed(lambda rtol=tolerance, run=run, launch_count=launches: run(launch_count, rtol), 2)
                exact = np.asarray(run(launches, TIGHT)) if exact is None else exact
                error = float(np.max(np.abs(np.asarray(timing.result) - exact)) / np.max(np.abs(exact)))
                yield Row(program, launches, tolerance, timing.wall / launches * 1e6, error, timing.first)


def page(rows: list[Row], omissions: list[str]) -> str:
    """The results in Markdown."""
    columns = [
        {
            "program": row.program,
            "launches": str(row.launches),
            "tolerance": f"{row.tolerance:.0e}",
            "us per launch": f"{row.microseconds:.3g}",
            "error": f"{row.error:.1e}",
            "first call [s]": f"{row.first:.1f}",
        }
        for row in rows
    ]
    lines = ["# Cost and error on an accelerator", "", "`python benchmarks/accelerator.py`, float64:", ""]
    lines += [*(f"* {jax.devices()[0].device_kind}", *(f"* {line}" for line in machine().splitlines())), ""]
    lines += [table(columns) if columns else "Nothing was measured.", ""]
    lines += [f"No time was left for: {'; '.join(omissions)}.", ""] if omissions else []
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> None:
    """Measure, print and write, if there is an accelerator."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--out", type=Path, default=Path("accelerator.txt"), help="the page of results")
    command.add_argument("--seconds", type=float, default=540.0, help="no row begins later")
    command.add_argument("--launches", type=int, nargs="+", default=LAUNCHES, help="numbers of launches")
    options = command.parse_args(arguments)
    if jax.default_backend() == "cpu":
        print(f"No accelerator: JAX finds {jax.devices()} only. Nothing is measured, and no page is written.")
        return
    if jnp.result_type(float) != jnp.float64:
        raise SystemExit("JAX_ENABLE_X64 = 0 must be left out: the measurements are of float64")
    rows, omissions = [], []
    for row in measured(programs(), options.launches, TOLERANCES, options.seconds):
        print(row, flush=True)
        (rows if isinstance(row, Row) else omissions).append(row)
        # Written after every row, so that nothing is lost.
        options.out.write_text(page(rows, omissions))


if __name__ == "__main__":
    main()
