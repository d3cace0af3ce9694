"""Forward and adjoint derivatives of the end of a run, and the rate at which neighbouring runs diverge.

With few tangents the variations are integrated along with the run; with more, each run is differentiated by one
backward pass. Both hold step lengths fixed. `sampled_run` gives a run at given times, with its derivatives. Hybrid runs
are in `nonholonomic.hybrid`.
"""

from .differentiable import AbstractDifferentiableSolve as AbstractDifferentiableSolve
from .differentiable import differentiable_solve as differentiable_solve
from .differentiable import tangents_by as tangents_by
from .lyapunov import exponent_of as exponent_of
from .lyapunov import growth as growth
from .lyapunov import probed as probed
from .sampled_runs import SampledRun as SampledRun
from .sampled_runs import sampled_run as sampled_run
from .sampled_runs import sampled_run_by_diffrax as sampled_run_by_diffrax
from .sampling import AbstractSampling as AbstractSampling
from .sampling import ProblemSpec as ProblemSpec
from .sampling import solve_for_samples as solve_for_samples
from .slopes import solve_ensemble_with_tangents as solve_ensemble_with_tangents
from .slopes import tangents_of as tangents_of
from .slopes import traced_solve_ensemble_with_tangents as traced_solve_ensemble_with_tangents
from .variation import VariationalProblem as VariationalProblem
from .variation import in_groups as in_groups
from .variation import tangent_scale as tangent_scale
from .variation import where_active as where_active
