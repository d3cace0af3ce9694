"""The names of components, which are the same in runs, tables, files, axes, fits, pictures, pages and messages."""

import numpy as np
import pytest
from own_modes import Ball, Sleigh

import nonholonomic
from nonholonomic import Hybrid, Recording, Table, identify, simulate, sweep
from nonholonomic.runs.trajectory import sliders_of


class NamedBall(Ball):
    names = ("height", "velocity", "bounces")


class NamedSleigh(Sleigh):
    names = ("x", "y", "heading")


SLEIGH = ([0.0, 0.0, 0.0], [0.5, 0.0, 2.0])

#: System, start, and the names of its components.
CASES = {
    "modes": (Hybrid([Ball()]), [1.0, 0.0, 0.0], ("y[0]", "y[1]", "y[2]")),
    "named modes": (Hybrid([NamedBall()]), [1.0, 0.0, 0.0], NamedBall.names),
    "system": (Sleigh(), SLEIGH, tuple(f"{kind}[{k}]" for kind in ("q", "rate") for k in range(3))),
    "named system": (NamedSleigh(), SLEIGH, ("x", "y", "heading", "x_rate", "y_rate", "heading_rate")),
    "system among modes": (
        Hybrid([NamedSleigh()]),
        [*SLEIGH[0], *SLEIGH[1]],
        (*NamedSleigh.names, "x_rate", "y_rate", "heading_rate"),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_names_agree(case, tmp_path):
    system, start, names = CASES[case]
    run = simulate(system, start, 0.5)
    table, model = run.to_table(), run.model
    assert run.names == tuple(run) == tuple(model.quantities) == tuple(table.variables)[:-1] == names
    assert tuple(run.to_dataframe().columns)[1:-1] == tuple(run.to_xarray().data_vars)[:-1] == names
    table.save(tmp_path / "run.h5")
    np.testing.assert_array_equal(Table.load(tmp_path / "run.h5")[names[-1]], run[names[-1]])
    assert [label.split(":")[0].strip() for label in str(run).splitlines()[1 : 1 + len(names)]] == [*names]
    assert tuple(text.get_text() for text in run.plot().axes[0].get_legend().get_texts()) == names
    assert run.plot(names[1]).axes[0].get_ylabel() == names[1]
    assert tuple(curve.label for curve in run.stages()[0].shows[0].curves) == names
    # A start is named by its component.
    starts = [f"start.{name}" for name in names]
    assert [name for name in model.known if name.startswith("start")] == starts
    assert [model.full_name("axes", name) for name in names] == starts
    grid = sweep(system, start, 0.2, axes={names[0]: [1.0, 1.1]}, progress=False)
    assert [*grid.coords] == starts[:1]
    assert set(names) < set(grid.variables)
    np.testing.assert_array_equal(grid[starts[0]], [1.0, 1.1])
    assert grid.plot(names[0]).axes[0].get_xlabel() == starts[0]
    sliders = sliders_of(model, {names[-1]: (-9.0, 9.0)})
    assert [(slider.path, slider.label) for slider in sliders] == [(starts[-1], starts[-1].replace("_", " "))]


@pytest.mark.parametrize("case", ["modes", "named system"])
def test_fits_use_these_names(case):
    system, start, names = CASES[case]
    times = np.linspace(0.02, 0.4, 12)
    run = simulate(system, start, 0.5, times=times)
    noise = 1e-3 * np.random.default_rng(0).normal(size=len(times))
    data = Recording(start, times, np.asarray(run[names[0]]) + noise, 1e-3, names[0])
    fit = identify(system, data, {names[0]: float(run[names[0]][0])}, starts=2, progress=False)
    assert [*fit.estimates] == [f"start.{names[0]}"]
    assert f"{names[0]}(0.02 s)" in str(fit)
    assert f"start.{names[0]}" in {axes.get_xlabel() for axes in fit.plot().axes}


def test_messages_use_these_names():
    system, start, names = CASES["named system"]
    run, known = simulate(system, start, 0.2), ", ".join(names)
    with pytest.raises(KeyError, match=rf"'headin' must be one of {known}; did you mean 'heading'\?"):
        run["headin"]
    with pytest.raises(ValueError, match=rf"quantity = 'headin' must be one of {known}, mode; did you mean 'heading'"):
        run.plot("headin")
    with pytest.raises(ValueError, match=r"axes: 'q0' must be one of start\.q\[0\], .*; did you mean 'q\[0\]'\?"):
        sweep(Sleigh(), start, 0.2, axes={"q0": [0.0, 1.0]}, progress=False)
    with pytest.raises(ValueError, match=r"axes: 'start.headin' must be one of start\.x, .*; did you mean 'heading'"):
        sweep(system, start, 0.2, axes={"start.headin": [0.0, 1.0]}, progress=False)


def test_rates_must_not_be_named_like_coordinates():
    wrong = type("Wrong", (Sleigh,), {"names": ("x", "x_rate", "heading")})
    with pytest.raises(ValueError, match="must be 3 different words, one for each coordinate"):
        nonholonomic.simulate(wrong(), SLEIGH, 0.2)
