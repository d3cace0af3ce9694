"""Tables of many launches: inversion times, reversal times, and trajectories."""

from collections.abc import Sequence
from concurrent.futures import Executor
from typing import Any

import diffrax
import numpy as np

from nonholonomic.integration.checks import require_times
from nonholonomic.integration.settings import DEFAULT_MAX_STEPS
from nonholonomic.integration.status import Status
from nonholonomic.runs import Options, TableForm, TableJob, check_cells, compute_table, full_sensitivities, samples_of
from nonholonomic.sweeps import Table
from nonholonomic.validation import as_number, require, require_kind, require_outside, shown
from nonholonomic.warning import warn

from ..model.scene import Scene
from ..modes.inversion_problem import StemContact
from .checks import check_event, check_reversible, event_of, require_rigid, warn_if_it_cannot_invert
from .launches import labels, launches
from .model import INVERSIONS, REVERSALS, TopModel
from .quantities import QUANTITIES, quantities_of
from .run_kind import why_unresolved

#: The words for how the run of a trajectory ends, in the order of `Status`.
TRAJECTORIES = TableForm(tuple(Status(code).word for code in range(Status.UNRESOLVED + 1)))


def too_many_steps(t1: float, max_steps: int, end: float) -> str:
    """Message for a run that needs more than the allowed steps."""
    return (
        f"t1 = {t1:g} s is too long: the run needs more than {max_steps:_} steps, which reached only {end:.4g} s; "
        "take a shorter t1 or a larger tolerance"
    ).replace("_", " ")


def inversion_table(
    scene: Scene,
    *,
    theta: Any,
    spin: Any,
    eta: Any = 0.0,
    mu: Any = None,
    t1: float,
    angle: float | None = None,
    tolerance: float = 1e-9,
    crossing: str = "first",
    path: Any = None,
    azimuth: Any = 0.0,
    axes: dict[str, Any] | None = None,
    solver: diffrax.AbstractERK | None = None,
    method: str = "ensemble",
    scattered: bool = False,
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> Table:
    """Inversion times over a grid of launches and scenes, in one batched call on all cores.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `theta`, `spin`, `eta`, `azimuth`: parameters of the launch, as for `Launch`; `mu`: coefficient of the scene's
      friction law, by default that of the scene. Each list or array becomes an axis of the table, in the order (theta,
      eta, mu, spin, azimuth).
    - `t1`: horizon [s].
    - `angle`: angle [rad] that counts as inverted. By default, a top with a stem counts as inverted when the stem first
      carries it, and any other body when theta reaches 0.95 pi.
    - `tolerance`: relative tolerance of the integration.
    - `crossing`: "first" for the first time theta reaches the angle; "last" for the crossing after which theta stays
      above the angle until `t1` (if theta oscillates, first crossings are ill-conditioned), or, for the contact of a
      stem, the time after which the sphere does not touch until `t1`; "both" for both times from one run: the variables
      `first_time` and `last_time` replace `time`, and the status is that of the last crossing.
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `axes`: additional axes, name of a parameter -> values. The end of a full name is enough if it is unique, such as
      `{"offset": [0.005, 0.006]}` for `"scene.body.offset"`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`, or `Dopri8()` for method "diffrax".
    - `method`: "ensemble" (fast); or "diffrax" for vmapped `diffeqsolve`, a slow reference that supports only first
      crossings and can miss a loss of contact shorter than a step.
    - `scattered`: whether the lists are columns of equal length instead of axes of a grid: the k-th cell has the k-th
      number of each list. The only axis of the table is then "cell", and the columns are variables.
    - `errors`: whether to run every cell again at a hundredth of the tolerance, for error bounds; this costs 2.8 times
      as much as a table without errors. Below a tolerance of 1e-12, the second run has a hundred times the tolerance
      instead of a hundredth, and the bounds are wider.
    - `sensitivities`: names of the parameters with respect to which the times are differentiated, such as
      `["scene.friction.mu", "launch.theta"]`; the end of a name is enough if only one parameter matches.
    - `progress`: whether to show progress, on a terminal or in a notebook; `NONHOLONOMIC_PROGRESS=0` hides it
      everywhere.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes` or of a Dask client;
      by default, a thread for each core. On the same kind of processor, all executors give bitwise equal results.
    - `max_steps`: a run that needs more steps, including rejected ones, fails; at least 1. In a hybrid run, the limit
      applies to each time in a mode; `method="diffrax"` allows 100 000 steps at most.

    **Returns:** a `Table` with the variables

    - `time` [s]: the inversion time, infinite if the top did not invert.
    - `stem_time` [s], for a top with a stem: when the stem first carries it, infinite if it does not by `t1`, whatever the
      angle. In a flight the stem carries nothing until it lands.
    - `status`: "inverted", "not_inverted" by `t1`, "contact_lost", "failed", "jammed", or "unresolved" (the energy grows;
      with `contact="hybrid"`, also 10 000 flights in a row, or sphere and stem on the plane together with so much
      friction that the forces are undetermined; with `SetValuedCoulomb`, also too many changes between slip and rolling).
    - `end_time` [s], `end_theta` [rad]: when and at which inclination the run ended, also if contact was lost or jammed.
    - `steps`, `rejected`: numbers of integration steps.
    - `hops`, with `contact="hybrid"`: number of flights until the run ended. The run continues through flights, and may
      reach the angle in flight.
    - `sticks`, with `SetValuedCoulomb`: number of changes from slip to rolling outside impacts.
    - `time_error` [s], with `errors`: a bound that is infinite if the two runs disagree on the status or failed, and 0 if
      both find no time. `end_time_error` and `end_theta_error` are such bounds, too; `hops_error` and `sticks_error` are
      the differences of the two runs; `status_error` is 1 if the runs disagree on the status or failed.
      `Table.digits("time")` shows the correct digits.
    - `time_by_mu` and so on, with `sensitivities`: the derivative of `time` with respect to each parameter; 0 if the top
      did not invert. Derivatives pass through flights, impacts, stick and slip.
    - `grazes`, with `sensitivities`: 1 if an earlier event, such as a landing, was grazing, so that within the tolerance
      it may not happen; the derivative is then NaN.

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used;
    `RuntimeError` for an executor that breaks down, or a worker with other versions.

    **Example:**

    ```
    >>> import numpy as np
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> table = tippe.inversion_table(scene, theta=[0.1, 0.2], spin=[100.0, 155.0], t1=8.0, tolerance=1e-6)
    >>> print(table.time.round(2))
    [[6.36 5.97]
     [5.86 5.59]]
    >>> print(table.status)
    [['inverted' 'inverted']
     ['inverted' 'inverted']]

    ```
    """
    require_outside((scene, theta, spin, eta, mu, azimuth, axes, t1, angle), "inversion_table", "inversion_time")
    check_event(angle, crossing, ("first", "last", "both"))
    if method not in ("ensemble", "diffrax"):
        raise ValueError(f"method = {shown(method)} must be 'ensemble' or 'diffrax'")
    if method == "diffrax" and sensitivities:
        raise ValueError("method = 'diffrax' must be 'ensemble' for sensitivities")
    if method == "diffrax" and crossing != "first":
        raise ValueError(f"crossing = {shown(crossing)} must be 'first' for method = 'diffrax'")
    launch_values = {"theta": theta, "eta": eta, "mu": mu, "spin": spin, "azimuth": azimuth}
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor)
    return event_table(scene, launch_values, axes, t1, event_of(scene, angle), options, crossing, method)


def reversal_table(
    scene: Scene,
    *,
    theta: Any,
    spin: Any,
    azimuth: Any = 0.0,
    mu: Any = None,
    t1: float,
    tolerance: float = 1e-9,
    path: Any = None,
    axes: dict[str, Any] | None = None,
    solver: diffrax.AbstractERK | None = None,
    scattered: bool = False,
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    progress: bool = True,
    executor: Executor | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> Table:
    """Times of the first reversal of spin over a grid of launches and scenes, in one batched call on all cores.

    **Arguments:** as for `inversion_table`; the body of the scene is an `Ellipsoid` or a `RigidBody`, and the spin is not zero.
    Axes have names such as `"scene.body.inertia.xy"` and `"scene.body.semi_axes[0]"`.

    **Returns:** a `Table` like that of `inversion_table`, with the time [s] at which the spin about the arena's normal
    first vanishes, infinite if it does not, and `status`: "reversed", "not_reversed" by `t1`, "contact_lost", "failed",
    "jammed".

    **Raises:** as for `inversion_table`, and `ValueError` for another body and a launch without spin.

    **Example:** a rattleback reverses sooner in one sense than in the other.

    ```
    >>> import tippe
    >>> inertia = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]
    >>> body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), inertia)
    >>> scene = tippe.Scene(body, friction=tippe.NoSlip())
    >>> table = tippe.reversal_table(scene, theta=0.02, spin=[-5.0, 5.0], t1=9.0, tolerance=1e-6)
    >>> print(table.time.round(2), table.status)
    [2.61 8.17] ['reversed' 'reversed']

    ```
    """
    require_outside((scene, theta, spin, azimuth, mu, axes, t1), "reversal_table", "reversal_time")
    require_kind(scene, "scene", Scene)
    require_rigid(scene)
    launch_values = {"theta": theta, "mu": mu, "spin": spin, "azimuth": azimuth}
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor)
    return event_table(scene, launch_values, axes, t1, None, options)


def event_table(
    scene: Scene,
    launch_values: dict[str, Any],
    axes: dict[str, Any] | None,
    t1: float,
    angle: Any,
    options: Options,
    crossing: str = "first",
    method: str = "ensemble",
) -> Table:
    """The table of the times at which theta reaches an angle, at which the stem carries the top, or, without an angle,
    at which the spin about the normal reverses.

    **Arguments:** as for `inversion_table`; `launch_values`: name of a launch's parameter, or "mu" -> a number or a
    list.
    """
    roots, grid = launches(scene, launch_values, axes, t1, options.tolerance)
    settings, form = options.settings, REVERSALS if angle is None else INVERSIONS
    model = TopModel.timed(**roots, angle=angle)
    names = full_sensitivities(model, options.sensitivities, crossing)
    if not model.smooth and method == "diffrax":
        raise ValueError(
            "method = 'diffrax' does not support runs of several modes: contact = 'hybrid' or SetValuedCoulomb"
        )
    check_cells(model, grid, options)
    axis_values = {axis.number: axis.values for axis in grid}
    if angle is None:
        check_reversible(roots["launch"], axis_values)
        request: dict[str, Any] = {"event": "reversal"}
    else:
        on_stem = isinstance(angle, StemContact)
        theta = axis_values.get("launch.theta", roots["launch"].theta)
        warn_if_it_cannot_invert(scene, roots["launch"], theta, None if on_stem else float(angle))
        request = {"event": "contact of the stem"} if on_stem else {"angle": float(angle)}
    request |= {"t1": float(t1), "crossing": crossing, "method": method}
    shorts = [name.rsplit(".", 1)[-1] for name in names]
    slopes = {
        name: "time_by_" + (short if shorts.count(short) == 1 else name.replace(".", "_"))
        for name, short in zip(names, shorts, strict=True)
    }
    units = {name: unit for name, (_, unit, _) in labels(scene, roots["launch"], names, ()).items()}
    by_diffrax = method == "diffrax"
    job = TableJob(model, form, float(t1), crossing, settings, slopes, options.errors, by_diffrax=by_diffrax)
    table = compute_table(job, grid, units, request, options)
    warn_of_long_runs(table, float(t1), options.max_steps)
    # Tables whose variables stay in the file are not checked.
    if model.smooth and isinstance(table.variables, dict):
        unresolved = np.asarray(table.variables["status"] == "unresolved")
        if unresolved.any():
            warn(f"{unresolved.sum()} of {unresolved.size} runs are unresolved: {why_unresolved(model.kind)}")
    return table


def warn_of_long_runs(table: Table, t1: float, max_steps: int) -> None:
    """Warn of runs that needed more than the allowed steps. Tables whose variables stay in the file are not checked."""
    if not isinstance(table.variables, dict):
        return
    is_long = (table.variables["status"] == "failed") & (table.variables["steps"] >= max_steps)
    if is_long.any():
        end = float(np.min(table.variables["end_time"][is_long]))
        warn(f"{is_long.sum()} of {is_long.size} runs have failed: {too_many_steps(t1, max_steps, end)}")


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
    solver: diffrax.AbstractERK | None = None,
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
    - `solver`: as for `inversion_table`.

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
    require_times(as_number(times), None)
    samples = samples_of(quantities_of(scene), times, quantities, None)
    assert samples is not None
    options = Options(tolerance, solver, max_steps, path=path, progress=progress, executor=executor)
    settings, t1 = options.settings, samples.times[-1]
    require(t1, "times[-1]", above=0.0, why="it is the horizon")
    launch_values = {"theta": theta, "eta": eta, "mu": mu, "spin": spin}
    roots, grid = launches(scene, launch_values, axes, t1, tolerance, taken=QUANTITIES)
    model = TopModel(scene=roots["scene"], launch=roots["launch"])
    check_cells(model, grid, options)
    job = TableJob(model, TRAJECTORIES, float(t1), "first", settings, samples=samples, timed=False)
    return compute_table(job, grid, {}, {}, options)
