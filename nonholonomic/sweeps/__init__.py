"""Grids of named axes, computed in chunks by any executor, and the resulting labelled tables and files.

`sweep` computes a grid and returns a `Table`. With a file, it writes every finished chunk, and can resume after an
interruption. Any executor can compute the chunks, such as that of `local_processes`.
"""

from ._chunks import saved_cells as saved_cells
from .grid import Axis as Axis
from .grid import Variable as Variable
from .grid import axis as axis
from .grid import cells_to_check as cells_to_check
from .grid import size_of as size_of
from .processes import local_processes as local_processes
from .running import chunk_for as chunk_for
from .running import sweep as sweep
from .table import Table as Table
from .tabular import Quantity as Quantity
from .tabular import Tabular as Tabular
from .tabular import run_table as run_table
from .tasks import versions as versions
