"""Views of a run: a page, an animation, the curves of the page."""

import abc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..terminal import status_line
from ..text import require_unit, shown
from ..validation import replacing, require, require_file, require_increasing, require_package
from .page import ANGLE, Page, centre_and_extent, page, view_from
from .plot import new_figure
from .stage import FINE, Mesh, Show, Stage, css, curves_in, finite, matrices, nearest

# Draw the contents of a page with matplotlib: an animation in a file, and the curves.

#: Dots per inch.
DOTS = 80

#: Number of characters for which a legend has room.
WIDTH = 90

#: Direction of the light, and brightness of unlit faces.
LIGHT, SHADE = np.array([0.3, -0.5, 0.81]), 0.55

#: Relative range of values below which a panel draws them as constant.
LEAST_RANGE = 1e-3

Times = Float[np.ndarray, " frames"]


def draw_curves(stages: list[Stage], names: Sequence[str] = ()) -> Any:
    """A panel for each label, with the curves of all runs in it.

    **Arguments:** `names`: names of the runs for the legend, by default those on the page.

    **Returns:** a matplotlib figure.
    """
    shows = [show for stage in stages for show in stage.shows]
    labels = _labels(shows)
    figure = new_figure(7.0, 1.3 + 1.5 * len(labels))
    for label, panel in zip(labels, figure.subplots(len(labels), 1, sharex=True, squeeze=False)[:, 0], strict=True):
        _draw_curve(panel, shows, label)
        panel.set_ylabel(label, fontsize="small")
    panel.set_xlabel("time [s]")
    if len(shows) > 1 or any(names):
        names = names or [show.name for show in shows]
        # As many columns as the longest name leaves room for.
        columns = max(1, WIDTH // (max(map(len, names)) + 6))
        figure.legend(names, loc="outside upper center", ncols=min(columns, len(names)), fontsize="small")
    return figure


def _labels(shows: list[Show]) -> list[str]:
    return list(dict.fromkeys(curve.label for show in shows for curve in show.curves))


def _draw_curve(panel: Any, shows: list[Show], label: str) -> None:
    for show in shows:
        for curve in show.curves:
            if curve.label == label:
                panel.plot(show.times, curve.drawn, color=css(show.colour), linewidth=1.0)
    panel.margins(x=0.0)
    low, high = panel.get_ylim()
    middle = (low + high) / 2.0
    # Draw values that are constant except for round-off as a constant.
    min_range = LEAST_RANGE * max(abs(low), abs(high))
    if high - low < min_range:
        panel.set_ylim(middle - min_range, middle + min_range)


def rate_of(kind: str, fps: float) -> float:
    """The frames per second of a file of a kind, ".gif" or ".mp4"; a GIF counts hundredths of a second, at least two."""
    return 100.0 / max(2, round(100.0 / fps)) if kind == ".gif" else fps


def frame_times(last: float, speed: float, rate: float) -> Times:
    """The times [s] of the frames of a run that ends at `last`, at a speed relative to real time."""
    return np.minimum(np.arange(int(np.ceil(last * rate / speed - 1e-9)) + 1) * speed / rate, last)


def speed_as_text(times: Times, rate: float) -> str:
    """The speed of an animation relative to real time; empty if it varies."""
    # The last frame may be shorter.
    steps = np.diff(times[:-1] if len(times) > 2 else times)
    if not len(steps) or np.ptp(steps) > 1e-6 * steps[0]:
        return ""
    speed = steps[0] * rate
    return ", real time" if abs(speed - 1.0) < 5e-3 else f", {speed:.3g} times real time"


def write_animation(stages: list[Stage], path: Any, times: Times | None, speed: float = 1.0, fps: float = 25.0) -> None:
    """Write an animation of stages side by side, with their curves below.

    **Arguments:** as for `Viewable.animate`.
    """
    from matplotlib.animation import FFMpegWriter, FuncAnimation, PillowWriter

    writers = {".gif": PillowWriter, ".mp4": FFMpegWriter}
    kind = writers.get(Path(path).suffix)
    if kind is None or not kind.isAvailable():
        raise ValueError(f"path = {str(path)!r} must end in .gif, or in .mp4 where ffmpeg is installed")
    shows = [show for stage in stages for show in stage.shows]
    last = max(float(show.times[-1]) for show in shows)
    rate = rate_of(Path(path).suffix, fps)
    times = frame_times(last, speed, rate) if times is None else times
    as_text = speed_as_text(times, rate)
    labels = _labels(shows)
    figure = new_figure(max(8.0, 5.0 * len(stages)), 6.0)
    grid = figure.add_gridspec(2, len(stages) * len(labels), height_ratios=(3.2, 1.0))
    spaces = []
    for number, stage in enumerate(stages):
        columns = slice(number * len(labels), (number + 1) * len(labels))
        spaces.append(
            _Space(figure.add_subplot(grid[0, columns], projection="3d", computed_zorder=False), stage, times)
        )
    cursors = []
    for number, label in enumerate(labels):
        panel = figure.add_subplot(grid[1, number * len(stages) : (number + 1) * len(stages)])
        _draw_curve(panel, shows, label)
        # At the right, where no power of ten of the axis is.
        panel.set_title(label, fontsize="small", loc="right")
        panel.tick_params(labelsize="x-small")
        cursors.append(panel.axvline(0.0, color="0.15", linewidth=1.0))
    clock = figure.suptitle("", fontsize="medium")

    def update(frame: int) -> list[Any]:
        for space in spaces:
            space.draw(frame)
        for cursor in cursors:
            cursor.set_xdata([times[frame]] * 2)
        clock.set_text(f"{times[frame]:.3f} s{as_text}")
        return []

    # Compute the margins once: if they were computed for every frame, the picture would shake.
    update(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    # Matplotlib truncates the duration of a frame to milliseconds.
    with replacing(Path(path)) as scratch:
        FuncAnimation(figure, update, frames=len(times)).save(scratch, writer=kind(fps=rate * (1.0 - 1e-9)), dpi=DOTS)


class _Space:
    """A stage in matplotlib axes."""

    def __init__(self, axes: Any, stage: Stage, times: Times):
        from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

        self.axes, self.stage = axes, stage
        self.frames = [nearest(show.times, times) for show in stage.shows]
        camera, self.follow = view_from(stage)
        place, middle = np.array(camera[:3]), np.array(camera[3:6])
        direction = place - middle
        distance = np.linalg.norm(direction)
        self.extent = centre_and_extent(np.stack([show.bodies[0].position[0] for show in stage.shows]))[1]
        self.reach, self.middle = 0.8 * distance * np.tan(np.radians(ANGLE) / 2.0), middle
        axes.view_init(
            np.degrees(np.arcsin(direction[2] / distance)), np.degrees(np.arctan2(direction[1], direction[0]))
        )
        axes.set_axis_off()
        axes.set_box_aspect((1.0, 1.0, 1.0), zoom=1.8)
        axes.set_title(f"{stage.title} ({stage.arena.spacing})", fontsize="medium")
        self.floor = axes.add_collection3d(Poly3DCollection([np.zeros((3, 3))], linewidths=0.3, zorder=0))
        mesh = stage.arena.mesh
        self.tiles = _tiles(mesh)
        front = np.cross(*(mesh.vertices[mesh.triangles[0]][[1, 2]] - mesh.vertices[mesh.triangles[0]][0]))
        normals = np.cross(self.tiles[:, 1] - self.tiles[:, 0], self.tiles[:, 2] - self.tiles[:, 0])
        normals *= np.sign(np.sum(normals[0] * front))
        self.tile_colours = _lit(normals, mesh.colour)
        self.ground = axes.add_collection3d(
            Line3DCollection([np.zeros((2, 3))], colors="0.75", linewidths=0.6, zorder=1)
        )
        traces = [trace for show in stage.shows for trace in show.traces if trace.shown]
        lines = [(trace.colour, 2 if trace.about is None else 3) for trace in traces]
        self.traces = [axes.plot([], [], [], color=css(c), linewidth=0.9, zorder=z)[0] for c, z in lines]
        arrows = [arrow for show in stage.shows for arrow in show.arrows if arrow.shown]
        # The bodies are at 4.
        self.arrows = [
            axes.plot([], [], [], color=css(arrow.colour), linewidth=2.2, zorder=5 if arrow.through else 3)[0]
            for arrow in arrows
        ]
        self.solids = axes.add_collection3d(Poly3DCollection([np.zeros((3, 3))], linewidths=0.3, zorder=4))

    def draw(self, frame: int) -> None:
        """Draw the stage at one of its times."""
        middle, reach = self.middle, self.reach
        if self.follow:
            pairs = zip(self.stage.shows, self.frames, strict=True)
            middle, extent = centre_and_extent(
                np.stack([show.bodies[0].position[frames[frame]] for show, frames in pairs])
            )
            reach += extent - self.extent
        for axis, centre in zip("xyz", middle, strict=True):
            getattr(self.axes, f"set_{axis}lim")(centre - reach, centre + reach)
        in_view = np.linalg.norm(self.tiles.mean(axis=1) - middle, axis=-1) < 1.6 * reach
        self.floor.set_verts(self.tiles[in_view])
        self.floor.set_facecolor(self.tile_colours[in_view])
        self.floor.set_edgecolor(self.tile_colours[in_view])
        segments = [line for whole in self.stage.arena.lines for line in _pieces(whole, middle, 1.6 * reach)]
        self.ground.set_segments(segments)
        triangles, colours, traces, arrows = [], [], iter(self.traces), iter(self.arrows)
        for show, frames in zip(self.stage.shows, self.frames, strict=True):
            index = frames[frame]
            for body in show.bodies:
                turn = matrices(body.orientation[index : index + 1])[0]
                for mesh in body.meshes:
                    corners = (mesh.vertices @ turn.T + body.position[index])[mesh.triangles]
                    triangles.append(corners)
                    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
                    colours.append(_lit(normals, mesh.colour))
            for trace in filter(lambda trace: trace.shown, show.traces):
                points = finite(trace.points[: index + 1]) + (0.0 if trace.about is None else trace.about[index])
                points = np.where(np.linalg.norm(points - middle, axis=-1, keepdims=True) < 1.6 * reach, points, np.nan)
                next(traces).set_data_3d(*points.T)
            for arrow in filter(lambda arrow: arrow.shown, show.arrows):
                ends = np.stack([arrow.start[index], arrow.start[index] + arrow.drawn[index]])
                next(arrows).set_data_3d(*ends.T)
        self.solids.set_verts(np.concatenate(triangles))
        # Edges of the same colour close the seams between triangles.
        self.solids.set_facecolor(np.concatenate(colours))
        self.solids.set_edgecolor(np.concatenate(colours))


def _tiles(mesh: Mesh) -> Float[np.ndarray, "tiles corners 3"]:
    """The polygons that show an arena: quadrilaterals for the grid of a surface, otherwise the triangles of the mesh."""
    if len(mesh.vertices) != FINE**2:
        return mesh.vertices[mesh.triangles]
    # A quarter of the mesh's lines is fine enough.
    index = np.arange(FINE**2).reshape(FINE, FINE)[::4, ::4]
    corners = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)
    return mesh.vertices[corners.reshape(-1, 4)]


def _pieces(line: np.ndarray, middle: np.ndarray, reach: float) -> list[np.ndarray]:
    """The parts of a line that are in view."""
    in_view = np.linalg.norm(line - middle, axis=-1) < reach
    cuts = np.flatnonzero(np.diff(in_view)) + 1
    parts = zip(np.split(line, cuts), np.split(in_view, cuts), strict=True)
    return [part for part, mask in parts if mask[0] and len(part) > 1]


def _lit(normals: Float[np.ndarray, "faces 3"], colour: int) -> Float[np.ndarray, "faces 3"]:
    """A colour with the brightness of faces with these normals (of any length) in the light."""
    normals = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    base = np.array([colour >> 16 & 255, colour >> 8 & 255, colour & 255]) / 255.0
    return base * (SHADE + (1.0 - SHADE) * np.clip(normals @ LIGHT, 0.0, 1.0))[:, None]


# Views of a run: a page, an animation, the curves of the page.


class Viewable(abc.ABC):
    """A run that can be drawn, alone or with others."""

    @abc.abstractmethod
    def stages(self, others: Sequence[Any] = (), overlaid: bool = False, unit: Any = None) -> list[Stage]:
        """This run and others as stages: each on its own stage, or all on that of the first. **Arguments:** `unit`: unit of
        the numbers in their names, as for `plot`."""

    @status_line("drawing")
    def view(
        self,
        path: Any = None,
        others: Sequence[Any] = (),
        overlaid: bool = False,
        unit: str | Sequence[str] | None = None,
    ) -> Page:
        """An animated page of the run: body, arena, traces, arrows, and curves over time (needs jupyter-threejs-sage).

        The page is one file that needs no network; a notebook shows the returned page.

        **Arguments:**

        - `path`: file for the page, with a name that ends in .html, or `None`.
        - `others`: other runs to show at the same time.
        - `overlaid`: whether to draw all runs in the arena of the first, instead of side by side.
        - `unit`: unit of the curves and of the names of the runs, as for `plot`, such as ("deg", "rpm").

        **Returns:** a `Page`, with its `html`.

        **Raises:** before anything is drawn: `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError`
        if the file cannot be written, `ValueError` for another file type, an unknown unit or a batch of runs.

        **Example:** `examples/a_page.py`.
        """
        require_package("jupyter_threejs_sage", "view", "view")
        if path is not None:
            require_file(path, "path", ".html", ".htm")
        stages = self._stages(others, overlaid, unit)
        html_page = page(stages, "; ".join(stage.title for stage in stages), speed=0.5)
        if path is not None:
            html_page.save(path)
        return html_page

    @status_line("drawing")
    def animate(
        self,
        path: Any,
        times: Any = None,
        others: Sequence[Any] = (),
        overlaid: bool = False,
        speed: float | None = None,
        fps: float = 25.0,
        unit: str | Sequence[str] | None = None,
    ) -> None:
        """Write an animation for slides (needs matplotlib). It plays the run in real time unless you give a `speed`; the
        picture states time and speed.

        **Arguments:**

        - `path`: file with a name that ends in .gif, or in .mp4 if ffmpeg is installed.
        - `times`: increasing times [s] of the frames; by default the whole run at the given speed.
        - `others`, `overlaid`, `unit`: as for `view`.
        - `speed`: seconds of the run per second of the animation, 1 by default; 0.1 is ten times slower than reality. With
          `times`, the speed follows from `times` and `fps`.
        - `fps`: frames per second. A GIF shows each frame for a whole number of hundredths of a second, at least two, so it
          gets the nearest possible rate. Drawing takes about 0.2 s for each frame.

        **Raises:** `ValueError` for another file type, an unknown unit, a batch of runs, numbers out of range, or both `times`
        and `speed`; `OSError` if the file cannot be written.

        **Example:** `examples/a_page.py`.
        """
        require_package("matplotlib", "plot", "animate")
        require_file(path, "path", ".gif", ".mp4")
        require(fps, "fps", above=0.0)
        if speed is not None:
            require(speed, "speed", above=0.0)
        if times is not None:
            if speed is not None:
                raise ValueError("speed follows from times and fps: omit speed, or omit times")
            times = np.asarray(times, dtype=float)
            require_increasing(times, "times")
        stages = self._stages(others, overlaid, unit)
        write_animation(stages, path, times, 1.0 if speed is None else float(speed), float(fps))

    def overview(self, runs: Sequence[Any], labels: Sequence[str], unit: Any, ax: Any) -> Any:
        """Draw the curves of the page of this run and others over time; arguments as for `plot`."""
        if ax is not None:
            raise ValueError("ax takes one quantity: name it, as in plot('energy', ax=ax)")
        return draw_curves(curves_in(self.stages(runs[1:]), unit), labels)

    def _stages(self, others: Sequence[Any], overlaid: bool, unit: Any) -> list[Stage]:
        """The stages in a unit, after a check of the unit and that the others are runs of the same package."""
        require_unit(unit)
        return curves_in(self.stages(require_others(self, others, "stages"), overlaid, unit), unit)


def require_others(run: Any, others: Any, method: str) -> Sequence[Any]:
    """Raise `ValueError` unless the others are a list of runs that share a method with the run; return them."""
    if isinstance(others, type(run)):
        raise ValueError("others = a run must be a list of runs: write others=[run]")
    if not isinstance(others, list | tuple):
        raise ValueError(f"others = {shown(others)} must be a list of runs, such as [run]")
    for k, other in enumerate(others):
        if getattr(type(other), method, None) is not getattr(type(run), method):
            raise ValueError(f"others[{k}] = {shown(other)} must be a run of the same package, as simulate returns it")
    return others
