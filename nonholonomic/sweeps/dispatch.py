"""Blocks are handed to an executor as its workers become free, and again where a worker died."""

import itertools
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Future
from queue import SimpleQueue
from typing import Any

#: A block is given up once it has killed this many workers, the last of them when it was the only block handed out.
MAX_CRASHES = 3


class ExecutorBroken(Exception):
    """The executor computes nothing any more."""


def handed_out(submit: Callable[[int], Future], chunks: Iterable[int], most: int) -> Iterator[tuple[int, Any]]:
    """Have blocks computed, each as soon as there is room.

    After an exception, Ctrl-C included, no further block starts.

    **Arguments:** `submit`: hands out a block; `chunks`: their numbers; `most`: how many may be handed out at once.

    **Returns:** the number and the results of each as it finishes; `None` for one that `MAX_CRASHES` workers died of.

    **Raises:** `ExecutorBroken` if the executor is gone; what a block itself raised.
    """
    finished: SimpleQueue[tuple[int, Future]] = SimpleQueue()
    out: set[Future] = set()
    crashes: Counter[int] = Counter()
    waiting = iter(chunks)
    suspects: list[int] = []

    def hand_out(chunk: int) -> None:
        try:
            future = submit(chunk)
        except (RuntimeError, OSError) as error:
            # A pool that is broken or shut down, a scheduler that does not answer.
            raise ExecutorBroken(f"the executor takes no more blocks ({error or type(error).__name__})") from error
        out.add(future)
        future.add_done_callback(lambda future: finished.put((chunk, future)))

    def hand_out_more() -> None:
        for chunk in itertools.islice(waiting, most - len(out)):
            hand_out(chunk)
        if not out and suspects:
            hand_out(suspects.pop())

    try:
        hand_out_more()
        while out:
            chunk, future = finished.get()
            out.discard(future)
            try:
                died, results = 0, future.result()
            except CancelledError as error:
                raise ExecutorBroken("the executor has cancelled its blocks") from error
            except Exception as error:
                died, results = crashes_reported_by(error), None
                if not died:
                    raise
            was_last_try = crashes[chunk] >= MAX_CRASHES - 1
            crashes[chunk] += died
            if died and crashes[chunk] < MAX_CRASHES - 1:
                hand_out(chunk)
            elif died and not was_last_try:
                # Where an executor cannot tell of which block a worker died, all that were with it are accused. So the last
                # try is made at the end, with each alone.
                suspects.append(chunk)
            hand_out_more()
            if was_last_try or not died:
                yield chunk, results
    finally:
        for future in out:
            future.cancel()


def crashes_reported_by(error: Any) -> int:
    """How many workers have died of a block, according to what its future raised."""
    if isinstance(error, BrokenExecutor):
        return 1
    # Dask has handed the block to others before it says so.
    distributed = sys.modules.get("distributed")
    if distributed is not None and isinstance(error, distributed.KilledWorker):
        return 1 + error.allowed_failures
    return 0
