"""How the manual is built: `sphinx-build -W docs build/manual`."""

import importlib
import inspect
import os
import re
from pathlib import Path

import nonholonomic

HERE = Path(__file__).parent

project = "nonholonomic"
author = "The nonholonomic authors"
version = release = nonholonomic.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax"]
exclude_patterns = ["tippe.md", "stroller.md", "_build"]

html_theme = "sphinx_book_theme"
html_title = "nonholonomic"
html_logo = None
html_theme_options = {"show_toc_level": 2, "home_page_in_toc": True}

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
# Formulas are large enough for their words.
myst_dmath_double_inline = True

nb_execution_mode = "cache"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"

PACKAGES = {
    "tippe": "The top: `tippe`",
    "stroller": "The vehicle: `stroller`",
    "nonholonomic": "The ground: `nonholonomic`",
}

# Notebooks keep what they compile, and show no progress bars.
os.environ["NONHOLONOMIC_PROGRESS"] = "0"
nonholonomic.enable_compilation_cache()
for name in ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"):
    value = getattr(importlib.import_module("jax").config, name)
    if value is not None:
        os.environ.setdefault(name.upper(), str(value))


def public(package: str) -> list[str]:
    """What a package hands out: the names that its `__init__.py` imports as themselves."""
    text = inspect.getsource(importlib.import_module(package))
    return sorted(set(re.findall(r"import (?!__)(\w+) as \1$", text, re.M)), key=str.lower)


def write_pages() -> None:
    """A page for each package, with an entry for every public name."""
    folder = HERE / "api"
    folder.mkdir(exist_ok=True)
    for package, title in PACKAGES.items():
        module = importlib.import_module(package)
        lines = [title.replace("`", ""), "=" * len(title), "", f".. currentmodule:: {package}", ""]
        for name in public(package):
            value = getattr(module, name)
            kind = "class" if inspect.isclass(value) else "module" if inspect.ismodule(value) else "function"
            home = getattr(value, "__module__", package)
            # What several packages hand out stands on the page of the first.
            first = next(
                one for one in PACKAGES if name in public(one) and getattr(importlib.import_module(one), name) is value
            )
            if first != package:
                lines += [f"``{package}.{name}``: as ``{first}.{name}``.", ""]
            elif kind == "module":
                lines += [f".. automodule:: {package}.{name}", "   :members:", ""]
            elif callable(value):
                members = ["   :members:"] if kind == "class" else []
                lines += [f".. auto{kind}:: {package}.{name}", *members, ""]
            assert home
        text = "\n".join(lines)
        page = folder / f"{package}.rst"
        if not page.exists() or page.read_text() != text:
            page.write_text(text)


write_pages()


def as_rst(app, what, name, obj, options, lines) -> None:
    """Docstrings are written in Markdown; what of it they use is turned into reStructuredText."""
    blocks, example = [[]], False
    for line in lines:
        starts, ends = line.lstrip().startswith(">>>"), example and not line.strip()
        if (starts and not example) or ends:
            blocks.append([])
            example = starts
        # An example needs no fences; an empty line parts it from the text.
        blocks[-1].append("" if line.strip() == "```" else line)
    found = []
    for block in blocks:
        text = "\n".join(block)
        if block and block[0].lstrip().startswith(">>>"):
            found += ["", *block]
        else:
            parts = re.split(r"(`+[^`]+`+)", text)
            found += "".join(_literal(part) if part.startswith("`") else _plain(part) for part in parts).split("\n")
    lines[:] = found


def _literal(text: str) -> str:
    return f"``{text.strip('`')}``"


def _plain(text: str) -> str:
    text = text.replace("\\", "\\\\").replace("|", "\\|")
    return re.sub(r"(?<!\*)\*(?!\*)", r"\\*", text)


def skip(app, what, name, obj, skip, options):
    """Fields without a docstring are told of in that of their class."""
    return True if name.startswith("_") or name == "units" else skip


def setup(app) -> None:
    app.connect("autodoc-process-docstring", as_rst)
    app.connect("autodoc-skip-member", skip)
