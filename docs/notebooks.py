"""Write three tutorials as notebooks for a hosted service: `python docs/notebooks.py FOLDER`, `pip install '.[docs]'` first.

The notebooks are the pages of the manual, with a cell that installs the package and without links between pages. An error that
a page shows on purpose is printed instead of raised. On GitHub Actions, which names the repository, each notebook begins with
a badge that opens the notebook in Colab from the branch `notebooks`, and a README.md lists the badges.
"""

import os
import re
import sys
import textwrap
from pathlib import Path

import jupytext
import nbformat

import nonholonomic

HERE = Path(__file__).parent
PAGES = {"top": "tutorials/inversion_map.md", "fit": "tutorials/video.md", "stroller": "tutorials/stroller.md"}
INSTALL = f'%pip install -q "nonholonomic[plot,view,xarray]~={nonholonomic.__version__}"'
BADGE = "https://colab.research.google.com/assets/colab-badge.svg"


def badge(name: str, repository: str) -> str:
    """Markdown of a badge that opens a notebook."""
    return f"[![Open in Colab]({BADGE})](https://colab.research.google.com/github/{repository}/blob/notebooks/{name}.ipynb)"


def notebook(page: Path) -> nbformat.NotebookNode:
    """The notebook of a page."""
    # A notebook must state the name of its kernel.
    kernel = "  name: python3\n"
    book = jupytext.reads(page.read_text().replace(kernel, f"{kernel}  display_name: Python 3\n", 1), fmt="md:myst")
    for cell in book.cells:
        if cell.cell_type == "markdown":
            # Pictures of the checkout are left out, and links to its pages are only their words.
            cell.source = re.sub(r"!\[[^\]]*\]\((?!https?:)[^)]*\)\n*", "", cell.source)
            cell.source = re.sub(r"\[([^\]]+)\]\((?!https?:)[^)]*\)", r"\1", cell.source)
        elif "raises-exception" in cell.metadata.get("tags", []):
            cell.source = f"try:\n{textwrap.indent(cell.source, '    ')}\nexcept Exception as error:\n    print(error)"
    book.cells.insert(0, nbformat.v4.new_code_cell(INSTALL))
    # Numbered cells: random names would differ from run to run.
    for number, cell in enumerate(book.cells):
        cell.id = f"cell-{number}"
    return book


def main(folder: Path, repository: str | None) -> None:
    """Write the notebooks and, if the repository is known, a list of badges."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = []
    for name, page in PAGES.items():
        book = notebook(HERE / page)
        if repository:
            book.cells.insert(0, nbformat.v4.new_markdown_cell(badge(name, repository), id="badge"))
            lines.append(f"{book.cells[2].source.splitlines()[0].lstrip('# ')}: {badge(name, repository)}")
        nbformat.write(book, folder / f"{name}.ipynb")
    if lines:
        (folder / "README.md").write_text("\n\n".join(lines) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), os.environ.get("GITHUB_REPOSITORY"))
