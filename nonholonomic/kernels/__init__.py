"""Runs as programs of scalars: in JavaScript for pages, and in CUDA C for GPUs, where a run is one thread.

`javascript` writes a function that JAX can trace. `SmoothRuns` and `HybridRuns` are the functions and coefficients of a run,
each a `Part` of a program that the loops of a language call. `solve_smooth`, `solve_smooth_with_tangents` and
`solve_in_modes` run the cells of a table by a `Kernel`, and `by_kernel` does so if there is a GPU and the table is large.
"""

from .device_code import solve_in_modes as solve_in_modes
from .device_code import solve_smooth as solve_smooth
from .device_code import solve_smooth_with_samples as solve_smooth_with_samples
from .device_code import solve_smooth_with_tangents as solve_smooth_with_tangents
from .gpu import CELLS_OF_KERNEL as CELLS_OF_KERNEL
from .gpu import by_kernel as by_kernel
from .gpu import chosen_gpu as chosen_gpu
from .gpu import place_of_jax as place_of_jax
from .gpu import require_device as require_device
from .motions import HybridRuns as HybridRuns
from .motions import HybridStart as HybridStart
from .motions import Part as Part
from .scalar_code import javascript as javascript
