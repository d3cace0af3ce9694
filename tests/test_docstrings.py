"""Every public name has an example in its docstring, and every example gives what it says.

The examples share few scenes, so that what one compiles serves the others.
"""

import doctest
import importlib
import inspect
import tempfile
from typing import Any

import api_pages
import jax
import pytest
from api_pages import ENGINE_ROOMS, PAGES, resolve
from jax.experimental.compilation_cache import compilation_cache

PACKAGES = ("tippe", "stroller", "nonholonomic")

#: JAX's settings that say where and which compiled programs are kept.
KEPT = ("compilation_cache_dir", "persistent_cache_min_compile_time_secs", "persistent_cache_min_entry_size_bytes")
KEPT = tuple(f"jax_{name}" for name in (*KEPT, "compilation_cache_max_size"))

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def public(package: str) -> dict[str, Any]:
    """What a package, a room or a public module hands out."""
    return {name: resolve(f"{package}.{name}") for name in api_pages.public(package)}


#: What is handed out, once each, under its first name.
NAMES = {id(value): (f"{package}.{name}", value) for package in PACKAGES for name, value in public(package).items()}
NAMES = {key: named for key, named in NAMES.items() if not isinstance(named[1], str)}

#: Those of their methods that have an example.
METHODS = [
    (f"{home}.{name}", method)
    for home, value in NAMES.values()
    if inspect.isclass(value)
    for name, method in inspect.getmembers(value, inspect.isroutine)
    if not name.startswith("_") and ">>>" in (inspect.getdoc(method) or "")
]

#: What the modules among them hand out, with the module, whose example theirs go on from.
MEMBERS = [
    (f"{home}.{name}", value, module)
    for home, module in NAMES.values()
    if inspect.ismodule(module)
    for name, value in public(module.__name__).items()
]


#: The rooms of the engine, and the names in each that are handed out for fast models.
NAMES_OF_ENGINE = [name for name in PAGES["engine"].names if not inspect.ismodule(resolve(name))]
ENGINE = {room: [name for name in NAMES_OF_ENGINE if name.startswith(f"{room}.")] for room in ENGINE_ROOMS}


def complaints(text: str, namespace: dict[str, Any], name: str = "example") -> str:
    """What is wrong with the examples in a text: none runs, or one gives something else; `known` gets the names they make."""
    example = doctest.DocTestParser().get_doctest(text, {}, name, None, None)
    if all(doctest.SKIP in line.options for line in example.examples):
        return "no example runs"
    # A copy of the names was made, which is to be kept.
    example.globs = namespace
    messages: list[str] = []
    doctest.DocTestRunner(optionflags=FLAGS).run(example, out=messages.append, clear_globs=False)
    return "".join(messages)


@pytest.fixture(autouse=True)
def folders_of_its_own(tmp_path, monkeypatch):
    """Temporary folders are removed, and compiled programs are kept afterwards where they were kept before."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("NONHOLONOMIC_CACHE", raising=False)
    values_before = {name: getattr(jax.config, name) for name in KEPT}
    yield
    if jax.config.jax_compilation_cache_dir != values_before["jax_compilation_cache_dir"]:
        for name, value in values_before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


@pytest.mark.parametrize(
    ("name", "value"), [*NAMES.values(), *METHODS], ids=[name for name, _ in (*NAMES.values(), *METHODS)]
)
def test_its_example_gives_what_it_says(name, value):
    assert not complaints(inspect.getdoc(value) or "", {})


@pytest.mark.parametrize(("name", "value", "module"), MEMBERS, ids=[name for name, *_ in MEMBERS])
def test_the_example_of_a_member_gives_what_it_says(name, value, module):
    namespace: dict[str, Any] = {}
    assert not complaints(inspect.getdoc(module) or "", namespace)
    assert not complaints(inspect.getdoc(value) or "", namespace)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (">>> 1 + 1\n3\n", "Expected"),
        ("No example at all.", "no example runs"),
        (">>> 1 + 1  # doctest: +SKIP\n3\n>>> 1  # doctest: +SKIP\n1\n", "no example runs"),
        (">>> 1 + 1  # doctest: +SKIP\n3\n>>> 1\n1\n", ""),
    ],
)
def test_a_wrong_example_is_found(text, complaint):
    assert complaint in complaints(text, {})
    assert bool(complaint) == bool(complaints(text, {}))


def test_the_public_names_are_those_that_people_use():
    names = {name for name, *_ in (*NAMES.values(), *MEMBERS)}
    assert {"tippe.Top", "tippe.steady.group", "tippe.inversion_table", "stroller.simulate"} <= names
    assert len(names) > 40


@pytest.mark.parametrize("room", ENGINE)
def test_the_examples_of_the_engine_give_what_they_say(room):
    """They go on from the example of their room."""
    namespace: dict[str, Any] = {}
    assert not complaints(inspect.getdoc(importlib.import_module(room)) or "", namespace, room)
    texts = {name: inspect.getdoc(resolve(name)) or "" for name in ENGINE[room]}
    # Two forms of a function share their example, which runs once.
    for name in {text.partition(">>>")[2]: name for name, text in texts.items()}.values():
        assert not complaints(texts[name], dict(namespace), name)
