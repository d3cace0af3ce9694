"""The rounds of hybrid runs with samples at given times, and the output rows of the samples."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..compilation.xla_cpu import greatest
from ..integration import Settings, solve_with_samples
from ..integration.status import LEFT_DOMAIN
from .ensemble import Advance, Carry, HybridOutcome, after_reset, after_solve, chosen, padded, resolution
from .mode import AbstractBatchedMode, mode_of_cells, over_cells
from .path import BETWEEN
from .saltation import VariationalMode
from .transition_rows import reset_with_rows


class Recorded(NamedTuple):
    """The samples so far: states of the modes, and their mode, NaN where still missing; the output rows between modes
    with their variations, the rows first, `None` if no mode records its path; and the time [s] of the first grazing
    event, infinite if there was none.
    """

    state: Float[Array, "components times cells"]
    number: Float[Array, "times cells"]
    between: Float[Array, "values shown times cells"] | None
    grazing_time: Float[Array, " cells"]


def sampled_rounds(
    modes: tuple[VariationalMode, ...],
    start: HybridOutcome[Array],
    times: Float[Array, "times cells"],
    t1: Float[Array, " cells"],
    settings: Settings,
    n_blocks: int,
) -> tuple[Carry, list[tuple[int, ...]], Advance, Advance]:
    """The rounds of `traced_solve_hybrid` with samples of every mode and of the transition to the next.

    **Returns:** the arguments of `traced_rounds`; the carry is a `HybridOutcome` and the `Recorded` samples.
    """
    size = times.shape[1]

    def solve(numbers: Sequence[int], carry: Carry, active: Bool[Array, " cells"]) -> Carry:
        def solved() -> Carry:
            (runs, output), cell = carry, padded(active)
            mode = mode_of_cells(mode_numbered(modes, numbers, runs.mode), cell)
            # Runs in another mode spend no time in this one.
            left = jnp.where(active, greatest(t1 - runs.end_time, 0.0), 0.0)
            times_in_mode = times - runs.end_time
            problem, count = mode.problem(runs.state[:, cell]), jnp.asarray(size)
            options = {"n_blocks": n_blocks, "one_kernel": True}
            outcome, samples = solve_with_samples(problem, times_in_mode, left, count, settings, **options)
            after = chosen(active, after_solve(jnp, runs, outcome, t1), runs)
            # A sample at the time of a reset is the state before it.
            is_last = abs(times - after.end_time) <= resolution(runs.end_time, after.end_time)
            is_last &= outcome.status == LEFT_DOMAIN
            samples = jnp.moveaxis(samples, -1, 0).swapaxes(1, 2)
            samples = jnp.where(is_last, outcome.state[:, None], samples)
            is_within = (times_in_mode >= 0.0) & (times <= after.end_time)
            is_new = active & (is_within | is_last) & jnp.isnan(output.number)
            state = jnp.where(is_new, samples, output.state)
            return after, output._replace(state=state, number=jnp.where(is_new, runs.mode, output.number))

        return jax.lax.cond(jnp.any(active), solved, lambda: carry)

    def reset(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " cells"]) -> Carry:
        def after_transition() -> Carry:
            (runs, output), cell = carry, padded(lost)
            transition, rows = _reset(numbers, runs, cell)
            after = chosen(lost, after_reset(jnp, runs, transition, t1), runs)
            if rows is not None:
                assert output.between is not None
                is_new = lost & (times > runs.end_time) & (times <= after.end_time) & jnp.isnan(output.number)
                output = output._replace(
                    between=jnp.where(is_new, rows, output.between), number=jnp.where(is_new, BETWEEN, output.number)
                )
            grazes = after.counts[-1] > runs.counts[-1]
            grazing_time = jnp.where(grazes, jnp.minimum(output.grazing_time, runs.end_time), output.grazing_time)
            return after, output._replace(grazing_time=grazing_time)

        return jax.lax.cond(jnp.any(lost), after_transition, lambda: carry)

    def _reset(numbers: Sequence[int], runs: HybridOutcome[Array], cell: Array) -> tuple[Any, Array | None]:
        """The transition of some cells, and its output rows with their variations."""

        def with_rows(mode: AbstractBatchedMode, state: Array, left: Array) -> Any:
            # If the event happens later, less time passes from the event to a fixed time, and to the horizon.
            return reset_with_rows(mode, state, left, times[:, cell] - t1[cell] + left, t1[cell])

        mode: Any = mode_of_cells(mode_numbered(modes, numbers, runs.mode), cell)
        left = greatest(t1[cell] - runs.end_time[cell], 0.0)
        transition, rows, variations = mode.reset_with_path(runs.state[:, cell], left, with_rows)
        return transition, None if rows is None else jnp.concatenate([rows[None], variations])

    groups = program_groups(modes)
    rows = [jax.eval_shape(functools.partial(_reset, group), start, jnp.arange(size))[1] for group in groups]
    between = next((jnp.zeros(shape.shape) for shape in rows if shape is not None), None)
    missing = jnp.full((len(start.state), *times.shape), jnp.nan)
    empty = Recorded(missing, missing[0], between, jnp.full(size, jnp.inf))
    return (start, empty), groups, solve, reset


def output_rows(
    modes: tuple[VariationalMode, ...], output: Recorded
) -> tuple[Float[Array, "shown times cells"], Float[Array, "tangents shown times cells"]]:
    """The output rows, NaN where a sample is missing, and their variations."""
    shapes = jax.eval_shape(over_cells(VariationalMode.output_rows, modes[0]), output.state)
    rows = jax.tree.map(jnp.full_like, shapes, (jnp.nan, 0.0))
    for number, mode in enumerate(modes):
        of_this = over_cells(VariationalMode.output_rows, mode)(output.state)
        rows = jax.tree.map(functools.partial(jnp.where, output.number == number), of_this, rows)
    if output.between is not None:
        between = (output.between[0], output.between[1:])
        rows = jax.tree.map(functools.partial(jnp.where, output.number == BETWEEN), between, rows)
    return rows


def program_groups(modes: tuple[AbstractBatchedMode, ...]) -> list[tuple[int, ...]]:
    """The indices of the modes, in groups. The modes of a group differ only in the values of their arrays, so they
    share a program."""
    groups: list[list[int]] = []
    for number, mode in enumerate(modes):
        shape = _shape(mode)
        group = next((group for group in groups if eqx.tree_equal(_shape(modes[group[0]]), shape)), None)
        if group is None:
            groups.append([number])
        else:
            group.append(number)
    return [tuple(group) for group in groups]


def _shape(mode: AbstractBatchedMode) -> Any:
    """A mode with the shapes of its arrays in place of their values."""
    return jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)) if eqx.is_array(leaf) else leaf, mode)


def mode_numbered(modes: tuple[VariationalMode, ...], numbers: Sequence[int], selected: Array) -> Any:
    """The mode numbered `selected` in one of the `program_groups`."""
    mode = modes[numbers[0]]
    for number in numbers[1:]:

        def leaf(old: Any, new: Any, number: int = number) -> Any:
            return old if old is new or not eqx.is_array(old) else jnp.where(selected == number, new, old)

        mode = jax.tree.map(leaf, mode, modes[number])
    return mode
