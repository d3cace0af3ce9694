"""The surfaces that bodies move on, vectors in their frames, and small linear systems.

A surface answers, for a place on it: the unit normal, how the frame turns with the velocity, the height and the
Gaussian curvature. Components that vanish identically are `None`, so that nothing is computed for them.
"""

from .ground import AbstractGround as AbstractGround
from .ground import AbstractQuadric as AbstractQuadric
from .ground import Spheroid as Spheroid
from .linear import inverse as inverse
from .linear import solve as solve
from .surface import AbstractSurface as AbstractSurface
from .surface import Cylinder as Cylinder
from .surface import Plane as Plane
from .surface import Sphere as Sphere
from .surface import Tangent as Tangent
from .surface import carried as carried
from .surface import none_if_zero as none_if_zero
from .vector import Component as Component
from .vector import Vector as Vector
from .vector import add as add
from .vector import cross as cross
from .vector import dot as dot
from .vector import multiply as multiply
from .vector import scale as scale
from .vector import subtract as subtract
from .vector import sum_vectors as sum_vectors
