"""The time of an event of a user's system, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from ..derivatives import (
    AbstractDifferentiableSolve,
    differentiable_solve,
    tangents_by,
    traced_solve_ensemble_with_tangents,
)
from ..hybrid import HybridOutcome, traced_solve_hybrid, traced_solve_hybrid_with_tangents
from ..integration import Outcome, Settings, explicit_tableau, traced_solve_ensemble
from ..integration.checks import legal_run
from ..integration.status import CROSSED, FAILED, UNRESOLVED
from ..progress import status_line
from ..validation import as_number
from .engine import Cells
from .mode import Event
from .system import System, check_run, run_of


@status_line("simulating")
def event_time(
    system: System,
    start: Any,
    t1: Float[ArrayLike, ""],
    event: Event | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
) -> Float[Array, ""]:
    """Time of the first event of a run; works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and their compositions.

    The event is the first time after the start at which a function of time and state falls through zero, along the
    motion or by a reset. For a run that starts at or below zero, the event is the next time at which the function falls
    through zero. Under `vmap`, all runs are lanes of one batch.

    Derivatives with respect to the start and every parameter of the system and of the event are exact: they use the
    implicit function theorem at the event and the saltation matrix at every reset (`nonholonomic/hybrid/saltation.py`).
    Derivatives are 0 if the time is infinite. Without resets, there are second derivatives, by `jax.hessian` (forward
    over reverse mode).

    **Arguments:**

    - `system`: a `Hybrid`, or an `AbstractSystem`.
    - `start`: state at time 0, (components,); of an `AbstractSystem`, the coordinates and their rates, (q, rate).
    - `t1`: horizon [s], positive.
    - `event`: a function `event(t, y)` of time [s] and state; by default the system's own. The state of an
      `AbstractSystem` is that of `Trajectory.state`: the coordinates, followed by their rates.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2]. The absolute tolerance is a tenth of it, in
      units of the largest component of the start if that is below 1.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default `nonholonomic.integration.Oscillatory8()`.

    **Returns:** the time [s]; infinite if there is no event by `t1` or if the run ends before the event; NaN if the
    integration failed, if resets follow one another without end, or if numbers inside a transformation are out of
    range. If the margin of a mode only touches zero, so that the mode may or may not end within the tolerance,
    derivatives are NaN.

    **Raises:** `ValueError` for arguments out of range, functions that return a wrong type or shape, and second
    derivatives through resets.

    **Example:** the fifth bounce of a ball.

    ```
    >>> import jax
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Ball(nonholonomic.AbstractMode):
    ...     restitution: float
    ...
    ...     def field(self, t, y):
    ...         return jnp.array([y[1], -9.81, 0.0])
    ...
    ...     def margin(self, t, y):
    ...         return y[0]
    ...
    ...     def reset(self, t, y):
    ...         return jnp.array([0.0, -self.restitution * y[1], y[2] + 1.0]), 0
    >>> def fifth(restitution):
    ...     ball = nonholonomic.Hybrid([Ball(restitution)])
    ...     start = jnp.array([1.0, 0.0, 0.0])
    ...     return nonholonomic.event_time(ball, start, t1=9.0, event=lambda t, y: 4.5 - y[2])
    >>> time, slope = jax.value_and_grad(fifth)(0.8)
    >>> print(f"{time:.6f} s, {slope:.6f} s")
    2.584160 s, 5.931215 s

    ```
    """
    check_run(system, start, t1, tolerance)
    run = run_of(system, start, event)
    if not run.cells.form.has_event:
        raise ValueError("event = None: the system has no event of its own; pass event=, a function of time and state")
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    return _time(run.cells, as_number(t1), settings)


# Compile the whole, so that further calls with the same functions need no tracing.
@eqx.filter_jit
def _time(cells: Cells, t1: Float[Array, ""], settings: Settings) -> Float[Array, ""]:
    numbers, structure = jax.tree.flatten(cells)
    floats = [number for number in numbers if eqx.is_inexact_array(number)]
    static = [number for number in numbers if not eqx.is_inexact_array(number)]
    places = tuple(eqx.is_inexact_array(number) for number in numbers)
    solve = SmoothEvent if cells.form.traits.smooth else HybridEvent
    event = solve(len(floats), structure, places, settings.with_tolerance(None))
    return differentiable_solve(event, *floats, *static, t1, settings.tolerance)


class SmoothEvent(AbstractDifferentiableSolve):
    """Event times of cells with smooth runs.

    The leaves are the numbers of `Cells`, floats first, the horizon and the tolerance. `structure`: structure of the
    `Cells`; `places`: positions of the leaves that are floats; `settings`: without the tolerance.
    """

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    places: tuple[bool, ...] = eqx.field(static=True)
    settings: Settings

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def of_leaves(self, leaves: tuple[Array, ...]) -> Cells:
        """The cells."""
        floats, static = iter(leaves[: self.movable]), iter(leaves[self.movable :])
        return jax.tree.unflatten(self.structure, [next(floats if is_float else static) for is_float in self.places])

    def permitted(self, leaves: tuple[Array, ...]) -> tuple[Bool[Array, "..."], Float[Array, "..."], Settings]:
        """A mask of the cells with a legal horizon, tolerance and start; the horizons, 0 for all other cells; and the
        settings.

        A batch has one tolerance: the smallest.
        """
        *_, t1, tolerance = leaves
        finite = jnp.isfinite(jnp.asarray(sum(self.of_leaves(leaves).start)))
        is_legal, t1, tolerance = legal_run(finite, t1, tolerance)
        return is_legal, t1, self.settings.with_tolerance(jnp.min(tolerance))

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        is_legal, t1, settings = self.permitted(leaves)
        problem = self.of_leaves(leaves).problem(cells)
        outcome, _ = traced_solve_ensemble(problem, t1, jnp.asarray(cells), settings, one_kernel=True)
        return _named(is_legal, outcome)

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        def build(floats: tuple[Array, ...], cells: int | None) -> Any:
            return self.of_leaves((*floats, *leaves[self.movable :])).problem(cells)

        is_legal, t1, settings = self.permitted(leaves)
        problem, tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)
        outcome, slopes = traced_solve_ensemble_with_tangents(
            problem, tangents, t1, jnp.asarray(cells), settings, one_kernel=not nested
        )
        time = _named(is_legal, outcome)
        return time, [jnp.where(jnp.isinf(time), 0.0, slope + 0.0 * time) for slope in gather(slopes)]


class HybridEvent(SmoothEvent):
    """Event times of cells whose runs have resets."""

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        is_legal, t1, settings = self.permitted(leaves)
        modes, first, states = self.of_leaves(leaves).modes(cells)
        return _named(is_legal, traced_solve_hybrid(modes, first, states, t1, cells, settings, counters=1))

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        if nested:
            raise ValueError(
                "second derivatives are not available through resets; take differences of a gradient instead"
            )

        def build(floats: tuple[Array, ...], cells: int | None) -> Any:
            assert cells is not None
            return self.of_leaves((*floats, *leaves[self.movable :])).modes(cells)

        is_legal, t1, settings = self.permitted(leaves)
        (modes, first, states), tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)

        hybrid_tangents = tuple((tangent[0], tangent[2]) for tangent in tangents)
        outcome, sensitivities = traced_solve_hybrid_with_tangents(
            modes, hybrid_tangents, first, states, t1, cells, settings, counters=1
        )
        time = _named(is_legal, outcome)
        return time, [jnp.where(jnp.isinf(time), 0.0, slope + 0.0 * time) for slope in gather([*sensitivities.slopes])]


def _named(is_legal: Bool[Array, "..."], ended: Outcome | HybridOutcome) -> Float[Array, " cells"]:
    """The event times: infinite if there is no event, NaN if the run could not be finished."""
    time = jnp.where(ended.status == CROSSED, ended.crossing_time, jnp.inf)
    failed = (ended.status == FAILED) | (ended.status == UNRESOLVED)
    return jnp.where(is_legal & ~failed, time, jnp.nan)
