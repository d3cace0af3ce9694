"""The cells of a table of any model: event times, how and where runs end, samples, error bounds and derivatives."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num

from ..derivatives import tangent_scale, tangents_by
from ..hybrid import HybridOutcome
from ..integration import Outcome, Settings, solve_by_diffrax
from ..integration.problem import TIGHTEST, TIGHTEST_IN_SINGLE, Status
from ..kernels import place_of_jax
from ..sweeps.grid import Axis, Values, Variable
from ..validation import as_number
from .event import SILENT, Ensemble, counted, status_of
from .model import AbstractModel, Number
from .simulate import Samples

#: The words for how a run ends, in the order of `Status`.
WORDS = tuple(status.word for status in sorted(Status)[1:])

#: Descriptions of the counters of every run.
COUNTED = {"steps": "steps", "rejected": "rejected steps"}


#: The parameters of some cells, or their results: name -> values.
Cells = dict[str, Values]


class TableForm(NamedTuple):
    """The names in a table of a kind of model.

    - `named`: statuses in place of others.
    - `event`: what the event is, for descriptions of variables.
    - `run`: the word for a run in descriptions.
    - `time`, `of_time`: name and description of the variable of the event's time; `order`: the variables in order, by default
      as they come.
    - `left_open`: what a run that ends at the first event leaves open, if it is to be said.
    - `nan_if_failed`: whether the time of a run without a result is NaN; otherwise it is infinite.
    """

    named: dict[Status, Status] | None = None
    event: str = "event"
    nan_if_failed: bool = True
    time: str = "time"
    of_time: str = "time of the event"
    run: str = "run"
    order: tuple[str, ...] | None = None
    left_open: str = ""

    @property
    def codes(self) -> np.ndarray:
        """The integer in a table for each integer of `Status` from 0 on."""
        named = self.named or {}
        return np.array([named.get(status, status) for status in sorted(Status)[1:]], np.int8)


class TableJob(NamedTuple):
    """The computation for every cell, as data that can be sent to another process.

    - `model`: with scalars; `form`: the names in the table.
    - `t1`: horizon [s]; `crossing`: "first", "last", "both" or "after"; `settings`: those of the integration.
    - `slopes`: full name of a parameter -> name of the variable with the derivative of the time.
    - `errors`: whether to run every cell again at other tolerances.
    - `samples`: the quantities at given times, or `None`; `timed`: whether runs are timed, not only sampled.
    - `by_diffrax`: whether Diffrax solves smooth runs, one by one, as a slow reference.
    - `nudge`: relative change of the initial states of runs with resets, which shows how resets amplify round-off.
    - `listed`: the numbers of scattered cells, which the results include; without a grid, the only axis counts the cells.
    """

    model: AbstractModel
    form: TableForm
    t1: float
    crossing: str
    settings: Settings
    slopes: dict[str, str] | None = None
    errors: bool = False
    samples: Samples | None = None
    timed: bool = True
    by_diffrax: bool = False
    nudge: float = 0.0
    listed: tuple[Axis, ...] = ()

    @property
    def times(self) -> tuple[str, ...]:
        """The variables that are times of events."""
        if not self.model.has_event and self.form.order is None:
            return ()
        return ("first_time", "last_time") if self.crossing == "both" else (self.form.time,)

    @property
    def continues(self) -> bool:
        """Whether a run continues through its event."""
        own = self.model.continues and self.model.event is None and self.model.has_event
        return self.crossing != "first" or own

    @property
    def has_kernel(self) -> bool:
        """Whether a kernel can run the cells."""
        has_samples = self.samples is None or (self.samples.has_kernel and self.model.smooth)
        return has_samples and not self.by_diffrax

    @property
    def variables(self) -> dict[str, Variable]:
        """The variables of the table, without derivatives."""
        if not self.timed:
            return self.samples.variables(self.model) | self._ending({}) if self.samples is not None else {}
        event = self.form.event
        words = {f"{name}_time": f"{name} {event} time" for name in ("first", "last")}
        words[self.form.time] = self.form.of_time.format(crossing=self.crossing)
        words = {name: words[name] for name in self.times}
        words |= {name: text for name, (text, _) in self.model.further_times.items()}
        variables = {name: Variable("s", np.float64, long_name=text) for name, text in words.items()}
        variables |= self._ending({} if self.samples is not None else self.model.ends)
        if self.slopes and not self.model.smooth:
            variables |= {"grazes": Variable("1", np.int8, long_name="whether an event on the way was grazing")}
        if self.errors:
            words = {name: f"error of the {variables[name].long_name}" for name in self.bounded}
            words |= {name: f"difference of the runs in {text}" for name, text in self.model.counters.items()}
            errors = {f"{name}_error": variables[name]._replace(long_name=text) for name, text in words.items()}
            errors["status_error"] = Variable("1", np.int8, long_name="whether the runs disagree on the status")
            variables |= errors
        if self.samples is not None:
            variables |= self.samples.variables(self.model)
        return variables if self.form.order is None else {name: variables[name] for name in self.form.order}

    def _ending(self, ends: dict[str, Variable]) -> dict[str, Variable]:
        """The variables that describe how a run ended."""
        counts = COUNTED | self.model.counters
        of_end = {
            "status": Variable("1", np.int8, WORDS, long_name=f"how the {self.form.run} ended"),
            "end_time": Variable("s", np.float64, long_name=f"end of the {self.form.run}"),
        }
        return of_end | ends | {name: Variable("1", np.int64, long_name=words) for name, words in counts.items()}

    @property
    def bounded(self) -> tuple[str, ...]:
        """The variables that get error bounds."""
        ends = self.model.ends if self.samples is None else ()
        return (*self.times, *self.model.further_times, "end_time", *ends)

    def __call__(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells, of which only the first `count` are run."""
        if self.listed:
            values = [axis.values[columns["cell"]] for axis in self.listed]
            numbers, names = ([getattr(axis, key) for axis in self.listed] for key in ("number", "name"))
            job = self._replace(listed=())
            return job(dict(zip(numbers, values, strict=True)), count) | dict(zip(names, values, strict=True))
        size = next((len(values) for values in columns.values()), 1)
        with place_of_jax(size, self.settings.device):
            return self._of_cells(columns, count)

    def _of_cells(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells of a grid, of which only the first `count` are run."""
        if self.by_diffrax and count == 0:
            # Diffrax always computes a whole chunk, so a call only to compile would compute the first chunk twice.
            return {}
        legal = self.model.legal_cells(columns)
        # Without columns, there is one cell.
        legal = None if legal is None else np.atleast_1d(legal)
        if legal is None or legal[:count].all():
            return self._of_legal(columns, count)
        # The legal cells come first, and only they run: with the same program as any others.
        order = np.argsort(~legal | (np.arange(len(legal)) >= count), kind="stable")
        ordered = {name: values[order] for name, values in columns.items()}
        variables = self._of_legal(ordered, int(legal[:count].sum()))
        results, illegal = {}, {"status": self.form.codes[Status.ILLEGAL]}
        for name, values in variables.items():
            # Illegal cells are NaN, or 0 for integers, with the status "illegal".
            values = np.asarray(values)[np.argsort(order)]
            nothing = illegal.get(name, np.nan if np.issubdtype(values.dtype, np.floating) else 0)
            is_legal = legal.reshape(-1, *(1,) * (values.ndim - 1))
            results[name] = np.where(is_legal, values, nothing).astype(values.dtype)
        return results

    def _of_legal(self, columns: Cells, count: int) -> Cells:
        """The variables of some cells, of which only the first `count` are run, which are legal."""
        size = next((len(values) for values in columns.values()), 1)
        cells = self.model.replaced(columns)
        sampled: dict[str, Any] = {}
        if self.samples is not None:
            status, sampled = self.samples.solve(cells, self.t1, size, count, self.settings)
            sampled["status"] = self.form.codes[np.asarray(status)]
        if not self.timed:
            return sampled
        variables = self._results(cells, columns, size, count, self.slopes)
        if self.errors:
            tolerances = map(as_number, other_tolerances(float(self.settings.tolerance)))
            runs = [variables]
            for number, tolerance in enumerate(tolerances, 1):
                job = self._replace(settings=self.settings.with_tolerance(tolerance), nudge=number * NUDGE)
                runs.append(job._results(cells, columns, size, count, None))
            # Where events are located: the error of a component is relative to the largest of its unit.
            ends = self.model.ends
            least: dict[str, float | Float[np.ndarray, " cells"]] = dict.fromkeys(self.bounded, 0.0)
            has_event = (not self.model.smooth) | (variables["status"] != self.form.codes[Status.COMPLETED])
            for name in [name for name in ends if name in least]:
                alike = [np.abs(variables[other]) for other in ends if ends[other].unit == ends[name].unit]
                least[name] = LOCATED * np.where(has_event, np.max(alike, axis=0), 0.0)
            least["end_time"] = 0.0 if self.model.smooth else LOCATED * variables["end_time"]
            variables |= errors_of(runs, least, tuple(self.model.counters), self.form.codes[list(SILENT)])
        return sampled | variables

    def _results(
        self, cells: AbstractModel, columns: Cells, size: int, count: int, slopes: dict[str, str] | None
    ) -> Cells:
        """The variables of one run of every cell."""
        derivatives, grazing, settings = {}, False, self.settings
        if slopes:
            names = tuple(slopes)
            ensemble, tangents, scales = _with_tangents(
                self.model, columns, names, settings.tolerance, size, self.continues
            )
            outcome, along, grazing = ensemble.solve_with_tangents(tangents, self.t1, count, settings)
            derivatives = {
                slopes[name]: np.asarray(slope) / np.asarray(scale)
                for name, slope, scale in zip(names, along, scales, strict=True)
            }
        else:
            ensemble = Ensemble.of(cells, size, settings.tolerance, self.continues).nudged(self.nudge)
            if self.by_diffrax:
                assert ensemble.problem is not None
                outcome = solve_by_diffrax(ensemble.problem, jnp.asarray(self.t1), settings)
            else:
                outcome = ensemble.solve(self.t1, count, settings)
        status, ends = at_the_end(cells, ensemble, outcome, settings.tolerance)
        has_event = np.asarray(status) == Status.EVENT
        variables = {}
        if self.times:
            time: Any = np.where(has_event, outcome.crossing_time, np.inf)
            if self.continues and self.crossing == "first" and isinstance(outcome, Outcome):
                time = outcome.first_crossing
            is_silent = self.form.nan_if_failed & np.isin(status, SILENT)
            variables[self.times[-1]] = np.where(is_silent, np.nan, time)
        ends = ends if self.samples is None else {}
        variables |= jax.tree.map(np.asarray, ends | counted(self.model, outcome))
        variables["status"] = self.form.codes[np.asarray(status)]
        if self.crossing == "both":
            if isinstance(outcome, HybridOutcome):
                # With several modes, the first event needs a separate solve, which ends there.
                variables["first_time"] = first_events(cells, self.t1, size, count, settings, self.nudge)[1]
            else:
                is_unresolved = np.asarray(status) == Status.UNRESOLVED
                variables["first_time"] = np.where(is_unresolved, np.inf, np.asarray(outcome.first_crossing))
        for name, (_, other) in cells.further_times.items():
            if jax.tree.structure(other) == jax.tree.structure(cells) and self.crossing != "last":
                variables[name] = variables[self.times[0]]
            else:
                variables[name] = first_events(other, self.t1, size, count, settings, self.nudge)[1]
        variables |= {name: np.where(has_event, slope, 0.0) for name, slope in derivatives.items()}
        if slopes and not self.model.smooth:
            variables["grazes"] = (has_event & np.asarray(grazing)).astype(np.int8)
        return variables


def first_events(
    cells: AbstractModel, t1: Number, size: int, count: int, settings: Settings, nudge: float = 0.0
) -> tuple[Int[np.ndarray, " cells"], Float[np.ndarray, " cells"], dict[str, Array]]:
    """The `Status` of runs that end on their event, the times of the events, infinite in cells that end otherwise, and the
    variables that describe the ends. **Arguments:** `nudge`: as in `TableJob`."""
    ensemble = Ensemble.of(cells, size, settings.tolerance, False).nudged(nudge)
    outcome = ensemble.solve(t1, count, settings)
    status, ends = at_the_end(cells, ensemble, outcome, settings.tolerance)
    status = np.asarray(status)
    return status, np.where(status == Status.EVENT, outcome.crossing_time, np.inf), ends


# Compiled once for all chunks.
@eqx.filter_jit
def at_the_end(
    cells: AbstractModel, ensemble: Ensemble, outcome: Outcome | HybridOutcome, tolerance: Float[Array, ""]
) -> tuple[Array, dict[str, Array]]:
    """The `Status` of all cells, and the variables that describe their ends."""
    return status_of(cells, ensemble, outcome, tolerance), cells.at_end(outcome, ensemble.starts)


@eqx.filter_jit
def _with_tangents(
    model: AbstractModel, columns: Cells, names: tuple[str, ...], tolerance: Number, size: int, continues: bool
) -> tuple[Ensemble, tuple[Ensemble, ...], list[Float[Array, "..."]]]:
    """The runs of all cells, the tangents along the named parameters, and the scale of each tangent."""

    def build(values: tuple[Array, ...], _: int | None) -> Ensemble:
        moved = model.replaced(columns | dict(zip(names, values, strict=True)))
        return Ensemble.of(moved, size, tolerance, continues)

    cells = model.replaced(columns)
    point = tuple(jnp.asarray(cells.value(name), float) for name in names)
    ensemble, tangents, _ = tangents_by(build, tuple(range(len(names))), point, size)
    return ensemble, tangents, [tangent_scale(value) for value in point]


# Error bounds for a table, from two more runs of each cell at smaller tolerances.

#: Ratio of the tolerance of each run to that of the next. With a pair of eighth order, the second run costs 1.8 times as
#: much as the first, and the third 3.2 times. The error of the second run is mostly a hundredth of that of the first, so the
#: difference of the two is the error of the first. Where both errors happen to be alike, or where functions of events and
#: not the tolerance limit the steps, the third run differs from both. With two runs, 0.05 to 8 % of the bounds of the systems
#: in `tests/nonholonomic/runs/test_error_bounds.py` fail, with the errors of the location of events.
FINER = 100.0

#: Ratio of the bound to the largest difference of the runs. With a ratio of 3, twice as many errors exceed the bound.
SAFETY = 5.0

#: The ratio if the runs do not converge: they differ in the number of events, or the second and third run by more than
#: `CONVERGING` times what the first differs from them. Differences of chaotic runs are those of random histories, and up to
#: 90 times smaller than the error.
SAFETY_OF_HISTORIES, CONVERGING = 100.0, 1.0 / 3.0

#: Relative change of the initial states of the other runs, times their number. Impacts can amplify round-off, of which there is
#: as much in each run, by a factor of 10^7; where the tolerance does not limit the steps, the runs would share it.
NUDGE = 4.0 * float(np.finfo(float).eps)

#: Relative errors: of values that accumulate round-off over thousands of steps; of the ends of runs with events, which are
#: located with it whatever the tolerance; and of differences between runs that are not from the tolerance.
ROUND_OFF, LOCATED, NOISE = 1e-14, 4e-10, 1e-9


def other_tolerances(tolerance: float) -> list[float]:
    """Tolerances of the other runs: each a hundredth of the one before, as far as the integration allows. If it allows no
    smaller tolerance than the first, there is one other run, at a hundred times that tolerance, and the bound is up to a
    hundred times wider."""
    tightest = TIGHTEST if jnp.result_type(float) == jnp.float64 else TIGHTEST_IN_SINGLE
    # Because of rounding, the quotient of 1e-12 may be below the least tolerance.
    if tolerance / FINER <= 0.99 * tightest:
        return [tolerance * FINER]
    second, third = (max(tolerance / FINER**power, tightest) for power in (1, 2))
    return [second, third] if third < 0.2 * second else [second]


def error_bound(
    values: Float[np.ndarray, "runs cells"], agree: Bool[np.ndarray, " cells"], same_history: Bool[np.ndarray, " cells"]
) -> Float[np.ndarray, " cells"]:
    """A bound of the error of a number. `docs/validation.md` lists how often the bound fails and how wide it is.

    **Arguments:**

    - `values`: times [s], infinite if there is no event, or other numbers; from the first run and the others, of which
      there are one or two.
    - `agree`: mask of the cells in which all runs have the same status.
    - `same_history`: mask of the cells in which the numbers of all kinds of events agree.

    **Returns:** the bound, in units of the value: infinite if the runs disagree, 0 if none finds a time.
    """
    is_finite = np.isfinite(values)
    agree = agree & (is_finite == is_finite[0]).all(axis=0)
    first, second, third = np.where(is_finite.all(axis=0), values, 0.0)[[0, 1, -1]]
    gaps = np.abs([first - second, first - third, second - third])
    converges = same_history & (gaps[2] <= np.maximum(CONVERGING * np.min(gaps[:2], axis=0), NOISE * np.abs(first)))
    bound = np.where(converges, SAFETY, SAFETY_OF_HISTORIES) * np.max(gaps, axis=0)
    return np.where(agree, np.maximum(bound, ROUND_OFF * np.abs(first)), np.inf)


def errors_of(
    runs: Sequence[dict[str, Num[np.ndarray, " cells"]]],
    least: Mapping[str, float | Float[np.ndarray, " cells"]],
    counts: tuple[str, ...],
    silent: Sequence[int] | Int[np.ndarray, " codes"],
) -> dict[str, Num[np.ndarray, " cells"]]:
    """The additional variables of a table with errors; their names have the suffix "_error".

    **Arguments:**

    - `runs`: the variables of the first run of every cell and of the others.
    - `least`: name of a variable -> least bound of its error; `counts`: names of the variables that count events.
    - `silent`: status codes of runs without a result; such runs count as disagreeing.

    **Returns:** bounds; for each count the largest difference from the first run; and 1 as `status_error` if the runs
    disagree on the status or are silent.
    """
    stacked = {name: np.stack([run[name] for run in runs]) for name in ("status", *least, *counts)}
    status = runs[0]["status"]
    agree = (stacked["status"] == status).all(axis=0) & ~np.isin(status, silent)
    differences = {name: np.abs(stacked[name] - stacked[name][0]).max(axis=0) for name in counts}
    is_same = np.all([np.ones_like(agree), *(difference == 0 for difference in differences.values())], axis=0)
    bounds = {name: np.fmax(error_bound(stacked[name], agree, is_same), error) for name, error in least.items()}
    errors = bounds | {"status": (~agree).astype(np.int8)} | differences
    return {f"{name}_error": np.asarray(error) for name, error in errors.items()}
