"""A problem that is integrated in the browser: its functions, and its method, in JavaScript.

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

from ...integration import (
    RUNNING,
    AbstractProblem,
    LaneScheduler,
    LaneState,
    Settings,
    Step,
    after_step,
    explicit_tableau,
    length_to_try,
    stages_to_look,
    watched_places,
)
from .javascript import javascript

Numbers = Float[Array, " numbers"]


class Simulator(NamedTuple):
    """What is integrated in the browser.

    - `problem`: of one cell, for the numbers of the sliders.
    - `t1`: horizon [s]; `settings`: with an explicit Runge-Kutta solver of Diffrax.
    - `readings`: what is read off a run, name -> a function of (the sliders' numbers, the problem, a `LaneState` of one lane).
    - `passes`: whether a run goes on through its event.
    """

    problem: Callable[[Numbers], AbstractProblem]
    t1: float
    settings: Settings
    readings: dict[str, Callable[[Numbers, Any, LaneState], Any]]
    passes: bool = False

    def begin(self, values: Numbers) -> LaneScheduler:
        """The run that the sliders' numbers say, at its start."""
        t1, cells = jnp.asarray(self.t1), jnp.asarray(1)
        return LaneScheduler.of(self.problem(values), t1, cells, self.settings, passes=self.passes)

    def read(self, name: str, values: Numbers) -> Any:
        """A reading at the start of a run."""
        scheduler = self.begin(values)
        return self.readings[name](values, scheduler.problem, scheduler.fresh)


def written(simulator: Simulator, values: Numbers) -> str:
    """A simulator as an object of JavaScript.

    **Arguments:** `values`: numbers of the sliders, which only say how many there are.
    """

    def begin(values: Numbers) -> tuple[Any, LaneState]:
        scheduler = simulator.begin(values)
        return (scheduler.problem, scheduler.control, scheduler.atols), scheduler.fresh

    shapes = eqx.filter_eval_shape(begin, values)
    (constants, lane), static = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
    run = functools.partial(eqx.combine, static[0])
    time, state = lane.time, lane.state
    tableau = explicit_tableau(simulator.settings.for_lanes)
    kinds = 0 if lane.margins is None else len(lane.margins)
    places = len(watched_places(tableau))
    margins = jax.tree.map(lambda least: jax.ShapeDtypeStruct((places, *least.shape), least.dtype), lane.margins)
    tried = Step(state, state, state, time, time, margins)

    def after(constants: Any, lane: LaneState, length: Any, tried: Step) -> LaneState:
        problem, control, atols = run(constants)
        return after_step(problem, control, atols, lane, length, tried)

    functions: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "begin": (lambda values: eqx.filter(begin(values), eqx.is_array), (values,)),
        "length": (lambda constants, lane: length_to_try(run(constants)[1], lane), (constants, lane)),
        "field": (lambda constants, time, state: run(constants)[0].field(time, state), (constants, time, state)),
        "margins": (lambda constants, time, state: run(constants)[0].margins(time, state), (constants, time, state)),
        "crossing": (
            lambda constants, state, rate: run(constants)[0].crossing_along(state, rate),
            (constants, state, state),
        ),
        "after": (after, (constants, lane, time, tried)),
    }
    for name, read in simulator.readings.items():
        functions[name] = (
            lambda values, constants, lane, read=read: read(values, run(constants)[0], lane),
            (values, constants, lane),
        )
    inner = len(tableau.c) - 1 if tableau.fsal else len(tableau.c)
    facts = {
        "constants": _size(constants),
        "components": state.shape[0],
        "lane": _offsets(lane),
        "running": RUNNING,
        "stages": [row.tolist() for row in tableau.a_lower[:inner]],
        "places": np.asarray(tableau.c[:inner]).tolist(),
        "looks": stages_to_look(tableau.c),
        "kinds": kinds,
        "step": np.asarray(tableau.b_sol[: 1 + inner]).tolist(),
        "error": np.asarray(tableau.b_error).tolist(),
    }
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in functions.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in facts.items()), *lines]) + "}"


def _size(tree: Any) -> int:
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def _offsets(lane: LaneState) -> dict[str, int]:
    """Where each part of a lane begins, as its numbers stand one after another, and under `size` how many there are."""
    sizes = [_size(part) for part in lane]
    return dict(zip((*LaneState._fields, "size"), np.cumsum([0, *sizes]).tolist(), strict=True))
