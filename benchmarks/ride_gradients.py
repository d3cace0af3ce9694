"""Cost and error of the gradients of rides, by the numbers of their inputs, beside Diffrax's adjoint.

    python benchmarks/ride_gradients.py [--numbers 6 16 32 1000] [--rides 64]

Each ride of 12 s on the plane has its own input, a spline with half of the numbers for the force and half for the steering
torque, or a network with about a thousand weights. The loss is a sum over 61 samples; `jax.grad` of the loss is mapped
over the rides by `vmap`, at a tolerance of 1e-6. Cost is CPU time on one core, without compilation; the gradient's is also
stated as a multiple of the loss's. Diffrax's adjoint is `RecursiveCheckpointAdjoint`, in the same process. Error is that
of the derivative of one ride's loss by one number at a tolerance of 1e-9, relative to the largest derivative, from
extrapolated central differences whose steps shrink from a tenth. `bytes` is the memory that XLA plans for intermediate
results of the gradient. Run the script alone: other work on the machine changes every number.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed, write_csv

import stroller

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "physics"))
from make_gradient_reference import RATIO, extrapolated

DURATION, TOLERANCE = 12.0, 1e-6
SCENE = stroller.Scene(
    stroller.Stroller(mass=5.0, wheelbase=0.25, inertia=0.1, steering_inertia=0.005),
    friction=stroller.Damping(2.0, 0.5, 0.1, 0.05),
)
LAUNCH = stroller.Launch((0.7, 0.8), 0.0, 0.1)


class Spline(eqx.Module):
    """Bells in time, with a factor for each."""

    factors: jax.Array

    def __call__(self, t: jax.Array, motion: stroller.Motion) -> Any:
        knots = jnp.linspace(0.0, DURATION, self.factors.size // 2)
        bells = jnp.exp(-(((t - knots) / (0.7 * knots[1])) ** 2))
        force, torque = (jnp.sum(half * bells) for half in jnp.split(self.factors, 2))
        return 4.0 * jnp.tanh(force), 0.1 * torque - 0.3 * motion.steering - 0.05 * motion.steering_rate


class Network(eqx.Module):
    """Two hidden layers of 28."""

    layers: tuple[jax.Array, ...]

    def __call__(self, t: jax.Array, motion: stroller.Motion) -> Any:
        seen = (jnp.sin(t), motion.speed, motion.steering, *motion.heading[:2], motion.steering_rate)
        first, second, last = self.layers
        force, torque = jnp.tanh(last @ jnp.tanh(second @ jnp.tanh(first @ jnp.stack(seen))))
        return force, 0.1 * torque - 0.3 * motion.steering - 0.05 * motion.steering_rate


def inputs(numbers: int | str, rides: int) -> Any:
    """Inputs with random numbers."""
    random = np.random.default_rng(0)
    if numbers != "network":
        return Spline(jnp.asarray(0.7 * random.normal(size=(rides, int(numbers)))))
    shapes = ((28, 6), (28, 28), (2, 28))
    return Network(tuple(jnp.asarray(random.normal(size=(rides, *shape)) / shape[1] ** 0.5) for shape in shapes))


def loss(controls: Any, tolerance: Any, adjoint: diffrax.AbstractAdjoint | None = None) -> Any:
    """Mean square of the distance from a place and of the heading."""
    times = jnp.linspace(0.0, DURATION, 61)
    run = stroller.simulate(SCENE, LAUNCH, DURATION, controls, times=times, tolerance=tolerance, adjoint=adjoint)
    x, y = run.position[:, 0], run.position[:, 1]
    return jnp.mean(x**2 + (y - 1.0) ** 2 + run.heading**2)


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[[], Any], int]:
    """A function of these arguments, compiled, and the bytes of its intermediate results."""
    program = jax.jit(function).lower(*arguments).compile()
    analysis: Any = program.memory_analysis()
    return lambda: program(*arguments), analysis.temp_size_in_bytes


def error_of(controls: Any) -> float:
    """The error of one derivative of the first ride's loss, relative to the largest derivative."""
    first, tolerance = jax.tree.map(lambda leaf: leaf[0], controls), jnp.asarray(1e-9)
    leaves, structure = jax.tree.flatten(first)

    def of_batch(steps: Any) -> Any:
        def moved(step: Any) -> Any:
            changed = leaves[0].ravel().at[1].add(step).reshape(leaves[0].shape)
            return loss(jax.tree.unflatten(structure, [changed, *leaves[1:]]), tolerance)

        return jax.vmap(moved)(steps)

    steps = 0.1 / RATIO ** np.arange(16)
    values = np.asarray(jax.jit(of_batch)(np.concatenate([steps, -steps])))
    expected, _ = extrapolated((values[:16] - values[16:]) / (2.0 * steps))
    gradient = jax.jit(jax.vmap(jax.grad(loss), (0, None)))(jax.tree.map(lambda leaf: leaf[:2], controls), tolerance)
    largest = max(float(jnp.max(jnp.abs(leaf[0]))) for leaf in jax.tree.leaves(gradient))
    return abs(float(jax.tree.leaves(gradient)[0][0].ravel()[1]) - expected) / largest


def row_of(numbers: int | str, rides: int, with_diffrax: bool) -> dict[str, str]:
    """Costs and error for inputs with a number of numbers."""
    controls, tolerance = inputs(numbers, rides), jnp.asarray(TOLERANCE)
    value, _ = compiled(jax.vmap(loss, (0, None)), controls, tolerance)
    gradient, memory = compiled(jax.vmap(jax.grad(loss), (0, None)), controls, tolerance)
    costs = [timed(run, 5).cpu for run in (value, gradient)]
    row = {
        "numbers": str(numbers),
        "loss ms": f"{1e3 * costs[0]:.1f}",
        "gradient ms": f"{1e3 * costs[1]:.1f}",
        "gradient / loss": f"{costs[1] / costs[0]:.2f}",
        "bytes": f"{memory / 2**20:.0f} MiB",
        "error": f"{error_of(controls):.1e}",
    }
    if with_diffrax:

        def by_diffrax(controls: Any, tolerance: Any) -> Any:
            return loss(controls, tolerance, diffrax.RecursiveCheckpointAdjoint())

        run, _ = compiled(jax.vmap(jax.grad(by_diffrax), (0, None)), controls, tolerance)
        diffrax_cost = timed(run, 2).cpu
        row |= {"Diffrax ms": f"{1e3 * diffrax_cost:.0f}", "ours / Diffrax": f"{costs[1] / diffrax_cost:.2f}"}
    print(table([row]), flush=True)
    return row


def main() -> None:
    """Measure, print and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--numbers", nargs="+", default=["6", "16", "32", "1000", "network"])
    command.add_argument("--rides", type=int, default=64)
    command.add_argument("--without-diffrax", action="store_true")
    command.add_argument("--out", type=Path, default=Path("ride_gradients.csv"))
    options = command.parse_args()
    one_core()
    print(machine())
    rows = [row_of(numbers, options.rides, not options.without_diffrax) for numbers in options.numbers]
    print(table(rows))
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
