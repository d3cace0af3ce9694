"""The derivatives of a sum over the samples of hybrid runs with respect to any number of parameters, by one backward pass.

The runs are computed round by round, and some rounds are kept as checkpoints. The backward pass takes the rounds in
reverse: the transpose of the saltation matrix carries the cotangents through every reset (`saltation.py`), and the adjoint of
the motion carries them through the mode (`derivatives/sampled_runs.py`). The motion is repeated from its start for the
time that it lasted, so that no event is located again. The cost does not depend on the number of parameters where the reset
map has a transpose; other reset maps are differentiated along every number of their mode. The memory is that of the
samples, of the checkpoints, and of the adjoint of one mode.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import greatest, uncounted
from ..derivatives import tangents_of
from ..derivatives.adjoint import Checkpoints
from ..derivatives.sampled_runs import SampledCotangents, mixture, samples_pulled_back
from ..derivatives.variation import over_cells as with_cells
from ..derivatives.variation import where_active
from ..integration import AbstractProblem, Jumps, Lanes, Settings, States, solve_with_samples
from ..integration.problem import LEFT_DOMAIN, REACHED_END, RUNNING
from .ensemble import (
    BETWEEN,
    MOST_ROUNDS,
    Advance,
    Carry,
    HybridOutcome,
    after_reset,
    after_solve,
    at_start,
    chosen,
    one_round,
    resolution,
    selected_cells,
)
from .mode import AbstractBatchedMode, mode_of_cells, over_cells, reset_with_rows, weighted
from .saltation import VariationalMode, along, delay, variational_modes, variational_start

# The rounds of hybrid runs with samples at given times, and the output rows of the samples.


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
            (runs, output), cell = carry, selected_cells(active)
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
            (runs, output), cell = carry, selected_cells(lost)
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


#: From numbers with the cells last to the modes, the index of the first mode of every cell, and the initial states.
Build = Callable[..., tuple[tuple[AbstractBatchedMode, ...], Array, Float[Array, "components cells"]]]


class EndlessProblem(AbstractProblem):
    """A problem without its event and without the end of its domain."""

    whole: AbstractProblem

    @property
    def fits_one_kernel(self) -> bool:
        return self.whole.fits_one_kernel

    def start(self) -> tuple[Float[Array, "components cells"], Float[Array, "components cells"]]:
        return self.whole.start()

    def field(self, time: Lanes, state: States) -> States:
        return self.whole.field(time, state)

    def event_function(self, state: States) -> None:
        return None

    def domain_margin(self, time: Lanes, state: States) -> None:
        return None

    def jumps(self, time: Lanes, state: States) -> Jumps | None:
        return self.whole.jumps(time, state)


class Costate(NamedTuple):
    """Derivatives of the sum with respect to the runs at the start of a round.

    - `state`: those by the state; `start_time`: those by the time at which the mode begins.
    - `numbers`: those by the moving numbers of every mode, from all later rounds.
    - `invalid`: whether a grazing event lies between the start of the round and a sample with a cotangent.
    """

    state: Float[Array, "components cells"]
    start_time: Float[Array, " cells"]
    numbers: list[list[Array]]
    invalid: Bool[Array, " cells"]


class Kept(NamedTuple):
    """What is kept of a round: the runs at its start, and at the ends of the modes before the resets; and whether the event
    there was grazing."""

    before: HybridOutcome[Array]
    ended: HybridOutcome[Array]
    grazes: Bool[Array, " cells"]


class Rounds(NamedTuple):
    """State of the forward pass and of the backward pass over the rounds.

    `frontier` holds the runs at the start of the round numbered `number`; `output` the samples so far and `owner` the rounds
    that they belong to. The backward pass takes the round before number `limit` next. The checkpoints are `Kept`.
    """

    frontier: HybridOutcome[Array]
    output: Recorded
    owner: Int[Array, "times cells"]
    number: Int[Array, ""]
    limit: Int[Array, ""]
    checkpoints: Checkpoints
    costate: Costate


def hybrid_samples_pulled_back(
    build: Build,
    point: tuple[Float[Array, "... cells"], ...],
    shown: Float[Array, "shown times cells"],
    end_time: Float[Array, " cells"],
    times: Float[Array, "times cells"],
    t1: Float[Array, " cells"],
    settings: Settings,
    counters: int,
) -> list[Float[Array, "... cells"]]:
    """The cotangents of the numbers of hybrid runs from those of their samples.

    **Arguments:**

    - `build`: numbers -> modes, the index of the first mode of every cell, and the initial states; `point`: the numbers,
      with the cells last.
    - `shown`, `end_time`: the cotangents of the output rows, 0 where there is no sample, and of the times of the ends of
      the runs.
    - The others as for `solve_hybrid_with_samples`.

    **Returns:** the cotangents, in the shapes of the numbers; NaN in cells with a grazing event before a sample that
    matters, and in cells that fail with the steps of the backward pass.
    """
    modes, first, state = build(*point)
    tangent = tangents_of(lambda *point: build(*point)[::2], point, [tuple(mixture(point))])
    variational = variational_modes(modes, tangent, settings.tolerance, False)
    cells, states = state.shape[1], variational_start(state, tangent)
    start = at_start(jnp, first, states, cells, counters + 1)
    (runs, output), groups, solve, reset = sampled_rounds(variational, start, times, t1, settings, 2)
    shown = jnp.where((times <= 0.0) & ~_moved_rows(variational, first, states), 0.0, shown)
    passes = Passes(variational, groups, (solve, reset), (times, t1), settings, shown, end_time)
    costate = passes.back_to_start(runs, output)

    def numbers_and_start(*point: Float[Array, "... cells"]) -> Any:
        modes, _, state = build(*point)
        numbers = [jax.tree.leaves(where_active(mode, rate)) for mode, rate in zip(modes, tangent[0][0], strict=True)]
        return jax.tree.map(lambda number: with_cells(number, cells), numbers), state

    by_point = jax.vjp(numbers_and_start, *point)[1]((costate.numbers, costate.state))
    return [jnp.where(costate.invalid, jnp.nan, part) for part in by_point]


def _moved_rows(
    modes: tuple[VariationalMode, ...], first: Int[Array, " cells"], state: Float[Array, "components cells"]
) -> Bool[Array, "shown 1 cells"]:
    """Which output rows the tangent moves at the start."""
    variations = [
        over_cells(lambda mode, states: mode.output_rows(states)[1][0], mode)(state[:, None]) for mode in modes
    ]
    moved = variations[0]
    for number, variation in enumerate(variations):
        moved = jnp.where(first == number, variation, moved)
    return moved != 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Passes:
    """The forward pass over the rounds, and the backward pass, which carries derivatives through them.

    - `modes`: with a tangent that moves all numbers; `groups`, `advance`: as for `one_round`.
    - `horizon`: times of the samples and ends of the runs [s]; `shown`, `end_time`: their cotangents.
    """

    modes: tuple[VariationalMode, ...]
    groups: Sequence[Sequence[int]]
    advance: tuple[Advance, Advance]
    horizon: tuple[Float[Array, "times cells"], Float[Array, " cells"]]
    settings: Settings
    shown: Float[Array, "shown times cells"]
    end_time: Float[Array, " cells"]

    def back_to_start(self, runs: HybridOutcome[Array], output: Recorded) -> Costate:
        """The derivatives with respect to the start of the first round, after both passes.

        **Arguments:** `runs`, `output`: the runs at their start, without samples.
        """
        cells, count = len(runs.mode), jnp.zeros((), int)
        no_cells = jnp.zeros(cells, bool)
        numbers = [
            [jnp.zeros((*jnp.shape(leaf)[:-1], cells)) for leaf in mode.active_numbers()[0]] for mode in self.modes
        ]
        costate = Costate(jnp.zeros_like(self.primal(runs)[0]), jnp.zeros(cells), numbers, no_cells)
        checkpoints = Checkpoints.none(Kept(runs, runs, no_cells))
        owner = jnp.full(self.horizon[0].shape, -1)
        run = Rounds(runs, output, owner, count, count + MOST_ROUNDS, checkpoints, costate)
        return jax.lax.while_loop(lambda run: uncounted(run.limit > 0, run.number), self.there_and_back, run).costate

    def there_and_back(self, run: Rounds) -> Rounds:
        """Compute all rounds up to the one that the backward pass needs, and take back those with a checkpoint."""
        is_first = run.limit == MOST_ROUNDS
        run = jax.lax.while_loop(self.is_ahead, self.forward, run)
        # At first, the derivatives begin at the ends of the runs; a horizon does not move.
        by_end = jnp.where(run.frontier.status == REACHED_END, 0.0, self.end_time)
        costate = run.costate._replace(start_time=jnp.where(is_first, by_end, run.costate.start_time))
        run = run._replace(limit=jnp.minimum(run.limit, run.number), costate=costate)
        run = jax.lax.while_loop(self.is_kept, self.backward, run)
        number, kept = run.checkpoints.latest()
        return run._replace(frontier=kept.before, number=number, checkpoints=run.checkpoints.without_latest())

    def is_ahead(self, run: Rounds) -> Bool[Array, ""]:
        """Whether a round that the backward pass needs has not been computed."""
        return jnp.any(run.frontier.status == RUNNING) & (run.number < run.limit)

    def forward(self, run: Rounds) -> Rounds:
        """Compute the next round."""
        solve, reset = self.advance

        def solved(numbers: Sequence[int], carry: Carry, active: Bool[Array, " cells"]) -> Carry:
            runs, output = solve(numbers, carry[:2], active)
            return runs, output, chosen(active, runs, carry[2])

        def left(numbers: Sequence[int], carry: Carry, lost: Bool[Array, " cells"]) -> Carry:
            return (*reset(numbers, carry[:2], lost), carry[2])

        before = run.frontier
        after, output, ended = one_round((before, run.output, before), self.groups, solved, left)
        is_new = jnp.isnan(run.output.number) & ~jnp.isnan(output.number)
        return run._replace(
            frontier=after,
            output=output,
            owner=jnp.where(is_new, run.number, run.owner),
            number=run.number + 1,
            checkpoints=run.checkpoints.added(run.number, Kept(before, ended, after.counts[-1] > before.counts[-1])),
        )

    def is_kept(self, run: Rounds) -> Bool[Array, ""]:
        """Whether the round that the backward pass takes next is a checkpoint."""
        number, _ = run.checkpoints.latest()
        return (run.checkpoints.depth > 0) & (number == run.limit - 1)

    def backward(self, run: Rounds) -> Rounds:
        """Carry the derivatives through the latest round."""
        (number, kept), costate = run.checkpoints.latest(), run.costate
        for group in self.groups:
            active = functools.reduce(jnp.logical_or, (kept.before.mode == number for number in group))
            active = active & (kept.before.status == RUNNING)
            stage = _Stage(self, group, kept, run.output, active & (run.owner == number))
            costate = _if_any(active & (kept.ended.status == LEFT_DOMAIN), stage.through_reset, costate)
            costate = _if_any(active, stage.through_motion, costate)
        return run._replace(limit=number, checkpoints=run.checkpoints.without_latest(), costate=costate)

    def primal(self, runs: HybridOutcome[Array]) -> tuple[Float[Array, "components cells"], Float[Array, " cells"]]:
        """The states of some runs, and the time since their modes began."""
        state = self.modes[0].parts(runs.state)[0]
        return state[:-1], state[-1]


def _if_any(
    cells: Bool[Array, " cells"], step: Callable[[Bool[Array, " cells"], Costate], Costate], costate: Costate
) -> Costate:
    """The derivatives after a step of the backward pass, if there are cells that take it."""
    return jax.lax.cond(jnp.any(cells), step, lambda _, costate: costate, cells, costate)


@dataclasses.dataclass(frozen=True, eq=False)
class _Stage:
    """The backward pass through one round of the modes of a group.

    `owned`: the samples of the round.
    """

    passes: Passes
    group: Sequence[int]
    kept: Kept
    output: Recorded
    owned: Bool[Array, "times cells"]

    def through_reset(self, lost: Bool[Array, " cells"], costate: Costate) -> Costate:
        """Carry the derivatives from the start of the next mode to the end of the mode."""
        (times, t1), cell = self.passes.horizon, selected_cells(lost)
        numbers, _, build = self._mode(cell)
        primal, duration = (part[..., cell] for part in self.passes.primal(self.kept.ended))
        left = greatest(t1[cell] - self.kept.ended.end_time[cell], 0.0)
        by_state, by_time = jnp.where(lost, costate.state, 0.0), jnp.where(lost, costate.start_time, 0.0)
        weights = jnp.where(self.owned & (self.output.number == BETWEEN), self.passes.shown, 0.0)

        def share(
            primal: Float[Array, "components cells"], start_time: Float[Array, " cells"], *numbers: Array
        ) -> Array:
            """The share of the later run in the sum; the reset moves with the event (`saltation.py`)."""
            mode = build(*numbers)
            problem = mode.problem(primal)
            rates = stop_gradient(problem.field(duration, primal))
            later = delay(lambda point: problem.domain_margin(duration, point), primal, rates)
            later = jnp.where(duration > 0.0, later, 0.0)
            state, left_then = primal + rates * later, left - start_time - later
            transition, rows = reset_with_rows(
                mode, state, left_then, times[:, cell] - t1[cell] + left_then, t1[cell], weights
            )
            by_end = weighted(by_time, start_time + later + transition.elapsed)
            total = by_end + jnp.sum(weighted(by_state, transition.state), axis=0)
            return total if rows is None else total + rows

        matters = jnp.any(by_state != 0.0, axis=0) | (by_time != 0.0) | jnp.any(weights != 0.0, axis=(0, 1))
        gradients = _gradients(share, (primal, jnp.zeros_like(duration), *numbers))
        by_primal, by_start_time, *by_numbers = (jnp.where(matters, gradient, 0.0) for gradient in gradients)
        return Costate(
            jnp.where(lost, by_primal, costate.state),
            jnp.where(lost, by_start_time, costate.start_time),
            self._added(costate.numbers, lost, by_numbers),
            costate.invalid | (lost & matters & self.kept.grazes),
        )

    def through_motion(self, active: Bool[Array, " cells"], costate: Costate) -> Costate:
        """Carry the derivatives from the end of the mode to its start."""
        (times, t1), cell, (before, ended, _) = self.passes.horizon, selected_cells(active), self.kept
        numbers, rates, build = self._mode(cell)
        start, variation = (part[:-1, cell] for part in self.passes.modes[0].parts(before.state))
        left = greatest(t1 - before.end_time, 0.0)
        duration = jnp.where(active, jnp.where(ended.status == REACHED_END, left, self.passes.primal(ended)[1]), 0.0)
        owned = self.owned & (self.output.number != BETWEEN)
        samples = jnp.where(owned, self.output.state[: len(start)], start[:, None])

        def rows(
            samples: Float[Array, "components times cells"], start_time: Float[Array, "times cells"], *numbers: Array
        ):
            def of_cell(mode: AbstractBatchedMode, states: Array, start_time: Array, duration: Array) -> Array:
                # If the mode begins later, the state has advanced less at the same time.
                rates = stop_gradient(mode.problem(states).field(duration, states))
                return mode.shown(states - rates * start_time)

            elapsed = jnp.broadcast_to(duration, start_time.shape)
            return over_cells(of_cell, build(*numbers))(samples, start_time, elapsed)

        pull = jax.vjp(rows, samples, jnp.zeros_like(times), *numbers)[1]
        by_samples, by_start_time, *by_numbers = pull(jnp.where(owned, self.passes.shown, 0.0))
        by_samples, by_start_time = (jnp.where(owned, part, 0.0) for part in (by_samples, by_start_time))
        # Rounding may put a sample after the end of the mode.
        times_in_mode = times - before.end_time
        times_in_mode = jnp.where(owned, jnp.minimum(times_in_mode, duration), times_in_mode)
        at_end = jnp.where(active & (ended.status == LEFT_DOMAIN), costate.state, 0.0)
        by_start, *by_problem = samples_pulled_back(
            lambda state, *numbers: EndlessProblem(build(*numbers).problem(state)),
            (start, *numbers),
            SampledCotangents(jnp.transpose(by_samples, (2, 1, 0)), jnp.zeros_like(duration), at_end),
            times_in_mode,
            duration,
            self.passes.settings,
            [variation, *rates],
        )
        by_numbers = [one + other for one, other in zip(by_numbers, by_problem, strict=True)]
        return costate._replace(
            state=jnp.where(active, by_start, costate.state),
            start_time=costate.start_time + jnp.sum(by_start_time, axis=0),
            numbers=self._added(costate.numbers, active, by_numbers),
        )

    def _mode(self, cell: Int[Array, " cells"]) -> tuple[list[Float[Array, "... cells"]], list[Array], Any]:
        """The moving numbers of the mode of some cells, their rates, and the mode as a function of the numbers."""
        mode: Any = mode_of_cells(mode_numbered(self.passes.modes, self.group, self.kept.before.mode), cell)
        numbers, build = mode.active_numbers()
        numbers, rates = ([with_cells(leaf, len(cell)) for leaf in leaves] for leaves in (numbers, mode.rates()[0]))
        return numbers, rates, build

    def _added(
        self, numbers: list[list[Array]], cells: Bool[Array, " cells"], shares: list[Array]
    ) -> list[list[Array]]:
        """The derivatives with respect to the numbers of all modes, with the shares of some cells in this group."""

        def of_mode(number: int, sums: list[Array]) -> list[Array]:
            if number not in self.group:
                return sums
            is_here = cells & (self.kept.before.mode == number)
            return [total + jnp.where(is_here, share, 0.0) for total, share in zip(sums, shares, strict=True)]

        return [of_mode(number, sums) for number, sums in enumerate(numbers)]


def _gradients(
    function: Callable[..., Float[Array, " cells"]], point: tuple[Float[Array, "... cells"], ...]
) -> list[Float[Array, "... cells"]]:
    """The derivatives of a value in every cell with respect to the cell's numbers."""
    try:
        value, pull = jax.vjp(function, *point)
        return list(pull(jnp.ones_like(value)))
    except ValueError:
        # A loop without a fixed number of iterations has no transpose: one tangent for each number.
        zeros = tuple(jnp.zeros_like(number) for number in point)
        entries = [(k, index) for k, number in enumerate(point) for index in np.ndindex(number.shape[:-1])]
        tangents = [(*zeros[:k], zeros[k].at[index].set(1.0), *zeros[k + 1 :]) for k, index in entries]
        slopes = along(function, point, tangents)[1]
        sizes = np.cumsum([np.prod(number.shape[:-1], dtype=int) for number in point])[:-1]
        return [part.reshape(number.shape) for part, number in zip(jnp.split(slopes, sizes), point, strict=True)]
