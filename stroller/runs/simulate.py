"""One ride: with its steps outside of transformations, and sampled inside."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.integration import ImplicitMidpoint, Settings
from nonholonomic.integration.checks import require_adaptive, require_adjoint, require_times
from nonholonomic.runs import evenly_spaced, sampled_if_legal
from nonholonomic.validation import as_known, is_traced, nan_unless, require_whole

from .steps import RideSpec, followed, stats_of
from .trajectory import Trajectory, read_off, read_off_compiled

#: Default limit of the steps of a ride.
DEFAULT_STEPS = 65536


def ride(
    model: Any,
    t1: Any,
    times: Any,
    tolerance: Any,
    solver: diffrax.AbstractSolver | None,
    max_steps: int,
    adjoint: diffrax.AbstractAdjoint | None,
) -> Trajectory:
    """The trajectory of a `RideModel`. **Arguments:** as for `stroller.simulate`; the model was checked."""
    if not isinstance(solver, ImplicitMidpoint):
        require_adaptive(solver, ", or an ImplicitMidpoint")
    require_whole(max_steps, "max_steps", 1)
    require_adjoint(adjoint)
    end, grid = as_known(t1), None
    times = evenly_spaced(end) if times is None else as_known(times)
    require_times(times, t1)
    if isinstance(solver, ImplicitMidpoint):
        jumps = model.problem(None, ()).jump_times
        known = jumps is not None and not is_traced((jumps, times, end))
        inside = [time for time in np.asarray(jumps) if 0.0 < time < end] if known else []
        grid = even_steps(jnp.asarray(np.union1d(times, inside)) if inside else times, end, solver.step_length)
        max_steps = grid.size
    settings = Settings(tolerance, solver, max_steps=max_steps)
    # Inside a transformation, this traces all numbers, even if they are known.
    spec = RideSpec.of(model, jnp.add(end, 0.0), settings, grid)
    inside = is_traced((spec, times))
    # Steps of other implicit solvers cannot be repeated cheaply, so they end on the times.
    if inside or not isinstance(settings.for_steps_alone, diffrax.AbstractERK | ImplicitMidpoint):
        return _sampled(spec, times, adjoint if inside else None)
    steps, stats = followed(spec)
    return dataclasses.replace(read_off_compiled(spec, times, steps.at(spec, np.asarray(times)), stats), steps=steps)


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _sampled(spec: RideSpec, times: Float[Array, " times"], adjoint: diffrax.AbstractAdjoint | None) -> Trajectory:
    """The run at `times`; NaN and `finished` false if a traced number is out of range."""
    model, t1, settings, grid = spec.parts
    is_legal, samples, _ = sampled_if_legal(model, times, t1, settings, grid, adjoint)
    run = read_off(spec, times, samples.rows, stats_of(samples.outcome))
    stats = run.stats._replace(finished=run.stats.finished & is_legal)
    return eqx.tree_at(lambda trajectory: (trajectory.t, trajectory.stats), nan_unless(is_legal, run), (times, stats))


def even_steps(
    times: Float[Array, " times"], t1: Float[Array, ""], max_duration: Float[Array, ""]
) -> Float[Array, " steps"]:
    """Times from 0 to `t1`, at most `max_duration` apart, that include all `times` and are evenly spaced between them.

    **Raises:** `ValueError` if an argument is traced, because the number of steps is part of the program.
    """
    for name, number in {"t1": t1, "times": times, "step_length": max_duration}.items():
        if is_traced(number):
            raise ValueError(
                f"{name} is traced and must be known for ImplicitMidpoint, whose steps have a given length"
            )
    knots = np.union1d(np.asarray(times), [0.0, float(t1)])
    counts = np.ceil(np.diff(knots) / float(max_duration) * (1.0 - 1e-12)).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots, knots[1:], counts, strict=False)]
    return jnp.asarray(np.concatenate([*pieces, knots[-1:]]))
