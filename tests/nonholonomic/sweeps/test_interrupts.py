"""Ctrl-C by real signals to real processes: within two seconds a message states what is saved, and nothing crashes."""

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from cheap_sweep import cheap_sweep, resumed

from nonholonomic.command_line import INTERRUPTED, PATIENCE
from nonholonomic.sweeps import Table
from nonholonomic.sweeps._store import ChunkStore, Stored

#: How long an answer to Ctrl-C may take [s]: twice as long where other programs keep all cores busy.
PROMPT = 2.0 if os.getloadavg()[0] <= (os.cpu_count() or 1) else 4.0

#: Keeps a thread in C for some seconds, deaf to signals, as XLA's compiler does; others go on.
DEAF = "import hashlib\ndef deaf(): hashlib.pbkdf2_hmac('sha256', b'', b'', 30_000_000)\n"

THREADS = """
import sys, time
from cheap_sweep import cheap_sweep
cheap_sweep(sys.argv[1], lambda block: time.sleep(1.0 if block > 2 else 0.0))
"""

#: Ctrl-C for itself in the middle of the sweep, during garbage collection of the main thread, where exceptions are ignored.
COLLECTING = """
import gc, os, signal, sys
from concurrent.futures import Future, ThreadPoolExecutor
from cheap_sweep import cheap_sweep
class Here(ThreadPoolExecutor):
    def submit(self, function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future
def interrupt(*_):
    gc.callbacks.remove(interrupt)
    os.kill(os.getpid(), signal.SIGINT)
def collect(block):
    if block == 2:
        gc.callbacks.append(interrupt)
        gc.collect()
cheap_sweep(sys.argv[1], collect, executor=Here())
"""

COMPILING = (
    DEAF
    + """
import os, sys
from cheap_sweep import cheap_sweep, expected
def job(columns, count):
    if not count:
        print("begun", flush=True)
        deaf()
    return expected(columns["x"])
try:
    cheap_sweep(sys.argv[1], job=job)
except KeyboardInterrupt as interrupt:
    print(interrupt, flush=True)
    os._exit(7)
"""
)

PROCESSES = """
import sys
from pathlib import Path
from cheap_sweep import CheapJob, cheap_sweep
from nonholonomic import local_processes
if __name__ == "__main__":
    with local_processes(1) as processes:
        cheap_sweep(sys.argv[1], job=CheapJob(Path(sys.argv[2]), pause=0.8), executor=processes)
"""

COMMAND = (
    DEAF
    + """
from nonholonomic.command_line import interruptible
def main():
    print("begun", flush=True)
    deaf()
    return 0
interruptible(main, "something")
"""
)

#: Ctrl-C for itself as soon as jax is about to be imported, during garbage collection, where exceptions are ignored.
IMPORTING = """
import gc, os, signal, sys
class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == "jax":
            gc.callbacks.append(lambda *_: os.kill(os.getpid(), signal.SIGINT))
            gc.collect()
sys.meta_path.insert(0, Interrupt())
"""


def started(folder: Path, *arguments: str) -> subprocess.Popen:
    """A process group of its own, as a shell starts a program on a terminal."""
    paths = [str(folder), str(Path(__file__).parent), *sys.path]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "XDG_CACHE_HOME": str(folder)}
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
        cwd=folder,
        # These tests may themselves run in a background job, to which a shell does not send Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def run(folder: Path, program: str, *arguments: str) -> subprocess.Popen:
    """A program in a file, because the processes that it starts import it."""
    (folder / "program.py").write_text(program)
    return started(folder, str(folder / "program.py"), *arguments)


def interrupted(process: subprocess.Popen) -> tuple[int, list[str], list[str], float]:
    """Ctrl-C for a process and all that it has started: exit status, lines of both outputs, and how long it took [s]."""
    start_time = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    output, error = process.communicate(timeout=60)
    return process.returncode, output.splitlines(), error.splitlines(), time.monotonic() - start_time


def wait_for(condition, process: subprocess.Popen) -> None:
    while not condition():
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.01)


def blocks(path: Path) -> set[int]:
    """The finished blocks of an unfinished table."""
    file = path.with_name(f"{path.name}.blocks") / "table.h5"
    return Stored(file).finished if file.exists() else set()


@pytest.mark.parametrize("way", ["threads", pytest.param("processes", marks=pytest.mark.slow)])
def test_a_table_says_what_is_saved_and_goes_on_from_there(way, tmp_path):
    path = tmp_path / "table.h5"
    process = run(tmp_path, THREADS if way == "threads" else PROCESSES, str(path), str(tmp_path))
    wait_for(lambda: len(blocks(path)) >= 2, process)
    status, output, error, duration = interrupted(process)
    assert (status, output) == (-signal.SIGINT, []), error
    assert duration < PROMPT
    saved_blocks = len(blocks(path))
    assert 2 <= saved_blocks < 7
    assert error[-1] == (
        f"KeyboardInterrupt: saved {8 * saved_blocks} of 50 cells to {path}; run the same call again to resume, or read "
        f"them from {path}.blocks with Table.load({str(path)!r})"
    )
    statuses = Table.load(path).status
    assert (statuses.size, np.sum(statuses == "pending")) == (50, 50 - 8 * saved_blocks)
    # The executor's processes print nothing.
    assert sum(line.startswith("Traceback") for line in error) == 1
    assert len(resumed(path)) == 7 - saved_blocks


def test_no_chunk_starts_after_an_interrupt_while_another_is_saved(tmp_path, monkeypatch):
    def interrupted_while_saving(store, chunks):
        next(chunks)
        raise KeyboardInterrupt

    begun, is_over = [], threading.Event()

    def run(block):
        begun.append(block)
        assert block == 0 or is_over.wait(60.0)

    monkeypatch.setattr(ChunkStore, "fill", interrupted_while_saving)
    with ThreadPoolExecutor(1) as executor:
        # As long as `caught` exists, so do the frames of its traceback.
        with pytest.raises(KeyboardInterrupt) as caught:
            cheap_sweep(tmp_path / "table.h5", run, executor=executor)
        is_over.set()
    assert caught
    assert len(begun) <= 2


def test_an_interrupt_stays_one_if_the_file_cannot_be_read(tmp_path, monkeypatch):
    def interrupted_while_saving(store, chunks, write=ChunkStore.write):
        for chunk, values in itertools.islice(chunks, 2):
            write(store, chunk, values)
        (store.folder / "table.h5").write_text("not a table")
        raise KeyboardInterrupt

    monkeypatch.setattr(ChunkStore, "fill", interrupted_while_saving)
    with ThreadPoolExecutor(1) as executor, pytest.raises(KeyboardInterrupt, match=r"saved 16 of 50 cells to .*; run"):
        cheap_sweep(tmp_path / "table.h5", executor=executor)


def test_an_interrupt_during_garbage_collection_is_neither_lost_nor_printed_twice(tmp_path):
    process = run(tmp_path, COLLECTING, "table.h5")
    _, output, error = process.wait(timeout=60), *process.communicate()
    assert error.count("Traceback") == 1
    assert (process.returncode, output) == (-signal.SIGINT, "")
    saved = "KeyboardInterrupt: saved 8 of 50 cells to table.h5; run the same call again to resume, or read them from "
    assert error.endswith(f"{saved}table.h5.blocks with Table.load('table.h5')\n")


def test_a_table_is_heard_while_it_compiles(tmp_path):
    process = run(tmp_path, COMPILING, "table.h5")
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.5)
    status, output, _, duration = interrupted(process)
    assert (status, output) == (7, ["saved 0 of 50 cells to table.h5; run the same call again to resume"])
    assert duration < PROMPT


@pytest.mark.oldest
def test_a_command_line_ends_while_it_compiles(tmp_path):
    process = run(tmp_path, COMMAND)
    assert process.stdout.readline() == "begun\n"
    # Until it no longer hears signals.
    time.sleep(0.5)
    status, output, error, duration = interrupted(process)
    assert (status, output) == (INTERRUPTED, [])
    assert error == ["python -m something: interrupted; run the same command again to resume"]
    assert PATIENCE <= duration < PROMPT


def test_the_main_job_of_the_top_says_what_is_saved(tmp_path):
    process = started(tmp_path, "-m", "tippe", "--theta", "6", "--t1", "5", "--out", "out")
    folder = tmp_path / "out" / "cylinder.h5.blocks"
    wait_for(lambda: (folder / "table.h5").exists(), process)
    # It compiles for some seconds from here on.
    time.sleep(0.5)
    status, _, error, duration = interrupted(process)
    assert status == INTERRUPTED
    assert error == ["python -m tippe: saved 0 of 10 cells to out; run the same command again to resume"]
    assert duration < PROMPT


@pytest.mark.parametrize("program", ["tippe", "stroller"])
def test_a_command_line_ends_with_one_line_while_it_is_imported(program, tmp_path):
    """The process sends itself the signal during garbage collection, just before it imports jax."""
    (tmp_path / "sitecustomize.py").write_text(IMPORTING)
    process = started(tmp_path, "-m", program, "--out", "out")
    _, output, error = process.wait(timeout=60), *process.communicate()
    assert (output, error) == ("", f"python -m {program}: interrupted\n")


def test_the_main_job_of_the_stroller_ends_with_one_line(tmp_path):
    process = started(tmp_path, "-m", "stroller", "--out", "out")
    wait_for(lambda: (tmp_path / "out").exists(), process)
    status, _, error, duration = interrupted(process)
    assert status == INTERRUPTED
    assert error == ["python -m stroller: interrupted; run the same command again to resume"]
    assert duration < PROMPT
