"""The page of a user's own system: the equations for the browser, and the point that shows the state."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..hybrid import HybridOutcome
from ..integration import LaneState, Settings
from ..integration.status import CROSSED, FAILED, UNRESOLVED
from ..runs.explore import page_of
from ..runs.portrait import RADIUS, frame_of, plane_points, portraits
from ..validation import shown
from ..views import Stage
from ..views.explore import Answer, Frame, HybridSimulator, LiveRun, Simulator, Slider, Summary, ends_of
from .model import OwnModel

#: The tolerance in the page, and that of the runs that determine the drawn part of the plane.
TOLERANCE, DRAWN = 1e-7, 1e-5

#: Greatest number of steps of a run in the page.
MOST_STEPS_OF_A_PAGE = 50_000

#: Number of parameters with a slider by default, and rotations of the drawn point per run, which set the number of frames.
DEFAULT_SLIDERS, TURNS = 3, 40.0


def sliders_of(model: OwnModel, ranges: Any) -> tuple[Slider, ...]:
    """The sliders for the ranges that a user passes; by default, for the first parameters from half to twice their values."""
    if ranges is None:
        names = [name for name in model.parameters.known if "[*]" not in name and float(model.value(name))]
        names.sort(key=lambda name: name.startswith("start"))
        values = {name: float(model.value(name)) for name in names[:DEFAULT_SLIDERS]}
        ranges = {name: tuple(sorted((0.5 * value, 2.0 * value))) for name, value in values.items()}
    if not (isinstance(ranges, dict) and ranges and all(isinstance(name, str) for name in ranges)):
        raise ValueError(f"sliders = {shown(ranges)} must be a dictionary, name of a parameter -> (low, high)")
    paths = {name: model.full_name("sliders", name) for name in ranges}
    labels, sliders = model.label(list(paths.values())), []
    for name, path in paths.items():
        low, high = (float(end) for end in ranges[name])
        value = float(model.value(path))
        if not (np.isfinite([low, high]).all() and low < high and low <= value <= high):
            raise ValueError(
                f"sliders[{name!r}] = {shown(ranges[name])} must be two numbers, low < high, that contain the parameter's "
                f"own value, {value:g}: the page starts there"
            )
        sliders.append(Slider(name, path, labels[path][0].replace("_", " "), "", low, high, value))
    return tuple(sliders)


@page_of.register(OwnModel)
def live_run(model: OwnModel, ranges: Any, t1: float) -> tuple[LiveRun, Stage]:
    """The page of a model: its run, and the plane on which it is drawn."""
    sliders = sliders_of(model, ranges)
    models = [model, *(model.replaced({path: end}) for path, end in ends_of(sliders))]
    runs = [one.simulate(t1, None, DRAWN, None, None) for one in models]
    centre, scale = frame_of(np.concatenate([plane_points(run) for run in runs]))
    (stage,) = portraits(runs[:1], False, (centre, scale))
    settings = Settings(TOLERANCE, max_steps=MOST_STEPS_OF_A_PAGE)
    names = model.names

    def at(values: Float[Array, " numbers"]) -> OwnModel:
        return model.replaced({slider.path: value for slider, value in zip(sliders, values, strict=True)})

    def frame(values: Float[Array, " numbers"], number: Any, rows: Float[Array, "rows 1"], time: Any) -> Frame:
        components = at(values).components_of(rows[:, 0])
        point = (components[jnp.array([0, len(names) - 1])] - centre) * scale
        position = jnp.concatenate([point, jnp.full(1, RADIUS)])
        upright, normal = jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 1.0])
        rate = jnp.asarray(2.0 * np.pi * TURNS / t1) + 0.0 * point[0]
        return Frame(normal, ((position, upright),), ((position, None),), (), tuple(components), rate)

    def outcome(values: Float[Array, " numbers"], ended: Any) -> tuple[Array, Array]:
        status = at(values).ended(ended, settings.tolerance)[0]
        failed = (ended.status == FAILED) | (ended.status == UNRESOLVED)
        if model.has_event:
            result = jnp.where(ended.status == CROSSED, ended.crossing_time, jnp.inf)
        else:
            result = jnp.where(failed, jnp.inf, at(values).components_of(ended.state[:, 0])[0])
        return status, result[0] if result.ndim else result

    def last(values: Float[Array, " numbers"], problem: Any, lane: LaneState) -> tuple[Array, Array]:
        return outcome(values, lane._replace(crossing_time=lane.time))

    def last_hybrid(values: Float[Array, " numbers"], runs: HybridOutcome) -> tuple[Array, Array]:
        return outcome(values, runs)

    def lane_frame(values: Float[Array, " numbers"], problem: Any, lane: LaneState) -> Frame:
        return frame(values, 0, lane.state, lane.time)

    free = model.without_event()

    def free_at(values: Float[Array, " numbers"]) -> OwnModel:
        return free.replaced({slider.path: value for slider, value in zip(sliders, values, strict=True)})

    if model.smooth:
        answer: Any = Simulator(lambda values: at(values).problem(1, None), t1, settings, {"outcome": last})
        motion: Any = Simulator(lambda values: free_at(values).problem(1, None), t1, settings, {"frame": lane_frame})
    else:

        def start(model: OwnModel) -> Any:
            return model.modes(1, settings.tolerance, None, False)

        counters = len(model.counters)
        answer = HybridSimulator(lambda values: start(at(values)), t1, settings, counters, {"outcome": last_hybrid})
        motion = HybridSimulator(lambda values: start(free_at(values)), t1, settings, counters, {}, frame)
    label, unit = ("time of the event", "s") if model.has_event else (f"{names[0]} at the end", "")
    live = LiveRun(
        title=type(model.parameters.tree["system"]).__name__,
        sliders=sliders,
        allowed=lambda values: jnp.all(jnp.isfinite(values)),
        answer=Answer(label, unit, answer),
        motion=motion,
        summaries=tuple(Summary(name, "", k) for k, name in enumerate(names[:2])),
    )
    return live, stage
