"""The layout of a table: everything except its numbers, and the division of its cells into chunks."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Shaped

Values = Shaped[np.ndarray, "..."]

#: The name of the checksum of a user's equations in a request.
EQUATIONS = "equations"

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

    @property
    def axes(self) -> list[str]:
        """The coordinates that are axes of the grid."""
        return axes_of(self.coords, self.inner)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the grid."""
        return tuple(len(self.coords[name]) for name in self.axes)

    @property
    def cells(self) -> int:
        """Number of cells of the grid."""
        return math.prod(self.shape)

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.cells // self.chunk)

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

    def shaped(self, name: str, values: Values) -> Values:
        """A variable in the shape of the grid, with words instead of codes."""
        values = values.reshape((*self.shape, *self.inner_shape(name)))
        return np.array([*self.words[name], UNREACHED])[values] if name in self.words else values

    def bytes_of_cells(self, cells: int) -> int:
        """Memory for the numbers of some cells [bytes]."""
        return cells * sum(kind.itemsize * math.prod(self.inner_shape(name)) for name, kind in self.kinds.items())


def axes_of(coords: dict[str, Values], inner: dict[str, tuple[str, ...]]) -> list[str]:
    """The coordinates that are axes of the grid, without those of the variables' additional dimensions."""
    inner_dims = {dim for dims in inner.values() for dim in dims}
    return [name for name in coords if name not in inner_dims]


def boxes(shape: tuple[int, ...], first: int, end: int) -> Iterator[tuple[slice, ...]]:
    """Slices of an array that contain its elements with the flat indices from `first` to `end` - 1, in order."""
    if not shape:
        yield ()
        return
    row = math.prod(shape[1:])
    while first < end:
        start, offset = divmod(first, row)
        rows = (end - first) // row
        if offset == 0 and rows:
            yield (slice(start, start + rows), *(slice(0, size) for size in shape[1:]))
            first += rows * row
        else:
            stop = min(end, (start + 1) * row)
            for box in boxes(shape[1:], offset, offset + stop - first):
                yield (slice(start, start + 1), *box)
            first = stop
