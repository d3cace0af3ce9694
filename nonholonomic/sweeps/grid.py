"""A grid of named axes: its cells, and the parameters of each cell."""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..validation import require
from .layout import Values

#: Grids with at most this many cells are checked cell by cell before anything runs.
CHECKED_WHOLE = 1 << 20


class Axis(NamedTuple):
    """One axis of a grid: its name in the table, the full name of the varied parameter, the unit, and a long name.

    **Example:** as for `axis`, which checks the values.

    >>> from nonholonomic.sweeps import Axis
    >>> Axis("rate", "system.rate", "1/s", np.array([1.0, 2.0])).name
    'rate'
    """

    name: str
    number: str
    unit: str
    values: Values
    long_name: str = ""


class Variable(NamedTuple):
    """One result of every cell: its unit and dtype, and, for a code, the words for its values.

    `inner`: names of the dimensions of an array result, in order; `long_name`: description.

    **Example:** a code with words.

    >>> from nonholonomic.sweeps import Variable
    >>> Variable("1", np.int8, words=("completed", "failed")).words[1]
    'failed'
    """

    unit: str
    kind: Any
    words: tuple[str, ...] | None = None
    inner: tuple[str, ...] = ()
    long_name: str = ""


def axis(name: str, number: str, unit: str, values: Any, long_name: str = "") -> Axis:
    """An axis, checked.

    **Arguments:** `name`: name in the table; `number`: full name of the varied parameter; `unit`; `values`, (values,);
    `long_name`: description.

    **Raises:** `ValueError` that names the axis unless the values are finite numbers in a one-dimensional, non-empty array.

    **Example:**

    >>> from nonholonomic.sweeps import axis
    >>> axis("rate", "system.rate", "1/s", [])
    Traceback (most recent call last):
    ValueError: rate must be a number or a non-empty list of numbers, not of shape (0,)
    """
    require(values, name)
    array = np.asarray(values, dtype=float)
    if array.ndim != 1 or array.size == 0:
        raise ValueError(f"{name} must be a number or a non-empty list of numbers, not of shape {array.shape}")
    return Axis(name, number, unit, array, long_name)


def size_of(axes: list[Axis]) -> int:
    """Number of cells of a grid.

    **Example:**

    >>> from nonholonomic.sweeps import size_of
    >>> size_of(axes)
    4
    """
    return int(np.prod([len(axis.values) for axis in axes], dtype=int))


def columns(axes: list[Axis], first: int, count: int) -> dict[str, Values]:
    """The parameters of some cells; the last axis varies fastest.

    **Arguments:** `axes`: the grid; `first`: index of the first cell; `count`: number of cells. Beyond the end of the
    grid, the last cell is repeated.

    **Returns:** full name of a parameter -> its value in every cell.
    """
    cell = np.minimum(np.arange(first, first + count), size_of(axes) - 1)
    places = np.unravel_index(cell, [len(axis.values) for axis in axes]) if axes else ()
    return {axis.number: axis.values[place] for axis, place in zip(axes, places, strict=True)}


def cells_to_check(axes: list[Axis]) -> Iterator[dict[str, Values]]:
    """The cells that are checked before anything runs, as columns: all cells of a small grid; for a large grid, every
    value of every axis, and all corners.

    If a limit on one parameter is monotonic in the others, as in the models, a violation also occurs in a corner. All
    other cells are checked later, when they run.

    **Example:**

    >>> from nonholonomic.sweeps import cells_to_check
    >>> next(cells_to_check(axes))["system.rate"]
    array([1., 1., 2., 2.])
    """
    if size_of(axes) <= CHECKED_WHOLE:
        yield columns(axes, 0, size_of(axes))
        return
    for axis in axes:
        constants = {neighbour.number: np.repeat(neighbour.values[:1], len(axis.values)) for neighbour in axes}
        yield constants | {axis.number: axis.values}
    corners = np.array(list(itertools.product(*((axis.values.min(), axis.values.max()) for axis in axes))))
    yield {axis.number: corner for axis, corner in zip(axes, corners.T, strict=True)}


def scattered_cells(axes: list[Axis]) -> dict[str, Values]:
    """The numbers of cells that are scattered instead of on a grid: the first of all axes, the second, and so on.

    **Arguments:** `axes`: a list of numbers for each variable.

    **Returns:** full name -> one value per cell.

    **Raises:** `ValueError` unless there are lists, all of equal length.

    **Example:**

    >>> from nonholonomic.sweeps import scattered_cells
    >>> scattered_cells(axes[:1])["system.rate"]
    array([1., 2.])
    """
    lengths = {axis.name: len(axis.values) for axis in axes}
    if len(set(lengths.values())) != 1:
        lengths_text = ", ".join(f"{name} of {length}" for name, length in lengths.items()) or "none"
        raise ValueError(
            f"scattered = True takes lists of one length, not {lengths_text}; the other numbers are scalars"
        )
    return {axis.number: axis.values for axis in axes}
