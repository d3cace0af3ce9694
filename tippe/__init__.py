"""The tippe top: scenes, trajectories and inversion tables."""

from nonholonomic.geometry import Cylinder as Cylinder
from nonholonomic.geometry import Plane as Plane
from nonholonomic.geometry import Sphere as Sphere
from nonholonomic.identification import FitWarning as FitWarning
from nonholonomic.identification import Free as Free
from nonholonomic.sweeps import Table as Table

from . import steady as steady
from .extended_times import extended_inversion_time as extended_inversion_time
from .friction import AbstractFriction as AbstractFriction
from .friction import Contensou as Contensou
from .friction import Coulomb as Coulomb
from .friction import Frictionless as Frictionless
from .friction import Rolling as Rolling
from .friction import SetValuedCoulomb as SetValuedCoulomb
from .friction import Viscous as Viscous
from .identify import identify as identify
from .inversion import inversion_time as inversion_time
from .launch import Launch as Launch
from .lyapunov import LyapunovExponent as LyapunovExponent
from .lyapunov import lyapunov_exponent as lyapunov_exponent
from .measured import InversionTimes as InversionTimes
from .measured import Recording as Recording
from .phases.flight_trajectory import HybridTrajectory as HybridTrajectory
from .read import read_recording as read_recording
from .scene import Scene as Scene
from .table import inversion_table as inversion_table
from .top import Stem as Stem
from .top import Top as Top
from .trajectory import Trajectory as Trajectory
from .trajectory import simulate as simulate
from .trajectory_table import trajectory_table as trajectory_table
