"""The file of a table: HDF5 with dimension scales, as netCDF-4 has it, so that xarray opens it with named coordinates.

Words, such as a cell's status, are stored as bytes with the attributes `flag_values` and `flag_meanings` (CF conventions).
Every array lies in one piece, so that a sweep can fill in a block of cells without touching the file's structure: a process
killed at any moment leaves a file that opens, with every finished block in it.
"""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Shaped

Values = Shaped[np.ndarray, "..."]

#: Stored for a cell that has not been computed, and the word for it.
PENDING, UNREACHED = -1, "pending"

#: Where a sweep marks its finished blocks.
BLOCKS = "block_finished"


def write_grid(
    path: Any,
    coords: dict[str, Values],
    variables: dict[str, Values],
    units: dict[str, str],
    attributes: dict[str, Any],
    words: dict[str, tuple[str, ...]] | None = None,
    blocks: int = 0,
) -> None:
    """Write a grid of variables, all at once or not at all.

    **Arguments:**

    - `path`: where to write; a file that exists is replaced.
    - `coords`, `variables`, `units`, `attributes`: as in `Table`.
    - `words`: for variables of words, or of codes that stand for them, the words in the order of their codes.
    - `blocks`: number of blocks that are still to be filled in.

    **Raises:** `OSError` that names the path if it cannot be written.
    """
    path = Path(path)
    if path.is_dir():
        raise OSError(f"cannot write {path}: it is a folder")
    try:
        handle, scratch = tempfile.mkstemp(dir=path.parent, prefix=path.name + ".", suffix=".part")
        os.close(handle)
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror}") from None
    try:
        # Zeros in the scratch file's permissions would outlive the rename.
        os.chmod(scratch, 0o666 & ~_umask())
        with h5py.File(scratch, "w", track_order=True) as file:
            _fill(file, coords, variables, units, attributes, words or {}, blocks)
        os.replace(scratch, path)
    except OSError as error:
        Path(scratch).unlink(missing_ok=True)
        raise OSError(f"cannot write {path}: {error}") from None
    except BaseException:
        Path(scratch).unlink(missing_ok=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _fill(
    file: h5py.File,
    coords: dict[str, Values],
    variables: dict[str, Values],
    units: dict[str, str],
    attributes: dict[str, Any],
    words: dict[str, tuple[str, ...]],
    blocks: int,
) -> None:
    file.attrs["Conventions"] = "CF-1.10"
    for name, value in attributes.items():
        file.attrs[name] = value if isinstance(value, str | int | float) else json.dumps(value)
    for name, values in coords.items():
        scale = file.create_dataset(name, data=np.asarray(values))
        scale.make_scale(name)
        scale.attrs["units"] = units.get(name, "1")
    for name, values in variables.items():
        values = np.asarray(values)
        meanings = words.get(name)
        if values.dtype.kind == "U":
            known = meanings or ()
            met = (word for word in dict.fromkeys(values.ravel().tolist()) if word not in (*known, UNREACHED))
            meanings = (*known, *met)
            codes = {word: code for code, word in enumerate(meanings)} | {UNREACHED: PENDING}
            values = np.vectorize(codes.get, otypes=[np.int8])(values)
        stored = file.create_dataset(name, data=values)
        for axis, coordinate in enumerate(coords):
            stored.dims[axis].attach_scale(file[coordinate])
        if meanings is None:
            stored.attrs["units"] = units.get(name, "1")
        else:
            stored.attrs["flag_values"] = np.arange(len(meanings), dtype=np.int8)
            stored.attrs["flag_meanings"] = " ".join(meanings)
    if blocks:
        file.create_dataset("block", data=np.arange(blocks)).make_scale("block")
        finished = file.create_dataset(BLOCKS, data=np.zeros(blocks, np.int8))
        finished.dims[0].attach_scale(file["block"])


def read_grid(path: Any) -> tuple[Any, ...]:
    """Read what `write_grid` wrote.

    **Returns:** `coords`, `variables`, `units`, `attributes` and `words`, as in `Table`.

    **Raises:** `OSError` that names the path if it cannot be read or holds no grid.
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"no such file: {path}")
    if Path(path).is_dir():
        raise OSError(f"cannot read {path}: it is a folder")
    try:
        with h5py.File(path, "r") as file:
            return _contents(file)
    except (OSError, KeyError, IndexError, ValueError, TypeError, AttributeError, RuntimeError) as error:
        raise OSError(f"cannot read {path}: it is not a table of nonholonomic, or it is damaged ({error})") from None


def stored_array(file: h5py.File, name: str) -> h5py.Dataset:
    """The array of that name in a file.

    **Raises:** `KeyError` if there is nothing of that name, `ValueError` if it is not an array.
    """
    stored = file[name]
    if not isinstance(stored, h5py.Dataset):
        raise ValueError(f"{name} is not an array")
    return stored


def _contents(file: h5py.File) -> tuple[Any, ...]:
    coords, variables, units, words = {}, {}, {}, {}
    if "request" not in file.attrs:
        raise ValueError("it names no request")
    for name in json.loads(str(file.attrs["axes"])):
        stored = stored_array(file, name)
        coords[name] = stored[()]
        units[name] = str(stored.attrs["units"])
    for name, stored in file.items():
        if name in coords or name in ("block", BLOCKS):
            continue
        values = stored[()]
        if values.shape != tuple(len(axis) for axis in coords.values()):
            raise ValueError(f"{name} has the wrong shape")
        if "flag_meanings" in stored.attrs:
            words[name] = tuple(str(stored.attrs["flag_meanings"]).split())
            values = np.array([*words[name], UNREACHED])[values]
        else:
            units[name] = str(stored.attrs["units"])
        variables[name] = values
    attributes = {name: file.attrs[name] for name in file.attrs if name != "Conventions"}
    return coords, variables, units, attributes, words
