"""The cells of the manual run; the notebooks for a hosted service are the tutorials, without what only the manual can do."""

import ast
import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.pyplot as plt
import nbformat
import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def builder() -> ModuleType:
    """`docs/notebooks.py`."""
    spec = importlib.util.spec_from_file_location("notebooks", DOCS / "notebooks.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_notebooks_have_the_code_of_the_tutorials(builder, tmp_path):
    """Every line of a page's cells, after one that installs the package; valid files, valid Python, no links between pages."""
    builder.main(tmp_path, None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fit.ipynb", "stroller.ipynb", "top.ipynb"]
    for name, page in builder.PAGES.items():
        book = nbformat.read(tmp_path / f"{name}.ipynb", as_version=4)
        nbformat.validate(book)
        install, *cells = [cell.source for cell in book.cells if cell.cell_type == "code"]
        assert install == builder.INSTALL
        blocks = re.findall(r"```\{code-cell\}\n(?::tags:[^\n]*\n)?(.*?)```", (DOCS / page).read_text(), re.DOTALL)
        lines = [line.strip() for block in blocks for line in block.strip().splitlines()]
        assert [line for line in lines if line not in "\n".join(cells)] == []
        assert len(blocks) == len(cells) >= 3
        for cell in cells:
            ast.parse(cell)
        texts = "\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
        assert re.findall(r"\]\((?!https?:)[^)]*\)", texts) == []


def test_errors_that_a_page_shows_do_not_stop_a_notebook(builder, capsys):
    cells = builder.notebook(DOCS / builder.PAGES["stroller"]).cells
    sources = [cell.source for cell in cells if "raises-exception" in cell.metadata.get("tags", [])]
    assert len(sources) == 1
    # The names of the earlier cells are missing: the error is printed.
    exec(sources[0], {})
    assert "is not defined" in capsys.readouterr().out


def test_a_badge_opens_the_notebook_of_the_repository(builder, tmp_path):
    builder.main(tmp_path, "owner/name")
    address = "https://colab.research.google.com/github/owner/name/blob/notebooks/top.ipynb"
    assert address in nbformat.read(tmp_path / "top.ipynb", as_version=4).cells[0].source
    assert address in (tmp_path / "README.md").read_text()


def show(source: str, names: dict[str, Any]) -> None:
    """Run a cell and draw what it ends with, as a notebook does."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    if last is not None:
        value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
        for drawn in ("_repr_html_", "_repr_png_"):
            if hasattr(value, drawn):
                getattr(value, drawn)()


#: The longest pages; tests of planning, bodies, fits, flights, laws, surfaces and own systems exercise their functions.
LONG = ("planning", "rattleback", "trust", "hops", "friction", "surface", "egg")
LONG += ("own_oscillator", "own_sleigh", "own_systems", "classroom", "walker")


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in LONG))
        for path in sorted(DOCS.rglob("*.md"))
        if "```{code-cell}" in path.read_text()
    ],
)
def test_the_cells_of_a_page_run(builder, page, monkeypatch, tmp_path):
    """In the process of the tests, whose compiled programs they share; a notebook of its own imports for six seconds."""
    # What a page may read: its neighbours' sketches.
    folder = tmp_path / "docs" / page.parent.name
    for path in (folder, tmp_path / "docs" / "concepts"):
        path.mkdir(parents=True, exist_ok=True)
    (tmp_path / "docs" / "concepts" / "sketches.py").symlink_to(DOCS / "concepts" / "sketches.py")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    names = {"__name__": "__main__"}
    _, *cells = [cell.source for cell in builder.notebook(page).cells if cell.cell_type == "code"]
    for cell in cells:
        show(cell, names)
    plt.close("all")
