"""How often intervals of `tippe.identify` contain the truth, and estimates lie within one standard error of it, with default
options, from random starts.

    nice python benchmarks/coverage.py [times late film hopping outliers censored] [--repeats 200]

Starts are drawn within a factor of 1.5 of the friction, 12 % of the offset and 5 % of the spin. The settings are eight
inversion times at 0.7 pi (`times`) and at 0.95 pi (`late`), the times with outliers and `student=4`, times of which the
latest are only known to be later (`censored`), a film of theta with unknown spin and clock (`film`), and a film of a wooden
top that hops (`hopping`). The script prints a row of a table for each unknown, with the binomial error of the fractions.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import tippe

warnings.simplefilter("ignore", tippe.FitWarning)
MU, OFFSET, SPIN = 0.3, 0.006, 150.0
WOODEN = {"cut": 0.015, "stem_radius": 0.005, "stem_length": 0.012, "hole_radius": 0.012, "hole_depth": 0.020}

#: A fit of one noisy data set, and the true values of its unknowns.
Trial = Callable[[np.random.Generator], tuple[Any, dict[str, float]]]


def scene_of(mu: float, offset: float) -> tippe.Scene:
    return tippe.Scene(tippe.Top(0.02, 0.02, offset, 2.994e-6, 3.2e-6), friction=tippe.Viscous(mu))


def times(
    theta: tuple[float, float], angle: float, error: float, student: float | None = None, latest: int = 0
) -> Trial:
    """Friction and offset from eight times, of which the `latest` are limits."""
    thetas, spins = np.linspace(*theta, 8), np.linspace(140.0, 170.0, 8)
    columns = {"theta": thetas, "spin": spins}
    table = tippe.inversion_table(scene_of(MU, OFFSET), **columns, t1=20.0, angle=angle, scattered=True)
    exact = np.asarray(table["time"])

    def trial(random: np.random.Generator) -> tuple[Any, dict[str, float]]:
        noise = random.normal(size=8)
        if student is not None:
            noise = noise / np.sqrt(random.chisquare(student, 8) / student)
        measured, until = exact + error * noise, np.full(8, 20.0)
        if latest:
            horizon = np.sort(exact)[-latest] - 0.5 * error
            measured, until = np.where(measured > horizon, np.inf, measured), np.full(8, horizon)
        launch = tippe.Launch(thetas, spins)
        data = tippe.InversionTimes(launch, measured, error, t1=20.0, until=until, angle=angle, student=student)
        mu, offset = MU * 1.5 ** random.uniform(-1.0, 1.0), OFFSET * 1.12 ** random.uniform(-1.0, 1.0)
        fit = tippe.identify(scene_of(mu, offset), data, {"mu": mu, "offset": offset}, progress=False)
        return fit, {"mu": MU, "offset": OFFSET}

    return trial


def film(scene: tippe.Scene, launch: tippe.Launch, clock: np.ndarray, error: float, with_clock: bool) -> Trial:
    """Friction and spin from a film of theta, and perhaps the clock's reading at the launch."""
    exact = np.asarray(tippe.simulate(scene, launch, float(clock[-1]), tolerance=1e-10).at(clock).theta)
    truth = {"friction.mu": float(scene.friction.mu), "launch.spin": float(launch.spin)} | (
        {"t0": 0.0} if with_clock else {}
    )

    def trial(random: np.random.Generator) -> tuple[Any, dict[str, float]]:
        measured = exact + error * random.normal(size=exact.size)
        data = tippe.Recording(launch, clock, measured, error, "theta")
        free = {"friction.mu": truth["friction.mu"] * 1.5 ** random.uniform(-1.0, 1.0)}
        free["launch.spin"] = truth["launch.spin"] * (1.0 + 0.05 * random.uniform(-1.0, 1.0))
        if with_clock:
            free["t0"] = 0.03 * random.uniform(-1.0, 1.0)
        return tippe.identify(scene, data, free, progress=False), truth

    return trial


def smooth_film() -> Trial:
    launch = tippe.Launch(0.1, SPIN, azimuth=0.3)
    return film(scene_of(MU, OFFSET), launch, np.arange(360) / 120.0, 0.02, True)


def hopping_film() -> Trial:
    top = tippe.Top.turned(0.020, 700.0, **WOODEN)
    scene = tippe.Scene(top, friction=tippe.Coulomb(MU, 0.05), contact="hybrid")
    return film(scene, tippe.Launch(0.1222, 219.9), np.arange(104) / 30.0, np.radians(2.0), False)


SETTINGS: dict[str, Callable[[], Trial]] = {
    "times": lambda: times((0.03, 0.08), 0.7 * np.pi, 0.02),
    "late": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05),
    "outliers": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05, student=4.0),
    "censored": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05, latest=2),
    "film": smooth_film,
    "hopping": hopping_film,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("settings", nargs="*", default=list(SETTINGS))
    parser.add_argument("--repeats", type=int, default=200)
    options = parser.parse_args()
    for name in options.settings:
        trial, random, rows = SETTINGS[name](), np.random.default_rng(0), []
        start_time = time.process_time()
        for _ in range(options.repeats):
            fit, truth = trial(random)
            for unknown, value in truth.items():
                full = next(key for key in fit.estimates if key.endswith(unknown))
                ends = np.array([fit.interval(full), fit.interval(full, 1.0)])
                near = abs(fit.estimates[full] - value) < fit.standard_errors[full]
                rows.append([*((ends[:, 0] <= value) & (value <= ends[:, 1])), near])
        shares = np.mean(np.array(rows, float).reshape(options.repeats, -1, 3), axis=0)
        errors = np.sqrt(shares * (1.0 - shares) / options.repeats)
        seconds = (time.process_time() - start_time) / options.repeats
        for unknown, share, error in zip(truth, shares, errors, strict=True):
            parts = " | ".join(f"{100.0 * s:.0f} ± {100.0 * e:.0f}" for s, e in zip(share, error, strict=True))
            print(f"| {name} | {unknown} | {options.repeats} | {parts} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
