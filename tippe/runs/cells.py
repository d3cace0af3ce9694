"""The cells of an inversion table: the job that runs them, and computes the variables of each cell."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nonholonomic.hybrid import HybridOutcome
from nonholonomic.integration import Outcome, Settings, solve_by_diffrax
from nonholonomic.integration.status import CROSSED, FAILED, LEFT_DOMAIN, UNRESOLVED, Status
from nonholonomic.parameters import with_numbers
from nonholonomic.runs.errors import errors_of, second_tolerance
from nonholonomic.sweeps import Variable
from nonholonomic.validation import as_number

from ..model.contact_dynamics import LOSSES
from ..model.launch import Launch
from ..model.scene import Scene
from ..modes import airborne_ends
from ..modes.inversion_problem import InversionProblem, StemContact
from .inversion import Inversions, carried_by_stem, checked, is_inverted
from .run_kind import COUNTED, HYBRID, WORDS, RunKind, run_kind_of
from .sensitivities import sensitivities_of_cells

TIMES = {"time": "inversion time", "first_time": "first inversion time", "last_time": "last inversion time"}

#: The variable with the time at which the stem first carries the top, and its description.
STEM_TIME = {"stem_time": "time at which the stem first carries the top"}

NAMES = TIMES | STEM_TIME | {"end_time": "end of the run", "end_theta": "θ at the end of the run"}

# Compiled once for all chunks.
_loss = eqx.filter_jit(lambda dynamics, state: dynamics.loss(state))
_flight_loss = eqx.filter_jit(airborne_ends.loss)


@eqx.filter_jit
def at_the_end(
    scene: Scene,
    problem: InversionProblem,
    outcome: Outcome | HybridOutcome,
    last: bool,
    tolerance: Float[Array, ""],
) -> tuple[Int[Array, " cells"], Bool[Array, " cells"], Float[Array, " cells"]]:
    """The status of all cells, which of them count as inverted, and theta [rad] at the end of each."""
    carried = carried_by_stem(run_kind_of(scene), problem, outcome)
    outcome = checked(scene, problem, outcome, tolerance)
    return outcome.status, is_inverted(outcome, problem, last, carried), scene.theta(jnp.asarray(outcome.state))


#: The word for a run's status if it has not inverted; `not_inverted` for all others.
WORD_OF_STATUS = {
    LEFT_DOMAIN: WORDS.index("contact_lost"),
    FAILED: WORDS.index("failed"),
    UNRESOLVED: WORDS.index("unresolved"),
}


def too_many_steps(t1: float, max_steps: int, end: float) -> str:
    """Message for a run that needs more than the allowed steps."""
    return (
        f"t1 = {t1:g} s is too long: the run needs more than {max_steps:_} steps, which reached only {end:.4g} s; "
        "take a shorter t1 or a larger tolerance"
    ).replace("_", " ")


class InversionRuns(NamedTuple):
    """The requested variables of every cell of a table; see `inversion_table`. `angle` is `None` for a table of
    reversal times; `has_stem` is true for a top with a stem."""

    run_kind: RunKind
    t1: float
    angle: float | StemContact | None
    crossing: str
    settings: Settings
    method: str
    slopes_by: list[str]
    has_stem: bool = False

    @property
    def bounded_times(self) -> tuple[str, ...]:
        """All variables that are times of events."""
        return (*self.times, *STEM_TIME) if self.has_stem else self.times

    @property
    def times(self) -> tuple[str, ...]:
        """The table's variables that are times of crossings."""
        return ("first_time", "last_time") if self.crossing == "both" else ("time",)

    @property
    def last(self) -> bool:
        """Whether a run continues through the angle; if it ends above the angle, the last crossing counts."""
        return self.crossing != "first"

    @property
    def variables(self) -> dict[str, Variable]:
        """The table's variables, without errors and derivatives."""
        names = NAMES if self.angle is not None else {"time": "reversal time"}
        times = {name: Variable("s", np.float64, long_name=names[name]) for name in self.bounded_times}
        grazes = Variable("1", np.int8, long_name="whether an event on the way was grazing")
        return (
            times
            | self.run_kind.variables
            | ({"grazes": grazes} if self.slopes_by and not self.run_kind.smooth else {})
        )

    @property
    def error_variables(self) -> dict[str, Variable]:
        """The table's variables that describe the accuracy of other variables (`time_error.py`)."""
        bounds = dict.fromkeys((*self.bounded_times, "end_time"), "s") | {"end_theta": "rad"}
        variables = {
            name: Variable(unit, np.float64, long_name=f"error of the {NAMES[name]}") for name, unit in bounds.items()
        }
        variables |= {"status": Variable("1", np.int8, long_name="whether the two runs disagree on the status")}
        variables |= {
            name: Variable("1", np.int64, long_name=f"difference of the two runs in {COUNTED[name]}")
            for name in self.run_kind.counts
        }
        return {f"{name}_error": variable for name, variable in variables.items()}

    def results(self, roots: dict[str, Any], columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of the given cells.

        **Arguments:** `roots`: scene and launch; `columns`: full name of a parameter -> its value in every cell, of
        which only the first `count` are run.
        """
        cells = with_numbers(roots, columns)
        scene, launch = cells["scene"], cells["launch"]
        size = next((len(values) for values in columns.values()), 1)
        settings = self.settings
        problem = InversionProblem.of(scene, launch, self.angle, size)

        def solved(last: bool) -> Any:
            return Inversions.of(scene, problem, settings.tolerance, last).solve(self.t1, count, settings)

        slopes, grazing = {}, False
        if self.slopes_by:
            numbers = (roots, columns, self.slopes_by, self.angle, self.t1, settings)
            outcome, slopes, grazing = sensitivities_of_cells(*numbers, count=count, size=size, last=self.last)
        elif self.method == "diffrax":
            outcome = solve_by_diffrax(problem, jnp.asarray(self.t1), settings)
        else:
            outcome = solved(self.last)
        variables = self._named(scene, problem, outcome, settings.tolerance)
        if self.crossing == "both":
            # With several modes, the first crossing needs a separate hybrid solve, which ends there.
            variables["first_time"] = (
                _time_of_first(checked(scene, problem, solved(False), settings.tolerance))
                if isinstance(outcome, HybridOutcome)
                else np.where(variables["status"] == WORDS.index("unresolved"), np.inf, outcome.first_crossing)
            )
        if self.has_stem:
            variables["stem_time"] = self._stem_time(scene, launch, variables, count, size)
        inverted = variables["status"] == WORDS.index("inverted")
        variables |= {name: np.where(inverted, slope, 0.0) for name, slope in slopes.items()}
        if slopes and not self.run_kind.smooth:
            variables["grazes"] = (inverted & grazing).astype(np.int8)
        return variables

    def _stem_time(
        self, scene: Scene, launch: Launch, variables: dict[str, Any], count: int, size: int
    ) -> Float[np.ndarray, " cells"]:
        """The time at which the stem first carries the top, infinite if it does not. If this is not an event of the run
        itself, it needs a run of its own."""
        if isinstance(self.angle, StemContact) and self.crossing != "last":
            return variables[self.times[0]]
        problem, tolerance = InversionProblem.of(scene, launch, StemContact(), size), self.settings.tolerance
        outcome = Inversions.of(scene, problem, tolerance, False).solve(self.t1, count, self.settings)
        assert isinstance(outcome, HybridOutcome)
        return _time_of_first(checked(scene, problem, outcome, tolerance))

    def _named(
        self,
        scene: Scene,
        problem: InversionProblem,
        outcome: Outcome | HybridOutcome,
        tolerance: Float[Array, ""],
    ) -> dict[str, Any]:
        """The variables that describe how the runs ended, except the first of two times."""
        ended, inverted, theta = at_the_end(scene, problem, outcome, self.last, tolerance)
        conditions = [np.asarray(ended) == status for status in WORD_OF_STATUS]
        code = np.select([np.asarray(inverted), *conditions], [0, *WORD_OF_STATUS.values()], 1)
        is_lost = code == WORDS.index("contact_lost")
        if is_lost.any():
            words = np.array([WORDS.index(status.word) for status in LOSSES])
            code = np.where(is_lost, words[self._loss(scene, jnp.asarray(outcome.state))], code)
        counts = zip(self.run_kind.counts, outcome.counts, strict=True) if isinstance(outcome, HybridOutcome) else ()
        return {
            self.times[-1]: np.where(inverted, outcome.crossing_time, np.inf),
            "status": code.astype(np.int8),
            "end_time": np.asarray(outcome.end_time),
            "end_theta": np.asarray(theta),
            "steps": np.asarray(outcome.steps),
            "rejected": np.asarray(outcome.rejected),
            **dict(counts),
        }

    def _loss(self, scene: Scene, state: Float[Array, "components cells"]) -> Any:
        """Why contact ended in each cell, as a code in `LOSSES`."""
        if self.run_kind is HYBRID:
            # A run with flights continues when contact is lost, and its ball fits everywhere.
            return LOSSES.index(Status.JAMMED)
        return np.asarray(_flight_loss(scene, state) if self.run_kind.flight_state else _loss(scene.dynamics, state))


def _time_of_first(outcome: HybridOutcome) -> Float[np.ndarray, " cells"]:
    """The time of the first crossing, infinite in cells that ended otherwise."""
    return np.where(outcome.status == CROSSED, outcome.crossing_time, np.inf)


class InversionJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process.

    `errors`: whether to run every cell again at another tolerance.
    """

    runs: InversionRuns
    roots: dict[str, Any]
    errors: bool

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which only the first `count` are run."""
        runs, words = self.runs, self.runs.run_kind.words
        if runs.method == "diffrax" and count == 0:
            # The slow reference always computes a whole chunk, so a call only to compile would compute the first chunk
            # twice.
            return {}
        variables = runs.results(self.roots, columns, count)
        if self.errors:
            settings = runs.settings.with_tolerance(as_number(second_tolerance(float(runs.settings.tolerance))))
            second = runs._replace(settings=settings, slopes_by=[]).results(self.roots, columns, count)
            silent = tuple(words.index(word) for word in ("failed", "unresolved") if word in words)
            bounded = (*runs.bounded_times, "end_time", "end_theta")
            variables |= errors_of(variables, second, bounded, runs.run_kind.counts, silent)
        return variables


class ScatteredJob(NamedTuple):
    """A job whose cells are listed in columns, one row per cell. The results include the columns.

    `columns`: full name of a number -> its value in every cell; `names`: full name -> name of the variable.
    """

    job: InversionJob
    columns: dict[str, Any]
    names: dict[str, str]

    def __call__(self, columns: dict[str, Any], count: int) -> dict[str, Any]:
        """The variables of some cells, of which only the first `count` are run."""
        values_of_columns = {number: values[columns["cell"]] for number, values in self.columns.items()}
        return self.job(values_of_columns, count) | {
            self.names[number]: values for number, values in values_of_columns.items()
        }
