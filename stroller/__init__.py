"""The stroller: a three-wheeled vehicle with nonholonomic constraints, on the plane and on curved grounds."""

from nonholonomic.ground import Spheroid as Spheroid
from nonholonomic.midpoint import ImplicitMidpoint as ImplicitMidpoint
from nonholonomic.surface import Plane as Plane
from nonholonomic.surface import Sphere as Sphere
from nonholonomic.unknown import Free as Free

from .friction import AbstractFriction as AbstractFriction
from .friction import Damping as Damping
from .friction import Frictionless as Frictionless
from .friction import RollingResistance as RollingResistance
from .identify import Recording as Recording
from .identify import identify as identify
from .input import Motion as Motion
from .input import Steady as Steady
from .launch import Launch as Launch
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .stroller import Stroller as Stroller
from .table import Table as Table
from .table import sweep as sweep
from .trajectory import Trajectory as Trajectory
