"""Cost of draws from a posterior of friction, offset and I1, from ten times or from a film, by several samplers.

    python benchmarks/posterior.py times                      `nonholonomic.identification.sample`
    python benchmarks/posterior.py film
    python benchmarks/posterior.py times --plain blackjax     NUTS on the density itself, with its own gradient, by BlackJAX
    python benchmarks/posterior.py times --plain numpyro      and by NumPyro

The ten times are those of `examples/posterior.py`. The film has 250 frames of inclination and azimuth at 50 frames per
second; the clock's start and the azimuth of the launch are also unknown. The plain samplers use the coordinates in
which `sample` found the posterior to be nearly round, and the starts of `sample`. The script prints CPU and wall time
[s], including compilation, and the effective draws of the worst unknown. If other work runs on the machine, only the
CPU time is meaningful.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from measure import machine
from plain_nuts import BY, plain

import tippe
from nonholonomic.identification import sample

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from posterior import I1, free_numbers, measured, scene

FRAMES, FPS, ERRORS = 250, 50.0, (0.02, 0.05)


def film() -> tuple[tippe.Recording, dict[str, Any]]:
    """The film, and its unknowns."""
    launch, clock = tippe.Launch(0.1, 120.0), np.arange(1, FRAMES + 1) / FPS
    run = tippe.simulate(scene(0.3, 0.0035), launch, clock[-1], clock)
    exact = np.stack([run.theta, run.azimuth], axis=1)
    value = exact + np.asarray(ERRORS) * np.random.default_rng(2).normal(size=exact.shape)
    free = {"data[0].t0": tippe.Free(0.0, prior=(0.0, 0.02)), "data[0].launch.azimuth": 0.0}
    return tippe.Recording(launch, clock, value, list(ERRORS), ("theta", "azimuth")), free_numbers() | free


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", choices=("times", "film"))
    parser.add_argument("--plain", choices=BY)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--warmup", type=int, default=25)
    parser.add_argument("--tolerance", type=float, default=1e-8)
    arguments = parser.parse_args()
    print(machine())
    data, free = film() if arguments.data == "film" else (measured(), free_numbers())
    start = scene(0.3, 0.0035)
    start_time, cpu_start = time.perf_counter(), time.process_time()

    def clock(label: str) -> None:
        print(
            f"{label}: {time.process_time() - cpu_start:.0f} s of CPU, {time.perf_counter() - start_time:.0f} s",
            flush=True,
        )

    fit = tippe.identify(start, data, free, tolerance=arguments.tolerance, progress=False)
    clock("fit")
    density = tippe.log_density(start, data, free, tolerance=arguments.tolerance)
    if arguments.plain:
        posterior, leaps = plain(arguments.plain, density, fit, arguments.warmup, arguments.draws)
        print(f"{leaps / posterior.coordinates.shape[0] / arguments.draws:.1f} leaps a draw")
    else:
        options = {"warmup": arguments.warmup, "draws": arguments.draws, "progress": False}
        posterior = sample(density, fit.coordinates, fit.coordinate_covariance, **options)
    clock("fit and draws")
    print(posterior)
    ratio = posterior.values["scene.body.I1"] / float(start.body.I3)
    print(f"I1 / I3 = {np.mean(ratio):.5f} +- {np.std(ratio):.5f}, of the data {I1 / float(start.body.I3):.5f}")
    print(f"worst: R-hat {max(posterior.r_hat.values()):.4f}, ESS {min(posterior.ess.values()):.0f}")


if __name__ == "__main__":
    main()
