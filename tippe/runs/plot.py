"""The plot of the main job: theta(t) of every launch, as in the papers' figures 2 and 3 (needs matplotlib)."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

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
                drawing.plot(
                    end,
                    np.interp(end, panel.times, theta),
                    "o",
                    color=colour,
                    markersize=9,
                    markeredgecolor="black",
                    zorder=3,
                )
        drawing.axhline(angle, color="0.5", linewidth=0.8, linestyle="--")
        drawing.set_title(panel.title)
        drawing.set_xlabel("time [s]")
        drawing.set_yticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    drawings[0].set_ylabel("θ, angle from the normal to the stem [rad]")
    figure.suptitle(dots, fontsize=9, color="0.4")
    if len(panels[-1].starts) > 1:
        drawings[-1].legend(title="θ(0) [rad]", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure
