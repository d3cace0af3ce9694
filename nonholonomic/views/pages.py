"""Self-contained pages, animated 3D views drawn by three.js, with curves; pages with sliders that simulate in the browser, by
equations of motion as JavaScript generated from jaxprs; and films of runs.

The page is one HTML file that makes no network requests. `page.html` is its frame; `stage.js` draws a stage, `strips.js` the
curves, `film.js` saves pictures and films, and `player.js` unpacks the data and sets the time. three.js comes from the package
jupyter-threejs-sage.
"""

import base64
import functools
import html
import json
import os
import re
import secrets
import shutil
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Generic, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from ..hybrid import AbstractBatchedMode, HybridOutcome
from ..integration.problem import Settings, Status
from ..kernels import HybridRuns, HybridStart, Part, javascript
from ..terminal import status_line
from ..text import Unit, distinguishing_labels, require_unit, shown, unit_of
from ..validation import replacing, require, require_file, require_increasing, require_package
from .stage import Arrow, Draw, Kind, Marks, Stage, Trace, converted, css, curves_in, finite

#: Selectable speeds of time.
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

#: Text of a page without motion.
NO_VIEW = "The page is without motion: jupyter-threejs-sage is not installed (pip install 'nonholonomic[view]')."

#: Path of three.js in its package.
PACKAGE, LIBRARY = "jupyter_threejs_sage", ("static", "r130", "three.min.js")

SCRIPTS = ("stage.js", "strips.js", "film.js", "player.js")

#: The name of a run, or a list of one for each run; `None` for names that say what differs.
Label = str | Sequence[str] | None

#: Other runs or tables, which are shown with the first.
Runs = Sequence[Any]


class Page(NamedTuple):
    """A self-contained page as HTML. A notebook shows it."""

    html: str

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the page to a file, completely or not at all.

        **Raises:** `OSError` if it cannot be written; `ValueError` unless the name ends in .html.
        """
        with replacing(require_file(path, "path", ".html", ".htm")) as scratch:
            scratch.write_text(self.html, encoding="utf-8")

    def written(self, path: str | os.PathLike[str] | None) -> "Page":
        """The page itself, saved if there is a path."""
        if path is not None:
            self.save(path)
        return self

    def _repr_html_(self) -> str:
        style = "width:100%;height:820px;border:0"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{style}" allow="fullscreen" loading="lazy"></iframe>'

    def __repr__(self) -> str:
        return f"Page of {len(self.html) / 1e6:.2f} MB; save(path) writes it, and a notebook shows it"


def page(
    stages: list[Stage],
    title: str,
    speed: float = 1.0,
    above: str = "",
    below: str = "",
    height: int = 460,
    scripts: Sequence[str] = (),
    autoplay: bool = True,
) -> Page:
    """A page with stages side by side, in synchronised motion.

    **Arguments:**

    - `stages`: the stages to show; without any, the page has text only.
    - `title`: title of the page; `above`, `below`: HTML around the view.
    - `speed`: speed of time at the start, one of `SPEEDS`.
    - `height`: height of each stage in pixels.
    - `scripts`: HTML of additional scripts, such as `script` returns, inserted after those of the page.
    - `autoplay`: whether the page plays once when it first becomes visible.
    """
    parts = {"TITLE": html.escape(title), "HEIGHT": str(height), "ABOVE": above, "BELOW": below, "VIEW": ""}
    if stages:
        numbers = _Numbers()
        facts = {
            "speed": speed,
            "speeds": [(f"{factor:g} x real time" if factor != 1.0 else "real time", factor) for factor in SPEEDS],
            "autoplay": autoplay,
            "stages": numbers.described(stages),
        }
        floats, whole = map(np.concatenate, numbers.parts.values())
        data = {
            "library": files(PACKAGE).joinpath(*LIBRARY).read_bytes(),
            "floats": floats.view(np.uint8).reshape(-1, 4).T.tobytes(),
            "whole": whole.tobytes(),
        }
        view = [script(json.dumps(facts).replace("<", "\\u003c"), ' type="application/json" id="facts"')]
        for name, part in data.items():
            coded = base64.b64encode(zlib.compress(part, 9)).decode()
            view.append(script(coded, f' type="text/plain" id="{name}"'))
        parts["VIEW"] = "\n".join([*view, *(script(template(name)) for name in SCRIPTS), *scripts])
    # In one pass: a title may contain the mark of another part.
    return Page(re.sub(r"\[([A-Z]+)\]", lambda mark: parts[mark[1]], template("page.html")))


def require_page(path: object, caller: str) -> None:
    """Raise the errors of `Page.written`, before the work begins, and `ModuleNotFoundError` without the package for pages."""
    require_package("jupyter_threejs_sage", "view", caller)
    if path is not None:
        require_file(path, "path", ".html", ".htm")


def table_as_html(rows: list[list[str]], heads: int) -> str:
    """Rows of entries as an HTML table; the first entry of each row is a heading."""
    parts = []
    for number, row in enumerate(rows):
        kind = "th" if number < heads else "td"
        parts.append("<tr>" + "".join(f"<{kind}>{html.escape(entry)}</{kind}>" for entry in row) + "</tr>")
    return f'<div class="wide"><table>{"".join(parts)}</table></div>'


def picture_as_html(path: Path, heading: str) -> str:
    """A PNG file as an HTML image with embedded data, below a heading that also describes the image."""
    coded, text = base64.b64encode(path.read_bytes()).decode(), html.escape(heading)
    return f'<h2>{text}</h2><div class="wide"><img alt="plot: {text}" src="data:image/png;base64,{coded}"></div>'


def script(text: str, attributes: str = "") -> str:
    """JavaScript, or data with `attributes` that say so, as an HTML script element."""
    # Browsers take "</script>" for the end of a script anywhere, even in data.
    safe_text = text.replace("</", "<\\/")
    return f"<script{attributes}>{safe_text}</script>"


def template(name: str) -> str:
    """The text of a file of this folder, such as a part of a page."""
    return files("nonholonomic.views").joinpath(name).read_text(encoding="utf-8")


class _Numbers:
    """Arrays of floats and whole numbers, stored one after the other; each array is identified by its kind, its start and
    its length.

    Floats are stored byte plane by byte plane and whole numbers as differences, which compress better. Equal arrays are
    stored once.
    """

    def __init__(self):
        self.parts: dict[str, list[np.ndarray]] = {"floats": [], "whole": []}
        self.places: dict[tuple[str, bytes], tuple[int, int]] = {}

    def add(self, values: np.ndarray) -> dict[str, tuple[int, int]]:
        """Add an array, and return what identifies the array."""
        is_whole = values.dtype.kind == "i"
        flat = np.diff(values.ravel(), prepend=0) if is_whole else values.ravel()
        flat = np.ascontiguousarray(flat, dtype="<i4" if is_whole else "<f4")
        key = kind, _ = "whole" if is_whole else "floats", flat.tobytes()
        if key not in self.places:
            self.places[key] = (sum(map(len, self.parts[kind])), flat.size)
            self.parts[kind].append(flat)
        return {kind: self.places[key]}

    def described(self, part: Any) -> Any:
        """Stages or their parts for the script: named tuples by their fields, colours in CSS, and arrays by their places."""
        if isinstance(part, Trace):
            part = part._replace(points=finite(part.points))
        elif isinstance(part, Arrow):
            part = part._replace(start=finite(part.start), vector=finite(part.vector))
        if hasattr(part, "_fields"):
            fields = {name: self.described(value) for name, value in part._asdict().items()}
            return fields | ({"colour": css(part.colour)} if "colour" in fields else {})
        if isinstance(part, list | tuple):
            return [self.described(item) for item in part]
        return part if isinstance(part, str | float | int | None) else self.add(np.asarray(part))


# What a command line writes and prints at the end.


class Outputs(NamedTuple):
    """What a job has written.

    - `runs`: number of runs; `files`: the tables and pictures; `page`: the page.
    - `read_from`: the folder from which all results were read, or `None`.
    """

    runs: int
    files: list[Path]
    page: Path
    read_from: Path | None = None


def run_job(job: Callable[[], Outputs], program: str, purpose: str = "To see it") -> int:
    """Run the job of a command line and print what it has written, or an error as one line.

    **Arguments:** `program`: the name of the command line; `purpose`: what the page is for.

    **Returns:** the exit status: 0, or 2 for input that cannot be used.
    """
    start_time = time.perf_counter()
    try:
        outputs = job()
    except (ValueError, OSError) as error:
        print(f"python -m {program}: {error}", file=sys.stderr)
        return 2
    if not can_draw():
        print("No picture: matplotlib is not installed (pip install 'nonholonomic[plot]').", file=sys.stderr)
    included = "compilation included"
    if outputs.read_from is not None:
        # Another installation of the same version may have stored them.
        included = f"read from {outputs.read_from}, where an earlier run stored the results of these options"
    files, duration = ", ".join(map(str, outputs.files)), time.perf_counter() - start_time
    print(f"\n{outputs.runs} runs in {duration:.1f} s, {included}. Wrote {files}.")
    print(". ".join(filter(None, [f"{purpose}, open {outputs.page}", without_motion()])))
    return 0


def can_draw() -> bool:
    """Whether matplotlib is installed."""
    return find_spec("matplotlib") is not None


def without_motion() -> str:
    """Why pages have no motion; empty if three.js is installed."""
    return "" if find_spec(PACKAGE) else NO_VIEW


def page_of_job(stages: Callable[[], list[Stage]], title: str, speed: float, below: str) -> Page:
    """The page of a job: the stages if three.js is installed, and HTML below them."""
    note = f'<p class="note">{without_motion()}</p>' if without_motion() else ""
    return page([] if note else stages(), title, speed, note, below)


# Views of a run: a page, a film, and the curves of the page.
#
# A browser without a window records the film: it opens the page, and the page posts its film to a server on this computer.

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


@functools.singledispatch
def stage_of(run: Any, runs: list[Any], numbers: Sequence[int], names: Sequence[str]) -> Stage:
    """The stage on which runs of one kind are drawn together.

    Each kind of run registers its own function. **Arguments:** `run`: the first of the `runs`; `numbers`: those of the runs
    among all on a page, which have different colours; `names`: the names of the runs.
    """
    raise NotImplementedError(f"{type(run).__name__} has no picture")


class Viewable:
    """A run that can be drawn, alone or with others."""

    #: What pictures and pages mark in the curves.
    marks: ClassVar[Marks] = ()

    def labels_of(self, runs: list[Any], unit: Unit) -> list[str]:
        """Labels that tell runs of this kind apart, in units as for `plot`; for a single run the title of its picture."""
        return [""] if len(runs) == 1 else [f"run {k + 1}" for k in range(len(runs))]

    def stages(self, others: Runs = (), overlaid: bool = False, unit: Unit = None, label: Label = None) -> list[Stage]:
        """This run and others as stages, one for each or a common one; arguments as for `view`."""
        runs, stages = [self, *others], []
        names = self.labels_of(runs, unit) if label is None else require_labels(label, runs)
        for group in [range(len(runs))] if overlaid else [[number] for number in range(len(runs))]:
            stage = stage_of(self, [runs[k] for k in group], group, [names[k] for k in group])
            shows = (show._replace(marks=runs[k].marks) for k, show in zip(group, stage.shows, strict=True))
            title = stage.title if label is None else "; ".join(names[k] for k in group)
            stages.append(stage._replace(title=title, shows=tuple(shows)))
        return stages

    @status_line("drawing")
    def view(
        self,
        path: str | os.PathLike[str] | None = None,
        others: Runs = (),
        overlaid: bool = False,
        unit: Unit = None,
        draw: Draw = None,
        label: Label = None,
    ) -> Page:
        """An animated page of the run: body, arena, traces, arrows, and curves over time (needs jupyter-threejs-sage).

        The page is one file that needs no network; a notebook shows the returned page.

        **Arguments:**

        - `path`: file for the page, with a name that ends in .html, or `None`.
        - `others`: other runs to show at the same time.
        - `overlaid`: whether to draw all runs in the arena of the first, instead of side by side.
        - `unit`: unit of the curves and of the names of the runs, as for `plot`, such as ("deg", "rpm").
        - `draw`: for your own system, a function `draw(system, t, y)` that returns a list of `views.Box`, `Wheel`, `Disc`,
          `Ball` and `Line`, of sizes that do not change in time; the first part leaves a trace. By default, the first two
          components of the state are a path.
        - `label`: name of the run; with `others`, a list of one for each run. By default, names say what differs.

        **Returns:** a `Page`, with its `html`.

        **Raises:** before anything is drawn: `ModuleNotFoundError` if jupyter-threejs-sage is not installed, `OSError`
        if the file cannot be written, `ValueError` for another file type, an unknown unit or a batch of runs.

        **Example:** `examples/a_page.py`.
        """
        require_page(path, "view")
        return self._page(others, overlaid, unit, draw, label, speed=0.5).written(path)

    @status_line("drawing")
    def animate(
        self,
        path: str | os.PathLike[str],
        times: Float[ArrayLike, " frames"] | Sequence[float] | None = None,
        others: Runs = (),
        overlaid: bool = False,
        speed: float | None = None,
        fps: float = 25.0,
        unit: Unit = None,
        draw: Draw = None,
        label: Label = None,
    ) -> None:
        """Write a film for slides: the page of the run, recorded by Chromium, Chrome or Edge without a window (needs
        jupyter-threejs-sage). It plays the run in real time unless you give a `speed`; the film states time and speed.

        **Arguments:**

        - `path`: file with a name that ends in .webm.
        - `times`: increasing times [s] of the frames; by default the whole run at the given speed.
        - `others`, `overlaid`, `unit`, `draw`, `label`: as for `view`.
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
        recording = {"scripts": [script(RECORD.replace("[REQUEST]", json.dumps(request)))], "autoplay": False}
        html_page = self._page(others, overlaid, unit, draw, label, height=HEIGHT, **recording)
        with replacing(file) as scratch:
            scratch.write_bytes(recorded(html_page, browser))

    def _page(self, others: Runs, overlaid: bool, unit: Unit, draw: Draw, label: Label, **options: Any) -> Page:
        """The page in a unit, after a check of the unit and that the others are runs of the same package. **Arguments:**
        `options`: of `page`."""
        require_unit(unit)
        runs, unit = [cast(Any, self), *require_others(self, others)], unit or unit_of(self)
        runs = runs if draw is None else [run.drawn_by(draw) for run in runs]
        stages = curves_in(runs[0].stages(runs[1:], overlaid, unit, label), unit)
        return page(stages, "; ".join(stage.title for stage in stages), **options)


def require_others(run: object, others: object) -> Sequence[Any]:
    """Raise `ValueError` unless the others are a list of runs that are drawn as the run is; return them."""
    if isinstance(others, type(run)):
        raise ValueError("others = a run must be a list of runs: write others=[run]")
    if not isinstance(others, list | tuple):
        raise ValueError(f"others = {shown(others)} must be a list of runs, such as [run]")
    for k, other in enumerate(others):
        if stage_of.dispatch(type(other)) is not stage_of.dispatch(type(run)):
            raise ValueError(f"others[{k}] = {shown(other)} must be a run of the same package, as simulate returns it")
    return others


def require_labels(label: Label, runs: Sequence[object]) -> list[str]:
    """The labels of runs, one for each; those of several runs are shortened. **Raises:** `ValueError` if there is another
    number of them."""
    labels = [label] if isinstance(label, str) else label
    if not isinstance(labels, list | tuple) or [type(text) for text in labels] != [str] * len(runs):
        raise ValueError(f"label = {shown(label)} must have {len(runs)} texts, one for each run")
    return distinguishing_labels([(text,) for text in labels])


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


# The contents of a page at one time of a run, in the form for the player (`player.js`).


class Frame(NamedTuple, Generic[Kind]):
    """One moment of a run, or several, with bodies, traces, arrows and curves in the order of the `Show` of the page.

    - `normal`: normal of the arena, towards the body; `bodies`: position [m] and quaternion (x, y, z, w) of each body.
    - `traces`: the point of each trace [m], and the point to which it is relative, or `None`.
    - `arrows`: start [m] and vector of each arrow, in its unit; `curves`: a number for each curve.
    - `turning_rate`: greatest rotation rate of all parts [rad/s], which determines the number of frames.
    """

    normal: Float[Kind, "*times 3"]
    bodies: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 4"]], ...]
    traces: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"] | None], ...]
    arrows: tuple[tuple[Float[Kind, "*times 3"], Float[Kind, "*times 3"]], ...]
    curves: tuple[Float[Kind, "*times"], ...]
    turning_rate: Float[Kind, "*times"]


Numbers = Float[Array, " numbers"]

Start = tuple[tuple[AbstractBatchedMode, ...], Int[Array, "1"], Float[Array, "components 1"]]


class Simulator(NamedTuple):
    """A run that is integrated in the browser.

    - `start`: function of the numbers of the sliders that returns the modes, the index of the first mode, and the
      initial state, for one cell.
    - `t1`: horizon [s]; `settings`: settings with an explicit Runge-Kutta solver of Diffrax; `counters`: rows of
      `Transition.counts`; `passes`: whether a run continues through its event.
    - `outcome`: function of the sliders' numbers and the `HybridOutcome` that returns the `Status` of the run, and the
      result, or infinity; of a drawn run, what it did after its event. `None` if neither is needed.
    - `frame`: function that returns the frame at any time; its arguments are the sliders' numbers, the index of the
      mode or -1 between modes, the output rows of the modes, and the time [s]. `None` if no path is needed.
    """

    start: Callable[[Numbers], Start]
    t1: float
    settings: Settings
    counters: int
    passes: bool
    outcome: Callable[[Numbers, HybridOutcome], PyTree] | None = None
    frame: Callable[[Numbers, Array, PyTree, Array], Frame] | None = None

    def javascript(self, values: Numbers) -> str:
        """The simulator as an object of JavaScript.

        **Arguments:** `values`: numbers of the sliders; only their count matters.
        """

        def start(values: Numbers) -> HybridStart:
            return HybridStart(*self.start(values), jnp.full(1, self.t1), self.settings)

        runs = HybridRuns(start, self.counters, self.passes, is_shown=self.frame is not None)
        (facts, functions), kinds = runs.parts(values)
        first = jax.eval_shape(runs.first, values)
        if self.outcome is not None:
            functions["outcome"] = (self.outcome, (values, first))
        if self.frame is not None:
            mode = eqx.filter_eval_shape(start, values).modes[0]
            rows = eqx.filter_eval_shape(lambda mode, state: mode.shown(state), mode, first.state)
            examples = (values, first.mode, rows, first.end_time)
            functions["frame"], frame = (self.frame, examples), eqx.filter_eval_shape(self.frame, *examples)
            # For readers of the flat list of numbers of a frame.
            facts["layout"] = {
                "bodies": len(frame.bodies),
                "traces": [about is not None for _, about in frame.traces],
                "arrows": len(frame.arrows),
                "curves": len(frame.curves),
            }
        return as_object(Part(facts, functions), kinds=f"[{', '.join(map(as_object, kinds))}]")


def as_object(part: Part, **more: str) -> str:
    """A part of a program as a JavaScript object; `more`: text of further entries."""
    lines = [f"{name}: {javascript('', function, *examples)}" for name, (function, examples) in part.functions.items()]
    lines += [f"{name}: {text}" for name, text in more.items()]
    return "{\n" + ",\n".join([*(f"{name}: {json.dumps(fact)}" for name, fact in part.facts.items()), *lines]) + "}"


# A page with sliders: its contents, and how they are combined into one file.


class Slider(NamedTuple):
    """A slider: its `name` in the page's address, the `path` of its parameter, a `label`, its range and its value in the SI
    unit, the unit in which the page shows it, and the factor that converts to this unit."""

    name: str
    path: str
    label: str
    unit: str
    low: float
    high: float
    value: float
    factor: float = 1.0


class LiveRun(NamedTuple):
    """The contents of a page with sliders.

    - `title`: title of the page.
    - `sliders`: the sliders; `allowed`: function that returns whether their numbers are legal in combination.
    - `answer`: the simulator whose `outcome` is the result of a run, which the page also shows as a map; `label`, `unit`: those
      of the result.
    - `motion`: the simulator of the drawn run, with its `frame`.
    - `summaries`: indices of the curves of the `Show` whose values at the start and the end of the run the page also shows as
      numbers, beside the result.
    - `afterwards`: what a run may do after its event, of which the `outcome` of `motion`, if it has one, returns the index.
    """

    title: str
    sliders: tuple[Slider, ...]
    allowed: Callable[[Numbers], Bool[Array, ""]]
    answer: Simulator
    label: str
    unit: str
    motion: Simulator
    summaries: tuple[int, ...]
    afterwards: tuple[str, ...] = ()


def live_page(live: LiveRun, stage: Stage, speed: float = 1.0, below: str = "", unit: Unit = None) -> Page:
    """The page of a run with sliders.

    **Arguments:** `stage`: a stage with one run, for its arena, meshes and names; `speed`, `below`: as for `page`; `unit`: that
    of curves, arrows and sliders, as for `in_unit`.

    **Raises:** `ValueError` for equations that cannot be written in JavaScript.
    """
    # The title and the warnings describe one run, but the sliders change the run.
    stage_of_live = stage._replace(title="", shows=tuple(show._replace(note="") for show in stage.shows))
    sliders = tuple(slider._replace(**converted(slider.unit, unit)) for slider in live.sliders)
    texts = (programs(live._replace(sliders=sliders)), template("map.js"), template("explore.js"))
    scripts = [script(text) for text in texts]
    section = f'<section id="below">{below}</section>'
    return page(curves_in([stage_of_live], unit), live.title, speed, template("explore.html"), section, scripts=scripts)


def programs(live: LiveRun) -> str:
    """The JavaScript of the simulation: the data of the sliders, all functions and the integrator, without a page."""
    values = jnp.array([slider.value for slider in live.sliders])
    facts = {
        "sliders": [slider._asdict() for slider in live.sliders],
        "words": {int(status): status.word for status in Status},
        "answer": {"label": live.label, "unit": live.unit, "horizon": live.answer.t1},
        "summaries": live.summaries,
        "afterwards": live.afterwards,
    }
    parts = {
        "facts": json.dumps(facts),
        "answer": live.answer.javascript(values),
        "motion": live.motion.javascript(values),
        "allowed": javascript("", live.allowed, values),
    }
    return (
        f"window.live = {{{', '.join(f'{name}: {text}' for name, text in parts.items())}}};\n"
        f"{template('integrator.js')}"
    )
