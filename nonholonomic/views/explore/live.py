"""A page with sliders: its contents, and how they are combined into one file."""

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ...integration.status import Status
from ..page import Page, page, script, template
from ..stage import Stage
from .frame import Frame
from .hybrid_simulator import HybridSimulator
from .javascript import javascript
from .simulator import Numbers, Simulator


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
    facts = {
        "sliders": [slider._asdict() for slider in live.sliders],
        "words": {int(status): status.word for status in Status} | dict(live.answer.words),
        "answer": {"label": live.answer.label, "unit": live.answer.unit},
        "summaries": [summary._asdict() for summary in live.summaries],
        "layout": _layout(live.motion, values),
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


def _layout(motion: Simulator | HybridSimulator, values: Numbers) -> dict[str, Any]:
    return Frame(*eqx.filter_eval_shape(lambda values: motion.read("frame", values), values)).layout()
