"""Views of a run: a page, an animation, the curves of the page."""

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..progress import status_line
from ..text import require_unit
from ..validation import require, require_file, require_increasing, require_package, shown
from .animation import draw_curves, write_animation
from .page import Page, page
from .stage import Stage, curves_in


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
