"""How often intervals of fits contain the truth, and estimates lie within one standard error of it, with default options, from
random starts.

    nice python benchmarks/coverage.py [times late ... own] [--repeats 200] [--rows coverage.jsonl] [--report]

Starts are drawn within a factor of 1.5 of the friction, 12 % of the offset and 5 % of the spin; numbers of other models
within a factor of 1.5. The settings:

- `times`, `late`: eight inversion times at 0.7 pi and at 0.95 pi;
- `outliers`: the late times with outliers and `student=4`; `censored`: the latest two are only known to be later;
- `hops`: two times of a top that hops; `stick`: four times, at 0.6 pi, of a top with set-valued friction;
- `reversal`: four reversal times of a rattleback;
- `film`: theta of a top, with unknown friction, spin and clock; `wooden`: theta of a wooden top that hops;
- `ride`: the speed of a stroller, with unknown rolling friction and launch speed;
- `own`: the heights of a bouncing ball of one's own, with unknown restitution and height at the start.

Every fit is appended to the file of rows at once; a second call continues where the first ended. `--report` prints the
table of the rows with the binomial errors of the fractions.
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import nonholonomic
import stroller
import tippe

warnings.simplefilter("ignore", tippe.FitWarning)
MU, OFFSET, SPIN = 0.3, 0.006, 150.0
WOODEN = {"cut": 0.015, "stem_radius": 0.005, "stem_length": 0.012, "hole_radius": 0.012, "hole_depth": 0.020}

#: The inertia of Kane and Levinson's rattleback [kg m^2].
STONE = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]

#: A fit of one noisy data set.
Trial = Callable[[np.random.Generator], Any]


class Setting(NamedTuple):
    """The true values of the unknowns, by the ends of their names, and the fit of a noisy data set."""

    truth: dict[str, float]
    trial: Trial


def scene_of(mu: float, offset: float) -> tippe.Scene:
    return tippe.Scene(tippe.Top(0.02, 0.02, offset, 2.994e-6, 3.2e-6), friction=tippe.Viscous(mu))


def near(random: np.random.Generator, value: float, factor: float = 1.5) -> float:
    """A start within a factor of the truth."""
    return value * factor ** random.uniform(-1.0, 1.0)


def times(
    theta: tuple[float, float], angle: float, error: float, student: float | None = None, latest: int = 0
) -> Setting:
    """Friction and offset from eight times, of which the `latest` are limits."""
    thetas, spins = np.linspace(*theta, 8), np.linspace(140.0, 170.0, 8)
    columns = {"theta": thetas, "spin": spins}
    table = tippe.inversion_table(scene_of(MU, OFFSET), **columns, t1=20.0, angle=angle, scattered=True, progress=False)
    exact = np.asarray(table["time"])

    def trial(random: np.random.Generator) -> Any:
        noise = random.normal(size=8)
        if student is not None:
            noise = noise / np.sqrt(random.chisquare(student, 8) / student)
        measured, until = exact + error * noise, np.full(8, 20.0)
        if latest:
            horizon = np.sort(exact)[-latest] - 0.5 * error
            measured, until = np.where(measured > horizon, np.inf, measured), np.full(8, horizon)
        launch = tippe.Launch(thetas, spins)
        data = tippe.InversionTimes(launch, measured, error, t1=20.0, until=until, angle=angle, student=student)
        mu, offset = near(random, MU), near(random, OFFSET, 1.12)
        return tippe.identify(scene_of(mu, offset), data, {"mu": mu, "offset": offset}, progress=False)

    return Setting({"friction.mu": MU, "offset": OFFSET}, trial)


def modal_times(scene: tippe.Scene, launch: tippe.Launch, error: float, t1: float, angle: float) -> Setting:
    """Friction from the times of a top whose runs have several modes."""
    columns = {"theta": np.broadcast_to(launch.theta, np.shape(launch.spin)), "spin": launch.spin}
    table = tippe.inversion_table(scene, **columns, t1=t1, angle=angle, scattered=True, progress=False)
    exact = np.asarray(table["time"])

    def trial(random: np.random.Generator) -> Any:
        measured = exact + error * random.normal(size=exact.size)
        data = tippe.InversionTimes(launch, measured, error, t1=t1, angle=angle)
        return tippe.identify(scene, data, {"friction.mu": near(random, MU)}, tolerance=1e-6, progress=False)

    return Setting({"friction.mu": float(scene.friction.mu)}, trial)


def hops() -> Setting:
    scene = tippe.Scene(scene_of(MU, OFFSET).body, friction=tippe.Viscous(MU), contact="hybrid")
    return modal_times(scene, tippe.Launch(0.1, np.array([180.0, 200.0])), 0.02, 12.0, 0.95 * np.pi)


def stick() -> Setting:
    scene = tippe.Scene(scene_of(MU, OFFSET).body, friction=tippe.SetValuedCoulomb(MU))
    return modal_times(scene, tippe.Launch(1.5, np.linspace(100.0, 150.0, 4)), 0.01, 2.0, 0.6 * np.pi)


def reversal() -> Setting:
    """The product of inertia of a rattleback from four times."""
    body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), STONE)
    scene = tippe.Scene(body, friction=tippe.NoSlip())
    thetas, spins = np.linspace(0.015, 0.025, 4), np.array([-4.0, -4.5, -5.0, -5.5])
    table = tippe.reversal_table(scene, theta=thetas, spin=spins, t1=8.0, scattered=True, progress=False)
    exact = np.asarray(table["time"])

    def trial(random: np.random.Generator) -> Any:
        launch = tippe.Launch(thetas, spins)
        data = tippe.ReversalTimes(launch, exact + 0.02 * random.normal(size=4), 0.02, t1=8.0)
        return tippe.identify(scene, data, {"inertia.xy": near(random, -2e-5)}, tolerance=1e-6, progress=False)

    return Setting({"inertia.xy": -2e-5}, trial)


def film(scene: tippe.Scene, launch: tippe.Launch, clock: np.ndarray, error: float, with_clock: bool) -> Setting:
    """Friction and spin from a film of theta, and perhaps the clock's reading at the launch."""
    exact = np.asarray(tippe.simulate(scene, launch, float(clock[-1]), tolerance=1e-10).at(clock).theta)
    truth = {"friction.mu": float(scene.friction.mu), "launch.spin": float(launch.spin)} | (
        {"t0": 0.0} if with_clock else {}
    )

    def trial(random: np.random.Generator) -> Any:
        measured = exact + error * random.normal(size=exact.size)
        data = tippe.Recording(launch, clock, measured, error, "theta")
        free = {"friction.mu": near(random, truth["friction.mu"])}
        free["launch.spin"] = truth["launch.spin"] * (1.0 + 0.05 * random.uniform(-1.0, 1.0))
        if with_clock:
            free["t0"] = 0.03 * random.uniform(-1.0, 1.0)
        return tippe.identify(scene, data, free, progress=False)

    return Setting(truth, trial)


def smooth_film() -> Setting:
    launch = tippe.Launch(0.1, SPIN, azimuth=0.3)
    return film(scene_of(MU, OFFSET), launch, np.arange(360) / 120.0, 0.02, True)


def wooden() -> Setting:
    top = tippe.Top.turned(0.020, 700.0, **WOODEN)
    scene = tippe.Scene(top, friction=tippe.Coulomb(MU, 0.05), contact="hybrid")
    return film(scene, tippe.Launch(0.1222, 219.9), np.arange(104) / 30.0, np.radians(2.0), False)


def ride() -> Setting:
    """Rolling friction and the speed at the launch from the speed at 30 times."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    launch, clock = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0), 0.1 * np.arange(1, 31)
    exact = np.asarray(stroller.simulate(scene, launch, 3.0, times=clock).speed)
    truth = {"friction.rolling": 2.0, "launch.speed": 2.0}

    def trial(random: np.random.Generator) -> Any:
        data = stroller.Recording(launch, clock, exact + 0.05 * random.normal(size=30), 0.05, "speed")
        free = {name: near(random, value, 1.5 if name == "friction.rolling" else 1.05) for name, value in truth.items()}
        return stroller.identify(scene, data, free, progress=False)

    return Setting(truth, trial)


class Ball(nonholonomic.AbstractMode):
    """A ball that bounces on the ground, with drag."""

    restitution: float
    drag: float

    def field(self, t, y):
        return jnp.array([y[1], -9.81 - self.drag * y[1]])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, -self.restitution * y[1]]), 0


def own() -> Setting:
    """Restitution and the height at the start from the height at 40 times, over three bounces."""
    ball, start, clock = nonholonomic.Hybrid([Ball(0.8, 0.2)]), [1.0, 0.0], 0.05 * np.arange(1, 41)
    exact = np.asarray(nonholonomic.simulate(ball, start, 2.0, times=clock)["y0"])
    truth = {"restitution": 0.8, "start[0]": 1.0}

    def trial(random: np.random.Generator) -> Any:
        data = nonholonomic.Recording(start, clock, exact + 0.03 * random.normal(size=40), 0.03, "y0")
        free = {
            "restitution": tippe.Free(min(near(random, 0.8), 0.95), 0.0, 1.0),
            "start[0]": near(random, 1.0, 1.05),
        }
        return nonholonomic.identify(ball, data, free, progress=False)

    return Setting(truth, trial)


SETTINGS: dict[str, Callable[[], Setting]] = {
    "times": lambda: times((0.03, 0.08), 0.7 * np.pi, 0.02),
    "late": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05),
    "outliers": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05, student=4.0),
    "censored": lambda: times((0.1, 0.3), 0.95 * np.pi, 0.05, latest=2),
    "hops": hops,
    "stick": stick,
    "reversal": reversal,
    "film": smooth_film,
    "wooden": wooden,
    "ride": ride,
    "own": own,
}


def row_of(setting: Setting, random: np.random.Generator) -> dict[str, Any]:
    """A fit as a row of the file."""
    begin = time.process_time()
    fit = setting.trial(random)
    row: dict[str, Any] = {
        "seconds": time.process_time() - begin,
        "effective": fit.verdict.effective,
        "k": fit.verdict.k,
    }
    row["kind"], row["minima"] = fit.distribution.kind, len(fit.verdict.minima)
    for unknown, value in setting.truth.items():
        name = next(key for key in fit.estimates if key.endswith(unknown))
        row[unknown] = {
            "truth": value,
            "wide": fit.interval(name),
            "narrow": fit.interval(name, 1.0),
            "estimate": fit.estimates[name],
            "error": fit.standard_errors[name],
        }
    return row


def measure(name: str, repeats: int, path: Path) -> None:
    """Fit until the file has `repeats` rows of a setting; the noise and the start of a row depend only on its number."""
    done = {row["number"] for row in rows_of(path, name)}
    setting = SETTINGS[name]() if len(done) < repeats else None
    for number in range(repeats):
        if setting is not None and number not in done:
            row = {"setting": name, "number": number} | row_of(setting, np.random.default_rng(number))
            with path.open("a") as file:
                file.write(json.dumps(row) + "\n")


def rows_of(path: Path, name: str) -> list[dict[str, Any]]:
    lines = path.read_text().splitlines() if path.exists() else []
    rows = [row for row in map(json.loads, lines) if row["setting"] == name]
    return [*{row["number"]: row for row in rows}.values()]


def report(name: str, rows: list[dict[str, Any]]) -> None:
    """Print a line of the table for every unknown. A fit without an interval counts as one that misses."""
    count, seconds = len(rows), np.median([row["seconds"] for row in rows])
    for unknown in (key for key, value in rows[0].items() if isinstance(value, dict)):
        numbers = [row[unknown] for row in rows]
        hits = [
            [each["wide"][0] <= each["truth"] <= each["wide"][1] for each in numbers],
            [each["narrow"][0] <= each["truth"] <= each["narrow"][1] for each in numbers],
            [abs(each["estimate"] - each["truth"]) < each["error"] for each in numbers],
        ]
        shares = np.mean(hits, axis=1)
        # Laplace's rule: that all fits hit does not mean that the share is known exactly.
        expected = (shares * count + 1.0) / (count + 2.0)
        errors = np.sqrt(expected * (1.0 - expected) / count)
        parts = " | ".join(f"{100.0 * s:.0f} ± {100.0 * e:.0f} %" for s, e in zip(shares, errors, strict=True))
        print(f"| {name} | {unknown} | {count} | {parts} | {seconds:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("settings", nargs="*", default=list(SETTINGS))
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--rows", type=Path, default=Path("coverage.jsonl"))
    parser.add_argument("--report", action="store_true", help="only print the table of the rows")
    options = parser.parse_args()
    for name in options.settings:
        if not options.report:
            measure(name, options.repeats, options.rows)
        if rows := rows_of(options.rows, name):
            report(name, rows)


if __name__ == "__main__":
    main()
