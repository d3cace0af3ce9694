"""Compiled programs kept on disk, so that a second process need not compile them again.

The store is JAX's persistent compilation cache. This module adds two things: a separate folder for every jaxlib, kind of
processor and set of XLA flags, because code compiled for one processor may not run on another; and a check of the entries,
because a process that is killed while writing leaves half an entry, which JAX would warn about forever.
"""

import contextlib
import errno
import hashlib
import logging
import os
import platform
import uuid
import warnings
import zlib
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental.compilation_cache import compilation_cache

#: The file that tells which entries were found sound, a line for each.
LOOKED_AT = ".looked_at"

#: What switches something off, as the value of an environment variable.
OFF = ("0", "off", "false", "no")

#: How writing fails where there is no room: the disk is full, or the user's share of it, or a file may not be so long.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_log = logging.getLogger(__name__)


def enable_compilation_cache(folder: Any = None) -> Path | None:
    """Keep compiled programs on disk, where later processes find them.

    Call it before the first computation. A folder that was already chosen, by JAX's own `jax_compilation_cache_dir` or by an
    earlier call, is kept unless another is given. One of JAX's own is left as it is: unless
    `jax_persistent_cache_min_compile_time_secs` is 0, programs that compile in less than a second are not kept in it.

    In other folders an entry that was written since the last look, in any process, is looked at once: if it does not
    decompress, because its writer was killed or its copy is damaged, it is removed, and costs one compilation. What cannot be
    seen so stays, and costs a compilation in every process: an entry that the disk damages later without a trace, one that
    decompresses to something else, and a bad one compressed by zstandard, which JAX uses where that package is installed.
    Nothing else is ever removed: delete the folder to be rid of such entries, and to reclaim its space. It holds code, so it
    should be where nobody else can write.

    **Arguments:** `folder`: where to keep them, by default `nonholonomic` in the user's cache folder (`XDG_CACHE_HOME`, or
    `~/.cache`). In it there is a folder for every version of jaxlib, kind of processor and set of XLA flags.

    **Returns:** the folder in use; `None` if `NONHOLONOMIC_CACHE` (0, off, false or no) forbids it or it cannot be written,
    which is logged as a warning. So is a full disk, from which programs are still read.

    **Raises:** `ValueError` for a folder that is no path.

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
    cache_home = os.environ.get("XDG_CACHE_HOME", "")
    # The specification of XDG_CACHE_HOME has relative paths ignored.
    return (Path(cache_home) if os.path.isabs(cache_home) else Path.home() / ".cache") / "nonholonomic"


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


def is_off(variable: str) -> bool:
    """Whether an environment variable switches off what it is named for."""
    return os.environ.get(variable, "").strip().lower() in OFF


def remove_damaged(folder: Path) -> None:
    """Remove the entries that do not decompress, among those written since they were last looked at.

    JAX neither writes entries at once nor replaces bad ones: without this, a program whose writer was killed (Ctrl-C on a
    command line does that too) is compiled in every later process. To look at 600 known entries takes 30 ms.

    **Raises:** `OSError` if the folder cannot be written; a full disk is only logged.
    """
    looked_at = folder / LOOKED_AT
    known = set(looked_at.read_bytes().split(b"\n")) if looked_at.exists() else set()
    found = []
    for entry in folder.glob("*-cache"):
        # Another process may remove one, too.
        try:
            line = _line(entry)
            if line in known or sound(entry.read_bytes()):
                found.append(line)
            else:
                entry.unlink()
        except FileNotFoundError:
            pass
    # Under a name of its own: of processes that start together each writes one, and the last one stays.
    looking = folder / f"{LOOKED_AT}-{uuid.uuid4().hex}"
    try:
        looking.write_bytes(b"\n".join([b"sound:", *found]))
        os.replace(looking, looked_at)
    except OSError as error:
        looking.unlink(missing_ok=True)
        if error.errno not in NO_ROOM:
            raise
        _log.warning("no more compiled programs are kept in %s: %s", folder, error)


def _line(entry: Path) -> bytes:
    """An entry's name, and what changes when it is written, even if its modification time is set back: that of its state."""
    state = entry.stat()
    return f"{entry.name} {state.st_size} {state.st_mtime_ns} {state.st_ctime_ns}".encode()


def sound(entry: bytes) -> bool:
    """Whether an entry decompresses; zlib's checksum covers every byte of it."""
    if entry.startswith(b"\x28\xb5\x2f\xfd"):  # zstandard's mark
        return True
    try:
        zlib.decompress(entry)
    except zlib.error:
        return False
    return True


def kept_text(folder: Path | None, facts: Any, compute: Callable[[], str]) -> str:
    """A text that takes seconds to compute, such as a page with sliders; kept beside the compiled programs.

    **Arguments:** `folder`: of `enable_compilation_cache`, `None` if nothing is kept; `facts`: all that the text depends on
    besides these packages, with a `repr`.
    """
    if folder is None:
        return compute()
    kept = hashlib.sha256(repr((facts, version("jax"), version("equinox"), version("diffrax"))).encode())
    for path in sorted(_sources()):
        kept.update(path.read_bytes())
    path = folder / f"text-{kept.hexdigest()[:32]}"
    try:
        return zlib.decompress(path.read_bytes()).decode()
    except (OSError, zlib.error):
        text = compute()
    # As a whole, for another process may read it; a full disk is no reason to stop.
    with contextlib.suppress(OSError):
        written = path.with_name(f".{uuid.uuid4().hex}")
        written.write_bytes(zlib.compress(text.encode(), 1))
        os.replace(written, path)
    return text


def _sources() -> Iterator[Path]:
    """The sources of the packages that were installed with this file."""
    root = Path(__file__).parent.parent
    for package in ("nonholonomic", "tippe", "stroller"):
        yield from (path for kind in ("py", "js", "html") for path in (root / package).rglob(f"*.{kind}"))
