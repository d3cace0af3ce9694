"""Bifurcation diagrams and basins of attraction against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from matplotlib.colors import to_hex

import nonholonomic
import tippe
from nonholonomic import AbstractMode, Hybrid
from nonholonomic.runs import attractors
from nonholonomic.runs.attractors import attractors_of
from nonholonomic.sweeps import Table


class Logistic(AbstractMode):
    """The logistic map, once a second."""

    rate: float

    def field(self, t, y):
        return jnp.array([0.0, 1.0])

    def margin(self, t, y):
        return 1.0 - y[1]

    def reset(self, t, y):
        return jnp.array([self.rate * y[0] * (1.0 - y[0]), 0.0]), 0


def middle(t, y):
    return 0.5 - y[1]


@pytest.fixture(scope="module")
def diagram():
    start, axes = [0.4, 0.0], {"rate": [2.8, 3.2, 3.4]}
    options = {"axes": axes, "tolerance": 1e-8, "progress": False}
    return nonholonomic.bifurcation(Hybrid([Logistic(2.8)]), start, 500.0, middle, 6, 200, **options)


def test_the_branches_of_the_logistic_map(diagram):
    """1 - 1/r, and beyond 3 the two solutions of r^2 x^2 - r (r + 1) x + r + 1 = 0."""
    assert diagram.crossing.tolist() == list(range(201, 207))
    assert_close(diagram.y0[0], 1.0 - 1.0 / 2.8, rtol=1e-12)
    for row, rate in zip(diagram.y0[1:], (3.2, 3.4), strict=True):
        root = np.sqrt((rate - 3.0) * (rate + 1.0))
        expected = np.array([rate + 1.0 - root, rate + 1.0 + root]) / (2.0 * rate)
        assert_close(np.sort(row), np.repeat(expected, 3), rtol=1e-12)


def test_a_diagram_is_drawn_as_points_over_its_number(diagram):
    (axes,) = diagram.plot("y0").axes
    (points,) = axes.lines
    assert points.get_linestyle() == "None"
    assert_close(np.sort(np.unique(points.get_xdata())), [2.8, 3.2, 3.4])
    assert len(points.get_ydata()) == 18
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("rate", "y0")
    # A single run has points over its crossings.
    (axes,) = diagram.plot("y0", at={"rate": 3.2}).axes
    assert [line.get_linestyle() for line in axes.lines] == ["None"]
    assert axes.get_xlabel() == "crossing"


def test_a_diagram_has_one_axis():
    axes = {"rate": [2.8], "start[0]": [0.1, 0.2]}
    with pytest.raises(ValueError, match="must name one parameter and its values; crossings takes several"):
        nonholonomic.bifurcation(Hybrid([Logistic(2.8)]), [0.4, 0.0], 9.0, middle, axes=axes)


class RestAndCycle(AbstractMode):
    """r' = -r (r^2 - 1/4) (r^2 - 1) and an angle that turns: rest, and a cycle of radius 1, parted by the circle r = 1/2."""

    rate: float

    def field(self, t, y):
        square = y[0] ** 2 + y[1] ** 2
        growth = -self.rate * (square - 0.25) * (square - 1.0)
        return jnp.array([growth * y[0] - y[1], y[0] + growth * y[1]])

    def margin(self, t, y):
        return 2.0 - y[0]


def test_the_basins_of_a_cycle_and_of_a_point_of_rest(tmp_path):
    system, values = Hybrid([RestAndCycle(2.0)]), np.linspace(-1.1, 1.1, 12)
    options = {"axes": {"start[0]": values, "start[1]": values}, "progress": False}
    table = nonholonomic.basins(system, [0.0, 0.0], 60.0, path=tmp_path / "basins.h5", **options)
    radius = np.hypot(*np.meshgrid(values, values))
    assert (np.abs(radius - 0.5) > 0.005).all()
    assert (table.attractor == np.where(radius > 0.5, 1, 2)).all()
    on_cycle = table.attractor == 1
    assert_close(table.y0_max[on_cycle], 1.0, atol=2e-3)
    assert_close(table.y0_min[on_cycle], -1.0, atol=2e-3)
    assert_close(table.y0_max[~on_cycle], 0.0, atol=1e-6)
    # The file has what the attractors follow from.
    again = nonholonomic.basins(system, [0.0, 0.0], 60.0, path=tmp_path / "basins.h5", **options)
    assert (again.attractor == table.attractor).all()
    # A colour for each number, and its number beside it.
    axes, bar = table.plot("attractor").axes
    assert [text.get_text() for text in bar.get_yticklabels()] == ["1", "2"]
    assert len(axes.collections) == 1


class Decay(AbstractMode):
    """Decay, beside a component that only noise changes."""

    rate: float

    def field(self, t, y):
        return jnp.array([-self.rate * y[0], 1e-9 * jnp.sin(1e3 * t)])

    def margin(self, t, y):
        return 2.0 - y[0]


def test_a_run_that_has_not_settled_or_cannot_start_has_no_attractor():
    axes = {"rate": [0.01, 1.0, 2.0, 1.0], "start[0]": [1.0, 1.0, 1.0, 2.5]}
    with pytest.warns(UserWarning, match="1 of 4 cells are illegal"):
        table = nonholonomic.basins(Hybrid([Decay(1.0)]), [1.0, 5.0], 60.0, axes=axes, scattered=True, progress=False)
    assert table.attractor.tolist() == [0, 1, 1, -1]
    assert table.status.tolist() == ["completed", "completed", "completed", "illegal"]


def test_runs_that_ended_are_told_from_those_that_have_not_settled():
    status = np.array([["completed"] * 12, ["completed"] * 11 + ["unresolved"]])
    ranges = {"y0_min": 1.0, "y0_max": 1.0, "y0_change": 0.0, "y0_range": 1.0}
    columns = {name: np.full((2, 12), value) for name, value in ranges.items()} | {"status": status}
    columns["y0_change"][0, 0] = 1.0
    numbers = attractors_of(Table({"x": np.arange(2.0), "y": np.arange(12.0)}, columns, {}, {}), ("y0",), 0.05, 1e-6)
    assert numbers[:, [0, 1, -1]].tolist() == [[0, 1, 1], [1, 1, -1]]
    axes, bar = Table({"x": np.arange(2.0), "y": np.arange(12.0)}, {"attractor": numbers}, {}, {}).plot().axes
    assert [text.get_text() for text in bar.get_yticklabels()] == ["-1", "0", "1"]
    colours = [to_hex(axes.collections[0].cmap(k)) for k in range(3)]
    assert colours == [to_hex(colour) for colour in ("0.55", "0.85", "C2")]


def test_a_diagram_says_how_many_runs_ended_early(monkeypatch):
    status = np.array(["event", "completed", "unresolved", "failed", "unresolved", "illegal"])
    monkeypatch.setattr(
        attractors, "crossings", lambda *_, **__: Table({"rate": np.arange(6.0)}, {"status": status}, {}, {})
    )
    with pytest.warns(
        UserWarning, match=r"3 of 6 runs ended early \(unresolved, failed\): returns are missing"
    ) as caught:
        nonholonomic.bifurcation(None, None, 1.0, axes={"rate": [1.0]})
    assert len(caught) == 1


class Cubic(Logistic):
    """x <- (3 x - x^3) / 2, once a second: to 1 from positive, and to -1 from negative numbers."""

    def reset(self, t, y):
        return jnp.array([self.rate * (3.0 * y[0] - y[0] ** 3), 0.0]), 0


def test_basins_through_resets():
    axes = {"start[0]": [-1.2, -0.3, 0.2, 0.5, 1.4]}
    table = nonholonomic.basins(Hybrid([Cubic(0.5)]), [0.0, 0.0], 40.0, axes=axes, progress=False)
    assert table.attractor.tolist() == [2, 2, 1, 1, 1]
    assert_close(table.y0_min, [-1.0, -1.0, 1.0, 1.0, 1.0], atol=1e-12)


BAD = [
    ({"resolution": 0.0}, "resolution = 0.0 must be greater than 0"),
    ({"quantities": "y0"}, "quantities = 'y0' must be a list of names"),
    ({"quantities": ["height"]}, "quantities: 'height' must be one of y0, y1"),
    ({"t1": -1.0}, "t1 = -1.0 must be greater than 0"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_arguments_are_named(arguments, message):
    options = {"t1": 9.0, "axes": {"start[0]": [0.1, 0.2]}, "progress": False} | arguments
    with pytest.raises(ValueError, match=message):
        nonholonomic.basins(Hybrid([RestAndCycle(2.0)]), [0.0, 0.0], **options)


def test_a_scene_needs_names_of_scalars(rutstam_scene):
    options = {"axes": {"launch.theta": [0.1, 0.2]}, "progress": False}
    with pytest.raises(ValueError, match="name quantities of the scene that tell attractors apart"):
        nonholonomic.basins(rutstam_scene, tippe.Launch(0.1, 155.0), 9.0, **options)
    with pytest.raises(ValueError, match="'position' is a vector; name scalar quantities"):
        nonholonomic.basins(rutstam_scene, tippe.Launch(0.1, 155.0), 9.0, quantities=["position"], **options)
