"""Compiled programs: kept on disk for later processes, and let go before memory is exhausted.

The store is JAX's persistent compilation cache. This module adds a separate folder for every jaxlib, kind of processor
and set of XLA flags, because code compiled for one processor may not run on another. It also checks the entries,
because a process that is killed while writing leaves half an entry, and JAX would warn about this entry in every run.
"""

import contextlib
import ctypes
import errno
import functools
import gc
import hashlib
import logging
import os
import platform
import threading
import uuid
import warnings
import zipfile
import zlib
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache
from jaxtyping import Float

from ..validation import is_traced, replacing

#: The file that lists the entries that passed the check, one per line.
LOOKED_AT = ".looked_at"

#: Values of an environment variable that switch a feature off.
OFF = ("0", "off", "false", "no")

#: Packages whose versions computed files depend on.
PACKAGES = ("jax", "equinox", "diffrax", "numpy", "scipy", "h5py", "matplotlib", "jupyter-threejs-sage")

#: Errors of writing without space: the disk is full, the user's quota is used up, or the file is too long.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_log = logging.getLogger(__name__)


def enable_compilation_cache(folder: str | os.PathLike[str] | None = None) -> Path | None:
    """Keep compiled programs on disk, where later processes find them. Call this function before the first computation.
    If JAX's `jax_compilation_cache_dir` or an earlier call already chose a folder, that folder is kept unless you pass
    another. In JAX's own folder, programs that compile in less than a second are not stored unless
    `jax_persistent_cache_min_compile_time_secs` is 0.

    In other folders, each new entry is checked once. An entry that does not decompress, because its writer was killed
    or its copy is damaged, is removed and its program is compiled again. The check misses entries that are damaged
    later, and entries compressed by zstandard, which JAX uses if that package is installed. Each missed entry costs a
    compilation in every process; delete the folder to remove them, and to reclaim space. The folder contains code, so
    choose one where nobody else can write.

    **Arguments:** `folder`: where to store the programs, by default `nonholonomic` in the user's cache folder
    (`XDG_CACHE_HOME`, or `~/.cache`). It gets a subfolder for every version of jaxlib, kind of processor and set of XLA
    flags.

    **Returns:** the folder in use; `None` if `NONHOLONOMIC_CACHE` (0, off, false or no) switches the cache off, or if
    the folder cannot be written, which is logged as a warning. A full disk is also logged; programs can still be read
    from it.

    **Raises:** `ValueError` if the folder is not a path.

    **Example:**

    ```
    >>> import tempfile
    >>> import nonholonomic
    >>> folder = nonholonomic.enable_compilation_cache(tempfile.mkdtemp())
    >>> folder.name.split("-")[0], folder.is_dir()
    ('jaxlib', True)

    ```
    """
    if folder is not None and (not isinstance(folder, str | os.PathLike) or folder == ""):
        raise ValueError(f"folder = {folder!r} must be a path")
    if is_off("NONHOLONOMIC_CACHE"):
        return None
    settings: Any = jax.config
    cache_folder = settings.jax_compilation_cache_dir
    if folder is None and cache_folder:
        return Path(cache_folder)
    try:
        if folder is None:
            cache_home = os.environ.get("XDG_CACHE_HOME", "")
            # The XDG specification says that relative paths must be ignored.
            folder = (Path(cache_home) if os.path.isabs(cache_home) else Path.home() / ".cache") / "nonholonomic"
        place = Path(folder).expanduser() / environment_name()
        place.mkdir(parents=True, exist_ok=True)
        remove_damaged(place)
    except (OSError, RuntimeError) as error:
        # Log instead of warn: if warnings are errors, a cache must not stop a computation.
        _log.warning("compiled programs are not stored: %s", error)
        return None
    if cache_folder != str(place):
        # JAX opens its folder only once.
        compilation_cache.reset_cache()
    settings.update("jax_compilation_cache_dir", str(place))
    settings.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    settings.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # A size limit would need a lock, and parallel processes would wait for it.
    settings.update("jax_compilation_cache_max_size", -1)
    # Another process may be writing the entry that this one reads. Then compile the program and go on.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry", UserWarning)
    return place


def environment_name() -> str:
    """A name for everything, besides the program, that compiled code depends on: jaxlib, the processor, and the XLA
    flags."""
    machine = "\n".join([platform.system(), platform.machine(), processor(), os.environ.get("XLA_FLAGS", "")])
    return f"jaxlib-{version('jaxlib')}-{hashlib.sha256(machine.encode()).hexdigest()[:12]}"


def processor() -> str:
    """The kind and features of the processor, as far as the system reports them."""
    lines = _reported("/proc/cpuinfo").decode().splitlines()
    if not lines:
        return platform.processor()
    # Assume that all cores are alike. ARM calls the features by another name.
    kinds = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")
    lines_by_name = dict(line.split(":", 1) for line in reversed(lines) if ":" in line)
    lines_by_name = {name.strip(): value.strip() for name, value in lines_by_name.items()}
    return "\n".join(lines_by_name.get(name, "") for name in kinds)


def is_off(variable: str) -> bool:
    """Whether an environment variable switches its feature off."""
    return os.environ.get(variable, "").strip().lower() in OFF


def remove_damaged(folder: Path) -> None:
    """Check the entries written since the last check, and remove those that do not decompress.

    JAX neither writes entries atomically nor replaces damaged ones. Without this check, a program whose writer was
    killed (as by Ctrl-C on a command line) would be compiled in every later process. Checking 600 known entries takes
    30 ms.

    **Raises:** `OSError` if the folder cannot be written; a full disk is only logged.
    """
    looked_at = folder / LOOKED_AT
    entries = set(looked_at.read_bytes().split(b"\n")) if looked_at.exists() else set()
    sound_lines = []
    for entry in folder.glob("*-cache"):
        # Another process may remove the entry, too.
        try:
            # The change time changes on every write, even if the modification time is set back.
            state = entry.stat()
            line = f"{entry.name} {state.st_size} {state.st_mtime_ns} {state.st_ctime_ns}".encode()
            if line in entries or sound(entry.read_bytes()):
                sound_lines.append(line)
            else:
                entry.unlink()
        except FileNotFoundError:
            pass
    # Use a unique name: each of several processes that start together writes a file, and the last file remains.
    looking = folder / f"{LOOKED_AT}-{uuid.uuid4().hex}"
    try:
        looking.write_bytes(b"\n".join([b"sound:", *sound_lines]))
        os.replace(looking, looked_at)
    except OSError as error:
        looking.unlink(missing_ok=True)
        if error.errno not in NO_ROOM:
            raise
        _log.warning("compiled programs can no longer be stored in %s: %s", folder, error)


def sound(entry: bytes) -> bool:
    """Whether an entry decompresses; zlib's checksum covers every byte."""
    if entry.startswith(b"\x28\xb5\x2f\xfd"):  # zstandard's mark
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True


def kept_files(folder: Path | None, facts: object, compute: Callable[[], dict[str, bytes]]) -> dict[str, bytes]:
    """Files that take seconds to compute, such as a page with sliders, stored beside the compiled programs.

    **Arguments:** `folder`: that of `enable_compilation_cache`, or `None` to store nothing; `facts`: an object whose
    `repr` contains everything that the files depend on, besides these packages, those in `PACKAGES`, the processor and the
    settings of JAX; `compute`: computes the files, name -> contents.
    """
    if folder is None:
        return compute()
    path = _place(folder, facts)
    try:
        with zipfile.ZipFile(path) as stored:
            return {name: stored.read(name) for name in stored.namelist()}
    except (OSError, ValueError, KeyError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error):
        files = compute()
    # Write the archive as a whole, because another process may read it. A full disk must not stop the program.
    with (
        contextlib.suppress(OSError),
        replacing(path) as scratch,
        zipfile.ZipFile(scratch, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, contents in files.items():
            archive.writestr(name, contents)
    return files


def are_kept(folder: Path | None, facts: object) -> bool:
    """Whether `kept_files` has stored the files of these facts."""
    return folder is not None and _place(folder, facts).exists()


def _place(folder: Path, facts: object) -> Path:
    """The archive of some files."""
    settings: Any = jax.config
    machine = (environment_name(), jax.default_backend(), str(jax.numpy.result_type(float)))
    versions = [platform.python_version()]
    for package in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            versions.append(f"{package} {version(package)}")
    state = (facts, versions, machine, sorted(settings.values.items()))
    digest = hashlib.sha256(repr(state).encode())
    # The packages that were installed with this file.
    packages = [Path(__file__).parents[2] / name for name in ("nonholonomic", "tippe", "stroller")]
    for path in sorted(path for package in packages for path in package.rglob("*")):
        if path.suffix in (".py", ".js", ".html"):
            digest.update(path.read_bytes())
    return folder / f"files-{digest.hexdigest()[:32]}"


# Keep the number of compiled programs small: one program for many sizes, and none kept until memory is exhausted.
#
# A program of a hybrid scene takes 60 to 180 MB and 200 to 800 memory mappings. Linux allows 65 530 mappings per process,
# and a compiler that gets no more mappings crashes the process.

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


def padded(values: Float[np.ndarray, "... times"], least: int) -> Float[np.ndarray, "... more"]:
    """Values padded to a power of two of at least `least` and `LEAST_PADDED` by repeating the last one, so that one
    program serves many sizes.

    **Example:**

    >>> import numpy as np
    >>> from nonholonomic.compilation.cache import padded
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
    pages = _reported("/proc/self/statm").split()
    return int(pages[1]) * os.sysconf("SC_PAGE_SIZE") if pages else 0


@functools.cache
def memory_of_machine() -> float:
    """Memory [bytes] of this machine, or of the container if it may have less; 0 if the system does not report it."""
    limits = []
    with contextlib.suppress(AttributeError, ValueError, OSError):
        limits.append(float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES"))
    # Of version 2 and of version 1 of Linux' control groups; "max" is no limit.
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(ValueError):
            limits.append(float(_reported(path)))
    return min(limits, default=0.0)


def count_mappings() -> int:
    """Number of memory mappings of this process; 0 if the system does not report it."""
    return _reported("/proc/self/maps").count(b"\n")


def most_mappings() -> int:
    """Number of memory mappings that a process may have."""
    return int(_reported("/proc/sys/vm/max_map_count") or 65_530)


def _reported(path: str) -> bytes:
    """What the system reports in a file; nothing if it has no such file."""
    try:
        return Path(path).read_bytes()
    except OSError:
        return b""


def release_memory() -> None:
    """Return freed memory to the system: 240 of 700 MB after compiling a hybrid scene. Only glibc keeps so much freed
    memory."""
    if hasattr(_libc, "malloc_trim"):
        _libc.malloc_trim(0)


_libc = ctypes.CDLL(None)
