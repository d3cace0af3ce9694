"""Ctrl-C where Python ignores exceptions."""

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any


@contextlib.contextmanager
def no_interrupt_lost() -> Iterator[Callable[[], None]]:
    """A function, as a context, that raises `KeyboardInterrupt` again if Ctrl-C arrived within the context.

    Python raises `KeyboardInterrupt` wherever the main thread happens to be. In finalizers, in callbacks of weak
    references and during garbage collection, where JAX calls back into Python, exceptions are printed and ignored. Then
    a sweep would go on, although its processes had ended. What will be raised again is not printed either.
    """
    arrived, hook = False, sys.unraisablehook

    def print_others(ignored: Any) -> None:
        if not issubclass(ignored.exc_type, KeyboardInterrupt):
            hook(ignored)

    def record_and_raise(number: int, frame: object) -> None:
        nonlocal arrived
        arrived = True
        raise KeyboardInterrupt

    def raise_again() -> None:
        if arrived:
            raise KeyboardInterrupt

    # Only the main thread may set handlers; another handler is somebody else's decision.
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield raise_again
        return
    signal.signal(signal.SIGINT, record_and_raise)
    sys.unraisablehook = print_others
    try:
        yield raise_again
        raise_again()
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = hook
