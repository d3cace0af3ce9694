"""Drawings of own systems in pages: a path of the first two components, or parts."""

import jax.numpy as jnp
import numpy as np
import pytest
from own_modes import Ball as Bouncing
from own_modes import Sleigh
from scipy.spatial.transform import Rotation

import nonholonomic
from nonholonomic import AbstractSystem, Hybrid, simulate
from nonholonomic.runs import model_of
from nonholonomic.runs.trajectory import drawn_by, page_of
from nonholonomic.views import Ball, Box, Disc, Line, Wheel

SLEIGH = ([0.0, 0.0, 0.3], [0.5 * np.cos(0.3), 0.5 * np.sin(0.3), 2.0])


class Pendulum(AbstractSystem):
    length: float = 1.0
    dimension = 1

    def metric(self, q):
        return jnp.array([[self.length**2]])

    def potential(self, q):
        return -9.81 * self.length * jnp.cos(q[0])


def pendulum(system, t, y):
    bob = (system.length * jnp.sin(y[0]), 0.0, -system.length * jnp.cos(y[0]))
    return [Ball(bob, 0.1, spin=-y[0]), Line((0.0, 0.0, 0.0), bob)]


def sleigh(system, t, y):
    place = (y[0], y[1], 0.1)
    return [
        Box(place, (0.6, 0.3, 0.2), heading=y[2]),
        Wheel(place, 0.1, heading=y[2], spin=2.0 * t),
        Disc(place, 0.1, heading=y[2], lean=0.5, colour=0x2A6FB0),
    ]


def test_the_first_two_components_are_a_path():
    """The coordinates of the sleigh have one scale, so that its path has its shape."""
    run = simulate(Sleigh(), SLEIGH, 3.0)
    (stage,) = run.stages()
    (show,) = stage.shows
    assert (stage.title, show.traces[0].name) == ("Sleigh: q1 over q0", "q1 over q0")
    (x, x_centre, x_scale), (y, y_centre, y_scale) = stage.arena.axes
    assert (x, y) == ("q0", "q1") == run.portrait_axes
    assert x_scale == y_scale
    expected = (np.asarray(run.state)[:, :2] - [x_centre, y_centre]) * x_scale
    np.testing.assert_allclose(show.traces[0].points[:, :2], expected, atol=1e-12)
    corners = stage.arena.mesh.vertices
    assert np.all(corners.min(axis=0)[:2] < expected.min(axis=0))
    assert np.all(corners.max(axis=0)[:2] > expected.max(axis=0))
    first, second, third = corners[stage.arena.mesh.triangles[0]]
    assert np.cross(second - first, third - first)[2] > 0.0


def test_components_of_unlike_size_have_scales_of_their_own():
    run = simulate(Hybrid([Bouncing()]), [1.0, 0.0, 0.0], 1.0)
    (_, _, height), (_, _, speed) = run.stages()[0].arena.axes
    assert height > 4.0 * speed
    assert simulate(Hybrid([Bouncing()]), [1.0, 0.0, 0.0], 1.0).stages()[0].title == "Ball: y1 over y0"


def test_parts_have_their_places_and_rotations():
    run = simulate(Sleigh(), SLEIGH, 1.0).drawn_by(sleigh)
    (stage,) = run.stages()
    (show,) = stage.shows
    _, box, wheel, disc = show.bodies
    heading, t = np.asarray(run.state)[:, 2], np.asarray(run.t)
    np.testing.assert_allclose(box.position[:, :2], np.asarray(run.state)[:, :2])
    for body, lean, spin in ((box, 0.0 * t, 0.0 * t), (wheel, 0.0 * t, 2.0 * t), (disc, 0.5 + 0.0 * t, 0.0 * t)):
        angles = np.stack([heading, lean, spin], axis=-1)
        expected = Rotation.from_euler("ZXY", angles).as_matrix()
        np.testing.assert_allclose(Rotation.from_quat(body.orientation).as_matrix(), expected, atol=1e-12)
    np.testing.assert_allclose(np.ptp(box.meshes[0].vertices, axis=0), [0.6, 0.3, 0.2])
    assert (disc.meshes[0].colour, stage.title) == (0x2A6FB0, "Sleigh")
    np.testing.assert_array_equal(show.traces[0].points, box.position)
    assert stage.arena.axes == (("x [m]", 0.0, 1.0), ("y [m]", 0.0, 1.0))


def test_a_pendulum_hangs_above_the_ground_in_pages_with_and_without_sliders():
    run = simulate(Pendulum(), ([1.0], [0.0]), 1.0)
    (show,) = run.drawn_by(pendulum).stages()[0].shows
    (line,) = show.arrows
    np.testing.assert_allclose(np.linalg.norm(line.vector, axis=-1), 1.0)
    assert (line.unit, line.colour) == ("", 0x3A3A3E)
    low = run.drawn_by(pendulum).stages()[0].arena.mesh.vertices[:, 2]
    np.testing.assert_allclose(low, np.min(line.vector[:, 2]) - 0.1)
    assert "Pendulum" in run.view(draw=pendulum).html
    model = drawn_by(model_of(Pendulum(), ([1.0], [0.0])), pendulum)
    _, stage = page_of(model, {"length": (0.5, 2.0)}, 1.0)
    assert len(stage.shows[0].bodies) == 2
    # The longest pendulum of the sliders also has room.
    assert stage.arena.mesh.vertices[0, 2] < -2.0
    assert nonholonomic.explore(Pendulum(), ([1.0], [0.0]), sliders={"length": (0.5, 2.0)}, t1=0.5, draw=pendulum).html


def test_runs_overlaid_have_colours_of_their_own():
    runs = [simulate(Pendulum(length), ([1.0], [0.0]), 1.0) for length in (1.0, 2.0)]
    (stage,) = runs[0].drawn_by(pendulum).stages([runs[1]], overlaid=True)
    assert [np.max(np.linalg.norm(show.arrows[0].vector, axis=-1)).round(6) for show in stage.shows] == [1.0, 2.0]
    assert len({show.colour for show in stage.shows}) == 2


@pytest.mark.parametrize(
    ("draw", "problem"),
    [
        (
            lambda system, t, y: Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
            "draw must return a list of Box, Wheel, Disc, Ball",
        ),
        (lambda system, t, y: [], "draw must return a list of Box, Wheel, Disc, Ball"),
        (
            lambda system, t, y: [y[7] + system.mass],
            r"draw\(system, t, y\) raised AttributeError: .*no attribute 'mass'",
        ),
        (lambda system, t, y: [Ball((y[0], 0.0), 0.1)], r"draw: a place in Ball must be three numbers, \(x, y, z\)"),
        (lambda system, t, y: [Line((0.0, 0.0), (1.0, 0.0))], "draw: a place in Line must be three numbers"),
        ("red", r"draw = 'red' must be a function draw\(system, t, y\) for your own system"),
    ],
)
def test_wrong_drawings_are_refused(draw, problem):
    with pytest.raises(ValueError, match=problem):
        simulate(Pendulum(), ([1.0], [0.0]), 0.2).view(draw=draw)
