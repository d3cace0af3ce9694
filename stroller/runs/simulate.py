"""Simulate a ride."""

import dataclasses
import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from nonholonomic.integration import ImplicitMidpoint, Settings
from nonholonomic.integration.checks import legal_run, require_times
from nonholonomic.progress import status_line
from nonholonomic.validation import as_known, is_traced, nan_unless

from ..model.input import Input
from ..model.launch import Launch
from ..model.scene import Scene
from .checks import check_options, check_run
from .ride import Ride, RideSpec, as_module, traced_ride
from .steps import followed
from .trajectory import Trajectory, read_off, read_off_compiled

#: Default number of times to report.
DEFAULT_TIMES = 201


@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: Float[ArrayLike, ""],
    input: Input | None = None,
    times: Float[ArrayLike, " times"] | None = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    max_steps: int = 65536,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory:
    """Simulate a ride from a launch until `t1`.

    **Arguments:**

    - `scene`: a `Scene`.
    - `launch`: a `Launch`.
    - `t1`: end of the run [s], positive.
    - `input`: a function `(t, motion) -> (drive force [N], steering torque [N m])` (see `input.py`), or `None`.
    - `times`: times [s] to report, increasing, within [0, t1]; by default 201 equally spaced ones.
    - `tolerance`: relative tolerance of an adaptive solver, in [1e-14, 1e-2]; the absolute tolerance is a tenth of it,
      in units of the scene's magnitudes.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations, or an `ImplicitMidpoint`; by default
      `diffrax.Dopri8()`; inside transformations without `adjoint`, if all numbers of scene and launch are scalars,
      `nonholonomic.integration.Oscillatory8()`.
    - `max_steps`: a run that needs more steps fails; at least 1.
    - `adjoint`: an adjoint method of Diffrax, such as `RecursiveCheckpointAdjoint()`, with which Diffrax
      differentiates. By default, this package computes forward and reverse derivatives; the gradient of a loss function
      costs about five runs, whatever the number of parameters, which may be arrays, such as the weights of an input.

    **Returns:** a `Trajectory`; its `status` states how the run ended.

    **Raises:** `ValueError` for arguments out of range, lists in place of numbers, an illegal launch, times that do not
    increase, a solver without an error estimate, and an input that is not a function, cannot be traced, or is not
    finite at the start.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> run = stroller.simulate(scene, launch, 1.0, stroller.Steady(1.0, 0.1), times=[0.5, 1.0], tolerance=1e-6)
    >>> print(f"{run.speed[-1]:.3f} m/s, {run.heading[-1]:.3f} rad, {run.status}")
    1.472 m/s, 0.980 rad, completed

    ```
    """
    check_run(scene, launch, t1, input, tolerance)
    check_options(solver, max_steps, adjoint)
    end, grid = as_known(t1), None
    times = _evenly_spaced(end) if times is None else as_known(times)
    require_times(times, t1)
    if isinstance(solver, ImplicitMidpoint):
        grid = even_steps(times, end, solver.step_length)
        max_steps = grid.size
    settings = Settings(tolerance, solver, max_steps=max_steps)
    # Inside a transformation, this traces all numbers, even if they are known.
    ride = Ride(scene, launch, as_module(input, scene, launch), jnp.add(end, 0.0), settings, grid)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((ride, times))):
        return _legal_or_nan(ride, times, adjoint)
    return _concrete(ride, times)


def _concrete(ride: Ride, times: Float[Array, " times"]) -> Trajectory:
    """The run of concrete numbers."""
    spec = RideSpec.of(ride)
    if not isinstance(ride.settings.for_steps_alone, diffrax.AbstractERK | ImplicitMidpoint):
        return read_off_compiled(spec, times, *_sampled(ride, times))
    steps, stats = followed(spec)
    return dataclasses.replace(read_off_compiled(spec, times, steps.at(spec, np.asarray(times)), stats), steps=steps)


# Steps of other implicit solvers cannot be repeated cheaply, so they end on the times.
_sampled = eqx.filter_jit(functools.partial(traced_ride, adjoint=None))


# Compiled as a whole even under a bare `vmap` or `grad`, which would otherwise dispatch each operation.
@eqx.filter_jit
def _legal_or_nan(ride: Ride, times: Float[Array, " times"], adjoint: diffrax.AbstractAdjoint | None) -> Trajectory:
    """The run, or NaN and `finished` false if a traced number is out of range."""
    may_start = ride.scene.may_start(ride.launch, ride.input)
    is_legal, t1, tolerance = legal_run(may_start, ride.t1, ride.settings.tolerance, times)
    legal_ride, run_times = ride._replace(settings=ride.settings.with_tolerance(tolerance)), times
    if ride.grid is None:
        legal_ride, run_times = legal_ride._replace(t1=t1), jnp.where(is_legal, times, 0.0)
    if adjoint is not None:
        # A run with illegal numbers never begins, but Diffrax would differentiate it.
        legal_ride = legal_ride._replace(
            **nan_unless(is_legal, {"scene": ride.scene, "launch": ride.launch, "input": ride.input})
        )
    run = read_off(RideSpec.of(ride), run_times, *traced_ride(legal_ride, run_times, adjoint))
    stats = run.stats._replace(finished=run.stats.finished & is_legal)
    return eqx.tree_at(lambda trajectory: (trajectory.t, trajectory.stats), nan_unless(is_legal, run), (times, stats))


def _evenly_spaced(t1: Float[Array, ""]) -> Float[Array, " times"]:
    """The default times of output; known inside a transformation if `t1` is known."""
    return jnp.linspace(0.0, t1, DEFAULT_TIMES) if is_traced(t1) else as_known(np.linspace(0.0, t1, DEFAULT_TIMES))


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
