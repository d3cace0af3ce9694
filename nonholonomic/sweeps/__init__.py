"""Grids of named axes, cut into chunks that run wherever there is room, and the labelled tables and files they end in.

`sweep` computes a grid and returns a `Table`; with a file it writes every chunk as it finishes, and an
interrupted sweep goes on from there. Any executor may compute the chunks; `local_processes` is one.
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
