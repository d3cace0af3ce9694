"""Equations of motion from a metric, a potential and constraints."""

from .formulation import AbstractFormulation as AbstractFormulation
from .formulation import AbstractVelocityFormulation as AbstractVelocityFormulation
from .formulation import Hamel as Hamel
from .formulation import Lagrange as Lagrange
from .formulation import lie_brackets as lie_brackets
from .system import AbstractSystem as AbstractSystem
from .system import Coordinates as Coordinates
