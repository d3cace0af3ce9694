"""The time of inversion of one launch, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

import math
import warnings
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from nonholonomic.derivatives import (
    AbstractDifferentiableSolve,
    differentiable_solve,
    in_groups,
    tangents_by,
    traced_solve_ensemble_with_tangents,
)
from nonholonomic.hybrid import (
    AbstractBatchedMode,
    HybridOutcome,
    traced_solve_hybrid,
    traced_solve_hybrid_with_tangents,
)
from nonholonomic.integration import (
    CROSSED,
    FAILED,
    REACHED_END,
    UNRESOLVED,
    Settings,
    explicit_tableau,
    traced_solve_ensemble,
)
from nonholonomic.progress import status_line
from nonholonomic.validation import as_number, is_traced

from ..model.launch import Launch
from ..model.scene import Scene
from ..modes.airborne import on_the_ground
from ..modes.inversion_problem import InversionProblem
from .cells import InversionRuns, check_differentiable, run_kind_of, too_many_steps
from .inversion import check_event, check_run, is_inverted, nan_if_illegal, permitted, warn_if_it_cannot_invert


@status_line("simulating")
def inversion_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[ArrayLike, ""] = 0.95 * math.pi,
    tolerance: float = 1e-9,
    crossing: str = "first",
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time at which theta reaches an angle; works under `jit`, `vmap`, `grad`, `jvp` and their compositions.

    The derivative is that of the event's time by the implicit function theorem; it is 0 where the result is infinite.
    The time and its derivative by one parameter cost about three times the time alone, by two parameters five times, by
    three or four seven to ten times, and by any number more eight to thirteen times (`nonholonomic/derivatives/slopes.py`);
    second derivatives take forward-mode passes.

    **Arguments:**

    - `scene`, `launch`: as for `simulate`, every number a scalar.
    - `t1`: horizon [s], positive.
    - `angle`: angle [rad] to be reached, in (0, pi].
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2].
    - `crossing`: "first" for the first time theta reaches the angle, "last" for the up-crossing after which theta stays
      above it until `t1`.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default
      `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if the top has not inverted by `t1`, or has lost contact or jammed before; NaN
    if the integration failed, or if numbers inside a transformation are out of range.

    With `contact="hybrid"` and `SetValuedCoulomb` first derivatives go through flights, impacts, stick and slip
    (`nonholonomic/hybrid/saltation.py`). Where an event on the way is grazing, so that within the tolerance it may
    not happen at all, the derivative is NaN; `inversion_table` says so in the variable `grazes`.

    **Raises:** `ValueError` for arguments outside these ranges, for a run that needs more than 2 000 000 steps, for second
    derivatives through changes of mode, and for derivatives with both, whose impacts may stop a slip.

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
    method = Settings(tolerance, solver).for_lanes
    explicit_tableau(method)
    warn_if_it_cannot_invert(scene, launch, launch.theta)
    return first_or_last_time(scene, launch, t1, as_number(angle), tolerance, crossing, method)


def first_or_last_time(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: Float[Array, ""] | None,
    tolerance: float,
    crossing: str,
    method: diffrax.AbstractSolver,
) -> Float[Array, ""]:
    """The time of a launch's event: that theta reaches an angle, or, without one, that the spin about the normal reverses.

    **Arguments:** as for `inversion_time`, checked.
    """
    leaves, structure = jax.tree.flatten((scene, launch, angle, as_number(t1), as_number(tolerance)))
    unchecked = any(is_traced(leaf) for leaf in leaves)
    question = InversionSolve if run_kind_of(scene).smooth else HybridInversionSolve
    # The last two leaves, horizon and tolerance, do not move the event.
    found = differentiable_solve(question(len(leaves) - 2, structure, method, crossing == "last", unchecked), *leaves)
    if not is_traced(found) and not unchecked and np.isnan(found):
        known = None if angle is None else np.asarray(angle).item()
        explain_failure(scene, launch, float(t1), known, float(tolerance), crossing, method)
    return nan_if_illegal(found, structure, unchecked, leaves)


def explain_failure(
    scene: Scene,
    launch: Launch,
    t1: float,
    angle: float | None,
    tolerance: float,
    crossing: str,
    solver: diffrax.AbstractSolver,
) -> None:
    """Raise `ValueError` for a run that needed too many steps; warn of any other failure. The run is repeated to find
    out.

    **Arguments:** as for `inversion_time`.
    """
    most = Settings(tolerance, solver).max_steps
    runs = InversionRuns(run_kind_of(scene), t1, angle, crossing, solver, "ensemble", [], most)
    cell = {
        name: values[0] for name, values in runs.results({"scene": scene, "launch": launch}, {}, tolerance, 1).items()
    }
    word = runs.run_kind.words[cell["status"]]
    if word == "failed" and cell["steps"] >= most:
        raise ValueError(too_many_steps(t1, most, cell["end_time"]))
    event = "reversal" if angle is None else "inversion"
    warnings.warn(
        f"the {event} time is NaN: the run ended as {word!r} at {cell['end_time']:.6g} s, at {cell['end_theta']:.6g} rad",
        UserWarning,
        stacklevel=4,
    )


class InversionSolve(AbstractDifferentiableSolve):
    """Inversion times of cells; the leaves are those of scene and launch, the angle if any, the horizon, the tolerance."""

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    solver: diffrax.AbstractSolver
    last: bool = eqx.field(static=True)
    # Whether some numbers were traced, so that they could not be checked.
    unchecked: bool = eqx.field(static=True)

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def problem(self, leaves: tuple[Array, ...], cells: int | None) -> InversionProblem:
        """The launches of some cells."""
        # The leaves that do not move the event are not needed here.
        unused = (None,) * (self.structure.num_leaves - len(leaves))
        scene, launch, angle, *_ = jax.tree.unflatten(self.structure, (*leaves, *unused))
        assert cells is not None
        return InversionProblem.of(scene, launch, angle, cells)

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        problem = self.problem(leaves[: self.movable], cells)
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        outcome, _ = traced_solve_ensemble(
            problem,
            t1,
            jnp.asarray(cells),
            Settings(tolerance, self.solver),
            nonterminal=self.last,
            one_kernel=True,
        )
        time = jnp.where(is_inverted(outcome, problem, self.last), outcome.crossing_time, jnp.inf)
        return jnp.where(may & (outcome.status != FAILED), time, jnp.nan)

    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        # Cells are independent, so varying a parameter in all of them at once gives each its own derivative.
        problem, tangents, gather = tangents_by(self.problem, active, leaves[: self.movable], cells)
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        outcome, slopes = traced_solve_ensemble_with_tangents(
            problem,
            tangents,
            t1,
            jnp.asarray(cells),
            Settings(tolerance, self.solver),
            nonterminal=self.last,
            one_kernel=not again,
        )
        inverted, good = is_inverted(outcome, problem, self.last), may & (outcome.status != FAILED)
        time = jnp.where(good, jnp.where(inverted, outcome.crossing_time, jnp.inf), jnp.nan)
        return time, [jnp.where(good, jnp.where(inverted, slope, 0.0), jnp.nan) for slope in gather(slopes)]


class HybridInversionSolve(InversionSolve):
    """Inversion times of cells with hybrid runs; the leaves are those of `InversionSolve`."""

    def answer(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        modes, first, problem, scene = self.hybrid((*leaves[: self.movable], tolerance), cells)
        return self.named(may, self.hybrid_outcome(modes, first, problem, scene, t1, tolerance), problem, scene)

    def with_slopes(
        self, active: tuple[int, ...], again: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        if again:
            raise ValueError(
                "second derivatives do not go through changes of phase: contact = 'hybrid', SetValuedCoulomb"
            )
        may, t1, tolerance = permitted(self.structure, self.unchecked, leaves)
        built = tangents_by(self.hybrid, active, (*leaves[: self.movable], tolerance), cells)
        (modes, first, problem, scene), tangents, gather = built
        check_differentiable(scene)
        if self.last:
            # The derivatives need the run only up to the event, whose time is then known.
            whole = self.hybrid_outcome(modes, first, problem, scene, t1, tolerance)
            t1 = jnp.where(jnp.isfinite(whole.crossing_time), whole.crossing_time, 0.0)
        settings = Settings(tolerance, self.solver)

        def run(some: tuple[Any, ...]) -> tuple[tuple[HybridOutcome, Array], list[Float[Array, " cells"]]]:
            moved = tuple((one[0], one[2].states) for one in some)
            given = (modes, moved, first, problem.states, t1, settings)
            counters = len(run_kind_of(scene).counts)
            hybrid_outcome, found = traced_solve_hybrid_with_tangents(
                *given, counters=counters, ends_on_event=not self.last
            )
            return (hybrid_outcome, found.grazing), list(found.slopes)

        (hybrid_outcome, grazing), slopes = in_groups(run, tangents)
        time = self.named(may, whole if self.last else hybrid_outcome, problem, scene)
        ended = hybrid_outcome.status == (REACHED_END if self.last else CROSSED)
        digits = ended & ~grazing
        # An event at the start has a fixed time, whatever the tangent.
        happened = jnp.isfinite(time) & (time > 0.0)
        return time, [jnp.where(happened, jnp.where(digits, slope, jnp.nan), 0.0 * time) for slope in gather(slopes)]

    def hybrid(self, leaves: tuple[Array, ...], cells: int | None) -> Any:
        """The modes of some cells, the number of each one's first, problem and scene; the last leaf is the tolerance."""
        *own, tolerance = leaves
        scene, *_ = jax.tree.unflatten(self.structure, (*own, *(None,) * (self.structure.num_leaves - len(own))))
        problem, modes_of = self.problem(tuple(own), cells), run_kind_of(scene).modes
        assert modes_of is not None
        return (*modes_of(scene, problem, tolerance, self.last), problem, scene)

    def hybrid_outcome(
        self,
        modes: tuple[AbstractBatchedMode, ...],
        first: Int[Array, " cells"],
        problem: InversionProblem,
        scene: Scene,
        t1: Float[Array, "..."],
        tolerance: Float[Array, ""],
    ) -> HybridOutcome:
        """The hybrid runs of cells."""
        settings, counters = Settings(tolerance, self.solver), len(run_kind_of(scene).counts)
        return traced_solve_hybrid(modes, first, problem.states, t1, settings, counters=counters, nonterminal=self.last)

    def named(
        self, may: Bool[Array, "..."], ended: HybridOutcome, problem: InversionProblem, scene: Scene
    ) -> Float[Array, " cells"]:
        """The times of inversion."""
        if run_kind_of(scene).flight_state:
            ended = ended._replace(state=on_the_ground(scene, ended.state, ended.mode))
        time = jnp.where(is_inverted(ended, problem, self.last), ended.crossing_time, jnp.inf)
        failed = (ended.status == FAILED) | (ended.status == UNRESOLVED)
        return jnp.where(may & ~failed, time, jnp.nan)
