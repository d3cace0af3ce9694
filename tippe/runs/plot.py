"""The plot of the main job: theta(t) of every launch, as in the papers' figures 2 and 3 (needs matplotlib), and theta(t) of
a launch with flights."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Settings
from nonholonomic.integration.status import REACHED_END
from nonholonomic.parameters import numbers_of, with_numbers
from nonholonomic.runs import Ensemble, at_the_end
from nonholonomic.sweeps import chunk_for

from ..model.launch import Launch
from ..model.scene import Scene
from .checks import event_of
from .model import TopModel

Values = Float[np.ndarray, "..."]


class Panel(NamedTuple):
    """One arena and place: its title, times [s], theta [rad] of every launch (launches, times), theta(0), and the times
    of the dots."""

    title: str
    times: Values
    theta: Values
    starts: Values
    ends: Values


def draw_launches(panels: list[Panel], angle: float, dots: str) -> Any:
    """Draw theta(t) of every launch, a panel for each arena and place.

    **Arguments:**

    - `panels`: the panels; `ends` are the times [s] that get a dot, if finite.
    - `angle`: angle [rad] that counts as inverted; `dots`: description of the dots, above the plot.

    **Returns:** a matplotlib figure.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0 if len(panels) > 1 else 8.0, 4.2), layout="constrained")
    drawings = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for drawing, panel in zip(drawings, panels, strict=True):
        colours = colormaps["viridis"](np.linspace(0.0, 0.92, len(panel.starts)))
        for theta, start, end, colour in zip(panel.theta, panel.starts, panel.ends, colours, strict=True):
            drawing.plot(panel.times, theta, color=colour, label=f"{start:.4g}", linewidth=1.2)
            if np.isfinite(end):
                dot = {"color": colour, "markersize": 9, "markeredgecolor": "black", "zorder": 3}
                drawing.plot(end, np.interp(end, panel.times, theta), "o", **dot)
        drawing.axhline(angle, color="0.5", linewidth=0.8, linestyle="--")
        drawing.set_title(panel.title)
        drawing.set_xlabel("time [s]")
        drawing.set_yticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    drawings[0].set_ylabel("θ, angle from the normal to the stem [rad]")
    figure.suptitle(dots, fontsize=9, color="0.4")
    if len(panels[-1].starts) > 1:
        drawings[-1].legend(title="θ(0) [rad]", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def theta_over_time(
    scene: Scene, launch: Launch, times: Float[np.ndarray, " times"], tolerance: float, axes: Sequence[str]
) -> Float[np.ndarray, " times"]:
    """theta [rad] of one launch at the given increasing times, also in flight. A program that has computed a table
    compiles nothing more for its plot, whereas `simulate` compiles fifty programs.

    All cells of a table run this launch. Each cell runs to the first time of its own part of the times, and from there
    from time to time.

    **Arguments:** `axes`: full names of the parameters along the axes of that table, such as "launch.theta".
    """
    roots = {"scene": scene, "launch": launch}
    values, size, settings = numbers_of(roots), chunk_for(1), Settings(tolerance)
    cells = with_numbers(roots, {name: np.full(size, float(values[name])) for name in axes})
    model = TopModel.timed(**cells, angle=event_of(scene, None))
    ensemble = Ensemble.of(model, size, settings.tolerance, False)
    # No inclination exceeds pi, so no run ends before its time, in the programs of the table.
    never = {"cos_angle": jnp.asarray(-1.0)} | ({"stem_counts": jnp.zeros(())} if scene.has_stem else {})
    modes = tuple(dataclasses.replace(mode, **never) for mode in ensemble.modes or ())
    ensemble = dataclasses.replace(ensemble, modes=modes)
    parts = -(-len(times) // size)
    ends = np.pad(times, (0, size * parts - len(times)), mode="edge").reshape(size, parts)
    rows, goes = [], np.ones(size, bool)
    for spans in np.diff(ends, axis=1, prepend=0.0).T:
        outcome: Any = ensemble.solve(spans, size, settings)
        assert isinstance(outcome, HybridOutcome)
        theta = np.asarray(at_the_end(model, ensemble, outcome, settings.tolerance)[1]["end_theta"])
        rows.append(theta if not rows else np.where(goes, theta, rows[-1]))
        goes &= outcome.status == REACHED_END
        ensemble = dataclasses.replace(ensemble, states=outcome.state, first=outcome.mode)
    return np.stack(rows, axis=1).ravel()[: len(times)]
