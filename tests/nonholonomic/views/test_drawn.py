"""Arenas, films and pages of a prescribed motion: a ball that rolls along a line."""

import base64
import contextlib
import json
import re
import sys
import time
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
from browser import needs_browser, open_browser, wait
from scipy.spatial.transform import Rotation

from nonholonomic.geometry import Cylinder, Graph, Implicit, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.sweeps import Table
from nonholonomic.views import (
    Arrow,
    Body,
    Curve,
    Show,
    Stage,
    Trace,
)
from nonholonomic.views.pages import Viewable, page, picture_as_html
from nonholonomic.views.plot import draw_series
from nonholonomic.views.stage import arena, ball, quaternion

SURFACES = (
    (Plane(), (0.3, 0.1)),
    (Plane(0.3), (0.3, 0.1)),
    (Cylinder(0.5), None),
    (Sphere(0.5), (0.3, -1.2)),
    (Spheroid(0.6, 0.3), (2.0, -1.5)),
    (Torus(1.0, 0.3), (0.3, 2.0)),
    (Paraboloid(0.4), (0.1, 0.2)),
    (Graph(lambda x, y: 0.1 * jnp.sin(3.0 * x) * y), (0.1, 0.2)),
    pytest.param(Implicit(lambda x, y, z: x**2 + y**2 + z**2 - 0.25), (0.3, 0.0, -0.4), marks=pytest.mark.slow),
)


@pytest.mark.parametrize(("surface", "place"), SURFACES, ids=lambda value: type(value).__name__)
def test_an_arena_lies_on_its_surface_and_reaches_about_the_run(surface, place):
    place = (0.2, 0.3) if place is None else place
    point = np.array([float(part) for part in surface.in_fixed_frame(surface.chart(tuple(map(jnp.asarray, place)))[0])])
    picture_of_arena = arena(surface, point[None], np.array([0.0, 0.0, 1.0]), 0.1, 0.03)
    for points in (picture_of_arena.mesh.vertices, np.concatenate(picture_of_arena.lines)):
        distances = surface.distance(surface.in_own_axes(tuple(points.T)))
        assert distances is None or np.max(np.abs(distances)) < 1e-9
    distance = np.linalg.norm(picture_of_arena.mesh.vertices - point, axis=-1)
    assert distance.min() < 0.01
    assert 0.09 < distance.max() < 0.6


def rolling(surface=None) -> Stage:
    """A ball that rolls along x, a radius each second, for 2 s."""
    times, radius = np.linspace(0.0, 2.0, 41), 0.1
    cosine, sine, zero = np.cos(times), np.sin(times), np.zeros(41)
    rows = [[cosine, zero, sine], [zero, zero + 1.0, zero], [-sine, zero, cosine]]
    rotation = np.moveaxis(np.array(rows), -1, 0)
    position = np.stack([radius * times, zero, zero + radius], axis=-1)
    foot = position * [1.0, 1.0, 0.0]
    body = Body(position, quaternion(rotation), ball(radius, (0xC8412B, 0xF4E9D2)))
    np.testing.assert_allclose(Rotation.from_quat(body.orientation).as_matrix(), rotation, atol=1e-14)
    show = Show(
        "a ball",
        0xC8412B,
        times,
        np.tile([0.0, 0.0, 1.0], (41, 1)),
        radius,
        (body,),
        (Trace("path", foot, 0x1F8A4C, 0.01),),
        (Arrow("up", foot, np.tile([0.0, 0.0, 2.0], (41, 1)), "N", radius, 0x7B4FA3, 0.01, 1.5 * radius),),
        (Curve("x", "m", position[:, 0]), Curve("z", "m", position[:, 2])),
    )
    ground = arena(Plane(), foot, np.array([0.0, 0.0, 1.0]), 0.2, 0.1)
    return Stage("rolling", ground, (show,))


class Rolling(Viewable):
    """A run with the stage of `rolling`."""

    def stages(self, others=(), overlaid=False, unit=None, label=None):
        return [rolling()]


#: Play a film, given as base64: duration, width and height, and some of its frames as grey values.
PLAY = """
const [film, parts, done] = arguments;
(async () => {
  const video = Object.assign(document.createElement("video"), { muted: true, src: `data:video/webm;base64,${film}` });
  await new Promise((next, fail) => { video.onloadeddata = next; video.onerror = () => fail(video.error.message); });
  const size = { width: video.videoWidth, height: video.videoHeight };
  const pen = Object.assign(document.createElement("canvas"), size).getContext("2d", { willReadFrequently: true }), frames = [];
  for (const part of parts) {
    video.currentTime = part * video.duration;
    await new Promise((next) => { video.onseeked = next; });
    pen.drawImage(video, 0, 0);
    frames.push([...pen.getImageData(0, 0, size.width, size.height).data.filter((_, k) => k % 4 === 1)]);
  }
  done([video.duration, size.width, size.height, frames]);
})().catch((error) => done(String(error)));
"""


def played(driver, film: bytes, parts: list[float]) -> tuple[float, np.ndarray]:
    """The duration of a film [s], and its frames at parts of it, (frames, rows, columns)."""
    duration, width, height, frames = driver.execute_async_script(PLAY, base64.b64encode(film).decode(), parts)
    return duration, np.array(frames, dtype=float).reshape(len(parts), height, width)


@needs_browser
def test_a_film_plays_the_run_in_its_time(tmp_path, monkeypatch):
    """The ball has rolled half of its way after half of the film, however long each frame took to draw."""
    monkeypatch.setattr("nonholonomic.views.pages.WINDOW", (500, 700))
    monkeypatch.setattr("nonholonomic.views.pages.HEIGHT", 100)
    Rolling().animate(tmp_path / "ball.webm", speed=4.0, fps=20)
    film = (tmp_path / "ball.webm").read_bytes()
    with open_browser() as driver:
        driver.set_script_timeout(60.0)
        duration, frames = played(driver, film, [0.0, 0.5, 1.0])
    # Two seconds at four times the speed; players add the duration of the last frame.
    assert 0.49 < duration < 0.56
    stages, curves = frames[:, 40:120], frames[:, -100:]
    changed = np.abs(np.diff(frames, axis=0)).max(axis=0) > 60.0
    assert all(np.count_nonzero(np.abs(step) > 60.0) > 50 for step in np.diff(stages, axis=0))
    # The cursors in the curves are the last dark columns that move.
    assert np.count_nonzero(changed[-100:]) > 50
    assert np.ptp(curves[0]) > 100.0


@needs_browser
def test_a_page_saves_films_and_pictures(tmp_path):
    """By the keyboard alone; the film begins at the time of the slider, and has the length and the speed that are chosen."""
    from selenium.webdriver import ActionChains, Keys

    page([rolling()], "A ball", height=100, autoplay=False).save(tmp_path / "page.html")
    with open_browser() as driver:
        driver.set_script_timeout(60.0)
        driver.execute_cdp_cmd("Page.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
        driver.get((tmp_path / "page.html").as_uri())
        wait(driver, "return !!window.player")
        driver.execute_script("player.seek(0.5); document.getElementById('save-film').focus()")
        ActionChains(driver).send_keys(Keys.ENTER, "0.4", Keys.TAB, "2", Keys.TAB, Keys.ENTER).perform()
        wait(driver, "return document.querySelector('#film output').value === 'saved'")
        assert driver.execute_script("return player.time()") == pytest.approx(1.3)
        # The file has the time of the picture, also on a page that is at another time when the file is ready.
        driver.execute_script(
            "const { toBlob } = HTMLCanvasElement.prototype; HTMLCanvasElement.prototype.toBlob = function (then) {"
            " toBlob.call(this, (blob) => { player.seek(0.5); then(blob); }); };"
            "document.getElementById('save-picture').focus()"
        )
        ActionChains(driver).send_keys(Keys.ENTER).perform()
        deadline = time.monotonic() + 30.0
        while not ((tmp_path / "A-ball.webm").exists() and (tmp_path / "A-ball-1.300s.png").exists()):
            assert time.monotonic() < deadline, list(tmp_path.iterdir())
            time.sleep(0.05)
        # The page itself loads no films.
        driver.get("about:blank")
        duration, _ = played(driver, (tmp_path / "A-ball.webm").read_bytes(), [0.0])
        assert 0.39 < duration < 0.45
    assert (tmp_path / "A-ball-1.300s.png").read_bytes().startswith(b"\x89PNG")


#: A browser that opens a page, and posts something in its place.
BROWSER = """#!{python}
import sys, urllib.request
opener = urllib.request.build_opener(urllib.request.ProxyHandler({{}}))
assert b"views.ready" in opener.open(sys.argv[-1]).read()
opener.open(sys.argv[-1] + {name!r}, data=b"no WebGL").close()
"""


@pytest.mark.parametrize("name", ["film", "error", "share"])
def test_a_film_is_what_the_page_posts(name, tmp_path, monkeypatch):
    (tmp_path / "browser").write_text(BROWSER.format(python=sys.executable, name=name))
    (tmp_path / "browser").chmod(0o755)
    monkeypatch.setattr("nonholonomic.views.pages.BROWSERS", ("no-such-browser", str(tmp_path / "browser")))
    message = {"error": "browser cannot record the page: no WebGL", "share": "browser ended with the status 0 before"}
    expected = pytest.raises(OSError, match=message[name]) if name in message else contextlib.nullcontext()
    with expected:
        Rolling().animate(tmp_path / "ball.webm")
    if name == "film":
        assert (tmp_path / "ball.webm").read_bytes() == b"no WebGL"
    assert len(list(tmp_path.glob("ball*"))) == (name == "film")


def test_a_film_without_a_browser_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr("nonholonomic.views.pages.BROWSERS", ())
    monkeypatch.setattr(Rolling, "stages", lambda *_: pytest.fail("it was drawn"))
    with pytest.raises(FileNotFoundError, match=r"needs Chromium, Chrome or Edge.*apt install chromium.*Save film"):
        Rolling().animate(tmp_path / "ball.webm")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0.0}, r"fps = 0\.0 must be greater than 0"),
        ({"speed": -1.0}, r"speed = -1\.0 must be greater than 0"),
        ({"speed": 1.0, "times": [0.0, 1.0]}, "speed follows from times and fps: omit speed, or omit times"),
        ({"times": [1.0, 0.0]}, "times"),
        ({"path": "ball.gif"}, r"path = 'ball\.gif' must end in \.webm"),
    ],
)
def test_what_cannot_be_filmed_is_refused(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Rolling().animate(**{"path": tmp_path / "ball.webm"} | options)


def test_curves_are_drawn_and_what_is_constant_is_flat():
    (show,) = rolling().shows
    curves = {curve.name: curve.values for curve in show.curves}
    tables = [Table({"time": show.times}, curves, dict.fromkeys(curves, "m") | {"time": "s"}, {})]
    x, z = draw_series(tables, list(curves), [""], [()]).axes
    np.testing.assert_array_equal(x.lines[0].get_ydata(), show.curves[0].values)
    assert x.get_ylabel() == "x [m]"
    low, high = z.get_ylim()
    assert low < 0.1 < high
    assert high - low > 1e-5


def test_a_view_has_the_unit_that_was_asked_for(tmp_path, monkeypatch):
    run = Rolling()
    monkeypatch.setattr("nonholonomic.views.pages.BROWSERS", (sys.executable,))
    assert re.search(
        r'"name": "z", "unit": "cm", "values": \{"floats": \[\d+, \d+\]\}, "factor": 100\.0', run.view(unit="cm").html
    )
    with pytest.raises(ValueError, match=r"unit = 'deg' fits nothing that is drawn: x \[m\], z \[m\]"):
        run.view(unit="deg")
    with pytest.raises(ValueError, match="unit = 'grade' must be one of"):
        run.animate(tmp_path / "ball.webm", unit="grade")


def test_the_front_of_an_arena_is_towards_the_room():
    """Inside and outside of a cylinder: triangles turn counterclockwise as seen from the side of the normal."""
    point = np.array([[0.0, 0.0, -0.5]])
    for normal in (np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
        vertices, triangles, _ = arena(Cylinder(0.5), point, normal, 0.1, 0.03).mesh
        corners = vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.all(normals @ normal > 0.0)


def test_a_page_holds_its_numbers_in_single_precision():
    """Floats byte plane by byte plane, whole numbers as differences, each array where the facts say; equal arrays once."""
    stage, html = rolling(), page([rolling(), rolling()], "a ball").html
    data = {name: re.search(rf'id="{name}">([^<]*)<', html).group(1) for name in ("facts", "floats", "whole")}
    facts = json.loads(data["facts"])
    planes, steps = (zlib.decompress(base64.b64decode(data[name])) for name in ("floats", "whole"))
    floats = np.frombuffer(planes, np.uint8).reshape(4, -1).T.copy().view("<f4").ravel()
    (show,) = stage.shows
    fact = facts["stages"][0]["shows"][0]
    assert fact == facts["stages"][1]["shows"][0]
    for place, values in (
        (fact["times"], show.times),
        (fact["bodies"][0]["orientation"], show.bodies[0].orientation),
        (fact["arrows"][0]["vector"], show.arrows[0].vector),
    ):
        start, length = place["floats"]
        np.testing.assert_allclose(floats[start : start + length], values.ravel(), rtol=1e-6, atol=1e-12)
    start, length = facts["stages"][0]["arena"]["mesh"]["triangles"]["whole"]
    triangles = np.cumsum(np.frombuffer(steps, "<i4")[start : start + length])
    np.testing.assert_array_equal(triangles, stage.arena.mesh.triangles.ravel())
    # The page of two balls, with three.js.
    assert len(html) < 4e5


def test_a_picture_has_its_heading_as_a_description(tmp_path):
    (tmp_path / "a.png").write_bytes(b"PNG")
    text = picture_as_html(tmp_path / "a.png", "a < b")
    assert text.startswith(
        '<h2>a &lt; b</h2><div class="wide"><img alt="plot: a &lt; b" src="data:image/png;base64,UE5H"'
    )


def test_a_page_without_motion_has_no_script(tmp_path):
    text = page([], "a < b", above="<p>words</p>").html
    assert "a &lt; b" in text
    assert "<p>words</p>" in text
    assert "<script" not in text
