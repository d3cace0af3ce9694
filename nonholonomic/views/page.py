"""One page that holds everything: a view in three dimensions that moves, drawn by K3D, and strips of curves (needs k3d)."""

import base64
import contextlib
import html
import json
import zlib
from collections.abc import Iterator
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .meshes import revolved
from .stage import Arrow, Mesh, Points, Show, Stage, css

#: How fast time may run.
SPEEDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)

#: What a page without motion says.
NO_VIEW = "The page is without motion: k3d is not installed (pip install 'nonholonomic[view]')."

LINES = 0x7C8896
BACKGROUND = 0xFBFBFA

#: Opening angle of the camera [deg].
ANGLE = 35.0


class Page(NamedTuple):
    """A page of its own: its HTML. A notebook shows it."""

    html: str

    def save(self, path: Any) -> None:
        """Write the page to a file.

        **Raises:** `OSError` if it cannot be written.
        """
        Path(path).write_text(self.html, encoding="utf-8")

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.html)}" style="width:100%;height:820px;border:0" loading="lazy"></iframe>'

    def __repr__(self) -> str:
        return f"Page of {len(self.html) / 1e6:.2f} MB; save(path) writes it, and a notebook shows it"


def can_view() -> bool:
    """Whether K3D is installed."""
    return find_spec("k3d") is not None


def page(
    stages: list[Stage], title: str, speed: float = 1.0, above: str = "", below: str = "", height: int = 460
) -> Page:
    """A page with some stages beside each other, whose times run together.

    **Arguments:**

    - `stages`: what is shown; none gives a page of words.
    - `title`: of the page; `above`, `below`: HTML around the view.
    - `speed`: how fast time runs at first, one of `SPEEDS`.
    - `height`: of each stage in pixels.

    **Raises:** `ModuleNotFoundError` if there are stages and K3D is not installed.
    """
    parts = {"TITLE": html.escape(title), "HEIGHT": str(height), "ABOVE": above, "BELOW": below, "VIEW": ""}
    if stages:
        parts["VIEW"] = _view(stages, speed)
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
    return f"<table>{''.join(parts)}</table>"


def picture_as_html(path: Path) -> str:
    """A PNG file as an HTML image that carries its data."""
    return f'<img style="max-width:100%" alt="" src="data:image/png;base64,{_coded(path.read_bytes())}">'


def _template(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _coded(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _script(name: str, text: str, kind: str = "text/plain") -> str:
    # A browser takes "</script>" for the end of a script wherever it stands, even in data.
    safe = text.replace("</", "<\\/")
    return f'<script type="{kind}" id="{name}">{safe}</script>'


def _view(stages: list[Stage], speed: float) -> str:
    if not can_view():
        raise ModuleNotFoundError("a view needs K3D: pip install 'nonholonomic[view]'")
    library = files("k3d").joinpath("static", "standalone.js").read_bytes()
    numbers = _Numbers()
    duration = max(float(show.times[-1]) for stage in stages for show in stage.shows)
    facts = {
        "duration": duration,
        "speed": speed,
        "speeds": [(f"{one:g} x real time" if one != 1.0 else "real time", one) for one in SPEEDS],
        "stages": [],
    }
    snapshots = []
    for number, stage in enumerate(stages):
        snapshot, fact = _stage(stage, numbers)
        facts["stages"].append(fact | {"snapshot": f"snapshot{number}"})
        snapshots.append(_script(f"snapshot{number}", _coded(snapshot)))
    return "\n".join(
        [
            _script("library", _coded(zlib.compress(library, 9))),
            _script("facts", json.dumps(facts), "application/json"),
            _script("numbers", _coded(zlib.compress(numbers.packed(), 9))),
            *snapshots,
            f"<script>{_template('page.js')}</script>",
        ]
    )


class _Numbers:
    """Arrays one after the other; each is known by where it begins and how many numbers it has."""

    def __init__(self):
        self.parts: list[np.ndarray] = []
        self.length = 0

    def add(self, values: np.ndarray) -> tuple[int, int]:
        flat = np.ascontiguousarray(values, dtype="<f4").ravel()
        begin, self.length = self.length, self.length + flat.size
        self.parts.append(flat)
        return begin, flat.size

    def packed(self) -> bytes:
        return np.concatenate(self.parts).tobytes()


def _stage(stage: Stage, numbers: _Numbers) -> tuple[bytes, dict[str, Any]]:
    """K3D's snapshot of what a stage draws, and what the script needs to know of it."""
    import k3d

    with _unseen():
        return _drawn(k3d, stage, numbers)


@contextlib.contextmanager
def _unseen() -> Iterator[None]:
    """K3D's widgets are not told to a notebook, which would keep megabytes of what the page holds anyway."""
    import comm

    told, comm.create_comm = comm.create_comm, comm.DummyComm
    try:
        yield
    finally:
        comm.create_comm = told


def _drawn(k3d: Any, stage: Stage, numbers: "_Numbers") -> tuple[bytes, dict[str, Any]]:
    from ipywidgets import Widget

    plot = k3d.plot(
        camera_auto_fit=False,
        grid_visible=False,
        menu_visibility=False,
        camera_fov=ANGLE,
        background_color=BACKGROUND,
        camera_mode="orbit",
        axes_helper=0.0,
    )
    drawn = _Drawn(k3d, plot)
    drawn.mesh(stage.arena.mesh, side="double")
    drawn.grid(stage.arena.lines)
    camera, follow = view_from(stage)
    plot.camera = camera
    shows = [_show(show, drawn, numbers) for show in stage.shows]
    keys = [(stage.arena.spacing, "")]
    for show in stage.shows:
        keys += [(show.name, css(show.colour))] if len(stage.shows) > 1 else []
    alone = len(stage.shows) == 1
    for show in stage.shows[:1]:
        # Traces of several runs have the runs' colours.
        keys += [(one.name, css(one.colour)) for one in (*(show.traces if alone else ()), *show.arrows)]
    fact = {"title": stage.title, "keys": keys, "follow": follow, "size": _size(stage), "shows": shows}
    snapshot = plot.get_binary_snapshot(9)
    # Widgets are kept until they are closed; a plot of K3D closes something else.
    for one in (*plot.objects, plot):
        Widget.close(one.layout)
        Widget.close(one)
    return snapshot, fact


class _Drawn:
    """A plot of K3D, and how meshes and lines get into it; each gives its id."""

    def __init__(self, k3d: Any, plot: Any):
        self.k3d, self.plot = k3d, plot

    def mesh(self, mesh: Mesh, side: str = "double") -> int:
        vertices, triangles = mesh.vertices.astype("f4"), mesh.triangles.astype("u4")
        return self._add(self.k3d.mesh(vertices, triangles, color=mesh.colour, flat_shading=False, side=side))

    def line(self, points: Points, colour: int, width: float) -> int:
        return self._add(self.k3d.line(points.astype("f4"), color=colour, shader="thick", width=width))

    def grid(self, lines: tuple[np.ndarray, ...]) -> int:
        ends = np.cumsum([len(line) for line in lines])
        begins = np.setdiff1d(np.arange(ends[-1]), ends - 1)
        pairs = np.stack([begins, begins + 1], axis=-1).astype("u4")
        points = np.concatenate(lines).astype("f4")
        kind = {"indices_type": "segment", "shader": "simple"}
        return self._add(self.k3d.lines(points, pairs, color=LINES, **kind))

    def _add(self, one: Any) -> int:
        self.plot += one
        return one.id


def _show(show: Show, drawn: _Drawn, numbers: _Numbers) -> dict[str, Any]:
    return {
        "name": show.name,
        "colour": css(show.colour),
        "times": numbers.add(show.times),
        "bodies": [
            {
                "name": body.name,
                "ids": [drawn.mesh(mesh) for mesh in body.meshes],
                "position": numbers.add(body.position),
                "turning": numbers.add(body.turning),
            }
            for body in show.bodies
        ],
        "traces": [
            {
                "id": drawn.line(finite(trace.points), trace.colour, trace.width),
                "about": None if trace.about is None else numbers.add(trace.about),
            }
            for trace in show.traces
        ],
        "arrows": [_arrow(arrow, drawn, numbers) for arrow in show.arrows],
        "curves": [{"label": curve.label, "values": numbers.add(curve.values)} for curve in show.curves],
    }


def finite(points: Points) -> Points:
    """Points, those that are not numbers replaced by the last before them."""
    good = np.all(np.isfinite(points), axis=-1)
    last = np.maximum.accumulate(np.where(good, np.arange(len(points)), 0))
    return np.nan_to_num(points[last])


def _arrow(arrow: Arrow, drawn: _Drawn, numbers: _Numbers) -> dict[str, Any]:
    """A shaft one metre long, which the script scales, and a tip, which it moves to the shaft's end."""
    head = 5.0 * arrow.width
    shaft = revolved([(0.0, 1.0), (arrow.width, 1.0), (arrow.width, 0.0), (0.0, 0.0)], arrow.colour)
    tip = revolved([(0.0, head), (2.4 * arrow.width, 0.0), (0.0, 0.0)], arrow.colour)
    return {
        "shaft": drawn.mesh(shaft),
        "tip": drawn.mesh(tip),
        "head": head,
        "start": numbers.add(finite(arrow.start)),
        "vector": numbers.add(finite(arrow.vector)),
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
    follow = bool(reach > 4.0 * size)
    if follow:
        middle, apart = among(np.stack([path[0] for path in paths]))
        reach = 2.0 * size + apart
    normal = stage.arena.normal
    aside = np.array([0.35, -1.0, 0.0])
    aside = aside - (aside @ normal) * normal
    direction = 0.55 * normal + aside / np.linalg.norm(aside)
    distance = 1.05 * (reach + 1.6 * size) / np.sin(np.radians(ANGLE) / 2.0)
    place = middle + distance * direction / np.linalg.norm(direction)
    return [*place.tolist(), *middle.tolist(), 0.0, 0.0, 1.0], follow
