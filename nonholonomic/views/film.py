"""Views of a run: a page, a film, and the curves of the page.

A browser without a window records the film: it opens the page, and the page posts its film to a server on this computer.
"""

import abc
import json
import os
import secrets
import shutil
import subprocess
import tempfile
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import ArrayLike, Float

from ..terminal import status_line
from ..text import Unit, require_unit, shown
from ..validation import replacing, require, require_file, require_increasing, require_package
from .page import Page, page, script
from .plot import draw_curves
from .stage import Stage, curves_in

# Only for type checkers: matplotlib is optional.
if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Commands and paths of the browsers that can record a page.
BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "msedge"),
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)

#: Without a graphics card, the processor draws the stages; everything else is then faster without WebGL.
OPTIONS = (
    "--headless=new",
    "--no-first-run",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-rasterization",
    "--disable-accelerated-2d-canvas",
    "--disable-gpu-compositing",
)

#: Width and height of the window in pixels, height of a stage, and the time [s] after which a silent browser counts as failed.
WINDOW, HEIGHT, PATIENCE = (1280, 1000), 520, 180.0

#: The script that records a film; the page posts each frame's share of the film, and the film or an error at the end.
RECORD = """
const post = (name, body) => fetch(name, { method: "POST", body });
views.ready.then((player) => player.film([REQUEST], (share) => { post("share", String(share)); }))
  .then((film) => post("film", film), (error) => post("error", String(error)));
"""


class Viewable(abc.ABC):
    """A run that can be drawn, alone or with others."""

    @abc.abstractmethod
    def stages(self, others: Sequence[Any] = (), overlaid: bool = False, unit: Unit = None) -> list[Stage]:
        """This run and others as stages: each on its own stage, or all on that of the first. **Arguments:** `unit`: unit of
        the numbers in their names, as for `plot`."""

    @status_line("drawing")
    def view(
        self,
        path: str | os.PathLike[str] | None = None,
        others: Sequence[Any] = (),
        overlaid: bool = False,
        unit: Unit = None,
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
        path: str | os.PathLike[str],
        times: Float[ArrayLike, " frames"] | Sequence[float] | None = None,
        others: Sequence[Any] = (),
        overlaid: bool = False,
        speed: float | None = None,
        fps: float = 25.0,
        unit: Unit = None,
    ) -> None:
        """Write a film for slides: the page of the run, recorded by Chromium, Chrome or Edge without a window (needs
        jupyter-threejs-sage). It plays the run in real time unless you give a `speed`; the film states time and speed.

        **Arguments:**

        - `path`: file with a name that ends in .webm.
        - `times`: increasing times [s] of the frames; by default the whole run at the given speed.
        - `others`, `overlaid`, `unit`: as for `view`.
        - `speed`: seconds of the run per second of the film, 1 by default; 0.1 is ten times slower than reality. With
          `times`, the speed follows from `times` and `fps`.
        - `fps`: frames per second. Without a graphics card, drawing takes about 0.3 s for each frame.

        **Raises:** `ModuleNotFoundError` if jupyter-threejs-sage is not installed; `ValueError` for another file type, an
        unknown unit, a batch of runs, numbers out of range, or both `times` and `speed`; `OSError` if there is no browser, if
        the browser fails, or if the file cannot be written.

        **Example:** `examples/a_page.py`.
        """
        require_package("jupyter_threejs_sage", "view", "animate")
        file = require_file(path, "path", ".webm")
        require(fps, "fps", above=0.0)
        request: dict[str, object] = {"fps": float(fps), "speed": 1.0}
        if speed is not None:
            require(speed, "speed", above=0.0)
            request["speed"] = float(speed)
        if times is not None:
            if speed is not None:
                raise ValueError("speed follows from times and fps: omit speed, or omit times")
            times = np.asarray(times, dtype=float)
            require_increasing(times, "times")
            request["times"] = times.tolist()
        if (browser := next(filter(None, map(shutil.which, BROWSERS)), None)) is None:
            raise FileNotFoundError(
                "animate needs Chromium, Chrome or Edge, and finds none: install one, for example by `apt install chromium` or "
                "from google.com/chrome; or open the page of run.view(path) in any browser and press its button Save film"
            )
        stages = self._stages(others, overlaid, unit)
        scripts = [script(RECORD.replace("[REQUEST]", json.dumps(request)))]
        html_page = page(
            stages, "; ".join(stage.title for stage in stages), height=HEIGHT, scripts=scripts, autoplay=False
        )
        with replacing(file) as scratch:
            scratch.write_bytes(recorded(html_page, browser))

    def overview(self, runs: Sequence[Any], labels: Sequence[str], unit: Unit, ax: "Axes | None") -> "Figure":
        """Draw the curves of the page of this run and others over time; arguments as for `plot`."""
        if ax is not None:
            raise ValueError("ax takes one quantity: name it, as in plot('energy', ax=ax)")
        return draw_curves(curves_in(self.stages(runs[1:]), unit), labels)

    def _stages(self, others: Sequence[Any], overlaid: bool, unit: Unit) -> list[Stage]:
        """The stages in a unit, after a check of the unit and that the others are runs of the same package."""
        require_unit(unit)
        return curves_in(self.stages(require_others(self, others, "stages"), overlaid, unit), unit)


def require_others(run: object, others: Any, method: str) -> Sequence[Any]:
    """Raise `ValueError` unless the others are a list of runs that share a method with the run; return them."""
    if isinstance(others, type(run)):
        raise ValueError("others = a run must be a list of runs: write others=[run]")
    if not isinstance(others, list | tuple):
        raise ValueError(f"others = {shown(others)} must be a list of runs, such as [run]")
    for k, other in enumerate(others):
        if getattr(type(other), method, None) is not getattr(type(run), method):
            raise ValueError(f"others[{k}] = {shown(other)} must be a run of the same package, as simulate returns it")
    return others


# Films, recorded by a browser.


def recorded(html_page: Page, browser: str) -> bytes:
    """The film that a page posts as "film" when a browser opens it without a window.

    **Raises:** `OSError` if the page posts an error, and if the browser ends or stays silent.
    """
    # Imported here, because most programs make no film.
    from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

    # Only the browser knows the folder, so that no other program can read the page or post a film.
    folder, html = f"/{secrets.token_urlsafe()}/", html_page.html.encode()
    posts: dict[str, bytes] = {}
    heard = time.monotonic()

    class Exchange(BaseHTTPRequestHandler):
        """Serve the page to the browser, and keep what the page posts, by its name."""

        def do_GET(self) -> None:
            nonlocal heard
            is_post = self.command == "POST"
            body = self.rfile.read(int(self.headers["Content-Length"])) if is_post else b""
            if not self.path.startswith(folder):
                return self.send_error(404)
            if is_post:
                posts[self.path.removeprefix(folder)] = body
                heard = time.monotonic()
            answer = b"" if is_post else html
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(answer)))
            self.end_headers()
            self.wfile.write(answer)

        do_POST = do_GET

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        ThreadingHTTPServer(("127.0.0.1", 0), Exchange) as server,
    ):
        # How long `handle_request` waits for a request [s]; then the loop looks after the browser.
        server.timeout = 0.2
        # Chromium refuses to run as root, as in a container, unless its sandbox is off.
        is_root = hasattr(os, "geteuid") and os.geteuid() == 0
        command = [browser, *OPTIONS, *(["--no-sandbox"] if is_root else [])]
        command += [f"--window-size={WINDOW[0]},{WINDOW[1]}", f"--user-data-dir={profile}"]
        command.append(f"http://127.0.0.1:{server.server_port}{folder}")
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while True:
                server.handle_request()
                # In this order: a browser that has ended has posted all that it will.
                has_ended = process.poll() is not None
                if posts.keys() & {"film", "error"}:
                    break
                if has_ended:
                    raise OSError(f"{browser} ended with the status {process.returncode} before the film was complete")
                if time.monotonic() - heard > PATIENCE:
                    raise OSError(f"{browser} has drawn nothing for {PATIENCE:g} s")
        finally:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
    if "error" in posts:
        raise OSError(f"{browser} cannot record the page: {posts['error'].decode()}")
    return posts["film"]
