"""Kernels compiled for the host, where there is a C++ compiler: the same text as for a GPU, one cell after another."""

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest

from nonholonomic.kernels.device_code import Kernel

COMPILER = shutil.which("c++")

#: Tests with this mark need the compiler.
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")


@functools.lru_cache
def compiled(text: str) -> ctypes.CDLL:
    """The library of a program."""
    folder = Path(tempfile.mkdtemp())
    (folder / "kernel.cpp").write_text(text)
    command = [
        COMPILER,
        "-std=c++17",
        "-O1",
        "-march=native",
        "-w",
        "-shared",
        "-fPIC",
        "-o",
        "kernel.so",
        "kernel.cpp",
    ]
    subprocess.run(command, cwd=folder, check=True)
    library = ctypes.CDLL(str(folder / "kernel.so"))
    shutil.rmtree(folder)
    return library


def run_on_host(kernel: Kernel, shared: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    """Run some cells, as a `Runner` does."""
    capacity = columns.shape[1]
    results, queue = np.zeros((kernel.results, capacity)), np.zeros(1, np.uint64)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (shared, columns, results)]
    count = ctypes.c_ulonglong(count)
    compiled(kernel.text).run_cells(*pointers, ctypes.c_longlong(capacity), count, ctypes.c_void_p(queue.ctypes.data))
    return results


class FakeDriver:
    """The functions of CUDA's driver that run a kernel, on the host: "machine code" is the text of a program."""

    class CUdevice_attribute:
        CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR = 9
        CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR = 0
        CU_DEVICE_ATTRIBUTE_MULTIPROCESSOR_COUNT = 132

    #: Bytes of memory.
    MOST = 1 << 22

    def __init__(self):
        self.memory: dict[int, np.ndarray] = {}
        self.launches: list[tuple[int, int]] = []

    def __getattr__(self, name):
        # Calls that only have to succeed.
        return lambda *arguments: (0, 0)

    def cuDeviceGetAttribute(self, kind, device):
        return 0, kind

    def cuMemAlloc(self, size):
        if size + sum(array.nbytes for array in self.memory.values()) > self.MOST:
            return OutOfMemory(2), 0
        array = np.zeros(size, np.uint8)
        self.memory[array.ctypes.data] = array
        return 0, array.ctypes.data

    def cuMemFree(self, pointer):
        del self.memory[pointer]
        return (0,)

    def cuMemcpyHtoD(self, target, source, size):
        ctypes.memmove(target, source, size)
        return (0,)

    cuMemcpyDtoH = cuMemcpyHtoD

    def cuModuleLoadData(self, code):
        return 0, compiled(ctypes.string_at(code).decode())

    def cuModuleGetFunction(self, library, name):
        return 0, getattr(library, name.decode())

    def cuLaunchKernel(self, function, x, y, z, block_x, block_y, block_z, shared, stream, arguments, extra):
        assert (y, z, block_y, block_z, shared, stream, extra) == (1, 1, 1, 1, 0, 0, 0)
        self.launches.append((x, block_x))
        function(*(kind(value) for value, kind in zip(*arguments, strict=True)))
        return (0,)


class OutOfMemory(int):
    """A status of CUDA."""

    name = "CUDA_ERROR_OUT_OF_MEMORY"
