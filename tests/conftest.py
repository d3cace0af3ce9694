"""Fixtures that pytest applies to every test, and the scene that most tests use."""

import gc
import os

import jax
import pytest
from tops import rutstam_top

import nonholonomic
import tippe
from nonholonomic.compilation.cache import (
    PART_OF_MAPPINGS,
    count_mappings,
    most_mappings,
    release_memory,
    resident_memory,
)
from nonholonomic.compilation.xla_cpu import compile_quickly

#: The tests that a plain `pytest` chooses (`pyproject.toml`).
ORDINARY = "not slow and not gpu"


def pytest_configure(config: pytest.Config) -> None:
    """All tests, their worker and child processes, and the next run of the tests share compiled programs.

    `pytest --cache-clear` forgets it; a folder that `JAX_COMPILATION_CACHE_DIR` names is used instead.

    The ordinary run compiles without LLVM's optimisations, as JAX's own tests do, and by XLA's older emitters where they still
    exist: compiling is most of its work, and takes a quarter of the time then. The slow tests run what users run; so do all
    with `XLA_FLAGS=`.
    """
    if config.option.markexpr == ORDINARY:
        compile_quickly()
    if hasattr(config, "cache"):
        # Child processes read the bytecode of the first: without it, each parses every module again, for two seconds.
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ.setdefault("PYTHONPYCACHEPREFIX", str(config.cache.mkdir("bytecode")))
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ and hasattr(config, "cache"):
        folder = nonholonomic.enable_compilation_cache(config.cache.mkdir("compiled"))
        if folder is not None:
            os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
            os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
            os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"


#: What a worker may need at most [bytes].
MEMORY_OF_WORKER = 3_000_000_000


def pytest_xdist_auto_num_workers() -> int:
    """One worker for each core, as far as the memory suffices. More than eight would mostly compile the same programs."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if hasattr(os, "sysconf"):
        cores = min(cores, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // MEMORY_OF_WORKER)
    return max(1, min(cores, 8))


#: What a worker may hold after a module of tests [bytes] before it forgets its compiled programs; those that the next modules
#: use too are read from the disk.
MOST_MEMORY = 2_300_000_000

# Tracing makes many long-lived objects, through which Python would look for cycles again and again.
gc.set_threshold(100_000, 50, 100)


@pytest.fixture(autouse=True, scope="module")
def forget_compiled_programs():
    """Let go of compiled programs before they exhaust the memory, or the mappings that Linux allows a process."""
    yield
    if resident_memory() > MOST_MEMORY:
        release_memory()
    if resident_memory() > MOST_MEMORY or count_mappings() > PART_OF_MAPPINGS * most_mappings():
        jax.clear_caches()
        gc.collect()
        release_memory()


@pytest.fixture(scope="session")
def rutstam_scene() -> tippe.Scene:
    """Rutstam's top on the plane with viscous friction, mu = 0.3 s/m."""
    return tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
