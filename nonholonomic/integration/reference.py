"""The outcome of every cell by vmapped `diffrax.diffeqsolve`: slow, and independent of the ensemble solver."""

import functools
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix
from jaxtyping import Array, Float

from .dense import saved
from .problem import AbstractProblem
from .scheduler import Outcome
from .settings import MOST_STEPS, Settings
from .status import CROSSED, FAILED, LEFT_DOMAIN, REACHED_END


@eqx.filter_jit
def solve_by_diffrax(problem: AbstractProblem, t1: Float[Array, ""], settings: Settings) -> Outcome:
    """Run every cell from t = 0 to its event, to the end of the model's validity, or to `t1`.

    The domain margin is checked at the ends of steps, so a short loss can be missed; events are located on Diffrax's
    dense output.

    **Arguments:** as for `solve_ensemble`, but any solver of Diffrax works.

    **Returns:** the `Outcome`.

    **Example:**

    >>> from nonholonomic.integration import solve_by_diffrax
    >>> print(solve_by_diffrax(problem, jnp.asarray(5.0), settings).crossing_time.round(6))
    [0.693147 0.346574 0.173287]
    """
    (states, scales), rtol = problem.start(), settings.tolerance
    lane_axes = jax.tree.map(lambda leaf: None if jnp.ndim(leaf) == 0 else -1, problem)

    def solve_cell(cell_problem: AbstractProblem, state: Array, scale: Array) -> Outcome:
        conditions: dict[int, Any] = {}
        if problem.event_function(states) is not None:
            conditions[CROSSED] = lambda t, y, args, **_: args.event_function(y)
        if problem.domain_margin(states[0], states) is not None:
            conditions[LEFT_DOMAIN] = lambda t, y, args, **_: args.domain_margin(t, y)
        # Diffrax detects only changes of a condition's sign, so a cell that starts with a negative condition must end
        # at once.
        at_once = [condition(jnp.zeros(()), state, cell_problem) <= 0.0 for condition in conditions.values()]
        ends_at_once = functools.reduce(jnp.logical_or, at_once, jnp.asarray(False))
        event = diffrax.Event(list(conditions.values()), root_finder=optimistix.Newton(1e-13, 1e-13))
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, args: args.field(t, y)),
            settings.for_single_runs,
            0.0,
            jnp.where(ends_at_once, 0.0, t1),
            None,
            state,
            args=cell_problem,
            stepsize_controller=diffrax.PIDController(rtol, settings.absolute * rtol * scale),
            max_steps=min(settings.max_steps, MOST_STEPS),
            event=event if conditions else None,
            throw=False,
        )
        ends, finals = saved(solution)
        end, final = ends[0], finals[0]
        status = jnp.where(end >= t1, REACHED_END, FAILED)
        for code, occurred, at_start in zip(conditions, solution.event_mask or [], at_once, strict=True):
            status = jnp.where(occurred | at_start, code, status)
        crossing_time = jnp.where(status == CROSSED, end, jnp.inf)
        steps, rejected = solution.stats["num_steps"], solution.stats["num_rejected_steps"]
        return Outcome(status, crossing_time, crossing_time, end, final, steps, rejected)

    axes = Outcome._make((0, 0, 0, 0, -1, 0, 0))
    return jax.vmap(solve_cell, in_axes=(lane_axes, -1, -1), out_axes=axes)(problem, states, scales)
