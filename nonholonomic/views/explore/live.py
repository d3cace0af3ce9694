"""A page with sliders: its contents, and its problem for integration in the browser."""

import functools
import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from ...hybrid import MOST_ROUNDS, AbstractBatchedMode, AbstractHoppingMode, HybridOutcome
from ...hybrid.ensemble import after_reset, after_solve, at_start, mode_numbered, program_groups
from ...integration import AbstractProblem, LaneState, Settings, explicit_tableau
from ...integration.problem import LEFT_DOMAIN, RUNNING, UNRESOLVED, Status
from ...integration.runge_kutta import Step, inner_stages, middle_weights, watched_places
from ...integration.scheduler import LaneScheduler, back_to_margin, outcome_of, with_crossing_times
from ...integration.step import Control, after_step, length_to_try, looks_of
from ..pages import Page, page, script, template
from ..stage import Stage
from .javascript import javascript

# The contents of a page at one time of a run, in the form for the player (`player.js`).

Three = Float[Array, "3"]


class Frame(NamedTuple):
    """One moment of a run, with bodies, traces, arrows and curves in the order of the `Show` of the page.

    - `normal`: normal of the arena, towards the body; `bodies`: position [m] and quaternion (x, y, z, w) of each body.
    - `traces`: the point of each trace [m], and the point to which it is relative, or `None`.
    - `arrows`: start [m] and vector of each arrow, in its unit; `curves`: a number for each curve.
    - `turning_rate`: greatest rotation rate of all parts [rad/s], which determines the number of frames.
    """

    normal: Three
    bodies: tuple[tuple[Three, Float[Array, "4"]], ...]
    traces: tuple[tuple[Three, Three | None], ...]
    arrows: tuple[tuple[Three, Three], ...]
    curves: tuple[Float[Array, ""], ...]
    turning_rate: Float[Array, ""]


def quaternion(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The quaternion (x, y, z, w) of a rotation matrix, from its largest component (Shepperd 1978)."""
    m, trace = rotation, rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    # Four times the products of the quaternion's components, one row each.
    skew = (m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    symmetric = (m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1])
    squares = [1.0 - trace + 2.0 * m[k, k] for k in range(3)]
    rows = jnp.stack(
        [
            jnp.stack([squares[0], symmetric[0], symmetric[1], skew[0]]),
            jnp.stack([symmetric[0], squares[1], symmetric[2], skew[1]]),
            jnp.stack([symmetric[1], symmetric[2], squares[2], skew[2]]),
            jnp.stack([*skew, 1.0 + trace]),
        ]
    )
    row = rows[0]
    for k in range(1, 4):
        # `row` is the largest of the first k compared rows.
        row = jnp.where(rows[k, k] > jnp.max(jnp.stack([rows[j, j] for j in range(k)])), rows[k], row)
    return row / jnp.sqrt(jnp.sum(row * row))


# A problem for integration in the browser: its functions and its method, in JavaScript.
#
# Everything is generated from the objects that make tables (`nonholonomic.integration`), so both take the same steps. Only the
# loops over steps and stages are written by hand, in `integrator.js`.

Numbers = Float[Array, " numbers"]

#: Functions of a page by name, with examples of their arguments.
Functions = dict[str, tuple[Callable[..., PyTree], tuple[PyTree, ...]]]


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
    readings: dict[str, Callable[[Numbers, AbstractProblem, LaneState], PyTree]]
    passes: bool = False

    def begin(self, values: Numbers) -> LaneScheduler:
        """The run for the sliders' numbers, at its start."""
        t1, cells = jnp.asarray(self.t1), jnp.asarray(1)
        return LaneScheduler.of(self.problem(values), t1, cells, self.settings, nonterminal=self.passes)

    def read(self, name: str, values: Numbers) -> PyTree:
        """A reading at the start of a run."""
        scheduler = self.begin(values)
        return self.readings[name](values, scheduler.problem, scheduler.fresh)

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """
        stepper = stepper_of(self.begin, (values,), self.settings)
        functions = stepper.functions
        for name, read in self.readings.items():
            functions[name] = (
                lambda values, constants, lane, read=read: read(values, stepper.run(constants)[0], lane),
                (values, stepper.constants, stepper.lane),
            )
        return as_object(stepper.facts, functions)


class Stepper(NamedTuple):
    """The steps of a motion in JavaScript.

    - `constants`, `lane`: the shapes of the constants of a run, and of the lane; `run` computes problem, control and
      absolute tolerances from the constants.
    - `facts`: the sizes and the coefficients that `integrator.js` reads; `functions`: the functions that it calls.
    """

    constants: PyTree
    lane: LaneState
    run: Callable[[PyTree], tuple[AbstractProblem, Control, PyTree]]
    facts: dict[str, object]
    functions: Functions


def stepper_of(begin: Callable[..., LaneScheduler], examples: tuple[PyTree, ...], settings: Settings) -> Stepper:
    """The steps of a motion. **Arguments:** `begin`: function that returns the scheduler of one cell; `examples`: example
    arguments of this function; `settings`: settings of the steps."""
    shapes = eqx.filter_eval_shape(functools.partial(_started, begin), *examples)
    (constants, lane), static = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
    run, time, state = functools.partial(eqx.combine, static[0]), lane.time, lane.state
    tableau = explicit_tableau(settings.for_lanes)
    inner = inner_stages(tableau)
    # The stages at which margins and event function are evaluated, too.
    looks = looks_of(run(constants)[0], tableau, lane)
    places = len(watched_places(tableau, looks))
    margins = jax.tree.map(lambda least: jax.ShapeDtypeStruct((places, *least.shape), least.dtype), lane.margins)
    trial = Step(state, state, state, time, time, margins, (), state, None)

    functions: Functions = {
        "begin": (lambda *inputs: eqx.filter(_started(begin, *inputs), eqx.is_array), examples),
        "length": (
            lambda constants, lane: length_to_try(run(constants)[0], run(constants)[1], lane),
            (constants, lane),
        ),
        "field": (lambda constants, time, state: run(constants)[0].field(time, state), (constants, time, state)),
        "margins": (lambda constants, time, state: run(constants)[0].margins(time, state), (constants, time, state)),
        "crossing": (
            lambda constants, state, rate: run(constants)[0].crossing_along(state, rate),
            (constants, state, state),
        ),
        "after": (lambda constants, *step: after_step(*run(constants), *step), (constants, lane, time, trial)),
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
    return Stepper(constants, lane, run, facts, functions)


def _started(
    begin: Callable[..., LaneScheduler], *inputs: PyTree
) -> tuple[tuple[AbstractProblem, Control, PyTree], LaneState]:
    scheduler = begin(*inputs)
    return (scheduler.problem, scheduler.control, scheduler.atols), scheduler.fresh


def as_object(facts: Mapping[str, object], functions: Functions, **more: str) -> str:
    """A JavaScript object with facts and functions; `more`: text of further entries."""
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in functions.items()]
    lines += [f"{name}: {text}" for name, text in more.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in facts.items()), *lines]) + "}"


def size_of(tree: PyTree) -> int:
    """Number of numbers in a tree of arrays."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def offsets_of(parts: LaneState | HybridOutcome) -> dict[str, int]:
    """The offset of each part of a named tuple in its flat list of numbers, and under `size` the length of the list."""
    return dict(zip((*parts._fields, "size"), np.cumsum([0, *map(size_of, parts)]).tolist(), strict=True))


# A hybrid system for integration in the browser: its modes and transitions, in JavaScript.
#
# Everything is generated from the modes that make tables (`nonholonomic.hybrid`). Only the loops over rounds and over the
# stretches of a transition are written by hand, in `integrator.js`.

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
    readings: dict[str, Callable[[Numbers, HybridOutcome], PyTree]]
    frame: Callable[[Numbers, Array, PyTree, Array], Frame] | None = None

    def first(self, values: Numbers) -> HybridOutcome[Array]:
        """The run for the sliders' numbers, at its start."""
        _, mode, state = self.start(values)
        return at_start(mode, state, 1, self.counters)

    def read(self, name: str, values: Numbers) -> PyTree:
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

        def ended(constants: PyTree, lane: LaneState, runs: HybridOutcome) -> HybridOutcome:
            problem = stepper.run(constants)[0]
            outcome = with_crossing_times(problem, back_to_margin(problem, outcome_of(lane)))
            return after_solve(runs, outcome, t1)

        def reset(values: Numbers, runs: HybridOutcome) -> HybridOutcome:
            transition = mode_of(values, runs).reset_map(runs.state, _left(t1, runs))
            return after_reset(runs, transition, t1)

        def lost(values: Numbers, runs: HybridOutcome) -> PyTree:
            stretch = mode_of(values, runs).lost(runs.state)
            return stretch.open, stretch.elapsed, stretch

        def hop(values: Numbers, runs: HybridOutcome, stretch: PyTree) -> PyTree:
            state_after, following = mode_of(values, runs).hop(stretch, _left(t1, runs))
            return following.open, state_after.elapsed, following

        def between(values: Numbers, runs: HybridOutcome, stretch: PyTree, elapsed: Array) -> PyTree:
            mode = mode_of(values, runs)
            return mode.between(mode.motion_in(stretch), elapsed)

        stepper = stepper_of(begin, (values, runs), self.settings)
        functions, facts = stepper.functions, stepper.facts
        functions["ended"] = (ended, (stepper.constants, stepper.lane, runs))
        if not isinstance(mode, AbstractHoppingMode):
            functions["reset"] = (reset, (values, runs))
        else:
            stretch = eqx.filter_eval_shape(lost, values, runs)[2]
            facts |= {"stretch": size_of(stretch), "most_hops": mode.most_hops}
            functions |= {"lost": (lost, (values, runs)), "hop": (hop, (values, runs, stretch))}
            functions["closed"] = (
                lambda values, runs, stretch: after_reset(runs, mode_of(values, runs).closed(stretch), t1),
                (values, runs, stretch),
            )
            if self.frame is not None:
                functions["between"] = (between, (values, runs, stretch, runs.end_time))
        if self.frame is not None:
            functions["shown"] = (
                lambda values, runs, state: mode_of(values, runs).shown(state),
                (values, runs, runs.state),
            )
        return as_object(facts, functions)


def _left(t1: Float[Array, "1"], runs: HybridOutcome) -> Float[Array, "1"]:
    """Time to the horizon [s]."""
    return jnp.maximum(t1 - runs.end_time, 0.0)


# A page with sliders: its contents, and how they are combined into one file.


class Slider(NamedTuple):
    """A slider: its `name` in the page's address, the `path` of its parameter, a `label`, its unit, its range and its value."""

    name: str
    path: str
    label: str
    unit: str
    low: float
    high: float
    value: float


class Answer(NamedTuple):
    """The result of a run, which the page also shows as a map: its `label` and `unit`, and the `simulator` that
    computes it.

    The simulator has the reading "outcome": the `Status` of the run, and the result, or infinity. `words` contains the
    words of statuses to which the page gives another name.
    """

    label: str
    unit: str
    simulator: Simulator | HybridSimulator
    words: Mapping[int, str] = MappingProxyType({})


class Summary(NamedTuple):
    """A curve of the `Show` whose values at the start and the end of the run are also shown as numbers."""

    label: str
    unit: str
    curve: int


class LiveRun(NamedTuple):
    """The contents of a page with sliders.

    - `title`: title of the page.
    - `sliders`: the sliders; `allowed`: function that returns whether their numbers are legal in combination.
    - `answer`: the result of a run.
    - `motion`: the simulator of the drawn run, with the reading "frame", a `Frame`.
    - `summaries`: numbers shown beside the result.
    """

    title: str
    sliders: tuple[Slider, ...]
    allowed: Callable[[Numbers], Bool[Array, ""]]
    answer: Answer
    motion: Simulator | HybridSimulator
    summaries: tuple[Summary, ...]


def live_page(live: LiveRun, stage: Stage, speed: float = 1.0, below: str = "") -> Page:
    """The page of a run with sliders.

    **Arguments:** `stage`: a stage with one run, for its arena, meshes and names; `speed`, `below`: as for `page`.

    **Raises:** `ModuleNotFoundError` if the library for views is not installed; `ValueError` for equations that cannot be
    written in JavaScript.
    """
    # The title and the warnings describe one run, but the sliders change the run.
    stage_of_live = stage._replace(title="", shows=tuple(show._replace(note="") for show in stage.shows))
    scripts = [script(text) for text in (programs(live), template("explore/map.js"), template("explore/explore.js"))]
    section = f'<section id="below">{below}</section>'
    return page([stage_of_live], live.title, speed, template("explore/explore.html"), section, scripts=scripts)


def programs(live: LiveRun) -> str:
    """The JavaScript of the simulation: the data of the sliders, all functions and the integrator, without a page."""
    values = jnp.array([slider.value for slider in live.sliders])
    frame = Frame(*eqx.filter_eval_shape(lambda values: live.motion.read("frame", values), values))
    facts = {
        "sliders": [slider._asdict() for slider in live.sliders],
        "words": {int(status): status.word for status in Status} | dict(live.answer.words),
        "answer": {"label": live.answer.label, "unit": live.answer.unit},
        "summaries": [summary._asdict() for summary in live.summaries],
        # For readers of the flat list of numbers of a frame.
        "layout": {
            "bodies": len(frame.bodies),
            "traces": [about is not None for _, about in frame.traces],
            "arrows": len(frame.arrows),
            "curves": len(frame.curves),
        },
    }
    parts = {
        "facts": json.dumps(facts),
        "answer": live.answer.simulator.javascript(values),
        "motion": live.motion.javascript(values),
        "allowed": javascript("", live.allowed, values),
    }
    return (
        f"window.live = {{{', '.join(f'{name}: {text}' for name, text in parts.items())}}};\n"
        f"{template('explore/integrator.js')}"
    )
