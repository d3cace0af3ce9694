"""Status lines for long calls, on a terminal or in a notebook."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import TracebackType
from typing import Any, ClassVar

import jax

from .compilation.cache import forget_programs_if_many, is_off
from .compilation.xla_cpu import on_cpu

#: How often the line is written [s] (a shorter call shows nothing), how often the thread checks whether the line is due
#: [s], and how long the thread waits for another call [s]: starting a thread for every call would cost short calls a
#: millisecond.
INTERVAL, TICK, LINGER = 0.5, 0.1, 5.0

#: Where nobody watches, in a log or in the window of an editor, the time [s] after which a call writes a line that stays.
PATIENCE = 2.0

#: The time [s] after which a call that still compiles says how long that takes and how often it happens.
EXPLAINED = 3.0

#: Functions of JAX that run while a program is traced or compiled: module, and start of the function's name.
COMPILERS = (
    ("jax._src.interpreters.partial_eval", "trace_to_jaxpr"),
    ("jax._src.interpreters.mlir", "lower_jaxpr"),
    ("jax._src.compiler", ""),
)


class Progress:
    """A status line: what a call does and, once it counts items, how many are done, how fast, and how many are left.
    Use it as a context manager. If contexts are nested, the innermost context that counts items owns the line,
    otherwise the outermost. The line disappears at the end, unless the outermost context counts items.

    A separate thread writes the line, because compiling blocks the caller's thread for many seconds. If standard error is
    neither a terminal nor a notebook's, the first call that takes longer than 2 s writes a single line, and later calls
    nothing. With `NONHOLONOMIC_PROGRESS=0`, nothing is written.
    """

    #: The process has a single line, because it has one standard error: the calls that have something to show, the outermost
    #: first, and the thread that writes the line.
    _lock = threading.RLock()
    _speakers: ClassVar[list["Progress"]] = []
    _writer: ClassVar[threading.Thread | None] = None
    _has_told: ClassVar[bool] = False

    def __init__(self, total: int | None, unit: str = "", doing: str = "compiling", *, shown: bool = True):
        """Describe the work.

        **Arguments:**

        - `total`: number of items, `None` if none are counted; `unit`: name of an item.
        - `doing`: activity before `begin`; while JAX traces or compiles for the caller, the line says "compiling".
        - `shown`: whether to show anything at all, including calls within this one.
        """
        self._total, self._unit, self._doing = total, unit, doing
        # A closed stream raises an error.
        is_open = not getattr(sys.stderr, "closed", sys.stderr is None)
        self._watched = (is_open and getattr(sys.stderr, "isatty", bool)()) or is_notebook()
        can_tell = is_open and not self._has_told
        self._heard = not is_off("NONHOLONOMIC_PROGRESS") and (self._watched or can_tell)
        self._shown = shown
        self._done, self._first, self._since, self._notes = 0, 0, None, {}
        self._bar: Any = None

    def begin(self, done: int = 0) -> None:
        """Start counting; `done` items were done before."""
        with self._lock:
            self._done = self._first = done
            self._since = time.time()
            self._clear()

    def advance(self, count: int, **notes: object) -> None:
        """Count `count` more items as done; `notes` are shown beside their number."""
        with self._lock:
            self._done, self._notes = self._done + count, notes
            if self._bar is not None and self._since is not None:
                self._bar.set_postfix(notes, refresh=False)
                self._bar.update(count)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Remove the line while something else is written."""
        with self._lock:
            self._clear()
            yield

    def __enter__(self) -> "Progress":
        self._caller, self._start = threading.get_ident(), time.time()
        if self._heard:
            with self._lock:
                outer = [speaker for speaker in self._speakers if speaker._caller == self._caller]
                self._shown &= all(speaker._shown for speaker in outer)
                self._inner = bool(outer)
                if self._shown:
                    self._tqdm = bar_class()
                self._speakers.append(self)
                if Progress._writer is None or not Progress._writer.is_alive():
                    Progress._writer = threading.Thread(target=Progress._write, daemon=True)
                    Progress._writer.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._heard:
            with self._lock:
                self._speakers.remove(self)
                if self._bar is not None:
                    self._bar.close()
                self._bar = None

    def _show(self) -> None:
        """Write the line, if it is due."""
        if self._bar is not None and time.time() - self._written < INTERVAL:
            return
        self._written = time.time()
        if not self._watched and (self._has_told or self._written - self._start < PATIENCE):
            return
        # JAX does not report whether it is tracing or compiling in a thread. The check takes 0.5 ms, twice a second.
        compiling, frame = False, sys._current_frames().get(self._caller)
        while frame is not None and not compiling:
            module, name = frame.f_globals.get("__name__"), frame.f_code.co_name
            compiling = any(module == compiler and name.startswith(begin) for compiler, begin in COMPILERS)
            frame = frame.f_back
        words = "compiling" if compiling else self._doing
        if words == "compiling" and self._written - self._start > EXPLAINED:
            often = " (kept on disk)" if getattr(jax.config, "jax_compilation_cache_dir", None) else " and session"
            words += f", usually up to 30 s, once for each kind of call{often}"
        if not self._watched:
            Progress._has_told, doing = True, "compiling, the first time only" if compiling else self._doing
            print(f"nonholonomic: {doing} (NONHOLONOMIC_PROGRESS=0 hides this line)", file=sys.stderr)
            return
        counts = self._since is not None
        if self._bar is None:
            # The rate is that of the whole run without the preparations, because chunks of items differ in cost.
            items = {"total": self._total, "initial": self._first, "unit": self._unit, "smoothing": 0}
            # Without a delay, tqdm writes the line before everything in it is known.
            options = {"delay": 1e-9, "leave": counts and not self._inner}
            self._bar = self._tqdm(**(items if counts else {"bar_format": "{desc} [{elapsed}]"}), **options)
            self._bar.start_t, self._bar.n = self._since or self._start, self._done
            self._bar.set_postfix(self._notes, refresh=False)
        if counts:
            self._bar.set_description("compiling" if compiling else None, refresh=False)
        else:
            self._bar.set_description_str(words, refresh=False)
        self._bar.refresh()

    @classmethod
    def _write(cls) -> None:
        """Write the line whenever it is due, until nothing has been shown for a while."""
        last = time.time()
        while True:
            time.sleep(TICK)
            with cls._lock:
                if cls._speakers:
                    last = time.time()
                elif time.time() - last > LINGER:
                    Progress._writer = None
                    return
                due = [line for line in cls._speakers if line._shown and time.time() - line._start >= INTERVAL]
                owner = next((line for line in reversed(due) if line._total is not None), due[0] if due else None)
                for line in due:
                    if line is not owner:
                        line._clear()
                if owner is not None:
                    owner._show()

    def _clear(self) -> None:
        """Remove the line until it is written again."""
        if self._bar is not None:
            self._bar.leave = False
            self._bar.close()
        self._bar = None


@contextmanager
def status_line(doing: str, shown: bool = True) -> Iterator[Progress]:
    """Show a status line while a call compiles; also a decorator for functions. First clear programs that take too much
    memory (`compilation/cache.py`). The call runs on the CPU.
    """
    forget_programs_if_many()
    with on_cpu(), Progress(None, doing=doing, shown=shown) as line:
        yield line


def is_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return "IPKernelApp" in getattr(shell, "config", {})


def bar_class() -> type:
    """The tqdm bar for a terminal, or for a notebook that has the widgets for it.

    `tqdm.auto` also chooses, but it warns if there are no widgets, and sets the warning filters when it is imported.
    """
    if is_notebook() and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm
    else:
        from tqdm import tqdm
    return tqdm
