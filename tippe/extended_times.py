"""Inversion times that a fit can follow beyond its horizon, with their derivatives along several directions at once."""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic.derivatives import VariationalProblem, in_groups
from nonholonomic.integration import CROSSED, FAILED, Queue, Settings, crossing_time
from nonholonomic.validation import as_number

from .inversion import InversionProblem, check_smooth
from .launch import Launch
from .scene import Scene
from .state import inclination, parts

#: A cell that needs more steps than this has failed: parameters tried by a fit may be far off.
MOST_STEPS = 100_000

#: The least angle [rad] distinguished from 0 in the penalty for a top that does not invert.
LEAST_ANGLE = 1e-6

#: From this many cells on it pays to compile for twice as long a program that runs in a third of the time.
MANY = 64


def extended_inversion_times(
    scene: Scene,
    launch: Launch,
    t1: Float[Array, ""],
    angle: Float[Array, ""],
    tolerance: float,
    lanes: int,
) -> Float[Array, " lanes"]:
    """Inversion times, continued beyond the horizon so that a fit finds a way back.

    A top that has not inverted by `t1`, or has lost contact, and is then at theta counts as inverting at
    t1 (1 + log(angle / theta) / C), C = log(angle / theta at the launch), 1 at least. Where theta grows as exp(s t), as it
    does from small angles, this is the tangent to the time C / s, taken at the rate s that arrives exactly at `t1`: continuous
    with its slope where a time passes the horizon, and linear in the rate beyond. It is a penalty, not a prediction. First
    derivatives, forward mode, are those of the event's time (implicit function theorem) and of the penalty.

    **Arguments:**

    - `scene`, `launch`: every number a scalar or (lanes,).
    - `t1`, `angle`, `tolerance`: as for `inversion_time`.
    - `lanes`: how many lanes.

    **Returns:** (lanes,) [s]; NaN where the integration failed.

    **Raises:** `ValueError` for a scene with `contact="hybrid"` or `SetValuedCoulomb`.
    """
    check_smooth(scene, "extended_inversion_times")
    leaves, structure = jax.tree.flatten(InversionProblem.of(scene, launch, angle, lanes))
    return _differentiable(structure, as_number(t1), as_number(tolerance))(*leaves)


def _differentiable(structure: Any, t1: Float[Array, ""], tolerance: Float[Array, ""]) -> Callable[..., Array]:
    """The extended times as a function of a problem's parameters; directions that `jax.vmap` stacks are integrated together."""

    def run(leaves: tuple[Array, ...], moving: list[list[Array | None]]) -> tuple[Array, Array]:
        directions = tuple(jax.tree.unflatten(structure, one) for one in moving)
        return _times_and_slopes(jax.tree.unflatten(structure, leaves), directions, t1, tolerance)

    @jax.custom_batching.custom_vmap
    def along(leaves, moving):
        times, slopes = run(leaves, [moving])
        return times, slopes[0]

    @along.def_vmap
    def along_several(size, batched, leaves, moving):
        if any(batched[0]):
            axes = jax.tree.map(lambda is_batched: 0 if is_batched else None, batched)
            results = jax.vmap(lambda *given: run(given[0], [given[1]]), axes)(leaves, moving)
            return (results[0], results[1][:, 0]), (True, True)

        def direction(k):
            return jax.tree.map(lambda tangent, is_batched: tangent[k] if is_batched else tangent, moving, batched[1])

        def together(some):
            times, slopes = run(leaves, some)
            return times, list(slopes)

        times, slopes = in_groups(together, tuple(direction(k) for k in range(size)))
        return (times, jnp.stack(slopes)), (False, True)

    @jax.custom_jvp
    def times(*leaves):
        return run(leaves, [])[0]

    @functools.partial(times.defjvp, symbolic_zeros=True)
    def variation(leaves, tangents):
        zero = jax.custom_derivatives.SymbolicZero
        return along(leaves, [None if isinstance(tangent, zero) else tangent for tangent in tangents])

    return times


def _times_and_slopes(
    problem: InversionProblem, directions: tuple[Any, ...], t1: Float[Array, ""], tolerance: Float[Array, ""]
) -> tuple[Float[Array, " cells"], Float[Array, "directions cells"]]:
    """The extended times of every cell, and their derivatives along directions (as of `VariationalProblem`)."""
    cells = problem.states.shape[1]
    varied = VariationalProblem(problem, directions, True)
    outcome, _ = Queue.of(
        varied,
        t1,
        jnp.asarray(cells),
        Settings(tolerance, max_steps=MOST_STEPS),
        one_kernel=cells >= MANY,
        parts=1 + len(directions),
    ).outcome()
    state, *variations = varied.parts(outcome.state)
    crossed = outcome.status == CROSSED

    def extended(problem: InversionProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        # A cell that starts beyond the angle has reached it at once.
        time = jnp.where(outcome.end_time > 0.0, crossing_time(problem, outcome.end_time, state), 0.0)
        angle = jnp.arccos(problem.cos_angle)
        missing = _e_folds(state, angle)
        whole = jnp.maximum(_e_folds(problem.states, angle), 1.0)
        return jnp.where(crossed, time, t1 * (1.0 + missing / whole))

    failed = outcome.status == FAILED
    times = jnp.where(failed, jnp.nan, extended(problem, state))
    slopes = [
        jnp.where(failed, 0.0, eqx.filter_jvp(extended, (problem, state), moved)[1])
        for moved in zip(directions, variations, strict=True)
    ]
    return times, jnp.stack(slopes) if slopes else jnp.zeros((0, cells))


def _e_folds(state: Float[Array, "components cells"], angle: Float[Array, "..."]) -> Float[Array, " cells"]:
    """How many times theta must still grow e-fold to reach an angle."""
    theta = inclination(parts(state).axis)
    return jnp.log(angle / jnp.clip(theta, LEAST_ANGLE, angle))
