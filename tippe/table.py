"""Tables of inversion times over the grid of launches and friction."""

import math
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.ensemble import compiled_march, lanes_for, single_kernel_march
from nonholonomic.lockstep import FAILED, GUARD_LOST
from nonholonomic.paths import description, with_numbers
from nonholonomic.reference import march_by_diffrax
from nonholonomic.runge_kutta import explicit_tableau
from nonholonomic.surface import Cylinder, Plane, Sphere
from nonholonomic.sweep import Axis, Variable, axis, sweep
from nonholonomic.table import Table

from .friction import Coulomb, Viscous
from .hybrid.cells import hybrid_cells
from .inversion import ABSOLUTE, InversionProblem, check_event, check_run, is_inverted
from .launch import Launch
from .scene import Scene
from .stick_slip.cells import stick_slip_cells

#: Arenas, laws and solvers whose loops XLA is known to compile into one kernel; a test goes through them all.
SINGLE_KERNEL = (Plane, Cylinder, Sphere, Viscous, Coulomb, diffrax.Dopri8, diffrax.Dopri5, diffrax.Tsit5)

#: Cells that are checked together, to bound the memory it takes.
CHECKED_AT_ONCE = 1 << 20

WORDS = ("inverted", "not_inverted", "contact_lost", "failed")
HYBRID_WORDS = (*WORDS, "unresolved", "both_contacts")

VARIABLES = {
    "time": Variable("s", np.float64),
    "status": Variable("1", np.int8, WORDS),
    "end_time": Variable("s", np.float64),
    "end_theta": Variable("rad", np.float64),
    "steps": Variable("1", np.int64),
    "rejected": Variable("1", np.int64),
}
HYBRID_VARIABLES = VARIABLES | {"status": Variable("1", np.int8, HYBRID_WORDS), "hops": Variable("1", np.int64)}

STICK_SLIP_WORDS = (*WORDS, "unresolved")
STICK_SLIP_VARIABLES = VARIABLES | {
    "status": Variable("1", np.int8, STICK_SLIP_WORDS),
    "sticks": Variable("1", np.int64),
}

UNITS = {"mass": "kg", "radius": "m", "offset": "m", "I1": "kg m2", "I3": "kg m2", "gravity": "m s-2"}
UNITS |= {"theta": "rad", "eta": "rad", "azimuth": "rad", "spin": "rad s-1"}


def inversion_table(
    scene: Scene,
    *,
    theta: Any,
    spin: Any,
    eta: Any = 0.0,
    mu: Any = None,
    t1: float,
    angle: float = 0.95 * math.pi,
    tolerance: float = 1e-9,
    crossing: str = "first",
    path: Any = None,
    azimuth: Any = 0.0,
    axes: dict[str, Any] | None = None,
    solver: diffrax.AbstractERK | None = None,
    method: str = "ensemble",
) -> Table:
    """Inversion times over a grid of launches and scenes, in one batched call on all cores.

    **Arguments:**

    - `scene`: the scene, every number a scalar.
    - `theta`, `spin`, `eta`, `azimuth`: of the launch, as for `Launch`; `mu`: of the scene's friction, its own by default.
      A list or array becomes an axis of the table, in the order (theta, eta, mu, spin, azimuth); a number does not.
    - `t1`: horizon [s].
    - `angle`: angle [rad] that counts as inverted.
    - `tolerance`: relative tolerance of the integration.
    - `crossing`: "first" for the first time theta reaches the angle; "last" for the up-crossing after which theta stays
      above it until `t1` (first crossings are ill-conditioned where theta oscillates about the angle).
    - `path`: HDF5 file to write, block by block. A run that was interrupted resumes from it.
    - `axes`: further axes, path of a number -> values, such as `{"scene.body.offset": [0.005, 0.006]}`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, `Dopri8()` by default.
    - `method`: "ensemble" for the fast driver; "diffrax" for vmapped `diffeqsolve`, the slow reference, which knows first
      crossings only.

    **Returns:** a `Table` with `time` [s] (infinite if not inverted), `status` ("inverted", "not_inverted" by `t1`,
    "contact_lost", "failed"), `end_time` [s] and `end_theta` [rad] at which the run ended (where contact was lost, when
    and at what angle), `steps` and `rejected`. A scene with `contact="hybrid"` flies on where contact is lost, and the angle
    counts in flight too; `hops` is the number of flights, and `status` may be "unresolved" (too many of them) or
    "both_contacts" (sphere and stem stayed on the plane together, which is not modelled). With `SetValuedCoulomb`, `sticks`
    is how often a slip has turned into rolling, and `status` may be "unresolved" (too many changes).

    **Raises:** `ValueError` for arguments out of range or an unknown axis; `OSError` for a path that cannot be used.
    """
    solver = diffrax.Dopri8() if solver is None else solver
    check_event(angle, crossing)
    explicit_tableau(solver)
    if method not in ("ensemble", "diffrax"):
        raise ValueError(f"method = {method!r} must be 'ensemble' or 'diffrax'")
    if method == "diffrax" and crossing != "first":
        raise ValueError(f"crossing = {crossing!r} must be 'first' for method = 'diffrax'")
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    hybrid = scene.contact == "hybrid"
    if method == "diffrax" and hybrid:
        raise ValueError("method = 'diffrax' must be 'ensemble' for a scene with contact = 'hybrid'")
    sticking = scene.friction.set_valued
    if method == "diffrax" and sticking:
        raise ValueError(f"method = 'diffrax' must be 'ensemble' with {type(scene.friction).__name__}")
    if axes is not None and not isinstance(axes, dict):
        raise ValueError(f"axes = {axes!r} must be a dictionary, path of a number -> values")
    given = {"launch.theta": theta, "launch.eta": eta, "scene.friction.mu": mu, "launch.spin": spin}
    given |= {"launch.azimuth": azimuth}
    if mu is None:
        del given["scene.friction.mu"]
    for number in given:
        if number in (axes or {}):
            raise ValueError(f"axes: {number!r} is an argument of its own")
    given |= axes or {}
    fixed = {number: value for number, value in given.items() if np.ndim(value) == 0}
    names = [number.rsplit(".", 1)[-1] for number in given]
    units = UNITS | scene.friction.units
    grid = []
    for number, name in zip(given, names, strict=True):
        if number not in fixed:
            unit = units.get(name, "1")
            grid.append(axis(name if names.count(name) == 1 else number, number, unit, given[number]))
    roots = with_numbers({"scene": scene, "launch": Launch(theta=0.0, spin=0.0)}, fixed)
    check_run(roots["scene"], roots["launch"], t1, tolerance)
    _check_cells(roots, grid)
    last = crossing == "last"
    tried = all(type(part) in SINGLE_KERNEL for part in (scene.surface, scene.friction, solver))
    march = single_kernel_march if tried else compiled_march

    def run(columns: dict[str, Any], count: int) -> dict[str, Any]:
        if method == "diffrax" and count == 0:
            # The reference runs whole blocks: a call that is there to compile would compute the first one twice.
            return {}
        cells = with_numbers(roots, columns)
        size = next((len(values) for values in columns.values()), 1)
        if hybrid:
            return hybrid_cells(cells["scene"], cells["launch"], t1, angle, tolerance, last, solver, size, count)
        if sticking:
            return stick_slip_cells(cells["scene"], cells["launch"], t1, angle, tolerance, last, solver, size, count)
        problem = InversionProblem.of(cells["scene"], cells["launch"], angle, size)
        horizon, rtol = jnp.asarray(t1, float), jnp.asarray(tolerance, float)
        if method == "diffrax":
            outcome = march_by_diffrax(problem, horizon, rtol, ABSOLUTE * rtol, solver=solver)
        else:
            outcome, _ = march(
                problem,
                horizon,
                jnp.asarray(count),
                rtol,
                ABSOLUTE * rtol,
                solver=solver,
                lanes=lanes_for(size),
                passes=last,
            )
        inverted = is_inverted(outcome, problem, last)
        return {
            "time": np.where(inverted, outcome.crossing_time, np.inf),
            "status": np.select(
                [inverted, outcome.status == GUARD_LOST, outcome.status == FAILED], [0, 2, 3], 1
            ).astype(np.int8),
            "end_time": np.asarray(outcome.end_time),
            "end_theta": np.asarray(jax.vmap(scene.theta, 1)(outcome.state)),
            "steps": np.asarray(outcome.steps),
            "rejected": np.asarray(outcome.rejected),
        }

    request = description("scene", roots["scene"]) | description("launch", roots["launch"])
    request |= {"t1": float(t1), "angle": float(angle), "tolerance": float(tolerance), "crossing": crossing}
    request |= {"solver": type(solver).__name__, "method": method}
    request |= {one.path: "an axis" for one in grid}
    if not hybrid:
        # As in files from before there was a choice.
        del request["scene.contact"]
    variables = HYBRID_VARIABLES if hybrid else STICK_SLIP_VARIABLES if sticking else VARIABLES
    return sweep(run, grid, variables, request, path=path)


def _check_cells(roots: dict[str, Any], grid: list[Axis]) -> None:
    """Have the modules check every cell, before anything compiles: numbers may be impossible only together."""
    shape = tuple(len(one.values) for one in grid)
    cells = int(np.prod(shape, dtype=int))
    for first in range(0, cells, CHECKED_AT_ONCE):
        places = np.unravel_index(np.arange(first, min(first + CHECKED_AT_ONCE, cells)), shape) if grid else ()
        with_numbers(roots, {one.path: one.values[place] for one, place in zip(grid, places, strict=True)})
