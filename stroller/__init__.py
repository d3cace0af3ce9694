"""The stroller: a three-wheeled vehicle with nonholonomic constraints, on the plane and on curved grounds."""

from nonholonomic import __version__ as __version__
from nonholonomic.geometry import Cylinder as Cylinder
from nonholonomic.geometry import Graph as Graph
from nonholonomic.geometry import Implicit as Implicit
from nonholonomic.geometry import Paraboloid as Paraboloid
from nonholonomic.geometry import Plane as Plane
from nonholonomic.geometry import Sphere as Sphere
from nonholonomic.geometry import Spheroid as Spheroid
from nonholonomic.geometry import Torus as Torus
from nonholonomic.identification import Free as Free
from nonholonomic.integration import ImplicitMidpoint as ImplicitMidpoint

from .friction import AbstractFriction as AbstractFriction
from .friction import Damping as Damping
from .friction import Frictionless as Frictionless
from .friction import RollingResistance as RollingResistance
from .identify import identify as identify
from .input import Motion as Motion
from .input import Steady as Steady
from .launch import Launch as Launch
from .recording import Recording as Recording
from .recording import read_recording as read_recording
from .scene import Scene as Scene
from .simulate import simulate as simulate
from .stroller import Stroller as Stroller
from .table import Table as Table
from .table import sweep as sweep
from .trajectory import Trajectory as Trajectory
