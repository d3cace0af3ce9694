"""A table by MPI: `mpirun -n 2 python -m mpi4py.futures mpi_sweep.py FOLDER`; the first process feeds, the other computes."""

import os
import sys
from pathlib import Path

import numpy as np
from tops import rutstam_top

import tippe
from nonholonomic.sweeps import running


def process(_):
    return os.getpid()


if __name__ == "__main__":
    from mpi4py.futures import MPIPoolExecutor

    running.chunk_for = lambda cells: 64
    scene = tippe.Scene(rutstam_top(), tippe.Plane(), tippe.Viscous(0.3))
    launches = {"theta": np.linspace(0.05, 0.6, 40), "spin": [80.0, 100.0, 190.0], "mu": [0.2, 0.3]}
    with MPIPoolExecutor() as executor:
        tippe.inversion_table(scene, **launches, t1=8.0, path=Path(sys.argv[1]) / "table.h5", executor=executor)
        workers = set(executor.map(process, range(20)))
    assert os.getpid() not in workers
    assert len(workers) == 1
