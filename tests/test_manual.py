"""The manual is short, and has an entry for every public name, a thumbnail for every picture and each cited derivation."""

import importlib
import inspect
import re
from pathlib import Path

import api_pages

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

#: Words of the pages, cells of code included, as `cat $(git ls-files 'docs/*.md') | wc -w` counts them.
MOST_WORDS = 22_000


def test_every_public_name_is_on_a_page_of_the_api():
    assert api_pages.missing() == []
    names = [name for page in api_pages.PAGES.values() for name in page.names]
    assert len(names) == len({id(api_pages.resolve(name)) for name in names})
    for name, members in api_pages.MEMBERS.items():
        assert name in names
        bases = api_pages.resolve(name).__mro__
        all_members = {member for base in bases for member in (*vars(base), *inspect.get_annotations(base))}
        assert set(members.split()) <= all_members
    for name in api_pages.CONSTANTS:
        room, _, constant = name.rpartition(".")
        assert f"`{constant}`" in (inspect.getdoc(importlib.import_module(room)) or "")


def test_the_gallery_has_a_card_with_a_thumbnail_for_every_picture():
    names = re.findall(r"^:link: gallery/(\w+)$", (DOCS / "gallery.md").read_text(), re.M)
    assert len(names) >= 12
    assert sorted(names) == sorted(p.stem for p in (ROOT / "examples").glob("*.py") if "def draw(" in p.read_text())
    assert sorted(names) == sorted(path.stem for path in (DOCS / "gallery").glob("*.webp"))


def test_every_tutorial_has_a_picture():
    pages = [page for page in (DOCS / "tutorials").glob("*.md") if page.stem != "index"]
    pictures = {page.stem: re.findall(r"^!\[.+\]\((.+\.webp)\)$", page.read_text(), re.M) for page in pages}
    assert len(pictures) >= 12
    assert [
        name for name, paths in pictures.items() if not any((DOCS / "tutorials" / path).exists() for path in paths)
    ] == []


def test_every_section_of_a_derivation_that_a_docstring_cites_exists():
    """The manual links "`tippe.md`, section 3" to the heading with that number."""
    cited = {
        citation
        for folder in ("nonholonomic", "tippe", "stroller", "tests", "benchmarks")
        for path in (ROOT / folder).rglob("*.py")
        for citation in re.findall(r"(tippe|stroller)\.md`?,\s+sections? (\d+)", path.read_text())
    }
    assert len(cited) > 10
    for model, number in cited:
        assert re.search(
            rf"^\({model}-{number}\)=\n## {number}\. ", (DOCS / "concepts" / f"{model}.md").read_text(), re.M
        )


def test_the_manual_does_not_grow():
    """What repeats a docstring, the README or another page can go."""
    words = {page.relative_to(DOCS): len(page.read_text().split()) for page in DOCS.rglob("*.md")}
    assert len(words) > 40
    assert sum(words.values()) <= MOST_WORDS
