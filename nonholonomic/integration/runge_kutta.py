"""One explicit Runge-Kutta step of many lanes, from a Diffrax solver's tableau."""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..compilation.xla_cpu import written_by_component, written_in_place
from ..text import shown

Lanes = Float[Array, "*lanes"]
States = Float[Array, "components *lanes"]
Stages = Float[Array, "stages components *lanes"]


class Step(NamedTuple):
    """The result of a trial step.

    - `state`, `rate`: the state at the end, and the field there; `error`: the estimated error.
    - `margin`: the least of the margins and the event function at the end.
    - `first_negative`: time of the first stage at which a margin or the event function was negative, as a fraction of
      the step; 2 if there was none.
    - `margins`: all margins at `watched_places` of the step; `None` if there are none.
    - `rates`: the field at all stages; `middle`: the state in the middle of the step, to fifth order.
    - `stages`: the field at the inner stages (`inner_stages`) in one array, whose memory the next step reuses.
    """

    state: States
    rate: States
    error: States
    margin: Lanes
    first_negative: Lanes
    margins: Float[Array, "places margins *lanes"] | None
    rates: Sequence[States]
    middle: States
    stages: Stages | None


def explicit_tableau(solver: diffrax.AbstractSolver) -> diffrax.ButcherTableau:
    """The tableau of an explicit, embedded Runge-Kutta solver of Diffrax.

    **Raises:** `ValueError` for any other solver.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration import explicit_tableau
    >>> explicit_tableau(diffrax.Dopri8()).num_stages
    14
    """
    tableau = getattr(solver, "tableau", None)
    if not isinstance(solver, diffrax.AbstractERK) or not isinstance(tableau, diffrax.ButcherTableau):
        raise ValueError(
            f"solver = {shown(solver)} must be an explicit Runge-Kutta solver of Diffrax, such as Dopri8()"
        )
    return tableau


def explicit_order(solver: diffrax.AbstractSolver) -> int:
    """The order of an explicit Runge-Kutta solver.

    **Raises:** `ValueError` for a solver that does not declare its order.
    """
    order = solver.order(None)
    if order is None:
        raise ValueError(f"solver = {shown(solver)} must have an order, as Dopri8() has")
    return order


def explicit_step(
    tableau: diffrax.ButcherTableau,
    field: Callable[[Lanes, States], States],
    margins: Callable[[Lanes, States], tuple[Lanes, ...]],
    crossing: Callable[[States, States], Lanes | None],
    time: Lanes,
    state: States,
    rate: States,
    length: Lanes,
    margins_before: Float[Array, "margins *lanes"] | None,
    stages: Stages,
    looks: Sequence[int],
) -> Step:
    """Try one step in every lane.

    The stages are computed in a loop, so that the field is compiled twice and not once per stage. In one kernel the
    loop runs as fast as unrolled stages, and compiles in half the time.

    **Arguments:**

    - `tableau`: the method.
    - `field`: (time [s], state) -> rate of the state.
    - `margins`, `crossing`: a function of (time, state) that returns the margins, and a function of (state, rate) that
      returns the event function; either may be `None`. Their values, one per lane, should stay positive. Both are
      evaluated at the end of the step and at the stages `looks`. The margins, which may need the whole state, are
      evaluated during these stages. The event function, which may need few components, is evaluated after all stages.
    - `time`, `state`, `rate`: time and state at the start of the step, and the field there.
    - `length`: length of the step [s], one per lane.
    - `margins_before`: the margins at the start; `None` if there are none.
    - `stages`: memory for the inner stages (`memory_for_stages`), whose numbers do not matter. A loop over steps passes it
      on from step to step: clearing new memory would take a tenth of the time of a step.

    **Returns:** a `Step`.
    """
    inner = inner_stages(tableau)
    places, is_look = jnp.asarray(tableau.c[:inner]), jnp.asarray(np.isin(np.arange(inner), looks))
    rows = jnp.asarray(np.searchsorted(looks, np.arange(inner)) + 1)

    def do(stage: Int[Array, ""], carry: tuple[Stages, Any]) -> tuple[Stages, Any]:
        stages, history = carry
        trial = moved_state(stage, tableau.a_lower[:inner], state, length, stages, first=rate)
        stage_time = time + places[stage] * length

        def look(history: Float[Array, "places margins *lanes"]) -> Float[Array, "places margins *lanes"]:
            return written_in_place(history, jnp.stack(margins(stage_time, trial)), at=rows[stage])

        # A branch, because margins in every stage would add a tenth to the cost of a step of a top in a cylinder.
        history = None if history is None else jax.lax.cond(is_look[stage], look, lambda history: history, history)
        return written_by_component(stages, field(stage_time, trial), at=stage), history

    history = None
    if margins_before is not None:
        history = jnp.zeros((2 + len(looks), *margins_before.shape), margins_before.dtype)
        history = written_in_place(history, margins_before, at=jnp.zeros((), int))
    stages, history = over_stages(inner, do, (stages, history))
    rates = [rate, *jnp.unstack(stages)]
    # Stored, because the step, its error and the event all depend on it.
    end = jax.lax.optimization_barrier(state + length * weighted_sum(tableau.b_sol[: 1 + inner], rates))
    last_rate = jax.lax.optimization_barrier(field(time + length, end))
    last = None if history is None else jax.lax.optimization_barrier(jnp.stack(margins(time + length, end)))
    margin_at_end = jax.lax.optimization_barrier(lesser(_least(last), crossing(end, last_rate), length))
    history = (
        None if history is None or last is None else written_in_place(history, last, at=jnp.asarray(1 + len(looks)))
    )
    # Read from the last version of `history`: if an earlier one were still in use, the compiler would copy it.
    first_negative = jnp.full_like(length, 2.0)
    for row, stage in enumerate(looks, start=1):
        trial = state + length * weighted_sum(tableau.a_lower[stage], rates[: stage + 1])
        margin = lesser(_least(None if history is None else history[row]), crossing(trial, rates[stage + 1]), length)
        negative = jnp.where(margin < 0.0, tableau.c[stage], 2.0)
        first_negative = jnp.minimum(first_negative, negative)
    middle = state + length * weighted_sum(middle_weights(tableau), [*rates, last_rate])
    rates += [last_rate] if tableau.fsal else []
    error = length * weighted_sum(tableau.b_error, rates)
    return Step(end, last_rate, error, margin_at_end, first_negative, history, rates, middle, stages)


def inner_stages(tableau: diffrax.ButcherTableau) -> int:
    """Number of stages after the first, without a last stage that is the end of the step."""
    return len(tableau.c) - 1 if tableau.fsal else len(tableau.c)


def middle_weights(tableau: diffrax.ButcherTableau) -> tuple[float, ...]:
    """Weights of the rates at the stages and at the end of a step in the state in its middle: the smallest that meet the
    order conditions (Hairer, Norsett and Wanner, Solving ODEs I, section II.2) to the fifth order, or to the highest that
    the stages allow.
    """
    inner = inner_stages(tableau)
    rows = [*tableau.a_lower[:inner], np.asarray(tableau.b_sol[: 1 + inner])]
    return _middle_weights(tuple(tuple(row.tolist()) for row in rows))


@functools.cache
def _middle_weights(rows: tuple[tuple[float, ...], ...]) -> tuple[float, ...]:
    a = np.zeros((1 + len(rows), 1 + len(rows)))
    for k, row in enumerate(rows, start=1):
        a[k, : len(row)] = row
    ones = np.ones(len(a))
    c = a @ ones
    # The elementary weights of the rooted trees, with the order and the density of each.
    trees = [(ones, 1, 1), (c, 2, 2), (c**2, 3, 3), (a @ c, 3, 6), (c**3, 4, 4), (c * (a @ c), 4, 8), (a @ c**2, 4, 12)]
    trees += [(a @ a @ c, 4, 24), (c**4, 5, 5), (c**2 * (a @ c), 5, 10), ((a @ c) ** 2, 5, 20), (c * (a @ c**2), 5, 15)]
    trees += [(c * (a @ a @ c), 5, 30), (a @ c**3, 5, 20), (a @ (c * (a @ c)), 5, 40), (a @ a @ c**2, 5, 60)]
    trees += [(a @ a @ a @ c, 5, 120)]
    for highest in (5, 4, 3, 2):
        conditions = np.array([tree for tree, order, _ in trees if order <= highest])
        values = np.array([0.5**order / density for _, order, density in trees if order <= highest])
        weights = np.linalg.lstsq(conditions, values, rcond=1e-12)[0]
        if np.abs(conditions @ weights - values).max() < 1e-12:
            break
    return tuple(np.where(np.abs(weights) < 1e-14, 0.0, weights).tolist())


def memory_for_stages(tableau: diffrax.ButcherTableau, state: States) -> Stages:
    """Memory in which `explicit_step` stores the field at the inner stages."""
    return jnp.zeros((inner_stages(tableau), *state.shape), state.dtype)


def watched_places(tableau: diffrax.ButcherTableau, looks: Sequence[int]) -> Float[np.ndarray, " places"]:
    """The fractions of a step at which its margins are known: its start, the stages `looks`, and its end."""
    return np.array([0.0, *(tableau.c[stage] for stage in looks), 1.0])


def lesser(margin: Lanes | None, crossing: Lanes | None, like: Lanes) -> Lanes:
    """The lesser of two numbers per lane, either of which may be `None`; 1 if both are."""
    if margin is None:
        return jnp.ones_like(like) if crossing is None else crossing
    return margin if crossing is None else jnp.minimum(crossing, margin)


def _least(margins: Float[Array, "margins *lanes"] | None) -> Lanes | None:
    return None if margins is None else jnp.min(margins, axis=0)


def over_stages(stages: int, do: Callable[[Int[Array, ""], Any], Any], start: Any) -> Any:
    """Loop over the stages and return the carry; on an accelerator, which would wait for the host at every branch, the
    loop is unrolled.
    """
    return jax.lax.fori_loop(0, stages, do, start, unroll=jax.default_backend() != "cpu")


def stages_to_look(fractions: Float[np.ndarray, " stages"]) -> list[int]:
    """The stages nearest to 1/4, 1/2 and 3/4 of the step, where the inside of the step is checked."""
    inner_stages = [stage for stage, fraction in enumerate(fractions) if 0.0 < fraction < 1.0]
    stages = {
        min(inner_stages, key=lambda stage: abs(fractions[stage] - part)) for part in (0.25, 0.5, 0.75) if inner_stages
    }
    return sorted(stages)


def weighted_sum(weights: Iterable[float], rates: Sequence[States]) -> States:
    """Weighted sum of the rates, without those of weight 0."""
    total = None
    for weight, rate in zip(weights, rates, strict=True):
        if weight != 0.0:
            term = float(weight) * rate
            total = term if total is None else total + term
    return jnp.zeros_like(rates[0]) if total is None else total


def moved_state(
    stage: Int[Array, ""],
    rows: Iterable[Float[np.ndarray, " before"]],
    state: States,
    length: Lanes,
    rates: Stages,
    first: States | None = None,
) -> States:
    """The state moved along the rates of the earlier stages, with the weights of a stage. Every stage is a branch of
    its own, so that its weights are constants, of which many are 0.

    **Arguments:** `first`: the rate at the first stage, if `rates` begins with the second.
    """
    before = [] if first is None else [first]

    def moved(row: Float[np.ndarray, " before"]) -> Callable[[Stages], States]:
        return lambda rates: (
            state + length * weighted_sum(row, [*before, *(rates[k] for k in range(len(row) - len(before)))])
        )

    return jax.lax.switch(stage, [moved(row) for row in rows], rates)


def scaled_error(
    error: States, old_state: States, new_state: States, rtol: Float[Array, ""], atol: States, n_blocks: int
) -> Lanes:
    """Error in units of the tolerance: the greatest root mean square among the blocks of the state (Diffrax's norm and
    scale).

    The squares are added one by one: XLA compiles a sum over an axis of more than eight components lane by lane, which
    took half of the time of a run with twelve components.
    """
    ratio = error / (atol + rtol * jnp.maximum(jnp.abs(old_state), jnp.abs(new_state)))
    squares, size = [component * component for component in ratio], ratio.shape[0] // n_blocks
    means = [functools.reduce(operator.add, squares[k * size : (k + 1) * size]) / size for k in range(n_blocks)]
    return jnp.sqrt(functools.reduce(jnp.maximum, means))


def inverse_root(value: Lanes, order: int) -> Lanes:
    """`value**(-1/order)`; by square roots alone where the order is a power of 2, because `pow` costs twenty of them."""
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
    rtol: Float[Array, ""],
    atol: States,
    n_blocks: int,
) -> Lanes:
    """Length of the first step [s] (Hairer, Norsett and Wanner, Solving ODEs I, section II.4), in the motion's own unit
    of time.

    The comparison of |y'| with |y''| in their formula depends on the unit of time; Diffrax uses seconds. Here the unit
    is |y|/|y'|, so that motions that differ only in scale are integrated alike. If the state has several blocks
    (`n_blocks`), the first one counts.
    """
    scale = atol + jnp.abs(state) * rtol
    size = state.shape[0] // n_blocks

    def measure(vector: States) -> Lanes:
        return jnp.sqrt(jnp.mean((vector / scale)[:size] ** 2, axis=0))

    magnitude, slope = measure(state), measure(rate)
    unit = magnitude / slope
    # A state at rest has no unit of time of its own; longer units would overflow below.
    at_rest = (magnitude < 1e-5) | ~(unit < 1e15)
    unit = jnp.where(at_rest, 1e-4, unit)
    trial = 0.01 * unit
    bend = measure(field(time + trial, state + trial * rate) - rate) / trial
    max_slope = unit * jnp.maximum(slope, unit * bend)
    fraction = jnp.where(max_slope <= 1e-15, 0.01, inverse_root(jnp.maximum(max_slope, 1e-15) * 100.0, order))
    return unit * jnp.minimum(1.0, fraction)
