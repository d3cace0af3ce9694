"""Hybrid systems: smooth motion in modes with resets between them, for ensembles and single runs, with their derivatives.

`travel` takes an ensemble of runs through the modes of an `AbstractPhase` each (`traced_travel` inside other transformed
functions); `follow_phases` is a single run with its path. `travel_with_slopes` carries tangents through every reset by the
saltation matrix, and `phased_samples` gives states at times, with their derivatives.
"""

from .phased_run import BETWEEN as BETWEEN
from .phased_run import PhasedPath as PhasedPath
from .phased_run import Piece as Piece
from .phased_run import follow_phases as follow_phases
from .phased_samples import PhasedSamples as PhasedSamples
from .phased_samples import phased_samples as phased_samples
from .phases import AbstractPhase as AbstractPhase
from .phases import Journey as Journey
from .phases import Passage as Passage
from .phases import Record as Record
from .phases import marched as marched
from .phases import passed_on as passed_on
from .phases import travel as travel
from .traced_phases import in_rounds as in_rounds
from .traced_phases import traced_travel as traced_travel
from .varied_phases import Slopes as Slopes
from .varied_phases import traced_travel_with_slopes as traced_travel_with_slopes
from .varied_phases import travel_with_slopes as travel_with_slopes
