"""Shared code of the command lines: how they start, and how Ctrl-C ends them."""

import gc
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable
from types import FrameType
from typing import NoReturn

#: Longest time [s] that the main thread may take to report what was saved before the process ends without the report.
PATIENCE = 1.0

#: The exit status that shells report for a program ended by SIGINT.
INTERRUPTED = 130

_ending = threading.Lock()


def import_quietly() -> None:
    """End the process with one line instead of a traceback if Ctrl-C arrives while `python -m` imports the packages.

    A `KeyboardInterrupt` would be lost if it arrived during garbage collection, where JAX calls back into Python.
    """
    program = sys.orig_argv[sys.orig_argv.index("-m") + 1]

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _end(f"python -m {program}: interrupted")

    # A shell may have told this process to ignore the signal.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, end)


def run_and_exit(main: Callable[[], int], program: str) -> NoReturn:
    """Run a command line and end the process.

    A command line takes seconds, so it compiles quickly. It also switches off garbage collection, which would take up
    to a fifth of the time because JAX holds many objects. It shows each warning once, as one line.

    **Arguments:** as for `interruptible`.
    """
    # Imported here, because this module must load before JAX does.
    from .compilation.xla_cpu import compile_quickly

    # After the filters of the user; those of Python hide what concerns developers only. Python's filter "once" repeats a
    # warning for each module and thread that it points to.
    warnings.simplefilter("always", UserWarning, append=True)
    shown_texts: set[str] = set()

    def show(message: Warning | str, *_: object) -> None:
        if str(message) not in shown_texts:
            shown_texts.add(str(message))
            print(f"python -m {program}: warning: {message}", file=sys.stderr)

    warnings.showwarning = show
    gc.disable()
    compile_quickly()
    status = interruptible(main, program)
    gc.freeze()
    sys.exit(status)


def interruptible(main: Callable[[], int], program: str) -> int:
    """Run a command line; Ctrl-C ends it within two seconds, even while XLA compiles.

    Python raises `KeyboardInterrupt` only when the main thread returns from C++, which takes up to half a minute while
    XLA compiles. Python's wake-up descriptor therefore also notifies a second thread, which ends the process if the
    main thread does not. The process ends without finalization, which would wait for compilations or crash in them; all
    results are on disk by then.

    **Arguments:** `main`: the command line, a function that returns the exit status; `program`: its name.

    **Returns:** the exit status of `main`.
    """
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    read_end, write_end = os.pipe()
    os.set_blocking(write_end, False)
    signal.set_wakeup_fd(write_end)

    def watch() -> None:
        while signal.SIGINT not in os.read(read_end, 64):
            pass
        # Other threads otherwise keep the interpreter for 5 ms each time the main thread needs it to read a file.
        sys.setswitchinterval(1e-5)
        time.sleep(PATIENCE)
        _end(f"python -m {program}: interrupted; run the same command again to resume")

    threading.Thread(target=watch, daemon=True).start()
    try:
        return main()
    except KeyboardInterrupt as interrupt:
        _end(f"python -m {program}: {str(interrupt) or 'interrupted; run the same command again to resume'}")


def _end(message: str) -> NoReturn:
    """End the process with one line."""
    # The first thread that gets here ends the process; the other one waits.
    _ending.acquire()
    sys.stdout.flush()
    # On a terminal, the status line is still visible.
    start = "\r\x1b[K" if sys.stderr.isatty() else ""
    print(f"{start}{message}", file=sys.stderr, flush=True)
    os._exit(INTERRUPTED)
