"""Throughput of one parent process: a sweep whose cells only take time, with many workers and a file.

    python benchmarks/feeding.py [--cells 1e8] [--workers 64] [--each 2e-4] [--quick]

The workers are threads that sleep for as long as the cells of a chunk would take, and then send their results pickled,
as processes do; the computation of results is not measured. The parent does its real work: it dispatches, unpickles,
writes and syncs each chunk, and writes the table's file. `each` is the time per cell [s]; 2e-4 is that of a top on the
plane at a tolerance of 1e-9. In the first run nobody sleeps, which gives the parent's maximum throughput. In the second
run, on fewer cells, the workers sleep: the time that they wait for chunks is the parent's overhead. All chunks take the
same time, so the last ones arrive together; the parent's work on those, when the workers have finished, is reported
separately, as is its CPU time, which does not depend on other load. At the start, the script measures the real cost of
a cell.
"""

import argparse
import pickle
import resource
import tempfile
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

import tippe
from nonholonomic.sweeps import Table, Variable, axis, running, sweep

#: The variables of an inversion table.
NAMES = ("time", "end_time", "end_theta")
VARIABLES = {name: Variable("s", np.float64) for name in NAMES}
VARIABLES |= {"status": Variable("1", np.int8, ("inverted", "not_inverted", "failed"))}
VARIABLES |= {name: Variable("1", np.int64) for name in ("steps", "rejected")}


def results(columns, count):
    """Results that take almost no time to compute."""
    variables = {name: columns["x"] for name in NAMES}
    zeros = np.zeros(len(columns["x"]), int)
    return variables | {"status": zeros.astype(np.int8), "steps": zeros, "rejected": zeros}


class Sleepers(Executor):
    """Workers that sleep for `each` seconds per cell; their results arrive as bytes, and a thread of a pool unpickles
    them."""

    def __init__(self, workers: int, seconds_per_block: float, cells: int):
        self._pool, self._each, self._cells = ThreadPoolExecutor(workers), seconds_per_block, cells
        self._sent: dict[bool, bytes] = {}
        self._lock, self.blocks, self.done = threading.Lock(), 0, 0.0

    def submit(self, function, /, payload, stamp, first, count, mark) -> Future:
        return self._pool.submit(self._worked, function, payload, stamp, first, count, mark)

    def shutdown(self, wait=True, *, cancel_futures=False):
        self._pool.shutdown(wait, cancel_futures=cancel_futures)

    def _worked(self, function, payload, stamp, first, count, mark):
        with self._lock:
            # The last may be shorter; all others have the same results here.
            last = first + count > self._cells
            if last not in self._sent:
                self._sent[last] = pickle.dumps(function(payload, stamp, first, count, mark))
            self.blocks += 1
        time.sleep(count * self._each)
        message = pickle.loads(self._sent[last])
        self.done = time.perf_counter()
        return message


class Took(NamedTuple):
    """The times of a sweep [s]: until the last worker had finished, until the last chunk was written, afterwards, and
    CPU time until then; and the number of chunks."""

    worked: float
    fed: float
    after: float
    processor: float
    blocks: int


def run(cells: int, workers: int, seconds_per_block: float, folder: Path) -> Took:
    """A sweep over `cells` cells, a multiple of 4096."""
    x, y = axis("x", "x", "1", np.linspace(0.0, 1.0, 1 << 12)), axis("y", "y", "1", np.arange(cells >> 12))
    sleepers, busy = Sleepers(workers, seconds_per_block, cells), []

    def handed_out(*arguments, original=running.handed_out):
        yield from original(*arguments)
        busy.extend([time.perf_counter(), time.process_time()])

    running.handed_out, original = handed_out, running.handed_out
    start, processor = time.perf_counter(), time.process_time()
    try:
        table = sweep(results, [y, x], VARIABLES, {"what": "nothing"}, path=folder / "table.h5", executor=sleepers)
    finally:
        running.handed_out = original
        sleepers.shutdown()
    end = time.perf_counter()
    assert isinstance(table, Table)
    assert table.shape == (len(y.values), len(x.values))
    (folder / "table.h5").unlink()
    return Took(sleepers.done - start, busy[0] - start, end - busy[0], busy[1] - processor, sleepers.blocks)


def cost_of_a_cell() -> float:
    """The CPU time per cell [s]: Rutstam's top on the plane, 64 x 64 launches, to an error of about 1e-8."""
    inertia = 0.02 * 0.02**2
    scene = tippe.Scene(tippe.Top(0.02, 0.02, 0.006, 131 / 350 * inertia, 0.4 * inertia), friction=tippe.Viscous(0.3))
    launches = {"theta": np.linspace(0.05, 0.4, 64), "spin": np.linspace(60.0, 160.0, 64), "t1": 30.0}
    with ThreadPoolExecutor(1) as thread:
        tippe.inversion_table(scene, executor=thread, **launches)
        start = time.process_time()
        tippe.inversion_table(scene, executor=thread, **launches)
    return (time.process_time() - start) / 4096


def peak() -> float:
    """The greatest memory of this process [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--cells", type=float, default=1e8, help="cells of the sweep whose workers do not sleep")
    command.add_argument("--workers", type=int, default=64)
    command.add_argument("--each", type=float, default=2e-4, help="time that a cell takes [s]")
    command.add_argument("--quick", action="store_true", help="a hundredth of the cells")
    options = command.parse_args()
    cost = cost_of_a_cell()
    print(f"a cell takes {1e3 * cost:.3f} ms of a core: 10^6 cells {1e6 * cost / 3600:.3f} core-hours")
    cells = int(options.cells) >> 12 << 12
    if options.quick:
        # The blocks keep their size.
        cells, running.BLOCKS = cells // 100 >> 12 << 12, running.BLOCKS // 100
    with tempfile.TemporaryDirectory(dir=".") as folder:
        times = run(cells, options.workers, 0.0, Path(folder))
        rate = cells / times.fed
        print(
            f"{cells:.3g} cells in {times.blocks} blocks, workers that need no time: {times.fed:.1f} s, "
            f"{rate:.3g} cells a second"
        )
        print(f"after the last block: {times.after:.1f} s; at most {peak():.2f} GiB held")
        print(f"so one parent feeds {rate * options.each:.0f} workers that take {options.each:g} s a cell")
        # Every worker gets the same number of chunks of the same size, whatever the number of workers.
        size = -(-cells // times.blocks // 512) * 512
        running.chunks_together, original = lambda layout: size // layout.chunk, running.chunks_together
        cell_count = size * options.workers * 8 >> 12 << 12
        ideal = cell_count * options.each / options.workers
        times = run(cell_count, options.workers, options.each, Path(folder))
        running.chunks_together = original
        print(
            f"{cell_count:.3g} cells in {times.blocks} blocks, {options.workers} workers that sleep for {ideal:.1f} s each:"
        )
        print(
            f"  the last was done after {times.worked:.1f} s: they waited for {100 * (times.worked / ideal - 1):.1f} % of that"
        )
        print(
            f"  the last {options.workers} blocks, which came at once, were written {times.fed - times.worked:.1f} s later"
        )
        print(f"  the parent took {times.processor:.1f} s of a core, {100 * times.processor / ideal:.1f} %")


if __name__ == "__main__":
    main()
