"""The file of a table: HDF5 with dimension scales, as in netCDF-4, so that xarray opens it with named coordinates.

Words, such as a cell's status, are stored as bytes with the attributes `flag_values` and `flag_meanings` (CF
conventions). Checksums cover every number: HDF5 has one for the description of the arrays, and the group `checksums`,
which xarray does not show, has one for each chunk of each variable. A file appears only when it is complete.
"""

import contextlib
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..integration.problem import FORMER_WORDS
from ..validation import as_path, replacing
from .grid import PENDING, UNREACHED, Layout, Values, boxes

if TYPE_CHECKING:
    import h5py

#: The group of the checksums.
CHECKSUMS = "checksums"

#: The attribute of a table with the long names of its variables; in a file, each variable has its own, as in CF.
LONG_NAMES, LONG_NAME = "long_names", "long_name"

#: The file's attribute that names the dimensions of variables other than those of the grid.
INNER = "inner"

#: Variables of tables larger than this [bytes] are read only when needed.
MAX_BYTES_IN_MEMORY = 1 << 27

#: No compression of HDF5 makes numbers smaller by a greater factor.
MAX_COMPRESSION = 2000


#: Endings of files in other formats, which a table's file must not have.
OTHER_FORMATS = (".csv", ".tsv", ".txt", ".dat", ".xls", ".xlsx", ".ods", ".json", ".npy", ".npz", ".mat", ".pkl")
OTHER_FORMATS += (".parquet", ".html", ".htm", ".png", ".jpg", ".svg", ".pdf", ".gif", ".mp4", ".webm", ".zip", ".zarr")


def table_path(path: Any) -> Path:
    """The path of a table's file.

    **Raises:** `ValueError` for a value that is no path, or whose ending belongs to another format.
    """
    file = as_path(path, "path")
    if file.suffix.lower() in OTHER_FORMATS:
        raise ValueError(
            f"path = {str(path)!r} must end in .h5: the file is in HDF5; for a CSV or Excel file, use to_dataframe().to_csv or "
            ".to_excel"
        )
    return file


def write_file(
    path: Path, layout: Layout, chunks: Iterable[tuple[int, dict[str, Values]]], folder: Path | None = None
) -> None:
    """Write a table completely or not at all; an existing file is replaced.

    **Arguments:** `chunks`: the index of a chunk and its cells by variable, in any order; without chunks, the file only
    describes the table. `folder`: as for `replacing`.

    **Raises:** `OSError` that names the path if it cannot be written.
    """
    # The import takes a tenth of a second, and most processes do not need it.
    import h5py

    with replacing(path, folder) as scratch, scratch.open("r+b", buffering=0) as disk:
        stream = Stream(disk)
        with h5py.File(stream, "w", libver=("v110", "v110"), track_order=True) as file:
            _describe(file, layout)
            group = file.create_group(CHECKSUMS)
            group.attrs["block"] = layout.chunk
            sums = {name: np.zeros(layout.chunks, np.uint32) for name in layout.kinds}
            for chunk, values in chunks:
                for name, kind in layout.kinds.items():
                    cells = np.ascontiguousarray(values[name], kind)
                    sums[name][chunk] = zlib.crc32(cells.data)
                    _put(_dataset(file, name), cells, layout.shape, *layout.ends(chunk))
                stream.check()
            for name in layout.coords:
                sums[name] = np.array([zlib.crc32(_dataset(file, name)[()])], np.uint32)
            for name, values in sums.items():
                group.create_dataset(name, data=values)
        stream.check()


class Stream:
    """A stream that postpones errors until `check`: HDF5 cannot close a file after a write to a full disk has
    failed."""

    def __init__(self, disk: Any):
        """Set the file to write to."""
        self._disk, self._error = disk, None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._disk, name)

    def write(self, data: Any) -> int:
        """Write all data, unless an earlier call has failed."""
        remainder = memoryview(data)
        while self._error is None and remainder:
            with self._noting():
                remainder = remainder[self._disk.write(remainder) :]
        return len(data)

    def truncate(self, size: int) -> int:
        """Change the length of the file, unless an earlier call has failed."""
        if self._error is None:
            with self._noting():
                self._disk.truncate(size)
        return size

    @contextlib.contextmanager
    def _noting(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._error = error

    def check(self) -> None:
        """Raise the postponed error, if any."""
        if self._error is not None:
            raise self._error


def _put(array: "h5py.Dataset", values: Values, shape: tuple[int, ...], first: int, end: int) -> None:
    start = 0
    for box in boxes(shape, first, end):
        sizes = [part.stop - part.start for part in box]
        stop = start + int(np.prod(sizes, dtype=int))
        array[box] = values[start:stop].reshape((*sizes, *values.shape[1:]))
        start = stop


def _describe(file: "h5py.File", layout: Layout) -> None:
    """Write everything in a table except the numbers of its variables."""
    attributes: dict[str, Any] = (
        layout.attributes | ({INNER: layout.inner} if layout.inner else {}) | {"Conventions": "CF-1.10"}
    )
    long_names = json.loads(attributes.pop(LONG_NAMES, "{}"))
    for name, value in attributes.items():
        _set(file, name, value if isinstance(value, str | int | float) else json.dumps(value))
    meanings = dict(layout.words)
    for name, values in layout.coords.items():
        if values.dtype.kind == "U":
            meanings[name], values = tuple(values.tolist()), np.arange(len(values), dtype=np.int8)
        file.create_dataset(name, data=values).make_scale(name)
    for name, kind in layout.kinds.items():
        array = file.create_dataset(name, shape=layout.shape + layout.inner_shape(name), dtype=kind)
        for axis, coordinate in enumerate((*layout.axes, *layout.inner.get(name, ()))):
            array.dims[axis].attach_scale(file[coordinate])
    for name in (*layout.coords, *layout.kinds):
        if name in meanings:
            file[name].attrs["flag_values"] = np.arange(len(meanings[name]), dtype=np.int8)
            _set(file[name], "flag_meanings", " ".join(meanings[name]))
        else:
            _set(file[name], "units", layout.units.get(name, "1"))
        if name in long_names:
            _set(file[name], LONG_NAME, long_names[name])


def _set(node: Any, name: str, value: Any) -> None:
    """Set an attribute; a string is stored at its own length, because no checksum covers HDF5's strings of variable length."""
    # Only files need it.
    import h5py

    if isinstance(value, str):
        data = value.encode()
        node.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))
    else:
        node.attrs.create(name, value)


def _dataset(group: "h5py.Group", name: str) -> "h5py.Dataset":
    """A variable.

    **Raises:** `ValueError` for a group by that name.
    """
    # Only files need it.
    import h5py

    array = group[name]
    if not isinstance(array, h5py.Dataset):
        raise ValueError(f"{name} is not an array")
    return array


def _values(group: "h5py.Group", name: str, box: Any = ()) -> Values:
    """The numbers of a variable, or those within a box.

    **Raises:** `ValueError` if there cannot be as many numbers in the file: reading them could take all memory.
    """
    array = _dataset(group, name)
    if array.nbytes > MAX_COMPRESSION * group.file.id.get_filesize():
        raise ValueError(f"{name} has {array.size} numbers, more than fit into the file")
    return np.asarray(array[box])


def _attribute(node: Any, name: str) -> Any:
    """An attribute, a number or a string."""
    value = node.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


def _text(node: Any, name: str) -> str:
    """An attribute that is a string."""
    value = _attribute(node, name)
    if not isinstance(value, str):
        raise ValueError(f"the attribute {name} is not a text")
    return value


class Stored:
    """A table in its file.

    `path`: the file; `layout`: its contents. Numbers are checked against their checksums when they are read.
    """

    def __init__(self, path: Path):
        """Open a file and read its layout.

        **Raises:** `OSError` that names the path if it cannot be read or holds no table.
        """
        if not path.exists():
            raise FileNotFoundError(f"no such file: {path}")
        if path.is_dir():
            raise OSError(f"cannot read {path}: it is a folder")
        self.path = path
        with self._opened() as file:
            self.layout, self._sums = _contents(file)

    def whole(self, name: str) -> Values:
        """A variable of all cells, which are along the first axis.

        **Raises:** `OSError` that names the path if numbers do not match their checksums.
        """
        with self._opened() as file:
            values, sums = _values(file, name), self._sums[name]
            if name in self.layout.words and np.any((values < PENDING) | (values >= len(self.layout.words[name]))):
                raise ValueError(f"{name} has codes without a word")
        values = values.reshape(-1, *self.layout.inner_shape(name))
        damaged = 0
        for chunk in range(self.layout.chunks):
            first, end = self.layout.ends(chunk)
            damaged += zlib.crc32(np.ascontiguousarray(values[first:end]).data) != sums[chunk]
        if damaged:
            raise OSError(
                f"cannot read {self.path}: it is damaged: {damaged} of its {self.layout.chunks} chunks do not match their "
                "checksums"
            )
        return values

    def chunk(self, chunk: int) -> dict[str, Values] | None:
        """The variables of one chunk; `None` if its numbers do not match their checksums."""
        first, end = self.layout.ends(chunk)
        variables = {}
        with self._opened() as file:
            for name in self.layout.kinds:
                parts = [_values(file, name, box) for box in boxes(self.layout.shape, first, end)]
                shape = self.layout.inner_shape(name)
                variables[name] = np.concatenate([part.reshape(-1, *shape) for part in parts])
                if zlib.crc32(variables[name].data) != self._sums[name][chunk]:
                    return None
        return variables

    @contextlib.contextmanager
    def _opened(self) -> Iterator["h5py.File"]:
        # Only files need it.
        import h5py

        try:
            with h5py.File(self.path, "r") as file:
                yield file
        # What a damaged file makes HDF5 and NumPy raise can be of any kind.
        except Exception as error:
            reason = f"it is not a table of nonholonomic, or it is damaged ({error or type(error).__name__})"
            raise OSError(f"cannot read {self.path}: {reason}") from None


def _contents(file: "h5py.File") -> tuple[Layout, dict[str, Values]]:
    """A file's layout, and its checksums by variable."""
    coords, kinds, units, words, shapes, long_names = {}, {}, {}, {}, {}, {}
    if "request" not in file.attrs:
        raise ValueError("it names no request")
    attributes = {name: _attribute(file, name) for name in file.attrs if name not in ("Conventions", LONG_NAMES)}
    for name in ("request", "versions"):
        if not isinstance(json.loads(attributes.get(name, "{}")), dict):
            raise ValueError(f"the attribute {name} is not a dictionary")
    inner = {name: tuple(dims) for name, dims in json.loads(attributes.pop(INNER, "{}")).items()}
    dims = [*json.loads(attributes["axes"]), *(dim for dims in inner.values() for dim in dims)]
    # Only files need it.
    import h5py

    checksums = file[CHECKSUMS]
    if not isinstance(checksums, h5py.Group):
        raise ValueError(f"{CHECKSUMS} is not a group")
    sums = {name: _values(checksums, name) for name in map(str, checksums)}
    for name in (*dict.fromkeys(dims), *(name for name in map(str, file) if name not in (*dims, CHECKSUMS))):
        array = _dataset(file, name)
        if LONG_NAME in array.attrs:
            long_names[name] = _text(array, LONG_NAME)
        if "flag_meanings" in array.attrs:
            meanings = _text(array, "flag_meanings").split()
            # Words of earlier versions are converted to current ones.
            words[name] = (
                tuple(FORMER_WORDS.get(word, word) for word in meanings) if name == "status" else tuple(meanings)
            )
        else:
            units[name] = _text(array, "units")
        if name in dims:
            coords[name] = _values(file, name)
            if coords[name].ndim != 1:
                raise ValueError(f"{name} is not a list of numbers")
            if [zlib.crc32(coords[name])] != sums[name].tolist():
                raise ValueError(f"{name} does not match its checksum")
        else:
            kinds[name], shapes[name] = array.dtype, array.shape
    if long_names:
        attributes[LONG_NAMES] = json.dumps(long_names, sort_keys=True)
    coords = {name: np.array(words.pop(name))[values] if name in words else values for name, values in coords.items()}
    layout = Layout(coords, kinds, units, attributes, words, inner, int(_attribute(checksums, "block")))
    if layout.chunk < 1:
        raise ValueError(f"its chunks have {layout.chunk} cells")
    for name, shape in shapes.items():
        if shape != layout.shape + layout.inner_shape(name) or len(sums[name]) != layout.chunks:
            raise ValueError(f"{name} has the wrong shape")
    return layout, sums


class StoredVariables(Mapping[str, Values]):
    """The variables of a table that stays in its file: each is read when needed."""

    def __init__(self, stored: Stored):
        """Set the location of the variables."""
        self.stored = stored

    def __getitem__(self, name: str) -> Values:
        if name not in self.stored.layout.kinds:
            raise KeyError(name)
        return self.stored.layout.shaped(name, self.stored.whole(name))

    def __contains__(self, name: object) -> bool:
        return name in self.stored.layout.kinds

    def __iter__(self) -> Iterator[str]:
        return iter(self.stored.layout.kinds)

    def __len__(self) -> int:
        return len(self.stored.layout.kinds)


def coded(values: Values, words: tuple[str, ...]) -> tuple[Values, tuple[str, ...]]:
    """Words as codes, and the words in the order of their codes, beginning with the given ones."""
    new_words = (word for word in dict.fromkeys(values.ravel().tolist()) if word not in (*words, UNREACHED))
    words = (*words, *new_words)
    codes = {word: code for code, word in enumerate(words)} | {UNREACHED: PENDING}
    return np.vectorize(codes.__getitem__, otypes=[np.int8])(values), words
