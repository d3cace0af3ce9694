"""States inside a step: a continuous extension of a pair of orders 8 and 7.

The extension needs no more stages. The stages, together with the second derivatives of the state at both ends of the
step, determine the state in the middle to seventh order (`AbstractTunedPair.middle`); the extension is the polynomial of
degree 7 with the states and rates at both ends and in the middle, and with the second derivatives at the ends. It costs
one derivative and one evaluation of the field per step, a sixth of a step.
"""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from .problem import AbstractProblem
from .runge_kutta import Lanes, States, weighted_sum

#: A function of the places in a step, as fractions of the step, that returns the states there.
StatesInside = Callable[[Lanes], States]


class StepEnd(NamedTuple):
    """One end of a step: time [s], state, and the first and second derivatives of the state."""

    time: Lanes
    state: States
    rate: States
    second: States


def second_derivative(problem: AbstractProblem, length: Lanes, time: Lanes, state: States, rate: States) -> States:
    """The second derivative of the state: the derivative of the field along the motion.

    Where this derivative is not finite, as for the norm of a zero velocity, it is a difference quotient over a small part
    of the step of the given length [s].
    """
    along_motion = jax.linearize(problem.field, time, state)[1]
    second = jax.lax.optimization_barrier(along_motion(jnp.ones_like(time), rate))

    def with_quotient() -> States:
        # With this delay, the errors by curvature and by round-off are about equal.
        delay = jnp.sqrt(jnp.finfo(state.dtype).eps) * length
        quotient = (problem.field(time + delay, state + delay * rate) - rate) / delay
        return jnp.where(jnp.isfinite(second), second, quotient)

    # The components are added one by one, for all lanes at once, as in `scaled_error`.
    total = jnp.sum(functools.reduce(operator.add, second))
    return jax.lax.cond(jnp.isfinite(total), lambda: second, with_quotient)


def continuous_extension(
    middle_weights: Sequence[float],
    problem: AbstractProblem,
    start: StepEnd,
    end: StepEnd,
    length: Lanes,
    rates: Sequence[States],
) -> StatesInside:
    """The states inside a step.

    **Arguments:** `middle_weights`: those of the pair (`AbstractTunedPair.middle`); `start`, `end`: the ends of the step;
    `length`: its length [s]; `rates`: the field at its stages.
    """
    seconds = weighted_sum(middle_weights[len(rates) :], (start.second, end.second))
    middle = start.state + length * (weighted_sum(middle_weights[: len(rates)], rates) + length * seconds)
    middle = jax.lax.optimization_barrier(middle)
    middle_rate = jax.lax.optimization_barrier(problem.field(start.time + 0.5 * length, middle))

    vectors = (start.state, start.rate, start.second, end.state, end.rate, end.second, middle, middle_rate)

    def states_inside(place: Lanes) -> States:
        # Behind a barrier; otherwise the compiler would compute the weights again for every component.
        factors = jax.lax.optimization_barrier(jnp.stack(hermite_factors(place, length)))
        return functools.reduce(operator.add, map(operator.mul, factors, vectors))

    return states_inside


def hermite_factors(place: Lanes, length: Lanes) -> tuple[Lanes, ...]:
    """The factors of value, slope and second derivative at the start and at the end of a step, and of value and slope in the
    middle, in the polynomial of degree 7 that matches all of them.

    **Arguments:** `place`: where to evaluate the polynomial, as a fraction of the step; `length`: length of the step [s].
    """
    left, from_middle = 1.0 - place, place - 0.5

    def of_end(near: Lanes, far: Lanes, length: Lanes) -> tuple[Lanes, ...]:
        # Vanishes triply at the other end, and doubly in the middle; the series of 1 / vanishing is 1 + 7 near + 30 near^2.
        vanishing, delay = far**3 * (2.0 * from_middle) ** 2, near * length
        slope = 1.0 + 7.0 * near
        return vanishing * (slope + 30.0 * near**2), vanishing * delay * slope, vanishing * 0.5 * delay**2

    of_middle = (4.0 * place * left) ** 3
    return *of_end(place, left, length), *of_end(left, place, -length), of_middle, of_middle * from_middle * length
