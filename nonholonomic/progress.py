"""What a long call is doing, in one line on a terminal or in a notebook."""

import os
import sys
import threading
import time
from types import TracebackType
from typing import Any

#: How often the line is written [s]; a call that ends sooner shows nothing.
INTERVAL = 0.5


class Progress:
    """A line that first says what is being prepared, then how many items are done, how fast, and how many are left.

    It is a context. A separate thread writes the line, because compiling blocks the caller's for many seconds. Nothing is
    written where standard error is neither a terminal nor a notebook's, nor with `NONHOLONOMIC_PROGRESS=0`.
    """

    def __init__(self, total: int, unit: str, preparing: str = "compiling", *, shown: bool = True):
        """State what is to be done.

        **Arguments:**

        - `total`: how many items are to be done, `unit`: what one is called.
        - `preparing`: what is done before the first `advance` or `begin`.
        - `shown`: whether to show anything at all.
        """
        self._total, self._unit, self._preparing = total, unit, preparing
        self._shown = shown and os.environ.get("NONHOLONOMIC_PROGRESS") != "0" and is_watched()
        self._done, self._first, self._since, self._notes = 0, 0, None, {}
        self._bar: Any = None
        self._lock, self._ended = threading.Lock(), threading.Event()

    def begin(self, done: int = 0) -> None:
        """The preparations are over; `done` items had been done before."""
        with self._lock:
            self._done = self._first = done
            self._since = time.time()
            self._close()

    def advance(self, count: int, **notes: Any) -> None:
        """`count` more items are done; `notes` are shown beside their number."""
        with self._lock:
            self._done, self._notes = self._done + count, notes
            if self._bar is not None and self._since is not None:
                self._bar.set_postfix(notes, refresh=False)
                self._bar.update(count)

    def __enter__(self) -> "Progress":
        if self._shown:
            # Imported here, and only if needed, because importing it changes the warning filters for a moment.
            from tqdm.auto import tqdm

            self._tqdm = tqdm
            threading.Thread(target=self._write, daemon=True).start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._ended.set()
        with self._lock:
            self._close()

    def _write(self) -> None:
        while not self._ended.wait(INTERVAL):
            with self._lock:
                if self._ended.is_set():
                    return
                if self._bar is None:
                    self._bar = self._line()
                else:
                    self._bar.refresh()

    def _line(self) -> Any:
        """The line in its present state."""
        # `disable=None` lets tqdm find out whether anybody is watching.
        if self._since is None:
            return self._tqdm(desc=self._preparing, bar_format="{desc} [{elapsed}]", leave=False, disable=None)
        # The rate is that of the whole run, without the preparations: items are done in blocks, some cheap, some expensive.
        bar = self._tqdm(total=self._total, initial=self._first, unit=self._unit, smoothing=0, disable=None)
        bar.start_t = self._since
        bar.set_postfix(self._notes, refresh=False)
        bar.update(self._done - self._first)
        bar.refresh()
        return bar

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
        self._bar = None


def is_watched() -> bool:
    """Whether somebody may be looking: standard error is a terminal, or this is a notebook."""
    return getattr(sys.stderr, "isatty", bool)() or "ipykernel" in sys.modules
