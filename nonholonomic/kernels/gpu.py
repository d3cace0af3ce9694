"""The GPU: compile kernels for it, and run cells on it. NVIDIA's packages are the extra `gpu`.

Numbers go to the GPU and back as NumPy arrays: those of a run are few beside its steps. JAX need not know the GPU.
"""

import ctypes
import functools
import importlib.util
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
from jaxtyping import Float

from ..compilation.cache import kept_files
from ..compilation.xla_cpu import current_platform, on_cpu
from ..text import shown
from ..validation import warn
from .device_code import Kernel

#: Number of threads in a block, and greatest number of blocks for each processor, of which four run at once.
BLOCK, BLOCKS = 64, 8

#: Tables with fewer cells than this run on the CPU: a kernel lasts as long as its longest run. An estimate, not measured.
LEAST_CELLS = 4096

#: Number of cells in a chunk of a table.
CELLS_OF_KERNEL = 1 << 17

#: How long a launch should take [s]: a GPU that draws a screen stops much longer ones, and Ctrl-C waits for its end.
#: No launch has fewer cells than run at once, so that a long run does not make all launches small.
LONGEST = 0.5

#: Greatest number of kernels that stay loaded.
LOADED = 64

OPTIONS = ("--std=c++17", "-diag-suppress=177,550")


class KernelError(RuntimeError):
    """A kernel could not be compiled or run; the message says why."""


#: The errors of kernels, of functions that cannot be written, of options that cannot be compared, and of NVIDIA's packages.
ERRORS = (ValueError, TypeError, RuntimeError)


def compiled(text: str, architecture: str) -> bytes:
    """The machine code of a program; this needs no GPU.

    **Arguments:** `text`: in CUDA C; `architecture`: such as "sm_90".

    **Raises:** `KernelError` with what the compiler says.
    """
    from cuda.bindings import nvrtc  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    program = _checked(nvrtc.nvrtcCreateProgram(text.encode(), b"kernel.cu", 0, [], []))
    options = [option.encode() for option in (f"--gpu-architecture={architecture}", *OPTIONS)]
    (result,) = nvrtc.nvrtcCompileProgram(program, len(options), options)
    if result != nvrtc.nvrtcResult.NVRTC_SUCCESS:
        log = b" " * (1 + _checked(nvrtc.nvrtcGetProgramLogSize(program)))
        nvrtc.nvrtcGetProgramLog(program, log)
        raise KernelError(f"the kernel does not compile: {log.decode(errors='replace').strip()[:300]}")
    code = b" " * _checked(nvrtc.nvrtcGetCUBINSize(program))
    _checked(nvrtc.nvrtcGetCUBIN(program, code))
    nvrtc.nvrtcDestroyProgram(program)
    return code


def _checked(results: tuple[Any, ...]) -> Any:
    """The result of a call of NVIDIA's libraries. **Raises:** `KernelError` unless the call succeeded."""
    status, *values = results
    if int(status):
        raise KernelError(f"the GPU reports {status.name}")
    return values[0] if len(values) == 1 else tuple(values)


class Gpu:
    """The first GPU of this machine. Calling it runs cells, as a `Runner` does."""

    def __init__(self, driver: Any):
        self.driver, self.lock = driver, threading.Lock()
        _checked(driver.cuInit(0))
        self.device = _checked(driver.cuDeviceGet(0))
        # JAX uses this context, too.
        self.context = _checked(driver.cuDevicePrimaryCtxRetain(self.device))
        kinds = driver.CUdevice_attribute

        def number(kind: Any) -> int:
            return _checked(driver.cuDeviceGetAttribute(kind, self.device))

        self.processors = number(kinds.CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT)
        major = number(kinds.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR)
        minor = number(kinds.CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR)
        self.architecture = f"sm_{major}{minor}"
        # By the text of a kernel: its module, its function, and the number of cells of its next launch.
        self.loaded: dict[str, tuple[Any, Any]] = {}
        self.sizes: dict[str, int] = {}

    def __call__(
        self,
        kernel: Kernel,
        shared: Float[np.ndarray, " shared"],
        columns: Float[np.ndarray, "numbers cells"],
        count: int,
    ) -> Float[np.ndarray, "results cells"]:
        driver, capacity, least = self.driver, columns.shape[1], 4 * BLOCK * self.processors
        with self.lock, self.current():
            function = self.function(kernel.text)
            results = np.zeros((kernel.results, capacity))
            with self.copied(shared, columns, results, np.zeros(1, np.uint64)) as (*pointers, queue):
                end = 0
                while end < count:
                    size, start = self.sizes.get(kernel.text, least), time.perf_counter()
                    begin, end = end, min(end + size, count)
                    first = np.array([begin], np.uint64)
                    _checked(driver.cuMemcpyHtoD(queue, first.ctypes.data, first.nbytes))
                    arguments = ((*map(int, pointers), capacity, end, int(queue)), (*[ctypes.c_void_p] * 3, *_COUNTS))
                    blocks = min(-(-(end - begin) // BLOCK), BLOCKS * self.processors)
                    _checked(driver.cuLaunchKernel(function, blocks, 1, 1, BLOCK, 1, 1, 0, 0, arguments, 0))
                    _checked(driver.cuCtxSynchronize())
                    if end - begin == size:
                        share = 0.5 * LONGEST / (time.perf_counter() - start)
                        self.sizes[kernel.text] = max(int(size * min(8.0, share)), least)
                _checked(driver.cuMemcpyDtoH(results.ctypes.data, pointers[2], results.nbytes))
        return results

    def function(self, text: str) -> Any:
        """The function that runs cells, compiled once, and kept in the cache of compiled programs."""
        if text not in self.loaded:
            facts, options = ("kernel", self.architecture, OPTIONS, text), cast(Any, jax.config)
            folder = options.jax_compilation_cache_dir
            files = kept_files(
                None if folder is None else Path(folder), facts, lambda: {"code": compiled(text, self.architecture)}
            )
            if len(self.loaded) == LOADED:
                self.driver.cuModuleUnload(self.loaded.pop(next(iter(self.loaded)))[0])
            module = _checked(self.driver.cuModuleLoadData(np.frombuffer(files["code"], np.uint8).ctypes.data))
            self.loaded[text] = module, _checked(self.driver.cuModuleGetFunction(module, b"run_cells"))
        return self.loaded[text][1]

    @contextmanager
    def current(self) -> Iterator[None]:
        """Make this the GPU of this thread."""
        _checked(self.driver.cuCtxPushCurrent(self.context))
        try:
            yield
        finally:
            self.driver.cuCtxPopCurrent()

    @contextmanager
    def copied(self, *arrays: np.ndarray) -> Iterator[list[Any]]:
        """Copies of arrays in the memory of the GPU."""
        pointers: list[Any] = []
        try:
            for array in map(np.ascontiguousarray, arrays):
                pointers.append(_checked(self.driver.cuMemAlloc(max(array.nbytes, 8))))
                if array.nbytes:
                    _checked(self.driver.cuMemcpyHtoD(pointers[-1], array.ctypes.data, array.nbytes))
            yield pointers
        finally:
            for pointer in pointers:
                self.driver.cuMemFree(pointer)


#: The types of the last arguments of a kernel: capacity, end, and the queue.
_COUNTS = (ctypes.c_longlong, ctypes.c_ulonglong, ctypes.c_void_p)


@functools.lru_cache(maxsize=1)
def first_gpu() -> Gpu | None:
    """The GPU of this machine, or `None` if there is none, JAX_PLATFORMS leaves it out, or the extra is missing."""
    chosen = os.environ.get("JAX_PLATFORMS", "")
    if chosen and not {"cuda", "gpu"} & set(chosen.split(",")):
        return None
    is_default = current_platform() == "gpu"
    if importlib.util.find_spec("cuda") is None or importlib.util.find_spec("cuda.bindings") is None:
        if is_default:
            warn("large tables run by JAX's loops, and not by kernels on the GPU: pip install 'nonholonomic[gpu]'")
        return None
    from cuda.bindings import driver  # pyright: ignore[reportMissingImports, reportAttributeAccessIssue]

    try:
        return Gpu(driver)
    except Exception as error:  # without a driver, NVIDIA's package raises an error of its own
        if is_default:
            warn(f"tables run by JAX's loops, because the GPU cannot be used for kernels: {error}")
        return None


def require_device(device: object) -> None:
    """Raise `ValueError` unless a table can run on this device."""
    if device not in (None, "cpu", "gpu"):
        raise ValueError(
            f"device = {shown(device)} must be 'cpu', 'gpu' or None, for a GPU if there is one and the table is large"
        )
    if device == "gpu" and first_gpu() is None:
        why = (
            "none is found for kernels: this takes a GPU of NVIDIA with its driver, and pip install 'nonholonomic[gpu]'"
        )
        raise ValueError(f"device = 'gpu': {why}; leave device out to run on the CPU")


def chosen_gpu(cells: int, device: str | None, try_it: Callable[[], object]) -> bool:
    """Whether a table runs by kernels on the GPU, which is decided once for all its chunks.

    **Arguments:** `cells`: number of cells; `device`: "cpu", "gpu", or `None` for the faster; `try_it`: compiles the kernel,
    and raises an error if there is none.
    """
    if device == "cpu" or (device is None and cells < LEAST_CELLS) or first_gpu() is None:
        return False
    try:
        try_it()
    except ERRORS as error:
        warn(f"this table runs by JAX's loops and not by a kernel on the GPU: {error}")
        return False
    return True


def place_of_jax(cells: int, device: str | None) -> AbstractContextManager[None]:
    """A context for JAX's part of a table: on the CPU if it is small or a device was chosen; otherwise, JAX's default."""
    return on_cpu() if device is not None or cells < LEAST_CELLS else nullcontext()


def by_kernel(solve: Callable[[Gpu], Any], device: str | None, count: Any) -> Any:
    """The result of a solve by a kernel; `None` if it shall not run by one, or the kernel fails, which a warning then says.

    **Arguments:** `solve`: function of the GPU; `device`: "gpu" for a kernel; `count`: number of cells: with 0, the kernel is
    only compiled, and errors are raised.
    """
    gpu = first_gpu() if device == "gpu" else None
    if gpu is None:
        return None
    try:
        return solve(gpu)
    except ERRORS as error:
        if int(count) == 0:
            raise
        warn(f"some cells run by JAX's loops and not by a kernel on the GPU: {error}")
        return None
