"""Arenas, animations and pages of a prescribed motion: a ball that rolls along a line."""

import base64
import json
import re
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from nonholonomic.geometry import Cylinder, Graph, Implicit, Paraboloid, Plane, Sphere, Spheroid, Torus
from nonholonomic.views import (
    Arrow,
    Body,
    Curve,
    Show,
    Stage,
    Trace,
    arena,
    ball,
    distinguished_by_colour,
    page,
    turned,
)
from nonholonomic.views.animation import Viewable, draw_curves, frame_times, rate_of, speed_as_text, write_animation
from nonholonomic.views.stage import matrices

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
    body = Body("ball", position, turned(rotation), ball(radius, (0xC8412B, 0xF4E9D2)))
    np.testing.assert_allclose(matrices(body.orientation), rotation, atol=1e-14)
    show = Show(
        "a ball",
        0xC8412B,
        times,
        np.tile([0.0, 0.0, 1.0], (41, 1)),
        radius,
        (body,),
        (Trace("path", foot, 0x1F8A4C, 0.01),),
        (Arrow("up", foot, np.tile([0.0, 0.0, 2.0], (41, 1)), "N", radius, 0x7B4FA3, 0.01, 1.5 * radius),),
        (Curve("x [m]", position[:, 0]), Curve("z [m]", position[:, 2])),
    )
    ground = arena(Plane(), foot, np.array([0.0, 0.0, 1.0]), 0.2, 0.1)
    return Stage("rolling", ground, (show,))


def test_turns_are_told_from_matrices_and_back():
    random = np.random.default_rng(0)
    turning = random.normal(size=(200, 4))
    # Half turns, where the quaternion's last component is 0, among them.
    turning[:50, 3] = 0.0
    turning /= np.linalg.norm(turning, axis=-1, keepdims=True)
    rotation = turned(matrices(turning))
    np.testing.assert_allclose(np.abs(np.sum(rotation * turning, axis=-1)), 1.0, atol=1e-12)


def test_an_animation_moves(tmp_path):
    write_animation([rolling()], tmp_path / "ball.gif", np.array([0.0, 1.0, 2.0]))
    with Image.open(tmp_path / "ball.gif") as picture:
        assert picture.n_frames == 3
        pictures = []
        for frame in range(3):
            picture.seek(frame)
            pictures.append(np.asarray(picture.convert("RGB"), dtype=float))
    assert all(np.mean(np.abs(a - b)) > 0.5 for a, b in zip(pictures, pictures[1:], strict=False))
    with pytest.raises(ValueError, match=r"ball\.avi' must end in \.gif"):
        write_animation([rolling()], tmp_path / "ball.avi", None)


class Rolling(Viewable):
    """A run with the stage of `rolling`."""

    def stages(self, others=(), overlaid=False, unit=None):
        return [rolling()]


def test_an_animation_plays_in_real_time(tmp_path):
    """By the delays in the file: two seconds last two seconds, or one at twice the speed."""
    for options, frames, seconds in (({"fps": 5}, 11, 2.0), ({"fps": 20.0, "speed": 4.0}, 11, 0.5)):
        Rolling().animate(tmp_path / "ball.gif", **options)
        with Image.open(tmp_path / "ball.gif") as picture:
            assert picture.n_frames == frames
            delays = []
            for frame in range(frames):
                picture.seek(frame)
                delays.append(picture.info["duration"] / 1000.0)
        # The last frame shows the end.
        assert sum(delays[:-1]) == pytest.approx(seconds)


def test_the_picture_states_the_speed():
    np.testing.assert_allclose(frame_times(8.0, 1.0, 25.0), np.linspace(0.0, 8.0, 201), rtol=1e-12)
    assert frame_times(0.1, 1.0, 4.0).tolist() == [0.0, 0.1]
    assert speed_as_text(frame_times(8.0, 1.0, 25.0), 25.0) == ", real time"
    assert speed_as_text(np.linspace(3.5, 5.5, 251), 25.0) == ", 0.2 times real time"
    assert speed_as_text(np.array([0.0, 1.0, 3.0, 4.0]), 25.0) == ""
    # A GIF counts hundredths of a second.
    assert rate_of(".gif", 30.0) == pytest.approx(100.0 / 3.0)
    assert rate_of(".gif", 100.0) == 50.0
    assert rate_of(".mp4", 30.0) == 30.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0.0}, r"fps = 0\.0 must be greater than 0"),
        ({"speed": -1.0}, r"speed = -1\.0 must be greater than 0"),
        ({"speed": 1.0, "times": [0.0, 1.0]}, "speed follows from times and fps: omit speed, or omit times"),
        ({"times": [1.0, 0.0]}, "times"),
    ],
)
def test_what_cannot_be_animated_is_refused(options, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        Rolling().animate(tmp_path / "ball.gif", **options)


def test_curves_are_drawn_and_what_is_constant_is_flat():
    stage = rolling()
    x, z = draw_curves([stage]).axes
    np.testing.assert_array_equal(x.lines[0].get_ydata(), stage.shows[0].curves[0].values)
    assert x.get_ylabel() == "x [m]"
    low, high = z.get_ylim()
    assert low < 0.1 < high
    assert high - low > 1e-5


def test_a_view_and_an_animation_have_the_unit_that_was_asked_for(tmp_path):
    run = Rolling()
    assert '"label": "z [cm]", "factor": 100.0' in run.view(unit="cm").html
    run.animate(tmp_path / "ball.gif", fps=2.0, unit="mm")
    with pytest.raises(ValueError, match=r"unit = 'deg' fits nothing that is drawn: x \[m\], z \[m\]"):
        run.view(unit="deg")
    with pytest.raises(ValueError, match="unit = 'degree' must be one of"):
        run.animate(tmp_path / "ball.gif", unit="degree")


def test_an_arrow_is_drawn_by_its_scale_up_to_its_limit():
    (arrow,) = rolling().shows[0].arrows
    np.testing.assert_allclose(arrow.drawn, np.tile([0.0, 0.0, 0.15], (41, 1)), rtol=1e-14)
    np.testing.assert_allclose(arrow._replace(limit=None).drawn, np.tile([0.0, 0.0, 0.2], (41, 1)), rtol=1e-14)
    assert not np.any(arrow._replace(vector=0.0 * arrow.vector).drawn)


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
    fact = facts["stages"][0]["runs"][0]
    assert fact == facts["stages"][1]["runs"][0]
    for (start, length), values in (
        (fact["times"], show.times),
        (fact["bodies"][0]["orientation"], show.bodies[0].orientation),
        (fact["arrows"][0]["vector"], show.arrows[0].vector),
    ):
        np.testing.assert_allclose(floats[start : start + length], values.ravel(), rtol=1e-6, atol=1e-12)
    start, length = facts["stages"][0]["arena"]["triangles"]
    triangles = np.cumsum(np.frombuffer(steps, "<i4")[start : start + length])
    np.testing.assert_array_equal(triangles, stage.arena.mesh.triangles.ravel())
    # The page of two balls, with three.js.
    assert len(html) < 4e5


def test_a_page_without_motion_has_no_script(tmp_path):
    text = page([], "a < b", above="<p>words</p>").html
    assert "a &lt; b" in text
    assert "<p>words</p>" in text
    assert "<script" not in text


def test_traces_of_several_runs_have_their_colours():
    (show,) = rolling().shows
    assert distinguished_by_colour((show,)) == (show,)
    drawings = distinguished_by_colour((show, show._replace(colour=0x2A6FB0)))
    assert [drawing.traces[0].colour for drawing in drawings] == [0xC8412B, 0x2A6FB0]
