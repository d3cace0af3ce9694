"""One explicit Runge-Kutta step of many lanes, from a Diffrax solver's tableau."""

import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..xla_cpu import written_by_component, written_in_place

Lanes = Float[Array, " lanes"]
States = Float[Array, "components lanes"]
Stages = Float[Array, "stages components lanes"]


class Step(NamedTuple):
    """A step that was tried: where it leads, the rate there, its error estimate and what was seen on the way."""

    state: States
    rate: States
    error: States
    watched: Lanes
    first_negative: Lanes


def explicit_tableau(solver: diffrax.AbstractSolver) -> diffrax.ButcherTableau:
    """The tableau of an explicit, embedded Runge-Kutta solver of Diffrax.

    **Raises:** `ValueError` for any other solver.
    """
    tableau = getattr(solver, "tableau", None)
    if not isinstance(solver, diffrax.AbstractERK) or not isinstance(tableau, diffrax.ButcherTableau):
        raise ValueError(f"solver = {solver!r} must be an explicit Runge-Kutta solver of Diffrax, such as Dopri8()")
    return tableau


def explicit_step(
    tableau: diffrax.ButcherTableau,
    field: Callable[[Lanes, States], States],
    domain_margin: Callable[[Lanes, States], Lanes | None],
    crossing: Callable[[States, States], Lanes | None],
    time: Lanes,
    state: States,
    rate: States,
    length: Lanes,
) -> Step:
    """Try one step in every lane.

    The stages are done in a loop, so that the field is compiled twice and not once a stage. In one kernel that runs as fast as
    stages that are written out, and compiles in half the time.

    **Arguments:**

    - `tableau`: the method.
    - `field`: (time [s], state) -> rate of the state.
    - `domain_margin`, `crossing`: (time, state) and (state, rate) -> a number per lane that should stay positive, or
      `None`. They are looked at in the end and at three stages between: the domain margin, which may need all of the state,
      in a branch of those stages; the crossing, which may need few components, after the stages. If one is negative for less
      than two fifths of a step, that may go unnoticed.
    - `time`, `state`, `rate`: where the step starts, and the field there.
    - `length`: length of the step [s], one per lane.

    **Returns:** a `Step`. `watched` is the lesser number at the end; `first_negative` the fraction of the step of the first
    stage at which one was negative, 2 if none was.
    """
    # The last stage of a method whose steps end with a stage is the end of the step, below.
    inner = len(tableau.c) - 1 if tableau.fsal else len(tableau.c)
    looks = places_to_look(tableau.c)
    places, looked = jnp.asarray(tableau.c[:inner]), jnp.asarray(np.isin(np.arange(inner), list(looks)))

    def do(stage: Int[Array, ""], carry: tuple[Stages, Lanes]) -> tuple[Stages, Lanes]:
        rates, first_negative = carry
        there = moved_state(stage, tableau.a_lower[:inner], state, length, rates)
        at = time + places[stage] * length

        def look(first_negative: Lanes) -> Lanes:
            return jnp.minimum(first_negative, _where_negative(domain_margin(at, there), places[stage], length))

        # A branch, for the other stages not to pay for it: a tenth of a step of a top in a cylinder.
        first_negative = jax.lax.cond(looked[stage], look, lambda first_negative: first_negative, first_negative)
        return written_by_component(rates, field(at, there), at=stage + 1), first_negative

    none = jnp.zeros((1 + inner, *rate.shape), rate.dtype)
    start = written_in_place(none, rate, at=jnp.zeros((), int)), jnp.full_like(length, 2.0)
    rates, first_negative = over_stages(inner, do, start)
    stages = list(jnp.unstack(rates))
    for stage in looks:
        there = state + length * weighted_sum(tableau.a_lower[stage], stages[: stage + 1])
        negative = _where_negative(crossing(there, stages[stage + 1]), tableau.c[stage], length)
        first_negative = jnp.minimum(first_negative, negative)
    # Stored, for the step, its error and the event all depend on it.
    end = jax.lax.optimization_barrier(state + length * weighted_sum(tableau.b_sol[: 1 + inner], stages))
    last_rate = jax.lax.optimization_barrier(field(time + length, end))
    watched = jax.lax.optimization_barrier(lesser(domain_margin(time + length, end), crossing(end, last_rate), length))
    stages += [last_rate] if tableau.fsal else []
    return Step(end, last_rate, length * weighted_sum(tableau.b_error, stages), watched, first_negative)


def lesser(domain_margin: Lanes | None, crossing: Lanes | None, like: Lanes) -> Lanes:
    """The lesser of two numbers per lane, of which each may be `None`; 1 if both are."""
    if domain_margin is None:
        return jnp.ones_like(like) if crossing is None else crossing
    return domain_margin if crossing is None else jnp.minimum(crossing, domain_margin)


def _where_negative(watched: Lanes | None, place: Any, like: Lanes) -> Lanes:
    """A place in the step in the lanes in which the number there is negative, 2 in the others."""
    never = jnp.full_like(like, 2.0)
    return never if watched is None else jnp.where(watched < 0.0, place, never)


def over_stages(stages: int, do: Callable[[Int[Array, ""], Any], Any], start: Any) -> Any:
    """What is carried on when something is done in every stage, in a loop; on an accelerator, which would wait for the host at
    every branch, one after the other."""
    return jax.lax.fori_loop(0, stages, do, start, unroll=jax.default_backend() != "cpu")


def places_to_look(fractions: Float[np.ndarray, " stages"]) -> set[int]:
    """The stages nearest to 1/4, 1/2 and 3/4 of the step: the places at which its inside is checked."""
    between = [stage for stage, fraction in enumerate(fractions) if 0.0 < fraction < 1.0]
    return {min(between, key=lambda stage: abs(fractions[stage] - part)) for part in (0.25, 0.5, 0.75) if between}


def weighted_sum(weights: Float[np.ndarray, " stages"], rates: Sequence[States]) -> States:
    """Sum of the rates with the given weights, leaving out those of weight 0."""
    total = None
    for weight, rate in zip(weights, rates, strict=True):
        if weight != 0.0:
            term = float(weight) * rate
            total = term if total is None else total + term
    return jnp.zeros_like(rates[0]) if total is None else total


def moved_state(
    stage: Int[Array, ""], rows: Sequence[Float[np.ndarray, " before"]], state: States, length: Lanes, rates: Stages
) -> States:
    """The state moved along the first of the rates, with the weights in the row of a stage.

    Every row is a branch of its own: the weights are then constants, of which many are 0.
    """

    def moved(row: Float[np.ndarray, " before"]) -> Callable[[Stages], States]:
        return lambda rates: state + length * weighted_sum(row, [rates[k] for k in range(len(row))])

    return jax.lax.switch(stage, [moved(row) for row in rows], rates)


def scaled_error(error: States, before: States, after: States, rtol: float, atol: States, parts: int) -> Lanes:
    """Error in units of the tolerance: of the parts of the state, the greatest root mean square (Diffrax's norm and scale).

    The squares are added one by one: XLA compiles a sum over an axis of more than eight components lane by lane, which took
    half of the time of a run with twelve.
    """
    ratio = error / (atol + rtol * jnp.maximum(jnp.abs(before), jnp.abs(after)))
    squares, size = [one * one for one in ratio], ratio.shape[0] // parts
    means = [functools.reduce(operator.add, squares[k * size : (k + 1) * size]) / size for k in range(parts)]
    return jnp.sqrt(functools.reduce(jnp.maximum, means))


def inverse_root(value: Lanes, order: int) -> Lanes:
    """`value**(-1/order)`; square roots alone where the order is a power of 2, because `pow` costs twenty of them."""
    if order & (order - 1) == 0:
        while order > 1:
            value, order = jnp.sqrt(value), order // 2
        return 1.0 / value
    return value ** (-1.0 / order)


def first_length(
    field: Callable[[Lanes, States], States],
    time: Lanes,
    state: States,
    rate: States,
    order: int,
    rtol: float,
    atol: States,
    parts: int,
) -> Lanes:
    """Length of the first step [s] (Hairer, Norsett and Wanner, Solving ODEs I, section II.4), in the motion's own unit.

    Their formula compares |y'| with |y''|, which depends on the unit of time; Diffrax uses seconds. Here the unit is |y|/|y'|,
    so that motions that differ only in scale are integrated alike. If the state has several `parts`, the first one counts.
    """
    scale = atol + jnp.abs(state) * rtol
    size = state.shape[0] // parts

    def measure(vector: States) -> Lanes:
        return jnp.sqrt(jnp.mean((vector / scale)[:size] ** 2, axis=0))

    magnitude, slope = measure(state), measure(rate)
    unit = magnitude / slope
    # A state at rest has no unit of its own; longer units would overflow below.
    still = (magnitude < 1e-5) | ~(unit < 1e15)
    unit = jnp.where(still, 1e-4, unit)
    trial = 0.01 * unit
    bend = measure(field(time + trial, state + trial * rate) - rate) / trial
    steepest = unit * jnp.maximum(slope, unit * bend)
    fraction = jnp.where(steepest <= 1e-15, 0.01, inverse_root(jnp.maximum(steepest, 1e-15) * 100.0, order))
    return unit * jnp.minimum(1.0, fraction)
