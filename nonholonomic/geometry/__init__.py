"""The surfaces that bodies move on, vectors in their frames, and small linear systems.

A surface answers, for a place on it: the unit normal, how the frame turns with the velocity, the height and the
Gaussian curvature. Components that vanish identically are `None`, so that nothing is computed for them.
"""

from .cylinder import Cylinder as Cylinder
from .graph import Graph as Graph
from .graph import Paraboloid as Paraboloid
from .implicit import Implicit as Implicit
from .linear import inverse as inverse
from .linear import solve as solve
from .moving import AbstractMovingFrame as AbstractMovingFrame
from .moving import Tangent as Tangent
from .moving import carried as carried
from .plane import Plane as Plane
from .quadric import AbstractQuadric as AbstractQuadric
from .quadric import Sphere as Sphere
from .quadric import Spheroid as Spheroid
from .surface import CLOSED as CLOSED
from .surface import AbstractSurface as AbstractSurface
from .surface import Place as Place
from .torus import Torus as Torus
from .vector import Component as Component
from .vector import Vector as Vector
from .vector import add as add
from .vector import cross as cross
from .vector import dot as dot
from .vector import multiply as multiply
from .vector import none_if_zero as none_if_zero
from .vector import scale as scale
from .vector import subtract as subtract
from .vector import sum_vectors as sum_vectors
from .vector import tangents as tangents
