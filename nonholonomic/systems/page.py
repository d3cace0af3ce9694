"""The page of a user's own system: the equations for the browser, and the point that shows the state."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..integration.status import CROSSED, FAILED, UNRESOLVED
from ..runs.explore import TOLERANCE, live_run, page_of, runs_at_ends, sliders_of
from ..runs.portrait import RADIUS, frame_of, plane_points, portraits
from ..views import Stage
from ..views.explore import Frame, LiveRun, Summary
from .model import OwnModel

#: Number of parameters with a slider by default, and rotations of the drawn point per run, which set the number of frames.
DEFAULT_SLIDERS, TURNS = 3, 40.0


def default_ranges(model: OwnModel) -> dict[str, Any]:
    """The default sliders: the first parameters that are not zero, from half to twice their values."""
    names = [name for name in model.known if "[*]" not in name and float(model.value(name))]
    names.sort(key=lambda name: name.startswith("start"))
    values = {name: float(model.value(name)) for name in names[:DEFAULT_SLIDERS]}
    return {name: tuple(sorted((0.5 * value, 2.0 * value))) for name, value in values.items()}


@page_of.register(OwnModel)
def page_of_system(model: OwnModel, ranges: Any, t1: float) -> tuple[LiveRun, Stage]:
    """The page of a model: its run, and the plane on which it is drawn."""
    sliders = sliders_of(model, default_ranges(model) if ranges is None else ranges)
    runs, names = runs_at_ends(model, sliders, t1), model.names
    centre, scale = frame_of(np.concatenate([plane_points(run) for run in runs]))
    (stage,) = portraits(runs[:1], False, (centre, scale))

    def outcome(model: OwnModel, problem: Any, ended: Any) -> tuple[Array, Array]:
        if model.has_event:
            time = ended.crossing_time if problem is None else ended.time
            result = jnp.where(ended.status == CROSSED, time, jnp.inf)
        else:
            failed = (ended.status == FAILED) | (ended.status == UNRESOLVED)
            result = jnp.where(failed, jnp.inf, model.components_of(ended.state[:, 0])[0])
        return model.ended(ended, TOLERANCE)[0], result[0]

    def frame(model: OwnModel, time: Any, rows: Array, mode: Any) -> Frame:
        components = model.components_of(rows[:, 0])
        point = (components[jnp.array([0, len(names) - 1])] - centre) * scale
        position = jnp.concatenate([point, jnp.full(1, RADIUS)])
        upright, normal = jnp.array([0.0, 0.0, 0.0, 1.0]), jnp.array([0.0, 0.0, 1.0])
        rate = jnp.asarray(2.0 * np.pi * TURNS / t1) + 0.0 * point[0]
        return Frame(normal, ((position, upright),), ((position, None),), (), tuple(components), rate)

    live = live_run(
        model,
        model.without_event(),
        sliders,
        t1,
        outcome,
        frame,
        title=type(model.parameters.tree["system"]).__name__,
        answer=("time of the event", "s") if model.has_event else (f"{names[0]} at the end", ""),
        summaries=tuple(Summary(name, "", k) for k, name in enumerate(names[:2])),
    )
    return live, stage
