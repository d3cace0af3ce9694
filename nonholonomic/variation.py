"""First derivatives of event times: the variations of the state run along with it.

A problem and its variations are one problem with a longer state, so that they run through the same loop as the problem
alone; differentiating the loop as a whole costs several times as much.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import Literal
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from .adjoint import march_with_gradient
from .ensemble import alone, lanes_for, with_crossing_times
from .lockstep import AbstractProblem, Block, crossing_time
from .queue import Outcome, Queue

#: Directions that run along together: more of them cost less time in all, but more to compile.
TOGETHER = 2


def lanes_along(cells: int, directions: int) -> int:
    """How many cells should advance together with their variations in some directions: the whole state fits the caches."""
    together = 0 < directions <= TOGETHER
    return max(8, 3 * lanes_for(cells) // (2 + 2 * directions)) if together else lanes_for(cells)


class VariationalProblem(AbstractProblem):
    """A problem and its first variation in each of some directions, the variations stacked behind the state.

    A direction is a tangent of the problem: the same tree, with the rate at which each number moves, `None` where none of
    the directions moves it.
    """

    problem: AbstractProblem
    directions: tuple[Any, ...]
    ends_on_event: bool = eqx.field(static=True)

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        states, scales = self.problem.start()

        def variation(direction: Any) -> Float[Array, "components cells"]:
            moved = eqx.filter_jvp(lambda problem: problem.start()[0], (self.problem,), (direction,))[1]
            return jnp.zeros_like(states) if moved is None else moved

        variations = [variation(direction) for direction in self.directions]
        return jnp.concatenate([states, *variations]), jnp.concatenate([scales] * (1 + len(variations)))

    def field(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        at, *variations = self.parts(state)
        if not variations:
            return self.problem.field(time, at)
        moving = _where_moved(self.problem, self.directions[0])

        def rate(moving: Any, at: Float[Array, "components lanes"]) -> Float[Array, "components lanes"]:
            return eqx.combine(moving, self.problem).field(time, at)

        # Linearised once: the rate is computed once, and the directions share what their changes have in common.
        here, change = jax.linearize(rate, moving, at)
        return jnp.concatenate([here, *(change(*moved) for moved in zip(self.directions, variations, strict=True))])

    def crossing(self, state: Float[Array, "components lanes"]) -> Float[Array, " lanes"] | None:
        return self.problem.crossing(self.parts(state)[0]) if self.ends_on_event else None

    def guard(self, time: Float[Array, " lanes"], state: Float[Array, "components lanes"]) -> Any:
        return self.problem.guard(time, self.parts(state)[0])

    def parts(self, state: Float[Array, "components ..."]) -> list[Float[Array, "components ..."]]:
        """The state and its variations."""
        return jnp.split(state, 1 + len(self.directions)) if self.directions else [state]


def march_with_slopes(
    problem: AbstractProblem,
    directions: tuple[Any, ...],
    t1: Float[Array, "..."],
    cells: Int[Array, ""],
    rtol: Float[Array, ""],
    atol: Float[Array, ""],
    *,
    solver: diffrax.AbstractERK,
    lanes: int,
    passes: bool = False,
    one_kernel: bool = False,
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell, and differentiate the time of its event in some directions.

    **Arguments:** as for `ensemble.march`, and

    - `directions`: tangents of the problem, as for `VariationalProblem`.

    **Returns:** the `Outcome`, and for each direction the derivative of `crossing_time`, 0 where that is infinite. Source:
    implicit function theorem at the event; step lengths are held fixed.
    """
    options = {"solver": solver, "lanes": lanes, "one_kernel": one_kernel}
    horizon = t1
    if passes:
        outcome = Queue.of(problem, t1, cells, rtol, atol, passes=True, **options).outcome()[0]
        # The slopes need the run up to the event alone, whose time is known by now.
        horizon = jnp.where(jnp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0)
    along = _slopes_by_adjoint if len(directions) > TOGETHER else _slopes_by_variations
    there, slopes = along(problem, directions, not passes, horizon, cells, rtol, atol, **options)
    if not passes:
        outcome = with_crossing_times(problem, there)
    # At the very start the event is there at once, whatever moves.
    happened = jnp.isfinite(outcome.crossing_time) & (there.end_time > 0.0)
    return outcome, [jnp.where(happened, slope, 0.0) for slope in slopes]


def _slopes_by_variations(
    problem: AbstractProblem, directions: tuple[Any, ...], ends_on_event: bool, *given: Any, **options: Any
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """Run every cell with its variations, and let them move the event at its end; what is `given` is as for `Queue.of`."""
    varied = VariationalProblem(problem, directions, ends_on_event)
    there, _ = Queue.of(varied, *given, controlled=problem.start()[0].shape[0], **options).outcome()
    state, *variations = varied.parts(there.state)

    def event_time(problem: AbstractProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
        return crossing_time(problem, there.end_time, state)

    slopes = [
        eqx.filter_jvp(event_time, (problem, state), moved)[1] for moved in zip(directions, variations, strict=True)
    ]
    return there._replace(state=state), slopes


def _slopes_by_adjoint(
    problem: AbstractProblem, directions: tuple[Any, ...], ends_on_event: bool, *given: Any, **options: Any
) -> tuple[Outcome, list[Float[Array, " cells"]]]:
    """The same by taking every run back, at a cost that does not depend on the number of directions."""
    moving = _moving(problem, directions[0])
    there, by_start, by_number = march_with_gradient(
        VariationalProblem(problem, (), ends_on_event),
        VariationalProblem(moving, (), ends_on_event),
        *given,
        measured=_event_time,
        **options,
    )

    def slope(direction: Any) -> Float[Array, " cells"]:
        start = eqx.filter_jvp(lambda problem: problem.start()[0], (problem,), (direction,))[1]
        rates = eqx.filter(direction, moving)
        shares = [
            gradient * rate
            for gradient, rate in zip(jax.tree.leaves(by_number), jax.tree.leaves(rates), strict=True)
        ]
        return sum(shares, jnp.zeros(by_start.shape[1]) if start is None else jnp.sum(by_start * start, axis=0))

    return there, [slope(direction) for direction in directions]


def _event_time(varied: VariationalProblem, block: Block) -> Float[Array, " lanes"]:
    """When the crossing function vanishes, for a block that has ended on the event, to first order (implicit function theorem)."""
    crossing, rate = varied.problem.crossing, varied.problem.field(block.time, block.state)
    fall = stop_gradient(jax.jvp(crossing, (stop_gradient(block.state),), (rate,))[1])
    return block.time - crossing(block.state) / jnp.where(fall == 0.0, 1.0, fall)


def _moving(problem: AbstractProblem, direction: Any) -> Any:
    """Which numbers of a problem a direction moves, of those that its field or its event depends on."""
    leaves, structure = jax.tree.flatten(problem)
    states = problem.start()[0]

    def seen(*leaves: Any) -> Any:
        one = jax.tree.unflatten(structure, leaves)
        return one.field(jnp.zeros_like(states[0]), states), one.crossing(states)

    closed = jax.make_jaxpr(seen)(*leaves)
    needed = set(closed.jaxpr.outvars)
    for equation in reversed(closed.jaxpr.eqns):
        if not needed.isdisjoint(equation.outvars):
            needed |= {variable for variable in equation.invars if not isinstance(variable, Literal)}
    used = jax.tree.unflatten(structure, [variable in needed for variable in closed.jaxpr.invars])
    return jax.tree.map(lambda rate, one: one and rate is not None, direction, used, is_leaf=lambda rate: rate is None)


def in_groups(run: Callable[..., tuple[Any, list[Any]]], directions: tuple[Any, ...]) -> tuple[Any, list[Any]]:
    """What `run` finds along many directions, a few at a time by one program.

    **Arguments:**

    - `run`: a tuple of `TOGETHER` directions -> a result that does not depend on them, and a slope for each.
    - `directions`: any number of them.

    **Returns:** the result, and the slopes.
    """
    if len(directions) <= TOGETHER:
        return run(directions)
    # The last group is filled with directions that lead nowhere.
    empty = -len(directions) % TOGETHER
    padded = [*directions, *[jax.tree.map(jnp.zeros_like, directions[0])] * empty]
    stacked = [jax.tree.map(lambda *rates: jnp.stack(rates), *padded[k::TOGETHER]) for k in range(TOGETHER)]
    results, slopes = jax.lax.map(lambda group: run(tuple(group)), stacked)
    each = [slopes[i % TOGETHER][i // TOGETHER] for i in range(len(directions))]
    return jax.tree.map(lambda leaf: leaf[0], results), each


#: `march_with_slopes`, compiled on its own, for use outside of other transformed functions.
compiled_march_with_slopes = alone(eqx.Partial(march_with_slopes, one_kernel=True))


def _where_moved(problem: Any, direction: Any) -> Any:
    """The numbers of a problem that a direction moves, `None` for the others."""

    def moved(rate: Any, number: Any) -> Any:
        return None if rate is None else number

    return jax.tree.map(moved, direction, problem, is_leaf=lambda rate: rate is None)


def directions_of(
    build: Callable[..., AbstractProblem], numbers: tuple[Any, ...], tangents: list[tuple[Any, ...]]
) -> tuple[Any, ...]:
    """The tangents of a problem that is built from numbers.

    **Arguments:**

    - `build`: numbers -> problem.
    - `numbers`: what it is built from, arrays.
    - `tangents`: for each direction the rate at which each number moves.

    **Returns:** for each direction the tangent of the problem, `None` for what depends on no number.
    """
    reached = _reached(jax.make_jaxpr(build)(*numbers))
    structure = jax.tree.structure(jax.eval_shape(build, *numbers))
    moving = jax.tree.unflatten(structure, reached)
    found = [jax.jvp(build, numbers, tangent)[1] for tangent in tangents]
    return tuple(eqx.filter(one, moving) for one in found)


def _reached(closed: Any) -> list[bool]:
    """Which outputs of a traced function depend on an input."""
    depends = set(closed.jaxpr.invars)
    for equation in closed.jaxpr.eqns:
        if any(not isinstance(variable, Literal) and variable in depends for variable in equation.invars):
            depends |= set(equation.outvars)
    return [not isinstance(variable, Literal) and variable in depends for variable in closed.jaxpr.outvars]
