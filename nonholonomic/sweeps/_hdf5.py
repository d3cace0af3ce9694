"""The file of a table: HDF5 with dimension scales, as in netCDF-4, so that xarray opens it with named coordinates.

Words, such as a cell's status, are stored as bytes with the attributes `flag_values` and `flag_meanings` (CF conventions).
Every array is contiguous, so that a sweep can fill in a block of cells without touching the file's structure: a process
killed at any moment leaves a file that opens, with every finished block in it. A finished block has a checksum, which
covers the coordinates, units, words and attributes too; a table that was saved whole is one block.
"""

import json
import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int, Shaped

from ._checksum import block_checksum, header_checksum

if TYPE_CHECKING:
    import h5py

Values = Shaped[np.ndarray, "..."]

#: Stored for a cell that has not been computed, and the word for it.
PENDING, UNREACHED = -1, "pending"

#: The group of what the sweep itself needs, apart from the variables that a reader sees.
SWEEP = "sweep"

#: The blocks: the first cell of each, whether it is finished, and its checksum.
FIRSTS, FINISHED, CHECKSUMS = f"{SWEEP}/block", f"{SWEEP}/block_finished", f"{SWEEP}/block_checksum"

#: The attribute of a table that names its variables in words; in a file each variable has its own, as in CF.
LONG_NAMES, LONG_NAME = "long_names", "long_name"

#: The file's attribute that names the dimensions which variables have besides the grid's.
INNER = "inner"


class Grid(NamedTuple):
    """What a file holds, as it is stored: numbers for words, and nothing where a block is not finished.

    `firsts` is the first cell of each block, `finished` says which are finished and match their checksum, `damaged` which
    are marked as finished but do not match; `header` is the `header_checksum`. The rest is as in `Table`.
    """

    coords: dict[str, Values]
    variables: dict[str, Values]
    units: dict[str, str]
    attributes: dict[str, Any]
    words: dict[str, tuple[str, ...]]
    inner: dict[str, tuple[str, ...]]
    firsts: Int[np.ndarray, " blocks"]
    finished: Bool[np.ndarray, " blocks"]
    damaged: Bool[np.ndarray, " blocks"]
    header: int


def axes_of(coords: dict[str, Values], inner: dict[str, tuple[str, ...]]) -> list[str]:
    """The coordinates that are axes of the grid: all but those of dimensions that only some variables have."""
    within = {dim for dims in inner.values() for dim in dims}
    return [name for name in coords if name not in within]


def blank(kind: Any) -> Any:
    """What stands for a number of the given dtype that has not been computed."""
    return np.nan if np.dtype(kind).kind == "f" else PENDING


def write_grid(
    path: Any,
    coords: dict[str, Values],
    variables: dict[str, Values],
    units: dict[str, str],
    attributes: dict[str, Any],
    words: dict[str, tuple[str, ...]] | None = None,
    pending: Any = (),
    inner: dict[str, tuple[str, ...]] | None = None,
) -> None:
    """Write a grid of variables, all at once or not at all.

    **Arguments:**

    - `path`: where to write; a file that exists is replaced.
    - `coords`, `variables`, `units`, `attributes`: as in `Table`.
    - `words`: for variables of words, or of codes that stand for them, the words in the order of their codes.
    - `pending`: the first cells of the blocks that are still to be filled in; by default all is there.
    - `inner`: as in `Table`.

    **Raises:** `OSError` that names the path if it cannot be written.
    """
    # It takes a tenth of a second to import, and most processes do not need it.
    import h5py

    path = Path(path)
    if path.is_dir():
        raise OSError(f"cannot write {path}: it is a folder")
    # HDF5 builds the file in memory: on a full disk it would abort the process.
    with h5py.File(path.name, "w", driver="core", backing_store=False, libver="v108", track_order=True) as file:
        _fill(file, coords, variables, units, attributes, words or {}, pending, inner or {})
        file.flush()
        image = file.id.get_file_image()
    scratch = None
    try:
        handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=path.name + ".", suffix=".part")
        with open(handle, "wb") as stream:
            stream.write(image)
            stream.flush()
            os.fsync(stream.fileno())
        # Zeros in the scratch file's permissions would outlive the rename.
        os.chmod(scratch, 0o666 & ~_umask())
        os.replace(scratch, path)
    except BaseException as error:
        if scratch is not None:
            Path(scratch).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise OSError(f"cannot write {path}: {error.strerror}") from None
        raise
    _sync_folder(path.parent)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk, on systems that let a folder be opened."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _fill(
    file: "h5py.File",
    coords: dict[str, Values],
    variables: dict[str, Values],
    units: dict[str, str],
    attributes: dict[str, Any],
    words: dict[str, tuple[str, ...]],
    pending: Any,
    inner: dict[str, tuple[str, ...]],
) -> None:
    _set(file, "Conventions", "CF-1.10")
    attributes = attributes | ({INNER: inner} if inner else {})
    attributes = {
        name: value if isinstance(value, str | int | float) else json.dumps(value) for name, value in attributes.items()
    }
    long_names = json.loads(attributes.get(LONG_NAMES, "{}"))
    if long_names:
        # As they will be read, for the checksum.
        long_names = {name: text for name, text in long_names.items() if name in coords | variables}
        attributes[LONG_NAMES] = json.dumps(long_names, sort_keys=True)
    for name, value in attributes.items():
        if name != LONG_NAMES:
            _set(file, name, value)
    known, words, stored = words, {}, {}
    for name, values in (coords | variables).items():
        stored[name], meanings = _coded(np.asarray(values), known.get(name))
        if meanings is not None:
            words[name] = meanings
    units = {name: units.get(name, "1") for name in stored if name not in words}
    coords = {name: stored.pop(name) for name in coords}
    axes = axes_of(coords, inner)
    for name, values in (coords | stored).items():
        array = file.create_dataset(name, data=values)
        if name in coords:
            array.make_scale(name)
        else:
            for axis, coordinate in enumerate((*axes, *inner.get(name, ()))):
                array.dims[axis].attach_scale(file[coordinate])
        if name in words:
            array.attrs["flag_values"] = np.arange(len(words[name]), dtype=np.int8)
            _set(array, "flag_meanings", " ".join(words[name]))
        else:
            _set(array, "units", units[name])
        if name in long_names:
            _set(array, LONG_NAME, long_names[name])
    whole = len(pending) == 0
    header = header_checksum(coords, units, attributes, words)
    checksum = block_checksum(header, {name: values.reshape(-1) for name, values in stored.items()}) if whole else 0
    firsts = np.zeros(1, int) if whole else np.asarray(pending, int)
    file.create_dataset(FIRSTS, data=firsts).make_scale(FIRSTS)
    for name, values in (
        (FINISHED, np.full(len(firsts), whole, np.int8)),
        (CHECKSUMS, np.full(len(firsts), checksum, np.uint32)),
    ):
        file.create_dataset(name, data=values).dims[0].attach_scale(file[FIRSTS])


def _set(of: Any, name: str, value: Any) -> None:
    """Set an attribute; a string is stored at its own length, because no checksum covers HDF5's strings of variable length."""
    # Only files need it.
    import h5py

    if isinstance(value, str):
        stored = value.encode()
        of.attrs.create(name, stored, dtype=h5py.string_dtype("utf-8", max(1, len(stored))))
    else:
        of.attrs.create(name, value)


def _attribute(of: Any, name: str) -> Any:
    """An attribute, a number or a string."""
    value = of.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


def _coded(values: Values, words: tuple[str, ...] | None) -> tuple[Values, tuple[str, ...] | None]:
    """Words as the codes that stand for them, and the words in the order of their codes; numbers as they are."""
    if values.dtype.kind != "U":
        return values, words
    known = words or ()
    met = (word for word in dict.fromkeys(values.ravel().tolist()) if word not in (*known, UNREACHED))
    words = (*known, *met)
    codes = {word: code for code, word in enumerate(words)} | {UNREACHED: PENDING}
    return np.vectorize(codes.get, otypes=[np.int8])(values), words


def read_grid(path: Any) -> tuple[Any, ...]:
    """Read what `write_grid` wrote.

    **Returns:** `coords`, `variables`, `units`, `attributes`, `words` and `inner`, as in `Table`.

    **Raises:** `OSError` that names the path if it cannot be read, holds no grid, or holds numbers other than those
    that were written.
    """
    grid = read_stored(path)
    if grid.damaged.any():
        raise OSError(
            f"cannot read {path}: it is damaged: {grid.damaged.sum()} of its {len(grid.damaged)} blocks do not match "
            "their checksums"
        )
    variables = {
        name: np.array([*grid.words[name], UNREACHED])[values] if name in grid.words else values
        for name, values in grid.variables.items()
    }
    return grid.coords, variables, grid.units, grid.attributes, grid.words, grid.inner


def read_stored(path: Any) -> Grid:
    """Read a file's `Grid`, and hold its finished blocks against their checksums.

    **Raises:** `OSError` that names the path if it cannot be read or holds no grid.
    """
    # Only files need it.
    import h5py

    if not Path(path).exists():
        raise FileNotFoundError(f"no such file: {path}")
    if Path(path).is_dir():
        raise OSError(f"cannot read {path}: it is a folder")
    try:
        with h5py.File(path, "r") as file:
            return _contents(file)
    except (OSError, KeyError, IndexError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise OSError(f"cannot read {path}: it is not a table of nonholonomic, or it is damaged ({error})") from None


def stored_array(file: "h5py.File", name: str) -> "h5py.Dataset":
    """The array of that name in a file.

    **Raises:** `KeyError` if there is nothing of that name, `ValueError` if it is not an array.
    """
    # Only files need it.
    import h5py

    stored = file[name]
    if not isinstance(stored, h5py.Dataset):
        raise ValueError(f"{name} is not an array")
    return stored


def _contents(file: "h5py.File") -> Grid:
    coords, variables, units, words, long_names = {}, {}, {}, {}, {}
    if "request" not in file.attrs:
        raise ValueError("it names no request")
    # The marks come first: what is marked by now is complete, even if another process is writing the file.
    firsts, marks, checksums = (stored_array(file, name)[()] for name in (FIRSTS, FINISHED, CHECKSUMS))
    attributes = {name: _attribute(file, name) for name in file.attrs if name != "Conventions"}
    axes = json.loads(attributes["axes"])
    inner = {name: tuple(dims) for name, dims in json.loads(attributes.get(INNER, "{}")).items()}
    dims = dict.fromkeys((*axes, *(dim for dims in inner.values() for dim in dims)))
    for name in (*dims, *(name for name in file if name not in (*dims, SWEEP))):
        stored = stored_array(file, name)
        if name in dims:
            coords[name] = stored[()]
        elif stored.shape == tuple(len(coords[dim]) for dim in (*axes, *inner.get(name, ()))):
            variables[name] = np.asarray(stored[()])
        else:
            raise ValueError(f"{name} has the wrong shape")
        if LONG_NAME in stored.attrs:
            long_names[name] = _attribute(stored, LONG_NAME)
        if "flag_meanings" in stored.attrs:
            words[name] = tuple(_attribute(stored, "flag_meanings").split())
        else:
            units[name] = _attribute(stored, "units")
    if long_names:
        attributes[LONG_NAMES] = json.dumps(long_names, sort_keys=True)
    cells = int(np.prod([len(coords[name]) for name in axes], dtype=int))
    ends = np.append(firsts[1:], cells)
    if not (len(firsts) == len(marks) == len(checksums) > 0 == firsts[0]) or np.any(ends < firsts):
        raise ValueError("its blocks do not cover it")
    header = header_checksum(coords, units, attributes, words)
    finished, damaged = marks != 0, np.zeros(len(marks), bool)
    for block, (first, end) in enumerate(zip(firsts, ends, strict=True)):
        some = {name: values.reshape(cells, -1)[first:end] for name, values in variables.items()}
        if finished[block]:
            damaged[block] = block_checksum(header, some) != checksums[block]
        if damaged[block] or not finished[block]:
            for values in some.values():
                values[...] = blank(values.dtype)
    attributes.pop(INNER, None)
    coords = {name: np.array(words.pop(name))[values] if name in words else values for name, values in coords.items()}
    return Grid(coords, variables, units, attributes, words, inner, firsts, finished & ~damaged, damaged, header)
