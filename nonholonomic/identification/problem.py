"""A model with its free parameters, and predictions with slopes, for many sets of parameters at once."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..sweeps.running import workers
from ..validation import is_traced, shown
from .likelihood import Measurements
from .unknown import Free, Unknown

Rows = Float[np.ndarray, "rows unknowns"]

#: Number of rows in a call of a model without and with slopes; on an accelerator.
ROWS_OF_CALL, ROWS_WITH_SLOPES, MOST_ROWS = 64, 8, 512

#: Number of predictions that are compared with measurements at once.
COMPARED = 4096

#: Step of differences in the coordinates: 1 % of a positive parameter. Differences smooth over narrower structure. The
#: valleys of recordings are narrower, and their predictions are smooth.
DIFFERENCE, OF_RECORDING = 0.01, 3e-4


def step_of(slopes: str, measurements: Measurements) -> float | None:
    """The step of the differences for a kind of slopes; `None` for automatic differentiation.

    **Raises:** `ValueError` for an unknown kind.
    """
    recorded = bool(np.any(np.asarray(measurements.time) > 0.0))
    ways = {"exact": None, "differences": OF_RECORDING if recorded else DIFFERENCE}
    if not isinstance(slopes, str) or slopes not in ways:
        raise ValueError(f"slopes = {shown(slopes)} must be one of {', '.join(map(repr, ways))}")
    return ways[slopes]


class Problem(eqx.Module):
    """A model and its free parameters.

    - `model`: parameters, name -> (rows,), to predictions (rows, n).
    - `names`, `unknowns`: the names of the free parameters, and the parameters; `free` combines both.
    - `step`: `None` for automatic differentiation in forward mode; otherwise the step of central differences in the
      coordinates. The model then need not be differentiable, nor traceable if it has `on_host = True`.
    - `acts`: which unknowns act on a prediction; the slopes of the others are round-off, and set to zero.
    """

    model: Callable[[dict[str, Float[Array, " rows"]]], Float[Array, "rows n"]]
    names: tuple[str, ...] = eqx.field(static=True)
    unknowns: tuple[Unknown, ...]
    step: float | None = eqx.field(static=True)
    acts: Bool[np.ndarray, " unknowns"]

    def __init__(self, model: Callable[..., Any], free: tuple[tuple[str, Free], ...], step: float | None = None):
        self.model, self.step = model, step
        self.names = tuple(name for name, _ in free)
        self.unknowns = tuple(Unknown.of(unknown) for _, unknown in free)
        self.acts = np.ones(len(free), bool)

    @property
    def free(self) -> tuple[tuple[str, Unknown], ...]:
        """The free parameters, each with its name."""
        return tuple(zip(self.names, self.unknowns, strict=True))

    def values(self, coordinates: Float[Array | np.ndarray, "... unknowns"]) -> Any:
        """The parameters at given coordinates, a NumPy array for a NumPy array."""
        stack: Any = np.stack if isinstance(coordinates, np.ndarray) else jnp.stack
        return stack([unknown.value(coordinates[..., k]) for k, unknown in enumerate(self.unknowns)], axis=-1)

    def slopes(self, coordinates: Float[np.ndarray, " unknowns"]) -> Float[np.ndarray, " unknowns"]:
        """The slopes of the parameters with respect to their coordinates."""
        pairs = zip(coordinates, self.unknowns, strict=True)
        return np.array([float(jax.grad(unknown.value)(coordinate)) for coordinate, unknown in pairs])

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

    - `prediction`: (rows, n); `residual`: (rows, n), of the data;
    - `jacobian`: (rows, n, unknowns), slopes of the residuals with respect to the coordinates;
    - `information`: the same with the expected curvature of the likelihood (`Measurements.information`), for errors;
    - `prior`, `prior_jacobian`: (rows, priors), (rows, priors, unknowns), of the priors.
    """

    prediction: Float[np.ndarray, "rows n"]
    residual: Float[np.ndarray, "rows n"]
    jacobian: Float[np.ndarray, "rows n unknowns"]
    information: Float[np.ndarray, "rows n unknowns"]
    prior: Float[np.ndarray, "rows priors"]
    prior_jacobian: Float[np.ndarray, "rows priors unknowns"]

    @property
    def deviance(self) -> Float[np.ndarray, " rows"]:
        """-2 log posterior of every row, up to a constant."""
        return np.sum(self.residual**2, axis=-1) + np.sum(self.prior**2, axis=-1)

    @property
    def whole_residual(self) -> Float[np.ndarray, "rows residuals"]:
        """The residuals of data and priors."""
        return np.concatenate([self.residual, self.prior], axis=1)

    @property
    def whole_jacobian(self) -> Float[np.ndarray, "rows residuals unknowns"]:
        """The slopes of data and priors."""
        return np.concatenate([self.jacobian, self.prior_jacobian], axis=1)

    @property
    def whole_information(self) -> Float[np.ndarray, "rows residuals unknowns"]:
        """The slopes of data and priors that represent the expected curvature."""
        return np.concatenate([self.information, self.prior_jacobian], axis=1)


@eqx.filter_jit
def _differentiated(
    problem: Problem, coordinates: Float[Array | np.ndarray, "rows unknowns"]
) -> tuple[Float[Array, "rows n"], Float[Array, "rows n unknowns"]]:
    """Predictions and their slopes; rows are independent, so a coordinate is moved in all of them at once."""

    def along(direction):
        return jax.jvp(problem.predict, (coordinates,), (jnp.broadcast_to(direction, coordinates.shape),))

    values, slopes = jax.vmap(along, out_axes=(0, -1))(jnp.eye(coordinates.shape[-1]))
    return values[0], jnp.where(jnp.isfinite(slopes), slopes, 0.0)


_predicted = eqx.filter_jit(Problem.predict)


def _differences(problem: Problem, step: float, coordinates: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Predictions and central differences; if a side has no prediction, its slope is 0."""
    rows, unknowns = coordinates.shape
    offsets = step * np.concatenate([np.zeros((1, unknowns)), np.eye(unknowns), -np.eye(unknowns)])
    moved = predictions(problem, (coordinates[:, None] + offsets).reshape(-1, unknowns))
    values, values_above, values_below = np.split(moved.reshape(rows, len(offsets), -1), [1, 1 + unknowns], axis=1)
    with np.errstate(invalid="ignore"):
        slopes = np.moveaxis(values_above - values_below, 1, -1) / (2.0 * step)
    return values[:, 0], np.where(np.isfinite(slopes), slopes, 0.0)


def predictions_and_slopes(problem: Problem, coordinates: Rows, mask: Any = None) -> tuple[np.ndarray, np.ndarray]:
    """Predictions and their slopes, for every row of coordinates.

    **Arguments:** `coordinates`: (rows, unknowns); `mask`: (rows,), which of the rows that are needed, by default
    all.

    **Returns:** (rows, n) and (rows, n, unknowns); NaN and 0 for rows that are not needed.
    """
    coordinates = np.asarray(coordinates, float)
    mask = np.ones(len(coordinates), bool) if mask is None else np.asarray(mask)
    points = np.where(mask[:, None], coordinates, np.nan)
    if problem.step is None:
        prediction, slopes = _in_parts(lambda part: _differentiated(problem, part), points, ROWS_WITH_SLOPES)
    else:
        prediction, slopes = _differences(problem, problem.step, points)
    return prediction, np.where(problem.acts, slopes, 0.0)


def compile_slopes(problem: Problem) -> None:
    """Compile the program of `predictions_and_slopes`, unless it uses that of `predictions`."""
    if problem.step is None:
        predictions_and_slopes(problem, np.full((1, len(problem.names)), np.nan))


def predictions(problem: Problem, coordinates: Rows) -> np.ndarray:
    """Predictions without slopes, for every row of coordinates; rows of NaN take no time."""
    predict = Problem.predict if problem.on_host else _predicted
    return _in_parts(lambda part: (predict(problem, jnp.asarray(part)),), coordinates, ROWS_OF_CALL)[0]


def _in_parts(
    function: Callable[[Rows], tuple[Any, ...]], coordinates: Rows, rows_of_part: int
) -> tuple[np.ndarray, ...]:
    """The results of a function of some rows for all rows; the cores share its calls, an accelerator has a single one.

    The program is compiled for a fixed number of rows. Runs of rows of NaN end at once.
    """
    cores = workers()
    rows = rows_of_part if jax.default_backend() == "cpu" else MOST_ROWS
    padding = np.full((-len(coordinates) % rows, coordinates.shape[1]), np.nan)
    parts = np.concatenate([coordinates, padding]).reshape(-1, rows, coordinates.shape[1])

    def of_part(part: Rows) -> list[np.ndarray]:
        return [np.asarray(result) for result in function(part)]

    with ThreadPoolExecutor(cores) as threads:
        # A single core stays in this thread, in which JAX's contexts hold, such as that of `jax.default_device`.
        results = zip(*(threads.map if cores > 1 else map)(of_part, parts), strict=True)
        return tuple(np.concatenate(result)[: len(coordinates)] for result in results)


def linearise(problem: Problem, coordinates: Any, measurements: Measurements, mask: Any = None) -> Linearised:
    """Predictions, residuals and their slopes.

    **Arguments:**

    - `problem`: the `Problem`.
    - `coordinates`: (rows, unknowns); `mask`: as for `predictions_and_slopes`.
    - `measurements`: `Measurements` of shape (n,) or (rows, n).

    **Returns:** a `Linearised`.

    **Raises:** `ValueError` if the model does not return one prediction per measurement.
    """
    prediction, slopes = predictions_and_slopes(problem, coordinates, mask)
    shape = (len(coordinates), measurements.value.shape[-1])
    if prediction.shape != shape:
        raise ValueError(f"model must predict {shape} for {shape[0]} sets, not {prediction.shape}")
    residual, by_prediction, root = compared(measurements, prediction)
    prior, by_coordinate = map(np.asarray, _priors(problem.unknowns, jnp.asarray(coordinates, float)))
    return Linearised(
        prediction, residual, by_prediction[..., None] * slopes, root[..., None] * slopes, prior, by_coordinate
    )


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

    def listed(values: Any) -> np.ndarray:
        values = np.broadcast_to(np.asarray(values), prediction.shape).ravel()
        return np.pad(values, (0, -values.size % COMPARED), mode="edge").reshape(-1, COMPARED)

    lists = jax.tree.map(listed, (measurements, prediction))
    parts = [_residuals(*jax.tree.map(lambda values, k=k: values[k], lists)) for k in range(len(lists[1]))]
    results = [np.concatenate(values)[: prediction.size] for values in zip(*parts, strict=True)]
    return [values.reshape(prediction.shape) for values in results]


@eqx.filter_jit
def _residuals(measurements: Measurements, prediction: Float[np.ndarray, " n"]) -> tuple[Array, Array, Array]:
    residual, slope = measurements.residuals_and_slopes(prediction)
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
