"""Every public name has an example in its docstring, and every example gives what it says.

The examples share few scenes, so that what one compiles serves the others.
"""

import doctest
import importlib
import inspect
import re
from typing import Any

import pytest

PACKAGES = ("tippe", "stroller", "nonholonomic")

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def public(package: str) -> dict[str, Any]:
    """What a package hands out: the names that its `__init__.py` imports as themselves."""
    module = importlib.import_module(package)
    return {name: getattr(module, name) for name in re.findall(r"import (\w+) as \1$", inspect.getsource(module), re.M)}


#: What is handed out, once each, under its first name.
NAMES = {id(value): (f"{package}.{name}", value) for package in PACKAGES for name, value in public(package).items()}
NAMES = {key: named for key, named in NAMES.items() if not isinstance(named[1], str)}


@pytest.mark.parametrize(("name", "value"), NAMES.values(), ids=[name for name, _ in NAMES.values()])
def test_its_example_gives_what_it_says(name, value):
    text = inspect.getdoc(value) or ""
    assert ">>>" in text, f"{name} has no example"
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    said: list[str] = []
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert not said, "".join(said)


def test_a_wrong_example_is_found():
    example = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, None)
    said: list[str] = []
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=said.append)
    assert "Expected" in "".join(said)


def test_the_public_names_are_those_that_people_use():
    names = {name for name, _ in NAMES.values()}
    assert {"tippe.Top", "tippe.steady", "tippe.inversion_table", "stroller.simulate"} <= names
    assert len(names) > 40
