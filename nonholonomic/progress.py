"""What a long call is doing, in one line on a terminal or in a notebook."""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from types import TracebackType
from typing import Any

from .compilation_cache import is_off
from .compiled_programs import forget_programs_if_many

#: How often the line is written [s]; a call that ends sooner shows nothing. How often is looked whether it is time [s], and
#: how long after the last call [s]: starting a thread for every call would cost short ones a millisecond.
INTERVAL, TICK, LINGER = 0.5, 0.1, 5.0

#: Functions of JAX, by their module and how their names begin, that are at work while a program is made.
COMPILERS = (
    ("jax._src.interpreters.partial_eval", "trace_to_jaxpr"),
    ("jax._src.interpreters.mlir", "lower_jaxpr"),
    ("jax._src.compiler", ""),
)


class Progress:
    """A line that says what is being done, and once items are counted, how many are done, how fast, and how many are left.

    It is a context. Of several, one inside the other, the innermost that counts has the line, or else the outermost. What is
    left of the line in the end is nothing, or what the outermost has counted.
    A separate thread writes the line, because compiling blocks the caller's for many seconds. Nothing is
    written where standard error is neither a terminal nor a notebook's, nor with `NONHOLONOMIC_PROGRESS=0`.
    """

    def __init__(self, total: int | None, unit: str = "", doing: str = "compiling", *, shown: bool = True):
        """State what is to be done.

        **Arguments:**

        - `total`: how many items are to be done, `None` if none are counted; `unit`: what one is called.
        - `doing`: what is done before `begin`; while JAX makes a program for the caller, the line says "compiling".
        - `shown`: whether to show anything at all, of calls within this one, too.
        """
        self._total, self._unit, self._doing = total, unit, doing
        self._heard = not is_off("NONHOLONOMIC_PROGRESS") and is_watched()
        self._shown = shown
        self._done, self._first, self._since, self._notes = 0, 0, None, {}
        self._bar: Any = None

    def begin(self, done: int = 0) -> None:
        """The preparations are over; `done` items had been done before."""
        with _LINE.lock:
            self._done = self._first = done
            self._since = time.time()
            self._clear()

    def advance(self, count: int, **notes: Any) -> None:
        """`count` more items are done; `notes` are shown beside their number."""
        with _LINE.lock:
            self._done, self._notes = self._done + count, notes
            if self._bar is not None and self._since is not None:
                self._bar.set_postfix(notes, refresh=False)
                self._bar.update(count)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Takes the line away while something else is written."""
        with _LINE.lock:
            self._clear()
            yield

    def __enter__(self) -> "Progress":
        self._caller, self._start = threading.get_ident(), time.time()
        if self._heard:
            with _LINE.lock:
                outer = [speaker for speaker in _LINE.speakers if speaker._caller == self._caller]
                self._shown &= all(speaker._shown for speaker in outer)
                self._inner = bool(outer)
                if self._shown:
                    self._tqdm = bar_class()
                _LINE.add(self)
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._heard:
            with _LINE.lock:
                _LINE.speakers.remove(self)
                if self._bar is not None:
                    self._bar.close()
                self._bar = None

    def _show(self) -> None:
        """Writes the line, if it is time."""
        if self._bar is not None and time.time() - self._written < INTERVAL:
            return
        self._written = time.time()
        compiling = is_making_programs(self._caller)
        if self._bar is None:
            self._bar = self._line()
        if self._since is None:
            self._bar.set_description_str("compiling" if compiling else self._doing, refresh=False)
        else:
            self._bar.set_description("compiling" if compiling else None, refresh=False)
        self._bar.refresh()

    def _line(self) -> Any:
        """The line in its present state, not yet written."""
        # With a delay, or tqdm writes the line before all is known of it.
        options = {"delay": 1e-9, "leave": self._since is not None and not self._inner}
        if self._since is None:
            bar = self._tqdm(bar_format="{desc} [{elapsed}]", **options)
            bar.start_t = self._start
            return bar
        # The rate is that of the whole run, without the preparations: items are done in blocks, some cheap, some expensive.
        bar = self._tqdm(total=self._total, initial=self._first, unit=self._unit, smoothing=0, **options)
        bar.start_t = self._since
        bar.n = self._done
        bar.set_postfix(self._notes, refresh=False)
        return bar

    def _clear(self) -> None:
        """Takes the line away, until it is written again."""
        if self._bar is not None:
            self._bar.leave = False
            self._bar.close()
        self._bar = None


class _Line:
    """The line of the whole process, whose standard error is one, and the thread that writes it.

    - `speakers`: who has something to say, the outermost call first.
    """

    def __init__(self):
        self.lock, self.speakers = threading.RLock(), []
        self._writer: threading.Thread | None = None

    def add(self, speaker: Progress) -> None:
        """One more has something to say."""
        self.speakers.append(speaker)
        if self._writer is None or not self._writer.is_alive():
            self._writer = threading.Thread(target=self._write, daemon=True)
            self._writer.start()

    def _write(self) -> None:
        last = time.time()
        while True:
            time.sleep(TICK)
            with self.lock:
                if self.speakers:
                    last = time.time()
                elif time.time() - last > LINGER:
                    self._writer = None
                    return
                self._update()

    def _update(self) -> None:
        shown = [speaker for speaker in self.speakers if speaker._shown and time.time() - speaker._start >= INTERVAL]
        if not shown:
            return
        told = next((speaker for speaker in reversed(shown) if speaker._total is not None), shown[0])
        for other in shown:
            if other is not told:
                other._clear()
        told._show()


_LINE = _Line()


@contextmanager
def status_line(doing: str, shown: bool = True) -> Iterator[Progress]:
    """Says what a call is doing that takes long when it is new to the compiler; decorates functions, too.

    Before that, programs are forgotten if they take too much memory (`compiled_programs.py`).
    """
    forget_programs_if_many()
    with Progress(None, doing=doing, shown=shown) as line:
        yield line


def is_making_programs(thread: int) -> bool:
    """Whether JAX is tracing or compiling in a thread; JAX does not report when it begins to. Costs 0.5 ms, twice a second."""
    frame = sys._current_frames().get(thread)
    while frame is not None:
        module, name = frame.f_globals.get("__name__"), frame.f_code.co_name
        if any(module == compiler and name.startswith(begin) for compiler, begin in COMPILERS):
            return True
        frame = frame.f_back
    return False


def is_watched() -> bool:
    """Whether somebody may be looking: standard error is a terminal, or this is a notebook."""
    # A stream that is closed does not answer.
    is_open = not getattr(sys.stderr, "closed", False)
    return (is_open and getattr(sys.stderr, "isatty", bool)()) or is_notebook()


def is_notebook() -> bool:
    """Whether this is the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return "IPKernelApp" in getattr(shell, "config", {})


def bar_class() -> type:
    """The bar of tqdm for a terminal, or for a notebook that has the widgets for it.

    `tqdm.auto` chooses too, but warns where there are no widgets, and sets the warning filters while it is imported.
    """
    if is_notebook() and find_spec("ipywidgets") is not None:
        from tqdm.notebook import tqdm
    else:
        from tqdm import tqdm
    return tqdm
