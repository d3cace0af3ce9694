"""Drawings of own systems in pages: a path of the first two components, or parts."""

import copy
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from own_modes import Ball as Bouncing
from own_modes import Pendulum, Sleigh
from scipy.spatial.transform import Rotation

import nonholonomic
from nonholonomic import AbstractMode, AbstractSystem, Hybrid, simulate
from nonholonomic.runs import model_of
from nonholonomic.runs.trajectory import Trajectory, drawn_by, page_of
from nonholonomic.views import Ball, Box, Disc, Line, Wheel

SLEIGH = ([0.0, 0.0, 0.3], [0.5 * np.cos(0.3), 0.5 * np.sin(0.3), 2.0])


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


def test_a_rate_has_a_scale_of_its_own_and_places_have_one():
    """The plane of an angle and its rate is a square; the arc of a pendulum in x and y keeps its shape."""
    (_, _, angle), (_, _, rate) = simulate(Pendulum(), ([1.0], [0.0]), 3.0).stages()[0].arena.axes
    assert 2.0 < angle / rate < 4.0
    named = type("Falling", (Decay,), {"names": ("x", "y"), "field": lambda self, t, y: -y * jnp.array([1.0, 3.0])})
    (_, _, x), (_, _, y) = simulate(Hybrid([named()]), [6.0, 1.0], 3.0).stages()[0].arena.axes
    assert x == y


class Rod(AbstractSystem):
    """A mass on a rod about the origin, which no start may move along the rod."""

    dimension, names = 2, ("x", "y")

    def metric(self, q):
        return jnp.eye(2)

    def constraints(self, q):
        return q[None]


def test_default_sliders_allow_runs_and_name_the_component():
    live, _ = page_of(model_of(Rod(), ([0.6, -0.8], [0.0, 0.0])), None, 1.0)
    assert [slider.label for slider in live.sliders] == ["x at the start", "y at the start"]
    live, _ = page_of(model_of(Sleigh(), SLEIGH), None, 1.0)
    assert [slider.label for slider in live.sliders] == ["mass", "inertia", "ahead"]


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
        (lambda system, t, y: [Ball((y[0], 0.0), 0.1)], r"draw: place in Ball must be three numbers, \(x, y, z\)"),
        (lambda system, t, y: [Line((0.0, 0.0), (1.0, 0.0))], "draw: begin in Line must be three numbers"),
        (
            lambda system, t, y: [Ball((y[0], 0.0, jnp.sqrt(0.1 - t)), 0.1)],
            r"draw returned NaN or infinity at t = 0\.1",
        ),
        (lambda system, t, y: [Ball((0.0, 0.0, 0.0), jnp.nan * t)], r"draw returned NaN or infinity at t = 0"),
        (lambda system, t, y: [Ball((0.0, 0.0, 0.0), 0.1 + t)], "draw: the size of a Ball must not change in time"),
        (
            lambda system, t, y: [Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0 + t))],
            "draw: the size of a Box must not change in time",
        ),
        (lambda system, t, y: [Wheel((0.0, 0.0, 0.0), y)], r"radius in Wheel must be one number, not of shape \(2,\)"),
        (lambda system, t, y: [Disc((0.0, 0.0, 0.0), 0.1, spin=y)], r"spin in Disc must be one number, not of shape"),
        (
            lambda system, t, y: [Box((0.0, 0.0, 0.0), 1.0)],
            r"lengths in Box must be three numbers, .*not of shape \(\)",
        ),
        ("red", r"draw = 'red' must be a function draw\(system, t, y\) for your own system"),
    ],
)
def test_wrong_drawings_are_refused(draw, problem):
    with pytest.raises(ValueError, match=problem):
        simulate(Pendulum(), ([1.0], [0.0]), 0.2).view(draw=draw)


def rising(system, t, y):
    return [Ball((0.0, 0.1 * t, t), 0.1), Line((0.0, 0.0, 0.0), (0.0, 0.0, t))]


def test_places_may_depend_on_time_in_pages_with_sliders():
    run = simulate(Pendulum(), ([1.0], [0.0]), 0.5)
    assert "Pendulum" in run.explore(sliders={"length": (0.5, 2.0)}, draw=rising).html
    (show,) = run.drawn_by(rising).stages()[0].shows
    np.testing.assert_allclose(show.bodies[1].position[:, 2], run.t)


def test_what_a_drawing_lacks_is_said_in_pages_with_sliders():
    with pytest.raises(ValueError, match="draw: place in Ball must be three numbers"):
        nonholonomic.explore(Pendulum(), ([1.0], [0.0]), t1=0.5, draw=lambda system, t, y: [Ball((y[0], 0.0), 0.1)])


def test_runs_side_by_side_are_all_drawn_by_the_function():
    runs = [simulate(Pendulum(length), ([1.0], [0.0]), 0.5) for length in (1.0, 2.0)]
    alone, together = (runs[0].view(others=others, draw=pendulum).html for others in ([], runs[1:]))
    # The meshes of the balls.
    assert together.count('"vertices"') == 2 * alone.count('"vertices"') > 2
    assert [stage.title for stage in runs[0].drawn_by(pendulum).stages([runs[1].drawn_by(pendulum)])] == 2 * [
        "Pendulum"
    ]


def test_a_batch_of_runs_is_refused_also_with_a_drawing():
    runs = jax.vmap(lambda angle: simulate(Pendulum(), (angle, jnp.zeros(1)), 0.5, times=[0.1]))(jnp.ones((2, 1)))
    with pytest.raises(ValueError, match="this is a batch of runs"):
        runs.view(draw=pendulum)


def test_a_run_without_a_finite_state_has_no_picture():
    illegal = jax.vmap(lambda height: simulate(Hybrid([Bouncing()]), [height, 0.0, 0.0], 0.5, times=[0.1]))(
        -jnp.ones(1)
    )
    run = jax.tree.map(lambda leaf: leaf[0], illegal)
    with pytest.raises(ValueError, match="needs a finite state, but the run, with status 'illegal', has none"):
        run.view()


class Decay(AbstractMode):
    def field(self, t, y):
        return -y


def test_one_component_is_drawn_on_a_line():
    (stage,) = simulate(Hybrid([Decay()]), [1.0], 1.0).stages()
    assert (stage.title, [name for name, _, _ in stage.arena.axes]) == ("Decay: y0", ["y0"])
    points = stage.shows[0].traces[0].points
    np.testing.assert_allclose((points[0], points[-1]), [[1.0, 0.0, 0.05], [-1.0, 0.0, 0.05]])


def test_a_drawing_without_extent_has_a_size():
    run = simulate(Hybrid([Decay()]), [1.0], 1.0).drawn_by(lambda system, t, y: [Ball((0.0, 0.0, 0.0), 0.0)])
    assert run.stages()[0].shows[0].size == 1.0


def test_copies_keep_the_drawing():
    run = simulate(Pendulum(), ([1.0], [0.0]), 0.5).drawn_by(pendulum)
    assert copy.deepcopy(run).model.draw is pickle.loads(pickle.dumps(run)).model.draw is pendulum
    assert not hasattr(object.__new__(Trajectory), "model")


def test_an_unknown_attribute_lists_the_state():
    run = simulate(Pendulum(), ([1.0], [0.0]), 0.5)
    with pytest.raises(AttributeError, match=r"no 'stat'; did you mean 'stat(e|us)'\? It has t, state, q0, rate0"):
        run.stat  # noqa: B018
    assert list(run) == ["q0", "rate0"]


@pytest.mark.parametrize("name", ["state", "model", "plot", "time", "end_time"])
def test_components_have_no_names_of_a_run(name):
    wrong = type("Wrong", (Decay,), {"names": (name,)})
    with pytest.raises(ValueError, match=rf"Wrong\.names = .* must be 1 different words, .*, such as {name}"):
        simulate(Hybrid([wrong()]), [1.0], 1.0)
