"""The ways in which a run can be shown: a page, an animation, a picture of its curves."""

import abc
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..progress import status_line
from ..validation import require_file, require_package
from .animation import draw_curves, write_animation
from .page import Page, page
from .stage import Stage


class Viewable(abc.ABC):
    """A run that can be drawn, alone or with others."""

    @abc.abstractmethod
    def stages(self, others: Sequence[Any] = (), overlaid: bool = False) -> list[Stage]:
        """This run and others as they are drawn: each in its own place, or all in that of the first."""

    @status_line("drawing")
    def view(self, path: Any = None, others: Sequence[Any] = (), overlaid: bool = False) -> Page:
        """A page in which the run moves: body, arena, traces, arrows, and curves over time (needs jupyter-threejs-sage).

        It is one file that needs no network; a notebook shows what is returned.

        **Arguments:**

        - `path`: file to write the page to, whose name ends in .html, or `None`.
        - `others`: more runs to be shown, whose time runs along.
        - `overlaid`: whether all are drawn in the arena of the first, otherwise side by side.

        **Returns:** a `Page`, with its `html`.

        **Raises:** before anything is drawn: `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError` if the
        file cannot be written, `ValueError` for a file of another kind or a batch of runs.

        **Example:** `examples/a_page.py`.
        """
        require_package("jupyter_threejs_sage", "view", "view")
        if path is not None:
            require_file(path, "path", ".html", ".htm")
        stages = self.stages(others, overlaid)
        found = page(stages, "; ".join(stage.title for stage in stages), speed=0.5)
        if path is not None:
            found.save(path)
        return found

    @status_line("drawing")
    def animate(self, path: Any, times: Any = None, others: Sequence[Any] = (), overlaid: bool = False) -> None:
        """Write an animation for slides, 25 pictures a second (needs matplotlib).

        **Arguments:**

        - `path`: a file whose name ends in .gif, or in .mp4 where ffmpeg is installed.
        - `times`: time [s] of each picture; by default 150 over the whole run.
        - `others`, `overlaid`: as for `view`.

        **Raises:** `ValueError` for a file of another kind, or a batch of runs; `OSError` if it cannot be written.

        **Example:** `examples/a_page.py`.
        """
        require_package("matplotlib", "plot", "animate")
        require_file(path, "path", ".gif", ".mp4")
        write_animation(self.stages(others, overlaid), path, None if times is None else np.asarray(times, dtype=float))

    @status_line("drawing")
    def plot(self, others: Sequence[Any] = ()) -> Any:
        """Draw the curves of the page over time (needs matplotlib).

        **Arguments:** `others`: as for `view`.

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for a batch of runs.

        **Example:** `examples/a_page.py`.
        """
        require_package("matplotlib", "plot", "plot")
        return draw_curves(self.stages(others))
