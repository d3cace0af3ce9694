"""What fits of tops, strollers and users' systems share: sets of data, their predictions, and the search.

Each of these fits adds the names of its parameters and the prediction of a set of data.
"""

import abc
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .data import joined, of_data
from .identify import check_search, identify
from .result import Identification
from .unknown import Free

#: Parameters of one set of data, name -> (rows,).
Values = dict[str, Float[Array, " rows"]]


class AbstractDataModel(eqx.Module):
    """Predictions of several sets of data, in the form that `identify` expects.

    `seen`: mask of the predictions that were measured.
    """

    data: eqx.AbstractVar[tuple[Any, ...]]
    seen: eqx.AbstractVar[Int[Array, " n"]]

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
        for alike in groups.values():
            predictions = self.predict([(self.data[k], values[k]) for k in alike], rows)
            parts |= dict(zip(alike, predictions, strict=True))
        return jnp.concatenate([parts[k] for k in range(len(self.data))], axis=1)[:, self.seen]


def as_sources(data: Any, kinds: Any, expected: str) -> tuple[Any, ...]:
    """Sets of data as a tuple.

    **Raises:** `ValueError`, with what was expected, unless there is at least one set and all are of these kinds.
    """
    sources = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not sources or not all(isinstance(source, kinds) for source in sources):
        raise ValueError(f"data = {data!r} must be {expected}, or a list of them")
    return sources


def search_options(starts: Any, spread: Any, seed: Any, max_steps: Any, progress: Any) -> dict[str, Any]:
    """The options of the search for `identify`, checked before a model prepares its data."""
    check_search(starts, spread, seed, max_steps, progress)
    return {"starts": starts, "spread": spread, "seed": seed, "max_steps": max_steps, "progress": progress}


def fit_data(
    build: Callable[[Any], Any],
    data: tuple[Any, ...],
    unknowns: dict[str, Free],
    search: dict[str, Any],
    slopes: str = "exact",
) -> Identification:
    """Fit a model to sets of data.

    **Arguments:** `build`: function from the mask of measured predictions to the model; `search`: `search_options`; the
    others as for `identify`.
    """
    measurements, labels, seen = joined(data)
    return identify(build(seen), measurements, unknowns, slopes=slopes, labels=labels, **search)
