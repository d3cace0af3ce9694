"""The result of a fit: estimates, errors, undetermined combinations, and the outcome of every start."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..parameters import full_name, text_as_html
from ..progress import status_line
from ..validation import require_package, shown
from ..views import draw_fit
from .levenberg_marquardt import minimise
from .likelihood import Measurements
from .problem import Linearised, Problem, linearise
from .verdict import CLOSE, RIVAL, SAME, Verdict, judge

#: Singular values below this fraction of the largest belong to directions that the data do not determine at all.
NO_SLOPE = 1e-7

#: A combination of parameters counts as undetermined if its relative error exceeds this.
UNSEEN = 1.0

#: Greatest number of rows of the residual table in a summary, and least share of a parameter that a combination lists.
MOST_ROWS, LEAST_SHARE = 24, 0.02


class Profile(NamedTuple):
    """The profile likelihood of one parameter.

    - `values`: (points,), the values at which the parameter was held.
    - `deviance`: (points,), -2 log likelihood above its minimum, with all other parameters fitted again.
    - `estimates`: name -> (points,), estimates of the other parameters.
    - `converged`: (points,), whether these fits converged.
    """

    values: Float[np.ndarray, " points"]
    deviance: Float[np.ndarray, " points"]
    estimates: dict[str, Float[np.ndarray, " points"]]
    converged: np.ndarray


class Identifiability(NamedTuple):
    """The combinations of parameters that the data determine, and those that they do not determine, to first order and
    without priors.

    They come from the singular values of the slopes of the residuals with respect to relative changes: changes of the
    logarithm for a parameter that cannot be negative, otherwise changes in units of `Free.unit`.

    - `singular_values`: (unknowns,), decreasing; the inverse of a value is the relative error of its combination of
      parameters.
    - `directions`: (unknowns, unknowns), the combinations, one per row.
    - `words`: the combinations as text: which parameters change together, and by how much.
    """

    singular_values: Float[np.ndarray, " unknowns"]
    directions: Float[np.ndarray, "unknowns unknowns"]
    words: tuple[str, ...]

    @property
    def unseen(self) -> tuple[str, ...]:
        """The combinations whose errors exceed their own size."""
        least = max(1.0 / UNSEEN, NO_SLOPE * self.singular_values[0])
        return tuple(word for value, word in zip(self.singular_values, self.words, strict=True) if value < least)


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

    - `estimates`, `standard_errors`: name -> number. The errors come from the Gauss-Newton matrix of data and priors;
      they are infinite for a parameter that takes part in an undetermined direction.
    - `covariance`: (unknowns, unknowns), in the order of `estimates`. Parameters with infinite error have covariance 0.
    - `deviance`: -2 log likelihood of data and priors at the estimate, up to a constant: the sum of squared residuals.
    - `degrees`: measurements and priors less unknowns.
    - `identifiability`: an `Identifiability`; `residuals`: a `ResidualRow` for every measurement.
    - `status`: "converged" or why not; `starts`, `ends`: name -> (starts,), where each fit began and ended;
      `end_deviances`: (starts,); `statuses`: "converged", "not_converged" or "failed" for each start.
    - `verdict`: a `Verdict`, whether the fit can be believed.
    - `coordinates`, `coordinate_covariance`: estimates and covariance in the coordinates of the fit.

    **Example:** the fit of the subpackage's example.

    >>> fit.status, fit.degrees, list(fit.estimates)
    ('converged', 2, ['scene.rate'])
    """

    estimates: dict[str, float]
    standard_errors: dict[str, float]
    covariance: Float[np.ndarray, "unknowns unknowns"]
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
    problem: Problem = dataclasses.field(repr=False)
    measurements: Measurements = dataclasses.field(repr=False)

    def interval(self, name: str, deviations: float = 1.96) -> tuple[float, float]:
        """The confidence interval of a parameter, symmetric in its coordinate and so within its bounds.

        **Arguments:** `name`: name of the parameter, or the end of its name; `deviations`: half the width in standard
        errors, 1.96 for 95 %.

        **Raises:** `ValueError` for a name that was not free.
        """
        k = self._place(name)
        free = self.problem.unknowns[k]
        reach = deviations * np.sqrt(self.coordinate_covariance[k, k])
        with np.errstate(over="ignore"):
            low, high = (float(free.value(np.asarray(self.coordinates[k] + side * reach))) for side in (-1.0, 1.0))
        return low, high

    @status_line("fitting again")
    def profile(self, name: str, values: Any = None) -> Profile:
        """The profile likelihood of a parameter: all others are fitted again, for all its values at once.

        **Arguments:**

        - `name`: name of the parameter, or the end of its name.
        - `values`: values at which to hold the parameter, by default 13 within three standard errors.

        **Returns:** a `Profile`.

        **Raises:** `ValueError` for a name that was not free, and for a parameter with an infinite error if `values` is
        missing.
        """
        k = self._place(name)
        free = self.problem.unknowns[k]
        if values is None:
            if not np.isfinite(self.standard_errors[self.problem.names[k]]):
                raise ValueError(f"values must be given for {name!r}, whose standard error is infinite")
            reach = 3.0 * np.sqrt(self.coordinate_covariance[k, k])
            values = np.asarray(free.value(jnp.asarray(self.coordinates[k] + np.linspace(-reach, reach, 13))))
        values = np.atleast_1d(np.asarray(values, float))
        if not np.all((values > free.lower) & (values < free.upper)):
            raise ValueError(
                f"values = {shown(values)} must lie within the bounds ({free.lower}, {free.upper}) of {name!r}"
            )
        starts = np.tile(self.coordinates, (len(values), 1))
        starts[:, k] = np.asarray(free.coordinate(values))
        ends = minimise(self.problem, starts, self.measurements, fixed=k)
        optima = np.asarray(self.problem.values(jnp.asarray(ends.coordinates)))
        deviance = deviance_of(self.problem, ends.coordinates, self.measurements) - self.deviance
        others = {other: optima[:, i] for i, other in enumerate(self.problem.names) if i != k}
        return Profile(values, deviance, others, ends.converged)

    @property
    def correlation(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Correlations of the estimates, in the coordinates of the fit; 0 for estimates with infinite error."""
        errors = np.sqrt(np.diag(self.coordinate_covariance))
        with np.errstate(invalid="ignore"):
            shares = self.coordinate_covariance / np.outer(errors, errors)
        return np.where(np.eye(len(errors), dtype=bool), 1.0, np.where(np.isfinite(shares), shares, 0.0))

    @status_line("drawing")
    def plot(self) -> Any:
        """Data and model, residuals, the profile likelihood of every parameter, and the correlations (needs matplotlib).

        **Returns:** a matplotlib figure.
        """
        require_package("matplotlib", "plot", "plot")
        return draw_fit(self)

    def _place(self, name: str) -> int:
        valid = list(self.estimates)
        return valid.index(full_name("name", name, valid))

    def _repr_html_(self) -> str:
        return text_as_html(str(self))

    def __str__(self) -> str:
        lines = [
            f"Identification of {len(self.estimates)} numbers from {len(self.residuals)} measurements: {self.status}",
            f"  {self.statuses.count('converged')} of {len(self.statuses)} starts converged, {self.verdict.agree} ended here",
            f"  -2 log likelihood {self.deviance:.4g} at {self.degrees} degrees of freedom",
            "verdict",
            str(self.verdict),
            "estimates, standard errors and 95 % intervals",
        ]
        width = max(map(len, self.estimates))
        for name, value in self.estimates.items():
            low, high = self.interval(name)
            lines.append(f"  {name:{width}}  {value:.6g} +- {self.standard_errors[name]:.2g}  ({low:.6g}, {high:.6g})")
        lines.append("combinations of parameters and their relative errors")
        for value, words in zip(self.identifiability.singular_values, self.identifiability.words, strict=True):
            mark = "  UNDETERMINED" if words in self.identifiability.unseen else ""
            lines.append(f"  {1.0 / max(value, 1e-300):8.2g}  {words}{mark}")
        lines.append("measured, predicted, residual in units of the error")
        width = max(len(row.label) for row in self.residuals)
        for row in self.residuals[:MOST_ROWS]:
            lines.append(f"  {row.label:{width}}  {row.measured:20}  {row.prediction:.6g}  {row.residual:+.2f}")
        if len(self.residuals) > MOST_ROWS:
            largest = max(self.residuals, key=lambda row: abs(row.residual))
            lines.append(
                f"  and {len(self.residuals) - MOST_ROWS} more; largest {largest.label} {largest.residual:+.2f}"
            )
        return "\n".join(lines)


def deviance_of(problem: Problem, coordinates: Any, measurements: Measurements) -> Float[np.ndarray, " rows"]:
    """-2 log likelihood of every row; infinite instead of NaN."""
    deviance = linearise(problem, coordinates, measurements).deviance
    return np.where(np.isfinite(deviance), deviance, np.inf)


def coordinate_covariance(jacobian: Float[np.ndarray, "residuals unknowns"]) -> Float[np.ndarray, "unknowns unknowns"]:
    """The inverse of the Gauss-Newton matrix J^T J; infinite for unknowns that take part in an undetermined direction.

    To find these directions, every unknown is measured in units of its own error with the other unknowns held fixed.
    """
    norms = np.linalg.norm(jacobian, axis=0)
    norms = np.where(norms > 0.0, norms, 1.0)
    values, directions = _singular(jacobian / norms)
    seen = values > NO_SLOPE * max(values[0], 1e-300)
    covariance = (directions[seen].T / values[seen] ** 2) @ directions[seen] / np.outer(norms, norms)
    is_undetermined = np.any(np.abs(directions[~seen]) > 1e-6, axis=0)
    covariance[is_undetermined, :] = covariance[:, is_undetermined] = 0.0
    covariance[is_undetermined, is_undetermined] = np.inf
    return covariance


def _singular(slopes: Float[np.ndarray, "n unknowns"]) -> tuple[np.ndarray, np.ndarray]:
    """Singular values and right singular vectors (one per row), as many as there are unknowns."""
    unknowns = slopes.shape[1]
    _, values, directions = np.linalg.svd(slopes, full_matrices=len(slopes) < unknowns)
    return np.concatenate([values, np.zeros(unknowns - len(values))]), directions


def identifiability(problem: Problem, estimates: Any, slopes: Any, jacobian: Any) -> Identifiability:
    """Singular values of the slopes of the residuals with respect to relative changes of the parameters, with their
    directions as text.

    **Arguments:** `estimates`: (unknowns,); `slopes`: (unknowns,), of the parameters with respect to their coordinates;
    `jacobian`: (n, unknowns), of the residuals with respect to the coordinates.
    """
    units = np.array(
        [abs(x) if unknown.positive else unknown.unit for x, unknown in zip(estimates, problem.unknowns, strict=True)]
    )
    relative = np.asarray(jacobian) * units / np.where(slopes == 0.0, 1.0, slopes)
    values, directions = _singular(relative)
    words = tuple(_in_words(problem, direction) for direction in directions)
    return Identifiability(values, directions, words)


def _in_words(problem: Problem, direction: Float[np.ndarray, " unknowns"]) -> str:
    """The parameters that change together: in per cent if a parameter cannot be negative, otherwise in hundredths of
    its unit."""
    largest = np.argmax(np.abs(direction))
    parts = []
    for share, (name, free) in zip(direction / direction[largest], problem.free, strict=True):
        if abs(share) >= LEAST_SHARE:
            parts.append(f"{name} {share:+.2g} %" if free.positive else f"{name} {0.01 * share * free.unit:+.2g}")
    return ", ".join(parts)


def summarise(
    problem: Problem,
    measurements: Measurements,
    labels: tuple[str, ...],
    starts: Float[np.ndarray, "starts unknowns"],
    ends: Float[np.ndarray, "starts unknowns"],
    converged: np.ndarray,
    at_ends: Linearised,
) -> Identification:
    """The result of fits from several starts: the best fit, with a record of the other fits."""
    valid = np.any(np.isfinite(at_ends.prediction), axis=1) & np.all(np.isfinite(ends), axis=1)
    deviances = np.where(valid & np.isfinite(at_ends.deviance), at_ends.deviance, np.inf)
    statuses = tuple(
        "failed" if np.isinf(deviance) else "converged" if has_converged else "not_converged"
        for deviance, has_converged in zip(deviances, converged, strict=True)
    )
    best = int(np.argmin(deviances))
    optimum, names = ends[best], problem.names
    values = np.asarray(problem.values(jnp.asarray(ends)))
    slopes = np.array(
        [
            float(jax.grad(unknown.value)(coordinate))
            for coordinate, unknown in zip(optimum, problem.unknowns, strict=True)
        ]
    )
    covariance = coordinate_covariance(at_ends.whole_information[best])
    with np.errstate(invalid="ignore"):
        by_value = np.where(covariance == 0.0, 0.0, covariance * np.outer(slopes, slopes))
    start_values = np.asarray(problem.values(jnp.asarray(starts)))
    numbers = (
        measurements.value,
        measurements.error,
        at_ends.prediction[best],
        at_ends.residual[best],
        measurements.upper,
    )
    table = zip(labels, *(np.asarray(part).tolist() for part in numbers), strict=True)
    combinations = identifiability(problem, values[best], slopes, at_ends.information[best])
    priors, limits = at_ends.prior.shape[-1], int(np.sum(np.asarray(measurements.censored)))
    degrees = len(labels) + priors - len(names)
    return Identification(
        estimates=dict(zip(names, values[best].tolist(), strict=True)),
        standard_errors=dict(zip(names, np.sqrt(np.diag(by_value)).tolist(), strict=True)),
        covariance=by_value,
        deviance=float(deviances[best]),
        degrees=degrees,
        identifiability=combinations,
        residuals=tuple(ResidualRow(*row) for row in table),
        status=statuses[best],
        starts=dict(zip(names, start_values.T, strict=True)),
        ends=dict(zip(names, values.T, strict=True)),
        end_deviances=deviances,
        statuses=statuses,
        verdict=judge(
            measurements,
            at_ends.prediction[best],
            at_ends.residual[best],
            degrees - limits,
            agreement(ends, deviances, covariance, best),
            combinations.unseen,
            statuses[best],
        ),
        coordinates=optimum,
        coordinate_covariance=covariance,
        problem=problem,
        measurements=measurements,
    )


def agreement(
    ends: Float[np.ndarray, "starts unknowns"],
    deviances: Float[np.ndarray, " starts"],
    covariance: Float[np.ndarray, "unknowns unknowns"],
    best: int,
) -> tuple[int, int, int]:
    """Three numbers of starts: those that ended at the best minimum, those that ended elsewhere with nearly the same
    likelihood, and all."""
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore"):
        distances = np.abs(ends - ends[best]) / errors
    # Parameters of infinite error are ignored: their value does not matter.
    is_close = np.all(np.where(np.isfinite(errors), distances, 0.0) < CLOSE, axis=1) | (
        deviances < deviances[best] + SAME
    )
    agree = is_close & (deviances < deviances[best] + 1.0)
    return int(np.sum(agree)), int(np.sum(~agree & (deviances < deviances[best] + RIVAL))), len(ends)
