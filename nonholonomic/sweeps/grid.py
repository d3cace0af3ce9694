"""A grid of named axes: its cells, and the numbers of each."""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from ..validation import require
from .layout import Values

#: Grids of at most this many cells are checked cell by cell before anything runs.
CHECKED_WHOLE = 1 << 20


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


def size_of(axes: list[Axis]) -> int:
    """How many cells a grid has."""
    return int(np.prod([len(axis.values) for axis in axes], dtype=int))


def columns(axes: list[Axis], first: int, count: int) -> dict[str, Values]:
    """The numbers of some cells, the last axis varying fastest.

    **Arguments:** `axes`: the grid; `first`: the first of the cells; `count`: how many. Beyond the end the last is repeated.

    **Returns:** full name of a parameter -> its value in every cell.
    """
    cell = np.minimum(np.arange(first, first + count), size_of(axes) - 1)
    places = np.unravel_index(cell, [len(axis.values) for axis in axes]) if axes else ()
    return {axis.number: axis.values[place] for axis, place in zip(axes, places, strict=True)}


def cells_to_check(axes: list[Axis]) -> Iterator[dict[str, Values]]:
    """The cells that are looked at before anything runs, as columns: all of a small grid; of a large one every value of every
    axis, and all corners.

    Where a limit on one number rises or falls with the others, as those of the models do, it is broken in a corner if
    anywhere. All other cells are checked when their turn comes.
    """
    if size_of(axes) <= CHECKED_WHOLE:
        yield columns(axes, 0, size_of(axes))
        return
    for axis in axes:
        fixed = {other.number: np.repeat(other.values[:1], len(axis.values)) for other in axes}
        yield fixed | {axis.number: axis.values}
    corners = np.array(list(itertools.product(*((axis.values.min(), axis.values.max()) for axis in axes))))
    yield {axis.number: corner for axis, corner in zip(axes, corners.T, strict=True)}
