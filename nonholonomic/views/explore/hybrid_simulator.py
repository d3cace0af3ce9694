"""A hybrid system for integration in the browser: its modes and transitions, in JavaScript.

Everything is generated from the modes that make tables (`nonholonomic.hybrid`). Only the loops over rounds and over the
stretches of a transition are written by hand, in `integrator.js`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...hybrid import MOST_ROUNDS, AbstractBatchedMode, AbstractHoppingMode, HybridOutcome
from ...hybrid.ensemble import after_reset, after_solve, at_start
from ...hybrid.sampled_rounds import mode_numbered, program_groups
from ...integration import Settings
from ...integration.ensemble import with_crossing_times
from ...integration.scheduler import LaneScheduler, back_to_margin, outcome_of
from ...integration.status import LEFT_DOMAIN, RUNNING, UNRESOLVED
from .simulator import Functions, Numbers, Stepper, as_object, offsets_of, size_of

Start = tuple[tuple[AbstractBatchedMode, ...], Int[Array, "1"], Float[Array, "components 1"]]


class HybridSimulator(NamedTuple):
    """A hybrid system that is integrated in the browser.

    - `start`: function of the numbers of the sliders that returns the modes, the index of the first mode, and the
      initial state, for one cell.
    - `t1`: horizon [s]; `settings`: settings with an explicit Runge-Kutta solver of Diffrax; `counters`: rows of
      `Transition.counts`.
    - `readings`: results at the end of a run, name -> function of (the sliders' numbers, a `HybridOutcome`).
    - `frame`: function that returns the frame at any time; its arguments are the sliders' numbers, the index of the
      mode or -1 between modes, the output rows of the modes, and the time [s]. `None` if no path is needed.
    """

    start: Callable[[Numbers], Start]
    t1: float
    settings: Settings
    counters: int
    readings: dict[str, Callable[[Numbers, HybridOutcome], Any]]
    frame: Callable[[Numbers, Any, Any, Any], Any] | None = None

    def first(self, values: Numbers) -> HybridOutcome[Array]:
        """The run for the sliders' numbers, at its start."""
        _, mode, state = self.start(values)
        return at_start(jnp, mode, state, 1, self.counters)

    def read(self, name: str, values: Numbers) -> Any:
        """A reading at the start of a run."""
        assert self.frame is not None, name
        modes, number, state = self.start(values)
        return self.frame(values, number, modes[0].shown(state), jnp.zeros(1))

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """
        modes = eqx.filter_eval_shape(self.start, values)[0]
        runs = jax.eval_shape(self.first, values)
        groups = program_groups(modes)
        facts = {
            "runs": offsets_of(runs),
            "modes": [next(k for k, group in enumerate(groups) if number in group) for number in range(len(modes))],
            "rounds": MOST_ROUNDS,
            "running": RUNNING,
            "left": LEFT_DOMAIN,
            "unresolved": UNRESOLVED,
        }
        functions: Functions = {"first": (self.first, (values,))}
        functions |= {name: (read, (values, runs)) for name, read in self.readings.items()}
        if self.frame is not None:
            rows = jax.eval_shape(lambda values: self.start(values)[0][0].shown(self.first(values).state), values)
            functions["frame"] = (self.frame, (values, runs.mode, rows, runs.end_time))
        kinds = [self._kind(values, group, modes[group[0]], runs) for group in groups]
        return as_object(facts, functions, kinds=f"[{', '.join(kinds)}]")

    def _kind(self, values: Numbers, group: tuple[int, ...], mode: AbstractBatchedMode, runs: HybridOutcome) -> str:
        """The modes of one group: how they are integrated, and how they end."""
        t1 = jnp.full(1, self.t1)

        def mode_of(values: Numbers, runs: HybridOutcome) -> Any:
            modes: Any = self.start(values)[0]
            return mode_numbered(modes, group, runs.mode)

        def begin(values: Numbers, runs: HybridOutcome) -> LaneScheduler:
            problem = mode_of(values, runs).problem(runs.state)
            return LaneScheduler.of(problem, _left(t1, runs), jnp.asarray(1), self.settings)

        def ended(constants: Any, lane: Any, runs: HybridOutcome) -> HybridOutcome:
            problem = stepper.run(constants)[0]
            outcome = with_crossing_times(problem, back_to_margin(problem, outcome_of(lane)))
            return after_solve(jnp, runs, outcome, t1)

        def reset(values: Numbers, runs: HybridOutcome) -> HybridOutcome:
            transition = mode_of(values, runs).reset_map(runs.state, _left(t1, runs))
            return after_reset(jnp, runs, transition, t1)

        def lost(values: Numbers, runs: HybridOutcome) -> Any:
            stretch = mode_of(values, runs).lost(runs.state)
            return stretch.open, stretch.elapsed, stretch

        def hop(values: Numbers, runs: HybridOutcome, stretch: Any) -> Any:
            state_after, following = mode_of(values, runs).hop(stretch, _left(t1, runs))
            return following.open, state_after.elapsed, following

        def closed(values: Numbers, runs: HybridOutcome, stretch: Any) -> HybridOutcome:
            return after_reset(jnp, runs, mode_of(values, runs).closed(stretch), t1)

        def output(values: Numbers, runs: HybridOutcome, state: Any) -> Any:
            return mode_of(values, runs).shown(state)

        def between(values: Numbers, runs: HybridOutcome, stretch: Any, elapsed: Any) -> Any:
            mode = mode_of(values, runs)
            return mode.between(mode.motion_in(stretch), elapsed)

        stepper = Stepper.of(begin, (values, runs), self.settings)
        functions, facts = stepper.functions, stepper.facts
        functions["ended"] = (ended, (stepper.constants, stepper.lane, runs))
        if not isinstance(mode, AbstractHoppingMode):
            functions["reset"] = (reset, (values, runs))
        else:
            stretch = eqx.filter_eval_shape(lost, values, runs)[2]
            facts |= {"stretch": size_of(stretch), "most_hops": mode.most_hops}
            functions |= {"lost": (lost, (values, runs)), "hop": (hop, (values, runs, stretch))}
            functions["closed"] = (closed, (values, runs, stretch))
            if self.frame is not None:
                functions["between"] = (between, (values, runs, stretch, runs.end_time))
        if self.frame is not None:
            functions["shown"] = (output, (values, runs, runs.state))
        return as_object(facts, functions)


def _left(t1: Float[Array, "1"], runs: HybridOutcome) -> Float[Array, "1"]:
    """Time to the horizon [s]."""
    return jnp.maximum(t1 - runs.end_time, 0.0)
