"""The tippe top: scenes, trajectories and inversion tables."""

from nonholonomic.surface import Cylinder as Cylinder
from nonholonomic.surface import Plane as Plane
from nonholonomic.surface import Sphere as Sphere
from nonholonomic.table import Table as Table

from .friction import AbstractFriction as AbstractFriction
from .friction import Coulomb as Coulomb
from .friction import Frictionless as Frictionless
from .friction import SetValuedCoulomb as SetValuedCoulomb
from .friction import Viscous as Viscous
from .inversion import inversion_time as inversion_time
from .launch import Launch as Launch
from .scene import Scene as Scene
from .table import inversion_table as inversion_table
from .top import Stem as Stem
from .top import Top as Top
from .trajectory import Trajectory as Trajectory
from .trajectory import simulate as simulate
