"""The functions for launches of a top: single runs, inversion times, tables."""

import math
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import Any, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, ArrayLike, Bool, Float

from nonholonomic.compilation.xla_cpu import greatest, least
from nonholonomic.derivatives import VariationalProblem, differentiable_solve, in_groups, tangents_by
from nonholonomic.integration import Lanes, Settings, crossing_time, solve_ensemble
from nonholonomic.integration.problem import (
    CROSSED,
    DEFAULT_MAX_STEPS,
    FAILED,
    LEFT_DOMAIN,
    MOST_STEPS,
    Status,
    require_run,
)
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.runs.attractors import LyapunovExponent, exponent_of_model
from nonholonomic.runs.event import EventTime, time_of_event
from nonholonomic.runs.model import Number, check_horizon, settings_for_lanes
from nonholonomic.runs.simulate import samples_of
from nonholonomic.runs.table import (
    Options,
    TableForm,
    TableJob,
    check_cells,
    compute_table,
    full_axes,
    full_sensitivities,
)
from nonholonomic.sweeps import Axis, Table, axis
from nonholonomic.terminal import status_line
from nonholonomic.text import in_unit, shown, unit_of
from nonholonomic.validation import IN_DEGREES, as_number, is_traced, require, require_kind, require_outside, warn

from ..friction import Frictionless
from ..model.body import Top
from ..model.dynamics import inclination, parts
from ..model.rigid import AbstractRigidBody
from ..model.scene import Launch, Scene
from ..modes.problems import InversionProblem, StemContact, angle_of, event_of
from .model import INVERSIONS, REVERSALS, SEVERAL, TopModel, of_launches, why_unresolved
from .observables import QUANTITIES, quantities_of
from .trajectory import HybridTrajectory, Trajectory, simulate_launch

#: One value or several of a number of a launch, and the values of other parameters by their names.
NumberOrList: TypeAlias = ArrayLike | Sequence[float] | None
Axes: TypeAlias = dict[str, ArrayLike | Sequence[float]] | None

# Checks of the arguments of a run, before anything compiles and inside a program.

#: The most turns a second by hand: greater spins are not taken for turns a second.
MOST_TURNS = 50.0

#: A horizon [s] above which milliseconds are suspected.
LONGEST = 1000.0

#: Advice in messages about lists, where a table is the better choice.
LISTS = "inversion_table takes lists, and jax.vmap maps over them"


def check_run(scene: Any, launch: Any, t1: Number, tolerance: Number, lists: str = LISTS) -> None:
    """Raise `ValueError` unless the arguments are a scene, a launch that the scene allows, a positive horizon and a
    legal tolerance.

    **Arguments:** as for `require_run`.
    """
    require_run(scene, launch, t1, tolerance, (Scene, Launch), lists)
    scene.check_start(launch)
    if not is_traced(t1) and np.max(t1) > LONGEST:
        warn(f"t1 = {np.max(t1):g} s is long for a top; times are in seconds: did you mean t1={np.max(t1) / 1e3:g}?")


def warn_if_it_cannot_invert(scene: Scene, launch: Launch, theta: Any, spin: object, angle: ArrayLike | None) -> None:
    """Warn if the scene has no friction, if the top stands exactly upright on a level plane or is inverted already, or if
    it is too slow to turn over, and would not be if its spin were in turns a second.

    **Arguments:** `launch`: its theta and its spin are ignored; `theta`: one angle or several [rad]; `spin`: one or
    several [rad/s]; `angle`: the angle to be reached, or `None` (see `event_of`).
    """
    if isinstance(scene.friction, Frictionless):
        warn(
            "friction = Frictionless(): without friction no top turns over; give the scene a law, such as "
            "tippe.Scene(top, friction=tippe.Viscous(0.3))"
        )
    limit = angle_of(scene, angle)
    if isinstance(scene.body, AbstractRigidBody) or is_traced(theta) or is_traced(limit):
        return
    if np.any(np.asarray(theta) >= np.min(limit)):
        unit, factor = in_unit("rad", unit_of(launch))
        start, least_angle = factor * float(np.max(np.asarray(theta))), factor * float(np.min(limit))
        on_stem = angle is None and scene.has_stem
        reached = "the angle at which the stem touches a level plane" if on_stem else "the angle to be reached"
        warn(
            f"theta = {start:g} {unit} is not below {reached}, {least_angle:.4g} {unit}: the top "
            f"{'stands on its stem' if on_stem else 'is inverted'} from the start"
            f"{IN_DEGREES.format(f'{start:g}') if unit == 'rad' else ''}"
        )
    is_at_rest = launch.velocity is None and launch.angular_velocity is None
    if scene.level and is_at_rest and np.any(np.asarray(theta) == 0.0):
        warn("theta = 0.0 is exactly upright, where a top stays forever: launch it at a small angle, such as 0.01 rad")
    warn_if_slow(scene, launch, theta, spin, limit)


def warn_if_slow(scene: Scene, launch: Launch, theta: ArrayLike, spin: object, limit: ArrayLike) -> None:
    """Warn if a top is too slow to turn over, and would not be in another unit of its spin. **Arguments:** as for
    `warn_if_it_cannot_invert`; `limit`: the angle to be reached [rad]."""
    at_rest = launch.velocity is None and launch.angular_velocity is None
    if not isinstance(scene.body, Top) or not at_rest or is_traced((scene, theta, spin, limit)):
        return
    # The spin of which Jellett's constant is that of the tumbling top (`steady.tumbling`), the greatest on the way from the
    # start to the angle: from the upright position on, it is `steady.upright_critical_spin`.
    body, fastest = scene.body, float(np.max(np.abs(np.asarray(spin))))
    mass, R, a, I1, I3 = (float(getattr(body, name)) for name in body.units)
    end, start = (float(np.cos(np.min(inclination))) for inclination in (limit, theta))
    if abs(I1 - I3) * R < I3 * a and start * R > a and fastest <= MOST_TURNS:
        cosine = np.linspace(min(end, start), start, 100)
        precession = np.sqrt(mass * float(scene.gravity) * a / (I3 * (a / R - cosine) + I1 * cosine))
        momentum = R * (I1 * (1.0 - cosine**2) + I3 * (cosine - a / R) ** 2) * precession
        slowest = float(np.max(momentum)) / (I3 * (R * start - a))
        unit, factor = in_unit("rad/s", unit_of(launch))
        number, turns = factor * fastest, 2.0 * math.pi * factor
        for other, size in {"rad/s": factor, "turns a second": turns}.items():
            # Such a top would turn over if its spin were in the other unit.
            if fastest < slowest < size * fastest:
                warn(
                    f"spin = {number:.4g} {unit} is slow: this top needs about {factor * slowest:.3g} {unit} to turn over; was "
                    f"it in {other}? {number:.4g} {other} are {size * number:.4g} {unit}"
                )
                break


def check_smooth(scene: Scene, caller: str) -> None:
    """Raise `ValueError` for a scene with hybrid runs, which do not support derivatives here."""
    if scene.contact == "hybrid":
        raise ValueError(f"contact = 'hybrid' must be 'stop' for {caller}; inversion_table supports flights")
    if scene.friction.set_valued:
        kind = type(scene.friction).__name__
        raise ValueError(
            f"friction = {kind} must be a law with a single mode for {caller}; inversion_table supports others"
        )


def check_reversible(scene: Scene, launch: Launch, values: Mapping[str, object] | None = None) -> None:
    """Raise `ValueError` for a body that cannot reverse its spin, and for a launch without spin.

    **Arguments:** `values`: full name of a number -> values in place of the launch's own.
    """
    if not isinstance(scene.body, AbstractRigidBody):
        kind = type(scene.body).__name__
        raise ValueError(
            f"body = {kind} must be an Ellipsoid or a RigidBody for times of reversal: a body of revolution keeps its "
            "sense of rotation"
        )
    spin = (values or {}).get("launch.spin", launch.spin)
    if launch.angular_velocity is None and not is_traced(spin) and np.any(np.asarray(spin) == 0.0):
        raise ValueError("spin = 0.0 must not be zero: a spin of zero cannot reverse")


def check_event(angle: Any, crossing: object, known: tuple[str, ...] = ("first", "last")) -> None:
    """Raise `ValueError` unless the angle is `None` or in (0, pi], and the crossing is a known word."""
    if angle is not None:
        require(angle, "angle", above=0.0, at_most=math.pi, unit="rad")
    if angle is not None and np.ndim(angle) != 0:
        raise ValueError(f"angle must be one number, not of shape {np.shape(angle)}")
    if crossing not in known:
        raise ValueError(f"crossing = {shown(crossing)} must be {' or '.join(map(repr, known))}")


# Tables of many launches: inversion times, reversal times, and trajectories.


def launches(
    scene: Any, launch_values: dict[str, Any], axes: Any, t1: Number, tolerance: Number, taken: Collection[str] = ()
) -> tuple[dict[str, Any], list[Axis]]:
    """The scene and launch that all cells share, and the axes of the grid.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch_values`: parameter of the launch, or "mu" for the scene's friction -> a number or a list; `None` keeps the
      scene's own `mu`; or "launch" -> a `Launch` with its parameters.
    - `axes`: full name of a parameter, or its unambiguous end -> values, or `None`; the numbers of a launch's vectors
      are `"launch.place[0]"` and so on; omitted numbers are 0.
    - `t1`, `tolerance`: as for `inversion_table`.
    - `taken`: names that no axis may have, as for `TopModel.label`.

    **Returns:** a dictionary with "scene" and "launch", in which only the numbers that are not axes have their values,
    for `with_numbers`; and the axes, the last varying fastest.

    **Raises:** `ValueError` for arguments out of range or an unknown axis.
    """
    require_kind(scene, "scene", Scene)
    # Those of a launch that leaves nothing out.
    complete = Launch(0.0, 0.0, place=(0.0, 0.0, 0.0), velocity=(0.0, 0.0), angular_velocity=(0.0, 0.0, 0.0))
    axes = full_axes({} if axes is None else axes, TopModel(scene=scene, launch=complete).full_name)
    for name in ("theta", "spin") if launch_values.get("launch") is None else ():
        if launch_values.get(name, 0.0) is None:
            raise ValueError(f"{name} = None is not a number: pass a launch, or both theta and spin")
    stated, launch_values = launch_values.get("launch"), {k: v for k, v in launch_values.items() if k != "launch"}
    if stated is not None:
        require_kind(stated, "launch", Launch, several="scattered=True takes lists of their numbers, by name")
        if doubled := [name for name, value in launch_values.items() if name != "mu" and np.any(value)]:
            lists = ", ".join(f"'{name}': [...]" for name in doubled)
            raise ValueError(f"launch must be left out where its numbers are given; or pass these by axes={{{lists}}}")
        own = {name for name in launch_values if f"launch.{name}" not in axes}
        launch_values = {name: getattr(stated, name, value) for name, value in launch_values.items() if name in own}
        others = {name: value for name, value in numbers("launch", stated).items() if value is not None}
        axes = {name: value for name, value in others.items() if name[len("launch.") :] not in launch_values} | axes
    friction_numbers = numbers("scene.friction", scene.friction)
    of_mu = next((number for number in friction_numbers if number.endswith(".mu")), "scene.friction.mu")
    paths = {name: of_mu if name == "mu" else f"launch.{name}" for name in launch_values}
    values = {paths[name]: value for name, value in launch_values.items() if name != "mu" or value is not None}
    for number in values:
        if number in axes:
            raise ValueError(f"axes: {number!r} has its own argument")
    values |= axes
    scalars = {number: value for number, value in values.items() if np.ndim(value) == 0}
    # A launch with entries for all given numbers.
    sizes = {name: len(parts) for name, parts in SEVERAL.items()}
    sizes["place"] = 3 if "launch.place[2]" in values else len(scene.surface.coordinates)
    unindexed = {number.partition("[")[0] for number in values}
    vectors = {name: (0.0,) * size for name, size in sizes.items() if f"launch.{name}" in unindexed}
    roots = with_numbers({"launch": Launch(0.0, 0.0, **vectors), "scene": scene}, scalars)
    roots["launch"].stated_in(unit_of(stated))
    names = TopModel(**roots).label(list(values), taken)
    listed = [(number, *names[number]) for number in values if number not in scalars]
    grid = [axis(name, number, unit, values[number], long_name) for number, name, unit, long_name in listed]
    # The numbers of axes are 0 here, which may not be a place on the arena; starts are checked cell by cell.
    require_run(roots["scene"], roots["launch"], t1, tolerance, (Scene, Launch), LISTS)
    return roots, grid


def too_many_steps(t1: float, max_steps: int, end: float) -> str:
    """Message for a run that needs more than the allowed steps."""
    return (
        f"t1 = {t1:g} s is too long: the run needs more than {max_steps:_} steps, which reached only {end:.4g} s; "
        "take a shorter t1 or a larger tolerance"
    ).replace("_", " ")


@of_launches
def inversion_table(
    scene: Scene,
    launch: Launch | None = None,
    *,
    theta: NumberOrList = None,
    spin: NumberOrList = None,
    eta: NumberOrList = 0.0,
    mu: NumberOrList = None,
    t1: float,
    angle: float | None = None,
    tolerance: float = 1e-9,
    crossing: str = "first",
    path: str | Path | None = None,
    azimuth: NumberOrList = 0.0,
    axes: Axes = None,
    solver: diffrax.AbstractERK | None = None,
    method: str = "ensemble",
    scattered: bool = False,
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    progress: bool = True,
    executor: Executor | None = None,
    device: str | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
) -> Table:
    """Inversion times over a grid of launches and scenes, in one batched call on all cores.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch`: a `Launch`; or `theta`, `spin`, `eta`, `azimuth`: its numbers; `mu`: coefficient of the scene's friction
      law, by default that of the scene. Each list or array becomes an axis of the table, in the order (theta, eta, mu, spin,
      azimuth). After `Launch.degrees`, texts and pictures of the table are in degrees and rpm.
    - `t1`: horizon [s].
    - `angle`: angle [rad] that counts as inverted. By default, a top with a stem counts as inverted when the stem first
      carries it, and any other body when theta reaches 0.95 pi.
    - `tolerance`: relative tolerance of the integration.
    - `crossing`: "first" for the first time theta reaches the angle; "last" for the crossing after which theta stays
      above the angle until `t1` (if theta oscillates, first crossings are ill-conditioned), or, for the contact of a
      stem, the time after which the sphere does not touch until `t1`; "both" for both times from one run: the variables
      `first_time` and `last_time` replace `time`, the status is that of the last crossing, and texts and pictures tell
      tops that were inverted for a time from the others (`table.for_a_time`).
    - `path`: HDF5 file to write, chunk by chunk. Repeat the same call to resume an interrupted table.
    - `axes`: additional axes, name of a parameter -> values. The end of a full name is enough if it is unique, such as
      `{"offset": [0.005, 0.006]}` for `"scene.body.offset"`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`, or `Dopri8()` for method "diffrax".
    - `method`: "ensemble" (fast); or "diffrax" for vmapped `diffeqsolve`, a slow reference that supports only first
      crossings and can miss a loss of contact shorter than a step.
    - `scattered`: whether the lists are columns of equal length instead of axes of a grid: the k-th cell has the k-th
      number of each list. The only axis of the table is then "cell", and the columns are variables.
    - `errors`: whether to run every cell again at 1e-2 and 1e-4 of the tolerance, for error bounds; this costs 6 times
      as much as a table without errors. Below a tolerance of 1e-12, there is one other run, at a hundred times the
      tolerance, and the bounds are wider.
    - `sensitivities`: names of the parameters with respect to which the times are differentiated, such as
      `["scene.friction.mu", "launch.theta"]`; the end of a name is enough if only one parameter matches.
    - `progress`: whether to show progress, on a terminal or in a notebook; `NONHOLONOMIC_PROGRESS=0` hides it
      everywhere.
    - `executor`: any `concurrent.futures.Executor`, such as that of `nonholonomic.local_processes` or of a Dask client;
      by default, a thread for each core. On the same kind of processor, all executors give bitwise equal results.
    - `device`: "cpu" or "gpu"; by default, large tables run on a GPU if there is one.
    - `max_steps`: a run that needs more steps, including rejected ones, fails; at least 1. In a hybrid run, the limit
      applies to each time in a mode; `method="diffrax"` allows 100 000 steps at most.

    **Returns:** a `Table` with the variables

    - `time` [s]: the inversion time, infinite if the top did not invert.
    - `stem_time` [s], for a top with a stem: when the stem first carries it, infinite if it does not by `t1`, whatever the
      angle. In a flight the stem carries nothing until it lands.
    - `status`: "inverted" (for the first time, if `crossing` is "first": the run ends there), "not_inverted" by `t1`,
      "contact_lost", "failed", "jammed", or "unresolved" (the energy grows; with `contact="hybrid"`, also 10 000 flights
      in a row, or sphere and stem on the plane together with so much friction that the forces are undetermined; with
      `SetValuedCoulomb`, also too many changes between slip and rolling).
    - `end_time` [s], `end_theta` [rad]: when and at which inclination the run ended, also if contact was lost or jammed.
    - `steps`, `rejected`: numbers of integration steps.
    - `hops`, with `contact="hybrid"`: number of flights until the run ended. The run continues through flights, and may
      reach the angle in flight.
    - `sticks`, with `SetValuedCoulomb`: number of changes from slip to rolling outside impacts.
    - `time_error` [s], with `errors`: a bound that is infinite if the runs disagree on the status or failed, and 0 if
      none finds a time. `end_time_error` and `end_theta_error` are such bounds, too; `hops_error` and `sticks_error` are
      the differences of the runs; `status_error` is 1 if the runs disagree on the status or failed.
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
    require_outside(
        (scene, launch, theta, spin, eta, mu, azimuth, axes, t1, angle), "inversion_table", "inversion_time"
    )
    require_kind(scene, "scene", Scene)
    check_event(angle, crossing, ("first", "last", "both"))
    if method not in ("ensemble", "diffrax"):
        raise ValueError(f"method = {shown(method)} must be 'ensemble' or 'diffrax'")
    if method == "diffrax" and sensitivities:
        raise ValueError("method = 'diffrax' must be 'ensemble' for sensitivities")
    if method == "diffrax" and crossing != "first":
        raise ValueError(f"crossing = {shown(crossing)} must be 'first' for method = 'diffrax'")
    launch_values = {"launch": launch, "theta": theta, "eta": eta, "mu": mu, "spin": spin, "azimuth": azimuth}
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor, device)
    return event_table(scene, launch_values, axes, t1, event_of(scene, angle), options, crossing, method)


@of_launches
def reversal_table(
    scene: Scene,
    launch: Launch | None = None,
    *,
    theta: NumberOrList = None,
    spin: NumberOrList = None,
    azimuth: NumberOrList = 0.0,
    mu: NumberOrList = None,
    t1: float,
    tolerance: float = 1e-9,
    path: str | Path | None = None,
    axes: Axes = None,
    solver: diffrax.AbstractERK | None = None,
    scattered: bool = False,
    errors: bool = False,
    sensitivities: Sequence[str] = (),
    progress: bool = True,
    executor: Executor | None = None,
    device: str | None = None,
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
    require_outside((scene, launch, theta, spin, azimuth, mu, axes, t1), "reversal_table", "reversal_time")
    launch_values = {"launch": launch, "theta": theta, "mu": mu, "spin": spin, "azimuth": azimuth}
    options = Options(tolerance, solver, max_steps, scattered, errors, sensitivities, path, progress, executor, device)
    return event_table(scene, launch_values, axes, t1, None, options)


def event_table(
    scene: Scene,
    launch_values: dict[str, object],
    axes: Axes,
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
        check_reversible(scene, roots["launch"], axis_values)
        request: dict[str, object] = {"event": "reversal"}
    else:
        on_stem = isinstance(angle, StemContact)
        theta, spin = (axis_values.get(f"launch.{name}", getattr(roots["launch"], name)) for name in ("theta", "spin"))
        warn_if_it_cannot_invert(scene, roots["launch"], theta, spin, None if on_stem else float(angle))
        request = {"event": "contact of the stem"} if on_stem else {"angle": float(angle)}
    request |= {"t1": float(t1), "crossing": crossing, "method": method}
    shorts = [name.rsplit(".", 1)[-1] for name in names]
    slopes = {
        name: "time_by_" + (short if shorts.count(short) == 1 else name.replace(".", "_"))
        for name, short in zip(names, shorts, strict=True)
    }
    job = TableJob(model, form, float(t1), crossing, settings, slopes, options.errors, by_diffrax=method == "diffrax")
    table = compute_table(job, grid, request, options)
    # Tables whose variables stay in the file are not checked.
    if not isinstance(table.variables, dict):
        return table
    status, steps = table.variables["status"], table.variables["steps"]
    is_long = (status == "failed") & (steps >= options.max_steps)
    if is_long.any():
        end = float(np.min(table.variables["end_time"][is_long]))
        warn(f"{is_long.sum()} of {status.size} runs have failed: {too_many_steps(float(t1), options.max_steps, end)}")
    if model.smooth and (unresolved := np.sum(status == "unresolved")):
        warn(f"{unresolved} of {status.size} runs are unresolved: {why_unresolved(smooth=True)}")
    return table


@of_launches
def trajectory_table(
    scene: Scene,
    launch: Launch | None = None,
    *,
    theta: NumberOrList = None,
    spin: NumberOrList = None,
    eta: NumberOrList = 0.0,
    mu: NumberOrList = None,
    times: ArrayLike | Sequence[float],
    axes: Axes = None,
    quantities: Sequence[str] = ("theta", "eta"),
    tolerance: float = 1e-9,
    path: str | Path | None = None,
    progress: bool = True,
    executor: Executor | None = None,
    device: str | None = None,
    max_steps: int = DEFAULT_MAX_STEPS,
    solver: diffrax.AbstractERK | None = None,
) -> Table:
    """Trajectories over a grid of launches and scenes, sampled at given times, in one batched call on all cores.

    The samples are as accurate as the steps. Up to 999 samples, a step ends on each of them; from 1000 on, they are
    interpolated inside steps. With 1001 samples over 10 s, this table costs 1.6 times as much as a table of inversion times
    to the same horizon.

    **Arguments:**

    - `scene`: the scene; all its numbers must be scalars.
    - `launch`, `theta`, `spin`, `eta`: as for `inversion_table`; `mu`: coefficient of the scene's friction law,
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
    - `progress`, `executor`, `device`: as for `inversion_table`.
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
    require_outside((scene, launch, theta, spin, eta, mu, times, axes), "trajectory_table", "simulate with times=")
    require_kind(scene, "scene", Scene)
    samples = samples_of(quantities_of(scene), times, quantities, None)
    assert samples is not None
    options = Options(tolerance, solver, max_steps, path=path, progress=progress, executor=executor, device=device)
    settings, t1 = options.settings, samples.times[-1]
    require(t1, "times[-1]", above=0.0, why="it is the horizon")
    launch_values = {"launch": launch, "theta": theta, "eta": eta, "mu": mu, "spin": spin}
    roots, grid = launches(scene, launch_values, axes, t1, tolerance, taken=QUANTITIES)
    model = TopModel(**roots)
    check_cells(model, grid, options)
    job = TableJob(model, TableForm(), float(t1), "first", settings, samples=samples, timed=False)
    return compute_table(job, grid, {}, options)


# The functions for single launches, on those of `nonholonomic.runs`.


@of_launches
@status_line("simulating")
def simulate(
    scene: Scene,
    launch: Launch,
    t1: float | Float[Array, ""],
    times: ArrayLike | Sequence[float] | None = None,
    tolerance: float | Float[Array, ""] = 1e-9,
    solver: diffrax.AbstractSolver | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Trajectory | HybridTrajectory:
    """Simulate one launch until `t1`, or until contact is lost or jams; with `contact="hybrid"`, through flights and
    impacts.

    Inside a transformation (`jit`, `vmap`, `grad`) `times` must be given; entries after the end of the run (see
    `status` and `end_time`) are then NaN. A batch from `vmap` is solved as one ensemble, like the cells of a table. If
    a program under `jit` does not use path, rotation or work, they are not integrated.

    **Arguments:**

    - `scene`, `launch`: all their numbers must be scalars.
    - `t1`: horizon [s].
    - `times`: times of the result [s], increasing, within [0, t1]; by default those of the accepted steps. Outside
      transformations, times after the end of the run are omitted; `Trajectory.at` returns the run at other times.
    - `tolerance`: relative tolerance, in [1e-14, 1e-2]; absolute tolerances are `tolerance`/10 in units of `Scene.scales`.
    - `solver`: any adaptive solver of Diffrax for ordinary differential equations; by default `Dopri8()`; inside
      transformations without an `adjoint`, `nonholonomic.integration.Oscillatory8()`.
    - `adjoint`: `RecursiveCheckpointAdjoint()` or `ForwardMode()` of Diffrax, with which Diffrax integrates a
      traced run. This is cheaper for a loss function with many parameters, but can miss a loss of contact shorter than
      a step. By default, this package computes forward and reverse derivatives, at the cost of about one run for each
      parameter.

    **Returns:** a `Trajectory`, or a `HybridTrajectory` for a hybrid scene.

    **Raises:** `ValueError` for arguments out of range, and for times that are all after the end of the run. For a
    hybrid scene or `SetValuedCoulomb` inside a transformation, also for an `adjoint`, for a solver that is not an explicit
    Runge-Kutta method, for derivatives with respect to `times`, and for second derivatives.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> run = tippe.simulate(scene, tippe.Launch(0.1, 155.0), t1=1.0, tolerance=1e-6)
    >>> print(f"{run.theta[-1]:.3f} rad, {run.spin[-1]:.1f} rad/s, {run.status}")
    0.025 rad, 154.0 rad/s, completed

    ```
    """
    check_run(scene, launch, t1, tolerance, "jax.vmap(simulate) takes lists, and so does trajectory_table")
    warn_if_slow(scene, launch, launch.theta, launch.spin, angle_of(scene, None))
    return simulate_launch(TopModel(scene=scene, launch=launch), t1, times, tolerance, solver, adjoint)


@of_launches
@status_line("simulating")
def inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[ArrayLike, ""] | None = None,
    tolerance: float = 1e-9,
    crossing: str = "first",
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""] | float:
    """Time at which the top has turned over; works under `jit`, `vmap`, `grad`, `jvp` and their compositions.

    The derivative comes from the implicit function theorem at the event; it is 0 if the result is infinite. Together
    with derivatives, a time costs two to three times as much for one parameter, four times for two, and six to eight
    times for more (`nonholonomic/derivatives/adjoint.py`). Second derivatives use forward mode.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`; all numbers must be scalars.
    - `t1`: horizon [s], positive.
    - `angle`: angle [rad] that theta reaches, in (0, pi]. By default, a top with a stem has turned over when the stem
      first carries it, and any other body when theta reaches 0.95 pi.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `crossing`: "first" for the first time theta reaches the angle, "last" for the crossing after which theta stays
      above the angle until `t1`; for the contact of a stem, the time after which the sphere does not touch until `t1`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if the top has not inverted by `t1`, or loses contact or jams before; NaN
    if the integration failed, if the run is unresolved, or if numbers inside a transformation are out of range.

    With `contact="hybrid"` and `SetValuedCoulomb`, first derivatives include flights, impacts, stick and slip
    (`nonholonomic/hybrid/saltation.py`). If an earlier event is grazing (within the tolerance, it may not happen), the
    derivative is NaN; the variable `grazes` of `inversion_table` reports this.

    **Raises:** `ValueError` for arguments outside these ranges, for a run that needs more than 2 000 000 steps, for
    second derivatives through changes of mode, and for derivatives of the last contact of a stem.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> time = tippe.inversion_time(scene, tippe.Launch(0.1, 155.0), t1=8.0, tolerance=1e-6)
    >>> print(f"{time:.2f} s")
    5.97 s

    ```
    """
    check_run(scene, launch, t1, tolerance)
    check_event(angle, crossing)
    warn_if_it_cannot_invert(scene, launch, launch.theta, launch.spin, angle)
    model = TopModel.timed(scene, launch, event_of(scene, angle))
    return first_or_last_time(model, t1, crossing, settings_for_lanes(tolerance, solver))


@of_launches
@status_line("simulating")
def reversal_time(
    scene: Scene, launch: Launch, t1: Number, tolerance: Number = 1e-9, solver: diffrax.AbstractERK | None = None
) -> Float[Array, ""] | float:
    """Time at which the spin about the arena's normal first vanishes; works under `jit`, `vmap`, `grad`, `jvp` and their
    compositions.

    Derivatives with respect to every number of the body, its inertia, the friction law and the launch use the implicit
    function theorem at the event; they are 0 if the result is infinite.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`, every number a scalar; the body is an `Ellipsoid` or a `RigidBody`, and the spin is
      not zero.
    - `t1`: horizon [s], positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if the spin has not reversed by `t1`, or the contact was lost before; NaN if the
    integration failed, or if numbers inside a transformation are out of range.

    **Raises:** `ValueError` for arguments outside these ranges, for another body, and for a run that needs more than 2 000 000
    steps.

    **Example:** the rattleback of `Ellipsoid`.

    ```
    >>> import tippe
    >>> inertia = [[2e-4, -2e-5, 0.0], [-2e-5, 1.6e-3, 0.0], [0.0, 0.0, 1.7e-3]]
    >>> body = tippe.Ellipsoid(1.0, (0.2, 0.03, 0.02), (0.0, 0.0, -0.01), inertia)
    >>> scene = tippe.Scene(body, friction=tippe.NoSlip())
    >>> print(f"{tippe.reversal_time(scene, tippe.Launch(0.02, spin=-5.0), t1=5.0, tolerance=1e-6):.2f} s")
    2.61 s

    ```
    """
    check_run(scene, launch, t1, tolerance, "reversal_table takes lists, and jax.vmap maps over them")
    check_reversible(scene, launch)
    return first_or_last_time(TopModel.timed(scene, launch, None), t1, "first", settings_for_lanes(tolerance, solver))


def first_or_last_time(model: TopModel, t1: Number, crossing: str, settings: Settings) -> Float[Array, ""] | float:
    """The time of the event of a launch. **Arguments:** as for `inversion_time`, checked.

    **Raises:** `ValueError` for a run that needed too many steps. A warning states any other failure.
    """
    time = time_of_event(model, t1, settings, crossing == "last")
    if is_traced((model, t1, time, settings)) or not np.isnan(time):
        return time
    # Repeat the run to find the cause.
    t1, form = float(t1), REVERSALS if model.reverses else INVERSIONS
    cell = {name: values[0] for name, values in TableJob(model, form, t1, crossing, settings)({}, 1).items()}
    word = Status(cell["status"]).word
    if word == "failed" and cell["steps"] >= settings.max_steps:
        raise ValueError(too_many_steps(t1, settings.max_steps, cell["end_time"]))
    reason = f": {why_unresolved(model.smooth)}" if word == "unresolved" else ""
    end = f"at {cell['end_time']:.6g} s, at {cell['end_theta']:.6g} rad"
    warn(f"the {form.event} time is NaN: the run ended as {word!r} {end}{reason}")
    return time


@of_launches
@status_line("simulating")
def lyapunov_exponent(
    scene: Scene, launch: Launch, t1: float, tolerance: float = 1e-9, solver: diffrax.AbstractERK | None = None
) -> LyapunovExponent:
    """The largest Lyapunov exponent of one launch or of many at once, by the variational equation.

    The exponent is positive if nearby launches diverge exponentially. While a top rises, the exponent is the rate of
    the rise; in chaotic motion, the exponent stays positive as `t1` grows. Source: Benettin et al., Meccanica 15 (1980)
    9; see `nonholonomic/derivatives/variation.py`. Tangents pass
    through flights, impacts, stick and slip by the saltation matrix.

    **Arguments:**

    - `scene`, `launch`: each number is a scalar or an array with one number per launch, (n,).
    - `t1`: time [s] to follow the motion, positive.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** a `LyapunovExponent`, its arrays of shape () or (n,): the mean rate of divergence in the second half of each
    run, and its error.

    **Raises:** `ValueError` for arguments outside these ranges.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> exponents = tippe.lyapunov_exponent(scene, tippe.Launch(1e-3, [155.0, 120.0]), t1=4.0, tolerance=1e-6)
    >>> print(exponents.exponent.round(1))  # 1/s, while the top rises
    [1.2 1.2]

    ```
    """
    require_kind(scene, "scene", Scene)
    require_kind(launch, "launch", Launch)
    require_outside((scene, launch, t1, tolerance), "lyapunov_exponent", "lists in the launch in place of vmap")
    check_horizon(t1, tolerance)
    settings = settings_for_lanes(tolerance, solver)
    shapes = {np.shape(leaf) for leaf in jax.tree.leaves((scene, launch))} - {()}
    if len(shapes) > 1 or any(len(shape) > 1 for shape in shapes):
        raise ValueError(f"scene and launch must hold scalars or one number per launch, not arrays of shapes {shapes}")
    model = TopModel(scene=scene, launch=launch).without_event()
    return exponent_of_model(model, float(t1), settings, shapes.pop() if shapes else ())


# Inversion time extended smoothly past the horizon, for use in a loss function.

#: The least angle [rad] distinguished from 0 in the penalty for a top that does not invert.
LEAST_ANGLE = 1e-6


@of_launches
@status_line("simulating")
def extended_inversion_time(
    scene: Scene, launch: Launch, t1: Number, angle: Number = 0.95 * math.pi, tolerance: Number = 1e-8
) -> Float[Array, ""]:
    """Inversion time, continued beyond the horizon, for loss functions: the result is finite everywhere, and its slope
    leads back to inversion.

    If a top has not inverted, and is at theta at `t1` or when it loses contact, the result is
    t1 (1 + log(angle / theta) / C) with C = log(angle / theta at the launch), at least 1. This is a penalty, not a
    prediction. Where theta grows as exp(s t), as it does from small angles, the penalty is linear in the rate s. It then
    continues the time C / s with the same value and slope at `t1`.

    The function works under `jit`, `vmap`, `grad`, `jvp` and their compositions. The derivatives of the time (implicit
    function theorem) and of the penalty are with respect to every number except `t1` and `tolerance`. Second derivatives are
    NaN where the contact was lost.

    **Arguments:**

    - `scene`, `launch`, `t1`, `angle`: as for `inversion_time`; all numbers must be scalars.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].

    **Returns:** the time [s]; NaN where the integration failed or numbers inside a transformation are out of range.

    **Raises:** `ValueError` for arguments out of range, and for a scene with `contact="hybrid"` or `SetValuedCoulomb`.

    **Example:** this top does not invert by 3 s, so the result is a later time.

    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=3.0e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> print(3.0 < tippe.extended_inversion_time(scene, tippe.Launch(0.2, 60.0), t1=3.0) < 10.0)
    True
    """
    check_run(scene, launch, t1, tolerance)
    check_event(angle, "first")
    check_smooth(scene, "extended_inversion_time")
    # A fit may try parameters that are far off.
    settings = Settings(as_number(tolerance), max_steps=MOST_STEPS)
    return differentiable_solve(*ExtendedTime.of(TopModel.timed(scene, launch, as_number(angle)), t1, settings, False))


class ExtendedTime(EventTime):
    """Extended inversion times of cells, until the angle of a smooth model."""

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        # Every run has a time. A select on NaN would make the derivative of a failed run zero.
        return jnp.zeros(jnp.shape(value), bool)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        return self._extended((), self.model(leaves).problem(cells, ()), leaves, cells)[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        def build(floats: tuple[Array, ...], cells: int | None) -> Any:
            return self.model((*floats, *leaves[self.movable :])).problem(cells, ())

        problem, tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)
        times, slopes = in_groups(lambda group: self._extended(group, problem, leaves, cells, nested), tangents)
        return times, gather(slopes)

    def _extended(
        self, tangents: tuple[Any, ...], problem: Any, leaves: tuple[Array, ...], cells: int, nested: bool = False
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        """The extended times of every cell, and their derivatives along tangents (as of `VariationalProblem`)."""
        is_legal, t1, settings = self.permitted(leaves)
        variational = VariationalProblem(problem, tangents, True)
        options = {"one_kernel": not nested, "n_blocks": 1 + len(tangents), "traced": True}
        outcome, _ = solve_ensemble(variational, t1, jnp.asarray(cells), settings, **options)
        state, *variations = variational.parts(outcome.state)
        has_crossed, is_lost, ended = outcome.status == CROSSED, outcome.status == LEFT_DOMAIN, outcome.end_time

        def extended(problem: InversionProblem, state: Float[Array, "components cells"]) -> Float[Array, " cells"]:
            # A cell that starts beyond the angle has reached it at time 0.
            time = jnp.where(ended > 0.0, crossing_time(problem, ended, state), 0.0)
            # Where the contact is lost, the end varies with the time of the loss.
            rates = stop_gradient(problem.field(ended, state))
            margin, rate = jax.jvp(lambda point: problem.margin_or_one(ended, point), (state,), (rates,))
            later = jnp.where(is_lost, (stop_gradient(margin) - margin) / stop_gradient(rate), 0.0)
            at_end = state + later * rates
            end, start = (inclination(parts(states).axis) for states in (at_end, problem.states))
            return jnp.where(has_crossed, time, beyond_horizon(end, start, jnp.arccos(problem.cos_angle), t1))

        is_good = is_legal & (outcome.status != FAILED)
        times = jnp.where(is_good, extended(problem, state), jnp.nan)
        # Second derivatives through a loss of contact would lack the second variation of its time.
        # A factor, because the derivative of a NaN that is selected would be 0.
        factor = jnp.where(is_good & ~(is_lost & nested), 1.0, jnp.nan)
        slopes = [
            factor * eqx.filter_jvp(extended, (problem, state), direction)[1]
            for direction in zip(tangents, variations, strict=True)
        ]
        return times, slopes


def beyond_horizon(end: Lanes, start: Lanes, angle: Float[Array, "..."], t1: Float[Array, "..."]) -> Lanes:
    """The time [s] of a top that has not inverted by `t1`, with theta at the end and at the start of the run [rad]; see
    `extended_inversion_time`."""
    # The numbers of e-folds by which theta must still grow to reach the angle.
    missing, at_start = (jnp.log(angle / least(greatest(theta, LEAST_ANGLE), angle)) for theta in (end, start))
    return t1 * (1.0 + missing / greatest(at_start, 1.0))
