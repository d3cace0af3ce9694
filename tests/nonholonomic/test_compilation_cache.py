"""Compiled programs on disk: a second process compiles nothing, and a damaged entry costs only a compilation."""

import concurrent.futures
import json
import logging
import os
import resource
import shutil
import subprocess
import sys
import threading
import warnings

import jax
import pytest
from jax.experimental.compilation_cache import compilation_cache

from nonholonomic import enable_compilation_cache
from nonholonomic.compilation import cache
from nonholonomic.compilation.cache import LOOKED_AT, are_kept, environment_name, kept_files

#: Tells the result of a program, how many programs were asked for, and how many of them were found compiled.
COUNTED = """
import collections, json, jax, numpy as np
counts = collections.Counter()
jax.monitoring.register_event_listener(lambda event, **_: counts.update([event]))
import nonholonomic
folder = nonholonomic.enable_compilation_cache()
{program}
asked, found = (counts[f"/jax/compilation_cache/{{name}}"] for name in ("compile_requests_use_cache", "cache_hits"))
print(json.dumps({{"folder": str(folder), "result": result, "asked": asked, "found": found}}))
"""

TABLE = """
import diffrax, tippe
scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6), friction=tippe.Viscous(0.3))
result = tippe.inversion_table(scene, theta=0.1, spin=155.0, t1=8.0, tolerance=1e-6, solver=diffrax.Bosh3()).time.item()
"""

SMALL = "result = jax.jit(lambda x: (x * x).sum())(np.arange(4.0)).item()"


def run(program, home, **settings):
    """The result of `COUNTED` in a separate process in which every warning is an error, and its other output."""
    settings_of_cache = ("JAX_COMPILATION_CACHE_DIR", "NONHOLONOMIC_CACHE")
    settings = {name: value for name, value in os.environ.items() if name not in settings_of_cache} | settings
    settings |= {"XDG_CACHE_HOME": str(home), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-W", "error", "-c", COUNTED.format(program=program)]
    process = subprocess.run(command, capture_output=True, text=True, env=settings, check=False)
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout), process.stderr


@pytest.mark.oldest
def test_a_second_process_compiles_nothing(tmp_path):
    first, _ = run(TABLE, tmp_path)
    assert first["folder"] == str(tmp_path / "nonholonomic" / environment_name())
    assert first["asked"] > first["found"]
    second, _ = run(TABLE, tmp_path)
    assert second["asked"] == second["found"] == first["asked"]
    assert second["result"] == first["result"]


def damaged(content):
    """Ways in which an entry can be bad."""
    middle = len(content) // 2
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    return {"empty": b"", "cut": content[:middle], "one bit turned": flipped, "noise": os.urandom(len(content))}


@pytest.fixture(scope="module")
def small_home(tmp_path_factory):
    """A home folder with the compiled `SMALL`, and the output of the process that compiled it."""
    home = tmp_path_factory.mktemp("home")
    return home, run(SMALL, home)[0]


@pytest.fixture
def home(small_home, tmp_path):
    """A copy of that home."""
    return shutil.copytree(small_home[0], tmp_path / "home")


#: What a process does with an entry that is damaged in several ways, one after the other, and tells of each.
WITH_DAMAGES = """
import os, pathlib
from jax.experimental.compilation_cache import compilation_cache
def hits(): return counts["/jax/compilation_cache/cache_hits"]
told = []
for k, content in enumerate(sorted(pathlib.Path({contents!r}).iterdir())):
    if k:
        # As a process does that starts now.
        (entry,) = folder.glob("*-cache")
        entry.write_bytes(content.read_bytes())
        if k % 2:
            # As from a copy that kept the times.
            os.utime(entry, (0, 0))
        jax.clear_caches()
        compilation_cache.reset_cache()
        nonholonomic.enable_compilation_cache(folder.parent)
    before = hits()
    {program}
    told.append([content.name, result, hits() - before])
result = told
"""


def test_a_bad_entry_costs_a_compilation_and_nothing_else(home, small_home, tmp_path):
    (entry,) = (home / "nonholonomic" / environment_name()).glob("*-cache")
    contents = tmp_path / "contents"
    contents.mkdir()
    ways = damaged(entry.read_bytes())
    for k, (way, content) in enumerate(ways.items()):
        (contents / f"{k} {way}").write_bytes(content)
    entry.write_bytes(next(iter(ways.values())))
    answer, message = run(WITH_DAMAGES.format(contents=str(contents), program=SMALL), home)
    result = small_home[1]["result"]
    assert answer["result"] == [[f"{k} {way}", result, 0] for k, way in enumerate(ways)]
    assert message == ""
    assert run(SMALL, home)[0]["found"] == 1


def test_an_entry_that_is_cut_while_it_is_used_costs_a_compilation_too(home):
    cut = f"import pathlib\nfor entry in pathlib.Path(folder).glob('*-cache'): entry.write_bytes(b'')\n{SMALL}"
    answer, message = run(cut, home)
    assert (answer["result"], answer["found"], message) == (14.0, 0, "")


def test_other_flags_have_another_folder(small_home, tmp_path):
    second, _ = run(SMALL, tmp_path, XLA_FLAGS="--xla_cpu_enable_fast_min_max=true")
    assert os.path.relpath(small_home[1]["folder"], small_home[0]) != os.path.relpath(second["folder"], tmp_path)


@pytest.mark.parametrize("forbidden", [False, True])
def test_without_a_folder_everything_goes_on(forbidden, tmp_path):
    (tmp_path / "nonholonomic").write_text("this is a file")
    answer, message = run(SMALL, tmp_path, **({"NONHOLONOMIC_CACHE": "0"} if forbidden else {}))
    assert (answer["folder"], answer["result"], answer["found"]) == ("None", 14.0, 0)
    # One line names the folder; there is no message if the user has switched caching off.
    assert len(message.splitlines()) == (0 if forbidden else 1)
    assert forbidden or str(tmp_path / "nonholonomic") in message


SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


@pytest.fixture
def unset(monkeypatch):
    """Without a chosen folder, and with caching allowed; later changes of settings are undone."""
    monkeypatch.delenv("NONHOLONOMIC_CACHE", raising=False)
    values_before = {name: getattr(jax.config, name) for name in SETTINGS}
    jax.config.update("jax_compilation_cache_dir", None)
    with warnings.catch_warnings():
        yield
    for name, value in values_before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_those_who_start_together_all_have_the_folder(unset, tmp_path):
    threads, barrier = 6, threading.Barrier(6)

    def start(_):
        barrier.wait()
        return [enable_compilation_cache(tmp_path) for _ in range(20)]

    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        folders = {folder for group in pool.map(start, range(threads)) for folder in group}
    assert folders == {tmp_path / environment_name()}
    assert [path.name for path in (tmp_path / environment_name()).iterdir()] == [LOOKED_AT]


@pytest.mark.parametrize("folder", [5, True, b"x", ""])
def test_what_is_no_folder_is_refused(folder, unset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=f"folder = {folder!r} must be a path"):
        enable_compilation_cache(folder)
    assert jax.config.jax_compilation_cache_dir is None


def test_words_that_forbid_it(unset, tmp_path, monkeypatch):
    for word in ("off", "FALSE", "No"):
        monkeypatch.setenv("NONHOLONOMIC_CACHE", word)
        assert enable_compilation_cache(tmp_path) is None
    monkeypatch.setenv("NONHOLONOMIC_CACHE", "1")
    assert enable_compilation_cache(tmp_path) == tmp_path / environment_name()


def test_a_full_disk_is_told_and_still_read(unset, tmp_path, caplog):
    """Stood in for by the shell's limit on the length of a file."""
    values_before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, values_before[1]))
    try:
        assert enable_compilation_cache(tmp_path) == tmp_path / environment_name()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, values_before)
    (message,) = caplog.messages
    assert message.startswith(f"compiled programs can no longer be stored in {tmp_path}")
    assert not list((tmp_path / environment_name()).iterdir())


def test_a_folder_that_was_chosen_before_stands(unset, tmp_path, caplog):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.7)
    with caplog.at_level(logging.WARNING):
        assert enable_compilation_cache() == tmp_path / "mine"
    assert not caplog.records
    # With JAX's limits.
    assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.7


def test_files_are_kept_until_their_facts_change(tmp_path, monkeypatch):
    calls = []

    def compute() -> dict[str, bytes]:
        calls.append(1)
        return {"a": b"file %d" % len(calls), "b": b""}

    def first(folder, facts) -> str:
        files = kept_files(folder, facts, compute)
        assert files["b"] == b""
        return files["a"].decode()

    assert not are_kept(tmp_path, "a")
    assert [first(tmp_path, facts) for facts in ("a", "a", "b")] == ["file 1", "file 1", "file 2"]
    assert are_kept(tmp_path, "a")
    # A damaged archive is written anew.
    for path in tmp_path.iterdir():
        path.write_bytes(b"half")
    assert first(tmp_path, "a") == first(tmp_path, "a") == "file 3"
    assert first(None, "a") == "file 4"
    # Single precision, another version of JAX, other flags of the compiler, and other sources give other results.
    with jax.enable_x64(False):
        assert first(tmp_path, "a") == "file 5"
    with monkeypatch.context() as changed:
        changed.setattr(cache, "version", lambda package: "0.0")
        assert first(tmp_path, "a") == "file 6"
    with monkeypatch.context() as changed:
        changed.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX")
        assert first(tmp_path, "a") == "file 7"
    with monkeypatch.context() as changed:
        # Packages that are installed elsewhere, with other sources.
        sources = tmp_path / "sources"
        (sources / "nonholonomic" / "compilation").mkdir(parents=True)
        (sources / "nonholonomic" / "other.py").write_text("source")
        changed.setattr(cache, "__file__", str(sources / "nonholonomic" / "compilation" / "cache.py"))
        assert first(tmp_path, "a") == "file 8"
        (sources / "nonholonomic" / "other.py").write_text("another source")
        assert first(tmp_path, "a") == "file 9"
    assert first(tmp_path, "a") == "file 3"
