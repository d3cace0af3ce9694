"""How often intervals of fits contain the truth, and estimates lie within one standard error of it, with default options.

    nice python benchmarks/interval_coverage.py [times ... own] [--drawn] [--orders 1] [--repeats 200] [--rows coverage.jsonl]

The truth is the same in all repeats, and starts are drawn within a factor of 1.5 of the friction, 12 % of the offset and
5 % of the spin; numbers of other models within a factor of 1.5. With `--drawn`, fits start from the same values, and the
truth is drawn from Gaussian priors, which the fits are given: intervals of the right posterior then contain the truth as often
as they say, also where the data say little; a truth between two bounds without a prior is uniform. With `--orders 3`, the names
of the unknowns are given in so many orders, which must make no difference. The settings:

- `times`, `late`: eight inversion times at 0.7 pi and at 0.95 pi;
- `outliers`: the late times with outliers and `student=4`; `censored`: the latest two are only known to be later;
- `hops`: two times of a top that hops; `stick`: four times, at 0.6 pi, of a top with set-valued friction;
- `reversal`: four reversal times of a rattleback;
- `film`: theta of a top, with unknown friction, spin and clock; `wooden`: theta of a wooden top that hops;
- `ride`: the speed of a stroller, with unknown rolling friction and launch speed;
- `own`: the heights of a bouncing ball of one's own, with unknown restitution and height at the start;
- `decay`: a sum of two decays, a function, with a prior, two bounds, and a prior within a bound: cheap.

Every fit is appended to the file of rows at once; a second call continues where the first ended. `--report` prints the
table of the rows with the binomial errors of the fractions.
"""

import argparse
import dataclasses
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
from nonholonomic.identification import Measurements, identify

warnings.simplefilter("ignore", tippe.FitWarning)
MU, OFFSET, SPIN = 0.3, 0.006, 150.0
WOODEN = {"cut": 0.015, "stem_radius": 0.005, "stem_length": 0.012, "hole_radius": 0.012, "hole_depth": 0.020}

#: The product of inertia of Kane and Levinson's rattleback [kg m^2].
XY = -2e-5


class Number(NamedTuple):
    """An unknown: its value; the greatest factor or difference of a start; bounds, if they are given to the fit; and whether
    it has no prior but these."""

    value: float
    factor: float = 1.5
    difference: float = 0.0
    bounds: tuple[float, float] = (-np.inf, np.inf)
    uniform: bool = False

    def start(self, random: np.random.Generator) -> tippe.Free:
        """A start near the value."""
        place = random.uniform(-1.0, 1.0)
        start = self.value + self.difference * place if self.difference else self.value * self.factor**place
        return tippe.Free(min(start, 0.95 * self.bounds[1]), *self.bounds)

    def prior(self) -> tippe.Free:
        """A prior with a standard deviation of half the reach of the starts; none between bounds that are the prior."""
        if self.uniform:
            return tippe.Free(self.value, *self.bounds)
        deviation = 0.5 * (self.difference or abs(self.value) * np.log(self.factor))
        return tippe.Free(self.value, *self.bounds, prior=(self.value, deviation))

    def draw(self, random: np.random.Generator) -> float:
        """A value from the prior, with the sign of the mean."""
        if self.uniform:
            return random.uniform(*self.bounds)
        mean, deviation = self.prior().prior
        while not (self.bounds[0] < (drawn := random.normal(mean, deviation)) < self.bounds[1] and drawn * mean >= 0.0):
            pass
        return drawn


class Setting(NamedTuple):
    """The unknowns, by names that `identify` knows; the exact measurements, a function of their values; the data, exact
    measurements with noise; and the fit of data from a start."""

    unknowns: dict[str, Number]
    exact: Callable[..., np.ndarray]
    data: Callable[[np.ndarray, np.random.Generator], Any]
    fit: Callable[[Any, dict[str, tippe.Free]], Any]


def scene_of(mu: float, offset: float) -> tippe.Scene:
    return tippe.Scene(tippe.Top(0.02, 0.02, offset, 2.994e-6, 3.2e-6), friction=tippe.Viscous(mu))


def times(
    theta: tuple[float, float], angle: float, error: float, student: float | None = None, latest: int = 0
) -> Setting:
    """Friction and offset from eight times, of which the `latest` are limits."""
    launch, t1 = tippe.Launch(np.linspace(*theta, 8), np.linspace(140.0, 170.0, 8)), 20.0
    columns = {"theta": launch.theta, "spin": launch.spin, "t1": t1, "angle": angle, "scattered": True}

    def exact(**values: float) -> np.ndarray:
        return np.asarray(tippe.inversion_table(scene_of(*values.values()), **columns, progress=False)["time"])

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        noise = random.normal(size=8)
        if student is not None:
            noise = noise / np.sqrt(random.chisquare(student, 8) / student)
        measured, until = exact + error * noise, np.full(8, t1)
        if latest:
            horizon = np.sort(exact)[-latest] - 0.5 * error
            measured, until = np.where(measured > horizon, np.inf, measured), np.full(8, horizon)
        return tippe.InversionTimes(launch, measured, error, t1=t1, until=until, angle=angle, student=student)

    def fit(data: tippe.InversionTimes, free: dict[str, tippe.Free]) -> Any:
        return tippe.identify(scene_of(free["friction.mu"].start, free["offset"].start), data, free, progress=False)

    return Setting({"friction.mu": Number(MU), "offset": Number(OFFSET, 1.12)}, exact, data, fit)


def modal_times(
    scene: Callable[[float], tippe.Scene], launch: tippe.Launch, error: float, t1: float, angle: float
) -> Setting:
    """Friction from the times of a top whose runs have several modes."""
    columns = {"theta": np.broadcast_to(launch.theta, np.shape(launch.spin)), "spin": launch.spin}
    columns |= {"t1": t1, "angle": angle, "scattered": True}

    def exact(**values: float) -> np.ndarray:
        return np.asarray(tippe.inversion_table(scene(*values.values()), **columns, progress=False)["time"])

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        measured = exact + error * random.normal(size=exact.size)
        return tippe.InversionTimes(launch, measured, error, t1=t1, angle=angle)

    def fit(data: tippe.InversionTimes, free: dict[str, tippe.Free]) -> Any:
        return tippe.identify(scene(MU), data, free, tolerance=1e-6, progress=False)

    return Setting({"friction.mu": Number(MU)}, exact, data, fit)


def hops() -> Setting:
    def scene(mu: float) -> tippe.Scene:
        return tippe.Scene(scene_of(MU, OFFSET).body, friction=tippe.Viscous(mu), contact="hybrid")

    return modal_times(scene, tippe.Launch(0.1, np.array([180.0, 200.0])), 0.02, 12.0, 0.95 * np.pi)


def stick() -> Setting:
    def scene(mu: float) -> tippe.Scene:
        return tippe.Scene(scene_of(MU, OFFSET).body, friction=tippe.SetValuedCoulomb(mu))

    return modal_times(scene, tippe.Launch(1.5, np.linspace(100.0, 150.0, 4)), 0.01, 2.0, 0.6 * np.pi)


def reversal() -> Setting:
    """The product of inertia of a rattleback from four times."""
    launch, t1 = tippe.Launch(np.linspace(0.015, 0.025, 4), np.array([-4.0, -4.5, -5.0, -5.5])), 8.0

    def scene(xy: float) -> tippe.Scene:
        inertia = np.array([[2e-4, xy, 0.0], [xy, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]])
        return tippe.Scene(tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), inertia), friction=tippe.NoSlip())

    def exact(**values: float) -> np.ndarray:
        columns = {"theta": launch.theta, "spin": launch.spin, "t1": t1, "scattered": True}
        return np.asarray(tippe.reversal_table(scene(*values.values()), **columns, progress=False)["time"])

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        return tippe.ReversalTimes(launch, exact + 0.02 * random.normal(size=4), 0.02, t1=t1)

    def fit(data: tippe.ReversalTimes, free: dict[str, tippe.Free]) -> Any:
        return tippe.identify(scene(XY), data, free, tolerance=1e-6, progress=False)

    return Setting({"inertia.xy": Number(XY)}, exact, data, fit)


def film(
    scene: tippe.Scene, launch: tippe.Launch, clock: np.ndarray, error: float, unknowns: dict[str, Number]
) -> Setting:
    """Unknowns from a film of theta."""

    def exact(**values: float) -> np.ndarray:
        true = dataclasses.replace(launch, **{name[7:]: values[name] for name in values if name.startswith("launch.")})
        other = dataclasses.replace(scene, friction=dataclasses.replace(scene.friction, mu=values["friction.mu"]))
        moments = clock - values.get("t0", 0.0)
        run = tippe.simulate(other, true, moments[-1], tolerance=1e-10)
        before = np.full(np.sum(moments < 0.0), launch.theta)
        return np.concatenate([before, run.at(moments[moments >= 0.0]).theta])

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        return tippe.Recording(launch, clock, exact + error * random.normal(size=exact.size), error, "theta")

    def fit(data: tippe.Recording, free: dict[str, tippe.Free]) -> Any:
        return tippe.identify(scene, data, free, progress=False)

    return Setting(unknowns, exact, data, fit)


def smooth_film() -> Setting:
    launch, clock = tippe.Launch(0.1, SPIN, azimuth=0.3), np.arange(360) / 120.0
    unknowns = {"friction.mu": Number(MU), "launch.spin": Number(SPIN, difference=0.05 * SPIN)}
    return film(scene_of(MU, OFFSET), launch, clock, 0.02, unknowns | {"t0": Number(0.0, difference=0.03)})


def wooden() -> Setting:
    top = tippe.Top.turned(0.020, 700.0, **WOODEN)
    scene = tippe.Scene(top, friction=tippe.Coulomb(MU, 0.05), contact="hybrid")
    unknowns = {"friction.mu": Number(MU), "launch.spin": Number(219.9, difference=0.05 * 219.9)}
    return film(scene, tippe.Launch(0.1222, 219.9), np.arange(104) / 30.0, np.radians(2.0), unknowns)


def ride() -> Setting:
    """Rolling friction and the speed at the launch from the speed at 30 times."""
    body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    clock = 0.1 * np.arange(1, 31)

    def scene(rolling: float) -> stroller.Scene:
        return stroller.Scene(body, friction=stroller.Damping(rolling, 1.0, 0.2, 0.05))

    def launch(speed: float) -> stroller.Launch:
        return stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=speed)

    def exact(**values: float) -> np.ndarray:
        rolling, speed = values.values()
        return np.asarray(stroller.simulate(scene(rolling), launch(speed), 3.0, times=clock).speed)

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        return stroller.Recording(launch(2.0), clock, exact + 0.05 * random.normal(size=30), 0.05, "speed")

    def fit(data: stroller.Recording, free: dict[str, tippe.Free]) -> Any:
        return stroller.identify(scene(2.0), data, free, progress=False)

    return Setting({"friction.rolling": Number(2.0), "launch.speed": Number(2.0, 1.05)}, exact, data, fit)


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
    clock = 0.05 * np.arange(1, 41)

    def exact(**values: float) -> np.ndarray:
        restitution, height = values.values()
        ball = nonholonomic.Hybrid([Ball(restitution, 0.2)])
        return np.asarray(nonholonomic.simulate(ball, [height, 0.0], 2.0, times=clock)["y0"])

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        return nonholonomic.Recording([1.0, 0.0], clock, exact + 0.03 * random.normal(size=40), 0.03, "y0")

    def fit(data: nonholonomic.Recording, free: dict[str, tippe.Free]) -> Any:
        return nonholonomic.identify(nonholonomic.Hybrid([Ball(0.8, 0.2)]), data, free, progress=False)

    return Setting({"restitution": Number(0.8, bounds=(0.0, 1.0)), "start[0]": Number(1.0, 1.05)}, exact, data, fit)


def decay() -> Setting:
    """A height, a rate and a second height from 12 values of a sum of decays."""
    at = np.linspace(0.0, 3.0, 12)

    def model(p: dict[str, Any]) -> Any:
        height, rate, background = (p[name][:, None] for name in ("height", "rate", "background"))
        return height * jnp.exp(-rate * at) + background * jnp.exp(-0.1 * at)

    def exact(**values: float) -> np.ndarray:
        return np.asarray(model({name: jnp.array([value]) for name, value in values.items()}))[0]

    def data(exact: np.ndarray, random: np.random.Generator) -> Any:
        return Measurements(exact + 0.2 * random.normal(size=12), 0.2)

    def fit(data: Any, free: dict[str, tippe.Free]) -> Any:
        return identify(model, data, free, progress=False)

    rate = Number(1.0, bounds=(0.3, 1.7), uniform=True)
    unknowns = {"rate": rate, "background": Number(0.4, bounds=(0.0, np.inf)), "height": Number(2.0)}
    return Setting(unknowns, exact, data, fit)


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
    "decay": decay,
}


def row_of(setting: Setting, random: np.random.Generator, drawn: bool = False, order: int = 0) -> dict[str, Any]:
    """A fit as a row of the file, with the names of the unknowns turned by `order` places."""
    values = {name: number.draw(random) if drawn else number.value for name, number in setting.unknowns.items()}
    data = setting.data(setting.exact(**values), random)
    free = {name: number.prior() if drawn else number.start(random) for name, number in setting.unknowns.items()}
    free = {name: free[name] for name in (*list(free)[order:], *list(free)[:order])}
    begin = time.process_time()
    fit = setting.fit(data, free)
    row: dict[str, Any] = {
        "seconds": time.process_time() - begin,
        "effective": fit.verdict.effective,
        "k": fit.verdict.k,
    }
    row["kind"], row["minima"] = fit.distribution.kind, len(fit.verdict.minima)
    for unknown, value in values.items():
        name = next(key for key in fit.estimates if key.endswith(unknown))
        row[unknown] = {
            "truth": value,
            "wide": fit.interval(name),
            "narrow": fit.interval(name, 1.0),
            "estimate": fit.estimates[name],
            "error": fit.standard_errors[name],
        }
    return row


def measure(name: str, repeats: int, path: Path, drawn: bool, order: int) -> None:
    """Fit until the file has `repeats` rows of a setting; the truth, noise and start of a row depend only on its number."""
    done = {row["number"] for row in rows_of(path, label(name, drawn, order))}
    setting = SETTINGS[name]() if len(done) < repeats else None
    for number in range(repeats):
        if setting is not None and number not in done:
            row = row_of(setting, np.random.default_rng(number), drawn, order)
            with path.open("a") as file:
                file.write(json.dumps({"setting": label(name, drawn, order), "number": number} | row) + "\n")


def label(name: str, drawn: bool, order: int) -> str:
    """The name of a setting in the rows."""
    return name + ", drawn" * drawn + f", order {order + 1}" * (order > 0)


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
    parser.add_argument("--drawn", action="store_true", help="draw the truth from priors instead of the starts")
    parser.add_argument("--orders", type=int, default=1, help="number of orders of the names of the unknowns")
    parser.add_argument("--rows", type=Path, default=Path("coverage.jsonl"))
    parser.add_argument("--report", action="store_true", help="only print the table of the rows")
    options = parser.parse_args()
    for name in options.settings:
        for order in range(options.orders if not options.report else 0):
            measure(name, options.repeats, options.rows, options.drawn, order)
        for named in (label(name, drawn, order) for drawn in (False, True) for order in range(options.orders)):
            if rows := rows_of(options.rows, named):
                report(named, rows)


if __name__ == "__main__":
    main()
