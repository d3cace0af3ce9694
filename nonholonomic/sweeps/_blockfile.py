"""A table's file while a sweep fills it in, block by block; a sweep that was killed resumes from it."""

import json
import os
import warnings
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

import numpy as np
from jaxtyping import Shaped

from ._checksum import block_checksum
from ._hdf5 import CHECKSUMS, FINISHED, Grid, axes_of, blank, read_stored, stored_array, write_grid
from .table import same_request

Values = Shaped[np.ndarray, "..."]


class BlockFile:
    """The arrays of a file under construction.

    A block's numbers and their checksum are handed to the disk first and the block's mark after them, all into space the
    file already has. So marked blocks are complete whenever the process dies, and whenever the machine does, as far as
    its disk keeps what it confirms. The file is written, not mapped into memory, where a full disk or a file cut short by
    someone else would kill the process.

    `attributes` are those in the file.
    """

    def __init__(self, path: Any, layout: "Layout"):
        """Open the file of an earlier run of the same request, or make a new one.

        **Arguments:**

        - `path`: the file.
        - `layout`: what the file holds.

        **Raises:** `OSError` that names the path if it cannot be read or written; `ValueError` that names the first
        difference if it holds the result of another request or of another version of this package.
        """
        try:
            self.path = Path(path)
        except TypeError:
            raise ValueError(f"path = {path!r} must be the path of a file") from None
        self._lock: Any = self._locked()
        self._stream: Any = None
        try:
            self._open(layout)
        except BaseException:
            self.close()
            raise

    def _open(self, layout: "Layout") -> None:
        # Only files need it.
        import h5py

        if not self.path.exists():
            layout.write(self.path)
        grid = read_stored(self.path)
        self._check(grid, layout)
        self.attributes, self._header, self._finished = grid.attributes, grid.header, grid.finished
        self._values = layout.rows(grid.variables)
        with h5py.File(self.path, "r") as file:
            arrays = {name: stored_array(file, name) for name in (*layout.kinds, FINISHED, CHECKSUMS)}
            self._places = {name: (array.id.get_offset(), array.dtype) for name, array in arrays.items()}
        try:
            # Unbuffered, so that what could not be written is not tried again on closing.
            self._stream = self.path.open("r+b", buffering=0)
        except OSError as error:
            raise self._unwritable(error) from None
        for block in np.flatnonzero(grid.damaged):
            self._put(FINISHED, block, 0)

    def _locked(self) -> Any:
        """Keep other processes from filling in the same file; the system releases it when the process ends."""
        if fcntl is None:
            return None
        beside = self.path.with_name(self.path.name + ".lock")
        while True:
            try:
                lock = beside.open("w")
            except OSError as error:
                raise self._unwritable(error) from None
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.close()
                raise OSError(f"cannot write {self.path}: another process is writing it") from None
            # A process that has just closed the file has removed its lock, perhaps after we opened it.
            try:
                if os.path.samestat(os.fstat(lock.fileno()), beside.stat()):
                    return lock
            except FileNotFoundError:
                pass
            lock.close()

    def close(self) -> None:
        """Let other processes have the file."""
        if self._stream is not None:
            self._stream.close()
        if self._lock is not None:
            self.path.with_name(self.path.name + ".lock").unlink(missing_ok=True)
            self._lock.close()

    def values(self) -> dict[str, Values]:
        """The numbers that the file held when it was opened, variable by variable, cells along the first axis."""
        return self._values

    def _check(self, grid: Grid, layout: "Layout") -> None:
        ours, theirs = (
            json.loads(str(attributes.get("versions", "{}"))) for attributes in (layout.attributes, grid.attributes)
        )
        difference = same_request(str(grid.attributes["request"]), layout.attributes["request"])
        if difference is None:
            for name, values in layout.coords.items():
                if name not in grid.coords or not np.array_equal(grid.coords[name], values):
                    difference = f"the axis {name} differs"
        if difference is None and list(grid.coords) != list(layout.coords):
            difference = f"its axes are {', '.join(grid.coords)}"
        if difference is None and theirs.get("nonholonomic") != ours.get("nonholonomic"):
            difference = f"nonholonomic is {theirs.get('nonholonomic')} there and {ours.get('nonholonomic')} here"
        if difference is not None:
            raise ValueError(
                f"{self.path} holds the result of another run: {difference}; give another path or remove the file"
            )
        kinds = {name: values.dtype for name, values in grid.variables.items()}
        if not np.array_equal(grid.firsts, layout.firsts) or kinds != layout.kinds or grid.inner != layout.inner:
            raise ValueError(
                f"{self.path} was not written by a sweep in {len(layout.firsts)} blocks; give another path"
            )
        if grid.damaged.any():
            warnings.warn(
                f"{self.path} is damaged: {grid.damaged.sum()} finished blocks do not match their checksums and are "
                "computed again",
                RuntimeWarning,
                stacklevel=6,
            )
        others = [name for name in ours if name not in ("nonholonomic", "python") and theirs.get(name) != ours[name]]
        if others and not grid.finished.all():
            versions = ", ".join(f"{name} {theirs.get(name)}, now {ours[name]}" for name in others)
            warnings.warn(f"{self.path} was begun with {versions}: digits may differ", RuntimeWarning, stacklevel=6)

    @property
    def finished(self) -> set[int]:
        """The blocks that need not be computed."""
        return set(np.flatnonzero(self._finished).tolist())

    def write(self, block: int, first: int, values: dict[str, Values]) -> None:
        """Write a block's values, for the cells from `first` on, and mark it finished.

        **Raises:** `OSError` that names the path if that fails; no block is then finished but those that were.
        """
        stored = {name: np.asarray(some, self._places[name][1]) for name, some in values.items()}
        for name, some in stored.items():
            self._put(name, first * int(np.prod(some.shape[1:], dtype=int)), some)
        self._put(CHECKSUMS, block, block_checksum(self._header, stored))
        self._sync()
        self._put(FINISHED, block, 1)
        self._sync()

    def _put(self, name: str, index: int, values: Any) -> None:
        """Write numbers into an array of the file, from an index on."""
        offset, kind = self._places[name]
        numbers = memoryview(np.asarray(values, kind).tobytes())
        try:
            self._stream.seek(offset + int(index) * kind.itemsize)
            while numbers:
                numbers = numbers[self._stream.write(numbers) :]
        except OSError as error:
            raise self._unwritable(error) from None

    def _sync(self) -> None:
        try:
            os.fsync(self._stream.fileno())
        except OSError as error:
            raise self._unwritable(error) from None

    def _unwritable(self, error: OSError) -> OSError:
        return OSError(f"cannot write {self.path}: {error.strerror}")


class Layout:
    """What a file under construction holds before anything is computed."""

    def __init__(
        self,
        coords: dict[str, Values],
        kinds: dict[str, Any],
        units: dict[str, str],
        words: dict[str, tuple[str, ...]],
        attributes: dict[str, Any],
        firsts: Any,
        inner: dict[str, tuple[str, ...]] | None = None,
    ):
        """Describe the grid.

        **Arguments:** as for `write_grid`, with `kinds`: variable -> dtype, and `firsts`: the first cell of each block.
        """
        self.coords, self.kinds, self.units, self.words = coords, kinds, units, words
        self.attributes, self.firsts, self.inner = attributes, firsts, inner or {}

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(self.coords[name]) for name in axes_of(self.coords, self.inner))

    def empty(self) -> dict[str, Values]:
        """The variables before anything is computed: not a number, or pending."""
        return {
            name: np.full(
                (*self.shape, *(len(self.coords[dim]) for dim in self.inner.get(name, ()))), blank(kind), kind
            )
            for name, kind in self.kinds.items()
        }

    def rows(self, variables: dict[str, Values]) -> dict[str, Values]:
        """The variables with all cells along one axis, the first."""
        return {name: values.reshape(-1, *values.shape[len(self.shape) :]) for name, values in variables.items()}

    def write(self, path: Path) -> None:
        """Make the file."""
        write_grid(path, self.coords, self.empty(), self.units, self.attributes, self.words, self.firsts, self.inner)
