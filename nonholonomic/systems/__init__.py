"""Users' own systems as models for the functions of `nonholonomic.runs`.

A hybrid system is a `Hybrid` of modes, each an `AbstractMode`; a mechanical system is an `AbstractSystem`, from whose metric,
potential, constraints and forces the equations of motion follow.
"""

from .form import Hybrid as Hybrid
from .mechanics import AbstractMode as AbstractMode
from .mechanics import AbstractSystem as AbstractSystem
from .model import OwnModel as OwnModel
