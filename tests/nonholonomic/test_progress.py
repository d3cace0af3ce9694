"""A long call says what it is doing, to whoever watches."""

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from terminal import Terminal

from nonholonomic.sweeps import Variable, axis, sweep

pytestmark = pytest.mark.newest


class Pipe(Terminal):
    def isatty(self):
        return False


def slow_sweep(monkeypatch, stream, cells=6, block=3, **options):
    """A sweep that compiles for 1.3 s and takes 0.8 s for each of its blocks, one at a time; what it writes, and when."""

    def compute(columns, count):
        time.sleep(0.8 if count else 1.3)
        return {"value": columns["x"]}

    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("nonholonomic.sweeps.running.workers", lambda: 1)
    x = axis("x", "x", "s", np.linspace(0.0, 1.0, cells))
    sweep(compute, [x], {"value": Variable("m", float)}, {"what": "a test"}, block=block, **options)
    return stream.lines


def test_a_table_says_what_it_does_within_a_second_and_then_how_fast(monkeypatch):
    lines = slow_sweep(monkeypatch, Terminal())
    since, first = lines[0]
    assert since < 1.0
    assert first.startswith("compiling")
    assert {text.split()[0] for at, text in lines if at < 1.3} == {"compiling"}
    # Half done: as much time is left as has passed since the compilation, and the rate leaves the compilation out.
    half = next(text for _, text in lines if "3/6" in text)
    passed, left = (float(half.split(mark)[1][:5].replace("00:", "")) for mark in ("[", "<"))
    rate = float(half.split(", ")[1].split("cell/s")[0])
    assert 0.0 <= left - passed <= 1.0 or passed == left
    assert 2.0 < rate < 4.0
    assert "6/6" in lines[-1][1]


def test_a_table_of_one_block_says_so_too(monkeypatch):
    lines = slow_sweep(monkeypatch, Terminal(), cells=3)
    assert lines[0][1].startswith("compiling")
    assert any("0/3" in text for _, text in lines)


def test_the_rate_is_that_of_all_workers(monkeypatch):
    """Two at once: what the first two blocks took is not known apart from the preparations, and the rest is twice as fast."""
    with ThreadPoolExecutor(2) as pool:
        lines = slow_sweep(monkeypatch, Terminal(), cells=18, executor=pool)
    half = next(text for _, text in lines if "12/18" in text)
    assert 5.0 < float(half.split(", ")[1].split("cell/s")[0]) < 14.0
    assert "18/18" in lines[-1][1]


@pytest.mark.parametrize("way", ["pipe", "argument", "environment"])
def test_nothing_is_written_where_nobody_watches_or_wants_it(way, monkeypatch):
    if way == "environment":
        monkeypatch.setenv("NONHOLONOMIC_PROGRESS", "0")
    options = {"progress": False} if way == "argument" else {}
    assert slow_sweep(monkeypatch, Pipe() if way == "pipe" else Terminal(), cells=3, **options) == []


def test_what_few_processes_need_is_not_imported_with_the_package():
    program = "import sys, tippe; print({'h5py', 'tqdm', 'matplotlib', 'pandas', 'jax.scipy.stats'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
