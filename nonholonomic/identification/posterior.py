"""Measurements and unknown parameters, a model with its unknowns, and their posterior as a function of coordinates."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ..compilation.xla_cpu import current_platform
from ..sweeps.running import workers
from ..terminal import status_line
from ..text import in_unit, readable_unit, shown
from ..validation import ArrayOrList, is_traced, require

#: Coordinates of one point, of a point for each row, and of n points; a number for each point or measurement; and a covariance.
Coordinates = Float[np.ndarray, " unknowns"]
Rows = Float[np.ndarray, "rows unknowns"]
Points = Float[np.ndarray, "n unknowns"]
PerPoint = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "unknowns unknowns"]

#: Predictions of all measurements in every row, and their slopes with respect to the coordinates.
Predictions = Float[np.ndarray, "rows n"]
Slopes = Float[np.ndarray, "rows n unknowns"]

# Compare predictions with measurements: residuals whose squares add up to -2 log likelihood.

#: Residual of a measurement for which the model has no prediction: a penalty without a slope.
MISSING = 1e4

#: Number of steps in which the scale of values with Student's t distribution is found.
SCALE_STEPS = 50


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

    value: Float[Array | np.ndarray, "... n"]
    error: Float[Array | np.ndarray, "... n"]
    upper: Float[Array | np.ndarray, "... n"]
    period: Float[Array | np.ndarray, "... n"]
    student: Float[Array | np.ndarray, "... n"]
    series: Int[Array | np.ndarray, "... n"]
    time: Float[Array | np.ndarray, "... n"]
    estimated: Bool[Array | np.ndarray, "... n"]

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
            setattr(self, name, np.broadcast_to(np.asarray(argument, kind), shape))

    @property
    def censored(self) -> Bool[Array | np.ndarray, "... n"]:
        """Which measurements are limits, or pairs of limits."""
        return self.upper > self.value

    def residuals(self, prediction: Float[Array, "... n"], has_limits: bool = True) -> Float[Array, "... n"]:
        """Residuals whose squares are -2 log likelihood, up to a constant.

        For a measurement the residual is z = (prediction - value) / error, or with Student's t of nu degrees of freedom
        r = sign(z) sqrt((nu + 1) log(1 + z^2 / nu)). For a lower limit, the residual is r = -sqrt(-2 log Phi(z)), where
        Phi is the normal distribution: close to z if the prediction is far below the limit, and close to 0 if the
        prediction is above the limit. Upper limits are the mirror image. `between` states the residual of two limits. A
        prediction that is not finite counts as `MISSING`, except that an infinite prediction exceeds a lower limit.

        **Arguments:** `prediction`: (..., n); `has_limits`: false if no measurement is a limit. **Returns:** (..., n).
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
        residuals = of_value
        if has_limits:
            choices = [of_value, between((finite_prediction - middle) / self.error, half), one_sided(excess)]
            residuals = jnp.select([~self.censored, two_limits, low], choices, -one_sided(shortfall))
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

    def standardised(self, prediction: Float[Array | np.ndarray, "... n"]) -> Any:
        """(prediction - value) / error, with whole periods removed, as for `whole_periods`; 0 for limits."""
        xp: Any = np if isinstance(prediction, np.ndarray) else jnp
        difference = xp.where(self.censored, 0.0, prediction - xp.where(self.censored, 0.0, self.value))
        return (difference - self.whole_periods(difference)) / self.error

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


def scale_of(off: Float[np.ndarray, "rows n"], freedom: float, share: float = 1.0) -> Float[np.ndarray, " rows"]:
    """The scale of the values in every row: the root of the sum of their squares / (n share). For Student's t, it is the
    scale for which the mean weight of the squares is 1 (maximum likelihood)."""
    scale = np.sqrt(np.mean(off**2, axis=-1) / share) + 1e-150
    for _ in range(SCALE_STEPS if math.isfinite(freedom) else 0):
        weight = (freedom + 1.0) / (freedom + (off / scale[..., None]) ** 2)
        scale = np.sqrt(np.mean(weight * off**2, axis=-1) / share) + 1e-150
    return scale


def estimated_errors(measurements: Measurements, prediction: PerPoint, unknowns: int) -> PerPoint:
    """The errors; unknown errors are estimated from the residuals of their series.

    In a fit of k unknowns to N values, the share of the residuals that is left of the errors is 1 - k / N.
    """
    errors, series, estimated = np.array(measurements.error), measurements.series, measurements.estimated
    off = measurements.standardised(prediction) * errors
    share = max(1.0 - unknowns / off.size, 1.0 / off.size)
    for number in np.unique(series[estimated]):
        members = (series == number) & estimated
        seen, freedom = off[members & np.isfinite(off)], float(measurements.student[members][0])
        errors[members] = scale_of(seen[None], freedom, share) if len(seen) else 1.0
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


#: The log density of a parameter: (mean, standard deviation) of a Gaussian, only the standard deviation, or a function of the
#: parameter.
Prior = tuple[float, float] | float | Callable[[Float[Array, ""]], Float[Array, ""]]


class Unknowns(eqx.Module):
    """The free parameters of a compiled program, which takes their numbers as arguments.

    - `start`, `unit`, `lower`, `upper`: (unknowns,), as for `Free`.
    - `priors`: for each unknown, mean and standard deviation of a Gaussian prior; a function that returns the log density of
      the parameter; or `None`.
    """

    start: Float[Array | np.ndarray, " unknowns"]
    unit: Float[Array | np.ndarray, " unknowns"]
    lower: Float[Array | np.ndarray, " unknowns"]
    upper: Float[Array | np.ndarray, " unknowns"]
    priors: tuple[Any, ...]

    def __init__(self, free: Mapping[str, Free], priors: Mapping[str, Prior]):
        numbers = [(unknown.start, unknown.unit, unknown.lower, unknown.upper) for unknown in free.values()]
        self.start, self.unit, self.lower, self.upper = np.array(numbers, float).T
        own_priors = (priors.get(name, unknown.prior) for name, unknown in free.items())
        self.priors = tuple(np.asarray(prior, float) if isinstance(prior, tuple) else prior for prior in own_priors)

    def values(self, coordinates: Float[Array | np.ndarray, "*batch unknowns"]) -> Any:
        """The parameters at given coordinates; in NumPy for a NumPy array, because JAX would compile for every shape."""
        if coordinates.shape[-1] != len(self.start):
            raise ValueError(f"coordinates must have {len(self.start)} numbers, not {coordinates.shape[-1]}")
        xp: Any = np if isinstance(coordinates, np.ndarray) and isinstance(self.start, np.ndarray) else jnp
        low, high = xp.isfinite(self.lower), xp.isfinite(self.upper)
        lower, upper = xp.where(low, self.lower, 0.0), xp.where(high, self.upper, 0.0)
        # 1 / (1 + exp(-x)) without an overflow.
        inside = lower + (upper - lower) * 0.5 * (1.0 + xp.tanh(0.5 * coordinates))
        # The functions of a single bound are evaluated only where they are used: their slopes may be infinite elsewhere.
        above, below = xp.where(low & ~high, coordinates, 0.0), xp.where(high & ~low, coordinates, 0.0)
        # A coordinate that is large enough stands for infinity.
        with np.errstate(over="ignore"):
            of_one_bound = [lower + xp.exp(above), upper - xp.exp(-below)]
        free = self.start + self.unit * coordinates
        return xp.select([low & high, low, high], [inside, *of_one_bound], free)

    def coordinates(self, values: Float[np.ndarray, "*batch unknowns"]) -> Float[np.ndarray, "*batch unknowns"]:
        """The coordinates of values strictly within the bounds; the inverse of `values`."""
        low, high = np.isfinite(self.lower), np.isfinite(self.upper)
        # Logarithms of infinite distances are not used.
        with np.errstate(invalid="ignore", divide="ignore"):
            above, below = np.log(values - self.lower), np.log(self.upper - values)
            inside = above - below
        return np.select([low & high, low, high], [inside, above, -below], (values - self.start) / self.unit)

    @eqx.filter_jit
    def prior_residuals(self, coordinates: Float[Array, "rows unknowns"]) -> tuple[Array, Array]:
        """Residuals of the Gaussian priors in every row, and their slopes with respect to the coordinates."""
        values, slopes = jax.jvp(self.values, (coordinates,), (jnp.ones_like(coordinates),))
        places = np.array([k for k, prior in enumerate(self.priors) if prior is not None and not callable(prior)], int)
        mean, deviation = jnp.array([self.priors[k] for k in places]).reshape(-1, 2).T
        by_own_coordinate = (slopes[:, places] / deviation)[..., None]
        return (values[:, places] - mean) / deviation, by_own_coordinate * jnp.eye(len(self.priors))[places]

    def log_prior(self, coordinates: Float[Array, " coordinates"]) -> Float[Array, ""]:
        """The log density of the priors in the coordinates: the density of each parameter, and the Jacobian of its
        coordinate. The coordinates of unknown errors, which come last, have a flat prior."""
        own = jnp.asarray(coordinates)[: len(self.priors)]
        values, slopes = jax.jvp(self.values, (own,), (jnp.ones_like(own),))
        # Uniform between two bounds; in the coordinate, the prior would have no finite integral.
        is_proper = np.array([prior is not None for prior in self.priors])
        is_proper = is_proper | (jnp.isfinite(self.lower) & jnp.isfinite(self.upper))
        total = jnp.sum(jnp.log(jnp.abs(jnp.where(is_proper, slopes, 1.0))))
        for value, prior in zip(values, self.priors, strict=True):
            if callable(prior):
                log_density: Any = prior(value)
                total += log_density
            elif prior is not None:
                mean, deviation = prior
                total += -0.5 * ((value - mean) / deviation) ** 2 - jnp.log(deviation * math.sqrt(2.0 * math.pi))
        return total

    # Without the data, so that one program serves all fits with as many unknowns.
    log_priors = eqx.filter_jit(eqx.filter_vmap(log_prior, in_axes=(None, 0)))


def as_free(free: Mapping[str, Free | float]) -> dict[str, Free]:
    """Unknowns as `Free`, checked.

    **Arguments:** `free`: name -> a `Free`, or only the start value.

    **Returns:** name -> `Free`.

    **Raises:** `ValueError` that names the unknown and the problem.
    """
    if not isinstance(free, Mapping) or not free:
        raise ValueError(f"free = {shown(free)} must be a non-empty dictionary, name of a number -> start value")
    unknowns = {}
    for name, start in free.items():
        unknown = start if isinstance(start, Free) else Free(start)
        require(unknown.start, f"start of {name}")
        if np.ndim(unknown.start) != 0:
            raise ValueError(f"start of {name} must be one number, not of shape {np.shape(unknown.start)}")
        require(unknown.start, f"start of {name}", above=unknown.lower, below=unknown.upper, why="the bounds")
        prior = None if unknown.prior is None else as_gaussian(unknown.prior, float(unknown.start), name)
        unknowns[name] = unknown._replace(
            start=float(unknown.start), lower=float(unknown.lower), upper=float(unknown.upper), prior=prior
        )
    return unknowns


def own_name(name: str) -> str:
    """The name of a parameter without the prefix `data[k].`."""
    return name.split(".", 1)[1] if name.startswith("data[") else name


# A model with its free parameters, and predictions with slopes, for many sets of parameters at once.

#: Number of rows in a call of a model without and with slopes; on an accelerator.
ROWS_OF_CALL, ROWS_WITH_SLOPES, MOST_ROWS = 64, 8, 512

#: Number of predictions that are compared with measurements at once.
COMPARED = 4096

#: Step of differences in the coordinates: 1 % of a positive parameter. Differences smooth over narrower structure. The
#: valleys of recordings are narrower, and their predictions are smooth.
DIFFERENCE, OF_RECORDING = 0.01, 3e-4


#: A function from parameters, name -> (rows,), to predictions (rows, n).
Model = Callable[[dict[str, Float[Array, " rows"]]], Float[Array, "rows n"]]


class Problem(eqx.Module):
    """A model and its free parameters.

    - `model`: parameters, name -> (rows,), to predictions (rows, n).
    - `names`, `unknowns`: the names of the free parameters, and their numbers.
    - `step`: `None` for automatic differentiation in forward mode; otherwise the step of central differences in the
      coordinates. The model then need not be differentiable, nor traceable if it has `on_host = True`.
    - `on_host`: whether the model cannot be traced.
    - `acts`: which unknowns act on a prediction; the slopes of the others are round-off, and set to zero.
    """

    model: Model
    names: tuple[str, ...] = eqx.field(static=True)
    unknowns: Unknowns
    step: float | None = eqx.field(static=True)
    on_host: bool = eqx.field(static=True)
    acts: Bool[np.ndarray, " unknowns"]

    def predict(self, coordinates: Float[Array | np.ndarray, "rows unknowns"]) -> Float[Array, "rows n"]:
        """The model's predictions in every row.

        **Raises:** `ValueError` inside a transformation, if the model cannot be traced.
        """
        if self.on_host and is_traced(coordinates):
            raise ValueError(
                "a model of tops with several modes cannot be compiled or differentiated: use `sample`, or a sampler that "
                "needs values only"
            )
        values = self.unknowns.values(coordinates)
        return self.model({name: values[:, k] for k, name in enumerate(self.names)})


class Linearised(NamedTuple):
    """A model and its likelihood at a point of every row.

    - `coordinates`: (rows, unknowns); `prediction`: (rows, n); `slopes`: (rows, n, unknowns), with respect to the coordinates.
    - `residual`: (rows, residuals), of the n data, then of the priors; `jacobian`: (rows, residuals, unknowns), its slopes.
    - `information`: the same with the expected curvature of the likelihood (`Measurements.roots_of_information`), for
      errors.
    """

    coordinates: Rows
    prediction: Predictions
    slopes: Slopes
    residual: Float[np.ndarray, "rows residuals"]
    jacobian: Float[np.ndarray, "rows residuals unknowns"]
    information: Float[np.ndarray, "rows residuals unknowns"]

    @property
    def deviance(self) -> Float[np.ndarray, " rows"]:
        """-2 log posterior of every row, up to a constant; infinite where the model failed."""
        deviance = np.sum(self.residual**2, axis=1)
        return np.where(np.isfinite(deviance), deviance, np.inf)


@eqx.filter_jit
def _differentiated(
    problem: Problem, coordinates: Float[Array | np.ndarray, "rows unknowns"]
) -> tuple[Float[Array, "rows n"], Float[Array, "rows n unknowns"]]:
    """Predictions and their slopes; rows are independent, so a coordinate is moved in all of them at once."""
    values, slopes = jax.vmap(
        lambda direction: jax.jvp(problem.predict, (coordinates,), (jnp.broadcast_to(direction, coordinates.shape),)),
        out_axes=(0, -1),
    )(jnp.eye(coordinates.shape[-1]))
    return values[0], jnp.where(jnp.isfinite(slopes), slopes, 0.0)


_predicted = eqx.filter_jit(Problem.predict)


def predictions(problem: Problem, coordinates: Rows) -> np.ndarray:
    """Predictions without slopes, for every row of coordinates; rows of NaN take no time."""
    predict, rows = Problem.predict if problem.on_host else _predicted, ROWS_OF_CALL
    if problem.on_host and len(problem.names) == 1:
        # Rounds are small, and calls take nearly as long for fewer rows: the cores share a round.
        rows = ROWS_OF_CALL // 2
    return _in_parts(lambda part: (predict(problem, part),), coordinates, rows)[0]


def _in_parts(
    function: Callable[[Rows], tuple[Array, ...]], coordinates: Rows, rows_of_part: int
) -> tuple[np.ndarray, ...]:
    """The results of a function of some rows for all rows; the cores share its calls, an accelerator has a single one.

    The program is compiled for a fixed number of rows. Runs of rows of NaN end at once.
    """
    cores = workers()
    rows = rows_of_part if current_platform() == "cpu" else MOST_ROWS
    padding = np.full((-len(coordinates) % rows, coordinates.shape[1]), np.nan)
    parts = np.concatenate([coordinates, padding]).reshape(-1, rows, coordinates.shape[1])
    with ThreadPoolExecutor(cores) as threads:
        # A single core stays in this thread, in which JAX's contexts hold, such as that of `jax.default_device`.
        each = threads.map if cores > 1 else map
        results = zip(*each(lambda part: [np.asarray(result) for result in function(part)], parts), strict=True)
        return tuple(np.concatenate(result)[: len(coordinates)] for result in results)


def linearise(density: "LogDensity", coordinates: Rows, mask: Bool[np.ndarray, " rows"] | None = None) -> Linearised:
    """Predictions, residuals and their slopes.

    **Arguments:**

    - `density`: its measurements may have the shape (n,) or (rows, n).
    - `coordinates`: (rows, unknowns).
    - `mask`: (rows,), which of the rows that are needed, by default all; predictions of the others are NaN, their slopes 0.

    **Returns:** a `Linearised`.
    """
    problem = density.problem
    points = np.asarray(coordinates, float)
    points = points if mask is None else np.where(mask[:, None], points, np.nan)
    if problem.step is None:
        prediction, slopes = _in_parts(lambda part: _differentiated(problem, part), points, ROWS_WITH_SLOPES)
    else:
        rows, unknowns = points.shape
        offsets = problem.step * np.concatenate([np.zeros((1, unknowns)), np.eye(unknowns), -np.eye(unknowns)])
        moved = predictions(problem, (points[:, None] + offsets).reshape(-1, unknowns))
        values, above, below = np.split(moved.reshape(rows, len(offsets), -1), [1, 1 + unknowns], axis=1)
        with np.errstate(invalid="ignore"):
            slopes = np.moveaxis(above - below, 1, -1) / (2.0 * problem.step)
        # If a side has no prediction, the slope is 0.
        prediction, slopes = values[:, 0], np.where(np.isfinite(slopes), slopes, 0.0)
    return weighed(density, coordinates, prediction, np.where(problem.acts, slopes, 0.0))


def weighed(
    density: "LogDensity", coordinates: Rows, prediction: Predictions, slopes: Slopes | None = None
) -> Linearised:
    """Predictions, and slopes if they are known, compared with measurements and priors; without a run."""
    slopes = np.zeros((*prediction.shape, coordinates.shape[1])) if slopes is None else slopes
    residual, by_prediction, root = compared(density.measurements, prediction)
    prior, by_coordinate = map(np.asarray, density.problem.unknowns.prior_residuals(jnp.asarray(coordinates, float)))
    of_all = (np.concatenate([factor[..., None] * slopes, by_coordinate], axis=1) for factor in (by_prediction, root))
    return Linearised(coordinates, prediction, slopes, np.concatenate([residual, prior], axis=1), *of_all)


def compared(measurements: Measurements, prediction: Predictions) -> list[np.ndarray]:
    """Residuals, their slopes with respect to the predictions, and the roots of the expected information.

    All are element by element. Lists of one length let one program serve all fits.
    """

    def listed(values: ArrayLike) -> np.ndarray:
        values = np.broadcast_to(np.asarray(values), prediction.shape).ravel()
        return np.pad(values, (0, -values.size % COMPARED), mode="edge").reshape(-1, COMPARED)

    lists = jax.tree.map(listed, (measurements, prediction))
    # The program of limits takes three times as long to compile.
    has_limits = bool(np.any(measurements.censored))
    rows = [jax.tree.map(lambda values, k=k: values[k], lists) for k in range(len(lists[1]))]
    parts = [_residuals(measured, predicted, has_limits) for measured, predicted in rows]
    return [np.concatenate(values)[: prediction.size].reshape(prediction.shape) for values in zip(*parts, strict=True)]


@eqx.filter_jit
def _residuals(measurements: Measurements, prediction: Float[Array, " n"], has_limits: bool) -> tuple[Array, ...]:
    ones = jnp.ones_like(prediction)
    residual, slope = jax.jvp(lambda value: measurements.residuals(value, has_limits), (prediction,), (ones,))
    return residual, slope, measurements.roots_of_information(prediction, slope)


# The posterior of parameters, as a function of unbounded coordinates for any sampler.


class LogDensity(eqx.Module):
    """The log of a posterior density, up to a constant, as a function of coordinates (unknowns,) without bounds.

    You can differentiate it in forward and reverse mode, compile it, and batch it with `jax.vmap`, so that the runs of
    all chains advance together; only for tops with several modes, it has values alone. Unknown errors are also unknowns:
    the coordinate of each is its logarithm, with a flat prior. Where the model has no prediction, the value is about
    -1e8, without a slope.

    - `names`: names of the unknowns, in the order of the coordinates; `start`: (unknowns,), coordinates at which to
      start.
    - `units`: name of an unknown -> its unit, if known; `unit`: the units in which texts and pictures show the unknowns.
    - `series_units`: the unit of each series of the measurements, if known; `series_shown`: the unit that is shown.

    **Example:** that of the subpackage's example.

    >>> LogDensity.of(decay, measured, free)
    LogDensity of rate, given 3 measurements
    """

    problem: Problem
    measurements: Measurements
    open_series: tuple[int, ...] = eqx.field(static=True)
    series_units: tuple[str, ...] = eqx.field(static=True, default=())
    series_shown: tuple[str, ...] = eqx.field(static=True, default=())
    own_units: tuple[str, ...] = eqx.field(static=True, default=())
    unit: tuple[str, ...] = eqx.field(static=True, default=())

    def __repr__(self) -> str:
        return f"LogDensity of {', '.join(self.names)}, given {self.measurements.value.size} measurements"

    @classmethod
    def of(
        cls,
        model: Model,
        measurements: Measurements,
        free: Mapping[str, Free | float],
        priors: Mapping[str, Prior] | None = None,
        series_units: tuple[str, ...] = (),
        slopes: str = "exact",
    ) -> "LogDensity":
        """The posterior of a model.

        **Arguments:** `model`, `measurements`, `free`, `slopes`: as for `identify`; `priors`: as for `tippe.log_density`;
        `series_units`: the unit of each series of the measurements, if known.
        """
        unknowns = as_free(free)
        checked: dict[str, Any] = {}
        for name, prior in (priors or {}).items():
            if name not in unknowns:
                raise ValueError(f"priors: {name!r} must be one of {', '.join(unknowns)}")
            # Numbers become arguments of compiled programs; a function becomes part of them.
            if not callable(prior):
                checked[name] = as_gaussian(prior, unknowns[name].start, name)
            else:
                checked[name] = prior if isinstance(prior, eqx.Module) else jax.tree_util.Partial(prior)
        recorded = bool(np.any(measurements.time > 0.0))
        steps = {"exact": None, "differences": OF_RECORDING if recorded else DIFFERENCE}
        if not isinstance(slopes, str) or slopes not in steps:
            raise ValueError(f"slopes = {shown(slopes)} must be one of {', '.join(map(repr, steps))}")
        on_host, acts = getattr(model, "on_host", False), np.ones(len(unknowns), bool)
        problem = Problem(model, tuple(unknowns), Unknowns(unknowns, checked), steps[slopes], on_host, acts)
        open_series = tuple(np.unique(measurements.series[measurements.estimated]).tolist())
        return cls(problem, measurements, open_series, series_units)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the unknowns; the names of errors contain the number of their series."""
        return (*self.problem.names, *(f"error[{k}]" for k in self.open_series))

    @property
    def units(self) -> dict[str, str]:
        """The units of the unknowns, if known."""
        errors = {f"error[{k}]": self.series_units[k] for k in self.open_series if k < len(self.series_units)}
        return dict(zip(self.problem.names, self.own_units, strict=False)) | errors

    def written(self, name: str, *values: float, form: str = ".4g") -> str:
        """The value of an unknown, or a range, as text in the unit that is shown."""
        unit, factor = in_unit(self.units.get(name, "1"), self.unit)
        texts = dict.fromkeys(f"{factor * value:{form}}" for value in values)
        return f"{' to '.join(texts)} {readable_unit(unit)}".rstrip()

    @property
    def start(self) -> Float[Array, " unknowns"]:
        """The coordinates of the start."""
        unknowns = self.problem.unknowns
        return jnp.append(unknowns.coordinates(np.asarray(unknowns.start)), jnp.zeros(len(self.open_series)))

    def values(self, coordinates: Float[Array | np.ndarray, "... unknowns"]) -> dict[str, Float[Array, "..."]]:
        """The unknowns at given coordinates: name -> (...,).

        **Arguments:** `coordinates`: the coordinates of all unknowns, or only those of a fit, without the unknown
        errors; the errors then get their first guess.

        **Raises:** `ValueError` for another number of coordinates.
        """
        numbers, coordinates = len(self.problem.names), jnp.asarray(coordinates, float)
        if coordinates.shape[-1:] == (numbers,):
            padding = jnp.zeros((*coordinates.shape[:-1], len(self.open_series)))
            coordinates = jnp.concatenate([coordinates, padding], axis=-1)
        if coordinates.shape[-1:] != (len(self.names),):
            raise ValueError(
                f"coordinates of shape {coordinates.shape} must have {len(self.names)} numbers along the last axis: "
                f"{', '.join(self.names)}"
            )
        unknowns = self.problem.unknowns.values(coordinates[..., :numbers])
        # The first guesses of the unknown errors, one for each series.
        mask = [self.measurements.estimated & (self.measurements.series == k) for k in self.open_series]
        guesses = jnp.array([jnp.asarray(self.measurements.error)[jnp.argmax(series)] for series in mask])
        errors = guesses * jnp.exp(coordinates[..., numbers:])
        return dict(zip(self.names, jnp.moveaxis(jnp.concatenate([unknowns, errors], axis=-1), -1, 0), strict=True))

    def predict(self, coordinates: Float[Array | np.ndarray, "rows unknowns"]) -> Any:
        """The model's predictions for all measurements, (rows, n), at several sets of coordinates; NumPy arrays outside of
        transformations, also of a model that cannot be traced, and NaN for NaN.

        **Raises:** `ValueError` if the model does not return one prediction per measurement.
        """
        own = coordinates[:, : len(self.problem.names)]
        if is_traced((own, self)):
            return self.problem.predict(jnp.asarray(own))
        prediction, shape = predictions(self.problem, np.asarray(own)), (len(own), self.measurements.value.size)
        if prediction.shape != shape:
            raise ValueError(f"model must predict {shape} for {shape[0]} sets, not {prediction.shape}")
        return prediction

    @status_line("simulating")
    def replicate(self, coordinates: Float[Array, "rows unknowns"], seed: int = 0) -> Float[np.ndarray, "rows n"]:
        """New measurements drawn from the predictions and their errors; limits are replaced by values."""
        random, predicted = np.random.default_rng(seed), np.asarray(self.predict(coordinates))
        heavy = np.isfinite(freedom := self.measurements.student)
        noise = random.normal(size=predicted.shape)
        squares = random.chisquare(np.where(heavy, freedom, 1.0), predicted.shape)
        noise /= np.where(heavy, np.sqrt(squares / freedom), 1.0)
        errors = jax.vmap(lambda point: self._with_errors(point).error)(jnp.asarray(coordinates))
        return predicted + np.asarray(errors) * noise

    @status_line("simulating")
    def __call__(self, coordinates: Float[Array | np.ndarray, " unknowns"]) -> Float[Array, ""]:
        return self.of_prediction(jnp.asarray(coordinates), self.predict(jnp.asarray(coordinates)[None])[0])

    # Programs outside of the repository call this, and `_with_errors`.
    def log_priors(self, coordinates: Float[Array | np.ndarray, "rows unknowns"]) -> Float[Array, " rows"]:
        """The log prior densities at several sets of coordinates."""
        return self.problem.unknowns.log_priors(coordinates)

    def of_prediction(self, coordinates: Float[Array, " unknowns"], prediction: Float[Array, " n"]) -> Float[Array, ""]:
        """The log density at given coordinates, for given predictions of the model."""
        return self._with_errors(coordinates).log_likelihood(prediction) + self.problem.unknowns.log_prior(coordinates)

    @status_line("simulating")
    def value_and_gradient(
        self, coordinates: Float[Array | np.ndarray, "*batch unknowns"] | Sequence[float]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch unknowns"]]:
        """The log density and its gradient, at one point or at a list of them."""
        return _value_and_gradient(self, jnp.asarray(coordinates, float))

    def with_errors(self, errors: Float[Array | np.ndarray, " n"]) -> "LogDensity":
        """The density for measurements with other errors."""
        return eqx.tree_at(lambda density: density.measurements.error, self, errors)

    def _with_errors(self, coordinates: Float[Array, " unknowns"]) -> Measurements:
        errors = self.measurements.error
        for coordinate, series in zip(coordinates[len(self.problem.names) :], self.open_series, strict=True):
            mask = self.measurements.estimated & (self.measurements.series == series)
            errors = jnp.where(mask, errors * jnp.exp(coordinate), errors)
        return self.with_errors(errors).measurements


@eqx.filter_jit
def _value_and_gradient(density: LogDensity, coordinates: Float[Array, "*batch unknowns"]) -> tuple[Array, Array]:
    function = jax.value_and_grad(density)
    return function(coordinates) if coordinates.ndim == 1 else jax.vmap(function)(coordinates)
