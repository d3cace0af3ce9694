"""What is computed somewhere: some cells of a grid, in this process or in another one that has only what it was sent."""

import functools
import os
import pickle
import platform
import threading
from collections.abc import Callable
from importlib.metadata import version
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from .. import __version__
from ..compiled_programs import forget_programs_if_many
from .grid import Axis, columns, size_of
from .layout import Values

#: (full name of a parameter -> values of some cells, how many of them count) -> name -> results.
Job = Callable[[dict[str, Values], int], dict[str, Values]]

#: What must be the same wherever a part of a table is computed.
MUST_AGREE = ("nonholonomic", "jax", "jaxlib", "diffrax", "float")


class ChunkTask(NamedTuple):
    """A job and the grid it is for; `chunk`: how many cells the job is given at once, so that one compiled program serves."""

    job: Job
    axes: list[Axis]
    chunk: int

    def compile(self) -> None:
        """Call the job with no cell that counts."""
        self.job(columns(self.axes, 0, self.chunk), 0)

    def results(self, first: int, count: int) -> dict[str, Values]:
        """The results of `count` cells from `first` on."""
        end = min(first + count, size_of(self.axes))
        parts = []
        for start in range(first, end, self.chunk):
            counted = min(self.chunk, end - start)
            variables = self.job(columns(self.axes, start, self.chunk), counted)
            parts.append({name: np.asarray(values)[:counted] for name, values in variables.items()})
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def packed(work: ChunkTask) -> bytes:
    """The work as another process can be sent it.

    **Raises:** `ValueError` that says what cannot be sent.
    """
    try:
        return pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"executor: the work cannot be sent to another process ({error}); a function in it must be defined at the top of a "
            "module, not inside another function and not as a lambda"
        ) from None


def remote_results(sent: bytes, needed: dict[str, str], first: int, count: int, mark: str) -> dict[str, Values]:
    """The results of some cells, in the process that this is called in.

    **Arguments:** `sent`: from `packed`; `needed`: the `stamp` of who sent it; `first`, `count`: as for `ChunkTask.results`;
    `mark`: different in every call, because Dask takes calls with the same arguments for one.

    **Raises:** `RuntimeError` that names the worker if it has another version of a package whose numbers may differ.
    """
    own = stamp()
    for name in MUST_AGREE:
        if own[name] != needed[name]:
            raise RuntimeError(
                f"the worker {platform.node()}, process {os.getpid()}, has {name} {own[name]}, and {needed[name]} is needed: "
                "a table is computed with one version of everything"
            )
    # Threads of one worker would compile the same program twice.
    with _unpacking:
        work = _unpacked(sent)
    return work.results(first, count)


_unpacking = threading.Lock()


@functools.lru_cache(maxsize=4)
def _unpacked(sent: bytes) -> ChunkTask:
    """The work, compiled: once in a process, however many parts of it come this way."""
    forget_programs_if_many()
    work = pickle.loads(sent)
    work.compile()
    return work


@functools.cache
def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    others = ("jax", "jaxlib", "diffrax", "numpy")
    return {"python": platform.python_version(), "nonholonomic": __version__} | {name: version(name) for name in others}


def stamp() -> dict[str, str]:
    """What `MUST_AGREE`, in this process."""
    # Doubles may have been switched off by hand.
    own = versions() | {"float": str(np.dtype(jnp.result_type(float)))}
    return {name: own[name] for name in MUST_AGREE}
