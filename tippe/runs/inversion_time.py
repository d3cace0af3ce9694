"""The time of inversion of one launch, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from nonholonomic.derivatives import AbstractDifferentiableSolve, differentiable_solve, tangents_by
from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Outcome, Settings, explicit_tableau
from nonholonomic.integration.status import FAILED, UNRESOLVED
from nonholonomic.progress import status_line
from nonholonomic.validation import as_number, is_traced, warn

from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.inversion_problem import InversionProblem, StemContact
from .cells import InversionRuns, too_many_steps
from .checks import (
    check_event,
    check_last_on_stem,
    check_run,
    nan_if_illegal,
    permitted,
    warn_if_it_cannot_invert,
)
from .inversion import Inversions, carried_by_stem, checked, is_inverted, traced
from .run_kind import check_differentiable, run_kind_of, why_unresolved
from .turned_over import event_of


@status_line("simulating")
def inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[ArrayLike, ""] | None = None,
    tolerance: float = 1e-9,
    crossing: str = "first",
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time at which the top has turned over; works under `jit`, `vmap`, `grad`, `jvp` and their compositions.

    The derivative comes from the implicit function theorem at the event; it is 0 if the result is infinite. Together
    with derivatives, a time costs two to three times as much for one parameter, four times for two, and six to eight
    times for more (`nonholonomic/derivatives/slopes.py`). Second derivatives use forward mode.

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
    second derivatives through changes of mode, for derivatives with both `contact="hybrid"` and `SetValuedCoulomb`,
    because an impact may stop a slip, and for derivatives of the last contact of a stem.

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
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    warn_if_it_cannot_invert(scene, launch, launch.theta, angle)
    return first_or_last_time(scene, launch, t1, event_of(scene, angle), crossing, settings)


def first_or_last_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[Array, ""] | StemContact | None,
    crossing: str,
    settings: Settings,
) -> Float[Array, ""]:
    """The time at which theta reaches an angle, or at which the stem carries the top, or, without an angle, at which the
    spin about the normal reverses.

    **Arguments:** as for `inversion_time`, checked.
    """
    leaves, structure = jax.tree.flatten((scene, launch, angle, as_number(t1), settings.tolerance))
    unchecked = any(is_traced(leaf) for leaf in leaves)
    # The last two leaves, horizon and tolerance, do not affect the event.
    solve = InversionSolve(len(leaves) - 2, structure, settings.with_tolerance(None), crossing == "last", unchecked)
    time = differentiable_solve(solve, *leaves)
    if not is_traced(time) and not unchecked and np.isnan(time):
        concrete_angle = angle if angle is None or isinstance(angle, StemContact) else np.asarray(angle).item()
        explain_failure(scene, launch, float(t1), concrete_angle, crossing, settings)
    return nan_if_illegal(time, structure, unchecked, leaves)


def explain_failure(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: float | StemContact | None,
    crossing: str,
    settings: Settings,
) -> None:
    """Raise `ValueError` for a run that needed too many steps; warn of any other failure. This repeats the run to find
    the cause.

    **Arguments:** as for `inversion_time`.
    """
    max_steps = settings.max_steps
    runs = InversionRuns(run_kind_of(scene), t1, angle, crossing, settings, "ensemble", [])
    cell = {name: values[0] for name, values in runs.results({"scene": scene, "launch": launch}, {}, 1).items()}
    word = runs.run_kind.words[cell["status"]]
    if word == "failed" and cell["steps"] >= max_steps:
        raise ValueError(too_many_steps(t1, max_steps, cell["end_time"]))
    event = "reversal" if angle is None else "inversion"
    reason = f": {why_unresolved(runs.run_kind)}" if word == "unresolved" else ""
    end = f"at {cell['end_time']:.6g} s, at {cell['end_theta']:.6g} rad"
    warn(f"the {event} time is NaN: the run ended as {word!r} {end}{reason}")


class InversionSolve(AbstractDifferentiableSolve):
    """Inversion times of cells; the leaves are those of scene and launch, the angle if any, the horizon, the tolerance."""

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    # Without the tolerance.
    settings: Settings
    last: bool = eqx.field(static=True)
    # Whether some numbers were traced and therefore could not be checked.
    unchecked: bool = eqx.field(static=True)

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        is_legal, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        inversions = self._inversions((*leaves[: self.movable], tolerance), cells)
        outcome = inversions.solve(t1, cells, self.settings.with_tolerance(tolerance), traced())
        return self._times(leaves, is_legal, tolerance, inversions, outcome, [])[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        is_legal, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        # Cells are independent, so varying a parameter in all of them at once gives each its own derivative.
        moving = (*leaves[: self.movable], tolerance)
        inversions, tangents, gather = tangents_by(self._inversions, active, moving, cells)
        check_differentiable(self._modules(leaves)[0])
        check_last_on_stem(self._modules(leaves)[2], self.last)
        if nested and not inversions.kind.smooth:
            raise ValueError(
                "second derivatives are not available through changes of mode: contact = 'hybrid', SetValuedCoulomb"
            )
        settings, solvers = self.settings.with_tolerance(tolerance), traced(one_kernel=not nested)
        outcome, slopes, _ = inversions.solve_with_tangents(tangents, t1, cells, settings, solvers)
        return self._times(leaves, is_legal, tolerance, inversions, outcome, gather([*slopes]))

    def _modules(self, leaves: Sequence[Array]) -> Any:
        """Scene, launch, angle, horizon and tolerance; `None` for omitted leaves at the end."""
        no_tangents = (None,) * (self.structure.num_leaves - len(leaves))
        return jax.tree.unflatten(self.structure, (*leaves, *no_tangents))

    def _inversions(self, leaves: tuple[Array, ...], cells: int | None) -> Inversions:
        """The launches of some cells, from the leaves that move the event, and the tolerance."""
        *numbers, tolerance = leaves
        scene, launch, angle, *_ = self._modules(numbers)
        assert cells is not None
        return Inversions.of(scene, InversionProblem.of(scene, launch, angle, cells), tolerance, self.last)

    def _times(
        self,
        leaves: Sequence[Array],
        is_legal: Bool[Array, "..."],
        tolerance: Float[Array, ""],
        inversions: Inversions,
        outcome: Outcome | HybridOutcome,
        slopes: list[Float[Array, " cells"]],
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        """The times of inversion and their derivatives: infinite and 0 where there is none, NaN where the run failed."""
        scene, carried = self._modules(leaves)[0], carried_by_stem(inversions.kind, inversions.problem, outcome)
        outcome = checked(scene, inversions.problem, outcome, tolerance)
        inverted = is_inverted(outcome, inversions.problem, self.last, carried)
        is_good = is_legal & (outcome.status != FAILED) & (outcome.status != UNRESOLVED)
        time = jnp.where(is_good, jnp.where(inverted, outcome.crossing_time, jnp.inf), jnp.nan)
        return time, [jnp.where(is_good, jnp.where(inverted, slope, 0.0), jnp.nan) for slope in slopes]
