"""Derivatives of the event times of many cells along tangents of a problem.

Up to `MOST_FORWARD` tangents are integrated forward, as variations beside the run (`variation.py`); for more tangents,
each run takes one backward pass (`_adjoint.py`).
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from ..compilation.xla_cpu import compiled_alone
from ..integration import AbstractProblem, Lanes, LaneState, Outcome, Settings, States
from ..integration.ensemble import with_crossing_times
from ..integration.problem import time_at_jump
from ..integration.scheduler import LaneScheduler
from ..integration.status import CROSSED, REACHED_END
from ._adjoint import solve_with_adjoint
from .variation import VariationalProblem, in_groups, slopes_by_variations

#: Up to this many tangents are integrated forward, in pairs. The cost relative to a table without derivatives, at a
#: tolerance of 1e-8, for 2, 3, 4 and 6 parameters, is on the plane 3.4, 6.4, 6.3, 9.6 forward and 5.0, 5.7, 5.6, 5.5
#: backward, in a cylinder 3.6, 7.6, 7.6, 11 forward and 5.6, 6.8, 6.8, 7.6 backward (jax 0.10).
MOST_FORWARD = 2


def ensemble_solve_with_tangents(
    problem: AbstractProblem,
    tangents: tuple[Any, ...],
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    settings: Settings,
    *,
    nonterminal: bool = False,
    one_kernel: bool = False,
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell, and differentiate the time of its event along tangents.

    `solve_ensemble_with_tangents` is compiled on its own, for use outside of other transformed functions;
    `traced_solve_ensemble_with_tangents` is for use inside them.

    **Arguments:** as for `solve_ensemble`, and

    - `tangents`: tangents of the problem, as for `VariationalProblem`. Their variations, or a mixture of the
      variations, take part in step-size control.
    - `one_kernel`: as for `solve_ensemble`. If it is false, all tangents are integrated forward, whatever their number,
      so that the result can be differentiated again.

    **Returns:** the `Outcome`, and for each tangent the derivative of `crossing_time`, 0 where that is infinite.
    Source: implicit function theorem at the event; step lengths are held fixed.

    **Example:** half-lives, and their derivatives with respect to the rates.

    >>> from nonholonomic.derivatives import solve_ensemble_with_tangents
    >>> problem, tangents = Decays(jnp.array([1.0, 2.0])), (Decays(jnp.ones(2)),)
    >>> outcome, slopes = solve_ensemble_with_tangents(problem, tangents, t1, jnp.asarray(2), settings)
    >>> print(outcome.crossing_time.round(6), slopes[0].round(6))
    [0.693147 0.346574] [-0.693147 -0.173287]
    """
    horizon = t1
    if nonterminal:
        scheduler = LaneScheduler.of(problem, t1, cells, settings, nonterminal=True, one_kernel=one_kernel)
        outcome = scheduler.outcome()[0]
        # The derivatives need the run only up to the event, whose time is now known.
        horizon = jnp.where(jnp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0)
    options = (not nonterminal, horizon, cells, settings)

    def with_group(group: tuple[Any, ...]) -> tuple[Outcome, list[Float[Array, " cells"]]]:
        return slopes_by_variations(problem, group, *options, one_kernel=one_kernel)

    if one_kernel and problem.fits_one_kernel and len(tangents) > MOST_FORWARD:
        ended, slopes = _slopes_by_adjoint(problem, tangents, *options)
    else:
        ended, slopes = in_groups(with_group, tangents)
    if not nonterminal:
        outcome = with_crossing_times(problem, ended)
    # An event at the start has a fixed time, whatever the tangent.
    has_delay = jnp.isfinite(outcome.crossing_time) & (ended.end_time > 0.0)
    # With its variations a run takes other steps: where it does not reach the event, it has no derivative.
    arrived = ended.status == (REACHED_END if nonterminal else CROSSED)
    return outcome, [jnp.where(has_delay, jnp.where(arrived, slope, jnp.nan), 0.0) for slope in slopes]


def _slopes_by_adjoint(
    problem: AbstractProblem, tangents: tuple[Any, ...], ends_on_event: bool, *options: Any
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """The result of `slopes_by_variations`, at a cost that does not depend on the number of tangents."""
    moving = moving_leaves(problem, tangents[0], _field_and_event)
    # Without tangents, a `VariationalProblem` is the problem itself, with the option not to end on its event.
    ended, by_start, by_number = solve_with_adjoint(
        VariationalProblem(problem, (), ends_on_event),
        VariationalProblem(moving, (), ends_on_event),
        _mixed(tangents),
        *options,
        measured=_event_time,
        one_kernel=True,
    )

    def slope(direction: Any) -> Float[Array, " cells"]:
        start = eqx.filter_jvp(lambda problem: problem.start()[0], (problem,), (direction,))[1]
        rates = eqx.filter(direction, moving)
        shares = [
            jnp.sum((gradient * rate).reshape(-1, by_start.shape[1]), axis=0)
            for gradient, rate in zip(jax.tree.leaves(by_number), jax.tree.leaves(rates), strict=True)
        ]
        return sum(shares, jnp.zeros(by_start.shape[1]) if start is None else jnp.sum(by_start * start, axis=0))

    return ended, [slope(direction) for direction in tangents]


def _mixed(tangents: tuple[Any, ...]) -> Any:
    """A mixture of some tangents."""
    shares = shares_of(len(tangents)).tolist()
    return jax.tree.map(lambda *rates: sum(c * rate for c, rate in zip(shares, rates, strict=True)), *tangents)


def shares_of(count: int) -> Float[np.ndarray, " count"]:
    """Shares for a mixture of some tangents that are unlikely to cancel. The mixture is about as large as each tangent, so
    that steps are as short as for one tangent.
    """
    return (0.5 + np.modf(0.618 * np.arange(count))[0]) / count


def _event_time(variational: VariationalProblem, lane_state: LaneState) -> Float[Array, " lanes"]:
    """Zero of the event function for lanes that have ended on the event."""
    problem = variational.problem
    return time_of_zero(problem, problem.event_function, lane_state.time, lane_state.state)


def time_of_zero(problem: AbstractProblem, function: Callable[[Any], Any], time: Lanes, state: States) -> Lanes:
    """The time at which a function of the state vanishes, for a state at the zero (implicit function theorem).

    First order, unlike `event_time`: the event is located to 1e-10 of a step, and its time is not differentiated again.
    """
    fall = stop_gradient(jax.jvp(function, (stop_gradient(state),), (problem.field(time, state),))[1])
    return time_at_jump(problem, time, state, time - function(state) / jnp.where(fall == 0.0, 1.0, fall))


def _field_and_event(problem: AbstractProblem, states: States) -> Any:
    zero = jnp.zeros_like(states[0])
    return problem.field(zero, states), problem.event_function(states), problem.jumps(zero, states)


def moving_leaves(problem: AbstractProblem, direction: Any, functions: Callable[[AbstractProblem, States], Any]) -> Any:
    """The leaves that a tangent moves, as far as some functions of problem and states depend on them, as a tree of
    booleans."""
    arrays, static = eqx.partition(problem, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)

    def values(*leaves: Any) -> Any:
        return functions(eqx.combine(jax.tree.unflatten(structure, leaves), static), problem.start()[0])

    closed = jax.make_jaxpr(values)(*leaves)
    dependencies = set(closed.jaxpr.outvars)
    for equation in reversed(closed.jaxpr.eqns):
        if not dependencies.isdisjoint(equation.outvars):
            dependencies |= {variable for variable in equation.invars if not isinstance(variable, Literal)}
    is_dependency = jax.tree.unflatten(structure, [variable in dependencies for variable in closed.jaxpr.invars])
    return jax.tree.map(
        lambda rate, is_used: bool(is_used) and rate is not None,
        direction,
        is_dependency,
        is_leaf=lambda rate: rate is None,
    )


# With its docstring.
_in_one_kernel = functools.partial(ensemble_solve_with_tangents, one_kernel=True)
solve_ensemble_with_tangents = compiled_alone(functools.update_wrapper(_in_one_kernel, ensemble_solve_with_tangents))

traced_solve_ensemble_with_tangents = eqx.filter_jit(ensemble_solve_with_tangents)


def tangents_of(
    build: Callable[..., Any], numbers: tuple[Any, ...], tangents: list[tuple[Any, ...]]
) -> tuple[Any, ...]:
    """The tangents of a problem that is built from numbers.

    **Arguments:**

    - `build`: numbers -> problem.
    - `numbers`: the arguments of `build`, arrays.
    - `tangents`: each with the rates at which the numbers move.

    **Returns:** for each tangent the tangent of the problem, `None` for leaves that depend on no number.

    **Example:**

    >>> from nonholonomic.derivatives import tangents_of
    >>> tangents = tangents_of(Decays, (jnp.ones(2),), [(jnp.array([1.0, 0.0]),)])
    >>> print(tangents[0].rate)
    [1. 0.]
    """

    def built(*numbers: Any) -> Any:
        # A problem may also hold functions.
        return eqx.filter(build(*numbers), eqx.is_inexact_array)

    dependents = _reached(jax.make_jaxpr(built)(*numbers))
    structure = jax.tree.structure(jax.eval_shape(built, *numbers))
    moving = jax.tree.unflatten(structure, dependents)
    changes = [jax.jvp(built, numbers, tangent)[1] for tangent in tangents]
    return tuple(eqx.filter(change, moving) for change in changes)


def _reached(closed: Any) -> list[bool]:
    """Which outputs of a traced function depend on an input."""
    depends = set(closed.jaxpr.invars)
    for equation in closed.jaxpr.eqns:
        if any(not isinstance(variable, Literal) and variable in depends for variable in equation.invars):
            depends |= set(equation.outvars)
    return [not isinstance(variable, Literal) and variable in depends for variable in closed.jaxpr.outvars]
