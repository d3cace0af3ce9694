"""One run of any model: its quantities, its plots and its page."""

import abc
import dataclasses
import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from .. import views
from ..compilation.tracing import named_errors
from ..hybrid.ensemble import MOST_ROUNDS, HybridOutcome, OnlyMode, hybrid_resets
from ..integration.problem import CROSSED, AbstractProblem, Settings, Status, run_bounds
from ..parameters import of_all_modes
from ..sweeps import Quantity, Table, Tabular, run_table
from ..terminal import status_line
from ..text import Unit, as_text, distinguishing_labels, readable_unit, require_unit, shown, unit_of
from ..validation import IN_DEGREES, explaining, is_traced, require_all, require_one_run, times_within
from ..views import COLOURS, PALE, Arena, Ball, Box, Line, Page, Show, Stage, stage_of
from ..views.pages import Frame, LiveRun, Simulator, Slider, live_page, require_labels, require_page
from ..views.stage import Draw, Drawing, Parts, Wheel, meshes_of, of_grid
from .model import AbstractModel, Names, Sliders, model_of, run_of

# A page with sliders that simulates any model in the browser.

#: The tolerance in the page, and that of the runs that determine the drawn part of the arena.
TOLERANCE, DRAWN = 1e-7, 1e-5

#: Greatest number of steps of a run in the page; they take some hundred milliseconds.
MOST_STEPS_OF_A_PAGE = 50_000

#: Parameters that change the drawn meshes.
OF_MESHES = ("scene.surface.", "scene.body.radius", "scene.body.equatorial", "scene.body.polar", "scene.body.wheelbase")


@explaining
@status_line("writing a page")
def explore(
    system: object,
    start: object,
    path: str | Path | None = None,
    sliders: Sliders | None = None,
    t1: float = 8.0,
    input: object = None,
    unit: Unit = None,
    jumps: object = None,
    draw: Draw = None,
    label: str | None = None,
) -> Page:
    """Make a page with sliders that simulates a run in the browser while you move a slider.

    The page is one file that needs no network; a notebook shows the returned `Page`. The equations of motion, the
    Runge-Kutta pair and the step-size control are generated from those of tables, at a tolerance of 1e-7. A scene shows
    its body; your own system shows the first two components of its state as a point in a plane, or what `draw` returns, and
    the curves of all components.

    **Arguments:**

    - `system`, `start`, `input`, `jumps`: as for `event_time`; the run that the page shows first.
    - `path`: file to write the page to, or `None`.
    - `sliders`: name of a parameter -> (lowest, highest) value; the end of a name is enough if only one parameter
      matches.
    - `t1`: horizon [s].
    - `unit`: unit of the curves and of the sliders, such as "deg" for all angles, or several, such as ("deg", "cm").
    - `draw`: for your own system, as for `Trajectory.view`; a slider moves the parts, but cannot change their size.
    - `label`: title of the page.

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
    model = model_of(system, start, None, input, jumps)
    return explore_model(drawn_by(model, draw), path, sliders, float(t1), unit, label)


def drawn_by(model: Any, draw: Draw) -> Any:
    """The model of your own system with a drawing; raises `ValueError` for another model."""
    if draw is None:
        return model
    if not callable(draw) or not hasattr(model, "draw"):
        raise ValueError(
            f"draw = {shown(draw)} must be a function draw(system, t, y) for your own system, and None for a scene"
        )
    return dataclasses.replace(model, **{"draw": draw})


def explore_model(model: AbstractModel, path: Any, sliders: Sliders | None, t1: float, unit: Unit, label: Any) -> Page:
    """The page of a model. **Arguments:** as for `explore`."""
    require_page(path, "explore")
    require_all(run_bounds(t1, 1e-9))
    require_unit(unit)
    model.check()
    live, stage = page_of(model, sliders, t1)
    live = live if label is None else live._replace(title=require_labels([label], [model])[0])
    return live_page(live, stage, unit=unit or unit_of(model)).written(path)


@functools.singledispatch
def page_of(model: AbstractModel, sliders: Sliders | None, t1: float) -> tuple[LiveRun, Stage]:
    """The contents of the page of a model, and the stage on which the page draws the run.

    Each kind of model registers its own function.

    **Arguments:** as for `explore`.

    **Raises:** `ValueError` for an unknown slider, and for numbers that are out of range.

    **Example:**

    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> from nonholonomic.runs import model_of
    >>> from nonholonomic.runs.trajectory import page_of
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


def sliders_of(model: AbstractModel, ranges: object, drawn: tuple[str, ...] = ()) -> tuple[Slider, ...]:
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
        sliders.append(Slider(name, path, label.replace("_", " ") or short, readable_unit(unit), low, high, value))
    return tuple(sliders)


def runs_at_ends(model: AbstractModel, sliders: tuple[Slider, ...], t1: float) -> list[Any]:
    """The run of a model, and those at both ends of every slider, which determine what part of the arena is drawn."""
    ends = [{slider.path: end} for slider in sliders for end in (slider.low, slider.high)]
    others = [changed for changed in map(model.replaced, ends) if np.all(changed.legal())]
    return [run_of(changed, t1, None, DRAWN) for changed in (model, *others)]


def live_run(
    model: AbstractModel,
    drawn: AbstractModel,
    sliders: tuple[Slider, ...],
    t1: float,
    frame: Callable[[Any, Any, Any, Any], Frame],
    *,
    title: str,
    answer: tuple[str, str],
    summaries: tuple[int, ...],
    named: Mapping[Status, Status] | None = None,
    result: Callable[[Any, HybridOutcome, Array], Array] | None = None,
    motion: Callable[[Any], AbstractProblem] | None = None,
    afterwards: Callable[..., Array] | None = None,
) -> LiveRun:
    """The contents of a page of any model.

    **Arguments:**

    - `model`, `drawn`: the model that answers, with its event, and that of the drawn run, for the same `sliders`.
    - `frame`: function that returns a frame; its arguments are the drawn model, the time, the rows of the state, and the
      index of the mode, `None` for a smooth run.
    - `answer`: label and unit of the result; the others as for `LiveRun`.
    - `named`: statuses in place of others, as in a table.
    - `result`: function of the model, the outcome and the integer of its `Status` that returns the result, or infinity; by
      default the time of the event.
    - `motion`: function that returns the problem of a smooth drawn run; by default that of the model.
    - `afterwards`: function of the drawn model and its outcome that returns an index of the `afterwards` of the `LiveRun`.
    """
    settings = Settings(TOLERANCE, max_steps=MOST_STEPS_OF_A_PAGE)

    def at(model: Any, values: Float[Array, " numbers"]) -> Any:
        return model.replaced({slider.path: value for slider, value in zip(sliders, values, strict=True)})

    def start(model: Any, names: Names, motion: Callable[[Any], AbstractProblem] | None = None) -> Any:
        if not model.smooth:
            return model.modes(1, settings.tolerance, names, False)
        problem = model.problem(1, names) if motion is None else motion(model)
        return (OnlyMode(problem),), jnp.zeros(1, int), problem.start()[0]

    def outcome(values: Float[Array, " numbers"], ended: HybridOutcome) -> tuple[Array, Array]:
        answering, time = at(model, values), jnp.where(ended.status[0] == CROSSED, ended.crossing_time[0], jnp.inf)
        status = answering.ended(ended, TOLERANCE)[0]
        number = time if result is None else result(answering, ended, status)
        for code, other in (named or {}).items():
            status = jnp.where(status == int(code), int(other), status)
        return status, number

    options = (t1, settings, len(model.counters))
    answer_of = Simulator(
        lambda values: start(at(model, values), ()),
        *options,
        model.smooth and model.continues and model.has_event,
        outcome=outcome,
    )
    moving = Simulator(
        lambda values: start(at(drawn, values), None, motion),
        *options,
        False,
        outcome=afterwards and (lambda values, ended: afterwards(at(drawn, values), ended)),
        frame=lambda values, mode, rows, time: frame(at(drawn, values), time, rows, None if model.smooth else mode),
    )
    return LiveRun(
        title, sliders, lambda values: jnp.all(at(model, values).legal()), answer_of, *answer, moving, summaries
    )


# Pictures of a user's system: what its function `draw` returns, or a point in the plane of two components; and curves.

#: Half the longer side of the plane in which a point is drawn, the radius of the point, and its size for the camera [m].
HALF, RADIUS, SIZE = 1.0, 0.05, 0.4

#: Components whose spans have at most this ratio have one scale, as the coordinates of a path; the ratio for components named
#: x, y or z. A second component that differs from the rate of the first by less than this part of its span has its own scale.
EQUAL, EQUAL_PLACES, RATE = 4.0, 20.0, 0.1

#: In units of the size of a drawing: the width of lines and traces, and the ground around it. The height of the camera in units
#: of its distance along the ground.
WIDTH, MARGIN, RISE = 0.03, 0.3, 0.7


def drawing_of(
    model: Any, t: np.ndarray, states: list[np.ndarray]
) -> tuple[Drawing, str, str, tuple[tuple[str, float, float], ...]]:
    """The function that draws the states of a model, the title, the name of the path, and the axes of the `Arena`.

    By default, a state is a point in the plane of its first two components, or on a line if it has one component.
    **Arguments:** `t`: the times of the first of the `states`.
    """
    if model.draw:
        return model.draw, model.title, "path", (("x [m]", 0.0, 1.0), ("y [m]", 0.0, 1.0))
    points = np.pad(np.concatenate(states), ((0, 0), (0, 1)))[:, :2]
    low, span = points.min(axis=0), np.ptp(points, axis=0)
    centre = low + 0.5 * span
    span = np.where(span > 0.0, span, np.max(span) or 1.0)
    names, (first, second) = model.names[:2], points[: len(t)].T
    with np.errstate(all="ignore"):
        error = np.nanmedian(np.abs(np.gradient(first, t) - second)) if len(t) > 1 else np.inf
    equal = 0.0 if error < RATE * np.ptp(second) else EQUAL_PLACES if set(names) <= set("xyz") else EQUAL
    scale = 2.0 * HALF / (np.full(2, np.max(span)) if np.max(span) < equal * np.min(span) else span)

    def draw(system: object, t: Array, y: Array) -> list[Ball]:
        x, y = ((part - middle) * by for part, middle, by in zip((*y, 0.0), centre, scale, strict=False))
        return [Ball((x, y, RADIUS), RADIUS)]

    path = " over ".join(names[::-1])
    return draw, f"{model.title}: {path}", path, tuple(zip(names, centre.tolist(), scale.tolist(), strict=False))


def frame_of(draw: Drawing, system: object, t: Array, state: Array, rate: Any = 0.0) -> tuple[Parts, Array, Frame]:
    """What is drawn of one state: the parts; their corners; and the frame, with a body without meshes amid the parts, the
    parts, and the lines. **Arguments:** `rate`: greatest rotation rate of all parts [rad/s].

    **Raises:** `ValueError` if `draw` fails or returns anything but a list of parts with numbers of the right shapes.
    """
    with named_errors("draw(system, t, y)", "the system, the time and the state"):
        parts = draw(system, t, state)
    if not isinstance(parts, list) or not parts or not all(isinstance(part, Box | Wheel | Line) for part in parts):
        raise ValueError(f"draw must return a list of Box, Wheel, Disc, Ball and Line, not {shown(parts)}")
    for part in parts:
        kind, shapes = type(part).__name__, {name: np.shape(value) for name, value in vars(part).items()}
        for name, shape in shapes.items():
            is_vector = name in ("place", "lengths", "begin", "end")
            if shape != ((3,) if is_vector else ()):
                words = "three numbers, (x, y, z) in metres" if is_vector else "one number"
                raise ValueError(f"draw: {name} in {kind} must be {words}, not of shape {shape}")
    solids = [part for part in parts if isinstance(part, Box | Wheel)]
    lines = [part for part in parts if isinstance(part, Line)]
    points = [*(part.place for part in solids), *(end for line in lines for end in (line.end, line.begin))]
    middle = sum(points[1:], points[0]) / len(points)
    bodies, corners = [(middle, jnp.array([0.0, 0.0, 0.0, 1.0]))], points.copy()
    for part in solids:
        half = 0.5 * part.lengths if isinstance(part, Box) else part.radius
        corners += [part.place - half, part.place + half]
        halves = [0.5 * jnp.asarray(angle) for angle in (part.heading, part.lean, part.spin)]
        (c, d, e), (s, r, q) = map(jnp.cos, halves), map(jnp.sin, halves)
        # The quaternion (x, y, z, w) of the lean after the spin, then that of the heading after these.
        x, y, z, w = r * e, d * q, r * q, d * e
        bodies.append((part.place, jnp.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])))
    arrows = tuple((line.begin, line.end - line.begin) for line in lines)
    frame = Frame(jnp.array([0.0, 0.0, 1.0]), tuple(bodies), ((points[0], None),), arrows, tuple(state), rate)
    return parts, jnp.stack(corners), frame


def show_of(
    name: str, colour: int, path: str, names: Sequence[str], size: float, drawn: tuple[np.ndarray, Parts, Frame]
) -> Show:
    """The drawing of a run. **Arguments:** `path`: name of its trace; `names`: those of its curves; `size`: that of the
    drawing [m]; `drawn`: the times, the parts and the frames."""
    t, parts, frame = drawn
    solids = [part for part in parts if isinstance(part, Box | Wheel)]
    for part in solids:
        sizes = np.asarray(part.lengths if isinstance(part, Box) else part.radius)
        if not np.allclose(sizes, sizes[:1]):
            raise ValueError(f"draw: the size of a {type(part).__name__} must not change in time; its place may")
    meshes = [(), *(meshes_of(part, colour) for part in jax.tree.map(lambda leaf: leaf[0], solids))]
    poses = zip(frame.bodies, meshes, strict=True)
    bodies = tuple(views.Body(*pose, mesh) for pose, mesh in poses)
    lines = zip([part for part in parts if isinstance(part, Line)], frame.arrows, strict=True)
    arrows = tuple(
        views.Arrow("line", begin, vector, "", 1.0, line.colour, 0.5 * (line.width or WIDTH * size))
        for line, (begin, vector) in lines
    )
    traces = (views.Trace(path, frame.traces[0][0], colour, WIDTH * size),)
    curves = tuple(views.Curve(name, "", values) for name, values in zip(names, frame.curves, strict=True))
    return Show(name, colour, t, frame.normal, size, bodies, traces, arrows, curves)


def drawn_stage(runs: list["Trajectory"], numbers: Sequence[int], names: Sequence[str]) -> tuple[Drawing, Stage]:
    """The function that draws runs, and the stage that shows the first of them.

    **Arguments:** `runs`: these runs, and others for which the ground must have room; `numbers`, `names`: as for
    `views.stage_of`, of the runs that the stage shows.

    **Raises:** `ValueError` for a batch of runs, a run without a finite state, and a function that draws NaN.
    """
    models: list[Any] = [run.model for run in runs]
    reached = []
    for run in runs:
        require_one_run(run, "a picture", ", and pass the others as others=")
        is_reached = np.all(np.isfinite(np.asarray(run.state)), axis=-1)
        if not np.any(is_reached):
            raise ValueError(f"a picture needs a finite state, but the run, with status {run.status!r}, has none")
        reached.append((np.asarray(run.t)[is_reached], np.asarray(run.state)[is_reached]))
    draw, title, path, axes = drawing_of(models[0], reached[0][0], [state for _, state in reached])
    size, corners, drawn = 0.0 if models[0].draw else SIZE, [], []
    for model, (t, state) in zip(models, reached, strict=True):
        draw_state = functools.partial(frame_of, draw, model.parameters.tree["system"])
        parts, ends, frame = jax.tree.map(np.asarray, jax.vmap(draw_state)(t, state))
        is_finite = np.all(np.isfinite(ends), axis=(1, 2))
        if not np.all(is_finite):
            raise ValueError(f"draw returned NaN or infinity at t = {t[np.argmin(is_finite)]:g}")
        size = max(size, float(np.max(np.linalg.norm(ends - frame.bodies[0][0][:, None], axis=-1))))
        corners.append(ends.reshape(-1, 3))
        drawn.append((t, parts, frame))
    size = size or 1.0
    low, high = (end(np.concatenate(corners), axis=0) for end in (np.min, np.max))
    low, high = np.append(low[:2] - MARGIN * size, min(0.0, low[2])), high + MARGIN * size
    ground = np.array([(x, y, low[2]) for x in (low[0], high[0]) for y in (low[1], high[1])])
    arena = Arena(views.Mesh(ground, of_grid(2, 2)[:, ::-1], PALE), (), "", np.array([0.0, 0.0, 1.0]), axes)
    shows = tuple(
        show_of(name, COLOURS[number % len(COLOURS)], path, model.names, size, of_run)
        for name, number, model, of_run in zip(names, numbers, models, drawn, strict=False)
    )
    return draw, Stage(title, arena, shows, rise=RISE if models[0].draw else 2.0 * RISE)


# One run of a user's system at given times.

#: Why a run ended early, by its word.
REASONS = {
    "failed": "a function may return NaN or infinity there, or `reset` the index of a mode that the Hybrid does not have",
    "unresolved": "resets followed one another without end; add a mode for rest, or start where the margin is positive; or "
    f"the run is too long: it may have at most {MOST_ROUNDS} resets",
}


class AbstractRun(Tabular, eqx.Module):
    """A run of any model at its times `t`, the first axis of its arrays; a batch has an axis before it."""

    #: The model of the run, and the end of the runs on its page [s].
    of_page: ClassVar[tuple[AbstractModel, float]]

    #: How the runs of a batch ended, as integers of `Status`; `None` if this is unknown.
    codes: ClassVar[Any] = None

    @abc.abstractmethod
    def in_words(self) -> str:
        """The text of a single run."""

    def explore(
        self,
        path: str | Path | None = None,
        sliders: Sliders | None = None,
        unit: Unit = None,
        draw: Draw = None,
        label: str | None = None,
    ) -> Page:
        """A page with sliders that simulates the run in the browser, until its end; see `nonholonomic.explore`.

        **Raises:** as for `nonholonomic.explore`, and `ValueError` for a batch of runs.
        """
        require_one_run(self, "explore", "")
        model, t1 = self.of_page
        return explore_model(drawn_by(model, draw), path, sliders, t1, unit, label)

    @status_line("reading off")
    def to_table(self) -> Table:
        return self.table_of(())

    def drawn_by(self, draw: Draw) -> Any:
        """The run with a drawing for its pictures; raises `ValueError` unless it is one of your own system."""
        return dataclasses.replace(self, **{"model": drawn_by(getattr(self, "model", None), draw)})

    @status_line("reading off")
    def __str__(self) -> str:
        # A batch, or a run inside a transformation, has no single values to show.
        if is_traced((self.t, self.codes)) or np.ndim(self.t) != 1:
            *batch, times = np.shape(self.t)
            traced_run = f"Trajectory of {times} times, inside a transformation"
            runs = f"{math.prod(batch)} runs of {times} times" if batch else traced_run
            codes = [] if self.codes is None or is_traced(self.codes) else np.ravel(self.codes)
            counts = Counter(Status(int(code)).word for code in codes)
            return ": ".join(filter(None, [runs, ", ".join(f"{count} {word}" for word, count in counts.items())]))
        return self.in_words()


class Trajectory(AbstractRun):
    """A run of your own system at given times. The times are the first axis of the arrays; `jax.vmap` adds an axis
    before it.

    - `t`: times [s], (times,).
    - `state`: (times, components), NaN after the end of the run; for an `AbstractSystem` the coordinates, followed by
      their rates. At the time of a reset, this is the state before the reset.
    - `mode`: index of the mode, (times,), -1 after the end.
    - `end_time`: time at which the run ended [s]; `switches`: number of resets.
    - `steps`, `rejected`: numbers of all integration steps and of rejected steps.
    - `code`: the status as an integer of `Status`.
    - `names`: names of the components in tables; `run[name]` is a component at the times, and so is `run.height` for a
      component named "height".
    - `model`, `t1`, `settings`: the model, the horizon and the settings of the integration.

    Pictures also show the states before and after each reset, whatever the times.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> run = nonholonomic.simulate(nonholonomic.Hybrid([Decay(2.0)]), [1.0], 1.0, times=[0.5, 1.0])
    >>> print(run.status, run.state.shape, f"{run.state[-1, 0]:.6f}")  # exp(-2)
    completed (2, 1) 0.135335

    ```
    """

    readable: ClassVar[tuple[str, ...]] = ("state",)

    t: Float[Array, " times"]
    state: Float[Array, "times components"]
    mode: Int[Array, " times"]
    end_time: Float[Array, ""]
    switches: Int[Array, ""]
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    code: Int[Array, ""]
    model: AbstractModel
    t1: Float[Array, ""]
    settings: Settings
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def status(self) -> Any:
        """How the run ended: "completed" at `t1`; "stopped" if a mode without a reset ended; "failed"; "unresolved"
        if resets followed one another without end; or, inside a transformation, "illegal" for a start that raises an error
        elsewhere.

        For a batch of runs, an array of words; inside a transformation, the integer.
        """
        if is_traced(self.code):
            return self.code
        words = np.vectorize(lambda code: Status(code).word, otypes=[object])(np.asarray(self.code))
        return str(words) if words.ndim == 0 else words.astype(str)

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        # A copy has no model at first.
        return self.model.quantities if "model" in vars(self) else {}

    @property
    def portrait_axes(self) -> tuple[str, str]:
        return self.names[0], self.names[:2][-1]

    @property
    def of_page(self) -> tuple[AbstractModel, float]:
        return self.model, float(self.t1)

    @property
    def codes(self) -> Int[Array, "..."]:
        return self.code

    @functools.cached_property
    def resets(self) -> Table:
        """The resets of the run, a `Table` with a row for each: its `time` [s], the indices `mode_before` and
        `mode_after`, and the components of the state, such as `y0_before` and `y0_after`; with several margins also `margin`,
        the name or the index of the one that fell. The run is repeated for it.

        **Raises:** `ValueError` inside transformations and for a batch of runs: `mode` and `switches` are there.
        """
        if not self._is_one_run:
            raise ValueError(
                "resets takes one run outside jit, vmap and grad; run.mode and run.switches work there too"
            )
        resets = []
        if not self.model.smooth and int(self.switches):
            modes, first, states = self.model.without_event().modes(1, self.settings.tolerance, None, False)
            start = (modes, int(np.asarray(first)[0]), np.asarray(states)[:, 0])
            changes = hybrid_resets(*start, float(self.t1), self.settings, counters=len(self.model.counters))
            # The end of a mode without a reset is not counted.
            resets = [pair for pair in changes if np.any(pair[1].counts > pair[0].counts)]
        columns = {"time": np.array([after.end_time[0] for _, after in resets], float)}
        for k, word in enumerate(("before", "after")):
            columns[f"mode_{word}"] = np.array([pair[k].mode[0] for pair in resets], int)
        model: Any = self.model
        for k, word in enumerate(("before", "after")):
            states = [model.components_of(jnp.asarray(pair[k].state[:, 0])) for pair in resets]
            components = np.array(states, float).reshape(-1, len(self.names))
            columns |= {f"{name}_{word}": components[:, part] for part, name in enumerate(self.names)}
        if resets and max(model.form.traits.ends) > 1:
            columns["margin"] = np.array([modes[before.mode[0]].fallen(before.state[:, 0]) for before, _ in resets])
        return Table({"reset": np.arange(1, len(resets) + 1)}, columns, {"time": "s"}, {})

    @property
    def _is_one_run(self) -> bool:
        """Whether this is a single run outside of transformations."""
        return not is_traced(self.code) and np.ndim(self.code) == 0

    def _with_resets(self) -> "Trajectory":
        """The run with the states before and after each reset in addition, so that its lines do not cut corners; a batch,
        and a run of one time, stay unchanged."""
        if not self._is_one_run or len(self.t) < 2 or not int(self.switches):
            return self
        resets, t = self.resets, np.asarray(self.t)
        is_within = (resets["time"] >= t[0]) & (resets["time"] <= t[-1])
        times = np.repeat(resets["time"][is_within], 2)
        places = np.searchsorted(t, times, side="right")

        def added(before: str, after: str) -> np.ndarray:
            return np.stack([resets[before][is_within], resets[after][is_within]], axis=-1).reshape(-1)

        states = np.stack([added(f"{name}_before", f"{name}_after") for name in self.names], axis=-1)
        t, state, mode = np.insert(t, places, times), np.asarray(self.state), np.asarray(self.mode)
        state = np.insert(state, places, states, axis=0)
        mode = np.insert(mode, places, added("mode_before", "mode_after"))
        return dataclasses.replace(self, t=t, state=state, mode=mode)

    def to_table(self) -> Table:
        """The run as a `Table` over its times.

        **Raises:** `ValueError` for a batch of runs.
        """
        require_one_run(self, "to_table", "; nonholonomic.sweep makes a table of many")
        columns = {name: np.asarray(self[name]) for name in self.model.quantities} | {"mode": np.asarray(self.mode)}
        request = self.model.description() | {"status": self.status, "end_time": float(self.end_time)}
        quantities = self.model.quantities | {"mode": Quantity("1", "mode")}
        return run_table(quantities, {"time": np.asarray(self.t)}, columns, ["time"], request)

    def at(self, times: ArrayLike | Sequence[float]) -> "Trajectory":
        """The same run at other times; the run is repeated.

        **Arguments:** `times`: increasing, within [0, `end_time`] [s]; or one time, for a run of one time.

        **Raises:** `ValueError` for times outside the run, and for a batch of runs.
        """
        if not self._is_one_run:
            raise ValueError("at takes one run outside jit, vmap and grad: pass times= to simulate there")
        times = times_within(times, self.end_time, "run")
        return run_of(self.model, self.t1, times, self.settings.tolerance, self.settings.solver)

    def table_of(self, names: Sequence[str]) -> Table:
        """The table that pictures draw, with the states before and after each reset."""
        return self._with_resets().to_table()

    def labels_of(self, runs: list[Any], unit: Unit) -> list[str]:
        """Labels that tell runs apart by the numbers of their systems and starts that differ."""
        models = [run.model for run in runs]
        names = models[0].known
        if any(model.known != names for model in models):
            return Tabular.labels_of(self, runs, unit)
        values = {name: [as_text(model.value(name)) for model in models] for name in names}
        texts = [[f"{label} {text}" for text in values[name]] for name, label in brief_names(values).items()]
        numbers = list(zip(*texts, strict=True))
        return distinguishing_labels(numbers) if len(set(numbers)) > 1 else Tabular.labels_of(self, runs, unit)

    def in_words(self) -> str:
        table = str(self.to_table()).splitlines()[1 : 1 + len(self.names)]
        lines = [f"Trajectory of {np.size(self.t)} times, {self.status} at {float(self.end_time):.6g} s", *table]
        lines.append(f"  resets: {int(self.switches)}")
        lines.append(f"  steps: {int(self.steps)}, of which {int(self.rejected)} rejected")
        if self.status in REASONS:
            lines.append(f"  {REASONS[self.status]}")
        return "\n".join(lines)


def brief_names(values: dict[str, list[str]]) -> dict[str, str]:
    """The parameters that a label may name: full name -> its last part, or the full name if several names end alike.

    A parameter with the same value in all modes that have it counts once, under its name for all modes. All other
    parameters count under their names in each mode.

    **Arguments:** `values`: full name -> the value in each run.
    """
    groups = {name: [single for single in values if single != name == of_all_modes(single)] for name in values}
    shared = {name for name, group in groups.items() if group and all(values[k] == values[name] for k in group)}
    names = [name for name in values if name in shared or not (groups[name] or of_all_modes(name) in shared)]
    ends = [name.rsplit(".", 1)[-1] for name in names]
    return {name: end if ends.count(end) == 1 else name for name, end in zip(names, ends, strict=True)}


@stage_of.register(Trajectory)
def _(run: Trajectory, runs: list[Trajectory], numbers: Sequence[int], names: Sequence[str]) -> Stage:
    return drawn_stage([run._with_resets() for run in runs], numbers, names)[1]
