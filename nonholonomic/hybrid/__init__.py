"""Hybrid systems: smooth motion in modes with resets between them, for ensembles and single runs, with their
derivatives.

`solve_hybrid` integrates an ensemble of runs, each through the modes of a system (`traced_solve_hybrid` inside other
transformed functions); `solve_hybrid_dense` integrates a single run with its path. `solve_hybrid_with_tangents` carries
tangents through every reset by the saltation matrix, and `hybrid_samples` returns states at times, with their
derivatives.
"""

from .ensemble import MOST_ROUNDS as MOST_ROUNDS
from .ensemble import HybridOutcome as HybridOutcome
from .ensemble import after_reset as after_reset
from .ensemble import after_solve as after_solve
from .ensemble import at_start as at_start
from .ensemble import solve_hybrid as solve_hybrid
from .ensemble import traced_solve_hybrid as traced_solve_hybrid
from .mode import AbstractBatchedMode as AbstractBatchedMode
from .mode import AbstractHoppingMode as AbstractHoppingMode
from .mode import Transition as Transition
from .mode import TransitionPath as TransitionPath
from .path import BETWEEN as BETWEEN
from .path import HybridPath as HybridPath
from .path import Segment as Segment
from .path import solve_hybrid_dense as solve_hybrid_dense
from .saltation import Slopes as Slopes
from .saltation import solve_hybrid_with_tangents as solve_hybrid_with_tangents
from .saltation import traced_solve_hybrid_with_tangents as traced_solve_hybrid_with_tangents
from .samples import HybridSamples as HybridSamples
from .samples import hybrid_samples as hybrid_samples
