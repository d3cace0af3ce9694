"""Compiled programs kept on disk, so that a second process need not compile them again.

The store is JAX's persistent compilation cache. This module adds two things: a separate folder for every jaxlib, kind of
processor and set of XLA flags, because code compiled for one processor may not run on another; and a check of the entries,
because a process that is killed while writing leaves half an entry, which JAX would warn about forever.
"""

import hashlib
import logging
import os
import platform
import warnings
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

#: Empty file whose modification time says when the entries were last checked, and the file that replaces it.
LOOKED_AT, LOOKING = ".looked_at", ".looking"

#: How coarse a file system's clock may be [s].
COARSE = 2.0

_log = logging.getLogger(__name__)


def enable_compilation_cache(folder: Any = None) -> Path | None:
    """Keep compiled programs on disk, where later processes find them.

    Call it before the first computation. A folder that was already chosen, by JAX's own `jax_compilation_cache_dir` or by an
    earlier call, is kept unless another is given. An entry that is cut short or damaged is removed and costs a compilation
    (entries compressed by zstandard, where that package is installed, are left for JAX to refuse). Nothing else is ever
    removed: delete the folder to reclaim its space. It holds code, so it should be where nobody else can write.

    **Arguments:** `folder`: where to keep them, by default `nonholonomic` in the user's cache folder (`XDG_CACHE_HOME`, or
    `~/.cache`). In it there is a folder for every version of jaxlib, kind of processor and set of XLA flags.

    **Returns:** the folder in use; `None` if `NONHOLONOMIC_CACHE=0` forbids it or it cannot be written, which is logged as a
    warning.

    **Example:**

    ```
    >>> import tempfile
    >>> import nonholonomic
    >>> folder = nonholonomic.enable_compilation_cache(tempfile.mkdtemp())
    >>> folder.name.split("-")[0], folder.is_dir()
    ('jaxlib', True)

    ```
    """
    if os.environ.get("NONHOLONOMIC_CACHE") == "0":
        return None
    settings: Any = jax.config
    chosen = settings.jax_compilation_cache_dir
    if folder is None and chosen:
        return Path(chosen)
    try:
        place = (user_folder() if folder is None else Path(folder)).expanduser() / environment_name()
        place.mkdir(parents=True, exist_ok=True)
        remove_damaged(place)
    except (OSError, RuntimeError) as error:
        # Logged, not a Python warning: where warnings are errors, a cache must not stop a computation.
        _log.warning("compiled programs are not kept: %s", error)
        return None
    if chosen != str(place):
        # JAX opens its folder only once.
        compilation_cache.reset_cache()
    settings.update("jax_compilation_cache_dir", str(place))
    settings.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    settings.update("jax_persistent_cache_min_entry_size_bytes", -1)
    # A limit would need a lock, which parallel processes wait for.
    settings.update("jax_compilation_cache_max_size", -1)
    # Another process may be writing the entry that this one reads. It is compiled then; that is no reason to stop.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry", UserWarning)
    return place


def user_folder() -> Path:
    """The package's folder in the user's cache folder, the same on all systems.

    **Raises:** `RuntimeError` if the user has no home.
    """
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The specification of XDG_CACHE_HOME has relative paths ignored.
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "nonholonomic"


def environment_name() -> str:
    """A name for all that compiled code depends on besides the program: jaxlib, the processor, and the flags of XLA."""
    machine = "\n".join([platform.system(), platform.machine(), processor(), os.environ.get("XLA_FLAGS", "")])
    return f"jaxlib-{version('jaxlib')}-{hashlib.sha256(machine.encode()).hexdigest()[:12]}"


def processor() -> str:
    """The processor's kind and features, as far as the system says."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    # All cores are taken to be alike. On ARM the features have another name.
    kinds = ("vendor_id", "cpu family", "model", "flags", "CPU implementer", "CPU part", "Features")
    lines_by_name = dict(line.split(":", 1) for line in reversed(lines) if ":" in line)
    lines_by_name = {name.strip(): value.strip() for name, value in lines_by_name.items()}
    return "\n".join(lines_by_name.get(name, "") for name in kinds)


def remove_damaged(folder: Path) -> None:
    """Remove the entries that do not decompress, among those changed since the last check.

    **Raises:** `OSError` if the folder cannot be written.
    """
    looking, looked_at = folder / LOOKING, folder / LOOKED_AT
    looking.write_bytes(b"")
    last = looked_at.stat().st_mtime - COARSE if looked_at.exists() else 0.0
    for entry in folder.glob("*-cache"):
        # Another process may remove one, too.
        try:
            if entry.stat().st_mtime >= last and not sound(entry.read_bytes()):
                entry.unlink()
        except FileNotFoundError:
            pass
    # What is written from here on is later than `looking`.
    os.replace(looking, looked_at)


def sound(entry: bytes) -> bool:
    """Whether an entry decompresses; zlib's checksum covers every byte of it."""
    if entry.startswith(b"\x28\xb5\x2f\xfd"):  # zstandard's mark
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True
