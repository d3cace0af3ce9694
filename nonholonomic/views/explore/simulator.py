"""A problem for integration in the browser: its functions and its method, in JavaScript.

Everything is generated from the objects that make tables (`nonholonomic.integration`), so both take the same steps. Only the
loops over steps and stages are written by hand, in `integrator.js`.
"""

import functools
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...integration import AbstractProblem, LaneState, Settings, explicit_tableau
from ...integration.runge_kutta import Step, inner_stages, middle_weights, watched_places
from ...integration.scheduler import LaneScheduler
from ...integration.status import RUNNING
from ...integration.step import Control, after_step, length_to_try, looks_of, past_jump, until_jump
from .javascript import javascript

Numbers = Float[Array, " numbers"]

#: Functions of a page by name, with examples of their arguments.
Functions = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]


class Simulator(NamedTuple):
    """A problem that is integrated in the browser.

    - `problem`: function of the numbers of the sliders that returns the problem of one cell.
    - `t1`: horizon [s]; `settings`: settings with an explicit Runge-Kutta solver of Diffrax.
    - `readings`: results of a run, name -> function of (the sliders' numbers, the problem, a `LaneState` of one lane).
    - `passes`: whether a run continues through its event.
    """

    problem: Callable[[Numbers], AbstractProblem]
    t1: float
    settings: Settings
    readings: dict[str, Callable[[Numbers, Any, LaneState], Any]]
    passes: bool = False

    def begin(self, values: Numbers) -> LaneScheduler:
        """The run for the sliders' numbers, at its start."""
        t1, cells = jnp.asarray(self.t1), jnp.asarray(1)
        return LaneScheduler.of(self.problem(values), t1, cells, self.settings, nonterminal=self.passes)

    def read(self, name: str, values: Numbers) -> Any:
        """A reading at the start of a run."""
        scheduler = self.begin(values)
        return self.readings[name](values, scheduler.problem, scheduler.fresh)

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """
        stepper = Stepper.of(self.begin, (values,), self.settings)
        functions = stepper.functions
        for name, read in self.readings.items():
            functions[name] = (
                lambda values, constants, lane, read=read: read(values, stepper.run(constants)[0], lane),
                (values, stepper.constants, stepper.lane),
            )
        return as_object(stepper.facts, functions)


class Stepper(NamedTuple):
    """The steps of a motion in JavaScript.

    - `begin`: function that returns the scheduler of one cell; `examples`: example arguments of this function;
      `settings`: settings of the steps.
    - `constants`, `lane`: the shapes of the constants of a run, and of the lane; `run` computes problem, control and
      absolute tolerances from the constants.
    """

    begin: Callable[..., LaneScheduler]
    examples: tuple[Any, ...]
    settings: Settings
    constants: Any
    lane: LaneState
    run: Callable[[Any], tuple[Any, Control, Any]]

    @classmethod
    def of(cls, begin: Callable[..., LaneScheduler], examples: tuple[Any, ...], settings: Settings) -> "Stepper":
        """The steps of the motion that a function begins."""
        shapes = eqx.filter_eval_shape(functools.partial(_started, begin), *examples)
        (constants, lane), static = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
        return cls(begin, examples, settings, constants, lane, functools.partial(eqx.combine, static[0]))

    @property
    def functions(self) -> Functions:
        """The functions that `integrator.js` calls."""
        constants, lane, run = self.constants, self.lane, self.run
        time, state = lane.time, lane.state
        places = len(watched_places(explicit_tableau(self.settings.for_lanes), self.looks))
        margins = jax.tree.map(lambda least: jax.ShapeDtypeStruct((places, *least.shape), least.dtype), lane.margins)
        trial = Step(state, state, state, time, time, margins, (), state, None)

        def after(constants: Any, lane: LaneState, length: Any, trial: Step) -> LaneState:
            problem, control, atols = run(constants)
            near = until_jump(problem, control, lane)
            new_lane = after_step(problem, near, atols, lane, length, trial)
            return past_jump(problem, control, near, lane, new_lane)

        def length(constants: Any, lane: LaneState) -> Any:
            return length_to_try(until_jump(*run(constants)[:2], lane), lane)

        return {
            "begin": (lambda *inputs: eqx.filter(_started(self.begin, *inputs), eqx.is_array), self.examples),
            "length": (length, (constants, lane)),
            "field": (lambda constants, time, state: run(constants)[0].field(time, state), (constants, time, state)),
            "margins": (
                lambda constants, time, state: run(constants)[0].margins(time, state),
                (constants, time, state),
            ),
            "crossing": (
                lambda constants, state, rate: run(constants)[0].crossing_along(state, rate),
                (constants, state, state),
            ),
            "after": (after, (constants, lane, time, trial)),
        }

    @property
    def facts(self) -> dict[str, Any]:
        """The sizes and the coefficients that `integrator.js` reads."""
        tableau = explicit_tableau(self.settings.for_lanes)
        inner = inner_stages(tableau)
        return {
            "constants": size_of(self.constants),
            "components": self.lane.state.shape[0],
            "lane": offsets_of(self.lane),
            "running": RUNNING,
            "stages": [row.tolist() for row in tableau.a_lower[:inner]],
            "places": np.asarray(tableau.c[:inner]).tolist(),
            "looks": self.looks,
            "margins_count": 0 if self.lane.margins is None else len(self.lane.margins),
            "step": np.asarray(tableau.b_sol[: 1 + inner]).tolist(),
            "error": np.asarray(tableau.b_error).tolist(),
            "middle": middle_weights(tableau),
        }

    @property
    def looks(self) -> list[int]:
        """The stages at which margins and event function are evaluated, too."""
        return looks_of(self.run(self.constants)[0], explicit_tableau(self.settings.for_lanes), self.lane)


def _started(begin: Callable[..., LaneScheduler], *inputs: Any) -> tuple[Any, LaneState]:
    scheduler = begin(*inputs)
    return (scheduler.problem, scheduler.control, scheduler.atols), scheduler.fresh


def as_object(facts: dict[str, Any], functions: Functions, **more: str) -> str:
    """A JavaScript object with facts and functions; `more`: text of further entries."""
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in functions.items()]
    lines += [f"{name}: {text}" for name, text in more.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in facts.items()), *lines]) + "}"


def size_of(tree: Any) -> int:
    """Number of numbers in a tree of arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def offsets_of(parts: Any) -> dict[str, int]:
    """The offset of each part of a named tuple in its flat list of numbers, and under `size` the length of the list."""
    return dict(zip((*parts._fields, "size"), np.cumsum([0, *map(size_of, parts)]).tolist(), strict=True))
