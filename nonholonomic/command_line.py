"""Ctrl-C on the command lines: the process ends at once, with one line and no traceback."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NoReturn

#: How long the main thread may take to tell what was saved [s] before the process ends without that.
PATIENCE = 1.0

#: The exit status of a program that SIGINT ended, as shells report it.
INTERRUPTED = 130

_ending = threading.Lock()


def import_quietly() -> None:
    """While `python -m` imports the packages, Ctrl-C ends it with one line instead of a traceback."""
    program, shown = sys.orig_argv[sys.orig_argv.index("-m") + 1], sys.excepthook

    def hook(kind: type[BaseException], error: BaseException, trace: Any) -> None:
        if issubclass(kind, KeyboardInterrupt):
            print(f"python -m {program}: interrupted", file=sys.stderr)
        else:
            shown(kind, error, trace)

    sys.excepthook = hook


def interruptible(main: Callable[[], int], program: str) -> int:
    """Run a command line; Ctrl-C ends it within two seconds, even while XLA compiles.

    Python raises `KeyboardInterrupt` only when the main thread is back from C++, which takes up to half a minute while XLA
    compiles. So a second thread, which Python's wake-up descriptor tells of the signal at once, ends the process if the main
    thread does not. The process ends without finalization, which would wait for compilations or crash in them; all that was
    saved is on the disk by then.

    **Arguments:** `main`: the command line, which returns the exit status; `program`: how it is called.

    **Returns:** the exit status of `main`.
    """
    watched, written = os.pipe()
    os.set_blocking(written, False)
    signal.set_wakeup_fd(written)

    def watch() -> None:
        while signal.SIGINT not in os.read(watched, 64):
            pass
        time.sleep(PATIENCE)
        _end(f"python -m {program}: interrupted; run the same command again to resume")

    threading.Thread(target=watch, daemon=True).start()
    try:
        return main()
    except KeyboardInterrupt as interrupt:
        _end(f"python -m {program}: {str(interrupt) or 'interrupted; run the same command again to resume'}")


def _end(message: str) -> NoReturn:
    """End the process with one line."""
    # The first thread to come here ends the process, the other one waits for that.
    _ending.acquire()
    sys.stdout.flush()
    # On a terminal the status line is still there.
    start = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{start}{message}", file=sys.stderr, flush=True)
    os._exit(INTERRUPTED)
