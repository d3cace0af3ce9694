"""One page that holds everything: a view in three dimensions that moves, drawn by three.js, and strips of curves.

The page is one HTML file without any request to a network. `page.html` is its frame; `stage.js` draws a stage, `strips.js` the
curves, and `player.js` unpacks the data and sets the time. three.js comes from the package jupyter-threejs-sage.
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

from .stage import Mesh, Show, Stage, css, finite

#: How fast time may run.
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

#: What a page without motion says.
NO_VIEW = "The page is without motion: jupyter-threejs-sage is not installed (pip install 'nonholonomic[view]')."

#: Where three.js lies in its package.
PACKAGE, LIBRARY = "jupyter_threejs_sage", ("static", "r130", "three.min.js")

SCRIPTS = ("stage.js", "strips.js", "player.js")

LINES = 0x7C8896
BACKGROUND = 0xFBFBFA

#: Opening angle of the camera [deg], and how high it stands over the ground, in units of its distance along it.
ANGLE, RISE = 35.0, 0.30


class Page(NamedTuple):
    """A page of its own: its HTML. A notebook shows it."""

    html: str

    def save(self, path: Any) -> None:
        """Write the page to a file.

        **Raises:** `OSError` if it cannot be written.
        """
        Path(path).write_text(self.html, encoding="utf-8")

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
    """A page with some stages beside each other, whose times run together.

    **Arguments:**

    - `stages`: what is shown; none gives a page of words.
    - `title`: of the page; `above`, `below`: HTML around the view.
    - `speed`: how fast time runs at first, one of `SPEEDS`.
    - `height`: of each stage in pixels.
    - `scripts`: HTML of more scripts, put in after those of the page, such as `script` makes.
    - `autoplay`: whether the page plays once when it is first seen.

    **Raises:** `ModuleNotFoundError` if there are stages and jupyter-threejs-sage is not installed.
    """
    parts = {"TITLE": html.escape(title), "HEIGHT": str(height), "ABOVE": above, "BELOW": below, "VIEW": ""}
    if stages:
        parts["VIEW"] = "\n".join([_view(stages, speed, autoplay), *scripts])
    whole = _template("page.html")
    for name, text in parts.items():
        whole = whole.replace(f"[{name}]", text)
    return Page(whole)


def table_as_html(rows: list[list[str]], heads: int) -> str:
    """Rows of entries as an HTML table, of which the first ones are headings."""
    parts = []
    for number, row in enumerate(rows):
        kind = "th" if number < heads else "td"
        parts.append("<tr>" + "".join(f"<{kind}>{html.escape(entry)}</{kind}>" for entry in row) + "</tr>")
    return f'<div class="wide"><table>{"".join(parts)}</table></div>'


def picture_as_html(path: Path) -> str:
    """A PNG file as an HTML image that carries its data."""
    return f'<img style="max-width:100%" alt="" src="data:image/png;base64,{_coded(path.read_bytes())}">'


def script(text: str) -> str:
    """JavaScript as an HTML script."""
    return f"<script>{_safe(text)}</script>"


def data_script(name: str, data: bytes) -> str:
    """Bytes as an HTML script that is only read, by its id: deflated, in base64."""
    return f'<script type="text/plain" id="{name}">{_coded(zlib.compress(data, 9))}</script>'


def json_script(name: str, value: Any) -> str:
    """A value as an HTML script that is only read, by its id: JSON."""
    return f'<script type="application/json" id="{name}">{_safe(json.dumps(value))}</script>'


def _safe(text: str) -> str:
    # A browser takes "</script>" for the end of a script wherever it stands, even in data.
    return text.replace("</", "<\\/")


def _template(name: str) -> str:
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
            *(script(_template(name)) for name in SCRIPTS),
        ]
    )


class _Numbers:
    """Arrays one after the other, floats and whole numbers; each array is known by its beginning and its length.

    Floats are kept byte plane by byte plane and whole numbers as differences, which compress better, and equal arrays once.
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
        joined = np.concatenate(self.parts["<f4"])
        return joined.view(np.uint8).reshape(-1, 4).T.tobytes()

    @property
    def whole(self) -> bytes:
        return np.concatenate(self.parts["<i4"]).tobytes()


def _stage(stage: Stage, numbers: _Numbers) -> dict[str, Any]:
    """What the script needs to know of a stage."""
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
                "turning": numbers.add(body.turning),
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
        "curves": [{"label": curve.label, "values": numbers.add(curve.values)} for curve in show.curves],
    }


def _size(stage: Stage) -> float:
    return max(show.size for show in stage.shows)


def among(points: Float[np.ndarray, "points 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """The middle of some points, and how far they are from it."""
    middle = points.mean(axis=0)
    return middle, float(np.linalg.norm(points - middle, axis=-1).max())


def view_from(stage: Stage) -> tuple[list[float], bool]:
    """Camera (its place, what it looks at, up), and whether it has to follow, as the body is small against its path."""
    paths = [finite(show.bodies[0].position) for show in stage.shows]
    size = _size(stage)
    points = np.concatenate(paths)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    reach = np.linalg.norm(points - middle, axis=-1).max()
    follow = stage.follows or bool(reach > 4.0 * size)
    if follow:
        middle, apart = among(np.stack([path[0] for path in paths]))
        reach = 1.1 * size + apart
    normal = stage.arena.normal
    aside = np.array([0.35, -1.0, 0.0])
    aside = aside - (aside @ normal) * normal
    direction = RISE * normal + aside / np.linalg.norm(aside)
    distance = 1.05 * (reach + 1.6 * size) / np.sin(np.radians(ANGLE) / 2.0)
    place = middle + distance * direction / np.linalg.norm(direction)
    return [*place.tolist(), *middle.tolist(), 0.0, 0.0, 1.0], follow
