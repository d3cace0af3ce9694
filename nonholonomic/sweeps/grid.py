"""The grid of a sweep: its axes, the layout of its results, and its tasks."""

import functools
import itertools
import json
import math
import platform
from collections.abc import Iterator
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

from .. import __version__
from ..validation import require

# The layout of a table: everything except its numbers, and the division of its cells into chunks.

Values = Shaped[np.ndarray, "..."]
if TYPE_CHECKING:
    Tabulated = Values
else:
    #: A variable of a table: an array or, for words of a table of one cell, a NumPy string.
    Tabulated = Values | np.str_

#: The name of the checksum of a user's equations in a request.
EQUATIONS = "equations"

#: How texts and pictures show a table, in a request and in the attributes: in which units; with which remark on the statuses;
#: and, for first and last times, the words for cells whose event holds at the end, and for those where it may have held before.
SHOWN = SHOWN_IN, REMARK, FOR_A_TIME = "shown_in", "remark", "for_a_time"

#: Code and word for a cell that has not been computed.
PENDING, UNREACHED = -1, "pending"


class Layout(NamedTuple):
    """A table without its numbers.

    `kinds`: variable -> dtype; `chunk`: number of cells in every chunk but the last; the other fields are as in
    `Table`.
    """

    coords: dict[str, Values]
    kinds: dict[str, np.dtype]
    units: dict[str, str]
    attributes: dict[str, Any]
    words: dict[str, tuple[str, ...]]
    inner: dict[str, tuple[str, ...]]
    chunk: int
    long_names: dict[str, str]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return tuple(len(self.coords[name]) for name in axes_of(self.coords, self.inner))

    @property
    def cells(self) -> int:
        """Number of cells of the grid."""
        return math.prod(self.shape)

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.cells // self.chunk)

    @property
    def versions(self) -> dict[str, str]:
        """The versions with which the table was computed."""
        return json.loads(self.attributes.get("versions", "{}"))

    def ends(self, chunk: int) -> tuple[int, int]:
        """The index of the first cell of a chunk, and of the cell after its last."""
        return chunk * self.chunk, min((chunk + 1) * self.chunk, self.cells)

    def size(self, chunk: int) -> int:
        """Number of cells in a chunk."""
        first, end = self.ends(chunk)
        return end - first

    def inner_shape(self, name: str) -> tuple[int, ...]:
        """Shape of a variable's value for one cell."""
        return tuple(len(self.coords[dim]) for dim in self.inner.get(name, ()))

    def empty(self, cells: int, status: int = PENDING) -> dict[str, Values]:
        """Variables without results, with cells along the first axis; variables of words are filled with `status`."""
        variables = {}
        for name, kind in self.kinds.items():
            value = status if name in self.words else np.nan if kind.kind == "f" else PENDING
            variables[name] = np.full((cells, *self.inner_shape(name)), value, kind)
        return variables

    def shaped(self, name: str, values: Values) -> Tabulated:
        """A variable in the shape of the grid, with words instead of codes."""
        values = values.reshape((*self.shape, *self.inner_shape(name)))
        return np.array([*self.words[name], UNREACHED])[values] if name in self.words else values

    def bytes_of_cells(self, cells: int, *names: str) -> int:
        """Memory for the numbers of some cells [bytes], of the named variables or of all."""
        sizes = {name: self.kinds[name].itemsize * math.prod(self.inner_shape(name)) for name in names or self.kinds}
        return cells * sum(sizes.values())


def attributes_of(request: dict[str, object], axes: list[str], default: Any = None) -> dict[str, str]:
    """The attributes of a table: what was computed, in JSON, over which axes, and with which versions; and how it is shown.
    **Arguments:** `default`: as for `json.dumps`."""
    words = json.dumps({name: value for name, value in request.items() if name not in SHOWN}, default=default)
    shown = {name: json.dumps(request[name]) for name in SHOWN if request.get(name)}
    return {"request": words, "axes": json.dumps(axes), "versions": json.dumps(versions())} | shown


def axes_of(coords: dict[str, Values], inner: dict[str, tuple[str, ...]]) -> list[str]:
    """The coordinates that are axes of the grid, without those of the variables' additional dimensions."""
    inner_dims = {dim for dims in inner.values() for dim in dims}
    return [name for name in coords if name not in inner_dims]


# A grid of named axes: its cells, and the parameters of each cell.

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
    kind: type | str
    words: tuple[str, ...] | None = None
    inner: tuple[str, ...] = ()
    long_name: str = ""


def axis(name: str, number: str, unit: str, values: object, long_name: str = "") -> Axis:
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
    return math.prod(len(axis.values) for axis in axes)


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


@functools.cache
def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    packages = ("jax", "jaxlib", "diffrax", "numpy")
    return {"python": platform.python_version(), "nonholonomic": __version__} | {
        name: version(name) for name in packages
    }
