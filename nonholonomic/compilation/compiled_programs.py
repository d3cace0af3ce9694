"""Keep the number of compiled programs small: one program for many sizes, and none kept until memory is exhausted.

A program of a hybrid scene takes 60 to 180 MB and 200 to 800 memory mappings. Linux allows 65 530 mappings per process,
and a compiler that gets no more mappings crashes the process.
"""

import contextlib
import ctypes
import functools
import gc
import logging
import os
import threading
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from ..validation import is_traced

#: A process keeps its programs up to this memory [bytes] or this part of the machine's memory, whichever is more.
LEAST_LIMIT, PART_OF_MEMORY = 2_500_000_000, 0.25

#: Number of mappings from which programs may be the cause of much memory.
MANY_MAPPINGS = 4_000

#: Fraction of the allowed mappings above which programs are cleared, however little memory they take.
PART_OF_MAPPINGS = 0.5

#: Below this memory [bytes] there cannot be that many mappings, so they are not counted; counting takes some ms.
LITTLE_MEMORY = 1_000_000_000

#: Least number of times at which a program evaluates a run: few runs are so long that more sizes are worth a compilation.
LEAST_PADDED = 256

_log = logging.getLogger(__name__)


def padded(values: Float[np.ndarray, "... times"], least: int) -> Float[np.ndarray, "... more"]:
    """Values padded to a power of two of at least `least` and `LEAST_PADDED` by repeating the last one, so that one
    program serves many sizes.

    **Example:**

    >>> import numpy as np
    >>> from nonholonomic.compilation.compiled_programs import padded
    >>> padded(np.array([1.0, 2.0, 3.0]), least=300).shape
    (512,)
    """
    padding = (1 << (max(least, LEAST_PADDED) - 1).bit_length()) - values.shape[-1]
    return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, padding)], mode="edge")


def forget_programs_if_many(most_memory: float | None = None) -> bool:
    """Clear all compiled programs if they take too much memory, and log a one-line warning.

    The next call of a cleared program compiles it again, or reads it from disk (`enable_compilation_cache`). Nothing is
    cleared inside transformations, outside the main thread, or if the system does not report the memory of a process
    (`/proc`).

    **Arguments:** `most_memory`: memory [bytes] that the process may hold; by default a quarter of the machine's, but at
    least 2.5 GB.

    **Returns:** whether programs were cleared.
    """
    memory = resident_memory()
    if most_memory is None:
        most_memory = max(LEAST_LIMIT, PART_OF_MEMORY * memory_of_machine())
    if memory < min(LITTLE_MEMORY, most_memory) or threading.current_thread() is not threading.main_thread():
        return False
    # Putting a number on a device compiles nothing; adding two numbers would.
    if is_traced(jax.device_put(np.zeros(()))):
        return False
    mappings = count_mappings()
    if mappings < PART_OF_MAPPINGS * most_mappings():
        if memory < most_memory or mappings < MANY_MAPPINGS:
            return False
        # First return to the system what the compiler has freed.
        release_memory()
        if resident_memory() < most_memory:
            return False
    jax.clear_caches()
    gc.collect()
    release_memory()
    _log.warning(
        "compiled programs took %.2g GB and %d memory mappings and were cleared; the next calls compile again",
        1e-9 * memory,
        mappings,
    )
    return True


def resident_memory() -> int:
    """Resident memory of this process [bytes]; 0 if the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


@functools.cache
def memory_of_machine() -> float:
    """Memory [bytes] of this machine, or of the container if it may have less; 0 if the system does not report it."""
    limits = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        limits.append(float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES"))
    # Of version 2 and of version 1 of Linux' control groups; "max" is no limit.
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            limits.append(float(Path(path).read_text()))
    return min(limits, default=0.0)


def count_mappings() -> int:
    """Number of memory mappings of this process; 0 if the system does not report it."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def most_mappings() -> int:
    """Number of memory mappings that a process may have."""
    try:
        return int(Path("/proc/sys/vm/max_map_count").read_bytes())
    except OSError:
        return 65_530


def release_memory() -> None:
    """Return freed memory to the system: 240 of 700 MB after compiling a hybrid scene. Only glibc keeps so much freed
    memory."""
    if hasattr(_libc, "malloc_trim"):
        _libc.malloc_trim(0)


_libc = ctypes.CDLL(None)
