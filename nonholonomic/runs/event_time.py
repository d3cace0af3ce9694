"""The time of an event of any model, as a function for `jit`, `vmap`, `grad`, `jvp` and their compositions."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..derivatives import AbstractDifferentiableSolve, differentiable_solve, tangents_by
from ..hybrid import HybridOutcome
from ..integration import Outcome, Settings, explicit_tableau
from ..integration.checks import legal_run
from ..integration.status import Status
from ..progress import status_line
from ..validation import as_number, is_traced, nan_unless, shown
from ..warning import warn
from .ensemble import SILENT, Ensemble, status_of
from .model import AbstractModel, check_run, model_of, require_event


@status_line("simulating")
def event_time(
    system: Any,
    start: Any,
    t1: Float[ArrayLike, ""],
    event: Callable[..., Any] | None = None,
    tolerance: float = 1e-9,
    solver: diffrax.AbstractERK | None = None,
    *,
    crossing: str = "first",
    input: Any = None,
    jumps: Any = None,
) -> Float[Array, ""]:
    """Time of the event of a run; works under `jit`, `vmap`, `grad`, `jvp`, `jacfwd` and their compositions.

    The event is the first time after the start at which a function falls through zero, along the motion or by a reset.
    For a run that starts at or below zero, the event is the next time at which the function falls through zero. Under
    `vmap`, all runs are lanes of one batch.

    Derivatives with respect to the start and every parameter of the system and of the event are exact: they use the
    implicit function theorem at the event and the saltation matrix at every reset (`nonholonomic/hybrid/saltation.py`).
    Derivatives are 0 if the time is infinite. Without resets, there are second derivatives, by `jax.hessian` (forward
    over reverse mode).

    **Arguments:**

    - `system`, `start`: a `tippe.Scene` or a `stroller.Scene` with its `Launch`; or your own system, a `Hybrid` with
      its state at time 0, (components,), or an `AbstractSystem` with its coordinates and their rates, (q, rate).
    - `t1`: horizon [s], positive.
    - `event`: for a scene a function `event(t, motion)` of time [s] and motion, whose attributes are the quantities of a
      trajectory, such as `motion.theta`, `motion.speed` or `motion.normal_force`; for your own system a function
      `event(t, y)`, where y is the state of a trajectory. By default the event of the system itself: that of the
      `Hybrid`, the inversion of a top, or the loss of contact of a stroller.
    - `tolerance`: relative tolerance of the integration, in [1e-14, 1e-2]. The absolute tolerance is a tenth of it, in
      units of the magnitudes of the system.
    - `solver`: an explicit Runge-Kutta solver of Diffrax, by default `nonholonomic.integration.Oscillatory8()`.
    - `crossing`: "first", or "last" for the last fall through zero after which the function stays below zero until `t1`.
    - `input`: the input of a stroller; `jumps`: times [s] at which the input jumps, as for `stroller.simulate`.

    **Returns:** the time [s]; infinite if there is no event by `t1` or if the run ends before the event; NaN if the
    integration failed or if resets follow one another without end (more than 2000), with a warning that says so, or if
    numbers inside a transformation are out of range. If the margin of a mode only touches zero, so that the mode may or
    may not end within the tolerance, derivatives are NaN.

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
    if crossing not in ("first", "last"):
        raise ValueError(f"crossing = {shown(crossing)} must be 'first' or 'last'")
    model = model_of(system, start, event, input, jumps)
    check_run(model, t1, tolerance)
    require_event(model)
    settings = Settings(tolerance, solver)
    explicit_tableau(settings.for_lanes)
    time = _compiled(model, as_number(t1), settings, crossing == "last", is_traced((model, t1, tolerance)))
    if not is_traced(time) and np.ndim(time) == 0 and np.isnan(time):
        _warn_of_failure(model, float(np.asarray(t1)), settings, crossing == "last")
    return time


def _warn_of_failure(model: AbstractModel, t1: float, settings: Settings, last: bool) -> None:
    """Warn of a run without a result: this repeats the run to find how it ended."""
    ensemble = Ensemble.of(model, 1, settings.tolerance, last)
    outcome = ensemble.solve(t1, 1, settings)
    word = Status(int(np.ravel(status_of(model, ensemble, outcome, settings.tolerance))[0])).word
    end = np.ravel(outcome.end_time)[0]
    warn(
        f"the time of the event is NaN: the run ended as {word!r} at {end:.6g} s; nonholonomic.simulate returns the run up to "
        "there, and states the reason"
    )


def time_of_event(
    model: AbstractModel, t1: Any, settings: Settings, last: bool, unchecked: bool | None = None
) -> Float[Array, ""]:
    """The time of the event of a model.

    **Arguments:** as for `event_time`, checked; `last`: whether the last crossing counts; `unchecked`: whether nothing has
    checked the numbers, by default if some are traced.
    """
    return differentiable_solve(*EventTime.of(model, t1, settings, last, unchecked))


# Compile the whole, so that further calls with the same functions need no tracing.
_compiled = eqx.filter_jit(time_of_event)


class EventTime(AbstractDifferentiableSolve):
    """Times of the events of cells. The leaves are the numbers of the model, floats first, the horizon and the tolerance.

    - `structure`, `rest`: the model without its numbers; `is_float`: which of them are floats; `settings`: without the
      tolerance.
    - `last`: whether the last crossing counts; `unchecked`: whether numbers were traced, so that nothing checked them.
    """

    movable: int
    # JAX's PyTreeDef, which type checkers take for a variable.
    structure: Any = eqx.field(static=True)
    is_float: tuple[bool, ...] = eqx.field(static=True)
    rest: Any
    settings: Settings
    last: bool = eqx.field(static=True)
    unchecked: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls, model: AbstractModel, t1: Any, settings: Settings, last: bool, unchecked: bool | None = None
    ) -> tuple[Any, ...]:
        """The solve and its leaves. **Arguments:** as for `time_of_event`."""
        unchecked = is_traced((model, t1, settings.tolerance)) if unchecked is None else unchecked
        arrays, rest = eqx.partition(model, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        is_float = tuple(eqx.is_inexact_array(leaf) for leaf in leaves)
        floats = [leaf for leaf in leaves if eqx.is_inexact_array(leaf)]
        others = [leaf for leaf in leaves if not eqx.is_inexact_array(leaf)]
        solve = cls(len(floats), structure, is_float, rest, settings.with_tolerance(None), last, unchecked)
        return (solve, *floats, *others, as_number(t1), settings.tolerance)

    def absent(self, value: Float[Array, "..."]) -> Bool[Array, "..."]:
        return jnp.isinf(value)

    def solve(self, cells: int, *leaves: Float[Array, "..."]) -> Float[Array, " cells"]:
        is_legal, t1, settings = self.permitted(leaves)
        ensemble = Ensemble.of(self.model(leaves), cells, settings.tolerance, self.last)
        outcome = ensemble.solve(t1, cells, settings, traced=True)
        return self._times(leaves, is_legal, settings, ensemble, outcome, [])[0]

    def value_and_tangents(
        self, active: tuple[int, ...], nested: bool, cells: int, *leaves: Float[Array, "..."]
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        is_legal, t1, settings = self.permitted(leaves)
        model = self.model(leaves)
        model.require_differentiable(nested, self.last)

        def build(floats: tuple[Array, ...], cells: Any) -> Ensemble:
            return Ensemble.of(self.model((*floats, *leaves[self.movable :])), cells, settings.tolerance, self.last)

        # Cells are independent, so varying a parameter in all of them at once gives each its own derivative.
        ensemble, tangents, gather = tangents_by(build, active, leaves[: self.movable], cells)
        options = {"traced": True, "one_kernel": not nested}
        outcome, slopes, _ = ensemble.solve_with_tangents(tangents, t1, cells, settings, **options)
        return self._times(leaves, is_legal, settings, ensemble, outcome, gather([*slopes]))

    def model(self, leaves: Any) -> AbstractModel:
        """The model of the leaves."""
        floats, others = iter(leaves[: self.movable]), iter(leaves[self.movable :])
        arrays = [next(floats if is_float else others) for is_float in self.is_float]
        return eqx.combine(jax.tree.unflatten(self.structure, arrays), self.rest)

    def permitted(self, leaves: Any) -> tuple[Bool[Array, "..."], Float[Array, "..."], Settings]:
        """A mask of the cells with legal numbers; the horizons, 0 for all other cells; and the settings.

        A batch has one tolerance: the smallest.
        """
        *_, t1, tolerance = leaves
        is_legal = jnp.asarray(True)
        if self.unchecked:
            is_legal, t1, tolerance = legal_run(self.model(leaves).legal(), t1, tolerance)
        return is_legal, t1, self.settings.with_tolerance(jnp.min(tolerance))

    def _times(
        self,
        leaves: Any,
        is_legal: Bool[Array, "..."],
        settings: Settings,
        ensemble: Ensemble,
        outcome: Outcome | HybridOutcome,
        slopes: list[Float[Array, " cells"]],
    ) -> tuple[Float[Array, " cells"], list[Float[Array, " cells"]]]:
        """The times and their derivatives: infinite and 0 where there is no event, NaN where the run failed."""
        status = status_of(self.model(leaves), ensemble, outcome, settings.tolerance)
        is_good = is_legal & (status != int(SILENT[0])) & (status != int(SILENT[1]))
        has_event = status == int(Status.EVENT)
        time = jnp.where(has_event, outcome.crossing_time, jnp.inf)
        return nan_unless(is_good, (time, [jnp.where(has_event, slope, 0.0) for slope in slopes]))
