"""Common parts of the fits of tops, strollers and users' systems: sets of data, their predictions, and the search.

Each of these fits adds the names of its parameters and the prediction of a set of data.
"""

import abc
import dataclasses
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..parameters import full_name
from ..validation import shown
from .data import joined, of_data, own_name, series_units
from .identify import check_search, identify
from .posterior import LogDensity
from .result import Identification
from .unknown import Free

#: Parameters of one set of data, name -> (rows,).
Values = dict[str, Float[Array, " rows"]]


class AbstractDataModel(eqx.Module):
    """Predictions of several sets of data, in the form that `identify` expects.

    `seen`: indices of the predictions that were measured.

    **Example:** the predictions of the subpackage's example.

    >>> model = Model(scene, data, jnp.arange(3))
    >>> print(model({"scene.rate": jnp.array([1.0, 2.0])}).round(3))
    [[0.368 0.135 0.05 ]
     [0.135 0.018 0.002]]
    """

    data: eqx.AbstractVar[tuple[Any, ...]]
    seen: eqx.AbstractVar[Int[Array, " n"]]

    @property
    def recorded(self) -> tuple[Any, ...]:
        """The sets of data, for curves between their samples."""
        return self.data

    def with_recorded(self, recorded: tuple[Any, ...]) -> "AbstractDataModel":
        """The model of other sets of data of the same shapes."""
        return dataclasses.replace(self, data=recorded)

    def unit_of(self, name: str) -> str:
        """The unit of a parameter other than `t0`, by its name without the prefix `data[k].`; "1" if it is unknown."""
        return "1"

    @abc.abstractmethod
    def together(self, source: Any, values: Values) -> Hashable:
        """A key for a set of data; sets with equal keys can be predicted together."""

    @abc.abstractmethod
    def predict(self, sources: list[tuple[Any, Values]], rows: int) -> list[Float[Array, "rows size"]]:
        """The predictions for sets of data with the same `together`, each with its parameters."""

    def __call__(self, parameters: Values) -> Float[Array, "rows n"]:
        rows = len(next(iter(parameters.values())))
        values = [of_data(parameters, k) for k in range(len(self.data))]
        groups: dict[Hashable, list[int]] = {}
        for k, source in enumerate(self.data):
            groups.setdefault(self.together(source, values[k]), []).append(k)
        parts: dict[int, Array] = {}
        for data_of_kind in groups.values():
            predictions = self.predict([(self.data[k], values[k]) for k in data_of_kind], rows)
            parts |= dict(zip(data_of_kind, predictions, strict=True))
        return jnp.concatenate([parts[k] for k in range(len(self.data))], axis=1)[:, self.seen]


def as_sources(data: Any, kinds: Any, expected: str) -> tuple[Any, ...]:
    """Sets of data as a tuple.

    **Arguments:** `data`: a set or several; `kinds`: a class or several; `expected`: words for the message.

    **Raises:** `ValueError` that names the allowed kinds, unless there is at least one set of data and all sets are of
    these kinds.

    **Example:**

    >>> from nonholonomic.identification import as_sources
    >>> len(as_sources(data[0], Recording, "a Recording"))
    1
    """
    sources = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not sources or not all(isinstance(source, kinds) for source in sources):
        raise ValueError(f"data = {shown(data)} must be {expected}, or a list of them")
    return sources


def search_options(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> dict[str, Any]:
    """The options of the search for `identify`, checked before a model prepares its data.

    **Example:**

    >>> from nonholonomic.identification import search_options
    >>> search_options(starts=0, spread=2.0, seed=0, max_steps=60, progress=False)
    Traceback (most recent call last):
    ValueError: starts = 0 ...
    """
    check_search(starts, spread, seed, max_steps, progress)
    return {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}


def posterior_of_data(
    build: Callable[[Any], Any],
    data: tuple[Any, ...],
    unknowns: dict[str, Free],
    priors: Any = None,
    slopes: str = "exact",
) -> LogDensity:
    """The posterior of a model, given sets of data.

    **Arguments:** `build`: function from the indices of measured predictions to the model; `priors`: name or end of a name
    -> prior, in addition to those of `unknowns`; the others as for `identify`.

    **Raises:** `ValueError` for priors that are no dictionary, or of an unknown name.

    **Example:**

    >>> from nonholonomic.identification import posterior_of_data
    >>> posterior_of_data(lambda seen: Model(scene, data, jnp.asarray(seen)), data, free, {"rate": (1.0, 0.5)})
    LogDensity of scene.rate, given 3 measurements
    """
    if priors is not None and not isinstance(priors, dict):
        raise ValueError(
            f"priors = {shown(priors)} must be a dictionary, name of a number -> (mean, standard deviation)"
        )
    by_name = {full_name("priors", name, list(unknowns)): prior for name, prior in (priors or {}).items()}
    measurements, _, seen = joined(data)
    return LogDensity.of(build(seen), measurements, unknowns, by_name, series_units(data), slopes)


def fit_data(
    build: Callable[[Any], Any],
    data: tuple[Any, ...],
    unknowns: dict[str, Free],
    search: dict[str, Any],
    slopes: str = "exact",
) -> Identification:
    """Fit a model to sets of data.

    **Arguments:** `build`: function from the indices of measured predictions to the model; `search`: `search_options`; the
    others as for `identify`.

    **Returns:** an `Identification`.

    **Example:** by central differences instead of derivatives.

    >>> rough = fit_data(lambda seen: Model(scene, data, jnp.asarray(seen)), data, free, search, slopes="differences")
    >>> print(f"{rough.estimates['scene.rate']:.3f}")
    0.997
    """
    measurements, labels, seen = joined(data)
    model = build(seen)
    fit = identify(model, measurements, unknowns, slopes=slopes, labels=labels, **search)
    own_names = {name: own_name(name) for name in unknowns}
    units = {name: "s" if own == "t0" else model.unit_of(own) for name, own in own_names.items()}
    return dataclasses.replace(fit, series_units=series_units(data), units=units)
