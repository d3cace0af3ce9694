"""Derivatives of the end of a run, forwards along it and backwards through it; and the rate at which neighbouring runs diverge.

For one direction the variation is integrated along with the run; for several, every run is differentiated backwards
once. Step lengths are held fixed in both. `sampled_run` gives a run at given times, with its derivatives. Runs of several
modes are in `nonholonomic.hybrid`.
"""

from .differentiable import AbstractQuestion as AbstractQuestion
from .differentiable import ask as ask
from .differentiable import directions_by as directions_by
from .lyapunov import exponent_of as exponent_of
from .lyapunov import growth as growth
from .lyapunov import probed as probed
from .sampled_runs import SampledRun as SampledRun
from .sampled_runs import sampled_run as sampled_run
from .sampled_runs import sampled_run_by_diffrax as sampled_run_by_diffrax
from .sampling import AbstractSampling as AbstractSampling
from .sampling import Recipe as Recipe
from .sampling import ask_for_samples as ask_for_samples
from .slopes import compiled_march_with_slopes as compiled_march_with_slopes
from .slopes import directions_of as directions_of
from .slopes import traced_march_with_slopes as traced_march_with_slopes
from .variation import VariationalProblem as VariationalProblem
from .variation import in_groups as in_groups
from .variation import natural_size as natural_size
from .variation import where_moved as where_moved
