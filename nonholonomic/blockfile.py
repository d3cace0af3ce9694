"""A table's file while a sweep fills it in, block by block; a sweep that was killed resumes from it."""

from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

import h5py
import numpy as np
from jaxtyping import Shaped

from .hdf5 import BLOCKS, PENDING, read_grid, stored_array, write_grid
from .table import same_request

Values = Shaped[np.ndarray, "..."]


class BlockFile:
    """The arrays of a file under construction, mapped into memory.

    A block's numbers are written first and its mark after them, both into space the file already has: whenever the process
    dies, the blocks that are marked are complete.
    """

    def __init__(self, path: Any, layout: "Layout"):
        """Open the file of an earlier run of the same request, or make a new one.

        **Arguments:**

        - `path`: the file.
        - `layout`: what the file holds.

        **Raises:** `OSError` that names the path if it cannot be read or written; `ValueError` that names the first
        difference if it holds the result of another request.
        """
        try:
            self.path = Path(path)
        except TypeError:
            raise ValueError(f"path = {path!r} must be the path of a file") from None
        self._lock, self._maps = self._locked(), {}
        try:
            self._open(layout)
        except BaseException:
            self.close()
            raise

    def _open(self, layout: "Layout") -> None:
        if self.path.exists():
            self._check(layout)
        else:
            layout.write(self.path)
        self.cells = layout.cells
        with h5py.File(self.path, "r") as file:
            arrays = {name: stored_array(file, name) for name in (*layout.kinds, BLOCKS)}
            places = {name: (array.id.get_offset(), array.dtype) for name, array in arrays.items()}
            blocks = len(arrays[BLOCKS])
        try:
            self._maps = {
                name: np.memmap(self.path, dtype, "r+", offset, (blocks if name == BLOCKS else self.cells,))
                for name, (offset, dtype) in places.items()
            }
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None

    def _locked(self) -> Any:
        """Keep other processes from filling in the same file; the system lets go of it when the process ends."""
        if fcntl is None:
            return None
        beside = self.path.with_name(self.path.name + ".lock")
        try:
            lock = beside.open("w")
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            raise OSError(f"cannot write {self.path}: another process is writing it") from None
        return lock

    def close(self) -> None:
        """Let other processes have the file."""
        self._maps.clear()
        if self._lock is not None:
            self.path.with_name(self.path.name + ".lock").unlink(missing_ok=True)
            self._lock.close()

    def values(self) -> dict[str, Values]:
        """The numbers in the file, variable by variable, cells in a row."""
        return {name: np.array(values) for name, values in self._maps.items() if name != BLOCKS}

    def _check(self, layout: "Layout") -> None:
        coords, _, _, attributes, _ = read_grid(self.path)
        difference = same_request(str(attributes["request"]), layout.attributes["request"])
        if difference is None:
            for name, values in layout.coords.items():
                if name not in coords or not np.array_equal(coords[name], values):
                    difference = f"the axis {name} differs"
        if difference is None and list(coords) != list(layout.coords):
            difference = f"its axes are {', '.join(coords)}"
        if difference is not None:
            raise ValueError(
                f"{self.path} holds the result of another run: {difference}; give another path or remove the file"
            )
        with h5py.File(self.path, "r") as file:
            if BLOCKS not in file or len(stored_array(file, BLOCKS)) != layout.blocks:
                raise ValueError(f"{self.path} was not written by a sweep in {layout.blocks} blocks; give another path")

    @property
    def finished(self) -> set[int]:
        """The blocks that need not be computed."""
        return set(np.flatnonzero(self._maps[BLOCKS]).tolist())

    def write(self, block: int, first: int, values: dict[str, Values]) -> None:
        """Write a block's values, for the cells from `first` on, and mark it finished."""
        for name, some in values.items():
            target = self._maps[name]
            target[first : first + len(some)] = some
            target.flush()
        self._maps[BLOCKS][block] = 1
        self._maps[BLOCKS].flush()


class Layout:
    """What a file under construction holds before anything is computed."""

    def __init__(
        self,
        coords: dict[str, Values],
        kinds: dict[str, Any],
        units: dict[str, str],
        words: dict[str, tuple[str, ...]],
        attributes: dict[str, Any],
        blocks: int,
    ):
        """State the grid.

        **Arguments:** as for `write_grid`, with `kinds`: variable -> dtype.
        """
        self.coords, self.kinds, self.units, self.words = coords, kinds, units, words
        self.attributes, self.blocks = attributes, blocks

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(values) for values in self.coords.values())

    @property
    def cells(self) -> int:
        return int(np.prod(self.shape, dtype=int))

    def empty(self) -> dict[str, Values]:
        """The variables before anything is computed: not a number, or pending."""
        return {
            name: np.full(self.shape, np.nan if np.dtype(kind).kind == "f" else PENDING, kind)
            for name, kind in self.kinds.items()
        }

    def write(self, path: Path) -> None:
        """Make the file."""
        write_grid(path, self.coords, self.empty(), self.units, self.attributes, self.words, self.blocks)
