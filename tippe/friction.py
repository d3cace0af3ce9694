"""The friction laws, and the classes for a law of your own: the slip at the contact, and the load that the law
returns."""

from .model.friction import AbstractFriction as AbstractFriction
from .model.friction import ContactLoad as ContactLoad
from .model.friction import Contensou as Contensou
from .model.friction import Coulomb as Coulomb
from .model.friction import Frictionless as Frictionless
from .model.friction import Rolling as Rolling
from .model.friction import SetValuedCoulomb as SetValuedCoulomb
from .model.friction import Slip as Slip
from .model.friction import Viscous as Viscous
from .model.friction import length as length
