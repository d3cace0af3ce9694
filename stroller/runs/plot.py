"""The plot of the main job (needs matplotlib): paths on the ground, speed, energy and side forces."""

from typing import Any

import numpy as np

from nonholonomic.geometry import AbstractQuadric, AbstractSurface
from nonholonomic.views import COLOURS, css

from .trajectory import Trajectory


def draw_rides(grounds: dict[str, AbstractSurface], rides: dict[tuple[str, str], Trajectory]) -> Any:
    """Draw rides, one row of plots per ground.

    **Arguments:**

    - `grounds`: name of a ground -> the ground.
    - `rides`: (name of a ground, name of a ride) -> its trajectory.

    **Returns:** a matplotlib figure.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(18.0, 4.2 * len(grounds)), layout="constrained")
    layout = figure.add_gridspec(len(grounds), 4, width_ratios=(1.5, 1.0, 1.0, 1.0))
    # As on the page, whose curves are those of all grounds.
    colours = {name: css(COLOURS[number % len(COLOURS)]) for number, name in enumerate(rides)}
    for row, (name, ground) in enumerate(grounds.items()):
        on_ground = {ride: run for (place_name, ride), run in rides.items() if place_name == name}
        space = figure.add_subplot(layout[row, 0], projection="3d")
        _draw_ground(space, ground, on_ground)
        panels = [figure.add_subplot(layout[row, column]) for column in (1, 2, 3)]
        for ride, run in on_ground.items():
            colour = colours[name, ride]
            space.plot(*np.asarray(run.position).T, color=colour, linewidth=1.4, label=ride)
            panels[0].plot(run.t, run.speed, color=colour)
            panels[1].plot(run.t, run.energy, color=colour)
            panels[1].plot(run.t, run.energy[0] + run.work, color="black", linewidth=0.8, linestyle=":")
            panels[2].plot(run.t, run.side_force[:, 0], color=colour)
            panels[2].plot(run.t, run.side_force[:, 1], color=colour, linestyle="--")
        space.set_title(name)
        space.legend(fontsize="small")
        for panel, label in zip(panels, ("speed [m/s]", "energy [J]", "side force [N]"), strict=True):
            panel.set_xlabel("time [s]")
            panel.set_ylabel(label)
        # The legend beside the path explains the colours; this one explains the line styles, above, where it hides
        # nothing.
        panels[1].set_title("dotted: start plus work", fontsize="small")
        panels[2].set_title("full: rear axle, dashed: front wheel", fontsize="small")
    return figure


def _draw_ground(space: Any, ground: AbstractSurface, rides: dict[str, Trajectory]) -> None:
    """A wire frame of the ground as far as the rides go."""
    from matplotlib.ticker import MaxNLocator

    places = np.concatenate([np.asarray(run.place) for run in rides.values()])
    first, second = (
        np.linspace(part.min() - 0.3, part.max() + 0.3, 13) if unit == "m" else np.linspace(-np.pi, np.pi, 49)
        for part, (_, unit) in zip(places.T, ground.coordinates, strict=True)
    )
    if isinstance(ground, AbstractQuadric):
        second = np.linspace(-np.pi / 2, min(places[:, 1].max() + 0.1, np.pi / 2), 13)
    grid = tuple(np.meshgrid(first, second, indexing="ij"))
    x, y, z = (np.asarray(part) for part in ground.in_fixed_frame(ground.chart(grid)[0]))
    space.plot_wireframe(x, y, z, color="0.75", linewidth=0.4)
    space.set_xlabel("x [m]", labelpad=8)
    space.set_ylabel("y [m]", labelpad=8)
    space.set_zlabel("z [m]")
    # As many ticks along each axis as there is room for.
    spans = [np.ptp(part) for part in (x, y, z)]
    for axis, span in zip((space.xaxis, space.yaxis, space.zaxis), spans, strict=True):
        axis.set_major_locator(MaxNLocator(max(round(4.0 * span / max(spans)), 1)))
    # A plane has nearly no height to show.
    if spans[2] < 0.1 * max(spans):
        space.set_zticks([])
        space.set_zlabel("")
    space.set_aspect("equal")
