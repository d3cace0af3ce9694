"""Inversions of many launches: whether and when each top turns over, and the derivatives of that time.

Tables use concrete numbers (`ON_HOST`); functions that run inside `jit`, `vmap` and `grad` use traced numbers
(`traced`). Runs are one smooth motion, or go through the modes of their `RunKind`.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.derivatives import solve_ensemble_with_tangents, traced_solve_ensemble_with_tangents
from nonholonomic.hybrid import (
    AbstractBatchedMode,
    HybridOutcome,
    solve_hybrid,
    solve_hybrid_with_tangents,
    traced_solve_hybrid,
    traced_solve_hybrid_with_tangents,
)
from nonholonomic.integration import Outcome, Settings, solve_ensemble, traced_solve_ensemble
from nonholonomic.integration.status import CROSSED, FAILED, REACHED_END, UNRESOLVED

from ..model.scene import Scene
from ..modes.airborne import LAST_BALL, ON_STEM, SLIDING
from ..modes.airborne_ends import on_the_ground
from ..modes.inversion_problem import InversionProblem
from .energy import has_grown
from .run_kind import RunKind, run_kind_of


class Solvers(NamedTuple):
    """The functions that solve ensembles, for concrete or for traced numbers; `xp` is `numpy` or `jax.numpy`."""

    xp: Any
    ensemble: Callable[..., Any]
    ensemble_with_tangents: Callable[..., Any]
    hybrid: Callable[..., Any]
    hybrid_with_tangents: Callable[..., Any]


ON_HOST = Solvers(np, solve_ensemble, solve_ensemble_with_tangents, solve_hybrid, solve_hybrid_with_tangents)


def traced(one_kernel: bool = True) -> Solvers:
    """The functions for traced numbers. **Arguments:** `one_kernel`: false for programs that are differentiated
    again."""
    return Solvers(
        jnp,
        functools.partial(traced_solve_ensemble, one_kernel=one_kernel),
        functools.partial(traced_solve_ensemble_with_tangents, one_kernel=one_kernel),
        traced_solve_hybrid,
        traced_solve_hybrid_with_tangents,
    )


class Inversions(eqx.Module):
    """Launches in many cells that run until theta reaches an angle.

    - `problem`: the smooth motion, and the initial states of all cells.
    - `modes`, `first`: the modes of a hybrid run, and the index of each cell's first mode; `None` for smooth runs.
    - `last`: whether a run continues through the angle; if it ends above the angle, the last crossing counts.
    """

    problem: InversionProblem
    modes: tuple[AbstractBatchedMode, ...] | None
    first: Int[Array, " cells"] | None
    kind: RunKind = eqx.field(static=True)
    last: bool = eqx.field(static=True)

    @classmethod
    def of(cls, scene: Scene[Any], problem: InversionProblem, tolerance: Any, last: bool) -> "Inversions":
        """Launches in a scene, for runs at a tolerance."""
        kind = run_kind_of(scene)
        modes, first = (None, None) if kind.modes is None else kind.modes(scene, problem, tolerance, last)
        return cls(problem, modes, first, kind, last)

    def solve(self, t1: Any, cells: int, settings: Settings, solvers: Solvers = ON_HOST) -> Outcome | HybridOutcome:
        """The outcome of the runs. **Arguments:** `t1`: horizon [s]; `cells`: number of cells to run, the rest is
        padding."""
        if self.modes is None:
            horizon = (jnp.asarray(t1), jnp.asarray(cells))
            return solvers.ensemble(self.problem, *horizon, settings, nonterminal=self.last)[0]
        start, counters = self._start(solvers.xp), len(self.kind.counts)
        return solvers.hybrid(self.modes, *start, t1, cells, settings, counters=counters, nonterminal=self.last)

    def solve_with_tangents(
        self,
        tangents: tuple["Inversions", ...],
        t1: Any,
        cells: int,
        settings: Settings,
        solvers: Solvers = ON_HOST,
    ) -> tuple[Outcome | HybridOutcome, Sequence[Any], Any]:
        """The outcome of the runs, and the derivatives of their crossing times along tangents.

        **Returns:** the outcome; for each tangent the derivative in every cell, 0 if there is no crossing or the
        crossing is at the start; and the cells whose derivative is NaN because an earlier event was grazing.
        """
        if self.modes is None:
            arguments = (tuple(tangent.problem for tangent in tangents), jnp.asarray(t1), jnp.asarray(cells), settings)
            outcome, slopes = solvers.ensemble_with_tangents(self.problem, *arguments, nonterminal=self.last)
            return outcome, slopes, False
        outcome, xp = None, solvers.xp
        if self.last:
            # The derivatives need the run only up to the event, whose time is known.
            outcome = self.solve(t1, cells, settings, solvers)
            t1 = xp.where(xp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0)
        hybrid_tangents = tuple((tangent.modes, tangent.problem.states) for tangent in tangents)
        arguments = (self.modes, hybrid_tangents, *self._start(xp), t1, cells, settings)
        run, sensitivities = solvers.hybrid_with_tangents(
            *arguments, counters=len(self.kind.counts), ends_on_event=not self.last
        )
        return run if outcome is None else outcome, sensitivities.slopes, sensitivities.grazing

    def _start(self, xp: Any) -> tuple[Any, Any]:
        """The index of each cell's first mode, and its initial state."""
        return xp.asarray(self.first), xp.asarray(self.problem.states)


# Compiled once for all chunks.
@eqx.filter_jit
def checked(
    scene: Scene[Any], problem: InversionProblem, outcome: Outcome | HybridOutcome, tolerance: Float[Array, ""]
) -> Any:
    """The outcome with all states, including those in flight, in the layout of a contact. Runs that end with more
    energy than they began with are unresolved (`energy.py`).
    """
    kind = run_kind_of(scene)
    first: Any = None if kind.modes is None else kind.modes(scene, problem, tolerance, False)[1]
    mode: Any = outcome.mode if isinstance(outcome, HybridOutcome) else None
    state = jnp.asarray(outcome.state)[: len(problem.states)]
    energy_before, energy_after = kind.energy_in(scene, problem.states, first)[1], kind.energy_in(scene, state, mode)[0]
    grown = has_grown(scene, energy_before, energy_after, tolerance) & (outcome.status != FAILED)
    outcome = outcome._replace(status=jnp.where(grown, UNRESOLVED, outcome.status))
    return outcome._replace(state=on_the_ground(scene, state, mode)) if kind.flight_state else outcome


def carried_by_stem(
    kind: RunKind, problem: InversionProblem, outcome: Outcome | HybridOutcome
) -> Bool[Array, " cells"] | None:
    """The cells whose stem was the last to touch, of an outcome before `checked`; `None` for a top without a stem."""
    if problem.stem_counts is None:
        return None
    assert isinstance(outcome, HybridOutcome)
    if not kind.flight_state:
        return jnp.asarray(outcome.mode) != 0
    flies = (outcome.mode != SLIDING) & (outcome.mode != ON_STEM)
    return jnp.asarray((outcome.mode == ON_STEM) | (flies & (outcome.state[LAST_BALL] == 1.0)))


def is_inverted(
    outcome: Outcome | HybridOutcome, problem: InversionProblem, last: bool, carried: Bool[Array, " cells"] | None
) -> Bool[Array, " cells"]:
    """The cells that count as inverted: the event happened or, if the last crossing counts, the run ends beyond it.

    **Arguments:** `carried`: as returned by `carried_by_stem`.
    """
    if not last:
        return outcome.status == CROSSED
    is_above = problem.event_function(jnp.asarray(outcome.state)) <= 0.0
    if carried is not None:
        is_above = jnp.where(problem.stem_counts > 0.0, carried, is_above)
    return (outcome.status == REACHED_END) & is_above & jnp.isfinite(outcome.crossing_time)
