"""Search for a top that reproduces Tables 2 and 3 of the paper, whose Table 1 is lost.

Differential evolution (SciPy) over the top, the cylinder, the azimuth of the axis and the coefficient of friction, from
the best of many random draws, with all members of a generation in one call. Every row counts as in
`examples/lost_numbers.py`: times with an error of 1 s, rows "not reversed" by 30 s with a one-sided likelihood, mu =
0.3 +- 0.03. The search counts large residuals by their logarithm, so that it does not sacrifice many rows for one. The
script prints the best of the last generation.

    python benchmarks/paper_tables_joint.py --law viscous --seconds 600
    python benchmarks/paper_tables_joint.py --law coulomb --seconds 600
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import differential_evolution

import tippe
from nonholonomic.identification import Measurements
from tippe import paper

HORIZON, ANGLE = 30.0, 0.95 * np.pi
ROWS = [(table, row) for table in (paper.TABLE_2, paper.TABLE_3) for row in table.rows]
THETA = np.array([row.theta for _, row in ROWS])
# At rest on the wall itself, N = 0: start slightly below it.
ETA = np.array([min(table.eta, np.pi / 2.0 - 1e-6) for table, _ in ROWS])
NAMES = ("mass [g]", "R [mm]", "alpha", "I1/I3", "I3/mR^2", "log rc/R", "azimuth", "mu", "log slip speed [m/s]")
LOW = np.array([5.0, 15.0, 0.05, 0.85, 0.3, np.log(3.0), -np.pi, 0.27, np.log(0.003)])
HIGH = np.array([60.0, 32.0, 0.4, 1.12, 0.45, np.log(150.0), np.pi, 0.33, np.log(0.3)])
DATA = Measurements([row.time or HORIZON for _, row in ROWS], 1.0, [row.time is None for _, row in ROWS])
#: Residuals larger than this count by their logarithm in the search.
LARGE = 4.0


def times(numbers: jax.Array, law: str) -> jax.Array:
    """Times of all rows [s], (sets, rows), for numbers (unknowns, sets) in the order of `NAMES`."""
    sets = numbers.shape[1]

    def single_time(theta, eta, mass, radius, alpha, ratio, inertia, cylinder, azimuth, mu, slip_speed=None):
        mass, radius = mass * paper.GRAM, radius * 1e-3
        I3 = inertia * mass * radius**2
        top = tippe.Top(mass, radius, alpha * radius, ratio * I3, I3)
        friction = tippe.Coulomb(mu, jnp.exp(slip_speed)) if law == "coulomb" else tippe.Viscous(mu)
        scene = tippe.Scene(top, tippe.Cylinder(jnp.exp(cylinder) * radius), friction)
        launch = tippe.Launch(theta, paper.BETA1 / I3, eta=eta, azimuth=azimuth)
        return tippe.extended_inversion_time(scene, launch, HORIZON, ANGLE, 1e-6)

    cells = jnp.repeat(numbers, len(ROWS), axis=1)
    return jax.vmap(single_time)(np.tile(THETA, sets), np.tile(ETA, sets), *cells).reshape(sets, -1)


def deviances(numbers: np.ndarray, law: str, run) -> tuple[np.ndarray, np.ndarray]:
    """-2 log posterior of every set, and the same with large residuals replaced by logarithms."""
    residuals = np.abs(DATA.residuals(run(jnp.asarray(numbers))))
    prior = ((numbers[7] - 0.3) / 0.03) ** 2
    bent = LARGE**2 * (1.0 + np.log1p(np.maximum(residuals - LARGE, 0.0)))
    return np.sum(residuals**2, axis=1) + prior, np.sum(np.where(residuals < LARGE, residuals**2, bent), axis=1) + prior


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--law", choices=("viscous", "coulomb"), default="viscous")
    parser.add_argument("--seconds", type=float, default=600.0, help="after which the search stops")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--members", type=int, default=128, help="of a generation")
    parser.add_argument("--draws", type=int, default=200, help="random generations, whose best members are the first")
    options = parser.parse_args()
    unknowns = 9 if options.law == "coulomb" else 8
    low, high, members = LOW[:unknowns], HIGH[:unknowns], options.members
    run = jax.jit(lambda numbers: times(numbers, options.law))
    start_time, generations = time.perf_counter(), 0

    def stop(intermediate_result) -> bool:
        nonlocal generations
        generations += 1
        if generations % 50 == 0:
            print(f"generation {generations}: {intermediate_result.fun:.1f}", flush=True)
        return time.perf_counter() - start_time > options.seconds

    random = np.random.default_rng(options.seed)
    draws = [random.uniform(low, high, (members, unknowns)) for _ in range(options.draws)]
    bent = np.concatenate([deviances(parameters.T, options.law, run)[1] for parameters in draws])
    first = np.concatenate(draws)[np.argsort(bent)[:members]]
    print(f"best of {bent.size} random sets: {bent.min():.1f}, {time.perf_counter() - start_time:.0f} s", flush=True)
    search = differential_evolution(
        lambda numbers: deviances(numbers, options.law, run)[1],
        list(zip(low, high, strict=True)),
        strategy="currenttobest1bin",
        init=first,
        mutation=(0.3, 0.9),
        recombination=0.85,
        maxiter=100_000,
        tol=0.0,
        polish=False,
        updating="deferred",
        vectorized=True,
        callback=stop,
        rng=random,
    )
    last = search.population.T
    exact, _ = deviances(last, options.law, run)
    errors = np.asarray(run(jnp.asarray(last)))
    order = np.argsort(exact)
    sets, seconds = members * (options.draws + generations), time.perf_counter() - start_time
    print(f"{options.law}: {sets} sets in {generations} generations, {seconds:.0f} s")
    for k in order[:6]:
        print(f"deviance {exact[k]:.1f}: " + ", ".join(f"{n} {v:.6g}" for n, v in zip(NAMES, last[:, k], strict=False)))
    print("times of the first [s]:", np.round(errors[order[0]], 1).tolist())


if __name__ == "__main__":
    main()
