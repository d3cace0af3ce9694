"""A grid of named axes, cut into blocks that run on all cores, are stored as they finish and end up in a table."""

import json
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from ..progress import Progress
from ..validation import require
from ._blockfile import BlockFile, Layout
from ._hdf5 import LONG_NAMES, UNREACHED
from .table import Table

Values = Shaped[np.ndarray, "..."]


class Axis(NamedTuple):
    """One axis of a grid: its name in the table, the full name of the parameter it varies, the unit, and a name in words."""

    name: str
    number: str
    unit: str
    values: Values
    long_name: str = ""


class Variable(NamedTuple):
    """One result of every cell: its unit and dtype, and, if it is a code, the words it stands for.

    `inner` names the dimensions of a result that is an array, in order; `long_name` says what it is.
    """

    unit: str
    kind: Any
    words: tuple[str, ...] | None = None
    inner: tuple[str, ...] = ()
    long_name: str = ""


def axis(name: str, number: str, unit: str, values: Any, long_name: str = "") -> Axis:
    """An axis, checked.

    **Raises:** `ValueError` that names the axis if the values are not a non-empty one-dimensional array of finite numbers.
    """
    require(values, name)
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name} must be a number or a non-empty list of numbers, not of shape {array.shape}")
    return Axis(name, number, unit, array, long_name)


def sweep(
    run: Callable[[dict[str, Values], int], dict[str, Values]],
    axes: list[Axis],
    variables: dict[str, Variable],
    request: dict[str, Any],
    *,
    path: Any = None,
    block: int | None = None,
    most: int | None = None,
    inner: Sequence[Axis] = (),
    progress: bool = True,
) -> Table:
    """Compute every cell of a grid.

    **Arguments:**

    - `run`: (full name of a parameter -> values of a block's cells, how many of them count) -> name -> results. It is called
      from several threads at once; the first call, with no cell that counts, lets it compile.
    - `axes`: the grid, the last axis varying fastest.
    - `variables`: what `run` returns.
    - `request`: plain data that says what is computed; it is stored in the table and guards the file.
    - `path`: file to write, block by block; if it holds part of the same request, only the rest is computed.
    - `block`: how many cells `run` is given at once, `block_for` their number by default; `most`: the most of them, where
      results are large.
    - `inner`: the coordinates of the dimensions that results have besides the grid's, numbers or words.
    - `progress`: whether to show it, on a terminal or in a notebook.

    **Returns:** the `Table`.

    **Raises:** `OSError` or `ValueError` if the file cannot be written or holds another request.
    """
    coords = {one.name: one.values for one in (*axes, *inner)}
    units = {one.name: one.unit for one in (*axes, *inner) if one.values.dtype.kind != "U"}
    units |= {name: one.unit for name, one in variables.items() if one.words is None}
    cells = int(np.prod([len(one.values) for one in axes], dtype=int))
    block = block_for(cells) if block is None else block
    block = block if most is None else min(block, most)
    firsts = range(0, cells, block)
    request = request | {"float": str(np.dtype(jnp.result_type(float)))}
    attributes = {
        "request": json.dumps(request),
        "axes": json.dumps([one.name for one in axes]),
        "versions": json.dumps(versions()),
    }
    long_names = {one.name: one.long_name for one in (*axes, *inner)}
    long_names |= {name: one.long_name for name, one in variables.items()}
    if any(long_names.values()):
        named = {name: long_name for name, long_name in long_names.items() if long_name}
        attributes[LONG_NAMES] = json.dumps(named, sort_keys=True)
    words = {name: one.words for name, one in variables.items() if one.words is not None}
    kinds = {name: one.kind for name, one in variables.items()}
    dims = {name: one.inner for name, one in variables.items() if one.inner}
    layout = Layout(coords, kinds, units, words, attributes, firsts, dims)

    def columns(index: int) -> dict[str, Values]:
        cell = np.minimum(np.arange(firsts[index], firsts[index] + block), cells - 1)
        places = np.unravel_index(cell, layout.shape) if axes else ()
        return {one.number: one.values[place] for one, place in zip(axes, places, strict=True)}

    def work(index: int) -> dict[str, Values]:
        count = min(block, cells - firsts[index])
        return {name: values[:count] for name, values in run(columns(index), count).items()}

    file = None if path is None else BlockFile(path, layout)
    try:
        found = layout.rows(layout.empty()) if file is None else file.values()
        todo = [index for index in range(len(firsts)) if file is None or index not in file.finished]
        with Progress(cells, "cell", shown=progress) as shown:
            if todo:
                run(columns(todo[0]), 0)
            shown.begin(cells - sum(min(block, cells - firsts[index]) for index in todo))
            for index, values in _as_they_finish(work, todo):
                for name, some in values.items():
                    found[name][firsts[index] : firsts[index] + len(some)] = some
                if file is not None:
                    file.write(index, firsts[index], values)
                shown.advance(min(block, cells - firsts[index]))
    finally:
        if file is not None:
            file.close()
    shaped = {name: values.reshape((*layout.shape, *values.shape[1:])) for name, values in found.items()}
    shaped |= {name: np.array([*words[name], UNREACHED])[shaped[name]] for name in words}
    return Table(coords, shaped, units, attributes if file is None else file.attributes, words, dims)


def _as_they_finish(work: Callable[[int], Any], todo: list[int]) -> Iterator[tuple[int, Any]]:
    """Run the blocks on all cores; after an exception, Ctrl-C included, no further block starts."""
    pool = ThreadPoolExecutor(workers())
    try:
        pending = {pool.submit(work, index): index for index in todo}
        for future in as_completed(pending):
            yield pending[future], future.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def block_for(cells: int) -> int:
    """Cells in a block: few different sizes, so that few programs are compiled, but many blocks, to be shared among cores.

    It does not depend on the number of cores, so that a file can be resumed on another machine.
    """
    if jax.default_backend() != "cpu":
        return 65536 if cells > 4096 else 4096
    # A block of 64 lanes takes no longer for two cells than one of two lanes does: starting its loops is what takes the time.
    return 64 if cells <= 64 else 128 if cells <= 4096 else 512


def workers() -> int:
    """How many blocks run at once: one for each core this process may use; an accelerator takes one at a time."""
    if jax.default_backend() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    found = {"python": platform.python_version()}
    for name in ("nonholonomic", "jax", "jaxlib", "diffrax", "numpy"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
