"""A self-contained page: an animated 3D view drawn by three.js, and curves.

The page is one HTML file that makes no network requests. `page.html` is its frame; `stage.js` draws a stage,
`strips.js` the curves, and `player.js` unpacks the data and sets the time. three.js comes from the package
jupyter-threejs-sage.
"""

import base64
import html
import json
import zlib
from collections.abc import Sequence
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..validation import replacing, require_file
from .stage import Mesh, Show, Stage, css, finite

#: Selectable speeds of time.
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

#: Text of a page without motion.
NO_VIEW = "The page is without motion: jupyter-threejs-sage is not installed (pip install 'nonholonomic[view]')."

#: Path of three.js in its package.
PACKAGE, LIBRARY = "jupyter_threejs_sage", ("static", "r130", "three.min.js")

SCRIPTS = ("stage.js", "strips.js", "player.js")

LINES = 0x7C8896
BACKGROUND = 0xFBFBFA

#: Opening angle of the camera [deg].
ANGLE = 35.0


class Page(NamedTuple):
    """A self-contained page as HTML. A notebook shows it."""

    html: str

    def save(self, path: Any) -> None:
        """Write the page to a file, completely or not at all.

        **Raises:** `OSError` if it cannot be written; `ValueError` unless the name ends in .html.
        """
        with replacing(require_file(path, "path", ".html", ".htm")) as scratch:
            scratch.write_text(self.html, encoding="utf-8")

    def _repr_html_(self) -> str:
        style = "width:100%;height:820px;border:0"
        return f'<iframe srcdoc="{html.escape(self.html)}" style="{style}" allow="fullscreen" loading="lazy"></iframe>'

    def __repr__(self) -> str:
        return f"Page of {len(self.html) / 1e6:.2f} MB; save(path) writes it, and a notebook shows it"


def can_view() -> bool:
    """Whether three.js is installed."""
    return find_spec(PACKAGE) is not None


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

    **Raises:** `ModuleNotFoundError` if there are stages and jupyter-threejs-sage is not installed.
    """
    parts = {"TITLE": html.escape(title), "HEIGHT": str(height), "ABOVE": above, "BELOW": below, "VIEW": ""}
    if stages:
        parts["VIEW"] = "\n".join([_view(stages, speed, autoplay), *scripts])
    page = template("page.html")
    for name, text in parts.items():
        page = page.replace(f"[{name}]", text)
    return Page(page)


def table_as_html(rows: list[list[str]], heads: int) -> str:
    """Rows of entries as an HTML table; the first entry of each row is a heading."""
    parts = []
    for number, row in enumerate(rows):
        kind = "th" if number < heads else "td"
        parts.append("<tr>" + "".join(f"<{kind}>{html.escape(entry)}</{kind}>" for entry in row) + "</tr>")
    return f'<div class="wide"><table>{"".join(parts)}</table></div>'


def picture_as_html(path: Path) -> str:
    """A PNG file as an HTML image with embedded data."""
    return f'<img style="max-width:100%" alt="" src="data:image/png;base64,{_coded(path.read_bytes())}">'


def script(text: str) -> str:
    """JavaScript as an HTML script element."""
    return f"<script>{_safe(text)}</script>"


def data_script(name: str, data: bytes) -> str:
    """Bytes as an HTML script element for data, read by its id: deflated, in base64."""
    return f'<script type="text/plain" id="{name}">{_coded(zlib.compress(data, 9))}</script>'


def json_script(name: str, value: Any) -> str:
    """A value as an HTML script element for data, read by its id: JSON."""
    return f'<script type="application/json" id="{name}">{_safe(json.dumps(value))}</script>'


def _safe(text: str) -> str:
    # Browsers take "</script>" for the end of a script anywhere, even in data.
    return text.replace("</", "<\\/")


def template(name: str) -> str:
    """The text of a file of this folder, such as a part of a page."""
    return files("nonholonomic.views").joinpath(name).read_text(encoding="utf-8")


def _coded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _view(stages: list[Stage], speed: float, autoplay: bool) -> str:
    if not can_view():
        raise ModuleNotFoundError("a view needs three.js: pip install 'nonholonomic[view]'")
    numbers = _Numbers()
    facts = {
        "speed": speed,
        "speeds": [(f"{factor:g} x real time" if factor != 1.0 else "real time", factor) for factor in SPEEDS],
        "autoplay": autoplay,
        "stages": [_stage(stage, numbers) for stage in stages],
    }
    return "\n".join(
        [
            data_script("library", files(PACKAGE).joinpath(*LIBRARY).read_bytes()),
            json_script("facts", facts),
            data_script("floats", numbers.floats),
            data_script("whole", numbers.whole),
            *(script(template(name)) for name in SCRIPTS),
        ]
    )


class _Numbers:
    """Arrays of floats and whole numbers, stored one after the other; each array is identified by its start and its
    length.

    Floats are stored byte plane by byte plane and whole numbers as differences, which compress better. Equal arrays are
    stored once.
    """

    def __init__(self):
        self.parts: dict[str, list[np.ndarray]] = {"<f4": [], "<i4": []}
        self.places: dict[bytes, tuple[int, int]] = {}
        self.lengths = {"<f4": 0, "<i4": 0}

    def add(self, values: np.ndarray) -> tuple[int, int]:
        """Add floats."""
        return self._add(np.ascontiguousarray(values, dtype="<f4").ravel(), "<f4")

    def add_whole(self, values: np.ndarray) -> tuple[int, int]:
        """Add whole numbers."""
        return self._add(np.diff(np.ravel(values), prepend=0).astype("<i4"), "<i4")

    def _add(self, flat: np.ndarray, kind: str) -> tuple[int, int]:
        key = kind.encode() + flat.tobytes()
        if key not in self.places:
            self.places[key] = (self.lengths[kind], flat.size)
            self.lengths[kind] += flat.size
            self.parts[kind].append(flat)
        return self.places[key]

    @property
    def floats(self) -> bytes:
        numbers = np.concatenate(self.parts["<f4"])
        return numbers.view(np.uint8).reshape(-1, 4).T.tobytes()

    @property
    def whole(self) -> bytes:
        return np.concatenate(self.parts["<i4"]).tobytes()


def _stage(stage: Stage, numbers: _Numbers) -> dict[str, Any]:
    """The data of a stage for the script."""
    camera, follow = view_from(stage)
    keys = [(stage.arena.spacing, "")]
    if len(stage.shows) > 1:
        keys += [(show.name, css(show.colour)) for show in stage.shows]
    arena = _mesh(stage.arena.mesh, numbers) | {"lines": [numbers.add(line) for line in stage.arena.lines]}
    return {
        "title": stage.title,
        "keys": keys,
        "notes": list(dict.fromkeys(show.note for show in stage.shows if show.note)),
        "follow": follow,
        "camera": (camera[:3], camera[3:6]),
        "angle": ANGLE,
        "size": _size(stage),
        "background": css(BACKGROUND),
        "lines": css(LINES),
        "arena": arena,
        "runs": [_show(show, numbers) for show in stage.shows],
    }


def _mesh(mesh: Mesh, numbers: _Numbers) -> dict[str, Any]:
    vertices, triangles = numbers.add(mesh.vertices), numbers.add_whole(mesh.triangles)
    return {"vertices": vertices, "triangles": triangles, "colour": css(mesh.colour)}


def _show(show: Show, numbers: _Numbers) -> dict[str, Any]:
    return {
        "name": show.name,
        "colour": css(show.colour),
        "times": numbers.add(show.times),
        "normal": numbers.add(show.normal),
        "bodies": [
            {
                "name": body.name,
                "meshes": [_mesh(mesh, numbers) for mesh in body.meshes],
                "position": numbers.add(body.position),
                "orientation": numbers.add(body.orientation),
            }
            for body in show.bodies
        ],
        "traces": [
            {
                "name": trace.name,
                "shown": trace.shown,
                "colour": css(trace.colour),
                "width": trace.width,
                "points": numbers.add(finite(trace.points)),
                "about": None if trace.about is None else numbers.add(trace.about),
            }
            for trace in show.traces
        ],
        "arrows": [
            arrow._asdict()
            | {
                "colour": css(arrow.colour),
                "start": numbers.add(finite(arrow.start)),
                "vector": numbers.add(finite(arrow.vector)),
            }
            for arrow in show.arrows
        ],
        "curves": [
            {"label": curve.label, "factor": curve.factor, "values": numbers.add(curve.values)} for curve in show.curves
        ],
    }


def _size(stage: Stage) -> float:
    return max(show.size for show in stage.shows)


def centre_and_extent(points: Float[np.ndarray, "points 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """The centre of points, and their distance from the centre."""
    middle = points.mean(axis=0)
    return middle, float(np.linalg.norm(points - middle, axis=-1).max())


def view_from(stage: Stage) -> tuple[list[float], bool]:
    """The camera (position, target, up), and whether it must follow the body, because the body is small compared with
    its path."""
    paths = [finite(show.bodies[0].position) for show in stage.shows]
    size = _size(stage)
    points = np.concatenate(paths)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    reach = np.linalg.norm(points - middle, axis=-1).max()
    follow = stage.follows or bool(reach > 4.0 * size)
    if follow:
        middle, extent = centre_and_extent(np.stack([path[0] for path in paths]))
        reach = 1.1 * size + extent
    normal = stage.arena.normal
    view_axis = np.array([0.35, -1.0, 0.0])
    view_axis = view_axis - (view_axis @ normal) * normal
    direction = stage.rise * normal + view_axis / np.linalg.norm(view_axis)
    distance = 1.05 * (reach + 1.6 * size) / np.sin(np.radians(ANGLE) / 2.0)
    place = middle + distance * direction / np.linalg.norm(direction)
    return [*place.tolist(), *middle.tolist(), 0.0, 0.0, 1.0], follow
