"""A page with sliders that simulates any model in the browser."""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..integration import AbstractProblem, Settings
from ..integration.checks import run_bounds
from ..progress import status_line
from ..text import readable_unit, require_unit
from ..validation import IN_DEGREES, require_all, require_file, shown
from ..views import Page, Stage
from ..views.explore import Answer, Frame, HybridSimulator, LiveRun, Simulator, Slider, Summary, live_page
from ..views.stage import curves_in
from .model import AbstractModel, model_of

#: The tolerance in the page, and that of the runs that determine the drawn part of the arena.
TOLERANCE, DRAWN = 1e-7, 1e-5

#: Greatest number of steps of a run in the page; they take some hundred milliseconds.
MOST_STEPS_OF_A_PAGE = 50_000

#: Parameters that change the drawn meshes.
OF_MESHES = ("scene.surface.", "scene.body.radius", "scene.body.equatorial", "scene.body.polar", "scene.body.wheelbase")


@status_line("writing a page")
def explore(
    system: Any,
    start: Any,
    path: Any = None,
    sliders: dict[str, tuple[float, float]] | None = None,
    t1: float = 8.0,
    input: Any = None,
    unit: Any = None,
    jumps: Any = None,
) -> Page:
    """Make a page with sliders that simulates a run in the browser while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the
    Runge-Kutta pair and the step-size control are generated from those of tables, at a tolerance of 1e-7. A scene shows
    its body; your own system shows the first and the last component of its state as a point in a plane, and the curves of
    all components.

    **Arguments:**

    - `system`, `start`, `input`, `jumps`: as for `event_time`; the run that the page shows first.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value; the end of a name is enough if only one parameter
      matches.
    - `t1`: horizon [s].
    - `unit`: unit of the curves, such as "deg" for all angles, or several, such as ("deg", "cm").

    **Returns:** a `Page`, with its `html`.

    **Raises:** `ValueError` for arguments out of range, an unknown slider, or equations with an operation of JAX that cannot
    be written in JavaScript; `ModuleNotFoundError` if the library for views is not installed; `OSError` if the file cannot be
    written.

    **Example:** a page with a slider for the drag of a ball.

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     drag: float = 0.1
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -9.81 - self.drag * y[1]])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -0.8 * y[1]]), 0
    >>> page = nonholonomic.explore(nonholonomic.Hybrid([Ball()]), [1.0, 0.0], sliders={"drag": (0.0, 0.3)}, t1=2.0)
    >>> "range" in page.html
    True

    ```
    """
    return explore_model(model_of(system, start, None, input, jumps), path, sliders, float(t1), unit)


def explore_model(model: AbstractModel, path: Any, sliders: Any, t1: float, unit: Any) -> Page:
    """The page of a model. **Arguments:** as for `explore`."""
    if path is not None:
        require_file(path, "path", ".html", ".htm")
    require_all(run_bounds(t1, 1e-9))
    require_unit(unit)
    model.check()
    live, stage = page_of(model, sliders, t1)
    (stage,) = curves_in([stage], unit)
    html_page = live_page(live, stage)
    if path is not None:
        html_page.save(path)
    return html_page


@functools.singledispatch
def page_of(model: AbstractModel, sliders: Any, t1: float) -> tuple[LiveRun, Stage]:
    """The contents of the page of a model, and the stage on which the page draws the run.

    Each kind of model registers its own function.

    **Arguments:** as for `explore`.

    **Raises:** `ValueError` for an unknown slider, and for numbers that are out of range.

    **Example:**

    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> from nonholonomic.runs import model_of, page_of
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float = 2.0
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> live, stage = page_of(model_of(nonholonomic.Hybrid([Decay()]), [1.0]), {"rate": (1.0, 3.0)}, 1.0)
    >>> [slider.label for slider in live.sliders]
    ['rate']
    """
    raise NotImplementedError(f"{type(model).__name__} has no page")


def sliders_of(model: AbstractModel, ranges: Any, drawn: tuple[str, ...] = ()) -> tuple[Slider, ...]:
    """The sliders for the ranges that a user passes.

    **Arguments:** `ranges`: name of a parameter -> (lowest, highest) value; `drawn`: parameters, in addition to
    `OF_MESHES`, that change the drawn meshes.

    **Raises:** `ValueError` for an unknown name, an illegal range, and numbers that the modules do not allow.
    """
    if not (isinstance(ranges, dict) and ranges and all(isinstance(name, str) for name in ranges)):
        raise ValueError(
            f"sliders = {shown(ranges)} must be a dictionary, name of a parameter -> (low, high), such as "
            '{"theta": (0.05, 0.5)}'
        )
    sliders = []
    for name, ends in ranges.items():
        path = model.full_name("sliders", name)
        if path.startswith((*OF_MESHES, *drawn)):
            raise ValueError(
                f"sliders[{name!r}]: {path} changes the drawn arena or body, which a page cannot change; "
                "write a page for each value"
            )
        try:
            low, high = (float(end) for end in ends)
        except (TypeError, ValueError):
            low, high = math.nan, math.nan
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"sliders[{name!r}] = {shown(ends)} must be two numbers, (low, high), with low < high")
        value = float(model.value(path))
        short, unit, label = model.label([path])[path]
        if not low <= value <= high:
            in_degrees = unit == "rad" and low <= math.degrees(value) <= high
            raise ValueError(
                f"sliders[{name!r}] = {shown(ends)} must contain the parameter's own value, {value:g}: the page starts there"
                + (IN_DEGREES.format(shown(ends)) if in_degrees else "")
            )
        for end in (low, high):
            model.require_values({path: end})
        sliders.append(Slider(name, path, (label or short).replace("_", " "), readable_unit(unit), low, high, value))
    return tuple(sliders)


def runs_at_ends(model: AbstractModel, sliders: tuple[Slider, ...], t1: float) -> list[Any]:
    """The run of a model, and those at both ends of every slider, which determine what part of the arena is drawn."""
    ends = [{slider.path: end} for slider in sliders for end in (slider.low, slider.high)]
    others = [changed for changed in map(model.replaced, ends) if np.all(changed.legal())]
    return [changed.simulate(t1, None, DRAWN, None, None) for changed in (model, *others)]


def live_run(
    model: AbstractModel,
    drawn: AbstractModel,
    sliders: tuple[Slider, ...],
    t1: float,
    outcome: Callable[[Any, Any, Any], tuple[Array, Array]],
    frame: Callable[[Any, Any, Any, Any], Frame],
    *,
    title: str,
    answer: tuple[str, str],
    words: Mapping[int, str] | None = None,
    summaries: tuple[Summary, ...],
    motion: Callable[[Any], AbstractProblem] | None = None,
) -> LiveRun:
    """The contents of a page of any model.

    **Arguments:**

    - `model`, `drawn`: the model that answers, with its event, and that of the drawn run, for the same `sliders`.
    - `outcome`: function that returns the `Status` and the result of a run, or infinity; its arguments are the model, its
      problem and the `LaneState` at the end of a smooth run, or the model, `None` and a `HybridOutcome`.
    - `frame`: function that returns a frame; its arguments are the drawn model, the time, the rows of the state, and the
      index of the mode, `None` for a smooth run.
    - `answer`: label and unit of the result; the others as for `LiveRun` and `Answer`.
    - `motion`: function that returns the problem of a smooth drawn run; by default that of the model.
    """
    settings = Settings(TOLERANCE, max_steps=MOST_STEPS_OF_A_PAGE)

    def at(model: Any, values: Float[Array, " numbers"]) -> Any:
        return model.replaced({slider.path: value for slider, value in zip(sliders, values, strict=True)})

    if model.smooth:
        problem = motion or (lambda drawn: drawn.problem(1, None))
        answering: Any = Simulator(
            lambda values: at(model, values).problem(1, ()),
            t1,
            settings,
            {"outcome": lambda values, problem, lane: outcome(at(model, values), problem, lane)},
            model.continues and model.has_event,
        )
        moving: Any = Simulator(
            lambda values: problem(at(drawn, values)),
            t1,
            settings,
            {"frame": lambda values, problem, lane: frame(at(drawn, values), lane.time, lane.state, None)},
        )
    else:
        counters = len(model.counters)
        answering = HybridSimulator(
            lambda values: at(model, values).modes(1, settings.tolerance, (), False),
            t1,
            settings,
            counters,
            {"outcome": lambda values, runs: outcome(at(model, values), None, runs)},
        )
        moving = HybridSimulator(
            lambda values: at(drawn, values).modes(1, settings.tolerance, None, False),
            t1,
            settings,
            counters,
            {},
            lambda values, mode, rows, time: frame(at(drawn, values), time, rows, mode),
        )
    result = Answer(*answer, answering, words or {})
    return LiveRun(title, sliders, lambda values: jnp.all(at(model, values).legal()), result, moving, summaries)
