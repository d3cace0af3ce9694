"""Cost and error of derivatives of inversion times, over tolerances.

    python benchmarks/gradients.py [--launches 1024]

The reference problem (Rutstam's top on the plane, viscous friction, 100 rad/s, theta(0) from 0.05 to 0.15) and the same
top in a cylinder: a table of times; the same table with the derivative by mu, and with those by two, four and six numbers;
and the gradient of a scalar loss of 256 launches by reverse mode, `jax.grad` through `vmap(inversion_time)`, with two numbers
and with six. Cost is CPU time on one core without compilation, as a multiple of the table's cost, or, for the loss, of
the loss's own cost. Error is the largest relative difference of the derivatives by mu from those at tolerance 1e-13,
and that of one of them from extrapolated central differences. Run the script alone: other work on the machine changes
every number.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed, write_csv
from scenes import TOP

import tippe
from nonholonomic.parameters import with_numbers
from nonholonomic.sweeps import running

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "physics"))
from make_gradient_reference import RATIO, extrapolated

ONE = ["scene.friction.mu"]
#: Number of launches in the loss.
OF_LOSS = 256
SIX = [*ONE, "scene.body.offset", "scene.body.I1", "scene.body.I3", "launch.spin", "launch.theta"]


def times(scene: tippe.Scene, theta: np.ndarray, tolerance: float, paths: list[str]) -> tippe.Table:
    """The table, with derivatives with respect to the given numbers."""
    return tippe.inversion_table(scene, theta=theta, spin=100.0, t1=30.0, tolerance=tolerance, sensitivities=paths)


def loss_of(scene: tippe.Scene, theta: np.ndarray, paths: list[str]) -> tuple[Callable[..., Any], list[Any]]:
    """Mean square of the launches' times, as a function of some numbers and the tolerance; and the numbers."""
    fixed_numbers = {"scene.friction.mu": scene.friction.mu, "launch.spin": 100.0, "launch.theta": theta}
    fixed_numbers |= {f"scene.body.{name}": getattr(scene.body, name) for name in ("offset", "I1", "I3")}

    def loss(values: list[Any], tolerance: Any) -> Any:
        def time(angle: Any) -> Any:
            numbers = dict(zip(paths, values, strict=True)) | (
                {"launch.theta": angle} if "launch.theta" in paths else {}
            )
            roots = with_numbers({"scene": scene, "launch": tippe.Launch(angle, 100.0)}, numbers)
            return tippe.inversion_time(roots["scene"], roots["launch"], 30.0, tolerance=tolerance)

        angles = values[paths.index("launch.theta")] if "launch.theta" in paths else jnp.asarray(theta)
        return jnp.mean(jax.vmap(time)(angles) ** 2)

    return loss, [jnp.asarray(fixed_numbers[path], float) for path in paths]


def differences(scene: tippe.Scene, theta: float) -> tuple[float, float]:
    """The derivative of one launch's time with respect to mu from extrapolated central differences, and its error."""
    mu = float(scene.friction.mu)
    steps = 1e-3 * mu / RATIO ** np.arange(16)
    times = tippe.inversion_table(
        scene, theta=theta, spin=100.0, mu=np.concatenate([mu + steps, mu - steps]), t1=30.0, tolerance=1e-13
    ).time
    return extrapolated((times[:16] - times[16:]) / (2.0 * steps))


def rows_of(name: str, scene: tippe.Scene, launches: int) -> list[dict[str, str]]:
    """The rows of one scene, for all tolerances."""
    theta = np.linspace(0.05, 0.15, launches)
    exact = times(scene, theta, 1e-13, ONE).time_by_mu
    slope, doubt = differences(scene, theta[0])
    losses = {}
    for label, paths in (("two", [*ONE, SIX[1]]), ("all", SIX)):
        loss, values = loss_of(scene, np.linspace(theta[0], theta[-1], OF_LOSS), paths)
        losses[label] = (values, jax.jit(loss), jax.jit(jax.grad(loss)))
    references = (losses, exact, (slope, doubt))
    rows = [row_of(name, scene, theta, tolerance, *references) for tolerance in (1e-6, 1e-8, 1e-10, 1e-12)]
    print(table(rows), flush=True)
    return rows


def row_of(
    name: str,
    scene: tippe.Scene,
    theta: np.ndarray,
    tolerance: float,
    losses: dict[str, Any],
    exact: Any,
    difference: tuple[float, float],
) -> dict[str, str]:
    """Costs and errors at one tolerance."""
    runs = {
        "table": timed(lambda: times(scene, theta, tolerance, []), 3),
        "one": timed(lambda: times(scene, theta, tolerance, ONE), 3),
        "two": timed(lambda: times(scene, theta, tolerance, SIX[:2]), 2),
        "four": timed(lambda: times(scene, theta, tolerance, SIX[:4]), 2),
        "six": timed(lambda: times(scene, theta, tolerance, SIX), 2),
    }
    for label, (values, *functions) in losses.items():
        for name_of_function, function in zip(("loss", "gradient"), functions, strict=True):
            runs[f"{name_of_function} of {label}"] = timed(
                lambda run=function, values_of_call=values: run(values_of_call, jnp.asarray(tolerance)), 2
            )
    base, slopes = runs["table"].cpu, runs["one"].result.time_by_mu
    slope, doubt = difference
    return {
        "scene": name,
        "tolerance": f"{tolerance:.0e}",
        "table ms per launch": f"{base / len(theta) * 1e3:.3f}",
        "by mu": f"{runs['one'].cpu / base:.2f} x",
        "by two": f"{runs['two'].cpu / base:.2f} x",
        "by four": f"{runs['four'].cpu / base:.2f} x",
        "by six": f"{runs['six'].cpu / base:.2f} x",
        "reverse, two": f"{runs['gradient of two'].cpu / runs['loss of two'].cpu:.2f} x",
        "reverse, six": f"{runs['gradient of all'].cpu / runs['loss of all'].cpu:.2f} x",
        "first call s": ", ".join(f"{runs[kind].first:.1f}" for kind in ("one", "six", "gradient of all")),
        "error by mu": f"{np.max(np.abs(slopes / exact - 1.0)):.1e}",
        "against differences": f"{abs(slopes[0] / slope - 1.0):.1e} (they: {doubt / abs(slope):.0e})",
    }


def main() -> None:
    """Measure, print and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--launches", type=int, default=1024)
    command.add_argument("--out", type=Path, default=Path("gradients.csv"))
    options = command.parse_args()
    one_core()
    running.workers = lambda: 1
    print(machine())
    top = tippe.Top(*TOP)
    scenes = {"plane": tippe.Plane(), "cylinder": tippe.Cylinder(0.3)}
    rows = []
    for name, surface in scenes.items():
        rows += rows_of(name, tippe.Scene(top, surface, tippe.Viscous(0.3)), options.launches)
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
