"""Checksums of a table's file, block by block: damage by a disk or a copy is noticed on reading."""

import json
import zlib
from typing import Any

import numpy as np
from jaxtyping import Shaped

Values = Shaped[np.ndarray, "..."]


def header_checksum(
    coords: dict[str, Values], units: dict[str, str], attributes: dict[str, Any], words: dict[str, tuple[str, ...]]
) -> int:
    """CRC-32 of everything that gives a table's numbers their meaning.

    **Arguments:** as in `Table`, as a file holds them.
    """
    strings = [sorted(units.items()), sorted((name, str(value)) for name, value in attributes.items())]
    strings += [list(coords), sorted((name, list(known)) for name, known in words.items())]
    return _array_checksums(coords, zlib.crc32(json.dumps(strings).encode()))


def block_checksum(header: int, values: dict[str, Values]) -> int:
    """CRC-32 of one block.

    **Arguments:**

    - `header`: the table's `header_checksum`, which the block's checksum continues, so that it covers both.
    - `values`: variable -> the block's cells, of the type they are stored in.
    """
    return _array_checksums({name: values[name] for name in sorted(values)}, header)


def _array_checksums(arrays: dict[str, Values], start: int) -> int:
    for name, values in arrays.items():
        # The type is included: the same bytes in the other order are other numbers.
        start = zlib.crc32(f"{name} {values.dtype.str}".encode(), start)
        start = zlib.crc32(np.ascontiguousarray(values).tobytes(), start)
    return start
