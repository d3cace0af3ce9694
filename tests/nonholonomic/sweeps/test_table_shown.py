"""Access to tables: variables by name, plots, xarray, and files without the sweep's internal attributes."""

import dataclasses
import io
import json

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray
from cheap_sweep import cheap_sweep
from close import assert_close

from nonholonomic.sweeps import Table
from nonholonomic.views.stage import COLOURS, css

THETA, SPIN, MU = np.linspace(0.1, 0.4, 4), np.linspace(60.0, 160.0, 11), np.array([0.1, 0.2, 0.3])


@pytest.fixture(scope="module")
def table():
    """Times 1 + theta + mu spin, with one outlier and one missing value."""
    time = 1.0 + THETA[:, None, None] + MU[:, None] * SPIN
    time[0, 0, 0], time[1, 0, 1] = 1e4, np.inf
    status = np.where(np.isfinite(time), "inverted", "not_inverted")
    units = {"theta": "rad", "mu": "s m-1", "spin": "rad s-1", "time": "s"}
    names = {"theta": "θ(0)", "mu": "friction μ", "time": "inversion time"}
    attributes = {"request": "{}", "axes": json.dumps(["theta", "mu", "spin"])}
    coords, variables = {"theta": THETA, "mu": MU, "spin": SPIN}, {"time": time, "status": status}
    return Table(coords, variables, units, attributes, long_names=names)


def test_names_are_found_and_completed(table):
    assert table["time"] is table.time
    assert table["spin"] is SPIN
    assert table.spin is SPIN
    assert {"time", "status", "theta"} <= set(table._ipython_key_completions_())
    assert "time" in dir(table)
    assert list(table) == ["time", "status", "theta", "mu", "spin"]
    assert "spin" in table
    assert "tme" not in table
    with pytest.raises(KeyError, match="no 'tme'; it has time, status, theta"):
        table["tme"]


def test_it_says_what_it_holds(table):
    assert table.label("time") == "inversion time [s]"
    assert table.label("theta") == "θ(0) [rad]"
    assert table.label("spin") == "spin [rad/s]"
    assert "time [s]: 7.2 to 10000, 1 not finite" in str(table)
    html = table._repr_html_()
    assert "θ(0) [rad]" in html
    assert "131 inverted, 1 not_inverted" in html


def test_a_picture_is_cut_where_it_says(table):
    figure = table.plot()
    drawing = figure.axes[0]
    # Three values of mu are lines over theta; the spin is cut at its first value.
    assert drawing.get_title() == "spin = 60 rad/s"
    assert [text.get_text() for text in drawing.get_legend().get_texts()] == [f"friction μ = {mu:g} s/m" for mu in MU]
    figure = table.plot("time", at={"mu": 0.19})
    drawing = figure.axes[0]
    assert drawing.get_title() == "friction μ = 0.2 s/m (nearest to 0.19)"
    assert table.plot("time", at={"mu": 0.2}).axes[0].get_title() == "friction μ = 0.2 s/m"
    assert (drawing.get_xlabel(), drawing.get_ylabel()) == ("θ(0) [rad]", "spin [rad/s]")
    assert figure.axes[1].get_ylabel() == "inversion time [s]"
    np.testing.assert_array_equal(np.asarray(drawing.collections[0].get_array()), table.time[:, 1].T)


def test_axes_labels_and_units_are_chosen(table):
    lines = table.plot(x="mu", at={"spin": 70.0}, label="a top", unit="deg").axes[0]
    assert (lines.get_xlabel(), lines.get_ylabel()) == ("friction μ [s/m]", "inversion time [s]")
    texts = [text.get_text() for text in lines.get_legend().get_texts()]
    assert texts == [f"a top, θ(0) = {theta:.4g} deg" for theta in np.degrees(THETA)]
    (third,) = (line for line in lines.get_lines() if line.get_label() == texts[2])
    assert_close(third.get_xydata(), np.stack([MU, table.time[2, :, 1]], axis=-1))
    assert third.get_color() == css(COLOURS[2])
    chart = table.plot(x="spin", y="theta", unit=["deg", "rpm"], label="a top").axes[0]
    assert (chart.get_xlabel(), chart.get_ylabel()) == ("spin [rpm]", "θ(0) [deg]")
    assert chart.get_title() == "a top, friction μ = 0.1 s/m"
    np.testing.assert_array_equal(np.asarray(chart.collections[0].get_array())[2], table.time[2, 0])
    # A value of `at` has the unit of the table.
    assert table.plot(at={"theta": 0.2}, unit="deg").axes[0].get_title() == "θ(0) = 11.46 deg"
    (single,) = table.plot(at={"mu": 0.1, "spin": 60.0}, label="mine").axes
    assert single.get_legend().get_texts()[0].get_text() == "mine"


def test_colours_lie_between_quantiles_and_may_be_logarithmic(table):
    times = table.time[:, 0]
    times = times[np.isfinite(times)]
    image = table.plot(at={"mu": 0.1}).axes[0].collections[0]
    assert image.get_clim() == pytest.approx(np.quantile(times, (0.02, 0.98)))
    assert image.get_clim()[1] < 1e4
    assert type(table.plot(at={"mu": 0.1}, log=True).axes[0].collections[0].norm).__name__ == "LogNorm"
    lines = table.plot(log=True)
    assert lines.axes[0].get_yscale() == "log"
    # Numbers are written as such, not as powers of ten.
    lines.draw_without_rendering()
    ticks = [tick.get_text() for tick in lines.axes[0].get_yticklabels(which="both")]
    assert any(ticks)
    assert not any("10^" in tick for tick in ticks)


def test_a_top_that_was_inverted_for_a_time_is_told_from_others():
    first, last = np.array([1.0, 2.0, np.inf]), np.array([1.5, np.inf, np.inf])
    status = np.array(["inverted", "not_inverted", "not_inverted"])
    flat = {"first_time": first, "last_time": last, "status": status, "end_theta": np.array([3.0, 0.1, 0.1])}
    words = {"for_a_time": '["inverted", "not_inverted"]'}
    table = Table({"spin": SPIN[:3]}, flat, {"spin": "rad s-1"}, words)
    assert "status: 1 inverted, 2 not_inverted, of which 1 inverted for a time\n" in str(table)
    texts = [text.get_text() for text in table.plot("last_time").axes[0].get_legend().get_texts()]
    assert texts == ["inverted for a time", "not inverted"]
    axes = table.plot("first_time", unit="rpm").axes[0]
    (marked,) = (line for line in axes.get_lines() if line.get_label() == "inverted for a time")
    assert_close(marked.get_xydata(), [[SPIN[1] * 30.0 / np.pi, 2.0]], rtol=1e-12)
    # A map of many more values.
    square = {name: np.broadcast_to(values[:, None], (3, 11)) for name, values in flat.items()}
    table = Table({"spin": SPIN[:3], "other": SPIN}, square, {}, words)
    (axes, _) = table.plot("first_time").axes
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["inverted for a time", "not inverted"]
    assert_close(axes.get_lines()[0].get_xydata(), np.stack([np.full(11, SPIN[1]), SPIN], axis=-1))
    (axes, _) = table.plot("last_time").axes
    assert {text.get_text() for text in axes.get_legend().get_texts()} == {"inverted for a time", "not inverted"}


def test_an_empty_table_is_one_line():
    assert str(Table({"reset": np.arange(0)}, {"time": np.zeros(0)}, {}, {})) == "Table over reset (0)"


def test_lines_without_a_time_say_why_they_are_empty():
    status = np.array(["not_inverted", "contact_lost", "not_inverted"])
    none = Table({"spin": SPIN[:3]}, {"time": np.full(3, np.inf), "status": status}, {"spin": "rad s-1"}, {})
    (axes,) = none.plot().axes
    assert [text.get_text() for text in axes.texts] == ["nothing finite to draw"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["contact lost", "not inverted"]
    marks = [line.get_xdata()[np.isfinite(line.get_ydata())].tolist() for line in axes.child_axes[0].lines]
    assert marks == [[SPIN[1]], [SPIN[0], SPIN[2]]]
    # Seven lines, one of which has such cells: the strip has one row, as for a single line.
    columns = {name: np.tile(none[name][:, None], 7) for name in ("time", "status")}
    columns["time"][:, 1:] = 1.0
    (drawn, *_) = Table({"spin": SPIN[:3], "y": np.arange(7.0)}, columns, {}, {}).plot().axes
    heights = []
    for panel in (axes, drawn):
        panel.figure.draw_without_rendering()
        heights.append(panel.child_axes[0].get_window_extent().height / panel.get_window_extent().height)
    assert_close(*heights, rtol=1e-9)


def test_cells_without_a_time_are_marked_and_named():
    """In a strip above the scale of lines, in the colour of their line; in maps by greys, whose names cover no cell."""
    has_time = np.arange(12)[:, None] > np.array([3, 6])
    variables = {"time": np.where(has_time, 1.0, np.inf), "status": np.where(has_time, "inverted", "not_inverted")}
    lines = Table({"x": np.arange(12.0), "y": np.arange(2.0)}, variables, {"time": "s"}, {}).plot().axes[0]
    assert [text.get_text() for text in lines.get_legend().get_texts()] == ["y = 0", "y = 1"]
    (strip,) = lines.child_axes
    for line, marks, count in zip(lines.lines, strip.lines, (4, 7), strict=True):
        heights = np.asarray(marks.get_ydata())
        np.testing.assert_array_equal(np.isfinite(heights), np.isnan(line.get_ydata()))
        assert (np.sum(np.isfinite(heights)), marks.get_color()) == (count, line.get_color())
    lines.figure.draw_without_rendering()
    assert [text.get_text() for text in strip.get_yticklabels()] == ["not inverted"]
    assert strip.get_window_extent().y0 >= lines.get_window_extent().y1
    assert strip.get_xlim() == lines.get_xlim()
    # Nor does the legend cover a line.
    assert lines.get_legend().get_window_extent().x0 >= lines.get_window_extent().x1
    variables = {name: np.tile(values[:, :1], 14) for name, values in variables.items()}
    axes = Table({"x": np.arange(12.0), "y": np.arange(14.0)}, variables, {"time": "s"}, {}).plot().axes[0]
    axes.figure.draw_without_rendering()
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["not inverted"]
    assert axes.get_legend().get_window_extent().y1 <= axes.xaxis.label.get_window_extent().y0 + 1.0


def test_the_end_of_the_name_of_an_axis_is_enough(table):
    coords = {"theta": THETA, "mu": MU, "launch.spin": SPIN}
    renamed = dataclasses.replace(table, coords=coords, units=table.units | {"launch.spin": "rad s-1"})
    assert renamed.plot(x="spin", at={"mu": MU[0]}).axes[0].get_xlabel() == "launch.spin [rad/s]"
    assert renamed.plot(x="mu", at={"spin": SPIN[1]}).axes[0].get_title().startswith("launch.spin = ")


def test_it_draws_in_given_axes_and_shows_itself(table):
    _, ax = plt.subplots()
    assert table.plot(ax=ax) is ax
    plt.close()
    assert table.plot()._repr_png_().startswith(b"\x89PNG")
    table.plot().savefig(io.BytesIO())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"at": {"colour": 1.0}}, "at: 'colour' must be one of theta, mu, spin"),
        ({"at": {"theta": 0.1, "mu": 0.1, "spin": 60.0}}, "leaves no axis to draw over"),
        (
            {"at": {"mu": 0.9}},
            "at: mu = 0.9 s/m must be between the ends of the axis, 0.1 and 0.3 s/m; at has the unit of the table",
        ),
        ({"at": {"mu": "x"}}, "at: mu = 'x' is not a number"),
        ({"x": "tehta"}, "x = 'tehta' must be one of theta, mu, spin; did you mean 'theta'"),
        ({"x": "mu", "y": "mu"}, "x = 'mu' must not be named in at, nor be both x and y"),
        ({"x": "mu", "at": {"mu": 0.1}}, "x = 'mu' must not be named in at"),
        ({"unit": "grades"}, "unit = 'grades' must be one of"),
        ({"variable": "status"}, "variable = 'status' must be a numeric variable"),
    ],
)
def test_bad_pictures_are_refused(table, arguments, message):
    with pytest.raises(ValueError, match=message):
        table.plot(**arguments)


def test_a_file_names_its_variables_and_shows_nothing_else(table, tmp_path):
    table.save(tmp_path / "table.h5")
    with xarray.open_dataset(tmp_path / "table.h5", engine="h5netcdf") as data:
        assert set(data.variables) == {"theta", "mu", "spin", "time", "status"}
        assert data["time"].attrs["long_name"] == "inversion time"
        assert data["theta"].attrs == {"units": "rad", "long_name": "θ(0)"}
    loaded_table = Table.load(tmp_path / "table.h5")
    assert loaded_table.long_names == table.long_names
    assert loaded_table.to_xarray()["time"].attrs == {"units": "s", "long_name": "inversion time"}
    assert "long_names" not in loaded_table.to_xarray().attrs


def test_a_sweeps_file_too(tmp_path):
    path = tmp_path / "sweep.h5"
    table = cheap_sweep(path)
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        assert set(data.variables) == {*table.coords, *table.variables}


def test_a_variable_may_be_left_out_of_a_file(tmp_path):
    """Then its dimensions belong to no variable, and are no axes."""
    coords = {"mu": np.array([0.3, 0.4]), "at": np.array([0.0, 1.0, 2.0])}
    values = {"time": np.array([1.0, 2.0]), "slip": np.ones((2, 3))}
    whole = Table(coords, values, {"slip": "m s-1"}, {"request": "{}", "axes": '["mu"]'}, inner={"slip": ("at",)})
    for name, table in (("whole", whole), ("part", dataclasses.replace(whole, variables={"time": values["time"]}))):
        table.save(tmp_path / name)
        loaded = Table.load(tmp_path / name)
        assert (set(loaded.coords), loaded.shape) == (set(coords), (2,))
        assert set(loaded.variables) == set(table.variables)
        np.testing.assert_array_equal(loaded["time"], values["time"])
        assert loaded.attributes == whole.attributes


def test_a_table_goes_to_pandas_a_row_for_each_cell():
    coords = {"theta": np.array([0.1, 0.2]), "mu": np.array([0.3, 0.4, 0.5])}
    time = np.arange(6.0).reshape(2, 3)
    words = np.where(time > 2.0, "inverted", "failed")
    frame = Table(coords, {"time": time, "status": words}, {"time": "s"}, {}).to_dataframe()
    assert list(frame.columns) == ["theta", "mu", "time", "status"]
    assert frame.attrs["units"] == {"time": "s"}
    rows_of_cell = frame[(frame.theta == 0.2) & (frame.mu == 0.4)]
    assert (rows_of_cell.time.item(), rows_of_cell.status.item()) == (4.0, "inverted")
    # Points of an additional dimension are rows; components of a vector are columns.
    coords |= {"at": np.array([0.0, 1.0]), "component": np.array(["x", "y"])}
    slip, inner = np.arange(24.0).reshape(2, 3, 2, 2), {"slip": ("at", "component")}
    frame = Table(coords, {"time": time, "slip": slip}, {"slip": "m s-1"}, {}, inner=inner).to_dataframe()
    assert list(frame.columns) == ["theta", "mu", "at", "time", "slip.x", "slip.y"]
    assert frame.attrs["units"] == {"slip.x": "m s-1", "slip.y": "m s-1"}
    assert len(frame) == 12
    rows = frame[(frame.theta == 0.2) & (frame.mu == 0.5) & (frame["at"] == 1.0)]
    assert (rows.time.item(), rows["slip.x"].item(), rows["slip.y"].item()) == (5.0, 22.0, 23.0)
    assert len(Table({}, {"time": np.array(3.0)}, {}, {}).to_dataframe()) == 1
