"""The friction laws, and the classes for a law of your own."""

from .model.vehicle import AbstractFriction as AbstractFriction
from .model.vehicle import Damping as Damping
from .model.vehicle import Drag as Drag
from .model.vehicle import Frictionless as Frictionless
from .model.vehicle import RollingResistance as RollingResistance
