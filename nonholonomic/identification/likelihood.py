"""Unknown parameters, measurements, and the likelihood of predictions."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..parameters import full_name
from ..text import shown
from ..validation import ArrayOrList, require

# Only for type checkers: data stand above measurements.
if TYPE_CHECKING:
    from .recording import AbstractData

# Compare predictions with measurements: residuals whose squares add up to -2 log likelihood.

#: Residual of a measurement for which the model has no prediction: a penalty without a slope.
MISSING = 1e4

#: Factor on the error of a measurement that is not fitted yet.
DOWN_WEIGHTED = 1e6


class Measurements(eqx.Module):
    """Measured numbers with independent errors.

    **Arguments:**

    - `value`: (n,), the measured values. Where `censored`, a lower limit of the quantity, which also has an error (a
      clock stopped by hand is uncertain); -inf if the quantity is only known to be below `upper`.
    - `error`: (n,), standard deviations, positive; or one scalar for all.
    - `censored`: (n,), which values are lower limits; none by default.
    - `upper`: (n,), upper limits of the quantities: `value` itself for measured values (the default), infinite if there
      is only a lower limit.
    - `period`: (n,), period of a quantity, such as 2 pi for an azimuth; infinite by default.
    - `student`: (n,), degrees of freedom of Student's t distribution, if the errors have this distribution with the
      scale `error`; infinite by default, for Gaussian errors. Limits always have Gaussian errors.
    - `series`: (n,), index of the series to which a value belongs; 0 by default. Within a series, values are in the
      order of measurement.
    - `time`: (n,) [s], time of a sample since the start of its recording; 0 by default. A fit first uses the early
      samples of a recording.
    - `estimated`: (n,), whether `error` is only a start value, and the error is to be estimated from the residuals of
      the series.

    **Raises:** `ValueError` for numbers that are not finite or shapes that do not match.

    **Example:** two values, and a lower limit.

    >>> from nonholonomic.identification import Measurements
    >>> Measurements([1.0, 2.0, 3.0], 0.1, censored=[False, False, True]).upper.tolist()
    [1.0, 2.0, inf]
    """

    value: Float[Array, "... n"]
    error: Float[Array, "... n"]
    upper: Float[Array, "... n"]
    period: Float[Array, "... n"]
    student: Float[Array, "... n"]
    series: Int[Array, "... n"]
    time: Float[Array, "... n"]
    estimated: Bool[Array, "... n"]

    def __init__(
        self,
        value: ArrayOrList,
        error: ArrayOrList,
        censored: ArrayOrList = False,
        *,
        upper: ArrayOrList | None = None,
        period: ArrayOrList = math.inf,
        student: ArrayOrList = math.inf,
        series: ArrayOrList = 0,
        time: ArrayOrList = 0.0,
        estimated: ArrayOrList = False,
    ):
        require(error, "error", above=0.0)
        if np.ndim(value) == 0 or np.size(value) == 0:
            raise ValueError(f"value must be a non-empty list, not of shape {np.shape(value)}")
        shape = np.shape(value)
        arguments = {"error": error, "censored": censored, "period": period, "student": student}
        for name, argument in (arguments | {"upper": 0.0 if upper is None else upper}).items():
            if np.shape(argument) not in ((), shape):
                raise ValueError(
                    f"{name} must be one number or of the shape {shape} of value, not {np.shape(argument)}"
                )
        value = np.asarray(value, float)
        upper = np.where(censored, np.inf, value) if upper is None else np.broadcast_to(upper, shape)
        require(value[~(np.isneginf(value) & np.isfinite(upper))], "value")
        if np.any(np.isnan(upper)) or np.any(upper < value):
            raise ValueError(f"upper = {shown(upper)} must be at least value")
        for name in ("period", "student"):
            if not np.all(np.asarray(arguments[name]) > 0.0):
                raise ValueError(f"{name} = {shown(arguments[name])} must be positive, or infinite")

        fields = {"value": value, "upper": upper, "error": error, "period": period, "student": student}
        for name, argument in (fields | {"series": series, "time": time, "estimated": estimated}).items():
            kind = {"series": int, "estimated": bool}.get(name, float)
            setattr(self, name, jnp.broadcast_to(jnp.asarray(argument, kind), shape))

    @property
    def censored(self) -> Bool[Array, "... n"]:
        """Which measurements are limits, or pairs of limits."""
        return self.upper > self.value

    def residuals(self, prediction: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Residuals whose squares are -2 log likelihood, up to a constant.

        For a measurement the residual is z = (prediction - value) / error, or with Student's t of nu degrees of freedom
        r = sign(z) sqrt((nu + 1) log(1 + z^2 / nu)). For a lower limit, the residual is r = -sqrt(-2 log Phi(z)), where
        Phi is the normal distribution: close to z if the prediction is far below the limit, and close to 0 if the
        prediction is above the limit. Upper limits are the mirror image. `between` states the residual of two limits. A
        prediction that is not finite counts as `MISSING`, except that an infinite prediction exceeds a lower limit.

        **Arguments:** `prediction`: (..., n). **Returns:** (..., n).
        """
        is_finite = jnp.isfinite(prediction)
        finite_prediction = jnp.where(is_finite, prediction, 0.0)
        low, high = jnp.isfinite(self.value), jnp.isfinite(self.upper)
        excess = (finite_prediction - jnp.where(low, self.value, 0.0)) / self.error
        shortfall = (jnp.where(high, self.upper, 0.0) - finite_prediction) / self.error
        two_limits = low & high & self.censored
        middle = jnp.where(two_limits, 0.5 * (self.value + self.upper), 0.0)
        half = jnp.where(two_limits, 0.5 * (self.upper - self.value) / self.error, 1.0)
        z, heavy = self.standardised(finite_prediction), jnp.isfinite(self.student)
        freedom = jnp.where(heavy, self.student, 1.0)
        share = z**2 / freedom
        # log(1 + q) / q without 0 / 0; divided before the square root, whose slope at 0 is infinite.
        is_small = share < 1e-8
        flat = jnp.where(is_small, 1.0 - 0.5 * share, jnp.log1p(share) / jnp.where(is_small, 1.0, share))
        of_value = jnp.where(heavy, z * jnp.sqrt((freedom + 1.0) / freedom * flat), z)
        residuals = jnp.select(
            [~self.censored, two_limits, low],
            [of_value, between((finite_prediction - middle) / self.error, half), one_sided(excess)],
            -one_sided(shortfall),
        )
        is_exceeded = low & ~high & (prediction == jnp.inf)
        return jnp.where(is_finite, residuals, jnp.where(is_exceeded, 0.0, MISSING))

    def whole_periods(self, off: Float[Array | np.ndarray, "... n"]) -> Any:
        """Differences rounded to the nearest whole period, without a slope; a NumPy array for a NumPy array, because JAX
        would compile for every number of rows."""
        xp: Any = np if isinstance(off, np.ndarray) else jnp
        period = xp.asarray(self.period)
        wraps = xp.isfinite(period)
        period = xp.where(wraps, period, 1.0)
        return xp.where(wraps, period * xp.round(off / period), 0.0)

    def standardised(self, prediction: Float[Array | np.ndarray, "... n"]) -> Float[Array, "... n"]:
        """(prediction - value) / error, with whole periods removed; 0 for limits."""
        difference = jnp.where(self.censored, 0.0, prediction - self.value)
        difference = difference - self.whole_periods(difference)
        return difference / self.error

    def roots_of_information(
        self, prediction: Float[Array | np.ndarray, "... n"], slope: Float[Array, "... n"]
    ) -> Float[Array, "... n"]:
        """Square roots of Fisher's information about the predictions, from the expected curvature, for standard errors:
        1 / error for Gaussian errors, sqrt((nu + 1) / (nu + 3)) / error for Student's t; the slope of the residual for
        limits.
        """
        heavy = jnp.isfinite(self.student)
        freedom = jnp.where(heavy, self.student, 1.0)
        expected = jnp.where(heavy, jnp.sqrt((freedom + 1.0) / (freedom + 3.0)), 1.0) / self.error
        return jnp.where(self.censored | ~jnp.isfinite(prediction), slope, expected)

    def log_likelihood(self, prediction: Float[Array, "... n"]) -> Float[Array, "..."]:
        """The log likelihood up to a constant that depends on neither predictions nor errors."""
        measured = jnp.where(self.censored, 0.0, jnp.log(self.error))
        return -jnp.sum(0.5 * self.residuals(prediction) ** 2 + measured, axis=-1)

    def with_errors(self, error: Float[Array | np.ndarray, "... n"]) -> "Measurements":
        """The same measurements with other errors."""
        return eqx.tree_at(lambda measurements: measurements.error, self, jnp.broadcast_to(error, self.error.shape))


def one_sided(z: Float[Array, "..."]) -> Float[Array, "..."]:
    """The residual -sqrt(-2 log Phi(z)) of a lower limit; 0 if its magnitude is less than 1e-9."""
    # Beyond this, the derivative of the square root would be infinity times zero.
    in_range = z < 9.0
    return jnp.where(in_range, -jnp.sqrt(-2.0 * log_ndtr(jnp.where(in_range, z, 0.0))), 0.0)


def between(z: Float[Array, "..."], half: Float[Array, "..."]) -> Float[Array, "..."]:
    """The residual of two limits: sign(z) sqrt(2 log(P(0) / P(z))), P(z) = Phi(half - z) - Phi(-half - z).

    **Arguments:** `z`: distance of the prediction above the middle, in errors; `half`: half the distance of the limits,
    in errors.
    """

    def log_probability(distance: Float[Array, "..."]) -> Float[Array, "..."]:
        upper, lower = log_ndtr(half - distance), log_ndtr(-half - distance)
        return upper + jnp.log(-jnp.expm1(lower - upper))

    # Near the middle, use z times the root of the curvature, 2 half phi(half) / P(0): the difference of logarithms
    # cancels there.
    distance = jnp.abs(z)
    deviance = 2.0 * (log_probability(jnp.zeros_like(distance)) - log_probability(distance))
    at_middle = deviance < 1e-9
    density = jnp.exp(-0.5 * half**2) / math.sqrt(2.0 * math.pi)
    curvature = 2.0 * half * density / jnp.exp(log_probability(jnp.zeros_like(distance)))
    return jnp.where(at_middle, z * jnp.sqrt(curvature), jnp.sign(z) * jnp.sqrt(jnp.where(at_middle, 1.0, deviance)))


def estimated_errors(
    measurements: Measurements, prediction: Float[np.ndarray, " n"], unknowns: int
) -> Float[np.ndarray, " n"]:
    """The errors; unknown errors are estimated from the residuals of their series.

    In a fit of k unknowns to N values, the estimate for a series of n values is the root of the sum of squares / (n - k
    n / N). For Student's t, the estimate is the scale for which the mean weight of the squares is 1 (maximum
    likelihood).
    """
    errors = np.array(measurements.error)
    series, estimated = np.asarray(measurements.series), np.asarray(measurements.estimated)
    off = np.asarray(measurements.standardised(prediction)) * errors
    for number in np.unique(series[estimated]):
        in_series = (series == number) & estimated & np.isfinite(off)
        n = np.sum(in_series)
        share = max(1.0 - unknowns / off.size, 1.0 / off.size)
        freedom = np.asarray(measurements.student)[in_series]
        scale = math.sqrt(np.sum(off[in_series] ** 2) / (n * share)) if n else 1.0
        if n and np.all(np.isfinite(freedom)):
            for _ in range(50):
                weight = (freedom + 1.0) / (freedom + (off[in_series] / scale) ** 2)
                scale = math.sqrt(np.sum(weight * off[in_series] ** 2) / (n * share))
        errors[(series == number) & estimated] = max(scale, 1e-300)
    return errors


# Unknown parameters: start value, bounds, and the coordinate in which they are fitted.


class Free(NamedTuple):
    """A parameter to be fitted.

    With a lower bound, the fit uses the logarithm of the distance from it (for `lower=0.0`, the logarithm of the
    parameter); between two bounds, the logit of the position between them; without bounds, the parameter itself.

    - `start`: value from which the fit starts, strictly within the bounds.
    - `lower`, `upper`: bounds, which a fit approaches but does not reach.
    - `prior`: mean and standard deviation of a Gaussian prior of the parameter itself; or only the standard deviation,
      if the mean is `start`; or `None`.

    **Example:**

    ```
    >>> import tippe
    >>> mu = tippe.Free(0.3, lower=0.0, prior=(0.3, 0.1))
    >>> mu.start, mu.positive
    (0.3, True)

    ```
    """

    start: float
    lower: float = -math.inf
    upper: float = math.inf
    prior: tuple[float, float] | float | None = None

    @property
    def unit(self) -> float:
        """The unit of changes of the parameter: the size of the start value; if this is 0, the prior's standard
        deviation, or 1."""
        return abs(self.start) or (1.0 if self.prior is None else float(np.ravel(self.prior)[-1]))

    @property
    def positive(self) -> bool:
        """Whether the parameter cannot be negative."""
        return self.lower >= 0.0


def as_gaussian(prior: Any, start: float, name: str) -> tuple[float, float]:
    """Mean and standard deviation of a prior, which may be only a standard deviation about the start value.

    **Raises:** `ValueError` that names the unknown.
    """
    if np.shape(prior) not in ((), (2,)):
        raise ValueError(
            f"prior of {name} = {shown(prior)} must be a mean and a standard deviation, or only the standard deviation"
        )
    mean, deviation = (start, prior) if np.ndim(prior) == 0 else prior
    require(mean, f"mean of the prior of {name}")
    require(deviation, f"standard deviation of the prior of {name}", above=0.0)
    return mean, deviation


class Unknown(eqx.Module):
    """A `Free` for compiled programs. A program depends on which bounds exist and on whether there is a prior, and
    takes their values as arguments.

    - `start`, `unit`, `lower`, `upper`: as for `Free`; `has_lower`, `has_upper`: which bounds are finite.
    - `prior`: mean and standard deviation, or `None`.
    """

    start: Float[Array | np.ndarray, ""]
    unit: Float[Array | np.ndarray, ""]
    lower: Float[Array | np.ndarray, ""]
    upper: Float[Array | np.ndarray, ""]
    prior: Float[Array | np.ndarray, " 2"] | None
    has_lower: bool = eqx.field(static=True)
    has_upper: bool = eqx.field(static=True)

    @classmethod
    def of(cls, free: Free) -> "Unknown":
        """The unknown of a `Free`, with arrays in place of Python numbers, which would become constants of the
        program."""
        numbers = (free.start, free.unit, free.lower, free.upper)
        start, unit, lower, upper = (np.asarray(number, float) for number in numbers)
        prior = None if free.prior is None else np.asarray(free.prior, float)
        return cls(start, unit, lower, upper, prior, math.isfinite(free.lower), math.isfinite(free.upper))

    def value(self, coordinate: Float[Array | np.ndarray, "..."]) -> Any:
        """The parameter at a coordinate; in NumPy for a NumPy array, because JAX would compile for every shape."""
        xp: Any = np if isinstance(coordinate, np.ndarray) and isinstance(self.lower, np.ndarray) else jnp
        if self.has_lower and self.has_upper:
            # 1 / (1 + exp(-x)) without an overflow.
            return self.lower + (self.upper - self.lower) * 0.5 * (1.0 + xp.tanh(0.5 * coordinate))
        # A coordinate that is large enough stands for infinity.
        with np.errstate(over="ignore"):
            if self.has_lower:
                return self.lower + xp.exp(coordinate)
            if self.has_upper:
                return self.upper - xp.exp(-coordinate)
        return self.start + self.unit * coordinate

    def coordinate(self, value: ArrayLike) -> Float[Array, "..."]:
        """The coordinate of a value strictly within the bounds; the inverse of `value`."""
        value = jnp.asarray(value, float)
        if self.has_lower and self.has_upper:
            return jnp.log(value - self.lower) - jnp.log(self.upper - value)
        if self.has_lower:
            return jnp.log(value - self.lower)
        return -jnp.log(self.upper - value) if self.has_upper else (value - self.start) / self.unit


def as_free(free: Mapping[str, Free | float], lower: dict[str, float] | None = None) -> dict[str, Free]:
    """Unknowns as `Free`, checked.

    **Arguments:**

    - `free`: name -> a `Free`, or only the start value.
    - `lower`: name -> lower bound for unknowns given by a value only, or without bounds.

    **Returns:** name -> `Free`.

    **Raises:** `ValueError` that names the unknown and the problem.
    """
    if not isinstance(free, Mapping) or not free:
        raise ValueError(f"free = {shown(free)} must be a non-empty dictionary, name of a number -> start value")
    unknowns = {}
    for name, start in free.items():
        unknown = start if isinstance(start, Free) else Free(start)
        if unknown.lower == -math.inf and unknown.upper == math.inf:
            unknown = unknown._replace(lower=(lower or {}).get(name, -math.inf))
        require(unknown.start, f"start of {name}")
        if np.ndim(unknown.start) != 0:
            raise ValueError(f"start of {name} must be one number, not of shape {np.shape(unknown.start)}")
        require(unknown.start, f"start of {name}", above=unknown.lower, below=unknown.upper, why="the bounds")
        prior = None if unknown.prior is None else as_gaussian(unknown.prior, float(unknown.start), name)
        unknowns[name] = unknown._replace(
            start=float(unknown.start), lower=float(unknown.lower), upper=float(unknown.upper), prior=prior
        )
    return unknowns


# Fit several sets of data together: join measurements, and name the parameters that are shared or belong to a single
# set.

Value = TypeVar("Value")

#: Stands for every set of data that has the parameter.
EACH = "data[*]."


def joined_data(data: Sequence["AbstractData"]) -> tuple[Measurements, tuple[str, ...], Int[np.ndarray, " n"]]:
    """The joined measurements of several sets of data, their labels, and the indices of the predictions that were measured.

    **Arguments:** `data`: sets of data, each with the attributes `measurements`, `labels`, `seen`, and `size` (the
    number of its predictions).
    """
    labels = numbered([source.labels for source in data])
    offsets = np.cumsum([0, *(source.size for source in data)])
    indices = np.concatenate([first + source.seen for first, source in zip(offsets, data, strict=False)])
    first, parts = 0, []
    for part in (source.measurements for source in data):
        # The series are renumbered consecutively.
        parts.append(eqx.tree_at(lambda part: part.series, part, part.series + first))
        first += int(np.max(part.series)) + 1
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts), labels, indices


def numbered(labels: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """The labels of all sets of data, with the number of the set if there are several."""
    several = len(labels) > 1
    return tuple(f"{k}: {label}" if several else label for k, part in enumerate(labels, 1) for label in part)


def of_data(parameters: dict[str, Value], k: int) -> dict[str, Value]:
    """The parameters of one set of data: the shared parameters, and its own parameters without the prefix `data[k].`."""
    prefix = f"data[{k}]."
    pairs = ((name.removeprefix(prefix), value) for name, value in parameters.items())
    return {name: value for name, value in pairs if not name.startswith("data[")}


def own_name(name: str) -> str:
    """The name of a parameter without the prefix `data[k].`."""
    return name.split(".", 1)[1] if name.startswith("data[") else name


def free_numbers(
    free: Mapping[str, Free | float],
    shared: list[str],
    own: list[list[str]],
    check: Callable[[dict[str, float]], object],
) -> dict[str, Free]:
    """The unknowns of a scene and its data: their full names, and a lower bound of 0 for parameters that cannot be negative.

    **Arguments:**

    - `free`: name, or its unambiguous end, -> a `Free` or a start value. `data[1].launch.azimuth` is a parameter of the
      second set of data alone, and `data[*].launch.azimuth` stands for one parameter of each set.
    - `shared`: full names of the parameters of the model; `own`: names of the parameters of each set of data, without
      the prefix. A name of `own` without a prefix is shared, too.
    - `check`: function of a dictionary (name without prefix -> number) that raises `ValueError` for illegal values.

    **Returns:** full name -> `Free`.

    **Raises:** `ValueError` for an unknown name or illegal start values.
    """
    of_any = list(dict.fromkeys(itertools.chain(*own)))
    of_each = [f"data[{k}].{name}" for k, names in enumerate(own) for name in names]
    unknowns: dict[str, Free] = {}
    for written, unknown in as_free(free).items():
        if str(written).startswith(EACH):
            end = full_name("free", written.removeprefix(EACH), of_any)
            names = [name for name in of_each if own_name(name) == end]
        else:
            known = of_each if str(written).startswith("data[") else [*shared, *of_any]
            names = [full_name("free", written, known)]
        for name in names:
            if name in unknowns:
                raise ValueError(f"free: {name!r} is named twice")
            unknowns[name] = unknown
    for name in unknowns:
        if own_name(name) != name and own_name(name) in unknowns:
            raise ValueError(f"free: {name!r} is named twice, alone and for all data")
    for k in range(len(own)):
        check({name: unknown.start for name, unknown in of_data(unknowns, k).items()})
    lower = {}
    for name, unknown in unknowns.items():
        try:
            check({own_name(name): -(abs(unknown.start) or 1.0)})
        except ValueError:
            lower[name] = 0.0
    return as_free(unknowns, lower)
