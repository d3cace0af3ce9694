"""The tippe top: scenes, trajectories and inversion tables."""

from nonholonomic.surface import Cylinder as Cylinder
from nonholonomic.surface import Plane as Plane
from nonholonomic.surface import Sphere as Sphere

from .friction import AbstractFriction as AbstractFriction
from .friction import Coulomb as Coulomb
from .friction import Frictionless as Frictionless
from .friction import Viscous as Viscous
from .launch import Launch as Launch
from .scene import Scene as Scene
from .top import Top as Top
