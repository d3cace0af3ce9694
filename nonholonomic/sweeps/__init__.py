"""Grids of named axes, computed in chunks by any executor, and the resulting labelled tables and files.

`sweep` computes a grid and returns a `Table`. With a file, it writes every finished chunk, and can resume after an
interruption. Any executor can compute the chunks, such as that of `local_processes`.

**Example:** a table of half-lives by rate and level.

>>> import numpy as np
>>> from nonholonomic.sweeps import Variable, axis, sweep
>>> def half_lives(columns, count):
...     return {"time": -np.log(columns["event.level"]) / columns["system.rate"]}
>>> axes = [axis("rate", "system.rate", "1/s", [1.0, 2.0]), axis("level", "event.level", "1", [0.5, 0.1])]
>>> variables = {"time": Variable("s", np.float64, long_name="time of the event")}
>>> table = sweep(half_lives, axes, variables, {"system": "decay"}, progress=False)
>>> print(table.time.round(6))
[[0.693147 2.302585]
 [0.346574 1.151293]]
"""

from ._store import AnotherRun as AnotherRun
from ._store import saved_cells as saved_cells
from .grid import Axis as Axis
from .grid import Variable as Variable
from .grid import axis as axis
from .grid import cells_to_check as cells_to_check
from .grid import scattered_cells as scattered_cells
from .grid import size_of as size_of
from .running import chunk_for as chunk_for
from .running import local_processes as local_processes
from .running import sweep as sweep
from .table import Quantity as Quantity
from .table import Table as Table
from .table import Tabular as Tabular
from .table import chosen as chosen
from .table import run_table as run_table
