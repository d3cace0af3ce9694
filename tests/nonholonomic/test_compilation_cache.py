"""Compiled programs on disk: a second process compiles nothing, and a bad entry costs a compilation, nothing else."""

import json
import logging
import os
import subprocess
import sys

import jax
import pytest

from nonholonomic import enable_compilation_cache
from nonholonomic.compilation_cache import environment_name

pytestmark = pytest.mark.newest

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
    """What `COUNTED` tells in a process of its own, in which every warning is an error, and what else it says."""
    own = ("JAX_COMPILATION_CACHE_DIR", "NONHOLONOMIC_CACHE")
    settings = {name: value for name, value in os.environ.items() if name not in own} | settings
    settings |= {"XDG_CACHE_HOME": str(home), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-W", "error", "-c", COUNTED.format(program=program)]
    done = subprocess.run(command, capture_output=True, text=True, env=settings, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr


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
    turned = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    return {"empty": b"", "cut": content[:middle], "one bit turned": turned, "noise": os.urandom(len(content))}


def test_a_bad_entry_costs_a_compilation_and_nothing_else(tmp_path):
    first, _ = run(SMALL, tmp_path)
    folder = tmp_path / "nonholonomic" / environment_name()
    (entry,) = folder.glob("*-cache")
    for way, content in damaged(entry.read_bytes()).items():
        entry.write_bytes(content)
        mended, said = run(SMALL, tmp_path)
        assert (mended["result"], mended["found"], said) == (first["result"], 0, ""), way
    assert run(SMALL, tmp_path)[0]["found"] == 1


def test_an_entry_that_is_cut_while_it_is_used_costs_a_compilation_too(tmp_path):
    run(SMALL, tmp_path)
    cut = f"import pathlib\nfor entry in pathlib.Path(folder).glob('*-cache'): entry.write_bytes(b'')\n{SMALL}"
    answer, said = run(cut, tmp_path)
    assert (answer["result"], answer["found"], said) == (14.0, 0, "")


def test_other_flags_have_another_folder(tmp_path):
    one, _ = run(SMALL, tmp_path)
    other, _ = run(SMALL, tmp_path, XLA_FLAGS="--xla_cpu_enable_fast_min_max=true")
    assert one["folder"] != other["folder"]


@pytest.mark.parametrize("forbidden", [False, True])
def test_without_a_folder_everything_goes_on(forbidden, tmp_path):
    (tmp_path / "nonholonomic").write_text("this is a file")
    answer, said = run(SMALL, tmp_path, **({"NONHOLONOMIC_CACHE": "0"} if forbidden else {}))
    assert (answer["folder"], answer["result"], answer["found"]) == ("None", 14.0, 0)
    # One line names the folder; nobody needs to be told of what he has forbidden.
    assert len(said.splitlines()) == (0 if forbidden else 1)
    assert forbidden or str(tmp_path / "nonholonomic") in said


def test_a_folder_that_was_chosen_before_stands(tmp_path, monkeypatch, caplog):
    monkeypatch.delenv("NONHOLONOMIC_CACHE", raising=False)
    before = jax.config.jax_compilation_cache_dir
    try:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
        with caplog.at_level(logging.WARNING):
            assert enable_compilation_cache() == tmp_path / "mine"
        assert not caplog.records
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
