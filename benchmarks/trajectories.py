"""Cost and error of sampled trajectories in batches, compared with a table of times and with vmapped Diffrax.

    python benchmarks/trajectories.py [--launches 512] [--samples 1001] [--quick]

The reference problem: Rutstam's top on the plane, viscous friction, 100 rad/s, theta(0) from 0.05 to 0.15, 10 s at a
relative tolerance of 1e-9. Cost is CPU time per launch on one core, the least of several runs, without the first call,
which compiles:

* `inversion_table` of last crossings, whose runs all continue to the same horizon: the cost without samples;
* `trajectory_table` with theta and eta, and with the position, which needs the path of the run;
* `vmap(simulate)` under `jit`, without and with the compiler's option for wide vectors, which tables use, but which
  only the outermost `jit` accepts;
* `vmap(diffeqsolve)` with `SaveAt(ts)`, Dopri8 and the same field, which interpolates its samples;
* the samples of theta together with their derivative by mu, in forward and reverse mode.

Error is the greatest difference of theta, over launches and samples, from the same program at a tolerance of 1e-13.
Errors grow while a top rises and shrink when it stands, so the error of the end state without samples is listed, too.
Run the script alone: other work on the machine changes every number.
"""

import argparse
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from measure import machine, one_core, table, timed

import tippe
from nonholonomic.compilation.xla_cpu import compiled_alone
from nonholonomic.integration.problem import ABSOLUTE

HORIZON, TOLERANCE, TIGHT, SPIN, MU = 10.0, 1e-9, 1e-13, 100.0, 0.3


def scene(mu: Any = MU) -> tippe.Scene:
    """Rutstam's top on the plane."""
    mass, radius = 0.02, 0.02
    top = tippe.Top(mass, radius, 0.3 * radius, 131.0 / 350.0 * mass * radius**2, 0.4 * mass * radius**2)
    return tippe.Scene(top, friction=tippe.Viscous(mu))


def simulated(thetas: Any, times: Any, mu: Any = MU) -> Any:
    """theta at every sample of every launch, by `vmap(simulate)`."""
    run = lambda theta: tippe.simulate(scene(mu), tippe.Launch(theta, SPIN), HORIZON, times, TOLERANCE).theta  # noqa: E731
    return jax.vmap(run)(thetas)


def by_diffrax(thetas: Any, times: Any) -> Any:
    """theta at every sample of every launch, by a plain `vmap(diffeqsolve)` with this package's field."""
    top = scene()
    dynamics = top.turning_dynamics

    def sampled_theta(theta: Any) -> Any:
        launch = tippe.Launch(theta, SPIN)
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda time, state, _: dynamics.field(state)),
            diffrax.Dopri8(),
            0.0,
            HORIZON,
            None,
            top.state(launch),
            saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=diffrax.PIDController(TOLERANCE, ABSOLUTE * TOLERANCE * top.scales(launch)),
            max_steps=100_000,
        )
        return jax.vmap(top.theta)(solution.ys)

    return jax.vmap(sampled_theta)(thetas)


def tabled(thetas: Any, times: Any, tolerance: float = TOLERANCE, **options: Any) -> tippe.Table:
    """The same launches by `trajectory_table`."""
    return tippe.trajectory_table(
        scene(), theta=np.asarray(thetas), spin=SPIN, times=times, tolerance=tolerance, **options
    )


def main() -> None:
    """Measure and print."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--launches", type=int, default=512)
    command.add_argument("--samples", type=int, default=1001)
    command.add_argument("--quick", action="store_true", help="without Diffrax and derivatives")
    options = command.parse_args()
    one_core()
    print(machine())
    launches, thetas, times = options.launches, np.linspace(0.05, 0.15, options.launches), None
    times = np.linspace(0.0, HORIZON, options.samples)
    inputs = (jnp.asarray(thetas), jnp.asarray(times))
    mu_value, one = jnp.asarray(MU), jnp.ones((launches, options.samples))

    def forward(mu: Any) -> Any:
        return jax.jvp(lambda mu: simulated(*inputs, mu), (mu,), (jnp.ones(()),))

    def reverse(mu: Any) -> Any:
        samples, pullback = jax.vjp(lambda mu: simulated(*inputs, mu), mu)
        return samples, pullback(one)

    refine, wide_program, obvious_program = jax.jit(simulated), compiled_alone(simulated), jax.jit(by_diffrax)
    along, back_through = jax.jit(forward), jax.jit(reverse)
    ways: dict[str, tuple[Callable[[], Any], int]] = {
        "inversion_table": (
            lambda: tippe.inversion_table(scene(), theta=thetas, spin=SPIN, t1=HORIZON, crossing="last").end_time,
            5,
        ),
        "trajectory_table": (lambda: tabled(thetas, times).theta, 5),
        "trajectory_table, position": (lambda: tabled(thetas, times, quantities=("position",)).position, 3),
        "jit(vmap(simulate))": (lambda: refine(*inputs), 3),
        "vmap(simulate), wide vectors": (lambda: wide_program(*inputs), 3),
    }
    if not options.quick:
        ways |= {
            "vmap(diffeqsolve)": (lambda: obvious_program(*inputs), 1),
            "samples and forward derivative": (lambda: along(mu_value), 2),
            "samples and reverse derivative": (lambda: back_through(mu_value), 2),
        }
    rows, theta = [], {}
    for name, (run, runs) in ways.items():
        measured = timed(run, runs)
        theta[name] = measured.result
        cost = measured.cpu / launches * 1e3
        first = rows[0]["cpu ms per launch"] if rows else cost
        rows.append(
            {"way": name, "cpu ms per launch": cost, "first call [s]": measured.first, "table = 1": cost / float(first)}
        )
        print(rows[-1], flush=True)
    print(
        table([{key: mu_value if key == "way" else f"{mu_value:.3g}" for key, mu_value in row.items()} for row in rows])
    )
    reference = tabled(thetas, times, TIGHT).theta
    max_row = 0
    print("error of theta against tolerance 1e-13: the way, the greatest over the samples, at the end")
    for name, angles in theta.items():
        if not isinstance(angles, tuple) and angles.shape == reference.shape:
            errors = np.max(np.abs(np.asarray(angles) - reference), axis=0)
            max_row = int(errors.argmax()) if name == "trajectory_table" else max_row
            print(f"  {name}: {errors.max():.1e} (at {times[errors.argmax()]:.2f} s), {errors[-1]:.1e}")
    sampled = np.max(np.abs(theta["trajectory_table"] - reference), axis=0)
    print("error of a sample, and of the end state of runs without samples to the same time")
    for place in sorted({max_row, *np.linspace(0, options.samples - 1, 6).astype(int)[1:]}):
        ends = tippe.inversion_table(
            scene(), theta=thetas, spin=SPIN, t1=float(times[place]), crossing="last"
        ).end_theta
        print(f"  {times[place]:5.2f} s: {sampled[place]:.1e}, {np.max(np.abs(ends - reference[:, place])):.1e}")


if __name__ == "__main__":
    main()
