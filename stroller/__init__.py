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
from nonholonomic.integration.status import Status as Status
from nonholonomic.sweeps import Table as Table

from . import presets as presets
from .fit.identify import identify as identify
from .fit.identify import log_density as log_density
from .fit.recording import Recording as Recording
from .fit.recording import read_recording as read_recording
from .model.friction import AbstractFriction as AbstractFriction
from .model.friction import Damping as Damping
from .model.friction import Frictionless as Frictionless
from .model.friction import RollingResistance as RollingResistance
from .model.input import Motion as Motion
from .model.input import Steady as Steady
from .model.launch import Launch as Launch
from .model.scene import Scene as Scene
from .model.stroller import Stroller as Stroller
from .planning.goal import Goal as Goal
from .planning.goal import Limits as Limits
from .planning.learn import learn_planner as learn_planner
from .planning.obstacles import Box as Box
from .planning.obstacles import Disc as Disc
from .planning.obstacles import Footprint as Footprint
from .planning.plan import plan as plan
from .planning.planner import Planner as Planner
from .planning.result import Plan as Plan
from .planning.track import track as track
from .runs.trajectory import Trajectory as Trajectory
from .runs.verbs import explore as explore
from .runs.verbs import simulate as simulate
from .runs.verbs import sweep as sweep

# `import *` exports the names above, and not the subpackages.
__all__ = [
    name for name, value in list(globals().items()) if not name.startswith("_") and not isinstance(value, _Module)
]
