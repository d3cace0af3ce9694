"""The chunks of an unfinished table: one file per chunk, in a folder beside the table's file, so that a killed sweep
can resume."""

import contextlib
import json
import os
import platform
import re
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None

import numpy as np

from ..validation import real_path, replacing, sync_folder, warn
from ._file import Stored, table_path, write_file
from .grid import EQUATIONS, Layout, Values

#: The files of the folder of a table's chunks, besides those of the chunks: a table without numbers, and the lock.
HEADER, LOCK = "table.h5", "nonholonomic.lock"

#: The name of a file in the folder that was not finished, as `replacing` names it.
PART = re.compile(r".+\.[0-9a-f]{32}\.part(\.[^.]*)?")


def folder_of(path: Path) -> Path:
    """The folder of a table's chunks while it is computed, beside the file itself, not beside a link to it."""
    path = real_path(path)
    return path.with_name(path.name + ".blocks")


def chunks_in(folder: Path, layout: Layout) -> set[int]:
    """The chunks of a table whose files are in its folder."""
    chunks = {int(file.stem) for file in folder.glob("*.npz") if file.stem.isdecimal()}
    return {chunk for chunk in chunks if chunk < layout.chunks}


def chunk_file(folder: Path, chunk: int) -> Path:
    """The file of a chunk."""
    return folder / f"{chunk}.npz"


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

    `finished`: the indices of the chunks that existed when the sweep began.
    """

    def __init__(self, path: Any, layout: Layout):
        """Find the chunks of an earlier run of the same request, or create a folder for new ones.

        **Raises:** `OSError` that names the path if it cannot be read or written; `ValueError` that names the first
        difference if it holds the result of another request or of another version of this package.
        """
        self.path = table_path(path)
        self.folder, self.layout, self._lock = folder_of(self.path), layout, None
        try:
            self._lock = self._locked()
            self._find()
        except BaseException:
            self.close()
            raise

    def _find(self) -> None:
        for part in filter(is_part, self.folder.iterdir()):
            part.unlink()
        stored = Stored(self.path) if self.path.exists() else None
        header = self.folder / HEADER
        table = stored or (Stored(header) if header.exists() else None)
        if table is not None:
            self._check(table)
            # The table records the versions with which it was begun; words added since then follow its own words.
            self.layout = table.layout._replace(words=layout_words(table.layout.words, self.layout.words))
        valid = {chunk for chunk in range(self.layout.chunks) if stored is not None and stored.chunk(chunk) is not None}
        self._whole = len(valid) == self.layout.chunks
        if self._whole:
            self.finished = valid
            return
        if not header.exists():
            self._begin(header)
        chunks_on_disk = chunks_in(self.folder, self.layout)
        damaged = {chunk for chunk in chunks_on_disk if read_chunk(self.folder, self.layout, chunk) is None}
        self.finished = chunks_on_disk - damaged
        if stored is not None:
            damaged |= set(range(self.layout.chunks)) - valid - self.finished
            for chunk in sorted(valid - self.finished):
                values = stored.chunk(chunk)
                assert values is not None
                self.write(chunk, values)
            self.finished |= valid
        if damaged:
            warn(
                f"{self.path} is damaged: {len(damaged)} finished chunks do not match their checksums and are computed again",
                RuntimeWarning,
            )

    def _begin(self, header: Path) -> None:
        """Write a note about the folder's purpose, unless the folder is somebody else's."""
        foreign = [file.name for file in self.folder.iterdir() if file.name != LOCK]
        if foreign:
            raise OSError(
                f"cannot write {self.path}: the folder of its chunks, {self.folder}, holds other files, such as {foreign[0]}; "
                "give another path, or move them"
            )
        # The chunks remain until the table's file exists.
        bytes_needed = 2 * self.layout.bytes_of_cells(self.layout.cells)
        try:
            room = shutil.disk_usage(self.folder).free
            if room < bytes_needed:
                raise OSError(
                    0,
                    f"{1e-9 * room:.3g} GB are free, and the table needs {1e-9 * bytes_needed:.3g} GB while it is computed",
                )
            sync_folder(self.folder.parent)
        except OSError as error:
            raise OSError(f"cannot write {self.path}: {error.strerror}") from None
        write_file(header, self.layout, ())

    def _check(self, table: Stored) -> None:
        new_layout, old_layout = self.layout, table.layout
        new, old = (json.loads(str(layout.attributes.get("versions", "{}"))) for layout in (new_layout, old_layout))
        # Another version of JAX may write the same equations in other words.
        ignored = () if new.get("jax") == old.get("jax") else (EQUATIONS,)
        difference = same_request(str(old_layout.attributes["request"]), new_layout.attributes["request"], ignored)
        if "status" in json.loads(str(old_layout.attributes["request"])):
            difference = "it is a single run, not a table of many"
        if difference is None:
            for name, values in new_layout.coords.items():
                if name not in old_layout.coords or not np.array_equal(old_layout.coords[name], values):
                    difference = f"the axis {name} differs"
        if difference is None and list(old_layout.coords) != list(new_layout.coords):
            difference = f"its axes are {', '.join(old_layout.coords)}"
        if difference is None and old.get("nonholonomic") != new.get("nonholonomic"):
            difference = f"nonholonomic is {old.get('nonholonomic')} in the file and {new.get('nonholonomic')} here"
        if difference is None and (old_layout.kinds, old_layout.inner, old_layout.chunk) != (
            new_layout.kinds,
            new_layout.inner,
            new_layout.chunk,
        ):
            difference = f"it was not written by a sweep in {new_layout.chunks} chunks"
        if difference is not None:
            source = self.path if table.path == self.path else self.folder
            raise AnotherRun(source, difference)
        changed = [name for name in new if name not in ("nonholonomic", "python") and old.get(name) != new[name]]
        if changed and table.path != self.path:
            versions = ", ".join(f"{name} {old.get(name)}, now {new[name]}" for name in changed)
            warn(f"{self.path} was begun with {versions}: digits may differ", RuntimeWarning)

    def filled(self, computed: Iterable[tuple[int, dict[str, Values]]]) -> Stored:
        """Store each chunk when it is computed, and write the table's file from these and from the existing chunks.

        Chunks that are written to the file during the computation need not be read again at the end.

        **Raises:** `OSError` that names the path if it cannot be written, or a chunk that is damaged; no chunk is lost.
        """
        if not self._whole:
            write_file(self.path, self.layout, self._all(computed), self.folder)
        for chunk in chunks_in(self.folder, self.layout):
            chunk_file(self.folder, chunk).unlink(missing_ok=True)
        (self.folder / HEADER).unlink(missing_ok=True)
        return Stored(self.path)

    def _all(self, computed: Iterable[tuple[int, dict[str, Values]]]) -> Iterator[tuple[int, dict[str, Values]]]:
        for chunk, values in computed:
            self.write(chunk, values)
            yield chunk, values
        for chunk in sorted(self.finished):
            values_on_disk = read_chunk(self.folder, self.layout, chunk)
            if values_on_disk is None:
                raise OSError(f"cannot read {self.folder}: chunk {chunk} is damaged; the same call computes it again")
            yield chunk, values_on_disk

    def write(self, chunk: int, values: dict[str, Values]) -> None:
        """Store a chunk.

        **Raises:** `OSError` that names the path if that fails; earlier chunks remain finished.
        """
        kinds = self.layout.kinds
        with replacing(chunk_file(self.folder, chunk)) as scratch, scratch.open("wb") as stream:
            arrays: dict[str, Any] = {name: np.asarray(cells, kinds[name]) for name, cells in values.items()}
            np.savez(stream, **arrays)

    def interrupted(self) -> str:
        """Message after Ctrl-C: what is saved, and how to resume."""
        numbers = chunks_in(self.folder, self.layout) | self.finished
        cells = self.layout.cells if self._whole else sum(map(self.layout.size, numbers))
        total = with_spaces(self.layout.cells)
        return f"saved {with_spaces(cells)} of {total} cells to {self.path}; run the same call again to resume"

    def _locked(self) -> Any:
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


def is_part(file: Path) -> bool:
    """Whether a file in the folder of the chunks was not finished."""
    return PART.fullmatch(file.name) is not None


def layout_words(
    old_words: dict[str, tuple[str, ...]], new_words: dict[str, tuple[str, ...]]
) -> dict[str, tuple[str, ...]]:
    """The words of a resumed table: `new_words` if they begin with the words of the file, otherwise the words of the
    file."""
    return {
        name: new_words[name] if new_words.get(name, ())[: len(words)] == words else words
        for name, words in old_words.items()
    }


def with_spaces(count: int) -> str:
    """A count with its digits in groups of three."""
    return f"{count:,}".replace(",", " ")


def saved_cells(path: Path) -> int:
    """Number of cells of a table that are on disk, in its file or in the files of its chunks.

    **Example:**

    >>> from pathlib import Path
    >>> from nonholonomic.sweeps import saved_cells
    >>> saved_cells(Path("none.h5"))
    0
    """
    folder = folder_of(path)
    if path.exists():
        return Stored(path).layout.cells
    if not (folder / HEADER).exists():
        return 0
    layout = Stored(folder / HEADER).layout
    return sum(map(layout.size, chunks_in(folder, layout)))


def unfinished(path: Path) -> tuple[Layout, dict[str, Values]] | None:
    """The finished part of an unfinished table; `None` if there is none.

    **Returns:** its layout, and its variables with all cells along the first axis.

    **Raises:** `OSError` that names the path if a chunk is damaged.
    """
    folder = folder_of(path)
    if path.exists() or not (folder / HEADER).exists():
        return None
    layout = Stored(folder / HEADER).layout
    variables, damaged = layout.empty(layout.cells), 0
    for chunk in chunks_in(folder, layout):
        first, end = layout.ends(chunk)
        values = read_chunk(folder, layout, chunk)
        damaged += values is None
        for name, cells in (values or {}).items():
            variables[name][first:end] = cells
    if path.exists():
        # The table was finished in the meantime.
        return None
    if damaged:
        reason = f"{damaged} of its {layout.chunks} chunks do not match their checksums"
        raise OSError(f"cannot read {path}: it is damaged: {reason}")
    return layout, variables


def read_chunk(folder: Path, layout: Layout, chunk: int) -> dict[str, Values] | None:
    """The variables of a chunk; `None` if they do not match the checksums of the archive."""
    try:
        # NumPy does not close a file that it cannot read.
        with chunk_file(folder, chunk).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            variables = {name: archive[name] for name in layout.kinds}
    # What a damaged file makes NumPy raise can be of any kind.
    except Exception:
        return None
    first, end = layout.ends(chunk)
    right = {name: (kind, (end - first, *layout.inner_shape(name))) for name, kind in layout.kinds.items()}
    return variables if {name: (values.dtype, values.shape) for name, values in variables.items()} == right else None


def same_request(left: str, right: str, ignored: tuple[str, ...] = ()) -> str | None:
    """The first difference between two requests (JSON), in words; `None` if they are the same.

    Earlier versions wrote an empty list for options that requests of this version omit.

    **Arguments:** `ignored`: names that may differ.
    """
    first, second = (
        {name: value for name, value in json.loads(request).items() if value != [] and name not in ignored}
        for request in (left, right)
    )
    for name in [*first, *(name for name in second if name not in first)]:
        if name == EQUATIONS:
            # Earlier versions wrote no checksum.
            if name in first and name in second and first[name] != second[name]:
                return "the code of the system, its event or its input has changed"
        # As texts, in which a missing number, NaN, equals itself.
        elif len({json.dumps(of.get(name), sort_keys=True) for of in (first, second)}) > 1:
            in_file, in_call = (repr(of[name]) if name in of else "absent" for of in (first, second))
            return f"{name} is {in_file} in the file and {in_call} here"
    return None
