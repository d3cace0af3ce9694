"""The computation of several cells of a grid, in this process or in another process that has only the data that it
received."""

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
from ..compilation.compiled_programs import forget_programs_if_many
from .grid import Axis, columns, size_of
from .layout import Values

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


def packed(work: ChunkTask) -> bytes:
    """The task in a form that can be sent to another process.

    **Raises:** `ValueError` that names the object that cannot be sent.
    """
    try:
        return pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"executor: the work cannot be sent to another process ({error}); a function in it must be defined at the top of a "
            "module, not inside another function and not as a lambda"
        ) from None


def remote_results(payload: bytes, needed: dict[str, str], first: int, count: int, mark: str) -> dict[str, Values]:
    """Compute the results of several cells in a worker process.

    **Arguments:** `payload`: the result of `packed`; `needed`: the `stamp` of the sender; `first`, `count`: as for
    `ChunkTask.results`; `mark`: different in every call, because Dask merges calls with equal arguments.

    **Raises:** `RuntimeError` that names the worker if a package there has another version, which may give other
    results.
    """
    local = stamp()
    for name in MUST_AGREE:
        if local[name] != needed[name]:
            raise RuntimeError(
                f"the worker {platform.node()}, process {os.getpid()}, has {name} {local[name]}, and {needed[name]} is needed: "
                "all workers of a table need the same versions"
            )
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


@functools.cache
def versions() -> dict[str, str]:
    """The versions that a result depends on."""
    packages = ("jax", "jaxlib", "diffrax", "numpy")
    return {"python": platform.python_version(), "nonholonomic": __version__} | {
        name: version(name) for name in packages
    }


def stamp() -> dict[str, str]:
    """The versions in this process of the packages in `MUST_AGREE`."""
    # Float64 may have been switched off by hand.
    local = versions() | {"float": str(np.dtype(jnp.result_type(float)))}
    return {name: local[name] for name in MUST_AGREE}
