"""A grid is cut into blocks, which are computed wherever there is room, stored as they finish, and end up in a table."""

import contextlib
import functools
import json
import math
import os
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..progress import Progress
from ._blockfile import BlockFile, Layout
from ._hdf5 import UNREACHED, blank
from .grid import Axis, Values, Variable, columns, size_of
from .handing import DEATHS, Lost, handed_out
from .table import Table
from .tasks import Job, Work, packed, remote_results, stamp, versions

#: Blocks that are handed out at once, at most: what their results take, when they come faster than they can be stored.
HANDED_OUT = 512

#: Blocks of a large grid, about, and what the results of one may take [bytes].
BLOCKS, MOST_BYTES = 8192, 1 << 21


def sweep(
    job: Job,
    axes: list[Axis],
    variables: dict[str, Variable],
    request: dict[str, Any],
    *,
    path: Any = None,
    block: int | None = None,
    most: int | None = None,
    inner: Sequence[Axis] = (),
    progress: bool = True,
    executor: Executor | None = None,
) -> Table:
    """Compute every cell of a grid.

    **Arguments:**

    - `job`: (full name of a parameter -> values of some cells, how many of them count) -> name -> results. It may be called
      from several threads at once; the first call, with no cell that counts, lets it compile. For an executor whose workers
      are other processes it is pickled.
    - `axes`: the grid, the last axis varying fastest.
    - `variables`: what `job` returns.
    - `request`: plain data that says what is computed; it is stored in the table and guards the file.
    - `path`: file to write, block by block; if it holds part of the same request, only the rest is computed.
    - `block`: how many cells `job` is given at once, `block_for` their number by default; `most`: the most of them, where
      results are large.
    - `inner`: the coordinates of the dimensions that results have besides the grid's, numbers or words.
    - `progress`: whether to show it, on a terminal or in a notebook.
    - `executor`: who computes; by default a thread for each core.

    **Returns:** the `Table`.

    **Raises:** `OSError` or `ValueError` if the file cannot be written or holds another request; `RuntimeError` if the executor
    breaks down or a worker has other versions: what had finished is in the file.
    """
    coords = {one.name: one.values for one in (*axes, *inner)}
    units = {one.name: one.unit for one in (*axes, *inner) if one.values.dtype.kind != "U"}
    units |= {name: one.unit for name, one in variables.items() if one.words is None}
    cells = size_of(axes)
    given = block_for(cells) if block is None else block
    given = given if most is None else min(given, most)
    size = given * blocks_together(cells, given, variables, coords)
    firsts = range(0, cells, size)
    request = request | {"float": str(np.dtype(jnp.result_type(float)))}
    attributes = {
        "request": json.dumps(request),
        "axes": json.dumps([one.name for one in axes]),
        "versions": json.dumps(versions()),
    }
    words = {name: one.words for name, one in variables.items() if one.words is not None}
    kinds = {name: one.kind for name, one in variables.items()}
    dims = {name: one.inner for name, one in variables.items() if one.inner}
    layout = Layout(coords, kinds, units, words, attributes, firsts, dims)
    work = Work(job, axes, given)

    file = None if path is None else BlockFile(path, layout)
    try:
        found = layout.rows(layout.empty()) if file is None else file.values()
        todo = [index for index in range(len(firsts)) if file is None or index not in file.finished]
        counts = [min(size, cells - first) for first in firsts]
        done = cells - sum(counts[index] for index in todo)
        with Progress(cells, "cell", shown=progress) as shown, workforce(work, executor) as submit:
            begun = executor is None
            if begun:
                if todo:
                    work.compile()
                shown.begin(done)
            for index, values in handed_out(lambda index: submit(firsts[index], counts[index]), todo, HANDED_OUT):
                if values is None:
                    values = given_up(axes, variables, coords, firsts[index], counts[index])
                for name, some in values.items():
                    found[name][firsts[index] : firsts[index] + len(some)] = some
                if file is not None:
                    file.write(index, firsts[index], values)
                done += counts[index]
                # Where others compute, nobody tells when the first of them has compiled.
                if begun:
                    shown.advance(counts[index])
                else:
                    shown.begin(done)
                begun = True
    except Lost as error:
        kept = (
            "nothing is kept without path="
            if file is None
            else f"{file.path} has what is done; the same call does the rest"
        )
        raise RuntimeError(f"{error}; {done} of {cells} cells are done, {kept}") from error.__cause__
    finally:
        if file is not None:
            file.close()
    shaped = {name: values.reshape((*layout.shape, *values.shape[1:])) for name, values in found.items()}
    shaped |= {name: np.array([*words[name], UNREACHED])[shaped[name]] for name in words}
    return Table(coords, shaped, units, attributes if file is None else file.attributes, words, dims)


@contextlib.contextmanager
def workforce(work: Work, executor: Executor | None) -> Iterator[Callable[[int, int], Future]]:
    """Who computes: a function that has `count` cells from `first` on computed.

    Threads share this process, and what it has compiled. Any other executor is sent all that it takes.
    """
    if executor is None:
        pool = ThreadPoolExecutor(workers())
        try:
            yield functools.partial(pool.submit, work.results)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    elif isinstance(executor, ThreadPoolExecutor):
        yield functools.partial(executor.submit, work.results)
    else:
        sent, needed = packed(work), stamp()
        yield lambda first, count: executor.submit(remote_results, sent, needed, first, count, uuid.uuid4().hex)


def given_up(
    axes: list[Axis], variables: dict[str, Variable], coords: dict[str, Values], first: int, count: int
) -> dict[str, Values]:
    """The results of a block that is given up: `failed`, and no numbers; a warning names its cells."""
    ends = [columns(axes, cell, 1) for cell in (first, first + count - 1)]
    named = ", ".join(f"{name} {ends[0][name].item():.6g} to {ends[1][name].item():.6g}" for name in ends[0])
    warnings.warn(
        f"cells {first} to {first + count - 1} ({named}) are given up as failed: {DEATHS} workers or more died of them",
        RuntimeWarning,
        stacklevel=4,
    )
    found = {}
    for name, one in variables.items():
        value = one.words.index("failed") if one.words is not None else blank(one.kind)
        found[name] = np.full((count, *(len(coords[dim]) for dim in one.inner)), value, one.kind)
    return found


def block_for(cells: int) -> int:
    """Cells in a block: few different sizes, so that few programs are compiled, but many blocks, to be shared among cores.

    It does not depend on the number of cores, so that a file can be resumed on another machine.
    """
    if jax.default_backend() != "cpu":
        return 65536 if cells > 4096 else 4096
    # A block of 64 lanes takes no longer for two cells than one of two lanes does: starting its loops is what takes the time.
    return 64 if cells <= 64 else 128 if cells <= 4096 else 512


def blocks_together(cells: int, block: int, variables: dict[str, Variable], coords: dict[str, Values]) -> int:
    """How many blocks are handed out and stored as one, a power of two: more than one where the grid is large."""
    bytes_of_cell = sum(
        np.dtype(one.kind).itemsize * math.prod(len(coords[dim]) for dim in one.inner) for one in variables.values()
    )
    wanted = min(cells // (BLOCKS * block), MOST_BYTES // (block * bytes_of_cell))
    return 1 << max(wanted, 1).bit_length() - 1


def workers() -> int:
    """How many blocks run at once in this process: one for each core it may use; an accelerator takes one at a time."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
