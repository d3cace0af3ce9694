"""A sweep that costs almost nothing to compute, and a check of its files."""

import os
import signal
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from nonholonomic.sweeps import Table, Variable, axis, sweep

CELLS, BLOCK = 50, 8
X = np.linspace(0.0, 1.0, CELLS)
VARIABLES = {
    "value": Variable("m", np.float64),
    "status": Variable("1", np.int8, ("low", "high", "failed")),
    "count": Variable("1", np.int64),
}


def expected(x):
    """The results at x."""
    return {"value": np.sin(x), "status": (x > 0.5).astype(np.int8), "count": (1000.0 * x).astype(int)}


def block_of(columns):
    """The number of the block that starts with the given cells."""
    return int(np.flatnonzero(columns["x"][0] == X)[0]) // BLOCK


class CheapJob(NamedTuple):
    """A job for other processes. It notes each block that it begins as a file, of which each line names a process.

    The process that begins block `deadly` for one of the first `crashes` times kills itself; every block takes `pause` [s].
    """

    folder: Path
    deadly: int = -1
    crashes: int = 0
    pause: float = 0.0

    def __call__(self, columns, count):
        if count:
            note = self.folder / f"block{block_of(columns)}"
            with note.open("a") as stream:
                stream.write(f"{os.getpid()}\n")
            time.sleep(self.pause)
            if block_of(columns) == self.deadly and len(self.begun(self.deadly)) <= self.crashes:
                os.kill(os.getpid(), signal.SIGKILL)
        return expected(columns["x"])

    def begun(self, block):
        """The processes that began a block."""
        note = self.folder / f"block{block}"
        return note.read_text().split() if note.exists() else []


def cheap_sweep(path, run=None, job=None, **options):
    """A sweep over `X` in seven blocks; `run` is called for each computed block unless there is a `job`."""

    def compute(columns, count):
        if run is not None and count:
            run(block_of(columns))
        return expected(columns["x"])

    grid = [axis("x", "x", "s", X)]
    return sweep(job or compute, grid, VARIABLES, {"what": "a test"}, path=path, chunk=BLOCK, **options)


def finished_blocks(table: Table) -> set[int]:
    """The blocks that a table has, after a check that each is there as a whole or not at all, with the right numbers."""
    np.testing.assert_array_equal(table.coords["x"], X)
    right = expected(X)
    words = np.array(VARIABLES["status"].words)[right["status"]]
    blocks = set()
    for block, first in enumerate(range(0, CELLS, BLOCK)):
        cells = slice(first, first + BLOCK)
        if (table.status[cells] == "pending").all():
            assert np.isnan(table.value[cells]).all()
            assert (table.count[cells] == -1).all()
        else:
            np.testing.assert_array_equal(table.value[cells], right["value"][cells])
            np.testing.assert_array_equal(table.status[cells], words[cells])
            np.testing.assert_array_equal(table.count[cells], right["count"][cells])
            blocks.add(block)
    return blocks


def resumed(path: Path) -> set[int]:
    """Resume a sweep, check its result and its file, and tell which blocks it computed."""
    computed = []
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "(?s).*is damaged: .* are computed again", RuntimeWarning)
        table = cheap_sweep(path, computed.append)
    assert len(computed) == len(set(computed))
    assert finished_blocks(table) == finished_blocks(Table.load(path)) == set(range(7))
    return set(computed)


def place() -> tuple[int, set[int], str, str]:
    """The current process, its cores, and the settings that JAX read at import."""
    return os.getpid(), os.sched_getaffinity(0), jax.config.jax_platforms, jax.config.jax_compilation_cache_dir
