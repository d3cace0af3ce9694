"""The tippe top: scenes, trajectories and inversion tables."""

from types import ModuleType as _Module

from nonholonomic import __version__ as __version__
from nonholonomic.geometry import Cylinder as Cylinder
from nonholonomic.geometry import Graph as Graph
from nonholonomic.geometry import Implicit as Implicit
from nonholonomic.geometry import Paraboloid as Paraboloid
from nonholonomic.geometry import Plane as Plane
from nonholonomic.geometry import Sphere as Sphere
from nonholonomic.geometry import Spheroid as Spheroid
from nonholonomic.geometry import Torus as Torus
from nonholonomic.identification import FitWarning as FitWarning
from nonholonomic.identification import Free as Free
from nonholonomic.integration.problem import Status as Status
from nonholonomic.runs.attractors import LyapunovExponent as LyapunovExponent
from nonholonomic.sweeps import Table as Table

from . import presets as presets
from . import steady as steady
from .fit import InversionTimes as InversionTimes
from .fit import Recording as Recording
from .fit import ReversalTimes as ReversalTimes
from .fit import identify as identify
from .fit import log_density as log_density
from .fit import read_inversion_times as read_inversion_times
from .fit import read_recording as read_recording
from .friction import AbstractFriction as AbstractFriction
from .friction import Contensou as Contensou
from .friction import Coulomb as Coulomb
from .friction import Frictionless as Frictionless
from .friction import NoSlip as NoSlip
from .friction import Rolling as Rolling
from .friction import SetValuedCoulomb as SetValuedCoulomb
from .friction import Viscous as Viscous
from .model.body import ConvexBody as ConvexBody
from .model.body import SpheroidBody as SpheroidBody
from .model.body import Stem as Stem
from .model.body import Top as Top
from .model.rigid import Ellipsoid as Ellipsoid
from .model.rigid import RigidBody as RigidBody
from .model.scene import Launch as Launch
from .model.scene import Scene as Scene
from .runs.trajectory import HybridTrajectory as HybridTrajectory
from .runs.trajectory import Trajectory as Trajectory
from .runs.verbs import extended_inversion_time as extended_inversion_time
from .runs.verbs import inversion_table as inversion_table
from .runs.verbs import inversion_time as inversion_time
from .runs.verbs import lyapunov_exponent as lyapunov_exponent
from .runs.verbs import reversal_table as reversal_table
from .runs.verbs import reversal_time as reversal_time
from .runs.verbs import simulate as simulate
from .runs.verbs import trajectory_table as trajectory_table
from .runs.view import explore as explore

# `import *` exports the names above, and not the subpackages.
__all__ = [
    "steady",
    *(name for name, value in list(globals().items()) if not name.startswith("_") and not isinstance(value, _Module)),
]
