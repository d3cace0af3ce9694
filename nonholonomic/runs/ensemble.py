"""Many runs of a model at once: how they end, and the derivatives of the times of their events.

Smooth runs are one ensemble; other runs go through the modes of the model. Functions for tables get concrete numbers,
and run their loops on the host; functions inside transformations get traced numbers.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..derivatives import solve_ensemble_with_tangents, traced_solve_ensemble_with_tangents
from ..hybrid import (
    HybridOutcome,
    solve_hybrid,
    solve_hybrid_with_tangents,
    traced_solve_hybrid,
    traced_solve_hybrid_with_tangents,
)
from ..integration import AbstractProblem, Outcome, Settings, solve_ensemble, traced_solve_ensemble
from ..integration.status import CROSSED, REACHED_END, Status
from .event import modes_of, problem_of
from .model import AbstractModel

#: The statuses of runs without a result.
SILENT = (Status.FAILED, Status.UNRESOLVED)


class Ensemble(eqx.Module):
    """The runs of many cells of a model.

    - `problem`: the motion of smooth runs; `None` for other runs.
    - `modes`, `first`, `states`: the modes, the index of each cell's first mode, and the initial states; `None` for
      smooth runs.
    - `counters`: number of counters; `continues`: whether a run continues through its event.
    """

    problem: AbstractProblem | None
    # A tuple, or `None`.
    modes: Any
    first: Int[Array, " cells"] | None
    states: Float[Array, "components cells"] | None
    counters: int = eqx.field(static=True)
    continues: bool = eqx.field(static=True)

    @classmethod
    def of(cls, model: AbstractModel, cells: int, tolerance: Any, continues: bool) -> "Ensemble":
        """The runs of some cells of a model, whose numbers are scalars or arrays with one number per cell."""
        if model.smooth:
            return cls(problem_of(model, cells, ()), None, None, None, 0, continues)
        return cls(None, *modes_of(model, cells, tolerance, (), continues), len(model.counters), continues)

    def solve(self, t1: Any, cells: Any, settings: Settings, traced: bool = False) -> Outcome | HybridOutcome:
        """The outcome of the runs.

        **Arguments:** `t1`: horizon [s]; `cells`: number of cells to run, the rest is padding; `traced`: whether numbers
        may be traced.
        """
        if self.problem is not None:
            horizon = (jnp.asarray(t1), jnp.asarray(cells), settings)
            if traced:
                return traced_solve_ensemble(self.problem, *horizon, nonterminal=self.continues, one_kernel=True)[0]
            return solve_ensemble(self.problem, *horizon, nonterminal=self.continues)[0]
        solve, xp = (traced_solve_hybrid, jnp) if traced else (solve_hybrid, np)
        start, options = self._start(xp), {"counters": self.counters, "nonterminal": self.continues}
        return solve(self.modes, *start, t1, cells, settings, **options)

    def solve_with_tangents(
        self,
        tangents: Sequence[Any],
        t1: Any,
        cells: Any,
        settings: Settings,
        traced: bool = False,
        one_kernel: bool = True,
    ) -> tuple[Any, Any, Any]:
        """The outcome of the runs, and the derivatives of the times of their events.

        **Arguments:** `tangents`: tangents of the ensemble; `one_kernel`: false for programs that are differentiated
        again; the others as for `solve`.

        **Returns:** the outcome; for each tangent the derivative in every cell, 0 if there is no event or the event is
        at the start; and a mask of the cells whose derivative is NaN because an earlier event was grazing.
        """
        if self.problem is not None:
            arguments = (tuple(tangent.problem for tangent in tangents), jnp.asarray(t1), jnp.asarray(cells), settings)
            if not traced:
                outcome, slopes = solve_ensemble_with_tangents(self.problem, *arguments, nonterminal=self.continues)
                return outcome, slopes, False
            options = {"nonterminal": self.continues, "one_kernel": one_kernel}
            return *traced_solve_ensemble_with_tangents(self.problem, *arguments, **options), False
        solve, xp = (traced_solve_hybrid_with_tangents, jnp) if traced else (solve_hybrid_with_tangents, np)
        outcome = None
        if self.continues:
            # The derivatives need the run only up to the event, whose time is known.
            outcome = self.solve(t1, cells, settings, traced)
            t1 = xp.where(xp.isfinite(outcome.crossing_time), outcome.crossing_time, 0.0)
        pairs = tuple((tangent.modes, tangent.states) for tangent in tangents)
        options = {"counters": self.counters, "ends_on_event": not self.continues}
        run, sensitivities = solve(self.modes, pairs, *self._start(xp), t1, cells, settings, **options)
        return run if outcome is None else outcome, sensitivities.slopes, sensitivities.grazing

    def _start(self, xp: Any) -> tuple[Any, Any]:
        return xp.asarray(self.first), xp.asarray(self.states)

    @property
    def starts(self) -> Float[Array, "components cells"]:
        """The initial states."""
        return self.problem.start()[0] if self.problem is not None else jnp.asarray(self.states)

    def has_event(self, outcome: Any) -> Bool[Array, " cells"]:
        """The cells whose event counts: the run ended on it or, if runs continue, ends beyond it."""
        if not self.continues:
            return outcome.status == CROSSED
        state = jnp.asarray(outcome.state)
        if self.problem is not None:
            value: Any = self.problem.event_function(state)
        else:
            value = jnp.ones(state.shape[1])
            for number, mode in enumerate(self.modes or ()):
                beyond: Any = mode.problem(state).event_function(state)
                value = jnp.where(outcome.mode == number, beyond, value)
        return (outcome.status == REACHED_END) & (value <= 0.0) & jnp.isfinite(outcome.crossing_time)


def status_of(model: AbstractModel, ensemble: Ensemble, outcome: Outcome | HybridOutcome, tolerance: Any) -> Any:
    """How each run has ended, as an integer of `Status`: `EVENT` for the runs whose event counts."""
    status, has_event = model.ended(outcome, tolerance), ensemble.has_event(outcome)
    is_sound = (status == int(Status.EVENT)) | (status == int(Status.COMPLETED))
    return jnp.where(is_sound & has_event, int(Status.EVENT), status)
