"""Configuration of the manual: `sphinx-build -W docs build/manual`."""

import importlib
import json
import os
import re
import sys
from pathlib import Path

import nbformat.v4 as notebooks

import nonholonomic

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
import api_pages  # noqa: E402

project = "nonholonomic"
author = "The nonholonomic authors"
version = release = nonholonomic.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.mathjax", "sphinx_design"]
exclude_patterns = ["_build"]

# MathJax from a package, so that the manual shows formulas without a network.
mathjax = Path(next(iter(importlib.import_module("sphinx-mathjax-offline").__path__))) / "static" / "mathjax"
mathjax_path = "tex-svg-full.js"

html_theme = "sphinx_book_theme"
html_title = "nonholonomic"
html_static_path = ["_static", str(mathjax / mathjax_path)]
html_css_files = ["manual.css"]
# The sidebar already has the search box.
html_theme_options = {"show_toc_level": 2, "home_page_in_toc": True, "navbar_persistent": []}

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autosummary_generate = False
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 80
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"

# Notebooks keep compiled programs, and show no progress bars.
os.environ["NONHOLONOMIC_PROGRESS"] = "0"
nonholonomic.enable_compilation_cache()
for name in ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"):
    value = getattr(importlib.import_module("jax").config, name)
    if value is not None:
        os.environ.setdefault(name.upper(), str(value))


def write(path: Path, text: str) -> None:
    """Write a generated page if it changed, so that Sphinx reads only such pages again."""
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def write_api() -> None:
    """Write an API page for each task."""
    if missing := api_pages.missing():
        raise ValueError(f"docs/api_pages.py names no page for {missing}")
    for name, page in api_pages.PAGES.items():
        write(HERE / "api" / f"{name}.rst", api_pages.text(page))


def write_gallery() -> None:
    """Write a notebook for each card of the gallery, from the script of its name in `examples/`."""
    cards = re.findall(r"^:::\{grid-item-card\} (.+)\n:link: gallery/(\w+)$", (HERE / "gallery.md").read_text(), re.M)
    for title, name in cards:
        program = (HERE.parent / "examples" / f"{name}.py").read_text().split('\n\nif __name__ == "__main__":')[0]
        cells = [
            notebooks.new_markdown_cell(f"# {title}", id="title"),
            notebooks.new_code_cell(program.strip(), id="program"),
            notebooks.new_code_cell("draw()", id="picture"),
        ]
        kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        notebook = notebooks.new_notebook(cells=cells, metadata=kernel)
        write(HERE / "gallery" / f"{name}.ipynb", json.dumps(notebook, indent=1) + "\n")


write_api()
write_gallery()


def as_rst(app, what, name, obj, options, lines) -> None:
    """Convert docstrings from Markdown to reStructuredText, as far as they use Markdown."""
    blocks, example = [[]], False
    for line in lines:
        starts, ends = line.lstrip().startswith(">>>"), example and not line.strip()
        if (starts and not example) or ends:
            blocks.append([])
            example = starts
        # An example needs no fences; an empty line separates it from the text.
        blocks[-1].append("" if line.strip() == "```" else line)
    converted = []
    for block in blocks:
        text = "\n".join(block)
        if block and block[0].lstrip().startswith(">>>"):
            converted += ["", *block]
        else:
            parts = re.split(r"(`(?:tippe|stroller)\.md`,\s+sections? \d+|`+[^`]+`+)", text)
            converted += "".join(map(_inline, parts)).split("\n")
    lines[:] = converted


def _inline(text: str) -> str:
    """Code, a link to a derivation, or plain text."""
    if cited := re.fullmatch(r"`((\w+)\.md)`,\s+(sections?) (\d+)", text):
        page, model, word, number = cited.groups()
        return f":ref:`{page}, {word} {number} <{model}-{number}>`"
    if text.startswith("`"):
        return f"``{text.strip('`')}``"
    text = text.replace("\\", "\\\\").replace("|", "\\|")
    return re.sub(r"(?<!\*)\*(?!\*)", r"\\*", text)


def skip(app, what, name, obj, skip, options):
    """The docstring of a class describes its fields."""
    return True if name.startswith("_") or name == "units" else skip


def setup(app) -> None:
    app.connect("autodoc-process-docstring", as_rst)
    app.connect("autodoc-skip-member", skip)
