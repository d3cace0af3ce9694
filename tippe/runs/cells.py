"""How to run the cells of a table: the kinds of scene, and the variables of each."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.hybrid import AbstractBatchedMode, HybridOutcome, solve_hybrid
from nonholonomic.integration import (
    CROSSED,
    DEFAULT_MAX_STEPS,
    FAILED,
    LEFT_DOMAIN,
    REACHED_END,
    UNRESOLVED,
    Outcome,
    Settings,
    Status,
    solve_by_diffrax,
    solve_ensemble,
)
from nonholonomic.parameters import with_numbers
from nonholonomic.sweeps import Variable

from ..model.dynamics import LOSSES
from ..model.scene import Scene
from ..modes import airborne, airborne_stem, airborne_stick_slip
from ..modes.inversion_problem import InversionProblem
from ..modes.sliding import modes as hybrid_modes
from ..modes.sticking import modes as stick_slip_modes
from .inversion import is_inverted
from .sensitivities import hybrid_sensitivities_of_cells, sensitivities_of_cells


class RunKind(NamedTuple):
    """How to run a kind of scene: its status words, its counters besides steps, and its modes.

    `modes` takes (scene, problem, tolerance, last) and returns the modes and the number of each cell's first; `None`
    for runs of one smooth motion. `flight_state` is whether states may be those of flight, in a layout of their own.
    """

    words: tuple[str, ...]
    counts: tuple[str, ...]
    modes: Callable[..., tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]] | None
    flight_state: bool = False

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion."""
        return self.modes is None

    @property
    def variables(self) -> dict[str, Variable]:
        """The table's variables besides the times."""
        found = {"status": Variable("1", np.int8, self.words, long_name="how the run ended")}
        found |= {"end_time": Variable("s", np.float64, long_name="end of the run")}
        found |= {"end_theta": Variable("rad", np.float64, long_name="θ at the end of the run")}
        counts = ("steps", "rejected", *self.counts)
        return found | {name: Variable("1", np.int64, long_name=COUNTED[name]) for name in counts}


#: Descriptions of the counters of a run.
COUNTED = {"steps": "steps", "rejected": "rejected steps", "hops": "flights", "sticks": "changes from slip to rolling"}
TIMES = {"time": "inversion time", "first_time": "first inversion time", "last_time": "last inversion time"}

NAMES = TIMES | {"end_time": "end of the run", "end_theta": "θ at the end of the run"}

# Compiled once for all chunks.
_on_the_ground = eqx.filter_jit(airborne.on_the_ground)
_loss = eqx.filter_jit(lambda dynamics, state: dynamics.loss(state))
_flight_loss = eqx.filter_jit(airborne.loss)


@eqx.filter_jit
def _at_the_end(
    scene: Scene, problem: InversionProblem, ended: Outcome | HybridOutcome, last: bool
) -> tuple[Bool[Array, " cells"], Float[Array, " cells"]]:
    """Which cells count as inverted, and theta [rad] at the end of each."""
    return is_inverted(ended, problem, last), scene.theta(jnp.asarray(ended.state))


#: The words of tables, in the order of the integers in their files, which is older than `Status`.
WORDS = ("inverted", "not_inverted", "contact_lost", "failed", "jammed", "does_not_fit")
SMOOTH = RunKind(WORDS, (), None)
REVERSAL = RunKind(("reversed", "not_reversed", *WORDS[2:]), (), None)
STICK_SLIP = RunKind((*WORDS, "unresolved"), ("sticks",), stick_slip_modes)
HYBRID = RunKind((*WORDS, "unresolved"), ("hops",), hybrid_modes)
AIRBORNE = RunKind((*WORDS, "unresolved"), ("hops",), airborne.modes, flight_state=True)
ON_STEM_TOO = RunKind((*WORDS, "unresolved"), ("hops",), airborne_stem.modes, flight_state=True)
STICK_SLIP_FLY = RunKind((*WORDS, "unresolved"), ("hops", "sticks"), airborne_stick_slip.modes, flight_state=True)

#: The word for a run's status if it has not inverted; `not_inverted` for all others.
WORD_OF_STATUS = {LEFT_DOMAIN: WORDS.index("contact_lost"), FAILED: WORDS.index("failed"), UNRESOLVED: len(WORDS)}


def too_many_steps(t1: float, most: int, end: float) -> str:
    """Message for a run that needs more than the most steps."""
    return (
        f"t1 = {t1:g} s is too long: the run needs more than {most:_} steps, with which it came to {end:.4g} s; "
        "take a shorter t1 or a larger tolerance"
    ).replace("_", " ")


def run_kind_of(scene: Scene) -> RunKind:
    """The run kind of a scene."""
    hybrid = scene.contact == "hybrid"
    if scene.friction.set_valued:
        return STICK_SLIP_FLY if hybrid else STICK_SLIP
    if not hybrid:
        return SMOOTH
    if scene.flies_in_closed_form:
        return HYBRID
    return AIRBORNE if scene.body.stem is None else ON_STEM_TOO


def check_differentiable(scene: Scene) -> None:
    """Raise `ValueError` for a scene whose modes do not support derivatives."""
    if run_kind_of(scene) is STICK_SLIP_FLY:
        raise ValueError(
            "friction = SetValuedCoulomb with contact = 'hybrid' has no derivatives: they do not go through impacts in which a "
            "slip may stop"
        )


class InversionRuns(NamedTuple):
    """The requested variables of every cell of a table; see `inversion_table`. `angle` is `None` where reversals are timed."""

    run_kind: RunKind
    t1: float
    angle: float | None
    crossing: str
    solver: diffrax.AbstractSolver | None
    method: str
    slopes_by: list[str]
    max_steps: int = DEFAULT_MAX_STEPS

    def settings(self, tolerance: float) -> Settings:
        """How the runs are integrated at a tolerance."""
        return Settings(tolerance, self.solver, max_steps=self.max_steps)

    @property
    def times(self) -> tuple[str, ...]:
        """The table's variables that are times of crossings."""
        return ("first_time", "last_time") if self.crossing == "both" else ("time",)

    @property
    def last(self) -> bool:
        """Whether a run continues through the angle: where it ends above it, the last crossing counts."""
        return self.crossing != "first"

    @property
    def variables(self) -> dict[str, Variable]:
        """The table's variables, without errors and derivatives."""
        names = TIMES if self.angle is not None else {"time": "reversal time"}
        times = {name: Variable("s", np.float64, long_name=names[name]) for name in self.times}
        grazes = Variable("1", np.int8, long_name="whether an event on the way was grazing")
        return (
            times
            | self.run_kind.variables
            | ({"grazes": grazes} if self.slopes_by and not self.run_kind.smooth else {})
        )

    @property
    def error_variables(self) -> dict[str, Variable]:
        """The table's variables that describe the accuracy of others (`time_error.py`)."""
        bounds = dict.fromkeys((*self.times, "end_time"), "s") | {"end_theta": "rad"}
        found = {
            name: Variable(unit, np.float64, long_name=f"error of the {NAMES[name]}") for name, unit in bounds.items()
        }
        found |= {"status": Variable("1", np.int8, long_name="whether the two runs disagree on the status")}
        found |= {
            name: Variable("1", np.int64, long_name=f"difference of the two runs in {COUNTED[name]}")
            for name in self.run_kind.counts
        }
        return {f"{name}_error": variable for name, variable in found.items()}

    def results(self, roots: dict[str, Any], columns: dict[str, Any], tolerance: float, count: int) -> dict[str, Any]:
        """The variables of some cells.

        **Arguments:** `roots`: scene and launch; `columns`: full name of a parameter -> its value in every cell, of which the
        first `count` are to be run; `tolerance`: relative tolerance.
        """
        cells = with_numbers(roots, columns)
        scene, launch = cells["scene"], cells["launch"]
        size = next((len(values) for values in columns.values()), 1)
        problem = InversionProblem.of(scene, launch, self.angle, size)
        options = {"count": count, "size": size, "last": self.last}
        numbers = (roots, columns, self.slopes_by, self.angle)
        if self.run_kind.modes is not None:
            options |= {"counters": len(self.run_kind.counts)}
            along = functools.partial(hybrid_sensitivities_of_cells, self.run_kind.modes, *numbers, **options)
            return self._hybrid_runs(scene, problem, tolerance, count, along)
        if not self.slopes_by:
            return self._ended(scene, problem, self._outcome(problem, tolerance, count))
        outcome, slopes = sensitivities_of_cells(*numbers, self.t1, self.settings(tolerance), **options)
        return self._ended(scene, problem, outcome) | slopes

    def _hybrid_runs(
        self, scene: Scene, problem: InversionProblem, tolerance: float, count: int, along: Callable[..., Any]
    ) -> dict[str, Any]:
        """The variables of cells with hybrid runs; `along` takes (horizon, settings) and returns runs and derivatives."""
        if self.slopes_by and not self.last:
            found, slopes, grazing = along(self.t1, self.settings(tolerance))
        else:
            found = self._hybrid_outcome(scene, problem, tolerance, count, self.last)
        if self.slopes_by and self.last:
            # The derivatives need the run only up to the event, whose time is now known.
            there, slopes, grazing = along(
                np.where(np.isfinite(found.crossing_time), found.crossing_time, 0.0), self.settings(tolerance)
            )
            grazing |= there.status != REACHED_END
        loss = functools.partial(self._loss, scene, found.state)
        if self.run_kind.flight_state:
            found = found._replace(state=np.asarray(_on_the_ground(scene, found.state, found.mode)))
        named = self._named(scene, problem, found, loss) | dict(zip(self.run_kind.counts, found.counts, strict=True))
        if self.crossing == "both":
            # With several modes the first crossing takes a hybrid solve of its own, which ends there.
            first = self._hybrid_outcome(scene, problem, tolerance, count, False)
            named["first_time"] = np.where(first.status == CROSSED, first.crossing_time, np.inf)
        if not self.slopes_by:
            return named
        # An event at the start has a fixed time, whatever the tangent.
        moves = (named["status"] == 0) & (named[self.times[-1]] > 0.0)
        slopes = {name: np.where(moves, np.where(grazing, np.nan, slope), 0.0) for name, slope in slopes.items()}
        return named | slopes | {"grazes": (moves & grazing).astype(np.int8)}

    def _hybrid_outcome(
        self, scene: Scene, problem: InversionProblem, tolerance: float, count: int, last: bool
    ) -> HybridOutcome:
        """The hybrid runs of cells."""
        assert self.run_kind.modes is not None
        modes, first = self.run_kind.modes(scene, problem, tolerance, last)
        start, settings = (np.asarray(first), np.asarray(problem.states)), self.settings(tolerance)
        return solve_hybrid(
            modes, *start, self.t1, count, settings, counters=len(self.run_kind.counts), nonterminal=last
        )

    def _outcome(self, problem: InversionProblem, tolerance: float, count: int) -> Outcome:
        horizon, settings = jnp.asarray(self.t1), self.settings(tolerance)
        if self.method == "diffrax":
            return solve_by_diffrax(problem, horizon, settings)
        return solve_ensemble(problem, horizon, jnp.asarray(count), settings, nonterminal=self.last)[0]

    def _ended(self, scene: Scene, problem: InversionProblem, outcome: Outcome) -> dict[str, Any]:
        """The variables of cells whose runs are one smooth motion."""
        return self._named(scene, problem, outcome, functools.partial(self._loss, scene, outcome.state))

    def _loss(self, scene: Scene, state: Any) -> Any:
        """Why contact ended in each cell, as a code in `LOSSES`."""
        if self.run_kind is HYBRID:
            # A run with flights continues where contact is lost, and its ball fits everywhere.
            return LOSSES.index(Status.JAMMED)
        state = jnp.asarray(state)
        return np.asarray(_flight_loss(scene, state) if self.run_kind.flight_state else _loss(scene.dynamics, state))

    def _named(
        self, scene: Scene, problem: InversionProblem, ended: Outcome | HybridOutcome, loss: Callable[[], Any]
    ) -> dict[str, Any]:
        inverted, theta = _at_the_end(scene, problem, ended, self.last)
        others = [np.asarray(ended.status) == status for status in WORD_OF_STATUS]
        code = np.select([np.asarray(inverted), *others], [0, *WORD_OF_STATUS.values()], 1)
        lost = code == WORDS.index("contact_lost")
        if lost.any():
            code = np.where(lost, np.array([WORDS.index(status.word) for status in LOSSES])[loss()], code)
        times = {self.times[-1]: np.where(inverted, ended.crossing_time, np.inf)}
        if isinstance(ended, Outcome) and self.crossing == "both":
            times["first_time"] = np.asarray(ended.first_crossing)
        return times | {
            "status": code.astype(np.int8),
            "end_time": np.asarray(ended.end_time),
            "end_theta": np.asarray(theta),
            "steps": np.asarray(ended.steps),
            "rejected": np.asarray(ended.rejected),
        }
