"""The stroller: a three-wheeled vehicle with nonholonomic constraints, on the plane and on curved grounds."""

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
from nonholonomic.identification import Free as Free
from nonholonomic.integration import ImplicitMidpoint as ImplicitMidpoint
from nonholonomic.integration.problem import Status as Status
from nonholonomic.sweeps import Table as Table

from . import presets as presets
from .friction import AbstractFriction as AbstractFriction
from .friction import Damping as Damping
from .friction import Frictionless as Frictionless
from .friction import RollingResistance as RollingResistance
from .model.input import Motion as Motion
from .model.input import Steady as Steady
from .model.scene import Launch as Launch
from .model.scene import Scene as Scene
from .model.scene import Stroller as Stroller
from .planning.plan import Plan as Plan
from .planning.plan import plan as plan
from .planning.plan import track as track
from .planning.planner import Planner as Planner
from .planning.planner import learn_planner as learn_planner
from .planning.problem import Box as Box
from .planning.problem import Disc as Disc
from .planning.problem import Footprint as Footprint
from .planning.problem import Goal as Goal
from .planning.problem import Limits as Limits
from .runs.model import Recording as Recording
from .runs.model import identify as identify
from .runs.model import log_density as log_density
from .runs.model import read_recording as read_recording
from .runs.model import simulate as simulate
from .runs.model import sweep as sweep
from .runs.trajectory import Trajectory as Trajectory
from .runs.view import explore as explore

# `import *` exports the names above, and not the subpackages.
__all__ = [
    name for name, value in list(globals().items()) if not name.startswith("_") and not isinstance(value, _Module)
]
