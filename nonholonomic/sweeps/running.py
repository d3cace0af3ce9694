"""Compute a grid in chunks, store each chunk when it finishes, and return a table; processes that compute the chunks."""

import contextlib
import functools
import itertools
import multiprocessing
import os
import pickle
import platform
import signal
import sys
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from queue import SimpleQueue
from typing import Any, NamedTuple, ParamSpec, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np

from ..compilation.cache import forget_programs_if_many, memory_of_machine
from ..compilation.xla_cpu import current_platform
from ..terminal import Progress
from ..text import shown
from ..validation import require_flag, require_whole, warn
from ._store import ChunkStore, with_spaces
from .grid import Axis, Layout, Values, Variable, attributes_of, columns, size_of, versions
from .table import Table

# The computation of several cells of a grid, in this process or in another process that has only the data that it
# received.

#: A function from (full name of a parameter -> values of some cells, number of cells to compute) to (name -> results).
Job = Callable[[dict[str, Values], int], dict[str, Values]]

#: Packages and settings that must agree wherever a part of a table is computed.
MUST_AGREE = ("nonholonomic", "jax", "jaxlib", "diffrax", "float")


class ChunkTask(NamedTuple):
    """A job and its grid; `chunk`: number of cells in each call of the job, always the same, so that it is compiled
    once."""

    job: Job
    axes: list[Axis]
    chunk: int

    def compile(self) -> None:
        """Call the job with padding alone, to compile it."""
        self.job(columns(self.axes, 0, self.chunk), 0)

    def results(self, first: int, count: int) -> dict[str, Values]:
        """The results of `count` cells, starting with cell `first`."""
        end = min(first + count, size_of(self.axes))
        parts = []
        for start in range(first, end, self.chunk):
            count_of_part = min(self.chunk, end - start)
            variables = self.job(columns(self.axes, start, self.chunk), count_of_part)
            parts.append({name: np.asarray(values)[:count_of_part] for name, values in variables.items()})
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def remote_results(payload: bytes, needed: dict[str, str], first: int, count: int, mark: str) -> dict[str, Values]:
    """Compute the results of several cells in a worker process.

    **Arguments:** `payload`: a pickled `ChunkTask`; `needed`: the `stamp` of the sender; `first`, `count`: as for
    `ChunkTask.results`; `mark`: different in every call, because Dask merges calls with equal arguments.

    **Raises:** `RuntimeError` that names the worker if a package there has another version, which may give other
    results.
    """
    local = stamp()
    for name in MUST_AGREE:
        if local[name] != needed[name]:
            worker = f"the worker {platform.node()}, process {os.getpid()}"
            mismatch = f"has {name} {local[name]}, and {needed[name]} is needed"
            raise RuntimeError(f"{worker}, {mismatch}: all workers of a table need the same versions")
    # Otherwise, threads of one worker would compile the same program twice.
    with _unpacking:
        work = _unpacked(payload)
    return work.results(first, count)


_unpacking = threading.Lock()


@functools.lru_cache(maxsize=4)
def _unpacked(payload: bytes) -> ChunkTask:
    """The work, compiled once per process, however many parts of it arrive."""
    forget_programs_if_many()
    work = pickle.loads(payload)
    work.compile()
    return work


def stamp() -> dict[str, str]:
    """The versions and the precision of numbers in this process."""
    # Float64 may have been switched off by hand.
    return versions() | {"float": str(np.dtype(jnp.result_type(float)))}


# Dispatch chunks to an executor as its workers become free, and dispatch a chunk again if its worker died.

#: A chunk is given up after it has killed this many workers, the last one while it was the only dispatched chunk.
MAX_CRASHES = 3


class ExecutorBroken(Exception):
    """The executor has broken down."""


def handed_out(submit: Callable[[int], Future], chunks: Iterable[int], max_in_flight: int) -> Iterator[tuple[int, Any]]:
    """Dispatch chunks, each as soon as a worker is free.

    After an exception, Ctrl-C included, no further chunk starts.

    **Arguments:** `submit`: function that dispatches a chunk; `chunks`: the indices of the chunks; `max_in_flight`: greatest
    number of chunks dispatched at a time.

    **Returns:** the index and the results of each chunk as it finishes; `None` for a chunk that killed `MAX_CRASHES`
    workers.

    **Raises:** `ExecutorBroken` if the executor broke down; exceptions of the chunks.
    """
    finished: SimpleQueue[tuple[int, Future]] = SimpleQueue()
    in_flight: set[Future] = set()
    crashes: Counter[int] = Counter()
    queue = iter(chunks)
    suspects: list[int] = []

    def hand_out(chunk: int) -> None:
        try:
            future = submit(chunk)
        except (RuntimeError, OSError) as error:
            # A pool that is broken or shut down, a scheduler that does not answer.
            raise ExecutorBroken(f"the executor accepts no more chunks ({error or type(error).__name__})") from error
        in_flight.add(future)
        future.add_done_callback(lambda future: finished.put((chunk, future)))

    def hand_out_more() -> None:
        for chunk in itertools.islice(queue, max_in_flight - len(in_flight)):
            hand_out(chunk)
        if not in_flight and suspects:
            hand_out(suspects.pop())

    try:
        hand_out_more()
        while in_flight:
            chunk, future = finished.get()
            in_flight.discard(future)
            try:
                crash_count, results = 0, future.result()
            except CancelledError as error:
                raise ExecutorBroken("the executor has cancelled its chunks") from error
            except BrokenExecutor:
                crash_count, results = 1, None
            except Exception as error:
                failure, distributed = cast(Any, error), sys.modules.get("distributed")
                if distributed is None or not isinstance(error, distributed.KilledWorker):
                    raise
                # Dask has already given the chunk to other workers.
                crash_count, results = 1 + failure.allowed_failures, None
            was_last_try = crashes[chunk] >= MAX_CRASHES - 1
            crashes[chunk] += crash_count
            if crash_count and crashes[chunk] < MAX_CRASHES - 1:
                hand_out(chunk)
            elif crash_count and not was_last_try:
                # If an executor cannot tell which chunk killed a worker, all chunks that were in flight are suspects.
                # Therefore each of them is retried alone at the end.
                suspects.append(chunk)
            hand_out_more()
            if was_last_try or not crash_count:
                yield chunk, results
    finally:
        for future in in_flight:
            future.cancel()


#: Greatest number of dispatched chunks: their results are in memory until they are stored.
HANDED_OUT = 512

#: Approximate number of chunks of a large grid, and greatest memory for the results of a chunk [bytes].
CHUNKS, MOST_BYTES = 1024, 1 << 21


def sweep(
    job: Job,
    axes: list[Axis],
    variables: dict[str, Variable],
    request: dict[str, object],
    *,
    path: object = None,
    chunk: int | None = None,
    most: int | None = None,
    inner: Sequence[Axis] = (),
    progress: bool = True,
    executor: Executor | None = None,
) -> Table:
    """Compute every cell of a grid.

    **Arguments:**

    - `job`: function of a dictionary (full name of a parameter -> values of several cells) and of the number of cells
      to compute; the other cells are padding. It returns a dictionary (name -> results). Several threads may call the
      job at once; the first call, with padding alone, compiles the job. If the executor has other processes, the job is
      pickled.
    - `axes`: the grid, the last axis varying fastest.
    - `variables`: the results of `job`.
    - `request`: plain data that describes the computation, stored in the table. To resume a file, the request must be
      equal.
    - `path`: file to write, chunk by chunk; if it contains part of the same request, only the rest is computed.
    - `chunk`: number of cells in a call of `job`, by default `chunk_for` the number of cells; `most`: an upper limit,
      for large results.
    - `inner`: the coordinates of the results' own dimensions, numbers or words.
    - `progress`: whether to show progress, on a terminal or in a notebook.
    - `executor`: any executor; by default a thread for each core.

    **Returns:** the `Table`.

    **Raises:** `ValueError` for an illegal executor, and if there is no file and not enough memory for the table;
    `OSError` or `ValueError` if the file cannot be written or holds another request; `RuntimeError` if the executor
    breaks down or a worker has other versions; the file then contains all finished chunks. `KeyboardInterrupt` after
    Ctrl-C, with the number of saved cells in the message.

    **Example:** in another thread, by any executor.

    >>> from concurrent.futures import ThreadPoolExecutor
    >>> with ThreadPoolExecutor(1) as executor:
    ...     again = sweep(half_lives, axes, variables, {"system": "decay"}, progress=False, executor=executor)
    >>> np.array_equal(again.time, table.time)
    True
    """
    require_flag(progress, "progress")
    if executor is not None and not isinstance(executor, Executor):
        raise ValueError(f"executor = {shown(executor)} must be a concurrent.futures.Executor, or None")
    context: Any = getattr(executor, "_mp_context", None)
    if isinstance(executor, ProcessPoolExecutor) and context.get_start_method() == "fork":
        raise ValueError(
            "executor = ProcessPoolExecutor(...) starts its processes by fork, in which JAX makes no progress: pass the "
            "processes of nonholonomic.local_processes, or ProcessPoolExecutor(mp_context=multiprocessing.get_context('spawn'))"
        )
    cells = size_of(axes)
    chunk_size = chunk_for(cells) if chunk is None else chunk
    chunk_size = chunk_size if most is None else min(chunk_size, most)
    coords = {axis.name: axis.values for axis in (*axes, *inner)}
    described = {axis.name: axis for axis in (*axes, *inner)} | variables
    # Lists are not equal to the tuples of a file.
    words = {name: tuple(variable.words) for name, variable in variables.items() if variable.words is not None}
    without_unit = {*words, *(name for name, values in coords.items() if values.dtype.kind == "U")}
    units = {name: part.unit for name, part in described.items() if name not in without_unit}
    request = request | {"float": str(np.dtype(jnp.result_type(float)))}
    # Without `default`: the text of an object would not tell two requests apart.
    attributes = attributes_of(request, [axis.name for axis in axes])
    long_names = {name: part.long_name for name, part in described.items() if part.long_name}
    kinds = {name: np.dtype(variable.kind) for name, variable in variables.items()}
    dims = {name: tuple(variable.inner) for name, variable in variables.items() if variable.inner}
    layout = Layout(coords, kinds, units, attributes, words, dims, chunk_size, long_names)
    layout = layout._replace(chunk=chunk_size * chunks_together(layout))
    forget_programs_if_many()
    work = ChunkTask(job, axes, chunk_size)
    required, room = layout.bytes_of_cells(layout.cells), memory_of_machine()
    if path is None and 0.0 < room < required:
        sizes = f"{layout.cells:.3g} cells take {1e-9 * required:.3g} GB, and this machine has {1e-9 * room:.3g} GB of memory"
        raise ValueError(f"path = None: {sizes}; pass path= to keep them in a file")
    store = None if path is None else ChunkStore(path, layout)
    try:
        chunks = computed(work, layout, set() if store is None else store.finished, executor, progress)
        # Ctrl-C may arrive while a chunk is saved. The traceback would then keep `chunks` alive, and its workers busy.
        with contextlib.closing(chunks):
            if store is not None:
                store.fill(chunks)
                return Table.load(store.path)
            of_all_cells = layout.empty(layout.cells)
            for number, values in chunks:
                for name, of_variable in of_all_cells.items():
                    of_variable[slice(*layout.ends(number))] = values[name]
            return Table.laid_out(layout, {name: layout.shaped(name, part) for name, part in of_all_cells.items()})
    except KeyboardInterrupt:
        none_saved = f"interrupted; without path=, none of {with_spaces(layout.cells)} cells is saved"
        raise KeyboardInterrupt(none_saved if store is None else store.interrupted()) from None
    except ExecutorBroken as error:
        none_saved = "without path=, nothing is saved"
        saved = f"{path} has the finished chunks; repeat the call to resume"
        raise RuntimeError(f"{error}, {none_saved if store is None else saved}") from error.__cause__
    finally:
        if store is not None:
            store.close()


def computed(
    work: ChunkTask, layout: Layout, finished: set[int], executor: Executor | None, progress: bool
) -> Generator[tuple[int, dict[str, Values]], None, None]:
    """Compute the unfinished chunks, and yield each when it is finished; see `sweep`."""
    todo = [chunk for chunk in range(layout.chunks) if chunk not in finished]
    finished_cells = layout.cells - sum(map(layout.size, todo))
    with contextlib.ExitStack() as stack:
        raise_lost_interrupt = stack.enter_context(no_interrupt_lost())
        display = stack.enter_context(Progress(layout.cells, "cell", shown=progress))
        is_compiled, pool = executor is None, executor
        if pool is None:
            pool = ThreadPoolExecutor(workers())
            stack.callback(pool.shutdown, wait=False, cancel_futures=True)
            if todo:
                # In another thread, so that this one receives Ctrl-C: XLA compiles for many seconds without checking.
                pool.submit(work.compile).result()
            display.begin(finished_cells)
        submit = submission(work, pool)
        try:
            for chunk, values in handed_out(lambda chunk: submit(chunk * layout.chunk, layout.chunk), todo, HANDED_OUT):
                yield chunk, failed_chunk(work.axes, layout, chunk) if values is None else values
                finished_cells += layout.size(chunk)
                # If other processes compute, they do not report when they have compiled.
                if is_compiled:
                    display.advance(layout.size(chunk))
                else:
                    display.begin(finished_cells)
                is_compiled = True
                raise_lost_interrupt()
        except ExecutorBroken as error:
            raise ExecutorBroken(f"{error}; {finished_cells} of {layout.cells} cells are done") from error.__cause__


def submission(work: ChunkTask, executor: Executor) -> Callable[[int, int], Future]:
    """A function that submits the computation of `count` cells, starting with cell `first`.

    Threads share this process and its compiled programs. Other executors receive all data that they need.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return functools.partial(executor.submit, work.results)
    try:
        payload, versions_here = pickle.dumps(work), stamp()
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"executor: the work cannot be sent to another process ({error}); a function in it must be defined at the top "
            "of a module, not inside another function and not as a lambda"
        ) from None
    return lambda first, count: executor.submit(remote_results, payload, versions_here, first, count, uuid.uuid4().hex)


def failed_chunk(axes: list[Axis], layout: Layout, chunk: int) -> dict[str, Values]:
    """The results of a chunk that could not be computed: the status `failed`, without numbers. A warning names the
    cells."""
    first, end = layout.ends(chunk)
    ends = [columns(axes, cell, 1) for cell in (first, end - 1)]
    ranges = ", ".join(f"{name} {ends[0][name].item():.6g} to {ends[1][name].item():.6g}" for name in ends[0])
    warn(
        f"cells {first} to {end - 1} ({ranges}) are given up as failed: they killed {MAX_CRASHES} workers or more",
        RuntimeWarning,
    )
    (words,) = layout.words.values()
    return layout.empty(end - first, words.index("failed"))


def chunk_for(cells: int) -> int:
    """Number of cells in a chunk. There are few different sizes, so that few programs are compiled, but many chunks, so
    that cores share the work. The size does not depend on the number of cores, so that another machine can resume a
    file.

    **Example:**

    >>> from nonholonomic.sweeps import chunk_for
    >>> chunk_for(100_000) >= chunk_for(4)
    True
    """
    if current_platform() != "cpu":
        return 65536 if cells > 4096 else 4096
    # For two cells, an ensemble of 64 lanes takes no longer than one of two lanes: most of the time is spent starting
    # loops.
    return 64 if cells <= 64 else 128 if cells <= 4096 else 512


def chunks_together(layout: Layout) -> int:
    """Number of chunks that are dispatched and stored together, a power of two, greater than one for large grids."""
    count = min(layout.cells // (CHUNKS * layout.chunk), MOST_BYTES // layout.bytes_of_cells(layout.chunk))
    return 1 << max(count, 1).bit_length() - 1


def workers() -> int:
    """Number of chunks that run at once in this process: one for each core; an accelerator takes one at a time."""
    if current_platform() != "cpu":
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# Ctrl-C where Python ignores exceptions.


@contextlib.contextmanager
def no_interrupt_lost() -> Iterator[Callable[[], None]]:
    """A function, as a context, that raises `KeyboardInterrupt` again if Ctrl-C arrived within the context.

    Python raises `KeyboardInterrupt` wherever the main thread happens to be. In finalizers, in callbacks of weak
    references and during garbage collection, where JAX calls back into Python, exceptions are printed and ignored. Then
    a sweep would go on, although its processes had ended. What will be raised again is not printed either.
    """
    arrived, hook = False, sys.unraisablehook

    def print_others(ignored: "sys.UnraisableHookArgs") -> None:
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


# Processes on this machine, each with its own cores, that compute the chunks of a sweep.


def local_processes(n: int, threads: int = 1) -> Executor:
    """Processes for `executor=`, which compute on this machine's processor. Each process has its own cores, and uses
    the parent's compilation cache if there is one. Processes start when chunks arrive. A process that dies is replaced,
    and its chunk is retried in another one. The processes end with the context or with the parent process. As for all
    processes that Python's `multiprocessing` starts, put the calls in your script under `if __name__ == "__main__":`.

    **Arguments:** `n`: number of processes; `threads`: number of cores for each.

    **Returns:** the executor, as a context.

    **Raises:** `ValueError` unless both are whole numbers of at least 1.

    **Example:** pass it to a table as `executor=processes`.

    ```
    >>> import nonholonomic
    >>> with nonholonomic.local_processes(1) as processes:
    ...     print(processes.submit(sum, [1.0, 2.0]).result())
    3.0

    ```
    """
    require_whole(n, "n", 1)
    require_whole(threads, "threads", 1)
    return LocalProcesses(n, threads)


#: The arguments and the result of a call.
P = ParamSpec("P")
T = TypeVar("T")


class LocalProcesses(Executor):
    """An executor of single-process pools, so that a process that dies loses only its own call."""

    def __init__(self, n: int, threads: int):
        """Set the number of processes and the number of cores for each."""
        self._pools: dict[int, ProcessPoolExecutor] = {}
        self._threads = threads
        self._free: SimpleQueue[int] = SimpleQueue()
        for place in range(n):
            self._free.put(place)
        self._callers = ThreadPoolExecutor(n)

    def submit(self, function: Callable[P, T], /, *arguments: P.args, **options: P.kwargs) -> Future[T]:
        """Call a function in one of the processes; its future raises `BrokenProcessPool` if the process dies."""
        return self._callers.submit(self._called, function, arguments, options)

    def __exit__(self, *_: object) -> None:
        """End the processes, after the calls that have begun."""
        self.shutdown(cancel_futures=True)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, after all calls, or after those that have begun."""
        self._callers.shutdown(wait, cancel_futures=cancel_futures)
        for pool in self._pools.values():
            pool.shutdown(wait, cancel_futures=cancel_futures)

    def _called(self, function: Callable[..., T], arguments: tuple[object, ...], options: dict[str, object]) -> T:
        place = self._free.get()
        try:
            if place not in self._pools:
                self._pools[place] = _started(place, self._threads)
            return self._pools[place].submit(function, *arguments, **options).result()
        except BrokenProcessPool:
            del self._pools[place]
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
                advice = "a script that starts processes must have its own calls under `if __name__ == '__main__':`"
                raise RuntimeError(f"a process ended before it computed anything; {advice}") from error
    advice = "if the machine has too little memory, start fewer: local_processes(n=...)"
    raise RuntimeError(f"{MAX_STARTS} processes were killed while they started; {advice}")


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
        for name in settings:
            if name in os.environ:
                stack.callback(os.environ.update, {name: os.environ[name]})
            else:
                stack.callback(os.environ.pop, name)
        os.environ.update(settings)
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
