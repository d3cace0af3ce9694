"""What needs an optional package says so before the work begins, with the command that installs it."""

import re
import tomllib
from pathlib import Path

import pytest
from never_run import density_of_a_film, run_of_nothing, small_table

import nonholonomic
from nonholonomic.identification import sample
from nonholonomic.runs.trajectory import explore_model

pytestmark = pytest.mark.oldest


OPTIONAL = {
    "to_xarray of a table": (lambda: small_table().to_xarray(), "xarray", "xarray"),
    "to_xarray in pieces": (lambda: small_table().to_xarray("auto"), "dask", "xarray"),
    "to_xarray of a run": (lambda: run_of_nothing().to_xarray(), "xarray", "xarray"),
    "to_dataframe": (lambda: small_table().to_dataframe(), "pandas", "pandas"),
    "plot of a table": (lambda: small_table().plot(), "matplotlib", "plot"),
    "a portrait": (lambda: run_of_nothing().portrait(), "matplotlib", "plot"),
    "a plot of a run": (lambda: run_of_nothing().plot(), "matplotlib", "plot"),
    "a film": (lambda: run_of_nothing().animate("a.webm"), "jupyter_threejs_sage", "view"),
    "a page": (lambda: run_of_nothing().view(), "jupyter_threejs_sage", "view"),
    "a page with sliders": (lambda: explore_model(None, None, None, 1.0, None, None), "jupyter_threejs_sage", "view"),
    "draws": (lambda: sample(density_of_a_film()[0], None, None), "blackjax", "bayes"),
}


@pytest.mark.parametrize("name", OPTIONAL)
def test_an_optional_package_is_looked_for_before_the_work_begins(name, monkeypatch):
    call, package, extra = OPTIONAL[name]
    original = nonholonomic.validation.find_spec
    monkeypatch.setattr(
        "nonholonomic.validation.find_spec", lambda module: None if module == package else original(module)
    )
    monkeypatch.setattr("tippe.Trajectory.to_table", lambda *_: pytest.fail("it was read off"))
    monkeypatch.setattr("tippe.Trajectory.stages", lambda *_: pytest.fail("it was drawn"))
    with pytest.raises(ModuleNotFoundError, match=rf"needs {package}: pip install 'nonholonomic\[{extra}\]'"):
        call()
    extras = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert any(module.replace("-", "_").startswith(package) for module in extras[extra])
    assert extra in re.findall(r"\w+", extras["all"][0])
