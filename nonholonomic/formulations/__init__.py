"""Equations of motion from a metric, a potential and constraints, in several independent forms.

The forms agree where all of them apply, so each is a check of the others and of equations written out by hand.
"""

from .brackets import Coordinates as Coordinates
from .brackets import structure_constants as structure_constants
from .formulation import AbstractFormulation as AbstractFormulation
from .formulation import ConstrainedConnection as ConstrainedConnection
from .formulation import Hamel as Hamel
from .formulation import Multipliers as Multipliers
from .formulation import ReducedBracket as ReducedBracket
from .lagrange import Lagrange as Lagrange
from .system import AbstractSystem as AbstractSystem
from .system import Routhian as Routhian
