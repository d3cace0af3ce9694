"""A grid of named axes, cut into blocks that run on all cores, are stored as they finish and end up in a table."""

import json
import os
import platform
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Shaped
from tqdm import tqdm

from .blockfile import BlockFile, Layout
from .table import Table
from .validation import require

Values = Shaped[np.ndarray, "..."]


class Axis(NamedTuple):
    """One axis of a grid: its name in the table, the path of the number it varies, and the unit."""

    name: str
    path: str
    unit: str
    values: Values


class Variable(NamedTuple):
    """One result of every cell: its unit and dtype, and, if it is a code, the words it stands for."""

    unit: str
    kind: Any
    words: tuple[str, ...] | None = None


def axis(name: str, path: str, unit: str, values: Any) -> Axis:
    """An axis, checked.

    **Raises:** `ValueError` that names the axis if the values are not a non-empty one-dimensional array of finite numbers.
    """
    require(values, name)
    numbers = np.asarray(values, dtype=float)
    if numbers.ndim != 1 or numbers.size == 0:
        raise ValueError(f"{name} must be a number or a non-empty list of numbers, not of shape {numbers.shape}")
    return Axis(name, path, unit, numbers)


def sweep(
    run: Callable[[dict[str, Values], int], dict[str, Values]],
    axes: list[Axis],
    variables: dict[str, Variable],
    request: dict[str, Any],
    *,
    path: Any = None,
    block: int | None = None,
) -> Table:
    """Compute every cell of a grid.

    **Arguments:**

    - `run`: (path -> values of a block's cells, how many of them count) -> name -> results. It is called from several
      threads at once; the first call, with no cell that counts, lets it compile.
    - `axes`: the grid, the last axis varying fastest.
    - `variables`: what `run` returns.
    - `request`: plain data that says what is computed; it is stored in the table and guards the file.
    - `path`: file to write, block by block; if it holds part of the same request, only the rest is computed.
    - `block`: how many cells `run` is given at once.

    **Returns:** the `Table`.

    **Raises:** `OSError` or `ValueError` if the file cannot be written or holds another request.
    """
    coords = {one.name: one.values for one in axes}
    units = {one.name: one.unit for one in axes}
    units |= {name: one.unit for name, one in variables.items() if one.words is None}
    cells = int(np.prod([len(one.values) for one in axes], dtype=int))
    block = block_for(cells) if block is None else block
    firsts = range(0, cells, block)
    attributes = {
        "request": json.dumps(request),
        "axes": json.dumps([one.name for one in axes]),
        "versions": json.dumps(versions()),
    }
    words = {name: one.words for name, one in variables.items() if one.words is not None}
    layout = Layout(coords, {name: one.kind for name, one in variables.items()}, units, words, attributes, len(firsts))
    file = None if path is None else BlockFile(path, layout)
    todo = [i for i in range(len(firsts)) if file is None or i not in file.finished]
    results = {name: values.reshape(-1) for name, values in layout.empty().items()}

    def columns(index: int) -> dict[str, Values]:
        cell = np.minimum(np.arange(firsts[index], firsts[index] + block), cells - 1)
        places = np.unravel_index(cell, layout.shape) if axes else ()
        return {one.path: one.values[place] for one, place in zip(axes, places, strict=True)}

    def work(index: int) -> dict[str, Values]:
        count = min(block, cells - firsts[index])
        return {name: values[:count] for name, values in run(columns(index), count).items()}

    if todo:
        run(columns(todo[0]), 0)
        with (
            ThreadPoolExecutor(workers()) as pool,
            # `disable=None` shows the bar on a terminal only.
            tqdm(total=cells, unit="cell", disable=None if len(todo) > 1 else True) as bar,
        ):
            bar.update(cells - sum(min(block, cells - firsts[i]) for i in todo))
            pending = {pool.submit(work, i): i for i in todo}
            try:
                for future in as_completed(pending):
                    index, values = pending[future], future.result()
                    for name, some in values.items():
                        results[name][firsts[index] : firsts[index] + len(some)] = some
                    if file is not None:
                        file.write(index, firsts[index], values)
                    bar.update(len(next(iter(values.values()))))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    if file is not None:
        return Table.load(path)
    found = {name: values.reshape(layout.shape) for name, values in results.items()}
    found |= {name: np.array(words[name])[found[name]] for name in words}
    return Table(coords, found, units, attributes)


def block_for(cells: int) -> int:
    """Cells in a block: few sizes, so that few programs are compiled, and enough blocks to keep every core busy."""
    small, middle, large = (64, 512, 4096) if jax.default_backend() == "cpu" else (4096, 65536, 1048576)
    if cells <= small:
        return 1 << (cells - 1).bit_length()
    return middle if cells <= 2 * large else large


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
