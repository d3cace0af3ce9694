"""Tables of trajectories over the grid of launches and friction."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nonholonomic.integration import Settings
from nonholonomic.integration.checks import require_times
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.integration.status import Status
from nonholonomic.parameters import with_numbers
from nonholonomic.sweeps import Axis, Table, Variable, axis, sweep
from nonholonomic.validation import as_number, require, require_outside, require_whole, shown

from ..model.scene import Scene
from .launches import described, launches
from .quantities import COMPONENTS, QUANTITIES
from .run_kind import COUNTED
from .trajectory_cells import solve_cells

#: The ways in which a run can end, in the order of `Status`.
WORDS = tuple(Status(code).word for code in range(Status.UNRESOLVED + 1))

#: Greatest number of values in the samples of a chunk: 256 MB.
MOST_SAMPLED = 1 << 25


def trajectory_table(
    scene: Scene,
    *,
    theta: Any,
    spin: Any,
    eta: Any = 0.0,
    mu: Any = None,
    times: Any,
    axes: dict[str, Any] | None = None,
    quantities: Sequence[str] = ("theta", "eta"),
    tolerance: float = 1e-9,
    path: Any = None,
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> Table:
    """Trajectories over a grid of launches and scenes, sampled at given times, in one batched call on all cores.

    The samples are as accurate as the steps. Up to 999 samples, a step ends on each of them; from 1000 on, they are
    interpolated inside steps. With 1001 samples over 10 s, this table costs 1.6 times as much as a table of inversion times
    to the same horizon.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `theta`, `spin`, `eta`: parameters of the launch, as for `Launch`; `mu`: coefficient of the scene's friction law,
      by default that of the scene. Each list or array becomes an axis of the table, in the order (theta, eta, mu,
      spin). The axes of the launch are called "launch.theta", "launch.eta" and "launch.spin", because `theta` is the
      sampled quantity.
    - `times`: times of the samples [s], increasing, at least 0; the last time is the horizon.
    - `axes`: additional axes, as for `inversion_table`, such as `{"azimuth": [0.0, 1.0]}`.
    - `quantities`: what to sample: any of "theta", "eta", "azimuth" [rad], "theta_rate", "spin" [rad/s], "energy" [J],
      "jellett" [kg m^3/s], "normal_force" [N], and the vectors "axis" [1], "position" [m], "velocity" [m/s], "angular_momentum"
      [kg m^2/s] and "slip" [m/s]; all as in `Trajectory`.
    - `tolerance`: relative tolerance of the integration.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `progress`, `executor`: as for `inversion_table`.
    - `max_steps`: a run that needs more steps, including rejected ones, fails; at least 1.

    **Returns:** a `Table` with a variable for each quantity. Its dimensions are the axes and "time"; a vector has one
    more dimension, "component" (x, y, z), or "tangent" (t1, t2) for "slip". Values after the end of a run are NaN. The
    table also contains, over the axes: `status` (the word of a `Status`, "completed" at the last of the times),
    `end_time` [s], `steps` and `rejected`.

    **Raises:** `ValueError` for arguments out of range, an unknown axis or quantity, and for a scene with
    `contact="hybrid"` or `SetValuedCoulomb`, whose runs only `simulate` samples, one by one; `OSError` for a path that
    cannot be used; `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import numpy as np
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> table = tippe.trajectory_table(scene, theta=[0.1, 0.2], spin=155.0, times=np.linspace(0.0, 1.0, 11))
    >>> table.dims("theta"), table.theta.shape
    (('launch.theta', 'time'), (2, 11))
    >>> print(table.theta[:, -1].round(3), table.status)
    [0.025 0.076] ['completed' 'completed']

    ```
    """
    require_outside((scene, theta, spin, eta, mu, times, axes), "trajectory_table", "simulate with times=")
    names = _names(quantities)
    require_whole(max_steps, "max_steps", 1)
    require_times(as_number(times), None)
    times = np.asarray(times, dtype=float)
    require(times[-1], "times[-1]", above=0.0, why="it is the horizon")
    launch_values = {"theta": theta, "eta": eta, "mu": mu, "spin": spin}
    roots, grid, _ = launches(scene, launch_values, axes, times[-1], tolerance, taken=QUANTITIES)
    reason = "for trajectory_table: simulate samples runs of several modes, one by one"
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' {reason}")
    if scene.friction.set_valued:
        raise ValueError(f"friction = {type(scene.friction).__name__} must be a law with a single mode {reason}")

    inner = [axis("time", "time", "s", times, "time")]
    variables = {}
    for name in names:
        unit, long_name, components, _ = QUANTITIES[name]
        dims = ("time",) if components is None else ("time", components)
        variables[name] = Variable(unit, np.float64, inner=dims, long_name=long_name)
    for dim in dict.fromkeys(QUANTITIES[name].components for name in names):
        inner += [] if dim is None else [Axis(dim, dim, "1", np.array(COMPONENTS[dim]))]
    variables |= {"status": Variable("1", np.int8, WORDS, long_name="how the run ended")}
    variables |= {"end_time": Variable("s", np.float64, long_name="end of the run")}
    variables |= {name: Variable("1", np.int64, long_name=COUNTED[name]) for name in ("steps", "rejected")}
    request = described(roots, grid) | {"quantities": list(names), "tolerance": float(tolerance)}
    settings = Settings(tolerance, max_steps=int(max_steps))
    request |= {"solver": type(settings.for_lanes).__name__}
    if max_steps != DEFAULT_MAX_STEPS:
        request |= {"max_steps": int(max_steps)}
    # A run has about a dozen components.
    max_cells = max(16, 1 << (MOST_SAMPLED // (12 * len(times))).bit_length() - 1)
    job = SamplingJob(roots, times, settings, names)
    options = {"path": path, "most": max_cells, "inner": inner, "progress": progress, "executor": executor}
    return sweep(job, grid, variables, request, **options)


class SamplingJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process."""

    roots: dict[str, Any]
    times: Float[np.ndarray, " times"]
    settings: Settings
    names: tuple[str, ...]

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which only the first `count` are run."""
        cells = with_numbers(self.roots, columns)
        size = next((len(values) for values in columns.values()), 1)
        variables = solve_cells(cells["scene"], cells["launch"], size, self.times, self.settings, self.names, count)
        return {name: np.asarray(values, np.int8 if name == "status" else None) for name, values in variables.items()}


def _names(quantities: Any) -> tuple[str, ...]:
    """The quantities, checked."""
    if isinstance(quantities, str) or not isinstance(quantities, Sequence) or not quantities:
        raise ValueError(f"quantities = {shown(quantities)} must be a list of names")
    for name in quantities:
        if name not in QUANTITIES:
            raise ValueError(f"quantities: {shown(name)} must be one of {', '.join(QUANTITIES)}")
        if quantities.count(name) > 1:
            raise ValueError(f"quantities: {shown(name)} must be named only once")
    return tuple(quantities)
