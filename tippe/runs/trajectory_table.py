"""Tables of trajectories over the grid of launches and friction."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import numpy as np

from nonholonomic.integration.checks import require_times
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.integration.status import Status
from nonholonomic.runs import Options, Samples, TableForm, TableJob, compute_table
from nonholonomic.sweeps import Table
from nonholonomic.validation import as_number, require, require_kind, require_outside, shown

from ..model.scene import Scene
from .launches import described, launches
from .model import TopModel
from .quantities import QUANTITIES, quantities_of

#: The words for how a run ends, in the order of `Status`.
FORM = TableForm(tuple(Status(code).word for code in range(Status.UNRESOLVED + 1)))


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
      [kg m^2/s] and "slip" [m/s]; "spin_angle" [rad] and "work" [J]; and of an `Ellipsoid` or a `RigidBody` "normal_spin"
      [rad/s], "grip" [1] and "reaction" [N]; all as in `Trajectory` and `HybridTrajectory`.
    - `tolerance`: relative tolerance of the integration.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `progress`, `executor`: as for `inversion_table`.
    - `max_steps`: a run that needs more steps, including rejected ones, fails; at least 1.

    **Returns:** a `Table` with a variable for each quantity. Its dimensions are the axes and "time"; a vector has one
    more dimension, "component" (x, y, z), or "tangent" (t1, t2) for "slip". Values after the end of a run are NaN. The
    table also contains, over the axes: `status` (the word of a `Status`, "completed" at the last of the times),
    `end_time` [s], `steps` and `rejected`; with `contact="hybrid"`, also `hops`, and with `SetValuedCoulomb` `sticks`.

    **Raises:** `ValueError` for arguments out of range, and for an unknown axis or quantity; `OSError` for a path that
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
    require_kind(scene, "scene", Scene)
    names = _names(quantities, list(quantities_of(scene)))
    options = Options(tolerance, max_steps=max_steps, path=path, progress=progress, executor=executor)
    settings = options.settings
    require_times(as_number(times), None)
    times = np.asarray(times, dtype=float)
    require(times[-1], "times[-1]", above=0.0, why="it is the horizon")
    launch_values = {"theta": theta, "eta": eta, "mu": mu, "spin": spin}
    roots, grid, _ = launches(scene, launch_values, axes, times[-1], tolerance, taken=QUANTITIES)
    samples = Samples(times, names)
    model = TopModel(scene=roots["scene"], launch=roots["launch"])
    job = TableJob(model, FORM, float(times[-1]), "first", settings, samples=samples, timed=False)
    request = described(roots, grid) | {"quantities": list(names), "tolerance": float(tolerance)}
    request |= {"solver": type(settings.for_lanes).__name__}
    if max_steps != DEFAULT_MAX_STEPS:
        request |= {"max_steps": int(max_steps)}
    return compute_table(job, grid, job.variables, request, options)


def _names(quantities: Any, known: list[str]) -> tuple[str, ...]:
    """The quantities, checked."""
    if isinstance(quantities, str) or not isinstance(quantities, Sequence) or not quantities:
        raise ValueError(f"quantities = {shown(quantities)} must be a list of names")
    for name in quantities:
        if name not in known:
            raise ValueError(f"quantities: {shown(name)} must be one of {', '.join(known)}")
        if quantities.count(name) > 1:
            raise ValueError(f"quantities: {shown(name)} must be named only once")
    return tuple(quantities)
