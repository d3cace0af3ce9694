"""Compiled programs in memory: all of them are forgotten before they exhaust it.

A program of a hybrid scene takes 60 to 180 MB and 200 to 800 memory mappings. Linux allows a process 65 530 mappings, and a
compiler that gets no more of them crashes the process.
"""

import ctypes
import gc
import logging
import os
import threading
from pathlib import Path

import jax
import numpy as np

from .validation import is_traced

#: A process may hold so much memory [bytes] before it forgets its programs, if these are why: if there are so many mappings.
MOST_MEMORY, MANY_MAPPINGS = 2_500_000_000, 4_000

#: The part of the mappings that Linux allows from which on programs are forgotten however little memory they take.
PART_OF_MAPPINGS = 0.5

#: With less memory than this [bytes] there cannot be that many mappings, and they are not counted: that takes some ms.
LITTLE_MEMORY = 1_000_000_000

_log = logging.getLogger(__name__)


def forget_programs_if_many(most_memory: int = MOST_MEMORY) -> bool:
    """Forget all compiled programs where they take too much memory, and log a warning of one line.

    A program that is used again is then compiled again, or read from the disk (`enable_compilation_cache`). Inside
    transformations nothing is forgotten, nor outside of the main thread, and where the system does not report what a
    process uses (`/proc`).

    **Arguments:** `most_memory`: that the process may hold [bytes].

    **Returns:** whether programs were forgotten.
    """
    memory = resident_memory()
    if memory < min(LITTLE_MEMORY, most_memory) or threading.current_thread() is not threading.main_thread():
        return False
    # Putting a number on a device compiles nothing, as adding two would.
    if is_traced(jax.device_put(np.zeros(()))):
        return False
    mappings = count_mappings()
    if mappings < PART_OF_MAPPINGS * most_mappings():
        if memory < most_memory or mappings < MANY_MAPPINGS:
            return False
        # What the compiler has freed may go back to the system first.
        release_memory()
        if resident_memory() < most_memory:
            return False
    jax.clear_caches()
    gc.collect()
    release_memory()
    _log.warning(
        "compiled programs took %.2g GB and %d memory mappings and are forgotten; the next calls compile again",
        1e-9 * memory,
        mappings,
    )
    return True


def resident_memory() -> int:
    """The memory of this process [bytes]; 0 where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


def count_mappings() -> int:
    """How many memory mappings this process has; 0 where the system does not say."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def most_mappings() -> int:
    """How many memory mappings a process may have."""
    try:
        return int(Path("/proc/sys/vm/max_map_count").read_bytes())
    except OSError:
        return 65_530


def release_memory() -> None:
    """Give freed memory back to the system: after a compilation of a hybrid scene 240 of 700 MB. Only glibc keeps so much."""
    if hasattr(_libc, "malloc_trim"):
        _libc.malloc_trim(0)


_libc = ctypes.CDLL(None)
