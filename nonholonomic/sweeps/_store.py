"""The file of a table, finished or not.

A table's file is HDF5 with dimension scales, as in netCDF-4, so that xarray opens it with named coordinates. Words, such as
a cell's status, are stored as bytes with the attributes `flag_values` and `flag_meanings` (CF conventions). This package reads
only the numbers, and the layout of the table from an attribute of the group `checksums`, which xarray does not show. Checksums
cover everything: HDF5 has one for the description of the arrays, and the group has one for each chunk of each variable. A file
appears only when it is complete.

A sweep fills a file in a folder beside it, chunk by chunk, so that a killed sweep can resume. The file has room for all
numbers from the beginning, and HDF5 never writes it again. A chunk is finished when it is marked so, in one byte, after its
numbers and checksums are on disk.
"""

import contextlib
import io
import json
import math
import os
import platform
import re
import shutil
import zlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

import numpy as np

from ..validation import as_path, real_path, replacing, sync_folder, warn
from .grid import EQUATIONS, PENDING, Layout, Values, axes_of

if TYPE_CHECKING:
    import h5py

#: The group of the checksums.
CHECKSUMS = "checksums"

#: The array of a byte for each chunk, in the same group: not 0 when the chunk is finished.
FINISHED = "finished chunks"

#: The attributes of this group with the layout of the table, and its checksum: that of HDF5 does not cover a long attribute.
LAYOUT, OF_LAYOUT = "layout", "checksum of the layout"

#: Variables of tables larger than this [bytes] are read only when needed.
MAX_BYTES_IN_MEMORY = 1 << 27


#: Endings of files in other formats, which a table's file must not have.
OTHER_FORMATS = (".csv", ".tsv", ".txt", ".dat", ".xls", ".xlsx", ".ods", ".json", ".npy", ".npz", ".mat", ".pkl")
OTHER_FORMATS += (".parquet", ".html", ".htm", ".png", ".jpg", ".svg", ".pdf", ".gif", ".mp4", ".webm", ".zip", ".zarr")


def table_path(path: object) -> Path:
    """The path of a table's file.

    **Raises:** `ValueError` for a value that is no path, or whose ending belongs to another format.
    """
    file = as_path(path, "path")
    if file.suffix.lower() in OTHER_FORMATS:
        advice = "for a CSV or Excel file, use to_dataframe().to_csv or .to_excel, or to_dataframe(unit='deg')"
        raise ValueError(f"path = {str(path)!r} must end in .h5: the file is in HDF5; {advice}")
    return file


class Stream(io.FileIO):
    """A file that keeps the first error until `check`: HDF5 cannot close a file after a write to a full disk has failed."""

    error: OSError | None = None

    def write(self, data) -> int:
        """Write all data, bytes or a view of an array, unless an earlier call has failed."""
        remainder = memoryview(data)
        try:
            while self.error is None and remainder:
                remainder = remainder[super().write(remainder) :]
        except OSError as error:
            self.error = error
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Change the length of the file, unless an earlier call has failed."""
        try:
            return super().truncate(size) if self.error is None else size or 0
        except OSError as error:
            self.error = error
            return size or 0

    def check(self, synced: bool = False) -> None:
        """Raise the first error, if any; `synced`: otherwise, wait until all data are on disk."""
        if self.error is not None:
            raise self.error
        if synced:
            os.fsync(self.fileno())


def write_file(path: Path, layout: Layout, chunks: Iterable[tuple[int, dict[str, Values] | None]]) -> None:
    """Write a table completely or not at all; an existing file is replaced.

    **Arguments:** `chunks`: the index of a chunk and its cells by variable, in any order; other chunks, and those with
    `None`, stay unfinished.

    **Raises:** `OSError` that names the path if it cannot be written; `ValueError` for words that a file cannot hold.
    """
    with replacing(path) as scratch, Stream(scratch, "r+b") as stream:
        places = _describe(stream, layout)
        for chunk, values in chunks:
            if values is not None:
                write_chunk(stream, layout, places, chunk, values)
                stream.check()


def write_chunk(
    stream: Stream, layout: Layout, places: dict[str, int], chunk: int, values: dict[str, Values], synced: bool = False
) -> None:
    """Write the numbers of a chunk and their checksums, and mark it as finished when they are on disk; the caller checks
    the stream for the mark.

    **Arguments:** `places`: where the file has the numbers of its arrays; `synced`: whether to wait for the disk.

    **Raises:** `OSError` if that fails; `ValueError`, before anything is written, if a variable has the wrong shape.
    """
    first, end = layout.ends(chunk)
    variables = {name: np.ascontiguousarray(values[name], kind) for name, kind in layout.kinds.items()}
    for name, cells in variables.items():
        # Longer data would overwrite other chunks and the description of the file.
        shape = (end - first, *layout.inner_shape(name))
        if cells.shape != shape:
            raise ValueError(f"{name} of cells {first} to {end - 1} must have the shape {shape}, not {cells.shape}")
    for name, cells in variables.items():
        stream.seek(places[name] + layout.bytes_of_cells(first, name))
        stream.write(cells.tobytes())
        stream.seek(places[f"{CHECKSUMS}/{name}"] + 4 * chunk)
        stream.write(zlib.crc32(cells.data).to_bytes(4, "little"))
    stream.check(synced)
    stream.seek(places[f"{CHECKSUMS}/{FINISHED}"] + chunk)
    stream.write(b"\xff")


def _describe(stream: Stream, layout: Layout) -> dict[str, int]:
    """Write everything in a table except the numbers of its variables; where the file has room for these."""
    # The import takes a tenth of a second, and most processes do not need it.
    import h5py

    def describe(node: h5py.HLObject, name: str, value: object) -> None:
        """Set an attribute; a string has its own length, because no checksum covers HDF5's strings of variable length."""
        if isinstance(value, str):
            data = value.encode()
            node.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", max(1, len(data))))
        else:
            node.attrs.create(name, value)

    with h5py.File(stream, "w", libver=("v110", "v110"), track_order=True) as file:
        for name, value in (layout.attributes | {"Conventions": "CF-1.10"}).items():
            describe(file, name, value if isinstance(value, str | int | float) else json.dumps(value))
        checksums = file.create_group(CHECKSUMS)
        words = {name: values.tolist() for name, values in layout.coords.items() if values.dtype.kind == "U"}
        names = {"coords": dict.fromkeys(layout.coords) | words, "kinds": list(layout.kinds)}
        text = json.dumps(layout._asdict() | names)
        describe(checksums, LAYOUT, text)
        describe(checksums, OF_LAYOUT, zlib.crc32(text.encode()))
        meanings = layout.words | words
        for name, values in layout.coords.items():
            codes = np.arange(len(values), dtype=np.int8)
            scale = file.create_dataset(name, data=codes if name in words else values)
            scale.make_scale(name)
            checksums.create_dataset(name, data=np.array([zlib.crc32(scale[()])], "<u4"))
        for name, kind in layout.kinds.items():
            array = file.create_dataset(name, shape=layout.shape + layout.inner_shape(name), dtype=kind)
            for axis, coordinate in enumerate((*axes_of(layout.coords, layout.inner), *layout.inner.get(name, ()))):
                array.dims[axis].attach_scale(file[coordinate])
            if array.size:
                # The first number that HDF5 writes makes room for all.
                array[(0,) * array.ndim] = 0
            checksums.create_dataset(name, data=np.zeros(layout.chunks, "<u4"))
        checksums.create_dataset(FINISHED, data=np.zeros(layout.chunks, np.uint8))
        for name in (*layout.coords, *layout.kinds):
            if name in meanings:
                file[name].attrs["flag_values"] = np.arange(len(meanings[name]), dtype=np.int8)
                text = " ".join(meanings[name])
                if text.split() != list(meanings[name]):
                    raise ValueError(f"the words of {name} must not have spaces or be empty: {tuple(meanings[name])}")
                describe(file[name], "flag_meanings", text)
            else:
                describe(file[name], "units", layout.units.get(name, "1"))
            if name in layout.long_names:
                describe(file[name], "long_name", layout.long_names[name])
        places = _places(file)
    stream.check()
    return places


def _places(file: "h5py.File") -> dict[str, int]:
    """Where a file has the numbers of its arrays, by name [bytes].

    **Raises:** `ValueError` for an array that is not there in one piece: reading more numbers could take all memory.
    """
    places, checksums = {}, cast("h5py.Group", file[CHECKSUMS])
    for name in (*(name for name in file if name != CHECKSUMS), *(f"{CHECKSUMS}/{name}" for name in checksums)):
        array = cast("h5py.Dataset", file[name])
        place = array.id.get_offset()
        if array.size and (place is None or place + array.nbytes > file.id.get_filesize()):
            raise ValueError(f"{name} has {array.size} numbers, more than fit into the file")
        places[name] = place or 0
    return places


class Stored(Mapping[str, Values]):
    """The variables of a table that stays in its file: each is read, and checked against its checksums, when needed.

    `path`: the file; `layout`: its contents; `places`: where its numbers are; `finished`: the finished chunks.
    """

    def __init__(self, path: Path, is_unfinished: bool = False):
        """Open the file of a table, or of an unfinished table, and read its layout.

        **Raises:** `OSError` that names the path of the table if it cannot be read or holds no table.
        """
        # The import takes a tenth of a second, and most processes do not need it.
        import h5py

        self.path = folder_of(path) / UNFINISHED if is_unfinished else path
        self._title = f"{path}, unfinished in {folder_of(path)}" if is_unfinished else f"{path}"
        if not self.path.exists():
            raise FileNotFoundError(f"no such file: {path}")
        if self.path.is_dir():
            raise OSError(f"cannot read {self._title}: it is a folder")
        try:
            with h5py.File(self.path, "r") as file:
                self.layout, self._sums, self.places = _contents(file)
        # What a damaged file makes HDF5 and NumPy raise can be of any kind.
        except Exception as error:
            reason = f"it is not a table of nonholonomic, or it is damaged ({error or type(error).__name__})"
            raise OSError(f"cannot read {self._title}: {reason}") from None
        self.finished = set(np.flatnonzero(self._sums[FINISHED]).tolist())

    def __getitem__(self, name: str) -> Values:
        return self.layout.shaped(name, self.whole(name))

    # Of a `Mapping`, it would read the numbers.
    def __contains__(self, name: object) -> bool:
        return name in self.layout.kinds

    def __iter__(self) -> Iterator[str]:
        return iter(self.layout.kinds)

    def __len__(self) -> int:
        return len(self.layout.kinds)

    def whole(self, name: str) -> Values:
        """A variable of all cells, which are along the first axis; as `Layout.empty` where chunks are not finished.

        **Raises:** `OSError` that names the path if numbers do not match their checksums.
        """
        values, damaged = self._cells(name, 0, self.layout.cells), 0
        for chunk in range(self.layout.chunks):
            part = values[slice(*self.layout.ends(chunk))]
            if chunk in self.finished:
                damaged += zlib.crc32(part.data) != self._sums[name][chunk]
            else:
                part[...] = self.layout.empty(1)[name]
        if damaged:
            reason = f"{damaged} of its {self.layout.chunks} chunks do not match their checksums"
            raise OSError(f"cannot read {self._title}: it is damaged: {reason}")
        if name in self.layout.words and np.any((values < PENDING) | (values >= len(self.layout.words[name]))):
            raise OSError(f"cannot read {self._title}: it is damaged: {name} has codes without a word")
        return values

    def chunk(self, chunk: int) -> dict[str, Values] | None:
        """The variables of one chunk; `None` if its numbers cannot be read or do not match their checksums."""
        try:
            variables = {name: self._cells(name, *self.layout.ends(chunk)) for name in self.layout.kinds}
        except OSError:
            return None
        are_right = all(zlib.crc32(values.data) == self._sums[name][chunk] for name, values in variables.items())
        return variables if are_right else None

    def _cells(self, name: str, first: int, end: int) -> Values:
        shape = (end - first, *self.layout.inner_shape(name))
        place = self.places[name] + self.layout.bytes_of_cells(first, name)
        try:
            return np.fromfile(self.path, self.layout.kinds[name], math.prod(shape), offset=place).reshape(shape)
        except (OSError, ValueError) as error:
            raise OSError(f"cannot read {self._title}: {error}") from None


def _contents(file: "h5py.File") -> tuple[Layout, dict[str, Values], dict[str, int]]:
    """A file's layout, its checksums, and where the numbers of its variables are."""
    arrays, checksums = cast("dict[str, h5py.Dataset]", file), cast("h5py.Group", file[CHECKSUMS])
    if LAYOUT not in checksums.attrs:
        raise ValueError("another program wrote it, or an earlier version, which can resume it")
    text = cast(bytes, checksums.attrs[LAYOUT])
    if zlib.crc32(text) != checksums.attrs[OF_LAYOUT]:
        raise ValueError("the description of the table does not match its checksum")
    fields, places = json.loads(text), _places(file)
    # The marks first: a sweep may finish a chunk meanwhile, which would then have its new mark and its old checksum.
    sums = {name: np.asarray(checksums[name]) for name in sorted(checksums, key=lambda name: name != FINISHED)}
    coords = {}
    for name, words in fields["coords"].items():
        numbers = np.asarray(arrays[name])
        if [zlib.crc32(numbers.data)] != sums[name].tolist():
            raise ValueError(f"{name} does not match its checksum")
        coords[name] = numbers if words is None else np.array(words)
    kinds = {name: arrays[name].dtype for name in fields["kinds"]}
    tuples = {part: {name: tuple(words) for name, words in fields[part].items()} for part in ("words", "inner")}
    layout = Layout(**fields | tuples | {"coords": coords, "kinds": kinds})
    for name in ("request", "versions"):
        if not isinstance(json.loads(layout.attributes.get(name, "{}")), dict):
            raise ValueError(f"the attribute {name} is not a dictionary")
    for name in (*kinds, FINISHED):
        shape = layout.shape + layout.inner_shape(name)
        if len(sums[name]) != layout.chunks or (name in kinds and arrays[name].shape != shape):
            raise ValueError(f"{name} has the wrong shape")
    return layout, sums, places


# The file of an unfinished table.

#: The files in the folder of an unfinished table: the table, and the lock.
UNFINISHED, LOCK = "table.h5", "nonholonomic.lock"

#: The name of a file in the folder that was not finished, as `replacing` names it.
PART = re.compile(r".+\.[0-9a-f]{32}\.part(\.[^.]*)?")


def folder_of(path: Path) -> Path:
    """The folder of an unfinished table, beside the table's file itself, not beside a link to it."""
    path = real_path(path)
    return path.with_name(path.name + ".blocks")


class AnotherRun(ValueError):
    """A table's path holds the result of another run, which would be overwritten; `difference` says how the runs differ.

    **Example:**

    >>> from pathlib import Path
    >>> from nonholonomic.sweeps import AnotherRun
    >>> print(AnotherRun(Path("times.h5"), "launch.spin is 155 in the file and 160 here"))
    times.h5 holds the result of another run: launch.spin is 155 in the file and 160 here; give another path or remove it
    """

    def __init__(self, source: Path, difference: str):
        super().__init__(f"{source} holds the result of another run: {difference}; give another path or remove it")
        self.difference = difference


class ChunkStore:
    """The finished chunks of a table's file.

    A chunk counts as finished only when it is complete and on disk. It then survives if the process dies, or if the
    machine dies and its disk keeps confirmed data.

    `finished`: the indices of the finished chunks.
    """

    def __init__(self, path: object, layout: Layout):
        """Find the chunks of an earlier run of the same request, or create a file for new ones.

        **Raises:** `OSError` that names the path if it cannot be read or written; `ValueError` that names the first
        difference if it holds the result of another request or of another version of this package.
        """
        self.path = table_path(path)
        self.folder, self.layout, self._lock = folder_of(self.path), layout, None
        self._unfinished = self.folder / UNFINISHED
        try:
            self._lock = self._locked()
            self._find()
        except BaseException:
            self.close()
            raise

    def _find(self) -> None:
        for file in list(self.folder.iterdir()):
            if PART.fullmatch(file.name):
                file.unlink()
        tables: list[Stored] = []
        self.finished, self._is_whole = set(), False
        for is_unfinished in (False, True):
            if not (self._unfinished if is_unfinished else self.path).exists():
                continue
            table = Stored(self.path, is_unfinished)
            difference = difference_between(table.layout, self.layout)
            if difference is not None:
                raise AnotherRun(self.folder if is_unfinished else self.path, difference)
            self.finished |= {chunk for chunk in table.finished if table.chunk(chunk) is not None}
            tables.append(table)
            self._is_whole = not is_unfinished and len(self.finished) == self.layout.chunks
            if self._is_whole:
                return
        if tables:
            old, new = tables[0].layout.versions, self.layout.versions
            changed = [name for name in new if name not in ("nonholonomic", "python") and old.get(name) != new[name]]
            if changed and not self.path.exists():
                versions = ", ".join(f"{name} {old.get(name)}, now {new[name]}" for name in changed)
                warn(f"{self.path} was begun with {versions}: digits may differ", RuntimeWarning)
            # The table records the versions with which it was begun.
            self.layout = tables[0].layout
        if [table.path for table in tables] != [self._unfinished]:
            self._begin(tables)
        unfinished = Stored(self.path, is_unfinished=True)
        # A chunk that could be read only the first time is not in a new file.
        self._places, self.finished = unfinished.places, self.finished & unfinished.finished
        damaged = {chunk for table in tables for chunk in table.finished} - self.finished
        if damaged:
            reason = f"{len(damaged)} finished chunks do not match their checksums, or are unreadable, and are computed again"
            warn(f"{self.path} is damaged: {reason}", RuntimeWarning)

    def _begin(self, tables: list[Stored]) -> None:
        """Create the file of the chunks, with those of other files, unless its folder is somebody else's."""
        foreign = [file.name for file in self.folder.iterdir() if file.name not in (LOCK, UNFINISHED)]
        if foreign and not self._unfinished.exists():
            folder = f"the folder of its chunks, {self.folder}, holds other files, such as {foreign[0]}"
            raise OSError(f"cannot write {self.path}: {folder}; give another path, or move them")
        bytes_needed = self.layout.bytes_of_cells(self.layout.cells)
        try:
            room = shutil.disk_usage(self.folder).free
            sync_folder(self.folder.parent)
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None
        if room < bytes_needed:
            sizes = f"{1e-9 * room:.3g} GB are free, and the table needs {1e-9 * bytes_needed:.3g} GB"
            raise OSError(f"cannot write {self.path}: {sizes}")
        chunks = ((chunk, table.chunk(chunk)) for table in tables for chunk in table.finished)
        write_file(self._unfinished, self.layout, chunks)

    def fill(self, computed: Iterable[tuple[int, dict[str, Values]]]) -> None:
        """Store each chunk when it is computed; then the file has all chunks, and becomes the table's file.

        **Raises:** `OSError` that names the path if it cannot be written; no chunk is lost.
        """
        if self._is_whole:
            return
        for chunk, values in computed:
            self.write(chunk, values)
        target = real_path(self.path)
        try:
            os.replace(self._unfinished, target)
            sync_folder(target.parent)
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None

    def write(self, chunk: int, values: dict[str, Values]) -> None:
        """Store a chunk.

        **Raises:** `OSError` that names the path if that fails, `ValueError` if a variable has the wrong shape; earlier
        chunks remain finished.
        """
        try:
            with Stream(self._unfinished, "r+b") as stream:
                write_chunk(stream, self.layout, self._places, chunk, values, synced=True)
                # Before waiting for the disk: from here on, the chunk survives the process, also if Ctrl-C ends it.
                self.finished.add(chunk)
                stream.check(synced=True)
        except ValueError as error:
            raise ValueError(f"cannot write {self.path}: {error}") from None
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None

    def interrupted(self) -> str:
        """Message after Ctrl-C: what is saved, and how to resume."""
        saved, total = (with_spaces(n) for n in (sum(map(self.layout.size, self.finished)), self.layout.cells))
        reading = f", or read them from {self.folder} with Table.load({str(self.path)!r})" if self.finished else ""
        return f"saved {saved} of {total} cells to {self.path}; run the same call again to resume{reading}"

    def _locked(self) -> IO[bytes] | None:
        """Create the folder, and keep others from computing the same file; the system releases the lock when this process
        ends."""
        while True:
            try:
                self.folder.mkdir(exist_ok=True)
            except OSError as error:
                where = f"; {self.folder} must be a folder or absent" if self.folder.exists() else ""
                raise OSError(f"cannot write {self.path}: {error.strerror}{where}") from None
            if fcntl is None:
                return None
            try:
                lock = (self.folder / LOCK).open("a+b", buffering=0)
            except FileNotFoundError:
                # A process that has just closed the file has removed the folder.
                continue
            except OSError as error:
                raise OSError(f"cannot write {self.path}: {error.strerror}") from None
            holder = f"process {os.getpid()} on {platform.node()}".encode()
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                lock.seek(0)
                other = {holder: "another thread", b"": "another thread or process"}.get(lock.read(), "another process")
                lock.close()
                raise OSError(f"cannot write {self.path}: {other} is writing it") from None
            # A process that has just closed the file has removed its lock, possibly after we opened it.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock.fileno()), (self.folder / LOCK).stat()):
                    with contextlib.suppress(OSError):
                        lock.truncate(0)
                        lock.write(holder)
                    return lock
            lock.close()

    def close(self) -> None:
        """Release the file for others, and remove the folder unless it holds files."""
        if self._lock is not None:
            (self.folder / LOCK).unlink(missing_ok=True)
            self._lock.close()
        with contextlib.suppress(OSError):
            self.folder.rmdir()


def with_spaces(count: int) -> str:
    """A count with its digits in groups of three."""
    return f"{count:,}".replace(",", " ")


def saved_cells(path: Path) -> int:
    """Number of cells of a table that are on disk, in its file or in that of an unfinished table.

    **Example:**

    >>> from pathlib import Path
    >>> from nonholonomic.sweeps import saved_cells
    >>> saved_cells(Path("none.h5"))
    0
    """
    is_unfinished = not path.exists()
    if is_unfinished and not (folder_of(path) / UNFINISHED).exists():
        return 0
    table = Stored(path, is_unfinished)
    return sum(map(table.layout.size, table.finished))


def contents_of(path: Path) -> tuple[Layout, Mapping[str, Values]]:
    """The layout of a table, and its variables, which stay in the file if the table is large. Of an unfinished table, these
    are the chunks that are on disk.

    **Raises:** `OSError` that names the path if it cannot be read, holds no table, or has a damaged chunk.
    """
    is_unfinished = not path.exists() and (folder_of(path) / UNFINISHED).exists()
    try:
        stored = Stored(path, is_unfinished)
        layout = stored.layout
        if not is_unfinished and layout.bytes_of_cells(layout.cells) > MAX_BYTES_IN_MEMORY:
            return layout, stored
        return layout, dict(stored)
    except OSError:
        # The table may have been finished in the meantime.
        if is_unfinished and path.exists():
            return contents_of(path)
        raise


def difference_between(old: Layout, new: Layout) -> str | None:
    """How the table in a file differs from the one to compute, in words; `None` if both are results of one request."""
    in_file, in_call = (json.loads(layout.attributes.get("request", "{}")) for layout in (old, new))
    if "status" in in_file:
        return "it is a single run, not a table of many"
    texts = [layout.versions.get("nonholonomic") for layout in (old, new)]
    if texts[0] != texts[1]:
        return f"nonholonomic is {texts[0]} in the file and {texts[1]} here"
    # Another version of JAX may write the same equations in other words.
    ignored = () if old.versions.get("jax") == new.versions.get("jax") else (EQUATIONS,)
    for name in dict.fromkeys([*in_file, *in_call]):
        # As texts, in which a missing number, NaN, equals itself.
        if name in ignored or len({json.dumps(of.get(name), sort_keys=True) for of in (in_file, in_call)}) == 1:
            continue
        if name == EQUATIONS:
            return "the code of the system, its event or its input has changed"
        texts = [repr(request[name]) if name in request else "absent" for request in (in_file, in_call)]
        return f"{name} is {texts[0]} in the file and {texts[1]} here"
    for name, values in new.coords.items():
        if name not in old.coords or not np.array_equal(old.coords[name], values):
            return f"the axis {name} differs"
    if list(old.coords) != list(new.coords):
        return f"its axes are {', '.join(old.coords)}"
    if (old.kinds, old.inner, old.chunk) != (new.kinds, new.inner, new.chunk):
        return f"it was not written by a sweep in {new.chunks} chunks"
    for name in new.kinds:
        if old.words.get(name) != new.words.get(name):
            texts = [repr(", ".join(layout.words.get(name, ()))) for layout in (old, new)]
            return f"the words of {name} are {texts[0]} in the file and {texts[1]} here"
    return None
