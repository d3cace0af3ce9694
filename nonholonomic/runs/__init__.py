"""The questions about runs, once for every model: a run, the time of an event, tables, fits, exponents, pages.

An `AbstractModel` answers what one system is: its modes for a start, its quantities, how a run ended, and its
parameters by name. `model_of` finds the model of a scene or of a user's own system.
"""

from .model import AbstractModel as AbstractModel
from .model import model_of as model_of
