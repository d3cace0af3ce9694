"""The posterior of parameters, as a function of unbounded coordinates for any sampler."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..progress import status_line
from ..validation import is_traced, require, shown
from .likelihood import Measurements
from .problem import Problem, predictions, step_of
from .unknown import Unknown, as_free, as_gaussian

#: The log density of a parameter: (mean, standard deviation) of a Gaussian, or a function of the parameter.
Prior = tuple[float, float] | Callable[[Float[Array, ""]], Float[Array, ""]]


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
        model: Callable[[dict[str, Float[Array, " rows"]]], Float[Array, "rows n"]],
        measurements: Measurements,
        free: Any,
        priors: Any = None,
        series_units: tuple[str, ...] = (),
        slopes: str = "exact",
    ) -> "LogDensity":
        """The posterior of a model.

        **Arguments:** `model`, `measurements`, `free`, `slopes`: as for `identify`; `priors`: as for `tippe.log_density`;
        `series_units`: the unit of each series of the measurements, if known.
        """
        unknowns = as_free(free)
        of_unknowns = {name: unknown.prior for name, unknown in unknowns.items() if unknown.prior is not None}
        all_priors: dict[str, Any] = of_unknowns | dict(priors or {})
        for name, prior in all_priors.items():
            if name not in unknowns:
                raise ValueError(f"priors: {name!r} must be one of {', '.join(unknowns)}")
            if not callable(prior):
                if np.shape(prior) not in ((), (2,)):
                    raise ValueError(
                        f"priors: {name!r} = {shown(prior)} must be a mean and a standard deviation, only the standard "
                        "deviation, or a function"
                    )
                all_priors[name] = prior = as_gaussian(prior, unknowns[name].start)
                require(prior[1], f"standard deviation of the prior of {name}", above=0.0)
        series, estimated = np.asarray(measurements.series), np.asarray(measurements.estimated)
        leaves = {name: _as_leaves(prior) for name, prior in all_priors.items()}
        problem = Problem(model, tuple(unknowns.items()), step_of(slopes, measurements))
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
    def _priors_in_order(self) -> tuple[Any, ...]:
        """The prior of every unknown or `None`, in the order of the coordinates; JAX would sort a dictionary by its keys."""
        return tuple(self.priors.get(name) for name in self.problem.names)

    @property
    def proper(self) -> Bool[np.ndarray, " unknowns"]:
        """Which unknowns have a prior, or lie between two bounds: the data need not determine them."""
        pairs = zip(self.problem.unknowns, self._priors_in_order, strict=True)
        return np.array([prior is not None or (u.has_lower and u.has_upper) for u, prior in pairs])

    @property
    def _first_errors(self) -> Float[Array, " errors"]:
        """The first guesses of the unknown errors, one for each series."""
        mask = [self.measurements.estimated & (self.measurements.series == k) for k in self.open_series]
        return jnp.array([self.measurements.error[jnp.argmax(series)] for series in mask])

    @property
    def start(self) -> Float[Array, " unknowns"]:
        """The coordinates of the start."""
        values = [float(unknown.coordinate(unknown.start)) for unknown in self.problem.unknowns]
        return jnp.array([*values, *(0.0 for _ in self.open_series)])

    def values(self, coordinates: Float[Array, "... unknowns"]) -> dict[str, Float[Array, "..."]]:
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
        errors = self._first_errors * jnp.exp(coordinates[..., numbers:])
        return dict(zip(self.names, jnp.moveaxis(jnp.concatenate([unknowns, errors], axis=-1), -1, 0), strict=True))

    def predict(self, coordinates: Float[Array, "rows unknowns"]) -> Float[Array, "rows n"]:
        """The model's predictions for all measurements, at several sets of coordinates."""
        if self.problem.on_host and not is_traced(coordinates):
            # By the program of a fit, for whatever number of rows.
            return jnp.asarray(self.predictions(np.asarray(coordinates)))
        return self.problem.predict(coordinates[:, : len(self.problem.names)])

    def predictions(self, coordinates: Float[np.ndarray, "rows unknowns"]) -> Float[np.ndarray, "rows n"]:
        """The predictions of the model as NumPy arrays, also of a model that cannot be traced; NaN for NaN.

        **Raises:** `ValueError` if the model does not return one prediction per measurement.
        """
        prediction = predictions(self.problem, coordinates[:, : len(self.problem.names)])
        shape = (len(coordinates), self.measurements.value.size)
        if prediction.shape != shape:
            raise ValueError(f"model must predict {shape} for {shape[0]} sets, not {prediction.shape}")
        return prediction

    def log_priors(self, coordinates: Float[np.ndarray, "rows unknowns"]) -> Float[np.ndarray, " rows"]:
        """The log density of the priors in the coordinates, in every row."""
        return np.asarray(_log_priors(self.problem.unknowns, self._priors_in_order, coordinates))

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
    def __call__(self, coordinates: Float[Array, " unknowns"]) -> Float[Array, ""]:
        return self.of_prediction(coordinates, self.predict(coordinates[None])[0])

    def of_prediction(self, coordinates: Float[Array, " unknowns"], prediction: Float[Array, " n"]) -> Float[Array, ""]:
        """The log density at given coordinates, for given predictions of the model."""
        return self._with_errors(coordinates).log_likelihood(prediction) + _log_prior(
            self.problem.unknowns, self._priors_in_order, coordinates
        )

    @status_line("simulating")
    def value_and_gradient(
        self, coordinates: Float[Array, "*batch unknowns"]
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
            log_density: Any = prior(value) if callable(prior) else _normal(value, *prior)
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


def _as_leaves(prior: Prior) -> Any:
    """Convert a prior: its numbers become arguments of compiled programs; its function, if any, becomes part of
    them."""
    if not callable(prior):
        return np.asarray(prior, float)
    return prior if isinstance(prior, eqx.Module) else jax.tree_util.Partial(prior)


def _normal(value: Float[Array, ""], mean: Float[Array, ""], deviation: Float[Array, ""]) -> Float[Array, ""]:
    """Logarithm of the normal density. `jax.scipy.stats` has it, too, but takes 0.15 s to import."""
    return -0.5 * ((value - mean) / deviation) ** 2 - jnp.log(deviation * math.sqrt(2.0 * math.pi))
