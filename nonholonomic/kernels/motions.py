"""The motion of one run as functions of numbers: what the hand-written loops of each language call.

Everything is generated from the objects that make tables (`nonholonomic.integration`, `nonholonomic.hybrid`), so a run in
another language takes the same steps. Only the loops over steps and stages, over rounds, and over the stretches of a
transition are written by hand: in `loops.cu` for GPUs, and in `views/integrator.js` for pages.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ..hybrid import MOST_ROUNDS, AbstractBatchedMode, AbstractHoppingMode, HybridOutcome
from ..hybrid.ensemble import after_reset, after_solve, at_start, mode_numbered, program_groups
from ..integration import AbstractProblem, Lanes, LaneState, Outcome, Settings, explicit_tableau
from ..integration.problem import LEFT_DOMAIN, RUNNING, UNRESOLVED
from ..integration.runge_kutta import Step, inner_stages, middle_weights, watched_places
from ..integration.scheduler import LaneScheduler, back_to_margin, outcome_of, with_crossing_times
from ..integration.step import Control, after_step, length_to_try, looks_of

#: Functions of a program by name, with examples of their arguments.
Functions = dict[str, tuple[Callable[..., PyTree], tuple[PyTree, ...]]]


class Part(NamedTuple):
    """A part of a program: its sizes and coefficients by name, and its functions."""

    facts: dict[str, Any]
    functions: Functions


def size_of(tree: PyTree) -> int:
    """Number of numbers in a tree of arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def offsets_of(parts: LaneState | HybridOutcome) -> dict[str, int]:
    """The offset of each part of a named tuple in its flat list of numbers, and under `size` the length of the list."""
    return dict(zip((*parts._fields, "size"), np.cumsum([0, *map(size_of, parts)]).tolist(), strict=True))


def steps_of(
    begin: Callable[..., LaneScheduler], end: Callable[..., PyTree], examples: tuple[PyTree, ...], settings: Settings
) -> Part:
    """The steps of a smooth motion.

    **Arguments:** `begin`: function that returns the scheduler of one cell; `end`: function of the problem, the `LaneState` at
    the end of the motion, and the arguments of `begin`; `examples`: example arguments of `begin`; `settings`: settings of the
    steps.
    """

    def started(*inputs: PyTree) -> tuple[tuple[AbstractProblem, Control, PyTree], LaneState]:
        scheduler = begin(*inputs)
        return (scheduler.problem, scheduler.control, scheduler.atols), scheduler.fresh

    shapes = eqx.filter_eval_shape(started, *examples)
    (constants, lane), static = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
    # Problem, control and absolute tolerances from the constants of a run.
    run, time, state = functools.partial(eqx.combine, static[0]), lane.time, lane.state
    tableau = explicit_tableau(settings.for_lanes)
    inner = inner_stages(tableau)
    # The stages at which margins and event function are evaluated, too.
    looks = looks_of(run(constants)[0], tableau, lane)
    places = len(watched_places(tableau, looks))
    margins = jax.tree.map(lambda least: jax.ShapeDtypeStruct((places, *least.shape), least.dtype), lane.margins)
    trial, along = Step(state, state, state, time, time, margins, (), state, None), (constants, time, state)
    functions: Functions = {
        "begin": (lambda *inputs: eqx.filter(started(*inputs), eqx.is_array), examples),
        "length": (
            lambda constants, lane: length_to_try(run(constants)[0], run(constants)[1], lane),
            (constants, lane),
        ),
        "field": (lambda constants, *at: run(constants)[0].field(*at), along),
        "margins": (lambda constants, *at: run(constants)[0].margins(*at), along),
        "crossing": (lambda constants, *at: run(constants)[0].crossing_along(*at), (constants, state, state)),
        "after": (lambda constants, *step: after_step(*run(constants), *step), (constants, lane, time, trial)),
        "ended": (lambda constants, *ended: end(run(constants)[0], *ended), (constants, lane, *examples)),
    }
    facts = {
        "constants": size_of(constants),
        "components": state.shape[0],
        "lane": offsets_of(lane),
        "running": RUNNING,
        "stages": [row.tolist() for row in tableau.a_lower[:inner]],
        "places": np.asarray(tableau.c[:inner]).tolist(),
        "looks": looks,
        "margins_count": 0 if lane.margins is None else len(lane.margins),
        "step": np.asarray(tableau.b_sol[: 1 + inner]).tolist(),
        "error": np.asarray(tableau.b_error).tolist(),
        "middle": middle_weights(tableau),
    }
    return Part(facts, functions)


class SmoothRuns(NamedTuple):
    """Runs of a problem to its event, as `solve_ensemble` solves them.

    - `start`: function of the numbers of a run that returns the problem, for one cell, the horizon [s] and the settings.
    - `passes`, `n_blocks`: `nonterminal` and `n_blocks` of `solve_ensemble`.
    - `read`: function of the numbers of a run and of a state that returns what is sampled; `None` without samples.
    """

    start: Callable[[PyTree], tuple[AbstractProblem, Float[Array, "..."], Settings]]
    passes: bool
    n_blocks: int = 1
    read: Callable[[PyTree, Float[Array, "components 1"]], PyTree] | None = None

    def part(self, values: PyTree) -> Part:
        """The program of a run, whose last function returns the `Outcome`. **Arguments:** `values`: an example."""

        def begin(values: PyTree) -> LaneScheduler:
            problem, t1, settings = self.start(values)
            options = {"nonterminal": self.passes, "n_blocks": self.n_blocks}
            return LaneScheduler.of(problem, t1, jnp.asarray(1), settings, **options)

        def end(problem: AbstractProblem, lane: LaneState, values: PyTree) -> Outcome:
            # As `LaneScheduler.store` does: a run that ends on a jump may be on its far side.
            lane = lane._replace(time=jnp.minimum(lane.time, self.start(values)[1]))
            outcome = back_to_margin(problem, outcome_of(lane))
            return outcome if self.passes else with_crossing_times(problem, outcome)

        part = steps_of(begin, end, (values,), eqx.filter_eval_shape(self.start, values)[2])
        if self.read is not None:
            state = jax.ShapeDtypeStruct((part.facts["components"], 1), jnp.result_type(float))
            part.functions["read"] = (self.read, (values, state))
            part.facts["quantities"] = size_of(eqx.filter_eval_shape(self.read, values, state))
        return part


class HybridStart(NamedTuple):
    """What a hybrid run of one cell starts with: the modes, the index of the first mode, the initial state, the horizon [s],
    and the settings."""

    modes: tuple[AbstractBatchedMode, ...]
    mode: Int[Array, "1"]
    state: Float[Array, "components 1"]
    t1: Float[Array, "1"]
    settings: Settings


class HybridRuns(NamedTuple):
    """Runs through modes, as `solve_hybrid` solves them.

    - `start`: function of the numbers of a run that returns the `HybridStart`.
    - `counters`: rows of `Transition.counts`; `passes`, `n_blocks`: `nonterminal` and `n_blocks` of `solve_hybrid`.
    - `is_shown`: whether the path is needed.
    """

    start: Callable[[PyTree], HybridStart]
    counters: int
    passes: bool
    n_blocks: int = 1
    is_shown: bool = False

    def first(self, values: PyTree) -> HybridOutcome:
        """A run at its start."""
        start = self.start(values)
        return at_start(start.mode, start.state, 1, self.counters)

    def parts(self, values: PyTree) -> tuple[Part, list[Part]]:
        """The program of the rounds, and those of the modes. **Arguments:** `values`: an example of a run's numbers."""
        start, runs = eqx.filter_eval_shape(self.start, values), jax.eval_shape(self.first, values)
        groups = program_groups(start.modes)
        numbers = range(len(start.modes))
        facts: dict[str, Any] = {
            "runs": offsets_of(runs),
            "modes": [next(k for k, group in enumerate(groups) if number in group) for number in numbers],
            "rounds": MOST_ROUNDS,
            "running": RUNNING,
            "left": LEFT_DOMAIN,
            "unresolved": UNRESOLVED,
        }
        kinds = [self._kind(values, group, start, runs) for group in groups]
        return Part(facts, {"first": (self.first, (values,))}), kinds

    def _kind(self, values: PyTree, group: tuple[int, ...], start: HybridStart, runs: HybridOutcome) -> Part:
        """The modes of one group: how they are integrated, and how they end."""
        examples, mode = (values, runs), start.modes[group[0]]

        def entered(values: PyTree, runs: HybridOutcome) -> tuple[Any, Lanes]:
            """The mode of a run, and the time [s] to the horizon."""
            modes, _, _, t1, _ = self.start(values)
            return mode_numbered(modes, group, runs.mode), jnp.maximum(t1 - runs.end_time, 0.0)

        def begin(values: PyTree, runs: HybridOutcome) -> LaneScheduler:
            mode, left = entered(values, runs)
            options = {"nonterminal": self.passes, "n_blocks": self.n_blocks}
            settings = self.start(values).settings
            return LaneScheduler.of(mode.problem(runs.state), left, jnp.asarray(1), settings, **options)

        def end(problem: AbstractProblem, lane: LaneState, values: PyTree, runs: HybridOutcome) -> HybridOutcome:
            outcome = back_to_margin(problem, outcome_of(lane))
            outcome = outcome if self.passes else with_crossing_times(problem, outcome)
            return after_solve(runs, outcome, self.start(values).t1)

        def reset(values: PyTree, runs: HybridOutcome) -> HybridOutcome:
            mode, left = entered(values, runs)
            return after_reset(runs, mode.reset_map(runs.state, left), self.start(values).t1)

        def lost(values: PyTree, runs: HybridOutcome) -> PyTree:
            stretch = entered(values, runs)[0].lost(runs.state)
            return stretch.open, stretch.elapsed, stretch

        def hop(values: PyTree, runs: HybridOutcome, stretch: PyTree) -> PyTree:
            mode, left = entered(values, runs)
            state_after, following = mode.hop(stretch, left)
            return following.open, state_after.elapsed, following

        def closed(values: PyTree, runs: HybridOutcome, stretch: PyTree) -> HybridOutcome:
            return after_reset(runs, entered(values, runs)[0].closed(stretch), self.start(values).t1)

        def between(values: PyTree, runs: HybridOutcome, stretch: PyTree, elapsed: Array) -> PyTree:
            mode, _ = entered(values, runs)
            return mode.between(mode.motion_in(stretch), elapsed)

        def shown(values: PyTree, runs: HybridOutcome, state: Array) -> Array:
            return entered(values, runs)[0].shown(state)

        facts, functions = steps_of(begin, end, examples, start.settings)
        if not isinstance(mode, AbstractHoppingMode):
            functions["reset"] = (reset, examples)
        else:
            stretch = eqx.filter_eval_shape(lost, *examples)[2]
            facts |= {"stretch": size_of(stretch), "most_hops": mode.most_hops}
            functions |= {"lost": (lost, examples), "hop": (hop, (*examples, stretch))}
            functions["closed"] = (closed, (*examples, stretch))
            if self.is_shown:
                functions["between"] = (between, (*examples, stretch, runs.end_time))
        if self.is_shown:
            functions["shown"] = (shown, (*examples, runs.state))
        return Part(facts, functions)
