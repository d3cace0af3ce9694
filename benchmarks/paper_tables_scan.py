"""Search for tops that reproduce rows of the paper's Tables 2 and 3, whose Table 1 is lost.

The script draws tops, cylinders, azimuths and friction laws at random, runs the rows of a table for each, and counts
the sets that give its pattern of reversed and not reversed, with contact kept in all rows or lost in some. A row whose
contact is lost counts as not reversed. The sets with the closest times are then varied at random by smaller and smaller
amounts, keeping the pattern and the contact. The best is repeated with `tippe.inversion_table` at a tolerance of 1e-10,
on both tables.

    python benchmarks/paper_tables_scan.py --table 2 --law viscous --sets 20000 --rounds 20
    python benchmarks/paper_tables_scan.py --table 3 --law coulomb --sets 5000 --rounds 20

beta1 is read as I3 omega3 = 2500 g cm^2/s at t = 0, the centre is at rest, reversed means theta = 0.95 pi.
"""

import argparse
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import tippe
from nonholonomic.integration import Settings, solve_ensemble
from nonholonomic.integration.problem import CROSSED, FAILED, LEFT_DOMAIN
from tippe import paper
from tippe.modes.problems import InversionProblem

ANGLE, BLOCK = 0.95 * np.pi, 4096
NAMES = ("mass [g]", "R [mm]", "alpha", "I1/I3", "I3/mR^2", "rc/R", "azimuth", "slip speed [m/s]")
#: Ranges of the numbers above; the radius of the cylinder and the slip speed are drawn on a logarithmic scale.
LOW = np.array([5.0, 15.0, 0.1, 0.9, 0.3, np.log(5.0), -np.pi, np.log(0.005)])
HIGH = np.array([50.0, 30.0, 0.35, 1.1, 0.45, np.log(100.0), np.pi, np.log(0.3)])
LOGARITHMIC = np.isin(np.arange(8), (5, 7))
#: Sets that are varied in each round, and variations of each.
PARENTS, CHILDREN = 16, 24
TABLES = {2: paper.TABLE_2, 3: paper.TABLE_3}


class Rows(NamedTuple):
    """The results of every set: times [s] (sets, rows), infinite if not reversed, and three flags (sets,).

    `pattern`: exactly the paper's rows reversed; `contact`: and no other lost contact; `failed`: a row could not be
    run. Once a row spoils the pattern of a set, its further rows are not run.
    """

    time: np.ndarray
    pattern: np.ndarray
    contact: np.ndarray
    failed: np.ndarray


def draw(rng: np.random.Generator, sets: int) -> np.ndarray:
    """Parameter sets (sets, 8) in the order of `NAMES`."""
    return exponentials(rng.uniform(LOW, HIGH, (sets, len(NAMES))))


def exponentials(numbers: np.ndarray) -> np.ndarray:
    """The sets, with the numbers on a logarithmic scale converted to plain numbers."""
    return np.where(LOGARITHMIC, np.exp(np.where(LOGARITHMIC, numbers, 0.0)), numbers)


def logarithms(numbers: np.ndarray) -> np.ndarray:
    """The inverse of `exponentials`."""
    return np.where(LOGARITHMIC, np.log(np.where(LOGARITHMIC, numbers, 1.0)), numbers)


def scene_and_launch(
    numbers: np.ndarray, table: paper.PrintedTable, theta: np.ndarray, law: str
) -> tuple[tippe.Scene, tippe.Launch]:
    """Scene and launch of one set (8,) or of many (8, cells)."""
    mass, radius, alpha, gamma, inertia, ratio, azimuth, slip_speed = numbers
    mass, radius = mass * 1e-3, radius * 1e-3
    I3 = inertia * mass * radius**2
    body = tippe.Top(mass, radius, alpha * radius, gamma * I3, I3)
    friction = tippe.Viscous(table.mu) if law == "viscous" else tippe.Coulomb(table.mu, slip_speed)
    # At rest on the wall itself, N = 0: start slightly below it, so that rounding does not decide.
    eta = min(table.eta, np.pi / 2.0 - 1e-6)
    eta, azimuth = np.broadcast_arrays(eta, azimuth)
    scene = tippe.Scene(body, tippe.Cylinder(ratio * radius), friction)
    return scene, tippe.Launch(theta, paper.BETA1 / np.asarray(I3), eta=eta, azimuth=azimuth)


def rows(
    numbers: np.ndarray, table: paper.PrintedTable, theta: np.ndarray, options: argparse.Namespace
) -> tuple[np.ndarray, np.ndarray]:
    """Time and status code of every set with every inclination, each (sets, inclinations)."""
    shape = len(numbers), len(theta)
    total = shape[0] * shape[1]
    cells, angles = np.repeat(numbers, shape[1], axis=0).T, np.tile(theta, shape[0])
    time_, status = np.empty(total), np.empty(total, int)
    for start_time in range(0, total, BLOCK):
        indices = np.minimum(np.arange(start_time, start_time + BLOCK), total - 1)
        scene, launch = scene_and_launch(cells[:, indices], table, angles[indices], options.law)
        count = min(BLOCK, total - start_time)
        outcome, _ = solve_ensemble(
            InversionProblem.of(scene, launch, ANGLE, BLOCK),
            jnp.asarray(options.horizon),
            jnp.asarray(count),
            Settings(options.tolerance, max_steps=100_000),
        )
        time_[start_time : start_time + count] = outcome.crossing_time[:count]
        status[start_time : start_time + count] = outcome.status[:count]
    return np.where(status == CROSSED, time_, np.inf).reshape(shape), status.reshape(shape)


def inclinations_and_times(table: paper.PrintedTable) -> tuple[np.ndarray, np.ndarray]:
    """The inclinations of a table [rad] and its times [s], infinite where not reversed."""
    times = [np.inf if row.time is None else row.time for row in table.rows]
    return np.array([row.theta for row in table.rows]), np.array(times)


def run(numbers: np.ndarray, table: paper.PrintedTable, options: argparse.Namespace) -> Rows:
    """Run the rows of a table for every set; those that must reverse come first, one at a time."""
    theta, expected_times = inclinations_and_times(table)
    reversing = np.isfinite(expected_times)
    inversion_times, is_lost = np.full((len(numbers), len(theta)), np.inf), np.zeros((len(numbers), len(theta)), bool)
    failed, alive = np.zeros(len(numbers), bool), np.arange(len(numbers))
    for group in (*np.flatnonzero(reversing)[:, None], np.flatnonzero(~reversing)):
        time_, status = rows(numbers[alive], table, theta[group], options)
        inversion_times[np.ix_(alive, group)], is_lost[np.ix_(alive, group)] = time_, status == LEFT_DOMAIN
        failed[alive] = np.any(status == FAILED, axis=1)
        right = np.all(np.isfinite(time_) == reversing[group], axis=1)
        alive = alive[right & ~failed[alive]]
    pattern = np.isin(np.arange(len(numbers)), alive)
    return Rows(inversion_times, pattern, pattern & ~np.any(is_lost, axis=1), failed)


def worst_error(runs: Rows, table: paper.PrintedTable, wanted_sets: np.ndarray) -> np.ndarray:
    """Largest error of the times of a set [s], infinite for unwanted sets."""
    _, expected_times = inclinations_and_times(table)
    reversing = np.isfinite(expected_times)
    with np.errstate(invalid="ignore"):
        error = np.max(np.abs(runs.time[:, reversing] - expected_times[reversing]), axis=1)
    return np.where(wanted_sets, error, np.inf)


def scan(table: paper.PrintedTable, options: argparse.Namespace) -> None:
    """Draw, run, count, refine and print."""
    start_time, rng = time.perf_counter(), np.random.default_rng(options.seed)
    numbers = draw(rng, options.sets)
    runs = run(numbers, table, options)
    print(f"  pattern reproduced by {np.sum(runs.pattern)} sets, with contact in all rows by {np.sum(runs.contact)}")
    print(f"  sets that failed: {np.sum(runs.failed)}; {time.perf_counter() - start_time:.0f} s on {jax.devices()[0]}")
    for label, mask in (("pattern", runs.pattern), ("pattern and contact", runs.contact)):
        error = worst_error(runs, table, mask)
        if np.any(mask):
            show(f"best with {label}", numbers[np.argmin(error)], np.min(error), runs.time[np.argmin(error)])
    if options.rounds and np.any(runs.contact):
        numbers, runs = refine(rng, numbers, runs, table, options)
        error = worst_error(runs, table, runs.contact)
        show(f"best after {options.rounds} rounds", numbers[0], error[0], runs.time[0])
    index = np.argmin(worst_error(runs, table, runs.contact if np.any(runs.contact) else runs.pattern))
    if np.any(runs.pattern):
        confirm(numbers[index], options)
    print(f"  {time.perf_counter() - start_time:.0f} s in all")


def refine(
    rng: np.random.Generator, numbers: np.ndarray, runs: Rows, table: paper.PrintedTable, options: argparse.Namespace
) -> tuple[np.ndarray, Rows]:
    """Vary the best sets round by round, keeping those that stay best; the range shrinks by a tenth each round."""
    scale = HIGH - LOW
    for turn in range(options.rounds):
        order = np.argsort(worst_error(runs, table, runs.contact))[:PARENTS]
        parents = numbers[order]
        variation = 0.1 * 0.9**turn * scale * rng.normal(size=(PARENTS * CHILDREN, len(NAMES)))
        children = logarithms(np.repeat(parents, CHILDREN, axis=0)[: len(variation)])
        children = exponentials(np.clip(children + variation[: len(children)], LOW, HIGH))
        kept_runs = Rows(*(part[order] for part in runs))
        new = run(children, table, options)
        numbers = np.concatenate([parents, children])
        runs = Rows(*(np.concatenate(pair) for pair in zip(kept_runs, new, strict=True)))
    order = np.argsort(worst_error(runs, table, runs.contact))
    return numbers[order], Rows(*(part[order] for part in runs))


def show(label: str, numbers: np.ndarray, error: float, times: np.ndarray) -> None:
    """Print one set."""
    print(f"  {label}: largest error {error:.2f} s, times {np.round(times[np.isfinite(times)], 2)} s")
    print("    " + ", ".join(f"{name} {value:.5g}" for name, value in zip(NAMES, numbers, strict=True)), flush=True)


def confirm(numbers: np.ndarray, options: argparse.Namespace) -> None:
    """Repeat one set with the package's own table at a small tolerance, on both tables of the paper."""
    for name, table in TABLES.items():
        theta, _ = inclinations_and_times(table)
        scene, launch = scene_and_launch(numbers, table, theta[0], options.law)
        result = tippe.inversion_table(
            scene,
            theta=theta,
            spin=float(launch.spin),
            eta=float(launch.eta),
            azimuth=float(launch.azimuth),
            t1=options.horizon,
            angle=ANGLE,
            tolerance=1e-10,
        )
        cells = zip(np.asarray(result.time), np.asarray(result.status), strict=True)
        words = [f"{time:.2f}" if np.isfinite(time) else str(word) for time, word in cells]
        print(f"    the same at 1e-10 on Table {name}: {', '.join(words)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=int, choices=tuple(TABLES), default=2)
    parser.add_argument("--law", choices=("viscous", "coulomb"), default="viscous")
    parser.add_argument("--sets", type=int, default=2000, help="parameter sets to draw")
    parser.add_argument("--rounds", type=int, default=0, help="rounds of variation of the best sets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--horizon", type=float, default=40.0, help="seconds after which a top counts as not reversed")
    parser.add_argument("--tolerance", type=float, default=1e-7)
    options = parser.parse_args()
    print(
        f"Table {options.table}, {options.law}, {options.sets} sets, seed {options.seed}, horizon {options.horizon} s"
    )
    scan(TABLES[options.table], options)


if __name__ == "__main__":
    main()
