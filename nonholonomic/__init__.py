"""The shared foundation of the models: surfaces, integration, sweeps, tables, and users' own systems."""

import os
import sys

from .command_line import import_quietly as _import_quietly

# While `python -m` looks for the module to run, `sys.argv[0]` is "-m".
if sys.argv[:1] == ["-m"]:
    _import_quietly()

import jax

#: The only place where the version is set; the package's metadata reads it from here.
__version__ = "0.2.0"

# Use float64 throughout, unless the user chose otherwise. This must be set before the first array is created.
if "JAX_ENABLE_X64" not in os.environ:
    jax.config.update("jax_enable_x64", True)

from .compilation.cache import enable_compilation_cache as enable_compilation_cache
from .geometry import AbstractSurface as AbstractSurface
from .geometry import Cylinder as Cylinder
from .geometry import Graph as Graph
from .geometry import Implicit as Implicit
from .geometry import Paraboloid as Paraboloid
from .geometry import Plane as Plane
from .geometry import Sphere as Sphere
from .geometry import Spheroid as Spheroid
from .geometry import Torus as Torus
from .identification import FitWarning as FitWarning
from .identification import Free as Free
from .integration.problem import Status as Status
from .runs.attractors import LyapunovSpectrum as LyapunovSpectrum
from .runs.attractors import basins as basins
from .runs.attractors import bifurcation as bifurcation
from .runs.attractors import lyapunov_exponent as lyapunov_exponent
from .runs.attractors import lyapunov_spectrum as lyapunov_spectrum
from .runs.branch import Branch as Branch
from .runs.branch import Orbit as Orbit
from .runs.branch import SpecialPoint as SpecialPoint
from .runs.crossings import crossings as crossings
from .runs.event import event_time as event_time
from .runs.identify import EventTimes as EventTimes
from .runs.identify import Recording as Recording
from .runs.identify import identify as identify
from .runs.identify import log_density as log_density
from .runs.orbit import periodic_orbit as periodic_orbit
from .runs.simulate import simulate as simulate
from .runs.table import sweep as sweep
from .runs.trajectory import Trajectory as Trajectory
from .runs.trajectory import explore as explore
from .sweeps import Table as Table
from .sweeps import local_processes as local_processes
from .systems import AbstractMode as AbstractMode
from .systems import AbstractSystem as AbstractSystem
from .systems import Hybrid as Hybrid
