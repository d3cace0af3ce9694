"""Simulation-based calibration of `sample` (Talts et al., arXiv:1804.06788): is the rank of the truth among the draws uniform?

    nice python benchmarks/calibration.py [times film] [--repeats 200] [--rows calibration.jsonl] [--report]

Each repeat draws the unknowns from their priors, simulates the data, adds noise, and draws from the posterior by
`nonholonomic.identification.sample` without a fit, from the same start. If the draws come from the posterior, the fraction of
the draws below the truth is uniform over the repeats. The settings are friction and offset from eight inversion times at
0.7 pi (`times`), and friction and spin from a film of theta (`film`). Every repeat is appended to the file of rows at once; a
second call continues where the first ended. The script prints the p-values of the Kolmogorov-Smirnov test, and the fractions of
repeats in which the central 50 and 90 % of the draws contain the truth.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from interval_coverage import OFFSET, SPIN, scene_of

import tippe
from nonholonomic.identification import LogDensity, sample

#: Mean and standard deviation of the priors.
FRICTION, DISTANCE, ROTATION = (0.3, 0.04), (OFFSET, 4e-4), (SPIN, 3.0)

#: Numbers of chains, of discarded draws and of kept draws of each chain.
CHAINS, WARMUP, DRAWS = 4, 10, 64


class Setting(NamedTuple):
    """The priors of the unknowns, by their full names, and the posterior for true values and a source of noise."""

    priors: dict[str, tuple[float, float]]
    posterior: Callable[[dict[str, float], np.random.Generator], LogDensity]


def times() -> Setting:
    thetas, spins, error, angle = np.linspace(0.03, 0.08, 8), np.linspace(140.0, 170.0, 8), 0.02, 0.7 * np.pi
    priors = {"scene.friction.mu": FRICTION, "scene.body.offset": DISTANCE}
    start = {name: tippe.Free(prior[0], 0.0, prior=prior) for name, prior in priors.items()}

    def posterior(truth: dict[str, float], random: np.random.Generator) -> LogDensity:
        scene = scene_of(*truth.values())
        options = {"t1": 30.0, "angle": angle, "scattered": True, "progress": False}
        exact = np.asarray(tippe.inversion_table(scene, theta=thetas, spin=spins, **options)["time"])
        measured = exact + error * random.normal(size=8)
        data = tippe.InversionTimes(tippe.Launch(thetas, spins), measured, error, t1=30.0, angle=angle)
        return tippe.log_density(scene_of(FRICTION[0], OFFSET), data, start)

    return Setting(priors, posterior)


def film() -> Setting:
    clock, error, scene = np.arange(90) / 30.0, 0.02, scene_of(FRICTION[0], OFFSET)
    priors = {"scene.friction.mu": FRICTION, "launch.spin": ROTATION}
    start = {name: tippe.Free(prior[0], 0.0, prior=prior) for name, prior in priors.items()}

    def posterior(truth: dict[str, float], random: np.random.Generator) -> LogDensity:
        mu, spin = truth.values()
        run = tippe.simulate(scene_of(mu, OFFSET), tippe.Launch(0.1, spin), float(clock[-1]))
        measured = np.asarray(run.at(clock).theta) + error * random.normal(size=clock.size)
        return tippe.log_density(scene, tippe.Recording(tippe.Launch(0.1, SPIN), clock, measured, error), start)

    return Setting(priors, posterior)


SETTINGS: dict[str, Callable[[], Setting]] = {"times": times, "film": film}


def row_of(setting: Setting, random: np.random.Generator, seed: int) -> dict[str, Any]:
    """The ranks of the true values among the draws of one repeat."""
    truth = {name: mean + deviation * random.normal() for name, (mean, deviation) in setting.priors.items()}
    density, begin = setting.posterior(truth, random), time.process_time()
    draws = sample(density, chains=CHAINS, warmup=WARMUP, draws=DRAWS, seed=seed, progress=False)
    ranks = {name: float(np.mean(draws.values[name] < value)) for name, value in truth.items()}
    seconds = time.process_time() - begin
    return {"ranks": ranks, "accepted": draws.accepted, "r_hat": max(draws.r_hat.values()), "seconds": seconds}


def rows_of(path: Path, name: str) -> dict[int, dict[str, Any]]:
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["number"]: row for row in map(json.loads, lines) if row["setting"] == name}


def report(name: str, rows: list[dict[str, Any]]) -> None:
    seconds = np.median([row["seconds"] for row in rows])
    for unknown in rows[0]["ranks"]:
        rank = np.array([row["ranks"][unknown] for row in rows])
        p_value = scipy.stats.kstest(rank, "uniform").pvalue
        inside = [np.mean(np.abs(rank - 0.5) < 0.5 * part) for part in (0.5, 0.9)]
        print(
            f"| {name} | {unknown} | {len(rows)} | {p_value:.2f} | {100.0 * inside[0]:.0f} % | {100.0 * inside[1]:.0f} % | "
            f"{seconds:.1f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("settings", nargs="*", default=list(SETTINGS))
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--rows", type=Path, default=Path("calibration.jsonl"))
    parser.add_argument("--report", action="store_true", help="only print the table of the rows")
    options = parser.parse_args()
    for name in options.settings:
        done = rows_of(options.rows, name)
        missing = [] if options.report else [k for k in range(options.repeats) if k not in done]
        setting = SETTINGS[name]() if missing else None
        for number in missing:
            assert setting is not None
            row = row_of(setting, np.random.default_rng(1000 + number), number)
            with options.rows.open("a") as file:
                file.write(json.dumps({"setting": name, "number": number} | row) + "\n")
        if rows := list(rows_of(options.rows, name).values()):
            report(name, rows)


if __name__ == "__main__":
    main()
