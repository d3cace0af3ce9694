"""Estimate parameters by maximum likelihood, and the result of a fit."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ..parameters import ByName, full_name
from ..terminal import status_line
from ..text import counted, readable_unit, require_unit, shown, text_as_html
from ..validation import require, require_flag, require_package, require_scalars, require_whole, warn
from ..views import draw_fit
from .conclusions import (
    CLOSE,
    SAME,
    Distribution,
    FitWarning,
    Minimum,
    Profile,
    Verdict,
    judge,
    minima_of,
    profiled,
    remarks,
    unsearched,
    without_prediction,
)
from .exploration import ROWS, Explorer, Weighted
from .least_squares import Identifiability, Minima, identifiability
from .likelihood import Measurements, as_free, joined_data, numbered
from .posterior import LogDensity, Problem, predictions
from .recording import AbstractRecording
from .sampling import search

# The result of a fit: estimates, errors, undetermined combinations, and the outcome of every start.

#: The most likely value is stated where it is farther from the estimate than this part of a standard error.
NOTICEABLE = 0.1

#: Greatest number of rows of the residual table in a summary.
MOST_ROWS = 24


class ResidualRow(NamedTuple):
    """One measurement: its value, its error, the prediction of the fit, the residual in units of the error, and the
    upper limit (the value itself for a measured value, infinite for a lower limit)."""

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
    - `series_units`: the unit of each series of the measurements, if known; `units`: name -> unit of a parameter, if known.
    - `profiles`: index of a parameter -> its profile, once it has been computed.

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
    problem: Problem = dataclasses.field(repr=False)
    measurements: Measurements = dataclasses.field(repr=False)
    explorer: Explorer = dataclasses.field(repr=False)
    series_units: tuple[str, ...] = ()
    units: dict[str, str] = dataclasses.field(default_factory=dict)
    profiles: dict[int, Profile] = dataclasses.field(default_factory=dict, repr=False)

    def interval(self, name: str, deviations: float = 1.96) -> tuple[float, float]:
        """The central interval of a parameter: the likelihood, times the priors, leaves equal probabilities below and
        above it.

        **Arguments:** `name`: name of the parameter, or the end of its name; `deviations`: half the width in standard
        errors of a normal distribution with the same probability, 1.96 for 95 %, 1 for 68 %.

        **Returns:** the two ends; NaN if the exploration of the likelihood ended early, as the verdict then says.

        **Raises:** `ValueError` for a name that was not free.
        """
        k = self._place(name)
        with np.errstate(over="ignore"):
            ends = self.problem.unknowns[k].value(np.array(self.distribution.interval(k, deviations)))
        return float(ends[0]), float(ends[1])

    @status_line("fitting again")
    def profile(self, name: str, values: Any = None) -> Profile:
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
        if values is not None:
            return self._profiled(k, name, values)
        if k not in self.profiles:
            error = self.standard_errors[self.problem.names[k]]
            if not np.isfinite(error):
                word = "infinite" if np.isinf(error) else "unknown"
                raise ValueError(f"values must be given for {name!r}, whose standard error is {word}")
            self.profiles[k] = self._profiled(k, name, np.linspace(*self.interval(name, 3.0), 13))
        return self.profiles[k]

    def _profiled(self, k: int, name: str, values: Any) -> Profile:
        """The profile of the parameter with index `k`, which the user calls `name`."""
        free, values = self.problem.unknowns[k], np.atleast_1d(np.asarray(values, float))
        if not np.all((values > free.lower) & (values < free.upper)):
            raise ValueError(
                f"values = {shown(values)} must lie within the bounds ({free.lower}, {free.upper}) of {name!r}"
            )
        profile = profiled(self, k, values)
        if concern := profile.concern(name):
            warn(concern, FitWarning)
        return profile

    @property
    def curves(self) -> tuple[Float[np.ndarray, "slices n"], Float[np.ndarray, "slices n"]]:
        """Times since the first sample of each recording [s] and predictions, at and between the samples, at the most likely
        point; empty without recordings."""
        pairs = zip(self.problem.unknowns, self.most_likely.values(), strict=True)
        return fine_predictions(self.problem, np.array([float(unknown.coordinate(value)) for unknown, value in pairs]))

    @property
    def correlation(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Correlations of the estimates, in the coordinates of the fit; 0 for estimates with infinite error."""
        errors = np.sqrt(np.diag(self.coordinate_covariance))
        with np.errstate(invalid="ignore"):
            shares = self.coordinate_covariance / np.outer(errors, errors)
        return np.where(np.eye(len(errors), dtype=bool), 1.0, np.where(np.isfinite(shares), shares, 0.0))

    @status_line("drawing")
    def plot(self, unit: str | Sequence[str] | None = None) -> Any:
        """Data and model, residuals, the profile likelihood of every parameter with its estimate and 95 % interval, and the
        correlations (needs matplotlib).

        **Arguments:** `unit`: unit to draw in, such as "deg" for all angles, or several, such as ("deg", "rpm").

        **Returns:** a matplotlib figure.

        **Raises:** `ValueError` for an unknown unit.
        """
        require_package("matplotlib", "plot", "plot")
        require_unit(unit)
        return draw_fit(self, self._labels(unit), unit)

    def _labels(self, unit: Any) -> tuple[str, ...]:
        """Short names of the measurements for a picture."""
        sources = getattr(self.problem.model, "recorded", ())
        if not sources:
            return tuple(row.label for row in self.residuals)
        return numbered([source.labels_in(unit) for source in sources])

    def _place(self, name: str) -> int:
        valid = list(self.estimates)
        return valid.index(full_name("name", name, valid))

    def _repr_html_(self) -> str:
        return text_as_html(str(self))

    def __str__(self) -> str:
        lines = [
            f"Identification of {counted(len(self.estimates), 'number')} from "
            f"{counted(len(self.residuals), 'measurement')}: {self.status}",
            f"  -2 log likelihood {self.deviance:.4g} at the most likely values, {self.degrees} degrees of freedom",
            "verdict",
            str(self.verdict),
            "estimates, standard errors and 95 % intervals",
        ]
        width = max(map(len, self.estimates))
        for name, value in self.estimates.items():
            low, high = self.interval(name)
            unit = readable_unit(self.units.get(name, "1"))
            error, likely = self.standard_errors[name], self.most_likely[name]
            text = f"{value:.6g} +- {error:.2g}  ({low:.6g}, {high:.6g}) {unit}".rstrip()
            # The estimate is another point where the most likely one is far from the mean.
            differs = abs(value - likely) > NOTICEABLE * error
            lines.append(f"  {name:{width}}  {text}{f', most likely {likely:.6g}' if differs else ''}")
        lines.append("combinations of parameters and their relative errors")
        for value, words in zip(self.identifiability.singular_values, self.identifiability.words, strict=True):
            mark = "  UNDETERMINED" if words in self.identifiability.unseen else ""
            lines.append(f"  {1.0 / max(value, 1e-300):8.2g}  {words}{mark}")
        lines.append("measured, predicted at the most likely values, residual in standard errors")
        width = max(len(row.label) for row in self.residuals)
        for row in self.residuals[:MOST_ROWS]:
            lines.append(f"  {row.label:{width}}  {row.measured:20}  {row.prediction:.6g}  {row.residual:+.2f}")
        if len(self.residuals) > MOST_ROWS:
            largest = max(self.residuals, key=lambda row: abs(row.residual))
            lines.append(
                f"  and {len(self.residuals) - MOST_ROWS} more; largest {largest.label} {largest.residual:+.2f}"
            )
        return "\n".join(lines)


def summarise(
    problem: Problem, labels: tuple[str, ...], ends: Minima, explorer: Explorer, sample: Weighted
) -> Identification:
    """The result of a search and an exploration: the best fit, errors and intervals, and a record of all ends."""
    names, best, measurements = problem.names, ends.best, ends.measurements
    deviances, linearised = ends.deviance, ends.linearised
    statuses = tuple(
        "failed" if np.isinf(deviance) else "converged" if has_converged else "not_converged"
        for deviance, has_converged in zip(deviances, ends.converged, strict=True)
    )
    optimum, by_slopes = ends.coordinates[best], ends.covariance(best)
    distribution = Distribution.of(optimum, by_slopes, sample)
    values, start_values, likely, estimates = (
        np.asarray(problem.values(np.asarray(points)))
        for points in (ends.coordinates, ends.starts, optimum, distribution.estimate)
    )
    slopes = problem.slopes(optimum)
    covariance = distribution.covariance_of_values(problem, slopes)
    prediction, residual = linearised.prediction[best], linearised.residual[best]
    numbers = (measurements.value, measurements.error, prediction, residual, measurements.upper)
    table = zip(labels, *(np.asarray(part).tolist() for part in numbers), strict=True)
    combinations = identifiability(problem, likely, slopes, linearised.information[best])
    priors, limits = linearised.prior.shape[-1], int(np.sum(np.asarray(measurements.censored)))
    degrees = len(labels) + priors - len(names)
    # Where the weights hold, a search by slopes that got stuck on a stair does not matter.
    status = "converged" if distribution.kind == "weights" else statuses[best]
    minima, concerns, notes = _shape(explorer, sample, distribution, by_slopes)
    explored = Verdict(
        p_value=math.nan,
        series=(),
        agree=agreement(ends.coordinates, deviances, by_slopes, best),
        starts=len(deviances),
        undetermined=combinations.unseen,
        concerns=concerns,
        notes=notes,
        effective=sample.effective,
        k=sample.k,
        minima=minima,
    )
    trusted = distribution.kind != "none"
    with np.errstate(invalid="ignore"):
        slope_covariance = np.where(by_slopes == 0.0, 0.0, by_slopes * np.outer(slopes, slopes))

    def by_name(numbers: np.ndarray) -> dict[str, Any]:
        return ByName(zip(names, numbers.tolist() if numbers.ndim == 1 else numbers, strict=True))

    return Identification(
        estimates=by_name(estimates),
        standard_errors=by_name(np.sqrt(np.diag(covariance))),
        covariance=covariance,
        most_likely=by_name(likely),
        slope_errors=by_name(np.sqrt(np.diag(slope_covariance))),
        deviance=float(deviances[best]),
        degrees=degrees,
        identifiability=combinations,
        residuals=tuple(ResidualRow(*row) for row in table),
        status=status,
        starts=by_name(start_values.T),
        ends=by_name(values.T),
        end_deviances=deviances,
        statuses=statuses,
        verdict=judge(measurements, prediction, residual, degrees - limits, status, trusted, explored),
        coordinates=distribution.estimate,
        coordinate_covariance=distribution.covariance,
        distribution=distribution,
        problem=problem,
        measurements=measurements,
        explorer=explorer,
    )


def _shape(
    explorer: Explorer, sample: Weighted, distribution: Distribution, by_slopes: np.ndarray
) -> tuple[tuple[Minimum, ...], tuple[str, ...], tuple[str, ...]]:
    """The minima that the data allow, and concerns and notes about the shape of the likelihood."""
    concerns, notes = without_prediction(explorer, sample, distribution)
    notes = (*unsearched(explorer, distribution.estimate), *notes)
    if distribution.kind != "weights":
        return (), concerns, notes
    further, others = remarks(explorer, sample, distribution, by_slopes)
    return minima_of(explorer, sample), (*concerns, *further), (*notes, *others)


def agreement(
    ends: Float[np.ndarray, "starts unknowns"],
    deviances: Float[np.ndarray, " starts"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    best: int,
) -> int:
    """The number of ends that are at the best minimum."""
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        distances = np.abs(ends - ends[best]) / errors
    # Parameters of infinite error are ignored: their value does not matter.
    is_close = np.all(np.where(np.isfinite(errors), distances, 0.0) < CLOSE, axis=1) | (
        deviances < deviances[best] + SAME
    )
    return int(np.sum(is_close & (deviances < deviances[best] + 1.0)))


# Predictions of a fit between the samples of its recordings, to be drawn as curves.

#: Number of points of a curve, and the greatest number of predictions for each sample.
POINTS, MOST = 1200, 16


def fine_predictions(
    problem: Problem, coordinates: Float[np.ndarray, " unknowns"]
) -> tuple[Float[np.ndarray, "slices n"], Float[np.ndarray, "slices n"]]:
    """Times and predictions at and between the samples of all recordings, and other predictions, for the coordinates of a fit.

    Every slice has as many samples as the recordings, at times that are shifted by a fraction of the distance to the next
    sample, so that the program of the fit predicts them. Without recordings there are no slices.

    **Returns:** times since the first sample of each recording [s], and predictions.
    """
    data = getattr(problem.model, "recorded", ())
    sizes = [len(source.times) for source in data if isinstance(source, AbstractRecording)]
    if not sizes:
        return np.zeros((0, 0)), np.zeros((0, 0))
    count = int(np.clip(np.ceil(POINTS / max(sizes)), 1, MOST))
    slices = []
    for k in range(count):
        shifted = tuple(_shifted(source, k / count) for source in data)
        moved = eqx.tree_at(lambda problem: problem.model, problem, problem.model.with_recorded(shifted))
        offsets = [
            float(new.times[0] - old.times[0]) if isinstance(old, AbstractRecording) else 0.0
            for new, old in zip(shifted, data, strict=True)
        ]
        offset = np.repeat(offsets, [len(source.seen) for source in data])
        slices.append((np.asarray(joined_data(shifted)[0].time) + offset, predictions(moved, coordinates[None])[0]))
    times, values = zip(*slices, strict=True)
    return np.stack(times), np.stack(values)


def _shifted(recording: Any, share: float) -> Any:
    """A recording at times that are moved by a share of the distance to the next sample, where the last sample stays; other
    data unchanged."""
    if not isinstance(recording, AbstractRecording):
        return recording
    times = np.asarray(recording.times)
    moved = np.append(times[:-1] + share * np.diff(times), times[-1] + share * 1e-6 * (times[-1] - times[0]))
    return dataclasses.replace(recording, times=moved)


# Estimate parameters by maximum likelihood, with errors and undetermined combinations.


def identify(
    model: Callable[[dict[str, Any]], Any],
    measurements: Measurements,
    free: dict[str, Any],
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

    The search has three steps, all in batches. It compares hundreds of quasi-random candidates in a region around the start
    values (`exploration.py`), refines the best by Levenberg-Marquardt (`least_squares.py`), and explores the likelihood around
    all minima by adaptive importance sampling (`exploration.py`), until errors and intervals rest on at least 400 effective
    draws. Slopes make the search fast; they do not enter errors and intervals unless the likelihood is that of a linear
    model.

    **Arguments:**

    - `model`: function from parameters, name -> (rows,), to predictions (rows, n); `jax.vmap` converts a function of
      one set of parameters. With exact `slopes`, JAX differentiates the model in forward mode. A row of NaN may give NaN.
    - `measurements`: `Measurements` of shape (n,).
    - `free`: name -> a `Free`, or only the start value.
    - `starts`: number of candidates that are refined.
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
    unknowns = as_free(free)
    if not isinstance(measurements, Measurements) or measurements.value.ndim != 1:
        raise ValueError(f"measurements = {shown(measurements)} must be Measurements of shape (n,)")
    count = measurements.value.size
    labels = tuple(f"#{i + 1}" for i in range(count)) if labels is None else tuple(labels)
    if len(labels) != count:
        raise ValueError(f"labels must be {count}, one for each measurement, not {len(labels)}")
    with status_line("fitting", progress):
        density = LogDensity.of(model, measurements, unknowns, slopes=slopes)
        explorer = Explorer.of(density, unknowns, spread, seed)
        explorer, minima, sample = search(explorer, starts, max_steps, seed, progress)
        result = summarise(explorer.density.problem, labels, minima, explorer, sample)
    if not result.verdict.good:
        warn("; ".join(result.verdict.concerns), FitWarning)
    return result


def check_search(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> None:
    """Raise `ValueError` unless the arguments are legal for `identify`; a model checks them before it prepares its
    data."""
    for name, value, lower in (("starts", starts, 1), ("seed", seed, 0), ("max_steps", max_steps, 1)):
        require_whole(value, name, lower)
    if starts > ROWS:
        raise ValueError(f"starts = {starts} must be at most {ROWS}, the number of candidates")
    require(spread, "spread", above=1.0)
    require_scalars({"spread": spread}, "it spreads the starts of all parameters")
    require_flag(progress, "progress")
