"""Simulate one run of a user's system."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..derivatives import sampled_run
from ..hybrid import AbstractBatchedMode, hybrid_samples
from ..integration import Settings, explicit_tableau
from ..integration.checks import legal_run, require_times
from ..integration.status import FAILED
from ..progress import status_line
from ..validation import as_known, as_number, is_traced, nan_unless
from .engine import Cells, ModeProblem
from .mode import Hybrid
from .system import Run, System, check_run, run_of
from .trajectory import Trajectory

#: Default number of times to report.
DEFAULT_TIMES = 201


@status_line("simulating")
def simulate(
    system: System,
    start: Any,
    t1: Float[ArrayLike, ""],
    times: Float[ArrayLike, " times"] | None = None,
    tolerance: Float[ArrayLike, ""] = 1e-9,
    solver: diffrax.AbstractERK | None = None,
) -> Trajectory:
    """Simulate one run of a system to `t1`; works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and their compositions.

    A run continues through all resets and through the system's event. Derivatives use the saltation matrix at resets.

    **Arguments:**

    - `system`, `start`, `tolerance`, `solver`: as for `event_time`.
    - `t1`: end of the run [s], positive.
    - `times`: times [s] to report, increasing, within [0, t1]; by default 201 equally spaced ones.

    **Returns:** a `Trajectory`; its `status` states how the run ended.

    **Raises:** `ValueError` for arguments out of range, times that do not increase, functions that return a wrong type
    or shape, and second derivatives through resets.

    **Example:** a pendulum as an `AbstractSystem`.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Pendulum(nonholonomic.AbstractSystem):
    ...     length: float
    ...     dimension = 1
    ...
    ...     def metric(self, q):
    ...         return jnp.array([[self.length**2]])
    ...
    ...     def potential(self, q):
    ...         return -9.81 * self.length * jnp.cos(q[0])
    >>> run = nonholonomic.simulate(Pendulum(length=1.0), ([0.1], [0.0]), t1=2.0, times=[1.0, 2.0])
    >>> print(f"{run.status}, {run.state[-1, 0]:.6f} rad, {run.state[-1, 1]:.6f} rad/s")
    completed, 0.099974 rad, 0.007169 rad/s

    ```
    """
    check_run(system, start, t1, tolerance)
    end = as_known(t1)
    if times is None:
        times = jnp.linspace(0.0, end, DEFAULT_TIMES) if is_traced(end) else np.linspace(0.0, end, DEFAULT_TIMES)
    require_times(times, t1)
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    if isinstance(system, Hybrid):
        system = dataclasses.replace(system, event=None)
    run = run_of(system, start, None)
    return _sampled(run, as_number(times), as_number(t1), settings)


@eqx.filter_jit
def _sampled(
    run: Run,
    times: Float[Array, " times"],
    t1: Float[Array, ""],
    settings: Settings,
) -> Trajectory:
    """The run, or NaN and "failed" if a traced number is out of range."""
    cells = run.cells
    is_legal, horizon, tolerance = legal_run(True, t1, settings.tolerance, times)
    settings, legal_times = settings.with_tolerance(tolerance), jnp.where(is_legal, times, 0.0)
    if cells.form.traits.smooth:
        samples = sampled_run(_problem, cells, legal_times, horizon, settings)
        states, is_reached = samples.states, jnp.all(jnp.isfinite(samples.states), axis=1)
        mode, switches = jnp.where(is_reached, cells.form.first, -1), jnp.zeros(())
        status, steps = samples.status, samples.accepted + samples.rejected
    else:
        samples = hybrid_samples(_modes, cells, legal_times, horizon, settings, 1)
        states, mode, switches = (
            samples.shown.T,
            jnp.where(jnp.isnan(samples.number), -1, samples.number),
            samples.counts[0],
        )
        status, steps = samples.status, samples.steps
    states = jax.vmap(run.shown)(nan_unless(is_legal, states))
    return Trajectory(
        t=times,
        state=states,
        mode=mode.astype(int),
        end_time=nan_unless(is_legal, samples.end_time),
        switches=switches.astype(int),
        steps=steps.astype(int),
        rejected=samples.rejected.astype(int),
        code=jnp.where(is_legal, status, FAILED).astype(int),
        names=run.names,
    )


def _problem(cells: Cells, count: int | None) -> ModeProblem:
    return cells.problem(count)


def _modes(
    cells: Cells, tolerance: Array, count: int
) -> tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"], Float[Array, "components cells"]]:
    """The modes of some runs, the index of each first mode, and the starts."""
    return cells.modes(count)
