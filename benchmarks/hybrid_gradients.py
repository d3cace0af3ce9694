"""Cost and error of the gradients of sampled runs through resets, by the number of parameters.

    python benchmarks/hybrid_gradients.py [--numbers 4 8 16 32 100] [--runs 64]

Each run has its own parameters. The balls bounce under a thrust, a sum of bells in time, each with a factor; the tops
are Rutstam's, which hops, with all ten numbers of its scene and launch (`--numbers top`, which compiles for minutes). The
loss is a sum over 61 samples in 4 s (tops: 3 s); `jax.grad` of the loss is mapped over the runs by `vmap`, at a tolerance
of 1e-6 (tops: 1e-9). Cost is
CPU time on one core, without compilation. Error is that of all derivatives of one run's loss at a tolerance of 1e-9, relative
to the largest derivative, from the best of six central differences; derivatives are by numbers relative to their own size.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed, write_csv

import nonholonomic
import tippe

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "shared"))
from tops import rutstam_top

DURATION, TOLERANCE = 4.0, 1e-6
TOP_DURATION, TOP_TOLERANCE = 3.0, 1e-9
TIMES = jnp.linspace(0.0, DURATION, 61)


class Ball(nonholonomic.AbstractMode):
    """A ball with a thrust."""

    restitution: float
    factors: Any

    def field(self, t, y):
        knots = jnp.linspace(0.0, DURATION, self.factors.size)
        thrust = jnp.sum(self.factors * jnp.exp(-(((t - knots) / (0.7 * DURATION / self.factors.size)) ** 2)))
        return jnp.stack([y[1], -9.81 + thrust - 0.1 * y[1]])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.stack([0.0 * y[0], -self.restitution * y[1]]), 0


def ball_loss(numbers: Any, tolerance: Any) -> Any:
    """A sum over the heights of a ball; the last number is the restitution."""
    ball = nonholonomic.Hybrid([Ball(numbers[-1], numbers[:-1])])
    run = nonholonomic.simulate(ball, [1.0, 0.0], DURATION, times=TIMES, tolerance=tolerance)
    return jnp.mean((run.state[:, 0] - 0.5) ** 2)


def top_loss(numbers: Any, tolerance: Any) -> Any:
    """A sum over the angles of a hopping top."""
    *body, mu, gravity, restitution, theta, spin = numbers
    scene = tippe.Scene(
        tippe.Top(*body), friction=tippe.Viscous(mu), gravity=gravity, contact="hybrid", restitution=restitution
    )
    times = jnp.linspace(0.0, TOP_DURATION, 61)
    run = tippe.simulate(scene, tippe.Launch(theta, spin), TOP_DURATION, times=times, tolerance=tolerance)
    return jnp.mean(run.theta**2) + 10.0 * jnp.mean(run.eta * jnp.cos(run.t))


def points(numbers: str, runs: int) -> Any:
    """The parameters of some runs."""
    random = np.random.default_rng(0)
    if numbers != "top":
        factors = 0.3 * random.normal(size=(runs, int(numbers) - 1))
        return jnp.asarray(np.concatenate([factors, 0.93 + 0.02 * random.uniform(-1.0, 1.0, (runs, 1))], axis=1))
    top = rutstam_top()
    own = [float(number) for number in (top.mass, top.radius, top.offset, top.I1, top.I3)]
    nominal = np.array([*own, 0.3, 9.81, 0.5, 0.1, 280.0])
    return jnp.asarray(nominal * (1.0 + 0.02 * random.uniform(-1.0, 1.0, (runs, 10))))


def row_of(numbers: str, runs: int) -> dict[str, str]:
    """Costs and error for some parameters."""
    loss, tolerance = (top_loss, TOP_TOLERANCE) if numbers == "top" else (ball_loss, TOLERANCE)
    point = points(numbers, runs)
    programs = [jax.jit(jax.vmap(function, (0, None))) for function in (loss, jax.grad(loss))]
    value, gradient = (program.lower(point, tolerance).compile() for program in programs)
    costs = [timed(lambda program=program: program(point, tolerance), 5).cpu for program in (value, gradient)]
    memory: Any = gradient.memory_analysis()
    count = point.shape[1]
    slopes, best = gradient(point, 1e-9)[0] * point[0], np.full(count, np.inf)
    many = jax.jit(jax.vmap(loss, (0, None)))
    for step in 10.0 ** -np.arange(4.0, 7.0, 0.5):
        changes = 1.0 + step * np.eye(count)
        values = many(jnp.concatenate([point[0] * changes, point[0] * (2.0 - changes)]), 1e-13)
        best = np.minimum(best, np.abs((values[:count] - values[count:]) / (2.0 * step) - slopes))
    row = {
        "numbers": numbers,
        "loss ms": f"{1e3 * costs[0]:.1f}",
        "gradient ms": f"{1e3 * costs[1]:.1f}",
        "gradient / loss": f"{costs[1] / costs[0]:.2f}",
        "bytes": f"{memory.temp_size_in_bytes / 2**20:.0f} MiB",
        "error": f"{np.max(best) / np.max(np.abs(slopes)):.1e}",
    }
    print(table([row]), flush=True)
    return row


def main() -> None:
    """Measure, print and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--numbers", nargs="+", default=["4", "8", "16", "32", "100"])
    command.add_argument("--runs", type=int, default=64)
    command.add_argument("--out", type=Path, default=Path("hybrid_gradients.csv"))
    options = command.parse_args()
    one_core()
    print(machine())
    rows = [row_of(numbers, options.runs) for numbers in options.numbers]
    print(table(rows))
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
