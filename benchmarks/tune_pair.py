"""Compute the weights of `Oscillatory8`: the pair of its family with the smallest errors along motions.

    python benchmarks/tune_pair.py [--starts 40] [--launches 64] [--seed 0]

The family (`tuning/family.py`) leaves ten weights free. The script minimises the sum of the logarithms of the errors
along seven motions (`tuning/motions.py`), plus a multiple of the squares of the weights, because large weights magnify
round-off. It starts from the pair of Prince and Dormand, and then from random neighbours of the best pairs so far. It
prints every pair that is better than all before: its errors relative to those of `Dopri8`, the norms of the remaining
errors in ninth order, and finally the weights. There are many minima of nearly the same depth, so another seed, or
another machine's round-off, ends in other weights.
"""

import argparse
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from measure import machine
from scenes import Case
from tuning.family import Unknowns, free_directions, pair_of, returned
from tuning.motions import PLAIN, Steps, errors, motions, slopes, steps_of
from tuning.trees import error_coefficients

#: How much the logarithm of each motion's errors counts; 1 where it is not said.
WEIGHTS = {
    "plane, viscous": 2.0,
    "plane, frame at rest": 0.5,
    "cylinder, viscous": 1.5,
    "cylinder, Coulomb 1e-2": 2.5,
    "spheroid, stroller": 3.0,
    "sphere, viscous": 0.7,
}

#: The share of the squares of the weights in what is made smaller.
SMALLNESS = 0.03**2


class Aim:
    """The objective: the weighted logarithms of the errors of each motion, and the weights of the pair."""

    def __init__(self, cases: dict[str, Case], seed: int):
        self.motions: list[tuple[str, float, Steps]] = [
            (name, WEIGHTS.get(name, 1.0), steps) for name, case in cases.items() for steps in steps_of(case, seed)
        ]

    def sizes(self, unknowns: Unknowns) -> list[float]:
        """The errors of each motion relative to those of `Dopri8`."""
        return [float(jnp.linalg.norm(errors(unknowns, steps))) for _, _, steps in self.motions]

    def __call__(self, unknowns: Unknowns) -> float:
        logarithms = np.log(self.sizes(unknowns)) @ np.array([weight for _, weight, _ in self.motions])
        return float(logarithms + 0.5 * SMALLNESS * unknowns @ unknowns)

    def least_squares(self, unknowns: Unknowns) -> tuple[Any, Any]:
        """Residuals whose sum of squares decreases with the objective, and their slopes."""
        residuals, rows = [np.sqrt(SMALLNESS) * unknowns], [np.sqrt(SMALLNESS) * np.eye(len(unknowns))]
        for (_, weight, steps), size in zip(self.motions, self.sizes(unknowns), strict=True):
            residuals.append(np.sqrt(weight) / size * np.ravel(errors(unknowns, steps)))
            rows.append(np.sqrt(weight) / size * np.reshape(slopes(unknowns, steps), (-1, len(unknowns))))
        return np.concatenate(residuals), np.concatenate(rows)


def descended(aim: Aim, unknowns: Unknowns, passes: int = 45) -> tuple[Unknowns, float]:
    """The local minimum, by Levenberg and Marquardt's method in the family's free directions."""
    damping, heights = 1e-2, [aim(unknowns)]
    for _ in range(passes):
        free = free_directions(unknowns)
        residuals, rows = aim.least_squares(unknowns)
        rows = rows @ free
        normal, fall = rows.T @ rows, rows.T @ residuals
        for _ in range(10):
            move = -free @ np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), fall)
            trial, left = returned(unknowns + move * min(1.0, 2.0 / np.abs(move).max()), 8)
            if left < 3e-11 and aim(trial) < heights[-1]:
                break
            damping *= 5.0
        else:
            break
        unknowns, damping = trial, max(damping / 8.0, 1e-9)
        heights.append(aim(unknowns))
        if len(heights) > 8 and heights[-6] - heights[-1] < 1e-2:
            break
    return unknowns, heights[-1]


def neighbour(unknowns: Unknowns, random: np.random.Generator) -> Unknowns:
    """Another pair of the family, some random steps away."""
    for _ in range(4):
        free = free_directions(unknowns)
        step = free @ random.normal(size=free.shape[1])
        trial, left = returned(unknowns + step * random.choice([0.2, 0.5, 1.0, 2.0]) / np.abs(step).max(), 20)
        if left < 1e-11 and np.abs(trial).max() < 60.0:
            unknowns = trial
    return unknowns


def shown(aim: Aim, unknowns: Unknowns, height: float) -> str:
    """A pair in a few lines."""
    pair, sizes = pair_of(unknowns), zip(aim.motions, aim.sizes(unknowns), strict=True)
    ninth = jnp.linalg.norm(error_coefficients(pair.stages, pair.eighth, 9))
    eighth = jnp.linalg.norm(error_coefficients(pair.stages, pair.seventh, 8))
    listing = ", ".join(f"{name} {size:.3f}" for (name, _, _), size in sizes)
    weights_text = f"largest weights {jnp.abs(pair.stages).max():.1f}, {jnp.abs(pair.eighth).max():.2f}"
    return f"aim {height:.2f}; {listing}; T9 {ninth:.1e}, T8 of the seventh order {eighth:.1e}, {weights_text}"


def main() -> None:
    """Search for the pair and print its weights."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--starts", type=int, default=40, help="how many valleys are looked into")
    command.add_argument("--launches", type=int, default=64, help="steps of each motion")
    command.add_argument("--seed", type=int, default=0)
    options = command.parse_args()
    print(machine())
    random, start_time = np.random.default_rng(options.seed), time.perf_counter()
    aim, candidates = Aim(motions(options.launches), options.seed), []
    for start in range(options.starts):
        first = neighbour(candidates[random.integers(min(3, len(candidates)))][1], random) if candidates else PLAIN
        parameters, height = descended(aim, first)
        candidates = sorted([*candidates, (height, parameters)], key=lambda candidate: candidate[0])[:3]
        if candidates[0][1] is parameters:
            print(
                f"{time.perf_counter() - start_time:5.0f} s, start {start}: {shown(aim, parameters, height)}",
                flush=True,
            )
    for name, rows in pair_of(candidates[0][1])._asdict().items():
        print(name, *(repr(row.tolist()) for row in np.atleast_2d(np.asarray(rows))), sep="\n")


if __name__ == "__main__":
    main()
