"""Pages with sliders that simulate in the browser: their contents, their equations of motion as JavaScript generated from
jaxprs, and how all parts are combined into one file.
"""

import json
from collections.abc import Callable
from typing import Generic, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from ..hybrid import AbstractBatchedMode, HybridOutcome
from ..integration import Settings
from ..integration.problem import Status
from ..kernels import HybridRuns, HybridStart, Part, javascript
from ..text import Unit
from .pages import Page, page, script, template
from .stage import Kind, Stage, converted, curves_in

# The contents of a page at one time of a run, in the form for the player (`player.js`).


class Frame(NamedTuple, Generic[Kind]):
    """One moment of a run, or several, with bodies, traces, arrows and curves in the order of the `Show` of the page.

    - `normal`: normal of the arena, towards the body; `bodies`: position [m] and quaternion (x, y, z, w) of each body.
    - `traces`: the point of each trace [m], and the point to which it is relative, or `None`.
    - `arrows`: start [m] and vector of each arrow, in its unit; `curves`: a number for each curve.
    - `turning_rate`: greatest rotation rate of all parts [rad/s], which determines the number of frames.
    """

    normal: Float[Kind, "*times 3"]
    bodies: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 4"]], ...]
    traces: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"] | None], ...]
    arrows: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"]], ...]
    curves: tuple[Float[Kind, "*times"], ...]
    turning_rate: Float[Kind, "*times"]


Numbers = Float[Array, " numbers"]

Start = tuple[tuple[AbstractBatchedMode, ...], Int[Array, "1"], Float[Array, "components 1"]]


class Simulator(NamedTuple):
    """A run that is integrated in the browser.

    - `start`: function of the numbers of the sliders that returns the modes, the index of the first mode, and the
      initial state, for one cell.
    - `t1`: horizon [s]; `settings`: settings with an explicit Runge-Kutta solver of Diffrax; `counters`: rows of
      `Transition.counts`; `passes`: whether a run continues through its event.
    - `outcome`: function of the sliders' numbers and the `HybridOutcome` that returns the `Status` of the run, and the
      result, or infinity; of a drawn run, what it did after its event. `None` if neither is needed.
    - `frame`: function that returns the frame at any time; its arguments are the sliders' numbers, the index of the
      mode or -1 between modes, the output rows of the modes, and the time [s]. `None` if no path is needed.
    """

    start: Callable[[Numbers], Start]
    t1: float
    settings: Settings
    counters: int
    passes: bool
    outcome: Callable[[Numbers, HybridOutcome], PyTree] | None = None
    frame: Callable[[Numbers, Array, PyTree, Array], Frame] | None = None

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """

        def start(values: Numbers) -> HybridStart:
            return HybridStart(*self.start(values), jnp.full(1, self.t1), self.settings)

        runs = HybridRuns(start, self.counters, self.passes, is_shown=self.frame is not None)
        (facts, functions), kinds = runs.parts(values)
        first = jax.eval_shape(runs.first, values)
        if self.outcome is not None:
            functions["outcome"] = (self.outcome, (values, first))
        if self.frame is not None:
            mode = eqx.filter_eval_shape(start, values).modes[0]
            rows = eqx.filter_eval_shape(lambda mode, state: mode.shown(state), mode, first.state)
            examples = (values, first.mode, rows, first.end_time)
            functions["frame"], frame = (self.frame, examples), eqx.filter_eval_shape(self.frame, *examples)
            # For readers of the flat list of numbers of a frame.
            facts["layout"] = {
                "bodies": len(frame.bodies),
                "traces": [about is not None for _, about in frame.traces],
                "arrows": len(frame.arrows),
                "curves": len(frame.curves),
            }
        return as_object(Part(facts, functions), kinds=f"[{', '.join(map(as_object, kinds))}]")


def as_object(part: Part, **more: str) -> str:
    """A part of a program as a JavaScript object; `more`: text of further entries."""
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in part.functions.items()]
    lines += [f"{name}: {text}" for name, text in more.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in part.facts.items()), *lines]) + "}"


# A page with sliders: its contents, and how they are combined into one file.


class Slider(NamedTuple):
    """A slider: its `name` in the page's address, the `path` of its parameter, a `label`, its range and its value in the SI
    unit, the unit in which the page shows it, and the factor that converts to this unit."""

    name: str
    path: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    factor: float = 1.0


class LiveRun(NamedTuple):
    """The contents of a page with sliders.

    - `title`: title of the page.
    - `sliders`: the sliders; `allowed`: function that returns whether their numbers are legal in combination.
    - `answer`: the simulator whose `outcome` is the result of a run, which the page also shows as a map; `label`, `unit`: those
      of the result.
    - `motion`: the simulator of the drawn run, with its `frame`.
    - `summaries`: indices of the curves of the `Show` whose values at the start and the end of the run the page also shows as
      numbers, beside the result.
    - `afterwards`: what a run may do after its event, of which the `outcome` of `motion`, if it has one, returns the index.
    """

    title: str
    sliders: tuple[Slider, ...]
    allowed: Callable[[Numbers], Bool[Array, ""]]
    answer: Simulator
    label: str
    unit: str
    motion: Simulator
    summaries: tuple[int, ...]
    afterwards: tuple[str, ...] = ()


def live_page(live: LiveRun, stage: Stage, speed: float = 1.0, below: str = "", unit: Unit = None) -> Page:
    """The page of a run with sliders.

    **Arguments:** `stage`: a stage with one run, for its arena, meshes and names; `speed`, `below`: as for `page`; `unit`: that
    of curves, arrows and sliders, as for `in_unit`.

    **Raises:** `ValueError` for equations that cannot be written in JavaScript.
    """
    # The title and the warnings describe one run, but the sliders change the run.
    stage_of_live = stage._replace(title="", shows=tuple(show._replace(note="") for show in stage.shows))
    sliders = tuple(slider._replace(**converted(slider.unit, unit)) for slider in live.sliders)
    texts = (programs(live._replace(sliders=sliders)), template("map.js"), template("explore.js"))
    scripts = [script(text) for text in texts]
    section = f'<section id="below">{below}</section>'
    return page(curves_in([stage_of_live], unit), live.title, speed, template("explore.html"), section, scripts=scripts)


def programs(live: LiveRun) -> str:
    """The JavaScript of the simulation: the data of the sliders, all functions and the integrator, without a page."""
    values = jnp.array([slider.value for slider in live.sliders])
    facts = {
        "sliders": [slider._asdict() for slider in live.sliders],
        "words": {int(status): status.word for status in Status},
        "answer": {"label": live.label, "unit": live.unit},
        "summaries": live.summaries,
        "afterwards": live.afterwards,
    }
    parts = {
        "facts": json.dumps(facts),
        "answer": live.answer.javascript(values),
        "motion": live.motion.javascript(values),
        "allowed": javascript("", live.allowed, values),
    }
    return (
        f"window.live = {{{', '.join(f'{name}: {text}' for name, text in parts.items())}}};\n"
        f"{template('integrator.js')}"
    )
