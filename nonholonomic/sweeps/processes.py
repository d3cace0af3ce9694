"""Processes on this machine, each with its own cores, that compute the chunks of a sweep."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from queue import SimpleQueue
from typing import ParamSpec, TypeVar

import jax

from ..text import shown
from ..validation import require


@contextlib.contextmanager
def local_processes(n: int, threads: int = 1) -> Iterator[Executor]:
    """Processes for `executor=`, which compute on this machine's processor. Each process has its own cores, and uses
    the parent's compilation cache if there is one. Processes start when chunks arrive. A process that dies is replaced,
    and its chunk is retried in another one. The processes end with the context or with the parent process. As for all
    processes that Python's `multiprocessing` starts, put the calls in your script under `if __name__ == "__main__":`.

    **Arguments:** `n`: number of processes; `threads`: number of cores for each.

    **Returns:** the executor, as a context.

    **Raises:** `ValueError` for numbers below 1.

    **Example:** pass it to a table as `executor=processes`.

    ```
    >>> import nonholonomic
    >>> with nonholonomic.local_processes(1) as processes:
    ...     print(processes.submit(sum, [1.0, 2.0]).result())
    3.0

    ```
    """
    for name, value in (("n", n), ("threads", threads)):
        require(value, name, at_least=1)
        if value != int(value):
            raise ValueError(f"{name} = {shown(value)} must be a whole number")
    executor = LocalProcesses(int(n), int(threads))
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


#: The arguments and the result of a call.
P = ParamSpec("P")
T = TypeVar("T")


class LocalProcesses(Executor):
    """An executor of single-process pools, so that a process that dies loses only its own call."""

    def __init__(self, n: int, threads: int):
        """Set the number of processes and the number of cores for each."""
        self._pools: list[ProcessPoolExecutor | None] = [None] * n
        self._threads = threads
        self._free: SimpleQueue[int] = SimpleQueue()
        for place in range(n):
            self._free.put(place)
        self._callers = ThreadPoolExecutor(n)

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **options: P.kwargs) -> Future[T]:
        """Call a function in one of the processes; its future raises `BrokenProcessPool` if the process dies."""
        return self._callers.submit(self._called, function, arguments, options)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, after the calls that have begun."""
        self._callers.shutdown(wait, cancel_futures=cancel_futures)
        for pool in self._pools:
            if pool is not None:
                pool.shutdown(wait, cancel_futures=cancel_futures)

    def _called(self, function: Callable[..., T], arguments: tuple[object, ...], options: dict[str, object]) -> T:
        place = self._free.get()
        try:
            pool = self._pools[place]
            if pool is None:
                pool = self._pools[place] = _started(place, self._threads)
            return pool.submit(function, *arguments, **options).result()
        except BrokenProcessPool:
            self._pools[place] = None
            raise
        finally:
            self._free.put(place)


#: A process inherits the cores of the thread that starts it, and the environment, which all threads share.
_starting = threading.Lock()


#: A process that is killed while it starts, by the system if memory is short, is started again, this many times in all.
MAX_STARTS = 3


def _started(place: int, threads: int) -> ProcessPoolExecutor:
    """A process that has its cores and its settings before its first line runs."""
    for _ in range(MAX_STARTS):
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin)
        with _starting, _starting_in(place, threads):
            others = multiprocessing.active_children()
            # The process starts with the first call.
            first_call = pool.submit(int)
            started = [process for process in multiprocessing.active_children() if process not in others]
        try:
            first_call.result()
            return pool
        except BrokenProcessPool as error:
            pool.shutdown()
            # The exit status of a process that a signal has ended is negative; one that is no longer listed was ended at once.
            if started and not any((process.exitcode or 0) < 0 for process in started):
                # It would end again.
                raise RuntimeError(
                    "a process ended before it computed anything; a script that starts processes must have its own calls under "
                    "`if __name__ == '__main__':`"
                ) from error
    raise RuntimeError(
        f"{MAX_STARTS} processes were killed while they started; if the machine has too little memory, start fewer: "
        "local_processes(n=...)"
    )


@contextlib.contextmanager
def _starting_in(place: int, threads: int) -> Iterator[None]:
    """A context whose processes start with their own environment and cores, and postpone Ctrl-C, as this thread does.

    They compute on the CPU, and share the store of compiled programs. Cores are assigned in turn, and again from the
    first when none is left.
    """
    settings = {"JAX_PLATFORMS": "cpu"}
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    if folder:
        settings |= {"JAX_COMPILATION_CACHE_DIR": str(folder), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        settings |= {"JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}
    with contextlib.ExitStack() as stack:
        old_values = {name: os.environ.get(name) for name in settings}
        os.environ.update(settings)
        for name, value in old_values.items():
            if value is None:
                stack.callback(os.environ.pop, name)
            else:
                stack.callback(os.environ.update, {name: value})
        if hasattr(os, "sched_setaffinity"):
            allowed = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(0, {allowed[(place * threads + k) % len(allowed)] for k in range(threads)})
            stack.callback(os.sched_setaffinity, 0, allowed)
        if hasattr(signal, "pthread_sigmask"):
            old_signals = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            stack.callback(signal.pthread_sigmask, signal.SIG_SETMASK, old_signals)
        yield


def _begin() -> None:
    """Prepare a process: Ctrl-C on a terminal also reaches it, and ends it at once without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    parent = multiprocessing.parent_process()

    def watch() -> None:
        assert parent is not None
        parent.join()
        os._exit(1)

    # This process ends when its parent ends, even if the parent was killed.
    threading.Thread(target=watch, daemon=True).start()
