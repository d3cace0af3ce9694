"""A model with its free parameters, and the posterior of these as a function of unbounded coordinates."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ..sweeps.running import workers
from ..terminal import status_line
from ..text import shown
from ..validation import is_traced
from .likelihood import Free, Measurements, Unknown, as_free, as_gaussian

# A model with its free parameters, and predictions with slopes, for many sets of parameters at once.

#: Coordinates of one point, of a point for each row, and of n points; a number for each point or measurement; and a covariance.
Coordinates = Float[np.ndarray, " unknowns"]
Rows = Float[np.ndarray, "rows unknowns"]
Points = Float[np.ndarray, "n unknowns"]
PerPoint = Float[np.ndarray, " n"]
Matrix = Float[np.ndarray, "unknowns unknowns"]

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
    - `names`, `unknowns`: the names of the free parameters, and the parameters.
    - `step`: `None` for automatic differentiation in forward mode; otherwise the step of central differences in the
      coordinates. The model then need not be differentiable, nor traceable if it has `on_host = True`.
    - `acts`: which unknowns act on a prediction; the slopes of the others are round-off, and set to zero.
    """

    model: Model
    names: tuple[str, ...] = eqx.field(static=True)
    unknowns: tuple[Unknown, ...]
    step: float | None = eqx.field(static=True)
    acts: Bool[np.ndarray, " unknowns"]

    def __init__(self, model: Model, free: Mapping[str, Free], step: float | None = None):
        self.model, self.step = model, step
        self.names = tuple(free)
        self.unknowns = tuple(map(Unknown.of, free.values()))
        self.acts = np.ones(len(free), bool)

    def values(self, coordinates: Float[Array | np.ndarray, "... unknowns"]) -> Any:
        """The parameters at given coordinates, a NumPy array for a NumPy array."""
        stack: Any = np.stack if isinstance(coordinates, np.ndarray) else jnp.stack
        return stack([unknown.value(coordinates[..., k]) for k, unknown in enumerate(self.unknowns)], axis=-1)

    @property
    def on_host(self) -> bool:
        """Whether the model cannot be traced."""
        return getattr(self.model, "on_host", False)

    def predict(self, coordinates: Float[Array, "rows unknowns"]) -> Float[Array, "rows n"]:
        """The model's predictions in every row.

        **Raises:** `ValueError` inside a transformation, if the model cannot be traced.
        """
        if self.on_host and is_traced(coordinates):
            raise ValueError(
                "a model of tops with several modes cannot be compiled or differentiated: use `sample`, or a sampler that "
                "needs values only"
            )
        values = self.values(coordinates)
        return self.model({name: values[:, k] for k, name in enumerate(self.names)})


class Linearised(NamedTuple):
    """A model and its likelihood at a point of every row.

    - `prediction`: (rows, n); `slopes`: (rows, n, unknowns), with respect to the coordinates.
    - `residual`: (rows, residuals), of the n data, then of the priors; `jacobian`: (rows, residuals, unknowns), its slopes.
    - `information`: the same with the expected curvature of the likelihood (`Measurements.roots_of_information`), for
      errors.
    """

    prediction: Float[np.ndarray, "rows n"]
    slopes: Float[np.ndarray, "rows n unknowns"]
    residual: Float[np.ndarray, "rows residuals"]
    jacobian: Float[np.ndarray, "rows residuals unknowns"]
    information: Float[np.ndarray, "rows residuals unknowns"]

    @property
    def deviance(self) -> Float[np.ndarray, " rows"]:
        """-2 log posterior of every row, up to a constant; infinite where the model failed."""
        of_data, of_priors = np.split(self.residual, [self.prediction.shape[1]], axis=1)
        deviance = np.sum(of_data**2, axis=1) + np.sum(of_priors**2, axis=1)
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


def predictions_and_slopes(
    problem: Problem, coordinates: Rows, mask: Bool[np.ndarray, " rows"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Predictions and their slopes, for every row of coordinates.

    **Arguments:** `coordinates`: (rows, unknowns); `mask`: (rows,), which of the rows that are needed, by default
    all.

    **Returns:** (rows, n) and (rows, n, unknowns); NaN and 0 for rows that are not needed.
    """
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
    return prediction, np.where(problem.acts, slopes, 0.0)


def predictions(problem: Problem, coordinates: Rows) -> np.ndarray:
    """Predictions without slopes, for every row of coordinates; rows of NaN take no time."""
    predict, rows = Problem.predict if problem.on_host else _predicted, ROWS_OF_CALL
    if problem.on_host and len(problem.names) == 1:
        # Rounds are small, and calls take nearly as long for fewer rows: the cores share a round.
        rows = ROWS_OF_CALL // 2
    return _in_parts(lambda part: (predict(problem, jnp.asarray(part)),), coordinates, rows)[0]


def _in_parts(
    function: Callable[[Rows], tuple[Array, ...]], coordinates: Rows, rows_of_part: int
) -> tuple[np.ndarray, ...]:
    """The results of a function of some rows for all rows; the cores share its calls, an accelerator has a single one.

    The program is compiled for a fixed number of rows. Runs of rows of NaN end at once.
    """
    cores = workers()
    rows = rows_of_part if jax.default_backend() == "cpu" else MOST_ROWS
    padding = np.full((-len(coordinates) % rows, coordinates.shape[1]), np.nan)
    parts = np.concatenate([coordinates, padding]).reshape(-1, rows, coordinates.shape[1])
    with ThreadPoolExecutor(cores) as threads:
        # A single core stays in this thread, in which JAX's contexts hold, such as that of `jax.default_device`.
        each = threads.map if cores > 1 else map
        results = zip(*each(lambda part: [np.asarray(result) for result in function(part)], parts), strict=True)
        return tuple(np.concatenate(result)[: len(coordinates)] for result in results)


def linearise(
    problem: Problem, coordinates: Rows, measurements: Measurements, mask: Bool[np.ndarray, " rows"] | None = None
) -> Linearised:
    """Predictions, residuals and their slopes.

    **Arguments:**

    - `problem`: the `Problem`.
    - `coordinates`: (rows, unknowns); `mask`: as for `predictions_and_slopes`.
    - `measurements`: `Measurements` of shape (n,) or (rows, n).

    **Returns:** a `Linearised`.
    """
    return weighed(problem, coordinates, *predictions_and_slopes(problem, coordinates, mask), measurements)


def weighed(
    problem: Problem,
    coordinates: Rows,
    prediction: Float[np.ndarray, "rows n"],
    slopes: Float[np.ndarray, "rows n unknowns"],
    measurements: Measurements,
) -> Linearised:
    """Predictions and slopes, compared with measurements and priors; without a run."""
    residual, by_prediction, root = compared(measurements, prediction)
    prior, by_coordinate = map(np.asarray, _priors(problem.unknowns, jnp.asarray(coordinates, float)))
    of_all = (np.concatenate([factor[..., None] * slopes, by_coordinate], axis=1) for factor in (by_prediction, root))
    return Linearised(prediction, slopes, np.concatenate([residual, prior], axis=1), *of_all)


def deviances(
    problem: Problem, coordinates: Rows, prediction: Float[np.ndarray, "rows n"], measurements: Measurements
) -> Float[np.ndarray, " rows"]:
    """-2 log posterior in every row, up to a constant, from the predictions of the rows."""
    residual = compared(measurements, prediction)[0]
    prior = np.asarray(_priors(problem.unknowns, jnp.asarray(coordinates, float))[0])
    return np.sum(residual**2, axis=1) + np.sum(prior**2, axis=1)


def compared(measurements: Measurements, prediction: Float[np.ndarray, "rows n"]) -> list[np.ndarray]:
    """Residuals, their slopes with respect to the predictions, and the roots of the expected information.

    All are element by element. Lists of one length let one program serve all fits.
    """

    def listed(values: ArrayLike) -> np.ndarray:
        values = np.broadcast_to(np.asarray(values), prediction.shape).ravel()
        return np.pad(values, (0, -values.size % COMPARED), mode="edge").reshape(-1, COMPARED)

    lists = jax.tree.map(listed, (measurements, prediction))
    parts = [_residuals(*jax.tree.map(lambda values, k=k: values[k], lists)) for k in range(len(lists[1]))]
    results = [np.concatenate(values)[: prediction.size] for values in zip(*parts, strict=True)]
    return [values.reshape(prediction.shape) for values in results]


@eqx.filter_jit
def _residuals(measurements: Measurements, prediction: Float[Array, " n"]) -> tuple[Array, Array, Array]:
    residual, slope = jax.jvp(measurements.residuals, (prediction,), (jnp.ones_like(prediction),))
    return residual, slope, measurements.roots_of_information(prediction, slope)


@eqx.filter_jit
def _priors(unknowns: tuple[Unknown, ...], coordinates: Float[Array, "rows unknowns"]) -> tuple[Array, Array]:
    """Residuals of the priors, and their slopes with respect to the coordinates."""

    def of(row: Float[Array, " unknowns"]) -> Float[Array, " priors"]:
        priors = [
            (unknown.value(row[k]), *unknown.prior) for k, unknown in enumerate(unknowns) if unknown.prior is not None
        ]
        return jnp.array([(value - mean) / deviation for value, mean, deviation in priors])

    return jax.vmap(of)(coordinates), jax.vmap(jax.jacfwd(of))(coordinates)


# The posterior of parameters, as a function of unbounded coordinates for any sampler.

#: The log density of a parameter: (mean, standard deviation) of a Gaussian, only the standard deviation, or a function of the
#: parameter.
Prior = tuple[float, float] | float | Callable[[Float[Array, ""]], Float[Array, ""]]


class LogDensity(eqx.Module):
    """The log of a posterior density, up to a constant, as a function of coordinates (unknowns,) without bounds.

    You can differentiate it in forward and reverse mode, compile it, and batch it with `jax.vmap`, so that the runs of
    all chains advance together; only for tops with several modes, it has values alone. Unknown errors are also unknowns:
    the coordinate of each is its logarithm, with a flat prior. Where the model has no prediction, the value is about
    -1e8, without a slope.

    - `names`: names of the unknowns, in the order of the coordinates; `start`: (unknowns,), coordinates at which to
      start.
    - `units`: name of an unknown -> its unit, if known.

    **Example:** that of the subpackage's example.

    >>> LogDensity.of(decay, measured, free)
    LogDensity of rate, given 3 measurements
    """

    problem: Problem
    measurements: Measurements
    priors: dict[str, Any]
    open_series: tuple[int, ...] = eqx.field(static=True)
    series_units: tuple[str, ...] = eqx.field(static=True, default=())

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
        of_unknowns = {name: unknown.prior for name, unknown in unknowns.items() if unknown.prior is not None}
        leaves: dict[str, Any] = {}
        for name, prior in (of_unknowns | dict(priors or {})).items():
            if name not in unknowns:
                raise ValueError(f"priors: {name!r} must be one of {', '.join(unknowns)}")
            # Numbers become arguments of compiled programs; a function becomes part of them.
            if not callable(prior):
                leaves[name] = np.asarray(as_gaussian(prior, unknowns[name].start, name), float)
            else:
                leaves[name] = prior if isinstance(prior, eqx.Module) else jax.tree_util.Partial(prior)
        series, estimated = np.asarray(measurements.series), np.asarray(measurements.estimated)
        recorded = bool(np.any(np.asarray(measurements.time) > 0.0))
        steps = {"exact": None, "differences": OF_RECORDING if recorded else DIFFERENCE}
        if not isinstance(slopes, str) or slopes not in steps:
            raise ValueError(f"slopes = {shown(slopes)} must be one of {', '.join(map(repr, steps))}")
        problem = Problem(model, unknowns, steps[slopes])
        open_series = tuple(np.unique(series[estimated]).tolist())
        return cls(problem, measurements, leaves, open_series, series_units)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the unknowns; the names of errors contain the number of their series."""
        return (*self.problem.names, *(f"error[{k}]" for k in self.open_series))

    @property
    def units(self) -> dict[str, str]:
        """The units of the unknown errors, if known."""
        units = {k: self.series_units[k] for k in self.open_series if k < len(self.series_units)}
        return {f"error[{k}]": unit for k, unit in units.items()}

    @property
    def start(self) -> Float[Array, " unknowns"]:
        """The coordinates of the start."""
        values = [float(unknown.coordinate(unknown.start)) for unknown in self.problem.unknowns]
        return jnp.array([*values, *(0.0 for _ in self.open_series)])

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
        unknowns = self.problem.values(coordinates[..., :numbers])
        # The first guesses of the unknown errors, one for each series.
        mask = [self.measurements.estimated & (self.measurements.series == k) for k in self.open_series]
        guesses = jnp.array([self.measurements.error[jnp.argmax(series)] for series in mask])
        errors = guesses * jnp.exp(coordinates[..., numbers:])
        return dict(zip(self.names, jnp.moveaxis(jnp.concatenate([unknowns, errors], axis=-1), -1, 0), strict=True))

    def predict(self, coordinates: Float[Array, "rows unknowns"]) -> Float[Array, "rows n"]:
        """The model's predictions for all measurements, at several sets of coordinates."""
        if self.problem.on_host and not is_traced(coordinates):
            # By the program of a fit, for whatever number of rows.
            return jnp.asarray(self.predictions(np.asarray(coordinates)))
        return self.problem.predict(coordinates[:, : len(self.problem.names)])

    def predictions(self, coordinates: Rows) -> Float[np.ndarray, "rows n"]:
        """The predictions of the model as NumPy arrays, also of a model that cannot be traced; NaN for NaN.

        **Raises:** `ValueError` if the model does not return one prediction per measurement.
        """
        prediction = predictions(self.problem, coordinates[:, : len(self.problem.names)])
        shape = (len(coordinates), self.measurements.value.size)
        if prediction.shape != shape:
            raise ValueError(f"model must predict {shape} for {shape[0]} sets, not {prediction.shape}")
        return prediction

    def log_priors(self, coordinates: Rows) -> Float[np.ndarray, " rows"]:
        """The log density of the priors in the coordinates, in every row."""
        # In the order of the coordinates; JAX would sort a dictionary by its keys.
        priors = tuple(map(self.priors.get, self.problem.names))
        return np.asarray(_log_priors(self.problem.unknowns, priors, coordinates))

    @status_line("simulating")
    def replicate(self, coordinates: Float[Array, "rows unknowns"], seed: int = 0) -> Float[np.ndarray, "rows n"]:
        """New measurements drawn from the predictions and their errors; limits are replaced by values."""
        random, predicted = np.random.default_rng(seed), self.predictions(np.asarray(coordinates))
        heavy = np.isfinite(freedom := np.asarray(self.measurements.student))
        noise = random.normal(size=predicted.shape)
        noise /= np.where(
            heavy, np.sqrt(random.chisquare(np.where(heavy, freedom, 1.0), predicted.shape) / freedom), 1.0
        )
        errors = jax.vmap(lambda point: self._with_errors(point).error)(jnp.asarray(coordinates))
        return predicted + np.asarray(errors) * noise

    @status_line("simulating")
    def __call__(self, coordinates: Float[Array | np.ndarray, " unknowns"]) -> Float[Array, ""]:
        return self.of_prediction(jnp.asarray(coordinates), self.predict(jnp.asarray(coordinates)[None])[0])

    def of_prediction(self, coordinates: Float[Array, " unknowns"], prediction: Float[Array, " n"]) -> Float[Array, ""]:
        """The log density at given coordinates, for given predictions of the model."""
        priors = tuple(map(self.priors.get, self.problem.names))
        log_prior = _log_prior(self.problem.unknowns, priors, coordinates)
        return self._with_errors(coordinates).log_likelihood(prediction) + log_prior

    @status_line("simulating")
    def value_and_gradient(
        self, coordinates: Float[Array | np.ndarray, "*batch unknowns"] | Sequence[float]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch unknowns"]]:
        """The log density and its gradient, at one point or at a list of them."""
        return _value_and_gradient(self, jnp.asarray(coordinates, float))

    def _with_errors(self, coordinates: Float[Array, " unknowns"]) -> Measurements:
        errors = self.measurements.error
        for coordinate, series in zip(coordinates[len(self.problem.names) :], self.open_series, strict=True):
            mask = self.measurements.estimated & (self.measurements.series == series)
            errors = jnp.where(mask, errors * jnp.exp(coordinate), errors)
        return self.measurements.with_errors(errors)


def _log_prior(
    unknowns: tuple[Unknown, ...], priors: tuple[Any, ...], coordinates: Float[Array, " unknowns"]
) -> Float[Array, ""]:
    """The log density of the priors in the coordinates: the density of each parameter, and the Jacobian of its
    coordinate. The coordinates of unknown errors, which come last, have a flat prior."""
    total = jnp.zeros(())
    for unknown, prior, coordinate in zip(unknowns, priors, coordinates[: len(unknowns)], strict=True):
        if prior is not None:
            value, slope = jax.value_and_grad(unknown.value)(coordinate)
            if callable(prior):
                log_density: Any = prior(value)
            else:
                mean, deviation = prior
                log_density = -0.5 * ((value - mean) / deviation) ** 2 - jnp.log(deviation * math.sqrt(2.0 * math.pi))
            total += log_density + jnp.log(jnp.abs(slope))
        elif unknown.has_lower and unknown.has_upper:
            # Uniform between two bounds; in the coordinate, the prior would have no finite integral.
            total += jnp.log(jnp.abs(jax.grad(unknown.value)(coordinate)))
    return total


# Without the data, so that one program serves all fits of the same unknowns.
_log_priors = eqx.filter_jit(eqx.filter_vmap(_log_prior, in_axes=(None, None, 0)))


@eqx.filter_jit
def _value_and_gradient(density: LogDensity, coordinates: Float[Array, "*batch unknowns"]) -> tuple[Array, Array]:
    function = jax.value_and_grad(density)
    return function(coordinates) if coordinates.ndim == 1 else jax.vmap(function)(coordinates)
