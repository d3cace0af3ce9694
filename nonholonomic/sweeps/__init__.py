"""Grids of named axes, cut into blocks that run on all cores, and the labelled tables and files they end in.

`sweep` computes a grid and returns a `Table`; with a file it writes every block as it finishes, and an
interrupted sweep goes on from there.
"""

from .grid import Axis as Axis
from .grid import Variable as Variable
from .grid import axis as axis
from .grid import sweep as sweep
from .grid import versions as versions
from .table import Table as Table
