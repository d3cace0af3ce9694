"""The tippe top: scenes, trajectories and inversion tables."""

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
from nonholonomic.sweeps import Table as Table

from . import steady as steady
from .friction import AbstractFriction as AbstractFriction
from .friction import Contensou as Contensou
from .friction import Coulomb as Coulomb
from .friction import Frictionless as Frictionless
from .friction import Rolling as Rolling
from .friction import SetValuedCoulomb as SetValuedCoulomb
from .friction import Viscous as Viscous
from .identify import InversionTimes as InversionTimes
from .identify import Recording as Recording
from .identify import identify as identify
from .inversion import inversion_time as inversion_time
from .launch import Launch as Launch
from .lyapunov import LyapunovExponent as LyapunovExponent
from .lyapunov import lyapunov_exponent as lyapunov_exponent
from .phases.flight_trajectory import HybridTrajectory as HybridTrajectory
from .scene import Scene as Scene
from .table import inversion_table as inversion_table
from .top import Stem as Stem
from .top import Top as Top
from .trajectory import Trajectory as Trajectory
from .trajectory import simulate as simulate
from .trajectory_table import trajectory_table as trajectory_table
