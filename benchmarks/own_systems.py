"""Event times of users' own systems, compared with Diffrax and heyoka: ten bounces of a ball, and a Chaplygin sleigh.

`python benchmarks/own_systems.py` prints, for each system, program and tolerance, the CPU time of a run without compilation,
and the median and largest error of the times against a closed form or an independent reference. A second table compares the
derivative with respect to a number with the best central difference of a scan.
"""

import argparse
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from measure import machine, one_core, table, timed
from peers import available
from scipy.integrate import solve_ivp

import nonholonomic

GRAVITY, BOUNCES = 9.81, 10
MASS, INERTIA, ANGLE = 1.7, 0.4, 0.5


class Ball(nonholonomic.AbstractMode):
    """Height, velocity and number of bounces."""

    restitution: float = 0.8

    def field(self, t, y):
        return jnp.array([y[1], -GRAVITY, 0.0])

    def margin(self, t, y):
        return y[0]

    def reset(self, t, y):
        return jnp.array([0.0, -self.restitution * y[1], y[2] + 1.0]), 0


def tenth(t, y):
    """The tenth bounce."""
    return BOUNCES - 0.5 - y[2]


class Sleigh(nonholonomic.AbstractSystem):
    """Chaplygin's sleigh."""

    ahead: float = 0.3
    dimension = 3

    def metric(self, q):
        c, s, lever = jnp.cos(q[2]), jnp.sin(q[2]), MASS * self.ahead
        return jnp.array(
            [[MASS, 0.0, -lever * s], [0.0, MASS, lever * c], [-lever * s, lever * c, INERTIA + lever * self.ahead]]
        )

    def constraints(self, q):
        return jnp.array([[-jnp.sin(q[2]), jnp.cos(q[2]), 0.0]])


def turned(t, y):
    """The heading reaches an angle."""
    return ANGLE - y[2]


def ball_reference(heights: Any, restitution: float) -> Any:
    """The closed form of the tenth bounce."""
    speed = jnp.sqrt(2.0 * GRAVITY * heights)
    return speed / GRAVITY * (1.0 + 2.0 * sum(restitution**k for k in range(1, BOUNCES)))


def sleigh_field(t: Any, y: Any, ahead: Any) -> Any:
    """The sleigh's equations written by hand: heading, speed and heading rate."""
    _, speed, rate = y
    turning = INERTIA + MASS * ahead**2
    return rate, ahead * rate**2, -MASS * ahead * speed * rate / turning


def sleigh_reference(speeds: Any, ahead: float) -> Any:
    """By SciPy's DOP853 at its tightest, from the equations written by hand."""

    def event(t, y):
        return ANGLE - y[0]

    event.terminal = True

    def field(t, y):
        return sleigh_field(t, y, ahead)

    options = {"method": "DOP853", "events": event, "rtol": 2.3e-14, "atol": 1e-14}
    runs = [solve_ivp(field, (0, 5), [0.0, speed, 1.3], **options) for speed in np.asarray(speeds)]
    return np.array([run.t_events[0][0] for run in runs])


def ball_by_diffrax(tolerance: float) -> Callable[[Any, Any], Any]:
    """Diffrax as in its manual: solve to the event, reset, solve again, all mapped over the runs."""

    def time(height, restitution):
        def leg(carry, _):
            has_begun, y = carry
            solution = diffrax.diffeqsolve(
                diffrax.ODETerm(lambda t, y, args: jnp.array([y[1], -GRAVITY])),
                diffrax.Dopri8(),
                0.0,
                20.0,
                None,
                y,
                stepsize_controller=diffrax.PIDController(tolerance, 0.1 * tolerance),
                event=diffrax.Event(lambda t, y, args, **_: y[0], optimistix.Newton(1e-12, 1e-12), direction=False),
                throw=False,
                max_steps=4096,
            )
            end = solution.ys[-1]
            return (has_begun + solution.ts[-1], jnp.array([0.0, -restitution * end[1]])), None

        start = (jnp.zeros(()), jnp.array([height, 0.0]))
        return jax.lax.scan(leg, start, None, length=BOUNCES)[0][0]

    return jax.jit(jax.vmap(time, (0, None)))


def sleigh_by_diffrax(tolerance: float) -> Callable[[Any, Any], Any]:
    """Diffrax with an event, from the equations written by hand."""

    def time(speed, ahead):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(sleigh_field),
            diffrax.Dopri8(),
            0.0,
            5.0,
            None,
            (jnp.zeros(()), speed, jnp.asarray(1.3)),
            args=ahead,
            stepsize_controller=diffrax.PIDController(tolerance, 0.1 * tolerance),
            event=diffrax.Event(lambda t, y, args, **_: ANGLE - y[0], optimistix.Newton(1e-12, 1e-12)),
            throw=False,
            max_steps=4096,
        ).ts[-1]

    return jax.jit(jax.vmap(time, (0, None)))


def times_of(build: Callable[[float], Any], tolerance: float, starts: Any, number: float) -> Callable[[], Any]:
    """The times of all runs, by a program that is compiled once."""
    run = build(tolerance)
    return lambda: run(starts, number)


def ball_by_heyoka(tolerance: float) -> Callable[[Any, Any], Any]:
    """heyoka, one run after the other: each bounce is a terminal event with a callback that resets the velocity."""
    import heyoka

    height, speed = heyoka.make_vars("height", "speed")
    bounces, restitution = 0, 0.0

    def bounce(integrator: Any, sign: int) -> bool:
        nonlocal bounces
        bounces += 1
        integrator.state[1] *= -restitution
        return bounces < BOUNCES

    event = heyoka.t_event(height, callback=bounce, direction=heyoka.event_direction.negative)
    field = [(height, speed), (speed, heyoka.expression(-GRAVITY))]
    integrator = heyoka.taylor_adaptive(field, [1.0, 0.0], tol=tolerance, t_events=[event])

    def times(heights: Any, number: float) -> Any:
        nonlocal bounces, restitution
        restitution, event_times = number, np.empty(len(heights))
        for k, start in enumerate(heights):
            bounces, integrator.time = 0, 0.0
            integrator.state[:] = start, 0.0
            integrator.reset_cooldowns()
            integrator.propagate_until(20.0)
            event_times[k] = integrator.time
        return event_times

    return times


def sleigh_by_heyoka(tolerance: float) -> Callable[[Any, Any], Any]:
    """heyoka, one run after the other to a terminal event, from the equations written by hand."""
    import heyoka

    variables = heyoka.make_vars("heading", "speed", "rate")
    field = list(zip(variables, sleigh_field(None, variables, heyoka.par[0]), strict=True))
    event = heyoka.t_event(ANGLE - variables[0], direction=heyoka.event_direction.negative)
    integrator = heyoka.taylor_adaptive(field, [0.0, 1.0, 1.3], pars=[0.3], tol=tolerance, t_events=[event])

    def times(speeds: Any, ahead: float) -> Any:
        integrator.pars[0], event_times = ahead, np.empty(len(speeds))
        for k, speed in enumerate(speeds):
            integrator.time = 0.0
            integrator.state[:] = 0.0, speed, 1.3
            integrator.reset_cooldowns()
            integrator.propagate_until(5.0)
            event_times[k] = integrator.time
        return event_times

    return times


def rows_of(name: str, starts: Any, reference: Any, runs: dict[str, Callable[[float], Any]]) -> list[dict[str, str]]:
    """A row for each program and tolerance."""
    rows = []
    for program, run in runs.items():
        for tolerance in (1e-7, 1e-9, 1e-11):
            result = timed(run(tolerance))
            error = np.abs(np.asarray(result.result)[: len(reference)] - reference)
            rows.append(
                {
                    "system": name,
                    "program": program,
                    "tolerance": f"{tolerance:.0e}",
                    "us of CPU a run": f"{1e6 * result.cpu / len(starts):.2f}",
                    "median error [s]": f"{np.median(error):.1e}",
                    "largest error [s]": f"{np.max(error):.1e}",
                }
            )
    return rows


def derivative_row(name: str, time: Callable[[Any], Any], value: float, exact: float | None) -> dict[str, str]:
    """The derivative with respect to a number, and a central difference with the best step of a scan."""
    slope = float(eqx.filter_jit(jax.grad(time))(value))
    jitted = eqx.filter_jit(time)
    differences = [float((jitted(value + h) - jitted(value - h)) / (2 * h)) for h in 10.0 ** -np.arange(2.0, 8.0)]
    index = differences[int(np.argmin(np.abs(np.diff(differences))))]
    row = {"system": name, "derivative": f"{slope:.12f}", "scanned difference": f"{index:.12f}"}
    return row | {"error": f"{abs(slope - (index if exact is None else exact)):.1e}"}


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000, help="how many runs of each system")
    count = parser.parse_args().runs
    one_core()
    print(machine())
    heights, speeds = np.linspace(0.5, 2.0, count), np.linspace(0.2, 1.5, count)
    sleigh_starts = (np.zeros(3), np.array([1.0, 0.0, 1.3]))

    def table_of(system, start, t1, event, axes):
        def with_tolerance(tolerance: float) -> Callable[[], Any]:
            return lambda: (
                nonholonomic.sweep(system, start, t1, axes=axes, event=event, tolerance=tolerance, progress=False).time
            )

        return with_tolerance

    balls = {
        "nonholonomic.sweep": table_of(
            nonholonomic.Hybrid([Ball()]), [1.0, 0.0, 0.0], 20.0, tenth, {"start[0]": heights}
        ),
        "Diffrax, vmapped": lambda tolerance: times_of(ball_by_diffrax, tolerance, jnp.asarray(heights), 0.8),
    }
    if available("heyoka"):
        balls["heyoka, scalar"] = lambda tolerance: times_of(ball_by_heyoka, tolerance, heights, 0.8)
    rows = rows_of("ball", heights, np.asarray(ball_reference(heights, 0.8)), balls)
    sleighs = {
        "nonholonomic.sweep": table_of(Sleigh(), sleigh_starts, 5.0, turned, {"rate[0]": speeds}),
        "Diffrax, vmapped": lambda tolerance: times_of(sleigh_by_diffrax, tolerance, jnp.asarray(speeds), 0.3),
    }
    if available("heyoka"):
        sleighs["heyoka, scalar"] = lambda tolerance: times_of(sleigh_by_heyoka, tolerance, speeds, 0.3)
    rows += rows_of("sleigh", speeds, sleigh_reference(speeds[:64], 0.3), sleighs)
    print(table(rows))

    def bounced(restitution):
        return nonholonomic.event_time(nonholonomic.Hybrid([Ball(restitution)]), [1.0, 0.0, 0.0], 20.0, event=tenth)

    def turning(ahead):
        return nonholonomic.event_time(Sleigh(ahead), sleigh_starts, 5.0, event=turned, tolerance=1e-12)

    exact = float(jax.grad(lambda restitution: ball_reference(1.0, restitution))(0.8))
    print(table([derivative_row("ball", bounced, 0.8, exact), derivative_row("sleigh", turning, 0.3, None)]))


if __name__ == "__main__":
    main()
