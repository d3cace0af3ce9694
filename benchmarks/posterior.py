"""What draws from a posterior cost: friction, offset and I1 from ten times, and from one film, by BlackJAX and by NumPyro.

    python benchmarks/posterior.py times                      `nonholonomic.identification.sample`
    python benchmarks/posterior.py film
    python benchmarks/posterior.py times --numpyro            NumPyro's NUTS on the same density, with its own gradient
    python benchmarks/posterior.py times --numpyro --steered  and with the slopes of `sample`

The ten times are those of `examples/posterior.py`. The film has 250 frames, 50 in a second, of inclination and azimuth, the
clock's start and the azimuth of the launch unknown too. Printed are seconds of CPU and of the wall, compiling included, and the
effective draws of the worst unknown. Run it alone: with other work beside it believe the CPU seconds.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import machine

import tippe
from nonholonomic.identification import Draws, sample
from nonholonomic.identification.sampling import DISPERSED, Steered

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from posterior import I1, free_numbers, measured, scene

FRAMES, FPS, ERRORS = 250, 50.0, (0.02, 0.05)


def film() -> tuple[tippe.Recording, dict[str, Any]]:
    """The film, and what is free in it."""
    launch, clock = tippe.Launch(0.1, 120.0), np.arange(1, FRAMES + 1) / FPS
    run = tippe.simulate(scene(0.3, 0.0035), launch, clock[-1], clock)
    exact = np.stack([run.theta, run.azimuth], axis=1)
    value = exact + np.asarray(ERRORS) * np.random.default_rng(2).normal(size=exact.shape)
    free = {"data[0].t0": tippe.Free(0.0, prior=(0.0, 0.02)), "data[0].launch.azimuth": 0.0}
    return tippe.Recording(launch, clock, value, list(ERRORS), ("theta", "azimuth")), free_numbers() | free


def by_numpyro(density: Any, fit: Any, draws: int, steered: bool) -> Draws:
    """The same number of draws by NumPyro, in the same coordinates, from the same starts."""
    import blackjax
    from numpyro.infer import MCMC, NUTS

    one = Steered.of(density, jnp.asarray(fit.coordinates), jnp.linalg.cholesky(fit.coordinate_covariance))

    def potential(point: Any) -> Any:
        return -(one(point) if steered else density(one.at(point)))

    _, first = jax.random.split(jax.random.key(0))
    starts = DISPERSED * jax.random.normal(first, (4, len(one.centre)))
    chains = {"num_chains": 4, "chain_method": "vectorized", "progress_bar": False}
    run = MCMC(NUTS(potential_fn=potential, dense_mass=True), num_warmup=100, num_samples=draws, **chains)
    run.run(jax.random.key(1), init_params=starts, extra_fields=("num_steps", "diverging"))
    kept = np.asarray(one.at(run.get_samples(group_by_chain=True)))
    extra = run.get_extra_fields(group_by_chain=True)
    values = {name: np.asarray(value) for name, value in density.values(jnp.asarray(kept)).items()}
    found = [blackjax.diagnostics.potential_scale_reduction(kept), blackjax.diagnostics.effective_sample_size(kept)]
    named = [dict(zip(density.names, np.asarray(numbers).tolist(), strict=True)) for numbers in found]
    # Warming up is not counted by NumPyro.
    leaps = int(np.sum(np.max(np.asarray(extra["num_steps"]), axis=0)))
    return Draws(values, kept, *named, divergences=int(np.sum(extra["diverging"])), leaps=leaps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", choices=("times", "film"))
    parser.add_argument("--numpyro", action="store_true")
    parser.add_argument("--steered", action="store_true")
    parser.add_argument("--draws", type=int, default=250)
    parser.add_argument("--tolerance", type=float, default=1e-8)
    given = parser.parse_args()
    print(machine())
    data, free = film() if given.data == "film" else (measured(), free_numbers())
    start = scene(0.3, 0.0035)
    began, spent = time.perf_counter(), time.process_time()

    def clock(what: str) -> None:
        print(f"{what}: {time.process_time() - spent:.0f} s of CPU, {time.perf_counter() - began:.0f} s", flush=True)

    fit = tippe.identify(start, data, free, tolerance=given.tolerance, progress=False)
    clock("fit")
    density = tippe.log_density(start, data, free, tolerance=given.tolerance)
    if given.numpyro:
        found = by_numpyro(density, fit, given.draws, given.steered)
    else:
        found = sample(density, fit.coordinates, fit.coordinate_covariance, draws=given.draws, progress=False)
    clock("fit and draws")
    print(found)
    ratio = found.values["scene.body.I1"] / float(start.body.I3)
    print(f"I1 / I3 = {np.mean(ratio):.5f} +- {np.std(ratio):.5f}, of the data {I1 / float(start.body.I3):.5f}")
    print(f"worst: R-hat {max(found.r_hat.values()):.4f}, ESS {min(found.ess.values()):.0f}")


if __name__ == "__main__":
    main()
