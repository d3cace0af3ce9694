"""The friction laws, and the classes for a law of your own."""

from .model.friction import AbstractFriction as AbstractFriction
from .model.friction import Damping as Damping
from .model.friction import Drag as Drag
from .model.friction import Frictionless as Frictionless
from .model.friction import RollingResistance as RollingResistance
