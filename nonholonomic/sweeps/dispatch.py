"""Dispatch chunks to an executor as its workers become free, and dispatch a chunk again if its worker died."""

import itertools
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future
from queue import SimpleQueue
from typing import Any

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
            except Exception as error:
                crash_count, results = crashes_reported_by(error), None
                if not crash_count:
                    raise
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


def crashes_reported_by(error: Any) -> int:
    """Number of workers that a chunk killed, according to the exception of its future."""
    if isinstance(error, BrokenExecutor):
        return 1
    # Dask has already given the chunk to other workers.
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(error, distributed.KilledWorker):
        return 1 + error.allowed_failures
    return 0
