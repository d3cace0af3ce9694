"""Estimate parameters by maximum likelihood, and draw from their posterior.

The exploration of the posterior (`exploration.py`) leaves a mixture of heavy-tailed distributions around all its minima. Each
chain of draws begins at one of the weighted points of the exploration, proposes draws of the mixture, and accepts them by
Metropolis and Hastings' rule, so that its draws come from the posterior itself, whatever the mixture is. Because proposals do
not depend on the chains, the runs of all chains and draws are computed together; a mixture that misses a part of the posterior
shows in few accepted proposals, and in R-hat and ESS (Tierney, Ann. Stat. 22 (1994) 1701).
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..parameters import ByName, full_name
from ..terminal import status_line
from ..text import Unit, counted, in_unit, readable_unit, require_unit, shown, text_as_html
from ..validation import require, require_flag, require_package, require_scalars, require_whole, warn
from ..views import draw_fit
from .conclusions import Distribution, Profile, Verdict, judge, profiled, sentences
from .exploration import ROWS, Explorer, Mixture, Pool, draw_errors
from .posterior import Free, LogDensity, Measurements, Model, predictions
from .recording import AbstractRecording, numbered
from .search import SAME, FitWarning, Identifiability, Minima, identifiability, search

# The result of a fit: estimates, errors, undetermined combinations, and the outcome of every start.

#: The most likely value is stated where it is farther from the estimate than this part of a standard error.
NOTICEABLE = 0.1

#: Decimal places, or zeros before the point, beyond which a number is not written out.
PLACES = 6

#: Number of points of a curve, and the greatest number of predictions for each sample.
POINTS, MOST = 1200, 16

#: Greatest number of rows of the residual table in a summary.
MOST_ROWS = 24


class ResidualRow(NamedTuple):
    """One measurement: its value, its error, the prediction of the fit, the residual (value - prediction) in units of the
    error, and the upper limit (the value itself for a measured value, infinite for a lower limit)."""

    label: str
    value: float
    error: float
    prediction: float
    residual: float
    upper: float

    @property
    def censored(self) -> bool:
        """Whether the measurement is a limit, or a pair of limits."""
        return self.upper > self.value

    @property
    def measured(self) -> str:
        """The measured value or limits, as text."""
        if not self.censored:
            return f" {self.value:.6g} +- {self.error:.2g}"
        if np.isinf(self.upper):
            return f">{self.value:.6g} +- {self.error:.2g}"
        low = "" if np.isneginf(self.value) else f"{self.value:.6g} to "
        return f"{low or '<'}{self.upper:.6g} +- {self.error:.2g}"


@dataclasses.dataclass(frozen=True)
class Identification:
    """Parameters identified from measurements.

    - `estimates`, `standard_errors`: name -> number; the end of a name is enough, as in `estimates["mu"]`. The errors are
      standard deviations over the likelihood times the priors, by importance sampling; they are infinite for a parameter
      that takes part in an undetermined direction, and NaN if the exploration of the likelihood ended early. The estimate
      is the most likely point; if this is more than half a standard error away from the mean, it is a likely point near
      the mean.
    - `covariance`: (unknowns, unknowns), in the order of `estimates`. Parameters with infinite error have covariance 0.
    - `most_likely`, `slope_errors`: name -> number, the point of the greatest likelihood, and the errors by the slopes of the
      predictions there (Gauss-Newton). These errors are wrong where predictions are a staircase.
    - `deviance`: -2 log likelihood of data and priors at the most likely point, up to a constant: the sum of squared
      residuals.
    - `degrees`: measurements and priors less unknowns.
    - `identifiability`: an `Identifiability`; `residuals`: a `ResidualRow` for every measurement.
    - `status`: "converged" or why not; `starts`, `ends`: name -> (starts,), where the refinement of each candidate began and
      ended;
      `end_deviances`: (starts,); `statuses`: "converged", "not_converged" or "failed" for each start.
    - `verdict`: a `Verdict`, whether the fit can be believed.
    - `coordinates`, `coordinate_covariance`: estimates and covariance in the coordinates of the fit.
    - `distribution`: the `Distribution` of the coordinates, with its weighted points.
    - `density`: the `LogDensity` of model and measurements; `density.series_units`: the unit of each series, if known.
    - `units`: name -> unit of a parameter, if known. Texts and pictures show the units of the launch and of the data.

    **Example:** the fit of the subpackage's example.

    >>> fit.status, fit.degrees, list(fit.estimates)
    ('converged', 2, ['rate'])
    """

    estimates: dict[str, float]
    standard_errors: dict[str, float]
    covariance: Float[np.ndarray, "unknowns unknowns"]
    most_likely: dict[str, float]
    slope_errors: dict[str, float]
    deviance: float
    degrees: int
    identifiability: Identifiability
    residuals: tuple[ResidualRow, ...]
    status: str
    starts: dict[str, Float[np.ndarray, " starts"]]
    ends: dict[str, Float[np.ndarray, " starts"]]
    end_deviances: Float[np.ndarray, " starts"]
    statuses: tuple[str, ...]
    verdict: Verdict
    coordinates: Float[np.ndarray, " unknowns"]
    coordinate_covariance: Float[np.ndarray, "unknowns unknowns"]
    distribution: Distribution = dataclasses.field(repr=False)
    density: LogDensity = dataclasses.field(repr=False)
    units: dict[str, str] = dataclasses.field(default_factory=dict)

    def interval(self, name: str, deviations: float = 1.96) -> tuple[float, float]:
        """The central interval of a parameter: the likelihood, times the priors, leaves equal probabilities below and
        above it.

        **Arguments:** `name`: name of the parameter, or the end of its name; `deviations`: half the width in standard
        errors of a normal distribution with the same probability, 1.96 for 95 %, 1 for 68 %.

        **Returns:** the two ends; NaN if the exploration of the likelihood ended early, as the verdict then says.

        **Raises:** `ValueError` for a name that was not free.
        """
        k = self._place(name)
        ends = np.tile(self.coordinates, (2, 1))
        ends[:, k] = self.distribution.interval(k, deviations)
        low, high = self.density.problem.unknowns.values(ends)[:, k].tolist()
        return low, high

    @status_line("fitting again")
    def profile(self, name: str, values: ArrayLike | None = None) -> Profile:
        """The profile likelihood of a parameter: the best likelihood with all other parameters free, for each of its
        values.

        Batches of runs look for the best other parameters, and least squares refine them where the model has slopes.

        **Arguments:**

        - `name`: name of the parameter, or the end of its name.
        - `values`: values at which to hold the parameter, by default 13 in its interval of three standard errors (99.7 %).

        **Returns:** a `Profile`; one that falls below the best fit gives a `FitWarning`.

        **Raises:** `ValueError` for a name that was not free, and for a parameter without a finite error if `values` is
        missing.
        """
        k = self._place(name)
        lower, upper = self.density.problem.unknowns.lower[k], self.density.problem.unknowns.upper[k]
        error = self.standard_errors[self.density.problem.names[k]]
        if values is None and not np.isfinite(error):
            word = "infinite" if np.isinf(error) else "unknown"
            raise ValueError(f"values must be given for {name!r}, whose standard error is {word}")
        held = (
            np.linspace(*self.interval(name, 3.0), 13) if values is None else np.atleast_1d(np.asarray(values, float))
        )
        if not np.all((held > lower) & (held < upper)):
            raise ValueError(f"values = {shown(held)} must lie within the bounds ({lower}, {upper}) of {name!r}")
        profile = profiled(self, k, held)
        best = int(np.argmin(profile.deviance))
        if profile.deviance[best] < -SAME:
            warn(f"the fit is better with {name} = {profile.values[best]:.6g}: start there", FitWarning)
        return profile

    @property
    def curves(self) -> tuple[Float[np.ndarray, "slices n"], Float[np.ndarray, "slices n"]]:
        """Times since the first sample of each recording [s] and predictions, at and between the samples, at the most likely
        point; empty without recordings.

        Every slice has as many samples as the recordings, at times that are shifted by a fraction of the distance to the next
        sample, so that the program of the fit predicts them.
        """
        problem = self.density.problem
        data = getattr(problem.model, "recorded", ())
        recordings = [source for source in data if isinstance(source, AbstractRecording)]
        if not recordings:
            return np.zeros((0, 0)), np.zeros((0, 0))
        coordinates = problem.unknowns.coordinates(np.array(list(self.most_likely.values())))
        count = int(np.clip(np.ceil(POINTS / max(len(source.times) for source in recordings)), 1, MOST))
        slices = []
        for share in np.arange(count) / count:

            def moved(source: AbstractRecording, share: float = share) -> dict[str, np.ndarray]:
                times = np.asarray(source.times)
                last = times[-1] + share * 1e-6 * (times[-1] - times[0])
                return {"times": np.append(times[:-1] + share * np.diff(times), last)}

            shifted = eqx.tree_at(lambda problem: problem.model, problem, problem.model.with_times(moved))
            times = []
            for source, original in zip(shifted.model.recorded, data, strict=True):
                offset = source.times[0] - original.times[0] if isinstance(source, AbstractRecording) else 0.0
                times.append(source.measurements.time + offset)
            slices.append((np.concatenate(times), predictions(shifted, coordinates[None])[0]))
        times, values = zip(*slices, strict=True)
        return np.stack(times), np.stack(values)

    @property
    def correlation(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Correlations of the estimates, in the coordinates of the fit; 0 for estimates with infinite error."""
        errors = np.sqrt(np.diag(self.coordinate_covariance))
        with np.errstate(invalid="ignore"):
            shares = self.coordinate_covariance / np.outer(errors, errors)
        return np.where(np.eye(len(errors), dtype=bool), 1.0, np.where(np.isfinite(shares), shares, 0.0))

    @status_line("drawing")
    def plot(self, unit: str | Sequence[str] | None = None) -> Any:
        """Data and model, residuals, the distributions of up to six parameters with estimates and 95 % intervals, and the
        correlations (needs matplotlib).

        **Arguments:** `unit`: unit to draw in, such as "deg" for all angles, or several, such as ("deg", "rpm"); by default
        those of the launch and of the data.

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for an unknown unit.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        sources = getattr(self.density.problem.model, "recorded", ())
        labels = [source.labels_in(unit or self.density.unit) for source in sources]
        labels = labels or [[row.label for row in self.residuals]]
        return draw_fit(self, numbered(labels), unit)

    def _place(self, name: str) -> int:
        valid = list(self.estimates)
        return valid.index(full_name("name", name, valid))

    def rows_in(self, unit: Unit = None) -> list[tuple[ResidualRow, str, float]]:
        """The residuals in the unit that is shown, this unit, and the factor that converts to it. **Arguments:** `unit`: as for
        `plot`."""
        rows, units = [], dict(enumerate(self.density.series_units))
        for row, number in zip(self.residuals, self.density.measurements.series.tolist(), strict=True):
            text, factor = in_unit(units.get(number, "1"), unit or self.density.series_shown[number : number + 1])
            numbers = {name: factor * getattr(row, name) for name in ("value", "error", "prediction", "upper")}
            rows.append((row._replace(**numbers), text, factor))
        return rows

    _repr_html_ = text_as_html

    def __str__(self) -> str:
        """Values with their 95 % intervals, whether to believe them, and what to do."""
        lines = [
            f"Identification of {counted(len(self.estimates), 'number')} from "
            f"{counted(len(self.residuals), 'measurement')}: {self.status}"
        ]
        width = max(map(len, self.estimates))
        for name in self.estimates:
            unit, factor = in_unit(self.units.get(name, "1"), self.density.unit)
            estimate, low, high = self.rounded(name, factor)
            interval = "undetermined" if np.isinf(self.standard_errors[name]) else "no interval"
            if np.isfinite(self.standard_errors[name]):
                likely = self.most_likely[name]
                differs = abs(likely - self.estimates[name]) > NOTICEABLE * self.standard_errors[name]
                interval = f"95 %: {low} to {high}" + differs * f"; most likely {factor * likely:.4g}"
            lines.append(f"  {name:{width}}  {f'{estimate} {readable_unit(unit)}'.rstrip()}  ({interval})")
        return "\n".join([*lines, f"verdict: {self.verdict}", "the statistics: print(fit.details)"])

    def rounded(self, name: str, factor: float = 1.0) -> tuple[str, str, str]:
        """The estimate of a parameter and the ends of its 95 % interval, to two digits of the distance to the farther end.

        **Arguments:** `name`: name of the parameter, or the end of its name; `factor`: from its unit to the one that is shown.
        """
        numbers = factor * np.array([list(self.estimates.values())[self._place(name)], *self.interval(name)])
        reach = np.max(np.abs(numbers - numbers[0]))
        form, places = ".4g", 15
        if 0.0 < reach < np.inf:
            places = 1 - math.floor(math.log10(reach))
            form = f".{max(places, 0)}f" if abs(places) <= PLACES else ".15g"
        estimate, low, high = (f"{round(number, places) + 0.0:{form}}" for number in numbers.tolist())
        return estimate, low, high

    @property
    def details(self) -> str:
        """The statistics behind the verdict, estimates with standard errors, the combinations of parameters that the data
        determine, and the residuals."""
        verdict, p_value, count = self.verdict, self.verdict.p_value, self.verdict.starts
        lines = [
            f"-2 log likelihood {self.deviance:.4g} at the most likely values, {self.degrees} degrees of freedom",
            *([] if math.isnan(p_value) else [f"residuals this large have a probability of {p_value:.2g}"]),
            *(f"{order.runs} runs of {order.count} signs (p = {order.p_value:.2g})" for order in verdict.series),
            f"{verdict.agree} of {count} refined candidates ended at the best minimum"
            + (", the others fit worse or were stopped early" if verdict.agree < count else ""),
            f"{verdict.effective:.0f} effective draws (k-hat {verdict.k:.2f})",
            *(f"note: {note}" for note in (*verdict.caveats, *verdict.notes)),
            "estimates, standard errors, most likely values",
        ]
        width = max(map(len, self.estimates))
        for name, value in self.estimates.items():
            _, factor = in_unit(self.units.get(name, "1"), self.density.unit)
            error, likely = factor * self.standard_errors[name], self.most_likely[name]
            written = self.density.written(name, likely, form=".6g")
            lines.append(f"  {name:{width}}  {factor * value:.6g} +- {error:.2g}, {written}")
        lines.append("combinations of parameters and their relative errors")
        for value, words in zip(self.identifiability.singular_values, self.identifiability.words, strict=True):
            mark = "  UNDETERMINED" if words in self.identifiability.unseen else ""
            lines.append(f"  {1.0 / max(value, 1e-300):8.2g}  {words}{mark}")
        lines.append("measured, predicted at the most likely values, measured - predicted in standard errors")
        width = max(len(row.label) for row in self.residuals)
        for row, unit, _ in self.rows_in()[:MOST_ROWS]:
            predicted = f"{row.prediction:.6g} {readable_unit(unit)}".rstrip()
            lines.append(f"  {row.label:{width}}  {row.measured:20}  {predicted}  {row.residual:+.2f}")
        if len(self.residuals) > MOST_ROWS:
            largest = max(self.residuals, key=lambda row: abs(row.residual))
            lines.append(
                f"  and {len(self.residuals) - MOST_ROWS} more; largest {largest.label} {largest.residual:+.2f}"
            )
        return "\n".join(lines)


def summarise(labels: tuple[str, ...], ends: Minima, explorer: Explorer, sample: Pool) -> Identification:
    """The result of a search and an exploration: the best fit, errors and intervals, and a record of all ends."""
    problem, best, measurements, count = ends.density.problem, ends.best, ends.density.measurements, len(labels)
    deviances, linearised, optimum = ends.deviance, ends.linearised, ends.coordinates[ends.best]
    statuses = tuple(
        "failed" if np.isinf(deviance) else "converged" if has_converged else "not_converged"
        for deviance, has_converged in zip(deviances, ends.converged, strict=True)
    )
    # The slopes of the parameters with respect to their coordinates.
    slopes = np.asarray(eqx.filter_jit(jax.jvp)(problem.unknowns.values, (optimum,), (np.ones_like(optimum),))[1])
    by_slopes = ends.covariance(best)
    # An undetermined number has an infinite variance, and its slope may vanish at a bound.
    with np.errstate(invalid="ignore"):
        slope_errors = np.sqrt(np.diag(by_slopes) * slopes**2)
    distribution = Distribution.of(optimum, by_slopes, sample)
    likely, covariance = problem.unknowns.values(optimum), distribution.covariance_of_values(problem, slopes)
    numbers = (measurements.value, measurements.error, linearised.prediction[best], -linearised.residual[best, :count])
    table = zip(labels, *(np.asarray(part).tolist() for part in (*numbers, measurements.upper)), strict=True)
    combinations = identifiability(ends.density, likely, slopes, linearised.information[best, :count])
    # Where the weights hold, a search by slopes that got stuck on a stair, or ended early, does not matter.
    status = "converged" if distribution.kind in ("weights", "linear") else statuses[best]

    def by_name(numbers: Sequence[Any] | np.ndarray) -> dict[str, Any]:
        return ByName(zip(problem.names, numbers, strict=True))

    return Identification(
        estimates=by_name(problem.unknowns.values(distribution.estimate).tolist()),
        standard_errors=by_name(np.sqrt(np.diag(covariance)).tolist()),
        covariance=covariance,
        most_likely=by_name(likely.tolist()),
        slope_errors=by_name(slope_errors.tolist()),
        deviance=float(deviances[best]),
        degrees=linearised.residual.shape[1] - len(likely),
        identifiability=combinations,
        residuals=tuple(ResidualRow(*row) for row in table),
        status=status,
        starts=by_name(problem.unknowns.values(ends.starts).T),
        ends=by_name(problem.unknowns.values(ends.coordinates).T),
        end_deviances=deviances,
        statuses=statuses,
        verdict=judge(labels, ends, explorer, sample, distribution, combinations.unseen, status),
        coordinates=distribution.estimate,
        coordinate_covariance=distribution.covariance,
        distribution=distribution,
        density=ends.density,
        units={name: unit for name, unit in ends.density.units.items() if name in problem.names},
    )


# Estimate parameters by maximum likelihood, with errors and undetermined combinations.


def identify(
    model: Model,
    measurements: Measurements,
    free: Mapping[str, Free | float],
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    max_steps: int = 60,
    slopes: str = "exact",
    labels: tuple[str, ...] | None = None,
    progress: bool = True,
) -> Identification:
    """Find the parameters of a model that make measurements most likely, and how far the measurements determine them.

    The search has three steps, all in batches. It compares quasi-random candidates in a region around the start values, 64
    for a single unknown (128 for recordings) and up to 512 for several, refines the best by Levenberg-Marquardt
    (`search.py`), and explores the likelihood around all minima by adaptive importance sampling (`exploration.py`), until
    errors and intervals rest on at least 400 effective draws. Slopes make the search fast; they do not enter errors and
    intervals unless the likelihood is that of a linear model.

    **Arguments:**

    - `model`: function from parameters, name -> (rows,), to predictions (rows, n); `jax.vmap` converts a function of
      one set of parameters. With exact `slopes`, JAX differentiates the model in forward mode. A row of NaN may give NaN.
    - `measurements`: `Measurements` of shape (n,).
    - `free`: name -> a `Free`, or only the start value.
    - `starts`: greatest number of candidates that are refined.
    - `spread`: how far from its start value an unknown with one bound is searched, as a factor greater than 1 in either
      direction. Priors and two bounds take precedence. A number of a launch is searched within 10 %, and `t0` within 2 % of
      the duration of the recording. Refinement and exploration may leave this region.
    - `seed`: seed of candidates and draws.
    - `max_steps`: a refinement that needs more steps has not converged.
    - `slopes`: "exact", by automatic differentiation; or "differences", central differences in every parameter (of 1 %,
      for recordings of 0.03 %), for a model whose derivative does not exist or is not smooth. Errors and intervals are the
      same.
    - `labels`: (n,), names of the measurements in the result.
    - `progress`: whether to show progress, on a terminal or in a notebook.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range.

    **Example:** the half-life of a decay.

    >>> import numpy as np
    >>> from nonholonomic.identification import Measurements, identify
    >>> times = np.array([1.0, 2.0, 3.0, 4.0])
    >>> counts = Measurements([505.0, 248.0, 127.0, 61.0], [22.0, 16.0, 11.0, 8.0])
    >>> def model(p):
    ...     return p["start"][:, None] * 0.5 ** (times / p["half_life"][:, None])
    >>> fit = identify(model, counts, {"start": 800.0, "half_life": 1.5}, progress=False)
    >>> print(f"{fit.estimates['half_life']:.2f} +- {fit.standard_errors['half_life']:.2f}, good: {fit.verdict.good}")
    0.99 +- 0.05, good: True
    """
    check_search(starts, spread, seed, max_steps, progress)
    if not isinstance(measurements, Measurements) or measurements.value.ndim != 1:
        raise ValueError(f"measurements = {shown(measurements)} must be Measurements of shape (n,)")
    count = measurements.value.size
    labels = tuple(f"#{i + 1}" for i in range(count)) if labels is None else tuple(labels)
    if len(labels) != count:
        raise ValueError(f"labels must be {count}, one for each measurement, not {len(labels)}")
    with status_line("fitting", progress):
        density = LogDensity.of(model, measurements, free, slopes=slopes)
        return most_likely(density, labels, starts, spread, seed, max_steps)


def most_likely(
    density: LogDensity, labels: tuple[str, ...], starts: int, spread: float, seed: int, max_steps: int
) -> Identification:
    """The parameters of greatest density. **Arguments:** as for `identify`, checked."""
    explorer, minima, sample = search(Explorer.of(density, spread, seed), starts, max_steps)
    result = summarise(labels, minima, explorer, sample)
    if not result.verdict.good:
        warn("; ".join(result.verdict.concerns), FitWarning)
    return result


def check_search(starts: int, spread: float, seed: int, max_steps: int, progress: bool) -> None:
    """Raise `ValueError` unless the arguments are legal for `identify`; a model checks them before it prepares its
    data."""
    for name, value, lower in (("starts", starts, 1), ("seed", seed, 0), ("max_steps", max_steps, 1)):
        require_whole(value, name, lower)
    if starts > ROWS:
        raise ValueError(f"starts = {starts} must be at most {ROWS}, the number of candidates")
    require(spread, "spread", above=1.0)
    require_scalars({"spread": spread}, "it spreads the starts of all parameters")
    require_flag(progress, "progress")


# Draws from the posterior.

#: Number of proposals for each draw.
MOVES = 2

#: Options of the search: range, refined candidates, and their steps.
SPREAD, STARTS, STEPS = 2.0, 16, 60

#: Draws are from a posterior only if at least this fraction of the proposals is accepted, and if every unknown has at least
#: this many effective draws for each chain.
LEAST_ACCEPTED, LEAST_ESS = 0.02, 50.0

#: Draws are far less probable than the start if its log density exceeds their median by more than this and 1 for each unknown;
#: the most probable point exceeds the median of a normal distribution by about 0.5 for each unknown.
FAR_BELOW = 10.0


#: The coordinates of draws.
Chains = Float[np.ndarray, "chains draws unknowns"]


class Draws(NamedTuple):
    """Draws from a posterior.

    - `values`: name -> (chains, draws), where the end of a name is enough; `coordinates`: (chains, draws, unknowns).
    - `r_hat`, `ess`: name -> number: the potential scale reduction, which should be below 1.01, and the effective number of
      independent draws.
    - `units`: name -> unit, if known.
    - `accepted`: fraction of accepted proposals; `runs`: number of parameter sets for which the model ran.
    - `flaws`: why the draws are not from the posterior, in words; empty if they are, as `good` says. `concerns`: what else to
      check.

    **Example:** as for `sample`.

    >>> from nonholonomic.identification import Draws
    >>> Draws._fields[:3]
    ('values', 'coordinates', 'r_hat')
    """

    values: dict[str, Float[np.ndarray, "chains draws"]]
    coordinates: Chains
    r_hat: dict[str, float]
    ess: dict[str, float]
    accepted: float
    runs: int
    units: dict[str, str]
    flaws: tuple[str, ...] = ()
    concerns: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether the draws can be used as those of a posterior."""
        return not self.flaws

    @classmethod
    def of(cls, density: LogDensity, coordinates: Chains, accepted: float, runs: int, excess: float = 0.0) -> "Draws":
        """Draws at given coordinates, with diagnostics. **Arguments:** `excess`: of the log density at the start over the
        median of the draws."""
        values = ByName((name, np.asarray(value)) for name, value in density.values(jnp.asarray(coordinates)).items())
        # For a single unknown, the diagnostics are numbers instead of lists.
        diagnostics = (np.ravel(numbers).tolist() for numbers in _diagnosed(coordinates))
        r_hat, ess = (ByName(zip(density.names, numbers, strict=True)) for numbers in diagnostics)
        chains = len(coordinates)
        name, least = min(ess.items(), key=lambda item: item[1] if item[1] > 0.0 else 0.0)
        flaws = sentences(
            (
                accepted < LEAST_ACCEPTED,
                f"only {100.0 * accepted:.2g} % of the proposals were accepted: start closer, or state priors or bounds that "
                "contain the truth",
            ),
            # The ESS of chains that never move is not a number.
            (
                not least >= LEAST_ESS * chains,
                f"the ESS of {name} is {least:.0f}, below {LEAST_ESS:.0f} for each of {chains} chains: ask for more draws",
            ),
        )
        concerns = sentences(
            (
                excess > FAR_BELOW + len(ess),
                f"the start is more probable than the draws, by a factor of exp({excess:.4g}): the search missed its "
                "surroundings; start closer, state priors or bounds, or pass the coordinates of a fit",
            )
        )
        return cls(values, coordinates, r_hat, ess, accepted, runs, density.units, flaws, concerns)

    def __str__(self) -> str:
        width = max(map(len, self.values))
        chains, draws = next(iter(self.values.values())).shape
        lines = [f"{chains} chains of {draws} draws, {100.0 * self.accepted:.0f} % accepted, {self.runs} runs"]
        for name, value in self.values.items():
            low, middle, high = np.quantile(value, (0.025, 0.5, 0.975))
            interval = f"{middle:.6g}  ({low:.6g}, {high:.6g})" if self.good else "no interval"
            quality = f"R-hat {self.r_hat[name]:.4f}, ESS {self.ess[name]:.0f}"
            unit = f" {readable_unit(self.units[name])}" if name in self.units else ""
            lines.append(f"  {name:{width}}  {interval}{unit}  {quality}")
        lines += [f"  NO POSTERIOR: {flaw}" for flaw in self.flaws] + [f"  BUT {concern}" for concern in self.concerns]
        return "\n".join(lines)


def sample(
    density: LogDensity,
    centre: ArrayLike | None = None,
    covariance: ArrayLike | None = None,
    *,
    chains: int = 4,
    warmup: int = 25,
    draws: int = 500,
    seed: int = 0,
    progress: bool = True,
) -> Draws:
    """Draw from a posterior, with all its minima.

    **Arguments:**

    - `density`: a `LogDensity`.
    - `centre`, `covariance`: (unknowns,), (unknowns, unknowns), the `coordinates` and `coordinate_covariance` of an
      `Identification`, which make the search faster; `None` without a fit.
    - `chains`: number of chains, at least 2, because R-hat compares chains; `warmup`, `draws`: number of draws of each
      chain that are discarded and kept; `seed`.
    - `progress`: whether to show progress, on a terminal or in a notebook.

    **Returns:** `Draws`. If hardly a proposal was accepted, or if an unknown has an ESS below 50 for each chain, these are not
    draws from the posterior: `draws.good` is false, `draws.flaws` says why, and a `FitWarning` is given, also for draws that
    are far less probable than the start.

    **Raises:** `ValueError` for arguments out of range, and `ModuleNotFoundError` without BlackJAX, whose diagnostics it uses.

    **Example:** the rate of the subpackage's example.

    >>> from nonholonomic.identification import sample
    >>> draws = sample(LogDensity.of(decay, measured, free), draws=200, progress=False)
    >>> print(f"{draws.values['rate'].mean():.2f}")
    1.00
    """
    require_package("blackjax", "bayes", "sample")
    for name, value, lower in (("chains", chains, 2), ("warmup", warmup, 0), ("draws", draws, 2), ("seed", seed, 0)):
        require_whole(value, name, lower)
    require_flag(progress, "progress")
    known = None
    if centre is not None:
        # A component around a fit.
        numbers, covariance = len(density.problem.names), np.asarray(covariance, float)
        if covariance.shape != (numbers, numbers) or not np.all(np.isfinite(covariance)):
            raise ValueError(
                f"covariance must be finite and of shape {(numbers, numbers)}: the data do not determine all numbers"
            )
        if np.shape(centre) != (numbers,):
            raise ValueError(f"centre = {shown(centre)} must be of shape {(numbers,)}")
        known = Mixture(np.ones(1), np.asarray(centre, float)[None], np.linalg.cholesky(covariance)[None])
    with status_line("sampling", progress):
        outcome = drawn(density, known, (chains, MOVES * warmup, draws), seed)
    with status_line("diagnosing the draws", progress):
        posterior = Draws.of(density, *outcome)
    if words := (*(f"these are no draws from the posterior: {flaw}" for flaw in posterior.flaws), *posterior.concerns):
        warn("; ".join(words), FitWarning)
    return posterior


def drawn(
    density: LogDensity, known: Mixture | None, sizes: tuple[int, int, int], seed: int
) -> tuple[Chains, float, int, float]:
    """Coordinates of draws, the fraction of accepted proposals, the number of runs, and the excess of the log density at the
    start over the median of the draws.

    **Arguments:** `known`: a component around a fit, or `None`; `sizes`: numbers of chains, of steps before the first
    draw, and of draws; the others as for `sample`.
    """
    chains, discarded, draws = sizes
    explorer, random = Explorer.of(density, SPREAD, seed), np.random.default_rng(seed)
    explorer, minima, explored = search(explorer, STARTS, STEPS)
    components = minima.components
    if known is not None:
        components = known if components is None else components.joined(known, 0.5)
    proposal = explorer.proposal(explored, components)
    steps = discarded + MOVES * draws
    first = explored.points[random.choice(len(explored.weights), chains, p=explored.weights)]
    start = np.asarray(density.start)[None, : len(density.problem.names)]
    points = np.concatenate([first, proposal.draw(chains * steps, random)])
    every = np.concatenate([points, start])
    parts = [explorer.compared(every[first : first + ROWS]) for first in range(0, len(every), ROWS)]
    predictions, log_density = (np.concatenate([part[k] for part in parts]) for k in (1, 4))
    order = random.permutation(np.arange(chains, len(points))).reshape(steps, chains)
    # The chains begin at the first points; the index of the point of every chain after each step.
    state, path, accepted = np.arange(chains), np.empty(order.shape, int), 0.0
    ratios = log_density[:-1] - proposal.log_density(points)
    ratios = np.where(np.isfinite(ratios), ratios, -np.inf)
    for step, proposed in enumerate(order):
        accept = np.log(random.uniform(size=chains)) < ratios[proposed] - ratios[state]
        state = np.where(accept, proposed, state)
        path[step] = state
        accepted += float(np.mean(accept)) / len(order)
    kept = path[discarded + MOVES - 1 :: MOVES].T.reshape(-1)
    errors = draw_errors(density.measurements, predictions[kept], random)
    coordinates = np.concatenate([points[kept], errors], axis=1).reshape(chains, draws, -1)
    excess = float(log_density[-1] - np.median(log_density[kept]))
    return coordinates, accepted, len(explored.weights) + len(points), excess


@jax.jit
def _diagnosed(coordinates: Float[Array | np.ndarray, "chains draws unknowns"]) -> tuple[Array, Array]:
    """The potential scale reduction and the effective sample size of every unknown."""
    from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

    return potential_scale_reduction(coordinates), effective_sample_size(coordinates)
