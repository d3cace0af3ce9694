"""The status line of a long call."""

import io
import subprocess
import sys
import threading
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import ModuleSpec

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from terminal import Terminal, left, watched, words

from nonholonomic import terminal as progress_module
from nonholonomic.derivatives import growth
from nonholonomic.integration import Outcome, Settings
from nonholonomic.integration.problem import REACHED_END
from nonholonomic.sweeps import Variable, axis, sweep
from nonholonomic.terminal import Progress, status_line


class Pipe(Terminal):
    def isatty(self):
        return False


def slow_sweep(monkeypatch, stream, cells=6, block=3, waits=(1.3, 0.8), **options):
    """Output, with times, of a sweep that compiles for 1.3 s and takes 0.8 s for each of its blocks, one at a time."""

    def compute(columns, count):
        time.sleep(waits[count > 0])
        return {"value": columns["x"]}

    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr("nonholonomic.sweeps.running.workers", lambda: 1)
    x = axis("x", "x", "s", np.linspace(0.0, 1.0, cells))
    sweep(compute, [x], {"value": Variable("m", float)}, {"what": "a test"}, chunk=block, **options)
    return stream.lines


def test_a_table_says_what_it_does_within_a_second_and_then_how_fast(monkeypatch):
    lines = slow_sweep(monkeypatch, Terminal())
    start_time, first = lines[0]
    assert start_time < 1.0
    assert first.startswith("compiling")
    assert {text.split()[0] for time_of_text, text in lines if time_of_text < 1.3} == {"compiling"}
    # Half done: as much time is left as has passed since the compilation, and the rate leaves the compilation out.
    half = next(text for _, text in lines if "3/6" in text)
    elapsed, left = (float(half.split(mark)[1][:5].replace("00:", "")) for mark in ("[", "<"))
    rate = float(half.split(", ")[1].split("cell/s")[0])
    assert 0.0 <= left - elapsed <= 1.0 or elapsed == left
    assert 2.0 < rate < 4.0
    assert "6/6" in lines[-1][1]


def test_a_table_of_one_block_says_so_too(monkeypatch):
    monkeypatch.setattr(progress_module, "EXPLAINED", 0.7)
    lines = slow_sweep(monkeypatch, Terminal(), cells=3)
    assert lines[0][1].startswith("compiling [")
    # Also where another thread compiles.
    assert any(text.startswith("compiling, usually up to 30 s, once for each kind of call") for _, text in lines)
    assert any("0/3" in text for _, text in lines)


def test_the_rate_is_that_of_all_workers(monkeypatch):
    """With two workers, the time of the first two blocks includes the preparations, and the rest is twice as fast."""
    with ThreadPoolExecutor(2) as pool:
        lines = slow_sweep(monkeypatch, Terminal(), cells=18, executor=pool)
    half = next(text for _, text in lines if "12/18" in text)
    assert 5.0 < float(half.split(", ")[1].split("cell/s")[0]) < 14.0
    assert "18/18" in lines[-1][1]


@pytest.mark.parametrize("way", ["pipe", "argument", "environment"])
def test_nothing_is_written_where_nobody_watches_or_wants_it(way, monkeypatch):
    if way == "environment":
        monkeypatch.setenv("NONHOLONOMIC_PROGRESS", "0")
    watched(monkeypatch)
    options = {"progress": False} if way == "argument" else {}
    stream = Pipe() if way == "pipe" else Terminal()
    assert slow_sweep(monkeypatch, stream, cells=3, waits=(0.2, 0.2), **options) == []


def test_where_nobody_watches_the_first_slow_call_writes_one_line(monkeypatch):
    watched(monkeypatch)
    pipe = Pipe()
    monkeypatch.setattr(sys, "stderr", pipe)
    monkeypatch.setattr(progress_module, "PATIENCE", 0.2)
    monkeypatch.setattr(Progress, "_has_told", False)
    with status_line("planning"):
        time.sleep(0.1)
    assert pipe.lines == []
    for _ in range(2):
        with status_line("planning"), status_line("simulating"):
            time.sleep(0.5)
    assert [text for _, text in pipe.lines] == ["nonholonomic: planning (NONHOLONOMIC_PROGRESS=0 hides this line)"]


def test_what_is_told_is_whether_a_program_is_being_made(monkeypatch):
    terminal = watched(monkeypatch)

    def waits(x):
        time.sleep(0.3)
        return x

    with status_line("simulating"):
        jax.jit(waits)(1.0)
        time.sleep(0.3)
    lines = words(terminal)
    assert lines[0] == "compiling"
    assert lines[-1] == "simulating"
    assert left(terminal) == ""


@pytest.mark.parametrize(("folder", "often"), [(None, " and session"), ("/programs", " (kept on disk)")])
def test_a_long_compilation_says_how_long_it_takes_and_how_often(folder, often, monkeypatch):
    terminal = watched(monkeypatch)
    monkeypatch.setattr(progress_module, "EXPLAINED", 0.2)
    # The line finds out that JAX compiles by the functions that are running.
    monkeypatch.setattr(progress_module, "COMPILERS", ((__name__, "sleep_as_a_compiler"),))
    own_folder = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", folder)
    try:
        with status_line("simulating"):
            sleep_as_a_compiler()
    finally:
        jax.config.update("jax_compilation_cache_dir", own_folder)
    lines = [text.partition(" [")[0] for _, text in terminal.lines if text.strip()]
    assert lines[0] == "compiling"
    assert lines[-1] == f"compiling, usually up to 30 s, once for each kind of call{often}"


def sleep_as_a_compiler():
    time.sleep(0.5)


def test_a_line_within_a_line_does_not_garble_it(monkeypatch):
    """A context that counts items owns the line until it ends; a context that does not count leaves the line unchanged."""
    terminal = watched(monkeypatch)
    with status_line("fitting"):
        with status_line("simulating"):
            time.sleep(0.3)
        with Progress(2, "fit") as progress:
            progress.begin()
            time.sleep(0.3)
            progress.advance(2)
        time.sleep(0.3)
    lines = words(terminal)
    assert "simulating" not in lines
    assert lines[0] == lines[-1] == "fitting"
    assert [text for _, text in terminal.lines if "fit/s" in text]
    assert left(terminal) == ""


def test_what_is_to_be_quiet_quiets_what_it_calls(monkeypatch):
    terminal = watched(monkeypatch)
    with status_line("fitting", shown=False), status_line("simulating"), Progress(1, "fit"):
        time.sleep(0.3)
    assert terminal.lines == []


def test_nothing_is_left_behind_after_an_error_and_nothing_is_in_the_way_of_what_is_printed(monkeypatch):
    terminal = watched(monkeypatch)

    @status_line("simulating")
    def fails():
        time.sleep(0.3)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert words(terminal)
    assert left(terminal) == ""
    with Progress(3, "ride") as progress:
        progress.begin()
        time.sleep(0.3)
        with progress.aside():
            remainder = left(terminal)
            time.sleep(0.1)
            assert left(terminal) == remainder == ""


def test_no_frame_is_written_twice(monkeypatch):
    terminal = watched(monkeypatch)
    with Progress(3, "ride") as progress:
        progress.begin()
        time.sleep(0.3)
    first, second, *_ = (time_of_text for time_of_text, text in terminal.lines if "0/3" in text)
    assert second - first > 0.03


def test_short_calls_start_no_threads(monkeypatch):
    terminal = watched(monkeypatch)
    threads, start = [], threading.Thread.start
    monkeypatch.setattr(threading.Thread, "start", lambda self: (threads.append(self), start(self)))
    for _ in range(50):
        with status_line("simulating"):
            pass
    assert len(threads) <= 1
    time.sleep(0.3)
    assert terminal.lines == []


def test_an_exponent_says_how_many_stretches_are_done(monkeypatch):
    terminal = watched(monkeypatch)

    class Still:
        def start(self):
            return jnp.ones((2, 3)), jnp.ones((2, 3))

    def ensemble_solve(problem, stretch, cells, settings):
        time.sleep(0.06)
        times, steps = jnp.ones((3, 3)), jnp.ones((2, 3), int)
        return Outcome(jnp.full(3, REACHED_END), *times, jnp.ones((4, 3)), *steps, jnp.ones((3, 3))), None

    monkeypatch.setattr(sys.modules["nonholonomic.derivatives.variation"], "solve_ensemble", ensemble_solve)
    growth(Still(), jnp.ones((1, 2, 3)), 1.0, 8, Settings(1e-6))
    assert words(terminal)[0] == "compiling"
    assert any("3/8" in text and "stretch/s" in text for _, text in terminal.lines)
    assert "8/8" in left(terminal)


@pytest.mark.parametrize("closed", [False, True])
def test_nobody_watches_a_stream_that_is_closed(closed, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO())
    stream.close()
    monkeypatch.setattr(sys, "stderr", stream if closed else None)
    with status_line("planning") as line:
        assert not line._watched


@pytest.mark.parametrize("widgets", [True, False])
def test_a_notebook_without_widgets_has_a_line_of_text_and_no_warning(widgets, monkeypatch):
    monkeypatch.setattr(progress_module, "is_notebook", lambda: True)
    monkeypatch.setattr(progress_module, "find_spec", lambda name: ModuleSpec(name, None) if widgets else None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bar = progress_module.bar_class()
    assert bar.__module__ == ("tqdm.notebook" if widgets else "tqdm.std")


def test_what_few_processes_need_is_not_imported_with_the_package():
    program = "import sys, tippe; print({'h5py', 'tqdm', 'matplotlib', 'pandas', 'jax.scipy.stats'} & set(sys.modules))"
    process = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert process.stdout == "set()\n"
