"""The surfaces that bodies move on, vectors in their frames, and small linear systems.

For a position on a surface, its methods return the unit normal and its rate, the height, the Gaussian curvature and the
coordinates in which users name the place. A frame moves with a ball along a surface; `frame_of` chooses the frame.
Components that vanish identically are `None`, so that nothing is computed for them.
"""

from .frames import AbstractFrame as AbstractFrame
from .frames import CarriedFrame as CarriedFrame
from .frames import FrameMotion as FrameMotion
from .frames import PlaneFrame as PlaneFrame
from .frames import Pose as Pose
from .frames import Tangent as Tangent
from .level_sets import Graph as Graph
from .level_sets import Implicit as Implicit
from .level_sets import Paraboloid as Paraboloid
from .level_sets import as_function as as_function
from .surface import CLOSED as CLOSED
from .surface import AbstractQuadric as AbstractQuadric
from .surface import AbstractSurface as AbstractSurface
from .surface import Cylinder as Cylinder
from .surface import Place as Place
from .surface import Plane as Plane
from .surface import Sphere as Sphere
from .surface import Spheroid as Spheroid
from .surface import Torus as Torus
from .vector import Component as Component
from .vector import Vector as Vector
from .vector import add as add
from .vector import cross as cross
from .vector import difference as difference
from .vector import dot as dot
from .vector import inverse as inverse
from .vector import multiply as multiply
from .vector import rate_in_frame as rate_in_frame
from .vector import scale as scale
from .vector import solve as solve
from .vector import stacked as stacked
from .vector import subtract as subtract
from .vector import sum_vectors as sum_vectors
